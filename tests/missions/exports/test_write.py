import csv
import math
import re
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from alice_survey.core.artefacts import read_csv, write_json
from alice_survey.core.config import VehicleConfig, parse_config
from alice_survey.core.errors import PlanError
from missions.exports import formats
from missions.exports.geometry import CameraMount
from missions.exports.registry import format_names, read_mission
from missions.exports.waypoints import DEPTH_STEP_M, bends, min_clearance_by_depth, waypoints
from missions.exports.write import export_report, write_exports
from missions.route.terrain import (
    Reach,
    TerrainLimits,
    line_profiles,
    terrain_figures,
    way_depths_m,
)
from missions.values.plan_file import Plan
from tests.missions.areas.sites import floor_of
from tests.missions.exports.plans import RIG, line, plan_of, small_plan
from tests.missions.exports.readers import local_ne
from tests.missions.test_own_vehicle import HEAVY


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_every_format_is_written_the_same_twice(tmp_path: Path) -> None:
    plan = small_plan()
    first = write_exports(tmp_path / "a", plan, RIG)
    second = write_exports(tmp_path / "b", plan, RIG)

    names = {path.name for path in first}
    for stem in ("mission_dive{}.xml", "mission_dive{}.plan", "mission_dive{}.waypoints"):
        assert {stem.format(1), stem.format(2)} < names
    assert {"plan.kml", "plan.gpx", "plan.geojson", "lines.csv", "stations.csv",
            "waypoints.csv", "about.txt"} < names  # fmt: skip
    assert names == {path.name for path in (tmp_path / "a").iterdir()}
    for one, two in zip(first, second, strict=True):
        assert one.read_bytes() == two.read_bytes()


def test_tables_do_not_hold_all_stations_at_once(tmp_path: Path) -> None:
    plan = small_plan()
    many = replace(plan, lines=(replace(plan.lines[0], stations=20_000), *plan.lines[1:]))
    write_exports(tmp_path, plan, RIG, formats=["csv"])  # what it imports is not counted
    tracemalloc.start()
    write_exports(tmp_path, many, RIG, formats=["csv"])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(rows(tmp_path / "stations.csv")) == many.stations
    assert peak < 500 * many.stations


def test_stations_and_waypoints_in_tables(tmp_path: Path) -> None:
    plan = small_plan()
    write_exports(tmp_path, plan, RIG, formats=["csv"])
    stations, points = rows(tmp_path / "stations.csv"), rows(tmp_path / "waypoints.csv")

    wanted = np.vstack([line.stations_ne for line in plan.lines])

    def ne(row: dict[str, str], of: str = "") -> tuple[float, float]:
        latitude, longitude = (float(row[f"{of}{name}_deg"]) for name in ("latitude", "longitude"))
        return local_ne(plan.datum, latitude, longitude)

    np.testing.assert_allclose([ne(row) for row in stations], wanted, atol=1e-3)
    assert [int(row["dive"]) for row in stations] == [1] * 33 + [2] * 31
    assert {row["altitude_m"] for row in stations} == {"2.000"}

    assert [int(row["number"]) for row in points] == list(range(1, len(points) + 1))
    assert {row["speed_mps"] for row in points} == {"0.2"}
    ends = [row for row in points if row["action"] == "line, camera off"]
    assert [int(row["line"]) for row in ends] == list(range(6))
    arms_m = [math.dist(ne(row), ne(row, "vehicle_")) for row in points]
    assert arms_m == pytest.approx([math.hypot(0.55, 0.05)] * len(points), abs=1e-3)
    assert points[-1]["depth_m"] == "0.000"


def test_the_report_takes_the_mount_from_the_settings_of_the_plan(tmp_path: Path) -> None:
    folder = tmp_path / "plan"
    write_json(folder / "plan.json", small_plan().to_json())
    with pytest.raises(PlanError):
        export_report(folder / "plan.json")

    config = parse_config({"camera": {"position_body_m": [0.7, -0.1, 0.05]}}, "test")
    settings = {name: getattr(config, name).model_dump(mode="json") for name in ("camera", "water")}
    settings["vehicle"] = VehicleConfig(name="own.toml").model_dump(mode="json")
    (tmp_path / "own.toml").write_bytes(HEAVY.read_bytes())
    entry = [1, 1, ""]  # files are known by their names, and by their way from the workspace
    write_json(folder / "stage.json", {"settings": settings, "inputs": {"own.toml": entry}})
    text, about = export_report(folder / "plan.json", ["wpl", "csv"])
    given, _ = export_report(folder, ["wpl", "csv"], tmp_path / "other")

    assert len(about["files"]) == 7
    assert text.splitlines()[1:] == given.splitlines()[1:]
    stated = (folder / "exports" / "about.txt").read_text()
    assert "+0.700 m" in stated and "-0.100 m" in stated

    export_report(folder, ["cola2"], tmp_path / "named", camera_on="/rig/go")
    named = (tmp_path / "named" / "about.txt").read_text()
    assert "/rig/go" in named and "camera_trigger/disable" in named


_TOY = """
from missions.exports.format import ExportFile, ExportFormat

def write_lengths(path, export, _dive):
    path.write_text("".join(f"{line.length_m:.3f}\\n" for line in export.plan.lines))

FILE = ExportFile(name="lengths.txt", about="lengths of lines", write=write_lengths)
FORMAT = ExportFormat(read_by="people who like lengths", files=(FILE,))
"""


def test_a_format_is_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "toy_lengths.py").write_text(_TOY)
    monkeypatch.setattr(formats, "__path__", [*formats.__path__, str(tmp_path)])
    assert "toy-lengths" in format_names()
    files = write_exports(tmp_path / "out", small_plan(), RIG)
    assert files[tmp_path / "out" / "lengths.txt"] == "lengths of lines"
    assert len((tmp_path / "out" / "lengths.txt").read_text().splitlines()) == 6
    assert "lengths.txt: lengths of lines" in (tmp_path / "out" / "about.txt").read_text()


def test_bends_keep_every_depth_within_the_tolerance() -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        along = np.cumsum(rng.uniform(0.1, 0.5, 60))
        depths = np.cumsum(rng.normal(0.0, 0.05, 60))
        kept = bends(along, depths, DEPTH_STEP_M)
        straight = np.interp(along, along[kept], depths[kept])
        assert np.abs(straight - depths).max() <= DEPTH_STEP_M + 1e-12
        assert len(kept) < 60
    slope = np.linspace(0.0, 5.0, 40)
    assert bends(slope, 0.3 * slope, DEPTH_STEP_M) == [0, 39]


VEHICLES = ("cola2", "qgc", "wpl")
CELL_M, STEEPEST_RAD = 0.25, math.radians(30.0)
REACH = Reach(ahead_m=1.0, astern_m=1.0, aside_m=1.0)


def plan_over(wall_m: float, slope: float = 0.0, made: Callable[..., Plan] = small_plan) -> Plan:
    """A plan over a floor 16 m deep that a wall raises east of 2 m."""
    east = (np.arange(160) + 0.5) * CELL_M - 20.0
    depth = np.broadcast_to(16.0 - slope * east - wall_m * (east > 2.0), (160, 160))
    floor, laid = floor_of(depth, CELL_M), made()
    limits = TerrainLimits(altitude_m=2.0, least_clearance_m=1.0, steepest_rad=STEEPEST_RAD)
    profiles = line_profiles(laid.lines, floor, REACH, limits)
    depths, floors = (
        tuple(tuple(map(float, getattr(profile, name))) for profile in profiles)
        for name in ("depth_m", "floor_m")
    )
    ways = tuple(way_depths_m(dive.route.legs, floor, REACH, 2.0) for dive in laid.dives)
    plan = made(
        line_depths_m=depths, line_floors_m=floors, way_depths_m=ways, seafloor_depth_m=16.0
    )
    mount = CameraMount(glass_body_m=(0.55, -0.05, 0.08), altimeter_body_m=(-0.41, 0.0, 0.11))
    dives = [waypoints(plan, dive, mount, 0.3, by_depth=True) for dive in plan.dives]
    min_m = min_clearance_by_depth(plan, dives, floor, REACH, STEEPEST_RAD)
    figures = terrain_figures(profiles, limits, relief_m=10.0)
    figures["by_depth"] = dict.fromkeys(("min_clearance_m", "cola2_min_clearance_m"), min_m)
    figures["by_depth"]["allowed_m"] = 1.0
    return replace(plan, details={"terrain": figures})


@pytest.mark.parametrize("format_", VEHICLES)
def test_a_wall_is_flown_by_depth(tmp_path: Path, format_: str) -> None:
    """Followed by the rules of a vehicle that sinks at once and rises before it goes on, the file
    keeps its clearance over a wall that knows nothing of the planner."""
    plan = plan_over(6.0)
    files = write_exports(tmp_path / "out", plan, RIG, formats=[format_])
    assert plan.is_flown_by_depth
    checked = 0
    for file in files:
        if not file.name.startswith("mission_"):
            continue
        mission = read_mission(file)
        assert {step.heave for step in mission.steps} == {"depth"}
        ends = mission.ends_ne(plan.datum)
        for i in range(1, len(ends) - 1):
            length_m = math.dist(ends[i - 1], ends[i])
            along = np.linspace(0.0, 1.0, math.ceil(length_m / 0.05) + 1)
            east = ends[i - 1][1] + along * (ends[i][1] - ends[i - 1][1])
            climbed = mission.steps[i - 1].depth_m - math.tan(STEEPEST_RAD) * length_m * along
            depth = np.maximum(mission.steps[i].depth_m, climbed)
            assert np.all(np.where(east > 2.0, 10.0, 16.0) - depth > 1.5)
            checked += 1
    depths = [step.depth_m for step in mission.steps[1:-1]]
    assert checked > 20
    assert min(depths) == pytest.approx(8.0 - 0.08, abs=0.01)
    assert max(depths) == pytest.approx(14.0 - 0.08, abs=0.01)


def test_tables_state_the_altitude_that_is_flown(tmp_path: Path) -> None:
    write_exports(tmp_path, plan_over(6.0), RIG, formats=["csv"])
    _, rows = read_csv(tmp_path / "stations.csv")
    floors = [16.0 - 6.0 * (float(row["east_m"]) > 2.0) for _, row in rows]
    apart = [
        abs(float(row["depth_m"]) + float(row["altitude_m"]) - floor)
        for (_, row), floor in zip(rows, floors, strict=True)
        if abs(float(row["east_m"]) - 2.0) > CELL_M
    ]
    assert max(apart) < 1e-3
    assert max(float(row["altitude_m"]) for _, row in rows) > 5.0


def test_a_way_home_over_a_wall_rises_first(tmp_path: Path) -> None:
    """The lines end 14 m deep west of the wall; home is on top of it."""
    west = [line((0.0, -8.0), (4.0, -8.0)), line((4.0, -7.0), (0.0, -7.0))]
    plan = plan_over(6.0, made=partial(plan_of, west, [(0, 1)], home=(0.0, 6.0)))
    write_exports(tmp_path, plan, RIG, formats=["csv", "cola2"])
    assert plan.clearance_by_depth_m[0] > 1.5
    _, rows = read_csv(tmp_path / "waypoints.csv")
    depths = [float(row["depth_m"]) for _, row in rows[1:-1]]
    assert depths[-1] == pytest.approx(8.0, abs=0.01) and max(depths) == pytest.approx(14.0)
    # It is where the lines end that it rises.
    names = ("latitude_deg", "longitude_deg")
    places = [[float(row[name]) for name in names] for _, row in rows[1:-1]]
    risen = max(i for i in range(1, len(depths)) if depths[i - 1] > 9.0 > depths[i])
    np.testing.assert_allclose(places[risen], places[risen - 1], atol=1e-8)


@pytest.mark.parametrize("min_m", [0.9, -4.0, None])
def test_missions_that_come_too_near_the_floor_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], min_m: float | None
) -> None:
    plan = plan_over(6.0)
    terrain = plan.details["terrain"] | {"by_depth": {"min_clearance_m": min_m, "allowed_m": 1.0}}
    near = replace(plan, details={"terrain": terrain})
    with pytest.raises(PlanError, match="clearance"):
        write_exports(tmp_path / "out", near, RIG, formats=["csv", "cola2"])
    assert not (tmp_path / "out").exists()
    write_exports(tmp_path / "out", plan, RIG)
    assert list((tmp_path / "out").glob("mission_*"))
    files = write_exports(tmp_path / "out", near, RIG)
    assert "missions are left out" in capsys.readouterr().err
    assert not list((tmp_path / "out").glob("mission_*"))
    assert {path.name for path in files} >= {"plan.kml", "waypoints.csv"}
    assert "Missions are left out" in (tmp_path / "out" / "about.txt").read_text()


@pytest.mark.parametrize(
    ("wall_m", "slope", "by_depth"),
    [(0.0, 0.0, False), (0.25, 0.0, False), (0.4, 0.0, True), (0.0, 0.2, False), (0.0, 0.4, True)],
)
def test_floors_within_thirty_centimetres_are_flown_by_altitude(
    tmp_path: Path, wall_m: float, slope: float, by_depth: bool
) -> None:
    plan = plan_over(wall_m, slope)
    # The highest floor within reach of 1 m ahead and aside is as much higher as the slope says.
    stated = plan.details["terrain"]["at_constant_altitude"]
    assert stated["max_difference_m"] == pytest.approx(max(wall_m, slope), abs=0.06)
    assert stated["min_clearance_m"] == pytest.approx(2.0 - max(wall_m, slope), abs=0.06)
    files = write_exports(tmp_path / "out", plan, RIG, formats=list(VEHICLES))
    assert len(files) == 8
    missions = [read_mission(file) for file in files if file.name.startswith("mission_")]
    heaves = {step.heave for mission in missions for step in mission.steps[1:-1]}
    assert heaves == {"depth" if by_depth else "altitude"}


def test_cola2_alone_is_refused_where_a_current_holds_it_over_the_wall(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = plan_over(6.0)
    by_depth = plan.details["terrain"]["by_depth"] | {"cola2_min_clearance_m": -4.0}
    near = replace(plan, details={"terrain": plan.details["terrain"] | {"by_depth": by_depth}})
    with pytest.raises(PlanError, match="COLA2"):
        write_exports(tmp_path, near, RIG, formats=["cola2"])
    write_exports(tmp_path, near, RIG)
    assert len(re.findall("left out", capsys.readouterr().err)) == 1
    kinds = {path.suffix for path in tmp_path.glob("mission_*")}
    assert kinds == {".plan", ".waypoints"}
