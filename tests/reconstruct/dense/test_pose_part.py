from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from alice_survey.base.errors import heard
from alice_survey.base.records import MappingRecord, RegistrationRecord, SimilarityRecord
from reconstruct.adjustment.uncertainty import Uncertainty, write_uncertainty
from reconstruct.dense.pose_part import PosePart, find_pose_part, spread_over
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
    (folder / "mapping").mkdir()
    ids = np.arange(1, 1 + len(read_model(folder / "sparse").points_world))
    noise = np.zeros((len(ids), 3, 3))
    noise[:, 2, 2] = np.random.default_rng(1).uniform(0.001, 0.01, len(ids)) ** 2
    world = noise.copy()
    world[:, 0, 0] += 1.0  # what is unsure along north must not count
    world[:, 2, 2] += 0.003**2
    turn = TURN.inv().as_matrix()
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
    MappingRecord(gauge="this model").write(folder / "mapping" / "mapping.json")
    placed = SimilarityRecord(scale=SCALE, quaternion_xyzw=tuple(TURN.as_quat().tolist()))
    RegistrationRecord(
        registered=4, total=4, points=len(ids), mean_reprojection_px=0.1, mean_track_length=2.0,
        scale_source=None, gauge="this model", world_from_mapping=placed,
    ).write(folder / "sparse" / "registration.json")  # fmt: skip
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
    fewer = replace(model, points_world=model.points_world[:-1])
    with heard() as warnings:
        assert find_pose_part(workspace, fewer) is None
    assert len(warnings) == 1
    path = workspace / "mapping" / "mapping.json"
    MappingRecord(gauge="another model").write(path)
    with heard() as warnings:
        assert find_pose_part(workspace, model) is None
    assert len(warnings) == 1
    MappingRecord(gauge="this model").write(path)


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
