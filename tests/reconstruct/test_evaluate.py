"""The score measures the error that was put in, and nothing else."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.artefacts import write_csv
from alice_survey.config import SeafloorConfig
from alice_survey.errors import WorkspaceError
from alice_survey.seafloor.terrain import Terrain, build_terrain
from reconstruct.evaluate import score_cameras, score_surface
from reconstruct.truth import surface_depth, surface_distance

AREA = np.array([[0.5, 0.5], [2.5, 0.5], [2.5, 2.0], [0.5, 2.0]])
CELL = 0.02
SHIFT = RigidTransform.from_components([0.3, -0.2, 0.05], Rotation.from_rotvec([0, 0, 0.02]))


@pytest.fixture(scope="module")
def terrain() -> Terrain:
    config = SeafloorConfig(relief_m=0.2, grid_m=0.02, rocks_per_m2=0.3, amphora=False)
    return build_terrain(config, (-1.0, 4.0, -1.0, 4.0), 10.0, np.random.default_rng(1))


def write_dem(path: Path, terrain: Terrain, error_m: float, holes: float) -> None:
    """The true surface as a model sees it whose world is shifted by SHIFT, with an error."""
    north, east = np.arange(3.4, -0.6, -CELL) - CELL / 2, np.arange(-0.6, 3.4, CELL) + CELL / 2
    norths, easts = np.meshgrid(north, east, indexing="ij")
    world = np.stack([norths, easts, np.zeros_like(norths)], axis=-1).reshape(-1, 3)
    true = SHIFT.apply(world)
    depth = surface_depth(terrain, true[:, :2]) - SHIFT.translation[2]
    heights = (-depth + error_m).reshape(norths.shape)
    heights[np.random.default_rng(2).random(heights.shape) < holes] = np.nan
    with rasterio.open(
        path, "w", driver="GTiff", width=len(east), height=len(north), count=1, dtype="float64",
        transform=from_origin(-0.6, 3.4, CELL, CELL), nodata=np.nan,
    ) as target:  # fmt: skip
        target.write(heights, 1)


def test_a_true_surface_scores_zero(terrain: Terrain, tmp_path: Path) -> None:
    write_dem(tmp_path / "dem.tif", terrain, 0.0, 0.0)
    score = score_surface(tmp_path / "dem.tif", AREA, terrain, SHIFT)
    assert score.completeness > 0.99
    assert np.abs(score.height_m).max() < 1e-5
    assert score.distance_m.max() < 1e-5


def test_an_error_and_holes_are_measured(terrain: Terrain, tmp_path: Path) -> None:
    write_dem(tmp_path / "dem.tif", terrain, 0.012, 0.25)
    score = score_surface(tmp_path / "dem.tif", AREA, terrain, SHIFT)
    figures = score.to_json()
    assert figures["height_rms_mm"] == pytest.approx(12.0, abs=0.01)
    assert 8.0 < figures["distance_rms_mm"] < 12.0
    assert score.completeness == pytest.approx(0.75, abs=0.02)
    assert np.all(score.distance_m <= np.abs(score.height_m) + 1e-6)


def test_distance_of_a_point_above_a_level_floor() -> None:
    config = SeafloorConfig(relief_m=0.0, grid_m=0.05, rocks_per_m2=0.0, amphora=False)
    flat = build_terrain(config, (-1.0, 1.0, -1.0, 1.0), 10.0, np.random.default_rng(1))
    points = np.array([[0.0, 0.0, 9.7], [0.2, 0.1, 10.4]])
    np.testing.assert_allclose(surface_distance(flat, points), [0.3, 0.4], atol=1e-5)
    np.testing.assert_allclose(surface_depth(flat, points[:, :2]), [10.0, 10.0], atol=1e-5)
    assert np.isnan(surface_depth(flat, np.array([[5.0, 0.0]]))).all()


def write_truth(path: Path, poses: dict[str, RigidTransform]) -> None:
    header = ("image", "north_m", "east_m", "depth_m", "qx", "qy", "qz", "qw")
    rows = [[n, *p.translation, *p.rotation.as_quat()] for n, p in poses.items()]
    write_csv(path, header, rows)


def test_cameras_are_aligned_without_scale(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    truth = {
        f"left/{i:03d}.png": RigidTransform.from_components(
            rng.uniform(-2, 2, 3), Rotation.random(rng=rng)
        )
        for i in range(30)
    }
    write_truth(tmp_path / "poses.csv", truth)
    world = {name: SHIFT.inv() * pose for name, pose in truth.items()}

    exact = score_cameras(world, tmp_path / "poses.csv", 31)
    grown = {
        name: RigidTransform.from_components(1.002 * p.translation, p.rotation)
        for name, p in world.items()
    }
    large = score_cameras(grown, tmp_path / "poses.csv", 31)

    assert exact.rms_m < 1e-9
    assert exact.turns_deg.max() < 1e-5
    assert abs(exact.scale_error) < 1e-9
    assert (exact.registered, exact.total) == (30, 31)
    assert large.scale_error == pytest.approx(0.002, rel=1e-6)
    places = np.stack([p.translation for p in truth.values()])
    spread = np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=1).mean())
    assert large.rms_m == pytest.approx(0.002 * spread, rel=1e-2)


def test_two_cameras_cannot_be_aligned(tmp_path: Path) -> None:
    truth = {f"{i}.png": RigidTransform.from_translation([i, 0, 0]) for i in range(2)}
    write_truth(tmp_path / "poses.csv", truth)
    with pytest.raises(WorkspaceError, match="3 or more"):
        score_cameras(truth, tmp_path / "poses.csv", 2)
