from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from reconstruct.mapping.global_mapper import RigPinholes, refine_link

FOCAL = 1130.0
PINHOLES = RigPinholes(
    focal_px=np.full((2, 2), FOCAL),
    centre_px=np.array([[423.0, 338.0], [421.0, 340.0]]),
    turn=np.stack([np.eye(3), Rotation.from_euler("y", 1.0, degrees=True).as_matrix()]),
    shift=np.array([[0.0, 0.0, 0.0], [-0.1, 0.0, 0.0]]),
)
TRUE = RigidTransform.from_components(
    [0.03, -0.55, 0.02], Rotation.from_euler("xyz", [2.0, -1.5, 4.0], degrees=True)
)


def stereo(points: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Points that fit a stereo pair's pixels best, one by one."""

    def miss(flat: np.ndarray) -> np.ndarray:
        return (both(flat.reshape(-1, 3)) - pixels).ravel()

    pattern = np.kron(np.ones((2, 1)), np.kron(np.eye(len(points)), np.ones((2, 3))))
    return least_squares(miss, points.ravel(), jac_sparsity=pattern).x.reshape(-1, 3)


def both(points: np.ndarray) -> np.ndarray:
    """(2, N, 2) pixels of the two cameras."""
    return np.stack([PINHOLES.see(points, np.full(len(points), k))[0] for k in (0, 1)])


def station_pair(
    seed: int, count: int = 200, noise_px: float = 0.3
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points by stereo, pixels of the second station, its cameras, and the true points."""
    rng = np.random.default_rng(seed)
    true = rng.uniform([-0.6, -0.2, 1.85], [0.6, 0.6, 2.15], (count, 3))
    points = stereo(true, both(true) + rng.normal(0, noise_px, (2, count, 2)))
    camera = rng.integers(0, 2, count)
    pixels = PINHOLES.see(TRUE.apply(true), camera)[0] + rng.normal(0, noise_px, (count, 2))
    return points, pixels, camera, true


OFF = RigidTransform.from_components([0.0, 0.03, 0.0], Rotation.from_rotvec([0.02, 0, 0]))
START = OFF * TRUE


def refined(points: np.ndarray, pixels: np.ndarray, camera: np.ndarray) -> Any:
    """The pose and its covariance."""
    return refine_link(points, pixels, camera, PINHOLES, START)


def test_exact_pixels_give_the_exact_pose() -> None:
    points, pixels, camera, _ = station_pair(1, noise_px=0.0)
    pose, _ = refined(points, pixels, camera)
    np.testing.assert_allclose(pose.translation, TRUE.translation, atol=1e-8)
    assert (pose.rotation * TRUE.rotation.inv()).magnitude() < 1e-8


def test_it_is_the_adjustment_of_pose_and_points_together() -> None:
    """Against a plain least squares over all unknowns; weights hardly matter without outliers."""
    points, pixels, camera, _ = station_pair(2, count=60)
    roots = np.linalg.cholesky(PINHOLES.information(points)).swapaxes(1, 2)

    def miss(flat: np.ndarray) -> np.ndarray:
        pose = RigidTransform.from_components(flat[3:6], Rotation.from_rotvec(flat[:3]))
        at = flat[6:].reshape(-1, 3)
        held = np.einsum("nij,nj->ni", roots, at - points)
        return np.concatenate(
            [(PINHOLES.see(pose.apply(at), camera)[0] - pixels).ravel(), held.ravel()]
        )

    first = np.concatenate([START.rotation.as_rotvec(), START.translation, points.ravel()])
    oracle = least_squares(miss, first).x
    pose, covariance = refined(points, pixels, camera)
    sigma = np.sqrt(np.diag(covariance))
    assert (np.abs(pose.translation - oracle[3:6]) < 0.7 * sigma[3:]).all()
    turn = (pose.rotation * Rotation.from_rotvec(oracle[:3]).inv()).as_rotvec()
    assert (np.abs(turn) < 0.7 * sigma[:3]).all()


def test_noise_of_stereo_does_not_shorten_the_way_between_stations() -> None:
    """With points taken as exact it shortens by several percent; sigmas are true, too."""
    lengths, pulls = [], []
    for seed in range(12):
        points, pixels, camera, _ = station_pair(seed)
        pose, covariance = refined(points, pixels, camera)
        lengths.append(np.linalg.norm(pose.translation) / np.linalg.norm(TRUE.translation))
        turn = (pose.rotation * TRUE.rotation.inv()).as_rotvec()
        error = np.concatenate([turn, pose.translation - TRUE.translation])
        pulls.append(error @ np.linalg.solve(covariance, error) / 6)
    assert np.mean(lengths) == pytest.approx(1.0, abs=0.01)
    assert 0.5 < np.mean(pulls) < 2.0


def test_wrong_matches_are_left_aside() -> None:
    points, pixels, camera, _ = station_pair(3)
    clean = refined(points, pixels, camera)
    pixels[::5] += np.random.default_rng(1).uniform(20, 200, pixels[::5].shape)
    spoiled = refined(points, pixels, camera)
    sigma = np.sqrt(np.diag(clean[1])[3:])
    assert (np.abs(spoiled[0].translation - clean[0].translation) < 2 * sigma).all()
