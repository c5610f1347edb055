from dataclasses import replace

import cv2
import numpy as np
import pytest

from camera_calib.approximation.pinhole_warp import best_warp
from camera_calib.calibration import TargetView
from camera_calib.freedom import Freedom, intrinsics, of_cameras, pose_names
from camera_calib.judge.homography import homography_residuals, homography_test
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


@pytest.mark.parametrize("view", [0, 3, 7])
def test_through_the_true_model_a_board_is_a_homography(view: int) -> None:
    """Non-central port, lens and all: without noise nothing is left."""
    rig = true_rig()
    made = synthetic_views(rig, 8, 0.0, 2)
    pixels = made.views[view].pixels["left"]
    seen = np.isfinite(pixels[:, 0])

    left, freedom = homography_residuals(
        best_warp(rig.cameras["left"], 0.6, 2.2),
        made.points[seen],
        pixels[seen],
        made.rig_from_target[view],
    )

    assert np.abs(left).max() < 1e-8
    # 8 unknowns take up 8 of the coordinates' freedom.
    assert 2 * freedom.sum() == pytest.approx(2 * seen.sum() - 8)


def test_an_error_of_the_pose_hardly_matters() -> None:
    rig = true_rig()
    made = synthetic_views(rig, 4, 0.0, 2)
    pixels = made.views[1].pixels["left"]
    seen = np.isfinite(pixels[:, 0])
    near = made.rig_from_target[1]
    off = type(near).from_translation([0.0, 0.0, 0.01]) * near

    left, _ = homography_residuals(
        best_warp(rig.cameras["left"], 0.6, 2.2), made.points[seen], pixels[seen], off
    )

    assert np.abs(left).max() < 2e-3


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
        assert test is not None
        assert test.views == len(found.views)
        assert test.inner_px == pytest.approx(0.1, rel=0.08)
        assert test.outer_px == pytest.approx(0.1, rel=0.2)
        assert test.excess_px == 0.0


def test_in_air_intrinsics_without_the_port_leave_more_and_more_outwards() -> None:
    """The lens of the camera in air, the port forgotten: refraction's distortion stays."""
    rig = true_rig()
    made = synthetic_views(rig, 12, 0.05, 1)
    bare = without_ports(rig)
    found = adjusted(made.views, made.points, bare, Freedom(free=("right.rx_rad",)))

    test = homography_test(found, "left")

    assert test is not None
    assert test.excess_px > 0.2
    rms = test.profile.rms_px[np.isfinite(test.profile.rms_px)]
    assert rms[0] < 0.08
    assert rms[-1] > 5 * rms[0]


def test_a_lens_fitted_in_water_without_the_port_leaves_more_too() -> None:
    """All that OPENCV's model can absorb is absorbed; the missing centre is left (noise 0.03)."""
    made = synthetic_views(true_rig(), 25, 0.03, 1)
    free = Freedom(free=(*of_cameras(DESIGN, intrinsics("opencv5")), *pose_names(DESIGN)))
    bare = adjusted(made.views, made.points, without_ports(DESIGN), free)
    for name in bare.rig.cameras:
        test = homography_test(bare, name)
        assert test is not None
        assert test.excess_px > 0.2 * test.inner_px
        assert test.outer_px > 0.036


def test_outliers_do_not_count() -> None:
    found = usual()
    spoiled = found.views[2].pixels["left"].copy()
    spoiled[np.nonzero(np.isfinite(spoiled[:, 0]))[0][::12]] += 20.0
    views = list(found.views)
    views[2] = TargetView(name="02", pixels={**views[2].pixels, "left": spoiled})
    before = homography_test(found, "left")
    after = homography_test(replace(found, views=tuple(views)), "left")
    assert before is not None
    assert after is not None
    assert after.inner_px == pytest.approx(before.inner_px, rel=0.02)
    assert after.profile.count.sum() < before.profile.count.sum()


def test_a_target_that_is_not_flat_is_not_tested() -> None:
    found = usual()
    bent = found.target_points.copy()
    bent[::7, 2] = 0.02
    assert homography_test(replace(found, target_points=bent), "left") is None
