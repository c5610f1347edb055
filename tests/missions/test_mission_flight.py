"""Exported missions flown by the laws of COLA2 and ArduSub."""

import math
import re
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alice_survey.core.config import SurveyConfig, change_section
from alice_survey.core.errors import PlanError, VehicleError
from alice_survey.core.frames import Datum
from alice_survey.sim.vehicle.pilot.gains import gains_for
from alice_survey.sim.vehicle.pilot.memory import ABORT, ALONG, CROSS, LEG, PHASE
from alice_survey.sim.vehicle.pilot.mission import circling_m, steady_drift
from alice_survey.sim.vehicle.sea import level_floor
from camera_calib.rig import Rig, design_rig
from missions.coverage.certificate import certificate
from missions.coverage.stations import plan_pattern, stations_of_flight
from missions.exports.follower import follower_of
from missions.exports.format import options_of
from missions.exports.write import write_exports
from missions.fly.simulation import (
    PASSED_M,
    covered_shares,
    flight_settings,
    mission_of_settings,
    mission_summary,
    overshoot_m,
    picture_times,
    planned_stations,
    simulate_mission,
)
from missions.route.energy import planned_vehicle
from missions.values.flight import Flight, rms
from missions.values.plan_file import Plan
from tests.missions.flown_plans import plan_of, planned, survey, walk
from tests.refusals import refused

FILES = {
    "cola2": "mission_dive1.xml", "wpl": "mission_dive1.waypoints", "qgc": "mission_dive1.plan",
}  # fmt: skip


def calm(**changes: Any) -> SurveyConfig:
    """A survey without gusts, and navigation all but exact."""
    sea = {"current_mps": 0.0, "current_sigma_mps": 0.0, "gust_n": (0.0, 0.0, 0.0)}
    biases = {"gps_bias_m": 0.0, "compass_bias_deg": 0.0}
    noises = {"compass_noise_deg": 0.01, "usbl_noise_m": 0.01, "dvl_noise_mps": 1e-4}
    sections = {**changes, "sea": sea | changes.get("sea", {})}
    return survey(area={"length_m": 6.0, "width_m": 3.0}, navigation=biases | noises, **sections)


def rig_of(config: SurveyConfig) -> Rig:
    return design_rig(config.camera, config.water)


@lru_cache
def small_plan() -> Plan:
    return planned(calm())


@lru_cache
def long_line() -> Plan:
    """One line of 30 m northwards, with 4 m to come onto it."""
    route = walk((-5.0, 0.0), 0.0, [("go", 4.0), ("go", 1.0), ("line", 30.0, 0), ("go", 1.0)])
    return plan_of([route], stations=61)


def exported(plan: Plan, config: SurveyConfig, name: str, folder: Path) -> SurveyConfig:
    """The survey with its mission written, to be flown."""
    options = options_of(config.camera, config.plan, config.vehicle, config.sea)
    write_exports(folder, plan, rig_of(config), formats=[name], options=options)
    return change_section(config, "vehicle", mission_file=folder / FILES[name])


@pytest.mark.parametrize(("altitudes", "least", "most"), [(1.4, 0.9, 1.0), (1.6, 0.0, 0.0)])
def test_pictures_from_too_high_are_no_coverage(
    altitudes: float, least: float, most: float
) -> None:
    """As in the plan's certificate: neither where a flight took them nor where a plan lays them."""
    plan, rig = small_plan(), rig_of(calm())
    depths = tuple((6.0 - altitudes * plan.altitude_m,) * line.stations for line in plan.lines)
    floors = tuple((6.0,) * line.stations for line in plan.lines)
    stations = planned_stations(replace(plan, line_depths_m=depths, line_floors_m=floors))
    assert len(stations.line) == plan.stations
    assert least <= covered_shares(plan, rig, stations)["covered_share"] <= most


def fly(plan: Plan, config: SurveyConfig) -> Flight:
    rng = np.random.default_rng(1)
    return simulate_mission(plan, flight_settings(config), level_floor(6.0), rng, label="")


def reference_off_m(flight: Flight, line: int, share: float) -> np.ndarray:
    """Offsets of the reference point on the last share of a line, to starboard, as believed."""
    rows = np.flatnonzero(flight.line == line)
    rows = rows[round(len(rows) * (1.0 - share)) :]
    planned_line = flight.plan.lines[line]
    # The reference point's line is as far to starboard of the glass's as the glass is to port.
    off = flight.log.position_ned[rows, :2] - planned_line.start_ne_m
    heading = planned_line.heading_rad
    return np.asarray(off @ [-math.sin(heading), math.cos(heading)]) - 0.05


@pytest.mark.parametrize("name", ["cola2", "qgc"])
def test_in_still_water_an_exported_mission_sees_what_its_certificate_promises(
    name: str, tmp_path: Path
) -> None:
    plan, config = small_plan(), exported(small_plan(), calm(), name, tmp_path)
    flight = fly(plan, config)
    seen = certificate(
        plan.area, rig_of(config), stations_of_flight(flight), plan_pattern(plan, rig_of(config))
    )

    assert flight.ending == "complete"
    assert plan.coverage == 1.0
    assert seen.covered_share > 0.999
    assert plan.coverage - 0.01 < seen.share_at_overlap <= plan.coverage
    known = mission_of_settings(plan, flight_settings(config))
    beyond_m = overshoot_m(known, flight)
    assert len(beyond_m) == len(plan.lines)
    assert max(beyond_m) < (PASSED_M if name == "cola2" else 0.3)
    found = mission_summary(known, flight, rig_of(config))
    assert found["planned"]["share_at_overlap"] == pytest.approx(plan.coverage)
    assert found["steps_begun"] == found["steps"] == len(known.mission.steps)


@pytest.mark.parametrize(("current", "towards_deg"), [(0.05, 90.0), (0.1, 270.0)])
def test_cola2_is_off_its_line_by_the_closed_form(
    current: float, towards_deg: float, tmp_path: Path
) -> None:
    sea = {"current_mps": current, "current_towards_deg": towards_deg}
    config = exported(long_line(), calm(sea=sea), "cola2", tmp_path)
    flight = fly(long_line(), config)
    delta_m = follower_of(config.vehicle, config.sea, 0.2).delta_m
    wanted = math.copysign(
        delta_m * steady_drift(current, 0.2), math.sin(math.radians(towards_deg))
    )

    off = reference_off_m(flight, 0, 0.35)[: -round(delta_m / 0.2 / 0.05)]
    assert flight.ending == "complete"
    assert float(off.mean()) == pytest.approx(wanted, rel=0.06)
    heading = math.degrees(np.median(flight.attitude_rad[flight.line == 0, 2]))
    assert heading == pytest.approx(-math.degrees(math.asin(wanted / delta_m)), abs=2.0)  # upstream


@pytest.mark.parametrize(
    ("vehicle", "margin_m", "current"),
    [
        *(
            pytest.param(*how, marks=pytest.mark.slow)
            for how in (("alice", None, 0.0), ("alice", 1.0, 0.0))
        ),
        ("alice", None, 0.1),
        ("sparus2", 1.5, 0.0),
    ],
)
def test_cola2_leaves_the_area_by_no_more_than_is_stated(
    vehicle: str, margin_m: float | None, current: float, tmp_path: Path
) -> None:
    sea = {"current_mps": current, "current_towards_deg": 90.0}
    config = calm(sea=sea, vehicle={"name": vehicle})
    config = change_section(config, "area", turn_margin_m=margin_m)
    plan = planned(change_section(config, "vehicle", name="alice"))
    flight = fly(plan, exported(plan, config, "cola2", tmp_path))
    about = (tmp_path / "about.txt").read_text()

    (stated,) = re.findall(r"allowed area by up to ([0-9.]+) m", about)
    stated_m = float(stated)
    assert flight.expected_m[1] == pytest.approx(stated_m, abs=0.006)
    off_m = float(re.findall(r"up to about ([0-9.]+) m", about)[0])
    assert flight.allowed_off_m.max() == pytest.approx(off_m, abs=0.006)
    assert 0.05 * off_m < rms(flight.line_errors[0]) < off_m
    worst_m = flight.outside_m.max()
    assert worst_m < stated_m + plan.allowed_offset_m
    assert worst_m > stated_m - 0.6  # no free pass
    if margin_m is None:  # there is room
        assert stated_m < (0.25 if current else 0.1)
        assert flight.stations_off_line < 0.05 * plan.stations


def test_ardusub_holds_its_line_in_a_current_at_its_speed(tmp_path: Path) -> None:
    sea = {"current_mps": 0.1, "current_towards_deg": 90.0}
    config = exported(long_line(), calm(sea=sea), "wpl", tmp_path)
    flight = fly(long_line(), config)

    off = reference_off_m(flight, 0, 0.5)
    assert flight.ending == "complete"
    assert abs(float(off.mean())) < 0.02 < 0.05 * steady_drift(0.1, 0.2)
    # Its target goes at 0.2 m/s, and takes 0.2 / a to start and stop, a = sqrt(0.2 jerk) / 2.
    report, known = flight.flown.report, mission_of_settings(long_line(), flight_settings(config))
    step = int(report[flight.line == 0, LEG][0])
    ends = known.mission.ends_ne(long_line().datum)
    took_s = 0.05 * np.count_nonzero(report[:, LEG] == step)
    min_s = math.dist(ends[step - 1], ends[step]) / 0.2 + 2.0 * math.sqrt(0.2)
    assert min_s - 0.1 < took_s < min_s + 5.0


@pytest.mark.parametrize("vehicle", ["alice", "sparus2"])
def test_a_tolerance_within_the_turning_circle_is_circled_for_ever(
    vehicle: str, tmp_path: Path
) -> None:
    plan = small_plan()
    config = exported(plan, calm(vehicle={"name": vehicle}), "cola2", tmp_path)
    circle = circling_m(gains_for(planned_vehicle(config.vehicle), 0.2), 0.2)
    path = tmp_path / FILES["cola2"]
    text = path.read_text()
    assert min(map(float, re.findall("tolerance_xy>([0-9.]+)", text))) > 0.999 * circle
    path.write_text(re.sub("tolerance_xy>[0-9.]+", "tolerance_xy>0.1", text))
    flight = fly(plan, config)

    assert "no progress" in flight.ending
    report = flight.flown.report
    step = report[-1, LEG]
    known = mission_of_settings(plan, flight_settings(config))
    end = known.mission.ends_ne(plan.datum)[int(step)]
    rows = np.flatnonzero((report[:, LEG] == step) & (report[:, PHASE] != ABORT))[-600:]
    away = np.hypot(*(flight.truth.ned_from_body.translation[rows, :2] - end).T)
    assert np.median(away) == pytest.approx(circle, rel=0.12)


def test_pictures_are_taken_at_the_interval_or_by_the_way(tmp_path: Path) -> None:
    plan, time_s = long_line(), np.arange(0.0, 100.0, 0.05)
    line = np.where((time_s > 10.0) & (time_s < 90.0), 0.0, -1.0)
    glass_ne = np.stack([0.2 * time_s, np.zeros_like(time_s)], axis=1)
    for name, step_s in (("cola2", plan.interval_s), ("wpl", 0.5 / 0.2)):
        config = exported(plan, calm(), name, tmp_path)
        known = mission_of_settings(plan, flight_settings(config))
        taken, lines = picture_times(known, plan, time_s, line, glass_ne)
        assert taken[0] == pytest.approx(10.05, abs=0.06)
        np.testing.assert_allclose(np.diff(taken), step_s, atol=0.06)
        assert len(lines) == len(taken) == pytest.approx(80.0 / step_s, abs=2)
        assert set(lines) == {0}


def test_missions_of_other_plans_and_autopilots_are_refused(tmp_path: Path) -> None:
    plan, config = long_line(), exported(long_line(), calm(), "cola2", tmp_path)
    moved = replace(
        plan.area, datum=Datum(plan.datum.latitude_deg + 0.01, plan.datum.longitude_deg)
    )
    with refused(PlanError, "another plan"):
        fly(replace(plan, area=moved), config)
    with pytest.raises(VehicleError, match="sideways"):
        sparus = calm(vehicle={"name": "sparus2", "controller": "los"})
        fly(plan, exported(plan, sparus, "wpl", tmp_path))
    path = tmp_path / FILES["cola2"]
    path.write_text(path.read_text().replace("action>", "act>"))
    with pytest.raises(PlanError, match="no pictures"):
        fly(plan, config)


def test_a_section_is_never_left_beyond_its_tolerance(tmp_path: Path) -> None:
    sea = {"current_mps": 0.05, "current_towards_deg": 90.0, "gust_n": (0.5, 0.5, 0.5)}
    plan, config = small_plan(), exported(small_plan(), calm(sea=sea), "cola2", tmp_path)
    flight = fly(plan, config)
    known = mission_of_settings(plan, flight_settings(config))
    ends, report = known.mission.ends_ne(plan.datum), flight.flown.report
    assert flight.ending == "complete"
    for i, step in enumerate(known.mission.steps[:-1]):
        last = np.flatnonzero(report[:, LEG] == i)[-1]
        away = math.dist(flight.log.position_ned[last, :2], ends[i])
        assert away < step.tolerance_m + 0.02
    assert np.isfinite(report[:, [ALONG, CROSS]]).all()
