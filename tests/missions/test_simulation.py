"""Plans flown by the simulated vehicle: the issue's acceptance figures, failures, seas."""

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from alice_survey.core.config import (
    CameraConfig,
    SeaConfig,
    SurveyConfig,
    VehicleConfig,
    WaterConfig,
)
from alice_survey.core.errors import VehicleError
from alice_survey.kit import figure
from alice_survey.sim.vehicle.navigation.tick import LOG_COLUMNS
from alice_survey.sim.vehicle.pilot.command import ThrustWatch
from alice_survey.sim.vehicle.sea import FloorGrid, current_at
from camera_calib.rig import design_rig
from missions.fly.run import draw_flight, flight_summary, line_spans, rpm_of
from missions.fly.simulation import current_of
from missions.values.flight import Flight, rms
from missions.values.plan_file import Plan
from tests.missions import flown_plans
from tests.missions.flown_plans import flown, off_stations_m, planned

RIG = design_rig(CameraConfig(), WaterConfig())


def survey(**changes: object) -> SurveyConfig:
    area = {"length_m": 6.0, "width_m": 4.0, "heading_deg": 20.0}
    return flown_plans.survey(area=area, **changes)


@lru_cache
def plan_of() -> Plan:
    return planned(survey())


def fly(config: SurveyConfig, floor: FloorGrid | None = None, seed: int = 1) -> Flight:
    return flown(plan_of(), config, floor, seed)


@pytest.fixture(scope="module")
def flight() -> Flight:
    return fly(survey())


def metres_into_line(flight: Flight) -> np.ndarray:
    """(T,) how far the glass is from the start of its line, along it; NaN between lines."""
    along = np.full(len(flight.line), np.nan)
    for index, line in enumerate(flight.plan.lines):
        rows = flight.line == index
        ahead = np.array([np.cos(line.heading_rad), np.sin(line.heading_rad)])
        along[rows] = (flight.glass_ned[rows, :2] - line.start_ne_m) @ ahead
    return along


def test_in_a_cross_current_alice_keeps_to_her_lines(flight: Flight) -> None:
    cross, heading = flight.line_errors
    assert flight.ending == "complete"
    assert 0.002 < rms(cross) <= 0.12
    assert 0.1 < np.rad2deg(rms(heading)) <= 3.0
    # The control alone, without the error of the navigation, is finer still.
    assert rms(flight.believed_cross_track) < 0.05


def test_every_station_is_taken_once_and_in_its_place(flight: Flight) -> None:
    plan = flight.plan
    assert len(flight.trigger_s) == plan.stations
    assert np.all(np.diff(flight.trigger_s) > 0)
    assert flight.trigger_line == tuple(
        i for i, line in enumerate(plan.lines) for _ in range(line.stations)
    )
    for glass in (flight.believed_glass_ned, flight.glass_ned):
        assert 0.001 < off_stations_m(flight, glass).max() < 0.2


def test_altitude_is_held_over_a_slope() -> None:
    north = np.arange(-15.0, 20.0, 0.5)
    slope = FloorGrid(-15.0, -15.0, 0.5, np.repeat(6.0 + 0.1 * north[:, None], 80, axis=1))
    flight = fly(survey(), slope)
    on_line = flight.line >= 0
    floor = 6.0 + 0.1 * flight.glass_ned[on_line, 0]
    altitude = floor - flight.glass_ned[on_line, 2]
    assert flight.ending == "complete"
    assert abs(altitude.mean() - 2.0) < 0.1
    assert 0.005 < altitude.std() < 0.15


@pytest.mark.parametrize("thruster", ["starboard", "port", "bow", "stern"])
def test_with_one_thruster_failed_she_still_flies_the_survey(thruster: str) -> None:
    flight = fly(survey(vehicle={"failures": [thruster]}))
    turns = flight.flown.rps[:, flight.flown.thrusters.index(thruster)]
    assert np.all(turns == 0.0)
    assert flight.ending == "complete"
    assert len(flight.trigger_s) == plan_of().stations
    # Without the bow thruster a line's first metres are spent on getting back to it after a turn.
    cross = flight.line_errors[0]
    assert 0.002 < rms(cross) < 0.3
    assert 0.002 < rms(cross[metres_into_line(flight) > 2.0]) < 0.15


def test_a_thruster_that_fails_unnoticed_leaves_pictures_off_their_lines() -> None:
    known = fly(survey(vehicle={"failures": ["bow"]}))
    dead = survey(vehicle={"failures": ["bow@0"]})
    unknown = fly(dead)
    # Off their lines, or not taken at all, where the vehicle spins before it has reached the start.
    on_line = [len(f.trigger_s) - f.stations_off_line for f in (known, unknown)]
    assert on_line[1] < 0.9 * on_line[0]
    assert (
        flight_summary(unknown, dead.vehicle, RIG)["stations_off_line"] == unknown.stations_off_line
    )


def test_figures_of_turns_and_altitude_are_true_ones(flight: Flight) -> None:
    found = flight_summary(flight, survey().vehicle, RIG)
    turns = found["in_turns"]
    assert 0.5 < turns["roll_worst_deg"] < 10.0
    assert turns["believed_off_route_rms_m"] < turns["off_route_rms_m"] < 0.3
    np.testing.assert_allclose(flight.altitude_m, 6.0 - flight.glass_ned[:, 2], atol=1e-9)
    assert 0.001 < found["on_lines"]["altitude_rms_m"] < 0.12
    assert 1.7 < found["on_lines"]["altitude_least_m"] < 2.0


def test_spans_are_the_times_on_lines(flight: Flight) -> None:
    spans, time_s = line_spans(flight), flight.truth.time_s
    inside = [(time_s >= begin) & (time_s <= end) for begin, end in spans]
    assert all(begin < end for begin, end in spans)
    assert len(spans) == len(flight.plan.lines)
    np.testing.assert_array_equal(np.sum(inside, axis=0), flight.line >= 0)


def test_strips_show_errors_thrusters_and_power(
    flight: Flight, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    kept: list[Any] = []
    monkeypatch.setattr(figure, "save_figure", lambda sheet, *_, **__: kept.append(sheet))
    draw_flight(tmp_path / "drawn.png", flight)
    curves = {
        (axes.get_ylabel(), line.get_label()): np.asarray(line.get_ydata(), np.float64)
        for axes in kept[0].axes
        for line in axes.lines
    }
    np.testing.assert_array_equal(curves["cross-track, m", "true"], flight.line_errors[0])
    off = flight.log.position_ned - flight.truth.ned_from_body.translation
    np.testing.assert_array_equal(curves["east error, m", "believed minus true"], off[:, 1])
    for name, rpm in rpm_of(flight.flown).items():
        np.testing.assert_array_equal(curves["rpm", name], rpm)
    spent_j = 0.05 * curves["power, W", "all thrusters"].sum()
    assert spent_j == pytest.approx(flight.flown.energy_j.sum(), rel=1e-3)


@pytest.mark.slow
def test_navigation_is_consistent_in_the_closed_loop() -> None:
    """Normalised errors squared of the position, averaged over runs (Y. Bar-Shalom et al., 2001).

    Epochs hang together, since each run draws its constant errors once: of 50 other runs a smaller
    share may lie inside.
    """
    runs, axes = 50, ("north", "east", "depth")
    squares = []
    for seed in range(runs):
        flight = fly(survey(), seed=seed)
        rows = np.flatnonzero(flight.line >= 0)[::20]
        off = flight.log.position_ned[rows] - flight.truth.ned_from_body.translation[rows]
        columns = dict(zip(LOG_COLUMNS, flight.flown.navigation[rows].T, strict=True))
        sigma = np.stack([columns[f"sigma_{axis}_m"] for axis in axes], axis=1)
        squares.append(((off / sigma) ** 2).sum(axis=1))
    epochs = min(len(square) for square in squares)
    assert epochs > 0.5 * plan_of().duration_s / 2
    mean = np.stack([square[:epochs] for square in squares]).mean(axis=0)
    low, high = (chi2.ppf(share, len(axes) * runs) / runs for share in (0.025, 0.975))
    assert ((mean > low) & (mean < high)).mean() >= 0.9


def test_the_original_vehicle_flies_by_heading_alone() -> None:
    flight = fly(survey(vehicle={"name": "sparus2", "controller": "los"}))
    assert flight.ending == "complete"
    assert flight.flown.thrusters == ("starboard", "port", "vertical")
    assert rms(flight.line_errors[0]) > 3 * rms(fly(survey()).line_errors[0])


@pytest.mark.parametrize(
    "changes",
    [
        {"vehicle": {"allocation": "rpi"}},
        {"sea": {"current_mps": 0.1, "current_towards_deg": 110.0, "surface_current_mps": 0.3}},
    ],
    ids=["pseudo-inverse", "sheared current"],
)
def test_lines_are_kept_otherwise_too(changes: dict[str, Any]) -> None:
    flight = fly(survey(**changes))
    assert flight.ending == "complete"
    assert 0.002 < rms(flight.line_errors[0]) <= 0.12


def test_a_loss_of_bottom_lock_is_survived_and_seen_in_the_sigmas() -> None:
    hold = survey(navigation={"dvl_dropouts_s": [[60.0, 75.0]]})
    flight, usual = fly(hold), fly(survey())
    lost = (flight.log.time_s > 63.0) & (flight.log.time_s < 75.0)
    assert np.all(np.isnan(flight.log.altitude_m[lost]))
    at = np.flatnonzero(lost)[-1]
    assert flight.log.sigma_horizontal_m[at] > 1.5 * usual.log.sigma_horizontal_m[at]
    assert flight.ending == "complete"


def test_without_bottom_lock_the_vehicle_goes_on_by_choice_while_it_knows_where_it_is() -> None:
    """For 60 s the DVL hears the water alone: USBL and water track bound the sigma."""
    silent = {"bottom_dropouts_s": [[60.0, 120.0]]}
    stopped, gone_on, doubtful = (
        fly(survey(navigation={**silent, **more}))
        for more in ({}, {"blind_sigma_m": 1.0}, {"blind_sigma_m": 0.1})
    )
    assert stopped.ending.startswith("aborted: the DVL did not hear the bottom")
    assert doubtful.ending == stopped.ending
    assert stopped.log.time_s[-1] < 130.0
    assert gone_on.ending == "complete"
    assert len(gone_on.trigger_s) == plan_of().stations
    seconds = gone_on.log.time_s
    blind = (seconds > 63.0) & (seconds < 119.0)
    assert np.isnan(gone_on.log.altitude_m[blind]).all()
    # It moves on, at its depth, and its sigma grows to what both say and back.
    steps = np.diff(gone_on.glass_ned[blind][::20, :2], axis=0)
    assert 5.0 < np.linalg.norm(steps, axis=1).sum() < 20.0
    assert np.ptp(gone_on.glass_ned[blind, 2]) < 0.3
    sigma = gone_on.log.sigma_horizontal_m
    before, worst = sigma[seconds < 60.0].max(), sigma[blind].max()
    assert 1.2 * before < worst < 1.0
    error = np.linalg.norm(
        gone_on.believed_glass_ned[blind, :2] - gone_on.glass_ned[blind, :2], axis=1
    )
    assert 0.2 < np.sqrt(np.mean((error / sigma[blind]) ** 2) / 2.0) < 2.0


def test_a_measured_current_is_read(tmp_path: Path) -> None:
    path = tmp_path / "adcp.csv"
    path.write_text(
        "time_s,depth_m,north_mps,east_mps\n0,2,0.1,0\n0,8,0.0,0\n60,2,0.3,0\n60,8,0.0,0.2\n"
    )
    current = current_of(SeaConfig(current_file=path), 20.0, 100.0, np.random.default_rng(1))
    out = np.zeros(6)
    current_at(current, 30.0, 5.0, out)
    np.testing.assert_allclose(out[:2], [0.1, 0.05], atol=1e-12)

    path.write_text("time_s,depth_m,north_mps,east_mps\n0,2,0.1,0\n0,8,0.0,0\n60,2,0.3,0\n")
    with pytest.raises(VehicleError, match="3 rows"):
        current_of(SeaConfig(current_file=path), 20.0, 100.0, np.random.default_rng(1))


def test_swell_moves_the_water_to_and_fro_as_linear_waves_do() -> None:
    sea = SeaConfig(
        current_mps=0.1, current_towards_deg=0.0, current_sigma_mps=0.0,
        swell_m=0.5, swell_period_s=6.0, swell_towards_deg=90.0,
    )  # fmt: skip
    current, out = current_of(sea, 15.0, 60.0, np.random.default_rng(1)), np.zeros(6)
    east = []
    for time_s in np.arange(0.0, 60.0, 0.25):
        current_at(current, float(time_s), 13.0, out)
        east.append(out[1])
        assert abs(out[0] - 0.1) < 1e-9
    # omega^2 = g k tanh(k h) at 6 s over 15 m: k = 0.11842 rad/m.
    expected = np.pi * 0.5 / 6.0 * np.cosh(0.11842 * 2.0) / np.sinh(0.11842 * 15.0)
    assert 0.98 * expected < max(east) < 1.02 * expected
    assert abs(np.mean(east)) < 0.01


def heading_deg(flight: Flight, after_s: float) -> float:
    """Root mean square of the heading's error on lines, from a time on."""
    return float(np.rad2deg(rms(flight.line_errors[1][flight.truth.time_s > after_s])))


@pytest.mark.parametrize(
    ("failure", "latest_s", "max_deg", "worse"),
    [("stern@70", 40.0, 12.0, 3.0), ("stern:propeller@70", 60.0, 20.0, 2.0)],
    ids=["stands still", "turns and pushes nothing"],
)
def test_a_thruster_that_fails_on_the_way_is_found_and_flown_without(
    failure: str, latest_s: float, max_deg: float, worse: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    at_s, turns = 70.0, "propeller" in failure
    found = fly(survey(vehicle={"failures": [failure]}))
    monkeypatch.setattr(VehicleConfig, "finds_failures", False)
    blind = fly(survey(vehicle={"failures": [failure]}))
    (one,) = found.flown.found
    assert (one.thruster, one.left, one.turns) == ("stern", 0.0, turns)
    assert at_s + 5.0 <= one.time_s <= at_s + latest_s
    assert found.ending == "complete"
    assert blind.flown.found == ()
    assert heading_deg(found, one.time_s + 20.0) < max_deg
    assert heading_deg(blind, at_s + 20.0) > worse * heading_deg(found, one.time_s + 20.0)
    if not turns:
        before = found.truth.time_s < at_s
        whole = fly(survey())
        np.testing.assert_array_equal(found.flown.state[before], whole.flown.state[: before.sum()])
        return
    # It turns as commanded until it is found, and stands still from then on.
    stern = found.flown.rps[:, found.flown.thrusters.index("stern")]
    seconds = found.truth.time_s
    assert np.abs(stern[(seconds > at_s) & (seconds < one.time_s)]).max() > 5.0
    assert np.abs(stern[seconds > one.time_s + 5.0]).max() < 1.0


@pytest.mark.slow
def test_in_seven_seas_nothing_adds_up_and_lost_propellers_do(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two hours of sound flights, of which no sum comes near the alarm; the failures it finds."""
    sums: list[float] = []
    judge = ThrustWatch.judge

    def noted(self: ThrustWatch, *args: Any) -> Any:
        found = judge(self, *args)
        sums.append(float(self.sums.max()))
        return found

    monkeypatch.setattr(ThrustWatch, "judge", noted)
    across = {"current_mps": 0.3}
    along = {"current_mps": 0.2, "current_towards_deg": 0.0}
    swell = {"swell_m": 0.8, "swell_period_s": 8.0}
    seas: tuple[dict[str, Any], ...] = (
        {}, {"sea": across}, {"sea": along}, {"sea": swell},
        {"sea": {**along, "swell_m": 0.5}}, {"vehicle": {"coefficients": "computed"}},
        {"vehicle": {"name": "sparus2", "controller": "los"}},
    )  # fmt: skip
    flown_s = 0.0
    for seed in (11, 12, 13):  # none that its settings were chosen by
        for changes in seas:
            sound = fly(survey(**changes), seed=seed)
            assert sound.flown.found == ()
            flown_s += float(sound.flown.time_s[-1])
    alarm = ThrustWatch(sound.vehicle, 0.05).alarm
    assert 1.8 < flown_s / 3600.0 < 2.6
    assert 0.5 < max(sums) < 0.5 * alarm
    for sea, latest_s in ((None, 60.0), (along, 60.0), (across, 150.0)):
        for name in ("bow", "stern", "vertical"):
            lost = {"failures": [f"{name}:propeller@70"]}
            one = fly(survey(vehicle=lost, **({"sea": sea} if sea else {}))).flown.found[0]
            assert (one.thruster, one.turns) == (name, True)
            assert 5.0 <= one.time_s - 70.0 <= latest_s


def test_a_vehicle_that_loses_its_only_vertical_thruster_gives_up() -> None:
    flight = fly(survey(vehicle={"failures": ["vertical@60"]}))
    assert flight.ending == "aborted: a thruster failed without which it cannot fly a survey"
    assert flight.flown.found[0].thruster == "vertical"
