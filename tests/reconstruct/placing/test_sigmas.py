"""The sigmas that a placement states are those of its errors, however correlated errors are."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.frames import Array, Datum, interpolate_poses, rotation_from_attitude
from alice_survey.core.manifest import ImageRecord
from alice_survey.core.records import BendRecord
from camera_calib.mount import mount_rotation
from reconstruct.placing.alignment import Similarity, level
from reconstruct.placing.correlated_fit import (
    correlated_share,
    dives_of,
    standard_residuals,
    whiten,
)
from reconstruct.placing.fit import PlacementFit, fit_navigation
from reconstruct.placing.navigation import USUAL_INSTALLATION, Installation
from reconstruct.placing.place import fit_with_mount
from tests.oracles_place import covariance_matrix, standard_residuals_densely

SLOW = pytest.mark.slow
DATUM = Datum(32.8236, 34.9553)
SIGMA = np.array([0.06, 0.06, 0.05, *np.deg2rad([0.05, 0.05, 0.3])])
"""Of north, east, depth (m), roll, pitch, heading (rad)."""
BODY_FROM_CAM = {"cam": RigidTransform.from_translation([0.4, 0.1, 0.2])}
STEP_S = 2.5


def flight(lines: int = 4, stations: int = 12) -> RigidTransform:
    """True poses of the body along lawnmower lines 1 m apart, a picture every half metre."""
    line, step = np.divmod(np.arange(lines * stations), stations)
    at = np.where(line % 2 == 0, step, stations - 1 - step)
    lean = np.random.default_rng(99).normal(0, np.deg2rad(1.5), (len(at), 2))
    attitudes = rotation_from_attitude(lean[:, 0], lean[:, 1], np.pi * (line % 2))
    return RigidTransform.from_components(
        np.column_stack([0.5 * at, line, np.full(len(at), 13.0)]), attitudes
    )


def gauss_markov(
    rng: np.random.Generator, count: int, tau_s: float, step_s: float = STEP_S
) -> Array:
    """(count, 6) stationary errors of unit variance at equal steps."""
    kept = np.exp(-step_s / tau_s)
    errors = rng.normal(size=(count, 6))
    errors[1:] *= np.sqrt(1 - kept**2)
    return np.asarray(lfilter([1.0], [1.0, -kept], errors, axis=0))


def records_of(body: RigidTransform, errors: Array, sigma: Array) -> list[ImageRecord]:
    """The manifest of a flight with such errors of position and attitude."""
    roll_pitch_heading = body.rotation.as_euler("ZYX")[:, ::-1] + errors[:, 3:]
    places = DATUM.geodetic_from_ned(body.translation + errors[:, :3])
    return [
        ImageRecord(
            image=f"{k:03d}.png", camera="cam", station=k, time_s=STEP_S * k,
            latitude_deg=float(place[0]), longitude_deg=float(place[1]), depth_m=float(place[2]),
            roll_deg=float(a[0]), pitch_deg=float(a[1]), heading_deg=float(a[2] % 360),
            sigma_horizontal_m=float(s[0]), sigma_depth_m=float(s[2]),
            sigma_attitude_deg=float(np.rad2deg(s[3])), sigma_heading_deg=float(np.rad2deg(s[5])),
        )
        for k, (place, a, s) in enumerate(
            zip(places, np.rad2deg(roll_pitch_heading), np.broadcast_to(sigma, errors.shape),
                strict=True)
        )
    ]  # fmt: skip


def flown(
    body: RigidTransform, seed: int | list[int], tau_s: float, factor: float = 1.0
) -> list[ImageRecord]:
    """The manifest of a flight with errors of `factor` times the sigmas that it states."""
    rng = np.random.default_rng(seed)
    return records_of(body, factor * SIGMA * gauss_markov(rng, len(body), tau_s), SIGMA)


def own_frame(
    rng: np.random.Generator, cameras: RigidTransform
) -> tuple[RigidTransform, list[RigidTransform], Similarity]:
    """Truth of a frame of a model's own, poses of cameras in it, and the model levelled."""
    truth = RigidTransform.from_components(rng.normal(0, 30, 3), Rotation.random(rng=rng))
    poses = [truth.inv() * pose for pose in cameras]
    floor = np.column_stack([rng.uniform(0, 5, (300, 2)), rng.normal(15, 0.1, 300)])
    centres = np.stack([pose.translation for pose in poses])
    return truth, poses, level(truth.inv().apply(floor), centres)


def errors_of(fit: PlacementFit, truth: RigidTransform, poses: list[RigidTransform]) -> Array:
    """(6,) shift of the cameras' middle and turn, in NED."""
    found, centres = fit.ned_from_model, np.stack([pose.translation for pose in poses])
    shift = found.apply(centres).mean(axis=0) - truth.apply(centres).mean(axis=0)
    return np.r_[shift, (found.rotation * truth.rotation.inv()).as_rotvec()]


def place(
    body: RigidTransform,
    records: list[ImageRecord],
    seed: int,
    **options: float | Installation | None,
) -> tuple[PlacementFit, Array, Array]:
    """Fit a model that is the truth moved; errors and sigmas: N, E, D, turn about each, scale.

    The model's own errors are 1 mm and 0.005 degrees.
    """
    rng = np.random.default_rng(seed)
    noise = RigidTransform.from_components(
        rng.normal(0, 1e-3, (len(body), 3)),
        Rotation.from_rotvec(rng.normal(0, 1e-4, (len(body), 3))),
    )
    truth, poses, levelled = own_frame(rng, body * BODY_FROM_CAM["cam"] * noise)
    options.setdefault("known_scale", 1.0)
    fit: Any = fit_navigation(
        records, poses, BODY_FROM_CAM, DATUM, levelled, **options,  # type: ignore[arg-type]
    )  # fmt: skip
    errors = np.r_[errors_of(fit, truth, poses), np.log(fit.ned_from_model.scale)]
    sigma = np.sqrt(np.diag(fit.covariance))
    return fit, errors, np.r_[sigma[3:6], sigma[:3], sigma[6]]


@pytest.mark.parametrize("tau_s", [40.0, *(pytest.param(t, marks=SLOW) for t in (1.0, 4000.0))])
def test_errors_over_their_sigmas_are_of_unit_size(tau_s: float) -> None:
    """From white errors to ones that outlast the survey; a wrong independence gives 3 to 7."""
    body, ratios = flight(), []
    for seed in range(5):
        _, error, sigma = place(body, flown(body, [int(tau_s), seed], tau_s), seed)
        ratios.append(error[:6] / sigma[:6])
    position, turns = np.array(ratios)[:, :3], np.array(ratios)[:, 3:]
    assert 0.55 < np.sqrt(np.mean(position**2)) < 1.4
    assert 0.5 < np.sqrt(np.mean(turns**2)) < 1.4


def test_correlation_is_found() -> None:
    body = flight(8, 15)
    for tau_s, low, high in ((1.0, 0.1, 6.0), (25.0, 6.0, 100.0)):
        fit, _, _ = place(body, flown(body, 3, tau_s), 3)
        for group in ("horizontal", "depth", "heading"):
            how = fit.correlation[group]
            assert low / 2 <= (how.tau if how.white < 0.5 else 0.5) <= high, (group, how)
        assert all("correlation_s" in how for how in fit.record.errors.values())


@pytest.mark.slow
def test_a_heading_that_turns_the_reckoned_track_too_is_one_error_not_two() -> None:
    """Compass error turns both headings and the positions integrated along them."""
    body, ratios = flight(), []
    for seed in range(5):
        rng = np.random.default_rng([5, seed])
        errors = SIGMA * gauss_markov(rng, len(body), 4000.0)
        turn = errors[:, 5].mean()
        away = body.translation - body.translation.mean(axis=0)
        errors[:, 0] -= turn * away[:, 1]
        errors[:, 1] += turn * away[:, 0]
        _, error, sigma = place(body, records_of(body, errors, SIGMA), seed)
        ratios.append(error[5] / sigma[5])
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.5


def test_bad_fixes_are_left_out_and_gaps_do_no_harm() -> None:
    body = flight()
    records = flown(body, 8, 100.0)
    clean, error, sigma = place(body, records, 1)
    bad = {7: 0.5, 20: -2.0, 33: 40.0}  # metres north
    for k, miss in bad.items():
        records[k] = replace(records[k], latitude_deg=records[k].latitude_deg + miss / 110_900)
    records[12] = replace(records[12], heading_deg=(records[12].heading_deg + 90) % 360)
    hurt, error_hurt, _ = place(body, records, 1)
    assert hurt.record.left_out["horizontal"] == 3
    assert hurt.record.left_out["heading"] == 1
    assert hurt.record.left_out["depth"] == clean.record.left_out["depth"] == 0
    assert np.all(np.abs(error_hurt - error)[:6] < 0.3 * sigma[:6])
    for k in range(15, 30):
        records[k] = replace(records[k], latitude_deg=np.nan)
    gap, error_gap, sigma_gap = place(body, records, 1)
    assert gap.record.stations == len(body) - 15 - 2
    assert np.all(np.abs(error_gap[:6]) < 4.0 * sigma_gap[:6])


def test_the_mount_adds_its_sigma_and_a_turning_vehicle_shows_it() -> None:
    body = flight()
    records = flown(body, 2, 1.0)
    *_, exact = place(body, records, 1)
    installed = replace(USUAL_INSTALLATION, mount_rad=np.deg2rad(2.0))
    *_, loose = place(body, records, 1, installed=installed)
    # Heading: its mount error is the same on all lines, only positions determine it.
    assert loose[5] > 1.1 * exact[5]
    # Tilt: lines flown to and fro show it, and depths do.
    assert np.all(loose[3:5] < np.deg2rad(0.5))
    np.testing.assert_allclose(np.rad2deg(loose[3:5]), np.rad2deg(exact[3:5]), atol=0.5)


def test_a_clock_that_is_off_by_more_than_stated_is_named_with_its_setting(
    capsys: pytest.CaptureFixture[str],
) -> None:
    body = flight(6, 14)
    headings = body.rotation.as_euler("ZYX")[:, 0]
    errors = SIGMA * gauss_markov(np.random.default_rng(5), len(body), 1.0)
    a_second_ahead_m = 0.5 / STEP_S
    errors[:, :2] += a_second_ahead_m * np.column_stack([np.cos(headings), np.sin(headings)])
    late = [  # 20 s for a turn between lines
        replace(r, time_s=r.time_s + 20.0 * (r.station // 14))
        for r in records_of(body, errors, SIGMA)
    ]
    place(body, late, 2)
    assert "clock_sigma_s" in capsys.readouterr().err
    loose = replace(USUAL_INSTALLATION, clock_s=2.0)
    fit, _, _ = place(body, late, 2, installed=loose)
    assert "clock_sigma_s" not in capsys.readouterr().err
    value, sigma = fit.stated.nuisances["clock_s"].value, fit.stated.nuisances["clock_s"].sigma
    assert abs(abs(value) - 1.0) < 4 * sigma < 1.0


@pytest.mark.parametrize("scatter_s", [1.0, pytest.param(0.0, marks=SLOW)])
def test_times_that_scatter_are_named_and_leave_the_heading_its_sigma(
    scatter_s: float, capsys: pytest.CaptureFixture[str]
) -> None:
    """Readings of other times than the pictures', with one constant error of the compass."""
    body, ratios = flight(6, 14), []
    time: Array = STEP_S * np.arange(len(body), dtype=np.float64)
    for seed in range(3):
        rng = np.random.default_rng([seed, 46])
        errors = SIGMA * gauss_markov(rng, len(body), 400.0)
        errors[:, 5] = SIGMA[5] * rng.normal()
        at: Array = np.clip(time + rng.uniform(-scatter_s, scatter_s, len(time)), 0.0, time[-1])
        read = interpolate_poses(time, body, at)
        fit, error, sigma = place(body, records_of(read, errors, SIGMA), seed)
        ratios.append(error[5] / sigma[5])
        found = fit.stated.nuisances.get("time_scatter_s")
        assert ("scatter" in capsys.readouterr().err) == (found is not None) == (scatter_s > 0)
        assert found is None or 0.4 < found.value < 0.8  # uniform: 0.58
        assert sigma[5] > 0.6 * SIGMA[5]
    assert np.sqrt(np.mean(np.square(ratios))) < 1.6


@pytest.mark.parametrize("drift_m", [0.036, *(pytest.param(d, marks=SLOW) for d in (0.0, 0.4))])
def test_a_drift_of_depths_is_named_and_costs_the_depth(
    drift_m: float, capsys: pytest.CaptureFixture[str]
) -> None:
    """0.7 of the stated sigma, as the worst of 24 flights has it, is usual; 8 are not."""
    body, off, found = flight(6, 14), [], []
    share = np.linspace(0.0, 1.0, len(body))
    for seed in range(4):
        errors = SIGMA * gauss_markov(np.random.default_rng([seed, 8]), len(body), 1.0)
        errors[:, 2] += drift_m * share
        fit, error, sigma = place(body, records_of(body, errors, SIGMA), seed)
        off.append(error[2] / sigma[2])
        drift = fit.stated.nuisances.get("depth_drift_m")
        found.append(0.0 if drift is None else drift.value)
        assert ("drift" in capsys.readouterr().err) == (drift_m > 0.1)
        assert np.all(np.abs(error[3:5]) < 4.0 * sigma[3:5])  # nor does it tilt the model
    np.testing.assert_allclose(found, drift_m, atol=0.1)
    assert np.sqrt(np.mean(np.square(off))) < 1.6
    assert drift_m < 0.1 or np.sqrt(np.mean(np.square(off))) > 0.4


@pytest.mark.parametrize("tau", [0.5, 7.0, 300.0])
@pytest.mark.parametrize("white", [1e-4, 0.3])
def test_whitening_is_the_inverse_of_choleskys_factor(tau: float, white: float) -> None:
    rng = np.random.default_rng(1)
    time = np.sort(rng.uniform(0, 40, 30))
    sigma = rng.uniform(0.5, 2.0, 30)
    used = rng.uniform(size=30) < 0.8
    values = np.where(used[:, None], rng.normal(size=(30, 3)), 0.0)
    found, log_det = whiten(time, sigma, used, values, tau, white)[:2]
    matrix = covariance_matrix(time[used], sigma[used], tau, white)
    factor = np.linalg.cholesky(matrix)
    np.testing.assert_allclose(found[used], np.linalg.solve(factor, values[used]), atol=1e-8)
    assert log_det == pytest.approx(np.linalg.slogdet(matrix)[1], abs=1e-8)
    assert np.all(found[~used] == 0)
    off = standard_residuals(time, sigma, used, values[:, 0], tau, white)
    expected = standard_residuals_densely(matrix, values[used, 0])
    np.testing.assert_allclose(off[used], expected, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("tau", [1.0, 30.0, 1e4])
def test_the_correlated_share_is_that_of_the_mean(tau: float) -> None:
    time = np.linspace(0, 100, 4000)
    matrix = np.exp(-np.abs(time[:, None] - time) / tau)
    assert correlated_share(time, tau, 0.2) == pytest.approx(0.8 * matrix.mean(), rel=0.02)
    assert correlated_share(time, 1e12, 0.0) == pytest.approx(1.0)


@pytest.mark.slow
def test_twenty_flights_are_placed_within_their_sigmas() -> None:
    """The built-in flight simulator, its sensors and its filter, 20 times over one small plan."""
    from alice_survey.core.config import AreaConfig, PlanConfig, SurveyConfig
    from camera_calib.rig import design_rig
    from missions.fly.simulation import flight_settings, floor_grid, simulate_plan
    from missions.plan.planner import plan_survey
    from tests.missions.flown_plans import terrain_of

    config = SurveyConfig(
        area=AreaConfig(length_m=4.5, width_m=3.7, seafloor_depth_m=15.0),
        plan=PlanConfig(forward_overlap=0.62, side_overlap=0.3, cross_lines=1),
    )
    plan = plan_survey(config, design_rig(config.camera, config.water)).plan
    floor = floor_grid(terrain_of(config, plan))
    ratios = []
    for seed in range(20):
        flight_ = simulate_plan(
            plan, flight_settings(config), floor, np.random.default_rng([seed, 20]), label=""
        )
        log, time_s = flight_.log, flight_.truth.time_s
        at = np.searchsorted(time_s, flight_.trigger_s).clip(0, len(time_s) - 1)
        body = flight_.truth.ned_from_body[at]
        true = body.rotation.as_euler("ZYX")[:, ::-1]
        errors = np.hstack([log.position_ned[at] - body.translation, log.attitude_rad[at] - true])
        sigma = np.column_stack([
            log.sigma_horizontal_m, log.sigma_horizontal_m, log.sigma_depth_m,
            log.sigma_attitude_rad, log.sigma_attitude_rad, log.sigma_heading_rad,
        ])[at]  # fmt: skip
        records = [
            replace(r, time_s=float(t))
            for r, t in zip(records_of(body, errors, sigma), time_s[at], strict=True)
        ]
        _, error, stated = place(body, records, seed)
        ratios.append(error[:6] / stated[:6])
    position, tilt, heading = np.split(np.array(ratios), [3, 5], axis=1)
    for part in (position, tilt, heading):
        assert 0.7 < np.sqrt(np.mean(part**2)) < 1.4


def test_sigmas_that_are_stated_too_small_are_enlarged() -> None:
    body = flight()
    fit, _, _ = place(body, flown(body, 4, 1.0, factor=5.0), 1)
    for group in ("horizontal", "depth", "heading"):
        assert 3.5 < fit.correlation[group].factor < 8.0
    honest, _, _ = place(body, flown(body, 4, 1.0), 1)
    assert all(how.factor < 1.6 for how in honest.correlation.values())


def test_a_single_line_without_attitude_does_not_know_its_roll() -> None:
    body = flight(1, 20)
    unknown: dict[str, Any] = dict.fromkeys(("roll_deg", "pitch_deg", "heading_deg"), np.nan)
    records = [replace(r, **unknown) for r in flown(body, 6, 1.0)]
    fit, error, sigma = place(body, records, 1)
    about_line, about_slope, heading = np.rad2deg(sigma[3:6])
    assert 8.0 < about_line < 10.5  # what the level sea floor says
    assert about_slope < 2.0
    assert heading < 2.0
    assert fit.record.largest_tilt_deg == pytest.approx(about_line, rel=0.02)
    axis = fit.record.largest_tilt_axis_deg
    assert axis is not None
    assert min(axis, 180 - axis) < 3.0
    assert np.abs(error[3]) < 3 * sigma[3]


@pytest.mark.slow
def test_a_free_scale_has_a_sigma_that_holds_its_error() -> None:
    body, ratios = flight(), []
    for seed in range(5):
        _, error, sigma = place(body, flown(body, [6, seed], 20.0), seed, known_scale=None)
        ratios.append(error[6] / sigma[6])
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 1.5


TWO_DIVES = flight(8, 15)
SECOND = len(TWO_DIVES) // 2
GAP_S = 1800.0


def two_dives(seed: int, jump_m: float, *, restart: bool = True) -> list[ImageRecord]:
    """Constant errors, a fifth of their variance white; positions of the second dive jump."""
    rng = np.random.default_rng([seed, int(10 * jump_m), restart])
    constants = rng.normal(size=(2, 6))
    if not restart:
        constants[1] = constants[0]
    dive = (np.arange(len(TWO_DIVES)) >= SECOND).astype(int)
    errors: Array = np.sqrt(0.8) * constants[dive] + np.sqrt(0.2) * rng.normal(
        size=(len(TWO_DIVES), 6)
    )
    errors *= SIGMA
    errors[:, :2] += dive[:, None] * jump_m * np.array([np.cos(seed), np.sin(seed)])
    return [
        replace(record, time_s=record.time_s + GAP_S * d)
        for record, d in zip(records_of(TWO_DIVES, errors, SIGMA), dive, strict=True)
    ]


def test_long_gaps_lie_between_dives() -> None:
    time = np.array([0.0, 2.5, 5.0, 65.0, 67.5, 1000.0, 1002.0])
    assert dives_of(time).tolist() == [0, 0, 0, 0, 0, 1, 1]
    assert dives_of(100.0 * np.arange(5.0)).tolist() == [0] * 5
    assert dives_of(400.0 * np.arange(5.0)).tolist() == [0] * 5


@pytest.mark.slow
@pytest.mark.parametrize("restart", [True, False])
def test_two_dives_are_as_sure_as_their_errors_are_independent(restart: bool) -> None:
    found, stated, restarts = [], [], []
    for seed in range(5):
        fit, errors, sigma = place(TWO_DIVES, two_dives(seed, 0.0, restart=restart), seed)
        found.append(errors[:3] / SIGMA[:3])
        stated.append(sigma[:3] / SIGMA[:3])
        restarts.append(fit.correlation["horizontal"].restart)
    ratio = np.sqrt(np.mean((np.array(found) / np.array(stated)) ** 2))
    assert 0.7 < ratio < 1.4
    share = np.mean(stated)
    if restart:  # the mean of two constants
        assert 0.6 < share < 0.85
        assert np.mean(restarts) > 0.5
    else:
        assert 0.75 < share < 1.05


@pytest.mark.slow
@pytest.mark.parametrize("jump_m", [0.5, 5.0])
def test_dives_that_contradict_each_other_leave_the_place_that_unsure(jump_m: float) -> None:
    ratios = []
    for seed in range(4):
        fit, errors, sigma = place(TWO_DIVES, two_dives(seed, jump_m), seed)
        assert not any(fit.record.left_out.values())
        assert fit.correlation["horizontal"].restart * SIGMA[0] > 0.1 * jump_m
        assert fit.correlation["horizontal"].factor < 1.5
        assert sigma[2] < SIGMA[2]  # depths do not suffer
        assert np.rad2deg(sigma[5]) < 0.35
        assert abs(errors[5]) < 4.0 * sigma[5]  # nor the heading
        ratios.append(errors[:2] / sigma[:2])
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 1.6


_MODES, _SIGMA_M = 16, 0.03
_PLACE = 7
"""Parameters of the placement before the modes."""


def waves(centres: Array) -> Array:
    """(N, 6, K) smooth heave of a block, waves of different lengths north and east."""
    span = np.ptp(centres[:, :2], axis=0)
    n, e = ((centres[:, :2] - centres[:, :2].min(axis=0)) / span).T
    modes = np.zeros((len(centres), 6, _MODES))
    for k in range(_MODES):
        modes[:, 2, k] = np.cos(np.pi * (k % 4 + 1) * n) * np.cos(np.pi * (k // 4 + 1) * e)
    return _SIGMA_M * modes


def fitted(seed: int, factor: float) -> tuple[PlacementFit, Array]:
    """A model deformed by this many times its sigmas, placed; its errors, in the fit's order."""
    rng = np.random.default_rng([7, seed])
    body = flight(8, 40)
    cameras = body * BODY_FROM_CAM["cam"]
    modes = waves(cameras.translation)
    sizes = factor * rng.normal(size=_MODES)
    bent = RigidTransform.from_components(
        cameras.translation - (modes @ sizes)[:, :3], cameras.rotation
    )
    own, poses, levelled = own_frame(rng, bent)
    turn = own.inv().rotation.as_matrix()
    modes[:, :3], modes[:, 3:] = turn @ modes[:, :3], turn @ modes[:, 3:]
    fit: Any = fit_navigation(
        flown(body, [4, seed], 1.0), poses, BODY_FROM_CAM, DATUM, levelled,
        known_scale=1.0, modes=modes,
    )  # fmt: skip
    return fit, fit.modes - sizes


def whitened(factor: float) -> tuple[Array, Array]:
    """Factors found of 5 models, and errors of their 80 modes over what is stated."""
    found, off = [], []
    for seed in range(5):
        fit, error = fitted(seed, factor)
        found.append(fit.record.soft_modes_factor)
        off.append(error / np.sqrt(np.diag(fit.joint)[_PLACE:]))
    return np.array(found), np.array(off)


@pytest.mark.slow
def test_modes_of_the_stated_size_stay_as_they_are() -> None:
    found, off = whitened(1.0)
    assert np.count_nonzero(found > 1.0) <= 1
    assert 0.8 < np.sqrt((off**2).mean()) < 1.2


@pytest.mark.slow
@pytest.mark.parametrize("factor", [2.5, 6.0])
def test_modes_larger_than_stated_are_found_and_their_sigmas_are_true(factor: float) -> None:
    found, off = whitened(factor)
    assert 0.8 * factor < np.sqrt(np.mean(found**2)) < 1.25 * factor  # of 80 modes, 8 % each way
    assert 0.75 < np.sqrt((off**2).mean()) < 1.3


def bends_of(
    body: RigidTransform, records: list[ImageRecord], along: float, across: float, seed: int = 0
) -> tuple[BendRecord, ...]:
    """Of a model in a frame of its own whose heights err by these curvatures north and east."""
    rng = np.random.default_rng(seed)
    cameras = body * BODY_FROM_CAM["cam"]
    n, e = (cameras.translation - cameras.translation.mean(axis=0))[:, :2].T
    down = -0.5 * (along * n**2 + across * e**2)
    zero = np.zeros_like(down)
    turns = Rotation.from_rotvec(np.column_stack([-across * e, along * n, zero]))
    bent = RigidTransform.from_components(
        cameras.translation + np.column_stack([zero, zero, down]), turns * cameras.rotation
    )
    _, poses, levelled = own_frame(rng, bent)
    fit: Any = fit_navigation(records, poses, BODY_FROM_CAM, DATUM, levelled, known_scale=1.0)
    return fit.bends


@pytest.mark.slow
@pytest.mark.parametrize("tau_s", [1.0, 4000.0])
def test_a_bent_block_shows_its_curvature(tau_s: float) -> None:
    body = flight(8, 40)
    for seed in range(2):
        found = bends_of(body, flown(body, [3, seed], tau_s), 4e-3, -6e-3, seed)
        along, across = found
        assert along.curvature_per_m == pytest.approx(4e-3, abs=3.5 * along.sigma_per_m)
        assert across.curvature_per_m == pytest.approx(-6e-3, abs=3.5 * across.sigma_per_m)
        assert along.sigma_per_m < 1e-3
        assert along.length_m == pytest.approx(19.5, rel=0.06)
        assert along.sag_m == pytest.approx(along.curvature_per_m * along.length_m**2 / 8)
        assert along.is_significant(1e-3)


@pytest.mark.slow
def test_straight_blocks_are_not_called_bent_and_sigmas_are_true() -> None:
    body, pulls, called = flight(6, 20), [], 0
    for seed in range(15):
        tau_s = [1.0, 60.0, 4000.0][seed % 3]
        for bend in bends_of(body, flown(body, [8, seed], tau_s), 0.0, 0.0, seed):
            pulls.append(bend.curvature_per_m / bend.sigma_per_m)
            called += bend.is_significant(1e-4)
    assert len(pulls) == 30
    assert 0.6 < np.sqrt(np.mean(np.square(pulls))) < 1.4
    assert called <= 1


def test_sigmas_that_are_stated_too_small_do_not_make_a_bend() -> None:
    body = flight(6, 20)
    honest = bends_of(body, flown(body, 3, 1.0), 0.0, 0.0)
    boasted = bends_of(body, flown(body, 3, 1.0, factor=20.0), 0.0, 0.0)
    for sure, unsure in zip(honest, boasted, strict=True):
        assert unsure.sigma_per_m > 8.0 * sure.sigma_per_m
        assert not unsure.is_significant(1e-4)


def test_jumps_of_the_depth_sensor_do_not_make_a_bend() -> None:
    body = flight(6, 20)
    records = flown(body, 4, 1.0)
    for k in (0, 19, 20, 39):
        records[k] = replace(records[k], depth_m=records[k].depth_m + 1.5)
    for bend in bends_of(body, records, 0.0, 0.0):
        assert abs(bend.curvature_per_m) < 4.0 * bend.sigma_per_m
        assert not bend.is_significant(1e-3)


def test_a_line_has_no_bend_across_and_a_few_stations_have_none() -> None:
    body = flight(1, 20)
    (along,) = bends_of(body, flown(body, 5, 1.0), 3e-3, 0.0)
    assert along.curvature_per_m == pytest.approx(3e-3, abs=4 * along.sigma_per_m)
    short = flight(1, 6)
    assert bends_of(short, flown(short, 5, 1.0), 0.0, 0.0) == ()


MOUNTED = flight(8, 15)


def with_mount(words: str, seed: int) -> tuple[PlacementFit, RigidTransform, Array]:
    """Fit with an unknown mount: the fit, the true mount, errors of turn (rad) and place (m)."""
    rng = np.random.default_rng([seed, 7])
    mount = RigidTransform.from_components(
        rng.uniform([0.2, -0.3, 0.0], [0.6, 0.3, 0.3]),
        Rotation.from_rotvec(rng.normal(0, 0.1, 3)) * mount_rotation(words),
    )
    noise = Rotation.from_rotvec(rng.normal(0, 1e-4, (len(MOUNTED), 3)))
    truth, poses, levelled = own_frame(rng, MOUNTED * mount * RigidTransform.from_rotation(noise))
    records = flown(MOUNTED, [seed, 3], 1.0)

    def navigate(
        mounts: Mapping[str, RigidTransform] | None, installed: Installation
    ) -> PlacementFit | None:
        return fit_navigation(
            records, poses, mounts, DATUM, levelled, known_scale=1.0, installed=installed
        )

    alone = {"cam": RigidTransform.identity()}
    fit: Any = fit_with_mount(records, poses, alone, navigate, USUAL_INSTALLATION)
    return fit, mount, np.roll(errors_of(fit, truth, poses), 3)


@pytest.mark.slow
@pytest.mark.parametrize("words", ["nadir-bow-left", "forward+45"])
def test_the_mount_is_found_within_its_sigmas(words: str) -> None:
    turns, arms, places = [], [], []
    for seed in range(4):
        fit, true, error = with_mount(words, seed)
        off = (true.rotation * fit.mount.body_from_rig.rotation.inv()).as_rotvec(degrees=True)
        assert np.abs(off).max() < 2.0
        turns.append(off / fit.mount.turn_sigma_deg)
        arm = true.translation - fit.mount.body_from_rig.translation
        arms.append(arm / fit.mount.lever_sigma_m)
        assert np.all(fit.mount.lever_sigma_m[:2] < 0.1)  # lines to and fro show it
        assert 0.1 < fit.mount.lever_sigma_m[2] < 0.3  # and 1.5 deg of roll and pitch this one
        places.append(error / np.sqrt(np.diag(fit.covariance))[:6])
    for ratios, low in ((turns, 0.4), (np.array(arms)[:, :2], 0.4), (places, 0.3)):
        assert low < np.sqrt(np.mean(np.square(ratios))) < 1.6
