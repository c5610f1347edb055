"""The navigation filter a second time, slow and dense: no closed-form Jacobian, no structure.

Everything is derived by central differences from three functions that say how the true state
moves and what the instruments read; attitudes are scipy's. Only the choices that are the filter's
own are shared: what is a state, that the DVL's scale acts on the growth of position alone and is
considered, and how its effect on accelerations counts as noise.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.navigation.sensors import DVL, GPS, IMU, PRESSURE, USBL, Sensors

GRAVITY = np.array([0.0, 0.0, 9.80665])
SCALE = 17
MANOEUVRE_S = 5.0


@dataclass(frozen=True)
class Belief:
    """Position of the IMU, scaled velocity in the body frame, attitude, and 16 more numbers."""

    position: Array
    velocity: Array
    attitude: Rotation
    rest: Array
    """Gyro bias (3), accelerometer bias (3), compass, depth, scale, angle, DVL bias (2), GPS bias
    (2), water (2)."""

    def moved(self, error: Array) -> "Belief":
        """The state with an error: truth = estimate moved by the error, (25,)."""
        return Belief(
            self.position + error[:3],
            self.velocity + error[3:6],
            Rotation.from_rotvec(error[6:9]) * self.attitude,
            self.rest + error[9:],
        )

    def error_of(self, other: "Belief") -> Array:
        """The error, (25,), by which the other is this one moved."""
        turned = (other.attitude * self.attitude.inv()).as_rotvec()
        moved = (other.position - self.position, other.velocity - self.velocity)
        return np.concatenate([*moved, turned, other.rest - self.rest])


def from_nominal(nominal: Array) -> Belief:
    """A belief from the kernel's nominal state, (26,)."""
    attitude = Rotation.from_quat(nominal[6:10])
    return Belief(nominal[:3].copy(), nominal[3:6].copy(), attitude, nominal[10:].copy())


def kept(sensors: Sensors, dt_s: float) -> Array:
    """What a tick leaves of each error, (25,), of those that decay."""
    times = np.full(25, np.inf)
    times[15], times[16] = sensors.compass.bias_correlation_s, sensors.pressure.bias_correlation_s
    times[21:23], times[23:25] = sensors.gps.bias_correlation_s, sensors.current_correlation_s
    return np.exp(-dt_s / times)


def next_state(
    state: Belief, turn: Array, push: Array, noise: Array, sensors: Sensors, dt_s: float
) -> Belief:
    """The state a tick later, by increments with errors of bias and noise (6,)."""
    turned = turn - state.rest[:3] * dt_s - noise[:3]
    pushed = push - state.rest[3:6] * dt_s - noise[3:]
    fall = state.attitude.inv().apply(GRAVITY * dt_s)
    new = state.velocity + pushed + fall
    way = state.attitude.apply(state.velocity + new) * dt_s / 2 * (1 - state.rest[SCALE - 9])
    rotation = Rotation.from_rotvec(turned)
    return Belief(
        state.position + way,
        rotation.inv().apply(new),
        state.attitude * rotation,
        state.rest * kept(sensors, dt_s)[9:],
    )


def jacobian(function: Callable[..., Array], size: int, step: float = 1e-5) -> Array:
    """Central differences about zero."""
    columns = [(function(e) - function(-e)) / (2 * step) for e in step * np.eye(size)]
    return np.stack(columns, axis=1)


def predict(
    belief: Belief, covariance: Array, turn: Array, push: Array, sensors: Sensors, dt_s: float
) -> tuple[Belief, Array, Array]:
    """Belief, covariance and transition (25, 25) of a tick."""
    none = np.zeros(6)
    after = next_state(belief, turn, push, none, sensors, dt_s)
    f = jacobian(
        lambda e: after.error_of(next_state(belief.moved(e), turn, push, none, sensors, dt_s)), 25
    )
    g = jacobian(lambda n: after.error_of(next_state(belief, turn, push, n, sensors, dt_s)), 6)
    gained = push - belief.rest[3:6] * dt_s + belief.attitude.inv().apply(GRAVITY * dt_s)
    covariance = f @ covariance @ f.T
    variance = sensors.imu.accelerometer_noise_mps_per_sqrt_s**2 * dt_s
    variance += covariance[SCALE, SCALE] * gained @ gained * MANOEUVRE_S / dt_s
    q = np.diag([sensors.imu.gyro_noise_rad_per_sqrt_s**2 * dt_s] * 3 + [variance] * 3)
    sigma = np.zeros(25)
    sigma[15], sigma[16] = sensors.compass.bias_sigma_rad, sensors.pressure.bias_sigma_m
    sigma[21:23], sigma[23:25] = sensors.gps.bias_sigma_m, sensors.current_sigma_mps
    covariance = covariance + g @ q @ g.T
    covariance += np.diag(sigma**2 * (1 - kept(sensors, dt_s) ** 2))
    imu, walk = sensors.imu, np.zeros(25)
    walk[9:12] = imu.gyro_bias_walk_radps_per_sqrt_s
    walk[12:15] = imu.accelerometer_bias_walk_mps2_per_sqrt_s
    return after, covariance + np.diag(walk**2 * dt_s), f


def heading(state: Belief) -> float:
    """What the compass reads."""
    return float(state.attitude.as_euler("ZYX")[0] + state.rest[6])


def place(state: Belief, sensors: Sensors, which: int) -> Array:
    """Where an instrument is, NED."""
    lever = sensors.place[which] - sensors.place[IMU]
    return np.asarray(state.position + state.attitude.apply(lever))


def depth(state: Belief, sensors: Sensors) -> float:
    """What the pressure sensor reads."""
    return float(place(state, sensors, PRESSURE)[2] + state.rest[7])


def gps(state: Belief, sensors: Sensors) -> Array:
    """What the GPS reads, north and east."""
    return np.asarray(place(state, sensors, GPS)[:2] + state.rest[12:14])


def usbl(state: Belief, sensors: Sensors) -> Array:
    """Where the boat hears the transponder, north and east."""
    return place(state, sensors, USBL)[:2]


def beams(state: Belief, sensors: Sensors, rates: Array, water: bool) -> Array:
    """Velocities along the four beams."""
    spin = np.cross(rates - state.rest[:3], sensors.place[DVL] - sensors.place[IMU])
    if water:
        spin = spin - state.attitude.inv().apply([*state.rest[14:16], 0.0])
    velocity = state.velocity + (1 + state.rest[SCALE - 9]) * spin
    seen = Rotation.from_euler("Z", state.rest[9]).inv().apply(velocity)
    bias = np.array([*state.rest[10:12], 0.0])
    return np.asarray(sensors.beams @ (seen + bias))


def update(
    belief: Belief,
    covariance: Array,
    measured: Array,
    reading: Callable[[Belief], Array],
    variance: Array,
) -> tuple[Belief, Array]:
    """A dense update in Joseph's form, the scale considered, one number after the other.

    Rows are those of the belief before. All at once gives another filter where a state is
    considered: the second number then knows what the first said of the scale.
    """
    rows = jacobian(lambda e: np.atleast_1d(reading(belief.moved(e))), 25)
    innovations = measured - np.atleast_1d(reading(belief))
    correction = np.zeros(25)
    for h, innovation, r in zip(rows, innovations, variance, strict=True):
        gain = covariance @ h / (h @ covariance @ h + r)
        gain[SCALE] = 0.0
        correction = correction + gain * (innovation - h @ correction)
        rest = np.eye(25) - np.outer(gain, h)
        covariance = rest @ covariance @ rest.T + np.outer(gain, gain) * r
    return belief.moved(correction), covariance
