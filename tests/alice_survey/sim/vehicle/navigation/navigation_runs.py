"""Tracks in closed form, and a compiled loop over them, for the tests of the navigation."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from alice_survey.core.compiled import kernel
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.estimate_vector import ESTIMATE
from alice_survey.sim.vehicle.navigation import filter as nf
from alice_survey.sim.vehicle.navigation.sensors import IMU, Sensors
from alice_survey.sim.vehicle.navigation.tick import LOG_ROW, log_row, navigation_tick
from alice_survey.sim.vehicle.sea import FloorGrid

TICK_S = 0.05


@kernel
def _run(
    dt_s: float,
    truth: Array,
    water: Array,
    floor: FloorGrid,
    sensors: Sensors,
    nav: nf.NavigationState,
    rng: np.random.Generator,
    estimate: Array,
    log: Array,
    innovations: Array,
    every: int,
    nominal: Array,
    hidden: Array,
    covariance: Array,
) -> None:
    for k in range(truth.shape[0]):
        navigation_tick(
            k * dt_s, k, dt_s, truth[max(k - 1, 0)], truth[k], water, floor, sensors, nav, rng,
            estimate[k],
        )  # fmt: skip
        log_row(nav, log[k])
        for j in range(innovations.shape[1]):
            innovations[k, j] = nav.innovations[j]
        if k % every == 0:
            m = k // every
            for j in range(nominal.shape[1]):
                nominal[m, j] = nav.nominal[j]
            for j in range(hidden.shape[1]):
                hidden[m, j] = nav.hidden[j]
            for i in range(covariance.shape[1]):
                for j in range(covariance.shape[2]):
                    covariance[m, i, j] = nav.covariance[i, j]


@dataclass(frozen=True)
class Run:
    """What a run left behind; epochs are some ticks apart."""

    truth: Array
    estimate: Array
    log: Array
    innovations: Array
    nominal: Array
    hidden: Array
    covariance: Array
    water: Array
    nav: nf.NavigationState
    sensors: Sensors
    every: int

    def errors(self) -> Array:
        """(M, 25) truth minus belief at the epochs of the covariance."""
        truth = self.truth[:: self.every]
        attitude = Rotation.from_quat(truth[:, 3:7])
        lever = self.sensors.place[IMU]
        error = np.empty((len(truth), 25))
        error[:, :3] = truth[:, :3] + attitude.apply(lever) - self.nominal[:, :3]
        velocity = attitude.inv().apply(truth[:, 7:10]) + np.cross(truth[:, 10:13], lever)
        error[:, 3:6] = (1 + self.hidden[:, 8:9]) * velocity - self.nominal[:, 3:6]
        believed = Rotation.from_quat(self.nominal[:, 6:10])
        error[:, 6:9] = (attitude * believed.inv()).as_rotvec()
        error[:, nf.GYRO_BIAS : nf.WATER] = (
            self.hidden - self.nominal[:, nf.GYRO_BIAS + 1 : nf.WATER + 1]
        )
        error[:, nf.WATER :] = self.water[:2] - self.nominal[:, nf.WATER + 1 :]
        return error

    def nees(self, states: slice) -> Array:
        """(M,) errors squared over the covariance, of some of the states."""
        error, covariance = self.errors()[:, states], self.covariance[:, states, states]
        weighed = np.linalg.solve(covariance, error[..., None])[..., 0]
        return np.einsum("ij,ij->i", error, weighed)

    def horizontal_error(self) -> Array:
        """(T,) distance of the believed origin from the true one, metres."""
        return np.hypot(*(self.log[:, :2] - self.truth[:, :2]).T)


def fly(
    sensors: Sensors,
    truth: Array,
    floor: FloorGrid,
    seed: int,
    *,
    water: Array | None = None,
    every: int = 100,
    start: nf.NavigationState | None = None,
) -> Run:
    """Navigate a known track; the current is drawn from the filter's own belief if not given."""
    rng = np.random.default_rng(seed)
    drawn = np.array([*(sensors.current_sigma_mps * rng.standard_normal(2)), 0.0])
    water = drawn if water is None else water
    nav = start or nf.new_navigation(sensors, truth[0], rng)
    count = len(truth)
    epochs = (count - 1) // every + 1
    run = Run(
        truth=truth,
        estimate=np.full((count, ESTIMATE), np.nan),
        log=np.full((count, LOG_ROW), np.nan),
        innovations=np.full((count, 14), np.nan),
        nominal=np.full((epochs, 26), np.nan),
        hidden=np.full((epochs, 14), np.nan),
        covariance=np.full((epochs, 25, 25), np.nan),
        water=water,
        nav=nav,
        sensors=sensors,
        every=every,
    )
    _run(
        sensors.tick_s, truth, water, floor, sensors, nav, rng, run.estimate, run.log,
        run.innovations, every, run.nominal, run.hidden, run.covariance,
    )  # fmt: skip
    return run


def track(
    duration_s: float,
    *,
    speed_mps: float = 0.2,
    depth_m: float = 13.0,
    line_m: float = 15.0,
    turn_s: float = 12.0,
    sway: bool = True,
    dt_s: float = TICK_S,
) -> Array:
    """Truth, (T, 13), of a lawnmower: lines and turns of 180 degrees, alternately to both sides.

    With sway the body rolls, pitches, heaves and crabs along, all in closed form. Position is the
    integral of velocity by Simpson's rule.
    """
    count = round(duration_s / dt_s) + 1

    def at(time_s: Array) -> tuple[Array, Array, Array]:
        period = line_m / speed_mps + turn_s
        number, phase = np.divmod(time_s, period)
        x = np.clip((phase - line_m / speed_mps) / turn_s, 0.0, 1.0)
        side = np.where(number % 2 == 0, 1.0, -1.0)
        start = np.where(number % 2 == 0, 0.0, np.pi)
        course = start + side * np.pi * (x - np.sin(2 * np.pi * x) / (2 * np.pi))
        course_rate = side * np.pi / turn_s * (1 - np.cos(2 * np.pi * x))
        a = 1.0 if sway else 0.0
        waves = a * np.array([0.08, 0.04, 0.05])[:, None]
        speeds = np.array([2 * np.pi / 5.0, 2 * np.pi / 7.0, 2 * np.pi / 11.0])[:, None]
        roll, pitch, crab = waves * np.sin(speeds * time_s)
        roll_rate, pitch_rate, crab_rate = waves * speeds * np.cos(speeds * time_s)
        crab = crab + 0.15 * a
        heading, heading_rate = course + crab, course_rate + crab_rate
        heave = a * 0.03 * np.cos(2 * np.pi * time_s / 9.0)
        velocity = np.stack([speed_mps * np.cos(course), speed_mps * np.sin(course), heave], axis=1)
        # Fossen 2011, 2.26 to 2.28: body rates of Euler rates.
        rates = np.stack(
            [
                roll_rate - heading_rate * np.sin(pitch),
                pitch_rate * np.cos(roll) + heading_rate * np.cos(pitch) * np.sin(roll),
                -pitch_rate * np.sin(roll) + heading_rate * np.cos(pitch) * np.cos(roll),
            ],
            axis=1,
        )
        return np.stack([heading, pitch, roll], axis=1), velocity, rates

    time_s = np.arange(count, dtype=float) * dt_s
    angles, velocity, rates = at(time_s)
    middle = at(time_s[:-1] + dt_s / 2)[1]
    steps = dt_s / 6 * (velocity[:-1] + 4 * middle + velocity[1:])
    position = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    position[:, 2] += depth_m
    quaternion = Rotation.from_euler("ZYX", angles).as_quat()
    return np.concatenate([position, quaternion, velocity, rates], axis=1)


def straight(duration_s: float, speed_mps: float = 0.5, depth_m: float = 13.0) -> Array:
    """Truth of a level body that goes north."""
    count = round(duration_s / TICK_S) + 1
    truth = np.zeros((count, 13))
    truth[:, 0] = np.arange(count) * TICK_S * speed_mps
    truth[:, 2], truth[:, 6], truth[:, 7] = depth_m, 1.0, speed_mps
    return truth
