"""Missions read back: the places of the files, as independent readers find them."""

import json
import math
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from pymavlink import mavwp

from alice_survey.core.errors import PlanError
from missions.exports.registry import read_mission
from missions.exports.write import write_exports
from missions.values.mission import Mission
from missions.values.plan_file import Plan
from tests.missions.exports.plans import RIG, golden_plan
from tests.missions.exports.readers import WIDE, local_ne, plans, read_cola2, turned

MM = 1e-3
ENDINGS = {"cola2": "xml", "wpl": "waypoints", "qgc": "plan"}


def files_of(plan: Plan, folder: Path, dive: int = 1) -> dict[str, Path]:
    write_exports(folder, plan, RIG, formats=list(ENDINGS))
    return {name: folder / f"mission_dive{dive}.{ending}" for name, ending in ENDINGS.items()}


def lines_of(mission: Mission, plan: Plan) -> list[tuple[np.ndarray, np.ndarray]]:
    """Where pictures are switched on and off, of the vehicle's reference point."""
    ends = mission.ends_ne(plan.datum)
    on = [ends[i] for i, step in enumerate(mission.steps) if step.camera == "on"]
    off = [ends[i] for i, step in enumerate(mission.steps) if step.camera == "off"]
    return list(zip(on, off, strict=True))


@WIDE
@given(plan=plans())
def test_every_format_switches_pictures_on_where_lines_begin(plan: Plan) -> None:
    """The switches, moved by the lever arm of the default rig, are the lines of the glass."""
    with tempfile.TemporaryDirectory() as folder:
        for number, dive in enumerate(plan.dives, start=1):
            wanted = plan.lines[dive.first_line : dive.last_line + 1]
            for name, path in files_of(plan, Path(folder), number).items():
                mission = read_mission(path)
                assert mission.autopilot == ("cola2" if "cola2" in name else "ardusub")
                flown = lines_of(mission, plan)
                assert len(flown) == len(wanted)
                for line, (start, end) in zip(wanted, flown, strict=True):
                    arm = turned((0.55, -0.05), line.heading_rad)
                    ahead = turned((1.0, 0.0), line.heading_rad)
                    np.testing.assert_allclose(start + arm, line.start_ne_m, atol=MM)
                    beyond = end + arm - np.array(line.end_ne_m)
                    assert beyond @ turned((0.0, 1.0), line.heading_rad) == pytest.approx(0, abs=MM)
                    assert -MM <= beyond @ ahead <= 3.0


def test_cola2_is_read_as_a_strict_parser_reads_it(tmp_path: Path) -> None:
    plan = golden_plan()
    path = files_of(plan, tmp_path)["cola2"]
    strict = read_cola2(path)
    mission = read_mission(path)
    ends, starts = mission.ends_ne(plan.datum), mission.starts_ne(plan.datum)

    assert len(mission.steps) == len(strict) > 5
    for i, (step, raw) in enumerate(zip(mission.steps, strict, strict=True)):
        assert step.manoeuvre == {"park": "keep"}.get(raw.kind, raw.kind)
        v = {key: float(value) for key, value in raw.values.items()}
        at = local_ne(plan.datum, v["final_latitude"], v["final_longitude"])
        np.testing.assert_allclose(ends[i], at, atol=MM)
        assert step.depth_m == v["final_depth"]
        assert step.altitude_m == v["final_altitude"]
        assert step.heave == ("depth", "altitude", "both")[int(v["heave_mode"])]
        assert step.speed_mps == v["surge_velocity"]
        assert step.hold_s == v.get("time", 0.0)
        if raw.kind == "section":
            begins = local_ne(plan.datum, v["initial_latitude"], v["initial_longitude"])
            np.testing.assert_allclose(starts[i], begins, atol=MM)
        else:
            assert np.isnan(starts[i]).all()
        if raw.kind == "park":
            assert step.heading_rad == v["final_yaw"]
        else:
            assert step.tolerance_m == v["tolerance_xy"]
        assert (step.camera is not None) == bool(raw.actions)


def test_plans_of_qgroundcontrol_and_the_waypoints_are_one_mission(tmp_path: Path) -> None:
    paths = files_of(golden_plan(), tmp_path)
    first = read_mission(paths["qgc"])
    again = read_mission(paths["wpl"])
    data = json.loads(paths["qgc"].read_text())
    items = data["mission"]["items"]
    survey = {"type": "ComplexItem", "TransectStyleComplexItem": {"Items": items[2:-1]}}
    data["mission"]["items"] = [*items[:2], survey, items[-1]]
    (tmp_path / "survey.plan").write_text(json.dumps(data))
    assert read_mission(tmp_path / "survey.plan") == first
    assert len(first.steps) == len(again.steps)
    for a, b in zip(first.steps, again.steps, strict=True):
        assert a.latitude_deg == pytest.approx(b.latitude_deg, abs=1e-9)
        assert a.heading_rad == pytest.approx(b.heading_rad, abs=1e-6, nan_ok=True)
        assert (a.camera, a.heave, a.hold_s) == (b.camera, b.heave, b.hold_s)


def test_a_heading_counts_only_as_the_second_command(tmp_path: Path) -> None:
    data = json.loads(files_of(golden_plan(), tmp_path)["qgc"].read_text())
    items = data["mission"]["items"]
    turns = [i for i, item in enumerate(items) if item["command"] == 115]
    path = tmp_path / "one.plan"
    path.write_text(json.dumps(data))
    assert sum(math.isfinite(s.heading_rad) for s in read_mission(path).steps) == len(turns) > 0
    for i in reversed(turns):  # the command before it goes
        del items[i - 1]
    path.write_text(json.dumps(data))
    assert not any(math.isfinite(s.heading_rad) for s in read_mission(path).steps)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no mission"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><mission/>', "no mission"),
        ("QGC WPL 110\n0\t1\t0", "3 cells"),
        ("QGC WPL 110\n" + "0 1 0 16 0 0 0 0 1 2 0 1\n" + "1 0 3 22 0 0 0 0 1 2 0 1", "22"),
        ("QGC WPL 110\n" + "0 1 0 16 0 0 0 0 1 2 0 1\n" + "1 0 3 16 0 0 0 0 1 2 0 1", "speed"),
        ("QGC WPL 110\n" + "0 1 0 16 0 0 0 0 nan 2 0 1", "finite"),
        ('{"fileType": "Plan"}', "mission items"),
        ("<mission><version>3.0</version></mission>", "version 3.0"),
        ("<mission><version>2.0</version></mission>", "no step"),
        ("<mission><version>2.0</version><mission_step/></mission>", "maneuver"),
    ],
)
def test_what_is_no_mission_is_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "file"
    path.write_text(text)
    with pytest.raises(PlanError, match=said) as caught:
        read_mission(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_waypoints_are_read_as_pymavlink_reads_them(tmp_path: Path) -> None:
    plan = golden_plan()
    path = files_of(plan, tmp_path)["wpl"]
    loader = mavwp.MAVWPLoader()
    loader.load(str(path))
    rows = [loader.wp(i) for i in range(1, loader.count()) if loader.wp(i).command == 16]
    mission = read_mission(path)
    ends = mission.ends_ne(plan.datum)

    assert len(mission.steps) == len(rows) > 5
    for step, row, end in zip(mission.steps, rows, ends, strict=True):
        np.testing.assert_allclose(end, local_ne(plan.datum, row.x, row.y), atol=MM)
        assert step.hold_s == row.param1
        assert step.tolerance_m == pytest.approx(row.param2, abs=1e-6)
        height = step.altitude_m if row.frame == 10 else -step.depth_m
        assert height == pytest.approx(row.z, abs=1e-4)
        assert step.speed_mps == pytest.approx(plan.speed_mps)
