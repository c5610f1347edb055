from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.artefacts import json_values
from camera_calib.judge.fit_quality import (
    CORNERS,
    camera_residuals,
    coverage,
    incidence_deg,
    largest_radius_px,
    outward,
    picture_fits,
    profile,
    radius_px,
    residual_profiles,
    rms_length_px,
)
from tests.oracles_report import DESIGN, usual

CAMERA = DESIGN.cameras["left"]


def test_the_angle_at_the_port_obeys_snell() -> None:
    pixels = np.array([[CAMERA.cx_px + r, CAMERA.cy_px] for r in (0.0, 100.0, 400.0)])
    air = np.arctan(np.array([0.0, 100.0, 400.0]) / CAMERA.fx_px)
    expected = np.degrees(np.arcsin(np.sin(air) / CAMERA.n_water))
    np.testing.assert_allclose(incidence_deg(CAMERA, pixels), expected, atol=1e-6)


def test_radii_count_from_the_principal_point() -> None:
    pixels = np.array([[CAMERA.cx_px + 3, CAMERA.cy_px - 4], [CAMERA.cx_px, CAMERA.cy_px]])
    np.testing.assert_allclose(radius_px(CAMERA, pixels), [5.0, 0.0])
    np.testing.assert_allclose(outward(CAMERA, pixels), [[0.6, -0.8], [0.0, 0.0]])
    corner = np.hypot(CAMERA.width_px / 2, CAMERA.height_px / 2)
    assert largest_radius_px(CAMERA) == pytest.approx(corner, abs=1.0)


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


def test_bins_with_few_points_say_nothing() -> None:
    few = profile(np.arange(5.0), np.ones((5, 2)), np.ones(5), np.ones(5), 12.0)
    assert np.isnan(few.rms_px).all()
    assert json_values(few)["rms_px"] == [None] * 12


def test_residuals_of_a_sound_calibration_are_noise_everywhere() -> None:
    found = usual()
    for name, camera in found.rig.cameras.items():
        seen = camera_residuals(found, name)
        for by in residual_profiles(camera, seen):
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
    count = len(camera_residuals(found, "right").radius_px)
    assert len(camera_residuals(worse, "right").radius_px) == count - 4
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
    camera, seen = found.rig.cameras["right"], camera_residuals(with_blur, "right")
    np.testing.assert_allclose(seen.sigma_px[seen.view == 3], 4.0 * found.noise_px)
    np.testing.assert_allclose(seen.sigma_px[seen.view != 3], found.noise_px)
    by = residual_profiles(camera, seen)[0]
    known = by.count >= 30
    np.testing.assert_allclose(by.rms_px[known], by.expected_px[known], rtol=0.35)


def test_pictures_tell_their_distance_and_tilt() -> None:
    found = usual()
    turn = Rotation.from_euler("xyz", [20.0, 0.0, 0.0], degrees=True)
    middle = found.target_points.mean(axis=0)
    pose = RigidTransform.from_components(np.array([0, 0, 1.5]) - turn.apply(middle), turn)
    poses = RigidTransform.concatenate([pose, *list(found.rig_from_target)[1:]])
    first = picture_fits(replace(found, rig_from_target=poses))[0]
    assert first.tilt_deg == pytest.approx(20.0, abs=1e-9)
    assert first.range_m == pytest.approx(1.5, abs=0.05)


def test_a_target_seen_from_behind_its_normal_has_the_same_tilt() -> None:
    """Some targets' normals point to the camera; a tilt is at most 90 degrees anyway."""
    found = usual()
    over = Rotation.from_euler("y", 180.0, degrees=True)
    turned = RigidTransform.concatenate(
        [pose * RigidTransform.from_rotation(over) for pose in found.rig_from_target]
    )
    before, after = (
        [one.tilt_deg for one in picture_fits(replace(found, rig_from_target=poses))]
        for poses in (found.rig_from_target, turned)
    )
    np.testing.assert_allclose(after, before, atol=1e-9)


def test_uncovered_corners_are_named() -> None:
    w, h = CAMERA.width_px, CAMERA.height_px
    pixels = np.array([[0.05 * w, 0.05 * h], [0.95 * w, 0.1 * h], [0.9 * w, 0.5 * h]])
    found = coverage(CAMERA, pixels)
    assert found.uncovered == ("bottom left", "bottom right")
    assert found.corner_reach["top left"] == pytest.approx(0.9)
    assert found.corner_reach["top right"] == pytest.approx(0.8)
    assert found.counts.sum() == 3
    assert found.counts[0, 0] == found.counts[0, 9] == found.counts[4, 9] == 1


def test_a_frame_full_of_points_is_covered() -> None:
    found = coverage(CAMERA, CAMERA.pixel_centres(20).reshape(-1, 2))
    assert found.uncovered == ()
    assert set(found.corner_reach) == set(CORNERS)
    assert found.empty_share == 0.0
    assert coverage(CAMERA, np.zeros((0, 2))).empty_share == 1.0
