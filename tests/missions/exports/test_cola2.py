import math
import re
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from shapely.geometry import MultiPolygon, Point, box

from alice_survey.core.config import CameraConfig, PlanConfig, SeaConfig, VehicleConfig
from alice_survey.core.errors import keep_warnings
from alice_survey.sim.vehicle.pilot.mission import steady_drift
from camera_calib.rig import Rig
from missions.exports import format as options
from missions.exports.follower import Follower, off_lines_m
from missions.exports.format import Options, line_tolerance_m, options_of
from missions.exports.write import write_exports
from missions.values.footprint import common_swath
from missions.values.plan_file import Plan
from tests.missions.exports.plans import RIG, golden_plan, small_plan
from tests.missions.exports.readers import WIDE, Step, local_ne, plans, read_cola2, rigs, turned

GOLDEN = Path(__file__).parent / "golden"
MM = 1e-3


def steps_of(plan: Plan, rig: Rig, number: int = 1) -> list[Step]:
    with tempfile.TemporaryDirectory() as folder:
        write_exports(Path(folder), plan, rig, formats=["cola2"])
        return read_cola2(Path(folder) / f"mission_dive{number}.xml")


def place(plan: Plan, step: Step, which: str = "final") -> np.ndarray:
    latitude, longitude = (float(step.values[f"{which}_{n}"]) for n in ("latitude", "longitude"))
    return np.array(local_ne(plan.datum, latitude, longitude))


def test_a_mission_is_that_on_file(tmp_path: Path) -> None:
    write_exports(tmp_path, golden_plan(), RIG, formats=["cola2"])
    written = (tmp_path / "mission_dive1.xml").read_bytes()
    assert written == (GOLDEN / "mission.xml").read_bytes()


@settings(WIDE, max_examples=25)
@given(plan=plans(), rig=rigs())
def test_the_glass_flies_every_line(plan: Plan, rig: Rig) -> None:
    """The reference point's section, moved by the lever arm, is the line of the glass."""
    glass = rig.body_from_cam("left").apply([0.0, 0.0, 0.03])  # port 20 mm, glass 10 mm
    for number, dive in enumerate(plan.dives, start=1):
        on = False
        flown = []
        for step in steps_of(plan, rig, number):
            if on:
                assert step.kind == "section"
                flown.append(step)
            on = step.actions[-1] == "camera_trigger/enable" if step.actions else on
        assert not on
        assert len(flown) == dive.last_line - dive.first_line + 1
        for index, step in enumerate(flown, start=dive.first_line):
            wanted = plan.lines[index]
            arm = turned((glass[0], glass[1]), wanted.heading_rad)
            np.testing.assert_allclose(
                place(plan, step, "initial") + arm, wanted.start_ne_m, atol=MM
            )
            # It goes on by its tolerance and a step: the allowed area is 3 m wider.
            past_m = float(step.values["tolerance_xy"]) + plan.station_spacing_m
            past = past_m * turned((1.0, 0.0), wanted.heading_rad)
            np.testing.assert_allclose(place(plan, step) + arm, wanted.end_ne_m + past, atol=MM)
            depth = plan.seafloor_depth_m - plan.altitude_m - glass[2]
            assert step.values["final_depth"] == pytest.approx(depth, abs=MM)
            # The DVL, 0.11 m below the origin, measures as much less as it is deeper.
            altitude = plan.altitude_m + glass[2] - 0.11
            assert step.values["final_altitude"] == pytest.approx(altitude, abs=MM)
            assert step.values["heave_mode"] == 1
            assert step.values["surge_velocity"] == pytest.approx(plan.speed_mps, abs=1e-4)


def test_the_way_down_needs_no_altitude_and_the_way_up_ends_at_the_surface() -> None:
    first, *_, last = steps_of(small_plan(), RIG)
    assert (first.kind, first.values["heave_mode"]) == ("goto", 2)
    assert (last.kind, last.values["heave_mode"], last.values["final_depth"]) == ("goto", 0, 0.0)
    assert not first.values["no_altitude_goes_up"]
    assert not last.values["no_altitude_goes_up"]


FOLLOWER = Follower(
    name="hull", sways=True, delta_m=3.0, circle_m=0.4, turn_in_m=0.3, turn_rad_s=0.5,
    current_ne_mps=(0.03, 0.04),
)  # fmt: skip


def test_in_a_current_steps_end_outside_of_the_turning_circle(tmp_path: Path) -> None:
    plan, known = small_plan(), Options(follower=FOLLOWER)
    write_exports(tmp_path, plan, RIG, formats=["cola2"], options=known)
    steps = read_cola2(tmp_path / "mission_dive1.xml")
    min_m = 0.4 + 0.05 / 0.5
    for step in steps:
        assert float(step.values.get("tolerance_xy", 1.0)) >= min_m - 1e-4
    # A line goes on by as much, and its run-in begins farther off than planned, within the area.
    for i, step in enumerate(steps):
        if step.kind != "section" or step.actions != ["camera_trigger/disable"]:
            continue
        run_in = steps[i - 1]
        assert run_in.kind == "section"
        length_m = math.dist(place(plan, run_in, "initial"), place(plan, run_in))
        assert length_m > 2 * plan.run_in_m
        on_m = math.dist(place(plan, step, "initial"), place(plan, step))
        line_m = min(line.length_m for line in plan.lines[:3])
        assert on_m == pytest.approx(line_m + min_m + plan.station_spacing_m, abs=MM)
        heading = math.atan2(*(place(plan, step) - place(plan, step, "initial"))[::-1])
        arm = turned((0.55, -0.05), heading)
        allowed = plan.area.allowed.buffer(1e-6)
        assert allowed.covers(Point(place(plan, run_in, "initial") + arm))
        assert allowed.covers(Point(place(plan, step) + arm))


def test_lines_end_at_the_edge_of_the_allowed_area(tmp_path: Path) -> None:
    plan = small_plan()
    allowed = MultiPolygon([box(-3.0, -3.0, 4.9, 6.5)])
    plan = replace(plan, area=replace(plan.area, allowed=allowed))
    write_exports(tmp_path, plan, RIG, formats=["cola2"], options=Options(follower=FOLLOWER))
    steps = read_cola2(tmp_path / "mission_dive1.xml")
    first = next(step for step in steps if step.actions == ["camera_trigger/disable"])
    end = place(plan, first) + turned((0.55, -0.05), 0.0)
    np.testing.assert_allclose(end, (4.9, 0.0), atol=MM)


def test_the_tolerance_keeps_neighbouring_lines_together(monkeypatch: pytest.MonkeyPatch) -> None:
    # Never COLA2's 1.5 m, never less than what a vehicle holds.
    assert line_tolerance_m(small_plan(line_spacing_m=1.26), RIG) == 0.12
    monkeypatch.setattr(options, "MIN_TOLERANCE_M", 0.01)
    plan = small_plan(line_spacing_m=0.8)
    stereo = common_swath(RIG, 2.0, plan.station_spacing_m)
    error_m = line_tolerance_m(plan, RIG)

    # Two lines that are off by it, apart, just meet; here that is less than half a step of 0.46 m.
    assert 0.8 + 2 * error_m == pytest.approx(2 * stereo.half_across_m)
    assert 0.2 < error_m < 0.23
    close = line_tolerance_m(small_plan(line_spacing_m=0.7), RIG)
    assert close == pytest.approx(0.23)
    written = [s.values["tolerance_xy"] for s in steps_of(plan, RIG) if s.kind == "section"]
    assert written == pytest.approx([error_m] * len(written), abs=1e-4)


def test_lines_that_follow_a_bathymetry_bend_where_the_floor_does() -> None:
    plan = small_plan()
    ramps = [np.full(line.stations, 13.0) for line in plan.lines]
    ramps[1] = np.interp(np.arange(plan.lines[1].stations), [0, 4, 10], [12.0, 12.8, 12.9])
    depths = tuple(tuple(map(float, ramp)) for ramp in ramps)
    terrain = {"at_constant_altitude": {"max_difference_m": 0.1, "min_clearance_m": 1.9}}
    bent = small_plan(line_depths_m=depths, details={"terrain": terrain})
    steps = steps_of(bent, RIG)
    second = [s for s in steps if s.kind == "section" and s.values["final_depth"] < 12.9]

    # A bend at 12.8 m, then the end; the run-in comes in at the line's first depth.
    assert [s.values["final_depth"] for s in second] == pytest.approx(
        [12.0 - 0.08, 12.8 - 0.08, 12.9 - 0.08], abs=MM
    )
    assert second[1].values["initial_depth"] == pytest.approx(12.0 - 0.08, abs=MM)
    assert [bool(s.actions) for s in second] == [True, False, True]


def sea_options(vehicle: str = "alice", **sea: Any) -> Options:
    given = SeaConfig(**({"gust_n": (0.0, 0.0, 0.0)} | sea))
    return options_of(CameraConfig(), PlanConfig(), VehicleConfig(name=vehicle), given)


@pytest.mark.parametrize(
    ("vehicle", "formats", "towards_deg", "warns"),
    [
        ("alice", ["cola2"], 90.0, True),  # lines run north and south
        ("alice", ["cola2"], 0.0, False),
        ("alice", ["wpl"], 90.0, False),
        ("alice", None, 90.0, False),
        ("sparus2", None, 90.0, True),
    ],
)
def test_lines_that_cola2_cannot_hold_are_said_beforehand(
    vehicle: str, formats: list[str] | None, towards_deg: float, warns: bool, tmp_path: Path
) -> None:
    known = sea_options(vehicle, current_mps=0.1, current_towards_deg=towards_deg)
    with keep_warnings() as warnings:
        write_exports(tmp_path, small_plan(), RIG, formats=formats, options=known)
    assert any("COLA2 brings" in text for text in warnings) == warns
    assert all("\n" not in text for text in warnings)


def test_a_current_holds_the_glass_off_its_line(tmp_path: Path) -> None:
    """Off lines across it as in closed form, with two sigmas of its changes."""
    plan, known = golden_plan(), sea_options(current_mps=0.05, current_sigma_mps=0.01)
    follower = known.follower
    assert follower is not None
    lever_m = RIG.body_from_cam("left").apply([0.0, 0.0, 0.03])[0]
    off_m = off_lines_m(follower, plan, lever_m)
    for line, off in zip(plan.lines, off_m, strict=True):
        across_mps = 0.05 * abs(math.sin(math.pi / 2 - line.heading_rad)) + 0.02
        drift = steady_drift(across_mps, plan.speed_mps)
        # Of the glass ahead of a vehicle that heads upstream.
        assert off == pytest.approx((follower.delta_m - lever_m) * drift, rel=1e-6)
    write_exports(tmp_path, plan, RIG, formats=["cola2"], options=known)
    stated = re.findall(r"(?:within|about) ([0-9.]+) m", (tmp_path / "about.txt").read_text())
    # The worst of all lines, also of those across the others.
    assert float(stated[1]) == pytest.approx(off_m.max(), abs=0.005)
    assert float(stated[0]) > float(stated[1])
