"""OpenCV's numbers for a lens: camera matrix and distortion vector, and the half pixel between.

OpenCV, ROS and Kalibr count pixels from the centre of the first one, this project and COLMAP from
its outer corner: principal points differ by 0.5 and nothing else does.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from alice_survey.base.errors import CalibrationError
from alice_survey.base.frames import Array
from camera_calib.camera import Camera
from camera_calib.formats.fields import Fields
from camera_calib.lenses.opencv import COEFFICIENTS, OpenCVLens
from camera_calib.ports.flat import FlatPort

HALF_PIXEL = 0.5


def camera_matrix(camera: Camera) -> Array:
    """OpenCV's camera matrix, (3, 3), pixels counted from the first one's centre."""
    cx, cy = camera.cx_px - HALF_PIXEL, camera.cy_px - HALF_PIXEL
    return np.array([[camera.fx_px, 0.0, cx], [0.0, camera.fy_px, cy], [0.0, 0.0, 1.0]])


def distortion(camera: Camera) -> Array:
    """OpenCV's distortion coefficients: 5, 8 or 12, as few as hold the camera's."""
    every = np.array([camera.parameter(name) for name in COEFFICIENTS])
    count = 12 if np.any(every[8:]) else 8 if np.any(every[5:]) else 5
    return every[:count]


def distorts(camera: Camera, *names: str) -> bool:
    """Whether any of these coefficients is not zero."""
    return any(name in camera.parameters and camera.parameter(name) != 0.0 for name in names)


def read_camera(
    fields: Fields, matrix_key: str, distortion_key: str | None, size: tuple[int, int]
) -> Camera:
    """A camera in air from a camera matrix and a vector of distortion coefficients.

    Args:
        fields: where both are.
        matrix_key: key of the 3 x 3 matrix.
        distortion_key: key of 4, 5, 8, 12 or 14 coefficients; None when there is no distortion.
        size: width and height, px.

    Raises:
        CalibrationError: a value is missing or wrong, the pixels are skewed or the sensor tilted.
    """
    matrix = fields.matrix(matrix_key, 3, 3)
    if np.any(matrix[[0, 1, 2, 2], [1, 0, 0, 1]]) or matrix[2, 2] != 1.0:
        raise fields.fault(matrix_key, "is not of the form [fx 0 cx; 0 fy cy; 0 0 1]")
    k = np.zeros(0)
    if distortion_key is not None:
        k = fields.vector(distortion_key, 4, 5, 8, 12, 14)
        if np.any(k[12:]):
            raise fields.fault(distortion_key, "tilts the sensor, which no rig here can hold")
    return camera_in_air(
        fields,
        matrix_key,
        size,
        lens=(matrix[0, 0], matrix[1, 1], matrix[0, 2] + HALF_PIXEL, matrix[1, 2] + HALF_PIXEL),
        coefficients=dict(zip(COEFFICIENTS, k.tolist(), strict=False)),
    )


def camera_in_air(
    fields: Fields,
    key: str,
    size: tuple[int, int],
    *,
    lens: tuple[float, float, float, float],
    coefficients: dict[str, float],
) -> Camera:
    """A camera without a port.

    Args:
        fields: where the numbers come from.
        key: key of the focal lengths, named when they are wrong.
        size: width and height, px.
        lens: fx, fy, cx, cy in this project's pixels.
        coefficients: coefficients of the distortion, by this project's names.
    """
    fx, fy, cx, cy = map(float, lens)
    if min(fx, fy) <= 0:
        raise fields.fault(key, f"has focal lengths of {fx:g} and {fy:g} px")
    try:
        return Camera(
            width_px=size[0],
            height_px=size[1],
            lens=OpenCVLens(fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy, **coefficients),
        )
    except CalibrationError as error:
        raise fields.fault(key, f"is of no camera: {error}") from None


def behind_port(fields: Fields, key: str, camera: Camera, **port: Any) -> Camera:
    """A camera with the port of a file.

    Args:
        fields: where the port is.
        key: key of the port.
        camera: in air.
        **port: fields of `FlatPort`.

    Raises:
        CalibrationError: a value is out of range; the message names file and key.
    """
    try:
        return replace(camera, port=FlatPort(**port))
    except CalibrationError as error:
        raise fields.fault(key, f"is not a port: {error}") from None
