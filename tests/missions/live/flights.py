"""A small plan, and a vehicle in the water that a pilot's loop can fly, tick by tick."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from alice_survey.core.artefacts import read_csv, write_json
from alice_survey.core.config import SurveyConfig
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.sea import level_floor
from alice_survey.sim.vehicle.simulator import SimulatedVehicle
from missions.fly.simulation import flight_settings, mission_setup
from missions.live.mission import LinkLimits, LiveMission, Odometry, mission_of
from missions.values.flight import trigger_times
from missions.values.plan_file import Plan
from tests.missions.flown_plans import Move, plan_of, walk

FLOOR_M = 6.0
START_S = 100.0
"""The clock's time at the first tick."""


def small_plan() -> Plan:
    """Two lines of 4 m, 1 m apart, in water of 6 m."""
    turn: list[Move] = [("spot", 90.0), ("go", 1.0), ("spot", 90.0)]
    moves: list[Move] = [("line", 4.0, 0), *turn, ("line", 4.0, 1)]
    return plan_of([walk((0.0, 0.0), 0.0, moves)])


def workspace_in(folder: Path) -> Path:
    """A workspace with the small plan."""
    write_json(folder / "plan" / "plan.json", small_plan().to_json())
    (folder / "survey.toml").write_text("seed = 5\n[area]\nseafloor_depth_m = 6.0\n")
    return folder


def pictures_of(record: Path, shift_s: float = 0.0) -> tuple[Array, tuple[int, ...]]:
    """Times and lines of pictures of the small plan by a pilot's record, its clock shifted."""
    _, rows = read_csv(record)
    names = ("time_s", "line", "glass_north_m", "glass_east_m")
    found = np.array([[float(row[name] or "nan") for name in names] for _, row in rows])
    known = found[np.isfinite(found[:, 2])]
    return trigger_times(small_plan(), known[:, 0] + shift_s, known[:, 1], known[:, 2:])


def vehicle_afloat(plan: Plan, survey: SurveyConfig, seed: int = 1) -> SimulatedVehicle:
    """The vehicle at the start of a plan."""
    rng = np.random.default_rng(seed)
    setup = mission_setup(plan, flight_settings(survey), level_floor(FLOOR_M), 1000.0, rng)
    return SimulatedVehicle(setup, rng)


class LoopFlight:
    """A loop that flies a simulated vehicle by its true motion; tests spoil what it hears."""

    def __init__(self, **limits: Any) -> None:
        survey, self.plan = SurveyConfig(), small_plan()
        self.vehicle = vehicle_afloat(self.plan, survey)
        link = LinkLimits(**limits)
        self.mission: LiveMission = mission_of(self.plan, flight_settings(survey), link)
        self.loop = self.mission.loop
        self.glass: list[Array] = []
        self.clock_offset_s = 0.0

    @property
    def now_s(self) -> float:
        return START_S + 0.05 * self.vehicle.tick + self.clock_offset_s

    @property
    def truth(self) -> Array:
        """(13,) position, quaternion, velocity over ground in NED, body rates."""
        return self.vehicle.world.now

    def true_odometry(self, stamp_s: float | None = None) -> Odometry:
        truth = self.truth.copy()
        velocity = Rotation.from_quat(truth[3:7]).inv().apply(truth[7:10])
        stamp = self.now_s if stamp_s is None else stamp_s
        return Odometry(
            stamp_s=stamp, position_ned=truth[:3], quaternion_xyzw=truth[3:7],
            velocity_body=velocity, rates_body=truth[10:],
        )  # fmt: skip

    def true_range(self) -> float:
        """Of the altimeter at the DVL's place to the level floor."""
        turn = Rotation.from_quat(self.truth[3:7])
        place = SurveyConfig().camera.dvl_position_body_m
        down = float(turn.apply([0.0, 0.0, 1.0])[2])
        return float(FLOOR_M - self.truth[2] - turn.apply(place)[2]) / down

    def ticks(self, count: int, **spoilt: Any) -> None:
        for _ in range(count):
            self.tick(**spoilt)

    def tick(self, *, odometry: Odometry | str = "true", altitude: bool = True) -> None:
        """A tick: `odometry` may be another, or "none"."""
        self.vehicle.sense()
        if isinstance(odometry, Odometry):
            self.loop.hear_odometry(odometry, self.now_s)
        elif odometry == "true":
            self.loop.hear_odometry(self.true_odometry(), self.now_s)
        if altitude:
            self.loop.hear_range(self.now_s, self.true_range(), self.now_s)
        self.command = self.mission.tick(self.now_s)
        point = SurveyConfig().camera.position_body_m
        self.glass.append(self.truth[:3] + Rotation.from_quat(self.truth[3:7]).apply(point))
        self.vehicle.move(self.command.rps)

    def until(self, phase: str, max_s: float = 400.0) -> None:
        """Fly until the guidance is in a phase."""
        for _ in range(math.ceil(max_s / 0.05)):
            if self.mission.phase == phase:
                return
            self.tick()
        raise AssertionError(f"no {phase} within {max_s} s, but {self.mission.phase}")
