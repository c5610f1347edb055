"""Effect of a calibrated rig's covariance on pixels, points and lengths.

Everything here is first order: a parameter error d moves a pixel by J d and has the covariance S,
so the pixel's is J S J^T. The derivatives J are the analytic ones of `Camera`.
"""

import math
import re
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import json_values
from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from alice_survey.kit.words import field_table, with_sigma
from camera_calib.camera import Camera, pose_jacobian
from camera_calib.freedom import POSE, all_names, slope_columns, value
from camera_calib.rig import Covariance, Rig, read_rig
from camera_calib.target_shape import TargetShape

_OVERLAP_GRID = 25
"""Pixels a side of the reference frame at which the overlap of the cameras is evaluated."""
_EDGE_PX = 1e-6
"""Tolerance above rounding: a point on the edge of a frame is in it."""
_READER_UNITS = (("_px", 1.0, "px"), ("_m", 1e3, "mm"), ("_rad", math.degrees(1.0), "deg"))
"""Endings of parameters, and the factors to the units in which they are shown."""
RANGES_M = (0.5, 1.0, 2.0, 4.0, 8.0)
_GRID = 11
_PARAMETERS = {
    "parameter": "{name}", "value": "{known}", "unit": "{unit}",
    "correlates most with": "{other}",
}  # fmt: skip
_PROJECTIONS = {
    "camera": "{camera}", "at": "{range_m:g} m",
    "best pose, median/worst": "{compensated_median_px:.3f} / {compensated_worst_px:.3f} px",
    "fixed pose, median/worst": "{plain_median_px:.3f} / {plain_worst_px:.3f} px",
}  # fmt: skip
_STEREO = {
    "at": "{at.range_m:g} m", "depth": "{mm[0]:.3g} mm", "shape": "{mm[1]:.3g} mm",
    "noise": "{mm[2]:.3g} mm", "a length": "{mm[3]:.3g} mm of {at.length_m:.2f} m",
}  # fmt: skip


def covariance_of(rig: Rig) -> Covariance:
    """The rig's covariance.

    Raises:
        CalibrationError: it has none, or one of parameters that a rig does not have.
    """
    if rig.covariance is None:
        raise CalibrationError(
            f"the rig ({rig.source}) has no covariance, so its uncertainty is unknown: calibrate it"
        )
    unknown = set(rig.covariance.parameters) - set(all_names(rig))
    if unknown:
        raise CalibrationError(f"the rig's covariance has {unknown.pop()}, which the rig has not")
    return rig.covariance


def camera_slopes(rig: Rig, camera: str, points_cam: Array) -> tuple[Array, Array, Array]:
    """Project points that are fixed to one camera, with slopes by the rig's parameters.

    Args:
        rig: with its covariance.
        camera: which of its cameras.
        points_cam: (N, 3) in that camera's frame, metres.

    Returns:
        Pixels (N, 2); slopes by the point (N, 2, 3); by the P parameters of the covariance
        (N, 2, P), those of poses and of other cameras being 0. NaN where nothing is projected.
    """
    pixels, by_point, by_own = rig.cameras[camera].project_jacobian(points_cam)
    names = covariance_of(rig).parameters
    columns, at = slope_columns(rig, names, camera)
    own = columns < by_own.shape[-1]
    by_parameter = np.zeros((*pixels.shape, len(names)))
    by_parameter[..., at[own]] = by_own[..., columns[own]]
    return pixels, by_point, by_parameter


def rig_slopes(rig: Rig, camera: str, points_rig: Array) -> tuple[Array, Array, Array]:
    """As `camera_slopes`, for points (N, 3) fixed to the rig's frame: its pose counts too.

    Rotations are small turns about the camera's axes, as in `freedom`.
    """
    pose = rig.cam_from_rig[camera]
    pixels, by_point, by_parameter = camera_slopes(rig, camera, pose.apply(points_rig))
    by_pose = pose_jacobian(by_point, pose.rotation.apply(points_rig))
    columns, at = slope_columns(rig, covariance_of(rig).parameters, camera)
    columns = columns - len(rig.cameras[camera].parameters)
    by_parameter[..., at[columns >= 0]] = by_pose[..., columns[columns >= 0]]
    return pixels, by_point @ pose.rotation.as_matrix(), by_parameter


def compensation(rig: Rig, camera: str, anchors_cam: Array) -> Array:
    """Change of the best-fitting pose with each parameter's error, (6, P).

    A rotation and a translation of the anchors, small, in the camera's frame, chosen so that their
    projections move least overall.

    Raises:
        CalibrationError: the anchors do not determine a pose.
    """
    _, by_point, by_parameter = camera_slopes(rig, camera, anchors_cam)
    seen = np.isfinite(by_parameter).all(axis=(1, 2)) & np.isfinite(by_point).all(axis=(1, 2))
    by_pose = pose_jacobian(by_point, anchors_cam)[seen].reshape(-1, 6)
    if len(by_pose) < 6 or np.linalg.matrix_rank(by_pose) < 6:
        raise CalibrationError(
            f"{camera}: {int(seen.sum())} points do not hold a pose; at least 3, not on one line, "
            "are needed"
        )
    moved = by_parameter[seen].reshape(len(by_pose), -1)
    return -taken_up(by_pose, moved)


def taken_up(slopes: Array, moved: Array) -> Array:
    """Unknowns (K, P), the least ones, whose slopes (M, K) come nearest to what moved (M, P)."""
    inverse = np.linalg.pinv(slopes.T @ slopes, rcond=1e-14, hermitian=True)
    return np.asarray(inverse @ (slopes.T @ moved), dtype=np.float64)


def frame_points(camera: Camera, ranges_m: tuple[float, ...]) -> Array:
    """Points over the frame at some distances, (N, 3) in the camera's frame."""
    pixels = camera.frame_grid(9, 9).reshape(-1, 2)
    points = np.concatenate([camera.at_depth(pixels, r) for r in ranges_m])
    return np.asarray(points[np.isfinite(points).all(axis=1)])


@dataclass(frozen=True, kw_only=True, eq=False)
class ProjectionSigma:
    """Uncertainty of a projection, along its worst direction, px; shaped as the pixels."""

    plain_px: Array
    """Uncertainty of a point fixed to the camera: applies to a rig that measures by itself."""
    compensated_px: Array
    """Uncertainty of a point fixed to the scene, after the pose that projects the targets most
    alike compensates: applies to pictures with poses estimated from them. Errors of the targets'
    own poses do not count; in mrcal 2.2 (`projection_uncertainty`) they do, as a point is there
    fixed to the mean of all boards. Both agree towards the edges; in the middle of the frame, at
    distances where no board was, mrcal's is several times larger."""


def projection_sigma(
    rig: Rig, camera: str, pixels: Array, range_m: float, compensating: Array
) -> ProjectionSigma:
    """Uncertainty of projection from the calibration alone.

    Args:
        rig: with its covariance.
        camera: which camera.
        pixels: (..., 2) where to evaluate.
        range_m: distance of the points from the entrance pupil along the axis.
        compensating: (6, P) from `compensation`; its anchors are best all points of the target that
            the camera saw.
    """
    matrix = covariance_of(rig).matrix
    flat = pixels.reshape(-1, 2)
    points = rig.cameras[camera].at_depth(flat, range_m)
    _, by_point, plain = camera_slopes(rig, camera, points)
    moved = plain + pose_jacobian(by_point, points) @ compensating
    shape = pixels.shape[:-1]
    return ProjectionSigma(
        plain_px=_worst_sigma(plain, matrix).reshape(shape),
        compensated_px=_worst_sigma(moved, matrix).reshape(shape),
    )


def _worst_sigma(slopes: Array, matrix: Array) -> Array:
    """(N,) largest standard deviation in any direction, of (N, D, P) slopes; NaN rows stay."""
    covariance = slopes @ matrix @ np.swapaxes(slopes, 1, 2)
    known = np.isfinite(covariance).all(axis=(1, 2))
    sigma = np.full(len(slopes), np.nan)
    sigma[known] = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance[known])[:, -1], 0.0))
    return sigma


def _triangulation(rig: Rig, points_rig: Array) -> tuple[Array, Array]:
    """Derivatives of triangulated points by the parameters, (N, 3, P), and pixels, (N, 3, 2C).

    Pixels are held and the point with the least reprojection error is taken: with G the slopes by
    the point, dp = -(G^T G)^-1 G^T J d. NaN where fewer than two cameras see a point.
    """
    by_points, by_parameters, seen = [], [], []
    for camera, model in rig.cameras.items():
        pixels, by_point, by_parameter = rig_slopes(rig, camera, points_rig)
        inside = _in_frame(model, pixels)
        by_points.append(np.where(inside[:, None, None], by_point, 0.0))
        by_parameters.append(np.where(inside[:, None, None], by_parameter, 0.0))
        seen.append(inside)
    g, j = np.concatenate(by_points, axis=1), np.concatenate(by_parameters, axis=1)
    known: NDArray[np.bool_] = np.asarray(np.stack(seen).sum(axis=0) >= 2)
    gain = np.full((len(points_rig), 3, g.shape[1]), np.nan)
    g_known = g[known]
    transposed = np.swapaxes(g_known, 1, 2)
    gain[known] = np.linalg.solve(transposed @ g_known, transposed)
    return -gain @ j, gain


def _sigmas(rig: Rig, slopes: Array) -> Array:
    """Standard deviations (...) of what follows the rig's parameters by slopes (..., P)."""
    variance = np.einsum("...p,pq,...q->...", slopes, covariance_of(rig).matrix, slopes)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def point_sigmas_m(rig: Rig, points_rig: Array) -> Array:
    """Standard deviations of triangulated points by calibration alone, (N, 3) along the rig's axes.

    NaN where fewer than two cameras have a point in their frames.
    """
    follow, _ = _triangulation(rig, points_rig)
    return _sigmas(rig, follow)


def shape_sigmas_m(rig: Rig, points_rig: Array) -> Array:
    """As `point_sigmas_m`, after the best rigid motion of all points: their shape.

    A survey's frame takes up the motion; the rest bends the model.
    """
    follow, _ = _triangulation(rig, points_rig)
    known = np.isfinite(follow).all(axis=(1, 2))
    shape = np.full(points_rig.shape, np.nan)
    if known.sum() < 3:
        return shape
    centred = points_rig[known] - points_rig[known].mean(axis=0)
    motion = pose_jacobian(np.broadcast_to(np.eye(3), (len(centred), 3, 3)), centred).reshape(-1, 6)
    moved = follow[known].reshape(len(motion), -1)
    left = (moved - motion @ taken_up(motion, moved)).reshape(-1, 3, moved.shape[1])
    shape[known] = _sigmas(rig, left)
    return shape


def noise_sigmas_m(rig: Rig, points_rig: Array, noise_px: float) -> Array:
    """Standard deviations (N, 3) of triangulated points by the noise of one pixel coordinate."""
    _, gain = _triangulation(rig, points_rig)
    return np.asarray(noise_px * np.sqrt((gain**2).sum(axis=-1)))


def length_sigmas_m(rig: Rig, starts_rig: Array, ends_rig: Array) -> Array:
    """Standard deviations (N,) of triangulated distances by calibration alone."""
    along = ends_rig - starts_rig
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    follow = _triangulation(rig, ends_rig)[0] - _triangulation(rig, starts_rig)[0]
    return _sigmas(rig, np.einsum("na,nap->np", along, follow))


def overlap_points(rig: Rig, range_m: float) -> Array:
    """Points at one distance that at least two cameras have in their frames, (N, 3) in `rig`."""
    reference = rig.cameras[rig.reference]
    pixels = reference.frame_grid(_OVERLAP_GRID, _OVERLAP_GRID).reshape(-1, 2)
    points = rig.cam_from_rig[rig.reference].inv().apply(reference.at_depth(pixels, range_m))
    count = np.zeros(len(points), dtype=int)
    for camera, model in rig.cameras.items():
        count += _in_frame(model, model.project(rig.cam_from_rig[camera].apply(points)))
    return points[count >= 2]


def _in_frame(camera: Camera, pixels: Array) -> NDArray[np.bool_]:
    x, y = pixels[:, 0], pixels[:, 1]
    right, bottom = camera.width_px + _EDGE_PX, camera.height_px + _EDGE_PX
    return (x >= -_EDGE_PX) & (x <= right) & (y >= -_EDGE_PX) & (y <= bottom)


@dataclass(frozen=True, kw_only=True)
class StereoSigma:
    """Stereo uncertainty at one distance; NaN where no two cameras see the same."""

    range_m: float
    point_m: tuple[float, ...] = (math.nan,) * 3
    """Sigmas right, down, forward of a point mid-overlap, by calibration alone."""
    worst_shape_m: float = math.nan
    """Largest sigma forward in the overlap, after the best rigid motion."""
    noise_m: tuple[float, ...] = (math.nan,) * 3
    """Sigmas of the same point as `point_m`, by the noise of its pixels alone."""
    length_m: float = math.nan
    """A length across the overlap: 1 m, or what fits."""
    length_sigma_m: float = math.nan
    """Sigma of the length, by calibration alone."""


def stereo_sigma(rig: Rig, range_m: float, noise_px: float) -> StereoSigma:
    """Uncertainty of triangulated points and lengths at one distance.

    Args:
        rig: with its covariance, two cameras or more.
        range_m: from the reference camera's entrance pupil along its axis.
        noise_px: standard deviation of one measured coordinate, for comparison.
    """
    points = overlap_points(rig, range_m)
    if len(points) < 2:
        return StereoSigma(range_m=range_m)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    centre = points[np.argmin(np.linalg.norm(points - middle, axis=1))]
    reach = min(centre[0] - points[:, 0].min(), points[:, 0].max() - centre[0])
    half = min(0.5, 0.95 * float(reach)) * np.array([1.0, 0.0, 0.0])
    at_centre = point_sigmas_m(rig, centre[None])[0]
    noise = noise_sigmas_m(rig, centre[None], noise_px)[0]
    length = length_sigmas_m(rig, (centre - half)[None], (centre + half)[None])
    return StereoSigma(
        range_m=range_m,
        point_m=tuple(at_centre.tolist()),
        worst_shape_m=float(np.nanmax(shape_sigmas_m(rig, points)[:, 2])),
        noise_m=tuple(noise.tolist()),
        length_m=2 * float(half[0]),
        length_sigma_m=float(length[0]),
    )


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One calibrated or fixed number, in units for readers."""

    name: str
    value: float
    sigma: float | None
    """Standard deviation; None: it was fixed."""
    unit: str
    most_alike: str = ""
    """The parameter it correlates with most; empty when fixed or alone."""
    correlation: float = 0.0
    prior: bool
    """Whether it had a prior."""


def rig_parameters(rig: Rig, with_prior: Collection[str] = ()) -> tuple[Parameter, ...]:
    """All parameters of a rig's cameras and poses, calibrated or fixed.

    Args:
        rig: with its covariance.
        with_prior: names of those that had a prior.
    """
    covariance = covariance_of(rig)
    names, sigmas = covariance.parameters, covariance.sigmas
    off_diagonal = covariance.correlation - np.eye(len(names))
    rows = []
    for name in all_names(rig):
        alike: dict[str, Any] = {}
        if name in sigmas:
            row = off_diagonal[names.index(name)]
            largest = int(np.abs(row).argmax())
            if names[largest] != name:
                alike = {"most_alike": names[largest], "correlation": float(row[largest])}
        number = _in_reader_unit(name, value(rig, name), sigmas.get(name))
        rows.append(Parameter(name=name, prior=name in with_prior, **number, **alike))
    return tuple(rows)


def shape_parameters(shape: TargetShape) -> tuple[Parameter, ...]:
    """Modes of a target's shape that were adjusted with the cameras."""
    return tuple(
        Parameter(name=n, prior=True, **_in_reader_unit(n, *shape.value_and_sigma(n)))
        for n in shape.parameters
    )


def parameter_cells(parameters: Collection[Parameter]) -> list[dict[str, str]]:
    """Names, values with their sigmas, units and strongest correlations as text."""
    return [
        {
            "name": re.sub(r"_(px|m|rad)$", "", one.name),
            "known": (
                f"{one.value:.6g} (fixed)" if one.sigma is None
                else with_sigma(one.value, one.sigma)
            ),
            "unit": one.unit,
            "other": f"{one.most_alike} {one.correlation:+.2f}" if one.most_alike else "",
        }
        for one in parameters
    ]  # fmt: skip


def parameter_table(parameters: Collection[Parameter]) -> str:
    """Parameters and their sigmas as a plain table."""
    return field_table("Parameters", _PARAMETERS, parameter_cells(parameters))


def _in_reader_unit(name: str, number: float, sigma: float | None) -> dict[str, Any]:
    """Value, sigma and unit: mm and degrees, not m, radians and sines of tilts."""
    units = ((factor, unit) for ending, factor, unit in _READER_UNITS if name.endswith(ending))
    factor, unit = next(units, (1.0, ""))
    shown = number * factor
    if name.endswith(("normal_x", "normal_y")):
        factor, unit = math.degrees(1.0) / math.sqrt(1.0 - number * number), "deg"
        shown = math.degrees(math.asin(number))
    return {"value": shown, "sigma": None if sigma is None else sigma * factor, "unit": unit}


def baselines_m(rig: Rig) -> dict[str, tuple[float, float]]:
    """Distance from the reference camera and its sigma, by camera.

    The distance is the length of the translation of `cam_from_rig`, so rotations do not count.
    """
    covariance, found = covariance_of(rig), {}
    for name, pose in rig.cam_from_rig.items():
        if name == rig.reference:
            continue
        length = float(np.linalg.norm(pose.translation))
        along = dict(zip((f"{name}.{axis}" for axis in POSE[3:]), pose.translation, strict=True))
        slopes = np.array([along.get(one, 0.0) for one in covariance.parameters]) / length
        found[name] = length, float(_sigmas(rig, slopes))
    return found


@dataclass(frozen=True, eq=False)
class RangeSigma:
    """Projection uncertainty over the frame of one camera at one distance, px."""

    range_m: float
    plain_median_px: float
    plain_worst_px: float
    compensated_median_px: float
    compensated_worst_px: float


def sigmas_by_range(
    rig: Rig, camera: str, pixels: Array, ranges_m: Collection[float], compensating: Array
) -> tuple[RangeSigma, ...]:
    """Median and largest of `projection_sigma` over pixels, at each distance; NaN: unknown."""
    found = []
    for range_m in ranges_m:
        sigma = projection_sigma(rig, camera, pixels, range_m, compensating)
        both = np.stack([sigma.plain_px.ravel(), sigma.compensated_px.ravel()])
        known = both[:, np.isfinite(both).all(axis=0)]
        levels = np.full((2, 2), np.nan)
        if known.size:
            levels = np.quantile(known, [0.5, 1.0], axis=1).T
        found.append(RangeSigma(range_m, *levels.ravel().tolist()))
    return tuple(found)


def uncertainty_report(
    path: Path, ranges_m: list[float] | None, near_m: float, far_m: float, noise_px: float
) -> tuple[str, dict[str, Any]]:
    """Sigmas of parameters, projections and stereo of a rig, as text and as JSON values.

    Args:
        path: `rig.json` with a covariance.
        ranges_m: distances to evaluate; `RANGES_M` if none.
        near_m: nearest distance of the points that poses are estimated from.
        far_m: farthest.
        noise_px: noise of one measured coordinate, for comparison.

    Raises:
        CalibrationError: the rig has no covariance, or the distances are not in order.
    """
    rig, ranges = read_rig(path), ranges_m or RANGES_M
    if not (0 < near_m <= far_m < math.inf and all(0 < r < math.inf for r in ranges)):
        raise CalibrationError(
            f"distances {near_m:g} to {far_m:g} m and --range: they must be positive and finite, "
            "the near one not beyond the far one"
        )
    parameters = [p for p in rig_parameters(rig) if p.sigma is not None]
    between = tuple(np.geomspace(near_m, far_m, 4).tolist())
    data: dict[str, Any] = {
        "parameters": parameters,
        "baselines_m": baselines_m(rig),
        "projection_sigma": {
            name: sigmas_by_range(
                rig, name, camera.frame_grid(_GRID, _GRID), ranges,
                compensation(rig, name, frame_points(camera, between)),
            )
            for name, camera in rig.cameras.items()
        },
    }  # fmt: skip
    projections = [
        vars(one) | {"camera": name}
        for name, sigmas in data["projection_sigma"].items()
        for one in sigmas
    ]
    texts = [
        parameter_table(parameters),
        field_table("One sigma of a projection over the frame", _PROJECTIONS, projections),
    ]
    if len(rig.cameras) > 1:
        data["stereo"] = [stereo_sigma(rig, r, noise_px) for r in ranges]
        title = f"One sigma of stereo by calibration alone, and by {noise_px:g} px of noise"
        rows = [
            {
                "at": s,
                "mm": 1e3
                * np.array([s.point_m[2], s.worst_shape_m, s.noise_m[2], s.length_sigma_m]),
            }
            for s in data["stereo"]
        ]
        texts.append(field_table(title, _STEREO, rows))
    return "\n\n".join(texts), json_values(data)
