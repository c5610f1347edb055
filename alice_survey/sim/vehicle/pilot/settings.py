"""Settings of the guidance, and their derivation from the vehicle and the path.

Guidance of vehicles that fins steer: depth by pitch, and circles in place of hovering.

In the vertical plane the vehicle heads for a point ahead on the target depth, as `los` does in the
horizontal one: its pitch is that of level flight plus the depth's error by a look-ahead distance,
plus an integral for what level flight takes that is not modelled. It cannot stop: it dives, waits
and surfaces on a circle that touches the way in to its path, at the survey's speed.
"""

import math
from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np

from alice_survey.core.compiled import kernel
from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.pilot import gains as g
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot.gains import Gains, coupled_pair, damping_ratio, heading_loop
from alice_survey.sim.vehicle.pilot.memory import PilotState, SafetyLimits
from alice_survey.sim.vehicle.pilot.path import Path
from alice_survey.sim.vehicle.steady import bisect

TURN_IN_PLACE_RAD_S = math.radians(15.0)
"""Rate of a turn on the spot: half of the fastest that gains.py lets a vehicle ask for (inferred).
"""
STEP_MPS = 0.15
"""Speed of a sway step (inferred: what ALICE swayed at in the paper's turns, section VI)."""


def turn_in_place_rate_rad_s(turn_rate_limit_deg_s: float) -> float:
    """Rate of turns on the spot under a survey's limit; a vehicle that can do less turns slower.

    Args:
        turn_rate_limit_deg_s: the setting `plan.turn_rate_limit_deg_s`.
    """
    return min(TURN_IN_PLACE_RAD_S, math.radians(turn_rate_limit_deg_s))


MAX_PITCH_RAD = math.radians(20.0)
"""Greatest commanded pitch besides that of level flight: two thirds of what ends a mission."""


class UnderWay(NamedTuple):
    """How a vehicle that cannot hover flies."""

    circle_m: float
    """Radius of the circle that it waits on; 0 of a vehicle that hovers."""
    side: float
    """+1: the circle is flown to starboard; -1: to port."""
    dive_ahead_m: float
    """Look-ahead in the vertical plane."""
    level_rad: float
    """Pitch of level flight."""


HOVERS = UnderWay(0.0, 1.0, 1.0, 0.0)
"""Of a vehicle that can stay where it is."""


def dive_loop(gains: Gains, speed_mps: float, look_ahead_m: float) -> Array:
    """State matrix of keeping a depth by pitch.

    States: integral of the pitch's error; pitch; heave, m/s; pitch rate; pitch acceleration that
    the lagging fins give; depth, m; integral of depth as a pitch.

    Args:
        gains: gains of the vehicle.
        speed_mps: surge.
        look_ahead_m: look-ahead of the guidance.

    Returns:
        (7, 7)
    """
    row = gains.axes[g.PITCH]
    loop = np.zeros((7, 7))
    loop[:5, :5] = heading_loop(gains.body, speed_mps, row, gains.fins, g.VERTICAL)
    sink = np.array([0.0, -speed_mps, 1.0, 0.0, 0.0, 0.0, 0.0])
    learns = g.INTEGRAL_SHARE * speed_mps / look_ahead_m**2
    loop[5], loop[6, 5] = sink, learns
    # Target pitch depth / look-ahead + integral, and its rate, without that of the integral.
    target, rate = np.zeros(7), sink / look_ahead_m
    target[5], target[6] = 1.0 / look_ahead_m, 1.0
    loop[0] -= target
    loop[4] += (row[g.PLACE] * target + row[g.RATE] * rate) / row[g.LAG]
    return loop


@kernel
def circle_course(
    goal_n: float,
    goal_e: float,
    heading: float,
    look_ahead_m: float,
    under_way: UnderWay,
    point: Array,
) -> tuple[float, float]:
    """Course that leads onto the circle through a goal, tangent to a heading there, and round it.

    Args:
        goal_n: north of the goal.
        goal_e: east of it.
        heading: at the goal.
        look_ahead_m: look-ahead in the horizontal plane.
        under_way: settings.
        point: of the pilot.

    Returns:
        The course, rad, and its rate by distance, 1/m.
    """
    side, radius = under_way.side, under_way.circle_m
    dn = point[slot.POINT_NORTH] - (goal_n - side * radius * math.sin(heading))
    de = point[slot.POINT_EAST] - (goal_e + side * radius * math.cos(heading))
    away = math.hypot(dn, de)
    tangent = math.atan2(de, dn) + side * 0.5 * math.pi
    return tangent + side * math.atan2(away - radius, look_ahead_m), side / max(away, radius)


LEFT_PORT_BODY_M = (0.55, -0.05, 0.08)
"""The left port's outer glass, as the default rig has it."""
CONTROL_LENGTH_M = 1.6
"""The unit of the pilot's distances: the hull of SPARUS II, which the paper (section II) states for
ALICE too; ALICE's is longer (`Vehicle.hull`)."""
LOS_DAMPING_RATIO = 0.5
"""Least damping of the path loop of `los` (inferred: one overshoot of a sixth)."""
_STRAIGHT_PER_M = 1e-9
_TERRAIN_SMOOTHING_M = 1.5
"""Relief shorter than this is not followed."""
_LOOK_AHEADS_M = np.geomspace(CONTROL_LENGTH_M, 100.0, 400)
_DEPTH_OFF_M = 0.2
"""Offset in depth for which fins do not have to be at their limits."""
_RAMP_PERIODS = 2.0
"""A reference gains its speed in this many times 1 / bandwidth of the loop that follows it: a
critically damped pair has then done most of what it does (inferred)."""
SWAY_LOOK_AHEAD_M = 2.5 * CONTROL_LENGTH_M
"""Look-ahead of `sway`, used only far off its path, where none is damped well: the longest
that Fossen (2011, section 10.3.2) gives."""


class Guidance(NamedTuple):
    """Settings of the guidance; `pilot_guidance` derives those that follow from the vehicle."""

    sway: float
    """1: the path is held by sway; 0: by heading alone."""
    point_body_m: Array
    """(3,) the followed point."""
    look_ahead_m: float
    far_m: float
    """Cross-track error beyond which sway gives way to heading ..."""
    near_m: float
    """... until it is below this."""
    lost_m: float
    """Cross-track error beyond which the vehicle goes back to where it left the path."""
    capture_m: float
    """The way in begins when its start is this near."""
    way_in_m: float
    """Straight way before the path's start."""
    smooth_m: float
    """The path's heading is averaged this far back and ahead, so that turns begin gently: as far as
    the vehicle goes, in the tightest turn, while its heading loop settles."""
    brake_mps2: float
    """Deceleration before turns that need a lower speed."""
    floor_rate_rad_s: float
    """Bandwidth at which the altitude follows the terrain."""
    surface_m: float
    """Depth of the origin at which the vehicle is at the surface."""
    stop_mps2: float
    """Deceleration into a stop."""
    turn_in_place_rad_s: float
    """Rate of a turn on the spot."""
    turn_in_place_rad_s2: float
    """Angular acceleration of that turn."""
    step_mps: float
    """Speed of a sway step."""
    step_mps2: float
    """Acceleration of that step."""
    limits: SafetyLimits
    under_way: UnderWay = HOVERS
    """How a vehicle that cannot hover flies."""


class Tick(NamedTuple):
    """A tick, for the kernels that steer: what they read, and the pilot that they write."""

    dt_s: float
    estimate: Array
    """(14,) of the navigation."""
    path: Path
    guidance: Guidance
    gains: Gains
    pilot: PilotState


def pilot_guidance(
    gains: Gains,
    path: Path,
    controller: Literal["sway", "los"],
    *,
    max_depth_m: float,
    point_body_m: tuple[float, float, float] = LEFT_PORT_BODY_M,
    look_ahead_m: float | None = None,
    turn_in_place_rad_s: float = TURN_IN_PLACE_RAD_S,
    limits: SafetyLimits | None = None,
) -> Guidance:
    """Settings for a vehicle and a path.

    Sway gives way to heading half a hull length off the path, where turning towards it begins to
    cost less than pushing the hull sideways, and takes over again at half of that (inferred).

    Args:
        gains: gains of the vehicle.
        path: its speed and altitude count.
        controller: `sway` or `los`.
        max_depth_m: no deeper than this.
        point_body_m: the followed point.
        look_ahead_m: when heading for the path; `min_look_ahead_m` when left out, and for
            `sway`, where there is none, SWAY_LOOK_AHEAD_M.
        turn_in_place_rad_s: greatest rate of turns on the spot; a vehicle that can do less
            turns slower.
        limits: for safety; half the path's altitude is the least when left out.

    Raises:
        VehicleError: the vehicle has no thrusters for sway, `los` is to fly sway steps, or no
            look-ahead will do for `los`.
    """
    axes, speed = gains.axes, path.speed_mps
    by_sway = controller == "sway"
    if by_sway and axes[g.SWAY, g.FASTEST] == 0.0:
        raise VehicleError(
            "the vehicle has no lateral thrusters: fly it with the controller los, not sway"
        )
    steps = int(np.count_nonzero(path.side_rad))
    if steps and not by_sway:
        raise VehicleError(
            f"the route has {steps} sway step{'s' if steps > 1 else ''}, which the controller los "
            "cannot fly: plan with turns = 'spot' or 'arcs', or fly alice with the controller sway"
        )
    if look_ahead_m is None:
        look_ahead_m = min_look_ahead_m(gains, speed, point_body_m[0])
    if gains.dives_by_pitch:
        look_ahead_m = max(look_ahead_m, _gentle_m(gains, g.YAW, speed, 0.5 * CONTROL_LENGTH_M))
    if math.isnan(look_ahead_m) and not by_sway:
        raise VehicleError(
            f"no look-ahead from {CONTROL_LENGTH_M:g} to {_LOOK_AHEADS_M[-1]:g} m keeps los from "
            f"weaving at {speed:g} m/s: lower the speed, or check the vehicle's coefficients"
        )
    weakest = min(-axes[g.SURGE, g.MIN_FORCE], axes[g.SURGE, g.MAX_FORCE])
    tightest = float(np.abs(path.curvature_per_m).max())
    under_way = HOVERS
    if gains.dives_by_pitch:
        under_way = _under_way(gains, path, tightest)
    turning = turning_speed_mps(gains, tightest, abs(point_body_m[0]) if by_sway else 0.0)
    turn_in_place_rad_s, step_mps = stop_speeds(
        gains, point_body_m[0], by_sway, turn_in_place_rad_s
    )
    return Guidance(
        sway=float(by_sway),
        point_body_m=np.array(point_body_m, np.float64),
        look_ahead_m=SWAY_LOOK_AHEAD_M if math.isnan(look_ahead_m) else look_ahead_m,
        far_m=0.5 * CONTROL_LENGTH_M,
        near_m=0.25 * CONTROL_LENGTH_M,
        lost_m=5.0 * CONTROL_LENGTH_M,
        capture_m=0.2 if by_sway else 1.0,
        way_in_m=CONTROL_LENGTH_M if by_sway else 3.0 * look_ahead_m,
        smooth_m=min(speed, turning) / float(axes[g.YAW, g.BANDWIDTH]),
        brake_mps2=g.STEADY_SHARE * weakest / float(axes[g.SURGE, g.MASS]),
        floor_rate_rad_s=2.0 * speed / _TERRAIN_SMOOTHING_M,
        surface_m=0.3,
        stop_mps2=speed * float(axes[g.SURGE, g.BANDWIDTH]) / _RAMP_PERIODS,
        turn_in_place_rad_s=turn_in_place_rad_s,
        turn_in_place_rad_s2=turn_in_place_rad_s * float(axes[g.YAW, g.BANDWIDTH]) / _RAMP_PERIODS,
        step_mps=step_mps,
        step_mps2=step_mps * float(axes[g.SWAY, g.BANDWIDTH]) / _RAMP_PERIODS,
        limits=limits or SafetyLimits(0.5 * path.altitude_m, max_depth_m),
        under_way=under_way,
    )


def _gentle_m(gains: Gains, axis: int, speed_mps: float, off_m: float) -> float:
    """The look-ahead with which an offset asks for no tighter a turn than fins hold.

    A path that closes as exp(-x / look-ahead) has a curvature of off / look-ahead^2.
    """
    return math.sqrt(off_m * speed_mps / float(gains.axes[axis, g.FASTEST]))


def _under_way(gains: Gains, path: Path, tightest_per_m: float) -> UnderWay:
    """How a vehicle that fins steer flies a path; it waits on a circle as wide as the path's turns.

    Raises:
        VehicleError: it cannot.
    """
    speed, fastest = path.speed_mps, float(gains.axes[g.YAW, g.FASTEST])
    if np.any(path.stop > 0.0):
        raise VehicleError(
            "the route has turns on the spot or sway steps, and a vehicle that fins steer cannot "
            "stop: plan it with turns = 'arcs', and with the room for them (area.turn_margin_m)"
        )
    if tightest_per_m * speed > fastest:
        raise VehicleError(
            f"the route has turns of {1 / tightest_per_m:.2f} m radius, and the fins hold "
            f"{speed / fastest:.2f} m at {speed:g} m/s: raise plan.turn_radius_m"
        )
    look_ahead_m = _min_m(lambda ahead_m: damping_ratio(dive_loop(gains, speed, ahead_m)))
    if math.isnan(look_ahead_m):
        raise VehicleError(
            f"no look-ahead up to {_LOOK_AHEADS_M[-1]:g} m keeps the vehicle from weaving about "
            f"its depth at {speed:g} m/s: change the speed, or check fins and coefficients"
        )
    radius_m = 1.0 / tightest_per_m if tightest_per_m > _STRAIGHT_PER_M else 2.0 * speed / fastest
    return UnderWay(
        circle_m=radius_m,
        side=1.0,
        dive_ahead_m=max(look_ahead_m, _gentle_m(gains, g.PITCH, speed, _DEPTH_OFF_M)),
        level_rad=gains.level_rad,
    )


def stop_speeds(
    gains: Gains, lever_m: float, by_sway: bool, turn_in_place_rad_s: float = TURN_IN_PLACE_RAD_S
) -> tuple[float, float]:
    """Rate of turns on the spot and speed of sway steps that a vehicle can do.

    While it turns about the followed point, the origin sways at the rate times the lever.

    Args:
        gains: gains of the vehicle.
        lever_m: how far the followed point is ahead of the origin.
        by_sway: whether sway is controlled.
        turn_in_place_rad_s: rate that is target.

    Returns:
        The rate, no greater than target, and the speed, at most `STEP_MPS`, 0 without sway.
    """
    rate = min(turn_in_place_rad_s, float(gains.axes[g.YAW, g.FASTEST]))
    if not by_sway:
        return rate, 0.0
    fastest = float(gains.axes[g.SWAY, g.FASTEST])
    if lever_m != 0.0:
        rate = min(rate, fastest / abs(lever_m))
    return rate, min(STEP_MPS, fastest)


@kernel
def turning_speed_mps(gains: Gains, curvature_per_m: float, lever_m: float) -> float:
    """Greatest speed at which a curvature needs no more yaw and sway than available.

    While the followed point goes round an arc with its heading along it, the origin, behind it,
    sways outwards by curvature times speed times the lever.

    Args:
        gains: gains of the vehicle.
        curvature_per_m: curvature of the path, not negative.
        lever_m: how far the followed point is ahead of the origin; 0 where sway is not controlled.

    Returns:
        Infinite on a straight.
    """
    if curvature_per_m < _STRAIGHT_PER_M:
        return math.inf
    speed = gains.axes[g.YAW, g.FASTEST] / curvature_per_m
    if lever_m > 0.0:
        speed = min(speed, gains.axes[g.SWAY, g.FASTEST] / (curvature_per_m * lever_m))
    return float(speed)


def los_loop(gains: Gains, speed_mps: float, lever_m: float, look_ahead_m: float) -> Array:
    """State matrix of `los` about a straight path without drift.

    States: offset of the followed point, m; heading minus the path's; sway, m/s; yaw rate; yaw
    acceleration that the lagging thrusters give. Sway and yaw are those of the hull, coupled.

    Args:
        gains: gains of the vehicle.
        speed_mps: surge.
        lever_m: how far the followed point is ahead of the origin.
        look_ahead_m: look-ahead of the guidance.

    Returns:
        (5, 5)
    """
    pair, by_moment = coupled_pair(gains.body, speed_mps, gains.fins)
    row = gains.axes[g.YAW]
    loop = np.zeros((5, 5))
    loop[0, 1:4] = speed_mps, 1.0, lever_m
    loop[1, 3] = 1.0
    loop[2:4, 2:4] = pair
    loop[2:4, 4] = by_moment * row[g.MASS]
    # Target heading -offset / look-ahead, and its rate.
    asked = -row[g.RATE] / look_ahead_m * loop[0]
    asked[[0, 1, 3]] -= row[g.PLACE] / look_ahead_m, row[g.PLACE], row[g.RATE]
    loop[4] = asked / row[g.LAG]
    loop[4, 4] -= 1.0 / row[g.LAG]
    return loop


def min_look_ahead_m(gains: Gains, speed_mps: float, lever_m: float) -> float:
    """The shortest look-ahead with which `los` is damped well enough on a straight path.

    The longer it is, the further does a current hold the vehicle off the path; the shorter, the
    more does it weave, since a slender hull slips through its turns and takes long to go where it
    points. Not below the length of the hull: the linear loop's prediction there assumes thrusters
    that are never at their limits.

    It depends on the coefficients, by the Munk moment: for SPARUS II at 0.2 m/s, origin followed,
    it is 2.87 m with `calibrated`, 1.79 with `estimated`, 1.97 with `cfd` and 1.74 with `computed`;
    with the left port followed 2.23 m and, for the others, the hull's length, 1.6 m. Fossen (2011,
    section 10.3.2) gives 1.5 to 2.5 lengths; COLA2's 5.5 m is too long for lines 1 m apart.

    Args:
        gains: gains of the vehicle.
        speed_mps: surge.
        lever_m: how far the followed point is ahead of the origin.

    Returns:
        NaN where no look-ahead up to 100 m gives that damping.
    """
    return _min_m(lambda ahead_m: damping_ratio(los_loop(gains, speed_mps, lever_m, ahead_m)))


def _min_m(damping: Callable[[float], float]) -> float:
    """The shortest look-ahead with LOS_DAMPING_RATIO; NaN where there is none."""
    ratios = np.array([damping(float(each)) for each in _LOOK_AHEADS_M])
    if not np.any(ratios >= LOS_DAMPING_RATIO):
        return math.nan
    first = int(np.argmax(ratios >= LOS_DAMPING_RATIO))
    if first == 0:
        return CONTROL_LENGTH_M
    low, high = float(_LOOK_AHEADS_M[first - 1]), float(_LOOK_AHEADS_M[first])
    return bisect(lambda ahead_m: damping(ahead_m) >= LOS_DAMPING_RATIO, high, low, 1e-3)
