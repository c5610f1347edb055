"""State that the navigation keeps from tick to tick, its layout, and its start."""

import math
from typing import NamedTuple

import numpy as np

from alice_survey.base.errors import VehicleError
from alice_survey.base.frames import Array
from alice_survey.vehicle.estimate_vector import ESTIMATE
from alice_survey.vehicle.navigation.sensors import IMU, Sensors

POSITION, VELOCITY, ATTITUDE, GYRO_BIAS, ACCELEROMETER_BIAS = 0, 3, 6, 9, 12
HEADING_BIAS, DEPTH_BIAS, DVL_SCALE, DVL_ANGLE, DVL_BIAS, GPS_BIAS, WATER = (
    15, 16, 17, 18, 19, 21, 23,
)  # fmt: skip
"""Offsets in the error state (25,): position of the IMU in NED, its velocity over
ground in the body frame with the DVL's scale error in it, its attitude about the axes of NED, its
biases, then the compass's, the depth's, scale and misalignment of the DVL, its bias of surge and
sway, the GPS's bias of north and east, the current."""
ERROR = 25
QUATERNION = 6
NOMINAL = ERROR + 1
"""Length of the nominal state: as the error state, with a quaternion (4) for the attitude (3), so
that what follows the attitude is one place further on."""
HIDDEN = WATER - GYRO_BIAS
"""Number of true errors of the instruments; error `GYRO_BIAS + i` estimates `hidden[i]`."""

TURN, PUSH, RATES, HEADING, DEPTH, RANGE, BEAM, WATER_BEAM = 0, 3, 6, 9, 10, 11, 15, 19
DVL_VELOCITY, WATER_VELOCITY, GPS_FIX, USBL_FIX = 23, 26, 29, 31
HEADING_TIME, DEPTH_TIME, DVL_TIME, WATER_TIME, GPS_TIME, USBL_TIME = 33, 34, 35, 36, 37, 38
"""Offsets of each instrument's latest reading in `readings`, and its time:
increments of angle (3) and velocity (3) over the tick, rates (3), heading, depth, ranges (4) and
velocities (4) along the beams, velocities through the water (4), bottom and water velocity in the
body frame at the DVL (3 each), north and east of the GPS antenna and of the transponder (2 each).
NaN where nothing was measured."""
READINGS = 39

COMPASS_USE, DEPTH_USE, DVL_USE, WATER_USE, GPS_USE, USBL_USE = 0, 1, 2, 3, 4, 5
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

    Raises:
        VehicleError: truth is not a finite state.
    """
    from scipy.spatial.transform import Rotation

    from alice_survey.base.frames import rotation_from_attitude

    if truth.shape != (13,) or not np.all(np.isfinite(truth)):
        raise VehicleError("navigation begins at a state that is no finite (13,) vector")
    covariance = initial_covariance(sensors)
    hidden_sigma = np.sqrt(np.diag(covariance)[GYRO_BIAS:WATER])
    hidden = hidden_sigma * rng.standard_normal(HIDDEN)
    bias_of = {i: hidden[i - GYRO_BIAS] for i in range(GYRO_BIAS, WATER)}
    attitude = Rotation.from_quat(truth[3:7])
    rates, lever = truth[10:13], sensors.place[IMU]

    nominal = np.zeros(NOMINAL)
    fix_error = np.array([bias_of[GPS_BIAS], bias_of[GPS_BIAS + 1], bias_of[DEPTH_BIAS]])
    fix_noise = np.array([sensors.gps_noise, sensors.gps_noise, sensors.pressure_noise])
    nominal[:3] = truth[:3] + attitude.apply(lever)
    nominal[:3] += fix_error + fix_noise * rng.standard_normal(3)
    nominal[3:6] = attitude.inv().apply(truth[7:10]) + np.cross(rates, lever)
    nominal[3:6] *= 1.0 + bias_of[DVL_SCALE]
    nominal[3:6] += _velocity_sigma(sensors) * rng.standard_normal(3)
    tilt = sensors.tilt_sigma * rng.standard_normal(2)
    turn = bias_of[HEADING_BIAS] + sensors.compass_noise * rng.standard_normal()
    # The compass error is about the vertical, the tilt's about the level axes of the body.
    believed = rotation_from_attitude(0.0, 0.0, turn) * attitude * Rotation.from_rotvec([*tilt, 0])
    nominal[QUATERNION : QUATERNION + 4] = believed.as_quat()
    level = attitude.as_matrix()[:, :2]
    block = slice(ATTITUDE, ATTITUDE + 3)
    covariance[block, block] = sensors.tilt_sigma**2 * level @ level.T
    covariance[ATTITUDE + 2, ATTITUDE + 2] += (
        sensors.compass_bias_sigma**2 + sensors.compass_noise**2
    )
    covariance[ATTITUDE + 2, HEADING_BIAS] = -(sensors.compass_bias_sigma**2)
    covariance[HEADING_BIAS, ATTITUDE + 2] = -(sensors.compass_bias_sigma**2)
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
    sigma[GYRO_BIAS : GYRO_BIAS + 3] = sensors.gyro_bias_sigma
    sigma[ACCELEROMETER_BIAS : ACCELEROMETER_BIAS + 3] = sensors.accelerometer_bias_sigma
    sigma[HEADING_BIAS] = sensors.compass_bias_sigma
    sigma[DEPTH_BIAS] = sensors.pressure_bias_sigma
    sigma[DVL_SCALE], sigma[DVL_ANGLE] = sensors.scale_sigma, sensors.misalignment_sigma
    sigma[DVL_BIAS : DVL_BIAS + 2] = sensors.dvl_bias_sigma
    sigma[GPS_BIAS : GPS_BIAS + 2] = sensors.gps_bias_sigma
    sigma[WATER : WATER + 2] = sensors.water_sigma
    sigma[VELOCITY : VELOCITY + 3] = _velocity_sigma(sensors)
    covariance = np.diag(sigma**2)
    for axis, bias, noise in (
        (POSITION, GPS_BIAS, sensors.gps_noise),
        (POSITION + 1, GPS_BIAS + 1, sensors.gps_noise),
        (POSITION + 2, DEPTH_BIAS, sensors.pressure_noise),
    ):
        covariance[axis, axis] = covariance[bias, bias] + noise**2
        covariance[axis, bias] = covariance[bias, axis] = -covariance[bias, bias]
    return covariance


def _velocity_sigma(sensors: Sensors) -> float:
    """Velocity sigma of each axis at the start: at rest, known to a few of the DVL's pings."""
    return 2.0 * sensors.beam_noise + sensors.dvl_bias_sigma
