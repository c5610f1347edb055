"""OpenCV's FileStorage: YAML and XML with the keys of its calibration and stereo samples.

One camera has `camera_matrix` and `distortion_coefficients` (also of ROS and of MATLAB's exports),
two have `M1 D1 M2 D2` and the second's pose `R T` in the first (x2 = R x1 + T), as the sample
`stereo_calib.cpp` names them; `camera_names` is a key of our own. Four coefficients
are k1 k2 p1 p2 of a pinhole or k1 to k4 of `cv2.fisheye`: `distortion_model` (with 1 or 2 where the
lenses of a pair differ) or the caller says which; without either it is a pinhole.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import Field
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import CalibrationError, warn
from camera_calib.camera import Camera
from camera_calib.formats import fields, opencv_model, rigs
from camera_calib.rig import Rig

_KEYS: Mapping[str, tuple[str, ...]] = {
    "camera_matrix": ("camera_matrix", "cameraMatrix", "Camera_Matrix", "M", "K"),
    "distortion_coefficients": (
        "distortion_coefficients", "distCoeffs", "Distortion_Coefficients", "D"
    ),
    "distortion_model": ("distortion_model",),
    "image_width": ("image_width", "image_Width"),
    "image_height": ("image_height", "image_Height"),
}  # fmt: skip
"""Other keys of what a camera has; of a pair they end in the camera's number."""
_OF_BOTH = ("distortion_model", "image_width", "image_height")
"""May be stated once for both."""


class _OpenCVCamera(fields.FileModel):
    camera_matrix: fields.Matrix33
    distortion_coefficients: fields.Numbers | None = None
    distortion_model: str | None = None
    image_width: fields.Pixels | None = None
    image_height: fields.Pixels | None = None


class _PairPose(fields.FileModel):
    rotation: fields.Turn = Field(alias="R")
    shift: fields.Vector3 = Field(alias="T")


class _Names(fields.FileModel):
    camera_name: str | None = None
    camera_names: list[str] | str | None = None
    """OpenCV's XML has no other way to write a list of one than its text."""


def read_opencv(path: Path, reading: rigs.ReadOptions) -> Rig:
    """Read one camera or a stereo pair.

    Raises:
        CalibrationError: a key is missing or wrong; the message names file and key.
    """
    values = fields.read_storage(path)
    if {"port", "port1", "port2", "covariance"} & set(values):
        raise CalibrationError(
            f"{path}: holds ports or a covariance, as versions before 0.2 wrote them: use "
            "rig.json, or remove these keys and state the port with --port-distance and --glass"
        )
    single = any(key in values for key in _KEYS["camera_matrix"])
    numbers = [""] if single else ["1", "2"]
    cameras = [_camera(path, values, number, reading) for number in numbers]
    poses = list(rigs.ONE)
    if not single:
        other = values if reading.extrinsics is None else fields.read_storage(reading.extrinsics)
        if reading.extrinsics is None and not {"R", "T"} & set(values):
            raise CalibrationError(
                f"{path}: lacks R and T of the second camera: name the file that holds them with "
                "--extrinsics"
            )
        pose = _PairPose.check(reading.extrinsics or path, other)
        poses.append(RigidTransform.from_components(pose.shift, pose.rotation))
    found = _Names.check(path, values)
    usual = ["cam0"] if single else ["left", "right"]
    stated = found.camera_names or (found.camera_name if single else None) or usual
    names = [stated] if isinstance(stated, str) else stated
    if len(names) != len(cameras):
        raise CalibrationError(
            f"{path}: camera_names has {len(names)} names for {len(cameras)} cameras"
        )
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


def _camera(
    path: Path, values: Mapping[str, Any], number: str, reading: rigs.ReadOptions
) -> Camera:
    own = {}
    for field, names in _KEYS.items():
        ends = (number, "") if field in _OF_BOTH else (number,)
        known = [name + end for end in ends for name in names if name + end in values]
        if known:
            own[field] = values[known[0]]
    if "camera_matrix" not in own:
        raise CalibrationError(
            f"{path}: lacks camera_matrix, or M{number or 1} of a stereo pair: is it a calibration?"
        )
    prefix = f"camera {number}: " if number else ""
    found = _OpenCVCamera.check(path, own, prefix)
    k, model = found.distortion_coefficients, found.distortion_model
    name, where = model or reading.lens or "opencv", f"{path}: {prefix}"
    if name not in opencv_model.LENS_NAMES:
        key = "--lens" if model is None else "distortion_model"
        lenses = ", ".join(opencv_model.LENS_NAMES)
        raise CalibrationError(f"{where}{key} is {name}; {lenses} can be read")
    if k is not None and len(k) == 4 and model is None and reading.lens is None:
        warn(f"{where}4 coefficients taken for k1 k2 p1 p2: a fisheye needs --lens fisheye")
    size = (found.image_width or 0, found.image_height or 0)
    size = size if all(size) else reading.size(path)
    lens, key = opencv_model.LENS_NAMES[name], f"{where}camera_matrix"
    return opencv_model.camera_of_matrix(key, found.camera_matrix, k, size, lens)


def _owns(path: Path) -> bool:
    if path.is_dir() or path.suffix.lower() == ".json":
        return False
    text = fields.read_text(path)
    marked = text.startswith("%YAML:1.") or "!!opencv-matrix" in text
    return marked or path.suffix.lower() == ".xml"


FORMAT = rigs.CalibrationFormat(
    name="opencv",
    title="OpenCV YAML or XML",
    holds=rigs.PINHOLE,
    owns=_owns,
    read=read_opencv,
    write=write_opencv,
    suffix=".xml",
    max_cameras=2,
)
