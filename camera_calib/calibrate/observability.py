"""Held parameters that views under water do not determine.

Index of the water, index and thickness of the glass are held (or known before). How far could the
views have determined them, and how far does a small error in one of them move what is calibrated?
Both follow from the information matrix S of all parameters, with a the adjusted ones and b the held
one, the same for all cameras: the views know b with the information S_bb - S_ba S_aa^-1 S_ab, and
an error of it moves a by -S_aa^-1 S_ab.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.block_solver import inverse_of
from alice_survey.core.frames import Array
from camera_calib.calibrate.normal_equations import CalibrationProblem
from camera_calib.calibration import Calibration, stack_views
from camera_calib.freedom import Freedom, of_cameras, value
from camera_calib.rig import Rig

_TAKEN_FOR_GRANTED: Mapping[str, float] = {
    "n_water": 0.001,
    "n_glass": 0.01,
    "glass_thickness_m": 0.0005,
}
"""Best sigma of each without a measurement of its own."""
_MOVED = ("fx_px", "port_distance_m", "normal_x", "normal_y", "x_m")
_NOTABLE = 0.5
"""Sigmas of its own that a parameter must move to be named."""
_MAX_NAMED = 3
FEW_VIEWS = 10
_CELLS = (4, 3)
"""Parts of the frame along x and y."""
_ROWS, _COLUMNS = ("top", "middle", "bottom"), ("far left", "left", "right", "far right")
_MIN_TILT = math.radians(8.0)
"""Root mean square lean of the target about each axis, from its mean."""
_MIN_RANGE_RATIO = 1.4
_USEFUL = {
    "fx_px": (0.005, "of the focal length", "more views at 20 to 40 degrees of tilt"),
    "fy_px": (0.005, "of the focal length", "more views at 20 to 40 degrees of tilt"),
    "port_distance_m": (0.003, "m", "near views that fill the frame, and tilted ones"),
    "normal_x": (math.radians(0.5), "rad", "near views with the target in the frame's corners"),
    "normal_y": (math.radians(0.5), "rad", "near views with the target in the frame's corners"),
}
"""Largest useful sigma, what it is a share or number of, and what would lower it."""


@dataclass(frozen=True, kw_only=True)
class HeldEffect:
    """Effect of a parameter that was held."""

    sigma: float
    """Sigma with which the views would have determined it; inf: not at all."""
    slopes: Mapping[str, float]
    """By adjusted parameter: how far it moves for each unit of an error of the held one."""


def unobservable(calibration: Calibration) -> Iterator[str]:
    """A line for each held parameter whose likely error matters and that the views leave open.

    Args:
        calibration: through ports.
    """
    rig = calibration.rig
    known = {name for camera in rig.cameras.values() for name in camera.parameters}
    for name, error in _TAKEN_FOR_GRANTED.items():
        held = of_cameras(rig, [name])
        if name not in known or set(held) & set(calibration.freedom.names(rig)):
            continue
        effect = held_effect(calibration, name)
        moved = [
            (abs(slope) * error / rig.sigmas[parameter], parameter, slope * error)
            for parameter, slope in effect.slopes.items()
            if parameter.split(".")[1] in _MOVED
        ]
        notable = sorted((m for m in moved if m[0] > _NOTABLE), reverse=True)[:_MAX_NAMED]
        if notable and effect.sigma >= error:
            yield (
                f"{name} is taken as {value(rig, held[0]):g}; these views would determine it to "
                f"{effect.sigma:.2g} only (sigma), and {error:g} more would move "
                + ", ".join(f"{parameter} by {move:+.2g}" for _, parameter, move in notable)
                + ": measure it apart"
            )


def held_effect(calibration: Calibration, name: str) -> HeldEffect:
    """Information on a held parameter, the same for all cameras, and its effects.

    Args:
        calibration: through ports.
        name: a parameter that was held in all cameras.
    """
    rig, freedom = calibration.rig, calibration.freedom
    held = of_cameras(rig, [name])
    wider = Freedom(free=(*freedom.free, *held), prior=freedom.prior)
    pixels = stack_views(calibration.views, rig, len(calibration.target_points))
    shape = calibration.shape
    problem = CalibrationProblem(pixels, calibration.drawn_points, rig, wider, shape)
    weights = np.where(problem.seen, calibration.sigma_px[..., None] ** -2.0, 0.0)
    state = problem.state(rig, calibration.rig_from_target)
    information = problem.equations(state, weights).information
    of_rig = freedom.names(rig)
    adjusted = (*of_rig, *shape.parameters)
    a = [problem.names.index(n) for n in adjusted]
    b = [problem.names.index(n) for n in held]
    coupling = information[np.ix_(a, b)].sum(axis=1)
    slopes = -inverse_of(information[np.ix_(a, a)]) @ coupling
    known = float(information[np.ix_(b, b)].sum() + coupling @ slopes)
    return HeldEffect(
        sigma=1.0 / math.sqrt(known) if known > 0.0 else math.inf,
        slopes=dict(zip(of_rig, slopes.tolist(), strict=False)),
    )


def advice(rig: Rig, measured: Array, rig_from_target: RigidTransform) -> Iterator[str]:
    """Lines on what the views do not constrain, each stating which views to add.

    Args:
        rig: calibrated, with its covariance.
        measured: (V, cameras, N, 2) pixels used; NaN where unseen.
        rig_from_target: (V,).
    """
    views = len(measured)
    if views < FEW_VIEWS:
        yield f"only {views} views: take {FEW_VIEWS} or more, 25 is good"
    for c, camera in enumerate(rig.cameras):
        yield from _coverage(camera, rig, measured[:, c].reshape(-1, 2))
    if any(name.split(".")[1] in _USEFUL for name in rig.sigmas):
        yield from _tilts(rig_from_target)
    if any(name.endswith("port_distance_m") for name in rig.sigmas):
        yield from _ranges(rig_from_target)
    yield from _loose(rig)


def _coverage(camera: str, rig: Rig, pixels: Array) -> Iterator[str]:
    model = rig.cameras[camera]
    seen = pixels[np.isfinite(pixels).all(axis=1)]
    counts, _, _ = np.histogram2d(
        seen[:, 0], seen[:, 1], bins=_CELLS, range=((0, model.width_px), (0, model.height_px))
    )
    empty = [f"{_ROWS[y]} {_COLUMNS[x]}" for y in range(_CELLS[1]) for x in range(_CELLS[0])
             if counts[x, y] == 0]  # fmt: skip
    if empty:
        where = ", ".join(empty[:4]) + (", ..." if len(empty) > 4 else "")
        yield (
            f"{camera}: no points in {len(empty)} of {counts.size} parts of the frame ({where}): "
            "take views with the target there"
        )


def _tilts(rig_from_target: RigidTransform) -> Iterator[str]:
    normals = rig_from_target.rotation.apply([0.0, 0.0, 1.0]).reshape(-1, 3)
    lean = np.arcsin(np.clip(normals[:, :2] - normals[:, :2].mean(axis=0), -1.0, 1.0))
    spread = np.sqrt((lean**2).mean(axis=0))
    for axis, tilt in (("left and right", spread[0]), ("up and down", spread[1])):
        if tilt < _MIN_TILT:
            yield (
                f"the target leans {axis} by only {math.degrees(tilt):.1f} deg rms: take views "
                f"in which it faces 20 to 40 deg {axis}"
            )


def _ranges(rig_from_target: RigidTransform) -> Iterator[str]:
    depths = np.asarray(rig_from_target.translation).reshape(-1, 3)[:, 2]
    near, far = np.quantile(depths, [0.1, 0.9])
    if far <= _MIN_RANGE_RATIO * near:
        yield (
            f"nearly all views lie between {near:.2f} and {far:.2f} m: take some at half and some "
            "at twice the distance, for the port"
        )


def _loose(rig: Rig) -> Iterator[str]:
    for name, sigma in rig.sigmas.items():
        field = name.split(".")[1]
        if field not in _USEFUL:
            continue
        limit, unit, more = _USEFUL[field]
        size = sigma / value(rig, name) if unit.startswith("of") else sigma
        if size > limit:
            yield f"{name} is known to {size:.2g} {unit} only (sigma): take {more}"
        if field == "port_distance_m" and value(rig, name) == 0.0:
            yield f"{name} ended at 0, its least: hold it, or the intrinsics as found in air"
