"""What to say of a current above the vehicle's strength: the conflict and ways out that work."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from alice_survey.base.config import SurveyConfig
from alice_survey.base.errors import AliceError, PlanError
from alice_survey.base.frames import Array
from camera_calib.rig import design_rig
from missions.exposure.conflicts import Way, conflict
from missions.exposure.settings import imaging_settings
from missions.route.energy import (
    craft_of,
    expected_current,
    flies_everywhere,
    line_manner,
    motion,
)

_SPEEDS_MPS = (0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.75, 1.0, 1.25, 1.5)
"""Over ground, that are tried for a way out."""
_HEADING_STEP_DEG = 5.0
_HALVINGS = 10


def too_strong(config: SurveyConfig, what: str) -> PlanError:
    """The error that names the current, what the vehicle holds, and the cheapest ways out.

    Each way was tried: with it lines, turns and ways between in all directions can be flown, and
    cameras and trigger keep up.

    Args:
        config: of the survey.
        what: cannot be flown, in words; empty where nothing can.
    """
    current = expected_current(config)
    size, towards_deg = math.hypot(*current), math.degrees(math.atan2(current[1], current[0])) % 360
    held_mps = held_current_mps(config, current)
    plan, name = config.plan, config.vehicle.name
    manner = "held by sway" if line_manner(config) == "held" else "crabbing"
    heading = "" if plan.line_heading_deg is None else f" on {plan.line_heading_deg:g} deg"
    against = f"a current of {size:.2f} m/s towards {towards_deg:03.0f} deg"
    ways = [*_waits(config, current, held_mps), *_changes(config, current)]
    said = f"{what} in {against}" if what else f"{against} is above the strength of {name}"
    if held_mps == 0.0:
        said = (
            f"{name} cannot fly lines{heading} {manner}, ways between in all directions and turns "
            f"at {plan.speed_mps:g} m/s over ground"
        )
        if not ways:
            return PlanError(f"{said} with the thrust it has left: check vehicle.thruster_health")
        return conflict(said, (against, "the thrust it has left (vehicle.thruster_health)"), ways)
    strength = (
        f"the {held_mps:.2f} m/s that {name} holds at {plan.speed_mps:g} m/s over ground, lines"
        f"{heading} {manner}"
    )
    return conflict(said, ("the current", strength), ways)


def held_current_mps(config: SurveyConfig, current_ne_mps: Array) -> float:
    """The strongest current, in a given one's direction and no stronger, to fly any survey in.

    In whole centimetres a second; 0 where there is none.
    """
    size = math.hypot(*current_ne_mps)
    if size == 0.0 or flies_everywhere(config, current_ne_mps):
        return size
    low, high = 0.0, size
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        flies = flies_everywhere(config, current_ne_mps * (middle / size))
        low, high = (middle, high) if flies else (low, middle)
    return math.floor(100.0 * low) / 100.0


def _waits(config: SurveyConfig, current: Array, held_mps: float) -> Iterator[Way]:
    """Wait for a weaker current; with a heading asked for, also with all others."""
    size = math.hypot(*current)

    def wait(most_mps: float, also: str) -> Way:
        return Way(
            change=f"wait for a current of {most_mps:.2f} m/s (sea.current_mps){also}",
            price=f"{1.0 - most_mps / size:.0%} less current",
            cost=1.0 - most_mps / size,
        )

    if held_mps > 0.0:
        yield wait(held_mps, "")
    free = _with(config, plan={"line_heading_deg": None})
    if config.plan.line_heading_deg is not None:
        most_mps = held_current_mps(free, current)
        if held_mps < most_mps < size:
            yield wait(most_mps, " and leave plan.line_heading_deg out")


def _changes(config: SurveyConfig, current: Array) -> Iterator[Way]:
    """Another heading, speed, controller or vehicle that flies in this current."""
    yield from _headings(config, current)
    own = config.vehicle
    yield from _speeds(config, config, current, "", 0.0)
    if _sways(config):
        other = "los" if own.controller == "sway" else "sway"
        changed = _with(config, vehicle={"controller": other})
        yield from _tried(config, changed, current, f"vehicle.controller = '{other}'", 0.0)
    other = "sparus2" if own.name == "alice" else "alice"
    changed = _with(config, vehicle={"name": other, "thruster_health": type(own.thruster_health)()})
    if own.coefficients_file is None:  # these are of this vehicle
        yield from _tried(config, changed, current, f"vehicle.name = '{other}'", 1.0)


def _tried(
    config: SurveyConfig, changed: SurveyConfig, current: Array, change: str, cost: float
) -> Iterator[Way]:
    """A change by itself if it works, else with another speed."""
    if flies_everywhere(changed, current):
        lost = _swath_lost(changed, current)
        price = f"heading off the course by up to {math.degrees(math.acos(1 - lost)):.0f} deg"
        if line_manner(changed) == "held":
            price = "lines held by sway"
        yield Way(change=change, price=price, cost=cost + lost)
    else:
        yield from _speeds(config, changed, current, f"{change} and ", cost)


def _headings(config: SurveyConfig, current: Array) -> Iterator[Way]:
    """The nearest heading that flies, where one is asked for."""
    asked = config.plan.line_heading_deg
    if asked is None:
        return
    for turned in np.arange(_HEADING_STEP_DEG, 90.0 + _HEADING_STEP_DEG / 2, _HEADING_STEP_DEG):
        for heading in ((asked + turned) % 360.0, (asked - turned) % 360.0):
            if flies_everywhere(_with(config, plan={"line_heading_deg": heading}), current):
                yield Way(
                    change=f"plan.line_heading_deg {heading:g} instead of {asked:g}",
                    price=f"lines turned by {turned:g} deg",
                    cost=turned / 90.0,
                )
                return


def _speeds(
    config: SurveyConfig, changed: SurveyConfig, current: Array, change: str, cost: float
) -> Iterator[Way]:
    """The speed nearest to the plan's that flies, and at which cameras and trigger keep up."""
    own = config.plan.speed_mps
    for speed in sorted(_SPEEDS_MPS, key=lambda each: abs(math.log(each / own))):
        faster = _with(changed, plan={"speed_mps": speed})
        if speed == own or not flies_everywhere(faster, current) or not _images(faster):
            continue
        ratio = speed / own
        price = (
            f"pictures {ratio:.2g} times as often, exposed as much shorter"
            if ratio > 1.0
            else f"lines take {1.0 / ratio:.2g} times as long"
        )
        yield Way(
            change=f"{change}plan.speed_mps {speed:g} instead of {own:g}",
            price=price,
            cost=cost + max(ratio, 1.0 / ratio) - 1.0 + _swath_lost(faster, current),
        )
        return


def _swath_lost(config: SurveyConfig, current: Array) -> float:
    """Share of the swath that is lost where a vehicle crabs across the current."""
    across = math.atan2(current[1], current[0]) + np.array([0.5, 1.5]) * math.pi
    crab = motion(across, config.plan.speed_mps, current, line_manner(config)).crab_rad
    return 1.0 - math.cos(float(np.abs(crab).max()))


def _sways(config: SurveyConfig) -> bool:
    return bool(np.any(np.abs(craft_of(config.vehicle).configuration_matrix[1]) > 0))


def _images(config: SurveyConfig) -> bool:
    try:
        imaging_settings(design_rig(config.camera, config.water), config, quiet=True)
    except AliceError:
        return False
    return True


def _with(config: SurveyConfig, **sections: dict[str, Any]) -> SurveyConfig:
    """The survey with settings changed, by section."""
    return config.model_copy(
        update={
            name: getattr(config, name).model_copy(update=values)
            for name, values in sections.items()
        }
    )
