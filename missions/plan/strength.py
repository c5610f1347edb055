"""What flying a survey takes, and whether its vehicle can: currents, swell, turns, depth."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from alice_survey.core.config import PlanConfig, SeaConfig, SurveyConfig
from alice_survey.core.errors import PlanError, warn
from alice_survey.sim.vehicle.pilot import gains as g
from alice_survey.sim.vehicle.pilot.gains import STEADY_SHARE, Gains
from alice_survey.sim.vehicle.sea import orbital_speed_mps
from alice_survey.sim.vehicle.steady import fin_flight, min_speed_mps, too_slow
from alice_survey.sim.vehicle.vehicle import Vehicle
from missions.exposure.conflict import conflict, last_that_fits
from missions.route import energy
from missions.values.costs import Costs
from missions.values.plan_file import Dive, Plan

_DRAG_PASSES = 20
"""Each halves what the drag's amplitude is off."""


def survey_costs(config: SurveyConfig, *, imaging_w: float = 0.0) -> Costs:
    """What flying a survey takes; as `energy.vehicle_costs`, whose errors name the current here.

    Args:
        config: of the survey.
        imaging_w: mean power of strobes while on lines.
    """
    plan = energy.plan_as_flown(config.plan, energy.planned_vehicle(config.vehicle))
    depth_m = config.area.seafloor_depth_m - plan.altitude_m
    glass_body_m = config.camera.position_body_m
    flown = energy.flight_conditions(plan, config.vehicle, config.sea, depth_m, glass_body_m)
    refused = partial(current_error, flown, is_set=config.sea.current_file is None)
    return energy.vehicle_costs(flown, refused=refused, imaging_w=imaging_w)


def current_error(flown: energy.FlightConditions, what: str, *, is_set: bool = True) -> PlanError:
    """The error that names the current, and what the vehicle holds.

    Args:
        flown: the conditions that are too hard.
        what: cannot be flown, in words; empty where nothing can.
        is_set: whether the current is a setting, and not of a file.
    """
    current, speed, name = flown.current_ne_mps, flown.speed_mps, flown.vehicle.name
    size, towards_deg = math.hypot(*current), math.degrees(math.atan2(current[1], current[0])) % 360
    held_mps = held_current_mps(flown)
    manner = "held by sway" if flown.manner == "held" else "crabbing"
    on = "" if flown.line_heading_deg is None else f" on {flown.line_heading_deg:g} deg"
    if held_mps > 0.0:
        against = f"a current of {size:.2f} m/s towards {towards_deg:03.0f} deg"
        return conflict(
            f"{what} in {against}" if what else f"{against} is above the strength of {name}",
            (
                "the current",
                f"the {held_mps:.2f} m/s that {name} holds at {speed:g} m/s over ground, lines"
                f"{on} {manner}",
            ),
            "sea.current_mps", held_mps if is_set and held_mps < size else None,
        )  # fmt: skip
    if flown.vehicle.fins and fin_flight(flown.vehicle, speed, 0.0, STEADY_SHARE) is None:
        return conflict(
            too_slow(flown.vehicle, speed, STEADY_SHARE),
            ("plan.speed_mps", "the lift of its fins and hull"),
            "plan.speed_mps", _min_fin_speed_mps(flown, size),
        )  # fmt: skip
    said = (
        f"{name} cannot fly lines{on} {manner}, ways between in all directions and turns at "
        f"{speed:g} m/s over ground"
    )

    def flies(speed_mps: float) -> bool:
        at = replace(flown, speed_mps=speed_mps)
        return energy.flies_everywhere(at) and bool(np.isfinite(energy.course_powers(at)[0]).all())

    slow_mps = PlanConfig().speed_mps
    if speed > slow_mps and flies(slow_mps):
        max_mps = math.floor(100.0 * last_that_fits(flies, slow_mps, speed, 1e-3)) / 100.0
        limits = "plan.speed_mps", "the thrust of the vehicle"
        return conflict(said, limits, "plan.speed_mps", max_mps)
    return PlanError(f"{said} {energy.lacking_thrust(flown.vehicle)}")


def _min_fin_speed_mps(flown: energy.FlightConditions, current_mps: float) -> float | None:
    """The lowest speed over ground at which fins hold a vehicle everywhere; None if unknown."""

    def flies(speed_mps: float) -> bool:
        settings = PlanConfig(speed_mps=speed_mps, turn_radius_m=flown.turn_radius_m)
        radius_m = energy.plan_as_flown(settings, flown.vehicle).arc_radius_m
        return energy.flies_everywhere(replace(flown, speed_mps=speed_mps, turn_radius_m=radius_m))

    slow_mps = min_speed_mps(flown.vehicle, STEADY_SHARE)
    fast_mps = min(2.0 * (slow_mps + current_mps), 3.0)
    if not flies(fast_mps):
        return None
    low = math.ceil(100.0 * last_that_fits(flies, fast_mps, slow_mps, 1e-3))
    # Radii go by steps, so that a little faster may not do.
    tried = (step / 100.0 for step in range(low, math.ceil(100.0 * fast_mps)))
    return next(filter(flies, tried), fast_mps)


def held_current_mps(conditions: energy.FlightConditions) -> float:
    """The strongest current, in the expected one's direction and no stronger, to fly any survey in.

    In whole centimetres a second; 0 where there is none.
    """
    current = conditions.current_ne_mps
    size = math.hypot(*current)

    def flies(held_mps: float) -> bool:
        held_ne = current * (held_mps / max(size, 1e-9))
        return energy.flies_everywhere(replace(conditions, current_ne_mps=held_ne))

    if flies(size):
        return size
    return math.floor(100.0 * last_that_fits(flies, 0.0, size, 1e-3)) / 100.0


def warn_of_swell(flown: energy.FlightConditions, sea: SeaConfig, plan: Plan) -> None:
    """Warn where swell carries the vehicle off its lines, or is more than it holds.

    Args:
        flown: conditions in the mean current.
        sea: its swell.
        plan: where the vehicle flies; its lines.
    """
    if sea.swell_m == 0.0:
        return
    period_s, depth_m = sea.swell_period_s, plan.seafloor_depth_m
    below_m = depth_m - plan.altitude_m
    swell_mps = float(orbital_speed_mps(sea.swell_m, period_s, depth_m, below_m))
    towards = math.radians(sea.swell_towards_deg)
    way = np.array([math.cos(towards), math.sin(towards)])
    crests = [flown.current_ne_mps + sign * swell_mps * way for sign in (1.0, -1.0)]
    is_held = all(energy.flies_everywhere(replace(flown, current_ne_mps=crest)) for crest in crests)
    across = np.abs(np.sin([line.heading_rad - towards for line in plan.lines]))
    gains = g.gains_for(flown.vehicle, flown.speed_mps)
    shares, of = np.unique(np.round(across, 6), return_inverse=True)
    offsets_m = np.array(
        [swell_offset_m(gains, flown.speed_mps, share * swell_mps, period_s) for share in shares]
    )[of]
    within = np.clip(plan.allowed_offset_m / np.maximum(offsets_m, 1e-9), 0.0, 1.0)
    stations = np.array([line.stations for line in plan.lines])
    off = round(float(stations @ np.arccos(within)) * 2.0 / math.pi)
    if is_held and not off:
        return
    beyond = "" if is_held else ", more than it holds,"
    warn(
        f"swell of {sea.swell_m:g} m every {period_s:g} s moves the water by up to "
        f"{swell_mps:.2f} m/s where {flown.vehicle.name} flies{beyond} and puts some {off} of "
        f"{plan.stations} pictures more than {plan.allowed_offset_m:.2f} m off their lines: wait "
        f"for less swell, lay lines along it (line_heading_deg = {sea.swell_towards_deg % 180:g}), "
        "or raise side_overlap"
    )


def swell_offset_m(gains: Gains, speed_mps: float, swell_mps: float, period_s: float) -> float:
    """How far waves carry the vehicle to either side of its line, where thrusters are not cut.

    Water that moves with u pushes a neutral body at v by M u' + D (u - v); the sway loop answers
    with M (rate s + place + integral / s) x / (1 + lag s). Quadratic drag counts as the linear one
    that takes as much energy out of a sine, 8 / (3 pi) of it at the speed's amplitude.

    Args:
        gains: of the vehicle.
        speed_mps: along the line.
        swell_mps: amplitude of the water's speed across the line.
        period_s: of the waves.
    """
    body, row, s = gains.body, gains.axes[g.SWAY], 2j * math.pi / period_s
    loop = (row[g.RATE] * s + row[g.PLACE] + row[g.INTEGRAL] / s) / (1.0 + row[g.LAG] * s)
    relative_mps, offset_s = swell_mps, 0.0 + 0.0j
    for _ in range(_DRAG_PASSES):
        nu = np.array([speed_mps, 4.0 / (3.0 * math.pi) * relative_mps, 0.0, 0.0, 0.0, 0.0])
        decay = g.linear_damping(body, nu)[1, 1] / body.mass[1, 1]
        offset_s = (s + decay) / (s * s + decay * s + loop)
        relative_mps = (relative_mps + abs(1.0 - s * offset_s) * swell_mps) / 2.0
    return abs(offset_s) * swell_mps


def check_turns(plan: PlanConfig) -> None:
    """Refuse arcs that are too quick; warn where they are wider than set.

    Raises:
        PlanError: the plan asks for arcs of a radius that its rate of turn does not allow.
    """
    rate_deg_s = math.degrees(plan.speed_mps / plan.arc_radius_m)
    if plan.turns == "arcs" and rate_deg_s > plan.turn_rate_limit_deg_s:
        raise PlanError(
            f"turns of {plan.turn_radius_m:g} m radius at {plan.speed_mps:g} m/s need "
            f"{rate_deg_s:.0f} deg/s; turn_rate_limit_deg_s is "
            f"{plan.turn_rate_limit_deg_s:g}: raise turn_radius_m, lower speed_mps or set "
            "turns = 'auto'"
        )
    if plan.arc_radius_m > plan.turn_radius_m:
        warn(
            f"turn_radius_m {plan.turn_radius_m:g} at {plan.speed_mps:g} m/s is beyond "
            f"turn_rate_limit_deg_s {plan.turn_rate_limit_deg_s:g}: arcs are planned with "
            f"{plan.arc_radius_m:g} m"
        )


def check_no_stops(vehicle: Vehicle, plan: PlanConfig, dives: Sequence[Dive]) -> None:
    """Refuse a route with stops, which a vehicle that fins steer cannot make.

    Raises:
        PlanError: there is no room for its arcs.
    """
    legs = [leg for dive in dives for leg in dive.route.legs]
    stops = sum(leg.turn_rad != 0.0 or leg.side_rad != 0.0 for leg in legs)
    if vehicle.fins and stops:
        raise PlanError(
            f"turns of {plan.turn_radius_m:g} m radius have no room inside the allowed area (the "
            f"way has {stops} stops), and {vehicle.name}, which fins steer, cannot stop: widen "
            "area.turn_margin_m or the allowed area, set plan.home_ne_m farther from its edges, or "
            "survey it with a vehicle that can stop"
        )
