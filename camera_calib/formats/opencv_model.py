"""OpenCV's numbers for a lens: camera matrix and distortion vector, and the half pixel between.

OpenCV, ROS and Kalibr count pixels from the centre of the first one, this project and COLMAP from
its outer corner: principal points differ by 0.5 and nothing else does.
"""

from collections.abc import Mapping
from dataclasses import fields as dataclass_fields
from dataclasses import replace
from typing import Any

import numpy as np

from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from camera_calib.camera import Camera
from camera_calib.formats.fields import Fields
from camera_calib.lenses.fisheye import COEFFICIENTS as FISHEYE_COEFFICIENTS
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.lenses.opencv import COEFFICIENTS, OpenCVLens
from camera_calib.lenses.values import FOCAL_AND_CENTRE, LensValues
from camera_calib.ports.values import PortValues

HALF_PIXEL = 0.5
FISHEYE = FisheyeLens.model
LENS_NAMES: Mapping[str, type[LensValues]] = {
    FISHEYE: FisheyeLens,
    "equidistant": FisheyeLens,
    "opencv": OpenCVLens,
    "radtan": OpenCVLens,
    "plumb_bob": OpenCVLens,
    "rational_polynomial": OpenCVLens,
}
"""Lenses by the names of their distortion models in files and options."""


def camera_matrix(camera: Camera) -> Array:
    """OpenCV's camera matrix, (3, 3), pixels counted from the first one's centre."""
    cx, cy = camera.cx_px - HALF_PIXEL, camera.cy_px - HALF_PIXEL
    return np.array([[camera.fx_px, 0.0, cx], [0.0, camera.fy_px, cy], [0.0, 0.0, 1.0]])


def is_fisheye(camera: Camera) -> bool:
    """Whether a camera's distortion vector is that of OpenCV's `fisheye`."""
    return camera.lens.model == FISHEYE


def distortion(camera: Camera) -> Array:
    """Distortion coefficients: 4 of a fisheye, else OpenCV's 5, 8 or 12, as few as hold them."""
    if is_fisheye(camera):
        return np.array([camera.parameter(name) for name in FISHEYE_COEFFICIENTS])
    every = np.array([camera.parameter(name) for name in COEFFICIENTS])
    count = 12 if np.any(every[8:]) else 8 if np.any(every[5:]) else 5
    return every[:count]


def distorts(camera: Camera, *names: str) -> bool:
    """Whether any of these coefficients of OpenCV's pinhole is not zero."""
    return not is_fisheye(camera) and any(camera.parameter(name) != 0.0 for name in names)


def read_camera(
    fields: Fields,
    matrix_key: str,
    distortion_key: str | None,
    size: tuple[int, int],
    kind: type[LensValues] = OpenCVLens,
) -> Camera:
    """A camera in air from a camera matrix and a vector of distortion coefficients.

    Args:
        fields: where both are.
        matrix_key: key of the 3 x 3 matrix.
        distortion_key: key of the coefficients, 4 of a fisheye, else 4, 5, 8, 12 or 14; None when
            there is no distortion.
        size: width and height, px.
        kind: of the lens.

    Raises:
        CalibrationError: a value is missing or wrong, the pixels are skewed or the sensor tilted.
    """
    matrix = fields.matrix(matrix_key, 3, 3)
    if np.any(matrix[[0, 1, 2, 2], [1, 0, 0, 1]]) or matrix[2, 2] != 1.0:
        raise fields.fault(matrix_key, "is not of the form [fx 0 cx; 0 fy cy; 0 0 1]")
    k = np.zeros(0)
    if distortion_key is not None:
        counts = (4,) if kind is FisheyeLens else (4, 5, 8, 12, 14)
        k = fields.vector(distortion_key, *counts)
        if np.any(k[12:]):
            raise fields.fault(distortion_key, "tilts the sensor, which no rig here can hold")
    return counted_from_centre(
        fields, matrix_key, size, kind, matrix[[0, 1, 0, 1], [0, 1, 2, 2]], k
    )


def counted_from_centre(
    fields: Fields,
    key: str,
    size: tuple[int, int],
    kind: type[LensValues],
    focal_and_centre: Array,
    k: Array,
) -> Camera:
    """A camera in air from numbers that count pixels from the centre of the first one.

    Args:
        fields: where the numbers come from.
        key: key of the focal lengths, named when they are wrong.
        size: width and height, px.
        kind: of the lens.
        focal_and_centre: (4,) fx, fy, cx, cy.
        k: the first distortion coefficients, in OpenCV's order.
    """
    fx, fy, cx, cy = focal_and_centre.tolist()
    numbers = [fx, fy, cx + HALF_PIXEL, cy + HALF_PIXEL, *k.tolist()]
    values = dict(zip(kind.parameters, numbers, strict=False))
    return camera_in_air(fields, key, size, kind, values)


def camera_in_air(
    fields: Fields,
    key: str,
    size: tuple[int, int],
    kind: type[LensValues],
    values: dict[str, float],
) -> Camera:
    """A camera without a port.

    Args:
        fields: where the numbers come from.
        key: key of the focal lengths, named when they are wrong.
        size: width and height, px.
        kind: of the lens.
        values: by its `parameters`, in this project's pixels.
    """
    fx, fy = values[FOCAL_AND_CENTRE[0]], values[FOCAL_AND_CENTRE[1]]
    if min(fx, fy) <= 0:
        raise fields.fault(key, f"has focal lengths of {fx:g} and {fy:g} px")
    try:
        return Camera(width_px=size[0], height_px=size[1], lens=kind(**values))
    except CalibrationError as error:
        raise fields.fault(key, f"is of no camera: {error}") from None


def behind_port(
    fields: Fields, key: str, camera: Camera, kind: type[PortValues], **values: Any
) -> Camera:
    """A camera with the port of a file.

    Args:
        fields: where the port is.
        key: key of the port.
        camera: in air.
        kind: of the port.
        **values: its fields.

    Raises:
        CalibrationError: a value is out of range; the message names file and key.
    """
    try:
        return replace(camera, port=kind(**values))
    except CalibrationError as error:
        raise fields.fault(key, f"is not a port: {error}") from None


def read_port(fields: Fields, key: str, camera: Camera, kind: type[PortValues]) -> Camera:
    """A camera with the port whose fields a file has by our names below a key."""
    port = fields.fields(key)
    values: dict[str, Any] = {}
    for each in dataclass_fields(kind):
        numbers = port.vector(each.name, 3 if each.name == "normal" else 1).tolist()
        values[each.name] = tuple(numbers) if each.name == "normal" else numbers[0]
    return behind_port(fields, key, camera, kind, **values)
