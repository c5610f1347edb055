"""Slow, obvious twins of the guidance and control kernels."""

import math

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.dynamics import coriolis_matrix
from alice_survey.sim.vehicle.pilot import gains as g
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot.gains import Gains
from alice_survey.sim.vehicle.pilot.path import Path
from alice_survey.sim.vehicle.pilot.settings import Guidance
from tests.alice_survey.sim.vehicle.motions import damping_matrix


def walked(path: Path, leg: int, along_m: float, steps: int = 20000) -> tuple[Array, float]:
    """Place and heading on a leg by walking along it in small steps; straight beyond its ends."""
    on = min(max(along_m, 0.0), path.length_m[leg])
    middles = (np.arange(steps) + 0.5) * on / steps
    headings = path.heading_rad[leg] + path.curvature_per_m[leg] * middles
    place = np.array([path.start_n[leg], path.start_e[leg]])
    place = place + on / steps * np.array([np.cos(headings).sum(), np.sin(headings).sum()])
    heading = path.heading_rad[leg] + path.curvature_per_m[leg] * on
    return place + (along_m - on) * np.array([math.cos(heading), math.sin(heading)]), heading


def nearest(path: Path, leg: int, place: Array, count: int = 20001) -> float:
    """Distance along a leg of its point nearest to a place, by trying many."""
    along = np.linspace(0.0, path.length_m[leg], count)
    heading = path.heading_rad[leg] + path.curvature_per_m[leg] * along / 2
    chord = along * np.sinc(path.curvature_per_m[leg] * along / (2 * math.pi))
    n = path.start_n[leg] + chord * np.cos(heading) - place[0]
    e = path.start_e[leg] + chord * np.sin(heading) - place[1]
    return float(along[np.argmin(n**2 + e**2)])


def point_motion(estimate: Array, guidance: Guidance) -> tuple[Array, Array, float]:
    """Place in NED, level velocity (ahead, to starboard) and turn rate of the followed point.

    The velocity leaves out what roll and pitch rates add.
    """
    roll, pitch, heading = estimate[vector.ROLL : vector.HEADING + 1]
    ned_from_body = Rotation.from_euler("ZYX", [heading, pitch, roll])
    place = estimate[:3] + ned_from_body.apply(guidance.point_body_m)
    level_from_body = Rotation.from_euler("ZYX", [0.0, pitch, roll])
    q, r = estimate[vector.Q], estimate[vector.R]
    turn = (math.sin(roll) * q + math.cos(roll) * r) / math.cos(pitch)
    lever = level_from_body.apply(guidance.point_body_m)
    velocity = level_from_body.apply(estimate[vector.U : vector.W + 1])
    velocity = velocity + np.cross([0.0, 0.0, turn], lever)
    return place, velocity[:2], turn


def wrench(gains: Gains, demand: Array) -> Array:
    """The wrench that a demand stands for, by matrices."""
    body = gains.body
    nu, rate = np.zeros(6), np.zeros(6)
    nu[list(g.DEGREES)] = demand[slot.REF_SURGE : slot.REF_SURGE + 4]
    rate[list(g.DEGREES)] = demand[slot.ACC_SURGE : slot.ACC_SURGE + 4]
    force = body.mass @ rate + coriolis_matrix(body.mass, nu) @ nu + damping_matrix(body, nu) @ nu
    force[2] -= body.weight_n - body.buoyancy_n
    result = np.zeros(6)
    for axis, degree in enumerate(g.DEGREES):
        result[degree] = np.clip(force[degree], *gains.axes[axis, [g.MIN_FORCE, g.MAX_FORCE]])
    return result


def follow_demand(
    estimate: Array, path: Path, guidance: Guidance, gains: Gains, along_m: float
) -> tuple[Array, float]:
    """Accelerations of surge, sway and yaw that a pilot without memory asks for on the first leg.

    For a straight first leg, at a distance along it further than the smoothing from its end.

    Returns:
        (3,) and the cross-track error.
    """
    place, (surge, sway), turn = point_motion(estimate, guidance)
    start, beta = np.array([path.start_n[0], path.start_e[0]]), path.heading_rad[0]
    tangent = np.array([math.cos(beta), math.sin(beta)])
    normal = np.array([-math.sin(beta), math.cos(beta)])
    cross = float((place[:2] - start) @ normal)
    heading = estimate[vector.HEADING]
    course = heading - beta
    sway_row, yaw_row, surge_row = gains.axes[g.SWAY], gains.axes[g.YAW], gains.axes[g.SURGE]
    by_sway = guidance.sway > 0 and abs(cross) < guidance.near_m
    if by_sway:
        wanted, feed = beta, 0.0
    else:
        aim = start + (along_m + guidance.look_ahead_m) * tangent
        wanted = math.atan2(*(aim - place[:2])[::-1])
        drift = surge * math.sin(course) + sway * math.cos(course)
        feed = -drift * guidance.look_ahead_m / (guidance.look_ahead_m**2 + cross**2)
    error = math.remainder(wanted - heading, 2 * math.pi)
    push = np.clip(yaw_row[g.PLACE] / yaw_row[g.INNER] * error, *yaw_row[g.FASTEST] * PLUS_MINUS)
    yaw = yaw_row[g.RATE] * (feed + push - turn)
    if by_sway:
        speed = path.speed_mps * max(math.cos(course), 0.0)
        inner = sway_row[g.INNER]
        k_p, k_d = sway_row[g.PLACE] / inner, sway_row[g.RATE] / inner - 1.0
        error_v = cross * math.cos(course)  # paper, eq. los_sway_e
        along_path = -path.speed_mps * math.sin(course)
        required = along_path - np.clip(k_p * error_v, *sway_row[g.FASTEST] * PLUS_MINUS)
        required -= k_d * (sway - along_path)
        sideways = inner * (required - sway) - guidance.point_body_m[0] * yaw
    else:
        speed = path.speed_mps * max(math.cos(error), 0.0)
        sideways = 0.0
        if guidance.sway > 0:
            sideways = -sway_row[g.RATE] * sway - guidance.point_body_m[0] * yaw
    ahead = surge_row[g.RATE] * (surge_row[g.WEIGHT] * speed - surge)
    ahead += surge_row[g.PLACE] * TICK_S * (speed - surge)  # learnt in this tick
    return np.array([ahead, sideways, yaw]), cross


def trapezoid(goal: float, maximum: float, acceleration: float, time_s: float) -> float:
    """Place of a thing that goes from rest to rest as fast as it may, in closed form."""
    top = min(maximum, math.sqrt(goal * acceleration))
    gaining_s = top / acceleration
    total_s = goal / top + gaining_s
    if time_s < gaining_s:
        return acceleration * time_s**2 / 2
    if time_s < total_s - gaining_s:
        return top * (time_s - gaining_s / 2)
    return goal - acceleration * max(total_s - time_s, 0.0) ** 2 / 2


def standing_demand(
    estimate: Array,
    guidance: Guidance,
    gains: Gains,
    speed_mps: float,
    place: Array,
    velocity: Array,
    acceleration: Array,
    turning: Array,
) -> Array:
    """Accelerations of surge, sway and yaw that follow a moving place and a turning heading.

    Args:
        estimate: (14,) of the navigation.
        guidance: settings, with sway.
        gains: of the inner loops.
        speed_mps: of the path.
        place: (2,) wanted of the followed point, north and east.
        velocity: (2,) of the place.
        acceleration: (2,) of the place.
        turning: (3,) wanted heading, its rate, and the rate of that.

    Returns:
        (3,)
    """
    point, (surge, sway), turn = point_motion(estimate, guidance)
    heading = estimate[vector.HEADING]
    hull = Rotation.from_euler("z", -heading).as_matrix()[:2, :2]
    off, feed, quicken = hull @ (place - point[:2]), hull @ velocity, hull @ acceleration
    angle = math.remainder(turning[0] - heading, 2 * math.pi)

    def pid(axis: int, error: float, rate: float, wanted: float, maximum: float) -> float:
        row = gains.axes[axis]
        inner = row[g.INNER]
        asked = wanted + np.clip(row[g.PLACE] / inner * error, -maximum, maximum)
        asked += (row[g.RATE] / inner - 1.0) * (wanted - rate)
        return float(inner * (asked - rate))

    yaw = turning[2] + pid(g.YAW, angle, turn, turning[1], gains.axes[g.YAW, g.FASTEST])
    ahead = quicken[0] + pid(g.SURGE, off[0], surge, feed[0], speed_mps)
    aside = quicken[1] + pid(g.SWAY, off[1], sway, feed[1], gains.axes[g.SWAY, g.FASTEST])
    lever = guidance.point_body_m
    return np.array([ahead + lever[1] * yaw, aside - lever[0] * yaw, yaw])


TICK_S = 0.05
PLUS_MINUS = np.array([-1.0, 1.0])


def smoothed_floor(heard_m: Array, rate_rad_s: float, dt_s: float) -> Array:
    """Depths that a critically damped second-order tracker follows, by its transfer function.

    (2 w s + w^2) / (s + w)^2, from rest at the first value, integrated on a ten times finer grid.
    """
    from scipy.signal import lsim

    fine = 10
    steps = (len(heard_m) - 1) * fine + 1
    time_s = np.arange(steps) * dt_s / fine
    held = np.repeat(heard_m, fine)[:steps] - heard_m[0]
    system = ([2 * rate_rad_s, rate_rad_s**2], [1.0, 2 * rate_rad_s, rate_rad_s**2])
    return lsim(system, held, time_s)[1][::fine] + heard_m[0]


def los_offset_m(
    look_ahead_m: float, speed_mps: float, across_mps: float, along_mps: float = 0.0
) -> float:
    """Where `los` settles next to a straight path in a steady current, metres to starboard.

    Steady means no turning and no drag across the hull, since nothing would balance it: the sway
    relative to the water is zero. With t the tangent of the angle from path to heading, the offset
    is -look_ahead t. The current's part across the hull must be the sway over ground: with surge
    over ground kept at U the speed along the path is U / cos and the sway over ground -U t, whence
    U t sqrt(1 + t^2) = along t - across.

    Args:
        look_ahead_m: of the guidance.
        speed_mps: U, the surge that is kept.
        across_mps: current to starboard of the path.
        along_mps: current along the path, below U.
    """

    def surplus(t: float) -> float:
        return speed_mps * t * math.sqrt(1.0 + t * t) - along_mps * t + across_mps

    reach = 1.0 + abs(across_mps) / (speed_mps - max(along_mps, 0.0))
    return -look_ahead_m * float(brentq(surplus, -reach, reach, xtol=1e-14))
