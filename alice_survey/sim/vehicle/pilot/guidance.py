"""Guidance: heading, speed and sway, tick by tick.

Two ways of following a path (paper, section VII). `los`, of the original vehicle, heads for a point
a look-ahead distance further on the path's tangent; a cross current holds it off the path
(docs/vehicle-comparison.md). `sway` keeps the heading along the path and asks the lateral thrusters
for a sway speed that takes the cross-track error away; far off the path it turns to `los` until it
is near. Position, cross-track error and altitude are those of the followed point, by default the
left port's glass, for which plans are made.

A mission in the form of another vehicle's software is flown by its law instead (mission.py).

A mission's phases (memory.py): DIVE to the altitude, as near to the start as the thrusters can
stay; APPROACH to the start of a straight way in, however far the current has carried the vehicle;
FOLLOW the path; ASCEND; DONE. ABORT, from any phase but the last two, is an ascent with a reason
(memory.py). Close to the sea floor the vehicle slows down and climbs. Without bottom lock it stops
and holds its depth, rising as the floor last did, until the lock is lost for too long. A vehicle
that fins steer goes on at the survey's speed in all of these, on a circle where it would wait.
"""

import math

from alice_survey.core.compiled import kernel
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.pilot import gains as g
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot.memory import (
    LOST_PATH,
    NO_NAVIGATION,
    NONE,
    PilotState,
    mind_floor,
    restart_watch,
    watch,
)
from alice_survey.sim.vehicle.pilot.mission import (
    COLA2,
    END_E,
    END_N,
    NO_LAW,
    PilotMission,
    fly_mission,
)
from alice_survey.sim.vehicle.pilot.path import MIN_SLANT, Path, advance, heading_at, place_at
from alice_survey.sim.vehicle.pilot.settings import Guidance, Tick, circle_course, turning_speed_mps
from alice_survey.sim.vehicle.pilot.steering import (
    DEPTH_KEPT_M,
    HEADING_KEPT_RAD,
    clamp,
    head_for,
    hear_floor,
    sink_to,
    stand,
    start_standing,
    surge_at,
    sway_by,
    write_point,
    write_wrench,
)
from alice_survey.sim.vehicle.rotations import wrap_angle
from alice_survey.sim.vehicle.sea import bracket

_STEP_M = 1000.0
"""Progress of a step of a mission that is done, above the length of any."""
_HOVER_M = 2.0
"""Nearer than this a vehicle with sway hovers towards its goal instead of heading for it."""
_MAX_LEAN_RAD = math.radians(30.0)
"""Greatest angle into a current that is learned (inferred: half of a vehicle's speed across)."""
_HOVER_SHARE = 0.25
"""Bandwidth of keeping place by surge, over that of the surge loop."""


@kernel
def follow(leg: int, along: float, tick: Tick) -> None:
    """Follow the path from where the progress is."""
    dt_s, estimate, path, guidance, gains, pilot = tick
    report, point, now = pilot.report, pilot.point, estimate[vector.HEADING]
    north, east = point[slot.POINT_NORTH], point[slot.POINT_EAST]
    n, e, beta, _ = place_at(path, leg, along)
    cross = (east - e) * math.cos(beta) - (north - n) * math.sin(beta)
    # A turn begins before its arc and ends after it: the path's heading averaged over a window.
    window = guidance.smooth_m
    back, k_back = heading_at(path, leg, along - window)
    front, k_front = heading_at(path, leg, along + window)
    curvature = (front - back) / (2.0 * window)
    # Averaged over the window by Simpson's rule on its halves.
    before, _ = heading_at(path, leg, along - 0.5 * window)
    here, _ = heading_at(path, leg, along)
    after, _ = heading_at(path, leg, along + 0.5 * window)
    smooth = (back + 4.0 * before + 2.0 * here + 4.0 * after + front) / 12.0
    # The speed now, low enough to brake before the turns ahead.
    lever = abs(guidance.point_body_m[0]) if guidance.sway > 0.0 else 0.0
    speed = min(path.speed_mps, turning_speed_mps(gains, abs(curvature), lever))
    distance = path.length_m[leg] - along - window
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
        head_for(smooth, feed, quicken, tick)
        surge_at(speed * max(cosine, 0.0), tick)
        # The cross-track error as the sway sees it (paper, eq. los_sway_e).
        sway_by(cross * cosine, -speed * sine, tick)
    else:
        ahead = guidance.look_ahead_m
        aim_n, aim_e = n + ahead * math.cos(beta), e + ahead * math.sin(beta)
        heading = math.atan2(aim_e - east, aim_n - north)
        flies = guidance.under_way.circle_m > 0.0
        if flies:
            # An angle into a current from the side: an integral of the cross-track error (Fossen,
            # 10.3), kept as a vector in NED, that learns on straights, near the path, at a tenth
            # of the bandwidth of the path's loop.
            memory, s, c = pilot.memory, math.sin(beta), math.cos(beta)
            if curvature == 0.0 and abs(cross) < 0.5 * ahead:
                step = -g.INTEGRAL_SHARE * path.speed_mps / (ahead * ahead) * cross * dt_s
                lean_n, lean_e = memory[slot.LEAN_N] - s * step, memory[slot.LEAN_E] + c * step
                cut = min(1.0, _MAX_LEAN_RAD / max(math.hypot(lean_n, lean_e), 1e-9))
                memory[slot.LEAN_N], memory[slot.LEAN_E] = cut * lean_n, cut * lean_e
            heading += c * memory[slot.LEAN_E] - s * memory[slot.LEAN_N]
        # The aim turns as the offset changes: what its heading does is known, not awaited.
        drift = surge * sine + sway * cosine
        feed -= ahead * drift / (ahead * ahead + cross * cross)
        error = head_for(heading + (smooth - beta), feed, quicken, tick)
        surge_at(speed * (1.0 if flies else max(math.cos(error), 0.0)), tick)
        if guidance.sway > 0.0:
            # Lateral thrusters keep the vehicle from slipping sideways, so that it goes where it
            # heads: else a current could hold it off the path indefinitely.
            sway_by(0.0, 0.0, tick)
    report[slot.BY_SWAY] = 1.0 if by_sway else 0.0
    report[slot.CROSS], report[slot.PATH_HEADING] = cross, beta
    report[slot.LEG], report[slot.ALONG], report[slot.LINE] = leg, along, path.line[leg]


_DEPTH_SPEED_KEPT_MPS = 0.05
_CAUTION_M = 0.5
"""A dive without bottom lock stops at least this far above the greatest depth."""
_AHEAD_M, _OFF_M = 0.4, 0.3
"""Over a known sea floor: how far ahead a hovering vehicle looks, about its way to stop, and from
how far off its depth on it goes slower, to stand at twice that."""
_MEAN_S = 12.0
"""Swings are averaged over about this time, and must be about the goal for as long: longer than the
period of a long swell."""
_SWING = 3.0
"""The path is entered from within so many times the distance that counts as near."""
_SETTLE_S = 2.0
_QUICKEST = 2.0
"""Greatest progress along the path over the requested speed: a projection may not jump."""


@kernel
def steer(time_s: float, tick: Tick, mission: PilotMission, wrench: Array) -> None:
    """Guide and control the vehicle for a tick.

    Args:
        time_s: since the start of the mission.
        tick: what is read, and the pilot that is written.
        mission: steps to fly by the law of another vehicle's software; `NO_MISSION` for none.
        wrench: (6,) N and N m, is written: forces and moments commanded of the thrusters.
    """
    dt_s, estimate, path, guidance, gains, pilot = tick
    report, demand = pilot.report, pilot.demand
    for i in range(slot.FULL_SURGE):
        demand[i] = 0.0
    for i in range(6):
        wrench[i] = 0.0
    report[slot.TARGET_SWAY] = report[slot.TARGET_SURGE] = 0.0
    if report[slot.PHASE] == slot.DONE:
        return
    known = 0.0
    for i in range(vector.ALTITUDE):
        known += estimate[i]
    if not math.isfinite(known):
        report[slot.REASON] = NO_NAVIGATION
        _enter(pilot, slot.ABORT)
    if report[slot.REASON] == NO_NAVIGATION:
        # Without an estimate of its motion the vehicle can only push itself up.
        wrench[2] = g.STEADY_SHARE * gains.axes[g.HEAVE, g.MIN_FORCE]
        return

    write_point(estimate, guidance, pilot)
    hear_floor(estimate, dt_s, guidance, pilot)
    # What should grow: of a mission the steps done, and less of this one left to go.
    leg, point = int(report[slot.LEG]), pilot.point
    if mission.law != NO_LAW:
        step = mission.steps[leg]
        left = math.hypot(
            step[END_N] - point[slot.POINT_NORTH], step[END_E] - point[slot.POINT_EAST]
        )
        left += abs(report[slot.TARGET_DEPTH] - estimate[vector.DEPTH])
        progress = _STEP_M * leg - left + pilot.memory[slot.HELD_S]
    elif report[slot.PHASE] == slot.DIVE:
        progress = -abs(_target_m(path, guidance, pilot) - estimate[vector.DEPTH])
    elif report[slot.PHASE] == slot.APPROACH:
        n, e, _ = _goal(path, guidance, pilot)
        progress = -math.hypot(n - point[slot.POINT_NORTH], e - point[slot.POINT_EAST])
    else:
        progress = path.begins_m[leg] + report[slot.ALONG]
        if path.turn_rad[leg] != 0.0:
            # A radian of a turn on the spot counts as a metre.
            progress += pilot.memory[slot.REF]
    reason = watch(time_s, dt_s, estimate, progress, guidance.limits, pilot)
    if reason != NONE:
        _abort(reason, estimate, pilot)

    phase = report[slot.PHASE]
    if mission.law != NO_LAW and (phase == slot.FOLLOW or phase == slot.DIVE):
        if fly_mission(mission, tick):
            _enter(pilot, slot.ASCEND)
    elif phase == slot.FOLLOW:
        _on_path(tick)
    elif phase == slot.DIVE or phase == slot.APPROACH:
        _on_the_way(tick)
    else:
        sink_to(0.0, 0.0, tick)
        turning, speed = 0.0, 0.0
        if guidance.under_way.circle_m > 0.0:
            speed = path.speed_mps
            turning = guidance.under_way.side * speed / guidance.under_way.circle_m
        heading = report[slot.TARGET_HEADING] + turning * dt_s
        if turning != 0.0:  # no farther ahead of the vehicle than it keeps up with
            behind = wrap_angle(heading - estimate[vector.HEADING])
            heading = estimate[vector.HEADING] + clamp(behind, HEADING_KEPT_RAD)
        head_for(heading, turning, 0.0, tick)
        surge_at(speed, tick)
        report[slot.LINE], report[slot.BY_SWAY] = -1.0, 0.0
        if estimate[vector.DEPTH] < guidance.surface_m:
            report[slot.AT_SURFACE] = 1.0
            if phase == slot.ASCEND:
                report[slot.PHASE] = slot.DONE
    write_wrench(estimate, dt_s, gains, pilot, wrench)
    if guidance.sway == 0.0 or (mission.law == COLA2 and pilot.memory[slot.KEEPS] == 0.0):
        wrench[1] = 0.0


@kernel
def _enter(pilot: PilotState, phase: int) -> None:
    pilot.report[slot.PHASE] = phase
    pilot.memory[slot.SETTLED_S] = 0.0
    restart_watch(pilot)


@kernel
def _abort(reason: int, estimate: Array, pilot: PilotState) -> None:
    pilot.report[slot.REASON] = reason
    pilot.report[slot.TARGET_HEADING] = estimate[vector.HEADING]
    _enter(pilot, slot.ABORT)


@kernel
def _target_m(path: Path, guidance: Guidance, pilot: PilotState) -> float:
    """Requested depth of the origin: as deep as allowed without bottom lock until there is one.

    The smoothed sum of depth and altitude holds by how much the followed point is below the origin.
    Never deeper than planned: over a known sea floor a plan climbs ahead of what is higher.
    """
    at_m, planned_m = path.profile_at_m, math.inf
    begins_m = path.begins_m[int(pilot.report[slot.LEG])] + pilot.report[slot.ALONG]
    for place in (begins_m, begins_m + _AHEAD_M):
        if at_m.shape[0] > 1:
            low, share = bracket(at_m, place)
            step_m = path.profile_m[low + 1] - path.profile_m[low]
            planned_m = min(planned_m, path.profile_m[low] + share * step_m)
    if pilot.memory[slot.FLOOR_KNOWN] == 0.0:
        limits = guidance.limits
        return float(min(limits.blind_depth_m, limits.max_depth_m - _CAUTION_M, planned_m))
    return float(min(pilot.memory[slot.FLOOR] - path.altitude_m, planned_m))


@kernel
def _minded_m(tick: Tick) -> float:
    """Requested depth of the origin, clear of the sea floor; the pace is slowed where one can."""
    _dt_s, estimate, path, guidance, _gains, pilot = tick
    target = mind_floor(_target_m(path, guidance, pilot), estimate, guidance.limits, pilot)
    if guidance.under_way.circle_m > 0.0:
        pilot.memory[slot.PACE] = 1.0
    return float(target)


@kernel
def _goal(path: Path, guidance: Guidance, pilot: PilotState) -> tuple[float, float, float]:
    """North, east and heading at the start of the approach to the path."""
    leg, along = int(pilot.report[slot.LEG]), pilot.report[slot.ALONG]
    if path.stands[leg] > 0.0:
        # Here the vehicle goes to the place itself, with the heading it has there.
        turned = math.copysign(pilot.memory[slot.REF], path.turn_rad[leg])
        n, e, heading, _ = place_at(path, leg, along)
        return n, e, heading + (turned if path.turn_rad[leg] != 0.0 else path.side_rad[leg])
    n, e, heading, _ = place_at(path, leg, along)
    back = guidance.way_in_m
    return n - back * math.cos(heading), e - back * math.sin(heading), heading


@kernel
def _on_the_way(tick: Tick) -> None:
    """Dive or approach for a tick."""
    dt_s, estimate, path, guidance, gains, pilot = tick
    memory, report, point = pilot.memory, pilot.report, pilot.point
    phase = report[slot.PHASE]
    target = _minded_m(tick)
    sink_to(target, memory[slot.FLOOR_SLOPE], tick)
    n, e, heading = _goal(path, guidance, pilot)
    # Go to the goal and stay there, with its heading if the vehicle can sway. One without faces it
    # and waits until the current has carried it off again. One that cannot hover circles, and comes
    # through the place with the heading.
    now, dn, de = estimate[vector.HEADING], n - point[slot.POINT_NORTH], e - point[slot.POINT_EAST]
    distance, hover = math.hypot(dn, de), False
    if guidance.under_way.circle_m > 0.0:
        course, bend = circle_course(
            n, e, heading, guidance.look_ahead_m, guidance.under_way, point
        )
        head_for(course, bend * path.speed_mps, 0.0, tick)
        surge_at(path.speed_mps, tick)
        error = wrap_angle(heading - now)
    else:
        ahead = math.cos(now) * dn + math.sin(now) * de
        speed = clamp(_HOVER_SHARE * gains.axes[g.SURGE, g.BANDWIDTH] * ahead, path.speed_mps)
        hover = guidance.sway > 0.0 and distance < _HOVER_M
        facing = heading
        if not hover and distance > guidance.capture_m:
            facing = math.atan2(de, dn)
        elif not hover and math.isfinite(report[slot.TARGET_HEADING]):
            facing = report[slot.TARGET_HEADING]
        error = head_for(facing, 0.0, 0.0, tick)
        if not hover and distance > guidance.capture_m:
            speed = path.speed_mps * max(math.cos(error), 0.0)
        surge_at(speed, tick)
    if hover:
        sway_by(-(math.cos(now) * de - math.sin(now) * dn), 0.0, tick)
    report[slot.BY_SWAY] = 1.0 if hover else 0.0
    dn, de = -dn, -de
    report[slot.CROSS] = de * math.cos(heading) - dn * math.sin(heading)
    report[slot.PATH_HEADING], report[slot.LINE] = heading, -1.0

    swings = False
    if phase == slot.DIVE:
        settled = (
            memory[slot.FLOOR_KNOWN] > 0.0
            and abs(target - estimate[vector.DEPTH]) < DEPTH_KEPT_M
            and abs(point[slot.SINK_SPEED]) < _DEPTH_SPEED_KEPT_MPS
        )
    else:
        hovers = guidance.under_way.circle_m == 0.0
        heads = (hovers and guidance.sway == 0.0) or abs(error) < HEADING_KEPT_RAD
        settled = distance < guidance.capture_m and heads
        # In swell the followed point never stays at its goal, but swings about it.
        share = dt_s / _MEAN_S
        memory[slot.MEAN_N] += share * (dn - memory[slot.MEAN_N])
        memory[slot.MEAN_E] += share * (de - memory[slot.MEAN_E])
        near = math.hypot(memory[slot.MEAN_N], memory[slot.MEAN_E]) < guidance.capture_m
        memory[slot.NEAR_S] = memory[slot.NEAR_S] + dt_s if near else 0.0
        swings = (
            heads
            and memory[slot.NEAR_S] > _MEAN_S
            and math.hypot(dn, de) < _SWING * guidance.capture_m
        )
    memory[slot.SETTLED_S] = memory[slot.SETTLED_S] + dt_s if settled else 0.0
    if phase == slot.DIVE and memory[slot.SETTLED_S] > _SETTLE_S:
        _enter(pilot, slot.APPROACH)
    elif phase == slot.APPROACH and (
        swings or memory[slot.SETTLED_S] > (_SETTLE_S if guidance.sway > 0.0 else 0.0)
    ):
        memory[slot.STANDING] = 0.0
        if path.stands[int(report[slot.LEG])] == 0.0:
            report[slot.ALONG] -= guidance.way_in_m
        _enter(pilot, slot.FOLLOW)


@kernel
def _on_path(tick: Tick) -> None:
    """Follow the path for a tick."""
    dt_s, estimate, path, guidance, gains, pilot = tick
    memory, report, point = pilot.memory, pilot.report, pilot.point
    leg, along, over = int(report[slot.LEG]), report[slot.ALONG], False
    if memory[slot.STANDING] == 0.0 and path.stands[leg] > 0.0:
        start_standing(memory[slot.REF], 0.0, pilot)
    elif memory[slot.STANDING] == 0.0:
        leg, along, over = advance(
            path,
            leg,
            along,
            point[slot.POINT_NORTH],
            point[slot.POINT_EAST],
            _QUICKEST * path.speed_mps * dt_s,
        )
        speed, lag_s = max(point[slot.SURGE_SPEED], 0.0), gains.axes[g.SURGE, g.LAG]
        braking = speed * speed / (2.0 * guidance.stop_mps2) + speed * lag_s
        if path.stop[leg] > 0.0 and path.length_m[leg] - along <= braking:
            # The reference starts where the vehicle is, as fast as it is. The integral of the speed
            # loop holds the share of the speed that its proportional part does not see (gains.py),
            # and what the current takes; only this is passed on to the place's.
            held = memory[slot.SURGE_SUM] - (1.0 - gains.axes[g.SURGE, g.WEIGHT]) * speed
            memory[slot.PLACE_SUM_N] = held * math.cos(estimate[vector.HEADING])
            memory[slot.PLACE_SUM_E] = held * math.sin(estimate[vector.HEADING])
            start_standing(along, speed, pilot)
            memory[slot.RAMP] += lag_s * speed
    target = _minded_m(tick)
    sink_to(target, memory[slot.FLOOR_SLOPE], tick)
    off, waits = abs(estimate[vector.DEPTH] - target), False
    if path.profile_m.shape[0] > 0 and guidance.under_way.circle_m == 0.0:
        memory[slot.PACE] *= min(max(2.0 - off / _OFF_M, 0.0), 1.0)
        waits = off > DEPTH_KEPT_M
    if memory[slot.STANDING] == 0.0:
        follow(leg, along, tick)
    elif stand(leg, tick) and not waits:
        over = leg + 1 == path.length_m.shape[0]
        if not over:
            report[slot.LEG], report[slot.ALONG] = leg + 1, 0.0
            start_standing(0.0, 0.0, pilot)
            if path.stands[leg + 1] == 0.0:
                memory[slot.STANDING], heading = 0.0, estimate[vector.HEADING]
                memory[slot.SURGE_SUM] = memory[slot.PLACE_SUM_N] * math.cos(heading) + memory[
                    slot.PLACE_SUM_E
                ] * math.sin(heading)
            restart_watch(pilot)
    if over:
        _enter(pilot, slot.ASCEND)
    elif abs(report[slot.CROSS]) > guidance.lost_m:
        memory[slot.RETURNS] += 1.0
        if memory[slot.RETURNS] > guidance.limits.max_returns:
            _abort(LOST_PATH, estimate, pilot)
            return
        # Back to where the path was left; of an arc, to its start, since the way in is straight.
        if path.curvature_per_m[leg] != 0.0:
            report[slot.ALONG] = 0.0
        _enter(pilot, slot.APPROACH)
