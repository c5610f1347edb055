import csv
import math
import re
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from alice_survey.core.artefacts import write_json
from alice_survey.core.config import parse_config
from alice_survey.core.errors import PlanError
from missions.exports import formats
from missions.exports.registry import format_names
from missions.exports.waypoints import DEPTH_STEP_M, bends
from missions.exports.write import export_report, write_exports
from missions.route.terrain import Reach, TerrainLimits, line_profiles, terrain_figures
from missions.values.plan_file import Plan
from tests.missions.areas.sites import floor_of
from tests.missions.exports.plans import RIG, small_plan
from tests.missions.exports.readers import local_ne


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
    write_json(folder / "stage.json", {"settings": settings})
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
CELL_M = 0.25
REACH = Reach(ahead_m=1.0, astern_m=1.0, aside_m=1.0)


def plan_over(wall_m: float, slope: float = 0.0) -> Plan:
    """The small plan over a floor 16 m deep that a wall raises east of 2 m."""
    east = (np.arange(160) + 0.5) * CELL_M - 20.0
    depth = np.broadcast_to(16.0 - slope * east - wall_m * (east > 2.0), (160, 160))
    lines = small_plan().lines
    limits = TerrainLimits(altitude_m=2.0, least_clearance_m=1.0, steepest_rad=np.deg2rad(30.0))
    profiles = line_profiles(lines, floor_of(depth, CELL_M), REACH, limits)
    figures = terrain_figures(profiles, limits, relief_m=10.0)
    depths = tuple(tuple(map(float, profile.depth_m)) for profile in profiles)
    return small_plan(line_depths_m=depths, seafloor_depth_m=16.0, details={"terrain": figures})


@pytest.mark.parametrize("format_", VEHICLES)
def test_a_wall_is_refused_with_the_least_clearance(tmp_path: Path, format_: str) -> None:
    plan = plan_over(6.0)
    with pytest.raises(PlanError, match="least clearance") as refused:
        write_exports(tmp_path / "out", plan, RIG, formats=["csv", format_])
    assert not (tmp_path / "out").exists()
    # 2 m above the foot of a wall of 6 m is 4 m below its top.
    clearance = re.search(r"least clearance of such a mission is (-?[\d.]+) m", str(refused.value))
    assert clearance is not None
    assert float(clearance[1]) == pytest.approx(-4.0, abs=0.05)


def test_all_formats_leave_missions_of_a_wall_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_exports(tmp_path / "out", small_plan(), RIG)
    assert list((tmp_path / "out").glob("mission_*"))
    files = write_exports(tmp_path / "out", plan_over(6.0), RIG)
    assert "missions are left out" in capsys.readouterr().err
    assert not list((tmp_path / "out").glob("mission_*"))
    assert {path.name for path in files} >= {"plan.kml", "waypoints.csv"}
    assert "Missions are left out" in (tmp_path / "out" / "about.txt").read_text()


@pytest.mark.parametrize(
    ("wall_m", "slope", "refused"),
    [(0.0, 0.0, False), (0.25, 0.0, False), (0.4, 0.0, True), (0.0, 0.2, False), (0.0, 0.4, True)],
)
def test_floors_within_thirty_centimetres_are_exported(
    tmp_path: Path, wall_m: float, slope: float, refused: bool
) -> None:
    plan = plan_over(wall_m, slope)
    # The highest floor within reach of 1 m ahead and aside is as much higher as the slope says.
    stated = plan.details["terrain"]["at_constant_altitude"]
    assert stated["max_difference_m"] == pytest.approx(max(wall_m, slope), abs=0.06)
    assert stated["min_clearance_m"] == pytest.approx(2.0 - max(wall_m, slope), abs=0.06)
    if refused:
        with pytest.raises(PlanError, match="least clearance"):
            write_exports(tmp_path / "out", plan, RIG, formats=["wpl"])
        return
    files = write_exports(tmp_path / "out", plan, RIG, formats=list(VEHICLES))
    assert len(files) == 8
