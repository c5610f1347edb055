"""The error-state Kalman filter: kernels that weigh one number at a time, and correct.

After J. Sola, Quaternion kinematics for the error-state Kalman filter, 2017, with the attitude's
error in NED (his global one: truth = exp(error) belief), and measurements as increments of angle
and velocity, so that prediction is exact but for noise and the course of velocity in a tick. The
covariance is (25, 25); `state` defines the layout, and `prediction` propagates it over a tick.
Errors of the instruments that do not average out are states, else it would be too optimistic.

Four choices keep the covariance honest over hours:
- The attitude's error is in NED, where heading is one number, and is not reset (see `correct`): no
  correction of the tilt, repeated at random, makes gravity give information on heading.
- The velocity is kept in the body frame. Were it in NED, a ping after a long drop-out would tie it
  to a heading it does not measure, and the next, about another velocity, would count as knowledge.
- It is kept as the DVL measures it, with the DVL's scale error in it: a ping's row then holds no
  estimated velocity, whose error is in the innovation too. The scale acts where position grows.
  Its effect on accelerations, a part in 500 of them, is process noise.
- The scale is considered, not estimated (the Schmidt-Kalman filter; R. G. Brown and P. Y. C. Hwang,
  Introduction to Random Signals and Applied Kalman Filtering): noisy increments as regressors pull
  a factor towards 0, and over half an hour that drove it off by four of its sigmas.
"""

import math

from alice_survey.vehicle.compiled import kernel
from alice_survey.vehicle.navigation.sensors import BEAMS, DVL, IMU, PRESSURE, Sensors
from alice_survey.vehicle.navigation.state import (
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
    GAIN,
    GYRO_BIAS,
    HEADING,
    HEADING_BIAS,
    INNOVATION_AT,
    QUATERNION,
    RATES,
    REJECTED,
    ROW,
    RUN,
    USED,
    VELOCITY,
    WATER,
    WATER_BEAM,
    WATER_USE,
    WIDENED,
    NavigationState,
)
from alice_survey.vehicle.rotations import matrix_of, turn, wrapped

DOUBT_AFTER = (50, 50, 40, 40, 6, 6)
"""Rejections in a row, of each instrument, after which covariances are widened: 5 s of compass and
depth, 2 s of the DVL, 6 fixes. Outliers do not come like that: of 1 in 20, 6 in a row once in 64
million."""


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
    scale_variance = p[DVL_SCALE, DVL_SCALE]
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
    # Considered: no correction, and what all others know of it stays.
    error[DVL_SCALE], p[DVL_SCALE, DVL_SCALE] = 0.0, scale_variance


@kernel
def remaining(nav: NavigationState, innovation: float) -> float:
    """An innovation about the estimate, minus what this tick's corrections already account for."""
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
        innovation: measured minus estimated.
        noise_variance: noise variance of the measurement.
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
        The estimate of that coordinate, metres.
    """
    h, turned, x = nav.scratch[ROW], nav.turns[BELIEVED], nav.nominal
    for j in range(ERROR):
        h[j] = 0.0
    a = sensors.place[place, 0] - sensors.place[IMU, 0]
    b = sensors.place[place, 1] - sensors.place[IMU, 1]
    c = sensors.place[place, 2] - sensors.place[IMU, 2]
    n = turned[0, 0] * a + turned[0, 1] * b + turned[0, 2] * c
    e = turned[1, 0] * a + turned[1, 1] * b + turned[1, 2] * c
    d = turned[2, 0] * a + turned[2, 1] * b + turned[2, 2] * c
    # A lever l turned by the error f moves by f x l; along an axis a that is f . (l x a).
    h[axis] = 1.0
    if axis == 0:
        h[ATTITUDE + 1], h[ATTITUDE + 2] = d, -e
        return float(x[0] + n)
    if axis == 1:
        h[ATTITUDE], h[ATTITUDE + 2] = -d, n
        return float(x[1] + e)
    h[ATTITUDE], h[ATTITUDE + 1] = e, -n
    return float(x[2] + d)


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
    # Of atan2(east, north) of the bow (n, e, d), which the error f moves by f x bow.
    n, e, d = turned[0, 0], turned[1, 0], turned[2, 0]
    level = n * n + e * e
    h[ATTITUDE], h[ATTITUDE + 1], h[ATTITUDE + 2] = -d * n / level, -d * e / level, 1.0
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
    # The water's velocity in the body frame.
    i0 = i1 = i2 = 0.0
    if through_water:
        n, e = x[WATER + 1], x[WATER + 2]
        i0 = turned[0, 0] * n + turned[1, 0] * e
        i1 = turned[0, 1] * n + turned[1, 1] * e
        i2 = turned[0, 2] * n + turned[1, 2] * e
    # What the scale multiplies still: the DVL's velocity about the IMU, less the water's.
    k0, k1, k2 = q * l2 - r * l1 - i0, r * l0 - p * l2 - i1, p * l1 - q * l0 - i2
    u, v, w = x[VELOCITY] + k0, x[VELOCITY + 1] + k1, x[VELOCITY + 2] + k2
    angle = x[DVL_ANGLE + 1]
    cosine, sine = math.cos(angle), math.sin(angle)
    along, across = cosine * u + sine * v, cosine * v - sine * u
    sigma = sensors.water_noise
    if not through_water:
        speed = math.sqrt(u * u + v * v + w * w)
        sigma = sensors.beam_noise + sensors.beam_noise_per_speed * speed
    # Opposite pairs of beams add up to the same except for noise: where they do not, one received
    # another echo, and after a drop-out the filter could not know which. NaN passes this test.
    odd = readings[first] + readings[first + 2] - readings[first + 1] - readings[first + 3]
    if odd * odd > sensors.gate * 4.0 * sigma * sigma:
        nav.counts[instrument, REJECTED] += 1
        return 0
    gyro_variance = sensors.gyro_noise * sensors.gyro_noise / sensors.tick_s
    used = 0
    for i in range(BEAMS):
        measured = readings[first + i]
        if not math.isfinite(measured):
            continue
        b0, b1, b2 = sensors.beams[i, 0], sensors.beams[i, 1], sensors.beams[i, 2]
        # The beam as the misalignment turns it.
        c0, c1, c2 = cosine * b0 - sine * b1, sine * b0 + cosine * b1, b2
        for j in range(ERROR):
            h[j] = 0.0
        h[VELOCITY], h[VELOCITY + 1], h[VELOCITY + 2] = c0, c1, c2
        if through_water:
            a = turned[0, 0] * c0 + turned[0, 1] * c1 + turned[0, 2] * c2
            b = turned[1, 0] * c0 + turned[1, 1] * c1 + turned[1, 2] * c2
            c = turned[2, 0] * c0 + turned[2, 1] * c1 + turned[2, 2] * c2
            n, e = x[WATER + 1], x[WATER + 2]
            h[ATTITUDE], h[ATTITUDE + 1], h[ATTITUDE + 2] = e * c, -n * c, n * b - e * a
            h[WATER], h[WATER + 1] = -a, -b
        h[GYRO_BIAS] = c1 * l2 - c2 * l1
        h[GYRO_BIAS + 1] = c2 * l0 - c0 * l2
        h[GYRO_BIAS + 2] = c0 * l1 - c1 * l0
        h[DVL_SCALE] = c0 * k0 + c1 * k1 + c2 * k2
        h[DVL_ANGLE] = b0 * across - b1 * along
        h[DVL_BIAS], h[DVL_BIAS + 1] = b0, b1
        believed = b0 * (along + x[DVL_BIAS + 1]) + b1 * (across + x[DVL_BIAS + 2]) + b2 * w
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
        place: place of the antenna or transponder in `sensors.place`.
        reading: reading of north; east follows.
        noise_variance: noise variance of each.
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
    """Apply the gathered correction to the estimate, and clear it.

    P stays as it is, as in an invariant filter (A. Barrau and S. Bonnabel, The invariant extended
    Kalman filter as a stable observer, 2017): gravity is what corrects the tilt, and it sees the
    tilt relative to the new estimate. Sola's reset (314) would let a heading error
    affect every such correction, and gravity would then give information on heading.
    """
    x, error = nav.nominal, nav.scratch[CORRECTION]
    angle, turned = error[ATTITUDE : ATTITUDE + 3], nav.turns[BELIEVED]
    for i in range(ATTITUDE):
        x[i] += error[i]
    for i in range(GYRO_BIAS, ERROR):
        x[i + 1] += error[i]
    # A turn f in NED is R^T f in the body frame.
    local = nav.scratch[GAIN]
    for i in range(3):
        local[i] = turned[0, i] * angle[0] + turned[1, i] * angle[1] + turned[2, i] * angle[2]
    turn(x[QUATERNION : QUATERNION + 4], local)
    for i in range(ERROR):
        error[i] = 0.0
    matrix_of(x[QUATERNION : QUATERNION + 4], turned)
