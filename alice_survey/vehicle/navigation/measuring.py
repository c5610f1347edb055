"""Readings of the instruments from the truth: kernels that write `NavigationState.readings`.

The truth is a vector (13,): position NED, quaternion ned_from_body xyzw, velocity of the body's
origin over ground in NED, body rates.
"""

import math

import numpy as np

from alice_survey.base.frames import Array
from alice_survey.vehicle.compiled import kernel
from alice_survey.vehicle.dynamics import GRAVITY
from alice_survey.vehicle.floor import FloorGrid, floor_range
from alice_survey.vehicle.navigation.sensors import BEAMS, DVL, GPS, IMU, PRESSURE, USBL, Sensors
from alice_survey.vehicle.navigation.state import (
    ACCELEROMETER_BIAS,
    BEAM,
    DEPTH,
    DEPTH_BIAS,
    DEPTH_TIME,
    DVL_ANGLE,
    DVL_BIAS,
    DVL_SCALE,
    DVL_TIME,
    DVL_VELOCITY,
    GPS_BIAS,
    GPS_FIX,
    GPS_TIME,
    GYRO_BIAS,
    HEADING,
    HEADING_BIAS,
    HEADING_TIME,
    PUSH,
    RANGE,
    RATES,
    TRUTH_BEFORE,
    TRUTH_NOW,
    TURN,
    USBL_FIX,
    USBL_TIME,
    WATER_BEAM,
    WATER_TIME,
    WATER_VELOCITY,
    NavigationState,
)
from alice_survey.vehicle.rotations import matrix_of, turn_between


@kernel
def drift(dt_s: float, sensors: Sensors, nav: NavigationState, rng: np.random.Generator) -> None:
    """Advance the instruments' biases by a tick: random walks and Gauss-Markov processes."""
    hidden, root = nav.hidden, math.sqrt(dt_s)
    for i in range(3):
        hidden[i] += sensors.gyro_walk * root * rng.standard_normal()
    for i in range(ACCELEROMETER_BIAS - GYRO_BIAS, ACCELEROMETER_BIAS - GYRO_BIAS + 3):
        hidden[i] += sensors.accelerometer_walk * root * rng.standard_normal()
    _gauss_markov(
        hidden, HEADING_BIAS - GYRO_BIAS, dt_s / sensors.compass_bias_s,
        sensors.compass_bias_sigma, rng,
    )  # fmt: skip
    _gauss_markov(
        hidden, DEPTH_BIAS - GYRO_BIAS, dt_s / sensors.pressure_bias_s,
        sensors.pressure_bias_sigma, rng,
    )  # fmt: skip
    for i in range(GPS_BIAS - GYRO_BIAS, GPS_BIAS - GYRO_BIAS + 2):
        _gauss_markov(hidden, i, dt_s / sensors.gps_bias_s, sensors.gps_bias_sigma, rng)


@kernel
def _gauss_markov(
    values: Array, i: int, steps: float, sigma: float, rng: np.random.Generator
) -> None:
    """Advance one value by a part of its correlation time."""
    kept = math.exp(-steps)
    values[i] = kept * values[i] + sigma * math.sqrt(1.0 - kept * kept) * rng.standard_normal()


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
    a, b = nav.turns[TRUTH_BEFORE], nav.turns[TRUTH_NOW]
    matrix_of(before[3:7], a)
    turn_between(before[3:7], now[3:7], readings[TURN : TURN + 3])
    x, y, z = sensors.place[IMU, 0], sensors.place[IMU, 1], sensors.place[IMU, 2]
    p, q, r = before[10], before[11], before[12]
    a0, a1, a2 = q * z - r * y, r * x - p * z, p * y - q * x
    p, q, r = now[10], now[11], now[12]
    b0, b1, b2 = q * z - r * y, r * x - p * z, p * y - q * x
    d0 = now[7] - before[7] + _row(b, 0, b0, b1, b2) - _row(a, 0, a0, a1, a2)
    d1 = now[8] - before[8] + _row(b, 1, b0, b1, b2) - _row(a, 1, a0, a1, a2)
    d2 = now[9] - before[9] + _row(b, 2, b0, b1, b2) - _row(a, 2, a0, a1, a2) - GRAVITY * dt_s
    root = math.sqrt(dt_s)
    for i in range(3):
        noise = sensors.gyro_noise * root * rng.standard_normal()
        readings[TURN + i] += hidden[i] * dt_s + noise
        readings[RATES + i] = now[10 + i] + hidden[i] + noise / dt_s
        readings[PUSH + i] = (
            a[0, i] * d0
            + a[1, i] * d1
            + a[2, i] * d2
            + hidden[3 + i] * dt_s
            + sensors.accelerometer_noise * root * rng.standard_normal()
        )


@kernel
def _row(matrix: Array, i: int, x: float, y: float, z: float) -> float:
    return float(matrix[i, 0] * x + matrix[i, 1] * y + matrix[i, 2] * z)


@kernel
def measure_rates(
    dt_s: float, now: Array, sensors: Sensors, nav: NavigationState, rng: np.random.Generator
) -> None:
    """The rates alone: before the first tick there is no increment."""
    noise = sensors.gyro_noise / math.sqrt(dt_s)
    for i in range(3):
        nav.readings[RATES + i] = now[10 + i] + nav.hidden[i] + noise * rng.standard_normal()


@kernel
def measure_heading(
    time_s: float, sensors: Sensors, nav: NavigationState, rng: np.random.Generator
) -> None:
    """Heading of the compass, radians."""
    turn = nav.turns[TRUTH_NOW]
    nav.readings[HEADING] = (
        math.atan2(turn[1, 0], turn[0, 0])
        + nav.hidden[HEADING_BIAS - GYRO_BIAS]
        + sensors.compass_noise * rng.standard_normal()
    )
    nav.readings[HEADING_TIME] = time_s


@kernel
def measure_depth(
    time_s: float, now: Array, sensors: Sensors, nav: NavigationState, rng: np.random.Generator
) -> None:
    """Depth of the pressure sensor, metres."""
    place = sensors.place[PRESSURE]
    nav.readings[DEPTH] = (
        now[2]
        + _row(nav.turns[TRUTH_NOW], 2, place[0], place[1], place[2])
        + nav.hidden[DEPTH_BIAS - GYRO_BIAS]
        + sensors.pressure_noise * rng.standard_normal()
    )
    nav.readings[DEPTH_TIME] = time_s


@kernel
def measure_gps(
    time_s: float, now: Array, sensors: Sensors, nav: NavigationState, rng: np.random.Generator
) -> bool:
    """North and east of the antenna, if it is out of the water; whether it was."""
    if now[2] > sensors.gps_most_depth:
        return False
    place, turn = sensors.place[GPS], nav.turns[TRUTH_NOW]
    for i in range(2):
        nav.readings[GPS_FIX + i] = (
            now[i]
            + _row(turn, i, place[0], place[1], place[2])
            + nav.hidden[GPS_BIAS - GYRO_BIAS + i]
            + sensors.gps_noise * rng.standard_normal()
        )
    nav.readings[GPS_TIME] = time_s
    return True


@kernel
def usbl_sigma(sensors: Sensors, north_m: float, east_m: float, depth_m: float) -> float:
    """Standard deviation of north and of east of a transponder's fix, by its slant range."""
    a, b = north_m - sensors.boat_north, east_m - sensors.boat_east
    c = depth_m - sensors.boat_depth
    noise, slope = sensors.usbl_noise, sensors.usbl_noise_fraction
    return math.sqrt(noise * noise + slope * slope * (a * a + b * b + c * c))


@kernel
def measure_usbl(
    time_s: float, now: Array, sensors: Sensors, nav: NavigationState, rng: np.random.Generator
) -> bool:
    """North and east of the transponder; whether there was an answer."""
    place, turn = sensors.place[USBL], nav.turns[TRUTH_NOW]
    north = now[0] + _row(turn, 0, place[0], place[1], place[2])
    east = now[1] + _row(turn, 1, place[0], place[1], place[2])
    depth = now[2] + _row(turn, 2, place[0], place[1], place[2])
    a, b = north - sensors.boat_north, east - sensors.boat_east
    c = depth - sensors.boat_depth
    # A transponder that breaks the surface is not received.
    if depth <= 0.0 or math.sqrt(a * a + b * b + c * c) > sensors.usbl_most_range:
        return False
    sigma = usbl_sigma(sensors, north, east, depth)
    wrong = rng.random() < sensors.usbl_outlier_probability
    for i in range(2):
        value = (north if i == 0 else east) + sigma * rng.standard_normal()
        if wrong:
            value += sensors.usbl_outlier * (2.0 * rng.random() - 1.0)
        nav.readings[USBL_FIX + i] = value
    nav.readings[USBL_TIME] = time_s
    return True


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
    readings, turn = nav.readings, nav.turns[TRUTH_NOW]
    for i in range(RANGE, WATER_VELOCITY + 3):
        readings[i] = math.nan
    readings[DVL_TIME] = time_s
    for i in range(sensors.dropouts_s.shape[0]):
        if sensors.dropouts_s[i, 0] <= time_s < sensors.dropouts_s[i, 1]:
            return
    if turn[2, 2] < sensors.least_cos_tilt or rng.random() < sensors.ping_loss:
        return
    x, y, z = sensors.place[DVL, 0], sensors.place[DVL, 1], sensors.place[DVL, 2]
    p, q, r = now[10], now[11], now[12]
    spin0, spin1, spin2 = q * z - r * y, r * x - p * z, p * y - q * x
    north = now[0] + _row(turn, 0, x, y, z)
    east = now[1] + _row(turn, 1, x, y, z)
    depth = now[2] + _row(turn, 2, x, y, z)
    u = turn[0, 0] * now[7] + turn[1, 0] * now[8] + turn[2, 0] * now[9] + spin0
    v = turn[0, 1] * now[7] + turn[1, 1] * now[8] + turn[2, 1] * now[9] + spin1
    w = turn[0, 2] * now[7] + turn[1, 2] * now[8] + turn[2, 2] * now[9] + spin2
    sigma = sensors.beam_noise + sensors.beam_noise_per_speed * math.sqrt(u * u + v * v + w * w)
    heard, clearance = 0, math.inf
    for i in range(BEAMS):
        b0, b1, b2 = sensors.beams[i, 0], sensors.beams[i, 1], sensors.beams[i, 2]
        down = _row(turn, 2, b0, b1, b2)
        reach = floor_range(
            floor, north, east, depth, _row(turn, 0, b0, b1, b2), _row(turn, 1, b0, b1, b2), down,
            sensors.most_range,
        )  # fmt: skip
        if not math.isfinite(reach):
            continue
        clearance = min(clearance, reach * down)
        if reach < sensors.least_range or rng.random() < sensors.beam_loss:
            continue
        heard += 1
        slope = sensors.range_noise_fraction * reach
        noise = math.sqrt(sensors.range_noise * sensors.range_noise + slope * slope)
        readings[RANGE + i] = reach + noise * rng.standard_normal()
        readings[BEAM + i] = (
            _along_beam(sensors, nav.hidden, i, u, v, w) + sigma * rng.standard_normal()
        )
        if rng.random() < sensors.dvl_outlier_probability:
            readings[BEAM + i] = sensors.dvl_outlier * (2.0 * rng.random() - 1.0)
            readings[RANGE + i] *= rng.random()
    solve_beams(sensors.beams, readings[BEAM : BEAM + 4], readings[DVL_VELOCITY : DVL_VELOCITY + 3])
    if sensors.water_every == 0 or (heard > 0 and ping % sensors.water_every != 0):
        return
    if clearance < sensors.water_least_altitude:
        return
    # Relative to the water: its velocity is taken off in NED before it is turned.
    n, e = now[7] - water_ned[0], now[8] - water_ned[1]
    u = turn[0, 0] * n + turn[1, 0] * e + turn[2, 0] * now[9] + spin0
    v = turn[0, 1] * n + turn[1, 1] * e + turn[2, 1] * now[9] + spin1
    w = turn[0, 2] * n + turn[1, 2] * e + turn[2, 2] * now[9] + spin2
    for i in range(BEAMS):
        readings[WATER_BEAM + i] = (
            _along_beam(sensors, nav.hidden, i, u, v, w)
            + sensors.water_noise * rng.standard_normal()
        )
    solve_beams(
        sensors.beams,
        readings[WATER_BEAM : WATER_BEAM + 4],
        readings[WATER_VELOCITY : WATER_VELOCITY + 3],
    )
    readings[WATER_TIME] = time_s


@kernel
def _along_beam(sensors: Sensors, hidden: Array, i: int, u: float, v: float, w: float) -> float:
    """Velocity along a beam with the instrument's constant errors."""
    angle = hidden[DVL_ANGLE - GYRO_BIAS]
    scale = 1.0 + hidden[DVL_SCALE - GYRO_BIAS]
    c, s = math.cos(angle), math.sin(angle)
    b = sensors.beams
    return float(
        b[i, 0] * (scale * (c * u + s * v) + hidden[DVL_BIAS - GYRO_BIAS])
        + b[i, 1] * (scale * (c * v - s * u) + hidden[DVL_BIAS - GYRO_BIAS + 1])
        + b[i, 2] * scale * w
    )


@kernel
def solve_beams(beams: Array, along: Array, out: Array) -> None:
    """Velocity, (3,), that four beams give by least squares, or three; NaN from fewer.

    Opposite beams of a Janus arrangement add up to the same as the other two, which gives back a
    beam that is missing.
    """
    missing, which = 0, 0
    for i in range(BEAMS):
        if not math.isfinite(along[i]):
            missing, which = missing + 1, i
    if missing > 1:
        out[0] = out[1] = out[2] = math.nan
        return
    given = along[which]
    if missing == 1:
        given = along[(which + 1) % 4] + along[(which + 3) % 4] - along[(which + 2) % 4]
    for axis in range(3):
        total = square = 0.0
        for i in range(BEAMS):
            total += beams[i, axis] * (given if i == which else along[i])
            square += beams[i, axis] * beams[i, axis]
        out[axis] = total / square
