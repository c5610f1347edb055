"""OpenCV's numbers for a lens: camera matrix and distortion vector, and the half pixel between.

OpenCV, ROS and Kalibr count pixels from the centre of the first one, this project and COLMAP from
its outer corner: principal points differ by 0.5 and nothing else does. A model that no lens here
holds becomes the nearest lens, by `nearest_camera`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import CalibrationError, warn
from alice_survey.core.frames import Array
from camera_calib.camera import Camera
from camera_calib.formats import fields, rigs
from camera_calib.lenses.fisheye import COEFFICIENTS as FISHEYE_COEFFICIENTS
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.lenses.opencv import COEFFICIENTS, OpenCVLens
from camera_calib.lenses.values import FOCAL_AND_CENTRE, LensValues
from camera_calib.ports.none import NO_PORT
from camera_calib.ports.values import PortValues

FISHEYE = FisheyeLens.model
LENS_NAMES: Mapping[str, type[LensValues]] = {
    **dict.fromkeys((FISHEYE, "equidistant", "KannalaBrandt8", "3"), FisheyeLens),
    **dict.fromkeys(("opencv", "radtan", "radial-tangential", "none", "plumb_bob"), OpenCVLens),
    **dict.fromkeys(("rational_polynomial", "PinHole", "Rectified", "0", "1", "2"), OpenCVLens),
}
"""Lenses by the names of their distortion models in files and options; numbers are Matisse's."""
_HALF_PIXEL = 0.5
_CANCELLING_PX = 0.01
"""Penalty of a distortion coefficient of 1: of fits that hardly differ, it prefers the one with the
smallest coefficients; the residual grows by less than 1 % for it."""
_FOLDED_PX = 1e4
"""Residual of a point beyond the fold of a lens, while it is fitted."""
_GRID, _ROUNDS = 15, 4
"""Places along each side of the frame at which a lens is fitted; fits with rays of the last."""
Terms = fields.numbers_model(("fx", "fy", "cx", "cy"), COEFFICIENTS)
MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "M", "K", "k", "mtx")


class CameraKeys(fields.FileModel):
    """A camera by the keys of OpenCV, ROS, Kalibr, EuRoC, Matisse and of examples in Python."""

    matrix: fields.Matrix33 | None = fields.keys(*MATRIX)
    coefficients: fields.Numbers | None = fields.keys(
        "distortion_coefficients", "distCoeffs", "Distortion_Coefficients", "D", "d", "dist",
        "dist_coeff", "dist_coeffs", "distortion_coeffs", "distortion_coeff",
    )  # fmt: skip
    model: str | int | None = fields.keys("distortion_model")
    width: fields.Pixels | None = fields.keys(
        "image_width", "image_Width", "width", "full_sensor_width"
    )
    height: fields.Pixels | None = fields.keys(
        "image_height", "image_Height", "height", "full_sensor_height"
    )
    size: tuple[fields.Pixels, fields.Pixels] | None = fields.keys("imageSize", "image_size")
    name: str | None = fields.keys("camera_name")
    names: list[str] | str | None = fields.keys("camera_names")
    """OpenCV's XML has no other way to write a list of one than its text."""

    def camera(self, path: Path, prefix: str, reading: rigs.ReadOptions) -> Camera:
        """The camera in air.

        Args:
            path: of its file.
            prefix: words or keys that lead to it, for messages.
            reading: values that the file may lack.

        Raises:
            CalibrationError: a value is missing or out of range.
        """
        k, where = self.coefficients, f"{path}: {prefix}"
        name = str(reading.lens or "opencv" if self.model is None else self.model)
        if name not in LENS_NAMES:
            key = "--lens" if self.model is None else "distortion_model"
            raise CalibrationError(f"{where}{key} is {name}; {', '.join(LENS_NAMES)} can be read")
        if self.matrix is None:
            raise CalibrationError(f"{where}lacks camera_matrix: is it a calibration?")
        if k is not None and len(k) == 4 and self.model is None and reading.lens is None:
            warn(f"{where}4 coefficients taken for k1 k2 p1 p2: a fisheye needs --lens fisheye")
        size = self.size or (self.width or 0, self.height or 0)
        size = size if all(size) else reading.size(path)
        return camera_of_matrix(f"{where}camera_matrix", self.matrix, k, size, LENS_NAMES[name])


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
        k: coefficients, 3 or 4 of a fisheye, else 1, 4, 5, 8, 12 or 14 of OpenCV, or 3: k1 k2 k3;
            None: there is no distortion.
        size: width and height, px.
        kind: of the lens.

    Raises:
        CalibrationError: the values are of no camera, pixels are skewed, or the sensor is tilted.
    """
    if np.any(matrix[[0, 1, 2, 2], [1, 0, 0, 1]]) or matrix[2, 2] != 1.0:
        raise CalibrationError(f"{where} is not of the form [fx 0 cx; 0 fy cy; 0 0 1]")
    k = np.zeros(0) if k is None else k
    counts = (0, 3, 4) if kind is FisheyeLens else (0, 1, 3, 4, 5, 8, 12, 14)
    if kind is FisheyeLens and not np.any(k[4:]):
        k = k[:4]
    elif kind is OpenCVLens and len(k) == 3:
        k = np.array([*k[:2], 0.0, 0.0, k[2]])
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


def camera_of_terms(
    path: Path,
    prefix: str,
    values: Mapping[str, Any],
    size: tuple[int, int],
    lens: type[LensValues],
) -> Camera:
    """A camera in air from fx, fy, cx, cy (counted as `camera_of_numbers`) and k1, p1 ... by name.

    Raises:
        CalibrationError: a value is missing, unknown or out of range.
    """
    terms = Terms.check(path, values, prefix, ()).model_dump()
    numbers = [terms[name.removesuffix("_px")] for name in lens.parameters]
    return camera_of_numbers(f"{path}: {prefix}fx", numbers, size, lens)


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


@dataclass(frozen=True, kw_only=True, eq=False)
class StandIn:
    """A camera without port that stands in for another, and what it leaves."""

    model: str
    """COLMAP's name of its lens model."""
    camera: Camera
    approx_from_cam: RigidTransform
    """From the other camera's frame to its own."""
    rms_px: float
    """Error over the frame's area and the distances."""
    max_px: float
    """Largest error in the frame, its corners included, at any of the distances."""


def fit_camera(
    first: Camera,
    terms: Sequence[str],
    points: Array,
    pixels: Array,
    pose: Callable[[Array], RigidTransform] = lambda _: RigidTransform.identity(),
    pose_unknowns: int = 0,
) -> StandIn:
    """Fit a camera without port to what another sees over a grid of its frame.

    Args:
        first: to start from.
        terms: distortion coefficients that are free, besides focal lengths and centre.
        points: (D, N, N, 3) points at D distances, which count alike, metres.
        pixels: (N, N, 2) or (D, N, N, 2) where the other camera sees them.
        pose: from the other camera's frame, by further unknowns that start at 0.
        pose_unknowns: how many.
    """
    side = np.r_[0.5, np.ones(len(points[0]) - 2), 0.5] / (len(points[0]) - 1)
    weights = np.sqrt(np.outer(side, side) / len(points))[..., None]
    names = (*FOCAL_AND_CENTRE, *terms)

    def camera(unknowns: Array) -> Camera:
        values = dict(zip(names, unknowns[pose_unknowns:].tolist(), strict=True))
        return first.with_parameters(values)

    def errors(unknowns: Array) -> Array:
        seen = pose(unknowns).apply(points.reshape(-1, 3)).reshape(points.shape)
        return np.nan_to_num(camera(unknowns).project(seen) - pixels, nan=_FOLDED_PX)

    def cost(unknowns: Array) -> Array:
        regular = _CANCELLING_PX * unknowns[pose_unknowns + 4 :]
        return np.append(errors(unknowns) * weights, regular)

    start = np.r_[np.zeros(pose_unknowns), [first.parameter(name) for name in names]]
    found = least_squares(cost, start, x_scale="jac", max_nfev=200).x
    sizes = np.linalg.norm(errors(found), axis=-1)
    return StandIn(
        model="OPENCV_FISHEYE" if is_fisheye(first) else "OPENCV",
        camera=camera(found),
        approx_from_cam=pose(found),
        rms_px=float(np.sqrt(np.sum((sizes * weights[..., 0]) ** 2))),
        max_px=float(sizes.max()),
    )


def nearest_camera(
    where: str, first: Camera, terms: Sequence[str], project: Callable[[Array], Array]
) -> Camera:
    """The camera that comes nearest to a model that no lens here holds; a warning states how near.

    Args:
        where: file and model, for messages.
        first: to start from.
        terms: coefficients that are free.
        project: rays (..., 3) to pixels of this project (..., 2), of that model.

    Raises:
        CalibrationError: the nearest camera is no lens over all of the frame.
    """
    found, grid = first, first.frame_grid(_GRID, _GRID)
    for _ in range(_ROUNDS):
        rays = found.unproject(grid)[1]
        rays = np.where(np.isfinite(rays), rays, [0.0, 0.0, 1.0])
        fit = fit_camera(found, terms, rays[None], project(rays))
        found = fit.camera
    if not np.isfinite(found.unproject(grid)[1]).all() or fit.max_px > 0.5 * _FOLDED_PX:
        raise CalibrationError(
            f"{where}: the nearest {found.lens.model} lens ends inside the frame"
        )
    warn(
        f"{where}: no lens here holds it: converted to the nearest {fit.model}, "
        f"{fit.rms_px:.2g} px rms and {fit.max_px:.2g} px at most over the frame"
    )
    return found
