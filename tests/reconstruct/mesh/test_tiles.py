import json
import tracemalloc
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import open3d as o3d
import pyproj
import pytest
import trimesh

from alice_survey.app.stages import spec
from alice_survey.core.config import ReconstructConfig, SurveyConfig
from alice_survey.core.executor import SERIAL, local_executor
from reconstruct.dense.cloud import VERTEX, write_cloud
from reconstruct.mesh import surface
from reconstruct.mesh.cells import CellLevel
from reconstruct.mesh.surface import coarser_level, finest_level
from reconstruct.mesh.topology import edges_of
from reconstruct.ply import open_cloud
from tests.oracles_dense import DATUM, FRAME, position_code
from tests.reconstruct.mesh.test_run import OFFSET, STEP_M, bump, make_workspace, welded

pytestmark = pytest.mark.slow
PAGE_PX = 512
ERROR_M = 3e-4


@dataclass(frozen=True, kw_only=True, eq=False)
class Tile:
    """A tile as a viewer without any library of ours reads it."""

    level: int
    error: float
    low: np.ndarray
    high: np.ndarray
    parent: "Tile | None"
    enu: np.ndarray
    """(V, 3) float32, z up."""
    triangles: np.ndarray
    uv: np.ndarray
    page: np.ndarray


def read_glb(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    assert int.from_bytes(path.read_bytes()[8:12], "little") == path.stat().st_size
    (mesh,) = trimesh.load_scene(path, process=False).geometry.values()
    page = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))[..., ::-1].copy()
    # as 3D Tiles turns y up to z up; v counts down in glTF
    enu = mesh.vertices[:, [0, 2, 1]].astype(np.float32) * np.array([1, -1, 1], np.float32)
    uv = (mesh.visual.uv * [1, -1] + [0, 1]).astype(np.float32)
    return enu, np.asarray(mesh.faces, np.int32), uv, page


def read_tiles(path: Path) -> list[Tile]:
    """All tiles, parents first."""

    def walk(node: dict[str, Any], folder: Path, parent: Tile | None) -> Iterator[Tile]:
        uri = node["content"]["uri"]
        if uri.endswith(".json"):
            yield from walk(json.loads((folder / uri).read_text())["root"], folder, parent)
            return
        box = np.array(node["boundingVolume"]["box"])
        half = np.abs(box[3:].reshape(3, 3)).sum(axis=0)
        enu, triangles, uv, page = read_glb(folder / uri)
        tile = Tile(
            level=int(uri.split("/")[0]), error=node["geometricError"], low=box[:3] - half,
            high=box[:3] + half, parent=parent, enu=enu, triangles=triangles, uv=uv, page=page,
        )  # fmt: skip
        yield tile
        for child in node.get("children", ()):
            yield from walk(child, folder, tile)

    return list(walk(json.loads(path.read_text())["root"], path.parent, None))


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("tiles")
    make_workspace(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surface, "_TILE_STEPS", (12, 12))
        patch.setattr("reconstruct.mesh.tiles._LEVELS_OF_A_FILE", 2)
        patch.setattr("reconstruct.mesh.atlas.PAGE_PX", PAGE_PX)
        patch.setattr(surface, "_MAX_TRIANGLES", 1)
        settings = SurveyConfig(reconstruct=ReconstructConfig(mesh_error_px=0.1))
        assert spec("mesh").make(folder, settings, SERIAL)
        yield folder


@pytest.fixture(scope="module")
def levels(survey: Path) -> list[CellLevel]:
    cloud, folder = open_cloud(survey / "dense" / "cloud.ply"), survey / "levels"
    found = [finest_level(cloud, STEP_M, ERROR_M, folder, SERIAL)]
    while len(found[-1].cells) > 1:
        found.append(coarser_level(found, STEP_M, folder, SERIAL))
    return found


@pytest.fixture(scope="module")
def tiles(survey: Path) -> list[Tile]:
    return read_tiles(survey / "mesh" / "tiles" / "tileset.json")


def whole(tiles: list[Tile], level: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a level, joined where vertices are the same to the bit."""
    mine = [tile for tile in tiles if tile.level == level]
    starts = np.cumsum([0, *(len(t.enu) for t in mine)])
    triangles = np.concatenate([t.triangles + s for t, s in zip(mine, starts, strict=False)])
    vertices, number = np.unique(np.concatenate([t.enu for t in mine]), axis=0, return_inverse=True)
    return vertices.astype(np.float64), number.reshape(-1)[triangles].astype(np.int32)


def distances(points: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(triangles.astype(np.uint32))
    )
    return scene.compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()


def spread(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Random points of a surface, (20000, 3)."""
    rng = np.random.default_rng(3)
    p = vertices[triangles]
    area = trimesh.triangles.area(p)
    face = rng.choice(len(p), 20_000, p=area / area.sum())
    a, b = np.sort(rng.random((2, len(face), 1)), axis=0)
    return a * p[face, 0] + (b - a) * p[face, 1] + (1 - b) * p[face, 2]


def test_finest_tiles_are_the_surface_once(survey: Path, tiles: list[Tile]):
    read = welded(survey / "mesh")
    leaves = [tile for tile in tiles if tile.level == 0]
    areas = (trimesh.Trimesh(t.enu, t.triangles, process=False).area for t in leaves)
    assert sum(areas) == pytest.approx(read.get_surface_area(), rel=0.01)

    def miss(v: np.ndarray) -> float:
        return float(np.sqrt(np.mean((v[:, 2] + OFFSET[2] + bump(v[:, 1], v[:, 0])) ** 2)))

    untiled = miss(spread(np.asarray(read.vertices), np.asarray(read.triangles)))
    assert miss(spread(*whole(tiles, 0))) <= 1.02 * untiled


def test_borders_are_closed_on_every_level(tiles: list[Tile]):
    before = 10**9
    for level in range(tiles[0].level + 1):
        vertices, triangles = whole(tiles, level)
        edges, edge = edges_of(triangles)
        count = np.bincount(edge)
        assert count.max() == 2
        assert len(vertices) - len(edges) + len(triangles) == 0  # a disk with one hole
        assert len(triangles) < 0.7 * before
        before = len(triangles)


def test_boxes_and_errors_of_tiles_hold_what_is_below(tiles: list[Tile]):
    for tile in tiles:
        assert (tile.enu >= tile.low - 1e-6).all() and (tile.enu <= tile.high + 1e-6).all()
        if tile.parent is not None:
            assert tile.parent.error > tile.error
            assert (tile.low >= tile.parent.low - 2e-6).all()
            assert (tile.high <= tile.parent.high + 2e-6).all()


def test_distance_bounds_that_from_the_finest_cells(levels: list[CellLevel], tiles: list[Tile]):
    fine = levels[0].whole()
    for number, level in enumerate(levels[1:], 1):
        farthest = []
        for key, cell in level.cells.items():
            mesh = cell.mesh()
            away = distances(spread(mesh.vertices, mesh.triangles), fine.vertices, fine.triangles)
            assert away.max() <= cell.distance < 20 * level.error, key
            farthest.append(away.max())
        assert max(farthest) > 0.1 * level.error  # where it is flat nothing moves
        worst, mesh = max(cell.distance for cell in level.cells.values()), level.whole()
        back = distances(spread(fine.vertices, fine.triangles), mesh.vertices, mesh.triangles)
        assert back.max() <= worst
        assert all(tile.error >= worst for tile in tiles if tile.level == number)


def test_texture_shows_the_coordinates_of_the_surface_on_every_level(tiles: list[Tile]):
    for level in range(tiles[0].level + 1):
        found = []
        for tile in (tile for tile in tiles if tile.level == level):
            assert max(tile.page.shape[:2]) <= PAGE_PX
            at = (tile.uv * tile.page.shape[1::-1] - 0.5).astype(np.float32)
            shown = cv2.remap(tile.page, at[:, :1], at[:, 1:], cv2.INTER_LINEAR)[:, 0]
            true = position_code(tile.enu[:, 1].astype(float), tile.enu[:, 0].astype(float))
            found.append(np.abs(shown - true).max(axis=1))
        miss = np.concatenate(found)
        # 2 levels a millimetre; a texel of level 0 is 4.7 mm
        assert np.median(miss) < 6 * 2**level and np.percentile(miss, 90) < 25 * 2**level


def test_colours_agree_where_tiles_meet(tiles: list[Tile]):
    steps = []
    for a, b in combinations([tile for tile in tiles if tile.level == 0], 2):
        known = {tuple(v): n for n, v in enumerate(a.enu.tolist())}
        for n, v in enumerate(b.enu.tolist()):
            if (m := known.get(tuple(v))) is not None:
                colours = []
                for tile, k in ((a, m), (b, n)):
                    at = (tile.uv[k] * tile.page.shape[1::-1] - 0.5).astype(np.float32)
                    colours.append(cv2.getRectSubPix(tile.page, (1, 1), at.tolist())[0, 0])
                steps.append(np.abs(np.subtract(*np.array(colours, float))).max())
    assert len(steps) > 100
    assert np.median(steps) < 6 and np.percentile(steps, 90) < 25  # 2 levels a millimetre


def test_root_is_where_pyproj_puts_it(survey: Path, tiles: list[Tile]):
    root = json.loads((survey / "mesh" / "tiles" / "tileset.json").read_text())["root"]
    matrix = np.array(root["transform"]).reshape(4, 4).T
    v = tiles[0].enu.astype(np.float64)
    placed = v @ matrix[:3, :3].T + matrix[:3, 3]
    enu = v + OFFSET
    chain = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 "
        f"+lat_0={DATUM.latitude_deg} +lon_0={DATUM.longitude_deg} +h_0={DATUM.height_m}"
    )
    np.testing.assert_allclose(placed, np.stack(chain.transform(*enu.T), axis=1), atol=1e-6)


def test_a_survey_smaller_than_a_stray_is_meshed(tmp_path: Path):
    east, north = (a.ravel() for a in np.mgrid[0:12, 0:12] * STEP_M)
    write_points(tmp_path / "cloud.ply", east, north, np.zeros((2, len(east))))
    mesh, _ = surface.mesh_cloud(
        open_cloud(tmp_path / "cloud.ply"), STEP_M, ERROR_M, tmp_path, SERIAL
    )

    area = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False).area
    assert 9**2 < area / STEP_M**2 < 15**2
    assert np.abs(mesh.vertices[:, 2]).max() < ERROR_M


def test_cells_are_the_same_bytes_with_two_workers(survey: Path, levels: list[CellLevel]):
    cloud, again = open_cloud(survey / "dense" / "cloud.ply"), survey / "again"
    with local_executor(2).start() as two:
        made = [finest_level(cloud, STEP_M, ERROR_M, again, two)]
        made.append(coarser_level(made, STEP_M, again, two))
    for level, other in zip(levels, made, strict=False):
        assert len(level.cells) == len(other.cells) > 4
        for key, cell in level.cells.items():
            assert cell.path.read_bytes() == other.cells[key].path.read_bytes()


def test_memory_of_a_pass_is_that_of_a_cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(surface, "_TILE_STEPS", (12, 12))
    peaks = []
    for length_m in (1.2, 4.8):
        folder = tmp_path / str(length_m)
        folder.mkdir()
        write_ripples(folder / "cloud.ply", length_m)
        levels = [finest_level(open_cloud(folder / "cloud.ply"), STEP_M, ERROR_M, folder, SERIAL)]
        tracemalloc.start()
        levels.append(coarser_level(levels, STEP_M, folder, SERIAL))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert len(levels[1].cells) > 7
    assert 0.7 * peaks[0] < peaks[1] < 2.0 * peaks[0]  # of an area four times as large


def write_ripples(path: Path, length_m: float) -> None:
    """A cloud of waves, so long and as wide as two of the finest tiles."""
    north, east = (a.ravel() for a in np.mgrid[0:length_m:STEP_M, 0:0.5:STEP_M])
    phase = 2 * np.pi * north / 0.15
    wave = 0.01 * np.array([np.sin(phase), 2 * np.pi / 0.15 * np.cos(phase)])
    write_points(path, east, north, wave)


def write_points(path: Path, east: np.ndarray, north: np.ndarray, wave: np.ndarray) -> None:
    """A cloud whose height and slope to the north are the two rows of a wave."""
    points = np.zeros(len(north), VERTEX)
    points["x"], points["y"], points["z"], points["sigma"] = east, north, wave[0], 1e-3
    points["ny"], points["nz"] = np.array([-wave[1], np.ones(len(north))]) / np.hypot(wave[1], 1)
    write_cloud(path, [points], OFFSET, FRAME)
