"""PLY files: clouds written part by part, points of our own and of others read.

Reading and writing hold a part of the points in memory at a time, and a file that is cut short is
refused: Open3D makes points at the origin of it. Format: http://paulbourke.net/dataformats/ply/.
"""

import io
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.contents import as_line, ordinary_file
from alice_survey.core.errors import WorkspaceError
from alice_survey.core.frames import Array

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_NAMES = {"<f4": "float", "|u1": "uchar"}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER = 1 << 16
_COLOURED = {"nx", "ny", "nz", "red", "green", "blue", "sigma"}
_CHUNK = 65_536
"""Points of which the bounds are kept, so that a tile reads only what may fall into it."""


def write_ply(path: Path, parts: Iterable[NDArray[Any]], comments: Sequence[str]) -> int:
    """Write a binary PLY of points.

    Args:
        path: of the file.
        parts: records of one type, of float32 and bytes, each dropped once it is written.
        comments: lines for the header.

    Returns:
        How many points were written.
    """
    body = path.with_suffix(".body")
    count, names = 0, []
    with body.open("wb") as file:
        for part in parts:
            names = [f"property {_NAMES[part.dtype[n].str]} {n}" for n in part.dtype.names or ()]
            file.write(part.tobytes())
            count += len(part)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {line}" for line in comments),
        f"element vertex {count}",
        *names,
    ]
    with atomic_path(path) as temporary, temporary.open("wb") as file, body.open("rb") as source:
        file.write("\n".join([*header, "end_header", ""]).encode("ascii", "replace"))
        shutil.copyfileobj(source, file)
    body.unlink()
    return count


@dataclass(frozen=True, kw_only=True)
class PlyHeader:
    """What the header of a file says of its points."""

    path: Path
    order: str
    """`<`, `>`, or empty for text."""
    count: int
    fields: tuple[tuple[str, str], ...]
    """Name and type of each property of a point."""
    start: int
    """Byte after the header."""
    offset: Array
    """(3,) offset that our own files state in a comment; zeros in others."""

    def rows(self) -> NDArray[Any]:
        """Records (N,) of a binary file, which stay on disk.

        Raises:
            WorkspaceError: the file is cut short.
        """
        record = np.dtype([(name, self.order + kind) for name, kind in self.fields])
        if self.path.stat().st_size < self.start + self.count * record.itemsize:
            raise _short(self.path, self.count)
        if not self.count:
            return np.empty(0, record)
        return np.memmap(self.path, record, "r", offset=self.start, shape=(self.count,))


def read_ply_points(path: Path, maximum: int) -> Array:
    """Every n-th point, at most `maximum` of them, (N, 3), with the offset our files state.

    Raises:
        WorkspaceError: it is not a PLY, its points do not come first, or it is cut short.
    """
    header = read_header(path)
    step = max(1, -(-header.count // maximum))
    points = _coordinates(header.rows()[::step]) if header.order else _text(header, step)
    return points + header.offset


def _coordinates(rows: NDArray[Any]) -> Array:
    return np.column_stack([rows[axis].astype(np.float64) for axis in "xyz"])


def _text(header: PlyHeader, step: int) -> Array:
    names = [name for name, _ in header.fields]
    chosen = [names.index(axis) for axis in "xyz"]
    points = []
    with header.path.open("rb") as file:
        file.seek(header.start)
        lines = io.BufferedReader(file)
        for i in range(header.count):
            cells = lines.readline().split()
            if len(cells) != len(names):
                raise _short(header.path, header.count)
            if i % step == 0:
                points.append([float(cells[column]) for column in chosen])
    return np.array(points, dtype=np.float64).reshape(-1, 3)


def _short(path: Path, count: int) -> WorkspaceError:
    return WorkspaceError(f"{path}: is cut short or damaged: {count} points should follow")


def read_header(path: Path) -> PlyHeader:
    """The header of a PLY file whose points come first, whatever else it holds.

    Raises:
        WorkspaceError: it is not a PLY, or its points are not read.
        OSError: the file cannot be read.
    """
    with ordinary_file(path, None).open("rb") as file:
        content = file.read(_MAX_HEADER)
    end = content.find(b"end_header")
    start = content.find(b"\n", end) + 1
    if not content.startswith(b"ply") or end < 0 or not start:
        raise WorkspaceError(f"{path}: not a PLY file")
    lines = [line.decode("ascii", "replace").split() for line in content[:end].splitlines()]
    kind = next((words[1] for words in lines if words[:1] == ["format"] and len(words) > 1), "")
    if kind not in _ORDERS:
        known = ", ".join(_ORDERS)
        raise WorkspaceError(f"{path}: PLY of the format {as_line(kind)!r}: {known} are read")
    elements = [i for i, words in enumerate(lines) if words[:1] == ["element"]]
    first = lines[elements[0]] if elements else []
    number = first[2] if len(first) == 3 and first[1] == "vertex" else ""
    if not (number.isascii() and number.isdigit() and len(number) < 15):
        raise WorkspaceError(f"{path}: points are not the first that it holds")
    ends = elements[1] if len(elements) > 1 else len(lines)
    fields = []
    for words in lines[elements[0] + 1 : ends]:
        if words[:1] != ["property"]:
            continue
        if len(words) != 3 or words[1] not in _TYPES:
            text = as_line(" ".join(words[1:]))
            raise WorkspaceError(f"{path}: a point's property {text!r} is not read")
        fields.append((words[2], _TYPES[words[1]]))
    names = [name for name, _ in fields]
    if len(set(names)) < len(names) or not {"x", "y", "z"} <= set(names):
        raise WorkspaceError(f"{path}: its points lack x, y or z, or have a property twice")
    return PlyHeader(
        path=path,
        order=_ORDERS[kind],
        count=int(number),
        fields=tuple(fields),
        start=start,
        offset=_offset(lines),
    )


def _offset(lines: list[list[str]]) -> Array:
    for words in lines:
        if words[:2] == ["comment", "offset_east_north_up"] and len(words) == 5:
            return np.array(words[2:], dtype=np.float64)
    return np.zeros(3)


@dataclass(frozen=True, kw_only=True, eq=False)
class CloudFile:
    """Points of a binary PLY file that stay on disk, with normals and colours."""

    header: PlyHeader
    chunk_low: Array
    """(C, 3) least coordinates of every chunk of `_CHUNK` points."""
    chunk_high: Array

    @property
    def low(self) -> Array:
        """(3,) least coordinates."""
        return np.asarray(self.chunk_low.min(axis=0))

    @property
    def high(self) -> Array:
        """(3,) greatest coordinates."""
        return np.asarray(self.chunk_high.max(axis=0))

    def inside(self, west: float, east: float, south: float, north: float) -> NDArray[Any]:
        """Records of the points in a closed rectangle of x and y, in the order of the file."""
        near = (
            (self.chunk_high[:, 0] >= west)
            & (self.chunk_low[:, 0] <= east)
            & (self.chunk_high[:, 1] >= south)
            & (self.chunk_low[:, 1] <= north)
        )
        points = self.header.rows()
        parts = [np.empty(0, points.dtype)]
        for chunk in np.flatnonzero(near):
            part = np.array(points[chunk * _CHUNK : (chunk + 1) * _CHUNK])
            here = (part["x"] >= west) & (part["x"] <= east)
            here &= (part["y"] >= south) & (part["y"] <= north)
            parts.append(part[here])
        return np.concatenate(parts)

    def sample(self, maximum: int) -> NDArray[Any]:
        """At most `maximum` records, evenly from the file."""
        return np.array(self.header.rows()[:: max(1, -(-self.header.count // maximum))])


def open_cloud(path: Path) -> CloudFile:
    """Read the header of a binary PLY file of points, and the bounds of its parts.

    Raises:
        WorkspaceError: it is missing, of another format, cut short, or lacks normals or colours.
    """
    try:
        header = read_header(path)
    except OSError as error:
        raise WorkspaceError(f"{path}: {error.strerror}") from None
    if not (header.order and header.count and dict(header.fields).keys() >= _COLOURED):
        raise WorkspaceError(
            f"{path}: no binary cloud with normals and colours: delete dense/ and run again"
        )
    points = header.rows()
    lows, highs = [], []
    for first in range(0, header.count, _CHUNK):
        xyz = _coordinates(points[first : first + _CHUNK])
        lows.append(xyz.min(axis=0))
        highs.append(xyz.max(axis=0))
    return CloudFile(header=header, chunk_low=np.array(lows), chunk_high=np.array(highs))
