"""OpenCV's numbers for a lens: camera matrix and distortion vector, and the half pixel between.

OpenCV, ROS and Kalibr count pixels from the centre of the first one, this project and COLMAP from
its outer corner: principal points differ by 0.5 and nothing else does.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from camera_calib.camera import Camera
from camera_calib.lenses.fisheye import COEFFICIENTS as FISHEYE_COEFFICIENTS
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.lenses.opencv import COEFFICIENTS, OpenCVLens
from camera_calib.lenses.values import LensValues
from camera_calib.ports.none import NO_PORT
from camera_calib.ports.values import PortValues

FISHEYE = FisheyeLens.model
LENS_NAMES: Mapping[str, type[LensValues]] = {
    FISHEYE: FisheyeLens,
    "equidistant": FisheyeLens,
    "opencv": OpenCVLens,
    "radtan": OpenCVLens,
    "none": OpenCVLens,
    "plumb_bob": OpenCVLens,
    "rational_polynomial": OpenCVLens,
}
"""Lenses by the names of their distortion models in files and options."""
_HALF_PIXEL = 0.5


def focal_and_centre(camera: Camera) -> list[float]:
    """OpenCV's fx, fy, cx and cy, pixels counted from the first one's centre."""
    return [camera.fx_px, camera.fy_px, camera.cx_px - _HALF_PIXEL, camera.cy_px - _HALF_PIXEL]


def camera_matrix(camera: Camera) -> Array:
    """OpenCV's camera matrix, (3, 3)."""
    fx, fy, cx, cy = focal_and_centre(camera)
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


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


def camera_of_matrix(
    where: str,
    matrix: Array,
    k: Array | None,
    size: tuple[int, int],
    kind: type[LensValues] = OpenCVLens,
) -> Camera:
    """A camera in air from a camera matrix and a vector of distortion coefficients.

    Args:
        where: file and key, for messages.
        matrix: (3, 3).
        k: coefficients, 4 of a fisheye, else 4, 5, 8, 12 or 14; None: there is no distortion.
        size: width and height, px.
        kind: of the lens.

    Raises:
        CalibrationError: the values are of no camera, pixels are skewed, or the sensor is tilted.
    """
    if np.any(matrix[[0, 1, 2, 2], [1, 0, 0, 1]]) or matrix[2, 2] != 1.0:
        raise CalibrationError(f"{where} is not of the form [fx 0 cx; 0 fy cy; 0 0 1]")
    k = np.zeros(0) if k is None else k
    counts = (0, 4) if kind is FisheyeLens else (0, 4, 5, 8, 12, 14)
    if len(k) not in counts:
        expected = " or ".join(map(str, counts[1:]))
        raise CalibrationError(f"{where}: {len(k)} distortion_coefficients; {expected} expected")
    if np.any(k[12:]):
        raise CalibrationError(
            f"{where}: distortion_coefficients tilt the sensor, which no rig here can hold"
        )
    return camera_of_numbers(where, [*matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *k], size, kind)


def camera_of_numbers(
    where: str, numbers: Any, size: tuple[int, int], kind: type[LensValues]
) -> Camera:
    """A camera in air from numbers that count pixels from the centre of the first one.

    Args:
        where: file and key, for messages.
        numbers: fx, fy, cx, cy, and the first distortion coefficients in OpenCV's order.
        size: width and height, px.
        kind: of the lens.
    """
    fx, fy, cx, cy, *k = map(float, numbers)
    centred = [fx, fy, cx + _HALF_PIXEL, cy + _HALF_PIXEL, *k]
    return camera_of(where, size, kind, dict(zip(kind.parameters, centred, strict=False)))


def camera_of(
    where: str,
    size: tuple[int, int],
    kind: type[LensValues],
    values: Mapping[str, float],
    port: type[PortValues] | None = None,
    port_values: Mapping[str, Any] | None = None,
) -> Camera:
    """A camera of the values of a file.

    Args:
        where: file and key, for messages.
        size: width and height, px.
        kind: of the lens.
        values: of the lens, in this project's pixels.
        port: kind of the port, if there is one.
        port_values: its values.

    Raises:
        CalibrationError: a value is out of range; the message names file and key.
    """
    try:
        behind = NO_PORT if port is None else port(**(port_values or {}))
        return Camera(width_px=size[0], height_px=size[1], lens=kind(**values), port=behind)
    except CalibrationError as error:
        raise CalibrationError(f"{where} is of no camera: {error}") from None
