"""The error-state Kalman filter: kernels that predict, weigh one number at a time, and correct.

After J. Sola, Quaternion kinematics for the error-state Kalman filter, 2017, with the attitude's
error in the body frame (truth = belief exp(error)), and measurements as increments of angle and
velocity, so that prediction is exact but for noise and the course of velocity within a tick. The
covariance is (25, 25); `navigation_state` says what lies where. Errors of the instruments that do
not average out are states, else the covariance would promise too much.
"""

import math

from alice_survey.frames import Array
from alice_survey.vehicle.compiled import kernel
from alice_survey.vehicle.dynamics import GRAVITY
from alice_survey.vehicle.navigation_state import (
    ACCELEROMETER_BIAS,
    ATTITUDE,
    BEAM,
    BELIEVED,
    COMPASS_USE,
    CORRECTION,
    DEPTH,
    DEPTH_BIAS,
    DEPTH_USE,
    DVL_ANGLE,
    DVL_BIAS,
    DVL_SCALE,
    DVL_USE,
    ERROR,
    EXTRA,
    GAIN,
    GPS_BIAS,
    GYRO_BIAS,
    HEADING,
    HEADING_BIAS,
    INNOVATION_AT,
    PUSH,
    QUATERNION,
    RATES,
    REJECTED,
    ROW,
    RUN,
    TURN,
    USED,
    VELOCITY,
    WATER,
    WATER_BEAM,
    WATER_USE,
    WIDENED,
    NavigationState,
)
from alice_survey.vehicle.rotations import matrix_of, turn, wrapped
from alice_survey.vehicle.sensors import BEAMS, DVL, IMU, PRESSURE, Sensors

DOUBT_AFTER = (50, 50, 40, 40, 5, 3)
"""Rejections in a row, of each instrument, after which the filter doubts itself: 5 s of compass and
depth, 2 s of the DVL, 5 fixes of the GPS, 3 of the USBL. Outliers do not come like that."""


@kernel
def predict(dt_s: float, sensors: Sensors, nav: NavigationState) -> None:
    """Move belief and covariance on by the IMU's increments in `readings`."""
    x, readings, turned = nav.nominal, nav.readings, nav.turns[BELIEVED]
    matrix_of(x[QUATERNION : QUATERNION + 4], turned)
    a, b, c = (
        readings[TURN] - x[GYRO_BIAS + 1] * dt_s,
        readings[TURN + 1] - x[GYRO_BIAS + 2] * dt_s,
        readings[TURN + 2] - x[GYRO_BIAS + 3] * dt_s,
    )
    d, e, f = (
        readings[PUSH] - x[ACCELEROMETER_BIAS + 1] * dt_s,
        readings[PUSH + 1] - x[ACCELEROMETER_BIAS + 2] * dt_s,
        readings[PUSH + 2] - x[ACCELEROMETER_BIAS + 3] * dt_s,
    )
    _transition(dt_s, a, b, c, d, e, f, turned, nav)
    _propagate(dt_s, sensors, nav)
    for i in range(3):
        push = turned[i, 0] * d + turned[i, 1] * e + turned[i, 2] * f
        if i == 2:
            push += GRAVITY * dt_s
        x[i] += dt_s * (x[3 + i] + 0.5 * push)
        x[3 + i] += push
    angle = nav.scratch[GAIN]
    angle[0], angle[1], angle[2] = a, b, c
    turn(x[QUATERNION : QUATERNION + 4], angle)
    for i, kept in (
        (HEADING_BIAS, math.exp(-dt_s / sensors.compass_bias_s)),
        (DEPTH_BIAS, math.exp(-dt_s / sensors.pressure_bias_s)),
        (GPS_BIAS, math.exp(-dt_s / sensors.gps_bias_s)),
        (GPS_BIAS + 1, math.exp(-dt_s / sensors.gps_bias_s)),
        (WATER, math.exp(-dt_s / sensors.water_s)),
        (WATER + 1, math.exp(-dt_s / sensors.water_s)),
    ):
        x[i + 1] *= kept
    matrix_of(x[QUATERNION : QUATERNION + 4], turned)


@kernel
def _transition(
    dt_s: float,
    a: float,
    b: float,
    c: float,
    d: float,
    e: float,
    f: float,
    turned: Array,
    nav: NavigationState,
) -> None:
    """The blocks of the transition that are not the identity, into rows of `scratch`.

    Row EXTRA: velocity by attitude, -R [push]x (9), then velocity by accelerometer bias, -R dt (9).
    Row EXTRA + 1: attitude by attitude, exp(-angle) (9), then by gyroscope bias,
    -(I - [angle]x / 2) dt (9) (Sola 2017, 183 and 270; 201 for the half).
    """
    move, rotate = nav.scratch[EXTRA], nav.scratch[EXTRA + 1]
    for i in range(3):
        r0, r1, r2 = turned[i, 0], turned[i, 1], turned[i, 2]
        move[3 * i] = r2 * e - r1 * f
        move[3 * i + 1] = r0 * f - r2 * d
        move[3 * i + 2] = r1 * d - r0 * e
        for j in range(3):
            move[9 + 3 * i + j] = -turned[i, j] * dt_s
    size2 = a * a + b * b + c * c
    size = math.sqrt(size2)
    # exp(-angle) = I - k [angle]x + m [angle]x^2, by series where the angle is next to nothing.
    k = math.sin(size) / size if size > 1e-4 else 1.0 - size2 / 6.0
    m = (1.0 - math.cos(size)) / size2 if size > 1e-4 else 0.5 - size2 / 24.0
    rotate[0], rotate[1], rotate[2] = (
        1.0 - m * (b * b + c * c),
        k * c + m * a * b,
        m * a * c - k * b,
    )
    rotate[3], rotate[4], rotate[5] = (
        m * a * b - k * c,
        1.0 - m * (a * a + c * c),
        k * a + m * b * c,
    )
    rotate[6], rotate[7], rotate[8] = (
        k * b + m * a * c,
        m * b * c - k * a,
        1.0 - m * (a * a + b * b),
    )
    h = 0.5 * dt_s
    rotate[9], rotate[10], rotate[11] = -dt_s, -h * c, h * b
    rotate[12], rotate[13], rotate[14] = h * c, -dt_s, -h * a
    rotate[15], rotate[16], rotate[17] = -h * b, h * a, -dt_s


@kernel
def _propagate(dt_s: float, sensors: Sensors, nav: NavigationState) -> None:
    """P <- F P F^T + Q, from the blocks of `_transition`.

    F acts on rows; on the transpose it acts once more.
    """
    p = nav.covariance
    _transform_rows(dt_s, sensors, nav)
    for i in range(ERROR):
        for j in range(i):
            p[i, j], p[j, i] = p[j, i], p[i, j]
    _transform_rows(dt_s, sensors, nav)
    # Rounding leaves the two halves apart by a last bit.
    for i in range(ERROR):
        for j in range(i):
            mean = 0.5 * (p[i, j] + p[j, i])
            p[i, j] = p[j, i] = mean
    push = sensors.accelerometer_noise * sensors.accelerometer_noise * dt_s
    angle = sensors.gyro_noise * sensors.gyro_noise * dt_s
    for i in range(3):
        v = VELOCITY + i
        p[v, v] += push
        p[i, v] += 0.5 * dt_s * push
        p[v, i] += 0.5 * dt_s * push
        p[i, i] += 0.25 * dt_s * dt_s * push
        p[ATTITUDE + i, ATTITUDE + i] += angle
        p[GYRO_BIAS + i, GYRO_BIAS + i] += sensors.gyro_walk * sensors.gyro_walk * dt_s
        p[ACCELEROMETER_BIAS + i, ACCELEROMETER_BIAS + i] += (
            sensors.accelerometer_walk * sensors.accelerometer_walk * dt_s
        )
    for i, correlation_s, sigma in (
        (HEADING_BIAS, sensors.compass_bias_s, sensors.compass_bias_sigma),
        (DEPTH_BIAS, sensors.pressure_bias_s, sensors.pressure_bias_sigma),
        (GPS_BIAS, sensors.gps_bias_s, sensors.gps_bias_sigma),
        (GPS_BIAS + 1, sensors.gps_bias_s, sensors.gps_bias_sigma),
        (WATER, sensors.water_s, sensors.water_sigma),
        (WATER + 1, sensors.water_s, sensors.water_sigma),
    ):
        p[i, i] += -math.expm1(-2.0 * dt_s / correlation_s) * sigma * sigma


@kernel
def _transform_rows(dt_s: float, sensors: Sensors, nav: NavigationState) -> None:
    """P <- F P."""
    p, move, rotate = nav.covariance, nav.scratch[EXTRA], nav.scratch[EXTRA + 1]
    th, gy, ac = ATTITUDE, GYRO_BIAS, ACCELEROMETER_BIAS
    for i in range(3):
        m0, m1, m2 = move[3 * i], move[3 * i + 1], move[3 * i + 2]
        n0, n1, n2 = move[9 + 3 * i], move[10 + 3 * i], move[11 + 3 * i]
        v = VELOCITY + i
        for j in range(ERROR):
            change = (
                m0 * p[th, j] + m1 * p[th + 1, j] + m2 * p[th + 2, j]
                + n0 * p[ac, j] + n1 * p[ac + 1, j] + n2 * p[ac + 2, j]
            )  # fmt: skip
            p[i, j] += dt_s * (p[v, j] + 0.5 * change)
            p[v, j] += change
    for j in range(ERROR):
        a, b, c = p[th, j], p[th + 1, j], p[th + 2, j]
        d, e, f = p[gy, j], p[gy + 1, j], p[gy + 2, j]
        p[th, j] = (
            rotate[0] * a + rotate[1] * b + rotate[2] * c
            + rotate[9] * d + rotate[10] * e + rotate[11] * f
        )  # fmt: skip
        p[th + 1, j] = (
            rotate[3] * a + rotate[4] * b + rotate[5] * c
            + rotate[12] * d + rotate[13] * e + rotate[14] * f
        )  # fmt: skip
        p[th + 2, j] = (
            rotate[6] * a + rotate[7] * b + rotate[8] * c
            + rotate[15] * d + rotate[16] * e + rotate[17] * f
        )  # fmt: skip
    for i, correlation_s in (
        (HEADING_BIAS, sensors.compass_bias_s),
        (DEPTH_BIAS, sensors.pressure_bias_s),
        (GPS_BIAS, sensors.gps_bias_s),
        (GPS_BIAS + 1, sensors.gps_bias_s),
        (WATER, sensors.water_s),
        (WATER + 1, sensors.water_s),
    ):
        kept = math.exp(-dt_s / correlation_s)
        for j in range(ERROR):
            p[i, j] *= kept


@kernel
def project(nav: NavigationState) -> float:
    """P h into row GAIN of `scratch`, for h in row ROW; the variance h P h."""
    p, h, w = nav.covariance, nav.scratch[ROW], nav.scratch[GAIN]
    for j in range(ERROR):
        w[j] = 0.0
    for i in range(ERROR):
        if h[i] != 0.0:
            factor = h[i]
            for j in range(ERROR):
                w[j] += factor * p[i, j]
    variance = 0.0
    for j in range(ERROR):
        variance += h[j] * w[j]
    return variance


@kernel
def absorb(nav: NavigationState, innovation: float, variance: float) -> None:
    """Correct by one number, whose P h is in row GAIN; the correction gathers in CORRECTION."""
    p, w, error = nav.covariance, nav.scratch[GAIN], nav.scratch[CORRECTION]
    inverse = 1.0 / math.sqrt(variance)
    for j in range(ERROR):
        w[j] *= inverse
    scaled = innovation * inverse
    # w w^T is symmetric to the last bit, and so P remains.
    for i in range(ERROR):
        factor = w[i]
        error[i] += factor * scaled
        for j in range(ERROR):
            p[i, j] -= factor * w[j]


@kernel
def remaining(nav: NavigationState, innovation: float) -> float:
    """An innovation about the belief, less what this tick's corrections account for already."""
    h, error = nav.scratch[ROW], nav.scratch[CORRECTION]
    for j in range(ERROR):
        innovation -= h[j] * error[j]
    return innovation


@kernel
def weigh(
    nav: NavigationState,
    sensors: Sensors,
    instrument: int,
    place: int,
    innovation: float,
    noise_variance: float,
    doubted: int,
    doubted_count: int,
) -> bool:
    """Use one measured number, whose row h is in ROW of `scratch`, unless it is too far off.

    Args:
        nav: the filter.
        sensors: for the gate.
        instrument: row of `counts`.
        place: in `innovations`.
        innovation: measured minus believed.
        noise_variance: of the measurement.
        doubted: where the errors begin that are widened after too many rejections in a row.
        doubted_count: how many.

    Returns:
        Whether it was used.
    """
    h, w, counts = nav.scratch[ROW], nav.scratch[GAIN], nav.counts
    innovation = remaining(nav, innovation)
    variance = project(nav) + noise_variance
    if not (math.isfinite(innovation) and variance > 0.0):
        counts[instrument, REJECTED] += 1
        return False
    nav.innovations[place] = innovation / math.sqrt(variance)
    excess = innovation * innovation - variance
    if innovation * innovation > sensors.gate * variance:
        counts[instrument, REJECTED] += 1
        counts[instrument, RUN] += 1
        if counts[instrument, RUN] < DOUBT_AFTER[instrument]:
            return False
        size2 = 0.0
        for i in range(doubted, doubted + doubted_count):
            size2 += h[i] * h[i]
        for i in range(doubted, doubted + doubted_count):
            nav.covariance[i, i] += excess / size2
            w[i] += excess / size2 * h[i]
        variance += excess
        counts[instrument, WIDENED] += 1
    counts[instrument, USED] += 1
    counts[instrument, RUN] = 0
    absorb(nav, innovation, variance)
    return True


@kernel
def lever_row(nav: NavigationState, sensors: Sensors, place: int, axis: int) -> float:
    """Row of an instrument's position along an axis of NED, into ROW.

    Returns:
        What is believed of that coordinate, metres.
    """
    h, turned, x = nav.scratch[ROW], nav.turns[BELIEVED], nav.nominal
    for j in range(ERROR):
        h[j] = 0.0
    a = sensors.place[place, 0] - sensors.place[IMU, 0]
    b = sensors.place[place, 1] - sensors.place[IMU, 1]
    c = sensors.place[place, 2] - sensors.place[IMU, 2]
    r0, r1, r2 = turned[axis, 0], turned[axis, 1], turned[axis, 2]
    h[axis] = 1.0
    h[ATTITUDE] = r2 * b - r1 * c
    h[ATTITUDE + 1] = r0 * c - r2 * a
    h[ATTITUDE + 2] = r1 * a - r0 * b
    return float(x[axis] + r0 * a + r1 * b + r2 * c)


@kernel
def use_depth(nav: NavigationState, sensors: Sensors) -> bool:
    """Weigh the depth in `readings`."""
    believed = lever_row(nav, sensors, PRESSURE, 2)
    nav.scratch[ROW, DEPTH_BIAS] = 1.0
    innovation = nav.readings[DEPTH] - believed - nav.nominal[DEPTH_BIAS + 1]
    noise = sensors.pressure_noise * sensors.pressure_noise
    return weigh(nav, sensors, DEPTH_USE, INNOVATION_AT[DEPTH_USE], innovation, noise, 2, 1)


@kernel
def use_heading(nav: NavigationState, sensors: Sensors) -> bool:
    """Weigh the heading in `readings`; too many rejections widen the compass's bias."""
    h, turned = nav.scratch[ROW], nav.turns[BELIEVED]
    for j in range(ERROR):
        h[j] = 0.0
    level = turned[0, 0] * turned[0, 0] + turned[1, 0] * turned[1, 0]
    # The Euler rate of heading: (q sin(roll) + r cos(roll)) / cos(pitch).
    h[ATTITUDE + 1], h[ATTITUDE + 2] = turned[2, 1] / level, turned[2, 2] / level
    h[HEADING_BIAS] = 1.0
    believed = math.atan2(turned[1, 0], turned[0, 0]) + nav.nominal[HEADING_BIAS + 1]
    innovation = wrapped(nav.readings[HEADING] - believed)
    noise = sensors.compass_noise * sensors.compass_noise
    return weigh(
        nav, sensors, COMPASS_USE, INNOVATION_AT[COMPASS_USE], innovation, noise, HEADING_BIAS, 1
    )


@kernel
def use_beams(nav: NavigationState, sensors: Sensors, through_water: bool) -> int:
    """Weigh a ping's velocities along the beams, over ground or through the water.

    Args:
        nav: the filter.
        sensors: the instruments.
        through_water: the velocities are relative to the water.

    Returns:
        Bit i is set if beam i was used.
    """
    x, readings, h, turned = nav.nominal, nav.readings, nav.scratch[ROW], nav.turns[BELIEVED]
    first, instrument = (WATER_BEAM, WATER_USE) if through_water else (BEAM, DVL_USE)
    l0 = sensors.place[DVL, 0] - sensors.place[IMU, 0]
    l1 = sensors.place[DVL, 1] - sensors.place[IMU, 1]
    l2 = sensors.place[DVL, 2] - sensors.place[IMU, 2]
    p = readings[RATES] - x[GYRO_BIAS + 1]
    q = readings[RATES + 1] - x[GYRO_BIAS + 2]
    r = readings[RATES + 2] - x[GYRO_BIAS + 3]
    n, e, d = x[3], x[4], x[5]
    if through_water:
        n, e = n - x[WATER + 1], e - x[WATER + 2]
    # Velocity of the IMU in the body frame, then of the DVL.
    i0 = turned[0, 0] * n + turned[1, 0] * e + turned[2, 0] * d
    i1 = turned[0, 1] * n + turned[1, 1] * e + turned[2, 1] * d
    i2 = turned[0, 2] * n + turned[1, 2] * e + turned[2, 2] * d
    u, v, w = i0 + q * l2 - r * l1, i1 + r * l0 - p * l2, i2 + p * l1 - q * l0
    scale, angle = 1.0 + x[DVL_SCALE + 1], x[DVL_ANGLE + 1]
    cosine, sine = math.cos(angle), math.sin(angle)
    along, across = cosine * u + sine * v, cosine * v - sine * u
    sigma = sensors.water_noise
    if not through_water:
        speed = math.sqrt(u * u + v * v + w * w)
        sigma = sensors.beam_noise + sensors.beam_noise_per_speed * speed
    gyro_variance = sensors.gyro_noise * sensors.gyro_noise / sensors.tick_s
    used = 0
    for i in range(BEAMS):
        measured = readings[first + i]
        if not math.isfinite(measured):
            continue
        b0, b1, b2 = sensors.beams[i, 0], sensors.beams[i, 1], sensors.beams[i, 2]
        # The beam as the misalignment turns it, with the scale.
        c0, c1, c2 = (
            scale * (cosine * b0 - sine * b1),
            scale * (sine * b0 + cosine * b1),
            scale * b2,
        )
        for j in range(ERROR):
            h[j] = 0.0
        for j in range(3):
            h[VELOCITY + j] = turned[j, 0] * c0 + turned[j, 1] * c1 + turned[j, 2] * c2
        h[ATTITUDE] = c1 * i2 - c2 * i1
        h[ATTITUDE + 1] = c2 * i0 - c0 * i2
        h[ATTITUDE + 2] = c0 * i1 - c1 * i0
        h[GYRO_BIAS] = c1 * l2 - c2 * l1
        h[GYRO_BIAS + 1] = c2 * l0 - c0 * l2
        h[GYRO_BIAS + 2] = c0 * l1 - c1 * l0
        h[DVL_SCALE] = b0 * along + b1 * across + b2 * w
        h[DVL_ANGLE] = scale * (b0 * across - b1 * along)
        h[DVL_BIAS], h[DVL_BIAS + 1] = b0, b1
        if through_water:
            h[WATER], h[WATER + 1] = -h[VELOCITY], -h[VELOCITY + 1]
        believed = scale * h[DVL_SCALE] + b0 * x[DVL_BIAS + 1] + b1 * x[DVL_BIAS + 2]
        # The rate's noise acts by the same lever as the gyroscopes' bias.
        arm = h[GYRO_BIAS] ** 2 + h[GYRO_BIAS + 1] ** 2 + h[GYRO_BIAS + 2] ** 2
        noise = sigma * sigma + gyro_variance * arm
        doubted, count = (WATER, 2) if through_water else (VELOCITY, 3)
        place = INNOVATION_AT[instrument] + i
        if weigh(nav, sensors, instrument, place, measured - believed, noise, doubted, count):
            used |= 1 << i
    return used


@kernel
def use_fix(
    nav: NavigationState,
    sensors: Sensors,
    instrument: int,
    place: int,
    reading: int,
    noise_variance: float,
    bias: int,
) -> bool:
    """Weigh north and east of a fix together: an outlier in one spoils both.

    Args:
        nav: the filter.
        sensors: the instruments.
        instrument: row of `counts`.
        place: of the antenna or transponder in `sensors.place`.
        reading: of north; east follows.
        noise_variance: of each.
        bias: where the errors of the fix's bias begin; -1 of none.

    Returns:
        Whether it was used.
    """
    counts, x = nav.counts, nav.nominal
    worst, excess = 0.0, 0.0
    for axis in range(2):
        innovation = nav.readings[reading + axis] - lever_row(nav, sensors, place, axis)
        if bias >= 0:
            nav.scratch[ROW, bias + axis] = 1.0
            innovation -= x[bias + 1 + axis]
        innovation = remaining(nav, innovation)
        variance = project(nav) + noise_variance
        if not (math.isfinite(innovation) and variance > 0.0):
            counts[instrument, REJECTED] += 1
            return False
        nav.innovations[INNOVATION_AT[instrument] + axis] = innovation / math.sqrt(variance)
        worst = max(worst, innovation * innovation / variance)
        excess = max(excess, innovation * innovation - variance)
    if worst > sensors.gate:
        counts[instrument, REJECTED] += 1
        counts[instrument, RUN] += 1
        if counts[instrument, RUN] < DOUBT_AFTER[instrument]:
            return False
        for axis in range(2):
            nav.covariance[axis, axis] += excess
        counts[instrument, WIDENED] += 1
    counts[instrument, USED] += 1
    counts[instrument, RUN] = 0
    for axis in range(2):
        innovation = nav.readings[reading + axis] - lever_row(nav, sensors, place, axis)
        if bias >= 0:
            nav.scratch[ROW, bias + axis] = 1.0
            innovation -= x[bias + 1 + axis]
        innovation = remaining(nav, innovation)
        absorb(nav, innovation, project(nav) + noise_variance)
    return True


@kernel
def correct(nav: NavigationState) -> None:
    """Move the gathered correction into the belief, and forget it.

    The attitude's error is then counted from a turned frame: P turns along by I - [error]x / 2
    (Sola 2017, 287).
    """
    x, p, error = nav.nominal, nav.covariance, nav.scratch[CORRECTION]
    for i in range(ATTITUDE):
        x[i] += error[i]
    for i in range(GYRO_BIAS, ERROR):
        x[i + 1] += error[i]
    angle = error[ATTITUDE : ATTITUDE + 3]
    turn(x[QUATERNION : QUATERNION + 4], angle)
    a, b, c = 0.5 * angle[0], 0.5 * angle[1], 0.5 * angle[2]
    if a * a + b * b + c * c > 1e-12:
        t = ATTITUDE
        for j in range(ERROR):
            k, m, n = p[t, j], p[t + 1, j], p[t + 2, j]
            p[t, j], p[t + 1, j], p[t + 2, j] = (
                k + c * m - b * n,
                m - c * k + a * n,
                n + b * k - a * m,
            )
        for j in range(ERROR):
            k, m, n = p[j, t], p[j, t + 1], p[j, t + 2]
            p[j, t], p[j, t + 1], p[j, t + 2] = (
                k + c * m - b * n,
                m - c * k + a * n,
                n + b * k - a * m,
            )
    for i in range(ERROR):
        error[i] = 0.0
    matrix_of(x[QUATERNION : QUATERNION + 4], nav.turns[BELIEVED])
