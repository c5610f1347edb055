"""The comparison of both configurations: the same water, honest figures, and numbers that hold."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from alice_survey.app.cli.main import app
from alice_survey.core.artefacts import read_csv
from alice_survey.core.config import SurveyConfig, change_section
from alice_survey.core.errors import VehicleError
from alice_survey.core.executor import SERIAL
from alice_survey.sim.vehicle import vehicle as files
from alice_survey.sim.vehicle.sea import level_floor
from alice_survey.sim.vehicle.simulator import Flown, Setup, simulate
from missions.fly import compare
from missions.fly.simulation import flight_settings, mission_setup, with_values
from missions.values.flight import Flight
from missions.values.plan_file import Plan
from tests.missions import flown_plans
from tests.missions.flown_plans import planned
from tests.oracles_guidance import los_offset_m

HEAVY = str(Path(files.__file__).parent / "fleet_files" / "bluerov2_heavy.toml")
STILL = compare.Case(current_mps=0.0, towards_deg=0.0)
BY_NAME = {variant.name: variant for variant in compare.VARIANTS}
Flights = dict[str, tuple[Setup, Flown, Flight]]


def survey(length_m: float, width_m: float, **sea: object) -> SurveyConfig:
    area = {"length_m": length_m, "width_m": width_m}
    plan = {"line_spacing_m": 1.0, "line_heading_deg": 0.0, "cross_lines": 0}
    return flown_plans.survey(area=area, plan=plan, sea={"gust_n": [0.5, 0.5, 0.0], **sea})


CONFIG = survey(3.0, 2.0)
SETTINGS = flight_settings(CONFIG)


@pytest.fixture(scope="module")
def small() -> Plan:
    return planned(CONFIG)


@pytest.fixture(scope="module")
def flown(small: Plan) -> Flights:
    """The three in a current to starboard, with the same draws of chance."""
    case = compare.Case(current_mps=0.05, towards_deg=90.0)
    return {
        name: compare.fly_variant(SETTINGS, small, BY_NAME[name], case, 3)
        for name in (compare.ORIGINAL, compare.EQUAL, compare.IMPROVED)
    }


def test_all_meet_the_same_current(flown: Flights) -> None:
    series = []
    for _, run, _ in flown.values():
        through = Rotation.from_quat(run.truth[:, 3:7]).apply(run.state[:, 7:10])
        series.append((run.truth[:, 7:10] - through)[:, :2])
    shortest = min(len(current) for current in series)
    for current in series[1:]:
        np.testing.assert_allclose(current[:shortest], series[0][:shortest], atol=1e-12)
    assert 0.02 < np.linalg.norm(series[0].mean(axis=0)) < 0.09
    assert series[0].std(axis=0).max() > 1e-4


def test_all_meet_the_same_gusts(small: Plan) -> None:
    """Six numbers a tick are drawn from the water's generator, whatever the vehicle does."""
    left = []
    for variant in ("alice", "sparus2"):
        settings = replace(
            SETTINGS, vehicle=with_values(SETTINGS.vehicle, name=variant, controller="los")
        )
        water = np.random.default_rng(5)
        setup = mission_setup(small, settings, level_floor(6.0), 300.0, water)
        fresh = np.random.default_rng(5)
        mission_setup(small, settings, level_floor(6.0), 300.0, fresh)
        chance = np.random.default_rng(6)
        ticks = len(simulate(setup, chance, max_s=5.0, label="", sea_rng=water).time_s)
        fresh.standard_normal(6 * ticks)
        assert water.standard_normal() == fresh.standard_normal()
        left.append(water.standard_normal())
    assert left[0] == left[1]


def test_figures_are_of_what_was_flown(flown: Flights) -> None:
    for _, run, flight in flown.values():
        figures = compare.figures_of(flight)
        cross, _ = flight.line_errors
        on = ~np.isnan(cross)
        assert on.any()
        np.testing.assert_allclose(flight.route_error[on], cross[on], atol=1e-6)
        assert figures.lines_true_m == pytest.approx(math.sqrt(np.nanmean(cross**2)))
        assert 0.0 < figures.survey_energy_wh < run.energy_j.sum() / 3600.0
        assert 0.0 < figures.survey_s < run.time_s[-1]
        assert figures.complete == (flight.ending == "complete")
        roll_deg = np.rad2deg(np.abs(flight.attitude_rad[:, 0]))
        assert 0.0 < figures.turn_roll_peak_deg <= roll_deg.max()
    found = {name: compare.figures_of(run[2]) for name, run in flown.items()}
    assert found[compare.IMPROVED].lines_believed_m < 0.05
    assert found[compare.ORIGINAL].lines_believed_m > 3.0 * found[compare.IMPROVED].lines_believed_m
    assert found[compare.IMPROVED].heading_rms_deg < 3.0 < found[compare.ORIGINAL].heading_rms_deg


def test_the_original_settles_where_the_closed_form_has_it() -> None:
    """On a line long enough, in a steady current across it and without gusts."""
    config = survey(45.0, 0.8, current_sigma_mps=0.0, gust_n=[0.0, 0.0, 0.0])
    # Fixes from above would shift the line under the vehicle.
    config = change_section(config, "navigation", usbl_noise_m=0.0)
    plan = planned(config)
    case = compare.Case(current_mps=0.05, towards_deg=90.0)
    setup, _, flight = compare.fly_variant(
        flight_settings(config), plan, BY_NAME[compare.ORIGINAL], case, 1
    )
    rows = np.flatnonzero(flight.line == 0)
    settled = flight.believed_cross_track[rows[-len(rows) // 4 :]]
    ahead = math.cos(plan.lines[0].heading_rad)
    expected = los_offset_m(setup.guidance.look_ahead_m, plan.speed_mps, 0.05 * ahead)
    assert settled.mean() == pytest.approx(expected, rel=0.05)
    assert settled.std() < 0.05


def test_turns_are_from_a_line_to_the_middle_of_the_next() -> None:
    line = np.array([-1, -1, 0, 0, 0, -1, -1, 1, 1, 1, 1, -1, 2, 2, -1], np.float64)
    following = np.ones(len(line), bool)
    assert compare.turn_rows(line, following) == [slice(5, 9), slice(11, 13)]
    # A way back to where the line was left is not a turn.
    again = np.array([0, 0, -1, 0, 0], np.float64)
    assert compare.turn_rows(again, np.ones(5, bool)) == []
    assert compare.turn_rows(np.full(4, -1.0), np.ones(4, bool)) == []


def test_currents_are_across_along_and_none(small: Plan) -> None:
    cases = compare.default_cases(small)
    turned = [math.radians(case.towards_deg) - small.lines[0].heading_rad for case in cases[:2]]
    assert math.sin(turned[0]) == pytest.approx(1.0)
    assert math.cos(turned[1]) == pytest.approx(1.0)
    assert [case.current_mps for case in cases] == [0.1, 0.1, 0.0, 0.0]
    assert [case.swell_m > 0 for case in cases] == [False, False, False, True]


@pytest.mark.slow
def test_the_report_holds_every_flight_next_to_the_paper(tmp_path: Path) -> None:
    currents = ["0.05@90", "0@0"]
    _, data = compare.compare_report(
        CONFIG, tmp_path / "one", currents=currents, seed=4, flights=1, executor=SERIAL
    )
    assert json.loads((tmp_path / "one" / "compare.json").read_text()) == data
    assert len(data["cases"]) == 2
    assert all(set(case["variants"]) == set(BY_NAME) for case in data["cases"])
    assert data["paper"]["improved"]["cross_track_rms_m"] == [0.12, 0.12]
    _, rows = read_csv(tmp_path / "one" / "flights.csv")
    assert len(rows) == 2 * len(compare.VARIANTS)
    for _, row in rows:
        current = f"{float(row['current_mps']):g}@{float(row['towards_deg']):g}"
        case = data["cases"][currents.index(current)]
        found = case["variants"][row["configuration"]]["lines_true_m"]["mean"]
        assert float(row["lines_true_m"]) == pytest.approx(found, abs=1e-6)


def test_any_vehicles_are_compared(tmp_path: Path) -> None:
    """Each as it can be steered, under its own name; the paper's figures are left out."""
    text, data = compare.compare_report(
        CONFIG, tmp_path, currents=["0.05@90"], seed=4, flights=1, executor=SERIAL,
        vehicles=["sparus2", HEAVY],
    )  # fmt: skip
    found = data["cases"][0]["variants"]
    assert list(found) == ["sparus2", "bluerov2_heavy"]
    assert [data["variants"][name]["controller"] for name in found] == ["los", "sway"]
    assert all(figures["complete"]["mean"] == 1.0 for figures in found.values())
    errors = [figures["lines_true_m"]["mean"] for figures in found.values()]
    assert 0.005 < errors[1] < 0.2 < errors[0] < 2.0
    assert "paper" not in text
    with pytest.raises(VehicleError, match="two have one name"):
        compare.variants_of(["bluerov2_heavy", HEAVY])
    with pytest.raises(VehicleError, match="'nautilus' is not known"):
        compare.variants_of(["nautilus"])


@pytest.mark.slow
def test_the_command_prints_what_it_writes(tmp_path: Path) -> None:
    text = (
        "[area]\nlength_m = 3.0\nwidth_m = 1.0\nseafloor_depth_m = 6.0\n[plan]\ncross_lines = 0\n"
    )
    (tmp_path / "survey.toml").write_text(text)
    arguments = ["vehicle", "compare", "-w", str(tmp_path), "--current", "0@0", "--flights", "1"]
    shown = CliRunner().invoke(app, [*arguments, "--threads", "1", "--json"])
    assert shown.exit_code == 0, shown.output
    data = json.loads(shown.stdout)
    assert data == json.loads((tmp_path / "compare" / "compare.json").read_text())
    assert data["plan"]["line_spacing_m"] == 1.0
