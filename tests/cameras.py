"""Cameras for tests."""

from dataclasses import fields, replace
from typing import Any

from camera_calib.camera import Camera


def changed(camera: Camera, **values: Any) -> Camera:
    """The camera with fields of its size, its lens or its port set to other values."""
    size, lens, port = (
        {f.name: values.pop(f.name) for f in fields(part) if f.name in values}
        for part in (camera, camera.lens, camera.port)
    )
    assert not values, values
    return replace(
        camera,
        **{"lens": replace(camera.lens, **lens), "port": replace(camera.port, **port), **size},
    )
