"""Files of other tools, read safely: bounded, and checked by models that name the faulty key.

YAML, OpenCV's FileStorage and JSON become plain values: nothing expands, nothing is constructed.
"""

import json
import math
import re
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Self

import cv2
import numpy as np
import pydantic
import yaml
from pydantic import BaseModel, ConfigDict, Field, PlainSerializer, PlainValidator, ValidationError
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.contents import as_line, first_fault, ordinary_file, refuse_declarations
from alice_survey.core.errors import CalibrationError, file_faults, warn
from alice_survey.core.frames import Array

_MAX_BYTES = 1 << 20
_MAX_SKIPPED_BYTES = 1 << 26
"""Of files with what was measured for a calibration, or poses of all pictures, next to it."""
_MAX_PARTS = 5000
"""Lists, mappings and tags. Parsers recurse: this bounds how deep (OpenCV's exhausts memory at some
hundred thousand levels, and handles 20,000)."""
_ROTATION_TOLERANCE = 1e-3
"""Tolerance of a rotation matrix written with few digits (four decimals and better pass)."""
PLAIN = (".yaml", ".yml", ".json")
"""Endings of files that are known by their keys."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


class FileModel(BaseModel):
    """Values of a file by its keys, to read and to write."""

    model_config = ConfigDict(
        frozen=True, allow_inf_nan=False, arbitrary_types_allowed=True, populate_by_name=True
    )

    @classmethod
    def check(
        cls, path: Path, values: Any, prefix: str = "", others: Collection[str] | None = None
    ) -> Self:
        """The model of parsed values.

        Args:
            path: of their file, for messages.
            values: as parsers give them.
            prefix: keys that lead here, such as `cam0.`.
            others: keys that are read elsewhere; a warning names further ones. None: no warning.

        Raises:
            CalibrationError: a value is missing or wrong; the message names file and key.
        """
        try:
            found = cls.model_validate(values)
        except ValidationError as error:
            given = error.errors(include_url=False)[0]["input"]
            value = "" if isinstance(given, dict | list) else f" ({as_line(repr(given))[:60]})"
            raise CalibrationError(f"{path}: {prefix}{first_fault(error)}{value}") from None
        if others is not None:
            known = [*others, *cls.known_keys()]
            lost = {key: get_close_matches(key, known, 1) for key in {**values} if key not in known}
            near = {key: "".join(f" ({name}?)" for name in names) for key, names in lost.items()}
            name_unread(path, (f"{prefix}{key}{near[key]}" for key in near if values[key] != 0))
        return found

    @classmethod
    def known_keys(cls) -> Iterator[str]:
        """The keys of its values."""
        for name, field in cls.model_fields.items():
            yield from getattr(field.validation_alias, "choices", [field.validation_alias or name])

    def values(self) -> dict[str, Any]:
        """What a file holds of it, by its keys."""
        return self.model_dump(mode="json", by_alias=True, exclude_none=True)


def keys(*names: str) -> Any:
    """A value that files call by any of these names, or lack."""
    return Field(None, validation_alias=pydantic.AliasChoices(*names))


def numbers_model(required: Iterable[str], optional: Iterable[str]) -> type[FileModel]:
    """The model of finite numbers, each under its own key; those that are left out are 0."""
    kinds: dict[str, Any] = dict.fromkeys(required, float) | dict.fromkeys(optional, (float, 0.0))
    return pydantic.create_model("Numbers", __base__=FileModel, **kinds)


def name_unread(path: Path, names: Iterable[str]) -> None:
    """Warn of what a file holds and nothing reads."""
    lost = list(dict.fromkeys(names))
    if lost:
        warn(f"{path}: not read: {as_line(', '.join(lost))}")


def read_vector(counts: tuple[int, ...], value: Any) -> Array:
    """Finite numbers in a list, or in lists of equal lengths, or in a matrix with its `data`."""
    values = value.get("data") if isinstance(value, Mapping) else value
    try:  # YAML 1.1 takes 1e-05, without a dot, for text; other tools write it so
        items = np.array(values, dtype=object).ravel()
        flat = np.array([math.nan if isinstance(item, bool) else float(item) for item in items])
    except (TypeError, ValueError, OverflowError):
        flat = np.array([math.nan])
    if not np.isfinite(flat).all():
        raise ValueError("holds something that is not a finite number")
    if counts and len(flat) not in counts:
        expected = " or ".join(map(str, counts))
        raise ValueError(f"holds {len(flat)} numbers; {expected} expected")
    return flat


def _read_matrix(rows: int, columns: int, value: Any) -> Array:
    """A matrix, as nested lists or as a mapping of rows, cols and data row by row."""
    if isinstance(value, Mapping) and [value.get("rows"), value.get("cols")] != [rows, columns]:
        raise ValueError(f"is not a {rows} x {columns} matrix")
    return read_vector((rows * columns,), value).reshape(rows, columns)


def _read_rotation(value: Any) -> Rotation:
    matrix = _read_matrix(3, 3, value)
    off = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    if off > _ROTATION_TOLERANCE or np.linalg.det(matrix) < 0:
        raise ValueError(f"is not a rotation (R R^T misses the identity by {off:.2g})")
    return Rotation.from_matrix(matrix)


def _read_pose(value: Any) -> RigidTransform:
    matrix = _read_matrix(4, 4, value)
    if not np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0]):
        raise ValueError("does not end in the row 0 0 0 1")
    return RigidTransform.from_components(matrix[:3, 3], _read_rotation(matrix[:3, :3].tolist()))


def matrix_of(array: Array) -> dict[str, Any]:
    """A matrix, or a row of numbers, as OpenCV and ROS write it into YAML."""
    rows, columns = np.atleast_2d(array).shape
    return {"rows": rows, "cols": columns, "data": array.ravel().tolist()}


def _validator(read: Callable[..., Any], *shape: Any) -> PlainValidator:
    return PlainValidator(partial(read, *shape))


Pixels = Annotated[int, Field(ge=1, le=1_000_000)]
"""A number of pixels."""
_AsList = PlainSerializer(lambda array: array.tolist())
Numbers = Annotated[Array, _validator(read_vector, ()), _AsList]
Vector3 = Annotated[Array, _validator(read_vector, (3,)), _AsList]
Vector4 = Annotated[Array, _validator(read_vector, (4,)), _AsList]
Matrix33 = Annotated[Array, _validator(_read_matrix, 3, 3)]
Matrix34 = Annotated[Array, _validator(_read_matrix, 3, 4)]
Turn = Annotated[Rotation, _validator(_read_rotation)]
Pose = Annotated[RigidTransform, _validator(_read_pose)]


def read_bytes(path: Path, largest: int = _MAX_BYTES) -> bytes:
    """The content of a file of limited size.

    Raises:
        CalibrationError: there is no such file, or it is larger.
    """
    with file_faults(path, CalibrationError), ordinary_file(path, None).open("rb") as file:
        content = file.read(largest + 1)
    _check_size(path, content, largest)
    return content


def _check_size(path: Path, content: bytes, largest: int) -> None:
    if len(content) > largest:
        raise CalibrationError(
            f"{path}: more than {largest >> 20} MiB: no calibration file is that large"
        )


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
        start, end = map(re.escape, skipped)
        content = re.sub(start + b".*?" + end, b"", content, flags=re.DOTALL)
        _check_size(path, content, _MAX_BYTES)
    try:
        text = content.decode("utf-8-sig")
        refuse_declarations(text)
    except UnicodeDecodeError:
        raise CalibrationError(f"{path}: is not UTF-8 text") from None
    except ValueError as error:
        raise CalibrationError(f"{path}: {error}") from None
    if "\0" in text:
        raise CalibrationError(f"{path}: is not text")
    if len(re.findall(r"[\[{]|<[A-Za-z_]", text)) > _MAX_PARTS:
        raise CalibrationError(f"{path}: has more than {_MAX_PARTS} parts: no calibration file")
    return text


def camera_name(path: Path, name: str) -> str:
    """A name that is safe as a file name.

    Raises:
        CalibrationError: other characters than letters, digits, `_`, `.` and `-`.
    """
    if not _NAME.fullmatch(name):
        raise CalibrationError(
            f"{path}: camera name {name!r} needs letters, digits, _ . - only: choose with --names"
        )
    return name


def plain_name(name: str) -> str:
    """A name of a file made safe as a file name: other characters become underscores."""
    plain = re.sub(r"[^A-Za-z0-9_.-]", "_", name.strip("/"))
    return plain.lstrip("_.-") or "cam0"


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


def read_documents(path: Path) -> list[dict[str, Any]]:
    """The documents of a YAML file, mappings all, or the one of a file of OpenCV's FileStorage.

    Raises:
        CalibrationError: the file is missing, of neither kind, or not a mapping of text keys.
    """
    text = read_text(path)
    if not text.strip():
        raise CalibrationError(f"{path}: is empty")
    if path.suffix.lower() == ".json":
        values = read_json_values(path)
        return [_mapping(path, one) for one in (values if isinstance(values, list) else [values])]
    if path.suffix.lower() not in PLAIN or "!!opencv-matrix" in text:
        return [_read_storage(path, text)]
    text = re.sub(r"^%YAML:.*", "", text)  # OpenCV's first line is not that of YAML
    try:
        found = [one for one in yaml.load_all(text, Loader=_PlainLoader) if one is not None]
    except (yaml.YAMLError, RecursionError, ValueError, TypeError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark is not None else ""
        what = getattr(error, "problem", None) or type(error).__name__
        raise CalibrationError(f"{path}: not valid YAML{where}: {_one_line(what)}") from None
    return [_mapping(path, one) for one in found or [None]]


def read_values(path: Path) -> dict[str, Any]:
    """The one document of a file, as of `read_documents`.

    Raises:
        CalibrationError: as of `read_documents`, or there are several.
    """
    found = read_documents(path)
    if len(found) > 1:
        raise CalibrationError(f"{path}: {len(found)} YAML documents; 1 expected")
    return found[0]


def yaml_files(folder: Path) -> list[Path]:
    """The YAML files of a folder, or those of its cameras as EuRoC's data sets have them."""
    patterns = ("cam*/sensor.yaml", "mav0/cam*/sensor.yaml", "*.[yY]*[mM][lL]")
    return next((files for each in patterns if (files := sorted(folder.glob(each)))), [])


def write_yaml(path: Path, document: Any) -> None:
    """Write a YAML file, lists of numbers on one line each."""
    with atomic_path(path) as temporary:
        text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=1000)
        temporary.write_text(text, encoding="utf-8")


def read_json_values(path: Path) -> Any:
    """The value of a JSON file.

    Raises:
        CalibrationError: the file is missing or not JSON.
    """
    try:
        return json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"{path}: not valid JSON: {_one_line(str(error))}") from None


def _read_storage(path: Path, text: str) -> dict[str, Any]:
    """Values of OpenCV's YAML, XML or JSON; matrices are `{rows, cols, dt, data}`."""
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


def write_storage(path: Path, values: Mapping[str, Any]) -> None:
    """Write what `read_documents` reads: arrays, numbers, texts and lists of texts."""
    suffix = ".xml" if path.suffix.lower() == ".xml" else ".yml"
    storage = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)

    for key, value in values.items():
        if isinstance(value, list):
            storage.startWriteStruct(key, cv2.FileNode_SEQ)
            for text in value:
                storage.write("", text)
            storage.endWriteStruct()
        else:
            storage.write(key, value)
    with atomic_path(path) as temporary:
        temporary.write_text(storage.releaseAndGetString(), encoding="utf-8")


def _mapping(path: Path, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise CalibrationError(f"{path}: is not a mapping of keys to values")
    return value


def _one_line(text: str) -> str:
    return " ".join(text.split())[:200]
