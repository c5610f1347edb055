"""A small closed loop for the pilot: true state, exact wrench with its lag, full dynamics."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

from alice_survey.core.compiled import kernel
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import dynamics
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot.gains import DEGREES, LAG, Gains, gains_for
from alice_survey.sim.vehicle.pilot.guidance import steer
from alice_survey.sim.vehicle.pilot.memory import PilotState, new_pilot
from alice_survey.sim.vehicle.pilot.mission import NO_MISSION
from alice_survey.sim.vehicle.pilot.path import Path, path_from_legs
from alice_survey.sim.vehicle.pilot.settings import Guidance, Tick, pilot_guidance
from alice_survey.sim.vehicle.rotations import matrix_rows
from alice_survey.sim.vehicle.sea import Current, current_at
from alice_survey.sim.vehicle.vehicle import vehicle_from
from tests.alice_survey.sim.vehicle import motions

Controller = Literal["sway", "los"]
TICK_S = 0.05
STEPS = 5
DEEPEST_M = 40.0


@kernel
def estimate_truth(state: Array, water: Array, point: Array, floor: Array, out: Array) -> None:
    """Write the true state as a navigation would: floor is depth, slope to north, lock or not."""
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = matrix_rows(
        state[3], state[4], state[5], state[6]
    )
    for i in range(3):
        out[i] = state[i]
        out[9 + i] = state[10 + i]
    out[3], out[4], out[5] = math.atan2(r21, r22), -math.asin(r20), math.atan2(r10, r00)
    out[6] = state[7] + r00 * water[0] + r10 * water[1]
    out[7] = state[8] + r01 * water[0] + r11 * water[1]
    out[8] = state[9] + r02 * water[0] + r12 * water[1]
    north = state[0] + r00 * point[0] + r01 * point[1] + r02 * point[2]
    depth = state[2] + r20 * point[0] + r21 * point[1] + r22 * point[2]
    out[12] = floor[0] + floor[1] * north - depth if floor[2] > 0.0 else math.nan
    out[13] = out[12]


@kernel
def _fly(
    first: int,
    state: Array,
    load: Array,
    floor: Array,
    keep: Array,
    plant: dynamics.Plant,
    current: Current,
    tick: Tick,
    scratch: dynamics.Scratch,
    room: Array,
    rows: Array,
) -> None:
    wrench, water, command = room[:6], room[6:12], room[12:]
    estimate, report, step = tick.estimate, tick.pilot.report, 0.05 / 5
    for k in range(rows.shape[0]):
        time_s = (first + k) * 0.05
        current_at(current, time_s, state[2], water)
        estimate_truth(state, water, tick.guidance.point_body_m, floor, estimate)
        steer(time_s, tick, NO_MISSION, wrench)
        rows[k, 0] = time_s
        for i in range(14):
            rows[k, 1 + i] = estimate[i]
        for i in range(13):
            rows[k, 15 + i] = report[i]
        for i in range(6):
            rows[k, 28 + i] = wrench[i]
        for i in range(5):
            for j in range(6):
                load[j] = wrench[j] + keep[j] * (load[j] - wrench[j])
            dynamics.rk4_step(
                time_s + i * step, step, state, command, load, plant, current, scratch
            )


@dataclass(eq=False)
class Flight:
    """A vehicle under way; `fly` takes it further."""

    path: Path
    guidance: Guidance
    gains: Gains
    plant: dynamics.Plant
    current: Current
    state: Array
    floor: Array
    pilot: PilotState
    load: Array
    ticks: int = 0

    def fly(self, seconds: float) -> "Rows":
        """Fly on."""
        rows = np.zeros((round(seconds / TICK_S), 34))
        thrusters = len(self.state) - 13
        lag_s = np.zeros(6)
        lag_s[list(DEGREES)] = np.maximum(self.gains.axes[: len(DEGREES), LAG] - TICK_S / 2, 0.0)
        keep = np.exp(-TICK_S / STEPS / np.maximum(lag_s, 1e-6))
        _fly(
            self.ticks, self.state, self.load, self.floor, keep, self.plant, self.current,
            Tick(TICK_S, np.zeros(14), self.path, self.guidance, self.gains, self.pilot),
            dynamics.scratch_for(thrusters), np.zeros(12 + thrusters), rows,
        )  # fmt: skip
        self.ticks += len(rows)
        return Rows(rows)


@dataclass(eq=False)
class Rows:
    """What happened, tick by tick."""

    table: Array

    @property
    def time_s(self) -> Array:
        return self.table[:, 0]

    @property
    def estimate(self) -> Array:
        return self.table[:, 1:15]

    @property
    def report(self) -> Array:
        return self.table[:, 15:28]

    @property
    def wrench(self) -> Array:
        return self.table[:, 28:]

    def on_lines(self) -> "Rows":
        """The part on survey lines."""
        following = self.report[:, slot.PHASE] == slot.FOLLOW
        return Rows(self.table[following & (self.report[:, slot.LINE] >= 0)])

    @property
    def cross_m(self) -> Array:
        return self.report[:, slot.CROSS]

    @property
    def heading_error_rad(self) -> Array:
        off = self.estimate[:, vector.HEADING] - self.report[:, slot.PATH_HEADING]
        return np.asarray(np.angle(np.exp(1j * off)))

    def phases(self) -> list[int]:
        """Phases in the order in which they came."""
        phase = self.report[:, slot.PHASE].astype(int)
        return [int(phase[0]), *(int(p) for p in phase[1:][np.diff(phase) != 0])]


def steered(
    path: Path,
    guidance: Guidance,
    gains: Gains,
    pilot: PilotState,
    estimate: Array,
    time_s: float = 0.0,
) -> Array:
    """The wrench, (6,), of one tick."""
    wrench = np.full(6, math.nan)
    steer(time_s, Tick(TICK_S, estimate, path, guidance, gains, pilot), NO_MISSION, wrench)
    return wrench


@cache
def gains_of(name: str, speed_mps: float = 0.2) -> Gains:
    return gains_for(vehicle_from(name), speed_mps)


def guidance_of(path: Path, name: str, controller: Controller) -> Guidance:
    gains = gains_of(name, path.speed_mps)
    return pilot_guidance(gains, path, controller, max_depth_m=DEEPEST_M)


@cache
def straight(length_m: float, heading_rad: float = 0.0, speed_mps: float = 0.2) -> Path:
    return path_from_legs([(0.0, 0.0)], [heading_rad], [length_m], [0.0], [0], 2.0, speed_mps)


@cache
def guidance_along(name: str, controller: Controller) -> Guidance:
    """For a straight path of 20 m."""
    return guidance_of(straight(20.0), name, controller)


Move = tuple[str, float] | tuple[str, float, int]


def lawnmower(lines: int, length_m: float, speed_mps: float = 0.2) -> Path:
    """Lines 1 m apart, to and fro along north, with half circles between their run-ins."""
    moves: list[Move] = []
    for i in range(lines):
        half_circle = ("arc", math.pi if i % 2 == 0 else -math.pi)
        moves += [("go", 0.5), ("go", length_m, i), ("go", 0.5), half_circle]
    return with_stops(moves[:-1], (-0.5, 0.0), speed_mps)


def with_stops(
    moves: Sequence[Move], start_ne: tuple[float, float] = (0.0, 0.0), speed_mps: float = 0.2
) -> Path:
    """A path of moves, northwards first.

    ("go", m) with a line's index if it is one, ("arc", rad) of 0.5 m, ("spot", rad), ("step", m).
    """
    place, heading = np.array(start_ne), 0.0
    rows = []
    for kind, amount, *line in moves:
        turn = amount if kind == "spot" else 0.0
        side = -math.copysign(math.pi / 2, amount) if kind == "step" else 0.0
        arc = amount if kind == "arc" else 0.0
        length = {"spot": 0.0, "arc": abs(arc) / 2}.get(kind, abs(amount))
        curvature = math.copysign(2.0, arc) if arc else 0.0
        course = heading - side
        rows.append((tuple(place), course, length, curvature, line[0] if line else -1, turn, side))
        chord = length * np.sinc(arc / (2 * math.pi))
        middle = course + arc / 2
        place = place + chord * np.array([math.cos(middle), math.sin(middle)])
        heading += turn + arc
    start, headings, lengths, curvatures, lines, turns, sides = zip(*rows, strict=True)
    return path_from_legs(start, headings, lengths, curvatures, lines, 2.0, speed_mps, turns, sides)


def launch(
    path: Path,
    name: str = "alice",
    controller: Controller = "sway",
    *,
    current: tuple[float, float] = (0.0, 0.0),
    at_ned: tuple[float, float, float] = (0.0, 0.0, 0.0),
    heading_rad: float = 0.0,
    floor_m: float = 15.0,
    slope: float = 0.0,
    following: bool = False,
) -> Flight:
    """A vehicle at rest over a plane; `following`: at depth, with the path begun."""
    craft, gains = vehicle_from(name), gains_of(name, path.speed_mps)
    guidance = guidance_of(path, name, controller)
    pilot = new_pilot()
    if following:
        pilot.report[slot.PHASE] = slot.FOLLOW
        at_ned = (at_ned[0], at_ned[1], floor_m - path.altitude_m - guidance.point_body_m[2])
    n = len(craft.thrusters)
    return Flight(
        path, guidance, gains, craft.plant, motions.constant_current(*current),
        dynamics.initial_state(np.array(at_ned), np.array([0.0, 0.0, heading_rad]), n),
        np.array([floor_m, slope, 1.0]), pilot, np.zeros(6),
    )  # fmt: skip
