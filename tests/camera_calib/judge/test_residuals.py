"""What residuals show: of pictures, over the frame, by homographies."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.artefacts import json_values
from camera_calib.approximation.pinhole_warp import best_warp
from camera_calib.calibration import TargetView
from camera_calib.freedom import Freedom, intrinsics, of_cameras, pose_names
from camera_calib.judge.judgement import judge, verdicts
from camera_calib.judge.residuals import (
    camera_residuals,
    homography_residuals,
    homography_test,
    incidence_deg,
    incidence_profile,
    outward,
    picture_fits,
    points_by_cell,
    profile,
    rms_length_px,
)
from tests.cameras import changed
from tests.oracles_report import (
    DESIGN,
    SQUARE_M,
    adjusted,
    synthetic_views,
    true_rig,
    usual,
    without_ports,
)

CAMERA = DESIGN.cameras["left"]


def test_the_angle_at_the_port_obeys_snell() -> None:
    pixels = np.array([[CAMERA.cx_px + r, CAMERA.cy_px] for r in (0.0, 100.0, 400.0)])
    air = np.arctan(np.array([0.0, 100.0, 400.0]) / CAMERA.fx_px)
    expected = np.degrees(np.arcsin(np.sin(air) / CAMERA.n_water))
    np.testing.assert_allclose(incidence_deg(CAMERA, pixels), expected, atol=1e-6)


def test_outward_counts_from_the_principal_point() -> None:
    pixels = np.array([[CAMERA.cx_px + 3, CAMERA.cy_px - 4], [CAMERA.cx_px, CAMERA.cy_px]])
    np.testing.assert_allclose(outward(CAMERA, pixels), [[0.6, -0.8], [0.0, 0.0]])


def test_a_profile_of_noise_is_flat_and_one_of_a_trend_is_not() -> None:
    rng = np.random.default_rng(1)
    position = rng.uniform(0, 100, 20_000)
    residuals = rng.normal(0, 0.2, (20_000, 2))
    trend = np.column_stack([1e-3 * position, np.zeros(20_000)])
    sigma = np.full(20_000, 0.2)

    flat = profile(position, residuals, residuals[:, 0], sigma, 100.0)
    bent = profile(position, residuals + trend, (residuals + trend)[:, 0], sigma, 100.0)

    np.testing.assert_allclose(flat.expected_px, 0.2)
    chance = flat.expected_px / np.sqrt(flat.count)
    assert np.abs((flat.rms_px - 0.2) / (chance / 2)).max() < 4
    assert np.abs(flat.outward_px / chance).max() < 4
    np.testing.assert_allclose(bent.outward_px, 1e-3 * bent.centres, atol=0.02)
    assert flat.count.sum() == 20_000
    few = profile(np.arange(5.0), np.ones((5, 2)), np.ones(5), np.ones(5), 12.0)
    assert json_values(few)["rms_px"] == [None] * 12


def test_residuals_of_a_sound_calibration_are_noise_everywhere() -> None:
    found = usual()
    for name, camera in found.rig.cameras.items():
        by = incidence_profile(camera, camera_residuals(found, name))
        known = by.count >= 30
        chance = found.noise_px / np.sqrt(by.count[known])
        assert np.abs(by.outward_px[known] / chance).max() < 4.5
        np.testing.assert_allclose(by.rms_px[known], found.noise_px, rtol=0.35)


def test_outliers_are_counted_and_set_aside() -> None:
    found = usual()
    spoiled = found.residuals_px.copy()
    at = np.argwhere(np.isfinite(spoiled[3, 1, :, 0]))[:4, 0]
    spoiled[3, 1, at] += 5.0
    worse = replace(found, residuals_px=spoiled)

    (picture,) = [p for p in picture_fits(worse) if p.view == "03" and p.camera == "right"]
    (before,) = [p for p in picture_fits(found) if p.view == "03" and p.camera == "right"]

    assert (before.outliers, picture.outliers) == (0, 4)
    assert picture.rms_px > 3 * before.rms_px
    assert picture.worst_px == pytest.approx(5 * 2**0.5, abs=1.0)
    count = len(camera_residuals(found, "right").pixels)
    assert len(camera_residuals(worse, "right").pixels) == count - 4
    assert rms_length_px(spoiled, found.noise_px) == pytest.approx(
        rms_length_px(found.residuals_px, found.noise_px), rel=0.01
    )


def test_points_of_a_dull_picture_are_judged_by_its_own_noise() -> None:
    found = usual()
    blur = np.ones(found.residuals_px.shape[:2])
    blur[3, 1] = 4.0
    dull = replace(found, residuals_px=found.residuals_px * blur[..., None, None])
    with_blur = replace(dull, blur=blur)
    assert max(picture.outliers for picture in picture_fits(dull)) > 5
    assert max(picture.outliers for picture in picture_fits(with_blur)) == 0

    seen = camera_residuals(with_blur, "right")
    assert {*np.round(seen.sigma_px / found.noise_px, 9)} == {1.0, 4.0}
    by = incidence_profile(found.rig.cameras["right"], seen)
    known = by.count >= 30
    np.testing.assert_allclose(by.rms_px[known], by.expected_px[known], rtol=0.35)


def test_pictures_have_their_distance() -> None:
    found = usual()
    turn = Rotation.from_euler("xyz", [20.0, 0.0, 0.0], degrees=True)
    centre = found.target_points.mean(axis=0)
    pose = RigidTransform.from_components(np.array([0, 0, 1.5]) - turn.apply(centre), turn)
    poses = RigidTransform.concatenate([pose, *list(found.rig_from_target)[1:]])
    first = picture_fits(replace(found, rig_from_target=poses))[0]
    assert first.range_m == pytest.approx(1.5, abs=0.05)


def test_points_are_counted_by_cell() -> None:
    w, h = CAMERA.width_px, CAMERA.height_px
    pixels = np.array([[0.05 * w, 0.05 * h], [0.95 * w, 0.1 * h], [0.9 * w, 0.5 * h]])
    counts = points_by_cell(CAMERA, pixels)
    assert counts.sum() == 3
    assert counts[0, 0] == counts[0, 9] == counts[4, 9] == 1
    assert points_by_cell(CAMERA, CAMERA.pixel_centres(20).reshape(-1, 2)).min() > 0


@pytest.mark.parametrize(("off_m", "bound_px"), [(0.0, 1e-8), (0.01, 2e-3)])
def test_through_the_true_model_a_board_is_a_homography(off_m: float, bound_px: float) -> None:
    """Non-central port, lens and all: without noise nothing is left; a pose hardly matters."""
    rig = true_rig()
    made = synthetic_views(rig, 8, 0.0, 2)
    for view in (0, 3, 7):
        pixels = made.views[view].pixels["left"]
        seen = np.isfinite(pixels[:, 0])
        pose = RigidTransform.from_translation([0.0, 0.0, off_m]) * made.rig_from_target[view]
        left, taken = homography_residuals(
            best_warp(rig.cameras["left"], 0.6, 2.2), made.points[seen], pixels[seen], pose
        )
        assert np.abs(left).max() < bound_px
        # 8 unknowns take up 8 of the coordinates' freedom.
        assert taken.shape == (2 * seen.sum(), 8)
        np.testing.assert_allclose(taken.T @ taken, np.eye(8), atol=1e-9)


def test_residuals_are_those_of_opencvs_homography() -> None:
    """For a pinhole without port or lens, where both minimise the same pixels."""
    bare = changed(DESIGN.cameras["left"], port_distance_m=0.0, glass_thickness_m=0.0, n_water=1.0)
    rig = replace(DESIGN, cameras={"left": bare, "right": bare})
    made = synthetic_views(rig, 2, 0.3, 5)
    pixels = made.views[0].pixels["left"]
    seen = np.isfinite(pixels[:, 0])
    board, pixels = made.points[seen], pixels[seen]

    found, _ = homography_residuals(
        best_warp(bare, 0.6, 2.2), board, pixels, made.rig_from_target[0]
    )

    matrix, _ = cv2.findHomography(board[:, :2] / SQUARE_M, pixels, 0)
    mapped = np.column_stack([board[:, :2] / SQUARE_M, np.ones(len(board))]) @ matrix.T
    np.testing.assert_allclose(found, mapped[:, :2] / mapped[:, 2:] - pixels, atol=1e-4)


def test_a_sound_calibration_leaves_noise_up_to_the_edge() -> None:
    found = usual()
    for name in found.rig.cameras:
        test = homography_test(found, name)
        assert test.noise_px == pytest.approx(0.1, rel=0.08)
        assert test.p_value > 0.01
        assert test.share < 0.15


def test_a_forgotten_port_leaves_more_outwards() -> None:
    """With the lens as in air, refraction's distortion stays; one fitted in water absorbs all that
    OPENCV's model can, and the missing centre is left (noise 0.03)."""
    made = synthetic_views(true_rig(), 12, 0.05, 1)
    bare = without_ports(true_rig())
    test = homography_test(
        adjusted(made.views, made.points, bare, Freedom(free=("right.rx_rad",))), "left"
    )
    assert test.p_value < 1e-6
    assert test.share > 0.5
    assert test.noise_px > 3 * 0.05

    made = synthetic_views(true_rig(), 25, 0.03, 1)
    free = Freedom(free=(*of_cameras(DESIGN, intrinsics("opencv5")), *pose_names(DESIGN)))
    fitted = adjusted(made.views, made.points, without_ports(DESIGN), free)
    for name in fitted.rig.cameras:
        test = homography_test(fitted, name)
        assert test.p_value < 1e-3
    assert any("homograph" in v.text for v in verdicts(judge(fitted, None)) if v.level != "good")


def test_outliers_do_not_count() -> None:
    found = usual()
    spoiled = found.views[2].pixels["left"].copy()
    spoiled[np.nonzero(np.isfinite(spoiled[:, 0]))[0][::12]] += 20.0
    views = list(found.views)
    views[2] = TargetView(name="02", pixels={**views[2].pixels, "left": spoiled})
    before, after = (
        homography_test(one, "left") for one in (found, replace(found, views=tuple(views)))
    )
    assert after.noise_px == pytest.approx(before.noise_px, rel=0.02)
    assert after.points < before.points


def test_a_target_that_is_not_flat_is_not_tested() -> None:
    found = usual()
    bent = found.target_points.copy()
    bent[::7, 2] = 0.02
    assert homography_test(replace(found, target_points=bent), "left") is None
