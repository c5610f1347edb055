"""Clouds of any size as one COPC file: a LAZ whose chunks are the nodes of an octree.

Any reader of LAZ reads it whole; one that knows COPC reads the nodes that a view needs. A node
takes, of each cell of a grid over it, the point nearest to the middle, and leaves the others to its
children: all levels down to any one are an even thinning of the cloud, and each point is in one
node. Format: https://copc.io, version 1.0, on LAS 1.4.

Points wait on disk in cubes. A task makes all nodes inside of a cube, from its leaves up, each node
taking its points from those of its children; the few above the cubes are made where the file is
written, so that memory holds these and one cube in each worker.
"""

import io
import shutil
import struct
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.executor import SERIAL, Executor

if TYPE_CHECKING:
    import laspy

Records = NDArray[Any]
"""Points as LAS stores them, with fields X, Y, Z in steps and all others."""
Key = tuple[int, int, int]
"""Place of a cube or a node among those of its size, in x, y, z."""
Entry = tuple[int, Key, int, int]
"""A node inside of a cube: level, key, bytes and points."""
_Put = Callable[[int, Key, Records], None]
"""Writes a node: level, key and points, of which there may be none."""

_GRID_BITS = 8
"""A node's grid has 2**8 cells a side: a surface across it fills some 65,000."""
_LEAF_POINTS = 100_000
_CUBE_SPACINGS = 1024
"""Most sides of the points' own cells along a cube: a surface has a million points in one."""
_CUBE_MIB = 500.0
"""That a task takes for a cube of a million points."""
_INFO = struct.Struct("<5d2Q2d88x")
_ENTRY = struct.Struct("<4iQ2i")
_EVLR = struct.Struct("<2x16sHQ32s")
_STATES_BOUNDS = 0b110
"""Bits of an extra dimension's options."""
_TABLE_AT = struct.Struct("<q")


@dataclass(frozen=True, kw_only=True)
class SpooledPart:
    """A part of the points that waits on disk."""

    name: str
    cubes: tuple[Key, ...]
    """Those that it has points in."""


@dataclass(frozen=True, kw_only=True)
class PointSpool:
    """Points on disk, in cubes whose corners are at whole multiples of their edges."""

    folder: Path
    """For them alone."""
    bits: int
    """Edges are 2**bits steps."""
    dtype: np.dtype[Any]

    @classmethod
    def of(cls, folder: Path, header: "laspy.LasHeader", spacing: float) -> "PointSpool":
        """For points with a header, whose neighbours are `spacing` apart in its unit."""
        bits = int(np.log2(_CUBE_SPACINGS * spacing / header.scales[0]))
        dtype = header.point_format.dtype()
        return cls(folder=folder, bits=max(bits, _GRID_BITS), dtype=dtype)

    def add(self, name: str, points: Records) -> SpooledPart:
        """Keep a part of the points, which no other part has the name of."""
        cubes = np.stack([points[axis] for axis in "XYZ"], axis=1) >> self.bits
        keys, cube = np.unique(cubes, axis=0, return_inverse=True)
        found = tuple(_key(row) for row in keys)
        for n, key in enumerate(found):
            path = self._path(key, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(points[cube.reshape(-1) == n].tobytes())
        return SpooledPart(name=name, cubes=found)

    def points(self, key: Key, names: Iterable[str]) -> Records:
        """The points of a cube in parts."""
        files = [np.fromfile(self._path(key, name), self.dtype) for name in names]
        return np.concatenate(files)

    def cube_folder(self, key: Key) -> Path:
        """Where the points of a cube wait."""
        return self.folder / "{}_{}_{}".format(*key)

    def _path(self, key: Key, name: str) -> Path:
        return self.cube_folder(key) / f"{name}.points"


def write_copc(
    path: Path,
    header: "laspy.LasHeader",
    spool: PointSpool,
    parts: Iterable[SpooledPart],
    executor: Executor = SERIAL,
) -> None:
    """Write a COPC file of spooled points, one or more in all, and drop the spool.

    Args:
        path: of the file.
        header: LAS 1.4 of point format 6 to 8; counts and bounds are filled in.
        spool: with the points.
        parts: of it, whose order decides between points that are as good for a node.
        executor: makes cubes in parallel.
    """
    names: dict[Key, list[str]] = {}
    for part in parts:
        for key in part.cubes:
            names.setdefault(key, []).append(part.name)
    grid = _OctreeGrid.over(names, spool.bits)
    packing = header.point_format.id, header.point_format.num_extra_bytes
    tasks = [(key, tuple(names[key])) for key in grid.in_order(names)]
    found = executor.map(
        partial(_make_cube, spool, grid, packing),
        tasks,
        label="write the point cloud",
        task_mib=_CUBE_MIB,
    )
    with atomic_path(path) as temporary, temporary.open("w+b") as file:
        _write(file, header, _Nodes(file, header, grid, packing, names, found))
    shutil.rmtree(spool.folder)


_Packing = tuple[int, int]
"""Number of the points' format, and their extra bytes."""


def _laz_of(packing: _Packing) -> Any:
    """Description of how points are compressed, for readers."""
    import lazrs

    return lazrs.LazVlr.new_for_compression(*packing, use_variable_size_chunks=True)


def _pack(packing: _Packing, points: Records) -> bytes:
    """Points as a chunk, which no other chunk has a part in."""
    if not len(points):
        return b""
    import lazrs

    packed = io.BytesIO()
    packer = lazrs.LasZipCompressor(packed, _laz_of(packing))
    packer.compress_many(points.tobytes())
    packer.finish_current_chunk()
    return packed.getvalue()[_TABLE_AT.size :]  # without the place of a table


def _extremes(points: Records) -> Records:
    """Points that have the least and the greatest value of every field."""
    fields = [points[name] for name in points.dtype.names or ()]
    at = {int(find(values)) for values in fields for find in (np.argmin, np.argmax)}
    return points[sorted(at)]


def _by_return(points: Records) -> NDArray[np.uint64]:
    """(15,) points by the number of their return, from 1."""
    numbers = points["bit_fields"] & 15
    return np.bincount(numbers, minlength=16)[1:].astype(np.uint64)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Cube:
    """The nodes inside of a cube, whose chunks and remaining points are on disk."""

    entries: list[Entry]
    chunks: Path
    left: Path
    """Points for the cube's own node and those above it."""
    count: int
    """Of all points in it."""
    by_return: NDArray[np.uint64]
    extremes: Records


def _make_cube(
    spool: PointSpool, grid: "_OctreeGrid", packing: _Packing, task: tuple[Key, tuple[str, ...]]
) -> _Cube:
    """Make all nodes below that of a cube."""
    key, names = task
    folder = spool.cube_folder(key)
    points = spool.points(key, names)
    cube = _Cube(
        entries=[],
        chunks=folder / "chunks",
        left=folder / "left",
        count=len(points),
        by_return=_by_return(points),
        extremes=_extremes(points),
    )
    with cube.chunks.open("wb") as file:

        def put(level: int, key: Key, points: Records) -> None:
            chunk = _pack(packing, points)
            file.write(chunk)
            cube.entries.append((level, key, len(chunk), len(points)))

        def grow(level: int, points: Records) -> Records:
            if len(points) <= _LEAF_POINTS or grid.bits(level) <= _GRID_BITS:
                return points
            divided = grid.divide(level + 1, points)
            rising = [(child, grow(level + 1, part)) for child, part in divided]
            return grid.shared_out(level, rising, put)

        cube.left.write_bytes(grow(grid.depth, points).tobytes())
    return cube


def _write(file: BinaryIO, header: "laspy.LasHeader", nodes: "_Nodes") -> None:
    import laspy
    import lazrs
    from laspy.vlrs.known import LasZipVlr

    laz = _laz_of(nodes.packing)
    info = laspy.VLR("copc", 1, "COPC info VLR", bytes(_INFO.size))
    header.vlrs.insert(0, info)
    header.vlrs.append(LasZipVlr(laz.record_data()))
    header.are_points_compressed = True
    header.global_encoding.wkt = True
    for vlr in header.vlrs.get("ExtraBytesVlr"):
        for dimension in vlr.extra_bytes_structs:  # laspy takes bounds from the first points alone
            dimension.options &= ~_STATES_BOUNDS
    header.write_to(file)
    start = file.tell()
    file.write(_TABLE_AT.pack(0))
    nodes.write()
    table_at = file.tell()
    lazrs.write_chunk_table(file, nodes.chunks, laz)
    header.start_of_first_evlr = file.tell()
    header.number_of_evlrs = 1
    pages = b"".join(
        _ENTRY.pack(level, *key, offset, size, count)
        for level, key, offset, size, count in sorted(nodes.entries)
    )
    file.write(_EVLR.pack(b"copc", 1000, len(pages), b"EPT hierarchy"))
    info.record_data = nodes.grid.info(header, file.tell(), len(pages))
    file.write(pages)
    file.seek(start)
    file.write(_TABLE_AT.pack(table_at))
    file.seek(0)
    header.write_to(file, ensure_same_size=True)


@dataclass(frozen=True, kw_only=True, eq=False)
class _OctreeGrid:
    """Where nodes lie: the root is over all cubes."""

    first: NDArray[np.int64]
    """(3,) key of the cube in the root's corner."""
    depth: int
    """Level of the nodes that are cubes."""
    cube_bits: int

    @classmethod
    def over(cls, cubes: Iterable[Key], bits: int) -> "_OctreeGrid":
        """Over cubes whose edges are 2**bits steps."""
        keys = np.array(sorted(cubes))
        first = keys.min(axis=0)
        return cls(first=first, depth=int((keys - first).max()).bit_length(), cube_bits=bits)

    @property
    def corner(self) -> NDArray[np.int64]:
        """(3,) corner of the root, in steps."""
        return np.asarray(self.first << self.cube_bits)

    def bits(self, level: int) -> int:
        """Nodes of a level have edges of 2**bits steps."""
        return self.cube_bits + self.depth - level

    def in_order(self, cubes: Iterable[Key]) -> list[Key]:
        """Cubes in the order of their nodes, children of one node together."""
        return sorted(cubes, key=lambda key: self._path(np.array(key) - self.first))

    def _path(self, node: NDArray[np.int64]) -> list[Key]:
        """Keys of a cube's node and all above it, from the root."""
        return [_key(node >> (self.depth - level)) for level in range(self.depth + 1)]

    def above(self, cubes: Iterable[Key]) -> set[tuple[int, Key]]:
        """Levels and keys of the nodes of cubes and all above them."""
        paths = [self._path(np.array(key) - self.first) for key in cubes]
        return {(level, key) for path in paths for level, key in enumerate(path)}

    def info(self, header: "laspy.LasHeader", pages_at: int, pages_size: int) -> bytes:
        """Where the root and the hierarchy are; its faces lie half a step off points."""
        half = 2.0 ** self.bits(0) / 2
        centre = (self.corner + half - 0.5) * header.scales + header.offsets
        half *= header.scales[0]
        spacing = 2 * half / 2**_GRID_BITS
        return _INFO.pack(*centre, half, spacing, pages_at, pages_size, 0.0, 0.0)

    def divide(self, level: int, points: Records) -> list[tuple[Key, Records]]:
        """Points by their node at a level."""
        nodes = self._steps(points) >> self.bits(level)
        octant = (nodes & 1) @ np.array([1, 2, 4])
        return [(_key(nodes[octant == n][0]), points[octant == n]) for n in np.unique(octant)]

    def shared_out(self, level: int, rising: Sequence[tuple[Key, Records]], put: _Put) -> Records:
        """The points that a node takes from its children, after these are put with the others."""
        points = np.concatenate([part for _, part in rising])
        taken = self._sample(level, points)
        stay = np.split(~taken, np.cumsum([len(part) for _, part in rising])[:-1])
        for (child, part), left in zip(rising, stay, strict=True):
            put(level + 1, child, part[left])
        return points[taken]

    def _sample(self, level: int, points: Records) -> NDArray[np.bool_]:
        """Which points are nearest to the middle of their cell of a node's grid."""
        edge = 1 << (self.bits(level) - _GRID_BITS)
        cells, within = np.divmod(self._steps(points), edge)
        cell = (cells % 2**_GRID_BITS) @ np.array([1, 2**_GRID_BITS, 4**_GRID_BITS])
        order = np.lexsort((np.square(2 * within + 1 - edge).sum(axis=1), cell))
        taken = np.zeros(len(points), np.bool_)
        taken[order[np.diff(cell[order], prepend=-1) > 0]] = True
        return taken

    def _steps(self, points: Records) -> NDArray[np.int64]:
        """(N, 3) steps from the root's corner."""
        return np.asarray(np.stack([points[axis] for axis in "XYZ"], axis=1) - self.corner)


class _Nodes:
    """All nodes, each written when its parent has taken its share."""

    def __init__(
        self,
        file: BinaryIO,
        header: "laspy.LasHeader",
        grid: _OctreeGrid,
        packing: _Packing,
        there: Collection[Key],
        cubes: Iterator[_Cube],
    ) -> None:
        """Take cubes that are there, in the order of the grid."""
        self._file, self._header, self.grid, self.packing = file, header, grid, packing
        self._there, self._cubes = grid.above(there), cubes
        self.entries: list[tuple[int, Key, int, int, int]] = []
        """Level, key, offset, bytes and points of each node."""
        self.chunks: list[tuple[int, int]] = []
        """Points and bytes of each chunk, in the order of the file."""

    def write(self) -> None:
        """Write all nodes, children first, and fill in the header's counts and bounds."""
        self._header.partial_reset()
        root = (0, 0, 0)
        self._put(0, root, self._grow(0, root))

    def _grow(self, level: int, key: Key) -> Records:
        """Write all nodes below one; return what is left for it and those above."""
        if level == self.grid.depth:
            return self._take(next(self._cubes))
        rising = [
            (child, self._grow(level + 1, child))
            for child in _children(key)
            if (level + 1, child) in self._there
        ]
        return self.grid.shared_out(level, rising, self._put)

    def _take(self, cube: _Cube) -> Records:
        """Append the nodes of a cube."""
        import laspy

        offset = self._file.tell()
        with cube.chunks.open("rb") as chunks:
            shutil.copyfileobj(chunks, self._file)
        for level, key, size, count in cube.entries:
            self._enter(level, key, offset, size, count)
            offset += size
        header = self._header
        count = header.point_count + cube.count
        by_return = header.number_of_points_by_return + cube.by_return
        header.grow(
            laspy.ScaleAwarePointRecord(
                cube.extremes, header.point_format, header.scales, header.offsets
            )
        )
        header.point_count, header.number_of_points_by_return = count, by_return
        left: Records = np.fromfile(cube.left, cube.extremes.dtype)
        shutil.rmtree(cube.left.parent)
        return left

    def _put(self, level: int, key: Key, points: Records) -> None:
        """Write a node, which may be empty."""
        offset, chunk = self._file.tell(), _pack(self.packing, points)
        self._file.write(chunk)
        self._enter(level, key, offset, len(chunk), len(points))

    def _enter(self, level: int, key: Key, offset: int, size: int, count: int) -> None:
        self.entries.append((level, key, offset if size else 0, size, count))
        if size:
            self.chunks.append((count, size))


def _children(key: Key) -> list[Key]:
    x, y, z = ((2 * k, 2 * k + 1) for k in key)
    return list(product(x, y, z))


def _key(row: NDArray[np.int64]) -> Key:
    x, y, z = row.tolist()
    return x, y, z
