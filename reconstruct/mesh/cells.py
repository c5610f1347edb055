"""Meshes of square cells of the ground, each in a file, decimated in passes that need no whole.

Every triangle is in one cell. Cells share vertices to the bit; an edge whose other triangle is in
another cell is cut, and its ends stay where they are. A pass goes over squares of 2 x 2 cells,
first shifted by one cell, whose triangles go back into four cells by their centroids, then in
place, where the four become one cell of the next level. What is a border in one is inside the
other, so that borders are decimated too, and once for both sides.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array
from reconstruct.mesh.decimate import decimate
from reconstruct.mesh.topology import Triangles, component_areas, edges_of, split_fans
from reconstruct.mesh.visibility import ray_scene

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
        np.savez(
            path,
            vertices=self.vertices,
            triangles=self.triangles,
            cut=self.cut,
            distance=self.distance,
        )
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
            return CellMesh(
                vertices=data["vertices"],
                triangles=data["triangles"],
                cut=data["cut"],
                distance=float(data["distance"]),
            )


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
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([np.empty((0, 3)), *(part.vertices for part in parts)])
    triangles = _numbered([part.triangles for part in parts], starts)
    cut = _numbered([part.cut for part in parts], starts).reshape(-1, 2)
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


def _numbered(parts: Sequence[NDArray[np.int32]], starts: NDArray[np.int64]) -> NDArray[np.int64]:
    moved = [part.astype(np.int64) + start for part, start in zip(parts, starts, strict=False)]
    return np.concatenate([np.empty((0, parts[0].shape[1]), np.int64), *moved])


def decimated(mesh: CellMesh, error: float, *, min_area: float = 0.0, maximum: int = 0) -> CellMesh:
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
    _, group, count = np.unique(
        np.sort(triangles, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    single: Triangles = triangles[count[group.reshape(-1)] == 1]
    return single


def farthest(points: Array, vertices: Array, triangles: Triangles) -> float:
    """Largest distance of points (N, 3) from a mesh."""
    import open3d as o3d

    middle = points.mean(axis=0)
    scene = ray_scene(vertices - middle, triangles)
    away = scene.compute_distance(o3d.core.Tensor((points - middle).astype(np.float32)), 1)
    return float(away.numpy().max())


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
        min_area: see `decimated`.
        maximum: see `decimated`.
        task: the square.
    """
    whole = join([cell.mesh() for cell in task.paths])
    mesh = decimated(whole, error, min_area=min_area, maximum=maximum)
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
