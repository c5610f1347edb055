import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest

from alice_survey.base.artefacts import write_json
from alice_survey.base.config import parse_config
from alice_survey.base.errors import PlanError
from missions.exports.options import Options
from missions.exports.waypoints import DEPTH_STEP_M, bends
from missions.exports.write import FORMATS, counted, export_report, write_exports
from missions.values.plan_file import read_plan
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
    for stem in ("mission_dive{}.xml", "mission_v1_dive{}.xml", "mission_dive{}.plan",
                 "survey_dive{}.plan", "mission_dive{}.waypoints"):  # fmt: skip
        assert {stem.format(1), stem.format(2)} < names
    assert {"plan.kml", "plan.gpx", "plan.geojson", "lines.csv", "stations.csv",
            "waypoints.csv", "about.txt"} < names  # fmt: skip
    assert names == {path.name for path in (tmp_path / "a").iterdir()}
    for one, two in zip(first, second, strict=True):
        assert one.read_bytes() == two.read_bytes()


@pytest.mark.parametrize("format_", FORMATS)
def test_a_format_comes_alone_with_its_description(tmp_path: Path, format_: str) -> None:
    files = write_exports(tmp_path, small_plan(), RIG, formats=[format_])
    assert files[-1].name == "about.txt"
    text = files[-1].read_text()
    assert all(file.name in text for file in files[:-1])
    assert 1 <= len(files) - 1 <= 3


def test_an_unknown_format_names_those_that_are_known(tmp_path: Path) -> None:
    with pytest.raises(PlanError, match=r"format 'dxf' is not known; known are cola2, .*csv"):
        write_exports(tmp_path / "none", small_plan(), RIG, formats=["cola2", "dxf"])
    assert not (tmp_path / "none").exists()


def test_stations_and_waypoints_in_tables(tmp_path: Path) -> None:
    plan = small_plan()
    write_exports(tmp_path, plan, RIG, formats=["csv"])
    stations, points = rows(tmp_path / "stations.csv"), rows(tmp_path / "waypoints.csv")

    wanted = np.vstack([line.stations_ne for line in plan.lines])
    read = [
        local_ne(plan.datum, float(row["latitude_deg"]), float(row["longitude_deg"]))
        for row in stations
    ]
    np.testing.assert_allclose(read, wanted, atol=1e-3)
    assert [int(row["dive"]) for row in stations] == [1] * 33 + [2] * 31
    assert {row["altitude_m"] for row in stations} == {"2.000"}

    assert [int(row["number"]) for row in points] == list(range(1, len(points) + 1))
    assert {row["speed_mps"] for row in points} == {"0.2"}
    ends = [row for row in points if row["action"] == "line, camera off"]
    assert [int(row["line"]) for row in ends] == list(range(6))
    for row in points:
        glass = np.array(
            local_ne(plan.datum, float(row["latitude_deg"]), float(row["longitude_deg"]))
        )
        vehicle = np.array(
            local_ne(
                plan.datum,
                float(row["vehicle_latitude_deg"]),
                float(row["vehicle_longitude_deg"]),
            )
        )
        assert math.dist(glass, vehicle) == pytest.approx(math.hypot(0.55, 0.05), abs=1e-3)
    assert points[-1]["depth_m"] == "0.000"


def test_the_report_takes_the_mount_from_the_settings_of_the_plan(tmp_path: Path) -> None:
    folder = tmp_path / "plan"
    write_json(folder / "plan.json", small_plan().to_json())
    with pytest.raises(PlanError, match="give the survey's settings too"):
        export_report(folder / "plan.json")

    config = parse_config({"camera": {"position_body_m": [0.7, -0.1, 0.05]}}, "test")
    settings = {name: getattr(config, name).model_dump(mode="json") for name in ("camera", "water")}
    write_json(folder / "stage.json", {"settings": settings})
    text, about = export_report(folder / "plan.json", ["wpl", "csv"])
    given, _ = export_report(folder, ["wpl", "csv"], tmp_path / "other", config)

    assert len(about["files"]) == 6
    assert text.splitlines()[0].startswith(f"{folder / 'exports'}: 6 files of 64 stations in 2")
    assert text.splitlines()[1:] == given.splitlines()[1:]
    told = (folder / "exports" / "about.txt").read_text()
    assert "+0.700 m forward, -0.100 m right" in told
    assert "plan of 6 lines, 64 stations, 2 dives\n" in told
    json.dumps(about)

    export_report(folder, ["cola2"], tmp_path / "named", camera_on="/rig/go")
    named = (tmp_path / "named" / "about.txt").read_text()
    assert "/rig/go starts pictures, camera_trigger/disable stops them" in named


def test_depths_that_do_not_fit_the_lines_are_refused(tmp_path: Path) -> None:
    plan = small_plan()
    with pytest.raises(PlanError, match="depths of 1 lines with 5 stations do not fit a plan of 6"):
        write_exports(tmp_path, plan, RIG, line_depths=[np.full(5, 13.0)])


@pytest.mark.parametrize("change", [{"least_tolerance_m": 0.0}, {"camera_on": ""}])
def test_options_without_sense_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(PlanError):
        Options(**change)  # type: ignore[arg-type]


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


@pytest.mark.parametrize(("number", "told"), [(0, "0 dives"), (1, "1 dive"), (2, "2 dives")])
def test_one_is_told_in_the_singular(number: int, told: str) -> None:
    assert counted(number, "dive") == told


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"MultiPolygon"', '"MultiPqlygon"'), ('"stations"', '"station"'),
        ("15.0", "1" + "0" * 400),
        ('"survey"', '"dive"'), ('"version": 2', '"version": 3'),
    ],
)  # fmt: skip
def test_a_plan_that_was_changed_names_itself(tmp_path: Path, old: str, new: str) -> None:
    path = tmp_path / "plan.json"
    text = json.dumps(small_plan().to_json())
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(PlanError, match=r"plan\.json") as fault:
        read_plan(path)
    assert "\n" not in str(fault.value)
