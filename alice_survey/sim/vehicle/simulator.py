"""The closed loop: navigation, guidance, control, allocation and dynamics, tick by tick.

A tick is 0.05 s: the sensors measure the true state for the navigation, the pilot commands
a wrench, the allocation converts it to thruster speeds, and the equations of motion advance by
five Runge-Kutta steps of 10 ms.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from alice_survey.core.compiled import note_compiling
from alice_survey.core.frames import Array, attitude_from_rotation
from alice_survey.sim.vehicle.compiled import kernel
from alice_survey.sim.vehicle.dynamics import STATE, Plant, Scratch
from alice_survey.sim.vehicle.floor import FloorGrid
from alice_survey.sim.vehicle.navigation.filter import NavigationState
from alice_survey.sim.vehicle.navigation.sensors import Sensors
from alice_survey.sim.vehicle.navigation.tick import LOG_ROW, log_row
from alice_survey.sim.vehicle.pilot.command import Allocation, Pilot, Without, allocate
from alice_survey.sim.vehicle.pilot.gains import Gains
from alice_survey.sim.vehicle.pilot.guidance import steer
from alice_survey.sim.vehicle.pilot.memory import (
    ABORT,
    AT_SURFACE,
    DONE,
    PHASE,
    REASON,
    REPORT,
    SIGMA_M,
    PilotState,
)
from alice_survey.sim.vehicle.pilot.mission import NO_MISSION, PilotMission
from alice_survey.sim.vehicle.pilot.path import Path
from alice_survey.sim.vehicle.pilot.safety import TOUCHED
from alice_survey.sim.vehicle.pilot.settings import Guidance
from alice_survey.sim.vehicle.pilot.thrust_watch import navigated_stretch
from alice_survey.sim.vehicle.pilot.thruster_watch import WATCHED_S, FoundFailure
from alice_survey.sim.vehicle.propulsion import electrical_power
from alice_survey.sim.vehicle.sea import Current, Disturbance
from alice_survey.sim.vehicle.simulated_vehicle import (
    TICK_S,
    Sea,
    SimulatedVehicle,
    World,
    move,
    sense,
    touches,
)
from alice_survey.sim.vehicle.vehicle import Vehicle

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
    wrench: Array,
    allocation: Allocation,
    world: World,
    scratch: Scratch,
    rng: np.random.Generator,
    sea_rng: np.random.Generator,
    rows: TickRows,
) -> int:
    """Fly ticks until the rows are full or the mission is over; return their number."""
    count, flown = rows.state.shape[0], 0
    thrusters, actuators = rows.command_rps.shape[1], allocation.thrust.shape[0]
    for k in range(count):
        tick = first + k
        sense(tick, sea, floor, sensors, navigation, world, rng)
        spread = max(navigation.covariance[0, 0], navigation.covariance[1, 1])
        pilot.memory[SIGMA_M] = math.sqrt(max(spread, 0.0))
        steer(
            tick * TICK_S, TICK_S, world.estimate, path, mission, guidance, gains, pilot, wrench
        )  # fmt: skip
        touched = touches(world.now, sensors, floor)
        if touched:
            pilot.report[PHASE], pilot.report[REASON] = ABORT, TOUCHED
        allocate(wrench, world.estimate, allocation)

        for i in range(STATE + actuators):
            rows.state[k, i] = world.state[i]
        for i in range(STATE):
            rows.truth[k, i] = world.now[i]
        for i in range(6):
            rows.wrench[k, i] = wrench[i]
        for i in range(thrusters):
            rows.command_rps[k, i] = allocation.command[i]
        for i in range(REPORT):
            rows.report[k, i] = pilot.report[i]
        electrical_power(
            plant.propulsion, world.state[STATE:], world.state[7:STATE], rows.power_w[k]
        )
        log_row(navigation, rows.navigation[k])
        flown += 1
        if touched or pilot.report[PHASE] == DONE or pilot.report[AT_SURFACE] == 1.0:
            break

        move(tick, plant, sea, allocation.command, world, scratch, sea_rng)
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
    without: Without | None = None
    """How to go on once failures are found; not looked for if None."""


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A thruster that fails on the way."""

    time_s: float
    thruster: str
    left: float
    """Share of its greatest speed squared that is left; of its thrust if it turns."""
    turns: bool = False
    """Whether it goes on turning as commanded, with the propeller gone or fouled."""


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
        return self.state[:, STATE : STATE + len(self.thrusters)]

    @property
    def fin_rad(self) -> Array:
        """(T, m) angles of the fins."""
        return self.state[:, STATE + len(self.thrusters) :]

    @property
    def energy_j(self) -> Array:
        """(n,) electrical energy of each thruster over the mission."""
        energy: Array = self.power_w.sum(axis=0) * TICK_S
        return energy


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

    note_compiling(_fly_ticks, "the vehicle's model, once: this takes about a minute")
    chunks: list[TickRows] = []
    total = math.ceil((expected_s or max_s) / TICK_S / _CHUNK_TICKS)
    found: list[FoundFailure] = []
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
    found: list[FoundFailure],
) -> Iterator[TickRows]:
    """Rows of a minute each at most, until the mission is over; adds failures that are found."""
    left, pushing = dict(setup.health), dict[str, float]()
    known = setup.health if setup.known_health is None else setup.known_health
    afloat = SimulatedVehicle(
        setup.vehicle, setup.sensors, setup.floor, setup.current, setup.disturbance, rng,
        sea_rng=sea_rng, start_ne_m=setup.start_ne_m, start_heading_rad=setup.start_heading_rad,
        health=left,
    )  # fmt: skip
    pilot = Pilot(
        setup.vehicle, setup.path, setup.gains, setup.guidance,
        exact_allocation=setup.exact_allocation, believed=setup.believed, known_health=known,
        without=setup.without, tick_s=TICK_S,
    )  # fmt: skip
    thrusters, last, first = len(setup.vehicle.thrusters), math.ceil(max_s / TICK_S), 0
    maximum = _CHUNK_TICKS if setup.without is None else _WATCHED_TICKS
    waiting = sorted(setup.failures, key=lambda failure: failure.time_s)
    while first < last:
        while waiting and round(waiting[0].time_s / TICK_S) <= first:
            (pushing if waiting[0].turns else left)[waiting[0].thruster] = waiting[0].left
            afloat.weaken(left, pushing)
            del waiting[0]
        end = min(first + maximum, last)
        if waiting:
            end = min(end, round(waiting[0].time_s / TICK_S))
        rows = _new_rows(end - first, thrusters, setup.vehicle.actuators)
        flown = _fly_ticks(
            first, afloat.plant, afloat.sea, afloat.floor, afloat.sensors, afloat.navigation,
            pilot.path, setup.mission, pilot.guidance, pilot.gains, pilot.state, pilot.wrench,
            pilot.allocation, afloat.world, afloat.scratch, rng, sea_rng, rows,
        )  # fmt: skip
        yield TickRows(*(part[:flown] for part in rows))
        if flown < len(rows.state) or pilot.state.report[REASON] == TOUCHED:
            return
        first = end
        found += pilot.judge(
            first * TICK_S,
            rows.command_rps,
            rows.state[:, STATE : STATE + thrusters],
            navigated_stretch(rows.navigation, afloat.navigation),
        )


def _new_rows(count: int, thrusters: int, actuators: int) -> TickRows:
    widths = (STATE + actuators, STATE, LOG_ROW, REPORT, 6, thrusters, thrusters)
    return TickRows(*(np.zeros((count, width)) for width in widths))
