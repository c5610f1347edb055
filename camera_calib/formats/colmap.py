"""COLMAP's models and rig configurations, and the cameras of Refractive COLMAP.

A folder holds `cameras.txt` (or `.bin`) and `rig_config.json`, which gives names (folders of
pictures) and poses; for COLMAP also the other files of a model without pictures, so that it opens
there. `rig_config.json` is https://colmap.github.io/rigs.html; Refractive COLMAP, a fork of 3.10,
has that version's: cameras by `camera_id`, the reference by `ref_camera_id`.

Without it the model's own `rigs.txt` or `rigs.bin` say which cameras form a rig
(https://colmap.github.io/format.html): `RIG_ID NUM_SENSORS REF_SENSOR_TYPE REF_SENSOR_ID`, then
for each other sensor `SENSOR_TYPE SENSOR_ID HAS_POSE [QW QX QY QZ TX TY TZ]`. They are read here
and not by pycolmap, which needs the whole model and accepts a file that is cut short.
"""

import math
import struct
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from pydantic import Field
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.artefacts import write_json
from alice_survey.core.errors import CalibrationError, warn
from camera_calib.formats import fields, rigs
from camera_calib.formats.camera_files import (
    MODELS,
    CameraRecord,
    camera_of_record,
    read_records,
    record_of,
    write_records,
)
from camera_calib.ports.dome import DomePort
from camera_calib.ports.flat import FlatPort
from camera_calib.rig import Rig

CAMERA_FILES = ("cameras.bin", "cameras.txt")
RIG_CONFIG = "rig_config.json"
_Tie = tuple[CameraRecord, str, RigidTransform]
_CAMERA = 0
_TYPES = {"CAMERA": _CAMERA, "IMU": 1}
_POSE = 7
PosesById = Mapping[int, RigidTransform]
"""Poses sensor_from_rig by CAMERA_ID, the reference's first; cameras without a pose are absent."""
_REFERENCE: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class _ConfigCamera(fields.FileModel):
    """A camera of a rig configuration."""

    camera_id: int | None = None
    image_prefix: str = ""
    ref_sensor: bool | None = None
    turn: fields.Vector4 | None = Field(None, alias="cam_from_rig_rotation")
    """Quaternion w x y z."""
    shift: fields.Vector3 | None = Field(None, alias="cam_from_rig_translation")
    camera_model_name: str | None = None
    camera_params: fields.Numbers | None = None

    @property
    def name(self) -> str:
        """Its folder of pictures."""
        return self.image_prefix.strip("/") or "cam"


class _RigConfig(fields.FileModel):
    ref_camera_id: int | None = None
    cameras: list[_ConfigCamera]


def read_colmap(path: Path, reading: rigs.ReadOptions) -> Rig:
    """Read a model's cameras, of COLMAP or Refractive COLMAP, and what ties them to a rig.

    Args:
        path: folder of a model, its cameras.txt or cameras.bin, or a rig_config.json.
        reading: picture size, for a rig_config.json without a model, and the camera to read.

    Raises:
        CalibrationError: a file is malformed, or several cameras have no common rig.
    """
    file = _camera_file(path)
    if file is None:
        return _from_config_alone(path, reading)
    folder = file.parent
    records = read_records(file)
    config = folder / RIG_CONFIG
    ties = _config_ties(config, records) if config.exists() else _model_ties(file, records)
    if not ties:
        chosen = [r for r in records if str(r.camera_id) == reading.camera or len(records) == 1]
        if len(chosen) != 1:
            ids = ", ".join(str(record.camera_id) for record in records)
            raise CalibrationError(
                f"{file}: cameras {ids} have no common rig: choose one with --camera, "
                f"or put {RIG_CONFIG} next to it"
            )
        ties = [(chosen[0], str(chosen[0].camera_id), RigidTransform.identity())]
    cameras = [camera_of_record(file, record) for record, _, _ in ties]
    tool = "Refractive COLMAP" if any(record.refraction for record, _, _ in ties) else "COLMAP"
    names = [name for _, name, _ in ties]
    return rigs.assemble(path, reading, tool, names, cameras, [pose for _, _, pose in ties])


def write_colmap(path: Path, rig: Rig) -> list[Path]:
    """Write a model without pictures and the rig configuration.

    Args:
        path: folder, or the cameras.txt or cameras.bin in it; text when it does not say.
        rig: cameras without ports.
    """
    folder, file = _target(path)
    model = pycolmap.Reconstruction()
    sensors = pycolmap.Rig(rig_id=1)
    entries = []
    for i, (name, camera) in enumerate(rig.cameras.items(), start=1):
        record = record_of(i, camera, port=False)
        colmap = pycolmap.Camera(
            camera_id=i,
            model=record.model,
            width=record.width_px,
            height=record.height_px,
            params=np.array(record.params),
        )
        model.add_camera(colmap)
        pose = rig.cam_from_rig[name]
        if i == 1:
            sensors.add_ref_sensor(colmap.sensor_id)
        else:
            rigid = pycolmap.Rigid3d(
                pycolmap.Rotation3d(pose.rotation.as_quat()), np.array(pose.translation)
            )
            sensors.add_sensor(colmap.sensor_id, rigid)
        entries.append(
            _ConfigCamera(
                image_prefix=f"{name}/",
                ref_sensor=True if i == 1 else None,
                **({} if i == 1 else _pose_values(pose)),
                camera_model_name=record.model,
                camera_params=list(record.params),
            ).values()
        )
    model.add_rig(sensors)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".model") as temporary:
        (model.write_binary if file.suffix == ".bin" else model.write_text)(temporary)
        written = [part.replace(folder / part.name) for part in sorted(Path(temporary).iterdir())]
    write_json(folder / RIG_CONFIG, [{"cameras": entries}])
    return [*written, folder / RIG_CONFIG]


def write_refractive(path: Path, rig: Rig) -> list[Path]:
    """Write cameras with the parameters of their ports and the rig configuration of COLMAP 3.10."""
    folder, file = _target(path)
    records = [record_of(i, c, port=True) for i, c in enumerate(rig.cameras.values(), start=1)]
    entries = [
        _ConfigCamera(camera_id=i, image_prefix=f"{name}/", **_pose_values(pose)).values()
        for i, (name, pose) in enumerate(rig.cam_from_rig.items(), start=1)
    ]
    write_records(file, records)
    write_json(folder / RIG_CONFIG, [{"ref_camera_id": 1, "cameras": entries}])
    return [file, folder / RIG_CONFIG]


def model_files(path: Path, _: Rig) -> list[Path]:
    """The files that writing to `path` would replace."""
    folder, file = _target(path)
    kinds = [file.with_stem(stem) for stem in ("cameras", "rigs", "frames", "images", "points3D")]
    return [*kinds, folder / RIG_CONFIG]


def _target(path: Path) -> tuple[Path, Path]:
    if path.name in CAMERA_FILES:
        folder, file = path.parent, path
    elif path.suffix in (".txt", ".bin", ".json"):
        raise CalibrationError(f"{path}: name a folder, or {' or '.join(CAMERA_FILES)} in it")
    else:
        folder, file = path, path / "cameras.txt"
    other = next(folder / name for name in CAMERA_FILES if name != file.name)
    if other.exists():
        raise CalibrationError(f"{other}: is there already, and COLMAP would read one of the two")
    return folder, file


def _camera_file(path: Path) -> Path | None:
    if path.is_dir() or path.name == RIG_CONFIG:
        folder = path if path.is_dir() else path.parent
        found = [folder / name for name in CAMERA_FILES if (folder / name).is_file()]
        if not found and path.is_dir() and not (path / RIG_CONFIG).is_file():
            raise CalibrationError(f"{path}: holds neither {' nor '.join(CAMERA_FILES)}")
        return found[0] if found else None
    return path


def _config_ties(path: Path, records: Sequence[CameraRecord]) -> list[_Tie]:
    """Each camera with its name and pose, the reference first, after a rig configuration."""
    entries = _read_config(path)
    free = list(records)
    ties = []
    for entry in entries:
        found = None
        if entry.camera_id is not None:
            found = next((r for r in free if r.camera_id == entry.camera_id), None)
        elif entry.camera_params is not None:
            model, params = _lens_of(path, entry)
            same = (r for r in free if r.model == model and np.allclose(r.params, params))
            found = next(same, None)
        elif len(records) == len(entries):
            found = free[0]
        if found is None:
            raise CalibrationError(f"{path}: image_prefix {entry.image_prefix} fits no camera")
        free.remove(found)
        ties.append((found, entry.name, _pose_of(path, entry)))
    if len(records) > 1 and any(e.camera_id is None and e.camera_params is None for e in entries):
        warn(f"{path}: its cameras carry no numbers: taken in the order of their CAMERA_ID")
    return ties


def _model_ties(file: Path, records: Sequence[CameraRecord]) -> list[_Tie]:
    """The same after the model's own rigs; empty when none holds all cameras with poses."""
    rigs = file.with_stem("rigs")
    if len(records) == 1 or not rigs.exists():
        return []
    by_id = {record.camera_id: record for record in records}
    for poses in read_rigs(rigs):
        if set(poses) == set(by_id):
            return [(by_id[i], f"cam{i}", pose) for i, pose in poses.items()]
    return []


def _from_config_alone(path: Path, reading: rigs.ReadOptions) -> Rig:
    file = path / RIG_CONFIG if path.is_dir() else path
    entries = _read_config(file)
    width, height = reading.size(file)
    cameras = []
    for i, entry in enumerate(entries, start=1):
        model, params = _lens_of(file, entry)
        record = CameraRecord(
            camera_id=i, model=model, width_px=width, height_px=height, params=params
        )
        cameras.append(camera_of_record(file, record))
    poses = [_pose_of(file, entry) for entry in entries]
    return rigs.assemble(file, reading, "COLMAP", [entry.name for entry in entries], cameras, poses)


def _read_config(path: Path) -> list[_ConfigCamera]:
    """Cameras of a rig configuration, the reference first."""
    rigs = fields.read_json_values(path)
    if not isinstance(rigs, list) or len(rigs) != 1:
        raise CalibrationError(f"{path}: a list of one rig expected")
    rig = _RigConfig.check(path, rigs[0])
    references = [
        entry
        for entry in rig.cameras
        if entry.ref_sensor
        or (rig.ref_camera_id is not None and entry.camera_id == rig.ref_camera_id)
    ]
    if len(references) != 1:
        raise CalibrationError(
            f"{path}: cameras has {len(references)} reference cameras; 1 expected"
        )
    return [references[0], *(entry for entry in rig.cameras if entry is not references[0])]


def _lens_of(path: Path, entry: _ConfigCamera) -> tuple[str, tuple[float, ...]]:
    model, params = entry.camera_model_name, entry.camera_params
    if model not in MODELS:
        raise CalibrationError(
            f"{path}: camera_model_name {model}: {', '.join(MODELS)} can be read"
        )
    if params is None or len(params) != len(MODELS[model][1]):
        raise CalibrationError(f"{path}: camera_params are not those of {model}")
    return model, tuple(params.tolist())


def _pose_of(path: Path, entry: _ConfigCamera) -> RigidTransform:
    if entry.ref_sensor:
        return RigidTransform.identity()
    if entry.turn is None or abs(np.linalg.norm(entry.turn) - 1.0) > 1e-3:
        raise CalibrationError(
            f"{path}: cam_from_rig_rotation of {entry.name} is not a unit quaternion w x y z"
        )
    if entry.shift is None:
        raise CalibrationError(f"{path}: lacks cam_from_rig_translation of {entry.name}")
    turn = Rotation.from_quat(entry.turn, scalar_first=True)
    return RigidTransform.from_components(entry.shift, turn)


def _pose_values(pose: RigidTransform) -> dict[str, Any]:
    turn = pose.rotation.as_quat(canonical=True, scalar_first=True)
    return {"turn": turn.tolist(), "shift": pose.translation.tolist()}


def read_rigs(path: Path) -> list[PosesById]:
    """The rigs of a model.

    Args:
        path: rigs.txt or rigs.bin.

    Raises:
        CalibrationError: the file is malformed.
    """
    is_binary = path.suffix == ".bin"
    content = fields.read_bytes(path) if is_binary else b""
    lines = [] if is_binary else fields.read_text(path).splitlines()
    words = [word for line in lines if line.strip()[:1] != "#" for word in line.split()]
    at = 0

    def take(form: str) -> tuple[Any, ...]:
        """The next values: `I` numbers, `i` a type of sensor, `B` a flag, `d` floats."""
        nonlocal at
        if is_binary:
            values = struct.unpack_from(f"<{form}", content, at)
            at += struct.calcsize(f"<{form}")
            return values
        kinds = _POSE * "d" if form == f"{_POSE}d" else form
        read: Mapping[str, Callable[[str], float]] = {"d": float, "i": _TYPES.__getitem__}
        values = tuple(read.get(kind, int)(words[at + i]) for i, kind in enumerate(kinds))
        at += len(kinds)
        return values

    try:
        left = take("Q")[0] if is_binary else None
        rigs: list[PosesById] = []
        while at < len(words) if left is None else len(rigs) < left:
            rigs.append(_take_rig(take))
        if is_binary and at != len(content):
            raise ValueError("more bytes than rigs")
    except (struct.error, ValueError, IndexError, KeyError, OverflowError):
        raise CalibrationError(f"{path}: is not a {path.name} of COLMAP") from None
    return rigs


def _take_rig(take: Callable[[str], tuple[Any, ...]]) -> PosesById:
    """The cameras of the next rig that have a pose, the reference first."""
    poses: dict[int, RigidTransform] = {}
    _, count = take("II")
    for i in range(count):
        kind, number = take("iI")
        pose = _REFERENCE
        if i > 0:
            pose = take(f"{_POSE}d") if take("B")[0] else ()
        if kind != _CAMERA or not pose:
            continue
        turn, shift = pose[:4], pose[4:]
        if not all(map(math.isfinite, pose)) or abs(math.hypot(*turn) - 1.0) > 1e-3:
            raise ValueError("no pose")
        poses[number] = RigidTransform.from_components(
            np.array(shift), Rotation.from_quat(turn, scalar_first=True)
        )
    return poses


def _owns(path: Path) -> bool:
    if path.is_dir():
        names = (*CAMERA_FILES, RIG_CONFIG)
        found = [path / name for name in names if (path / name).is_file()]
        return bool(found) and _owns(found[0])
    suffix = path.suffix.lower()
    if suffix == ".json":
        return fields.read_text(path).lstrip().startswith("[")
    return suffix in (".txt", ".bin") and not any(r.refraction for r in read_records(path))


def _owns_refractive(path: Path) -> bool:
    if path.is_dir():
        found = [path / name for name in CAMERA_FILES if (path / name).is_file()]
        return bool(found) and _owns_refractive(found[0])
    suffixes = (".txt", ".bin")
    return path.suffix.lower() in suffixes and any(r.refraction for r in read_records(path))


FORMAT = rigs.CalibrationFormat(
    name="colmap",
    title="COLMAP model and rig_config.json",
    holds=frozenset({rigs.K3, rigs.RATIONAL, rigs.FISHEYE}),
    owns=_owns,
    read=read_colmap,
    write=write_colmap,
    files=model_files,
)
REFRACTIVE = rigs.CalibrationFormat(
    name="refractive",
    title="Refractive COLMAP cameras with FLATPORT or DOMEPORT",
    holds=FORMAT.holds | {FlatPort.shape, DomePort.shape},
    owns=_owns_refractive,
    read=read_colmap,
    write=write_refractive,
    files=model_files,
)
