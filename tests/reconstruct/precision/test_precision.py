"""What is predicted from plans, against surveys of known truth, closed forms and invariances."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import rasterio

from alice_survey.app.pipeline import run
from alice_survey.core.artefacts import json_values, read_json
from alice_survey.core.config import NavigationConfig, ReconstructConfig, SurveyConfig, load_config
from alice_survey.core.executor import SERIAL
from benchmarks import bend_survey
from benchmarks.precision import errors, errors_of_drawn_logs, swayed
from camera_calib.rig import Rig, design_rig
from missions.plan.planner import plan_survey
from missions.plan.strength import survey_costs
from missions.values.plan_file import Plan, read_plan
from reconstruct.placing.alignment import sag_weights
from reconstruct.precision.instruments import NavigationErrors, usual_rig
from reconstruct.precision.predict import Precision, predict
from reconstruct.precision.run import (
    Candidate,
    precision_report,
    single_measures,
    stations_and_times,
    with_control,
    worst_bend,
)
from reconstruct.precision.tracks import ExpectedBlock, TrackModel
from tests.small_survey import SMALL, settings_in

TRACKS = TrackModel(per_picture=400.0, matched=0.5, noise_px=0.1)
FIGURES = ("bend along", "bend across", "scale", "heights", "shape")


def settings(length_m: float = 6.0, width_m: float = 5.0, cross_lines: int = 0) -> SurveyConfig:
    return SurveyConfig.model_validate(
        {
            "area": {"length_m": length_m, "width_m": width_m, "seafloor_depth_m": 12.0},
            "plan": {"altitude_m": 3.0, "cross_lines": cross_lines, "closing_line": False},
            "imaging": {"scale": 8},
        }
    )


@cache
def rig() -> Rig:
    return calibrated(25)


def calibrated(views: int) -> Rig:
    imaging = settings().imaging.model_copy(update={"pool_views": views})
    return usual_rig(settings().camera, settings().water, imaging)


@cache
def plan() -> Plan:
    return plan_survey(settings(), design_rig(settings().camera, settings().water)).plan


def block(tracks: TrackModel = TRACKS, drawn: float = 30.0, seed: int = 0) -> ExpectedBlock:
    return Candidate(config=settings(), made=plan(), rig=rig()).block(
        tracks, drawn=drawn, seed=seed
    )


def figures(found: Precision) -> np.ndarray:
    shape = float(np.sqrt((found.shape_m**2).sum(axis=1).mean()))
    return np.array([*found.bend_m, found.scale, found.heights_rms_m, shape])


NAVIGATION = NavigationErrors.of(NavigationConfig(), ReconstructConfig())


@pytest.mark.slow
def test_a_plan_says_how_far_surveys_err(tmp_path: Path) -> None:
    """Sag, scale and heights of surveys of known truth that the pipeline's end adjusts."""
    config = settings(5.0, 4.0)
    own = plan_survey(config, design_rig(config.camera, config.water)).plan
    _, time_s = stations_and_times(own, rig(), survey_costs(config))
    tracks = TrackModel(
        per_picture=bend_survey.OBSERVATIONS / (2 * len(time_s)), matched=bend_survey.MATCHED,
        noise_px=bend_survey.NOISE_PX,
    )  # fmt: skip
    expected = predict(
        Candidate(config=config, made=own, rig=rig()).block(tracks),
        errors_of_drawn_logs(np.ptp(time_s)),
    )
    said = figures(expected)[:4]
    made = [
        errors(swayed(own, rig(), config, seed), rig(), expected.cell_m, seed) for seed in range(6)
    ]
    ratio = np.sqrt((np.array(made) ** 2).mean(axis=0)) / said
    assert np.all((ratio > 0.45) & (ratio < 1.8)), dict(zip(FIGURES, ratio, strict=False))
    assert 0.7 < np.exp(np.log(ratio).mean()) < 1.4


@pytest.mark.parametrize(("drawn", "within"), [(20.0, 0.1), (40.0, 0.05)])
def test_the_answer_hardly_depends_on_how_many_points_are_drawn(
    drawn: float, within: float
) -> None:
    few, many = (figures(predict(block(drawn=n, seed=1), NAVIGATION)) for n in (drawn, 160.0))
    np.testing.assert_allclose(few, many, rtol=within)
    assert not np.allclose(few, many, rtol=1e-6)


def test_sigmas_go_with_the_root_of_all_that_errs() -> None:
    once = predict(block(), NAVIGATION)
    noisier = replace(TRACKS, noise_px=2 * TRACKS.noise_px)
    fewer = replace(noisier, per_picture=4 * TRACKS.per_picture)
    np.testing.assert_allclose(figures(predict(block(fewer), NAVIGATION)), figures(once), rtol=1e-9)
    held = predict(block(), NAVIGATION.times(1e-6), calibration=False)
    twice = predict(block(noisier), NAVIGATION.times(2e-6), calibration=False)
    np.testing.assert_allclose(figures(twice)[2:], 2 * figures(held)[2:], rtol=0.05)


def test_what_is_left_out_does_not_err() -> None:
    every = figures(predict(block(), NAVIGATION))
    for part in (
        predict(block(), NAVIGATION, calibration=False),
        predict(block(), NAVIGATION, pixels=False),
        predict(block(), NAVIGATION.times(1e-3)),
    ):
        assert np.all(figures(part) <= every * 1.03)
    exact = predict(block(), NAVIGATION.times(1e-3))
    assert np.all(exact.bend_m < 0.85 * every[:2])  # what is not soft is not corrected
    none = predict(block(), NAVIGATION.times(1e-3), pixels=False, calibration=False)
    assert figures(none)[4] < 0.05 * every[4]


def test_depth_alone_holds_the_bend_as_a_plain_fit_would() -> None:
    """White depth and nothing else: the sag is that of a paraboloid through the readings, weighed
    with what the pictures know themselves."""
    soft = block(replace(TRACKS, noise_px=0.3))
    channels = {
        name: replace(errs, constant=1e3 * errs.constant, white=1e3 * errs.white)
        for name, errs in NAVIGATION.channels.items()
    }
    white_m = 0.002
    free = {**channels, "depth": replace(channels["depth"], constant=10.0, white=10.0)}
    channels["depth"] = replace(channels["depth"], constant=0.01, slow=1e-9, white=white_m)
    found, alone = (
        predict(soft, replace(NAVIGATION, channels=given)).bend_m for given in (channels, free)
    )
    plain = white_m * np.linalg.norm(sag_weights(soft.state.centres[:, :2]), axis=1)
    np.testing.assert_allclose(found, (alone**-2 + plain**-2) ** -0.5, rtol=0.2)
    assert np.all(found < 0.6 * alone)


def test_tracks_are_as_the_model_states() -> None:
    found = block(drawn=60.0)
    pixels, stations = found.pixels, len(found.time_s)
    per_picture = found.times * len(pixels.station) / (2 * stations)
    assert per_picture == pytest.approx(TRACKS.per_picture, rel=1e-9)
    lengths, camera = np.diff(pixels.starts), found.state.rig.cameras["left"]
    assert lengths.min() >= 2
    shown = np.zeros(pixels.points)
    for turn, centre in zip(found.state.turns, found.state.centres, strict=True):
        for pose in found.state.rig.cam_from_rig.values():
            at = camera.project(pose.apply((found.state.points - centre) @ turn))
            shown += np.all((at > 0) & (at < [camera.width_px, camera.height_px]), axis=1)
    # A binomial number of views of which those below two are not kept.
    k = np.arange(2, shown.max() + 1)
    chances = np.array([[math.comb(int(n), int(j)) * 0.5**n for j in k] for n in shown])
    expected = (chances @ k / chances.sum(axis=1)).mean()
    assert lengths.mean() == pytest.approx(expected, rel=0.03)
    assert np.all(np.bincount(pixels.station, minlength=stations) > 20)


@pytest.mark.slow
def test_four_times_the_views_halve_the_sigmas_of_a_calibration() -> None:
    few, many = (calibrated(views).sigmas for views in (25, 100))
    ratios = np.array([few[name] / many[name] for name in few])
    assert 1.6 < np.exp(np.log(ratios).mean()) < 2.5
    assert few["left.port_distance_m"] == pytest.approx(0.003, rel=0.6)  # Caesarea's: 0.0033


def test_control_points_place_a_survey() -> None:
    base = Candidate(config=settings(), rig=rig())
    plain, held = base.precision.place_m, with_control(base).precision.place_m
    assert np.sqrt((plain[:, 2] ** 2).mean()) > 0.04
    assert 0.003 < np.sqrt((held**2).mean()) < 0.01


@pytest.mark.slow
def test_measures_are_ranked_by_what_a_minute_buys() -> None:
    base = Candidate(config=settings(), rig=rig())
    found = single_measures(base)
    assert {"1 more cross line", "a closing line"} <= {one.name for one in found}
    gains = [
        (worst_bend(base.precision) - worst_bend(one.precision)) / (one.minutes - base.minutes)
        for one in found
    ]
    assert gains == sorted(gains, reverse=True)
    assert gains[0] > 0


@pytest.mark.slow
def test_the_report_of_a_planned_workspace_writes_what_it_says(tmp_path: Path) -> None:
    workspace = settings_in(tmp_path / "w", SMALL)
    run(["plan"], workspace, None, executor=SERIAL)
    config = load_config(workspace / "survey.toml")
    text, data = precision_report(workspace, config, measures=False)
    assert "without errors of calibration" in text
    assert 0 < data["heights_rms_m"] < 0.01
    assert 0 < data["without"]["calibration"]["scale"] < data["scale"] < 1e-3
    assert data["stations_shape_rms_m"] < data["stations_shape_worst_m"]
    plan_folder = workspace / "plan"
    assert read_json(plan_folder / "precision.json") == json_values(data)
    with rasterio.open(plan_folder / "precision.tif") as raster:
        heights, (west, south, east, north) = raster.read(1), raster.bounds
        assert "Azimuthal_Equidistant" in raster.crs.to_wkt()
    known = heights[np.isfinite(heights)]
    assert np.sqrt((known**2).mean()) == pytest.approx(data["heights_rms_m"], rel=1e-4)
    area = read_plan(plan_folder / "plan.json").area.corners_ne
    assert np.all(area[:, :2].min(axis=0) > [south - 0.5, west - 0.5])
    assert np.all(area[:, :2].max(axis=0) < [north + 0.5, east + 0.5])
    assert "up to date" in str(run(["plan"], workspace, None, executor=SERIAL))
