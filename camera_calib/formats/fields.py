"""Files of other tools, read safely: bounded, checked value by value, faults named by key.

YAML, OpenCV's FileStorage and JSON become plain values: nothing expands, nothing is constructed.
"""

import json
import math
import re
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from alice_survey.core.untrusted import refuse_declarations

_MAX_BYTES = 1 << 20
_MAX_SKIPPED_BYTES = 1 << 26
"""Of files with what was measured for a calibration, or poses of all pictures, next to it."""
_MAX_PARTS = 5000
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
            raise self.fault(key, f"holds {len(flat)} numbers; {wanted} expected")
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


def read_bytes(path: Path, largest: int = _MAX_BYTES) -> bytes:
    """The content of a file of limited size.

    Raises:
        CalibrationError: there is no such file, or it is larger.
    """
    try:
        with path.open("rb") as file:
            content = file.read(largest + 1)
    except FileNotFoundError:
        raise CalibrationError(f"{path}: no such file") from None
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror}") from None
    _check_size(path, content, largest)
    return content


def _check_size(path: Path, content: bytes, largest: int) -> None:
    if len(content) > largest:
        raise CalibrationError(
            f"{path}: more than {largest >> 20} MiB: no calibration file is that large"
        )


def _without(content: bytes, start: bytes, end: bytes) -> bytes:
    kept, at = [], 0
    while (first := content.find(start, at)) >= 0:
        last = content.find(end, first + len(start))
        if last < 0:
            break
        kept.append(content[at:first])
        at = last + len(end)
    return b"".join([*kept, content[at:]])


def read_text(path: Path, skipped: tuple[bytes, bytes] | None = None) -> str:
    """The text of a file that parsers can take without harm.

    Args:
        path: of the file.
        skipped: marks; all between them is left out, and may be long.

    Raises:
        CalibrationError: no such file, too large, no UTF-8, too many parts, or a document type (XML
            entities).
    """
    content = read_bytes(path, _MAX_BYTES if skipped is None else _MAX_SKIPPED_BYTES)
    if skipped is not None:
        content = _without(content, *skipped)
        _check_size(path, content, _MAX_BYTES)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise CalibrationError(f"{path}: is not UTF-8 text") from None
    if "\0" in text:
        raise CalibrationError(f"{path}: is not text")
    if len(re.findall(r"[\[{]|<[A-Za-z_]", text)) > _MAX_PARTS:
        raise CalibrationError(f"{path}: has more than {_MAX_PARTS} parts: no calibration file")
    try:
        refuse_declarations(text)
    except ValueError as error:
        raise CalibrationError(f"{path}: {error}") from None
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


class _PlainLoader(yaml.SafeLoader):  # type: ignore[misc]  # PyYAML has no types
    """Safe YAML without aliases (which can grow without bound) and without repeated keys."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.events.AliasEvent):
            raise yaml.constructor.ConstructorError(
                None, None, "an alias", self.peek_event().start_mark
            )
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for key in keys:
            if keys.count(key) > 1:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key} twice", node.start_mark
                )
        values: dict[Hashable, Any] = super().construct_mapping(node, deep)
        return values


def read_yaml(path: Path, skipped: tuple[bytes, bytes] | None = None) -> Fields:
    """A YAML file whose top is a mapping; `skipped` as for `read_text`.

    Raises:
        CalibrationError: the file is missing, not YAML, or not a mapping of text keys.
    """
    text = read_text(path, skipped)
    try:
        value = yaml.load(text, Loader=_PlainLoader)  # noqa: S506 - a SafeLoader
    except (yaml.YAMLError, RecursionError, ValueError, TypeError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark is not None else ""
        what = getattr(error, "problem", None) or type(error).__name__
        raise CalibrationError(f"{path}: not valid YAML{where}: {_one_line(what)}") from None
    return _mapping(path, value)


def write_yaml(path: Path, document: Any) -> None:
    """Write a YAML file, lists of numbers on one line each."""
    with atomic_path(path) as temporary:
        text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=1000)
        temporary.write_text(text, encoding="utf-8")


def read_json_fields(path: Path) -> Fields:
    """A JSON file whose top is a mapping, or a list, which is then found below the key `list`.

    Raises:
        CalibrationError: the file is missing or not JSON.
    """
    try:
        value = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"{path}: not valid JSON: {_one_line(str(error))}") from None
    return _mapping(path, {"list": value} if isinstance(value, list) else value)


def read_storage(path: Path) -> Fields:
    """A YAML, XML or JSON file of OpenCV's FileStorage; matrices are `{rows, cols, dt, data}`.

    Raises:
        CalibrationError: the file is missing, is not such a file, or repeats a key.
    """
    text = read_text(path)
    if not text.strip():
        raise CalibrationError(f"{path}: is empty")
    storage = cv2.FileStorage()
    try:
        if not storage.open(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY):
            raise CalibrationError(f"{path}: OpenCV's FileStorage cannot read it")
        return _mapping(path, _plain(path, storage.root()))
    except (cv2.error, SystemError, UnicodeDecodeError) as error:
        found = re.search(r"\((\d+)\): ([^\n]*)", str(error))
        what = f"line {found[1]}: {found[2]}" if found else _one_line(str(error))
        raise CalibrationError(f"{path}: OpenCV's FileStorage cannot read it: {what}") from None
    finally:
        storage.release()


def _plain(path: Path, node: Any) -> Any:
    if node.isMap():
        keys = node.keys()
        if len(set(keys)) != len(keys):
            repeated = next(key for key in keys if keys.count(key) > 1)
            raise CalibrationError(f"{path}: has the key {repeated} twice")
        return {key: _plain(path, node.getNode(key)) for key in keys}
    if node.isSeq():
        return [_plain(path, node.at(i)) for i in range(node.size())]
    if node.isString():
        return node.string()
    if node.isInt():
        return int(node.real())
    return node.real() if node.isReal() else None


def _mapping(path: Path, value: Any) -> Fields:
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise CalibrationError(f"{path}: is not a mapping of keys to values")
    return Fields(path=path, values=value)


def _one_line(text: str) -> str:
    return " ".join(text.split())[:200]
