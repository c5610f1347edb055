"""The navigation's tick: measure, predict, weigh, and report to the controller and the log.

The closed loop calls the tick. Instruments measure the true state at that time, which the filter
sees in no other way.

The truth is a vector (13,): position NED, quaternion ned_from_body xyzw, velocity of the body's
origin over ground in NED, body rates. Kernels named `measure_...` write the readings of it into
`NavigationState.readings`.
"""

import math

import numpy as np

from alice_survey.core.compiled import kernel
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.navigation import filter as slot
from alice_survey.sim.vehicle.navigation import sensors as part
from alice_survey.sim.vehicle.navigation.filter import (
    NavigationState,
    correct,
    correlated_states,
    lever_row,
    predict,
    use_beams,
    use_depth,
    use_fix,
    use_heading,
)
from alice_survey.sim.vehicle.navigation.sensors import Sensors
from alice_survey.sim.vehicle.rotations import (
    matrix_of,
    rotate,
    rotate_back,
    turn_between,
    wrap_angle,
)
from alice_survey.sim.vehicle.sea import GRAVITY, FloorGrid, floor_range

LOG_COLUMNS = (
    "north_m", "east_m", "depth_m", "roll_rad", "pitch_rad", "heading_rad",
    "u_mps", "v_mps", "w_mps", "p_radps", "q_radps", "r_radps", "altitude_m",
    "sigma_north_m", "sigma_east_m", "sigma_depth_m",
    "sigma_roll_rad", "sigma_pitch_rad", "sigma_heading_rad", "sigma_altitude_m",
    "range_1_m", "range_2_m", "range_3_m", "range_4_m",
    "used_compass", "used_depth", "used_dvl", "used_water", "used_gps", "used_usbl",
    "rejected_compass", "rejected_depth", "rejected_dvl", "rejected_water", "rejected_gps",
    "rejected_usbl", "clearance_m",
)  # fmt: skip
"""Columns of `log_row`: the estimate in the order of `estimate_vector`, sigmas, the latest ping's
ranges, how many measurements of each instrument were used and rejected so far, the clearance."""
LOG_ROW = len(LOG_COLUMNS)
LOG_SIGMA, LOG_RANGE, LOG_USED, LOG_REJECTED, LOG_CLEARANCE = 13, 20, 24, 30, 36
"""Offsets of sigmas, ranges, counts and clearance in a row."""
_MIN_SPREAD = 0.01
"""Least determinant of the scatter of the ends over its squared trace: 1/4 for a square, 0.19 for
three corners."""
_RELIEF_MEMORY_S = 10.0
"""Time over which the beams' spread is averaged; their own footprint at survey speed."""
_MAX_RELIEF_M = 0.35
"""How far the sea floor may lie above the highest end of a beam, and the sigma of it: what strays
more is a wall, whose top an end meets."""


@kernel
def navigation_tick(
    time_s: float,
    tick: int,
    dt_s: float,
    before: Array,
    now: Array,
    water_velocity_ned: Array,
    floor: FloorGrid,
    suite: Sensors,
    nav: NavigationState,
    rng: np.random.Generator,
    estimate: Array,
) -> None:
    """Advance the navigation from the previous tick to now.

    Args:
        time_s: now, for drop-outs and ages.
        tick: counted from 0, when nothing is predicted and `before` is not looked at.
        dt_s: since the tick before, and at tick 0 the time to the next.
        before: (13,) truth then: position NED, quaternion ned_from_body, velocity of the body's
            origin over ground in NED, body rates.
        now: (13,) truth now.
        water_velocity_ned: north and east of the current now come first; the rest is not read.
        floor: the sea floor that the DVL measures.
        suite: the instruments.
        nav: filter and instruments, overwritten.
        rng: source of noise.
        estimate: (14,) is written as `estimate_vector` has it; altitude and clearance are NaN
            without bottom lock.
    """
    for i in range(nav.innovations.shape[0]):
        nav.innovations[i] = math.nan
    truth = nav.turns[slot.TRUTH_NOW]
    matrix_of(now[3:7], truth)
    if tick > 0:
        measure_imu(dt_s, before, now, suite, nav, rng)
        predict(dt_s, suite, nav)
        # The instruments' biases drift: random walks and Gauss-Markov processes.
        hidden, root, imu = nav.hidden, math.sqrt(dt_s), suite.imu
        for i in range(3):
            hidden[i] += imu.gyro_bias_walk_radps_per_sqrt_s * root * rng.standard_normal()
        for i in range(
            slot.ACCELEROMETER_BIAS - slot.GYRO_BIAS, slot.ACCELEROMETER_BIAS - slot.GYRO_BIAS + 3
        ):
            hidden[i] += imu.accelerometer_bias_walk_mps2_per_sqrt_s * root * rng.standard_normal()
        for i, correlation_s, sigma in correlated_states(suite)[:-2]:  # water is no instrument
            kept = math.exp(-dt_s / correlation_s)
            draw = sigma * math.sqrt(1.0 - kept * kept) * rng.standard_normal()
            hidden[i - slot.GYRO_BIAS] = kept * hidden[i - slot.GYRO_BIAS] + draw
    else:  # the first tick has no increment, but rates
        noise = suite.imu.gyro_noise_rad_per_sqrt_s / math.sqrt(dt_s)
        for i in range(3):
            nav.readings[slot.RATES + i] = (
                now[10 + i] + nav.hidden[i] + noise * rng.standard_normal()
            )
        matrix_of(nav.nominal[slot.QUATERNION : slot.QUATERNION + 4], nav.turns[slot.BELIEVED])
    pinged, used = False, False
    bottom = 0
    if suite.compass_every > 0 and tick % suite.compass_every == 0:
        nav.readings[slot.HEADING] = (
            math.atan2(truth[1, 0], truth[0, 0])
            + nav.hidden[slot.HEADING_BIAS - slot.GYRO_BIAS]
            + suite.compass.noise_rad * rng.standard_normal()
        )
        used |= use_heading(nav, suite)
    if suite.pressure_every > 0 and tick % suite.pressure_every == 0:
        place = suite.place[part.PRESSURE]
        nav.readings[slot.DEPTH] = (
            now[2]
            + rotate(truth, place[0], place[1], place[2])[2]
            + nav.hidden[slot.DEPTH_BIAS - slot.GYRO_BIAS]
            + suite.pressure.noise_m * rng.standard_normal()
        )
        used |= use_depth(nav, suite)
    due = suite.gps_every > 0 and tick % suite.gps_every == 0
    if due and now[2] <= suite.gps.max_depth_m:  # the antenna is out of the water
        place = suite.place[part.GPS]
        arm = rotate(truth, place[0], place[1], place[2])
        for i in range(2):
            drawn = suite.gps.noise_m * rng.standard_normal()
            bias = nav.hidden[slot.GPS_BIAS - slot.GYRO_BIAS + i]
            nav.readings[slot.GPS_FIX + i] = now[i] + arm[i] + bias + drawn
        used |= use_fix(nav, suite, slot.GPS_USE, suite.gps.noise_m * suite.gps.noise_m)
    due = suite.usbl_every > 0 and tick % suite.usbl_every == 0
    if due:
        used |= _use_usbl(now, suite, nav, rng)
    if suite.dvl_every > 0 and tick % suite.dvl_every == 0:
        pinged = True
        ping = tick // suite.dvl_every
        measure_dvl(time_s, ping, now, water_velocity_ned, floor, suite, nav, rng)
        bottom = use_beams(nav, suite, slot.OVER_GROUND)
        used |= bottom != 0
        used |= use_beams(nav, suite, slot.THROUGH_WATER) != 0
    if used:
        correct(nav)
    if pinged and bottom != 0:
        _hear_floor(time_s, bottom, nav, suite)
    _write_estimate(time_s, nav, suite, estimate)


@kernel
def _followed_depth(nav: NavigationState, suite: Sensors) -> float:
    """Believed depth of the followed point, metres."""
    turned, total = nav.turns[slot.BELIEVED], nav.nominal[2]
    for i in range(3):
        total += turned[2, i] * (suite.place[part.FOLLOWED, i] - suite.place[part.IMU, i])
    return float(total)


@kernel
def _hear_floor(time_s: float, used: int, nav: NavigationState, suite: Sensors) -> None:
    """Altitude of the followed point and clearance of the hull from a ping: a plane by the beams.

    The beams meet the sea floor about the DVL; the followed point is elsewhere. A plane is fitted
    (least squares) to their ends by the estimated attitude, and read below the point. How far
    relief departs from a plane is not seen by one ping, whose four ends leave a single degree of
    freedom: the ends' deviation from their mean slope of the last seconds shows it.
    A beam whose velocity was an outlier did not measure the sea floor. Fewer than three
    beams, or three with ends nearly in line, give no plane.
    """
    turned, memory, place = nav.turns[slot.BELIEVED], nav.memory, suite.place
    count = 0
    noise = sn = se = sd = snn = sne = see = snd = sed = sdd = 0.0
    highest = math.inf
    for i in range(part.BEAMS):
        if used >> i & 1 == 0:
            continue
        reach = nav.readings[slot.RANGE + i]
        a = reach * suite.beams[i, 0] + place[part.DVL, 0] - place[part.FOLLOWED, 0]
        b = reach * suite.beams[i, 1] + place[part.DVL, 1] - place[part.FOLLOWED, 1]
        c = reach * suite.beams[i, 2] + place[part.DVL, 2] - place[part.FOLLOWED, 2]
        # Where the beam ends, from the followed point.
        n, e, d = rotate(turned, a, b, c)
        count += 1
        sn, se, sd = sn + n, se + e, sd + d
        snn, sne, see = snn + n * n, sne + n * e, see + e * e
        snd, sed, sdd = snd + n * d, sed + e * d, sdd + d * d
        highest = min(highest, d)
        down = turned[2, 0] * suite.beams[i, 0] + turned[2, 1] * suite.beams[i, 1]
        down += turned[2, 2] * suite.beams[i, 2]
        growth = suite.dvl.range_noise_fraction * reach
        noise += (suite.dvl.range_noise_m * suite.dvl.range_noise_m + growth * growth) * down * down
    if count < 3:
        return
    noise /= count
    n, e, d = sn / count, se / count, sd / count
    cnn, cne, cee = snn - n * sn, sne - n * se, see - e * se
    cnd, ced, cdd = snd - n * sd, sed - e * sd, sdd - d * sd
    determinant = cnn * cee - cne * cne
    if determinant < _MIN_SPREAD * (cnn + cee) * (cnn + cee):
        return
    north, east = (cee * cnd - cne * ced) / determinant, (cnn * ced - cne * cnd) / determinant
    altitude = d - north * n - east * e
    # Of the plane's depth below the point, by that of a beam's end.
    leverage = 1.0 / count + (cee * n * n - 2.0 * cne * n * e + cnn * e * e) / determinant

    share = suite.dvl_every * suite.tick_s / _RELIEF_MEMORY_S
    share = max(1.0 / (memory[slot.RELIEF_PINGS] + 1.0), share)
    freedom = count - 3.0 + 2.0 * (1.0 - share) * (1.0 - share)
    if freedom > 0.0:
        memory[slot.RELIEF_PINGS] += 1.0
        memory[slot.MEAN_SLOPE_NORTH] += share * (north - memory[slot.MEAN_SLOPE_NORTH])
        memory[slot.MEAN_SLOPE_EAST] += share * (east - memory[slot.MEAN_SLOPE_EAST])
        gn, ge = memory[slot.MEAN_SLOPE_NORTH], memory[slot.MEAN_SLOPE_EAST]
        square = cdd - 2.0 * (gn * cnd + ge * ced)
        square += gn * gn * cnn + 2.0 * gn * ge * cne + ge * ge * cee
        memory[slot.RELIEF_VARIANCE] += share * (square / freedom - memory[slot.RELIEF_VARIANCE])
    relief = memory[slot.RELIEF_VARIANCE]
    # The spread holds the ranges' noise, of which the plane keeps a part only.
    spread = max((1.0 + leverage) * relief - noise, leverage * noise)
    # A tilt turns the ends about the point: over a level floor that moves them sideways only.
    tilt = _variance(nav, slot.ATTITUDE, altitude * east, -altitude * north, 0.0)
    memory[slot.ALTITUDE_PING], memory[slot.ALTITUDE_VARIANCE] = altitude, spread + tilt
    memory[slot.SLOPE_NORTH], memory[slot.SLOPE_EAST] = north, east
    memory[slot.SLOPE_VARIANCE] = max(relief, noise) * (cnn + cee) / determinant
    memory[slot.MOVED_NORTH] = memory[slot.MOVED_EAST] = 0.0
    memory[slot.ALTITUDE_TIME] = time_s
    memory[slot.FOLLOWED_DEPTH] = _followed_depth(nav, suite)

    clearance, lowest = altitude, 0.0
    low, port = suite.low, place[part.FOLLOWED]
    for i in range(low.shape[0]):
        a, b, c = low[i, 0] - port[0], low[i, 1] - port[1], low[i, 2] - port[2]
        n, e, d = rotate(turned, a, b, c)
        clearance = min(clearance, altitude + north * n + east * e - d)
        lowest = max(lowest, d)
    ends = highest - lowest
    clearance = min(ends, max(clearance, ends - _MAX_RELIEF_M))
    memory[slot.CLEARANCE_PING] = clearance - math.sqrt(min(spread, _MAX_RELIEF_M**2) + tilt)


@kernel
def _variance(nav: NavigationState, t: int, a: float, b: float, c: float) -> float:
    """Variance of g . e for g = (a, b, c) and the three errors e that begin at t."""
    p = nav.covariance
    return float(
        a * a * p[t, t]
        + b * b * p[t + 1, t + 1]
        + c * c * p[t + 2, t + 2]
        + 2.0 * (a * b * p[t, t + 1] + a * c * p[t, t + 2] + b * c * p[t + 1, t + 2])
    )


@kernel
def _write_estimate(time_s: float, nav: NavigationState, suite: Sensors, estimate: Array) -> None:
    """Write the estimate of the body's origin, and altitude and clearance by the last ping's plane.

    The depth gained since the ping and the rise of the plane below the way gone since are taken
    off. Both are NaN when the ping is too long ago.
    """
    memory, x, turned = nav.memory, nav.nominal, nav.turns[slot.BELIEVED]
    a, b, c = suite.place[part.IMU, 0], suite.place[part.IMU, 1], suite.place[part.IMU, 2]
    for i in range(3):
        estimate[i] = x[i] - turned[i, 0] * a - turned[i, 1] * b - turned[i, 2] * c
        estimate[vector.P + i] = nav.readings[slot.RATES + i] - x[slot.GYRO_BIAS + 1 + i]
    p, q, r = estimate[vector.P], estimate[vector.P + 1], estimate[vector.P + 2]
    estimate[vector.U] = x[slot.VELOCITY] - q * c + r * b
    estimate[vector.U + 1] = x[slot.VELOCITY + 1] - r * a + p * c
    estimate[vector.U + 2] = x[slot.VELOCITY + 2] - p * b + q * a
    estimate[3] = math.atan2(turned[2, 1], turned[2, 2])
    estimate[4] = -math.asin(min(max(turned[2, 0], -1.0), 1.0))
    heading = math.atan2(turned[1, 0], turned[0, 0])
    memory[slot.HEADING_TURNS] += wrap_angle(heading - memory[slot.HEADING_TURNS])
    estimate[vector.HEADING] = memory[slot.HEADING_TURNS]
    age = time_s - memory[slot.ALTITUDE_TIME]
    # Not a number before the first ping: then this is false too.
    if age <= suite.altitude_age_s + 1e-9:
        if age > 0.0:
            # Summed speeds, not places: a fix would move the vehicle along the slope.
            u, v, w = x[slot.VELOCITY], x[slot.VELOCITY + 1], x[slot.VELOCITY + 2]
            step = suite.tick_s
            memory[slot.MOVED_NORTH] += step * (
                turned[0, 0] * u + turned[0, 1] * v + turned[0, 2] * w
            )
            memory[slot.MOVED_EAST] += step * (
                turned[1, 0] * u + turned[1, 1] * v + turned[1, 2] * w
            )
        n, e = memory[slot.MOVED_NORTH], memory[slot.MOVED_EAST]
        gained = _followed_depth(nav, suite) - memory[slot.FOLLOWED_DEPTH]
        sinks = memory[slot.SLOPE_NORTH] * n + memory[slot.SLOPE_EAST] * e
        drifted = (
            age * age * _variance(nav, slot.VELOCITY, turned[2, 0], turned[2, 1], turned[2, 2])
        )
        drifted += memory[slot.SLOPE_VARIANCE] * (n * n + e * e)
        memory[slot.ALTITUDE_NOW] = memory[slot.ALTITUDE_PING] - gained + sinks
        memory[slot.ALTITUDE_SIGMA] = math.sqrt(memory[slot.ALTITUDE_VARIANCE] + drifted)
        clearance = memory[slot.CLEARANCE_PING] - gained + min(sinks, 0.0)
        memory[slot.CLEARANCE_NOW] = clearance - math.sqrt(drifted)
    else:
        memory[slot.ALTITUDE_NOW] = memory[slot.ALTITUDE_SIGMA] = memory[slot.CLEARANCE_NOW] = (
            math.nan
        )
    estimate[vector.ALTITUDE] = memory[slot.ALTITUDE_NOW]
    estimate[vector.CLEARANCE] = memory[slot.CLEARANCE_NOW]
    for i in range(vector.ESTIMATE):
        memory[slot.LATEST + i] = estimate[i]


@kernel
def log_row(nav: NavigationState, out: Array) -> None:
    """Write a row of the log, (LOG_ROW,), as `LOG_COLUMNS` names it, of the latest tick.

    Sigmas are of the body's origin, whose position error includes attitude, and of Euler angles.
    """
    p, turned = nav.covariance, nav.turns[slot.BELIEVED]
    latest = nav.memory[slot.LATEST : slot.LATEST + vector.ESTIMATE]
    for i in range(LOG_SIGMA):
        out[i] = latest[i]
    out[LOG_CLEARANCE] = latest[vector.CLEARANCE]
    a, b, c = (
        nav.memory[slot.IMU_PLACE],
        nav.memory[slot.IMU_PLACE + 1],
        nav.memory[slot.IMU_PLACE + 2],
    )
    n, e, d = rotate(turned, a, b, c)
    t = slot.ATTITUDE
    # The origin lies at minus the lever l from the IMU: the error f moves it by -f x l.
    for i, g0, g1, g2 in ((0, 0.0, -d, e), (1, d, 0.0, -n), (2, -e, n, 0.0)):
        both = g0 * p[i, t] + g1 * p[i, t + 1] + g2 * p[i, t + 2]
        variance = p[i, i] + 2.0 * both + _variance(nav, slot.ATTITUDE, g0, g1, g2)
        out[LOG_SIGMA + i] = math.sqrt(max(variance, 0.0))
    # Of the bow (n, e, d): pitch turns about the level axis across it, roll about itself.
    n, e, d = turned[0, 0], turned[1, 0], turned[2, 0]
    level2 = n * n + e * e
    level = math.sqrt(level2)
    out[LOG_SIGMA + 3] = math.sqrt(_variance(nav, slot.ATTITUDE, n / level2, e / level2, 0.0))
    out[LOG_SIGMA + 4] = math.sqrt(_variance(nav, slot.ATTITUDE, -e / level, n / level, 0.0))
    out[LOG_SIGMA + 5] = math.sqrt(
        _variance(nav, slot.ATTITUDE, -d * n / level2, -d * e / level2, 1.0)
    )
    out[LOG_SIGMA + 6] = nav.memory[slot.ALTITUDE_SIGMA]
    for i in range(part.BEAMS):
        out[LOG_RANGE + i] = nav.readings[slot.RANGE + i]
    for i in range(6):
        out[LOG_USED + i] = nav.counts[i, slot.USED]
        out[LOG_REJECTED + i] = nav.counts[i, slot.REJECTED]


@kernel
def measure_imu(
    dt_s: float,
    before: Array,
    now: Array,
    sensors: Sensors,
    nav: NavigationState,
    rng: np.random.Generator,
) -> None:
    """Increments of angle and of velocity over a tick, and the rates at its end.

    Exact between the two truths: the turn is log(R_k^T R_k+1), and the velocity that the specific
    force adds in the frame at the tick's start is R_k^T (v_k+1 - v_k - g dt) at the IMU's place.
    The white noise of the turn is that of the rates too: one gyroscope.
    """
    readings, hidden = nav.readings, nav.hidden
    a, b = nav.turns[slot.TRUTH_BEFORE], nav.turns[slot.TRUTH_NOW]
    matrix_of(before[3:7], a)
    turn_between(before[3:7], now[3:7], readings[slot.TURN : slot.TURN + 3])
    x, y, z = sensors.place[part.IMU, 0], sensors.place[part.IMU, 1], sensors.place[part.IMU, 2]
    p, q, r = before[10], before[11], before[12]
    a0, a1, a2 = q * z - r * y, r * x - p * z, p * y - q * x
    p, q, r = now[10], now[11], now[12]
    b0, b1, b2 = q * z - r * y, r * x - p * z, p * y - q * x
    a0, a1, a2 = rotate(a, a0, a1, a2)
    b0, b1, b2 = rotate(b, b0, b1, b2)
    d0 = now[7] - before[7] + b0 - a0
    d1 = now[8] - before[8] + b1 - a1
    d2 = now[9] - before[9] + b2 - a2 - GRAVITY * dt_s
    d0, d1, d2 = rotate_back(a, d0, d1, d2)
    root = math.sqrt(dt_s)
    for i in range(3):
        noise = sensors.imu.gyro_noise_rad_per_sqrt_s * root * rng.standard_normal()
        readings[slot.TURN + i] += hidden[i] * dt_s + noise
        readings[slot.RATES + i] = now[10 + i] + hidden[i] + noise / dt_s
        readings[slot.PUSH + i] = (
            (d0, d1, d2)[i]
            + hidden[3 + i] * dt_s
            + sensors.imu.accelerometer_noise_mps_per_sqrt_s * root * rng.standard_normal()
        )


@kernel
def _use_usbl(now: Array, sensors: Sensors, nav: NavigationState, rng: np.random.Generator) -> bool:
    """Measure and weigh north and east of the transponder; whether there was an answer of use."""
    place, turn, usbl = sensors.place[part.USBL], nav.turns[slot.TRUTH_NOW], sensors.usbl
    north, east, depth = rotate(turn, place[0], place[1], place[2])
    north, east, depth = now[0] + north, now[1] + east, now[2] + depth
    boat = usbl.boat_ned_m
    reach2 = (north - boat[0]) ** 2 + (east - boat[1]) ** 2 + (depth - boat[2]) ** 2
    # A transponder that breaks the surface is not received.
    if depth <= 0.0 or math.sqrt(reach2) > usbl.max_range_m:
        return False
    slope2, noise2 = usbl.noise_fraction * usbl.noise_fraction, usbl.noise_m * usbl.noise_m
    sigma = math.sqrt(noise2 + slope2 * reach2)
    wrong = rng.random() < usbl.outlier_probability
    for i in range(2):
        value = (north if i == 0 else east) + sigma * rng.standard_normal()
        if wrong:
            value += usbl.outlier_m * (2.0 * rng.random() - 1.0)
        nav.readings[slot.USBL_FIX + i] = value
    # The filter takes the sigma of the distance that is estimated.
    north = lever_row(nav, sensors, part.USBL, slot.NORTH_AXIS)
    east = lever_row(nav, sensors, part.USBL, slot.EAST_AXIS)
    depth = lever_row(nav, sensors, part.USBL, slot.DOWN_AXIS)
    reach2 = (north - boat[0]) ** 2 + (east - boat[1]) ** 2 + (depth - boat[2]) ** 2
    sigma = math.sqrt(noise2 + slope2 * reach2)
    return use_fix(nav, sensors, slot.USBL_USE, sigma * sigma)


@kernel
def measure_dvl(
    time_s: float,
    ping: int,
    now: Array,
    water_ned: Array,
    floor: FloorGrid,
    sensors: Sensors,
    nav: NavigationState,
    rng: np.random.Generator,
) -> None:
    """One ping: ranges and velocities along the beams, and at intervals through the water.

    A velocity along a beam b is b . ((1 + s) Rz(a)^T v + bias), of the velocity v of the instrument
    in the body frame, its scale error s and its misalignment a about the vertical.
    """
    readings, turn, dvl = nav.readings, nav.turns[slot.TRUTH_NOW], sensors.dvl
    for i in range(slot.RANGE, slot.WATER_BEAM + 4):
        readings[i] = math.nan
    for i in range(sensors.dropouts_s.shape[0]):
        if sensors.dropouts_s[i, 0] <= time_s < sensors.dropouts_s[i, 1]:
            return
    if turn[2, 2] < sensors.min_cos_tilt or rng.random() < dvl.ping_loss:
        return
    x, y, z = sensors.place[part.DVL, 0], sensors.place[part.DVL, 1], sensors.place[part.DVL, 2]
    p, q, r = now[10], now[11], now[12]
    spin0, spin1, spin2 = q * z - r * y, r * x - p * z, p * y - q * x
    north, east, depth = rotate(turn, x, y, z)
    north, east, depth = now[0] + north, now[1] + east, now[2] + depth
    u, v, w = rotate_back(turn, now[7], now[8], now[9])
    u, v, w = u + spin0, v + spin1, w + spin2
    speed = math.sqrt(u * u + v * v + w * w)
    sigma = dvl.beam_noise_mps + dvl.beam_noise_per_speed * speed
    heard, clearance, bottom = 0, math.inf, True
    for i in range(sensors.bottom_dropouts_s.shape[0]):
        silent = sensors.bottom_dropouts_s[i]
        bottom &= not (silent[0] <= time_s < silent[1])
    for i in range(part.BEAMS if bottom else 0):
        b0, b1, b2 = sensors.beams[i, 0], sensors.beams[i, 1], sensors.beams[i, 2]
        beam_n, beam_e, down = rotate(turn, b0, b1, b2)
        reach = floor_range(floor, north, east, depth, beam_n, beam_e, down, dvl.max_range_m)
        if not math.isfinite(reach):
            continue
        clearance = min(clearance, reach * down)
        if reach < dvl.min_range_m or rng.random() < dvl.beam_loss:
            continue
        heard += 1
        slope = dvl.range_noise_fraction * reach
        noise = math.sqrt(dvl.range_noise_m * dvl.range_noise_m + slope * slope)
        readings[slot.RANGE + i] = reach + noise * rng.standard_normal()
        readings[slot.BEAM + i] = (
            _along_beam(sensors, nav.hidden, i, u, v, w) + sigma * rng.standard_normal()
        )
        if rng.random() < dvl.outlier_probability:
            readings[slot.BEAM + i] = dvl.outlier_mps * (2.0 * rng.random() - 1.0)
            readings[slot.RANGE + i] *= rng.random()
    if dvl.water_every == 0 or (heard > 0 and ping % dvl.water_every != 0):
        return
    if clearance < dvl.water_least_altitude_m:
        return
    # Relative to the water: its velocity is taken off in NED before it is turned.
    n, e = now[7] - water_ned[0], now[8] - water_ned[1]
    u, v, w = rotate_back(turn, n, e, now[9])
    u, v, w = u + spin0, v + spin1, w + spin2
    for i in range(part.BEAMS):
        readings[slot.WATER_BEAM + i] = (
            _along_beam(sensors, nav.hidden, i, u, v, w)
            + dvl.water_noise_mps * rng.standard_normal()
        )


@kernel
def _along_beam(sensors: Sensors, hidden: Array, i: int, u: float, v: float, w: float) -> float:
    """Velocity along a beam with the instrument's constant errors."""
    angle = hidden[slot.DVL_ANGLE - slot.GYRO_BIAS]
    scale = 1.0 + hidden[slot.DVL_SCALE - slot.GYRO_BIAS]
    c, s = math.cos(angle), math.sin(angle)
    b = sensors.beams
    return float(
        b[i, 0] * (scale * (c * u + s * v) + hidden[slot.DVL_BIAS - slot.GYRO_BIAS])
        + b[i, 1] * (scale * (c * v - s * u) + hidden[slot.DVL_BIAS - slot.GYRO_BIAS + 1])
        + b[i, 2] * scale * w
    )
