"""The costs of flying a survey, and what to change where the current forbids it."""

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from alice_survey.core.config import PlanConfig, SurveyConfig, VehicleConfig
from alice_survey.core.errors import AliceError, PlanError, warn
from alice_survey.sim.vehicle.files import vehicles_of_a_geometry
from alice_survey.sim.vehicle.pilot.gains import STEADY_SHARE
from alice_survey.sim.vehicle.sea import orbital_speed_mps
from alice_survey.sim.vehicle.steady import fin_flight, too_slow
from missions.exposure.settings import ImagingSetup, imaging_settings
from missions.exposure.ways_out import Settings, Way, conflict
from missions.route.energy import (
    FlightConditions,
    flies_everywhere,
    flight_conditions,
    has_sway,
    motion,
    vehicle_costs,
)
from missions.route.flyable import as_flown, plan_as_flown
from missions.values.costs import Costs

_SPEEDS_MPS = (0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.75, 1.0, 1.25, 1.5)
"""Speeds over ground that are tried as a way out."""
_HEADING_STEP_DEG = 5.0
_HALVINGS = 10


def survey_costs(config: SurveyConfig, *, imaging_w: float = 0.0) -> Costs:
    """What flying a survey takes; as `vehicle_costs`, whose errors name ways out here.

    Args:
        config: of the survey.
        imaging_w: mean power of strobes while on lines.
    """
    config = as_flown(config)
    flown = flight_conditions(config)
    refused = partial(too_strong, flown, config.vehicle, ImagingSetup.of(config))
    return vehicle_costs(flown, refused=refused, imaging_w=imaging_w)


def warn_of_swell(config: SurveyConfig, depth_m: float) -> None:
    """Warn where swell moves the water faster, with the current, than the vehicle holds.

    Args:
        config: of the survey.
        depth_m: of the sea floor.
    """
    sea = config.sea
    if sea.swell_m == 0.0:
        return
    flown, below_m = flight_conditions(config), depth_m - config.plan.altitude_m
    swell_mps = float(orbital_speed_mps(sea.swell_m, sea.swell_period_s, depth_m, below_m))
    towards = math.radians(sea.swell_towards_deg)
    way = np.array([math.cos(towards), math.sin(towards)])
    crests = [flown.current_ne_mps + sign * swell_mps * way for sign in (1.0, -1.0)]
    if all(flies_everywhere(replace(flown, current_ne_mps=crest)) for crest in crests):
        return
    warn(
        f"swell of {sea.swell_m:g} m every {sea.swell_period_s:g} s moves the water by up to "
        f"{swell_mps:.2f} m/s where {flown.craft.name} flies, more than it holds: it is carried "
        "off its lines and back by every wave; wait for less swell, or raise side_overlap"
    )


def turn_rate_deg_s(plan: PlanConfig) -> float:
    """Rate of the turns that a plan's arcs need."""
    return math.degrees(plan.speed_mps / plan.arc_radius_m)


def arcs_fit(plan: PlanConfig) -> bool:
    """Whether the arcs of a plan are within its rate of turn, where it wants nothing but arcs."""
    return plan.turns != "arcs" or turn_rate_deg_s(plan) <= plan.turn_rate_limit_deg_s


def too_strong(
    flown: FlightConditions, vehicle: VehicleConfig, setup: ImagingSetup, what: str
) -> PlanError:
    """The error that names the current, what the vehicle holds, and the cheapest ways out.

    Each way was tried: with it lines, turns and ways between in all directions can be flown, and
    cameras and trigger keep up.

    Args:
        flown: the conditions that are too hard.
        vehicle: the same vehicle, as set.
        setup: cameras, and speed and turns of the plan.
        what: cannot be flown, in words; empty where nothing can.
    """
    current = flown.current_ne_mps
    size, towards_deg = math.hypot(*current), math.degrees(math.atan2(current[1], current[0])) % 360
    held_mps = held_current_mps(flown)
    speed, name, heading_deg = flown.speed_mps, vehicle.name, flown.line_heading_deg
    manner = "held by sway" if flown.manner == "held" else "crabbing"
    heading = "" if heading_deg is None else f" on {heading_deg:g} deg"
    against = f"a current of {size:.2f} m/s towards {towards_deg:03.0f} deg"
    ways = [*_waits(flown, held_mps), *_changes(flown, vehicle, setup)]
    said = f"{what} in {against}" if what else f"{against} is above the strength of {name}"
    if (
        held_mps == 0.0
        and flown.craft.fins
        and fin_flight(flown.craft, speed, 0.0, STEADY_SHARE) is None
    ):
        said = too_slow(flown.craft, speed, STEADY_SHARE)
        return conflict(said, ("plan.speed_mps", "the lift of its fins and hull"), ways)
    if held_mps == 0.0:
        said = (
            f"{name} cannot fly lines{heading} {manner}, ways between in all directions and turns "
            f"at {speed:g} m/s over ground"
        )
        if not ways:
            return PlanError(f"{said} with the thrust it has left: check vehicle.failures")
        return conflict(said, (against, "the thrust it has left (vehicle.failures)"), ways)
    strength = (
        f"the {held_mps:.2f} m/s that {name} holds at {speed:g} m/s over ground, lines"
        f"{heading} {manner}"
    )
    return conflict(said, ("the current", strength), ways)


def held_current_mps(conditions: FlightConditions) -> float:
    """The strongest current, in the expected one's direction and no stronger, to fly any survey in.

    In whole centimetres a second; 0 where there is none.
    """
    current = conditions.current_ne_mps
    size = math.hypot(*current)
    if size == 0.0 or flies_everywhere(conditions):
        return size
    low, high = 0.0, size
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        flies = flies_everywhere(replace(conditions, current_ne_mps=current * (middle / size)))
        low, high = (middle, high) if flies else (low, middle)
    return math.floor(100.0 * low) / 100.0


def _waits(flown: FlightConditions, held_mps: float) -> Iterator[Way]:
    """Wait for a weaker current; with a heading requested, also with all others."""
    size = math.hypot(*flown.current_ne_mps)

    towards_deg = math.degrees(math.atan2(*flown.current_ne_mps[::-1])) % 360.0
    weaker = {"sea.current_file": None, "sea.current_towards_deg": towards_deg}

    def wait(max_mps: float, also: str, more: Settings) -> Way:
        return Way(
            change=f"wait for a current of {max_mps:.2f} m/s (sea.current_mps){also}",
            price=f"{1.0 - max_mps / size:.0%} less current",
            cost=1.0 - max_mps / size,
            settings={**weaker, "sea.current_mps": max_mps, **more},
        )

    if held_mps > 0.0:
        yield wait(held_mps, "", {})
    if flown.line_heading_deg is not None:
        max_mps = held_current_mps(replace(flown, line_heading_deg=None))
        if held_mps < max_mps < size:
            yield wait(
                max_mps, " and leave plan.line_heading_deg out", {"plan.line_heading_deg": None}
            )


def _changes(flown: FlightConditions, own: VehicleConfig, setup: ImagingSetup) -> Iterator[Way]:
    """Another heading, speed, controller or vehicle that flies in this current."""
    yield from _headings(flown)
    yield from _speeds(flown, setup)
    if has_sway(flown.craft):
        other = "los" if own.controller == "sway" else "sway"
        changed = flown.with_vehicle(own.model_copy(update={"controller": other}))
        named = f"vehicle.controller = '{other}'"
        yield from _tried(changed, setup, named, 0.0, {"vehicle.controller": other})
    if own.file is not None or own.coefficients_file is not None:  # of this vehicle alone
        return
    for other in (name for name in vehicles_of_a_geometry() if name != own.name):
        changed = flown.with_vehicle(own.model_copy(update={"name": other, "failures": ()}))
        named = f"vehicle.name = '{other}'"
        settings: dict[str, Any] = {"vehicle.name": other}
        if own.impaired:
            named += " without vehicle.failures"
            settings["vehicle.failures"] = ()
        yield from _tried(changed, setup, named, 1.0, settings)


def _tried(
    changed: FlightConditions, setup: ImagingSetup, change: str, cost: float, settings: Settings
) -> Iterator[Way]:
    """A change by itself if it works, else with another speed."""
    if flies_everywhere(changed):
        lost = _swath_lost(changed)
        price = f"heading off the course by up to {math.degrees(math.acos(1 - lost)):.0f} deg"
        if changed.manner == "held":
            price = "lines held by sway"
        yield Way(change=change, price=price, cost=cost + lost, settings=settings)
        return
    alone = Way(change=change, price="", cost=cost, settings=settings)
    for way in _speeds(changed, setup):
        yield replace(alone.then(way), price=way.price)


def _headings(flown: FlightConditions) -> Iterator[Way]:
    """The nearest heading that flies, where one is requested."""
    wanted_deg = flown.line_heading_deg
    if wanted_deg is None:
        return
    for turned in np.arange(_HEADING_STEP_DEG, 90.0 + _HEADING_STEP_DEG / 2, _HEADING_STEP_DEG):
        for heading in ((wanted_deg + turned) % 360.0, (wanted_deg - turned) % 360.0):
            if flies_everywhere(replace(flown, line_heading_deg=heading)):
                yield Way(
                    change=f"plan.line_heading_deg {heading:g} instead of {wanted_deg:g}",
                    price=f"lines turned by {turned:g} deg",
                    cost=turned / 90.0,
                    settings={"plan.line_heading_deg": float(heading)},
                )
                return


def _speeds(flown: FlightConditions, setup: ImagingSetup) -> Iterator[Way]:
    """The speed nearest to the plan's that flies, and at which cameras and trigger keep up.

    With it the radius of turns, where the arcs would be too quick.
    """
    own = flown.speed_mps
    for speed in sorted(_SPEEDS_MPS, key=lambda each: abs(math.log(each / own))):
        settings, wider = {"plan.speed_mps": speed}, ""
        try:
            plan = plan_as_flown(setup.plan.model_copy(update={"speed_mps": speed}), flown.craft)
        except PlanError:
            continue
        if not arcs_fit(plan):
            limit_rad_s = math.radians(plan.turn_rate_limit_deg_s)
            radius_m = math.ceil(10.0 * speed / limit_rad_s) / 10.0
            plan = plan.model_copy(update={"turn_radius_m": radius_m})
            settings["plan.turn_radius_m"] = radius_m
            wider = f" and plan.turn_radius_m {radius_m:g}"
        faster = replace(flown, speed_mps=speed, turn_radius_m=plan.arc_radius_m)
        if speed == own or not flies_everywhere(faster) or not _images(replace(setup, plan=plan)):
            continue
        ratio = speed / own
        price = (
            f"pictures {ratio:.2g} times as often, exposed as much shorter"
            if ratio > 1.0
            else f"lines take {1.0 / ratio:.2g} times as long"
        )
        yield Way(
            change=f"plan.speed_mps {speed:g} instead of {own:g}{wider}",
            price=price,
            cost=max(ratio, 1.0 / ratio) - 1.0 + _swath_lost(faster),
            settings=settings,
        )
        return


def _swath_lost(flown: FlightConditions) -> float:
    """Share of the swath that is lost where a vehicle crabs across the current."""
    current = flown.current_ne_mps
    across = math.atan2(current[1], current[0]) + np.array([0.5, 1.5]) * math.pi
    crab = motion(across, flown.speed_mps, current, flown.manner).crab_rad
    return 1.0 - math.cos(float(np.abs(crab).max()))


def _images(setup: ImagingSetup) -> bool:
    try:
        imaging_settings(setup.rig, setup, quiet=True)
    except AliceError:
        return False
    return True
