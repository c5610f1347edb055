"""Where to steer: to a place, and along a path.

Both command heading, surge and sway (steering.py), in the order yaw, surge, sway.
"""

import math

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.compiled import kernel
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot.diving import circle_course
from alice_survey.sim.vehicle.pilot.gains import (
    BANDWIDTH,
    INTEGRAL_SHARE,
    SURGE,
    Gains,
)
from alice_survey.sim.vehicle.pilot.memory import PilotState
from alice_survey.sim.vehicle.pilot.path import MIN_SLANT, Path, heading_at, place_at
from alice_survey.sim.vehicle.pilot.settings import Guidance, turning_speed_mps
from alice_survey.sim.vehicle.pilot.steering import clamped, head_for, surge_at, sway_by
from alice_survey.sim.vehicle.rotations import wrapped

_HOVER_M = 2.0
"""Nearer than this a vehicle with sway hovers towards its goal instead of heading for it."""
_MAX_LEAN_RAD = math.radians(30.0)
"""Greatest angle into a current that is learned (inferred: half of a vehicle's speed across)."""
_HOVER_SHARE = 0.25
"""Bandwidth of keeping place by surge, over that of the surge loop."""


@kernel
def go_to(
    goal_n: float,
    goal_e: float,
    heading: float,
    dt_s: float,
    estimate: Array,
    path: Path,
    guidance: Guidance,
    gains: Gains,
    pilot: PilotState,
) -> tuple[float, float]:
    """Go to a place and stay there, with a heading if the vehicle can sway.

    A vehicle without sway faces its goal and waits until the current has carried it off again. One
    that cannot hover circles, and comes through the place with the heading.

    Returns:
        Distance from the goal, and the error of the wanted heading.
    """
    now = estimate[vector.HEADING]
    dn, de = goal_n - pilot.point[slot.POINT_NORTH], goal_e - pilot.point[slot.POINT_EAST]
    distance = math.hypot(dn, de)
    if guidance.under_way.circle_m > 0.0:
        course, bend = circle_course(
            goal_n, goal_e, heading, guidance.look_ahead_m, guidance.under_way, pilot.point
        )
        head_for(course, bend * path.speed_mps, 0.0, estimate, dt_s, gains, pilot)
        surge_at(path.speed_mps, dt_s, guidance, gains, pilot)
        pilot.report[slot.BY_SWAY] = 0.0
        return distance, wrapped(heading - now)
    ahead, abeam = math.cos(now) * dn + math.sin(now) * de, math.cos(now) * de - math.sin(now) * dn
    speed = clamped(_HOVER_SHARE * gains.axes[SURGE, BANDWIDTH] * ahead, path.speed_mps)
    hover = guidance.sway > 0.0 and distance < _HOVER_M
    if hover:
        error = head_for(heading, 0.0, 0.0, estimate, dt_s, gains, pilot)
    elif distance > guidance.capture_m:
        error = head_for(math.atan2(de, dn), 0.0, 0.0, estimate, dt_s, gains, pilot)
        speed = path.speed_mps * max(math.cos(error), 0.0)
    else:
        facing = pilot.report[slot.WANTED_HEADING]
        if not math.isfinite(facing):
            facing = heading
        error = head_for(facing, 0.0, 0.0, estimate, dt_s, gains, pilot)
    surge_at(speed, dt_s, guidance, gains, pilot)
    if hover:
        sway_by(-abeam, 0.0, estimate, dt_s, guidance, gains, pilot)
    pilot.report[slot.BY_SWAY] = 1.0 if hover else 0.0
    return distance, error


@kernel
def follow(
    leg: int,
    along: float,
    dt_s: float,
    estimate: Array,
    path: Path,
    guidance: Guidance,
    gains: Gains,
    pilot: PilotState,
) -> None:
    """Follow the path from where the progress is."""
    report, point, now = pilot.report, pilot.point, estimate[vector.HEADING]
    north, east = point[slot.POINT_NORTH], point[slot.POINT_EAST]
    n, e, beta, _ = place_at(path, leg, along)
    cross = (east - e) * math.cos(beta) - (north - n) * math.sin(beta)
    # A turn begins before its arc and ends after it: the path's heading averaged over a window.
    window = guidance.smooth_m
    back, k_back = heading_at(path, leg, along - window)
    front, k_front = heading_at(path, leg, along + window)
    curvature = (front - back) / (2.0 * window)
    smooth = _mean_heading(path, leg, along, window)
    speed = _wanted_speed(path, guidance, gains, leg, along, curvature)
    course = now - beta
    sine, cosine = math.sin(course), math.cos(course)
    surge, sway = point[slot.SURGE_SPEED], point[slot.SWAY_SPEED]
    slant = max(1.0 - curvature * cross, MIN_SLANT)
    pace = min(max(surge * cosine - sway * sine, 0.0), 2.0 * speed) / slant
    feed = curvature * pace
    quicken = (k_front - k_back) / (2.0 * window) * pace * pace

    by_sway = report[slot.BY_SWAY] > 0.0
    if by_sway and abs(cross) > guidance.far_m:
        by_sway = False
    elif not by_sway and guidance.sway > 0.0 and abs(cross) < guidance.near_m:
        by_sway = True
    if by_sway:
        head_for(smooth, feed, quicken, estimate, dt_s, gains, pilot)
        surge_at(speed * max(cosine, 0.0), dt_s, guidance, gains, pilot)
        # The cross-track error as the sway sees it (paper, eq. los_sway_e).
        sway_by(cross * cosine, -speed * sine, estimate, dt_s, guidance, gains, pilot)
    else:
        ahead = guidance.look_ahead_m
        aim_n, aim_e = n + ahead * math.cos(beta), e + ahead * math.sin(beta)
        heading = math.atan2(aim_e - east, aim_n - north)
        flies = guidance.under_way.circle_m > 0.0
        if flies:
            straight = curvature == 0.0
            heading += _lean(cross, beta, straight, dt_s, path, guidance, pilot)
        # The aim turns as the offset changes: what its heading does is known, not awaited.
        drift = surge * sine + sway * cosine
        feed -= ahead * drift / (ahead * ahead + cross * cross)
        error = head_for(heading + (smooth - beta), feed, quicken, estimate, dt_s, gains, pilot)
        surge_at(
            speed * (1.0 if flies else max(math.cos(error), 0.0)), dt_s, guidance, gains, pilot
        )
        if guidance.sway > 0.0:
            # Lateral thrusters keep the vehicle from slipping sideways, so that it goes where it
            # heads: else a current could hold it off the path indefinitely.
            sway_by(0.0, 0.0, estimate, dt_s, guidance, gains, pilot)
    report[slot.BY_SWAY] = 1.0 if by_sway else 0.0
    report[slot.CROSS], report[slot.PATH_HEADING] = cross, beta
    report[slot.LEG], report[slot.ALONG], report[slot.LINE] = leg, along, path.line[leg]


@kernel
def _lean(
    cross: float,
    beta: float,
    straight: bool,
    dt_s: float,
    path: Path,
    guidance: Guidance,
    pilot: PilotState,
) -> float:
    """Angle into a current from the side: an integral of the cross-track error (Fossen, 10.3).

    It is kept as a vector in NED, as that of sway is, and learns on straights, near the path, at a
    tenth of the bandwidth of the path's loop.
    """
    memory, ahead = pilot.memory, guidance.look_ahead_m
    s, c = math.sin(beta), math.cos(beta)
    if straight and abs(cross) < 0.5 * ahead:
        step = -INTEGRAL_SHARE * path.speed_mps / (ahead * ahead) * cross * dt_s
        north, east = memory[slot.LEAN_N] - s * step, memory[slot.LEAN_E] + c * step
        cut = min(1.0, _MAX_LEAN_RAD / max(math.hypot(north, east), 1e-9))
        memory[slot.LEAN_N], memory[slot.LEAN_E] = cut * north, cut * east
    return float(c * memory[slot.LEAN_E] - s * memory[slot.LEAN_N])


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
def _wanted_speed(
    path: Path, guidance: Guidance, gains: Gains, leg: int, along_m: float, curvature: float
) -> float:
    """The speed now, low enough to brake before the turns ahead."""
    lever = abs(guidance.point_body_m[0]) if guidance.sway > 0.0 else 0.0
    speed = min(path.speed_mps, turning_speed_mps(gains, abs(curvature), lever))
    distance = path.length_m[leg] - along_m - guidance.smooth_m
    reach = path.speed_mps * path.speed_mps / (2.0 * guidance.brake_mps2)
    following = leg + 1
    while (
        following < path.length_m.shape[0] and distance < reach and path.stop[following - 1] == 0.0
    ):
        there = turning_speed_mps(gains, abs(path.curvature_per_m[following]), lever)
        braking = 2.0 * guidance.brake_mps2 * max(distance, 0.0)
        speed = min(speed, math.sqrt(there * there + braking))
        distance += path.length_m[following]
        following += 1
    return speed
