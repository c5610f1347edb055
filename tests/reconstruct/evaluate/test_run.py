"""The score measures the error that was put in, and nothing else."""

import numpy as np
import pytest
import shapely
from scipy.spatial.transform import RigidTransform, Rotation
from shapely.geometry import MultiPolygon, Polygon, box

from alice_survey.core.config import CameraConfig, SeafloorConfig, WaterConfig
from alice_survey.sim.seafloor.terrain import Terrain, build_terrain
from camera_calib.rig import design_rig
from missions.values.footprint import level_pose
from reconstruct.elevation import Elevation
from reconstruct.evaluate.run import score_cameras
from reconstruct.evaluate.scores import SurfaceScore, area_in_world, score_mesh, score_surface
from reconstruct.evaluate.truth import ground_pixel_m, surface_depth

HOLE = [(1.0, 0.8), (1.6, 0.8), (1.6, 1.4), (1.0, 1.4)]
AREA = MultiPolygon([
    Polygon([(0.5, 0.5), (2.0, 0.5), (2.0, 2.0), (0.5, 2.0)], [HOLE]),
    Polygon([(2.3, 0.5), (2.9, 0.5), (2.9, 2.0)]),
])  # fmt: skip
"""Two parts, one with a hole."""
CELL, DEPTH_M = 0.02, 10.0
SHIFT = RigidTransform.from_components([0.3, -0.2, 0.05], Rotation.from_rotvec([0, 0, 0.02]))


def floor(relief_m: float, rocks: float) -> Terrain:
    config = SeafloorConfig(relief_m=relief_m, grid_m=0.02, rocks_per_m2=rocks, amphora=False)
    return build_terrain(config, (-2.0, 4.0, -2.0, 4.0), DEPTH_M, np.random.default_rng(1))


@pytest.fixture(scope="module")
def terrain() -> Terrain:
    return floor(0.2, 0.3)


def scored(terrain: Terrain, error_m: float, *, holes: float = 0.0) -> SurfaceScore:
    """The true surface as a model sees it whose world is shifted by SHIFT, with an error."""
    north, east = np.arange(3.4, -0.6, -CELL) - CELL / 2, np.arange(-0.6, 3.4, CELL) + CELL / 2
    norths, easts = np.meshgrid(north, east, indexing="ij")
    world = np.stack([norths, easts, np.zeros_like(norths)], axis=-1).reshape(-1, 3)
    true = SHIFT.apply(world)
    depth = surface_depth(terrain, true[:, :2]) - SHIFT.translation[2]
    heights = (error_m - depth).reshape(norths.shape)
    heights[np.random.default_rng(2).random(heights.shape) < holes] = np.nan
    model = Elevation(
        height=heights, sigma=np.full(heights.shape, 0.002), west=-0.6, north=3.4, cell=CELL
    )
    return score_surface(model, AREA, terrain, SHIFT, 0.0015)


def test_errors_and_holes_are_measured(terrain: Terrain) -> None:
    true = scored(terrain, 0.0)
    assert true.completeness > 0.99
    assert np.abs(true.height_m).max() < 1e-5
    assert true.distance_m.max() < 1e-5
    score = scored(terrain, 0.012, holes=0.25)
    figures = score.to_json()
    assert figures["height_rms_mm"] == pytest.approx(12.0, abs=0.01)
    assert 8.0 < figures["distance_rms_mm"] < 12.0
    assert score.completeness == pytest.approx(0.75, abs=0.02)
    assert np.all(score.distance_m <= np.abs(score.height_m) + 1e-5)  # depths are of 32 bits


def test_sigmas_and_ground_pixels_are_compared_with_the_error(terrain: Terrain) -> None:
    figures = scored(terrain, 0.004).to_json()
    assert figures["error_over_sigma"]["rms"] == pytest.approx(2.0, abs=0.01)
    assert figures["error_over_sigma"]["within_1_sigma"] == 0
    assert figures["height_median_mm"] == pytest.approx(4.0, abs=0.01)
    assert abs(figures["doming"]["dome_mm"]) < 0.01

    # 4 mm in height are less in distance where the surface is steep, and 2.67 ground pixels.
    assert figures["completeness_within_px"]["3"] > 0.98
    assert figures["completeness_within_px"]["1"] < 0.1


def test_the_area_moves_with_the_model(terrain: Terrain) -> None:
    moved = area_in_world(AREA, terrain, SHIFT)
    assert moved.area == pytest.approx(AREA.area, rel=1e-9)
    assert [len(part.interiors) for part in moved.geoms] == [1, 0]
    there = shapely.get_coordinates(moved)
    back = SHIFT.apply(np.column_stack([there, np.full(len(there), terrain.offset_ned[2])]))
    np.testing.assert_allclose(back[:, :2], shapely.get_coordinates(AREA), atol=1e-9)


def test_cameras_are_aligned_without_scale() -> None:
    rng = np.random.default_rng(3)
    truth = {
        f"left/{i:03d}.png": RigidTransform.from_components(
            rng.uniform(-2, 2, 3), Rotation.random(rng=rng)
        )
        for i in range(30)
    }
    world = {name: SHIFT.inv() * pose for name, pose in truth.items()}

    exact = score_cameras(world, truth, 31)
    grown = {
        name: RigidTransform.from_components(1.002 * p.translation, p.rotation)
        for name, p in world.items()
    }
    large = score_cameras(grown, truth, 31)

    assert exact.rms_m < 1e-9
    assert exact.turns_deg.max() < 1e-5
    assert abs(exact.scale_error) < 1e-9
    assert (exact.registered, exact.total) == (30, 31)
    assert large.scale_error == pytest.approx(0.002, rel=1e-6)
    places = np.stack([p.translation for p in truth.values()])
    spread = np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=1).mean())
    assert large.rms_m == pytest.approx(0.002 * spread, rel=1e-2)


def test_the_ground_pixel_is_range_over_focal_length_in_water() -> None:
    rig = design_rig(CameraConfig(), WaterConfig(), scale=8)
    camera = rig.cameras["left"]
    poses = {
        f"left/{north}.png": level_pose(camera, np.array([north, 0.0]), 2.0, DEPTH_M, 0.0)
        for north in (0.0, 0.5)
    }
    pupil_m = DEPTH_M - poses["left/0.0.png"].translation[2]
    pixel = ground_pixel_m(rig, dict.fromkeys(poses, "left"), poses, floor(0.0, 0.0))
    assert pixel == pytest.approx(pupil_m / (camera.fx_px * camera.n_water), rel=1e-5)


def test_a_lifted_half_of_a_mesh_scores_its_lift_and_half_complete() -> None:
    half = np.array([[0.0, -1, DEPTH_M], [1, -1, DEPTH_M], [1, 1, DEPTH_M], [0, 1, DEPTH_M]])
    half -= [0.0, 0.0, 0.004]  # north 0 to 1, 4 mm too high
    faces, area = np.array([[0, 1, 2], [0, 2, 3]]), MultiPolygon([box(-1, -1, 1, 1)])
    figures = score_mesh(
        half, faces, area, floor(0.0, 0.0), RigidTransform.identity(), 0.002,
        np.random.default_rng(5),
    )  # fmt: skip
    assert figures["distance_rms_mm"] == pytest.approx(4.0, abs=0.01)
    assert figures["completeness_within_px"]["1"] == 0
    assert figures["completeness_within_px"]["5"] == pytest.approx(0.5, abs=0.02)
