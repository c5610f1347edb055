from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import pytest
import trimesh

from alice_survey.app.stages import spec
from alice_survey.core.artefacts import read_json, write_json
from alice_survey.core.config import ReconstructConfig, SurveyConfig
from alice_survey.core.executor import SERIAL
from reconstruct.dense.cloud import VERTEX, write_cloud, write_cloud_json
from reconstruct.evaluate.scores import read_mesh
from reconstruct.export import export_copies
from reconstruct.light.solve import GRID, LightModel, write_light
from reconstruct.mesh.atlas import pack
from reconstruct.mesh.cells import decimate
from reconstruct.mesh.surface import splat
from reconstruct.mesh.texture import spread_corners
from reconstruct.mesh.topology import edges_of
from reconstruct.ply import read_ply_points
from tests import oracles_dense
from tests.engines import PicklingThreads
from tests.oracles_mesh import boxes_overlap, implicit_value, spread_value

STEP_M = 0.012
OFFSET = (0.0, 0.0, -12.0)
HOLE = (0.35, 0.1, 0.09)
"""North, east and radius of a place without points."""


def bump(north: np.ndarray, east: np.ndarray) -> np.ndarray:
    return oracles_dense.DEPTH_M - 0.1 * np.exp(-((north - 0.1) ** 2 + east**2) / 0.03)


SCENE = oracles_dense.Scene(depth_of=bump, paint=oracles_dense.position_code)


def write_dense(folder: Path, images: list[str]) -> None:
    dense = folder / "dense"
    dense.mkdir()
    north, east = (a.ravel() for a in np.mgrid[-0.5:0.7:STEP_M, -0.5:0.5:STEP_M])
    kept = np.hypot(north - HOLE[0], east - HOLE[1]) > HOLE[2]
    north, east = north[kept], east[kept]
    step = 1e-4
    slope_n = (bump(north + step, east) - bump(north - step, east)) / (2 * step)
    slope_e = (bump(north, east + step) - bump(north, east - step)) / (2 * step)
    normal = np.column_stack([slope_e, slope_n, np.ones(len(north))])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    points = np.zeros(len(north), VERTEX)
    points["x"], points["y"], points["z"] = east, north, -bump(north, east) - OFFSET[2]
    points["nx"], points["ny"], points["nz"] = normal.T
    points["sigma"] = 1e-3
    write_cloud(dense / "cloud.ply", [points], OFFSET, oracles_dense.FRAME)
    write_cloud_json(dense / "cloud.json", len(points), OFFSET, STEP_M, oracles_dense.FRAME)
    patterns = {camera: np.zeros((*GRID, 3)) for camera in ("left", "right")}
    gains = {image: np.zeros(3) for image in images}
    light = LightModel(patterns=patterns, gains=gains, white=np.ones(3))
    write_light(dense / "light.json", light)
    write_json(dense / "stage.json", {})


def make_workspace(folder: Path, others: Sequence[str] = ()) -> None:
    """Three stations over the bump; `others` are pictures that only the light knows."""
    views = oracles_dense.stereo_views(np.array([-0.2, 0.2, 0.5]), np.array([0.0, 0.05, 0.0]))
    oracles_dense.write_workspace(folder, views, SCENE)
    write_dense(folder, [*(view.image for view in views), *others])


@pytest.mark.slow
def test_tasks_do_not_grow_with_the_survey(tmp_path: Path):
    make_workspace(tmp_path, [f"left/other_{n:05d}.png" for n in range(5000)])
    settings = SurveyConfig(reconstruct=ReconstructConfig(mesh_error_px=1.0))
    with PicklingThreads(2) as engine:
        assert spec("mesh").make(tmp_path, settings, engine.executor)
    assert engine.tasks > 10
    assert engine.largest_task < 50_000  # the light of 5,000 pictures takes far more


@pytest.fixture(scope="module")
def mesh(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mesh")
    make_workspace(folder)
    settings = SurveyConfig(reconstruct=ReconstructConfig(mesh_error_px=0.1))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("reconstruct.mesh.atlas.PAGE_PX", 1024)
        assert spec("mesh").make(folder, settings, SERIAL)
    assert not spec("mesh").make(folder, settings, SERIAL)
    return folder / "mesh"


def welded(mesh: Path) -> o3d.geometry.TriangleMesh:
    """The mesh of a folder, east, north, up, joined where its texture was cut."""
    ned, triangles = read_mesh(mesh)
    enu = np.float32(ned[:, [1, 0, 2]] * [1, 1, -1] - OFFSET)
    vertices, number = np.unique(enu, axis=0, return_inverse=True)

    corners = o3d.utility.Vector3iVector(number.reshape(-1)[triangles])
    return o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(vertices), corners)


def test_surface_is_the_bump_with_its_hole_and_no_other(mesh: Path):
    read = welded(mesh)
    assert read.is_edge_manifold() and read.is_vertex_manifold() and read.is_orientable()
    v = np.asarray(read.vertices)
    miss = v[:, 2] + OFFSET[2] + bump(v[:, 1], v[:, 0])
    assert np.sqrt(np.mean(miss**2)) < 1e-3 and np.abs(miss).max() < 6e-3
    gap = np.hypot(v[:, 1] - HOLE[0], v[:, 0] - HOLE[1])
    assert HOLE[2] - 2 * STEP_M < gap.min() < HOLE[2] + STEP_M
    triangles = np.asarray(read.triangles)
    edges = edges_of(triangles.astype(np.int32))[0]
    euler = len(v) - len(edges) + len(triangles)
    assert euler == 0  # a disk with one hole
    area = read_json(mesh / "mesh.json")["area"]
    assert 1.0 < area < 1.35


def test_texture_shows_the_coordinates_of_the_surface(mesh: Path):
    scene = trimesh.load(mesh / "mesh.glb")
    assert read_json(mesh / "mesh.json")["textured_share"] > 0.95
    worst = []
    for part in scene.geometry.values():
        uv = part.visual.uv
        assert uv.min() >= 0 and uv.max() <= 1
        page = np.asarray(part.visual.material.baseColorTexture.convert("RGB"), np.float32)
        x, y = uv[:, 0] * page.shape[1] - 0.5, (1 - uv[:, 1]) * page.shape[0] - 0.5
        shown = cv2.remap(
            page, x.astype(np.float32)[:, None], y.astype(np.float32)[:, None], cv2.INTER_LINEAR
        )[:, 0, ::-1]
        east, north = part.vertices[:, 0], -part.vertices[:, 2]
        worst.append(np.abs(shown - oracles_dense.position_code(north, east)).max(axis=1))
    miss = np.concatenate(worst)
    assert np.median(miss) < 6 and np.percentile(miss, 95) < 25  # 2 levels a millimetre


def test_copies_hold_what_the_mesh_holds(mesh: Path):
    """GLB alone by default; OBJ on request, in the place and with the texture of the GLB."""
    assert {p.name for p in mesh.iterdir()} == {"mesh.glb", "mesh.json", "mesh.png", "stage.json"}
    export_copies(mesh.parent)
    copies = mesh.parent / "ply-obj"
    glb, obj = trimesh.load_scene(mesh / "mesh.glb"), trimesh.load_scene(copies / "mesh.obj")
    assert len(glb.geometry) == len(obj.geometry)
    for one, other in zip(glb.geometry.values(), obj.geometry.values(), strict=True):
        enu = other.vertices[other.faces]
        assert np.abs(one.vertices[one.faces][..., [0, 2, 1]] * [1, -1, 1] - enu).max() < 1e-6
        assert np.abs(one.visual.uv[one.faces] - other.visual.uv[other.faces]).max() < 1e-6
        pages = one.visual.material.baseColorTexture, other.visual.material.image
        shown = [np.asarray(page.convert("RGB"), float) for page in pages]
        assert np.abs(shown[0] - shown[1]).mean() < 0.1
    cloud = read_ply_points(copies / "cloud.ply", 10**9)
    assert len(cloud) == read_json(mesh.parent / "dense" / "cloud.json")["points"]


def test_kernels_do_what_their_twins_do():
    rng = np.random.default_rng(4)
    points, normals = rng.uniform(2, 6, (40, 3)), rng.normal(size=(40, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    weights = rng.uniform(0.5, 2, 40)
    values = splat(points, normals, weights, (1, 2, 0), (5, 4, 7))
    for node in np.ndindex(*values.shape):
        expected = implicit_value(points, normals, weights, np.add(node, (1, 2, 0)))
        assert values[node] == pytest.approx(expected, nan_ok=True, abs=1e-12)
    corners, colours = np.array([[1.0, 1.5], [17.0, 4.0], [6.0, 15.0]]), rng.uniform(0, 9, (3, 3))
    spread, covered = spread_corners(
        corners, np.array([[0, 1, 2]], np.int32), colours.astype(np.float32), (20, 20)
    )
    for row, column in np.ndindex(20, 20):
        inside = spread_value(corners, colours, column + 0.5, row + 0.5)
        if inside is not None:
            assert covered[row, column]
            np.testing.assert_allclose(spread[row, column], inside, atol=1e-4)


def test_boxes_of_an_atlas_do_not_overlap():
    rng = np.random.default_rng(1)
    boxes = rng.integers(3, 60, (60, 2))
    for side in (300, 128, 59):
        corner = pack(boxes, side)
        assert (corner >= 0).all() and ((corner + boxes)[:, 0] <= side).all()
        assert not boxes_overlap(corner.astype(float), boxes.astype(float))
    used = (pack(boxes, 300) + boxes)[:, 1].max()
    assert boxes.prod(axis=1).sum() > 0.75 * 300 * used


def test_decimation_keeps_planes_outlines_and_locked_vertices():
    x, y = (a.ravel() for a in np.mgrid[0:20, 0:20].astype(float))
    n = np.arange(400).reshape(20, 20)
    a, b, c, d = n[:-1, :-1], n[1:, :-1], n[1:, 1:], n[:-1, 1:]
    triangles = np.stack([a, b, c, a, c, d], -1).reshape(-1, 3).astype(np.int32)
    vertices = np.column_stack([x, y, 0.3 * x])
    locked = x == 0
    fewer = decimate(vertices, triangles, locked, 1e-3 + 0.2)
    assert len(fewer.triangles) < 0.5 * len(triangles)
    kept = {tuple(v) for v in fewer.vertices}
    assert all(tuple(v) in kept for v in vertices[locked])
    np.testing.assert_allclose(fewer.vertices[:, 2], 0.3 * fewer.vertices[:, 0], atol=1e-9)
    p = fewer.vertices[fewer.triangles]
    area = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])[:, 2].sum() / 2
    assert area == pytest.approx(19 * 19, rel=1e-3)
