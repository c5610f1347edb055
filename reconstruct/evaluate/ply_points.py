"""The points of a PLY file of others: text or binary, whatever else they hold.

Open3D reads such files too, but of one that is cut short it makes points at the origin.
Format: http://paulbourke.net/dataformats/ply/.
"""

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from alice_survey.base.errors import WorkspaceError
from alice_survey.base.frames import Array

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 1 << 16


@dataclass(frozen=True, kw_only=True)
class _Header:
    order: str
    """`<`, `>`, or empty for text."""
    count: int
    fields: tuple[tuple[str, str], ...]
    """Name and type of each property of a point."""
    start: int
    """Byte after the header."""
    offset: Array
    """(3,) that our own files state in a comment; zeros in others."""


def read_ply_points(path: Path, most: int) -> Array:
    """Every n-th point, so that there are at most `most`, (N, 3), with the offset our files state.

    Raises:
        WorkspaceError: it is no PLY, its points do not come first, or it is cut short.
    """
    with path.open("rb") as file:
        header = _header(path, file.read(_LONGEST_HEADER))
    step = max(1, -(-header.count // most))
    read = _binary if header.order else _text
    return read(path, header, step) + header.offset


def _binary(path: Path, header: _Header, step: int) -> Array:
    record = np.dtype([(name, header.order + kind) for name, kind in header.fields])
    if path.stat().st_size < header.start + header.count * record.itemsize:
        raise _short(path, header.count)
    if not header.count:
        return np.empty((0, 3))
    rows = np.memmap(path, record, "r", offset=header.start, shape=(header.count,))[::step]
    return np.column_stack([rows[axis].astype(np.float64) for axis in "xyz"])


def _text(path: Path, header: _Header, step: int) -> Array:
    names = [name for name, _ in header.fields]
    wanted = [names.index(axis) for axis in "xyz"]
    points = []
    with path.open("rb") as file:
        file.seek(header.start)
        lines = io.BufferedReader(file)
        for i in range(header.count):
            cells = lines.readline().split()
            if len(cells) != len(names):
                raise _short(path, header.count)
            if i % step == 0:
                points.append([float(cells[column]) for column in wanted])
    return np.array(points, dtype=np.float64).reshape(-1, 3)


def _short(path: Path, count: int) -> WorkspaceError:
    return WorkspaceError(f"{path}: is cut short or damaged: {count} points were to follow")


def _header(path: Path, content: bytes) -> _Header:
    end = content.find(b"end_header")
    start = content.find(b"\n", end) + 1
    if not content.startswith(b"ply") or end < 0 or not start:
        raise WorkspaceError(f"{path}: is no PLY file")
    lines = [line.decode("ascii", "replace").split() for line in content[:end].splitlines()]
    kind = next((words[1] for words in lines if words[:1] == ["format"] and len(words) > 1), "")
    if kind not in _ORDERS:
        raise WorkspaceError(f"{path}: PLY of the format {kind!r}: {', '.join(_ORDERS)} are read")
    elements = [i for i, words in enumerate(lines) if words[:1] == ["element"]]
    first = lines[elements[0]] if elements else []
    if len(first) != 3 or first[1] != "vertex" or not first[2].isascii() or not first[2].isdigit():
        raise WorkspaceError(f"{path}: points are not the first that it holds")
    ends = elements[1] if len(elements) > 1 else len(lines)
    fields = []
    for words in lines[elements[0] + 1 : ends]:
        if words[:1] != ["property"]:
            continue
        if len(words) != 3 or words[1] not in _TYPES:
            raise WorkspaceError(f"{path}: a point's property {' '.join(words[1:])!r} is not read")
        fields.append((words[2], _TYPES[words[1]]))
    names = [name for name, _ in fields]
    if len(set(names)) < len(names) or not {"x", "y", "z"} <= set(names):
        raise WorkspaceError(f"{path}: its points lack x, y or z, or have a property twice")
    return _Header(
        order=_ORDERS[kind],
        count=int(first[2]),
        fields=tuple(fields),
        start=start,
        offset=_offset(lines),
    )


def _offset(lines: list[list[str]]) -> Array:
    for words in lines:
        if words[:2] == ["comment", "offset_east_north_up"] and len(words) == 5:
            return np.array(words[2:], dtype=np.float64)
    return np.zeros(3)
