"""OpenCV's FileStorage: YAML and XML with the keys of its calibration and stereo samples.

One camera has `camera_matrix` and `distortion_coefficients` (also of ROS and of MATLAB's exports),
two have `M1 D1 M2 D2` and the second's pose `R T` in the first (x2 = R x1 + T), as the sample
`stereo_calib.cpp` names them; `camera_names` is a key of our own. Four coefficients
are k1 k2 p1 p2 of a pinhole or k1 to k4 of `cv2.fisheye`: `distortion_model` (with 1 or 2 where the
lenses of a pair differ) or the caller says which; without either it is a pinhole. Values of a pair
without a number are those of both cameras.

Matisse (github.com/IfremerUnderwater/Matisse) calibrates with OpenCV and writes the same with keys
of its own: models 0 to 2 are pinholes, 3 a fisheye; three coefficients are k1 k2 k3.
"""

from pathlib import Path
from typing import Any

from pydantic import Field
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import CalibrationError
from camera_calib.formats import fields, opencv_model, rigs
from camera_calib.rig import Rig


class _PairPose(fields.FileModel):
    rotation: fields.Turn = Field(alias="R")
    shift: fields.Vector3 = Field(alias="T")


def read_opencv(path: Path, reading: rigs.ReadOptions) -> Rig:
    """Read one camera or a stereo pair.

    Raises:
        CalibrationError: a key is missing or wrong; the message names file and key.
    """
    values = fields.read_values(path)
    single = any(key in values for key in opencv_model.MATRIX)
    cameras, read, model = [], set[str]() if single else {"R", "T"}, opencv_model.CameraKeys
    for number in ("",) if single else ("1", "2"):
        keys = {key + end: key for end in ("", number) for key in model.known_keys()}
        own = {key: values[name] for name, key in keys.items() if name in values}
        prefix, read = f"camera {number}: " if number else "", read | set(keys)
        found = model.check(path, own, prefix)
        cameras.append(found.camera(path, prefix, reading))
    fields.name_unread(path, (key for key in values if key not in read))
    poses = list(rigs.ONE)
    if not single:
        other = values if reading.extrinsics is None else fields.read_values(reading.extrinsics)
        if reading.extrinsics is None and not {"R", "T"} & set(values):
            raise CalibrationError(f"{path}: lacks R and T: name their file with --extrinsics")
        pose = _PairPose.check(reading.extrinsics or path, other)
        poses.append(RigidTransform.from_components(pose.shift, pose.rotation))
    stated = found.names or ([found.name or "cam0"] if single else ["left", "right"])
    names = [stated] if isinstance(stated, str) else stated
    if len(names) != len(cameras):
        raise CalibrationError(f"{path}: camera_names: {len(names)}; {len(cameras)} expected")
    return rigs.assemble(path, reading, "OpenCV", names, cameras, poses)


def write_opencv(path: Path, rig: Rig) -> list[Path]:
    """Write one camera or two as YAML, or as XML when the path ends so."""
    single = len(rig.cameras) == 1
    cameras = [("" if single else str(i), c) for i, c in enumerate(rig.cameras.values(), start=1)]
    sizes = {(camera.width_px, camera.height_px) for _, camera in cameras}
    values: dict[str, Any] = {}
    for number, camera in cameras[: len(sizes)]:
        end = number if len(sizes) > 1 else ""
        values |= {f"image_width{end}": camera.width_px, f"image_height{end}": camera.height_px}
    for number, camera in cameras:
        matrix, k = ("camera_matrix", "distortion_coefficients") if single else ("M", "D")
        values |= {f"{matrix}{number}": opencv_model.camera_matrix(camera)}
        values |= {f"{k}{number}": opencv_model.distortion(camera)[None]}
        if opencv_model.is_fisheye(camera):
            values[f"distortion_model{number}"] = opencv_model.FISHEYE
    if not single:
        pose = list(rig.cam_from_rig.values())[1]
        values |= {"R": pose.rotation.as_matrix(), "T": pose.translation[:, None]}
    values["camera_names"] = list(rig.cameras)
    fields.write_storage(path, values)
    return [path]
