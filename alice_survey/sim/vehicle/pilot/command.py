"""From an estimate to thruster speeds and fins: guidance, control, allocation, failures found.

Find thrusters that do not turn as commanded.

A propeller follows its command by a first-order lag, within its greatest speed and outside of its
dead band. One that turns much slower than that for long has failed, or is weak: a weak thruster
follows up to the speed that its share of the greatest thrust, as the square of the speed, leaves.

Find thrusters that turn and give no thrust: a lost propeller, a fouled one, a loose coupling.

Speeds do not show that; forces do. What the vehicle accelerates by, as the navigation has it, less
what the model makes of its velocity through the water and of its thrusters' speeds, is a residual
force. Its slow part (a current that is off, a load) is followed and taken off. A thruster i that
has lost the share lambda of its thrust T_i leaves -lambda B_i T_i of it.

Each stretch gives the logarithm of the likelihood ratio of lambda = 1 and lambda = 0 in noise that
is white from sample to sample and has a part constant over the stretch, with sizes learned on the
way. Its cumulative sum, never less than zero (E. S. Page, Biometrika 41, 1954), is an alarm above
h: of white noise no false one comes more often than once in exp(h) stretches (G. Lorden, Ann. Math.
Statist. 42, 1971). A thruster weaker by less than a half, or a model off by that, adds up to
nothing.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array, rotation_from_attitude
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.allocation import allocate, new_allocation
from alice_survey.sim.vehicle.dynamics import forces_over_time
from alice_survey.sim.vehicle.navigation.filter import WATER, NavigationState
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot.gains import INNER, SWAY, Gains
from alice_survey.sim.vehicle.pilot.guidance import steer
from alice_survey.sim.vehicle.pilot.memory import THRUSTER_LOST, PilotState, new_pilot
from alice_survey.sim.vehicle.pilot.mission import NO_MISSION, PilotMission
from alice_survey.sim.vehicle.pilot.path import Path
from alice_survey.sim.vehicle.pilot.settings import Guidance, Tick
from alice_survey.sim.vehicle.propulsion import Thruster, turned_speeds
from alice_survey.sim.vehicle.vehicle import Vehicle

WATCHED_S = 5.0
"""Thrusters are judged over stretches of this length."""
_STRETCHES = 2
"""So many in a row make a failure: a rope that is thrown off again in time is none."""
_MARGIN_RPS = 2.0
"""Speeds that differ by less are measured no better (inferred)."""
_SLOW = 0.7
"""A propeller that turns by less than this share of what it should is slow ..."""
_OFTEN = 0.8
"""... and failing where it is slow for this share of the time that it should turn."""
_MIN_S = 1.0
"""It must be asked to turn for at least this long in a stretch to be judged."""


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A thruster that does not do as commanded: as it happens in a simulation, or as found."""

    time_s: float
    thruster: str
    left: float
    """Share that it has left of its greatest thrust: of its speed squared, or if it turns as
    before, at all speeds."""
    turns: bool = False
    """Whether it turns as commanded, with the propeller gone or fouled."""


class ThrusterWatch:
    """Compares commanded with turned speeds, stretch by stretch."""

    def __init__(self, thrusters: Sequence[Thruster], tick_s: float) -> None:
        self._thrusters, self._tick_s = thrusters, tick_s
        self._slow = np.zeros(len(thrusters), dtype=np.int64)
        self._gone = np.zeros(len(thrusters), dtype=np.bool_)

    def judge(self, end_s: float, command_rps: Array, rps: Array) -> list[Failure]:
        """Failures that a stretch shows, each once.

        Args:
            end_s: time of its end.
            command_rps: (T, n) commanded speeds, tick by tick.
            rps: (T, n) speeds that were turned.
        """
        found = []
        time_s: Array = self._tick_s * np.arange(len(rps), dtype=np.float64)
        for i, thruster in enumerate(self._thrusters):
            if self._gone[i]:
                continue
            asked = turned_speeds(time_s, command_rps[:, i], thruster, float(rps[0, i]))
            turning = np.abs(asked) > thruster.dead_band_rps + _MARGIN_RPS
            if turning.sum() * self._tick_s < _MIN_S:
                continue
            turned = rps[:, i] * np.sign(asked)
            slow = turned[turning] < _SLOW * np.abs(asked[turning])
            self._slow[i] = self._slow[i] + 1 if slow.mean() > _OFTEN else 0
            if self._slow[i] == _STRETCHES:
                self._gone[i] = True
                maximum = float(np.abs(rps[:, i]).max())
                turns = maximum > thruster.dead_band_rps + _MARGIN_RPS
                left = (maximum / thruster.most_rps) ** 2 if turns else 0.0
                found.append(Failure(time_s=end_s, thruster=thruster.name, left=left))
        return found


FALSE_ALARM_H = 1000.0
"""Hours of flight between false alarms of all thrusters together, at least."""
_WATER_NE = slice(WATER + 1, WATER + 3)
"""Current to the north and east in the filter's nominal state, whose quaternion is one longer."""
_SAMPLE_TICKS = 9
"""Ticks over which accelerations are taken: long against the pings of a DVL."""
_MEMORY = 12
"""Stretches, a minute of them, over which the noise and the slow force are learned ..."""
_FIRST = 6
"""... and before which nothing is judged."""
_MIN_SPEED = np.array([0.003] * 3 + [0.002] * 3)
"""Noise of a velocity, m/s and rad/s, that navigation has at least (inferred)."""
_MODEL_SHARE = 0.3
"""Share of the hull's and of the thrusters' forces that the model may be off by (inferred: most
coefficients that were computed and then measured, table V of the paper, differ by more)."""
_MAX_MEMORY = 0.9
"""Greatest correlation of one stretch's force with the next's."""
_GREATEST_SHARE = 1.5
"""More than all of a thrust is missing: another force, and no failure."""
_APART = math.log(100.0)
"""By how much, as a logarithm of odds, one thruster must explain it better than any other."""


class NavigatedStretch(NamedTuple):
    """What the navigation has of a stretch."""

    estimate: Array
    """(T, 12) estimates, tick by tick, in the order of `estimate_vector`, up to the altitude."""
    water_ne: Array
    """(2,) estimated current towards north and east."""
    water_sigma_mps: float
    """Standard deviation of either."""


def navigated_stretch(rows: Array, navigation: NavigationState) -> NavigatedStretch:
    """A stretch by the navigation's rows (T, LOG_ROW), up to its state now."""
    sigma_mps = math.sqrt(navigation.covariance[WATER, WATER])
    return NavigatedStretch(rows[:, : vector.ALTITUDE], navigation.nominal[_WATER_NE], sigma_mps)


class ThrustWatch:
    """Compares accelerations with those that the model makes of speeds, stretch by stretch."""

    def __init__(self, vehicle: Vehicle, tick_s: float) -> None:
        count = len(vehicle.thrusters)
        self._names = [thruster.name for thruster in vehicle.thrusters]
        self._plant, self._tick_s = vehicle.plant, tick_s
        noise = np.diag(vehicle.plant.body.mass) * _MIN_SPEED / (_SAMPLE_TICKS * tick_s)
        self._minimum = noise**2
        self._white, self._constant = self._minimum.copy(), self._minimum / _MEMORY
        self._slow, self._before, self._lagged, self._next = (np.zeros(6) for _ in range(4))
        self._learned = 0
        self.sums, self._scores, self._information = (np.zeros(count) for _ in range(3))
        self._gone = np.zeros(count, dtype=np.bool_)
        # Cumulative sums by thruster; one above this is an alarm.
        self.alarm = math.log(FALSE_ALARM_H * 3600.0 / WATCHED_S * count)

    def known_gone(self, thruster: str) -> None:
        """Take a thruster for lost from now on, by whatever showed it."""
        self._gone[self._names.index(thruster)] = True

    def judge(self, end_s: float, navigated: NavigatedStretch, rps: Array) -> list[Failure]:
        """Failures that a stretch shows, each once.

        Args:
            end_s: time of its end.
            navigated: how it moved.
            rps: (T, n) speeds that were turned.
        """
        if len(rps) <= 2 * _SAMPLE_TICKS or not np.all(np.isfinite(navigated.estimate)):
            return []
        residual, missing, doubt = self._residuals(navigated, rps)
        if self._learned >= _FIRST:
            self._add_up(residual - self._slow, missing, doubt)
        order = np.argsort(self.sums)
        best = int(order[-1])
        other = float(self.sums[order[-2]]) if len(order) > 1 else 0.0
        # What looks like a failure is not learned as noise.
        if self.sums[best] < 0.5 * self.alarm:
            self._learn(residual)
        if self.sums[best] < max(self.alarm, other + _APART):
            return []
        share = self._scores[best] / self._information[best]
        self.sums[:], self._scores[:], self._information[:] = 0.0, 0.0, 0.0
        if share > _GREATEST_SHARE:
            self._learn(residual)
            return []
        self._gone[best] = True
        return [Failure(time_s=end_s, thruster=self._names[best], left=0.0, turns=True)]

    def _residuals(self, navigated: NavigatedStretch, rps: Array) -> tuple[Array, Array, Array]:
        """Residual force, (S, 6), thrust by thruster, (S, n, 6), and the model's doubt, (2, 6).

        The doubt is what the model may be off by all along: shares of the hull's and the thrusters'
        forces, and what an error of the current does to the hull's. Its square over a stretch has a
        constant part and that about it.
        """
        estimate, water_ne, water_sigma_mps = navigated
        ticks = len(rps)
        angles = estimate[:, [vector.ROLL, vector.PITCH, vector.HEADING]]
        body_from_ned = rotation_from_attitude(*angles.T).inv()
        nu = estimate[:, vector.U : vector.U + 6].copy()
        nu[:, :3] -= body_from_ned.apply([water_ne[0], water_ne[1], 0.0])
        down = body_from_ned.apply([0.0, 0.0, 1.0])
        hull, thrust = forces_over_time(*self._plant[:2], nu, down, rps)
        thrust[:, self._gone] = 0.0
        edges = np.arange(0, ticks, _SAMPLE_TICKS)
        span_s = _SAMPLE_TICKS * self._tick_s
        inertial = np.diff(nu[edges], axis=0) @ self._plant.body.mass.T / span_s
        pairs = list(itertools.pairwise(edges.tolist()))

        def sample(table: Array) -> Array:
            return np.array([table[a:b].mean(axis=0) for a, b in pairs])

        by_hull, by_thrust = sample(hull), sample(thrust)
        pushed = by_thrust.sum(axis=1)
        doubts = [_MODEL_SHARE * by_hull, _MODEL_SHARE * pushed]
        for axis in range(2):
            other = nu.copy()
            other[:, axis] += water_sigma_mps
            doubts.append(sample(forces_over_time(*self._plant[:2], other, down, rps)[0] - hull))
        doubt = np.sum([[d.mean(axis=0) ** 2, d.var(axis=0)] for d in doubts], axis=0)
        return inertial - by_hull - pushed, by_thrust, doubt

    def _add_up(self, rest: Array, thrust: Array, doubt: Array) -> None:
        """Add a stretch's logarithms of likelihood ratios to the sums."""
        samples = len(rest)
        # What lasts counts as often as its memory r is long: the mean of a first-order process has
        # (1 + r) / (1 - r) times the variance of that of as many independent values.
        constant = _lasting(self._constant, self._lagged) + _MEMORY * doubt[0]
        white = _lasting(self._white, self._next) + _MEMORY * doubt[1]
        # Inverse of s2 I + t2 11': (x - m 1 t2 / (s2 / S + t2)) / s2, with the mean m of x.
        held = constant / (white / samples + constant)

        def product(first: Array, second: Array) -> float:
            mean = first.mean(axis=0) * second.mean(axis=0) * held
            return float(np.sum(((first * second).mean(axis=0) - mean) * samples / white))

        for i in range(thrust.shape[1]):
            if self._gone[i]:
                continue
            score = product(thrust[:, i], -rest)
            information = product(thrust[:, i], thrust[:, i])
            self.sums[i] += score - 0.5 * information
            self._scores[i] += score
            self._information[i] += information
            if self.sums[i] <= 0.0:
                self.sums[i] = self._scores[i] = self._information[i] = 0.0

    def _learn(self, residual: Array) -> None:
        """Follow the slow force, and the size of the noise about it."""
        self._learned += 1
        share = 1.0 / min(self._learned, _MEMORY)
        rest = residual - self._slow
        mean = rest.mean(axis=0)
        white = np.sum((rest - mean) ** 2, axis=0) / (len(rest) - 1.0)
        self._white += share * (np.maximum(white, self._minimum) - self._white)
        about = rest - mean
        product = np.sum(about[1:] * about[:-1], axis=0) / (len(rest) - 1.0)
        self._next += share * (product - self._next)
        if self._learned > 1:
            self._constant += share * (mean**2 - self._constant)
            self._lagged += share * (mean * self._before - self._lagged)
        self._before = mean
        self._slow += share * mean


def _lasting(variance: Array, lagged: Array) -> Array:
    """Variance, (6,), of independent values that say as much as those with this covariance."""
    kept = np.clip(lagged / variance, 0.0, _MAX_MEMORY)
    return variance * (1.0 + kept) / (1.0 - kept)


Without = Callable[[Mapping[str, float], Array | None], tuple[Gains, Guidance]]
"""How to fly with what thrusters have left in a current, (2,) m/s north and east, if it is known; a
`VehicleError`: not at all."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Piloting:
    """How a vehicle flies a plan, at sea or simulated."""

    vehicle: Vehicle
    """With all its thrusters."""
    path: Path
    gains: Gains
    guidance: Guidance
    mission: PilotMission = NO_MISSION
    """What is flown instead of the path, by the law of another vehicle's software."""
    exact_allocation: bool = True
    """Or by the redistributed pseudo-inverse."""
    believed: Vehicle | None = None
    """Vehicle that the allocation assumes, with as many thrusters; the vehicle itself if not
    given."""
    known_health: Mapping[str, float] | None = None
    """Share left of thrusters that are known not to be intact."""
    without: Without | None = None
    """How to go on once failures are found; not looked for if None."""


class Pilot:
    """A pilot on a path, who goes on without thrusters that are found to have failed."""

    def __init__(self, flies: Piloting, tick_s: float) -> None:
        """A pilot at the start of a mission.

        Args:
            flies: how.
            tick_s: time between ticks.

        Raises:
            VehicleError: a thruster that is named is not one of the vehicle's.
        """
        self._flies, self.gains, self.guidance = flies, flies.gains, flies.guidance
        self.state, self.wrench = new_pilot(), np.zeros(6)
        self.known, believed = dict(flies.known_health or {}), flies.believed or flies.vehicle
        self.allocation = new_allocation(
            believed,
            flies.vehicle.health_of(self.known),
            exact=flies.exact_allocation,
            axes=flies.gains.axis_weights,
        )
        self._sees = ThrusterWatch(flies.vehicle.thrusters, tick_s)
        # What fins do is not in its model of the forces.
        self._feels = None if flies.vehicle.fins else ThrustWatch(believed, tick_s)

    def tick(self, dt_s: float, estimate: Array) -> Tick:
        """A tick for compiled code, of an estimate of the navigation."""
        return Tick(dt_s, estimate, self._flies.path, self.guidance, self.gains, self.state)

    def steer(self, time_s: float, dt_s: float, estimate: Array) -> None:
        """Write the wrench and the allocation of a tick, for an estimate of the navigation."""
        steer(time_s, self.tick(dt_s, estimate), NO_MISSION, self.wrench)
        allocate(self.wrench, estimate[vector.U :], self.allocation)

    def judge(
        self,
        end_s: float,
        command_rps: Array,
        rps: Array,
        navigated: NavigatedStretch | None = None,
    ) -> list[Failure]:
        """Look for failures in a stretch of `WATCHED_S`, and go on without what has failed.

        Args:
            end_s: time of its end.
            command_rps: (T, n) commanded speeds, tick by tick.
            rps: (T, n) speeds that were turned.
            navigated: motion, which shows what pushes nothing; speeds alone count without it.
        """
        if self._flies.without is None:
            return []
        found = self._sees.judge(end_s, command_rps, rps)
        if self._feels is not None and navigated is not None:
            for failure in found:
                self._feels.known_gone(failure.thruster)
            found += self._feels.judge(end_s, navigated, rps)
        for failure in found:
            self.known[failure.thruster] = min(failure.left, self.known.get(failure.thruster, 1.0))
        if found:
            self.allocation.health[:] = self._flies.vehicle.health_of(self.known)
            water_ne = None if navigated is None else navigated.water_ne
            try:
                before, after = self.gains, self._flies.without(self.known, water_ne)
                self.gains, self.guidance = after
                _carry_over(self.state, before, self.gains)
            except VehicleError:
                report = self.state.report
                if report[slot.PHASE] != slot.ABORT:
                    report[slot.PHASE], report[slot.REASON] = slot.ABORT, THRUSTER_LOST
        return found


def _carry_over(pilot: PilotState, before: Gains, after: Gains) -> None:
    """Let the pilot's memory mean the same with other gains, in place.

    Integrals are kept as speeds, of which the inner loops make accelerations: what holds against
    the current goes on. That of yaw has learned of what the lost thruster left undone.
    """
    pilot.memory[slot.YAW_SUM] = 0.0
    inner = after.axes[SWAY, INNER]
    factor = before.axes[SWAY, INNER] / inner if inner > 0.0 else 0.0
    pilot.memory[[slot.SWAY_SUM_N, slot.SWAY_SUM_E]] *= factor
