"""The surface through a point cloud: meshed tile by tile, welded, cleaned and decimated."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from alice_survey.base.errors import ReconstructionError
from alice_survey.base.executor import Executor, progress
from alice_survey.base.frames import Array
from reconstruct.mesh.decimate import decimate
from reconstruct.mesh.implicit import splat, zero_mesh
from reconstruct.mesh.topology import (
    Triangles,
    component_areas,
    split_fans,
    triangulated,
    without_folds,
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
_LEAST_PART_STEPS2 = 400.0
"""Parts with an area of fewer lattice squares are taken for strays."""
_MOST_WEIGHT = 4.0
"""Largest weight of a point that is better known than the median."""
_KEY_BITS = 21
_DENSE_ROUNDS = 12
_GROWTH = 1.3
"""Factor by which the error grows until the triangles are few enough."""


@dataclass(frozen=True, kw_only=True)
class SurfaceTask:
    """One tile of the lattice to mesh."""

    cloud: CloudFile
    step: float
    first: tuple[int, int]
    """Number of the tile's first cell along x and y."""
    cells: tuple[int, int]
    sigma: float
    """Sigma of a point of weight 1."""
    error: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Piece:
    """The mesh of a tile."""

    vertices: Array
    triangles: Triangles
    keys: NDArray[np.int64]
    """(V,) the same for a vertex that two tiles share."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TriangleMesh:
    """Triangles, counter-clockwise seen from the water."""

    vertices: Array
    """(V, 3) vertices in the coordinates of the cloud."""
    triangles: Triangles
    error: float
    """Error of the decimation, in the unit of the vertices."""


def mesh_cloud(
    cloud: CloudFile, step: float, error: float, most_triangles: int, executor: Executor
) -> TriangleMesh:
    """Mesh a cloud.

    Args:
        cloud: oriented points.
        step: of the lattice: the spacing of the points.
        error: that decimation may make, in the unit of the points.
        most_triangles: the error is raised until there are no more.
        executor: where tasks run.

    Raises:
        ReconstructionError: no surface is left.
    """
    tasks = surface_tasks(cloud, step, error)
    pieces = executor.map(mesh_tile, tasks, label="mesh")
    vertices, triangles = weld([p for p in pieces if len(p.triangles)])
    triangles = without_folds(vertices, triangles)
    part, area = component_areas(vertices, triangles)
    large = area[part] >= min(_LEAST_PART_STEPS2 * step * step, area.max(initial=0.0))
    vertices, triangles, _ = split_fans(vertices, triangles[large])
    if not len(triangles):
        raise ReconstructionError(
            f"{cloud.header.path}: its {cloud.header.count} points, {step:.3g} apart, lie too "
            "thinly to carry a surface; the pictures need more overlap or sharper texture"
        )
    vertices, triangles, error = _to_count(vertices, triangles, step, error, most_triangles)
    triangles = without_folds(vertices, triangles)
    vertices, triangles, _ = split_fans(vertices, triangles)
    return TriangleMesh(vertices=vertices, triangles=triangles, error=error)


def surface_tasks(cloud: CloudFile, step: float, error: float) -> list[SurfaceTask]:
    """Tiles over the bounds of a cloud, row by row."""
    low = np.floor(cloud.low / step).astype(int) - 3
    high = np.ceil(cloud.high / step).astype(int) + 3
    least, most = _TILE_STEPS
    side = int(np.clip(math.sqrt(_NODES / (high[2] - low[2])), least, most))
    sample = cloud.sample(200_000)
    names = sample.dtype.names or ()
    sigma = float(np.median(sample["sigma"])) if "sigma" in names else 1.0
    return [
        SurfaceTask(
            cloud=cloud,
            step=step,
            first=(x, y),
            cells=(min(side, int(high[0]) - x), min(side, int(high[1]) - y)),
            sigma=sigma,
            error=error,
        )
        for y in range(int(low[1]), int(high[1]), side)
        for x in range(int(low[0]), int(high[0]), side)
    ]


def mesh_tile(task: SurfaceTask) -> Piece:
    """Mesh the cells of a tile and decimate what it does not share with its neighbours."""
    from scipy.spatial import cKDTree

    nothing = Piece(
        vertices=np.empty((0, 3)),
        triangles=np.empty((0, 3), np.int32),
        keys=np.empty(0, np.int64),
    )
    step, (x, y), (nx, ny) = task.step, task.first, task.cells
    west, south = (x - _RIM_STEPS) * step, (y - _RIM_STEPS) * step
    records = task.cloud.inside(
        west, (x + nx + _RIM_STEPS) * step, south, (y + ny + _RIM_STEPS) * step
    )
    if len(records) < _NEIGHBOURS:
        return nothing
    points = np.column_stack([records[axis].astype(np.float64) for axis in "xyz"]) / step
    normals = np.column_stack([records[f"n{axis}"].astype(np.float64) for axis in "xyz"])
    weights = np.ones(len(points))
    if "sigma" in (records.dtype.names or ()):
        ratio = task.sigma / np.maximum(records["sigma"].astype(np.float64), 1e-3 * task.sigma)
        weights = np.minimum(ratio * ratio, _MOST_WEIGHT)
    sound = np.isfinite(normals).all(axis=1) & np.isfinite(weights) & (weights > 0)
    points, normals, weights = points[sound], normals[sound], weights[sound]
    if len(points) < _NEIGHBOURS:
        return nothing
    bottom = math.floor(points[:, 2].min()) - 3
    height = math.ceil(points[:, 2].max()) + 3 - bottom
    first = (x - 1, y - 1, bottom)
    values = splat(points, normals, weights, first, (nx + 2, ny + 2, height + 1))
    local, cells, quads = zero_mesh(values)
    del values
    if not len(quads):
        return nothing
    vertices = local + np.array(first)
    near = np.asarray(cKDTree(points).query(vertices, k=_NEIGHBOURS)[0])
    kept = (near[:, 0] <= TRIM_STEPS) & (near[:, -1] <= _NEIGHBOURHOOD_STEPS)
    triangles = triangulated(vertices, quads[kept[quads].all(axis=1)])
    triangles = without_folds(vertices, triangles)
    shared = (cells[:, 0] == 0) | (cells[:, 0] == nx) | (cells[:, 1] == 0) | (cells[:, 1] == ny)
    vertices, triangles, source = split_fans(vertices, triangles)
    keys = _keys(cells[source].astype(np.int64) + np.array(first), shared[source])
    fewer = decimate(vertices, triangles, shared[source], task.error / step)
    return Piece(vertices=fewer.vertices * step, triangles=fewer.triangles, keys=keys[fewer.source])


def _keys(cells: NDArray[np.int64], shared: NDArray[np.bool_]) -> NDArray[np.int64]:
    """A number for the cell of each shared vertex, -1 for others."""
    wrapped = cells & ((1 << _KEY_BITS) - 1)
    key = (wrapped[:, 0] << (2 * _KEY_BITS)) | (wrapped[:, 1] << _KEY_BITS) | wrapped[:, 2]
    return np.where(shared, key, np.int64(-1))


def weld(pieces: Sequence[Piece]) -> tuple[Array, Triangles]:
    """Join pieces at the vertices they share; the first piece's copy stays."""
    if not pieces:
        return np.empty((0, 3)), np.empty((0, 3), np.int32)
    starts = np.cumsum([0, *(len(p.vertices) for p in pieces)])
    vertices = np.concatenate([p.vertices for p in pieces])
    keys = np.concatenate([p.keys for p in pieces])
    triangles = np.concatenate(
        [p.triangles.astype(np.int64) + start for p, start in zip(pieces, starts, strict=False)]
    )
    target = np.arange(len(vertices))
    shared = np.flatnonzero(keys >= 0)
    _, first, group = np.unique(keys[shared], return_index=True, return_inverse=True)
    target[shared] = shared[first[group.reshape(-1)]]
    used = np.zeros(len(vertices), np.bool_)
    used[target[triangles]] = True
    number = np.cumsum(used) - 1
    return vertices[used], number[target[triangles]].astype(np.int32)


def _to_count(
    vertices: Array, triangles: Triangles, step: float, error: float, most: int
) -> tuple[Array, Triangles, float]:
    """Decimate across the seams of the tiles, and with a growing error until few are left.

    The whole is cut into blocks by shifted squares of the plane, each decimated by itself with
    what it shares locked, so that the memory of a round stays that of one block.
    """
    for number in range(_DENSE_ROUNDS * 8):
        shift = (0.5, 0.0)[number % 2]
        before = len(triangles)
        vertices, triangles = _decimate_blocks(vertices, triangles, step, error, shift)
        if number == 0:
            continue
        if len(triangles) <= most:
            return vertices, triangles, error
        if len(triangles) > 0.97 * before:
            error *= _GROWTH
    raise ReconstructionError(
        f"the surface keeps {len(triangles)} triangles where mesh_triangles asks for {most}: "
        "raise it"
    )


def _decimate_blocks(
    vertices: Array, triangles: Triangles, step: float, error: float, shift: float
) -> tuple[Array, Triangles]:
    side = _TILE_STEPS[1] * step
    middle = vertices[triangles].mean(axis=1)
    low = vertices.min(axis=0)
    at = np.floor((middle[:, :2] - low[:2]) / side + shift).astype(np.int64)
    block = at[:, 1] * (at[:, 0].max(initial=0) + 1) + at[:, 0]
    order = np.argsort(block, kind="stable")
    cuts = np.flatnonzero(np.diff(block[order])) + 1
    owner = np.full(len(vertices), -1, np.int64)
    owner[triangles] = block[:, None]
    locked = np.zeros(len(vertices), np.bool_)
    foreign = owner[triangles] != block[:, None]
    locked[triangles[foreign]] = True
    pieces = []
    for group in progress(np.split(order, cuts), "decimate"):
        used, flat = np.unique(triangles[group], return_inverse=True)
        held = locked[used]
        fewer = decimate(vertices[used], flat.reshape(-1, 3).astype(np.int32), held, error)
        old = used[fewer.source]
        pieces.append(
            Piece(
                vertices=fewer.vertices,
                triangles=fewer.triangles,
                keys=np.where(locked[old], old, -1),
            )
        )
    return weld(pieces)
