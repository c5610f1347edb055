"""Clouds of any size as one COPC file: a LAZ whose chunks are the nodes of an octree.

Any reader of LAZ reads it whole; one that knows COPC reads the nodes that a view needs. A node
takes, of each cell of a grid over it, the point nearest to the middle, and leaves the others to its
children: all levels down to any one are an even thinning of the cloud, and each point is in one
node. Format: https://copc.io, version 1.0, on LAS 1.4.

Points wait on disk in cubes. The octree grows from its leaves, cube by cube, each node taking its
points from those of its children, so that memory holds one cube and the nodes above it.
"""

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from alice_survey.base.artefacts import atomic_path
from alice_survey.base.run import progress

if TYPE_CHECKING:
    import laspy

Records = NDArray[Any]
"""Points as LAS stores them, with fields X, Y, Z in steps and all others."""
Key = tuple[int, int, int]
"""Place of a cube or a node among those of its size, in x, y, z."""

_GRID_BITS = 8
"""A node's grid has 2**8 cells a side: a surface across it fills some 65,000."""
_LEAF_POINTS = 100_000
_CUBE_SPACINGS = 1024
"""Most sides of the points' own cells along a cube: a surface has a million points in one."""
_INFO = struct.Struct("<5d2Q2d88x")
_ENTRY = struct.Struct("<4iQ2i")
_EVLR = struct.Struct("<2x16sHQ32s")


@contextmanager
def copc_writer(
    path: Path, header: "laspy.LasHeader", spacing: float, scratch: Path
) -> Iterator[Callable[["laspy.ScaleAwarePointRecord"], None]]:
    """A COPC file that takes points in any order, one or more in all.

    Args:
        path: of the file.
        header: LAS 1.4 of point format 6 to 8; counts and bounds are filled in.
        spacing: of neighbouring points, in the unit of the coordinates.
        scratch: a folder that is not there yet, for the points until the file is written.

    Yields:
        A function that takes points with this header.
    """
    header.partial_reset()
    scratch.mkdir()
    bits = int(np.log2(_CUBE_SPACINGS * spacing / header.scales[0]))
    cubes = _Cubes(scratch, max(bits, _GRID_BITS), header.point_format.dtype())

    def add(points: "laspy.ScaleAwarePointRecord") -> None:
        if len(points):
            header.grow(points)
            cubes.add(points.array)

    yield add
    with atomic_path(path) as temporary, temporary.open("w+b") as file:
        _write(file, header, cubes)
    scratch.rmdir()


@dataclass(frozen=True)
class _Cubes:
    """Points on disk, in cubes whose corners are at whole multiples of their edges."""

    folder: Path
    bits: int
    """Edges are 2**bits steps."""
    dtype: np.dtype[Any]
    keys: set[Key] = field(default_factory=set)

    def add(self, points: Records) -> None:
        cubes = np.stack([points[axis] for axis in "XYZ"], axis=1) >> self.bits
        keys, cube = np.unique(cubes, axis=0, return_inverse=True)
        for n, (x, y, z) in enumerate(keys.tolist()):
            self.keys.add((x, y, z))
            with self._path((x, y, z)).open("ab") as file:
                file.write(points[cube.reshape(-1) == n].tobytes())

    def take(self, key: Key) -> Records:
        """The points of a cube, which is dropped."""
        points: Records = np.fromfile(self._path(key), self.dtype)
        self._path(key).unlink()
        return points

    def _path(self, key: Key) -> Path:
        return self.folder / "{}_{}_{}.points".format(*key)


@progress.step("write the point cloud")
def _write(file: BinaryIO, header: "laspy.LasHeader", cubes: _Cubes) -> None:
    import laspy
    import lazrs
    from laspy.vlrs.known import LasZipVlr

    laz = lazrs.LazVlr.new_for_compression(
        header.point_format.id, header.point_format.num_extra_bytes, use_variable_size_chunks=True
    )
    info = laspy.VLR("copc", 1, "COPC info VLR", bytes(_INFO.size))
    header.vlrs.insert(0, info)
    header.vlrs.append(LasZipVlr(laz.record_data()))
    header.are_points_compressed = True
    header.global_encoding.wkt = True
    header.write_to(file)
    packer = lazrs.LasZipCompressor(file, laz)
    packer.reserve_offset_to_chunk_table()
    tree = _Octree(file, packer, cubes)
    tree.write()
    packer.done()
    header.start_of_first_evlr = file.seek(0, 2)
    header.number_of_evlrs = 1
    pages = b"".join(_ENTRY.pack(*entry) for entry in sorted(tree.entries))
    file.write(_EVLR.pack(b"copc", 1000, len(pages), b"EPT hierarchy"))
    info.record_data = tree.info(header, file.tell(), len(pages))
    file.write(pages)
    file.seek(0)
    header.write_to(file, ensure_same_size=True)


class _Octree:
    """The nodes over cubes of points, each written when its parent has taken its share."""

    def __init__(self, file: BinaryIO, packer: Any, cubes: _Cubes) -> None:
        """Lay the root over all cubes."""
        self._file, self._packer, self._cubes = file, packer, cubes
        keys = np.array(sorted(cubes.keys))
        self._first = keys.min(axis=0)
        self._depth = int((keys - self._first).max()).bit_length()
        """Level of the nodes that are cubes."""
        self._corner = self._first << cubes.bits
        self._there = [
            {_key(row) for row in (keys - self._first) >> (self._depth - level)}
            for level in range(self._depth + 1)
        ]
        """By level down to cubes, the nodes that hold anything."""
        self.entries: list[tuple[int, ...]] = []
        """Level, x, y, z, offset, bytes and points of each node that was written."""

    def write(self) -> None:
        """Write all nodes, children first."""
        root = (0, 0, 0)
        self._put(0, root, self._grow(0, root))

    def info(self, header: "laspy.LasHeader", pages_at: int, pages_size: int) -> bytes:
        """Where the root and the hierarchy are; its faces lie half a step off points."""
        half = 2.0 ** self._bits(0) / 2
        centre = (self._corner + half - 0.5) * header.scales + header.offsets
        half *= header.scales[0]
        spacing = 2 * half / 2**_GRID_BITS
        return _INFO.pack(*centre, half, spacing, pages_at, pages_size, 0.0, 0.0)

    def _bits(self, level: int) -> int:
        """Nodes of a level have edges of 2**bits steps."""
        return self._cubes.bits + self._depth - level

    def _grow(self, level: int, key: Key, points: Records | None = None) -> Records:
        """Write all nodes below one.

        Args:
            level: of the node.
            key: of the node.
            points: all in it; None where they are in cubes.

        Returns:
            Points that are left for the node and those above it.
        """
        if points is None and level == self._depth:
            points = self._cubes.take(_key(self._first + key))
        if points is None:
            parts = [
                (child, self._grow(level + 1, child))
                for child in product(*((2 * k, 2 * k + 1) for k in key))
                if child in self._there[level + 1]
            ]
        elif len(points) <= _LEAF_POINTS or self._bits(level) <= _GRID_BITS:
            return points
        else:
            parts = [
                (child, self._grow(level + 1, child, part))
                for child, part in self._divided(level + 1, points)
            ]
        rising = np.concatenate([part for _, part in parts])
        taken = self._sampled(level, rising)
        stay = np.split(~taken, np.cumsum([len(part) for _, part in parts])[:-1])
        for (child, part), left in zip(parts, stay, strict=True):
            self._put(level + 1, child, part[left])
        return rising[taken]

    def _steps(self, points: Records) -> NDArray[np.int64]:
        """(N, 3) steps from the root's corner."""
        steps: NDArray[np.int64] = np.stack([points[axis] for axis in "XYZ"], axis=1) - self._corner
        return steps

    def _divided(self, level: int, points: Records) -> list[tuple[Key, Records]]:
        """Points by their node at a level."""
        nodes = self._steps(points) >> self._bits(level)
        octant = (nodes & 1) @ np.array([1, 2, 4])
        return [(_key(nodes[octant == n][0]), points[octant == n]) for n in np.unique(octant)]

    def _sampled(self, level: int, points: Records) -> NDArray[np.bool_]:
        """Which points are nearest to the middle of their cell of a node's grid."""
        edge = 1 << (self._bits(level) - _GRID_BITS)
        cells, within = np.divmod(self._steps(points), edge)
        cell = (cells % 2**_GRID_BITS) @ np.array([1, 2**_GRID_BITS, 4**_GRID_BITS])
        order = np.lexsort((np.square(2 * within + 1 - edge).sum(axis=1), cell))
        taken = np.zeros(len(points), np.bool_)
        taken[order[np.diff(cell[order], prepend=-1) > 0]] = True
        return taken

    def _put(self, level: int, key: Key, points: Records) -> None:
        """Write a node, which may be empty, as a chunk."""
        start = self._file.tell()
        if len(points):
            self._packer.compress_many(points.tobytes())
            self._packer.finish_current_chunk()
        size = self._file.tell() - start
        self.entries.append((level, *key, start if size else 0, size, len(points)))


def _key(row: NDArray[np.int64]) -> Key:
    x, y, z = row.tolist()
    return x, y, z
