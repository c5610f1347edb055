"""Exported missions, flown by the law of the autopilot that they are for.

    .venv/bin/python -m benchmarks.missions [--quick] [--json FILE]

The paper's survey, 15 x 17 m with lines 1 m apart, is planned once; ALICE and SPARUS II (this one
by COLA2 alone, since ArduSub needs thrusters sideways) fly each format in currents along and across
the lines, with gusts and sensors as by default. Each mission is exported again with its current as
the expected one. For each: cross-track rms on lines, ends of lines overshot, and how much of the
area is seen at the requested overlap, next to the plan's certificate, and where the export warned.
"""

import argparse
import math
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from alice_survey.core.config import SurveyConfig, change_section
from alice_survey.core.errors import keep_warnings
from alice_survey.kit.words import text_table
from alice_survey.sim.vehicle.sea import level_floor
from benchmarks.figures import Figure, Findings, Goal, add_options, hand_over
from benchmarks.machine import heading, machine
from camera_calib.rig import Rig, design_rig
from missions.coverage.certificate import certificate
from missions.coverage.stations import plan_pattern, stations_of_flight
from missions.exports.format import options_of
from missions.exports.write import write_exports
from missions.fly.simulation import (
    PASSED_M,
    flight_settings,
    mission_of_settings,
    overshoot_m,
    simulate_mission,
)
from missions.plan.planner import plan_survey
from missions.values.flight import rms
from missions.values.plan_file import Plan

FORMATS = {
    "cola2": "mission_dive1.xml",
    "wpl": "mission_dive1.waypoints",
    "qgc": "mission_dive1.plan",
}
_SPARE = 0.02
"""How much less than promised may be seen: navigation and gusts."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One flown mission."""

    vehicle: str
    format: str
    current_mps: float
    across: bool
    ending: str
    cross_track_rms_m: float
    line_ends: int
    overshot: int
    promised: float
    """Share of the area at the requested overlap by the plan's certificate."""
    warned: bool
    """Whether the export warned that the promise would not be kept."""
    flown: float

    def figure(self) -> Figure:
        """What is seen, and as its goal what is promised, unless less was said beforehand."""
        goal = None if self.warned else Goal(minimum=100.0 * (self.promised - _SPARE))
        return Figure(
            name=f"{self.vehicle}, {self.format}, {_sea(self)}: at the requested overlap",
            value=100.0 * self.flown,
            unit="%",
            goal=goal,
        )


def main() -> None:
    """Fly all, print the table, and say which missions see less than was said."""
    options = _options()
    about = machine(("numpy", "numba", "scipy"))
    print(heading(about), "\n", flush=True)
    rows = measure(quick=options.quick)
    print(table(rows), flush=True)
    findings = Findings(
        figures=tuple(row.figure() for row in rows),
        failed=tuple(
            f"{r.vehicle}, {r.format}, {_sea(r)}: {r.ending}"
            for r in rows
            if r.ending != "complete"
        ),
    )
    sys.exit(hand_over(options, about, findings, {"rows": [asdict(row) for row in rows]}))


def measure(*, quick: bool) -> list[Row]:
    """Fly every format in every current."""
    config = change_section(SurveyConfig(), "sea", current_sigma_mps=0.0)
    rig = design_rig(config.camera, config.water)
    plan = plan_survey(config, rig).plan
    along_deg = math.degrees(plan.lines[0].heading_rad) % 360.0
    seas = [(0.0, False), (0.1, True)] if quick else _SEAS
    rows = []
    for vehicle in ("alice", "sparus2"):
        flown = ("cola2",) if vehicle == "sparus2" else (("cola2", "qgc") if quick else FORMATS)
        for current, across in seas:
            towards = (along_deg + (90.0 if across else 0.0)) % 360.0
            at = change_section(config, "sea", current_mps=current, current_towards_deg=towards)
            at = change_section(at, "vehicle", name=vehicle)
            rows += [_fly(plan, rig, at, name, across=across) for name in flown]
    return rows


_SEAS = [(0.0, False), (0.1, False), (0.1, True), (0.2, False), (0.2, True)]


def _fly(plan: Plan, rig: Rig, config: SurveyConfig, name: str, *, across: bool) -> Row:
    with tempfile.TemporaryDirectory() as folder:
        options = options_of(config.camera, config.plan, config.vehicle, config.sea)
        with keep_warnings() as warnings:
            write_exports(Path(folder), plan, rig, formats=[name], options=options)
        config = change_section(config, "vehicle", mission_file=Path(folder) / FORMATS[name])
        settings = flight_settings(config)
        floor = level_floor(config.area.seafloor_depth_m)
        flight = simulate_mission(plan, settings, floor, np.random.default_rng(7), label="")
        beyond_m = overshoot_m(mission_of_settings(plan, settings), flight)
    seen = certificate(plan.area, rig, stations_of_flight(flight), plan_pattern(plan, rig))
    return Row(
        vehicle=config.vehicle.name,
        format=name,
        current_mps=config.sea.current_mps,
        across=across,
        ending=flight.ending,
        cross_track_rms_m=rms(flight.line_errors[0]),
        line_ends=len(beyond_m),
        overshot=sum(beyond > PASSED_M for beyond in beyond_m),
        promised=plan.coverage,
        warned=any("COLA2 holds" in text for text in warnings),
        flown=seen.share_at_overlap,
    )


def _sea(row: Row) -> str:
    if row.current_mps == 0.0:
        return "still"
    return f"{row.current_mps:g} m/s {'across' if row.across else 'along'}"


def table(rows: list[Row]) -> str:
    """The rows as a table."""
    header = ("vehicle", "format", "current", "cross-track rms m", "line ends overshot",
              "promised %", "flown %", "ending")  # fmt: skip
    return text_table(header, [
        (
            row.vehicle, row.format, _sea(row), f"{row.cross_track_rms_m:.2f}",
            f"{row.overshot} of {row.line_ends}",
            f"{100 * row.promised:.1f}{', warned' if row.warned else ''}",
            f"{100 * row.flown:.1f}", row.ending,
        )
        for row in rows
    ])  # fmt: skip


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Exported missions as autopilots fly them.")
    add_options(parser, quick="two formats, two currents")
    return parser.parse_args()


if __name__ == "__main__":
    main()
