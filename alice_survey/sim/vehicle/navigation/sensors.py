"""Navigation instruments of the vehicle, and the accuracy of each.

Values are those of instruments a SPARUS II carries or could: an AHRS of the Xsens MTi-300 class, a
DVL of the 600 kHz to 1 MHz Janus class, a strain-gauge pressure sensor, a GPS receiver, and an
ultra-short-baseline transponder of the SeaTrac class. Read: the MTi-300 leaflet (Movella 2023:
gyroscope 0.01 deg/s/sqrt(Hz) and 10 deg/h in run, accelerometer 60 ug/sqrt(Hz) and 15 ug in run,
roll and pitch 0.2 deg, heading 1 deg rms); the MTi user manual (GPS/INS 1.0 m horizontally); Sea-
Bird application note 27Druck (0.1 % of full scale); VideoRay on the Nortek DVL (75 m); a maker's
thread on the Water Linked A50 (0.1 to 1 % in the long run). Other numbers are marked inferred.

Positions are those of the SPARUS II scenario of Stonefish, x from the vertical thruster, as all
positions on the body here.

Not simulated: the Earth's rotation (0.004 deg/s, hidden in the gyroscope's bias), sensors' latency,
and a compass error that varies with heading.
"""

import math
from typing import NamedTuple

import numpy as np

from alice_survey.core.compiled import columns
from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.sea import GRAVITY
from alice_survey.sim.vehicle.vehicle import POINT, Hull

Place = tuple[float, float, float]

IMU, DVL, PRESSURE, GPS, USBL, FOLLOWED = columns(6)
"""Rows of `Sensors.place`."""
BEAMS = 4


class ImuSpec(NamedTuple):
    """Gyroscopes and accelerometers, read as increments over each tick.

    White noise is given by its random walk, a bias by its value at the start and its own walk.
    """

    position_body_m: Place = (0.364, -0.021, -0.085)
    gyro_noise_rad_per_sqrt_s: float = math.radians(0.01)
    gyro_bias_sigma_radps: float = math.radians(0.01)
    """At the start, after a rest on deck (inferred)."""
    gyro_bias_walk_radps_per_sqrt_s: float = math.radians(10.0 / 3600.0) / 60.0
    """Reaches the stability in run after an hour (inferred)."""
    accelerometer_noise_mps_per_sqrt_s: float = 60e-6 * GRAVITY
    accelerometer_bias_sigma_mps2: float = GRAVITY * math.radians(0.2)
    """Equivalent of the accuracy of roll and pitch at rest (inferred)."""
    accelerometer_bias_walk_mps2_per_sqrt_s: float = 15e-6 * GRAVITY / 60.0
    tilt_sigma_rad: float = math.radians(0.2)
    """Sigma of roll and of pitch at the start."""


class CompassSpec(NamedTuple):
    """Heading of the AHRS: a slowly varying bias and white noise."""

    rate_hz: float = 10.0
    noise_rad: float = math.radians(0.3)
    """Inferred."""
    bias_sigma_rad: float = math.radians(1.0)
    bias_correlation_s: float = 3600.0
    """Inferred."""


class DvlSpec(NamedTuple):
    """A Doppler velocity log with four beams in Janus arrangement, 45 degrees off the bow."""

    position_body_m: Place = (-0.4145, 0.0, 0.11)
    rate_hz: float = 5.0
    beam_angle_rad: float = math.radians(30.0)
    beam_noise_mps: float = 0.0035
    """Noise of a ping along a beam at rest: 5 mm/s horizontally (inferred)."""
    beam_noise_per_speed: float = 0.002
    """Noise added, as a share of the speed over ground (inferred)."""
    scale_sigma: float = 0.002
    """Constant scale error: the speed of sound and the beams' angle."""
    bias_sigma_mps: float = 0.001
    """Constant bias of surge and of sway (inferred)."""
    misalignment_sigma_rad: float = math.radians(0.2)
    """Constant misalignment about the vertical, after calibration (inferred)."""
    range_noise_m: float = 0.02
    range_noise_fraction: float = 0.003
    """Added in squares, of the range (both inferred)."""
    min_range_m: float = 0.2
    """Inferred."""
    max_range_m: float = 75.0
    max_tilt_rad: float = math.radians(25.0)
    """Greatest tilt of the instrument's axis from the vertical (inferred)."""
    ping_loss: float = 0.01
    beam_loss: float = 0.01
    """Probabilities of no echo (inferred)."""
    outlier_probability: float = 0.001
    """Probability that a beam receives another echo, of a fish or a second one (inferred)."""
    outlier_mps: float = 2.0
    """Half width of the reading it then gives."""
    water_every: int = 5
    """Interval, in pings, of water tracking; 0: never. Without bottom lock all pings do it."""
    water_noise_mps: float = 0.01
    """Noise along a beam (inferred)."""
    water_least_altitude_m: float = 6.0
    """The layer must lie clear of the bottom's echo (inferred)."""


class PressureSpec(NamedTuple):
    """Depth from pressure, set to zero at the surface."""

    position_body_m: Place = (0.387, 0.0, -0.033)
    rate_hz: float = 10.0
    noise_m: float = 0.01
    """Inferred."""
    bias_sigma_m: float = 0.05
    """A quarter of 0.1 % of 200 m: what the surface does not take away (inferred)."""
    bias_correlation_s: float = 3600.0
    """Inferred."""


class GpsSpec(NamedTuple):
    """Position while the antenna is above water: a slowly varying bias and white noise."""

    position_body_m: Place = (-0.39, 0.0, -0.36)
    rate_hz: float = 1.0
    noise_m: float = 0.3
    """Inferred."""
    bias_sigma_m: float = 1.0
    bias_correlation_s: float = 600.0
    """Inferred."""
    max_depth_m: float = 0.3
    """Greatest depth of the body's origin with a fix."""


class UsblSpec(NamedTuple):
    """Horizontal position by an acoustic transceiver under a boat; off unless it has a rate."""

    position_body_m: Place = (-0.39, 0.0, -0.25)
    """Position of the transponder, on the mast (inferred)."""
    rate_hz: float = 0.0
    boat_ned_m: Place = (0.0, 0.0, 1.0)
    """Position of the transceiver."""
    noise_m: float = 0.5
    """Noise of the boat's own position (inferred)."""
    noise_fraction: float = 0.0175
    """Added in squares, as a share of the slant range: 1 degree (SeaTrac class, inferred)."""
    outlier_probability: float = 0.05
    """Inferred."""
    outlier_m: float = 20.0
    """Half width of an echo's place about the true one (inferred)."""
    max_range_m: float = 1000.0


class Sensors(NamedTuple):
    """The suite as compiled code sees it; `every` counts ticks, 0 is never."""

    imu: ImuSpec
    compass: CompassSpec
    dvl: DvlSpec
    pressure: PressureSpec
    gps: GpsSpec
    usbl: UsblSpec
    tick_s: float
    place: Array
    """(6, 3) positions of the instruments and of the followed point on the body."""
    low: Array
    """(P + 2, 3) points whose clearance is computed: of the hull, the DVL, the followed one."""
    beams: Array
    """(4, 3) unit vectors in the body frame."""
    dropouts_s: Array
    """(K, 2)"""
    bottom_dropouts_s: Array
    """(K, 2)"""
    min_cos_tilt: float
    compass_every: int
    pressure_every: int
    dvl_every: int
    gps_every: int
    usbl_every: int
    current_sigma_mps: float
    current_correlation_s: float
    gate: float
    """Square of the sigmas beyond which a measurement is not used."""
    altitude_age_s: float


class SensorSuite(NamedTuple):
    """All instruments, and the filter's settings for them."""

    imu: ImuSpec = ImuSpec()
    compass: CompassSpec = CompassSpec()
    dvl: DvlSpec = DvlSpec()
    pressure: PressureSpec = PressureSpec()
    gps: GpsSpec = GpsSpec()
    usbl: UsblSpec = UsblSpec()
    dvl_dropouts_s: tuple[tuple[float, float], ...] = ()
    """Times (from, to) without any echo of the DVL."""
    bottom_dropouts_s: tuple[tuple[float, float], ...] = ()
    """Times without an echo of the bottom; the water's is tracked."""
    current_sigma_mps: float = 0.3
    """Sigma of north and of east each: the filter's prior of currents, a Gauss-Markov process."""
    current_correlation_s: float = 3600.0
    gate_sigmas: float = 5.0
    """A measurement farther from its prediction is not used; by chance 1 in 1.7 million is."""
    followed_body_m: Place = (0.55, -0.05, 0.08)
    """The point whose altitude is reported: the left port's outer glass."""
    altitude_age_s: float = 2.0
    """An altitude whose last ping is older is not reported."""

    def pack(self, hull: Hull = POINT, tick_s: float = 0.05) -> Sensors:
        """For compiled code.

        Args:
            hull: hull of the vehicle that carries them.
            tick_s: time between calls of the navigation.

        Raises:
            VehicleError: a drop-out ends before it begins.
        """
        imu, compass, dvl, pressure, gps, usbl = self[:6]
        for start, end in (*self.dvl_dropouts_s, *self.bottom_dropouts_s):
            if not start < end:
                raise VehicleError(f"a DVL drop-out from {start:g} s to {end:g} s ends too early")
        places = [kind.position_body_m for kind in (imu, dvl, pressure, gps, usbl)]
        return Sensors(
            *self[:6],
            tick_s=tick_s,
            place=np.array([*places, self.followed_body_m], dtype=np.float64),
            low=np.vstack([hull.points_body_m, dvl.position_body_m, self.followed_body_m]),
            beams=janus_beams(dvl.beam_angle_rad),
            dropouts_s=np.array(self.dvl_dropouts_s, dtype=np.float64).reshape(-1, 2),
            bottom_dropouts_s=np.array(self.bottom_dropouts_s, dtype=np.float64).reshape(-1, 2),
            min_cos_tilt=math.cos(dvl.max_tilt_rad),
            compass_every=_ticks(compass.rate_hz, tick_s),
            pressure_every=_ticks(pressure.rate_hz, tick_s),
            dvl_every=_ticks(dvl.rate_hz, tick_s),
            gps_every=_ticks(gps.rate_hz, tick_s),
            usbl_every=_ticks(usbl.rate_hz, tick_s),
            current_sigma_mps=self.current_sigma_mps,
            current_correlation_s=self.current_correlation_s,
            gate=self.gate_sigmas**2,
            altitude_age_s=self.altitude_age_s,
        )


def janus_beams(angle_rad: float) -> Array:
    """Directions, (4, 3), of beams at an angle to the vertical, 45, 135, 225, 315 deg off the bow.

    Opposite beams are 0 and 2, 1 and 3.
    """
    azimuth = np.deg2rad([45.0, 135.0, 225.0, 315.0])
    return np.column_stack(
        [
            math.sin(angle_rad) * np.cos(azimuth),
            math.sin(angle_rad) * np.sin(azimuth),
            np.full(BEAMS, math.cos(angle_rad)),
        ]
    )


def beam_velocity(beams: Array, along: Array) -> Array:
    """Velocity, (3,), of the speeds along four beams, or of three where one is NaN; else NaN."""
    heard = np.isfinite(along)
    if heard.sum() < 3:
        return np.full(3, np.nan)
    return np.asarray(np.linalg.lstsq(beams[heard], along[heard])[0], np.float64)


def _ticks(rate_hz: float, tick_s: float) -> int:
    """Ticks between measurements, of a rate that the ticks' is a multiple of; 0 at no rate."""
    return round(1.0 / (rate_hz * tick_s)) if rate_hz else 0
