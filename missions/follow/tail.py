"""A navigation CSV that grows: read from where it was left, whatever happens to the file.

The last line may be half written; the file may be replaced by another one (rotated) or cut and
begun again. What is held is one chunk, and half a line.
"""

import csv
import os
from collections import Counter
from pathlib import Path
from typing import BinaryIO

import numpy as np

from alice_survey.core.errors import NavigationError
from missions.follow.rows import ROW, TIME, Piece
from missions.logs.navigation_csv import READINGS, RowParser, find_zone

_CHUNK = 1 << 20
_MAX_LINE = 1 << 14
_HEAD = 512
"""Bytes at the beginning by which a file is known again."""


class NavigationTail:
    """A navigation CSV that is appended to."""

    def __init__(self, path: Path) -> None:
        """Nothing is read yet; the file need not be there.

        Args:
            path: of the CSV.
        """
        self.path, self.name = path, str(path)
        self.left_out: Counter[str] = Counter()
        self._file: BinaryIO | None = None
        self._parser: RowParser | None = None
        self._columns: list[str] = []
        self._half, self._head = b"", b""
        self._starts = False

    def poll(self, wall_s: float) -> list[Piece]:
        """Rows that were written since, a chunk at a time.

        Raises:
            NavigationError: the file cannot be read, or is no navigation CSV.
        """
        try:
            return self._poll()
        except OSError as error:
            raise NavigationError(f"{self.path}: cannot be read: {error.strerror}") from None

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _poll(self) -> list[Piece]:
        file = self._file or self._open()
        if file is None:
            return []
        if self._was_cut(file):
            self._begin_again(file)
        while data := file.read(_CHUNK):
            if len(self._head) < _HEAD:
                self._head += data[: _HEAD - len(self._head)]
            pieces = self._pieces(data)
            if pieces:
                return pieces
        if self._was_replaced(file):
            self.close()
            again = self._open()
            if again is not None:
                self._begin_again(again)
        return []

    def _open(self) -> BinaryIO | None:
        """Open the file; None: it is not there yet."""
        try:
            self._file = self.path.open("rb")
        except FileNotFoundError:
            return None
        self._head = b""
        return self._file

    def _was_cut(self, file: BinaryIO) -> bool:
        """Whether the file is shorter than what was read, or begins in another way."""
        if os.fstat(file.fileno()).st_size < file.tell():
            return True
        return os.pread(file.fileno(), len(self._head), 0) != self._head

    def _was_replaced(self, file: BinaryIO) -> bool:
        try:
            there = self.path.stat()
        except FileNotFoundError:
            return False
        here = os.fstat(file.fileno())
        return (there.st_dev, there.st_ino) != (here.st_dev, here.st_ino)

    def _begin_again(self, file: BinaryIO) -> None:
        if self._half:
            self.left_out["half a line at the end of a file that was replaced"] += 1
        file.seek(0)
        self._half, self._head, self._starts = b"", b"", True

    def _pieces(self, data: bytes) -> list[Piece]:
        lines = (self._half + data).split(b"\n")
        self._half = lines.pop()
        if len(self._half) > _MAX_LINE:
            self.left_out["a line of more than 16 kB"] += 1
            self._half = b""
        rows = []
        for line in lines:
            row = self._row(line)
            if row is not None:
                rows.append(row)
        if not rows and not self._starts:
            return []
        piece = Piece(rows=np.array(rows).reshape(-1, len(ROW)), starts=self._starts)
        self._starts = False
        return [piece]

    def _row(self, line: bytes) -> list[float] | None:
        try:
            text = line.decode("utf-8-sig").strip("\r")
            cells = [cell.strip() for cell in next(csv.reader([text], skipinitialspace=True), [])]
        except (UnicodeDecodeError, csv.Error):
            self.left_out["a line that is no text"] += 1
            return None
        if not any(cells):
            return None
        if self._parser is None or "time_s" in cells or "time_utc" in cells:
            # A log that goes on in another file may have its header there again, or not.
            self._parser = RowParser(cells, find_zone("UTC"), (), str(self.path))
            self._columns = cells
            return None
        padded = [*cells, *[""] * (len(self._columns) - len(cells))]
        try:
            time, values, wrong = self._parser.parse(dict(zip(self._columns, padded, strict=False)))
        except ValueError:
            self.left_out["a row without a time"] += 1
            return None
        if wrong:
            self.left_out["values that are no numbers, or out of range"] += len(wrong)
        found = dict(zip(self._parser.names, values, strict=True))
        return [time, *(found.get(name, np.nan) for name in READINGS)]


class ReplayedLog:
    """A finished navigation CSV as if it were written now, at a number of times the true pace."""

    def __init__(self, path: Path, pace: float) -> None:
        """Start at the first row.

        Args:
            path: of the CSV.
            pace: times as fast as it was flown.
        """
        self.pace = pace
        self._tail = NavigationTail(path)
        self.name, self.left_out = f"{path} again, {pace:g} times as fast", self._tail.left_out
        self._ahead: list[Piece] = []
        self._start: tuple[float, float] | None = None

    def poll(self, wall_s: float) -> list[Piece]:
        """Rows whose time has come."""
        due: list[Piece] = []
        while True:
            if not self._ahead:
                self._ahead = self._tail.poll(wall_s)
                if not self._ahead:
                    return due
            piece = self._ahead[0]
            if not len(piece.rows):
                due.append(self._ahead.pop(0))
                continue
            if self._start is None or piece.starts:
                self._start = (wall_s, float(piece.rows[0, TIME]))
            now_s = self._start[1] + (wall_s - self._start[0]) * self.pace
            count = int(np.searchsorted(np.maximum.accumulate(piece.rows[:, TIME]), now_s, "right"))
            if count:
                due.append(Piece(rows=piece.rows[:count], starts=piece.starts))
            if count < len(piece.rows):
                self._ahead[0] = Piece(rows=piece.rows[count:], starts=piece.starts and not count)
                return due
            self._ahead.pop(0)

    def close(self) -> None:
        """Close the file."""
        self._tail.close()
