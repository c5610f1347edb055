"""A point cloud in a PLY file, read part by part."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.base.contents import shown
from alice_survey.base.errors import WorkspaceError
from alice_survey.base.frames import Array

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "<i2", "int16": "<i2", "ushort": "<u2", "uint16": "<u2",
    "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4",
    "float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8",
}  # fmt: skip
_NEEDED = ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue")
_CHUNK = 65_536
"""Points of which the bounds are kept, so that a tile reads only what may fall into it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CloudFile:
    """Points of a binary PLY file that stay on disk."""

    path: Path
    start: int
    """Byte at which the first point starts."""
    record: NDArray[Any]
    """(0,) array of the type of a point."""
    count: int
    chunk_low: Array
    """(C, 3) least coordinates of every chunk of `_CHUNK` points."""
    chunk_high: Array

    @property
    def low(self) -> Array:
        """(3,) least coordinates."""
        low: Array = self.chunk_low.min(axis=0)
        return low

    @property
    def high(self) -> Array:
        """(3,) greatest coordinates."""
        high: Array = self.chunk_high.max(axis=0)
        return high

    def inside(self, west: float, east: float, south: float, north: float) -> NDArray[Any]:
        """Records of the points in a closed rectangle of x and y, in the order of the file."""
        near = (
            (self.chunk_high[:, 0] >= west)
            & (self.chunk_low[:, 0] <= east)
            & (self.chunk_high[:, 1] >= south)
            & (self.chunk_low[:, 1] <= north)
        )
        points = _mapped(self.path, self.start, self.record.dtype, self.count)
        parts = [np.empty(0, self.record.dtype)]
        for chunk in np.flatnonzero(near):
            part = np.array(points[chunk * _CHUNK : (chunk + 1) * _CHUNK])
            here = (part["x"] >= west) & (part["x"] <= east)
            here &= (part["y"] >= south) & (part["y"] <= north)
            parts.append(part[here])
        return np.concatenate(parts)

    def sample(self, most: int) -> NDArray[Any]:
        """At most so many records, evenly from the file."""
        points = _mapped(self.path, self.start, self.record.dtype, self.count)
        return np.array(points[:: max(1, -(-self.count // most))])


def open_cloud(path: Path) -> CloudFile:
    """Read the header of a binary little-endian PLY file of points, and the bounds of its parts.

    Raises:
        WorkspaceError: it is missing, of another format, cut short, or lacks normals or colours.
    """
    try:
        with path.open("rb") as file:
            record, count = _header(path, iter(file.readline, b""))
            start = file.tell()
    except OSError as error:
        raise WorkspaceError(f"{path}: {error.strerror}") from None
    if path.stat().st_size < start + count * record.itemsize:
        raise WorkspaceError(f"{path}: cut short, {count} points were to follow its header")
    if count == 0:
        raise WorkspaceError(f"{path}: holds no points")
    points = _mapped(path, start, record, count)
    lows, highs = [], []
    for first in range(0, count, _CHUNK):
        part = points[first : first + _CHUNK]
        xyz = np.column_stack([part[axis].astype(np.float64) for axis in "xyz"])
        if not np.isfinite(xyz).all():
            raise WorkspaceError(f"{path}: a point of {first} to {first + len(part)} is not finite")
        lows.append(xyz.min(axis=0))
        highs.append(xyz.max(axis=0))
    return CloudFile(
        path=path,
        start=start,
        record=np.empty(0, record),
        count=count,
        chunk_low=np.array(lows),
        chunk_high=np.array(highs),
    )


def _mapped(path: Path, start: int, record: np.dtype[Any], count: int) -> NDArray[Any]:
    return np.memmap(path, dtype=record, mode="r", offset=start, shape=(count,))


def _header(path: Path, lines: Iterator[bytes]) -> tuple[np.dtype[Any], int]:
    text = [line.decode("ascii", "replace").split() for line in _until_end(lines)]
    if not text or text[0] != ["ply"]:
        raise WorkspaceError(f"{path}: is no PLY file")
    if ["format", "binary_little_endian", "1.0"] not in text:
        raise WorkspaceError(f"{path}: only binary little-endian PLY files are read")
    elements = [words for words in text if words[:1] == ["element"]]
    if not elements or elements[0][1:2] != ["vertex"]:
        raise WorkspaceError(f"{path}: points are not its first element")
    first, fields, inside = elements[0], [], False
    for words in text:
        if words[:1] == ["element"]:
            inside = words is first
        elif inside and words[:1] == ["property"]:
            if len(words) != 3 or words[1] not in _TYPES:
                raise WorkspaceError(
                    f"{path}: cannot read the property {shown(' '.join(words[1:]))!r}"
                )
            fields.append((words[2], _TYPES[words[1]]))
    count = first[2] if len(first) == 3 and first[2].isascii() and first[2].isdigit() else ""
    if not 0 < len(count) < 15 or len({name for name, _ in fields}) < len(fields):
        raise WorkspaceError(f"{path}: its header is damaged")
    record = np.dtype(fields)
    lacking = [name for name in _NEEDED if name not in (record.names or ())]
    if lacking:
        raise WorkspaceError(f"{path}: its points lack {', '.join(lacking)}")
    return record, int(count)


def _until_end(lines: Iterator[bytes]) -> Iterator[bytes]:
    for number, line in enumerate(lines):
        if line.strip() == b"end_header" or number > 1000:
            return
        yield line
