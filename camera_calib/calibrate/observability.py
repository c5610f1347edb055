"""What views under water do not tell of the parameters that are taken for granted.

Index of the water, index and thickness of the glass are held (or known before). How far could the
views have told them, and how far does a small error in one of them move what is calibrated? Both
follow from the information matrix S of all parameters, with a the adjusted ones and b the held one,
the same for all cameras: the views know b with the information S_bb - S_ba S_aa^-1 S_ab, and an
error of it moves a by -S_aa^-1 S_ab.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from camera_calib.calibrate.adjust import stack_views
from camera_calib.calibrate.normal_equations import Problem
from camera_calib.calibration import Calibration
from camera_calib.flat_port import FlatPortCamera
from camera_calib.freedom import Freedom, of_cameras, value

TAKEN_FOR_GRANTED: Mapping[str, float] = {
    "n_water": 0.001,
    "n_glass": 0.01,
    "glass_thickness_m": 0.0005,
}
"""How well each is known at best without a measurement of its own."""
_MOVED = ("fx_px", "port_distance_m", "normal_x", "normal_y", "x_m")
_NOTABLE = 0.5
"""Sigmas of its own that a parameter must move to be named."""
_MOST_NAMED = 3


@dataclass(frozen=True, kw_only=True)
class HeldEffect:
    """What follows from a parameter that was held."""

    sigma: float
    """How well the views would have told it; inf: not at all."""
    slopes: Mapping[str, float]
    """By adjusted parameter: how far it moves for each unit of an error of the held one."""


def unobservable(
    calibration: Calibration, errors: Mapping[str, float] = TAKEN_FOR_GRANTED
) -> tuple[str, ...]:
    """A line for each held parameter whose likely error matters and that the views cannot tell.

    Args:
        calibration: through ports.
        errors: held parameters of a camera, and the error each may have.
    """
    return tuple(
        line for name, error in errors.items() if (line := _line(calibration, name, error))
    )


def held_effect(calibration: Calibration, name: str) -> HeldEffect:
    """What the views say of a held parameter, the same for all cameras, and what hangs on it.

    Args:
        calibration: through ports.
        name: one of `flat_port.PARAMETERS` that was held in all cameras.
    """
    rig, freedom = calibration.rig, calibration.freedom
    held = of_cameras(rig, [name])
    wider = Freedom(free=(*freedom.free, *held), prior=freedom.prior)
    pixels = stack_views(calibration.views, rig, len(calibration.target_points))
    problem = Problem(pixels, calibration.target_points, rig, wider)
    weights = np.where(problem.seen, calibration.sigma_px[..., None] ** -2.0, 0.0)
    state = problem.state(rig, calibration.rig_from_target)
    information = problem.information(problem.equations(state, weights))
    adjusted = freedom.names(rig)
    a = [problem.names.index(n) for n in adjusted]
    b = [problem.names.index(n) for n in held]
    scale = 1.0 / np.sqrt(np.diag(information)[a])
    coupling = information[np.ix_(a, b)].sum(axis=1)
    inner = information[np.ix_(a, a)] * np.outer(scale, scale)
    slopes = -scale * np.linalg.solve(inner, scale * coupling)
    told = float(information[np.ix_(b, b)].sum() + coupling @ slopes)
    return HeldEffect(
        sigma=1.0 / math.sqrt(told) if told > 0.0 else math.inf,
        slopes=dict(zip(adjusted, slopes.tolist(), strict=True)),
    )


def _line(calibration: Calibration, name: str, error: float) -> str | None:
    rig = calibration.rig
    held = of_cameras(rig, [name])
    if set(held) & set(calibration.freedom.names(rig)):
        return None
    if not any(_matters(camera, name) for camera in rig.cameras.values()):
        return None
    effect = held_effect(calibration, name)
    if effect.sigma < error:
        return None
    moved = [
        (abs(slope) * error / rig.sigmas[parameter], parameter, slope * error)
        for parameter, slope in effect.slopes.items()
        if parameter.split(".")[1] in _MOVED
    ]
    notable = sorted((m for m in moved if m[0] > _NOTABLE), reverse=True)[:_MOST_NAMED]
    if not notable:
        return None
    return (
        f"{name} is taken as {value(rig, held[0]):g}; these views would tell it to "
        f"{effect.sigma:.2g} only (sigma), and {error:g} more would move "
        + ", ".join(f"{parameter} by {move:+.2g}" for _, parameter, move in notable)
        + ": measure it apart"
    )


def _matters(camera: FlatPortCamera, name: str) -> bool:
    """Whether light meets what the parameter describes."""
    if name == "n_glass":
        return camera.glass_thickness_m > 0.0
    if name == "glass_thickness_m":
        return camera.n_glass != camera.n_water
    return True
