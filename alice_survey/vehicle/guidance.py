"""Guidance: which way to head, how fast to go, and how to sway, tick by tick.

Two ways of following a path (paper, section VII). `los`, of the original vehicle, heads for a point
a look-ahead distance further on the path's tangent; a cross current holds it off the path by
`los_offset`. `sway` keeps the heading along the path and asks the lateral thrusters for a sway
speed that takes the cross-track error away; far off the path it turns to `los` until it is near.
Position, cross-track error and altitude are those of the followed point, by default the left port's
glass, for which plans are made.
"""

import math
from typing import Literal, NamedTuple

import numpy as np

from alice_survey.errors import VehicleError
from alice_survey.frames import Array
from alice_survey.vehicle import pilot as told
from alice_survey.vehicle import signals
from alice_survey.vehicle.compiled import kernel
from alice_survey.vehicle.control import (
    clamped,
    place_demand,
    place_sum_step,
    speed_demand,
    sum_bound,
    wrapped,
    write_wrench,
)
from alice_survey.vehicle.gains import (
    BANDWIDTH,
    FASTEST,
    HEAVE,
    LEAST,
    MASS,
    MOST,
    STEADY_SHARE,
    SURGE,
    SWAY,
    YAW,
    Gains,
)
from alice_survey.vehicle.path import Path, advance, heading_at, path_from_legs, place_at
from alice_survey.vehicle.pilot import REPORT, PilotState, new_pilot
from alice_survey.vehicle.rotations import wrapped
from alice_survey.vehicle.safety import (
    LOST_PATH,
    NO_NAVIGATION,
    NONE,
    Limits,
    restart_watch,
    watch,
)
from alice_survey.vehicle.signals import ABORT, APPROACH, ASCEND, DIVE, DONE, FOLLOW

__all__ = [
    "REPORT", "Gains", "Guidance", "Limits", "Path", "PilotState", "los_offset", "new_pilot",
    "path_from_legs", "pilot_guidance", "steer",
]  # fmt: skip

LEFT_PORT_BODY_M = (0.55, -0.05, 0.08)
HULL_LENGTH_M = 1.6
"""Of SPARUS II and ALICE (paper, section II)."""
LOOK_AHEAD_SHARE = 4.0
"""The cross-track loop of `los`, of bandwidth speed / look-ahead, is this much slower than the
heading loop (inferred: the usual separation of cascaded loops, 3 to 5)."""
_DEPTH_KEPT_M = 0.2
_DEPTH_SPEED_KEPT_MPS = 0.05
_HEADING_KEPT_RAD = math.radians(10.0)
_SETTLE_S = 2.0
_HOVER_M = 2.0
"""Nearer than this a vehicle with sway hovers towards its goal instead of heading for it."""
_HOVER_SHARE = 0.25
"""Bandwidth of keeping place by surge, by that of the surge loop."""
_QUICKEST = 2.0
"""Progress along the path by the wanted speed, at most: a projection may not jump."""


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
    """The path's heading is averaged this far back and ahead, so that turns begin gently."""
    brake_mps2: float
    """Deceleration before turns that need a lower speed."""
    floor_rate_rad_s: float
    """Bandwidth at which the altitude follows the terrain."""
    surface_m: float
    """Depth of the origin at which the vehicle is at the surface."""
    limits: Limits


def pilot_guidance(
    gains: Gains,
    path: Path,
    controller: Literal["sway", "los"],
    *,
    most_depth_m: float,
    point_body_m: tuple[float, float, float] = LEFT_PORT_BODY_M,
    look_ahead_m: float | None = None,
    terrain_smoothing_m: float = 1.5,
    limits: Limits | None = None,
) -> Guidance:
    """Settings for a vehicle and a path.

    The look-ahead is the shortest that the heading loop allows: the longer, the further does a
    current hold the vehicle off the path. Fossen (2011, section 10.3.2) takes 1.5 to 2.5 lengths of
    the vessel; COLA2's 5.5 m is far too long for lines 1 m apart.

    Args:
        gains: of the vehicle.
        path: its speed and altitude count.
        controller: `sway` or `los`.
        most_depth_m: no deeper than this.
        point_body_m: the followed point.
        look_ahead_m: of `los`; derived when left out.
        terrain_smoothing_m: relief shorter than this is not followed.
        limits: for safety; half the path's altitude is the least when left out.

    Raises:
        VehicleError: the vehicle has no thrusters for sway, or a value is out of range.
    """
    axes, speed = gains.axes, path.speed_mps
    by_sway = controller == "sway"
    if by_sway and axes[SWAY, FASTEST] == 0.0:
        raise VehicleError(
            "the vehicle has no lateral thrusters: fly it with the controller los, not sway"
        )
    if look_ahead_m is None:
        look_ahead_m = LOOK_AHEAD_SHARE * speed / float(axes[YAW, BANDWIDTH])
    for name, value in (("look-ahead", look_ahead_m), ("terrain smoothing", terrain_smoothing_m)):
        if not value > 0.0:
            raise VehicleError(f"the {name} is {value:g} m: it must be positive")
    weakest = min(-axes[SURGE, LEAST], axes[SURGE, MOST])
    return Guidance(
        sway=float(by_sway),
        point_body_m=np.array(point_body_m, np.float64),
        look_ahead_m=look_ahead_m,
        far_m=0.5 * HULL_LENGTH_M,
        near_m=0.25 * HULL_LENGTH_M,
        lost_m=5.0 * HULL_LENGTH_M,
        capture_m=0.2 if by_sway else 1.0,
        way_in_m=HULL_LENGTH_M if by_sway else 3.0 * look_ahead_m,
        smooth_m=speed / float(axes[YAW, BANDWIDTH]),
        brake_mps2=STEADY_SHARE * weakest / float(axes[SURGE, MASS]),
        floor_rate_rad_s=2.0 * speed / terrain_smoothing_m,
        surface_m=0.3,
        limits=limits or Limits(0.5 * path.altitude_m, most_depth_m),
    )


def los_offset(
    look_ahead_m: float,
    speed_mps: float,
    across_mps: float,
    along_mps: float = 0.0,
    *,
    over_ground: bool = True,
) -> float:
    """Where `los` settles beside a straight path in a steady current, metres to starboard.

    Steady means no turning and no drag across the hull, since nothing would balance it: the sway
    relative to the water is zero. With t the tangent of the angle from path to heading, the offset
    is -look_ahead t. The current's part across the hull must be the sway over ground. If surge
    relative to the water is kept at U, U sin = -across, so that the offset is
    look_ahead across / sqrt(U^2 - across^2). If surge over ground is kept at U, the speed along the
    path is U / cos and the sway over ground -U t, whence U t sqrt(1 + t^2) = along t - across;
    without a current along the path t^2 = (sqrt(1 + 4 (across / U)^2) - 1) / 2.

    Args:
        look_ahead_m: of the guidance.
        speed_mps: U, the surge that is kept.
        across_mps: current to starboard of the path.
        along_mps: current along the path.
        over_ground: what U is relative to.

    Returns:
        NaN where there is no such state: the current across is too strong for a speed relative to
        the water, or the current along takes the vehicle faster than U.
    """
    if not over_ground:
        if abs(across_mps) >= speed_mps:
            return math.nan
        return look_ahead_m * across_mps / math.sqrt(speed_mps**2 - across_mps**2)
    if along_mps >= speed_mps:
        return math.nan
    if along_mps == 0.0:
        ratio = across_mps / speed_mps
        size = math.sqrt(0.5 * (math.sqrt(1.0 + 4.0 * ratio**2) - 1.0))
        return look_ahead_m * math.copysign(size, across_mps)
    from scipy.optimize import brentq

    def surplus(t: float) -> float:
        return speed_mps * t * math.sqrt(1.0 + t * t) - along_mps * t + across_mps

    reach = 1.0 + 2.0 * (abs(across_mps) + abs(along_mps)) / (speed_mps - max(along_mps, 0.0))
    return -look_ahead_m * float(brentq(surplus, -reach, reach, xtol=1e-14))


@kernel
def _hear_floor(estimate: Array, dt_s: float, guidance: Guidance, pilot: PilotState) -> None:
    """Smooth the depth that the origin's depth and the altitude add up to, and its slope.

    A critically damped second-order tracker: it follows a constant slope without lag. Without
    bottom lock the depth is held and the slope fades.
    """
    memory, rate = pilot.memory, guidance.floor_rate_rad_s
    heard = estimate[signals.DEPTH] + estimate[signals.ALTITUDE]
    if not math.isfinite(heard):
        memory[told.FLOOR_SLOPE] *= 1.0 - rate * dt_s
        return
    if memory[told.FLOOR_KNOWN] == 0.0:
        memory[told.FLOOR_KNOWN], memory[told.FLOOR] = 1.0, heard
        restart_watch(pilot)
        return
    surprise = heard - memory[told.FLOOR]
    memory[told.FLOOR] += dt_s * (memory[told.FLOOR_SLOPE] + 2.0 * rate * surprise)
    memory[told.FLOOR_SLOPE] += dt_s * rate * rate * surprise


@kernel
def _followed_point(
    estimate: Array, guidance: Guidance
) -> tuple[float, float, float, float, float, float]:
    """North and east of the followed point; its level velocity ahead and to starboard; the depth
    rate of the origin; and the rate of the heading.
    """
    p = guidance.point_body_m
    sr, cr = math.sin(estimate[signals.ROLL]), math.cos(estimate[signals.ROLL])
    sp, cp = math.sin(estimate[signals.PITCH]), math.cos(estimate[signals.PITCH])
    sy, cy = math.sin(estimate[signals.HEADING]), math.cos(estimate[signals.HEADING])
    ahead = cp * p[0] + sp * (sr * p[1] + cr * p[2])
    beside = cr * p[1] - sr * p[2]
    u, v, w = estimate[signals.U], estimate[signals.V], estimate[signals.W]
    turn = (sr * estimate[signals.Q] + cr * estimate[signals.R]) / cp
    surge = cp * u + sp * (sr * v + cr * w) - turn * beside
    sway = cr * v - sr * w + turn * ahead
    sink = -sp * u + cp * (sr * v + cr * w)
    north = estimate[signals.NORTH] + cy * ahead - sy * beside
    east = estimate[signals.EAST] + sy * ahead + cy * beside
    return north, east, surge, sway, sink, turn


@kernel
def _allowed_speed(path: Path, guidance: Guidance, gains: Gains, curvature: float) -> float:
    """Greatest speed at which a curvature asks for no more yaw and sway than there is."""
    k = abs(curvature)
    if k < 1e-9:
        return path.speed_mps
    speed = min(path.speed_mps, gains.axes[YAW, FASTEST] / k)
    lever = abs(guidance.point_body_m[0])
    if guidance.sway > 0.0 and lever > 1e-9:
        speed = min(speed, gains.axes[SWAY, FASTEST] / (k * lever))
    return float(speed)


@kernel
def _wanted_speed(
    path: Path, guidance: Guidance, gains: Gains, leg: int, along_m: float, curvature: float
) -> float:
    """The speed now, low enough to brake before the turns ahead."""
    speed = _allowed_speed(path, guidance, gains, curvature)
    distance = path.length_m[leg] - along_m - guidance.smooth_m
    reach = path.speed_mps * path.speed_mps / (2.0 * guidance.brake_mps2)
    following = leg + 1
    while following < path.length_m.shape[0] and distance < reach:
        there = _allowed_speed(path, guidance, gains, path.curvature_per_m[following])
        braking = 2.0 * guidance.brake_mps2 * max(distance, 0.0)
        speed = min(speed, math.sqrt(there * there + braking))
        distance += path.length_m[following]
        following += 1
    return speed


@kernel
def _enter(pilot: PilotState, phase: int) -> None:
    pilot.report[told.PHASE] = phase
    pilot.memory[told.SETTLED_S] = 0.0
    restart_watch(pilot)


@kernel
def _sink_to(
    depth_m: float, feed_mps: float, estimate: Array, sink_mps: float, dt_s: float, gains: Gains,
    pilot: PilotState,
) -> None:  # fmt: skip
    """Ask for the heave that takes the origin to a depth."""
    memory, demand = pilot.memory, pilot.demand
    error, most = depth_m - estimate[signals.DEPTH], gains.axes[HEAVE, FASTEST]
    full = demand[told.FULL_HEAVE]
    demand[told.REF_HEAVE], demand[told.ACC_HEAVE] = place_demand(
        gains, HEAVE, error, sink_mps, clamped(feed_mps, 0.5 * most), memory[told.HEAVE_SUM], most
    )
    # Far from the depth the speed is cut, and an integral would only wind up.
    if abs(error) < _DEPTH_KEPT_M:
        total = memory[told.HEAVE_SUM] + place_sum_step(gains, HEAVE, error, full, dt_s)
        memory[told.HEAVE_SUM] = clamped(total, sum_bound(gains, HEAVE))
    pilot.report[told.WANTED_DEPTH] = depth_m


@kernel
def _head_for(
    heading: float, turn_feed: float, acceleration: float, estimate: Array, turn: float,
    dt_s: float, gains: Gains, pilot: PilotState,
) -> float:  # fmt: skip
    """Ask for the yaw that takes the heading to a wanted one; the error of heading, rad."""
    memory, demand = pilot.memory, pilot.demand
    error = wrapped(heading - estimate[signals.HEADING])
    most = gains.axes[YAW, FASTEST]
    demand[told.REF_YAW], accelerate = place_demand(
        gains, YAW, error, turn, turn_feed, memory[told.YAW_SUM], most
    )
    demand[told.ACC_YAW] = accelerate + acceleration
    if abs(error) < _HEADING_KEPT_RAD:
        step = place_sum_step(gains, YAW, error, demand[told.FULL_YAW], dt_s)
        memory[told.YAW_SUM] = clamped(memory[told.YAW_SUM] + step, sum_bound(gains, YAW))
    pilot.report[told.WANTED_HEADING] = heading
    return error


@kernel
def _surge_at(
    speed: float, surge: float, dt_s: float, guidance: Guidance, gains: Gains, pilot: PilotState
) -> None:
    """Ask for a surge of the followed point over ground."""
    memory, demand = pilot.memory, pilot.demand
    demand[told.ACC_SURGE], memory[told.SURGE_SUM] = speed_demand(
        gains, SURGE, speed - surge, demand[told.FULL_SURGE], memory[told.SURGE_SUM], dt_s
    )
    demand[told.REF_SURGE] = speed + demand[told.REF_YAW] * guidance.point_body_m[1]
    pilot.report[told.WANTED_SURGE] = speed


@kernel
def _sway_by(
    offset: float, feed: float, sway: float, learn: bool, heading: float, dt_s: float,
    guidance: Guidance, gains: Gains, pilot: PilotState,
) -> None:  # fmt: skip
    """Ask for the sway that takes away an offset of the followed point to starboard.

    The integral is kept as a vector in NED and turned into the body (Fossen 2011, section 12.2.7,
    does so for positioning): what holds against a current is still right after a turn.
    """
    memory, demand = pilot.memory, pilot.demand
    s, c = math.sin(heading), math.cos(heading)
    total = c * memory[told.SWAY_SUM_E] - s * memory[told.SWAY_SUM_N]
    steady, accelerate = place_demand(
        gains, SWAY, -offset, sway, feed, total, gains.axes[SWAY, FASTEST]
    )
    lever = guidance.point_body_m[0]
    demand[told.REF_SWAY] = steady - lever * demand[told.REF_YAW]
    demand[told.ACC_SWAY] = accelerate - lever * demand[told.ACC_YAW]
    pilot.report[told.WANTED_SWAY] = steady
    if learn:
        step = place_sum_step(gains, SWAY, -offset, demand[told.FULL_SWAY], dt_s)
        memory[told.SWAY_SUM_N] -= s * step
        memory[told.SWAY_SUM_E] += c * step
        size = math.hypot(memory[told.SWAY_SUM_N], memory[told.SWAY_SUM_E])
        bound = sum_bound(gains, SWAY)
        if size > bound:
            memory[told.SWAY_SUM_N] *= bound / size
            memory[told.SWAY_SUM_E] *= bound / size


@kernel
def _go_to(
    goal_n: float, goal_e: float, heading: float, north: float, east: float, surge: float,
    sway: float, turn: float, dt_s: float, estimate: Array, path: Path, guidance: Guidance,
    gains: Gains, pilot: PilotState,
) -> tuple[float, float]:  # fmt: skip
    """Go to a place and stay there, with a heading if the vehicle can sway.

    A vehicle without sway faces its goal and waits until the current has carried it off again.

    Returns:
        Distance from the goal, and the error of the wanted heading.
    """
    now = estimate[signals.HEADING]
    dn, de = goal_n - north, goal_e - east
    distance = math.hypot(dn, de)
    ahead, beside = math.cos(now) * dn + math.sin(now) * de, math.cos(now) * de - math.sin(now) * dn
    keep = _HOVER_SHARE * gains.axes[SURGE, BANDWIDTH]
    hover = guidance.sway > 0.0 and distance < _HOVER_M
    if hover:
        error = _head_for(heading, 0.0, 0.0, estimate, turn, dt_s, gains, pilot)
        speed = clamped(keep * ahead, path.speed_mps)
    elif distance > guidance.capture_m:
        error = _head_for(math.atan2(de, dn), 0.0, 0.0, estimate, turn, dt_s, gains, pilot)
        speed = path.speed_mps * max(math.cos(error), 0.0)
    else:
        facing = pilot.report[told.WANTED_HEADING]
        error = _head_for(facing, 0.0, 0.0, estimate, turn, dt_s, gains, pilot)
        speed = clamped(keep * ahead, path.speed_mps)
    _surge_at(speed, surge, dt_s, guidance, gains, pilot)
    if hover:
        _sway_by(-beside, 0.0, sway, distance < guidance.far_m, now, dt_s, guidance, gains, pilot)
    pilot.report[told.BY_SWAY] = 1.0 if hover else 0.0
    return distance, error


@kernel
def _follow(
    leg: int, along: float, north: float, east: float, surge: float, sway: float, turn: float,
    dt_s: float, estimate: Array, path: Path, guidance: Guidance, gains: Gains, pilot: PilotState,
) -> None:  # fmt: skip
    """Follow the path from where the progress is."""
    report, now = pilot.report, estimate[signals.HEADING]
    n, e, beta, _ = place_at(path, leg, along)
    cross = (east - e) * math.cos(beta) - (north - n) * math.sin(beta)
    # A turn begins before its arc and ends after it: the path's heading averaged over a window.
    window = guidance.smooth_m
    back, k_back = heading_at(path, leg, along - window)
    front, k_front = heading_at(path, leg, along + window)
    mean_turned = _mean_heading(path, leg, along, window) - beta
    curvature = (front - back) / (2.0 * window)
    speed = _wanted_speed(path, guidance, gains, leg, along, curvature)
    course = now - beta
    slant = max(1.0 - curvature * cross, 0.3)
    pace = min(max(surge * math.cos(course) - sway * math.sin(course), 0.0), 2.0 * speed) / slant
    drift = surge * math.sin(course) + sway * math.cos(course)
    feed = curvature * pace
    quicken = (k_front - k_back) / (2.0 * window) * pace * pace

    by_sway = report[told.BY_SWAY] > 0.0
    if by_sway and abs(cross) > guidance.far_m:
        by_sway = False
    elif not by_sway and guidance.sway > 0.0 and abs(cross) < guidance.near_m:
        by_sway = True
    if by_sway:
        error = _head_for(beta + mean_turned, feed, quicken, estimate, turn, dt_s, gains, pilot)
        _surge_at(speed * math.cos(course), surge, dt_s, guidance, gains, pilot)
        # The cross-track error as the sway sees it (paper, eq. los_sway_e).
        _sway_by(
            cross * math.cos(course), -speed * math.sin(course), sway, True, now, dt_s, guidance,
            gains, pilot,
        )  # fmt: skip
    else:
        ahead = guidance.look_ahead_m
        seen_n = n + ahead * math.cos(beta) - north
        seen_e = e + ahead * math.sin(beta) - east
        heading = math.atan2(seen_e, seen_n)
        feed -= ahead * drift / (ahead * ahead + cross * cross)
        error = _head_for(heading + mean_turned, feed, quicken, estimate, turn, dt_s, gains, pilot)
        _surge_at(speed * max(math.cos(error), 0.0), surge, dt_s, guidance, gains, pilot)
    report[told.BY_SWAY] = 1.0 if by_sway else 0.0
    report[told.CROSS], report[told.PATH_HEADING] = cross, beta
    report[told.LEG], report[told.ALONG], report[told.LINE] = leg, along, path.line[leg]


@kernel
def _mean_heading(path: Path, leg: int, along_m: float, window_m: float) -> float:
    """Heading of the path averaged over a window: Simpson's rule on its halves."""
    a, _ = heading_at(path, leg, along_m - window_m)
    b, _ = heading_at(path, leg, along_m - 0.5 * window_m)
    c, _ = heading_at(path, leg, along_m)
    d, _ = heading_at(path, leg, along_m + 0.5 * window_m)
    e, _ = heading_at(path, leg, along_m + window_m)
    return (a + 4.0 * b + 2.0 * c + 4.0 * d + e) / 12.0


@kernel
def steer(
    time_s: float,
    dt_s: float,
    estimate: Array,
    path: Path,
    guidance: Guidance,
    gains: Gains,
    pilot: PilotState,
    wrench: Array,
) -> None:
    """Guide and control the vehicle for a tick.

    Args:
        time_s: since the start of the mission.
        dt_s: the tick.
        estimate: (13,) of the navigation, see signals.py.
        path: to follow.
        guidance: settings.
        gains: of the inner loops.
        pilot: memory and report, written.
        wrench: (6,) N and N m, is written: forces and moments to ask of the thrusters.
    """
    memory, report, demand = pilot.memory, pilot.report, pilot.demand
    for i in range(told.FULL_SURGE):
        demand[i] = 0.0
    report[told.WANTED_SWAY], report[told.WANTED_SURGE] = 0.0, 0.0
    phase, leg, along = int(report[told.PHASE]), int(report[told.LEG]), report[told.ALONG]
    if phase == DONE or report[told.REASON] == NO_NAVIGATION:
        # Without knowing how it moves the vehicle can only push itself up.
        for i in range(6):
            wrench[i] = 0.0
        if phase == ABORT:
            wrench[2] = STEADY_SHARE * gains.axes[HEAVE, LEAST]
        return
    north, east, surge, sway, sink, turn = _followed_point(estimate, guidance)
    _hear_floor(estimate, dt_s, guidance, pilot)
    known = memory[told.FLOOR_KNOWN] > 0.0
    depth = estimate[signals.DEPTH]
    # Origin and followed point differ in depth by what the smoothed sum holds on average.
    target = memory[told.FLOOR] - path.altitude_m if known else guidance.limits.most_depth_m

    goal_n, goal_e, goal_heading, _ = place_at(path, leg, along - guidance.way_in_m)
    progress = 0.0
    if phase == DIVE:
        progress = -abs(target - depth)
    elif phase == APPROACH:
        progress = -math.hypot(goal_n - north, goal_e - east)
    elif phase == FOLLOW:
        progress = path.begins_m[leg] + along
    reason = watch(time_s, dt_s, estimate, progress, guidance.limits, pilot)
    if reason != NONE and phase != ABORT:
        report[told.REASON] = reason
        report[told.WANTED_HEADING] = estimate[signals.HEADING]
        _enter(pilot, ABORT)
        phase = ABORT

    if phase == DIVE or phase == APPROACH:
        _sink_to(target, memory[told.FLOOR_SLOPE], estimate, sink, dt_s, gains, pilot)
        distance, error = _go_to(
            goal_n, goal_e, goal_heading, north, east, surge, sway, turn, dt_s, estimate, path,
            guidance, gains, pilot,
        )  # fmt: skip
        report[told.CROSS], report[told.PATH_HEADING] = (
            (east - goal_e) * math.cos(goal_heading) - (north - goal_n) * math.sin(goal_heading),
            goal_heading,
        )
        report[told.LEG], report[told.ALONG], report[told.LINE] = leg, along, -1.0
        deep = known and abs(target - depth) < _DEPTH_KEPT_M and abs(sink) < _DEPTH_SPEED_KEPT_MPS
        there = distance < guidance.capture_m and (
            guidance.sway == 0.0 or abs(error) < _HEADING_KEPT_RAD
        )
        settled = deep if phase == DIVE else there
        memory[told.SETTLED_S] = memory[told.SETTLED_S] + dt_s if settled else 0.0
        if phase == DIVE and memory[told.SETTLED_S] > _SETTLE_S:
            _enter(pilot, APPROACH)
        elif (
            phase == APPROACH
            and there
            and (guidance.sway == 0.0 or memory[told.SETTLED_S] > _SETTLE_S)
        ):
            report[told.ALONG] = along - guidance.way_in_m
            _enter(pilot, FOLLOW)
    elif phase == FOLLOW:
        most_m = _QUICKEST * path.speed_mps * dt_s
        leg, along, over = advance(path, leg, along, north, east, most_m)
        _sink_to(target, memory[told.FLOOR_SLOPE], estimate, sink, dt_s, gains, pilot)
        _follow(
            leg, along, north, east, surge, sway, turn, dt_s, estimate, path, guidance, gains,
            pilot,
        )  # fmt: skip
        if over:
            _enter(pilot, ASCEND)
        elif abs(report[told.CROSS]) > guidance.lost_m:
            memory[told.RETURNS] += 1.0
            if memory[told.RETURNS] > guidance.limits.most_returns:
                report[told.REASON] = LOST_PATH
                _enter(pilot, ABORT)
            else:
                # Back to where the path was left; of an arc, to its start.
                if path.curvature_per_m[leg] != 0.0:
                    report[told.ALONG] = 0.0
                _enter(pilot, APPROACH)
    else:
        _sink_to(0.0, 0.0, estimate, sink, dt_s, gains, pilot)
        facing = report[told.WANTED_HEADING]
        _head_for(facing, 0.0, 0.0, estimate, turn, dt_s, gains, pilot)
        _surge_at(0.0, surge, dt_s, guidance, gains, pilot)
        report[told.LINE], report[told.BY_SWAY] = -1.0, 0.0
        if depth < guidance.surface_m:
            report[told.AT_SURFACE] = 1.0
            if phase == ASCEND:
                report[told.PHASE] = DONE
    write_wrench(gains, pilot, wrench)
