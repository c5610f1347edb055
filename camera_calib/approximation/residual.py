"""Errors of treating a flat-port camera as a camera model of other software.

Two ways: warp the pictures at one range to a virtual pinhole, or let a camera with distortion
absorb refraction. Either is exact at most at one range; `approximations` states the residual over
the frame and over an interval of distances.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from alice_survey.core.errors import CalibrationError, ConfigError
from alice_survey.core.frames import Array
from camera_calib.approximation.pinhole_warp import PinholeWarp, best_warp
from camera_calib.camera import Camera

COLMAP_PARAMETERS = {
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": (
        "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6",
    ),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}  # fmt: skip
"""COLMAP's camera models that are judged here, their parameters in COLMAP's order."""

FITTED = ("SIMPLE_RADIAL", "OPENCV", "FULL_OPENCV")
"""Models that are fitted to pictures without a warp."""

_GRID = 15
_CANCELLING_PX = 0.01
"""Penalty of a distortion coefficient of 1: of coefficients that cancel in FULL_OPENCV's fraction,
the smallest are taken; the residual grows by less than 1 % for it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StandIn:
    """A camera of one centre that stands in for a flat-port camera."""

    name: str
    model: str
    """COLMAP's name of the camera model."""
    params: tuple[float, ...]
    """In COLMAP's order and pixels."""
    warped_at_m: float | None
    """Pictures are warped so that they are exact at this range; None: they are used as they are."""
    centre_m: tuple[float, float, float]
    """Centre of projection, in the flat-port camera's frame."""
    approx_from_cam: Rotation
    """Turn of the axes against those of the flat-port camera."""

    def project(self, points_cam: Array) -> Array:
        """Pixels, (..., 2), of points (..., 3) in the flat-port camera's frame."""
        from_centre = points_cam - np.array(self.centre_m)
        seen = self.approx_from_cam.apply(from_centre.reshape(-1, 3)).reshape(points_cam.shape)
        return colmap_pixels(self.model, self.params, seen)


@dataclass(frozen=True, kw_only=True, eq=False)
class Residual:
    """Errors of a stand-in over the frame and some distances."""

    stand_in: StandIn
    distances_m: Array
    """(D,) from the entrance pupil along the axis."""
    pixels: Array
    """(rows, columns, 2) places in the picture, corners included."""
    errors_px: Array
    """(D, rows, columns, 2): pixel of the stand-in minus pixel of the (warped) picture."""

    @property
    def sizes_px(self) -> Array:
        """(D, rows, columns) lengths of the errors."""
        lengths: Array = np.linalg.norm(self.errors_px, axis=-1)
        return lengths

    @property
    def rms_by_distance_px(self) -> Array:
        """(D,) rms over the frame's area."""
        weights = _area_weights(*self.pixels.shape[:2])
        rms: Array = np.sqrt(np.sum(self.sizes_px**2 * weights, axis=(1, 2)))
        return rms

    @property
    def rms_px(self) -> float:
        """Rms over the frame's area and the distances."""
        return float(np.sqrt(np.mean(self.rms_by_distance_px**2)))

    @property
    def max_px(self) -> float:
        """Largest error in the frame, its corners included, at any of the distances."""
        return float(self.sizes_px.max())

    @property
    def map_px(self) -> Array:
        """(rows, columns) rms over the distances."""
        rms: Array = np.sqrt(np.mean(self.sizes_px**2, axis=0))
        return rms

    def to_json(self) -> dict[str, Any]:
        """All of it as JSON values; the map rounded to 1e-5 px."""
        camera = self.stand_in
        return {
            "name": camera.name,
            "model": camera.model,
            "params": dict(zip(COLMAP_PARAMETERS[camera.model], camera.params, strict=True)),
            "warped_at_m": camera.warped_at_m,
            "centre_m": list(camera.centre_m),
            "turn_deg": np.rad2deg(camera.approx_from_cam.as_rotvec()).tolist(),
            "rms_px": self.rms_px,
            "max_px": self.max_px,
            "distances_m": self.distances_m.tolist(),
            "rms_by_distance_px": self.rms_by_distance_px.tolist(),
            "max_by_distance_px": self.sizes_px.max(axis=(1, 2)).tolist(),
            "map_x_px": self.pixels[0, :, 0].tolist(),
            "map_y_px": self.pixels[:, 0, 1].tolist(),
            "map_px": np.round(self.map_px, 5).tolist(),
        }


def approximations(
    camera: Camera,
    near_m: float,
    far_m: float,
    *,
    distances_m: Sequence[float] | None = None,
    working_range_m: float | None = None,
    turned: bool = True,
    models: Sequence[str] = FITTED,
) -> list[Residual]:
    """The usual stand-ins for a flat-port camera over an interval of distances.

    Two pinholes after a warp, at the entrance pupil and at the point that rays miss least; then
    some of COLMAP's models, fitted by least squares to exact rays, with the centre along the port's
    normal.

    Args:
        camera: exact.
        near_m: nearest distance from the entrance pupil along the axis.
        far_m: farthest.
        distances_m: at which to look, all counting alike; nine, evenly from near to far, when not
            given.
        working_range_m: where warped pictures are exact; the harmonic mean when not given.
        turned: let the fitted cameras' axes turn, as bundle adjustment does with a tilted port.
        models: to fit, keys of `COLMAP_PARAMETERS`.

    Raises:
        ConfigError: the interval is empty or reaches into the port.
        CalibrationError: a part of the frame sees nothing.
    """
    closest = _outer_glass_m(camera)
    if not closest < near_m < far_m < np.inf:
        raise ConfigError(
            f"distances {near_m:g} to {far_m:g} m: give near < far, both beyond the port's outer "
            f"glass, {closest:g} m from the entrance pupil"
        )
    distances = np.linspace(near_m, far_m, 9) if distances_m is None else np.array(distances_m)
    best = best_warp(camera, near_m, far_m, working_range_m)
    at_pupil = replace(best, centre_m=(0.0, 0.0, 0.0))
    pixels, points = _visible_points(camera, distances, _GRID)
    stand_ins = [
        _warp_pinhole("pinhole at the pupil, warped", at_pupil),
        _warp_pinhole("pinhole at the best point, warped", best),
        *(_fit_model(model, camera, pixels, points, turned) for model in models),
    ]
    return [residual(camera, one, distances) for one in stand_ins]


def residual(camera: Camera, stand_in: StandIn, distances_m: Array, grid: int = _GRID) -> Residual:
    """Errors of a stand-in against the flat-port camera.

    Args:
        camera: exact.
        stand_in: for it.
        distances_m: (D,) from the entrance pupil along the axis.
        grid: places along each side of the frame.

    Raises:
        CalibrationError: a part of the frame sees nothing.
    """
    pixels, points = _visible_points(camera, distances_m, grid)
    shown = pixels
    if stand_in.warped_at_m is not None:
        shown = stand_in.project(camera.at_depth(pixels, stand_in.warped_at_m))
    return Residual(
        stand_in=stand_in,
        distances_m=distances_m,
        pixels=pixels,
        errors_px=stand_in.project(points) - shown,
    )


def colmap_pixels(model: str, params: Sequence[float] | Array, points: Array) -> Array:
    """Project points in front of a COLMAP camera.

    Args:
        model: a key of `COLMAP_PARAMETERS`.
        params: in COLMAP's order.
        points: (..., 3) in the camera's frame.

    Returns:
        (..., 2) pixels, counted from the outer corner of the first.
    """
    value = dict(zip(COLMAP_PARAMETERS[model], np.asarray(params), strict=True))
    fx, fy = value.get("fx", value.get("f")), value.get("fy", value.get("f"))
    u, v = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
    if model == "OPENCV_FISHEYE":  # tangents as long as the angle from the axis
        tangent = np.hypot(u, v)
        bend = np.divide(np.arctan(tangent), tangent, out=np.ones_like(u), where=tangent > 0)
        u, v = u * bend, v * bend
    k1, k2, k3, k4, k5, k6 = (value.get(f"k{i}", 0.0) for i in range(1, 7))
    p1, p2 = value.get("p1", 0.0), value.get("p2", 0.0)
    r2 = u * u + v * v
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    if model == "OPENCV_FISHEYE":
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    x = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
    y = v * radial + 2 * p2 * u * v + p1 * (r2 + 2 * v * v)
    pixels: Array = np.stack([fx * x + value["cx"], fy * y + value["cy"]], axis=-1)
    return pixels


def _warp_pinhole(name: str, warp: PinholeWarp) -> StandIn:
    return StandIn(
        name=name,
        model="PINHOLE",
        params=tuple(warp.pinhole.numbers.tolist()),
        warped_at_m=warp.working_range_m,
        centre_m=warp.centre_m,
        approx_from_cam=Rotation.identity(),
    )


def _fit_model(model: str, camera: Camera, pixels: Array, points: Array, turned: bool) -> StandIn:
    """Least squares over shift along the port's axis (m), turn (rotation vector) and intrinsics."""
    axis = np.array(camera.port.axis_cam)
    names = COLMAP_PARAMETERS[model]
    is_distortion = np.array([name[0] in "kp" for name in names])
    weights = _area_weights(*pixels.shape[:2]) / len(points)
    scale = np.sqrt(weights)[None, :, :, None]

    def stand_in(unknowns: Array) -> StandIn:
        x_m, y_m, z_m = (unknowns[0] * axis).tolist()
        return StandIn(
            name=f"{model}, fitted",
            model=model,
            params=tuple(unknowns[4 if turned else 1 :].tolist()),
            warped_at_m=None,
            centre_m=(x_m, y_m, z_m),
            approx_from_cam=Rotation.from_rotvec(unknowns[1:4] if turned else np.zeros(3)),
        )

    def cost(unknowns: Array) -> Array:
        one = stand_in(unknowns)
        coefficients = np.array(one.params)[is_distortion]
        residuals = (one.project(points) - pixels) * scale
        return np.concatenate([residuals.ravel(), _CANCELLING_PX * coefficients])

    start = {
        "f": camera.focal_in_water_px,
        "fx": camera.port.magnification * camera.fx_px,
        "fy": camera.port.magnification * camera.fy_px,
        "cx": camera.cx_px,
        "cy": camera.cy_px,
    }
    first = np.array([0.0] * (4 if turned else 1) + [start.get(name, 0.0) for name in names])
    return stand_in(least_squares(cost, first, x_scale="jac", max_nfev=200).x)


def _visible_points(camera: Camera, distances: Array, grid: int) -> tuple[Array, Array]:
    """Places in the frame, (grid, grid, 2), and what they see at each distance, (D, ..., 3)."""
    pixels = camera.frame_grid(grid, grid)
    points = np.stack([camera.at_depth(pixels, float(z)) for z in distances])
    if not np.all(np.isfinite(points)):
        raise CalibrationError(
            "a part of the frame sees nothing: the lens model or the port does not reach the "
            "corners"
        )
    return pixels, points


def _area_weights(rows: int, columns: int) -> Array:
    """Shares of the frame, by the trapezoidal rule: places on its border count half."""
    sides = []
    for count in (rows, columns):
        side = np.ones(count)
        side[[0, -1]] = 0.5
        sides.append(side / side.sum())
    weights: Array = np.outer(*sides)
    return weights


def _outer_glass_m(camera: Camera) -> float:
    """Farthest along the axis that the outer glass is from the entrance pupil, over the frame."""
    points, _ = camera.unproject(camera.border(8))
    return max(float(camera.front_cam[2]), float(np.nanmax(points[:, 2], initial=0.0)))
