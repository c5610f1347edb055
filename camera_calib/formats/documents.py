"""YAML, OpenCV's FileStorage and JSON as plain values: nothing expands, nothing is constructed."""

import json
import re
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import cv2
import yaml

from alice_survey.base.errors import CalibrationError
from camera_calib.formats.fields import Fields, read_text


class _PlainLoader(yaml.SafeLoader):  # type: ignore[misc]
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


def read_yaml(path: Path) -> Fields:
    """A YAML file whose top is a mapping.

    Raises:
        CalibrationError: the file is missing, not YAML, or not a mapping of text keys.
    """
    text = read_text(path)
    try:
        value = yaml.load(text, Loader=_PlainLoader)  # noqa: S506 - a SafeLoader
    except (yaml.YAMLError, RecursionError, ValueError, TypeError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark is not None else ""
        what = getattr(error, "problem", None) or type(error).__name__
        raise CalibrationError(f"{path}: not valid YAML{where}: {_one_line(what)}") from None
    return _mapping(path, value)


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
        CalibrationError: the file is missing, is not such a file, declares a document type (XML
            entities), or repeats a key.
    """
    text = read_text(path)
    if re.search(r"<!\s*(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise CalibrationError(f"{path}: declares a DOCTYPE or ENTITY, which is refused")
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
