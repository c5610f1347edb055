"""Exported missions, flown by the law of the autopilot that they are for.

    .venv/bin/python -m benchmarks.missions [--quick] [--json FILE]

The paper's survey, 15 x 17 m with lines 1 m apart, is planned once; ALICE and SPARUS II (this one
by COLA2 alone, since ArduSub needs thrusters sideways) fly each format in currents along and across
the lines, with gusts and sensors as by default. Each mission is exported again with its current as
the expected one. For each: cross-track rms on lines, ends of lines overshot, and how much of the
area is seen at the requested overlap, next to the plan's certificate, and where the export warned.

A survey of 8 x 2 m is planned over floors that a bathymetry holds: flat, slopes and a wall. ALICE
flies its missions over them, with sand and rocks on top, in still water and 0.1 m/s across, or
their export is refused. Nothing may touch.
"""

import math
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from pyproj import Transformer

from alice_survey.core.config import AreaConfig, SurveyConfig, change_section, parse_config
from alice_survey.core.errors import PlanError, keep_warnings
from alice_survey.core.frames import Array
from alice_survey.core.records import FlightRecord
from alice_survey.sim.vehicle.pilot.memory import REASONS, TOUCHED
from alice_survey.sim.vehicle.sea import FloorGrid, level_floor
from benchmarks.figures import Figure, Findings, Goal, Parser, hand_over, markdown
from camera_calib.rig import design_rig
from missions.exports.format import options_of
from missions.exports.write import write_exports
from missions.fly.run import flight_summary
from missions.fly.simulation import (
    PASSED_M,
    flight_settings,
    mission_of_settings,
    overshoot_m,
    simulate_mission,
    true_floor,
)
from missions.plan.planner import plan_survey
from missions.stages import FLY
from missions.values.flight import rms
from missions.values.plan_file import Plan

FORMATS = {
    "cola2": "mission_dive1.xml", "wpl": "mission_dive1.waypoints", "qgc": "mission_dive1.plan",
}  # fmt: skip
_LEVEL = "level"
_UTM = "EPSG:32636"
_SPARE = 0.02
"""How much less than promised may be seen: navigation and gusts."""


_SEAS = [(0.0, False), (0.1, False), (0.1, True), (0.2, False), (0.2, True)]
_SMALL = {"length_m": 8.0, "width_m": 2.0, "heading_deg": 0.0, "seafloor_depth_m": 16.0}
_CELL_M, _CELLS = 0.25, 240
_FLOORS: dict[str, Callable[[Array, Array], Any]] = {
    "flat": lambda north, east: 0.0 * north,
    "8.5 deg along the lines": lambda north, east: 0.15 * (north - 4.0),
    "30 deg along the lines": lambda north, east: math.tan(math.radians(30.0)) * (north - 4.0),
    "6 m wall across the lines": lambda north, east: 6.0 * (north > 4.0),
    "6 m wall along the lines": lambda north, east: 6.0 * (east > 2.7),
}
"""How far they rise above 16 m."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One flown mission."""

    floor: str
    """Level, or one of `_FLOORS`."""
    vehicle: str
    format: str
    sea: str
    ending: str
    """Or why the export was refused."""
    promised: float
    """Share of the area at the requested overlap by the plan's certificate."""
    cross_track_rms_m: float = math.nan
    line_ends: int = 0
    overshot: int = 0
    warned: bool = False
    """Whether the export warned that the promise would not be kept."""
    flown: float = math.nan
    clearance_m: float = math.nan
    """Least of hull, port and DVL."""
    outside_m: float = math.nan
    """Farthest that the left port was out of the allowed area."""
    expected_outside_m: float = math.nan
    """How far it was expected to be at most."""
    shortfall: str = ""
    """Why `fly` ends with exit code 3; empty with 0."""

    def figure(self) -> Figure:
        """What is seen of what is promised, unless less was said; over terrain the clearance."""
        name = f"{self.vehicle}, {self.format}, {self.sea}"
        if self.floor != _LEVEL:
            name, above = f"{self.floor}: {name}, least clearance", Goal(minimum=0.1)
            return Figure(name=name, value=self.clearance_m, unit="m", goal=above)
        goal = None if self.warned else Goal(minimum=100.0 * (self.promised - _SPARE))
        seen = 100.0 * self.flown
        return Figure(name=f"{name}: at the requested overlap", value=seen, unit="%", goal=goal)

    def cells(self) -> dict[str, str]:
        """A row of the table."""
        shares = {
            "promised %": f"{100 * self.promised:.1f}{', warned' if self.warned else ''}",
            "flown %": f"{100 * self.flown:.1f}",
            "out of the area m": f"{self.outside_m:.2f} of {self.expected_outside_m:.2f}",
        }
        if self.floor == _LEVEL:
            return {
                "vehicle": self.vehicle, "format": f"`{self.format}`", "current": self.sea,
                "cross-track rms m": f"{self.cross_track_rms_m:.2f}",
                "line ends overshot": f"{self.overshot} of {self.line_ends}", **shares,
            }  # fmt: skip
        return {
            "floor": self.floor, "format": f"`{self.format}`", "current": self.sea,
            "least clearance m": f"{self.clearance_m:.2f}", **shares,
            "outcome": self.shortfall or self.ending,
        }  # fmt: skip


def main() -> None:
    """Fly all, print the tables, and say which missions see less than was said, or touch."""
    parser = Parser(__doc__, quick="two formats, two currents, two floors")
    options, about = parser.begin("numpy", "numba", "scipy")
    level, terrain = measure(quick=options.quick), over_terrain(quick=options.quick)
    for rows in (level, terrain):
        print(*markdown([row.cells() for row in rows]), sep="\n", flush=True)
    ended = [r for r in level if r.ending != "complete" or r.outside_m > r.expected_outside_m]
    ended += [row for row in terrain if row.ending.endswith(REASONS[TOUCHED])]
    failed = tuple(f"{row.figure().name}: {row.ending}" for row in ended)
    flown = [row for row in (*level, *terrain) if math.isfinite(row.flown)]
    findings = Findings(figures=tuple(row.figure() for row in flown), failed=failed)
    kept = {"level": [*map(asdict, level)], "terrain": [*map(asdict, terrain)]}
    sys.exit(hand_over(options, about, findings, kept))


def measure(*, quick: bool) -> list[Row]:
    """Fly every format in every current."""
    config = change_section(SurveyConfig(), "sea", current_sigma_mps=0.0)
    plan = _planned(config)
    seas = [(0.0, False), (0.1, True)] if quick else _SEAS
    floor, rows = level_floor(config.area.seafloor_depth_m), []
    for vehicle in ("alice", "sparus2"):
        flown = ("cola2",) if vehicle == "sparus2" else (("cola2", "qgc") if quick else FORMATS)
        at = change_section(config, "vehicle", name=vehicle)
        rows += [_fly(plan, at, name, sea, (_LEVEL, floor)) for sea in seas for name in flown]
    return rows


def over_terrain(*, quick: bool) -> list[Row]:
    """Fly every format over every floor, in still water and in a current across."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in [*_FLOORS][2:4] if quick else _FLOORS:
            raster = Path(folder) / "floor.tif"
            _write_floor(raster, _FLOORS[name])
            config = parse_config({"area": {**_SMALL, "bathymetry_file": raster}}, "missions")
            for sea in ((0.0, False), (0.1, True)):
                plan = _planned(at := _in_current(config, _planned(config), sea))
                floor = name, true_floor(plan, flight_settings(at))
                rows += [_fly(plan, at, kind, sea, floor) for kind in FORMATS]
    return rows


def _write_floor(path: Path, rise: Callable[[Array, Array], Any]) -> None:
    """A GeoTIFF of depths, in UTM, with the datum of the area in its middle."""
    area, half_m = AreaConfig(), 0.5 * _CELLS * _CELL_M
    places = (np.arange(_CELLS) + 0.5) * _CELL_M - half_m
    depth = _SMALL["seafloor_depth_m"] - rise(*np.meshgrid(-places, places, indexing="ij"))
    to_utm = Transformer.from_crs("EPSG:4326", _UTM, always_xy=True)
    x, y = to_utm.transform(area.longitude_deg, area.latitude_deg)
    corner = rasterio.transform.from_origin(x - half_m, y + half_m, _CELL_M, _CELL_M)
    size: dict[str, Any] = {"width": _CELLS, "height": _CELLS, "count": 1, "dtype": "float64"}
    with rasterio.open(path, "w", driver="GTiff", crs=_UTM, transform=corner, **size) as file:
        file.write(depth, 1)
        file.update_tags(1, positive="down")


def _planned(config: SurveyConfig) -> Plan:
    return plan_survey(config, design_rig(config.camera, config.water)).plan


def _in_current(config: SurveyConfig, plan: Plan, sea: tuple[float, bool]) -> SurveyConfig:
    """Settings of the same lines, and of a sea whose current flows along or across them."""
    heading = math.degrees(plan.lines[0].heading_rad) % 360.0
    towards = (heading + 90.0 * sea[1]) % 360.0
    config = change_section(config, "plan", line_heading_deg=heading)
    return change_section(config, "sea", current_mps=sea[0], current_towards_deg=towards)


def _fly(
    plan: Plan, config: SurveyConfig, name: str, sea: tuple[float, bool],
    over: tuple[str, FloorGrid],
) -> Row:  # fmt: skip
    """Export a plan for its current, along or across its lines, and fly it over a floor."""
    (mps, across), (floor_name, floor) = sea, over
    words = f"{mps:g} m/s {'across' if across else 'along'}" if mps else "still"
    config = _in_current(config, plan, sea)
    rig = design_rig(config.camera, config.water)
    row = Row(
        floor=floor_name, vehicle=config.vehicle.name, format=name, sea=words, ending="",
        promised=plan.coverage,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as directory:
        folder = Path(directory)
        options = options_of(config.camera, config.plan, config.vehicle, config.sea)
        try:
            with keep_warnings() as warnings:
                write_exports(folder, plan, rig, formats=[name], options=options)
        except PlanError as error:
            return replace(row, ending=f"refused: {error}")
        config = change_section(config, "vehicle", mission_file=folder / FORMATS[name])
        settings = flight_settings(config)
        flight = simulate_mission(plan, settings, floor, np.random.default_rng(7), label="")
        beyond_m = overshoot_m(mission_of_settings(plan, settings), flight)
        summary = flight_summary(flight, config.vehicle, rig)
        FlightRecord.save(folder / "flight.json", summary)
        shortfall = FLY.shortfall(folder)
    return replace(
        row,
        ending=flight.ending,
        cross_track_rms_m=rms(flight.line_errors[0]),
        line_ends=len(beyond_m),
        overshot=sum(beyond > PASSED_M for beyond in beyond_m),
        warned=any("COLA2 holds" in text for text in warnings),
        flown=summary["coverage"]["share_at_overlap"],
        clearance_m=flight.clearance_m,
        outside_m=float(flight.outside_m.max()),
        expected_outside_m=flight.allowed_outside_m,
        shortfall=shortfall,
    )


if __name__ == "__main__":
    main()
