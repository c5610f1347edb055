import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from camera_calib.triangulate import nearest_to_rays, rays_world, reproject, triangulate
from tests.cameras import MANTA, changed
from tests.oracles_interface import (
    LENS,
    nearest_slowly,
    points_in_tank,
    triangulate_slowly,
    true_tank,
)

UNDERWATER = changed(MANTA, fy_px=3390.0, k1=-0.1, k2=0.05, k4=0.02, s1=1e-3).with_parameters(
    {"normal_x": 0.03, "normal_y": -0.05}
)


def stereo(cameras: int = 2) -> list[RigidTransform]:
    """Poses in a row, 0.3 m apart, turned a little."""
    return [
        RigidTransform.from_components(
            [-0.3 * i, 0.01 * i, 0.0], Rotation.from_rotvec([0.01 * i, 0.08 * i, -0.02 * i])
        )
        for i in range(cameras)
    ]


def seen(points: Array, cameras: int, noise_px: Array | float = 0.0) -> Array:
    """Pixels of points in cameras in a row."""
    return reproject([UNDERWATER] * cameras, stereo(cameras), points) + noise_px


def seafloor(rng: np.random.Generator, count: int) -> Array:
    return np.column_stack([rng.uniform(-0.2, 0.5, (count, 2)), rng.uniform(1.2, 2.6, count)])


@pytest.mark.parametrize("cameras", [2, 3, 5])
def test_exact_pixels_give_back_the_points(cameras: int) -> None:
    points = seafloor(np.random.default_rng(1), 500)

    found = triangulate([UNDERWATER] * cameras, stereo(cameras), seen(points, cameras))

    np.testing.assert_allclose(found.points_world, points, atol=1e-11)
    assert np.abs(found.residuals_px).max() < 1e-8


@settings(max_examples=30, deadline=None)
@given(
    n_water=st.floats(1.2, 1.5),
    glass_m=st.floats(0.0, 0.02),
    lean_m=st.floats(-0.04, 0.04),
    seed=st.integers(0, 1000),
)
def test_exact_through_two_interfaces_at_right_angles(
    n_water: float, glass_m: float, lean_m: float, seed: int
) -> None:
    tank = true_tank(glass_m=(glass_m / 2, glass_m), n_water=n_water, lean_m=lean_m)
    points = points_in_tank(np.random.default_rng(seed), 40)

    found = tank.triangulate(tank.seen(points))

    np.testing.assert_allclose(found.points_world, points, atol=1e-9)


def test_agrees_with_the_slow_twin() -> None:
    rng = np.random.default_rng(2)
    points, poses = seafloor(rng, 12), stereo(3)
    cameras = [UNDERWATER, changed(UNDERWATER, n_water=1.35), UNDERWATER]
    pixels = reproject(cameras, poses, points) + rng.normal(0.0, 3.0, (3, 12, 2))

    found = triangulate(cameras, poses, pixels)

    for i in range(len(points)):
        slow = triangulate_slowly(cameras, poses, pixels[:, i], points[i])
        np.testing.assert_allclose(found.points_world[i], slow, atol=2e-8)


def test_converges_even_where_rays_miss_by_hundreds_of_pixels() -> None:
    rng = np.random.default_rng(3)
    tank = true_tank()
    points = points_in_tank(rng, 12)
    pixels = tank.seen(points)
    pixels[1, :, 0] += rng.choice([-150.0, 150.0], 12)

    found = tank.triangulate(pixels)

    assert np.isfinite(found.points_world).all()
    nearest = nearest_to_rays(*rays_world(tank.cameras, tank.poses, pixels))
    for i in range(len(points)):
        slow = triangulate_slowly(tank.cameras, tank.poses, pixels[:, i], nearest[i])
        np.testing.assert_allclose(found.points_world[i], slow, atol=1e-6)


@pytest.mark.parametrize("sigma_px", [0.3, [0.2, 0.8, 0.4]])
def test_sigmas_are_true(sigma_px: float | list[float]) -> None:
    rng = np.random.default_rng(5)
    points = seafloor(rng, 4000)
    sigmas = np.broadcast_to(sigma_px, 3)
    noise = rng.normal(0.0, 1.0, (3, 4000, 2)) * sigmas[:, None, None]

    found = triangulate([UNDERWATER] * 3, stereo(3), seen(points, 3, noise), sigma_px)

    error = found.points_world - points
    normalised = np.sqrt(np.mean((error / found.sigmas_m) ** 2, axis=0))
    assert np.all((normalised > 0.97) & (normalised < 1.03))
    distance2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance), error)
    assert 2.9 < distance2.mean() < 3.1
    chi2 = ((found.residuals_px / sigmas[:, None, None]) ** 2).sum(axis=(0, 2))
    assert 2.9 < chi2.mean() < 3.1  # six pixels coordinates less three of the point


def test_a_camera_that_does_not_see_a_point_does_not_count() -> None:
    rng = np.random.default_rng(6)
    points, poses = seafloor(rng, 30), stereo(3)
    pixels = seen(points, 3, rng.normal(0.0, 1.0, (3, 30, 2)))
    pixels[1, :10] = np.nan
    pixels[1:, 10:20] = np.nan

    found = triangulate([UNDERWATER] * 3, poses, pixels)

    pair = triangulate([UNDERWATER] * 2, [poses[0], poses[2]], pixels[[0, 2], :10])
    np.testing.assert_allclose(found.points_world[:10], pair.points_world, atol=1e-12)
    np.testing.assert_allclose(found.covariance[:10], pair.covariance, rtol=1e-6)
    assert np.isnan(found.points_world[10:20]).all()
    assert np.isnan(found.covariance[10:20]).all()
    assert np.isfinite(found.points_world[20:]).all()


def test_rays_that_meet_in_the_air_or_are_parallel_have_no_solution() -> None:
    tank = true_tank(glass_m=(0.0, 0.0))
    inside = np.array([[0.2, 0.1, 0.1]])
    # Where a camera in air would see a point above the water, before the wall.
    above = np.array([[0.2, 0.30, -0.02]])
    pixels = np.stack([LENS.project(pose.apply(above)) for pose in tank.poses])

    found = tank.triangulate(np.concatenate([pixels, tank.seen(inside)], axis=1))

    assert np.isnan(found.points_world[0]).all() and np.isnan(found.residuals_px[:, 0]).all()
    np.testing.assert_allclose(found.points_world[1], inside[0], atol=1e-9)
    same = [RigidTransform.identity()] * 2
    parallel = triangulate([UNDERWATER] * 2, same, np.full((2, 3, 2), 1500.0))
    assert np.isnan(parallel.points_world).all()


def test_nearest_point_agrees_with_its_slow_twin_and_is_the_middle_of_a_gap() -> None:
    rng = np.random.default_rng(8)
    origins, directions = rng.normal(size=(2, 4, 20, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    origins[1, 5] = np.nan

    found = nearest_to_rays(origins, directions)

    for i in range(20):
        rays = [0, 2, 3] if i == 5 else [0, 1, 2, 3]
        slow = nearest_slowly(origins[rays, i], directions[rays, i])
        np.testing.assert_allclose(found[i], slow, atol=1e-10)
    origins = np.array([[[0.0, 0.0, 0.0]], [[0.0, 1.0, 5.0]]])
    directions = np.array([[[1.0, 0.0, 0.0]], [[0.0, 0.0, -1.0]]])
    middle = nearest_to_rays(origins, directions)
    np.testing.assert_allclose(middle, [[0.0, 0.5, 0.0]], atol=1e-15)


@pytest.mark.parametrize(
    ("pixels", "poses", "sigma", "named"),
    [
        (np.zeros((2, 5)), 2, 1.0, "(2, 5)"),
        (np.zeros((3, 5, 2)), 2, 1.0, "2 cameras"),
        (np.zeros((2, 5, 2)), 1, 1.0, "1 poses"),
        (np.zeros((2, 5, 2)), 2, 0.0, "sigma_px"),
    ],
)
def test_bad_input_is_one_clear_line(pixels: Array, poses: int, sigma: float, named: str) -> None:
    with pytest.raises(CalibrationError) as error:
        triangulate([UNDERWATER] * 2, stereo(poses), pixels, sigma)
    assert named in str(error.value) and "\n" not in str(error.value)


def test_least_squares_is_never_worse_than_the_midpoint() -> None:
    rng = np.random.default_rng(4)
    points, poses = seafloor(rng, 2000), stereo()
    pixels = seen(points, 2, rng.normal(0.0, 5.0, (2, 2000, 2)))

    found = triangulate([UNDERWATER] * 2, poses, pixels)

    best = (found.residuals_px**2).sum(axis=(0, 2))
    nearest = nearest_to_rays(*rays_world([UNDERWATER] * 2, poses, pixels))
    middle = ((reproject([UNDERWATER] * 2, poses, nearest) - pixels) ** 2).sum(axis=(0, 2))
    assert np.all(best <= middle + 1e-9)
    assert np.any(best < 0.99 * middle)
