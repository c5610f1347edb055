"""The navigation's tick: measure, predict, weigh, and report to the controller and the log.

The closed loop calls the tick. Instruments measure the true state at that time, which the filter
sees in no other way.
"""

import math

import numpy as np

from alice_survey.base.frames import Array
from alice_survey.vehicle.compiled import kernel
from alice_survey.vehicle.estimate_vector import ALTITUDE, CLEARANCE, ESTIMATE, HEADING, P, U
from alice_survey.vehicle.floor import FloorGrid
from alice_survey.vehicle.navigation.filter import (
    correct,
    lever_row,
    use_beams,
    use_depth,
    use_fix,
    use_heading,
)
from alice_survey.vehicle.navigation.measuring import (
    drift,
    measure_depth,
    measure_dvl,
    measure_gps,
    measure_heading,
    measure_imu,
    measure_rates,
    measure_usbl,
    usbl_sigma,
)
from alice_survey.vehicle.navigation.prediction import predict
from alice_survey.vehicle.navigation.sensors import BEAMS, DVL, FOLLOWED, GPS, IMU, USBL, Sensors
from alice_survey.vehicle.navigation.state import (
    ALTITUDE_NOW,
    ALTITUDE_PING,
    ALTITUDE_SIGMA,
    ALTITUDE_TIME,
    ALTITUDE_VARIANCE,
    ATTITUDE,
    BELIEVED,
    CLEARANCE_NOW,
    CLEARANCE_PING,
    FOLLOWED_DEPTH,
    GPS_BIAS,
    GPS_FIX,
    GPS_USE,
    GYRO_BIAS,
    HEADING_TURNS,
    IMU_PLACE,
    LATEST,
    MEAN_SLOPE_EAST,
    MEAN_SLOPE_NORTH,
    MOVED_EAST,
    MOVED_NORTH,
    QUATERNION,
    RANGE,
    RATES,
    REJECTED,
    RELIEF_PINGS,
    RELIEF_VARIANCE,
    SLOPE_EAST,
    SLOPE_NORTH,
    SLOPE_VARIANCE,
    TRUTH_NOW,
    USBL_FIX,
    USBL_USE,
    USED,
    VELOCITY,
    NavigationState,
)
from alice_survey.vehicle.rotations import matrix_of, wrapped

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
_LEAST_SPREAD = 0.01
"""Least determinant of the scatter of the ends over its squared trace: 1/4 for a square, 0.19 for
three corners."""


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
    matrix_of(now[3:7], nav.turns[TRUTH_NOW])
    if tick > 0:
        measure_imu(dt_s, before, now, suite, nav, rng)
        predict(dt_s, suite, nav)
        drift(dt_s, suite, nav, rng)
    else:
        measure_rates(dt_s, now, suite, nav, rng)
        matrix_of(nav.nominal[QUATERNION : QUATERNION + 4], nav.turns[BELIEVED])
    pinged, used = False, False
    bottom = 0
    if suite.compass_every > 0 and tick % suite.compass_every == 0:
        measure_heading(time_s, suite, nav, rng)
        used |= use_heading(nav, suite)
    if suite.pressure_every > 0 and tick % suite.pressure_every == 0:
        measure_depth(time_s, now, suite, nav, rng)
        used |= use_depth(nav, suite)
    due = suite.gps_every > 0 and tick % suite.gps_every == 0
    if due and measure_gps(time_s, now, suite, nav, rng):
        noise = suite.gps_noise * suite.gps_noise
        used |= use_fix(nav, suite, GPS_USE, GPS, GPS_FIX, noise, GPS_BIAS)
    due = suite.usbl_every > 0 and tick % suite.usbl_every == 0
    if due and measure_usbl(time_s, now, suite, nav, rng):
        used |= _use_usbl(nav, suite)
    if suite.dvl_every > 0 and tick % suite.dvl_every == 0:
        pinged = True
        ping = tick // suite.dvl_every
        measure_dvl(time_s, ping, now, water_velocity_ned, floor, suite, nav, rng)
        bottom = use_beams(nav, suite, False)
        used |= bottom != 0
        used |= use_beams(nav, suite, True) != 0
    if used:
        correct(nav)
    _write_estimate(nav, suite, estimate)
    if pinged and bottom != 0:
        _hear_floor(time_s, bottom, nav, suite)
    _carry_altitude(time_s, nav, suite)
    estimate[ALTITUDE] = nav.memory[ALTITUDE_NOW]
    estimate[CLEARANCE] = nav.memory[CLEARANCE_NOW]
    for i in range(ESTIMATE):
        nav.memory[LATEST + i] = estimate[i]


@kernel
def _use_usbl(nav: NavigationState, suite: Sensors) -> bool:
    """Weigh the fix of the transponder, with the sigma of its estimated distance."""
    north = lever_row(nav, suite, USBL, 0)
    east = lever_row(nav, suite, USBL, 1)
    sigma = usbl_sigma(suite, north, east, lever_row(nav, suite, USBL, 2))
    return use_fix(nav, suite, USBL_USE, USBL, USBL_FIX, sigma * sigma, -1)


@kernel
def _write_estimate(nav: NavigationState, suite: Sensors, estimate: Array) -> None:
    """Write the estimate of the body's origin, except for the altitude."""
    x, turned, memory = nav.nominal, nav.turns[BELIEVED], nav.memory
    a, b, c = suite.place[IMU, 0], suite.place[IMU, 1], suite.place[IMU, 2]
    for i in range(3):
        estimate[i] = x[i] - turned[i, 0] * a - turned[i, 1] * b - turned[i, 2] * c
        estimate[P + i] = nav.readings[RATES + i] - x[GYRO_BIAS + 1 + i]
    p, q, r = estimate[P], estimate[P + 1], estimate[P + 2]
    estimate[U] = x[VELOCITY] - q * c + r * b
    estimate[U + 1] = x[VELOCITY + 1] - r * a + p * c
    estimate[U + 2] = x[VELOCITY + 2] - p * b + q * a
    estimate[3] = math.atan2(turned[2, 1], turned[2, 2])
    estimate[4] = -math.asin(min(max(turned[2, 0], -1.0), 1.0))
    heading = math.atan2(turned[1, 0], turned[0, 0])
    memory[HEADING_TURNS] += wrapped(heading - memory[HEADING_TURNS])
    estimate[HEADING] = memory[HEADING_TURNS]


@kernel
def _followed_depth(nav: NavigationState, suite: Sensors) -> float:
    """Believed depth of the followed point, metres."""
    turned, total = nav.turns[BELIEVED], nav.nominal[2]
    for i in range(3):
        total += turned[2, i] * (suite.place[FOLLOWED, i] - suite.place[IMU, i])
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
    turned, memory, place = nav.turns[BELIEVED], nav.memory, suite.place
    count = 0
    noise = sn = se = sd = snn = sne = see = snd = sed = sdd = 0.0
    highest = math.inf
    for i in range(BEAMS):
        if used >> i & 1 == 0:
            continue
        reach = nav.readings[RANGE + i]
        a = reach * suite.beams[i, 0] + place[DVL, 0] - place[FOLLOWED, 0]
        b = reach * suite.beams[i, 1] + place[DVL, 1] - place[FOLLOWED, 1]
        c = reach * suite.beams[i, 2] + place[DVL, 2] - place[FOLLOWED, 2]
        # Where the beam ends, from the followed point.
        n = turned[0, 0] * a + turned[0, 1] * b + turned[0, 2] * c
        e = turned[1, 0] * a + turned[1, 1] * b + turned[1, 2] * c
        d = turned[2, 0] * a + turned[2, 1] * b + turned[2, 2] * c
        count += 1
        sn, se, sd = sn + n, se + e, sd + d
        snn, sne, see = snn + n * n, sne + n * e, see + e * e
        snd, sed, sdd = snd + n * d, sed + e * d, sdd + d * d
        highest = min(highest, d)
        down = turned[2, 0] * suite.beams[i, 0] + turned[2, 1] * suite.beams[i, 1]
        down += turned[2, 2] * suite.beams[i, 2]
        growth = suite.range_noise_fraction * reach
        noise += (suite.range_noise * suite.range_noise + growth * growth) * down * down
    if count < 3:
        return
    noise /= count
    n, e, d = sn / count, se / count, sd / count
    cnn, cne, cee = snn - n * sn, sne - n * se, see - e * se
    cnd, ced, cdd = snd - n * sd, sed - e * sd, sdd - d * sd
    determinant = cnn * cee - cne * cne
    if determinant < _LEAST_SPREAD * (cnn + cee) * (cnn + cee):
        return
    north, east = (cee * cnd - cne * ced) / determinant, (cnn * ced - cne * cnd) / determinant
    altitude = d - north * n - east * e
    # Of the plane's depth below the point, by that of a beam's end.
    doubt = 1.0 / count + (cee * n * n - 2.0 * cne * n * e + cnn * e * e) / determinant

    share = suite.dvl_every * suite.tick_s / suite.relief_memory_s
    share = max(1.0 / (memory[RELIEF_PINGS] + 1.0), share)
    freedom = count - 3.0 + 2.0 * (1.0 - share) * (1.0 - share)
    if freedom > 0.0:
        memory[RELIEF_PINGS] += 1.0
        memory[MEAN_SLOPE_NORTH] += share * (north - memory[MEAN_SLOPE_NORTH])
        memory[MEAN_SLOPE_EAST] += share * (east - memory[MEAN_SLOPE_EAST])
        gn, ge = memory[MEAN_SLOPE_NORTH], memory[MEAN_SLOPE_EAST]
        square = cdd - 2.0 * (gn * cnd + ge * ced)
        square += gn * gn * cnn + 2.0 * gn * ge * cne + ge * ge * cee
        memory[RELIEF_VARIANCE] += share * (square / freedom - memory[RELIEF_VARIANCE])
    relief = memory[RELIEF_VARIANCE]
    # The spread holds the ranges' noise, of which the plane keeps a part only.
    spread = max((1.0 + doubt) * relief - noise, doubt * noise)
    # A tilt turns the ends about the point: over a level floor that moves them sideways only.
    tilt = _variance(nav, ATTITUDE, altitude * east, -altitude * north, 0.0)
    memory[ALTITUDE_PING], memory[ALTITUDE_VARIANCE] = altitude, spread + tilt
    memory[SLOPE_NORTH], memory[SLOPE_EAST] = north, east
    memory[SLOPE_VARIANCE] = max(relief, noise) * (cnn + cee) / determinant
    memory[MOVED_NORTH] = memory[MOVED_EAST] = 0.0
    memory[ALTITUDE_TIME] = time_s
    memory[FOLLOWED_DEPTH] = _followed_depth(nav, suite)

    clearance, lowest = altitude, 0.0
    points = suite.hull.shape[0]
    for i in range(points + 1):
        if i < points:
            a, b, c = suite.hull[i, 0], suite.hull[i, 1], suite.hull[i, 2]
        else:
            a, b, c = place[DVL, 0], place[DVL, 1], place[DVL, 2]
        a, b, c = a - place[FOLLOWED, 0], b - place[FOLLOWED, 1], c - place[FOLLOWED, 2]
        n = turned[0, 0] * a + turned[0, 1] * b + turned[0, 2] * c
        e = turned[1, 0] * a + turned[1, 1] * b + turned[1, 2] * c
        d = turned[2, 0] * a + turned[2, 1] * b + turned[2, 2] * c
        clearance = min(clearance, altitude + north * n + east * e - d)
        lowest = max(lowest, d)
    memory[CLEARANCE_PING] = min(clearance, highest - lowest)


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
def _carry_altitude(time_s: float, nav: NavigationState, suite: Sensors) -> None:
    """Altitude and clearance now, by the last ping's plane; NaN when that is too long ago.

    The depth gained since and the rise of the plane below the way gone since are taken off.
    """
    memory, x, turned = nav.memory, nav.nominal, nav.turns[BELIEVED]
    age = time_s - memory[ALTITUDE_TIME]
    # Not a number before the first ping: then this is false too.
    if age <= suite.altitude_age_s + 1e-9:
        if age > 0.0:
            # Summed speeds, not places: a fix would move the vehicle along the slope.
            u, v, w = x[VELOCITY], x[VELOCITY + 1], x[VELOCITY + 2]
            step = suite.tick_s
            memory[MOVED_NORTH] += step * (turned[0, 0] * u + turned[0, 1] * v + turned[0, 2] * w)
            memory[MOVED_EAST] += step * (turned[1, 0] * u + turned[1, 1] * v + turned[1, 2] * w)
        n, e = memory[MOVED_NORTH], memory[MOVED_EAST]
        gained = _followed_depth(nav, suite) - memory[FOLLOWED_DEPTH]
        sinks = memory[SLOPE_NORTH] * n + memory[SLOPE_EAST] * e
        drifted = age * age * _variance(nav, VELOCITY, turned[2, 0], turned[2, 1], turned[2, 2])
        drifted += memory[SLOPE_VARIANCE] * (n * n + e * e)
        memory[ALTITUDE_NOW] = memory[ALTITUDE_PING] - gained + sinks
        memory[ALTITUDE_SIGMA] = math.sqrt(memory[ALTITUDE_VARIANCE] + drifted)
        clearance = memory[CLEARANCE_PING] - gained + min(sinks, 0.0)
        memory[CLEARANCE_NOW] = clearance - memory[ALTITUDE_SIGMA]
    else:
        memory[ALTITUDE_NOW] = memory[ALTITUDE_SIGMA] = memory[CLEARANCE_NOW] = math.nan


@kernel
def log_row(nav: NavigationState, out: Array) -> None:
    """Write a row of the log, (LOG_ROW,), as `LOG_COLUMNS` names it, of the latest tick.

    Sigmas are of the body's origin, whose position error includes attitude, and of Euler angles.
    """
    p, turned = nav.covariance, nav.turns[BELIEVED]
    latest = nav.memory[LATEST : LATEST + ESTIMATE]
    for i in range(LOG_SIGMA):
        out[i] = latest[i]
    out[LOG_CLEARANCE] = latest[CLEARANCE]
    a, b, c = nav.memory[IMU_PLACE], nav.memory[IMU_PLACE + 1], nav.memory[IMU_PLACE + 2]
    n = turned[0, 0] * a + turned[0, 1] * b + turned[0, 2] * c
    e = turned[1, 0] * a + turned[1, 1] * b + turned[1, 2] * c
    d = turned[2, 0] * a + turned[2, 1] * b + turned[2, 2] * c
    t = ATTITUDE
    # The origin lies at minus the lever l from the IMU: the error f moves it by -f x l.
    for i, g0, g1, g2 in ((0, 0.0, -d, e), (1, d, 0.0, -n), (2, -e, n, 0.0)):
        both = g0 * p[i, t] + g1 * p[i, t + 1] + g2 * p[i, t + 2]
        variance = p[i, i] + 2.0 * both + _variance(nav, ATTITUDE, g0, g1, g2)
        out[LOG_SIGMA + i] = math.sqrt(max(variance, 0.0))
    # Of the bow (n, e, d): pitch turns about the level axis across it, roll about itself.
    n, e, d = turned[0, 0], turned[1, 0], turned[2, 0]
    level2 = n * n + e * e
    level = math.sqrt(level2)
    out[LOG_SIGMA + 3] = math.sqrt(_variance(nav, ATTITUDE, n / level2, e / level2, 0.0))
    out[LOG_SIGMA + 4] = math.sqrt(_variance(nav, ATTITUDE, -e / level, n / level, 0.0))
    out[LOG_SIGMA + 5] = math.sqrt(_variance(nav, ATTITUDE, -d * n / level2, -d * e / level2, 1.0))
    out[LOG_SIGMA + 6] = nav.memory[ALTITUDE_SIGMA]
    for i in range(BEAMS):
        out[LOG_RANGE + i] = nav.readings[RANGE + i]
    for i in range(6):
        out[LOG_USED + i] = nav.counts[i, USED]
        out[LOG_REJECTED + i] = nav.counts[i, REJECTED]
