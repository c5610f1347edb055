from dataclasses import replace

import numpy as np

from alice_survey.base.artefacts import read_json
from reconstruct.dense.cloud import (
    VERTEX,
    thinned_points,
    voxel_edge,
    write_cloud,
    write_cloud_json,
)
from reconstruct.dense.points import Points
from reconstruct.raster import DemGrid
from tests.oracles_dense import FRAME

GRID = DemGrid(west=0.0, north=1.0, cell=0.1, rows=10, columns=10)


def random_points(count: int = 4000) -> Points:
    rng = np.random.default_rng(6)
    normals = rng.normal(np.array([0.0, 0.0, 4.0]), 1.0, (count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[::50] = np.nan
    return Points(
        enu=rng.uniform([-0.05, -0.05, -0.3], [1.05, 1.05, 0.3], (count, 3)).astype(np.float32),
        normals=normals.astype(np.float32),
        colours=rng.integers(0, 256, (count, 3)).astype(np.uint8),
        sigmas=rng.uniform(0.002, 0.02, count).astype(np.float32),
        views=np.zeros(count, np.int32),
    )


def test_one_vertex_per_cube_with_the_weighted_mean_of_its_points():
    points = random_points()
    vertices = thinned_points(GRID, points)
    cubes: dict[tuple[int, int, int], list[int]] = {}
    for number, (east, north, up) in enumerate(points.enu.astype(np.float64).tolist()):
        key = (int((1.0 - north) // 0.1), int(east // 0.1), int(up // 0.1))
        inside = 0 <= key[0] < 10 and 0 <= key[1] < 10
        if inside and np.isfinite(points.normals[number]).all():
            cubes.setdefault(key, []).append(number)
    assert len(vertices) == len(cubes)
    for vertex, key in zip(vertices, sorted(cubes), strict=True):
        members = cubes[key]
        w = 1 / points.sigmas[members].astype(np.float64) ** 2
        place = np.average(points.enu[members], axis=0, weights=w)
        np.testing.assert_allclose([vertex["x"], vertex["y"], vertex["z"]], place, atol=1e-5)
        colour = np.average(points.colours[members], axis=0, weights=w)
        found = [vertex["red"], vertex["green"], vertex["blue"]]
        np.testing.assert_allclose(found, colour, atol=0.51)
        sigma = np.average(points.sigmas[members], weights=w)
        np.testing.assert_allclose(vertex["sigma"], sigma, rtol=1e-4)
    length = np.sqrt(vertices["nx"] ** 2 + vertices["ny"] ** 2 + vertices["nz"] ** 2)
    np.testing.assert_allclose(length, 1.0, atol=1e-5)


def test_ply_is_read_back_by_another_library(tmp_path):
    import open3d as o3d

    vertices = thinned_points(GRID, random_points())
    parts = [vertices[:100], vertices[100:100], vertices[100:]]
    count = write_cloud(tmp_path / "cloud.ply", parts, (1.0, 2.0, -12.0), FRAME)
    assert count == len(vertices)
    cloud = o3d.t.io.read_point_cloud(str(tmp_path / "cloud.ply"))
    places = np.column_stack([vertices["x"], vertices["y"], vertices["z"]])
    np.testing.assert_array_equal(cloud.point.positions.numpy(), places)
    np.testing.assert_array_equal(cloud.point.colors.numpy()[:, 0], vertices["red"])
    np.testing.assert_array_equal(cloud.point.normals.numpy()[:, 2], vertices["nz"])
    np.testing.assert_array_equal(cloud.point.sigma.numpy()[:, 0], vertices["sigma"])
    header = (tmp_path / "cloud.ply").read_bytes()[:600].decode("ascii", "replace")
    assert "comment offset_east_north_up 1.0 2.0 -12.0\n" in header
    assert VERTEX.itemsize * count < (tmp_path / "cloud.ply").stat().st_size
    assert list(tmp_path.iterdir()) == [tmp_path / "cloud.ply"]


def test_cloud_json_names_frame_offset_and_datum(tmp_path):
    write_cloud_json(tmp_path / "a.json", 5, (1.0, 2.0, -12.0), 0.004, FRAME)
    data = read_json(tmp_path / "a.json")
    assert data["points"] == 5
    assert data["offset_east_north_up"] == [1.0, 2.0, -12.0]
    assert "Azimuthal_Equidistant" in data["crs"]
    assert data["vertical_datum"] == "sea surface"
    free = replace(FRAME, name="model", datum=None, scaled=False)
    write_cloud_json(tmp_path / "b.json", 5, (0.0, 0.0, 0.0), 0.004, free)
    data = read_json(tmp_path / "b.json")
    assert data["crs"] is None
    assert data["unit"] == "model units"


def test_cubes_grow_only_when_there_are_too_many():
    assert voxel_edge(0.004, 1_000_000, 40_000_000) == 0.004
    assert voxel_edge(0.001, 160_000_000, 40_000_000) == 0.002
