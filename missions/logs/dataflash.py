"""ArduPilot's on-board log (DataFlash, binary .BIN or text .log) as tables of numbers.

The format describes itself: a message is A3 95, a type number and packed fields; messages of type
0x80 (FMT) give each type's length, name, field types and field names (ardupilot,
libraries/AP_Logger/LogStructure.h and README.md). pymavlink's reader of these logs is under the
GPL, so this is another.
"""

import struct
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.errors import NavigationError
from alice_survey.core.frames import Array

Mask = NDArray[np.bool_]

_HEAD = b"\xa3\x95"
_FMT, _FMT_LENGTH = 0x80, 89
_FIELDS = {
    "a": "S64", "b": "i1", "B": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4", "f": "<f4",
    "d": "<f8", "g": "<f2", "n": "S4", "N": "S16", "Z": "S64", "c": "<i2", "C": "<u2", "e": "<i4",
    "E": "<u4", "L": "<i4", "M": "u1", "q": "<i8", "Q": "<u8",
}  # fmt: skip
_DIVISORS = {"c": 100.0, "C": 100.0, "e": 100.0, "E": 100.0, "L": 1e7}
"""Field types that hold hundredths, or degrees in 1e-7."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LogTable:
    """All messages of one name."""

    name: str
    columns: dict[str, Array]
    """(N,) numbers by field, in the units that the field's type scales to."""
    texts: dict[str, list[str]]
    """Fields of text."""

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def has(self, *names: str) -> bool:
        """Whether all of these columns are there."""
        return all(name in self.columns for name in names)

    def rows(self, keep: Mask) -> "LogTable":
        """The rows where a mask, (N,), holds."""
        return LogTable(
            name=self.name,
            columns={name: column[keep] for name, column in self.columns.items()},
            texts={
                name: [text for text, good in zip(column, keep, strict=True) if good]
                for name, column in self.texts.items()
            },
        )

    def stacked(self, *names: str) -> Array:
        """Columns side by side, (N, k)."""
        return np.stack([self.columns[name] for name in names], axis=1)


@dataclass(frozen=True, kw_only=True)
class _MessageFormat:
    name: str
    length: int
    kinds: str
    fields: tuple[str, ...]

    def problem(self) -> str | None:
        """What makes it unusable, if anything."""
        wrong = [kind for kind in self.kinds if kind not in _FIELDS]
        if wrong:
            return f"field type {wrong[0]!r}"
        if len(self.kinds) != len(self.fields):
            return f"{len(self.kinds)} field types for {len(self.fields)} names"
        if len(set(self.fields)) < len(self.fields) or "" in self.fields:
            return "fields without a name, or two of one name"
        if self.dtype.itemsize != self.length:
            return f"length {self.length} of fields that take {self.dtype.itemsize}"
        return None

    @property
    def dtype(self) -> np.dtype[Any]:
        """Record type of a whole message."""
        own = [(field, _FIELDS[kind]) for field, kind in zip(self.fields, self.kinds, strict=True)]
        return np.dtype([(" head", "S3"), *own])


def read_dataflash(
    path: Path, wanted: Collection[str], lost: Counter[str]
) -> tuple[dict[str, LogTable], list[str]]:
    """Read the messages of some names.

    Args:
        path: a .BIN or a text .log.
        wanted: names of messages.
        lost: counts what cannot be read; is added to.

    Returns:
        Tables by name, and the names of all messages in the log.

    Raises:
        NavigationError: it is not such a log, or cannot be read.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise NavigationError(f"{path}: cannot be read: {error.strerror}") from None
    if _HEAD + b"\x80" in data[:4096]:
        return _read_binary(data, wanted, lost)
    if b"FMT," in data[:8192]:
        return _read_text(data, wanted, lost)
    raise NavigationError(
        f"{path}: no DataFlash log: its first bytes hold no FMT message (was it cut at the start?)"
    )


def _read_binary(
    data: bytes, wanted: Collection[str], lost: Counter[str]
) -> tuple[dict[str, LogTable], list[str]]:
    formats: dict[int, _MessageFormat] = {}
    lengths = [0] * 256
    lengths[_FMT] = _FMT_LENGTH
    offsets: list[list[int]] = [[] for _ in range(256)]
    place, end, skipped = 0, len(data), 0
    while place + 3 <= end:
        length = lengths[data[place + 2]] if data[place : place + 2] == _HEAD else 0
        if not length:
            following = data.find(_HEAD, place + 1)
            following = end if following < 0 else following
            skipped += following - place
            place = following
            continue
        if place + length > end:
            break
        kind = data[place + 2]
        offsets[kind].append(place)
        if kind == _FMT:
            _learn(data[place + 3 : place + _FMT_LENGTH], formats, lengths, lost)
        place += length
    if skipped:
        lost["bytes that are not a message"] += skipped
    if place < end:
        lost["bytes of a message cut off at the end of the file"] += end - place
    view = np.frombuffer(data, dtype=np.uint8)
    tables: dict[str, LogTable] = {}
    for number, form in formats.items():
        if form.name in wanted and offsets[number]:
            starts = np.array(offsets[number])
            raw = view[starts[:, None] + np.arange(form.length)]
            tables[form.name] = _table(form, np.ascontiguousarray(raw).view(form.dtype)[:, 0])
    present = sorted(form.name for number, form in formats.items() if offsets[number])
    return tables, present


def _learn(
    body: bytes, formats: dict[int, _MessageFormat], lengths: list[int], lost: Counter[str]
) -> None:
    """Take in one FMT message."""
    number, length, *texts = struct.unpack("<BB4s16s64s", body)
    name, kinds, fields = (t.split(b"\0")[0].decode("ascii", "replace") for t in texts)
    form = _MessageFormat(
        name=name, length=length, kinds=kinds, fields=tuple(fields.split(",")) if fields else ()
    )
    known = formats.get(number)
    if number == _FMT or known == form:
        return
    if known is not None:
        # A second meaning of a number would make rubbish of the messages before.
        lost[f"FMT of {name}: its number is taken by {known.name}"] += 1
        return
    problem = form.problem()
    if problem is None:
        formats[number] = form
    else:
        lost[f"FMT of {name}: {problem}"] += 1
    lengths[number] = length if length > 3 else 0


def _table(form: _MessageFormat, records: Any) -> LogTable:
    columns: dict[str, Array] = {}
    texts: dict[str, list[str]] = {}
    for name, kind in zip(form.fields, form.kinds, strict=True):
        if kind in "anNZ":
            texts[name] = [t.split(b"\0")[0].decode("utf-8", "replace") for t in records[name]]
        else:
            columns[name] = records[name].astype(np.float64) / _DIVISORS.get(kind, 1.0)
    return LogTable(name=form.name, columns=columns, texts=texts)


def _read_text(
    data: bytes, wanted: Collection[str], lost: Counter[str]
) -> tuple[dict[str, LogTable], list[str]]:
    """Lines of comma-separated values, already scaled; FMT lines first name the fields."""
    formats: dict[str, tuple[str, tuple[str, ...]]] = {}
    rows: dict[str, list[list[str]]] = {}
    for line in data.decode("utf-8", "replace").splitlines():
        name, *cells = (cell.strip() for cell in line.split(","))
        if name == "FMT" and len(cells) >= 4:
            formats[cells[2]] = (cells[3], tuple(cells[4:]))
        elif name in formats:
            rows.setdefault(name, [])
            if name in wanted:
                rows[name].append(cells)
        elif name:
            lost["lines that are not a message"] += 1
    tables = {}
    for name in wanted:
        if rows.get(name):
            table = _text_table(name, *formats[name], rows[name], lost)
            if len(table):
                tables[name] = table
    return tables, sorted(rows)


def _text_table(
    name: str, kinds: str, fields: tuple[str, ...], rows: list[list[str]], lost: Counter[str]
) -> LogTable:
    whole = [row for row in rows if len(row) == len(fields)]
    if len(whole) < len(rows):
        lost[f"{name}: lines without all of its fields"] += len(rows) - len(whole)
    columns: dict[str, Array] = {}
    texts: dict[str, list[str]] = {}
    for i, (field, kind) in enumerate(zip(fields, kinds, strict=False)):
        cells = [row[i] for row in whole]
        if kind in "anNZM":
            texts[field] = cells
            continue
        values = np.full(len(cells), np.nan)
        for j, cell in enumerate(cells):
            try:
                values[j] = float(cell)
            except ValueError:
                lost[f"{name}: {field} is not a number"] += 1
        columns[field] = values
    return LogTable(name=name, columns=columns, texts=texts)
