"""The closed loop: navigation, guidance, control, allocation and dynamics, tick by tick.

A tick is 0.05 s: the sensors measure the true state for the navigation, the pilot commands
a wrench, the allocation converts it to thruster speeds, and the equations of motion advance by
five Runge-Kutta steps of 10 ms.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from alice_survey.base.compiled import note_compiling
from alice_survey.base.errors import VehicleError
from alice_survey.base.frames import Array, attitude_from_rotation
from alice_survey.vehicle import estimate_vector as vector
from alice_survey.vehicle.allocation import (
    AXIS_WEIGHTS,
    LEVEL_WEIGHTS,
    AllocationScratch,
    allocate_exact,
    allocate_rpi,
    allocation_scratch,
    preference_weights,
)
from alice_survey.vehicle.compiled import kernel
from alice_survey.vehicle.dynamics import (
    STATE,
    Plant,
    Scratch,
    initial_state,
    rk4_step,
    scratch_for,
)
from alice_survey.vehicle.floor import FloorGrid, floor_depth
from alice_survey.vehicle.navigation.filter import NavigationState, new_navigation
from alice_survey.vehicle.navigation.sensors import DVL, FOLLOWED, Sensors
from alice_survey.vehicle.navigation.tick import LOG_ROW, log_row, navigation_tick
from alice_survey.vehicle.pilot.gains import INNER, SWAY, Gains
from alice_survey.vehicle.pilot.guidance import steer
from alice_survey.vehicle.pilot.memory import (
    ABORT,
    AT_SURFACE,
    DONE,
    PHASE,
    REASON,
    REPORT,
    SWAY_SUM_E,
    SWAY_SUM_N,
    YAW_SUM,
    PilotState,
    new_pilot,
)
from alice_survey.vehicle.pilot.mission import NO_MISSION, PilotMission
from alice_survey.vehicle.pilot.path import Path
from alice_survey.vehicle.pilot.safety import THRUSTER_LOST, TOUCHED
from alice_survey.vehicle.pilot.settings import Guidance
from alice_survey.vehicle.pilot.thruster_watch import WATCHED_S, FoundFailure, ThrusterWatch
from alice_survey.vehicle.propulsion import (
    Propulsion,
    electrical_power,
    speeds_for,
    thrust_limits,
    weakened,
)
from alice_survey.vehicle.rotations import matrix_rows
from alice_survey.vehicle.sea import Current, Disturbance, current_at
from alice_survey.vehicle.vehicle import Vehicle

TICK_S = 0.05
STEPS = 5
"""Runge-Kutta steps in a tick."""
_CHUNK_TICKS = 1200
_WATCHED_TICKS = round(WATCHED_S / TICK_S)


class Sea(NamedTuple):
    """External influences on the vehicle."""

    current: Current
    gust_sigma: Array
    """(6,) N and N m."""
    gust_decay: float
    """Correlation of gusts from one tick to the next."""


class Allocation(NamedTuple):
    """Settings of the allocation from wrench to thrust."""

    exact: bool
    propulsion: Propulsion
    """Propulsion as the allocation assumes it."""
    matrix: Array
    """B, (6, n)."""
    axes: Array
    """(6,) weight of each axis; 0 of one that is not requested."""
    health: Array
    """(n,) 1 of an intact thruster, 0 of a failed one, see `weakened`."""
    lower: Array
    upper: Array
    weights: Array
    thrust: Array
    command_rps: Array
    scratch: AllocationScratch


class World(NamedTuple):
    """State that changes from tick to tick, apart from pilot and navigation."""

    state: Array
    """(13 + n,) state of the dynamics."""
    before: Array
    """(13,) truth at the tick before: position, quaternion, velocity over ground in NED, rates."""
    now: Array
    gust: Array
    """(6,)"""
    load: Array
    water: Array
    estimate: Array
    wrench: Array


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


@kernel
def _touches(now: Array, sensors: Sensors, floor: FloorGrid) -> bool:
    """Whether hull, DVL or port is on the sea floor, or in it."""
    rows = matrix_rows(now[3], now[4], now[5], now[6])
    points = sensors.hull.shape[0]
    for i in range(points + 2):
        if i < points:
            a, b, c = sensors.hull[i, 0], sensors.hull[i, 1], sensors.hull[i, 2]
        else:
            k = DVL if i == points else FOLLOWED
            a, b, c = sensors.place[k, 0], sensors.place[k, 1], sensors.place[k, 2]
        north = rows[0][0] * a + rows[0][1] * b + rows[0][2] * c
        east = rows[1][0] * a + rows[1][1] * b + rows[1][2] * c
        down = rows[2][0] * a + rows[2][1] * b + rows[2][2] * c
        if now[2] + down >= floor_depth(floor, now[0] + north, now[1] + east):
            return True
    return False


@kernel
def _fly_ticks(
    first: int,
    plant: Plant,
    sea: Sea,
    floor: FloorGrid,
    sensors: Sensors,
    navigation: NavigationState,
    path: Path,
    mission: PilotMission,
    guidance: Guidance,
    gains: Gains,
    pilot: PilotState,
    allocation: Allocation,
    world: World,
    scratch: Scratch,
    rng: np.random.Generator,
    sea_rng: np.random.Generator,
    rows: TickRows,
) -> int:
    """Fly ticks until the rows are full or the mission is over; return their number."""
    count, thrusters, flown = rows.state.shape[0], allocation.thrust.shape[0], 0
    for k in range(count):
        tick = first + k
        time_s = tick * TICK_S
        _write_truth(world, sea.current, time_s)
        navigation_tick(
            time_s, tick, TICK_S, world.before, world.now, world.water, floor, sensors,
            navigation, rng, world.estimate,
        )  # fmt: skip
        steer(time_s, TICK_S, world.estimate, path, mission, guidance, gains, pilot, world.wrench)
        touched = _touches(world.now, sensors, floor)
        if touched:
            pilot.report[PHASE], pilot.report[REASON] = ABORT, TOUCHED
        # The flow past the hull is not measured: the velocity over ground stands for it.
        known = world.estimate[vector.U : vector.U + 6]
        lower, upper = allocation.lower, allocation.upper
        thrust_limits(allocation.propulsion, allocation.health, known, lower, upper)
        preference_weights(allocation.propulsion, known[0], allocation.weights)
        if allocation.exact:
            allocate_exact(
                allocation.matrix, world.wrench, lower, upper,
                allocation.axes, allocation.weights, allocation.thrust, allocation.scratch,
            )  # fmt: skip
        else:
            allocate_rpi(
                allocation.matrix, world.wrench, lower, upper,
                allocation.axes, allocation.weights, allocation.thrust, allocation.scratch,
            )  # fmt: skip
        speeds_for(allocation.propulsion, allocation.thrust, known, allocation.command_rps)

        for i in range(STATE + thrusters):
            rows.state[k, i] = world.state[i]
        for i in range(STATE):
            rows.truth[k, i] = world.now[i]
        for i in range(6):
            rows.wrench[k, i] = world.wrench[i]
        for i in range(thrusters):
            rows.command_rps[k, i] = allocation.command_rps[i]
        for i in range(REPORT):
            rows.report[k, i] = pilot.report[i]
        electrical_power(
            plant.propulsion, world.state[STATE:], world.state[7:STATE], rows.power_w[k]
        )
        log_row(navigation, rows.navigation[k])
        flown += 1
        if touched or pilot.report[PHASE] == DONE or pilot.report[AT_SURFACE] == 1.0:
            break

        for i in range(STATE):
            world.before[i] = world.now[i]
        kept = math.sqrt(1.0 - sea.gust_decay * sea.gust_decay)
        for i in range(6):
            world.gust[i] = sea.gust_decay * world.gust[i] + kept * sea_rng.standard_normal()
            world.load[i] = sea.gust_sigma[i] * world.gust[i]
        step = TICK_S / STEPS
        for i in range(STEPS):
            rk4_step(
                time_s + i * step, step, world.state, allocation.command_rps, world.load, plant,
                sea.current, scratch,
            )  # fmt: skip
    return flown


@dataclass(frozen=True, kw_only=True, eq=False)
class Setup:
    """All inputs of a mission except random numbers."""

    vehicle: Vehicle
    path: Path
    guidance: Guidance
    gains: Gains
    sensors: Sensors
    floor: FloorGrid
    current: Current
    disturbance: Disturbance
    mission: PilotMission = NO_MISSION
    """What is flown instead of the path, by the law of another vehicle's software."""
    exact_allocation: bool = True
    health: Mapping[str, float] = field(default_factory=dict)
    """Share of its greatest speed squared left in a thruster: 0 failed; intact if not named."""
    known_health: Mapping[str, float] | None = None
    """The same as the allocation assumes it; the true one if not given."""
    believed: Vehicle | None = None
    """Vehicle that the allocation assumes, with as many thrusters; the vehicle itself if not
    given."""
    start_ne_m: tuple[float, float] = (0.0, 0.0)
    start_heading_rad: float = 0.0
    failures: tuple["Failure", ...] = ()
    """Thrusters that fail on the way."""
    without: Callable[[Mapping[str, float]], tuple[Gains, Guidance]] | None = None
    """How to fly with what thrusters have left, once failures are found; not looked for if None. A
    `VehicleError`: not at all."""


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A thruster that fails on the way."""

    time_s: float
    thruster: str
    left: float
    """Share of its greatest speed squared that is left."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Flown:
    """A flown mission: rows of T ticks, 0.05 s apart."""

    time_s: Array
    state: Array
    """(T, 13 + n) states of the dynamics."""
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
    found: tuple[FoundFailure, ...] = ()
    """Failures that the vehicle found."""

    @property
    def attitude_rad(self) -> Array:
        """(T, 3) true roll, pitch, heading."""
        from scipy.spatial.transform import Rotation

        return attitude_from_rotation(Rotation.from_quat(self.truth[:, 3:7]))

    @property
    def rps(self) -> Array:
        """(T, n) speeds of the thrusters, rev/s."""
        return self.state[:, STATE:]

    @property
    def energy_j(self) -> Array:
        """(n,) electrical energy of each thruster over the mission."""
        energy: Array = self.power_w.sum(axis=0) * TICK_S
        return energy


def simulate(
    setup: Setup,
    rng: np.random.Generator,
    *,
    longest_s: float,
    label: str,
    expected_s: float | None = None,
    sea_rng: np.random.Generator | None = None,
) -> Flown:
    """Fly a mission to its end.

    Args:
        setup: the mission.
        rng: source of all noise.
        longest_s: the mission ends at this time at the latest.
        label: text of the progress bar; there is none if it is empty.
        expected_s: how long the mission will take, for that bar.
        sea_rng: source of the gusts, six numbers a tick, so that vehicles can be flown in the same
            ones; `rng` if not given.

    Raises:
        VehicleError: a thruster that is named is not one of the vehicle's.
    """
    from alice_survey.base.executor import progress

    note_compiling(_fly_ticks, "the vehicle's model, once: this takes about a minute")
    chunks: list[TickRows] = []
    total = math.ceil((expected_s or longest_s) / TICK_S / _CHUNK_TICKS)
    found: list[FoundFailure] = []
    flying = _chunks(setup, rng, sea_rng or rng, longest_s, found)
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
    longest_s: float,
    found: list[FoundFailure],
) -> Iterator[TickRows]:
    """Rows of a minute each at most, until the mission is over; adds failures that are found."""
    vehicle, n = setup.vehicle, len(setup.vehicle.thrusters)
    sound = vehicle.plant
    left = dict(setup.health)
    plant = Plant(sound.body, weakened(sound.propulsion, vehicle.health_of(left)))
    world = _new_world(setup, n)
    navigation = new_navigation(setup.sensors, world.now, rng)
    pilot, allocation, scratch = new_pilot(), _allocation(setup), scratch_for(n)
    gusts = setup.disturbance
    sea = Sea(
        setup.current, np.array(gusts.sigma), math.exp(-TICK_S / max(gusts.correlation_s, 1e-9))
    )
    last, first = math.ceil(longest_s / TICK_S), 0
    gains, guidance = setup.gains, setup.guidance
    known = dict(setup.health if setup.known_health is None else setup.known_health)
    sees = ThrusterWatch(vehicle.thrusters, TICK_S)
    most = _CHUNK_TICKS if setup.without is None else _WATCHED_TICKS
    waiting = sorted(setup.failures, key=lambda failure: failure.time_s)
    while first < last:
        while waiting and round(waiting[0].time_s / TICK_S) <= first:
            left[waiting[0].thruster] = waiting[0].left
            plant = Plant(sound.body, weakened(sound.propulsion, vehicle.health_of(left)))
            del waiting[0]
        end = min(first + most, last)
        if waiting:
            end = min(end, round(waiting[0].time_s / TICK_S))
        rows = _new_rows(end - first, n)
        flown = _fly_ticks(
            first, plant, sea, setup.floor, setup.sensors, navigation, setup.path,
            setup.mission, guidance, gains, pilot, allocation, world, scratch, rng, sea_rng, rows,
        )  # fmt: skip
        yield TickRows(*(part[:flown] for part in rows))
        if flown < len(rows.state) or pilot.report[REASON] == TOUCHED:
            return
        first = end
        if setup.without is None:
            continue
        new = sees.judge(first * TICK_S, rows.command_rps, rows.state[:, STATE:])
        for failure in new:
            found.append(failure)
            known[failure.thruster] = min(failure.left, known.get(failure.thruster, 1.0))
        if new:
            allocation.health[:] = vehicle.health_of(known)
            try:
                before, (gains, guidance) = gains, setup.without(known)
                _carry_over(pilot, before, gains)
            except VehicleError:
                if pilot.report[PHASE] != ABORT:
                    pilot.report[PHASE], pilot.report[REASON] = ABORT, THRUSTER_LOST


def _carry_over(pilot: PilotState, before: Gains, after: Gains) -> None:
    """Let the pilot's memory mean the same with other gains, in place.

    Integrals are kept as speeds, of which the inner loops make accelerations: what holds against
    the current goes on. That of yaw has learned of what the lost thruster left undone.
    """
    pilot.memory[YAW_SUM] = 0.0
    inner = after.axes[SWAY, INNER]
    factor = before.axes[SWAY, INNER] / inner if inner > 0.0 else 0.0
    pilot.memory[[SWAY_SUM_N, SWAY_SUM_E]] *= factor


def _new_world(setup: Setup, thrusters: int) -> World:
    start = np.array([*setup.start_ne_m, 0.0])
    attitude = np.array([0.0, 0.0, setup.start_heading_rad])
    world = World(
        initial_state(start, attitude, thrusters),
        *(np.zeros(size) for size in (13, 13, 6, 6, 6, vector.ESTIMATE, 6)),
    )
    _write_truth(world, setup.current, 0.0)
    world.before[:] = world.now
    return world


def _allocation(setup: Setup) -> Allocation:
    n = len(setup.vehicle.thrusters)
    left = setup.health if setup.known_health is None else setup.known_health
    health = setup.vehicle.health_of(left)
    believed = setup.believed or setup.vehicle
    matrix = np.ascontiguousarray(believed.configuration_matrix)
    weights = LEVEL_WEIGHTS if setup.gains.holds_level else AXIS_WEIGHTS
    return Allocation(
        setup.exact_allocation, believed.plant.propulsion, matrix, weights.copy(), health,
        lower=np.zeros(n), upper=np.zeros(n), weights=np.zeros(n), thrust=np.zeros(n),
        command_rps=np.zeros(n), scratch=allocation_scratch(n),
    )  # fmt: skip


def _new_rows(count: int, thrusters: int) -> TickRows:
    widths = (STATE + thrusters, STATE, LOG_ROW, REPORT, 6, thrusters, thrusters)
    return TickRows(*(np.zeros((count, width)) for width in widths))
