"""What stands off the heights of a plane and hides them: piles, walls, hulls, ladders.

A DEM has one height to a cell and leaves out where a wall stands. The cloud has all of the surface:
its points off the heights around are what a view meets first, where it does not see the heights
themselves. They are kept part by part of the cloud, so that a view reads those it may see.
"""

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.windows import Window
from scipy.ndimage import maximum_filter, minimum_filter

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.compiled import compiled
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array
from alice_survey.core.records import CloudRecord
from reconstruct.mosaic.grid import Float32
from reconstruct.planes import Plane
from reconstruct.ply import read_header
from reconstruct.raster import opened_raster, small_cache
from reconstruct.views.model import View

_PART = 65_536
"""Points of the cloud, which lie together, to a part."""
_BLOCK_CELLS = 1024
"""Side of the parts of a DEM that are held at once, wherever a part of the cloud lies."""
_AROUND_CELLS = 2
"""Cells on each side of a point whose heights count as those around it."""
_OFF_CELLS = 3.0
"""Distance above or below all heights around a point, in cells, from which it is off them."""
_HIDES_SPACINGS = 4.0
"""Distance before a cell, in spacings of points, from which a point hides it."""
_SHRINK = 2
"""Pixels of a picture to one of those in which occluders are drawn."""
_COVER = 0.75
"""Half the side of the square that a point covers, in spacings of points."""
_MARGIN = 1.1
"""Reach of a frame over its own, for what a port bends."""
_TASK_MIB = 100


@dataclass(frozen=True, kw_only=True, eq=False)
class Occluders:
    """Points off the heights of a plane, in parts that stay on disk."""

    folder: Path
    numbers: NDArray[np.int64]
    """(C,) of the parts."""
    centres: Array
    """(C, 3) of spheres around them, in the plane's frame."""
    radii: Array
    """(C,)."""
    spacing: float
    """Of points."""

    def seen_by(self, view: View) -> Float32:
        """(N, 3) points of the parts that may reach into a view's frame, in the plane's frame."""
        middle = view.world_from_cam.inv().apply(self.centres)
        low, high = view.pinhole.slopes(np.array([(0, 0), view.pinhole.size_px]))
        slope = _MARGIN * float(np.hypot(*np.maximum(-low, high)))
        away = np.hypot(middle[:, 0], middle[:, 1]) - slope * middle[:, 2]
        near = (away < self.radii * math.hypot(1.0, slope)) & (middle[:, 2] > -self.radii)
        parts = [np.load(_part_path(self.folder, number)) for number in self.numbers[near]]
        return np.concatenate([np.empty((0, 3), np.float32), *parts])


def find_occluders(
    dense: Path, plane: Plane, dem: Path, folder: Path, executor: Executor, label: str
) -> None:
    """Write the points of a surface that are off the heights of a plane.

    Args:
        dense: folder of the cloud.
        plane: whose heights.
        dem: they.
        folder: to write to.
        executor: where tasks run.
        label: of its progress.

    Raises:
        WorkspaceError: the cloud is missing or damaged.
    """
    folder.mkdir()
    record = CloudRecord.read(dense / "cloud.json")
    header = read_header(dense / "cloud.ply")
    parts = range(-(-header.count // _PART))
    find = partial(_off_heights, dense / "cloud.ply", plane, dem, folder)
    found = executor.map(find, parts, label=label, task_mib=_TASK_MIB)
    kept = [(number, *sphere) for number, sphere in enumerate(found) if sphere is not None]
    with atomic_path(folder / "index.npz") as temporary, temporary.open("wb") as file:
        np.savez(
            file,
            numbers=np.array([number for number, *_ in kept], np.int64),
            centres=np.array([centre for _, centre, _ in kept]).reshape(-1, 3),
            radii=np.array([radius for *_, radius in kept]),
            spacing=np.array(record.thinned_to),
        )


def read_occluders(folder: Path) -> Occluders:
    """What `find_occluders` wrote."""
    with np.load(folder / "index.npz") as index:
        return Occluders(
            folder=folder,
            numbers=index["numbers"],
            centres=index["centres"],
            radii=index["radii"],
            spacing=float(index["spacing"]),
        )


@small_cache()
def _off_heights(
    cloud: Path, plane: Plane, dem: Path, folder: Path, number: int
) -> tuple[Array, float] | None:
    """Write a part's points off the heights; a sphere around them, None where there are none."""
    header = read_header(cloud)
    rows = header.rows()[number * _PART : (number + 1) * _PART]
    east, north, up = (rows[axis] + header.offset[n] for n, axis in enumerate("xyz"))
    points = plane.plane_from_world.apply(np.column_stack([north, east, -up]).astype(np.float64))
    off = points[_are_off(points, dem)]
    if not len(off):
        return None
    np.save(_part_path(folder, number), off.astype(np.float32))
    centre = 0.5 * (off.min(axis=0) + off.max(axis=0))
    return centre, float(np.linalg.norm(off - centre, axis=1).max())


def _are_off(points: Array, dem: Path) -> NDArray[np.bool_]:
    """(N,) whether points (N, 3), north, east, down, are off all heights around them."""
    off = np.zeros(len(points), np.bool_)
    with opened_raster(dem) as raster:
        t = raster.transform
        column = np.floor((points[:, 1] - t.c) / t.a).astype(np.int64)
        row = np.floor((t.f - points[:, 0]) / t.a).astype(np.int64)
        blocks = np.stack([row, column], axis=1) // _BLOCK_CELLS
        _, block = np.unique(blocks, axis=0, return_inverse=True)
        for n in range(block.max(initial=-1) + 1):
            here = block.reshape(-1) == n
            off[here] = _off_in_block(points[here, 2], row[here], column[here], raster)
    return off


def _off_in_block(
    down: Array, row: NDArray[np.int64], column: NDArray[np.int64], raster: Any
) -> NDArray[np.bool_]:
    """(N,) whether points are off all heights around them, of those in a part of a DEM.

    Args:
        down: (N,) of the points.
        row: (N,) of their cells.
        column: (N,) of their cells.
        raster: the DEM.
    """
    left, top = column.min() - _AROUND_CELLS, row.min() - _AROUND_CELLS
    size = column.max() - left + _AROUND_CELLS + 1, row.max() - top + _AROUND_CELLS + 1
    window = Window(int(left), int(top), int(size[0]), int(size[1]))
    heights = raster.read(1, window=window, boundless=True, fill_value=np.nan)
    known = np.isfinite(heights)
    side = 2 * _AROUND_CELLS + 1
    highest = maximum_filter(np.where(known, heights, -np.inf), side)[row - top, column - left]
    lowest = minimum_filter(np.where(known, heights, np.inf), side)[row - top, column - left]
    up, limit = -down, _OFF_CELLS * raster.transform.a
    off: NDArray[np.bool_] = (up > highest + limit) | (up < lowest - limit)
    return off


def hidden_by(occluders: Occluders, view: View, points: Array) -> NDArray[np.bool_]:
    """(N,) whether occluders hide points (N, 3) of the plane's frame from a view."""
    standing = occluders.seen_by(view).astype(np.float64)
    hidden = np.zeros(len(points), np.bool_)
    if not len(standing) or not len(points):
        return hidden
    width, height = view.pinhole.size_px
    low, high = view.pinhole.slopes(np.array([(0, 0), (width, height)]))
    focal_px = width / float(high[0] - low[0])
    depth = view.world_from_cam.inv().apply(standing)[:, 2]
    drawn = _drawn(
        view.project(standing) / _SHRINK,
        depth,
        _COVER * occluders.spacing * focal_px / _SHRINK,
        (-(-height // _SHRINK), -(-width // _SHRINK)),
    )
    pixels = np.nan_to_num(view.project(points) / _SHRINK, nan=-1.0)
    column, row = np.floor(pixels).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (row < drawn.shape[0]) & (column < drawn.shape[1])
    own = view.world_from_cam.inv().apply(points[inside])[:, 2]
    nearest = drawn[row[inside], column[inside]]
    hidden[inside] = nearest < own - _HIDES_SPACINGS * occluders.spacing
    return hidden


@compiled
def _drawn(pixels: Array, depth: Array, cover: float, shape: tuple[int, int]) -> Float32:
    """(H, W) depth of the nearest point at each pixel, infinite where there is none.

    Args:
        pixels: (N, 2) columns and rows; NaN where not seen.
        depth: (N,).
        cover: half the side of a point's square at a depth of 1, px.
        shape: H and W.
    """
    drawn = np.full(shape, np.inf, np.float32)
    for n in range(len(depth)):
        x, y = pixels[n, 0], pixels[n, 1]
        if depth[n] <= 0.0 or math.isnan(x) or math.isnan(y):
            continue
        reach = cover / depth[n]
        if x + reach < 0 or y + reach < 0 or x - reach >= shape[1] or y - reach >= shape[0]:
            continue
        for row in range(max(0, math.floor(y - reach)), min(shape[0], math.floor(y + reach) + 1)):
            first, last = math.floor(x - reach), math.floor(x + reach) + 1
            for column in range(max(0, first), min(shape[1], last)):
                drawn[row, column] = min(drawn[row, column], np.float32(depth[n]))
    return drawn


def _part_path(folder: Path, number: int | np.int64) -> Path:
    return folder / f"{int(number):06d}.npy"
