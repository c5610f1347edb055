from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from alice_survey.base.errors import heard
from reconstruct.adjustment.soft_modes import no_modes
from reconstruct.adjustment.uncertainty import Uncertainty, write_uncertainty
from reconstruct.dense.pose_part import PosePart, find_pose_part, spread_over
from reconstruct.views.model import SparseModel, read_model
from tests.oracles_dense import Scene, flat, position_code, sparse_model, stereo_views
from tests.oracles_dense import write_workspace as write

SCENE = Scene(depth_of=flat, paint=position_code)


def small_model() -> SparseModel:
    return sparse_model(stereo_views(0.3 * np.arange(4), np.zeros(4)), SCENE, points=300)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Points whose heights poses shift by 3 mm."""
    folder = write(tmp_path_factory.mktemp("poses"), small_model(), SCENE)
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


def test_what_pixels_do_is_taken_out(workspace: Path):
    model = read_model(workspace / "sparse")
    part = find_pose_part(workspace, model)
    assert part is not None
    assert part.median == pytest.approx(0.003, rel=1e-3)
    nodes = part.at_nodes(0.8, -0.4, 0.01, 100, 70)
    assert nodes.shape == (8, 6)
    np.testing.assert_allclose(nodes, 0.003, rtol=0.01)


def test_a_covariance_of_another_model_is_not_taken(workspace: Path):
    model = read_model(workspace / "sparse")
    fewer = replace(model, points_world=model.points_world[:-1])
    with heard() as warnings:
        assert find_pose_part(workspace, fewer) is None
    assert len(warnings) == 1


def test_nodes_take_the_median_of_the_points_around_and_cells_lie_between():
    rng = np.random.default_rng(2)
    places = rng.uniform(0, 1, (4000, 2))
    sigmas = 0.001 + 0.002 * places[:, 1]  # growing eastwards
    sigmas[::9] = 1.0  # wrong matches
    part = PosePart(places=places, variances=sigmas**2)
    nodes = part.at_nodes(1.0, 0.0, 0.01, 100, 100)
    cells = spread_over(nodes, 100, 100)
    assert cells.shape == (100, 100)
    expected = 0.001 + 0.002 * (np.arange(100) + 0.5) * 0.01
    np.testing.assert_allclose(cells[50, 5:95], expected[5:95], rtol=0.08)
