import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.absolute_pose import Sighting, absolute_pose, pose_information
from benchmarks.camera_pose import PUBLISHED, run_level, simulated
from camera_calib.camera import Camera
from tests.cameras import changed, flat_port_camera

Array = np.ndarray

CAMERA = flat_port_camera(
    width_px=1920,
    height_px=1080,
    fx_px=1297.0,
    fy_px=1290.0,
    cx_px=955.0,
    cy_px=545.0,
    k1=-0.1,
    p1=0.001,
    port_distance_m=0.03,
    glass_thickness_m=0.02,
    normal=(0.05, -0.03, math.sqrt(1 - 0.05**2 - 0.03**2)),
)


def sighting(
    rng: np.random.Generator,
    cam_from_world: RigidTransform,
    *,
    camera: Camera = CAMERA,
    count: int = 120,
    noise_px: float = 0.0,
) -> Sighting:
    pixels = rng.uniform([0, 0], [camera.width_px, camera.height_px], (count, 2))
    points_cam = camera.at_depth(pixels, rng.uniform(0.6, 4.0, count))
    noisy = pixels + noise_px * rng.normal(size=pixels.shape)
    return Sighting(
        camera=camera, pixels=noisy, points_world=cam_from_world.inv().apply(points_cam)
    )


def random_pose(rng: np.random.Generator) -> RigidTransform:
    return RigidTransform.from_components(3 * rng.normal(size=3), Rotation.random(rng=rng))


def apart(first: RigidTransform, second: RigidTransform) -> tuple[float, float]:
    """Angle (degrees) and distance (mm) of two poses."""
    motion = first * second.inv()
    return math.degrees(motion.rotation.magnitude()), 1e3 * float(
        np.linalg.norm(motion.translation)
    )


@pytest.mark.parametrize("noise_px", [0.5, 2.0])
def test_errors_reach_the_bound_and_beat_the_published_ones(noise_px: float) -> None:
    level = run_level(noise_px, range(70))

    assert level.misses() == []
    assert level.mean_deg < PUBLISHED[noise_px][0] / 3
    assert level.mean_mm < PUBLISHED[noise_px][1] / 3
    assert 0.85 < level.rms_deg / level.bound_deg < 1.15
    assert 0.85 < level.rms_mm / level.bound_mm < 1.15
    assert 0.9 < level.by_bound < 1.1
    assert 0.9 < level.by_sigma < 1.1
    assert level.sigma_px == pytest.approx(noise_px, rel=0.03)
    assert level.missed < 0.3
    assert level.wrong < 0.3


def test_without_noise_outliers_are_found_and_the_pose_is_exact() -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        seen, cam_from_world, right = simulated(rng, 0.0)

        found = absolute_pose([seen], rng)

        angle_deg, distance_mm = apart(cam_from_world, found.rig_from_world)
        assert angle_deg < 1e-10
        assert distance_mm < 1e-8
        np.testing.assert_array_equal(found.inliers[0], right)


@pytest.mark.parametrize("ports", [(0.0, 0.0, 1.34), (0.0, 0.0, 1.0), (1e-9, 0.0, 1.34)])
def test_a_port_without_depth_is_no_special_case(ports: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(4)
    truth = random_pose(rng)
    distance_m, glass_m, n_water = ports
    camera = changed(CAMERA, port_distance_m=distance_m, glass_thickness_m=glass_m, n_water=n_water)

    found = absolute_pose([sighting(rng, truth, camera=camera)], rng)

    assert np.all(np.less(apart(truth, found.rig_from_world), (1e-9, 1e-7)))


def test_two_cameras_of_a_rig_pose_it_together() -> None:
    rng = np.random.default_rng(5)
    rig_from_world = random_pose(rng)
    right_from_rig = RigidTransform.from_components(
        [-0.1, 0.002, 0.001], Rotation.from_rotvec([0.01, -0.03, 0.005])
    )
    right = changed(CAMERA, port_distance_m=0.012, fx_px=1400.0)
    left_seen = sighting(rng, rig_from_world, noise_px=0.4)
    right_seen = replace(
        sighting(rng, right_from_rig * rig_from_world, camera=right, noise_px=0.4),
        cam_from_rig=right_from_rig,
    )
    wrong = np.arange(120) % 4 == 0
    both = [
        replace(s, pixels=np.where(wrong[:, None], s.pixels[::-1], s.pixels))
        for s in (left_seen, right_seen)
    ]

    found = absolute_pose(both, np.random.default_rng(1))
    alone = absolute_pose(both[:1], np.random.default_rng(1))

    for mask in found.inliers:
        assert not mask[wrong].any()
        assert mask[~wrong].sum() >= 88
    angle_deg, distance_mm = apart(rig_from_world, found.rig_from_world)
    assert angle_deg < 4 * math.degrees(found.sigma_rotation_rad) < 0.05
    assert distance_mm < 4e3 * found.sigma_position_m < 2.0
    assert found.sigma_position_m < 0.9 * alone.sigma_position_m


def test_information_is_that_of_numeric_slopes() -> None:
    rng = np.random.default_rng(6)
    rig_from_world = random_pose(rng)
    cam_from_rig = RigidTransform.from_components(
        [0.1, -0.05, 0.02], Rotation.from_rotvec([0.1, 0.2, -0.1])
    )
    seen = replace(sighting(rng, cam_from_rig * rig_from_world), cam_from_rig=cam_from_rig)

    def pixels(motion: Array) -> Array:
        moved = RigidTransform.from_components(motion[3:], Rotation.from_rotvec(motion[:3]))
        points_cam = (cam_from_rig * moved * rig_from_world).apply(seen.points_world)
        return seen.camera.project(points_cam).ravel()

    step = 1e-6
    slopes = np.stack([(pixels(a) - pixels(-a)) / (2 * step) for a in step * np.eye(6)], axis=1)
    expected = slopes.T @ slopes

    found = pose_information(rig_from_world, [seen])

    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, atol=1e-7)


def test_refinement_ends_where_another_solver_does() -> None:
    rng = np.random.default_rng(7)
    truth = random_pose(rng)
    seen = sighting(rng, truth, count=40, noise_px=1.0)
    found = absolute_pose([seen], rng)
    keep = found.inliers[0]

    def miss(motion: Array) -> Array:
        moved = RigidTransform.from_components(motion[3:], Rotation.from_rotvec(motion[:3]))
        points_cam = (moved * truth).apply(seen.points_world[keep])
        return (seen.camera.project(points_cam) - seen.pixels[keep]).ravel()

    other = least_squares(miss, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15)

    expected = (
        RigidTransform.from_components(other.x[3:], Rotation.from_rotvec(other.x[:3])) * truth
    )
    assert np.all(np.less(apart(expected, found.rig_from_world), (1e-6, 1e-5)))
    freedom = 2 * keep.sum() - 6
    assert found.sigma_px == pytest.approx(math.sqrt((other.fun**2).sum() / freedom), rel=1e-6)


def test_far_from_the_worlds_origin_nothing_is_lost() -> None:
    rng = np.random.default_rng(8)
    truth = random_pose(rng)
    seen = sighting(rng, truth, noise_px=0.5)
    shift = np.array([4.5e5, 6.1e6, -300.0])
    far = replace(seen, points_world=seen.points_world + shift)

    near_pose = absolute_pose([seen], np.random.default_rng(2))
    far_pose = absolute_pose([far], np.random.default_rng(2))

    back = far_pose.rig_from_world * RigidTransform.from_translation(shift)
    assert np.all(np.less(apart(near_pose.rig_from_world, back), (1e-5, 1e-4)))
    np.testing.assert_allclose(far_pose.covariance, near_pose.covariance, rtol=1e-4, atol=1e-12)
