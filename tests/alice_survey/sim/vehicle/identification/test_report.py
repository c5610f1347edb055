"""The command, from files to files, and how well a model predicts a log."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from alice_survey.app.cli.main import app
from alice_survey.core.errors import VehicleError
from alice_survey.sim.vehicle.identification.problem import free_parameters, make_windows
from alice_survey.sim.vehicle.identification.report import (
    IdentifyOptions,
    fit_percent,
    identify_report,
    validate,
)
from alice_survey.sim.vehicle.log import write_vehicle_log
from alice_survey.sim.vehicle.vehicle import coefficients_from_file, vehicle_from
from tests.alice_survey.sim.vehicle.identification import manoeuvres as flown
from tests.alice_survey.sim.vehicle.identification.test_two_step import pull_csv

KNOWN = vehicle_from("alice")
TRUTH = {"X_uu": -12.0, "N_rr": -70.0}


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A log, and one of another day: another current, other manoeuvres."""
    folder = tmp_path_factory.mktemp("logs")
    truth = flown.hidden(TRUTH)
    first = flown.fly(truth, duration_s=40.0, current=(0.1, -0.05))
    second = flown.fly(
        truth,
        duration_s=30.0,
        current=(-0.05, 0.1),
        asked=lambda time_s: flown.survey_like(time_s + 53),
    )
    for seed, (name, log) in enumerate((("first", first), ("second", second))):
        write_vehicle_log(folder / f"{name}.csv", flown.measured(log, np.random.default_rng(seed)))
    return folder / "first.csv", folder / "second.csv"


@pytest.mark.slow
def test_the_joint_fit_writes_what_it_found(logs: tuple[Path, Path], tmp_path: Path) -> None:
    options = IdentifyOptions(free=("X_uu", "N_rr", "current"), validate=logs[1])
    text, data = identify_report([logs[0]], tmp_path / "out", options)
    found = data["identified"]
    assert found["X_uu"]["identified"] == pytest.approx(-12.0, rel=0.05)
    assert found["N_rr"]["identified"] == pytest.approx(-70.0, rel=0.05)
    assert found["X_uu"]["factor"] == pytest.approx(12.0 / 15.23, rel=0.05)
    assert found["current_north_mps"]["identified"] == pytest.approx(0.1, abs=0.01)
    assert found["current_north_mps"]["factor"] is None
    assert min(data["validation"]["fit_percent"].values()) > 80.0
    assert data["validation"]["constant_fit_percent"]["u"] < 50.0
    fits, before = (data["validation"][key] for key in ("fit_percent", "start_fit_percent"))
    assert before["u"] < fits["u"] - 1.0 and before["r"] < fits["r"] - 1.0
    for name in ("coefficients.json", "fit.png"):
        assert (tmp_path / "out" / name).stat().st_size > 500
    lines = text.splitlines()
    assert any(line.split()[:2] == ["X_uu", "-15.23"] for line in lines)
    # The other day's current is that day's, and is reported.
    of_that_day = [float(number) for number in re.findall(r"(-?[\d.]+) m/s", text)[-2:]]
    assert of_that_day == pytest.approx([-0.05, 0.1], abs=0.01)
    read = coefficients_from_file(tmp_path / "out" / "coefficients.json")
    assert read.values["X_uu"] == found["X_uu"]["identified"]
    assert read.values["Y_vv"] == -321.597
    identify_report([logs[0]], tmp_path / "again", options)
    for name in ("coefficients.json", "fit.png"):
        again = (tmp_path / "again" / name).read_bytes()
        assert again == (tmp_path / "out" / name).read_bytes()


def test_a_log_is_predicted_open_loop_by_what_was_identified(
    logs: tuple[Path, Path], tmp_path: Path
) -> None:
    """The whole log without a fit: buoyancy of the file counts, its current is of another day."""
    net_n = float(KNOWN.plant.body.buoyancy_n - KNOWN.plant.body.weight_n)
    others = {"net_buoyancy_n": net_n, "current_north_mps": 3.0}
    found = {"values": {**KNOWN.coefficients.values, **TRUTH}, "others": others}
    (tmp_path / "found.json").write_text(json.dumps(found))
    arguments = [
        "--coefficients", str(tmp_path / "found.json"), "--held", "current_north_mps=-0.05",
        "--held", "current_east_mps=0.1", "-o", str(tmp_path / "out"), "--json",
    ]  # fmt: skip
    for command in (
        ["vehicle", "identify", "--validate", str(logs[1])],
        ["vehicle", "replay", str(logs[1])],
    ):
        result = CliRunner().invoke(app, [*command, *arguments])
        assert result.exit_code == 0, result.output
        data = json.loads(result.stdout)
        assert data["validation"]["window_s"] == pytest.approx(29.95)
        assert min(data["validation"]["fit_percent"].values()) > 75.0
        assert data["others"]["current_north_mps"] == -0.05
        assert data["identified"] == {}
    assert (tmp_path / "out" / "fit.png").stat().st_size > 10_000


@pytest.mark.slow
@pytest.mark.parametrize("method", ["joint", "two-step"])
def test_the_command_takes_a_bollard_pull_and_held_values(
    logs: tuple[Path, Path], tmp_path: Path, method: str
) -> None:
    pull = pull_csv(tmp_path / "pull.csv", 0.0, factors=(1.0, 1.0))
    arguments = [
        "vehicle", "identify", str(logs[0]), "--method", method, "--free", "X_uu,N_rr", "--bollard",
        str(pull), "--held", "current_north_mps=0.1", "--held", "current_east_mps=-0.05", "-o",
        str(tmp_path / "out"), "--json",
    ]  # fmt: skip
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    data = json.loads(result.stdout)
    assert data["method"] == method
    assert [round(one["factor"], 6) for one in data["thrust"]] == [1.0, 1.0]
    assert data["identified"]["X_uu"]["identified"] == pytest.approx(-12.0, rel=0.05)
    assert data["identified"]["N_rr"]["identified"] == pytest.approx(-70.0, rel=0.05)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (IdentifyOptions(method="guess"), "'guess'"),
        (IdentifyOptions(held=("current_north_mps",)), "current_north_mps"),
        (IdentifyOptions(held=("X_uu=3",)), "X_uu"),
        (IdentifyOptions(vehicle="sparus2"), "sparus2"),
        (IdentifyOptions(given=("u",)), "'u'"),
        (IdentifyOptions(free=("gain",)), "gain_X"),
    ],
)
def test_wrong_options_are_refused(
    logs: tuple[Path, Path], tmp_path: Path, options: IdentifyOptions, message: str
) -> None:
    with pytest.raises(VehicleError) as raised:
        identify_report([logs[0]], tmp_path / "out", options)
    assert message in str(raised.value)
    assert not (tmp_path / "out").exists()


def test_the_fit_is_as_defined() -> None:
    y = np.array([[1.0], [2.0], [3.0], [6.0]])
    assert fit_percent(y, y)[0] == 100.0
    assert fit_percent(y, np.full((4, 1), 3.0))[0] == 0.0
    # Off by one everywhere: 2 against the root of 4 + 1 + 0 + 9.
    assert fit_percent(y, y + 1)[0] == pytest.approx(100 * (1 - 2 / np.sqrt(14)))
    gappy = y.copy()
    gappy[1] = np.nan
    assert np.isfinite(fit_percent(gappy, y)[0])
    assert np.isnan(fit_percent(np.ones((3, 1)), np.ones((3, 1)))[0])


def test_the_truth_predicts_itself_and_a_wrong_model_does_not() -> None:
    log = flown.fly(flown.hidden(TRUTH), duration_s=40.0, current=(0.1, 0.05))
    parameters = free_parameters(KNOWN, (*TRUTH, "current"))
    windows = make_windows(log, KNOWN, window_s=10.0)
    right = validate(windows, parameters, np.array([-12.0, -70.0, 0.1, 0.05]))
    wrong = validate(windows, parameters, np.array([-24.0, -35.0, 0.1, 0.05]))
    assert np.all(right.fit_percent > 99.0)
    assert np.all(right.constant_fit_percent < 60.0)
    assert wrong.fit_percent[0] < 97.0
    assert wrong.fit_percent[5] < 95.0


def test_a_motion_that_follows_the_log_is_not_scored() -> None:
    windows = make_windows(flown.fly(KNOWN, duration_s=10.0), KNOWN, given=("p", "q"))
    parameters = free_parameters(KNOWN, ("X_uu",))
    found = validate(windows, parameters, parameters.start)
    assert np.all(np.isnan(found.fit_percent[3:5]))
    assert np.all(found.fit_percent[[0, 1, 2, 5]] > 99.0)
