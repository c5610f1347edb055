"""The vehicle: whole missions, and the paper's mission in other seas.

    .venv/bin/python -m benchmarks.vehicle [--quick] [--json FILE] [--only PART ...]

`loop`: how many times faster than real time a mission is simulated. It is the paper's: 15 x 17 m,
lines 1 m apart, some half an hour. Each tick of 0.05 s has the sensors and the navigation filter,
guidance and control, the exact allocation, and five Runge-Kutta steps of 10 ms; every tick is
recorded. One core; the best run of several counts. `seas`: see `vehicle_seas`.
Ends with exit code 1 when a goal is missed.
"""

import math
import sys
import time
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from alice_survey.core.config import SurveyConfig, change_section
from alice_survey.sim.vehicle.pilot.memory import DONE, NONE, PHASE, REASON
from alice_survey.sim.vehicle.sea import FloorGrid, level_floor
from alice_survey.sim.vehicle.simulator import Setup, simulate
from benchmarks import vehicle_seas
from benchmarks.figures import Figure, Findings, Goal, Parser, hand_over
from camera_calib.rig import design_rig
from missions.fly.simulation import flight_settings, mission_setup
from missions.plan.planner import plan_survey

_MAX_S = 7200.0
_PARTS = ("loop", "seas")


def main() -> int:
    """Measure, print, and say which goals are missed."""
    parser = Parser(__doc__, quick="fewer and shorter runs")
    parser.add_argument("--only", nargs="+", choices=_PARTS, default=list(_PARTS))
    options, about = parser.begin("numpy", "numba", "scipy")
    report, findings = dict[str, Any](), Findings()
    if "loop" in options.only:
        flights = measure(1 if options.quick else 5)
        report["loop"] = [{**asdict(row), "factor": row.factor} for row in flights]
        findings += Findings(
            figures=tuple(flight.figure() for flight in flights),
            failed=tuple(f"{f.mission}: was broken off" for f in flights if not f.complete),
        )
    if "seas" in options.only:
        seas = vehicle_seas.measure(1 if options.quick else 5)
        report["seas"] = [asdict(row) for row in seas]
        findings += Findings(figures=tuple(vehicle_seas.figures(seas)))
    return hand_over(options, about, findings, report)


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


if __name__ == "__main__":
    sys.exit(main())
