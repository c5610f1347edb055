"""The filter's prediction: kernels that propagate estimate and covariance over a tick.

See `filter` for the states and the reasons.
"""

import math

from alice_survey.base.frames import Array
from alice_survey.vehicle.compiled import kernel
from alice_survey.vehicle.dynamics import GRAVITY
from alice_survey.vehicle.navigation.sensors import Sensors
from alice_survey.vehicle.navigation.state import (
    ACCELEROMETER_BIAS,
    ATTITUDE,
    BELIEVED,
    BLOCKS,
    DEPTH_BIAS,
    DVL_SCALE,
    ERROR,
    FLOW,
    GAIN,
    GAINED,
    GPS_BIAS,
    GYRO_BIAS,
    HEADING_BIAS,
    KEPT,
    LEVERS,
    NEW,
    PUSH,
    QUATERNION,
    SUM,
    TURN,
    VELOCITY,
    WATER,
    NavigationState,
)
from alice_survey.vehicle.rotations import matrix_of, turn

MANOEUVRE_S = 5.0
"""Time of acceleration in one direction: half a turn of ALICE at 17 deg/s (paper, section VII)
takes so long."""


@kernel
def predict(dt_s: float, sensors: Sensors, nav: NavigationState) -> None:
    """Propagate estimate and covariance by the IMU's increments in `readings`.

    With the velocity v in the body frame, the turn R, the increments a of angle and d of velocity,
    s = v + d + R^T g dt is the new velocity in the old frame; v' = exp(-a) s, R' = R exp(a), and
    p' = p + R (v + s) dt / 2.
    """
    x, readings, turned, flow = nav.nominal, nav.readings, nav.turns[BELIEVED], nav.scratch[FLOW]
    spin, attitude = nav.scratch[BLOCKS], x[QUATERNION : QUATERNION + 4]
    matrix_of(attitude, turned)
    angle = nav.scratch[GAIN]
    for i in range(3):
        angle[i] = readings[TURN + i] - x[GYRO_BIAS + 1 + i] * dt_s
        push = readings[PUSH + i] - x[ACCELEROMETER_BIAS + 1 + i] * dt_s
        flow[GAINED + i] = push + turned[2, i] * GRAVITY * dt_s
        flow[NEW + i] = x[VELOCITY + i] + flow[GAINED + i]
        flow[SUM + i] = x[VELOCITY + i] + flow[NEW + i]
    _exponential(angle[0], angle[1], angle[2], dt_s, spin)
    for i in range(3):
        x[VELOCITY + i] = (
            spin[3 * i] * flow[NEW]
            + spin[3 * i + 1] * flow[NEW + 1]
            + spin[3 * i + 2] * flow[NEW + 2]
        )
        along = (
            turned[i, 0] * flow[SUM] + turned[i, 1] * flow[SUM + 1] + turned[i, 2] * flow[SUM + 2]
        )
        x[i] += 0.5 * dt_s * along
    _transition(dt_s, nav)
    turn(attitude, angle)
    matrix_of(attitude, turned)
    _turn_by_bias(nav)
    for i, correlation_s in (
        (HEADING_BIAS, sensors.compass_bias_s),
        (DEPTH_BIAS, sensors.pressure_bias_s),
        (GPS_BIAS, sensors.gps_bias_s),
        (GPS_BIAS + 1, sensors.gps_bias_s),
        (WATER, sensors.water_s),
        (WATER + 1, sensors.water_s),
    ):
        nav.scratch[KEPT, i] = math.exp(-dt_s / correlation_s)
        x[i + 1] *= nav.scratch[KEPT, i]
    _propagate(dt_s, sensors, nav)


@kernel
def _exponential(a: float, b: float, c: float, dt_s: float, out: Array) -> None:
    """exp(-angle) (9), then -(I - [angle]x / 2) dt (9), row by row (Sola 2017, 78 and 184)."""
    size2 = a * a + b * b + c * c
    size = math.sqrt(size2)
    # exp(-angle) = I - k [angle]x + m [angle]x^2, by series where the angle is next to nothing.
    k = math.sin(size) / size if size > 1e-4 else 1.0 - size2 / 6.0
    m = (1.0 - math.cos(size)) / size2 if size > 1e-4 else 0.5 - size2 / 24.0
    out[0], out[1], out[2] = 1.0 - m * (b * b + c * c), k * c + m * a * b, m * a * c - k * b
    out[3], out[4], out[5] = m * a * b - k * c, 1.0 - m * (a * a + c * c), k * a + m * b * c
    out[6], out[7], out[8] = k * b + m * a * c, m * b * c - k * a, 1.0 - m * (a * a + b * b)
    h = 0.5 * dt_s
    out[9], out[10], out[11] = -dt_s, -h * c, h * b
    out[12], out[13], out[14] = h * c, -dt_s, -h * a
    out[15], out[16], out[17] = -h * b, h * a, -dt_s


@kernel
def _transition(dt_s: float, nav: NavigationState) -> None:
    """The blocks of the transition that need the attitude before it is moved on.

    Into row LEVERS: position by each of the two velocities, R dt / 2 (9); velocity by attitude,
    R^T [g dt]x without its third column, which is 0 (6); half the tick's way, R (v + s) dt / 2 = w
    (3): position by attitude is -[w]x, by the DVL's scale -w. Into row LEVERS + 1: velocity by
    gyroscope bias, [v']x J (9), with J as in `_exponential`.
    """
    x, turned, flow = nav.nominal, nav.turns[BELIEVED], nav.scratch[FLOW]
    spin, levers, swing = nav.scratch[BLOCKS], nav.scratch[LEVERS], nav.scratch[LEVERS + 1]
    h, fall = 0.5 * dt_s, GRAVITY * dt_s
    for i in range(3):
        r0, r1, r2 = h * turned[i, 0], h * turned[i, 1], h * turned[i, 2]
        levers[3 * i], levers[3 * i + 1], levers[3 * i + 2] = r0, r1, r2
        levers[9 + 2 * i], levers[10 + 2 * i] = fall * turned[1, i], -fall * turned[0, i]
        levers[15 + i] = r0 * flow[SUM] + r1 * flow[SUM + 1] + r2 * flow[SUM + 2]
    u, v, w = x[VELOCITY], x[VELOCITY + 1], x[VELOCITY + 2]
    for j in range(3):
        j0, j1, j2 = spin[9 + j], spin[12 + j], spin[15 + j]
        swing[j], swing[3 + j], swing[6 + j] = v * j2 - w * j1, w * j0 - u * j2, u * j1 - v * j0


@kernel
def _turn_by_bias(nav: NavigationState) -> None:
    """Attitude by gyroscope bias, R' J (9), behind the others in row LEVERS + 1."""
    turned, spin, swing = nav.turns[BELIEVED], nav.scratch[BLOCKS], nav.scratch[LEVERS + 1]
    for i in range(3):
        for j in range(3):
            swing[9 + 3 * i + j] = (
                turned[i, 0] * spin[9 + j]
                + turned[i, 1] * spin[12 + j]
                + turned[i, 2] * spin[15 + j]
            )


@kernel
def _propagate(dt_s: float, sensors: Sensors, nav: NavigationState) -> None:
    """P <- F P F^T + Q, from the blocks of the transition.

    F acts on rows; on the transpose it acts once more.
    """
    p = nav.covariance
    _transform_rows(dt_s, nav)
    for i in range(ERROR):
        for j in range(i):
            p[i, j], p[j, i] = p[j, i], p[i, j]
    _transform_rows(dt_s, nav)
    # Rounding leaves the two halves apart by a last bit.
    for i in range(ERROR):
        for j in range(i):
            mean = 0.5 * (p[i, j] + p[j, i])
            p[i, j] = p[j, i] = mean
    _add_noise(dt_s, sensors, nav)


@kernel
def _add_noise(dt_s: float, sensors: Sensors, nav: NavigationState) -> None:
    """Add Q: a turn's noise n moves attitude by -R n, velocity by -[v]x n; a push's m velocity.

    By the trapezoid half of it reaches the position within the tick. A velocity with the DVL's
    scale in it gains more than the push says: counted as noise, the same for MANOEUVRE_S.
    """
    p, x, turned = nav.covariance, nav.nominal, nav.turns[BELIEVED]
    push = sensors.accelerometer_noise * sensors.accelerometer_noise * dt_s
    gained2 = 0.0
    for i in range(3):
        gained2 += nav.scratch[FLOW, GAINED + i] ** 2
    push += p[DVL_SCALE, DVL_SCALE] * gained2 * MANOEUVRE_S / dt_s
    angle = sensors.gyro_noise * sensors.gyro_noise * dt_s
    u, v, w = x[VELOCITY], x[VELOCITY + 1], x[VELOCITY + 2]
    speed2 = u * u + v * v + w * w
    for i in range(3):
        p[i, i] += 0.25 * dt_s * dt_s * push
        p[VELOCITY + i, VELOCITY + i] += push + angle * speed2
        p[ATTITUDE + i, ATTITUDE + i] += angle
        p[GYRO_BIAS + i, GYRO_BIAS + i] += sensors.gyro_walk * sensors.gyro_walk * dt_s
        p[ACCELEROMETER_BIAS + i, ACCELEROMETER_BIAS + i] += (
            sensors.accelerometer_walk * sensors.accelerometer_walk * dt_s
        )
        for j in range(3):
            both = 0.5 * dt_s * turned[i, j] * push
            p[i, VELOCITY + j] += both
            p[VELOCITY + j, i] += both
            p[VELOCITY + i, VELOCITY + j] -= angle * x[VELOCITY + i] * x[VELOCITY + j]
    for j in range(3):
        r0, r1, r2 = angle * turned[j, 0], angle * turned[j, 1], angle * turned[j, 2]
        for i, both in ((0, v * r2 - w * r1), (1, w * r0 - u * r2), (2, u * r1 - v * r0)):
            p[VELOCITY + i, ATTITUDE + j] += both
            p[ATTITUDE + j, VELOCITY + i] += both
    for i, sigma in (
        (HEADING_BIAS, sensors.compass_bias_sigma),
        (DEPTH_BIAS, sensors.pressure_bias_sigma),
        (GPS_BIAS, sensors.gps_bias_sigma),
        (GPS_BIAS + 1, sensors.gps_bias_sigma),
        (WATER, sensors.water_sigma),
        (WATER + 1, sensors.water_sigma),
    ):
        kept = nav.scratch[KEPT, i]
        p[i, i] += (1.0 - kept * kept) * sigma * sigma


@kernel
def _transform_rows(dt_s: float, nav: NavigationState) -> None:
    """P <- F P."""
    p, e, levers = nav.covariance, nav.scratch[BLOCKS], nav.scratch[LEVERS]
    swing = nav.scratch[LEVERS + 1]
    w0, w1, w2 = levers[15], levers[16], levers[17]
    ve, th, gy, ac = VELOCITY, ATTITUDE, GYRO_BIAS, ACCELEROMETER_BIAS
    for j in range(ERROR):
        t0, t1, t2 = p[th, j], p[th + 1, j], p[th + 2, j]
        b0, b1, b2 = p[gy, j], p[gy + 1, j], p[gy + 2, j]
        v0, v1, v2, c = p[ve, j], p[ve + 1, j], p[ve + 2, j], p[DVL_SCALE, j]
        # The error of s: of v, of the push, and of gravity.
        s0 = v0 - dt_s * p[ac, j] + levers[9] * t0 + levers[10] * t1
        s1 = v1 - dt_s * p[ac + 1, j] + levers[11] * t0 + levers[12] * t1
        s2 = v2 - dt_s * p[ac + 2, j] + levers[13] * t0 + levers[14] * t1
        v0, v1, v2 = v0 + s0, v1 + s1, v2 + s2
        p[0, j] += levers[0] * v0 + levers[1] * v1 + levers[2] * v2 + w2 * t1 - w1 * t2 - w0 * c
        p[1, j] += levers[3] * v0 + levers[4] * v1 + levers[5] * v2 + w0 * t2 - w2 * t0 - w1 * c
        p[2, j] += levers[6] * v0 + levers[7] * v1 + levers[8] * v2 + w1 * t0 - w0 * t1 - w2 * c
        p[ve, j] = e[0] * s0 + e[1] * s1 + e[2] * s2 + swing[0] * b0 + swing[1] * b1 + swing[2] * b2
        p[ve + 1, j] = (
            e[3] * s0 + e[4] * s1 + e[5] * s2 + swing[3] * b0 + swing[4] * b1 + swing[5] * b2
        )
        p[ve + 2, j] = (
            e[6] * s0 + e[7] * s1 + e[8] * s2 + swing[6] * b0 + swing[7] * b1 + swing[8] * b2
        )
        p[th, j] = t0 + swing[9] * b0 + swing[10] * b1 + swing[11] * b2
        p[th + 1, j] = t1 + swing[12] * b0 + swing[13] * b1 + swing[14] * b2
        p[th + 2, j] = t2 + swing[15] * b0 + swing[16] * b1 + swing[17] * b2
    for i in (HEADING_BIAS, DEPTH_BIAS, GPS_BIAS, GPS_BIAS + 1, WATER, WATER + 1):
        kept = nav.scratch[KEPT, i]
        for j in range(ERROR):
            p[i, j] *= kept
