"""What flying takes, by course against the current: from the vehicle's own equations of motion.

Along lines a vehicle that can sway holds its heading and meets the current's part across by sway;
one that cannot turns into the current until nothing pushes it sideways (it crabs), as all do on the
way between lines. The thrusts that balance drag, body lift, buoyancy and jets, and the electrical
power that they take, are those of `alice_survey.sim.vehicle.steady`; to them come the hotel load
and, on lines, the lights.

Where the numbers of `[vehicle]` come from:

- battery_wh 1400: SPARUS II carries 1.4 kWh of Li-ion cells by its maker's data sheet and by
  Carreras et al., IEEE Journal of Oceanic Engineering 43(2), 2018. Neither could be read here:
  inferred. Its endurance could (8 to 10 hours: El Radar and Infobae on the Spanish Navy's two, July
  2025), and agrees: at 1 m/s the model's thrusters take 87 W, with hotel_w that is 9.5 hours.
- battery_reserve 0.2: inferred; for ascent, recovery and the ageing of the cells.
- hotel_w 60: inferred, as the sum of a Jetson TX2 at 15 W (its greater mode, by huggingface.co's
  list of hardware; 7.4 W was logged with all processors busy, gist TerryTsao/fa30ba54), two cameras
  at 6 W, a DVL at 10 W, the vehicle's computer at 12 W, and inertial unit, modem, controller of the
  lights and losses at 11 W. Of these only the Jetson's could be read.

Left out: swell and gusts, which make drag larger on average; a propeller's dead band, below which
ALICE's lateral thrusters stand still and wait for the error to grow (0.4 N, below 0.1 W).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.config import PlanConfig, SeaConfig, VehicleConfig
from alice_survey.core.errors import PlanError, VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.pilot.gains import STEADY_SHARE
from alice_survey.sim.vehicle.pilot.settings import (
    MAX_PITCH_RAD,
    STEP_MPS,
    turn_in_place_rate_rad_s,
)
from alice_survey.sim.vehicle.propulsion import thrust_limits
from alice_survey.sim.vehicle.sea import GRAVITY
from alice_survey.sim.vehicle.steady import fin_flight, min_radius_m, steady_flight
from alice_survey.sim.vehicle.vehicle import Vehicle, coefficients_from_file, vehicle_to_fly
from missions.values.costs import SETTLE_S, Costs

Manner = Literal["held", "crab"]
"""How a current from the side is met: heading held, by sway; or heading turned into it."""
COURSES = 72
_HEADINGS = 24
"""Number of headings over which a turn on the spot in a current is averaged."""
_RATES = np.linspace(1.0, 1.0 / 16.0, 16)
"""Shares of a greatest rate that are tried, downwards."""
_ROOM = 1.25
"""Radius of turns over the tightest that fins hold (inferred): room to come back to the path."""
_DEAR = 100.0
"""Price of what cannot be flown, over that of an arc."""
_HEAVES_MPS = np.linspace(0.5, 0.01, 50)
"""Rates of descent that are tried."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FlightConditions:
    """What the power of flying follows from: a vehicle, how it flies, and the current."""

    vehicle: Vehicle
    manner: Manner
    """How lines are flown."""
    speed_mps: float
    """Speed over ground."""
    line_heading_deg: float | None
    """Heading of all lines; None where any will do."""
    current_ne_mps: Array
    """(2,) mean of the current that is expected."""
    turn_radius_m: float
    max_turn_rad_s: float
    """Rate of turns on the spot, if the vehicle has the thrust for it."""
    glass_body_m: tuple[float, float, float]
    """The left port's outer glass, about which a vehicle with sway turns."""
    hotel_w: float
    """Everything but thrusters and strobes."""
    needs_arcs: bool = False
    """Whether the plan turns in no other way."""


def flight_conditions(
    plan: PlanConfig,
    settings: VehicleConfig,
    sea: SeaConfig,
    depth_m: float,
    glass_body_m: tuple[float, float, float],
) -> FlightConditions:
    """The conditions that a survey expects.

    Args:
        plan: speed, heading and turns, as its vehicle can fly them.
        settings: of the vehicle.
        sea: its current.
        depth_m: at which it is flown.
        glass_body_m: the left port's outer glass.

    Raises:
        VehicleError: the vehicle is described wrongly.
        NavigationError: the file of the current cannot be read.
    """
    vehicle = planned_vehicle(settings)
    by_sway = has_sway(vehicle) and settings.controller == "sway"
    return FlightConditions(
        vehicle=vehicle,
        manner="held" if by_sway else "crab",
        speed_mps=plan.speed_mps,
        line_heading_deg=plan.line_heading_deg,
        current_ne_mps=expected_current(sea, depth_m),
        turn_radius_m=plan.arc_radius_m,
        max_turn_rad_s=turn_in_place_rate_rad_s(plan.turn_rate_limit_deg_s),
        glass_body_m=glass_body_m,
        hotel_w=hotel_w(settings),
        needs_arcs=plan.turns == "arcs" or bool(vehicle.fins),
    )


def without_stops(plan: PlanConfig, vehicle: Vehicle) -> PlanConfig:
    """Settings for laying routes: of a vehicle that fins steer, by arcs alone."""
    return plan.model_copy(update={"turns": "arcs"}) if vehicle.fins else plan


def plan_as_flown(plan: PlanConfig, vehicle: Vehicle) -> PlanConfig:
    """Settings with arcs that fins hold and run-ins as long as their radius.

    They are widened where `turns = "auto"`. At a speed at which it does not fly at all they are
    left: the speed is refused elsewhere.

    Raises:
        PlanError: turns are set that it cannot fly.
    """
    if not vehicle.fins:
        return plan
    if plan.turns not in ("auto", "arcs"):
        raise PlanError(
            f"{vehicle.name} is steered by fins and cannot stop: plan.turns = {plan.turns!r} "
            "cannot be flown; set 'arcs', or leave it out"
        )
    if fin_flight(vehicle, plan.speed_mps, 0.0, STEADY_SHARE) is None:
        return plan
    min_m = min_radius_m(vehicle, plan.speed_mps, STEADY_SHARE)
    if plan.turns == "auto":
        radius_m = max(plan.arc_radius_m, math.ceil(10.0 * _ROOM * min_m) / 10.0)
        run_in_m = max(plan.run_in_m, radius_m)
        return plan.model_copy(update={"turn_radius_m": radius_m, "run_in_m": run_in_m})
    if plan.turn_radius_m < min_m:
        raise PlanError(
            f"turn_radius_m {plan.turn_radius_m:g} is tighter than the {min_m:.2f} m that the "
            f"fins of {vehicle.name} hold at {plan.speed_mps:g} m/s: raise it, or "
            "set turns = 'auto'"
        )
    return plan


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Straight flight over ground in a current, at N courses."""

    nu: Array
    """(N, 6) velocity relative to the water, in the body."""
    crab_rad: Array
    """(N,) heading minus course."""
    possible: Array
    """(N,) 1.0, or NaN where the current along the course is not below the speed of a vehicle that
    crabs: it would have to face away from where it goes."""


def vehicle_costs(
    conditions: FlightConditions, *, refused: Callable[[str], PlanError], imaging_w: float = 0.0
) -> Costs:
    """What flying takes.

    Args:
        conditions: vehicle, speed and current.
        refused: makes the error for what cannot be flown, in words; empty where nothing can.
        imaging_w: mean power of strobes while on lines.

    Returns:
        Powers that are infinite at courses which the vehicle cannot keep with `STEADY_SHARE` of its
        thrust, the rest being left for control.

    Raises:
        PlanError: lines cannot be flown both ways on any heading, or not on the one requested, or
            the vehicle cannot turn from one line to the next.
    """
    vehicle, current = conditions.vehicle, conditions.current_ne_mps
    courses = _courses()
    lines, between = course_powers(conditions)
    stop_w, turn_rad_s = _stop_power(conditions)
    if not np.any(_both_ways(lines)) or not math.isfinite(stop_w):
        raise refused("")
    asked_deg = conditions.line_heading_deg
    if not _flies_heading(conditions) and asked_deg is not None:
        can_deg = np.degrees(courses[np.flatnonzero(_both_ways(lines))])
        off_deg = np.abs((can_deg - asked_deg + 90.0) % 180.0 - 90.0)
        nearest_deg = can_deg[int(np.argmin(off_deg))]
        raise refused(
            f"lines on {asked_deg:g} deg cannot be flown both ways (the nearest that can are on "
            f"{nearest_deg:.0f} deg)"
        )
    hotel = conditions.hotel_w
    arc_w, pace = _arc(conditions)
    if conditions.needs_arcs and not math.isfinite(arc_w):
        raise refused(f"arcs of {conditions.turn_radius_m:g} m radius cannot be flown")
    step_mps, step_w = _sway_step(vehicle, courses, current, conditions.manner)
    heave_mps, heave_w = _heave(conditions)
    return Costs(
        speed_mps=conditions.speed_mps,
        line_w=lines + hotel + imaging_w,
        way_w=between + hotel,
        stop_w=stop_w + hotel,
        arc_extra_w=(arc_w + hotel) / pace - float(between[np.isfinite(between)].mean()) - hotel,
        turn_rate_rad_s=turn_rad_s,
        settle_s=SETTLE_S,
        sway_mps=step_mps,
        sway_w=step_w + hotel,
        heave_mps=heave_mps,
        heave_w=heave_w + hotel,
        refused=refused,
    )


def course_powers(conditions: FlightConditions) -> tuple[Array, Array]:
    """Power of the thrusters on lines and between, (COURSES,) W each, by course from north.

    Infinite at courses that cannot be kept.
    """
    return _line_power(conditions, _courses()), _between(conditions, _courses())


def _line_power(conditions: FlightConditions, courses: Array) -> Array:
    return course_power(
        conditions.vehicle, courses, conditions.speed_mps, conditions.current_ne_mps,
        conditions.manner,
    )  # fmt: skip


def _between(conditions: FlightConditions, courses: Array) -> Array:
    crabbing = _line_power(replace(conditions, manner="crab"), courses)
    if conditions.manner == "crab":
        return crabbing
    # Where it cannot crab it may still hold its heading.
    return np.where(np.isfinite(crabbing), crabbing, _line_power(conditions, courses))


def _flies_heading(conditions: FlightConditions) -> bool:
    """Whether lines on the heading requested can be flown both ways; True where none is."""
    if conditions.line_heading_deg is None:
        return True
    there_and_back = math.radians(conditions.line_heading_deg) + np.array([0.0, math.pi])
    return bool(np.all(np.isfinite(_line_power(conditions, there_and_back))))


def battery_wh(settings: VehicleConfig) -> float:
    """The battery of a survey's vehicle.

    Raises:
        VehicleError: neither the settings nor the vehicle state it.
    """
    return _own_value("battery_wh", settings)


def hotel_w(settings: VehicleConfig) -> float:
    """What a survey's vehicle takes for everything but thrusters and strobes.

    Raises:
        VehicleError: neither the settings nor the vehicle state it.
    """
    return _own_value("hotel_w", settings)


def _own_value(field: str, settings: VehicleConfig) -> float:
    if field in settings.model_fields_set:
        stated: float = getattr(settings, field)
        return stated
    own: float | None = getattr(sound_vehicle(settings), field)
    if own is None:
        raise VehicleError(f"{settings.name}: states no {field}: add it, or set vehicle.{field}")
    return own


def usable_wh(settings: VehicleConfig) -> float:
    """What a dive may take of a battery."""
    return battery_wh(settings) * (1.0 - settings.battery_reserve)


def sound_vehicle(settings: VehicleConfig) -> Vehicle:
    """The vehicle of a survey with all its thrust, a named set of coefficients or those of a file.

    Raises:
        VehicleError: the set is not known, or the file is not one of coefficients.
    """
    file = settings.coefficients_file
    if file is None:
        return vehicle_to_fly(settings.name, settings.coefficients)
    return vehicle_to_fly(settings.name).with_coefficients(coefficients_from_file(file))


def planned_vehicle(settings: VehicleConfig) -> Vehicle:
    """The vehicle that a plan counts on: without the thrust that is known to be lost.

    Raises:
        VehicleError: as `sound_vehicle`.
    """
    vehicle = sound_vehicle(settings)
    left = vehicle.weaken(settings.impaired)
    if not left.thrusters:
        raise VehicleError(f"{vehicle.name} has no thruster left: check vehicle.failures")
    return left


def has_sway(vehicle: Vehicle) -> bool:
    """Whether any of its thrusters pushes a vehicle sideways."""
    return bool(np.any(np.abs(vehicle.configuration_matrix[1]) > 0))


def expected_current(sea: SeaConfig, depth_m: float) -> Array:
    """(2,) the current's mean, m/s north and east, at a depth.

    Raises:
        NavigationError: the file of the current cannot be read.
    """
    if sea.current_file is None:
        towards = math.radians(sea.current_towards_deg)
        return sea.current_mps * np.array([math.cos(towards), math.sin(towards)])
    from alice_survey.sim.vehicle.sea import read_current

    current = read_current(sea.current_file)
    means = [
        float(np.interp(depth_m, current.depth_m, profile))
        for profile in current.velocity_ne_mps.mean(axis=0).T
    ]
    return np.array(means)


def motion(courses_rad: Array, speed_mps: float, current_ne_mps: Array, manner: Manner) -> Motion:
    """Velocity relative to the water of straight flight.

    Crabbing, the heading is that of the velocity relative to the water, so that nothing pushes the
    hull sideways.

    Args:
        courses_rad: (N,)
        speed_mps: over ground.
        current_ne_mps: (2,) or (N, 2)
        manner: of meeting what comes from the side.
    """
    north, east = np.broadcast_to(current_ne_mps, (len(courses_rad), 2)).T
    sine, cosine = np.sin(courses_rad), np.cos(courses_rad)
    ahead = speed_mps - (north * cosine + east * sine)
    across = -(east * cosine - north * sine)
    nu = np.zeros((len(courses_rad), 6))
    if manner == "held":
        nu[:, 0], nu[:, 1] = ahead, across
        return Motion(nu=nu, crab_rad=np.zeros(len(nu)), possible=np.ones(len(nu)))
    nu[:, 0] = np.hypot(ahead, across)
    return Motion(
        nu=nu, crab_rad=np.arctan2(across, ahead), possible=np.where(ahead > 0.0, 1.0, np.nan)
    )


def course_power(
    vehicle: Vehicle, courses_rad: Array, speed_mps: float, current_ne_mps: Array, manner: Manner
) -> Array:
    """Electrical power of the thrusters, (N,) W; infinite at courses that cannot be kept."""
    moved = motion(courses_rad, speed_mps, current_ne_mps, manner)
    return _power(vehicle, moved.nu, moved.possible)


def _power(
    vehicle: Vehicle,
    nu: Array,
    possible: Array | float = 1.0,
    nu_rate: Array | None = None,
    *,
    slips: bool = False,
) -> Array:
    flight = steady_flight(vehicle, nu, nu_rate, share=STEADY_SHARE, slips=slips)
    power: Array = flight.power_w * possible
    return np.where(np.isnan(power), np.inf, power)


def _courses(count: int = COURSES) -> Array:
    return np.linspace(0.0, 2 * math.pi, count, endpoint=False)


def _both_ways(power_w: Array) -> NDArray[np.bool_]:
    """(K / 2,) whether a line can be flown both ways, at each heading from north to south."""
    half = len(power_w) // 2
    return np.isfinite(power_w[:half]) & np.isfinite(power_w[half:])


def _turning(
    conditions: FlightConditions, headings: Array, speed_mps: Array, rate_rad_s: Array
) -> tuple[Array, Array]:
    """Velocity relative to the water, and its rate, while the vehicle turns.

    With sway the left port's glass goes ahead at the speed, and the hull swings about it. Without,
    the vehicle goes ahead itself and drifts across its heading with the water.

    Args:
        conditions: vehicle and current.
        headings: (N,)
        speed_mps: (N,) ahead over ground.
        rate_rad_s: (N,) of yaw.

    Returns:
        (N, 6) each.
    """
    nu, nu_rate = np.zeros((len(headings), 6)), np.zeros((len(headings), 6))
    current = conditions.current_ne_mps
    ahead = -(np.cos(headings) * current[0] + np.sin(headings) * current[1])
    nu[:, 0], nu[:, 5] = speed_mps + ahead, rate_rad_s
    if conditions.manner == "held":
        across = np.sin(headings) * current[0] - np.cos(headings) * current[1]
        forward_m, right_m, _ = conditions.glass_body_m
        nu[:, 0] += rate_rad_s * right_m
        nu[:, 1] = across - rate_rad_s * forward_m
        # The current, fixed over ground, turns in the body.
        nu_rate[:, 0], nu_rate[:, 1] = rate_rad_s * across, -rate_rad_s * ahead
    return nu, nu_rate


def _turning_power(conditions: FlightConditions, speeds_mps: Array, rates_rad_s: Array) -> Array:
    """Power, (N,), of turning at speeds and rates (N,), mean over all headings."""
    nu, nu_rate = _turning(
        conditions,
        np.tile(_courses(_HEADINGS), len(speeds_mps)),
        np.repeat(speeds_mps, _HEADINGS),
        np.repeat(rates_rad_s, _HEADINGS),
    )
    slips = conditions.manner == "crab"
    power = _power(conditions.vehicle, nu, nu_rate=nu_rate, slips=slips)
    means: Array = power.reshape(-1, _HEADINGS).mean(axis=1)
    return means


def _stop_power(conditions: FlightConditions) -> tuple[float, float]:
    """Power on the spot, of turning through a quarter and settling; and the rate of turning.

    A vehicle that fins steer cannot: it costs so much that a plan has it for want of room alone,
    and is refused for it.
    """
    if conditions.vehicle.fins:
        return _DEAR * _arc(conditions)[0], conditions.max_turn_rad_s
    rates = conditions.max_turn_rad_s * np.append(_RATES, 0.0)
    power = _turning_power(conditions, np.zeros(len(rates)), rates)
    can = np.flatnonzero(np.isfinite(power[:-1]))
    if not len(can):
        return math.inf, conditions.max_turn_rad_s
    rate = float(rates[can[0]])
    turning_s = math.pi / 2 / rate
    joules = power[can[0]] * turning_s + power[-1] * SETTLE_S
    return float(joules / (turning_s + SETTLE_S)), rate


def _arc(conditions: FlightConditions) -> tuple[float, float]:
    """Power on an arc of the plan's radius, and the share of the plan's speed it is flown at.

    Mean of both senses and all courses.
    """
    # Fins need the whole speed.
    speeds = conditions.speed_mps * (_RATES[:1] if conditions.vehicle.fins else _RATES)
    rates = speeds / conditions.turn_radius_m
    both = np.concatenate([rates, -rates])
    power = _turning_power(conditions, np.tile(speeds, 2), both)
    power = power.reshape(2, -1).mean(axis=0)
    can = np.flatnonzero(np.isfinite(power))
    if not len(can):
        return math.inf, 1.0
    return float(power[can[0]]), float(_RATES[can[0]])


def _sway_step(
    vehicle: Vehicle, courses: Array, current: Array, manner: Manner
) -> tuple[float, Array]:
    """Speed of a sway step, and its power by course, mean of a step to port and to starboard."""
    if manner == "crab":
        return STEP_MPS, np.full(len(courses), np.inf)
    still = np.zeros((len(_RATES), 6))
    still[:, 1] = STEP_MPS * _RATES
    can = np.flatnonzero(np.isfinite(_power(vehicle, still)))
    if not len(can):
        return STEP_MPS, np.full(len(courses), np.inf)
    step_mps = float(STEP_MPS * _RATES[can[0]])
    relative = step_mps * np.stack([np.cos(courses), np.sin(courses)], axis=1) - current
    powers = []
    for side in (-math.pi / 2, math.pi / 2):
        heading = courses + side
        nu = np.zeros((len(courses), 6))
        nu[:, 0] = np.cos(heading) * relative[:, 0] + np.sin(heading) * relative[:, 1]
        nu[:, 1] = np.cos(heading) * relative[:, 1] - np.sin(heading) * relative[:, 0]
        powers.append(_power(vehicle, nu))
    return step_mps, (powers[0] + powers[1]) / 2


def _heave(conditions: FlightConditions) -> tuple[float, float]:
    """Rate of descent and ascent, and their mean power, heading into the current and held there.

    A vehicle that fins steer pitches, and goes round.
    """
    vehicle, current = conditions.vehicle, conditions.current_ne_mps
    if vehicle.fins:
        return conditions.speed_mps * math.sin(MAX_PITCH_RAD), _arc(conditions)[0]
    rates = np.concatenate([_HEAVES_MPS, -_HEAVES_MPS])
    nu = np.zeros((len(rates), 6))
    nu[:, 0], nu[:, 2] = math.hypot(*current), rates
    power = _power(vehicle, nu).reshape(2, -1).mean(axis=0)
    can = np.flatnonzero(np.isfinite(power))
    if not len(can):
        raise PlanError(f"{vehicle.name} cannot dive {lacking_thrust(vehicle)}")
    return float(_HEAVES_MPS[can[0]]), float(power[can[0]])


def lacking_thrust(vehicle: Vehicle) -> str:
    """Why the thrust of a vehicle is not enough: its weight in water, or what it has lost."""
    ends = np.zeros((2, len(vehicle.thrusters)))
    health = np.full(len(vehicle.thrusters), STEADY_SHARE)
    thrust_limits(vehicle.plant.propulsion, health, np.zeros(6), *ends)
    up_n, down_n = np.sort(vehicle.configuration_matrix[2] * ends, axis=0).sum(axis=1)
    body = vehicle.rigid_body
    sinks_n = (body.dry_kg - body.buoyancy_kg) * GRAVITY
    if vehicle.fins or -down_n <= sinks_n <= -up_n:
        return "with the thrust it has left: check vehicle.failures"
    way, at_hand_n = ("up", -up_n) if sinks_n > 0.0 else ("down", down_n)
    return (
        f"as rigid_body.dry_kg {body.dry_kg:g} less buoyancy_kg {body.buoyancy_kg:g} weighs "
        f"{sinks_n:.1f} N in water, and its thrusters push {way} with {at_hand_n:.1f} N at most "
        f"({STEADY_SHARE:.0%} of their thrust): trim it, or check the thrusters"
    )


def flies_everywhere(conditions: FlightConditions) -> bool:
    """Whether any survey can be flown, whatever way between lines it takes.

    That is: lines both ways, on the heading requested if there is one; all courses between lines;
    turns on the spot, arcs where the plan has no other turns; descent and ascent.
    """
    current = conditions.current_ne_mps
    try:
        _heave(conditions)
    except PlanError:
        return False
    downstream = math.atan2(current[1], current[0])
    between = _between(conditions, downstream + _courses())
    lines = _both_ways(_line_power(conditions, _courses()))
    if not np.all(np.isfinite(between)) or not np.any(lines) or not _flies_heading(conditions):
        return False
    if conditions.needs_arcs and not math.isfinite(_arc(conditions)[0]):
        return False
    return math.isfinite(_stop_power(conditions)[0])
