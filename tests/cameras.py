"""Cameras for tests."""

from dataclasses import fields, replace
from typing import Any

from camera_calib.camera import Camera
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.ports.flat import FlatPort


def flat_port_camera(*, width_px: int, height_px: int, **values: Any) -> Camera:
    """A camera with OpenCV's lens behind a flat port, from the fields of both."""
    lens = {name: values.pop(name) for name in OpenCVLens.parameters if name in values}
    return Camera(
        width_px=width_px, height_px=height_px, lens=OpenCVLens(**lens), port=FlatPort(**values)
    )


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
