from pathlib import Path

import laspy
import numpy as np
import pytest

from alice_survey.core.artefacts import read_json
from alice_survey.core.executor import SERIAL
from reconstruct.dense import cloud as cloud_module
from reconstruct.dense.cloud import VERTEX, cloud_in_parts, vertices_of, write_cloud, write_clouds
from reconstruct.dense.surface_points import SURFACE_POINT
from reconstruct.dense.surface_tiles import SurfaceTile
from reconstruct.dense.view_store import ViewStore
from reconstruct.ply import open_cloud
from tests.oracles_dense import FRAME


def random_surface(count: int = 4000) -> np.ndarray:
    rng = np.random.default_rng(6)
    normals = rng.normal(np.array([0.0, 0.0, 4.0]), 1.0, (count, 3))
    found = np.zeros(count, SURFACE_POINT)
    found["enu"] = rng.uniform([0.0, 0.0, -0.3], [1.0, 1.0, 0.3], (count, 3))
    found["normal"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    found["colour"] = rng.integers(0, 256, (count, 3))
    found["sigma"] = rng.uniform(0.002, 0.02, count)
    found["shared"] = rng.uniform(0.0, 0.01, count)
    return found


def test_each_point_of_the_surface_is_a_vertex_with_all_of_its_sigma():
    surface = random_surface()
    vertices = vertices_of(surface, 0.1, 0.1)
    np.testing.assert_array_equal(np.column_stack([vertices[a] for a in "xyz"]), surface["enu"])
    colours = np.column_stack([vertices[name] for name in ("red", "green", "blue")])
    np.testing.assert_array_equal(colours, surface["colour"])
    np.testing.assert_allclose(
        vertices["sigma"] ** 2, surface["sigma"] ** 2 + surface["shared"] ** 2, rtol=1e-5
    )


def test_larger_cubes_take_the_weighted_mean_of_their_points():
    surface = random_surface()
    sigmas = np.hypot(surface["sigma"].astype(float), surface["shared"])
    vertices = vertices_of(surface, 0.05, 0.1)
    cubes = surface["enu"].astype(np.float64) // 0.1
    _, cube = np.unique(cubes, axis=0, return_inverse=True)
    for number, vertex in zip(range(cube.max() + 1), vertices, strict=True):
        members = np.flatnonzero(cube.ravel() == number)
        w = 1 / sigmas[members] ** 2
        place = np.average(surface["enu"][members], axis=0, weights=w)
        np.testing.assert_allclose([vertex["x"], vertex["y"], vertex["z"]], place, atol=1e-5)
        colour = np.average(surface["colour"][members], axis=0, weights=w)
        found = [vertex["red"], vertex["green"], vertex["blue"]]
        np.testing.assert_allclose(found, colour, atol=0.51)
        np.testing.assert_allclose(
            vertex["sigma"], np.average(sigmas[members], weights=w), rtol=1e-4
        )
    length = np.sqrt(vertices["nx"] ** 2 + vertices["ny"] ** 2 + vertices["nz"] ** 2)
    np.testing.assert_allclose(length, 1.0, atol=1e-5)


def test_ply_is_read_back_by_another_library(tmp_path):
    import open3d as o3d

    vertices = vertices_of(random_surface(), 0.1, 0.1)
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


@pytest.mark.parametrize("cell", [0.05, 3e-4])
def test_points_of_the_copc_are_those_of_the_surface(tmp_path: Path, cell: float):
    surface = random_surface()
    surface["enu"] *= np.float32(cell / 0.05)
    store = ViewStore(tmp_path / "scratch")
    store.save(0, "surface", surface)
    whole = SurfaceTile(number=0, count=len(surface), corners_enu=np.empty((8, 3)), bounds={})
    write_clouds(tmp_path, store, [whole], (1.0, 2.0, -12.0), FRAME, cell, SERIAL)
    assert not (tmp_path / "cloud.ply").exists()
    (tmp_path / "copy").mkdir()
    found = open_cloud(cloud_in_parts(tmp_path, tmp_path / "copy", FRAME))
    expected = vertices_of(surface, cell, cell)
    points, expected = (np.sort(rows, order="sigma") for rows in (found.header.rows(), expected))
    for name in expected.dtype.names:
        limit = 0.06 * cell if name in "xyz" else 0.0
        np.testing.assert_allclose(points[name], expected[name], rtol=0, atol=limit)
    assert found.header.offset.tolist() == [1.0, 2.0, -12.0]


def test_the_overview_is_thinned_and_the_copc_is_not(tmp_path, monkeypatch):
    monkeypatch.setattr(cloud_module, "_MAX_OVERVIEW_POINTS", 1000)
    surface, offset = random_surface(), (1.0, 2.0, -12.0)
    store = ViewStore(tmp_path / "scratch")
    left = store.folder / "copc" / "0_0_0" / "0.points"  # of a run that was interrupted
    left.parent.mkdir(parents=True)
    left.write_bytes(bytes(500))
    tiles = []
    for number, part in enumerate(np.array_split(surface, 5)):
        store.save(number, "surface", part)
        tiles.append(
            SurfaceTile(number=number, count=len(part), corners_enu=np.empty((8, 3)), bounds={})
        )
    write_clouds(tmp_path, store, tiles, offset, FRAME, 0.05, SERIAL)
    about = read_json(tmp_path / "cloud.json")
    assert about["thinned_to"] == 0.1
    assert about["points"] < 0.9 * len(surface)
    cloud = laspy.read(tmp_path / "cloud.copc.laz")
    found = np.sort(cloud.xyz - offset, axis=0)
    np.testing.assert_allclose(found, np.sort(surface["enu"], axis=0), atol=6e-5)
    np.testing.assert_array_equal(np.sort(cloud.red), np.sort(surface["colour"][:, 0] * 257.0))
    assert not left.parent.parent.exists()
