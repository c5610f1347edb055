"""The error-state Kalman filter: its state, the prediction over a tick, and the corrections.

After J. Sola, Quaternion kinematics for the error-state Kalman filter, 2017, with the attitude's
error in NED (his global one: truth = exp(error) belief), and measurements as increments of angle
and velocity, so that prediction is exact but for noise and the course of velocity in a tick.
Errors of the instruments that do not average out are states, else the covariance, (25, 25), would
be too optimistic.

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
from typing import NamedTuple

import numpy as np

from alice_survey.core.compiled import columns, kernel
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.estimate_vector import ESTIMATE
from alice_survey.sim.vehicle.navigation import sensors as part
from alice_survey.sim.vehicle.navigation.sensors import Sensors
from alice_survey.sim.vehicle.rotations import matrix_of, rotate, rotate_back, turn, wrap_angle
from alice_survey.sim.vehicle.sea import GRAVITY

POSITION, VELOCITY, ATTITUDE, GYRO_BIAS, ACCELEROMETER_BIAS = 0, 3, 6, 9, 12
HEADING_BIAS, DEPTH_BIAS, DVL_SCALE, DVL_ANGLE, DVL_BIAS, GPS_BIAS, WATER = (
    15, 16, 17, 18, 19, 21, 23,
)  # fmt: skip
"""Offsets in the error state (25,): position of the IMU in NED, its velocity over
ground in the body frame with the DVL's scale error in it, its attitude about the axes of NED, its
biases, then the compass's, the depth's, scale and misalignment of the DVL, its bias of surge and
sway, the GPS's bias of north and east, the current."""
NORTH_AXIS, EAST_AXIS, DOWN_AXIS = columns(3)
ERROR = 25
QUATERNION = 6
NOMINAL = ERROR + 1
"""Length of the nominal state: as the error state, with a quaternion (4) for the attitude (3), so
that what follows the attitude is one place further on."""
HIDDEN = WATER - GYRO_BIAS
"""Number of true errors of the instruments; error `GYRO_BIAS + i` estimates `hidden[i]`."""

TURN, PUSH, RATES, HEADING, DEPTH, RANGE, BEAM, WATER_BEAM = 0, 3, 6, 9, 10, 11, 15, 19
GPS_FIX, USBL_FIX = 23, 25
"""Offsets of each instrument's latest reading in `readings`: increments of angle (3) and velocity
(3) over the tick, rates (3), heading, depth, ranges (4) and velocities (4) along the beams,
velocities through the water (4), north and east of the GPS antenna and of the transponder (2 each).
NaN where nothing was measured."""
READINGS = 27

COMPASS_USE, DEPTH_USE, DVL_USE, WATER_USE, GPS_USE, USBL_USE = columns(6)
"""Rows of `counts`."""
USED, REJECTED, RUN, WIDENED = 0, 1, 2, 3
"""Columns of `counts`: scalars used and rejected, rejected in a row by now, and how often too many
in a row made the filter widen its covariance."""
INNOVATIONS = 14
"""Compass, depth, DVL (4), water (4), GPS (2), USBL (2): places in `innovations`."""
INNOVATION_AT = (0, 1, 2, 6, 10, 12)
"""Place of each instrument's first innovation."""

HEADING_TURNS, ALTITUDE_PING, ALTITUDE_TIME, ALTITUDE_VARIANCE, FOLLOWED_DEPTH = 0, 1, 2, 3, 4
RELIEF_VARIANCE, RELIEF_PINGS, ALTITUDE_NOW, ALTITUDE_SIGMA = 5, 6, 7, 8
IMU_PLACE = 9
SLOPE_NORTH, SLOPE_EAST, SLOPE_VARIANCE, MEAN_SLOPE_NORTH, MEAN_SLOPE_EAST = 12, 13, 14, 15, 16
MOVED_NORTH, MOVED_EAST, CLEARANCE_PING, CLEARANCE_NOW, LATEST = 17, 18, 19, 20, 21
MEMORY = LATEST + ESTIMATE
"""Places in `memory`: the heading not wrapped; altitude of the followed point, its time, variance
and depth at the last ping; the beams' spread; altitude and its sigma now; where the IMU is on the
body (3); by how much the floor's depth grows to the north and to the east at the last ping, the
variance of either, and both averaged; how far the vehicle has gone since; clearance at the last
ping and now; the latest estimate, as `estimate_vector` has it (14)."""

TRUTH_BEFORE, TRUTH_NOW, BELIEVED = 0, 1, 2
"""Rows of `turns`."""
ROW, GAIN, CORRECTION, KEPT, FLOW, BLOCKS, LEVERS = 0, 1, 2, 3, 4, 5, 6
"""Rows of `scratch`; LEVERS has two."""
NEW, SUM, GAINED = 0, 3, 6
"""Places in row FLOW: the velocity after a tick in the frame before it, the sum of both velocities,
and what gravity and push add."""

MANOEUVRE_S = 5.0
"""Time of acceleration in one direction: half a turn of ALICE at 17 deg/s (paper, section VII)
takes so long."""
WIDEN_AFTER = (50, 50, 40, 40, 6, 6)
"""Rejections in a row, of each instrument, after which covariances are widened: 5 s of compass and
depth, 2 s of the DVL, 6 fixes. Outliers do not come like that: of 1 in 20, 6 in a row once in 64
million."""
_WIDENED = (HEADING_BIAS, 2, VELOCITY, WATER, 0, 0)
_WIDENED_COUNT = (1, 1, 3, 2, 2, 2)
"""The errors that are widened then: where they begin, and how many."""
OVER_GROUND, THROUGH_WATER = np.bool_(False), np.bool_(True)
"""Of a ping's velocities along the beams."""


class NavigationState(NamedTuple):
    """Filter, hidden errors of the instruments, and latest readings; overwritten tick by tick."""

    nominal: Array
    """(26,) estimate."""
    covariance: Array
    """(25, 25) covariance of truth minus estimate."""
    hidden: Array
    """(14,) the instruments' true biases, scale and misalignment."""
    readings: Array
    innovations: Array
    """(14,) the tick's innovations over their standard deviations, NaN where none was due."""
    memory: Array
    counts: Array
    """(6, 4) integers."""
    scratch: Array
    """(8, 25)"""
    turns: Array
    """(3, 3, 3) rotation matrices."""


def new_navigation(sensors: Sensors, truth: Array, rng: np.random.Generator) -> NavigationState:
    """Begin at a fix: draw the instruments' errors, and an estimate with the same errors.

    The position comes from the GPS and shares its bias, as do heading and depth from compass and
    pressure; the covariance includes this. Velocity is the true one, known to be zero at rest, with
    a DVL's noise.

    Args:
        sensors: the instruments.
        truth: (13,) position NED, quaternion, velocity over ground NED, body rates.
        rng: source of all errors.
    """
    from scipy.spatial.transform import Rotation

    from alice_survey.core.frames import rotation_from_attitude

    covariance = initial_covariance(sensors)
    hidden_sigma = np.sqrt(np.diag(covariance)[GYRO_BIAS:WATER])
    hidden = hidden_sigma * rng.standard_normal(HIDDEN)
    bias_of = {i: hidden[i - GYRO_BIAS] for i in range(GYRO_BIAS, WATER)}
    attitude = Rotation.from_quat(truth[3:7])
    rates, lever = truth[10:13], sensors.place[part.IMU]

    nominal = np.zeros(NOMINAL)
    fix_error = np.array([bias_of[GPS_BIAS], bias_of[GPS_BIAS + 1], bias_of[DEPTH_BIAS]])
    fix_noise = np.array([sensors.gps.noise_m, sensors.gps.noise_m, sensors.pressure.noise_m])
    nominal[:3] = truth[:3] + attitude.apply(lever)
    nominal[:3] += fix_error + fix_noise * rng.standard_normal(3)
    nominal[3:6] = attitude.inv().apply(truth[7:10]) + np.cross(rates, lever)
    nominal[3:6] *= 1.0 + bias_of[DVL_SCALE]
    nominal[3:6] += _velocity_sigma(sensors) * rng.standard_normal(3)
    tilt = sensors.imu.tilt_sigma_rad * rng.standard_normal(2)
    turn = bias_of[HEADING_BIAS] + sensors.compass.noise_rad * rng.standard_normal()
    # The compass error is about the vertical, the tilt's about the level axes of the body.
    believed = rotation_from_attitude(0.0, 0.0, turn) * attitude * Rotation.from_rotvec([*tilt, 0])
    nominal[QUATERNION : QUATERNION + 4] = believed.as_quat()
    level = attitude.as_matrix()[:, :2]
    block = slice(ATTITUDE, ATTITUDE + 3)
    covariance[block, block] = sensors.imu.tilt_sigma_rad**2 * level @ level.T
    covariance[ATTITUDE + 2, ATTITUDE + 2] += (
        sensors.compass.bias_sigma_rad**2 + sensors.compass.noise_rad**2
    )
    covariance[ATTITUDE + 2, HEADING_BIAS] = -(sensors.compass.bias_sigma_rad**2)
    covariance[HEADING_BIAS, ATTITUDE + 2] = -(sensors.compass.bias_sigma_rad**2)
    memory = np.full(MEMORY, np.nan)
    rotation = believed.as_matrix()
    memory[HEADING_TURNS] = math.atan2(rotation[1, 0], rotation[0, 0])
    memory[RELIEF_VARIANCE] = memory[RELIEF_PINGS] = 0.0
    memory[MEAN_SLOPE_NORTH] = memory[MEAN_SLOPE_EAST] = 0.0
    memory[IMU_PLACE : IMU_PLACE + 3] = lever
    return NavigationState(
        nominal=nominal,
        covariance=covariance,
        hidden=hidden,
        readings=np.full(READINGS, np.nan),
        innovations=np.full(INNOVATIONS, np.nan),
        memory=memory,
        counts=np.zeros((6, 4), dtype=np.int64),
        scratch=np.zeros((8, ERROR)),
        turns=np.zeros((3, 3, 3)),
    )


def initial_covariance(sensors: Sensors) -> Array:
    """(25, 25) at the start, of a level vehicle.

    A fix with bias and noise leaves a position error of opposite sign: truth minus estimate
    is minus the bias minus the noise.
    """
    sigma = np.zeros(ERROR)
    sigma[GYRO_BIAS : GYRO_BIAS + 3] = sensors.imu.gyro_bias_sigma_radps
    sigma[ACCELEROMETER_BIAS : ACCELEROMETER_BIAS + 3] = sensors.imu.accelerometer_bias_sigma_mps2
    sigma[HEADING_BIAS] = sensors.compass.bias_sigma_rad
    sigma[DEPTH_BIAS] = sensors.pressure.bias_sigma_m
    sigma[DVL_SCALE], sigma[DVL_ANGLE] = sensors.dvl.scale_sigma, sensors.dvl.misalignment_sigma_rad
    sigma[DVL_BIAS : DVL_BIAS + 2] = sensors.dvl.bias_sigma_mps
    sigma[GPS_BIAS : GPS_BIAS + 2] = sensors.gps.bias_sigma_m
    sigma[WATER : WATER + 2] = sensors.current_sigma_mps
    sigma[VELOCITY : VELOCITY + 3] = _velocity_sigma(sensors)
    covariance = np.diag(sigma**2)
    for axis, bias, noise in (
        (POSITION, GPS_BIAS, sensors.gps.noise_m),
        (POSITION + 1, GPS_BIAS + 1, sensors.gps.noise_m),
        (POSITION + 2, DEPTH_BIAS, sensors.pressure.noise_m),
    ):
        covariance[axis, axis] = covariance[bias, bias] + noise**2
        covariance[axis, bias] = covariance[bias, axis] = -covariance[bias, bias]
    return covariance


def _velocity_sigma(sensors: Sensors) -> float:
    """Velocity sigma of each axis at the start: at rest, known to a few of the DVL's pings."""
    return 2.0 * sensors.dvl.beam_noise_mps + sensors.dvl.bias_sigma_mps


@kernel
def correlated_states(sensors: Sensors) -> tuple[tuple[int, float, float], ...]:
    """Gauss-Markov processes, first the instruments' biases: state, correlation time, sigma."""
    compass, pressure, gps = sensors.compass, sensors.pressure, sensors.gps
    return (
        (HEADING_BIAS, compass.bias_correlation_s, compass.bias_sigma_rad),
        (DEPTH_BIAS, pressure.bias_correlation_s, pressure.bias_sigma_m),
        (GPS_BIAS, gps.bias_correlation_s, gps.bias_sigma_m),
        (GPS_BIAS + 1, gps.bias_correlation_s, gps.bias_sigma_m),
        (WATER, sensors.current_correlation_s, sensors.current_sigma_mps),
        (WATER + 1, sensors.current_correlation_s, sensors.current_sigma_mps),
    )


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
    # exp(-angle) (9), then J = -(I - [angle]x / 2) dt (9), row by row (Sola 2017, 78 and 184):
    # exp(-angle) = I - k [angle]x + m [angle]x^2, by series where the angle is next to nothing.
    a, b, c, h = angle[0], angle[1], angle[2], 0.5 * dt_s
    size2 = a * a + b * b + c * c
    size = math.sqrt(size2)
    k = math.sin(size) / size if size > 1e-4 else 1.0 - size2 / 6.0
    m = (1.0 - math.cos(size)) / size2 if size > 1e-4 else 0.5 - size2 / 24.0
    spin[0], spin[1], spin[2] = 1.0 - m * (b * b + c * c), k * c + m * a * b, m * a * c - k * b
    spin[3], spin[4], spin[5] = m * a * b - k * c, 1.0 - m * (a * a + c * c), k * a + m * b * c
    spin[6], spin[7], spin[8] = k * b + m * a * c, m * b * c - k * a, 1.0 - m * (a * a + b * b)
    spin[9], spin[10], spin[11] = -dt_s, -h * c, h * b
    spin[12], spin[13], spin[14] = h * c, -dt_s, -h * a
    spin[15], spin[16], spin[17] = -h * b, h * a, -dt_s
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
    # Blocks of the transition that need the attitude before it is moved on. Into row LEVERS:
    # position by each of the two velocities, R dt / 2 (9); velocity by attitude, R^T [g dt]x but
    # for its third column, 0 (6); half the tick's way, R (v + s) dt / 2 = w (3): position by
    # attitude is -[w]x, by the DVL's scale -w. Into row LEVERS + 1: velocity by gyroscope bias,
    # [v']x J (9).
    levers, swing, fall = nav.scratch[LEVERS], nav.scratch[LEVERS + 1], GRAVITY * dt_s
    for i in range(3):
        r0, r1, r2 = h * turned[i, 0], h * turned[i, 1], h * turned[i, 2]
        levers[3 * i], levers[3 * i + 1], levers[3 * i + 2] = r0, r1, r2
        levers[9 + 2 * i], levers[10 + 2 * i] = fall * turned[1, i], -fall * turned[0, i]
        levers[15 + i] = r0 * flow[SUM] + r1 * flow[SUM + 1] + r2 * flow[SUM + 2]
    u, v, w = x[VELOCITY], x[VELOCITY + 1], x[VELOCITY + 2]
    for j in range(3):
        j0, j1, j2 = spin[9 + j], spin[12 + j], spin[15 + j]
        swing[j], swing[3 + j], swing[6 + j] = v * j2 - w * j1, w * j0 - u * j2, u * j1 - v * j0
    turn(attitude, angle)
    matrix_of(attitude, turned)
    # Attitude by gyroscope bias, R' J (9), behind the others in row LEVERS + 1.
    for i in range(3):
        for j in range(3):
            swing[9 + 3 * i + j] = (
                turned[i, 0] * spin[9 + j]
                + turned[i, 1] * spin[12 + j]
                + turned[i, 2] * spin[15 + j]
            )
    for i, correlation_s, _ in correlated_states(sensors):
        nav.scratch[KEPT, i] = math.exp(-dt_s / correlation_s)
        x[i + 1] *= nav.scratch[KEPT, i]
    _propagate(dt_s, sensors, nav)


@kernel
def _propagate(dt_s: float, sensors: Sensors, nav: NavigationState) -> None:
    """P <- F P F^T + Q, from the blocks of the transition.

    F acts on rows; on the transpose it acts once more. Q: a turn's noise n moves attitude by -R n,
    velocity by -[v]x n; a push's m velocity, and by the trapezoid half of it the position. A
    velocity with the DVL's scale in it gains more than the push says: counted as noise, the same
    for MANOEUVRE_S.
    """
    p, x, turned = nav.covariance, nav.nominal, nav.turns[BELIEVED]
    imu = sensors.imu
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
    push = imu.accelerometer_noise_mps_per_sqrt_s**2 * dt_s
    gained2 = 0.0
    for i in range(3):
        gained2 += nav.scratch[FLOW, GAINED + i] ** 2
    push += p[DVL_SCALE, DVL_SCALE] * gained2 * MANOEUVRE_S / dt_s
    angle = imu.gyro_noise_rad_per_sqrt_s**2 * dt_s
    u, v, w = x[VELOCITY], x[VELOCITY + 1], x[VELOCITY + 2]
    speed2 = u * u + v * v + w * w
    for i in range(3):
        p[i, i] += 0.25 * dt_s * dt_s * push
        p[VELOCITY + i, VELOCITY + i] += push + angle * speed2
        p[ATTITUDE + i, ATTITUDE + i] += angle
        p[GYRO_BIAS + i, GYRO_BIAS + i] += imu.gyro_bias_walk_radps_per_sqrt_s**2 * dt_s
        p[ACCELEROMETER_BIAS + i, ACCELEROMETER_BIAS + i] += (
            imu.accelerometer_bias_walk_mps2_per_sqrt_s**2 * dt_s
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
    for i, _, sigma in correlated_states(sensors):
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


@kernel
def project(nav: NavigationState, innovation: float) -> tuple[float, float]:
    """P h into row GAIN of `scratch`, for h in row ROW.

    Returns:
        The innovation about the estimate, minus what this tick's corrections already account for;
        and the variance h P h.
    """
    p, h, w, error = nav.covariance, nav.scratch[ROW], nav.scratch[GAIN], nav.scratch[CORRECTION]
    for j in range(ERROR):
        innovation -= h[j] * error[j]
        w[j] = 0.0
    for i in range(ERROR):
        if h[i] != 0.0:
            factor = h[i]
            for j in range(ERROR):
                w[j] += factor * p[i, j]
    variance = 0.0
    for j in range(ERROR):
        variance += h[j] * w[j]
    return innovation, variance


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
def weigh(
    nav: NavigationState,
    sensors: Sensors,
    instrument: int,
    place: int,
    innovation: float,
    noise_variance: float,
) -> bool:
    """Use one measured number, whose row h is in ROW of `scratch`, unless it is too far off.

    Args:
        nav: the filter.
        sensors: for the gate.
        instrument: row of `counts`.
        place: in `innovations`.
        innovation: measured minus estimated.
        noise_variance: noise variance of the measurement.

    Returns:
        Whether it was used.
    """
    h, w, counts = nav.scratch[ROW], nav.scratch[GAIN], nav.counts
    innovation, variance = project(nav, innovation)
    variance += noise_variance
    if not (math.isfinite(innovation) and variance > 0.0):
        counts[instrument, REJECTED] += 1
        return False
    nav.innovations[place] = innovation / math.sqrt(variance)
    excess = innovation * innovation - variance
    if innovation * innovation > sensors.gate * variance:
        counts[instrument, REJECTED] += 1
        counts[instrument, RUN] += 1
        if counts[instrument, RUN] < WIDEN_AFTER[instrument]:
            return False
        size2, first = 0.0, _WIDENED[instrument]
        for i in range(first, first + _WIDENED_COUNT[instrument]):
            size2 += h[i] * h[i]
        for i in range(first, first + _WIDENED_COUNT[instrument]):
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
    a = sensors.place[place, 0] - sensors.place[part.IMU, 0]
    b = sensors.place[place, 1] - sensors.place[part.IMU, 1]
    c = sensors.place[place, 2] - sensors.place[part.IMU, 2]
    n, e, d = rotate(turned, a, b, c)
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
    believed = lever_row(nav, sensors, part.PRESSURE, DOWN_AXIS)
    nav.scratch[ROW, DEPTH_BIAS] = 1.0
    innovation = nav.readings[DEPTH] - believed - nav.nominal[DEPTH_BIAS + 1]
    noise = sensors.pressure.noise_m * sensors.pressure.noise_m
    return weigh(nav, sensors, DEPTH_USE, INNOVATION_AT[DEPTH_USE], innovation, noise)


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
    innovation = wrap_angle(nav.readings[HEADING] - believed)
    noise = sensors.compass.noise_rad * sensors.compass.noise_rad
    return weigh(nav, sensors, COMPASS_USE, INNOVATION_AT[COMPASS_USE], innovation, noise)


@kernel
def use_beams(nav: NavigationState, sensors: Sensors, through_water: bool | np.bool_) -> int:
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
    l0 = sensors.place[part.DVL, 0] - sensors.place[part.IMU, 0]
    l1 = sensors.place[part.DVL, 1] - sensors.place[part.IMU, 1]
    l2 = sensors.place[part.DVL, 2] - sensors.place[part.IMU, 2]
    p = readings[RATES] - x[GYRO_BIAS + 1]
    q = readings[RATES + 1] - x[GYRO_BIAS + 2]
    r = readings[RATES + 2] - x[GYRO_BIAS + 3]
    # The water's velocity in the body frame.
    i0 = i1 = i2 = 0.0
    if through_water:
        i0, i1, i2 = rotate_back(turned, x[WATER + 1], x[WATER + 2], 0.0)
    # What the scale multiplies still: the DVL's velocity about the IMU, minus the water's.
    k0, k1, k2 = q * l2 - r * l1 - i0, r * l0 - p * l2 - i1, p * l1 - q * l0 - i2
    u, v, w = x[VELOCITY] + k0, x[VELOCITY + 1] + k1, x[VELOCITY + 2] + k2
    angle = x[DVL_ANGLE + 1]
    cosine, sine = math.cos(angle), math.sin(angle)
    along, across = cosine * u + sine * v, cosine * v - sine * u
    sigma = sensors.dvl.water_noise_mps
    if not through_water:
        speed = math.sqrt(u * u + v * v + w * w)
        sigma = sensors.dvl.beam_noise_mps + sensors.dvl.beam_noise_per_speed * speed
    # Opposite pairs of beams add up to the same except for noise: where they do not, one received
    # another echo, and after a drop-out the filter could not know which. NaN passes this test.
    odd = readings[first] + readings[first + 2] - readings[first + 1] - readings[first + 3]
    if odd * odd > sensors.gate * 4.0 * sigma * sigma:
        nav.counts[instrument, REJECTED] += 1
        return 0
    gyro_variance = sensors.imu.gyro_noise_rad_per_sqrt_s**2 / sensors.tick_s
    used = 0
    for i in range(part.BEAMS):
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
            a, b, c = rotate(turned, c0, c1, c2)
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
        place = INNOVATION_AT[instrument] + i
        if weigh(nav, sensors, instrument, place, measured - believed, noise):
            used |= 1 << i
    return used


@kernel
def use_fix(nav: NavigationState, sensors: Sensors, instrument: int, noise_variance: float) -> bool:
    """Weigh north and east of a fix together: an outlier in one spoils both.

    Args:
        nav: the filter.
        sensors: the instruments.
        instrument: row of `counts`: `GPS_USE`, whose bias is a state, or `USBL_USE`.
        noise_variance: noise variance of each.

    Returns:
        Whether it was used.
    """
    counts, x, biased = nav.counts, nav.nominal, instrument == GPS_USE
    reading, place = (GPS_FIX, part.GPS) if biased else (USBL_FIX, part.USBL)
    worst, excess = 0.0, 0.0
    for axis in range(2):
        innovation = nav.readings[reading + axis] - lever_row(nav, sensors, place, axis)
        if biased:
            nav.scratch[ROW, GPS_BIAS + axis] = 1.0
            innovation -= x[GPS_BIAS + 1 + axis]
        innovation, variance = project(nav, innovation)
        variance += noise_variance
        if not (math.isfinite(innovation) and variance > 0.0):
            counts[instrument, REJECTED] += 1
            return False
        nav.innovations[INNOVATION_AT[instrument] + axis] = innovation / math.sqrt(variance)
        worst = max(worst, innovation * innovation / variance)
        excess = max(excess, innovation * innovation - variance)
    if worst > sensors.gate:
        counts[instrument, REJECTED] += 1
        counts[instrument, RUN] += 1
        if counts[instrument, RUN] < WIDEN_AFTER[instrument]:
            return False
        for axis in range(2):
            nav.covariance[axis, axis] += excess
        counts[instrument, WIDENED] += 1
    counts[instrument, USED] += 1
    counts[instrument, RUN] = 0
    for axis in range(2):
        innovation = nav.readings[reading + axis] - lever_row(nav, sensors, place, axis)
        if biased:
            nav.scratch[ROW, GPS_BIAS + axis] = 1.0
            innovation -= x[GPS_BIAS + 1 + axis]
        innovation, variance = project(nav, innovation)
        absorb(nav, innovation, variance + noise_variance)
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
    local[0], local[1], local[2] = rotate_back(turned, angle[0], angle[1], angle[2])
    turn(x[QUATERNION : QUATERNION + 4], local)
    for i in range(ERROR):
        error[i] = 0.0
    matrix_of(x[QUATERNION : QUATERNION + 4], turned)
