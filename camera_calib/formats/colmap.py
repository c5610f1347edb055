"""COLMAP's models and rig configurations, and the cameras of Refractive COLMAP.

A folder holds `cameras.txt` (or `.bin`) and `rig_config.json`, which gives names (folders of
pictures) and poses; for COLMAP also the other files of a model without pictures, so that it opens
there. `rig_config.json` is https://colmap.github.io/rigs.html; Refractive COLMAP, a fork of 3.10,
has that version's: cameras by `camera_id`, the reference by `ref_camera_id`.
"""

import os
import tempfile
from collections.abc import Sequence
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
from camera_calib.rig import Rig

CAMERA_FILES = ("cameras.bin", "cameras.txt")
RIG_CONFIG = "rig_config.json"
_Tie = tuple[CameraRecord, str, RigidTransform]


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
        path: folder of a model, or its cameras.txt, cameras.bin or rig_config.json.
        reading: the camera to read, of several without a common rig.

    Raises:
        CalibrationError: a file is malformed, or several cameras have no common rig.
    """
    file = _camera_file(path)
    folder = file.parent
    records = read_records(file)
    config = folder / RIG_CONFIG
    ties = _config_ties(config, records) if os.path.lexists(config) else []
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


def _camera_file(path: Path) -> Path:
    if not path.is_dir() and path.name != RIG_CONFIG:
        return path
    folder = path if path.is_dir() else path.parent
    found = [folder / name for name in CAMERA_FILES if os.path.lexists(folder / name)]
    if not found:
        raise CalibrationError(f"{path}: no {' or '.join(CAMERA_FILES)} in the folder")
    return found[0]


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


def _read_config(path: Path) -> list[_ConfigCamera]:
    """Cameras of a rig configuration, the reference first."""
    rigs = fields.read_json_values(path)
    if not isinstance(rigs, list) or len(rigs) != 1:
        raise CalibrationError(f"{path}: a list of one rig expected")
    rig = _RigConfig.check(path, rigs[0], "", ())
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
    if entry.turn is None or entry.shift is None or abs(np.linalg.norm(entry.turn) - 1.0) > 1e-3:
        raise CalibrationError(
            f"{path}: {entry.name} needs cam_from_rig_rotation, a unit quaternion w x y z, and "
            "cam_from_rig_translation"
        )
    turn = Rotation.from_quat(entry.turn, scalar_first=True)
    return RigidTransform.from_components(entry.shift, turn)


def _pose_values(pose: RigidTransform) -> dict[str, Any]:
    turn = pose.rotation.as_quat(canonical=True, scalar_first=True)
    return {"turn": turn.tolist(), "shift": pose.translation.tolist()}


def has_ports(path: Path) -> bool | None:
    """Whether a camera of a file or folder of these formats has a port; None for any other."""
    if path.is_dir():
        names = (*CAMERA_FILES, RIG_CONFIG)
        found = [path / name for name in names if os.path.lexists(path / name)]
        return has_ports(found[0]) if found else None
    suffix = path.suffix.lower()
    if suffix in (".txt", ".bin"):
        return any(record.refraction for record in read_records(path))
    return False if suffix == ".json" and fields.read_text(path).lstrip()[:1] == "[" else None
