from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from alice_survey.base.errors import heard
from reconstruct.dense.pose_part import PosePart, find_pose_part, spread_over
from reconstruct.mapping.uncertainty import Uncertainty, write_uncertainty
from reconstruct.views.model import SparseModel, read_model
from tests.oracles_dense import Scene, flat, position_code, sparse_model, stereo_views
from tests.oracles_dense import write_workspace as write

SCENE = Scene(depth_of=flat, paint=position_code)
SCALE, TURN = 2.0, Rotation.from_euler("xyz", [100, 20, -40], degrees=True)


def small_model() -> SparseModel:
    return sparse_model(stereo_views(0.3 * np.arange(4), np.zeros(4)), SCENE, points=300)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Points whose heights poses shift by 3 mm, known in a gauge that is turned and half as big."""
    folder = write(tmp_path_factory.mktemp("poses"), small_model(), SCENE)
    mapping = folder / "mapping" / "model"
    mapping.mkdir(parents=True)
    colmap = pycolmap.Reconstruction(folder / "sparse" / "model")
    ids = np.array(sorted(colmap.points3D))
    back = TURN.inv()
    move = pycolmap.Sim3d(1 / SCALE, pycolmap.Rotation3d(back.as_quat()), np.array([3.0, 4.0, 5.0]))
    colmap.transform(move)
    colmap.write(str(mapping))
    noise = np.zeros((len(ids), 3, 3))
    noise[:, 2, 2] = np.random.default_rng(1).uniform(0.001, 0.01, len(ids)) ** 2
    world = noise.copy()
    world[:, 0, 0] += 1.0  # what is unsure along north must not count
    world[:, 2, 2] += 0.003**2
    turn = back.as_matrix()
    found = Uncertainty(
        frames=np.arange(4),
        stations=np.arange(4),
        images=("a", "b", "c", "d"),
        frame_cov=np.zeros((4, 6, 6)),
        point_ids=ids,
        point_cov=turn @ world @ turn.T / SCALE**2,
        point_noise=turn @ noise @ turn.T / SCALE**2,
        sigma_px=0.2,
    )
    write_uncertainty(folder / "mapping" / "covariance.npz", found)
    return folder


def test_what_pixels_do_is_taken_out_and_the_gauge_does_not_matter(workspace: Path):
    model = read_model(workspace / "sparse")
    part = find_pose_part(workspace, model)
    assert part is not None
    assert part.median == pytest.approx(0.003, rel=1e-3)
    nodes = part.at_nodes(0.8, -0.4, 0.01, 100, 70)
    assert nodes.shape == (8, 6)
    np.testing.assert_allclose(nodes, 0.003, rtol=0.01)


def test_a_covariance_of_another_model_is_not_taken(workspace: Path):
    model = read_model(workspace / "sparse")
    moved = model.points_world.copy()
    moved[7] += [0.0, 0.0, 0.01]
    other = SparseModel(
        frame=model.frame, views=model.views, points_world=moved, observations=model.observations
    )
    with heard() as warnings:
        assert find_pose_part(workspace, other) is None
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
