"""The closed loop: navigation, guidance, control, allocation and dynamics, tick by tick.

A tick is 0.05 s: the sensors measure the true state for the navigation, the pilot commands
a wrench, the allocation converts it to thruster speeds, and the equations of motion advance by
five Runge-Kutta steps of 10 ms.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from alice_survey.core.compiled import kernel
from alice_survey.core.frames import Array, attitude_from_rotation
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.allocation import Allocation, allocate
from alice_survey.sim.vehicle.dynamics import (
    STATE,
    Plant,
    Scratch,
    initial_state,
    rk4_step,
    scratch_for,
)
from alice_survey.sim.vehicle.navigation.filter import NavigationState, new_navigation
from alice_survey.sim.vehicle.navigation.sensors import Sensors
from alice_survey.sim.vehicle.navigation.tick import LOG_ROW, log_row, navigation_tick
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot.command import (
    WATCHED_S,
    Failure,
    Pilot,
    Piloting,
    navigated_stretch,
)
from alice_survey.sim.vehicle.pilot.guidance import steer
from alice_survey.sim.vehicle.pilot.memory import TOUCHED
from alice_survey.sim.vehicle.pilot.mission import PilotMission
from alice_survey.sim.vehicle.pilot.settings import Tick
from alice_survey.sim.vehicle.propulsion import electrical_power, with_health, without_thrust
from alice_survey.sim.vehicle.rotations import matrix_rows
from alice_survey.sim.vehicle.sea import Current, Disturbance, FloorGrid, current_at, floor_depth

TICK_S = 0.05
STEPS = 5
"""Runge-Kutta steps in a tick."""


class Sea(NamedTuple):
    """External influences on the vehicle."""

    current: Current
    gust_sigma: Array
    """(6,) N and N m."""
    gust_decay: float
    """Correlation of gusts from one tick to the next."""


class World(NamedTuple):
    """State that changes from tick to tick, apart from pilot and navigation."""

    state: Array
    """(13 + n + m,) state of the dynamics: of n thrusters and m drives of fins."""
    before: Array
    """(13,) truth at the tick before: position, quaternion, velocity over ground in NED, rates."""
    now: Array
    gust: Array
    """(6,)"""
    load: Array
    water: Array
    estimate: Array


@kernel
def _write_truth(world: World, current: Current, time_s: float) -> None:
    """Write the truth of now from the state of the dynamics."""
    state, now = world.state, world.now
    current_at(current, time_s, state[2], world.water)
    u, v, w = state[7], state[8], state[9]
    for i in range(7):
        now[i] = state[i]
    north, east, down = matrix_rows(state[3], state[4], state[5], state[6])
    now[7] = (north[0] * u + north[1] * v + north[2] * w) + world.water[0]
    now[8] = (east[0] * u + east[1] * v + east[2] * w) + world.water[1]
    now[9] = down[0] * u + down[1] * v + down[2] * w
    for i in range(3):
        now[10 + i] = state[10 + i]


class VehicleParts(NamedTuple):
    """A vehicle in its sea, as compiled code takes it."""

    plant: Plant
    sea: Sea
    floor: FloorGrid
    sensors: Sensors
    navigation: NavigationState
    world: World
    scratch: Scratch


@kernel
def touches(parts: VehicleParts) -> bool:
    """Whether hull, DVL or port is on the sea floor, or in it."""
    now, low = parts.world.now, parts.sensors.low
    north, east, down = matrix_rows(now[3], now[4], now[5], now[6])
    for i in range(low.shape[0]):
        a, b, c = low[i, 0], low[i, 1], low[i, 2]
        n = north[0] * a + north[1] * b + north[2] * c
        e = east[0] * a + east[1] * b + east[2] * c
        d = down[0] * a + down[1] * b + down[2] * c
        if now[2] + d >= floor_depth(parts.floor, now[0] + n, now[1] + e):
            return True
    return False


@kernel
def sense(tick: int, parts: VehicleParts, rng: np.random.Generator) -> None:
    """Write the truth of a tick, and what the navigation makes of its sensors."""
    time_s, world = tick * TICK_S, parts.world
    _write_truth(world, parts.sea.current, time_s)
    navigation_tick(
        time_s, tick, TICK_S, world.before, world.now, world.water, parts.floor, parts.sensors,
        parts.navigation, rng, world.estimate,
    )  # fmt: skip


@kernel
def move(tick: int, parts: VehicleParts, command: Array, sea_rng: np.random.Generator) -> None:
    """Advance the vehicle from a tick to the next under commanded speeds and angles, (n + m,)."""
    time_s, world, sea = tick * TICK_S, parts.world, parts.sea
    for i in range(STATE):
        world.before[i] = world.now[i]
    kept = math.sqrt(1.0 - sea.gust_decay * sea.gust_decay)
    for i in range(6):
        world.gust[i] = sea.gust_decay * world.gust[i] + kept * sea_rng.standard_normal()
        world.load[i] = sea.gust_sigma[i] * world.gust[i]
    step = TICK_S / STEPS
    for i in range(STEPS):
        rk4_step(
            time_s + i * step, step, world.state, command, world.load, parts.plant, sea.current,
            parts.scratch,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Setup(Piloting):
    """All inputs of a mission except random numbers."""

    sensors: Sensors
    floor: FloorGrid
    current: Current
    disturbance: Disturbance
    health: Mapping[str, float] = field(default_factory=dict)
    """Share of its greatest speed squared left in a thruster: 0 failed; intact if not named."""
    start_ne_m: tuple[float, float] = (0.0, 0.0)
    start_heading_rad: float = 0.0
    failures: tuple[Failure, ...] = ()
    """Thrusters that fail on the way."""


class SimulatedVehicle:
    """A vehicle in its sea, with its sensors and the state of both."""

    def __init__(
        self, setup: Setup, rng: np.random.Generator, sea_rng: np.random.Generator | None = None
    ) -> None:
        """Put a vehicle at rest on the surface, where a mission starts.

        Args:
            setup: of the mission.
            rng: source of all noise.
            sea_rng: source of the gusts; `rng` if not given.

        Raises:
            VehicleError: a thruster that is named is not one of the vehicle's.
        """
        self.vehicle, self.rng, self.sea_rng = setup.vehicle, rng, sea_rng or rng
        self.tick = 0
        gusts, actuators = setup.disturbance, self.vehicle.actuators
        decay = math.exp(-TICK_S / max(gusts.correlation_s, 1e-9))
        attitude = np.array([0.0, 0.0, setup.start_heading_rad])
        world = World(
            initial_state(np.array([*setup.start_ne_m, 0.0]), attitude, actuators),
            *(np.zeros(size) for size in (13, 13, 6, 6, 6, vector.ESTIMATE)),
        )
        _write_truth(world, setup.current, 0.0)
        world.before[:] = world.now
        self.parts = VehicleParts(
            self.vehicle.plant, Sea(setup.current, np.array(gusts.sigma), decay), setup.floor,
            setup.sensors, new_navigation(setup.sensors, world.now, rng), world,
            scratch_for(actuators),
        )  # fmt: skip
        """For compiled code."""
        self.world = world
        self.weaken(setup.health)

    def weaken(self, left: Mapping[str, float], pushing: Mapping[str, float] | None = None) -> None:
        """Leave thrusters a share of their speed squared, or of their thrust at all speeds.

        Args:
            left: as of `Vehicle.health_of`.
            pushing: the same, of propellers that turn as before.
        """
        sound = self.vehicle.plant
        slower = with_health(sound.propulsion, self.vehicle.health_of(left))
        propulsion = without_thrust(slower, self.vehicle.health_of(pushing or {}))
        self.parts = self.parts._replace(plant=sound._replace(propulsion=propulsion))

    def sense(self) -> Array:
        """Measure at this tick; the navigation's estimate, as `estimate_vector` has it."""
        sense(self.tick, self.parts, self.rng)
        return self.world.estimate

    @property
    def touches_floor(self) -> bool:
        """Whether hull, DVL or port is on the sea floor, or in it."""
        return bool(touches(self.parts))

    def move(self, command: Array) -> None:
        """Advance to the next tick under commands (n + m,): speeds in rev/s, angles in rad."""
        move(self.tick, self.parts, command, self.sea_rng)
        self.tick += 1


_CHUNK_TICKS = 1200
_WATCHED_TICKS = round(WATCHED_S / TICK_S)


class TickRows(NamedTuple):
    """Record of all ticks, a row each."""

    state: Array
    truth: Array
    navigation: Array
    report: Array
    wrench: Array
    command_rps: Array
    power_w: Array


@kernel
def _record(values: Array, row: Array) -> None:
    for i in range(row.shape[0]):
        row[i] = values[i]


@kernel
def _fly_ticks(
    first: int,
    parts: VehicleParts,
    steered: Tick,
    mission: PilotMission,
    wrench: Array,
    allocation: Allocation,
    rng: np.random.Generator,
    sea_rng: np.random.Generator,
    rows: TickRows,
) -> int:
    """Fly ticks until the rows are full or the mission is over; return their number."""
    world, navigation, pilot = parts.world, parts.navigation, steered.pilot
    count, flown = rows.state.shape[0], 0
    for k in range(count):
        tick = first + k
        sense(tick, parts, rng)
        spread = max(navigation.covariance[0, 0], navigation.covariance[1, 1])
        pilot.memory[slot.SIGMA_M] = math.sqrt(max(spread, 0.0))
        steer(tick * TICK_S, steered, mission, wrench)
        touched = touches(parts)
        if touched:
            pilot.report[slot.PHASE], pilot.report[slot.REASON] = slot.ABORT, TOUCHED
        allocate(wrench, world.estimate[vector.U :], allocation)

        _record(world.state, rows.state[k])
        _record(world.now, rows.truth[k])
        _record(wrench, rows.wrench[k])
        _record(pilot.report, rows.report[k])
        _record(allocation.command, rows.command_rps[k])
        electrical_power(
            parts.plant.propulsion, world.state[STATE:], world.state[7:STATE], rows.power_w[k]
        )
        log_row(navigation, rows.navigation[k])
        flown += 1
        if touched or pilot.report[slot.PHASE] == slot.DONE or pilot.report[slot.AT_SURFACE] == 1.0:
            break

        move(tick, parts, allocation.command, sea_rng)
    return flown


@dataclass(frozen=True, kw_only=True, eq=False)
class Flown:
    """A flown mission: rows of T ticks, 0.05 s apart."""

    time_s: Array
    state: Array
    """(T, 13 + n + m) states of the dynamics."""
    truth: Array
    """(T, 13) position, quaternion, velocity over ground in NED, body rates."""
    navigation: Array
    """(T, LOG_ROW) as `navigation.log_row` has it."""
    report: Array
    """(T, REPORT) as `guidance` has it."""
    wrench: Array
    """(T, 6) requested wrench."""
    command_rps: Array
    """(T, n)"""
    power_w: Array
    """(T, n) electrical power."""
    thrusters: tuple[str, ...]
    found: tuple[Failure, ...] = ()
    """Failures that the vehicle found."""

    @property
    def attitude_rad(self) -> Array:
        """(T, 3) true roll, pitch, heading."""
        from scipy.spatial.transform import Rotation

        return attitude_from_rotation(Rotation.from_quat(self.truth[:, 3:7]))

    @property
    def rps(self) -> Array:
        """(T, n) speeds of the thrusters, rev/s."""
        return self.state[:, STATE : STATE + len(self.thrusters)]

    @property
    def fin_rad(self) -> Array:
        """(T, m) angles of the fins."""
        return self.state[:, STATE + len(self.thrusters) :]

    @property
    def energy_j(self) -> Array:
        """(n,) electrical energy of each thruster over the mission."""
        return np.asarray(self.power_w.sum(axis=0) * TICK_S)


def simulate(
    setup: Setup,
    rng: np.random.Generator,
    *,
    max_s: float,
    label: str,
    expected_s: float | None = None,
    sea_rng: np.random.Generator | None = None,
) -> Flown:
    """Fly a mission to its end.

    Args:
        setup: the mission.
        rng: source of all noise.
        max_s: the mission ends at this time at the latest.
        label: text of the progress bar; there is none if it is empty.
        expected_s: how long the mission will take, for that bar.
        sea_rng: source of the gusts, six numbers a tick, so that vehicles can be flown in the same
            ones; `rng` if not given.

    Raises:
        VehicleError: a thruster that is named is not one of the vehicle's.
    """
    from alice_survey.core.executor import progress

    chunks: list[TickRows] = []
    total = math.ceil((expected_s or max_s) / TICK_S / _CHUNK_TICKS)
    found: list[Failure] = []
    flying = _chunks(setup, rng, sea_rng or rng, max_s, found)
    for chunk in progress(flying, label, total) if label else flying:
        chunks.append(chunk)  # noqa: PERF402  the bar takes an iterator
    rows = TickRows(*(np.concatenate(parts) for parts in zip(*chunks, strict=True)))
    return Flown(
        time_s=TICK_S * np.arange(len(rows.state), dtype=np.float64),
        thrusters=tuple(t.name for t in setup.vehicle.thrusters),
        found=tuple(found),
        **rows._asdict(),
    )


def _chunks(
    setup: Setup,
    rng: np.random.Generator,
    sea_rng: np.random.Generator,
    max_s: float,
    found: list[Failure],
) -> Iterator[TickRows]:
    """Rows of a minute each at most, until the mission is over; adds failures that are found."""
    left, pushing = dict(setup.health), dict[str, float]()
    simulated = SimulatedVehicle(setup, rng, sea_rng)
    known = setup.health if setup.known_health is None else setup.known_health
    pilot = Pilot(replace(setup, known_health=known), TICK_S)
    thrusters, last, first = len(setup.vehicle.thrusters), math.ceil(max_s / TICK_S), 0
    maximum = _CHUNK_TICKS if setup.without is None else _WATCHED_TICKS
    widths = (STATE + setup.vehicle.actuators, STATE, LOG_ROW, slot.REPORT, 6, thrusters, thrusters)
    waiting = sorted(setup.failures, key=lambda failure: failure.time_s)
    while first < last:
        while waiting and round(waiting[0].time_s / TICK_S) <= first:
            failure = waiting.pop(0)
            (pushing if failure.turns else left)[failure.thruster] = failure.left
            simulated.weaken(left, pushing)
        end = min(first + maximum, last)
        if waiting:
            end = min(end, round(waiting[0].time_s / TICK_S))
        rows = TickRows(*(np.zeros((end - first, width)) for width in widths))
        flown = _fly_ticks(
            first, simulated.parts, pilot.tick(TICK_S, simulated.world.estimate), setup.mission,
            pilot.wrench, pilot.allocation, rng, sea_rng, rows,
        )  # fmt: skip
        yield TickRows(*(part[:flown] for part in rows))
        if flown < len(rows.state) or pilot.state.report[slot.REASON] == TOUCHED:
            return
        first = end
        found += pilot.judge(
            first * TICK_S,
            rows.command_rps,
            rows.state[:, STATE : STATE + thrusters],
            navigated_stretch(rows.navigation, simulated.parts.navigation),
        )
