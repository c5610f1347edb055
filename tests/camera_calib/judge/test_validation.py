from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from alice_survey.core.errors import CalibrationError
from camera_calib.calibrate.detect_views import Detections
from camera_calib.calibrate.results import write_results
from camera_calib.calibrate.solve import recalibrate
from camera_calib.calibrate.start import locate
from camera_calib.calibration import Calibration, TargetView
from camera_calib.freedom import Freedom, Prior, intrinsics, of_cameras, of_ports, pose_names, value
from camera_calib.judge.validation import (
    LengthErrors,
    farthest,
    halves_agreement,
    hold_out,
    length_errors,
    score_hold_out,
)
from camera_calib.rig import read_rig
from tests.oracles_report import (
    DESIGN,
    SQUARE_M,
    adjusted,
    all_free,
    board_points,
    moved_rig,
    synthetic_views,
    true_rig,
    usual,
    usual_held_out,
)


def lengths_of(found: Calibration) -> LengthErrors:
    return length_errors(
        found.rig,
        found.views,
        found.rig_from_target,
        found.residuals_px,
        found.target_points,
        found.noise_px,
    )


def test_every_fifth_view_is_held_out_and_posed_without_it() -> None:
    held = usual_held_out()
    names = {view.name for view in held.views}
    assert names == {"02", "07", "12"}
    assert not names & {view.name for view in held.used.views}
    true = synthetic_views(true_rig(), 14, 0.1, 1).rig_from_target
    for view, pose in zip(held.views, held.rig_from_target, strict=True):
        off = pose.translation - true[int(view.name)].translation
        assert np.abs(off).max() < 0.02


@pytest.mark.slow
def test_held_out_views_fit_as_noise_and_covariance_promise() -> None:
    """Squares of the errors over five calibrations, against their expectation."""
    scores = [score_hold_out(usual_held_out(seed)) for seed in range(1, 6)]
    found = sum(s.points * s.rms_px**2 for s in scores)
    expected = sum(s.points * s.expected_px**2 for s in scores)
    assert found / expected == pytest.approx(1.0, abs=0.12)
    assert all(s.outliers == 0 for s in scores)
    assert all(s.expected_px < 0.1 * 2**0.5 * 1.1 for s in scores)


def test_a_wrong_model_fits_held_out_views_worse_than_it_promises() -> None:
    """Distortion is left out: a lens that the views used cannot bear, nor those held out."""
    made = synthetic_views(true_rig(), 12, 0.02, 3)
    names = ("fx_px", "fy_px", "cx_px", "cy_px", "port_distance_m")
    free = Freedom(free=(*of_cameras(DESIGN, names), *pose_names(DESIGN)))

    def wrong(views: Sequence[TargetView]) -> Calibration:
        return replace(adjusted(views, made.points, DESIGN, free), noise_px=0.02)

    held = hold_out(made.views, wrong, locate)

    assert held is not None
    score = score_hold_out(held)
    assert score.outliers > 0.2 * (score.points + score.outliers)


def test_halves_differ_as_their_covariances_promise() -> None:
    found = [held.halves for held in map(usual_held_out, range(1, 6))]
    agree = [halves_agreement(halves) for halves in found if halves is not None]
    assert len(agree) == 5
    assert sum(one.chi2 for one in agree) / sum(one.parameters for one in agree) == pytest.approx(
        1.0, abs=0.25
    )


def test_an_error_of_the_prior_is_the_same_in_both_halves() -> None:
    """A prior about as good as the views: its own error hardly shows between halves."""
    lens = of_cameras(DESIGN, intrinsics("opencv5"))
    true = np.array([value(true_rig(), name) for name in lens])
    ratios, independent = [], []
    for seed in range(1, 6):
        found, rng = usual(seed), np.random.default_rng([seed, 5])
        assert found.rig.covariance is not None
        at = [found.rig.covariance.parameters.index(name) for name in lens]
        covariance = 0.3 * found.rig.covariance.matrix[np.ix_(at, at)]
        mean = rng.multivariate_normal(true, covariance)
        prior = Prior(parameters=lens, mean=mean, covariance=covariance)
        ports = (*of_ports(DESIGN), *pose_names(DESIGN))
        freedom = Freedom(free=ports, prior=prior)
        first, second = (
            adjusted(found.views[i::2], found.target_points, found.rig, freedom) for i in range(2)
        )
        alone = Freedom(free=freedom.names(found.rig))
        shared = halves_agreement((first, second))
        unaware = (replace(first, freedom=alone), replace(second, freedom=alone))
        ratios.append(shared.chi2 / shared.parameters)
        independent.append(halves_agreement(unaware).chi2 / shared.parameters)
    assert 0.75**2 < np.mean(ratios) < 1.3**2
    assert np.mean(independent) < 0.75**2


def test_the_same_calibration_twice_does_not_differ_and_drawn_ones_do_by_chance() -> None:
    found = usual()
    same = halves_agreement((found, found))
    assert same.chi2 == 0.0
    assert same.p_value == 1.0
    covariance = found.rig.covariance
    assert covariance is not None
    names, rng = covariance.parameters, np.random.default_rng(6)
    draws = rng.multivariate_normal(np.zeros(len(names)), 2.0 * covariance.matrix, 100, "ignore")
    moved = (moved_rig(found.rig, dict(zip(names, draw, strict=True))) for draw in draws)
    agree = [halves_agreement((found, replace(found, rig=rig))) for rig in moved]
    assert np.mean([one.chi2 for one in agree]) == pytest.approx(len(names), rel=0.08)
    assert np.std([one.chi2 for one in agree]) == pytest.approx((2 * len(names)) ** 0.5, rel=0.3)
    assert 0.4 < np.mean([one.p_value for one in agree]) < 0.6


@pytest.mark.slow
@pytest.mark.parametrize("longer", [0.0, 0.02])
def test_sigmas_are_wider_where_halves_disagree(longer: float, tmp_path: Path) -> None:
    """Every other view was taken with a focal length that is 2 % longer."""
    rig, moved = true_rig(), {}
    for name in rig.cameras:
        fx_px, fy_px = (rig.cameras[name].parameter(one) for one in ("fx_px", "fy_px"))
        moved |= {f"{name}.fx_px": longer * fx_px, f"{name}.fy_px": longer * fy_px}
    made, other = (synthetic_views(one, 14, 0.1, 1) for one in (rig, moved_rig(rig, moved)))
    views = [pair[i % 2] for i, pair in enumerate(zip(made.views, other.views, strict=True))]
    found = adjusted(views, made.points, DESIGN, all_free(DESIGN))
    found = replace(found, rig=replace(found.rig, body_from_rig=None))
    sizes = {name: (camera.width_px, camera.height_px) for name, camera in rig.cameras.items()}

    write_results(tmp_path, found, Detections(views=tuple(views), sizes=sizes, rejections=()))

    written, covariance = read_rig(tmp_path / "rig.json").covariance, found.rig.covariance
    assert written is not None
    assert covariance is not None
    first, second = (recalibrate(found, views[i::2]) for i in range(2))
    apart = [value(second.rig, one) - value(first.rig, one) for one in moved]
    sigmas = np.array([[one.rig.covariance.sigmas[m] for m in moved] for one in (first, second)])
    ratios = np.array([written.sigmas[one] / covariance.sigmas[one] for one in moved])
    if longer:
        assert np.ptp(ratios) < 1e-3
        # Chi-squared is at least the square of any parameter's own difference.
        least = np.abs(apart / np.hypot(*sigmas)).max() / len(covariance.parameters) ** 0.5
        assert 1.2 < least < ratios[0] < 3.0 * least
    else:
        assert ratios.tolist() == [1.0] * 4


@pytest.mark.parametrize("enough", [8, 14])
def test_tests_are_left_out_where_too_few_views_calibrate(enough: int) -> None:
    found = usual()

    def calibrate(views: Sequence[TargetView]) -> Calibration:
        if len(views) < enough:
            raise CalibrationError("too few")
        return adjusted(views, found.target_points, found.rig, all_free(DESIGN))

    held = hold_out(found.views, calibrate, locate)
    assert held is None if enough == 14 else held is not None and held.halves is None


def test_lengths_are_exact_in_the_true_rig() -> None:
    rig = true_rig()
    made = synthetic_views(rig, 5, 0.0, 4)
    nothing = np.zeros((5, 2, len(made.points), 2))
    for v, view in enumerate(made.views):
        for c, name in enumerate(rig.cameras):
            nothing[v, c, np.isnan(view.pixels[name][:, 0])] = np.nan
    found = length_errors(rig, made.views, made.rig_from_target, nothing, made.points, 0.1)
    assert np.abs(found.error_m).max() < 1e-9
    assert found.scale_ppm()[0] == pytest.approx(0.0, abs=600.0)  # the bias, expected of noise


def test_lengths_err_as_their_noise_and_a_wrong_baseline_or_target_is_a_wrong_scale() -> None:
    calibration = usual()
    found = lengths_of(calibration)
    rms, expected = found.rms_m()
    assert rms / expected == pytest.approx(1.0, abs=0.2)
    scale, sigma = found.scale_ppm()
    assert abs(scale) < 4 * sigma
    scaled = (found.error_m - found.bias_m) / found.sigma_m
    assert np.std(scaled) == pytest.approx(1.0, abs=0.2)
    longer = moved_rig(calibration.rig, {"right.x_m": -0.001 * 0.1001})
    of_longer, sigma = lengths_of(replace(calibration, rig=longer)).scale_ppm()
    assert of_longer - scale == pytest.approx(1000.0, abs=60.0)
    assert sigma < 1000.0
    wrong = lengths_of(replace(calibration, target_points=0.998 * calibration.target_points))
    assert wrong.scale_ppm()[0] - scale == pytest.approx(2000.0, abs=60.0)


def test_lengths_in_dull_pictures_err_as_their_noise() -> None:
    """Every second view three times as noisy."""
    rig, made = true_rig(), synthetic_views(true_rig(), 16, 0.0, 4)
    rng, noise_px = np.random.default_rng(8), np.tile([[0.05, 0.05], [0.15, 0.15]], (8, 1))
    views, misses = [], np.full((16, 2, len(made.points), 2), np.nan)
    for v, view in enumerate(made.views):
        pixels = {}
        for c, (name, seen) in enumerate(view.pixels.items()):
            pixels[name] = seen + rng.normal(0.0, noise_px[v, c], seen.shape)
            misses[v, c] = seen - pixels[name]
        views.append(replace(view, pixels=pixels))
    found = length_errors(rig, views, made.rig_from_target, misses, made.points, noise_px)
    scores = (found.error_m - found.bias_m) / found.sigma_m
    for odd in (0, 1):
        assert np.std(scores[found.view % 2 == odd]) == pytest.approx(1.0, abs=0.1)


def test_the_farthest_of_a_grid_are_its_corners() -> None:
    points = board_points(5, 4)
    pairs = farthest(points, np.arange(20))
    assert {0, 4, 15, 19} <= set(pairs.ravel())
    apart = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    assert apart.max() == pytest.approx(SQUARE_M * 5.0)
    some = farthest(points, np.array([0, 1, 2]))
    np.testing.assert_array_equal(some, [[0, 1], [0, 2]])
