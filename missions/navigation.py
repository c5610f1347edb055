"""What the vehicle believes of where it is: the navigation log of a simulated flight.

Errors are those of a dead-reckoning vehicle: a position bias drawn once (the fix at the start) and
a random walk (the DVL), a heading bias drawn once, white noise on depth, attitude and altitude. The
logged sigmas are what these errors have at each moment, so that the log can be weighed by them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from alice_survey.artefacts import write_csv
from alice_survey.config import CameraConfig, FlightConfig
from alice_survey.frames import Array, Datum, attitude_from_rotation, rotation_from_attitude
from alice_survey.trajectory import Trajectory
from missions.track import SeaFloor, depth_clamped

NAVIGATION_COLUMNS = (
    "time_s", "latitude_deg", "longitude_deg", "depth_m", "roll_deg", "pitch_deg", "heading_deg",
    "altitude_m", "sigma_horizontal_m", "sigma_depth_m", "sigma_attitude_deg", "sigma_heading_deg",
    "sigma_altitude_m",
)  # fmt: skip

_BEAM_ANGLE_RAD = math.radians(30.0)
"""Of each of a DVL's four beams from its axis."""
_BEAM_STEPS = 20
_SMALLEST_SIGMA = 1e-6
"""So that a log of no errors still has weights."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NavigationLog:
    """Believed position and attitude of the body origin, and altitude of the left port's glass.

    All (T,) but `position_ned`, (T, 3).
    """

    time_s: Array
    position_ned: Array
    attitude_rad: Array
    """(T, 3) roll, pitch, heading."""
    altitude_m: Array
    sigma_horizontal_m: Array
    """Of north and of east each."""
    sigma_depth_m: float
    sigma_attitude_rad: float
    """Of roll and of pitch each."""
    sigma_heading_rad: float
    sigma_altitude_m: float


def navigate(
    truth: Trajectory,
    errors: FlightConfig,
    floor: SeaFloor,
    camera: CameraConfig,
    rng: np.random.Generator,
) -> NavigationLog:
    """The log that a vehicle on a true track would write.

    Args:
        truth: of the body origin, at a constant rate.
        errors: of the sensors.
        floor: what the DVL hears.
        camera: where the left port and the DVL are on the body.
        rng: where the errors come from.
    """
    count = len(truth.time_s)
    bias_ne = errors.position_bias_sigma_m * rng.standard_normal(2)
    steps_s = np.diff(truth.time_s, prepend=truth.time_s[0])
    walk = np.cumsum(np.sqrt(steps_s)[:, None] * rng.standard_normal((count, 2)), axis=0)
    depth_error = errors.depth_noise_m * rng.standard_normal(count)
    offsets = np.column_stack(
        [bias_ne + errors.position_walk_m_per_sqrt_s * walk, depth_error[:, None]]
    )
    attitude_sigma = math.radians(errors.attitude_noise_deg)
    heading_bias = math.radians(errors.heading_bias_sigma_deg) * rng.standard_normal()
    attitude = attitude_from_rotation(truth.ned_from_body.rotation)
    attitude = attitude + attitude_sigma * rng.standard_normal((count, 3))
    attitude[:, 2] += heading_bias
    believed = rotation_from_attitude(*attitude.T)
    altitude, spread_m = dvl_altitude(truth, believed, floor, camera)
    lever = np.subtract(camera.dvl_position_body_m, camera.position_body_m)
    elapsed_s = truth.time_s - truth.time_s[0]
    return NavigationLog(
        time_s=truth.time_s,
        position_ned=truth.ned_from_body.translation + offsets,
        attitude_rad=attitude,
        altitude_m=altitude + errors.altitude_noise_m * rng.standard_normal(count),
        sigma_horizontal_m=np.sqrt(
            errors.position_bias_sigma_m**2
            + errors.position_walk_m_per_sqrt_s**2 * elapsed_s
            + _SMALLEST_SIGMA**2
        ),
        sigma_depth_m=max(errors.depth_noise_m, _SMALLEST_SIGMA),
        sigma_attitude_rad=max(attitude_sigma, _SMALLEST_SIGMA),
        sigma_heading_rad=max(
            math.hypot(attitude_sigma, math.radians(errors.heading_bias_sigma_deg)),
            _SMALLEST_SIGMA,
        ),
        sigma_altitude_m=math.sqrt(
            errors.altitude_noise_m**2
            + spread_m**2
            + (attitude_sigma * math.hypot(lever[0], lever[1])) ** 2
            + _SMALLEST_SIGMA**2
        ),
    )


def dvl_altitude(
    truth: Trajectory, believed: Rotation, floor: SeaFloor, camera: CameraConfig
) -> tuple[Array, float]:
    """Altitude of the left port's outer glass as four slanted beams at the DVL give it.

    Each range is brought to the vertical by the believed attitude; the mean is moved from the DVL
    to the port by the lever arm. Over relief the sea floor below the port is not the beams' mean:
    the spread of the beams, as far apart as DVL and port are, says by how much.

    Args:
        truth: of the body origin.
        believed: (T,) attitude as measured.
        floor: the true sea floor.
        camera: where the left port and the DVL are on the body.

    Returns:
        (T,) metres, and the standard deviation of a point of the floor about the beams' mean.
    """
    azimuths = np.deg2rad([45.0, 135.0, 225.0, 315.0])
    beams_body = np.column_stack(
        [
            math.sin(_BEAM_ANGLE_RAD) * np.cos(azimuths),
            math.sin(_BEAM_ANGLE_RAD) * np.sin(azimuths),
            np.full(4, math.cos(_BEAM_ANGLE_RAD)),
        ]
    )
    dvl_ned = truth.ned_from_body.apply(np.asarray(camera.dvl_position_body_m))
    vertical = []
    for beam in beams_body:
        ranges_m = beam_ranges(floor, dvl_ned, truth.ned_from_body.rotation.apply(beam))
        vertical.append(ranges_m * believed.apply(beam)[:, 2])
    heights = np.stack(vertical, axis=1)
    lever = np.subtract(camera.dvl_position_body_m, camera.position_body_m)
    altitude: Array = heights.mean(axis=1) + believed.apply(lever)[:, 2]
    # Of a fifth draw about the mean of four: variance 1 + 1/4.
    spread_m = math.sqrt(1.25 * float(heights.var(axis=1, ddof=1).mean()))
    return altitude, spread_m


def beam_ranges(floor: SeaFloor, origin_ned: Array, beam_ned: Array) -> Array:
    """Range, (T,), along beams to the sea floor, by bisection between level floors.

    Args:
        floor: the true sea floor.
        origin_ned: (T, 3) where the beams start, above the sea floor.
        beam_ned: (T, 3) unit directions that descend.
    """
    below = depth_clamped(floor, origin_ned[:, :2]) - origin_ned[:, 2]
    near, far = np.zeros_like(below), 2.0 * below / beam_ned[:, 2]
    for _ in range(_BEAM_STEPS):
        middle = (near + far) / 2
        points = origin_ned + middle[:, None] * beam_ned
        wet = points[:, 2] < depth_clamped(floor, points[:, :2])
        near, far = np.where(wet, middle, near), np.where(wet, far, middle)
    ranges: Array = (near + far) / 2
    return ranges


def write_navigation(path: Path, log: NavigationLog, datum: Datum) -> None:
    """Write `navigation.csv`; positions in latitude and longitude to 0.01 mm."""
    geodetic = datum.geodetic_from_ned(log.position_ned)
    roll, pitch, heading = np.rad2deg(log.attitude_rad).T
    constants = [
        f"{log.sigma_depth_m:.6f}",
        f"{math.degrees(log.sigma_attitude_rad):.6f}",
        f"{math.degrees(log.sigma_heading_rad):.6f}",
        f"{log.sigma_altitude_m:.6f}",
    ]
    columns: Sequence[tuple[Array, int]] = (
        (log.time_s, 6),
        (geodetic[:, 0], 10),
        (geodetic[:, 1], 10),
        (log.position_ned[:, 2], 5),
        (roll, 6),
        (pitch, 6),
        (heading % 360.0, 6),
        (log.altitude_m, 5),
        (log.sigma_horizontal_m, 6),
    )
    rows = zip(*(_texts(values, decimals) for values, decimals in columns), strict=True)
    write_csv(path, NAVIGATION_COLUMNS, ([*row, *constants] for row in rows))


def _texts(values: Array, decimals: int) -> list[str]:
    return [f"{value:.{decimals}f}" for value in values.tolist()]
