"""A log through the model: exact where the model is the vehicle, drifting as it is not."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from alice_survey.app.cli.vehicle import app
from alice_survey.core.errors import VehicleError
from alice_survey.sim.vehicle.files import vehicle_from
from alice_survey.sim.vehicle.identification.replay import (
    AXES,
    ReplayOptions,
    replay,
    replay_report,
)
from alice_survey.sim.vehicle.log import VehicleLog, read_vehicle_log, write_vehicle_log
from alice_survey.sim.vehicle.propulsion import turned_speeds
from tests.alice_survey.sim.vehicle.identification.manoeuvres import fly, hidden, survey_like

KNOWN = vehicle_from("alice")
U, W, HEADING, NORTH, EAST, DEPTH = (
    AXES.index(a) for a in ["u", "w", "heading", "north", "east", "depth"]
)


@pytest.fixture(scope="module")
def log() -> VehicleLog:
    """A minute in a current of 0.1 m/s to the north."""
    return fly(hidden({}), duration_s=60.0, current=(0.1, 0.0))


NET_N = float(KNOWN.plant.body.buoyancy_n - KNOWN.plant.body.weight_n)
CURRENT = {"current_north_mps": 0.1}


def test_the_vehicle_itself_does_not_drift(log: VehicleLog) -> None:
    found = replay(log, KNOWN, others=CURRENT)
    assert found.starts == (0,)
    errors = np.abs(found.errors)
    assert np.isfinite(errors).all()
    assert errors[:, :3].max() < 2e-3
    assert errors[:, 6:9].max() < 0.2
    assert errors[:, 9:].max() < 0.02
    # The manoeuvre is one: the vehicle goes metres and turns by more than half a circle.
    assert np.ptp(found.measured[:, NORTH]) > 3.0
    assert np.ptp(found.measured[:, HEADING]) > 180.0


def test_a_wrong_drag_drifts_by_what_it_makes(log: VehicleLog) -> None:
    """Without the current the track is off by 0.1 m/s; a start each 10 s keeps it near."""
    still = replay(log, KNOWN)
    assert still.drift_per_min[NORTH] == pytest.approx(6.0, abs=1.0)
    assert still.drift_per_min[EAST] < 1.0
    other = hidden({"Z_ww": 4.0 * KNOWN.coefficients.values["Z_ww"]})
    whole = replay(log, other, others=CURRENT)
    again = replay(log, other, others=CURRENT, reset_s=10.0)
    assert [round(float(again.time_s[row]) / 10.0) for row in again.starts] == list(range(6))
    for one in (whole, again):
        assert np.nanmax(np.abs(one.errors[:, W])) > 0.02
    worst = [float(np.abs(one.errors[:, DEPTH]).max()) for one in (whole, again)]
    assert worst[0] > 1.5 * worst[1] > 0.05
    assert whole.max_s == pytest.approx(59.95)
    assert again.max_s == pytest.approx(10.0, abs=0.1)


def test_commands_go_through_the_lag(log: VehicleLog) -> None:
    names = [thruster.name for thruster in KNOWN.thrusters]
    asked = np.array([survey_like(time_s) for time_s in log.time_s])
    commanded = replace(log, rpm=dict(zip(names, 60.0 * asked.T, strict=True)))
    for i, thruster in enumerate(KNOWN.thrusters):
        speeds = 60.0 * turned_speeds(log.time_s, asked[:, i], thruster)
        # Commands hold for a row here, and change between rows when they fly.
        error = speeds - log.rpm[thruster.name]
        assert np.sqrt(np.mean(error**2)) < 0.05 * np.std(log.rpm[thruster.name])
    as_turned = replay(commanded, KNOWN, others=CURRENT).errors[:, U]
    assert 0.02 < np.sqrt(np.mean(as_turned**2)) < 0.3  # a lag of tenths of a second is seen


def test_a_gap_starts_from_what_is_measured(log: VehicleLog) -> None:
    keep = np.ones(len(log.time_s), bool)
    keep[500:700] = False
    rows = {name: value[keep] for name, value in log.rpm.items()}
    gappy = replace(
        log, time_s=log.time_s[keep], position_ned=log.position_ned[keep], rpm=rows,
        quaternion_xyzw=log.quaternion_xyzw[keep], velocity_body=log.velocity_body[keep],
        rates_body=log.rates_body[keep], altitude_m=log.altitude_m[keep],
        wrench=log.wrench[keep],
    )  # fmt: skip
    found = replay(gappy, KNOWN, others=CURRENT)
    assert found.starts == (0, 500)
    assert np.abs(found.errors[:, 9:]).max() < 0.02


def test_the_command_writes_figures_and_the_motion(log: VehicleLog, tmp_path: Path) -> None:
    names = [thruster.name for thruster in KNOWN.thrusters]
    asked = np.array([survey_like(time_s) for time_s in log.time_s])
    commanded = replace(log, rpm=dict(zip(names, 60.0 * asked.T, strict=True)))
    write_vehicle_log(tmp_path / "log.csv", commanded)
    # What `identify` has written: its buoyancy is taken, its current is of another day.
    (tmp_path / "found.json").write_text(
        json.dumps(
            {
                "values": dict(KNOWN.coefficients.values),
                "others": {"net_buoyancy_n": NET_N, "current_north_mps": 3.0},
            }
        )
    )
    arguments = [
        "replay", str(tmp_path / "log.csv"), "--commanded", "--held", "current_north_mps=0.1",
        "--coefficients", str(tmp_path / "found.json"), "-o", str(tmp_path / "out"), "--json",
    ]  # fmt: skip
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    data = json.loads(result.stdout)
    assert data["others"] == {"net_buoyancy_n": NET_N, "current_north_mps": 0.1}
    assert data["starts_s"] == [0.0]
    assert data["axes"]["u"]["rms"] < 0.02
    assert 80.0 < data["axes"]["u"]["fit_percent"] <= 100.0
    assert 0.0 < data["axes"]["depth"]["drift_per_min"] < 0.2
    assert (tmp_path / "out" / "replay.png").stat().st_size > 10_000
    assert (tmp_path / "out" / "report.txt").read_text().count("\n") > 12
    written = read_vehicle_log(tmp_path / "out" / "replay.csv")
    moved = written.position_ned[-1] - log.position_ned[-1]
    assert np.abs(moved).max() < 0.5


def test_wrong_options_are_refused(log: VehicleLog, tmp_path: Path) -> None:
    write_vehicle_log(tmp_path / "log.csv", replace(log, rpm={}, wrench=np.zeros((1200, 6))))
    for options, named in (
        (ReplayOptions(held=("X_uu=1",)), "X_uu"),
        (ReplayOptions(commanded=True), "rpm_NAME"),
        (ReplayOptions(given=("u",)), "'u'"),
    ):
        with pytest.raises(VehicleError, match=named):
            replay_report(tmp_path / "log.csv", tmp_path / "out", options)
    assert not (tmp_path / "out").exists()
