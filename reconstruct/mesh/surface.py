"""The surface through a point cloud: meshed tile by tile, joined, cleaned and decimated.

The surface is the zero of an implicit function on a lattice: the weighted mean height over the
tangent planes of the points around (implicit moving least squares, Kolluri 2008, "Provably good
moving least squares"). It depends on points within a few lattice steps only, so that tiles that
share a rim of points agree exactly where they meet, and where there are no points there is no
surface: holes stay holes. A global Poisson surface would close them, and differs from tile to tile.

The zero set is meshed by dual cells (surface nets, Gibson 1998, "Constrained elastic surface
nets"): one vertex in every lattice cell that it crosses, one quadrilateral around every lattice
edge that it crosses.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import compiled
from alice_survey.core.errors import ReconstructionError
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array
from reconstruct.mesh.cells import (
    Cell,
    CellLevel,
    CellMesh,
    coarser,
    decimate_cell,
    part_of,
    without_pairs,
)
from reconstruct.mesh.topology import (
    Triangles,
    component_areas,
    find_unfolded,
    split_fans,
    triangulate,
)
from reconstruct.ply import CloudFile

_NODES = 12_000_000
"""Nodes of a tile's lattice, which bound its memory to some 300 MB."""
_TILE_STEPS = (24, 192)
"""Fewest and most cells along the sides of a tile."""
_RIM_STEPS = 6
"""Points around a tile that its nodes and the trimming may reach."""
TRIM_STEPS = 1.5
"""The surface ends so far from the nearest point: gaps of twice this are bridged."""
_NEIGHBOURS, _NEIGHBOURHOOD_STEPS = 4, 2.5
"""A vertex needs this many points in this many steps around it."""
_MIN_PART_STEPS2 = 400.0
"""Parts with an area of fewer lattice squares are taken for strays."""
_MAX_WEIGHT = 4.0
"""Largest weight of a point that is better known than the median."""
_MAX_TRIANGLES = 4_000_000
"""Of a mesh that is held at once."""
KERNEL_STEPS = 0.8
"""Standard deviation of the points' Gaussian weight, lattice steps."""
REACH_STEPS = 2.5
"""Distance from a node at which points stop to count, lattice steps."""
_NEWTON_STEPS = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class TriangleMesh:
    """Triangles, counter-clockwise seen from the water."""

    vertices: Array
    """(V, 3) vertices in the coordinates of the cloud."""
    triangles: Triangles


def mesh_cloud(
    cloud: CloudFile, step: float, error: float, folder: Path, executor: Executor
) -> tuple[TriangleMesh, list[CellLevel]]:
    """Mesh a cloud.

    Args:
        cloud: oriented points.
        step: of the lattice: the spacing of the points.
        error: that decimation may make, in the unit of the points.
        folder: for files.
        executor: where tasks run.

    Returns:
        The mesh; and the same in cells, the first level with the error as given, and coarser ones
        down to the mesh where the first has too many triangles to be held at once.

    Raises:
        ReconstructionError: no surface is left.
    """
    levels = [finest_level(cloud, step, error, folder, executor)]
    while levels[-1].triangles > _MAX_TRIANGLES and len(levels[-1].cells) > 1:
        levels.append(coarser_level(levels, step, folder, executor))
    whole = levels[-1].whole()
    vertices = whole.vertices
    triangles = without_pairs(whole.triangles)
    triangles = triangles[find_unfolded(vertices, triangles)]
    part, area = component_areas(vertices, triangles)
    large = area[part] >= min(_MIN_PART_STEPS2 * step * step, area.max(initial=0.0))
    if not large.any():
        raise ReconstructionError(
            f"{cloud.header.path}: its {cloud.header.count} points, {step:.3g} apart, lie too "
            "thinly to carry a surface; the pictures need more overlap or sharper texture"
        )
    vertices, triangles, _ = split_fans(vertices, triangles[large])
    return TriangleMesh(vertices=vertices, triangles=triangles), levels


def finest_level(
    cloud: CloudFile, step: float, error: float, folder: Path, executor: Executor
) -> CellLevel:
    """The mesh of a cloud in cells of 2 x 2 tiles; arguments as `mesh_cloud` takes them."""
    sigma = float(np.median(cloud.sample(200_000)["sigma"]))
    tiles = surface_tiles(cloud, step)
    (x, y), (side, _) = tiles[0]
    (folder / "lattice").mkdir(parents=True)
    mesh = partial(mesh_tile, cloud, step, sigma, error, folder / "lattice")
    made = zip(tiles, executor.map(mesh, tiles, label="mesh"), strict=True)
    lattice = CellLevel(
        origin=(x * step, y * step),
        side=side * step,
        error=error,
        cells={((i - x) // side, (j - y) // side): c for ((i, j), _), c in made if c is not None},
    )
    minimum = _MIN_PART_STEPS2 * step * step
    found = coarser(lattice, folder / "0", error, minimum, executor, maximum=0)
    if not found.cells:  # a survey that is smaller than what is a stray elsewhere
        found = coarser(lattice, folder / "all", error, 0.0, executor, maximum=0)
    return found


def coarser_level(
    levels: Sequence[CellLevel], step: float, folder: Path, executor: Executor
) -> CellLevel:
    """The level after the last, with twice its error; arguments as `mesh_cloud` takes them."""
    minimum, into = _MIN_PART_STEPS2 * step * step, folder / str(len(levels))
    return coarser(levels[-1], into, 2.0 * levels[-1].error, minimum, executor)


def surface_tiles(cloud: CloudFile, step: float) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Tiles over the bounds of a cloud, row by row: first cells along x and y, and how many."""
    low = np.floor(cloud.low / step).astype(int) - 3
    high = np.ceil(cloud.high / step).astype(int) + 3
    minimum, maximum = _TILE_STEPS
    side = int(np.clip(math.sqrt(_NODES / (high[2] - low[2])), minimum, maximum))
    return [
        ((x, y), (min(side, int(high[0]) - x), min(side, int(high[1]) - y)))
        for y in range(int(low[1]), int(high[1]), side)
        for x in range(int(low[0]), int(high[0]), side)
    ]


def mesh_tile(
    cloud: CloudFile,
    step: float,
    sigma: float,
    error: float,
    folder: Path,
    tile: tuple[tuple[int, int], tuple[int, int]],
) -> Cell | None:
    """Mesh the cells of a tile and decimate what it does not share with its neighbours.

    The lattice reaches a cell beyond the tile, which shows where the surface goes on.

    Args:
        cloud: oriented points.
        step: of the lattice.
        sigma: of a point of weight 1.
        error: that decimation may make.
        folder: to write into.
        tile: number of its first cell along x and y, and how many cells it has.

    Returns:
        The mesh; None where there is none.
    """
    from scipy.spatial import cKDTree

    (x, y), (nx, ny) = tile
    west, south = (x - _RIM_STEPS) * step, (y - _RIM_STEPS) * step
    records = cloud.inside(west, (x + nx + _RIM_STEPS) * step, south, (y + ny + _RIM_STEPS) * step)
    if len(records) < _NEIGHBOURS:
        return None
    points = np.column_stack([records[axis].astype(np.float64) for axis in "xyz"]) / step
    normals = np.column_stack([records[f"n{axis}"].astype(np.float64) for axis in "xyz"])
    ratio = sigma / np.maximum(records["sigma"].astype(np.float64), 1e-3 * sigma)
    weights = np.minimum(ratio * ratio, _MAX_WEIGHT)
    sound = np.isfinite(normals).all(axis=1) & np.isfinite(weights) & (weights > 0)
    points, normals, weights = points[sound], normals[sound], weights[sound]
    if len(points) < _NEIGHBOURS:
        return None
    bottom = math.floor(points[:, 2].min()) - 3
    height = math.ceil(points[:, 2].max()) + 3 - bottom
    first = (x - 2, y - 2, bottom)
    values = splat(points, normals, weights, first, (nx + 4, ny + 4, height + 1))
    vertices, cells, quads = zero_mesh(values, first)
    del values
    if not len(quads):
        return None
    near = np.asarray(cKDTree(points).query(vertices, k=_NEIGHBOURS)[0])
    kept = (near[:, 0] <= TRIM_STEPS) & (near[:, -1] <= _NEIGHBOURHOOD_STEPS)
    quads = quads[kept[quads].all(axis=1)]
    start = cells[quads, :2].max(axis=1)  # the cell at whose edge a quadrilateral is
    own = np.repeat(((start >= 2) & (start < np.array([nx, ny]) + 2)).all(axis=1), 2)
    triangles = triangulate(vertices, quads)
    sound = find_unfolded(vertices, triangles)
    around = CellMesh(
        vertices=vertices * step, triangles=triangles[sound], cut=np.empty((0, 2), np.int32)
    )
    if not own[sound].any():
        return None
    (i, j), mesh = tile[0], decimate_cell(part_of(around, own[sound]), error)
    return mesh.save(folder / f"{i}_{j}.npz")


@compiled
def splat(
    points: Array,
    normals: Array,
    weights: Array,
    first: tuple[int, int, int],
    shape: tuple[int, int, int],
) -> NDArray[np.float64]:
    """The implicit function at the nodes of a block of the lattice.

    Args:
        points: (N, 3) in lattice steps from the lattice's origin.
        normals: (N, 3) unit vectors, out of the ground.
        weights: (N,) of the points.
        first: number of the block's first node along x, y, z.
        shape: nodes of the block.

    Returns:
        (X, Y, Z) in lattice steps, positive outside of the ground; NaN without a point in reach.
        A node's value does not depend on the block, if all points in its reach are there.
    """
    moment = np.zeros(shape)
    total = np.zeros(shape)
    for i in range(points.shape[0]):
        x0 = max(math.ceil(points[i, 0] - REACH_STEPS), first[0])
        x1 = min(math.floor(points[i, 0] + REACH_STEPS), first[0] + shape[0] - 1)
        y0 = max(math.ceil(points[i, 1] - REACH_STEPS), first[1])
        y1 = min(math.floor(points[i, 1] + REACH_STEPS), first[1] + shape[1] - 1)
        z0 = max(math.ceil(points[i, 2] - REACH_STEPS), first[2])
        z1 = min(math.floor(points[i, 2] + REACH_STEPS), first[2] + shape[2] - 1)
        for x in range(x0, x1 + 1):
            a = x - points[i, 0]
            for y in range(y0, y1 + 1):
                b = y - points[i, 1]
                for z in range(z0, z1 + 1):
                    c = z - points[i, 2]
                    square = a * a + b * b + c * c
                    if square > REACH_STEPS * REACH_STEPS:
                        continue
                    w = weights[i] * math.exp(-0.5 * square / (KERNEL_STEPS * KERNEL_STEPS))
                    over = a * normals[i, 0] + b * normals[i, 1] + c * normals[i, 2]
                    moment[x - first[0], y - first[1], z - first[2]] += w * over
                    total[x - first[0], y - first[1], z - first[2]] += w
    for x in range(shape[0]):
        for y in range(shape[1]):
            for z in range(shape[2]):
                if total[x, y, z] > 0.0:
                    moment[x, y, z] /= total[x, y, z]
                else:
                    moment[x, y, z] = np.nan
    return moment


def zero_mesh(
    values: Array, first: tuple[int, int, int]
) -> tuple[Array, NDArray[np.int32], NDArray[np.int32]]:
    """Mesh the zero of a function on a lattice.

    Quadrilaterals around edges that start in the first cells along any axis are left to the block
    before, of which those cells are the last.

    Args:
        values: (X, Y, Z) at the nodes; NaN where unknown (such a cell holds no surface).
        first: number of the block's first node along x, y, z.

    Returns:
        Vertices, (V, 3) in steps from the lattice's origin, the same to the bit in every block;
        their cells in the block, (V, 3); and
        quadrilaterals, (Q, 4), counter-clockwise seen from where the function is positive.
    """
    shape = [size - 1 for size in values.shape]
    below, crossed = np.zeros(shape, np.uint8), np.ones(shape, np.bool_)
    for corner in np.ndindex(2, 2, 2):
        part = values[tuple(slice(k, k + size) for k, size in zip(corner, shape, strict=True))]
        below += part < 0.0
        crossed &= ~np.isnan(part)
    crossed &= (below > 0) & (below < 8)
    cells = np.argwhere(crossed).astype(np.int32)
    number = np.full(shape, -1, np.int32)
    number[crossed] = np.arange(len(cells))
    quads, sound = np.empty((len(cells), 3, 4), np.int32), np.empty((len(cells), 3), np.bool_)
    for axis in range(3):  # the lattice edge from a cell's first node along the axis
        ahead = cells + np.eye(3, dtype=np.int32)[axis]
        starts, ends = values[tuple(cells.T)] < 0.0, values[tuple(ahead.T)] < 0.0
        back = np.zeros((4, 3), np.int32)
        back[[1, 2], (axis + 1) % 3] = back[[2, 3], (axis + 2) % 3] = 1
        around = number[tuple(np.moveaxis(cells[:, None] - back, 2, 0))]
        quads[:, axis] = np.where(starts[:, None], around, around[:, ::-1])
        sound[:, axis] = cells.all(axis=1) & (starts != ends) & (around >= 0).all(axis=1)
    return _place_vertices(values, cells) + (cells + np.array(first)), cells, quads[sound]


def _place_vertices(values: Array, cells: NDArray[np.int32]) -> Array:
    """The vertex of each cell: the mean crossing of its edges, moved onto the zero within the cell.

    Args:
        values: (X, Y, Z) at the nodes.
        cells: (V, 3) that the zero crosses.

    Returns:
        (V, 3) places in the cells, 0 to 1.
    """
    corner = np.empty((2, 2, 2, len(cells)))
    for at in np.ndindex(2, 2, 2):
        corner[at] = values[tuple((cells + np.array(at)).T)]
    out, crossings = np.zeros((3, len(cells))), np.zeros(len(cells))
    for axis in range(3):
        b, c = (axis + 1) % 3, (axis + 2) % 3
        for j, i in np.ndindex(2, 2):
            start, end = np.moveaxis(corner, (axis, b, c), (0, 1, 2))[:, i, j]
            crossed = (start < 0.0) != (end < 0.0)
            crossings += crossed
            out[axis] += np.divide(start, start - end, np.zeros(len(cells)), where=crossed)
            out[b] += i * crossed
            out[c] += j * crossed
    out /= crossings
    moving = np.ones(len(cells), np.bool_)
    for _ in range(_NEWTON_STEPS):
        share, f, slope = (1.0 - out, out), np.zeros(len(cells)), np.zeros_like(out)
        for at in np.ndindex(2, 2, 2):
            (p, q, r), (dp, dq, dr) = (
                (share[k][n] for n, k in enumerate(at)),
                (2 * k - 1 for k in at),
            )
            f += corner[at] * p * q * r
            slope += corner[at] * dp * q * r, corner[at] * p * dq * r, corner[at] * p * q * dr
        square = slope[0] * slope[0] + slope[1] * slope[1] + slope[2] * slope[2]
        moving &= square >= 1e-6
        step = np.divide(f * slope, square, np.zeros_like(out), where=moving)
        out = np.where(moving, np.minimum(np.maximum(out - step, 0.0), 1.0), out)
    return np.ascontiguousarray(out.T)
