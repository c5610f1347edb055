"""Files of other tools, read safely: bounded, checked value by value, faults named by key."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.errors import CalibrationError
from alice_survey.base.frames import Array

_LARGEST_BYTES = 1 << 20
_MOST_PARTS = 5000
"""Lists, mappings and tags. Parsers recurse: this bounds how deep (OpenCV's exhausts memory at some
hundred thousand levels, and handles 20,000)."""
_DEEPEST = 20
"""Lists in lists that hold numbers."""
_ROTATION_TOLERANCE = 1e-3
"""Tolerance of a rotation matrix written with few digits (four decimals and better pass)."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


@dataclass(frozen=True, kw_only=True)
class Fields:
    """Values by key, as parsers give them, with the file they come from."""

    path: Path
    values: Mapping[str, Any]
    prefix: str = ""
    """Keys that lead here, such as `cam0.`."""

    def fault(self, key: str, text: str) -> CalibrationError:
        """Error about a key, as one line that names the file."""
        return CalibrationError(f"{self.path}: {self.prefix}{key} {text}")

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def first(self, *keys: str) -> str | None:
        """The first of these keys that is there."""
        return next((key for key in keys if key in self.values), None)

    def get(self, key: str) -> Any:
        """A value of any kind.

        Raises:
            CalibrationError: the key is missing.
        """
        if key not in self.values:
            raise CalibrationError(f"{self.path}: lacks {self.prefix}{key}")
        return self.values[key]

    def fields(self, key: str) -> "Fields":
        """The mapping below a key."""
        value = self.get(key)
        if not isinstance(value, Mapping):
            raise self.fault(key, "is not a mapping")
        return Fields(path=self.path, values=value, prefix=f"{self.prefix}{key}.")

    def text(self, key: str) -> str:
        """A line of text."""
        value = self.get(key)
        if not isinstance(value, str) or "\n" in value:
            raise self.fault(key, "is not a line of text")
        return value

    def texts(self, key: str) -> list[str]:
        """A list of texts; OpenCV's XML has no other way to write a list of one than its text."""
        value = self.get(key)
        every = [value] if isinstance(value, str) else value
        if not isinstance(every, list) or not all(isinstance(text, str) for text in every):
            raise self.fault(key, "is not a list of names")
        return every

    def number(self, key: str) -> float:
        """A finite number."""
        return float(self.numbers(key, 1)[0])

    def size(self, key: str) -> int:
        """A positive whole number."""
        value = self.number(key)
        if value != int(value) or not 1 <= value <= 1e6:
            raise self.fault(key, f"= {value:g} is not a number of pixels")
        return int(value)

    def numbers(self, key: str, *counts: int) -> Array:
        """Finite numbers, however nested, as one vector of one of these lengths."""
        flat = _flat(self.get(key))
        if flat is None:
            raise self.fault(key, "holds something that is not a finite number")
        if len(flat) not in counts:
            wanted = " or ".join(map(str, counts))
            raise self.fault(key, f"holds {len(flat)} numbers; {wanted} wanted")
        return np.array(flat)

    def matrix(self, key: str, rows: int, columns: int) -> Array:
        """A matrix, as nested lists or as a mapping of rows, cols and data row by row."""
        value = self.get(key)
        if not isinstance(value, Mapping):
            return self.numbers(key, rows * columns).reshape(rows, columns)
        inner = self.fields(key)
        if [inner.size("rows"), inner.size("cols")] != [rows, columns]:
            raise self.fault(key, f"is not a {rows} x {columns} matrix")
        return inner.numbers("data", rows * columns).reshape(rows, columns)

    def vector(self, key: str, *counts: int) -> Array:
        """Numbers in a list, or a row or column matrix."""
        if isinstance(self.get(key), Mapping):
            return self.fields(key).numbers("data", *counts)
        return self.numbers(key, *counts)

    def rotation(self, key: str, matrix: Array) -> Rotation:
        """A 3 x 3 matrix read from `key` as a rotation.

        Raises:
            CalibrationError: it is not one.
        """
        off = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
        if off > _ROTATION_TOLERANCE or np.linalg.det(matrix) < 0:
            raise self.fault(key, f"is not a rotation (R R^T misses the identity by {off:.2g})")
        return Rotation.from_matrix(matrix)

    def pose(self, key: str) -> RigidTransform:
        """A 4 x 4 rigid transformation."""
        matrix = self.matrix(key, 4, 4)
        if not np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0]):
            raise self.fault(key, "does not end in the row 0 0 0 1")
        return RigidTransform.from_components(matrix[:3, 3], self.rotation(key, matrix[:3, :3]))


def _flat(value: Any, depth: int = 0) -> list[float] | None:
    if isinstance(value, list):
        if depth > _DEEPEST:
            return None
        parts = [_flat(part, depth + 1) for part in value]
        if any(part is None for part in parts):
            return None
        return [number for part in parts if part is not None for number in part]
    # YAML 1.1 takes 1e-05, without a dot, for text; other tools write it so.
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return [number] if math.isfinite(number) else None


def read_bytes(path: Path) -> bytes:
    """The content of a file of at most 1 MiB.

    Raises:
        CalibrationError: there is no such file, or it is larger.
    """
    try:
        with path.open("rb") as file:
            content = file.read(_LARGEST_BYTES + 1)
    except FileNotFoundError:
        raise CalibrationError(f"{path}: no such file") from None
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror}") from None
    if len(content) > _LARGEST_BYTES:
        raise CalibrationError(f"{path}: more than 1 MiB: no calibration file is that large")
    return content


def read_text(path: Path) -> str:
    """The text of a file that parsers can take without harm.

    Raises:
        CalibrationError: no such file, too large, no UTF-8, or too many parts.
    """
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise CalibrationError(f"{path}: is not UTF-8 text") from None
    if "\0" in text:
        raise CalibrationError(f"{path}: is not text")
    if len(re.findall(r"[\[{]|<[A-Za-z_]", text)) > _MOST_PARTS:
        raise CalibrationError(f"{path}: has more than {_MOST_PARTS} parts: no calibration file")
    return text


def camera_name(path: Path, name: str) -> str:
    """A name that is safe as a file name; slashes become underscores.

    Raises:
        CalibrationError: other characters than letters, digits, `_`, `.` and `-`.
    """
    plain = name.strip("/").replace("/", "_")
    if not _NAME.fullmatch(plain):
        raise CalibrationError(
            f"{path}: camera name {name!r} needs letters, digits, _ . - only: choose with --names"
        )
    return plain
