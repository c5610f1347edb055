"""The ground pixel and the scores of a mesh against closed forms."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform
from shapely.geometry import MultiPolygon, box

from alice_survey.core.config import CameraConfig, SeafloorConfig, WaterConfig
from alice_survey.sim.seafloor.terrain import Terrain, build_terrain
from camera_calib.rig import Rig, design_rig
from missions.values.footprint import level_pose
from reconstruct.evaluate.scores import score_mesh
from reconstruct.evaluate.truth import ground_pixel_m

DEPTH_M = 10.0


@pytest.fixture(scope="module")
def rig() -> Rig:
    return design_rig(CameraConfig(), WaterConfig(), scale=8)


def floor(rocks: float = 0.0) -> Terrain:
    config = SeafloorConfig(relief_m=0.0, grid_m=0.02, rocks_per_m2=rocks, amphora=False)
    return build_terrain(config, (-2.0, 2.0, -2.0, 2.0), DEPTH_M, np.random.default_rng(1))


def poses_at(rig: Rig, norths: list[float]) -> dict[str, RigidTransform]:
    camera = rig.cameras["left"]
    return {
        f"left/{i}.png": level_pose(camera, np.array([n, 0.0]), 2.0, DEPTH_M, 0.0)
        for i, n in enumerate(norths)
    }


def test_the_ground_pixel_is_range_over_focal_length_in_water(rig: Rig) -> None:
    poses = poses_at(rig, [0.0, 0.5])
    camera = rig.cameras["left"]
    pupil_m = DEPTH_M - poses["left/0.png"].translation[2]
    pixel = ground_pixel_m(rig, dict.fromkeys(poses, "left"), poses, floor())
    assert pixel == pytest.approx(pupil_m / (camera.fx_px * camera.n_water), rel=1e-5)


SQUARE = np.array([[-1.0, -1, 10], [1, -1, 10], [1, 1, 10], [-1, 1, 10]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def test_a_lifted_half_of_a_mesh_scores_its_lift_and_half_complete() -> None:
    half = SQUARE * [0.5, 1, 1] + [0.5, 0, -0.004]  # north 0 to 1, 4 mm too high
    area = MultiPolygon([box(-1, -1, 1, 1)])
    figures = score_mesh(
        half, FACES, area, floor(), RigidTransform.identity(), 0.002, np.random.default_rng(5)
    )
    assert figures["distance_rms_mm"] == pytest.approx(4.0, abs=0.01)
    assert figures["completeness_within_px"]["1"] == 0
    assert figures["completeness_within_px"]["5"] == pytest.approx(0.5, abs=0.02)
