from pathlib import Path

import numpy as np
import pytest

from reconstruct.adjustment.uncertainty import Uncertainty, no_modes, write_uncertainty
from reconstruct.dense.surface_tiles import ErrorsOfPoses, find_errors_of_poses
from reconstruct.views.model import read_model
from tests.oracles_dense import CODED, stereo_views, write_workspace


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Points whose heights poses shift by 3 mm."""
    views = stereo_views(0.3 * np.arange(4.0), np.zeros(4))
    folder = write_workspace(tmp_path_factory.mktemp("poses"), views, CODED)
    ids = np.arange(1, 1 + len(read_model(folder / "sparse").points_world))
    noise = np.zeros((len(ids), 3, 3))
    noise[:, 2, 2] = np.random.default_rng(1).uniform(0.001, 0.01, len(ids)) ** 2
    world = noise.copy()
    world[:, 0, 0] += 1.0  # what is unsure along north must not count
    world[:, 2, 2] += 0.003**2
    found = Uncertainty(
        frames=np.arange(4),
        stations=np.arange(4),
        images=("a", "b", "c", "d"),
        frame_cov=np.zeros((4, 6, 6)),
        point_ids=ids,
        point_cov=world,
        point_noise=noise,
        sigma_px=0.2,
        modes=no_modes(4, len(ids)),
    )
    write_uncertainty(folder / "sparse" / "covariance.npz", found)
    return folder


@pytest.fixture(scope="module")
def errors(workspace: Path) -> ErrorsOfPoses:
    found = find_errors_of_poses(workspace, read_model(workspace / "sparse"))
    assert found is not None
    return found


def test_what_pixels_do_is_taken_out(errors: ErrorsOfPoses):
    assert errors.median_along(np.array([0.0, 0.0, -1.0])) == pytest.approx(0.003, rel=1e-3)


@pytest.mark.parametrize(("azimuth_deg", "expected"), [(0.0, 1.0), (180.0, 1.0), (60.0, 0.5)])
def test_a_wall_takes_what_is_unsure_along_its_normal(
    errors: ErrorsOfPoses, azimuth_deg: float, expected: float
):
    azimuth = np.deg2rad(azimuth_deg)
    normal = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    places = errors.points_world
    found = errors.at(places, np.tile(normal, (len(places), 1)), 0.1)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_a_point_takes_the_median_of_sparse_points_around_also_of_a_part_of_them():
    rng = np.random.default_rng(2)
    places = np.column_stack([rng.uniform(0, 1, (4000, 2)), np.zeros(4000)])
    sigmas = 0.001 + 0.002 * places[:, 1]  # growing eastwards
    sigmas[::9] = 1.0  # wrong matches
    covariances = np.zeros((4000, 3, 3))
    covariances[:, 2, 2] = sigmas**2
    errors = ErrorsOfPoses(points_world=places, covariances=covariances)
    east = np.linspace(0.1, 0.9, 50)
    spots = np.column_stack([np.full(50, 0.5), east, np.zeros(50)])
    up = np.tile([0.0, 0.0, -1.0], (50, 1))
    found = errors.at(spots, up, 0.02)
    np.testing.assert_allclose(found, 0.001 + 0.002 * east, rtol=0.12)
    part = errors.around(np.array([0.45, 0.05]), np.array([0.55, 0.95]))
    assert len(part.points_world) <= len(places)
    np.testing.assert_array_equal(part.at(spots, up, 0.02), found)
    few = errors.around(np.array([9.0, 9.0]), np.array([9.1, 9.1]))  # far from all
    assert len(few.points_world) >= 16
