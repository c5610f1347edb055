"""Sigmas are what errors of the parameters do, to first order, found by doing them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import CalibrationError
from camera_calib.camera import Camera
from camera_calib.freedom import POSE
from camera_calib.judge.judgement import anchors_cam
from camera_calib.judge.uncertainty import (
    baselines_m,
    compensation,
    frame_points,
    length_sigmas_m,
    noise_sigmas_m,
    overlap_points,
    point_sigmas_m,
    projection_sigma,
    rig_parameters,
    rig_slopes,
    shape_sigmas_m,
    stereo_sigma,
    taken_up,
)
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.ports.flat import FlatPort
from camera_calib.rig import Covariance, Rig
from camera_calib.triangulate import reproject, triangulate
from tests.camera_calib.calibration_scenes import tilted
from tests.cameras import changed
from tests.oracles_report import (
    DESIGN,
    best_pose_by_search,
    moved_rig,
    some_errors,
    usual,
    with_one_error,
)

PARAMETERS = (*OpenCVLens.parameters, *FlatPort.parameters)

POINTS = np.array([[0.1, -0.2, 1.0], [-0.3, 0.25, 1.7], [0.02, 0.01, 0.8]])


def parts(rig: Rig) -> tuple[list[Camera], list[RigidTransform]]:
    return list(rig.cameras.values()), list(rig.cam_from_rig.values())


@pytest.mark.parametrize("field", [*PARAMETERS, *POSE])
def test_slopes_by_each_parameter_are_those_of_small_changes(field: str) -> None:
    name = f"right.{field}"
    rig = with_one_error(usual().rig, {"left.fx_px": 1.0, name: 1.0})
    _, _, slopes = rig_slopes(rig, "right", POINTS)

    step = 1e-4 if field.endswith("_px") else 1e-6
    plus, minus = (moved_rig(rig, {name: sign * step}) for sign in (1, -1))
    moved = [
        r.cameras["right"].project(r.cam_from_rig["right"].apply(POINTS)) for r in (plus, minus)
    ]
    numeric = (moved[0] - moved[1]) / (2 * step)

    np.testing.assert_allclose(slopes[..., 1], numeric, rtol=2e-5, atol=2e-5)
    np.testing.assert_array_equal(slopes[..., 0], 0.0)


@pytest.mark.parametrize("seed", range(3))
def test_a_projection_errs_by_its_sigma(seed: int) -> None:
    """With one error only, the sigma in the worst direction is the length of its effect."""
    found = usual()
    errors = some_errors(found.rig, seed)
    rig, wrong = with_one_error(found.rig, errors), moved_rig(found.rig, errors)
    camera, anchors = rig.cameras["right"], anchors_cam(found, "right")[::7]
    pixels = camera.frame_grid(5, 4)

    sigma = projection_sigma(rig, "right", pixels, 1.5, compensation(rig, "right", anchors))

    points = camera.at_depth(pixels, 1.5)
    plain = np.linalg.norm(wrong.cameras["right"].project(points) - pixels, axis=-1)
    pose = best_pose_by_search(camera, wrong.cameras["right"], anchors)
    shifted = pose.apply(points.reshape(-1, 3)).reshape(points.shape)
    compensated = np.linalg.norm(wrong.cameras["right"].project(shifted) - pixels, axis=-1)
    np.testing.assert_allclose(sigma.plain_px, plain, rtol=0.05, atol=1e-4)
    np.testing.assert_allclose(sigma.compensated_px, compensated, rtol=0.05, atol=2e-4)
    assert compensated.mean() < 0.5 * plain.mean()


def test_a_turn_hidden_in_the_principal_point_is_compensated() -> None:
    """Far away, moving the centre of a narrow frame is a turn of the camera."""
    rig = with_one_error(DESIGN, {"left.cx_px": 1.0})
    camera = rig.cameras["left"]
    pixels = camera.frame_grid(5, 5)
    anchors = frame_points(camera, (5.0, 10.0))

    sigma = projection_sigma(rig, "left", pixels, 8.0, compensation(rig, "left", anchors))

    np.testing.assert_allclose(sigma.plain_px, 1.0, rtol=1e-9)
    assert 0.0 < sigma.compensated_px.max() < 0.25


@pytest.mark.parametrize("seed", range(3))
def test_triangulated_points_and_lengths_err_by_their_sigmas(seed: int) -> None:
    """True pixels, triangulated exactly in a rig with one error."""
    errors = some_errors(usual().rig, seed)
    rig, wrong = with_one_error(usual().rig, errors), moved_rig(usual().rig, errors)
    points = np.array([[0.0, 0.0, 2.0], [0.35, 0.2, 2.0], [-0.3, -0.3, 1.5], [0.1, 0.1, 1.0]])

    found = triangulate(*parts(wrong), reproject(*parts(rig), points)).points_world

    np.testing.assert_allclose(
        point_sigmas_m(rig, points), np.abs(found - points), rtol=0.05, atol=2e-7
    )
    lengths = np.linalg.norm(np.diff(found, axis=0), axis=1)
    true = np.linalg.norm(np.diff(points, axis=0), axis=1)
    np.testing.assert_allclose(
        length_sigmas_m(rig, points[:-1], points[1:]), np.abs(lengths - true), rtol=0.05, atol=2e-7
    )


def test_noise_sigmas_are_those_of_the_triangulation() -> None:
    rig = usual().rig
    points = np.array([[0.0, 0.0, 2.0], [0.3, 0.2, 1.4]])
    found = triangulate(*parts(rig), reproject(*parts(rig), points), 0.1)
    np.testing.assert_allclose(noise_sigmas_m(rig, points, 0.1), found.sigmas_m, rtol=1e-6)


def test_depth_noise_is_range_squared_over_baseline_and_focal_length() -> None:
    """The closed form of stereo, sigma_z = z^2 sqrt(2) sigma / (f B), from the pinhole's centre."""
    camera = DESIGN.cameras["left"]
    bare = {"port_distance_m": 0.0, "glass_thickness_m": 0.0}
    rig = replace(DESIGN, cameras={n: camera.with_parameters(bare) for n in DESIGN.cameras})
    rig = with_one_error(rig, {"left.fx_px": 0.1})

    ((_, _, sigma_m),) = noise_sigmas_m(rig, np.array([[0.05, 0.0, 2.0]]), 0.1)

    expected_m = 2.0**2 * 2**0.5 * 0.1 / (camera.fx_px * camera.n_water * 0.1)
    assert sigma_m == pytest.approx(expected_m, rel=0.01)


def test_a_rigs_rigid_motion_does_not_count_as_shape() -> None:
    """An error that both centres share turns all that stereo sees."""
    both = with_one_error(DESIGN, {"left.cy_px": 0.5, "right.cy_px": 0.5})
    points = overlap_points(both, 2.0)
    moved, shape = point_sigmas_m(both, points), shape_sigmas_m(both, points)
    assert moved[:, 1].min() > 5e-4
    assert np.abs(shape).max() < 0.1 * moved[:, 1].min()


def test_points_that_one_camera_sees_have_no_sigma() -> None:
    away = {
        "left": RigidTransform.identity(),
        "right": RigidTransform.from_translation([-5.0, 0.0, 0.0]),
    }
    assert np.isnan(stereo_sigma(replace(usual().rig, cam_from_rig=away), 2.0, 0.1).length_sigma_m)
    outside = np.array([[-0.72, 0.0, 2.0], [0.0, 0.0, 2.0]])
    sigmas = point_sigmas_m(usual().rig, outside)
    assert np.isnan(sigmas[0]).all()
    assert np.isfinite(sigmas[1]).all()


def test_a_length_fits_the_overlap() -> None:
    near, far = (stereo_sigma(usual().rig, range_m, 0.1) for range_m in (0.5, 3.0))
    assert 0.1 < near.length_m < 0.35
    assert far.length_m == pytest.approx(1.0)
    assert near.length_sigma_m < far.length_sigma_m


def test_the_baselines_sigma_is_that_of_its_length() -> None:
    rig = usual().rig
    draws = np.random.default_rng(3).multivariate_normal(
        np.zeros(len(rig.covariance.parameters)), rig.covariance.matrix, size=4000, method="eigh"
    )
    at = [rig.covariance.parameters.index(f"right.{axis}") for axis in POSE[3:]]
    lengths = np.linalg.norm(rig.cam_from_rig["right"].translation + draws[:, at], axis=1)
    assert baselines_m(rig)["right"][1] == pytest.approx(lengths.std(), rel=0.05)


def test_the_sigma_of_a_tilt_is_the_spread_of_drawn_tilts() -> None:
    names = ("left.normal_x", "left.normal_y")
    covariance = np.array([[4e-6, 1e-6], [1e-6, 1e-6]])
    left = changed(DESIGN.cameras["left"], normal=tilted(2.0, -25.0))
    rig = replace(
        DESIGN, cameras={**DESIGN.cameras, "left": left},
        covariance=Covariance(parameters=names, matrix=covariance),
    )  # fmt: skip
    rows = {row.name: row for row in rig_parameters(rig)}
    drawn = np.random.default_rng(4).multivariate_normal(left.port.axis_cam[:2], covariance, 20_000)
    for name, angles in zip(names, np.degrees(np.arcsin(drawn)).T, strict=True):
        row = rows[name]
        assert (row.unit, row.correlation) == ("deg", pytest.approx(0.5))
        assert row.value == pytest.approx(angles.mean(), abs=0.01)
        assert row.sigma == pytest.approx(angles.std(), rel=0.03)
    assert rows["right.normal_x"].sigma is None


@pytest.mark.parametrize("seed", range(1, 4))
def test_all_of_the_overlap_has_sigmas(seed: int) -> None:
    """Also its points on the very edge of a frame, which rounding may put beyond."""
    points = overlap_points(usual(seed).rig, 2.0)
    assert len(points) > 100
    assert np.isfinite(point_sigmas_m(usual(seed).rig, points)).all()
    assert np.isfinite(shape_sigmas_m(usual(seed).rig, points)).all()


def test_what_is_unknown_is_refused() -> None:
    with pytest.raises(CalibrationError):
        point_sigmas_m(DESIGN, POINTS)
    for name in ("middle.fx_px", "left.rx_rad", "left.colour"):
        with pytest.raises(CalibrationError, match=name):
            point_sigmas_m(with_one_error(DESIGN, {name: 1.0}), POINTS)
    with pytest.raises(CalibrationError, match="2 points"):
        compensation(usual().rig, "left", POINTS[:2])


def test_what_a_pose_takes_up_is_the_least_squares_fit() -> None:
    rng = np.random.default_rng(5)
    slopes, moved = rng.normal(size=(40, 6)), rng.normal(size=(40, 3))
    expected = np.linalg.lstsq(slopes, moved, rcond=None)[0]
    np.testing.assert_allclose(taken_up(slopes, moved), expected, rtol=1e-9)
