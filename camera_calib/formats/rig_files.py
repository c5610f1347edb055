"""COLMAP's rigs.txt and rigs.bin: which cameras of a model form a rig, and their poses in it.

https://colmap.github.io/format.html: `RIG_ID NUM_SENSORS REF_SENSOR_TYPE REF_SENSOR_ID`, then for
each other sensor `SENSOR_TYPE SENSOR_ID HAS_POSE [QW QX QY QZ TX TY TZ]`. Read here and not by
pycolmap, which would need the whole model and trusts what it reads.
"""

import math
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.errors import CalibrationError
from camera_calib.formats.fields import read_bytes, read_text

_CAMERA = 0
_TYPES = {"CAMERA": _CAMERA, "IMU": 1}
_POSE = 7

PosesById = Mapping[int, RigidTransform]
"""Poses sensor_from_rig by CAMERA_ID, the reference's first; cameras without a pose are absent."""


def read_rigs(path: Path) -> list[PosesById]:
    """The rigs of a model.

    Args:
        path: rigs.txt or rigs.bin.

    Raises:
        CalibrationError: the file is malformed.
    """
    try:
        rows = _binary_rows(path) if path.suffix == ".bin" else _text_rows(path)
        return [_poses(row) for row in rows]
    except (struct.error, ValueError, IndexError, KeyError, OverflowError):
        raise CalibrationError(f"{path}: is no {path.name} of COLMAP") from None


_Sensor = tuple[int, int, tuple[float, ...]]
"""Type, number, and the seven numbers of its pose; none when it has no pose."""


def _poses(sensors: list[_Sensor]) -> PosesById:
    poses: dict[int, RigidTransform] = {}
    for kind, number, pose in sensors:
        if kind != _CAMERA or not pose:
            continue
        w, x, y, z, *shift = pose
        if not all(map(math.isfinite, pose)) or abs(math.hypot(w, x, y, z) - 1.0) > 1e-3:
            raise ValueError("no pose")
        poses[number] = RigidTransform.from_components(
            np.array(shift), Rotation.from_quat([x, y, z, w])
        )
    return poses


_REFERENCE = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def _text_rows(path: Path) -> list[list[_Sensor]]:
    rows: list[list[_Sensor]] = []
    for line in read_text(path).splitlines():
        items = line.split()
        if not items or items[0].startswith("#"):
            continue
        count = int(items[1])
        sensors: list[_Sensor] = [(_TYPES[items[2]], int(items[3]), _REFERENCE)] if count else []
        at = 4
        for _ in range(min(count, len(items)) - 1):
            length = _POSE if items[at + 2] == "1" else 0
            pose = tuple(map(float, items[at + 3 : at + 3 + length]))
            if len(pose) != length:
                raise ValueError("pose cut short")
            sensors.append((_TYPES[items[at]], int(items[at + 1]), pose))
            at += 3 + length
        rows.append(sensors)
    return rows


def _binary_rows(path: Path) -> list[list[_Sensor]]:
    content = read_bytes(path)
    (rigs,) = struct.unpack_from("<Q", content)
    at = 8
    rows: list[list[_Sensor]] = []
    for _ in range(min(rigs, len(content))):
        _, count = struct.unpack_from("<II", content, at)
        at += 8
        sensors: list[_Sensor] = []
        for i in range(min(count, len(content))):
            kind, number = struct.unpack_from("<iI", content, at)
            at += 8
            pose: tuple[float, ...] = _REFERENCE
            if i > 0:
                has_pose = content[at]
                at += 1
                pose = struct.unpack_from(f"<{_POSE}d", content, at) if has_pose else ()
                at += 8 * len(pose)
            sensors.append((kind, number, pose))
        rows.append(sensors)
    if at != len(content):
        raise ValueError("more bytes than rigs")
    return rows
