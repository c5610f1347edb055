"""How many times faster than real time a mission is simulated, and how long the first one waits.

The mission is the paper's: 15 x 17 m, lines 1 m apart, some half an hour. Each tick of 0.05 s has
the sensors and the navigation filter, guidance and control, the exact allocation, and five
Runge-Kutta steps of 10 ms; every tick is recorded. One core; the best run of several counts.
"""

import json
import math
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from alice_survey.core.config import SurveyConfig, change_section
from alice_survey.sim.vehicle.pilot.memory import DONE, PHASE, REASON
from alice_survey.sim.vehicle.pilot.safety import NONE
from alice_survey.sim.vehicle.sea import FloorGrid, level_floor
from alice_survey.sim.vehicle.simulator import Setup, simulate
from benchmarks.figures import Figure, Goal
from camera_calib.rig import design_rig
from missions.fly.simulation import flight_settings, mission_setup
from missions.plan.planner import plan_survey

_MAX_S = 7200.0


@dataclass(frozen=True, kw_only=True)
class Row:
    """One mission."""

    mission: str
    simulated_s: float
    wall_s: float
    complete: bool
    goal: float = 1000.0
    """The least factor that is requested; 2,000 is hoped for."""

    @property
    def factor(self) -> float:
        """Real-time factor."""
        return self.simulated_s / self.wall_s

    def figure(self) -> Figure:
        """The factor and its goal."""
        goal = Goal(minimum=self.goal)
        return Figure(name=self.mission, value=self.factor, unit="times real time", goal=goal)


@dataclass(frozen=True, kw_only=True)
class Start:
    """How long a fresh process waits, s."""

    what: str
    compiling_s: float
    """With nothing compiled before."""
    cached_s: float
    """With the machine code of the process before."""

    def figures(self) -> list[Figure]:
        """Both waits."""
        return [
            Figure(name=f"{self.what}, compiling", value=self.compiling_s, unit="s"),
            Figure(name=f"{self.what}, compiled before", value=self.cached_s, unit="s"),
        ]


def measure(runs: int) -> list[Row]:
    """All missions, each a number of times."""
    calm = SurveyConfig()
    across = change_section(calm, "sea", current_mps=0.1, current_towards_deg=90.0)
    rough = change_section(
        across, "sea", surface_current_mps=0.2, current_sigma_mps=0.03, gust_n=(2.0, 2.0, 1.0)
    )
    sparus = change_section(across, "vehicle", name="sparus2", controller="los")
    level, waves = level_floor(calm.area.seafloor_depth_m), _waves(calm.area.seafloor_depth_m)
    missions = {
        "ALICE, sway controller, 0.1 m/s across": _setup(across, level),
        "the same, shear, gusts, waves of sand": _setup(rough, waves),
        "SPARUS II, heading controller, 0.1 m/s across": _setup(sparus, level),
    }
    return [_fly(name, setup, runs) for name, setup in missions.items()]


def _setup(config: SurveyConfig, floor: FloorGrid) -> Setup:
    plan = plan_survey(config, design_rig(config.camera, config.water)).plan
    return mission_setup(plan, flight_settings(config), floor, _MAX_S, np.random.default_rng(1))


def _waves(depth_m: float) -> FloorGrid:
    places = np.arange(-15.0, 35.0, 0.1)
    waves = 0.15 * np.sin(places[:, None] / 1.3) * np.sin(places[None, :] / 0.9)
    return FloorGrid(-15.0, -15.0, 0.1, depth_m + waves)


def _fly(name: str, setup: Setup, runs: int) -> Row:
    best = math.inf
    for _ in range(runs + 1):
        started = time.perf_counter()
        flown = simulate(setup, np.random.default_rng(2), max_s=_MAX_S, label=name)
        best = min(best, time.perf_counter() - started)
    return Row(
        mission=name,
        simulated_s=float(flown.time_s[-1]),
        wall_s=best,
        complete=bool(flown.report[-1, PHASE] == DONE and flown.report[-1, REASON] == NONE),
    )


_PROGRAM = """
import json, time
started = time.perf_counter()
from benchmarks import vehicle_dynamics
imported = time.perf_counter()
vehicle_dynamics.first_step()
stepped = time.perf_counter()
from benchmarks import vehicle_loop
imported_all = time.perf_counter()
vehicle_loop.first_tick()
print(json.dumps([stepped - imported, time.perf_counter() - imported_all]))
"""


def first_tick() -> None:
    """Compile, or load, all that a mission needs."""
    setup = _setup(SurveyConfig(), level_floor(15.0))
    simulate(setup, np.random.default_rng(2), max_s=0.05, label="first tick")


def starts(cache: Path) -> list[Start]:
    """The first Runge-Kutta step, and the first tick of a mission after it, in fresh processes.

    Args:
        cache: an empty folder for compiled code.
    """
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    seconds = []
    for _ in range(2):
        ran = subprocess.run(
            [sys.executable, "-c", _PROGRAM],
            env=environment,
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
        seconds.append(json.loads(ran.stdout.splitlines()[-1]))
    names = ("first Runge-Kutta step", "first tick of a mission after it")
    return [
        Start(what=what, compiling_s=cold, cached_s=warm)
        for what, cold, warm in zip(names, *seconds, strict=True)
    ]


def table(rows: list[Row]) -> str:
    """The missions in Markdown."""
    lines = [
        "| mission | simulated, s | wall, s | real-time factor | goal |",
        "|---|---|---|---|---|",
    ]
    lines += [
        f"| {row.mission} | {row.simulated_s:.0f} | {row.wall_s:.3f} | {row.factor:,.0f} "
        f"| {row.goal:,.0f} |"
        for row in rows
    ]
    return "\n".join(lines)


def starts_table(rows: list[Start]) -> str:
    """The waits in Markdown."""
    lines = ["| what | compiling, s | compiled before, s |", "|---|---|---|"]
    lines += [f"| {row.what} | {row.compiling_s:.1f} | {row.cached_s:.2f} |" for row in rows]
    return "\n".join(lines)
