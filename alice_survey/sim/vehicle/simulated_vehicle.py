"""A vehicle in its sea: it senses and moves, tick by tick, under the commands of any pilot.

A tick is 0.05 s: the sensors measure the true state for the navigation, and the equations of motion
advance by five Runge-Kutta steps of 10 ms.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.compiled import kernel
from alice_survey.sim.vehicle.dynamics import (
    STATE,
    Plant,
    Scratch,
    initial_state,
    rk4_step,
    scratch_for,
)
from alice_survey.sim.vehicle.floor import FloorGrid, floor_depth
from alice_survey.sim.vehicle.navigation.filter import NavigationState, new_navigation
from alice_survey.sim.vehicle.navigation.sensors import DVL, FOLLOWED, Sensors
from alice_survey.sim.vehicle.navigation.tick import navigation_tick
from alice_survey.sim.vehicle.propulsion import weakened, without_thrust
from alice_survey.sim.vehicle.rotations import matrix_rows
from alice_survey.sim.vehicle.sea import Current, Disturbance, current_at
from alice_survey.sim.vehicle.vehicle import Vehicle

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


@kernel
def touches(now: Array, sensors: Sensors, floor: FloorGrid) -> bool:
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
def sense(
    tick: int,
    sea: Sea,
    floor: FloorGrid,
    sensors: Sensors,
    navigation: NavigationState,
    world: World,
    rng: np.random.Generator,
) -> None:
    """Write the truth of a tick, and what the navigation makes of its sensors."""
    time_s = tick * TICK_S
    _write_truth(world, sea.current, time_s)
    navigation_tick(
        time_s, tick, TICK_S, world.before, world.now, world.water, floor, sensors,
        navigation, rng, world.estimate,
    )  # fmt: skip


@kernel
def move(
    tick: int,
    plant: Plant,
    sea: Sea,
    command: Array,
    world: World,
    scratch: Scratch,
    sea_rng: np.random.Generator,
) -> None:
    """Advance the vehicle from a tick to the next under commanded speeds and angles, (n + m,)."""
    time_s = tick * TICK_S
    for i in range(STATE):
        world.before[i] = world.now[i]
    kept = math.sqrt(1.0 - sea.gust_decay * sea.gust_decay)
    for i in range(6):
        world.gust[i] = sea.gust_decay * world.gust[i] + kept * sea_rng.standard_normal()
        world.load[i] = sea.gust_sigma[i] * world.gust[i]
    step = TICK_S / STEPS
    for i in range(STEPS):
        rk4_step(
            time_s + i * step, step, world.state, command, world.load, plant, sea.current,
            scratch,
        )  # fmt: skip


class SimulatedVehicle:
    """A vehicle in its sea, with its sensors and the state of both."""

    def __init__(
        self,
        vehicle: Vehicle,
        sensors: Sensors,
        floor: FloorGrid,
        current: Current,
        disturbance: Disturbance,
        rng: np.random.Generator,
        *,
        sea_rng: np.random.Generator | None = None,
        start_ne_m: tuple[float, float] = (0.0, 0.0),
        start_heading_rad: float = 0.0,
        health: Mapping[str, float] | None = None,
    ) -> None:
        """Put a vehicle at rest on the surface.

        Args:
            vehicle: with all its thrusters.
            sensors: its instruments.
            floor: the sea floor.
            current: the water.
            disturbance: the gusts.
            rng: source of all noise.
            sea_rng: source of the gusts; `rng` if not given.
            start_ne_m: where the body's origin is.
            start_heading_rad: where it heads.
            health: as of `Vehicle.health_of`.

        Raises:
            VehicleError: a thruster that is named is not one of the vehicle's.
        """
        self.vehicle, self.sensors, self.floor = vehicle, sensors, floor
        self.rng, self.sea_rng = rng, sea_rng or rng
        self.tick = 0
        self.weaken(health or {})
        decay = math.exp(-TICK_S / max(disturbance.correlation_s, 1e-9))
        self.sea = Sea(current, np.array(disturbance.sigma), decay)
        attitude = np.array([0.0, 0.0, start_heading_rad])
        self.world = World(
            initial_state(np.array([*start_ne_m, 0.0]), attitude, vehicle.actuators),
            *(np.zeros(size) for size in (13, 13, 6, 6, 6, vector.ESTIMATE)),
        )
        _write_truth(self.world, current, 0.0)
        self.world.before[:] = self.world.now
        self.navigation = new_navigation(sensors, self.world.now, rng)
        self.scratch = scratch_for(vehicle.actuators)

    def weaken(self, left: Mapping[str, float], pushing: Mapping[str, float] | None = None) -> None:
        """Leave thrusters a share of their speed squared, or of their thrust at all speeds.

        Args:
            left: as of `Vehicle.health_of`.
            pushing: the same, of propellers that turn as before.
        """
        sound = self.vehicle.plant
        slower = weakened(sound.propulsion, self.vehicle.health_of(left))
        propulsion = without_thrust(slower, self.vehicle.health_of(pushing or {}))
        self.plant = sound._replace(propulsion=propulsion)

    def sense(self) -> Array:
        """Measure at this tick; the navigation's estimate, as `estimate_vector` has it."""
        sense(
            self.tick, self.sea, self.floor, self.sensors, self.navigation, self.world, self.rng
        )  # fmt: skip
        return self.world.estimate

    @property
    def touches_floor(self) -> bool:
        """Whether hull, DVL or port is on the sea floor, or in it."""
        return bool(touches(self.world.now, self.sensors, self.floor))

    def move(self, command: Array) -> None:
        """Advance to the next tick under commands (n + m,): speeds in rev/s, angles in rad."""
        move(
            self.tick, self.plant, self.sea, command, self.world, self.scratch, self.sea_rng
        )  # fmt: skip
        self.tick += 1
