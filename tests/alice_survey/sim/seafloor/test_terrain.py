from functools import cache
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from alice_survey.core.config import SeafloorConfig
from alice_survey.core.errors import WorkspaceError
from alice_survey.sim.seafloor.terrain import (
    CERAMIC,
    LENGTH_M,
    Terrain,
    amphora_mesh,
    build_terrain,
    read_terrain,
    survey_terrain,
)

BOUNDS = (10.0, 16.0, -3.0, 2.0)
DEPTH_M = 15.0


def build(seed: int = 1, **settings_: float | bool) -> Terrain:
    config = SeafloorConfig(**{"grid_m": 0.02, **settings_})
    return build_terrain(config, BOUNDS, DEPTH_M, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def terrain() -> Terrain:
    return build()


@cache
def bare_sand() -> Terrain:
    return build(amphora=False)


def look_down(terrain: Terrain, points_ne: np.ndarray) -> np.ndarray:
    """Depth of what vertical rays from above meet first."""
    rays = np.zeros((len(points_ne), 6), dtype=np.float32)
    rays[:, :2] = points_ne - terrain.offset_ned[:2]
    rays[:, 2], rays[:, 5] = -3.0, 1.0
    hits = terrain.raycasting_scene().cast_rays(o3d.core.Tensor(rays))
    return hits["t_hit"].numpy() - 3.0 + terrain.offset_ned[2]


@pytest.mark.parametrize("relief_m", [0.1, 0.35, 1.0])
def test_sand_spans_the_relief_asked_for_about_the_mean_depth(relief_m: float) -> None:
    sand = build(relief_m=relief_m, rocks_per_m2=0.0, amphora=False)
    depths = sand.vertices[:, 2]
    assert np.ptp(depths) == pytest.approx(relief_m, rel=1e-5)
    assert depths.mean() == pytest.approx(DEPTH_M, abs=1e-5)


def test_rocks_stick_out_of_the_sand_with_slopes_that_rocks_have() -> None:
    bare, rocky = (build(rocks_per_m2=r, amphora=False) for r in (0.0, 1.0))
    rise = bare.depths - rocky.depths
    assert 0.05 < rise.max() < 0.35
    assert rise.min() > -1e-3
    share = rocky.material > 0.5
    assert 0.002 < share.mean() < 0.3
    assert rise[share].min() > 0.0
    slope = np.hypot(*np.gradient(rocky.depths.astype(float), rocky.grid_m))
    assert np.quantile(slope, 0.9999) < np.tan(np.deg2rad(85))


def test_amphora_lies_half_buried_near_the_middle(terrain: Terrain) -> None:
    (amphora,) = terrain.objects
    points = amphora.vertices + terrain.offset_ned
    middle = np.array([np.mean(BOUNDS[:2]), np.mean(BOUNDS[2:])])
    assert amphora.name == "amphora"
    assert amphora.material == CERAMIC
    assert np.linalg.norm(points[:, :2].mean(axis=0) - middle) < 0.6
    away = points - points.mean(axis=0)
    spread, axes = np.linalg.eigh(away.T @ away)
    assert 0.55 < np.ptp(away @ axes[:, 2]) < 0.66
    assert spread[2] > 2.0 * spread[1]
    buried = points[:, 2] > terrain.depth_at(points[:, :2])
    assert 0.3 < buried.mean() < 0.75
    above = terrain.depth_at(points[:, :2]) - points[:, 2]
    assert 0.08 < above.max() < 0.25


def test_amphora_is_closed_and_faces_outward() -> None:
    vertices, triangles = amphora_mesh()
    mesh = trimesh.Trimesh(vertices, triangles)
    parts = mesh.split(only_watertight=True)
    volumes = sorted(part.volume for part in parts)
    assert len(parts) == 3
    assert 0.012 < volumes[-1] < 0.022  # clay and wine, cubic metres
    assert 2e-5 < volumes[0] < 2e-4
    assert np.ptp(vertices[:, 0]) == pytest.approx(LENGTH_M, abs=0.005)


@settings(max_examples=20, deadline=None)
@given(north=st.floats(10.0, 16.0), east=st.floats(-3.0, 2.0))
def test_depth_is_that_of_the_triangles(north: float, east: float) -> None:
    smooth = bare_sand()
    point = np.clip([[north, east]], [10.001, -2.999], [15.999, 1.999])
    np.testing.assert_allclose(smooth.depth_at(point), look_down(smooth, point), atol=3e-6)


def test_what_is_read_is_what_was_written_to_the_bit(terrain: Terrain, tmp_path: Path) -> None:
    terrain.write(tmp_path / "terrain.ply")
    again = read_terrain(tmp_path / "terrain.ply")
    for name in ("vertices", "triangles", "material", "normals", "origin_ned"):
        np.testing.assert_array_equal(getattr(again.patch(), name), getattr(terrain.patch(), name))
    mesh = trimesh.load(tmp_path / "terrain.ply", process=False)
    np.testing.assert_allclose(mesh.vertices, terrain.vertices - terrain.offset_ned, atol=1e-6)
    assert len(mesh.faces) == len(terrain.triangles)


def test_a_patch_is_the_same_surface(terrain: Terrain) -> None:
    patch = terrain.patch((12.0, 13.7, -1.5, 0.4))
    points = patch.vertices + patch.origin_ned
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    assert np.all(low <= np.array([12.0, -1.5]) + 1e-6)
    assert np.all(high >= np.array([13.7, 0.4]) - 1e-6)
    ground = patch.material < 1.5
    np.testing.assert_allclose(
        points[ground, 2],
        terrain.depth_at(np.clip(points[ground, :2], [10, -3], [16, 2])),
        atol=2e-6,
    )
    assert np.any(~ground)
    whole = terrain.patch()
    first = np.flatnonzero(
        np.all(np.isclose(whole.vertices + whole.origin_ned, points[0], atol=1e-5), axis=1)
    )[0]
    np.testing.assert_array_equal(patch.normals[0], whole.normals[first])


def test_a_survey_has_one_terrain_by_its_seed() -> None:
    area = [[0.0, 0.0], [2.0, 0.0], [2.0, 3.0]]
    coarse = SeafloorConfig(grid_m=0.03)
    one, two, other = (
        survey_terrain(coarse, area, margin_m=2.0, depth_m=15.0, seed=seed) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one.vertices, two.vertices)
    assert np.abs(one.depths - other.depths).max() > 0.05
    south, north, west, east = one.bounds_ne_m
    # An altitude beyond where the vehicle may be.
    assert -2.5 < south <= -2.0
    assert -2.5 < west <= -2.0
    assert 4.0 <= north < 4.5
    assert 5.0 <= east < 5.5


def test_broken_and_missing_files_are_refused(terrain: Terrain, tmp_path: Path) -> None:
    path = tmp_path / "terrain.ply"
    with pytest.raises(WorkspaceError, match=r"terrain\.json"):
        read_terrain(path)
    terrain.write(path)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(WorkspaceError, match=r"terrain\.ply"):
        read_terrain(path)


def test_sand_holds_nothing_finer_than_its_grid_can_carry() -> None:
    sand = build(grid_m=0.01, relief_m=0.35, rocks_per_m2=0.0, amphora=False).depths
    window = np.outer(np.hanning(sand.shape[0]), np.hanning(sand.shape[1]))
    power = np.abs(np.fft.fft2((sand - sand.mean()) * window)) ** 2
    north, east = (np.fft.fftfreq(n, 0.01) for n in sand.shape)
    fine = np.hypot(north[:, None], east) > 1.0 / (5 * 0.01)
    ripples = (np.hypot(north[:, None], east) > 4.0) & ~fine
    assert power[fine].sum() < 1e-4 * power.sum()
    assert power[ripples].sum() > 1e-5 * power.sum()


def test_normals_point_into_the_water(terrain: Terrain) -> None:
    patch = terrain.patch()
    np.testing.assert_allclose(np.linalg.norm(patch.normals, axis=1), 1.0, atol=1e-5)
    ground = slice(0, terrain.depths.size)
    assert patch.normals[ground, 2].max() < 0.0
    corners = patch.vertices[patch.triangles].astype(float)
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    field = 2 * (terrain.depths.shape[0] - 1) * (terrain.depths.shape[1] - 1)
    assert faces[:field, 2].max() < 0.0


def test_depth_beyond_the_edge_is_nan(terrain: Terrain) -> None:
    south, north, west, east = terrain.bounds_ne_m
    inside = [[south, west], [north, east], [12.0, 0.0]]
    outside = [[south - 0.01, 0.0], [12.0, east + 0.01], [np.nan, 0.0]]
    assert np.all(np.isfinite(terrain.depth_at(np.array(inside))))
    assert np.all(np.isnan(terrain.depth_at(np.array(outside))))


def test_written_depths_are_good_to_a_hundredth_of_a_millimetre_in_deep_water() -> None:
    config = SeafloorConfig(grid_m=0.02, amphora=False)
    deep = build_terrain(config, BOUNDS, 5999.0, np.random.default_rng(1))
    rise = deep.vertices[:, 2] - bare_sand().vertices[:, 2]
    np.testing.assert_allclose(rise, 5984.0, atol=1e-6)
