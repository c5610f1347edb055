"""The mesh of a survey of any size as 3D Tiles 1.1: `mesh/tiles/tileset.json`.

The cells of each level of `reconstruct.mesh.cells` are tiles. The finest have the full detail and
are painted from the pictures, some at once with what is around them, so that colours are levelled
across their borders. Coarser ones have four times the area, twice the error and twice the texel,
and take their texture from the tiles that they stand for, where these come closest.

`geometricError` is the largest distance between the surfaces of a tile and of the full detail, as
measured between the vertices of each and the other's faces from level to level and added up, and at
least 16 texels of the tile: viewers refine by default what errs by 16 pixels of the screen, at
which a texel is one of them. It is 0 for the finest tiles.

Coordinates are east, north and up from the offset of `mesh.json` (y up inside of the GLB files, as
glTF has it); the root's transform takes them to EPSG:4978 where the survey has a datum.

Specification: OGC 22-025r4, https://docs.ogc.org/cs/22-025r4/22-025r4.html.
"""

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import write_json
from alice_survey.core.executor import SERIAL, Executor
from alice_survey.core.frames import Array
from reconstruct.light.solve import LightModel
from reconstruct.mesh.atlas import Wedges, make_pages, make_wedges
from reconstruct.mesh.cells import Cell, CellLevel, Key, join, number_vertices
from reconstruct.mesh.formats import write_glb
from reconstruct.mesh.texture import (
    MeshSetup,
    Textured,
    make_texture,
    nearest_covered,
    remap,
    spread_corners,
    wedge_pixels,
    write_jpeg,
)
from reconstruct.mesh.visibility import (
    CANDIDATES,
    blocks_near,
    choose_axes,
    make_charts,
    ray_scene,
    to_world,
)
from reconstruct.pictures.undistorted import read_colour
from reconstruct.views.model import View, WorldFrame

REGION_LEVEL = 2
"""The finest tiles below a cell of this level are painted at once."""
_RING = 0.5
"""Sides of a finest tile around them whose colours are levelled with theirs."""
_FAR = 4.0
"""Views so many times as far as those nearest are too coarse to paint."""
_HIDING_REGIONS = 4
"""What hides tiles from views is looked for so many regions away, near ones in full detail."""
_TEXELS = 16.0
_LEVELS_OF_A_FILE = 4
"""Levels of tiles that one JSON file describes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TileSetup:
    """What all tiles share."""

    mesh: MeshSetup
    """Of the survey; its pixel is the side of a texel of the finest tiles."""
    folder: Path
    """Of the tiles."""
    scratch: Path

    def skin(self, level: int, key: Key) -> Path:
        """File of the texture coordinates of a tile; its picture is next to it."""
        return self.scratch / f"{level}_{key[0]}_{key[1]}.npz"

    def glb(self, level: int, key: Key) -> Path:
        """File of a tile."""
        return self.folder / str(level) / f"{key[0]}_{key[1]}.glb"


@dataclass(frozen=True, kw_only=True, eq=False)
class RegionTask:
    """Finest tiles to paint at once."""

    number: Key
    tiles: dict[Key, Cell]
    """First the tiles to paint, then those around them."""
    count: int
    """How many to paint."""
    box: tuple[float, float, float, float]
    """West, south, east and north of the tiles to paint, with the ring."""
    occluders: tuple[Cell, ...]
    """Cells that hide tiles from views, besides the tiles."""
    views: tuple[View, ...]
    light: LightModel
    """Of these views."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BakeTask:
    """A tile to paint with what it stands for."""

    level: int
    key: Key
    cell: Cell
    children: tuple[Key, ...]
    """Tiles of the level before, in the tile and around it."""


def write_tiles(
    setup: TileSetup,
    levels: Sequence[CellLevel],
    frame: WorldFrame,
    views: Sequence[View],
    light: LightModel,
    executor: Executor,
) -> int:
    """Paint and write all tiles, and the tree of them.

    Args:
        setup: of the tiles.
        levels: finest first; the last has one cell.
        frame: of the survey.
        views: of the survey.
        light: of the survey.
        executor: where tasks run.

    Returns:
        How many tiles there are.
    """
    setup.scratch.mkdir(parents=True)
    for level in range(len(levels)):
        (setup.folder / str(level)).mkdir(parents=True)
    tasks = region_tasks(setup, levels, views, light)
    for _ in executor.map(partial(paint_region, setup), tasks, label="texture tiles"):
        pass
    for number in range(1, len(levels)):
        finer = levels[number - 1].cells
        bakes = [
            BakeTask(
                level=number,
                key=key,
                cell=cell,
                children=tuple(near for near in _around(key, 1, 2) if near in finer),
            )
            for key, cell in levels[number].cells.items()
        ]
        for _ in executor.map(partial(bake_tile, setup), bakes, label="coarser tiles"):
            pass
    _write_tree(setup, levels, frame)
    return sum(len(level.cells) for level in levels)


def _around(key: Key, ring: int, ratio: int = 1) -> list[Key]:
    """Cells in a cell of `ratio` times their side, and in a ring around it."""
    (x, y), reach = key, range(-ring, ratio + ring)
    return [(ratio * x + i, ratio * y + j) for j in reach for i in reach]


def region_tasks(
    setup: TileSetup, levels: Sequence[CellLevel], views: Sequence[View], light: LightModel
) -> Iterator[RegionTask]:
    """Regions, each with the views that may see it, one by one as they are asked for."""
    fine, coarse = levels[0], levels[min(REGION_LEVEL, len(levels) - 1)]
    ratio = round(coarse.side / fine.side)
    eyes = np.array([view.world_from_cam.translation for view in views]).reshape(-1, 3)
    regions: dict[Key, list[Key]] = {}
    for x, y in sorted(fine.cells):
        regions.setdefault((x // ratio, y // ratio), []).append((x, y))
    for number, mine in regions.items():
        tiles = {key: fine.cells[key] for key in mine}
        low = np.min([tile.low for tile in tiles.values()], axis=0)
        high = np.max([tile.high for tile in tiles.values()], axis=0)
        middle, radius = 0.5 * (low + high), np.array([0.5 * np.linalg.norm(high - low)])
        away = np.linalg.norm(eyes - to_world(middle, setup.mesh.offset), axis=1)
        reach = _FAR * (float(np.sort(away)[:CANDIDATES].max(initial=0.0)) + float(radius[0]))
        seeing = tuple(
            views[n]
            for n in np.flatnonzero(away <= reach).tolist()
            if len(blocks_near(views[n], (middle[None], radius), setup.mesh.offset))
        )
        ring = [key for key in _around(number, 1, ratio) if key in fine.cells and key not in tiles]
        near = {key for cell in _around(number, 1) for key in _around(cell, 0, ratio)}
        hiding = [fine.cells[key] for key in sorted(near & fine.cells.keys())
                  if key not in tiles and key not in ring]  # fmt: skip
        far = set(_around(number, _HIDING_REGIONS)) - set(_around(number, 1))
        hiding += [coarse.cells[key] for key in sorted(far & coarse.cells.keys())]
        names = {view.image for view in seeing}
        corner = np.array(fine.origin) + np.array(number) * coarse.side
        margin = _RING * fine.side
        yield RegionTask(
            number=number,
            tiles={**tiles, **{key: fine.cells[key] for key in ring}},
            count=len(tiles),
            box=(*(corner - margin).tolist(), *(corner + coarse.side + margin).tolist()),
            occluders=tuple(_between(hiding, low, high, seeing, setup.mesh.offset)),
            views=seeing,
            light=replace(light, gains={n: g for n, g in light.gains.items() if n in names}),
        )


def _between(
    cells: Sequence[Cell], low: Array, high: Array, views: Sequence[View], offset: Array
) -> list[Cell]:
    """The cells in the rectangle around a box and the views that may see it."""
    eyes = np.array([view.world_from_cam.translation for view in views]).reshape(-1, 3)
    eyes = eyes[:, [1, 0, 2]] * [1.0, 1.0, -1.0] - offset
    low, high = np.min([low, *eyes], axis=0), np.max([high, *eyes], axis=0)
    return [
        cell for cell in cells
        if (np.array(cell.low) < high)[:2].all() and (np.array(cell.high) > low)[:2].all()
    ]  # fmt: skip


def paint_region(setup: TileSetup, task: RegionTask) -> None:
    """Paint and write finest tiles.

    Args:
        setup: of the tiles.
        task: the tiles, and what is needed around them.
    """
    parts = [cell.mesh() for cell in task.tiles.values()]
    whole = join(parts)
    tile = np.repeat(np.arange(len(parts)), [len(part.triangles) for part in parts])
    middle = whole.vertices[whole.triangles, :2].mean(axis=1)
    west, south, east, north = task.box
    near = ((middle > [west, south]) & (middle < [east, north])).all(axis=1)
    kept = (tile < task.count) | near
    tile = np.where(tile < task.count, tile, -1)[kept].astype(np.int32)
    used, flat = np.unique(whole.triangles[kept], return_inverse=True)
    beyond = [
        replace(whole, triangles=whole.triangles[~kept]),
        *(cell.mesh() for cell in task.occluders),
    ]
    folder = setup.scratch / f"region_{task.number[0]}_{task.number[1]}"
    folder.mkdir()
    textured = make_texture(
        setup.mesh,
        folder,
        whole.vertices[used],
        flat.reshape(-1, 3).astype(np.int32),
        task.views,
        task.light,
        SERIAL,
        tile,
        occluder_vertices=np.concatenate([part.vertices for part in beyond]),
        occluder_triangles=number_vertices(beyond, [part.triangles for part in beyond]),
    )
    for number, key in enumerate(list(task.tiles)[: task.count]):
        _write_tile(setup, 0, key, _of_page(textured, number))
    shutil.rmtree(folder)


def _of_page(mesh: Textured, number: int) -> Textured:
    """The part of a mesh that has its texture on one page."""
    used, flat = np.unique(mesh.wedges.triangles[mesh.page == number], return_inverse=True)
    kept, vertex = np.unique(mesh.wedges.vertex[used], return_inverse=True)
    return replace(
        mesh,
        vertices=mesh.vertices[kept],
        wedges=Wedges(
            vertex=vertex.reshape(-1).astype(np.int64),
            chart=mesh.wedges.chart[used],
            triangles=flat.reshape(-1, 3).astype(np.int32),
        ),
        uv=mesh.uv[used],
        page=np.zeros(len(flat.reshape(-1, 3)), np.int32),
        pages=(mesh.pages[number],),
        label=mesh.label[mesh.page == number],
    )


def _write_tile(setup: TileSetup, level: int, key: Key, mesh: Textured) -> None:
    """Write a tile, and what the next level takes its texture from."""
    write_glb(setup.glb(level, key), mesh, {})
    skin = setup.skin(level, key)
    np.savez(
        skin,
        vertices=mesh.vertices,
        triangles=mesh.wedges.vertex[mesh.wedges.triangles].astype(np.int32),
        uv=mesh.uv[mesh.wedges.triangles],
    )
    shutil.move(mesh.pages[0], skin.with_suffix(".jpg"))


def bake_tile(setup: TileSetup, task: BakeTask) -> None:
    """Paint and write a coarser tile: each texel is what the finer tiles show next to it.

    Args:
        setup: of the tiles.
        task: the tile.
    """
    mesh = task.cell.mesh()
    texel = setup.mesh.pixel * 2.0**task.level
    label = choose_axes(mesh.vertices, mesh.triangles)
    charts = make_charts(mesh.vertices, mesh.triangles, label)
    wedges = make_wedges(mesh.triangles, charts)
    pixels = wedge_pixels(mesh.vertices, wedges, charts, (), setup.mesh.offset, texel)
    page = np.zeros(len(charts.views), np.int32)
    atlas = make_pages(pixels, wedges, page, len(page))
    (width, height), on_page = atlas.sizes[0], atlas.place(pixels, wedges.chart)
    middle = mesh.vertices.mean(axis=0)
    local = (mesh.vertices - middle)[wedges.vertex].astype(np.float32)
    places, covered = spread_corners(on_page, wedges.triangles, local, (height, width))
    picture = np.zeros((height, width, 3), np.uint8)
    skins = [setup.skin(task.level - 1, key) for key in task.children]
    picture[covered] = _colours_next_to(places[covered], middle, skins)
    picture = picture[nearest_covered(covered)]
    path = setup.scratch / f"page_{task.level}_{task.key[0]}_{task.key[1]}.jpg"
    write_jpeg(path, picture)
    textured = Textured(
        vertices=mesh.vertices,
        wedges=wedges,
        uv=atlas.uv(on_page, wedges.chart),
        page=np.zeros(len(mesh.triangles), np.int32),
        pages=(path,),
        label=label,
        scale=atlas.scale,
    )
    _write_tile(setup, task.level, task.key, textured)


def _colours_next_to(
    points: NDArray[np.float32], middle: Array, skins: Sequence[Path]
) -> NDArray[np.uint8]:
    """Colours (N, 3), BGR, of textured tiles at half their resolution where points come closest.

    Args:
        points: (N, 3) from the middle.
        middle: (3,) in the coordinates of the tiles.
        skins: of the tiles.
    """
    import open3d as o3d

    parts, uv, pages = [], [], []
    for skin in skins:
        with np.load(skin) as data:
            parts.append((data["vertices"] - middle, data["triangles"]))
            uv.append(data["uv"])
        page = read_colour(skin.with_suffix(".jpg"))
        pages.append(cv2.resize(page, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    found = ray_scene(*parts).compute_closest_points(o3d.core.Tensor(points), 1)
    owner = found["geometry_ids"].numpy()
    face = found["primitive_ids"].numpy().astype(np.int64)
    share = found["primitive_uvs"].numpy().astype(np.float64)
    weights = np.column_stack([1.0 - share.sum(axis=1), share])
    colours = np.empty((len(points), 3), np.uint8)
    for number, page in enumerate(pages):
        mine = owner == number
        at = (uv[number][face[mine]] * weights[mine][..., None]).sum(axis=1)
        size = page.shape[1::-1]
        pixels = np.column_stack([at[:, 0], 1.0 - at[:, 1]]) * size
        colours[mine] = remap(page, pixels, cv2.INTER_LINEAR, cv2.BORDER_REPLICATE)
    return colours


def _write_tree(setup: TileSetup, levels: Sequence[CellLevel], frame: WorldFrame) -> None:
    """Write `tileset.json`, and a file like it for every so many levels below."""
    present = [set(level.cells) for level in levels]
    for finer, keys in pairwise(present):
        keys |= {(x // 2, y // 2) for x, y in finer}

    def node(level: int, key: Key) -> tuple[dict[str, Any], Array, Array]:
        cell = levels[level].cells.get(key)
        finer = present[level - 1] if level else set()
        nodes = [node(level - 1, child) for child in _around(key, 0, 2) if child in finer]
        own = [] if cell is None else [(np.array(cell.low), np.array(cell.high))]
        low = np.min([*(n[1] for n in nodes), *(box[0] for box in own)], axis=0)
        high = np.max([*(n[2] for n in nodes), *(box[1] for box in own)], axis=0)
        error = max((n[0]["geometricError"] for n in nodes), default=0.0)
        if level:
            distance = 0.0 if cell is None else cell.distance
            error = max(error, distance, _TEXELS * setup.mesh.pixel * 2.0**level)
        tile: dict[str, Any] = {"boundingVolume": _box(low, high), "geometricError": error}
        if cell is not None:
            tile["content"] = {"uri": f"{level}/{key[0]}_{key[1]}.glb"}
        if nodes:
            tile["refine"] = "REPLACE"
            tile["children"] = [n[0] for n in nodes]
        if level % _LEVELS_OF_A_FILE == 0 and 0 < level < len(levels) - 1:
            name = f"tileset_{level}_{key[0]}_{key[1]}.json"
            _write_tileset(setup.folder / name, tile, error)
            tile = {**tile, "content": {"uri": name}}
            tile.pop("children")
        return tile, low, high

    (top,) = present[-1]
    root, low, high = node(len(levels) - 1, top)
    if frame.datum is not None and frame.name == "ned" and frame.scaled:
        corners = to_world(np.vstack([np.eye(3), np.zeros((1, 3))]), setup.mesh.offset)
        ecef = frame.datum.ecef_from_ned(corners)
        axes = np.vstack([ecef[:3] - ecef[3], ecef[3:]])
        root["transform"] = np.column_stack([axes, [0.0, 0.0, 0.0, 1.0]]).ravel().tolist()
    _write_tileset(setup.folder / "tileset.json", root, float(np.linalg.norm(high - low)))


def _write_tileset(path: Path, root: dict[str, Any], error: float) -> None:
    root = {**root, "refine": "REPLACE"}
    write_json(path, {"asset": {"version": "1.1"}, "geometricError": error, "root": root})


def _box(low: Array, high: Array) -> dict[str, list[float]]:
    half = np.maximum(0.5 * (high - low), 1e-6)
    return {"box": [*(0.5 * (low + high)).tolist(), *np.diag(half).ravel().tolist()]}
