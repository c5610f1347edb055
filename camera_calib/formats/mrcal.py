"""mrcal's .cameramodel: a file for each camera, with its pose in a common frame.

https://mrcal.secretsauce.net/cameramodels.html: a Python literal, which without the packed
`optimization_inputs` is YAML too. The pinhole models are read and written: intrinsics fx fy cx cy
and OpenCV's coefficients, pixels counted from the centre of the first one. `extrinsics` is a
rotation vector and a translation that take points of the reference to the camera.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.errors import CalibrationError
from camera_calib.camera import Camera
from camera_calib.formats.fields import Fields, read_yaml
from camera_calib.formats.opencv_model import camera_matrix, counted_from_centre, distortion
from camera_calib.formats.rigs import ReadOptions, assemble, file_each
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.rig import Rig

SUFFIX = ".cameramodel"
_COUNTS = {"LENSMODEL_PINHOLE": 0} | {f"LENSMODEL_OPENCV{count}": count for count in (4, 5, 8, 12)}
"""Distortion coefficients by model."""
_PACKED = (b": b'", b"'")
"""Marks around all that was measured for a calibration."""


def read_mrcal(path: Path, reading: ReadOptions) -> Rig:
    """Read a file of one camera, or a folder of those of a rig.

    Raises:
        CalibrationError: a key is missing or wrong, or a model is none of OpenCV's.
    """
    files = sorted(path.glob(f"*{SUFFIX}")) if path.is_dir() else [path]
    if not files:
        raise CalibrationError(f"{path}: holds no {SUFFIX}")
    every = [read_yaml(file, _PACKED) for file in files]
    return assemble(
        path,
        reading,
        "mrcal",
        [file.stem for file in files] if path.is_dir() else ["cam0"],
        [_camera(fields) for fields in every],
        [_pose(fields) for fields in every],
    )


def write_mrcal(path: Path, rig: Rig) -> list[Path]:
    """Write a file of one camera, or into a folder those of a rig."""
    files = mrcal_files(path, rig)
    for file, (name, camera) in zip(files, rig.cameras.items(), strict=True):
        k = distortion(camera)
        k = k[: 0 if not np.any(k) else 4 if not np.any(k[4:]) else k.size]
        pose = rig.cam_from_rig[name]
        matrix = camera_matrix(camera)
        numbers = {
            "intrinsics": [*matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *k],
            "extrinsics": [*pose.rotation.as_rotvec(), *pose.translation],
            "imagersize": [camera.width_px, camera.height_px],
        }
        model = f"LENSMODEL_OPENCV{k.size}" if k.size else "LENSMODEL_PINHOLE"
        lines = [f"    'lensmodel': '{model}',"]
        for key, values in numbers.items():
            lines.append(f"    '{key}': [ {', '.join(str(value) for value in values)} ],")
        with atomic_path(file) as temporary:
            temporary.write_text("\n".join(["{", *lines, "}", ""]), encoding="utf-8")
    return files


def mrcal_files(path: Path, rig: Rig) -> list[Path]:
    """The files that writing a rig would replace."""
    return file_each(path, rig, SUFFIX)


def _camera(fields: Fields) -> Camera:
    model = fields.text("lensmodel")
    if model not in _COUNTS:
        raise fields.fault("lensmodel", f"is {model[:60]}; {', '.join(_COUNTS)} can be read")
    width, height = fields.numbers("imagersize", 2).tolist()
    size = Fields(path=fields.path, prefix="imagersize: ", values={"w": width, "h": height})
    numbers = fields.numbers("intrinsics", 4 + _COUNTS[model])
    return counted_from_centre(
        fields, "intrinsics", (size.size("w"), size.size("h")), OpenCVLens, numbers[:4], numbers[4:]
    )


def _pose(fields: Fields) -> RigidTransform:
    numbers = fields.numbers("extrinsics", 6)
    return RigidTransform.from_components(numbers[3:], Rotation.from_rotvec(numbers[:3]))
