"""Meshes of square cells of the ground, each in a file, decimated in passes that need no whole.

Every triangle is in one cell. Cells share vertices to the bit; an edge whose other triangle is in
another cell is cut, and its ends stay where they are. A pass goes over squares of 2 x 2 cells,
first shifted by one cell, whose triangles go back into four cells by their centroids, then in
place, where the four become one cell of the next level. What is a border in one is inside the
other, so that borders are decimated too, and once for both sides.

Edges collapse where quadrics say that the surface is flat within an error: quadric error metrics
(Garland & Heckbert 1997, "Surface simplification using quadric error metrics"), with what the usual
libraries lack: vertices can be locked, so that tiles still meet after each was decimated by itself;
no collapse changes the topology (link condition, Dey et al. 1999) or turns a face over; and the
result does not depend on threads.

Edges collapse in rounds: the cheapest first, none at an end of another of its round.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from alice_survey.core.compiled import compiled
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array
from reconstruct.mesh.topology import Triangles, component_areas, count_edges, edges_of, split_fans
from reconstruct.mesh.visibility import distances_from

_MAX_ROUNDS = 60
_ENOUGH = 0.004
"""A round that removes less than this share of the vertices is the last."""
_SHARE = 0.3
"""Only this share of the edges, the cheapest, may collapse in one round."""
_RIM_WEIGHT = 3.0
"""Weight of the planes that hold the outline of a mesh, over that of its faces."""
_MIN_COSINE = 0.3
"""Least cosine between the normals of a face before and after a collapse."""
_MIN_QUALITY = 0.06
"""4 sqrt(3) area over the sum of squared sides (1 if equilateral) that a face must keep."""
_SHORTNESS = 1e-4
"""Share of an edge's squared length added to its cost: on a plane short edges go first."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Decimated:
    """A mesh with fewer triangles."""

    vertices: Array
    triangles: Triangles
    source: NDArray[np.int64]
    """(V,) number of a vertex of the mesh before; a locked vertex keeps its own."""


def decimate(
    vertices: Array, triangles: Triangles, locked: NDArray[np.bool_], error: float
) -> Decimated:
    """Collapse edges while the surface moves less than an error (root mean square).

    Args:
        vertices: (V, 3).
        triangles: (T, 3), every edge of one or two.
        locked: (V,) vertices that stay where they are.
        error: largest distance, in the unit of the vertices, of a vertex from the planes of the
            faces it stands for.
    """
    centre = vertices.mean(axis=0) if len(vertices) else np.zeros(3)
    place = vertices - centre
    faces = triangles.astype(np.int32)
    source = np.arange(len(vertices))
    fixed = locked.copy()
    quadrics = _quadrics(place, faces)
    for _ in range(_MAX_ROUNDS):
        if not len(faces):
            break
        edges, count = count_edges(faces)
        rim_edge = count == 1
        rim = np.zeros(len(place), np.bool_)
        rim[edges[rim_edge]] = True
        cost, target_place = _costs(place, quadrics, edges, rim_edge, rim, fixed)
        cheapest = int(_SHARE * len(edges))
        largest = min(np.partition(cost, cheapest)[cheapest], error * error)
        able = np.flatnonzero(cost <= largest)
        if not len(able):
            break
        rank = np.sqrt(cost[able] / (largest or 1.0)) * np.iinfo(np.uint16).max
        order = able[np.argsort(rank.astype(np.uint16), kind="stable")]
        at = faces.reshape(-1), np.arange(faces.size, dtype=np.int32) // 3
        around = csr_array((np.ones(faces.size, np.int8), at), (len(place), len(faces)))
        gone = _collapse(
            place,
            faces,
            quadrics,
            edges[order],
            target_place[order],
            rim_edge[order],
            around.indptr,
            around.indices,
        )
        faces = np.ascontiguousarray(faces[faces[:, 0] >= 0])
        used = np.zeros(len(place), np.bool_)
        used[faces] = True
        number = np.cumsum(used, dtype=np.int32) - 1
        before = len(place)
        place, quadrics, source, fixed = place[used], quadrics[used], source[used], fixed[used]
        faces = number[faces].astype(np.int32)
        if gone < _ENOUGH * before:
            break
    return Decimated(
        vertices=np.where(fixed[:, None], vertices[source], place + centre),
        triangles=faces,
        source=source,
    )


def _quadrics(vertices: Array, triangles: Triangles) -> Array:
    """(V, 11): upper triangle of the sum of weighted plane quadrics, and the weight of the faces.

    The planes of all faces around, weighted by area, and at the outline planes square to them.
    """
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    area = 0.5 * np.linalg.norm(cross, axis=1)
    normal = cross / np.maximum(2.0 * area, 1e-30)[:, None]
    rows = _plane(normal, -(normal * a).sum(axis=1)) * area[:, None]
    rows = np.column_stack([rows, area])
    edges, edge = edges_of(triangles)
    lone = (np.bincount(edge, minlength=len(edges)) == 1)[edge]
    side = np.flatnonzero(lone)
    face = side // 3
    start = triangles.reshape(-1)[side]
    end = triangles.reshape(-1)[face * 3 + (side + 1) % 3]
    along = vertices[end] - vertices[start]
    length = np.linalg.norm(along, axis=1)
    across = np.cross(along / np.maximum(length, 1e-30)[:, None], normal[face])
    rim = _plane(across, -(across * vertices[start]).sum(axis=1))
    rim = np.column_stack([rim * (_RIM_WEIGHT * length * length)[:, None], np.zeros(len(side))])
    at = np.concatenate([triangles.reshape(-1), start, end])
    values = np.concatenate([np.repeat(rows, 3, axis=0), rim, rim])
    total = [np.bincount(at, values[:, k], len(vertices)) for k in range(11)]
    return np.ascontiguousarray(np.stack(total, axis=1))


def _plane(normal: Array, offset: Array) -> Array:
    x, y, z, d = normal[:, 0], normal[:, 1], normal[:, 2], offset
    return np.stack([x * x, x * y, x * z, x * d, y * y, y * z, y * d, z * z, z * d, d * d], axis=1)


def quadric_errors(q: Array, p: Array) -> Array:
    """(N,) sums of weighted squared distances of points (3, N) from planes of quadrics (11, N)."""
    x, y, z = p
    total: Array = (
        q[0] * x * x + q[4] * y * y + q[7] * z * z + q[9]
        + 2.0 * (q[1] * x * y + q[2] * x * z + q[3] * x + q[5] * y * z + q[6] * y + q[8] * z)
    )  # fmt: skip
    return np.maximum(total, 0.0)


def best_points(q: Array) -> Array:
    """(3, N) points of least error of quadrics (11, N); NaN where the planes leave it open."""
    a, b, c, g, d, e, h, f, i = q[:9]
    m0, m1, m2 = d * f - e * e, c * e - b * f, b * e - c * d
    m4, m5, m8 = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * m0 + b * m1 + c * m2
    known = determinant > 1e-3 * ((a + d + f) / 3.0) ** 3
    sums = m0 * -g + m1 * -h + m2 * -i, m1 * -g + m4 * -h + m5 * -i, m2 * -g + m5 * -h + m8 * -i
    return np.asarray(np.array(sums) / np.where(known, determinant, np.nan))


def _costs(
    place: Array,
    quadrics: Array,
    edges: NDArray[np.int64],
    rim_edge: NDArray[np.bool_],
    rim: NDArray[np.bool_],
    fixed: NDArray[np.bool_],
) -> tuple[Array, Array]:
    """Squared error of collapsing each edge (inf where it may not), and the spot to collapse to.

    An edge of which one end must stay is turned so that this end comes first.
    """
    a, b = edges.T
    keep_a, keep_b = fixed[a] | (rim[a] & ~rim[b]), fixed[b] | (rim[b] & ~rim[a])
    able = ~(keep_a & keep_b) & (rim_edge | ~(rim[a] & rim[b]))
    q, first, second = (
        np.ascontiguousarray(rows.T) for rows in (quadrics[a] + quadrics[b], place[a], place[b])
    )
    length2 = np.square(first - second).sum(axis=0)
    turned = able & keep_b
    edges[turned] = edges[turned][:, ::-1]
    middle, target = 0.5 * (first + second), best_points(q)
    near = np.square(target - middle).sum(axis=0) <= length2
    target = np.where(near, target, middle)
    target = np.where(keep_a, first, np.where(keep_b, second, target))
    cost = quadric_errors(q, target) / np.maximum(q[10], 1e-30) + _SHORTNESS * length2
    return np.where(able, cost, np.inf), np.ascontiguousarray(target.T)


@compiled
def _normal(a: Array, b: Array, c: Array, out: Array) -> float:
    """Cross product of two sides; returns its length, and twice the area."""
    u0, u1, u2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    v0, v1, v2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    out[0], out[1], out[2] = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
    return math.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])


@compiled
def _turns_or_thins(
    place: Array,
    faces: NDArray[np.int32],
    ring: NDArray[np.int32],
    moving: int,
    other: int,
    target_place: Array,
) -> bool:
    """Whether moving a vertex would turn a face of its ring over, or make a splinter of it."""
    old, new, corner = np.empty(3), np.empty(3), np.empty((3, 3))
    for i in range(ring.size):
        face = faces[ring[i]]
        if face[0] < 0 or face[0] == other or face[1] == other or face[2] == other:
            continue
        before = _normal(place[face[0]], place[face[1]], place[face[2]], old)
        for k in range(3):
            for axis in range(3):
                corner[k, axis] = target_place[axis] if face[k] == moving else place[face[k], axis]
        after = _normal(corner[0], corner[1], corner[2], new)
        dot = old[0] * new[0] + old[1] * new[1] + old[2] * new[2]
        if not dot > _MIN_COSINE * before * after:
            return True
        sides = 0.0
        for k in range(3):
            for axis in range(3):
                sides += (corner[k, axis] - corner[(k + 1) % 3, axis]) ** 2
        if not 2.0 * math.sqrt(3.0) * after > _MIN_QUALITY * sides:
            return True
    return False


@compiled
def _collapse(
    place: Array,
    faces: NDArray[np.int32],
    quadrics: Array,
    edges: NDArray[np.int64],
    target_place: Array,
    rim_edge: NDArray[np.bool_],
    starts: NDArray[np.int32],
    around: NDArray[np.int32],
) -> int:
    """Collapse edges in order, in place, no two of one vertex; returns how many.

    What is known of an edge stays true while its own ends do not change. Faces that are gone have
    -1 for their first corner.
    """
    touched = np.zeros(place.shape[0], np.bool_)
    mark = np.full(place.shape[0], -1, np.int64)
    gone = 0
    for n in range(edges.shape[0]):
        a, b = edges[n, 0], edges[n, 1]
        if touched[a] or touched[b]:
            continue
        ring_a, ring_b = around[starts[a] : starts[a + 1]], around[starts[b] : starts[b + 1]]
        for i in range(ring_a.size):
            if faces[ring_a[i], 0] < 0:
                continue
            for k in range(3):
                mark[faces[ring_a[i], k]] = n
        common = 0
        for i in range(ring_b.size):
            if faces[ring_b[i], 0] < 0:
                continue
            for k in range(3):
                vertex = faces[ring_b[i], k]
                if mark[vertex] == n and vertex != a and vertex != b:
                    common += 1
                    mark[vertex] = -1
        if common != (1 if rim_edge[n] else 2):
            continue
        if _turns_or_thins(place, faces, ring_a, a, b, target_place[n]):
            continue
        if _turns_or_thins(place, faces, ring_b, b, a, target_place[n]):
            continue
        touched[a] = touched[b] = True
        for i in range(ring_b.size):
            face = ring_b[i]
            if faces[face, 0] == a or faces[face, 1] == a or faces[face, 2] == a:
                faces[face, 0] = -1
                continue
            for k in range(3):
                if faces[face, k] == b:
                    faces[face, k] = a
        for k in range(3):
            place[a, k] = target_place[n, k]
        for k in range(11):
            quadrics[a, k] += quadrics[b, k]
        gone += 1
    return gone


MAX_CELL_TRIANGLES = 60_000
"""The error of a coarser cell grows until it has no more."""
_GROWTH = 1.3
"""Factor by which the error grows until the triangles are few enough."""
_GROWTHS = 20

Key = tuple[int, int]
"""Number of a cell along x and y."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CellMesh:
    """The mesh of a cell."""

    vertices: Array
    """(V, 3) in the coordinates of the cloud."""
    triangles: Triangles
    cut: NDArray[np.int32]
    """(E, 2) vertices at the ends of edges whose other triangle is in another cell."""
    distance: float = 0.0
    """Largest distance between its surface and the full detail."""

    def save(self, path: Path) -> "Cell":
        """Write it."""
        np.savez(path, **vars(self))
        low, high = self.vertices.min(axis=0).tolist(), self.vertices.max(axis=0).tolist()
        return Cell(
            path=path,
            triangles=len(self.triangles),
            low=tuple(low),
            high=tuple(high),
            distance=self.distance,
        )


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A cell whose mesh is in a file."""

    path: Path
    triangles: int
    low: tuple[float, ...]
    """Least x, y and z of its vertices."""
    high: tuple[float, ...]
    distance: float

    def mesh(self) -> CellMesh:
        """Read it."""
        with np.load(self.path) as data:
            return CellMesh(**{**data, "distance": float(data["distance"])})


@dataclass(frozen=True, kw_only=True, eq=False)
class CellLevel:
    """The cells of one size."""

    origin: tuple[float, float]
    """Corner of the cell (0, 0): x and y."""
    side: float
    error: float
    """Error of the decimation."""
    cells: dict[Key, Cell]

    @property
    def triangles(self) -> int:
        """How many there are in all cells."""
        return sum(cell.triangles for cell in self.cells.values())

    def whole(self) -> CellMesh:
        """All cells as one mesh."""
        return join([self.cells[key].mesh() for key in sorted(self.cells)])


def join(parts: Sequence[CellMesh]) -> CellMesh:
    """Join meshes where they were cut; the triangles are those of the parts, in order."""
    vertices = np.concatenate([np.empty((0, 3)), *(part.vertices for part in parts)])
    triangles = number_vertices(parts, [part.triangles for part in parts])
    cut = number_vertices(parts, [part.cut for part in parts]).reshape(-1, 2)
    target = np.arange(len(vertices))
    ends = np.unique(cut)
    _, first, group = np.unique(vertices[ends], axis=0, return_index=True, return_inverse=True)
    target[ends] = ends[first[group.reshape(-1)]]
    used = np.zeros(len(vertices), np.bool_)
    used[target[triangles]] = True
    number = (np.cumsum(used) - 1)[target]
    edges, sides = np.unique(np.sort(number[cut], axis=1), axis=0, return_counts=True)
    return CellMesh(
        vertices=vertices[used],
        triangles=number[triangles].astype(np.int32),
        cut=edges[sides == 1].astype(np.int32),
        distance=max((part.distance for part in parts), default=0.0),
    )


def number_vertices(
    parts: Sequence[CellMesh], corners: Sequence[NDArray[np.int32]]
) -> NDArray[np.int64]:
    """Corners of parts as numbers of vertices that follow one another, part after part."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    moved = [own.astype(np.int64) + start for own, start in zip(corners, starts, strict=False)]
    return np.concatenate(moved)


def decimate_cell(
    mesh: CellMesh, error: float, *, min_area: float = 0.0, maximum: int = 0
) -> CellMesh:
    """Decimate all but the ends of cut edges.

    Args:
        mesh: of a cell or several; its vertices may have several fans.
        error: that decimation may make.
        min_area: parts of less, which no cut edge bounds, are left out.
        maximum: the error grows until there are no more triangles; 0 for any number. The distance
            between the meshes is measured then.
    """
    if not len(mesh.triangles):
        return mesh
    vertices, triangles, source = split_fans(mesh.vertices, without_pairs(mesh.triangles))
    locked = np.isin(source, mesh.cut)
    if min_area > 0.0 and len(triangles):
        part, area = component_areas(vertices, triangles)
        kept = area >= min_area
        kept[part[locked[triangles].any(axis=1)]] = True
        vertices, triangles, again = split_fans(vertices, triangles[kept[part]])
        source, locked = source[again], locked[again]
    fewer = decimate(vertices, triangles, locked, error)
    for _ in range(_GROWTHS):
        if not maximum or len(fewer.triangles) <= maximum:
            break
        error *= _GROWTH
        fewer = decimate(vertices, triangles, locked, error)
    distance = mesh.distance
    if maximum and len(fewer.triangles):
        distance += max(
            farthest(vertices, fewer.vertices, fewer.triangles),
            farthest(fewer.vertices, vertices, triangles),
        )
    edges, edge = edges_of(fewer.triangles)
    old = np.sort(source[fewer.source][edges], axis=1)
    lone = np.bincount(edge, minlength=len(edges)) == 1
    still = lone & np.isin(_keys(old), _keys(np.sort(mesh.cut, axis=1)))
    return CellMesh(
        vertices=fewer.vertices,
        triangles=fewer.triangles,
        cut=edges[still].astype(np.int32),
        distance=distance,
    )


def without_pairs(triangles: Triangles) -> Triangles:
    """Without triangles back to back, which two cells make where both cut the same corner off."""
    low, middle, high = np.sort(triangles, axis=1).T
    order = np.lexsort((high, middle, low))
    same = (np.diff(np.stack([low, middle, high])[:, order]) == 0).all(axis=0)
    alone = np.ones(len(triangles), np.bool_)
    alone[order[1:][same]] = alone[order[:-1][same]] = False
    return np.asarray(triangles[alone])


def farthest(points: Array, vertices: Array, triangles: Triangles) -> float:
    """Largest distance of points (N, 3) from a mesh."""
    return float(distances_from(vertices, triangles, points).max())


def _keys(edges: NDArray[np.integer]) -> NDArray[np.int64]:
    return edges[:, 0].astype(np.int64) << 32 | edges[:, 1].astype(np.int64)


def part_of(mesh: CellMesh, mine: NDArray[np.bool_]) -> CellMesh:
    """The mesh of some of its triangles (T,); edges to others are cut."""
    edges, edge = edges_of(mesh.triangles)
    here = np.bincount(edge.reshape(-1, 3)[mine].reshape(-1), minlength=len(edges))
    total = np.bincount(edge, minlength=len(edges))
    known = np.isin(_keys(edges), _keys(np.sort(mesh.cut, axis=1)))
    used, flat = np.unique(mesh.triangles[mine], return_inverse=True)
    cut = edges[(here == 1) & ((total == 2) | known)]
    return CellMesh(
        vertices=mesh.vertices[used],
        triangles=flat.reshape(-1, 3).astype(np.int32),
        cut=np.searchsorted(used, cut).astype(np.int32),
        distance=mesh.distance,
    )


@dataclass(frozen=True, kw_only=True)
class SquareTask:
    """A square of 2 x 2 cells to decimate."""

    key: Key
    """Of its first cell, or of the cell that it becomes."""
    paths: tuple[Cell, ...]
    """Those of its cells that there are."""
    middle: tuple[float, float] | None
    """Where it is split into cells again; None where it becomes one."""


def decimate_square(
    folder: Path, error: float, min_area: float, maximum: int, task: SquareTask
) -> list[tuple[Key, Cell]]:
    """Decimate a square of cells and write the cells that it becomes.

    Args:
        folder: to write into.
        error: that decimation may make.
        min_area: see `decimate_cell`.
        maximum: see `decimate_cell`.
        task: the square.
    """
    whole = join([cell.mesh() for cell in task.paths])
    mesh = decimate_cell(whole, error, min_area=min_area, maximum=maximum)
    (x, y), part = task.key, np.zeros(len(mesh.triangles), np.int64)
    if task.middle is not None:
        part = mesh.vertices[mesh.triangles, :2].mean(axis=1) >= task.middle
        part = part[:, 0] + 2 * part[:, 1].astype(np.int64)
    made = []
    for number in np.unique(part).tolist():
        key = (x + number % 2, y + number // 2)
        cell = part_of(mesh, part == number)
        made.append((key, cell.save(folder / f"{key[0]}_{key[1]}.npz")))
    return made


def coarser(
    level: CellLevel,
    folder: Path,
    error: float,
    min_area: float,
    executor: Executor,
    *,
    maximum: int = MAX_CELL_TRIANGLES,
) -> CellLevel:
    """The level of cells twice as wide.

    Args:
        level: to start from.
        folder: for the files; it does not exist yet.
        error: that decimation may make.
        min_area: parts of less are left out.
        executor: where tasks run.
        maximum: triangles of a cell; 0 for any number, and the finest level.
    """
    cells = level.cells
    for shift in (1, 0):
        into = folder / ("cells", "shifted")[shift]
        into.mkdir(parents=True)
        squares: dict[Key, list[Cell]] = {}
        for key in sorted(cells):
            square = ((key[0] + shift) // 2, (key[1] + shift) // 2)
            squares.setdefault(square, []).append(cells[key])
        tasks = [
            SquareTask(
                key=(2 * x - 1, 2 * y - 1) if shift else (x, y),
                paths=tuple(mine),
                middle=(level.origin[0] + 2 * x * level.side, level.origin[1] + 2 * y * level.side)
                if shift
                else None,
            )
            for (x, y), mine in squares.items()
        ]
        work = partial(decimate_square, into, error, min_area, maximum)
        cells = dict(pair for made in executor.map(work, tasks, label="decimate") for pair in made)
    return CellLevel(origin=level.origin, side=2 * level.side, error=error, cells=cells)
