"""YAML files of calibrations: Kalibr's chain and ROS's camera_info.

Kalibr's camchain YAML: pinhole cameras with radtan or equidistant distortion, in a chain.

The format is that of https://github.com/ethz-asl/kalibr/wiki/yaml-formats: `T_cn_cnm1` takes points
of the camera before (cam0 for cam1) to this camera, `radtan` has k1 k2 p1 p2 with OpenCV's meaning,
`equidistant` k1 to k4 of OpenCV's `fisheye`, and pixels count from the centre of the first one.

ROS's camera_info YAML: a file for each camera, as `camera_calibration_parsers` reads and writes.

Keys are those of http://wiki.ros.org/camera_calibration_parsers, their meaning that of
`sensor_msgs/CameraInfo`. A stereo pair has no pose as such: each camera has the rotation R to the
rectified pair (`rectification_matrix`), and the second's projection P has -f B in its last column.
From both follows the second camera's pose in the first, R2^T R1 and R2^T (P2[:, 3] / f).
"""

import re
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import CalibrationError, warn
from alice_survey.core.frames import Array
from camera_calib.camera import Camera
from camera_calib.formats import fields, opencv_model, rigs
from camera_calib.rig import Rig

_NOT_HELD = ("T_cam_imu", "T_imu_cam", "timeshift_cam_imu")
_TOPIC = re.compile(r"/(?P<name>[A-Za-z0-9][A-Za-z0-9_./-]*)/image_raw")
_YAML = (".yaml", ".yml")


class _KalibrCamera(fields.FileModel):
    pose: fields.Pose | None = Field(None, alias="T_cn_cnm1")
    cam_overlaps: tuple[int, ...] = ()
    camera_model: Literal["pinhole"]
    distortion_coeffs: fields.Numbers
    distortion_model: Literal["radtan", "equidistant", "none"]
    intrinsics: fields.Vector4
    resolution: tuple[fields.Pixels, fields.Pixels]
    rostopic: Any = None


def read_kalibr(path: Path, reading: rigs.ReadOptions) -> Rig:
    """Read a chain of cameras.

    Raises:
        CalibrationError: a key is missing or wrong, or a model is not held here.
    """
    top = fields.read_yaml(path)
    count = sum(f"cam{i}" in top for i in range(len(top)))
    if count == 0 or f"cam{count - 1}" not in top:
        raise CalibrationError(f"{path}: lacks cam0, or a camera of the chain is left out")
    cameras, poses, names = [], list(rigs.ONE), []
    for i in range(count):
        values, prefix = top[f"cam{i}"], f"cam{i}."
        one = _KalibrCamera.check(path, values, prefix)
        k = one.distortion_coeffs
        if len(k) != 4 and one.distortion_model != "none":
            raise CalibrationError(f"{path}: {prefix}distortion_coeffs: {len(k)}; 4 expected")
        numbers = [*one.intrinsics, *(() if one.distortion_model == "none" else k)]
        lens = opencv_model.LENS_NAMES[one.distortion_model]
        cameras.append(
            opencv_model.camera_of_numbers(
                f"{path}: {prefix}intrinsics", numbers, one.resolution, lens
            )
        )
        topic = _TOPIC.fullmatch(one.rostopic) if isinstance(one.rostopic, str) else None
        names.append(f"cam{i}" if topic is None else topic["name"])
        if i > 0:
            if one.pose is None:
                raise CalibrationError(f"{path}: lacks {prefix}T_cn_cnm1")
            poses.append(one.pose * poses[-1])
        left_out = [key for key in _NOT_HELD if key in values]
        if left_out:
            warn(f"{path}: cam{i}: {', '.join(left_out)} left out: a rig holds no IMU")
    return rigs.assemble(path, reading, "Kalibr", names, cameras, poses)


def write_kalibr(path: Path, rig: Rig) -> list[Path]:
    """Write a chain of cameras in the order of the rig."""
    names, chain = list(rig.cameras), {}
    for i, (name, camera) in enumerate(rig.cameras.items()):
        before = rig.cam_from_rig[names[max(i - 1, 0)]]
        chain[f"cam{i}"] = _KalibrCamera(
            pose=(rig.cam_from_rig[name] * before.inv()).as_matrix().tolist() if i else None,
            cam_overlaps=tuple(other for other in range(len(names)) if other != i),
            camera_model="pinhole",
            distortion_coeffs=opencv_model.distortion(camera)[:4].tolist(),
            distortion_model="equidistant" if opencv_model.is_fisheye(camera) else "radtan",
            intrinsics=opencv_model.focal_and_centre(camera),
            resolution=(camera.width_px, camera.height_px),
            rostopic=f"/{name}/image_raw",
        ).values()
    fields.write_yaml(path, chain)
    return [path]


KALIBR = rigs.CalibrationFormat(
    name="kalibr",
    title="Kalibr camchain YAML",
    holds=frozenset(),
    owns=lambda path: path.suffix.lower() in _YAML and "cam0" in fields.read_yaml(path),
    read=read_kalibr,
    write=write_kalibr,
)


_RosModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]
_ROS_COUNTS = {"plumb_bob": (0, 4, 5), "rational_polynomial": (0, 8, 12, 14), "equidistant": (0, 4)}


class _RosCamera(fields.FileModel):
    image_width: fields.Pixels
    image_height: fields.Pixels
    camera_name: str | None = None
    camera_matrix: fields.Matrix33
    distortion_model: _RosModel = "plumb_bob"
    distortion_coefficients: fields.Numbers
    rectification_matrix: fields.Turn | None = None
    projection_matrix: fields.Matrix34 | None = None

    @property
    def shift(self) -> Array:
        """(3,) last column of the projection: 0 of a first or only camera."""
        matrix = self.projection_matrix
        return np.zeros(3) if matrix is None else matrix[:, 3]


def read_ros(path: Path, reading: rigs.ReadOptions) -> Rig:
    """Read a file of one camera, or a folder that holds those of a stereo pair.

    Raises:
        CalibrationError: a key is missing or wrong, or the folder does not hold one or two files.
    """
    files = [path]
    if path.is_dir():
        files = [file for file in sorted(path.iterdir()) if file.suffix.lower() in _YAML]
        if not 1 <= len(files) <= 2:
            raise CalibrationError(f"{path}: {len(files)} .yaml files; 1, or 2 of a pair, expected")
    every = [(file, _RosCamera.check(file, fields.read_yaml(file))) for file in files]
    moved = [bool(np.any(one.shift)) for _, one in every]
    if len(every) == 1:
        if moved[0]:
            warn(f"{path}: baseline left out: give the folder of both files to read a pair")
        ((file, one),) = every
        names = [one.camera_name or "cam0"]
        return rigs.assemble(path, reading, "ROS", names, [_ros_camera(file, one)], rigs.ONE)
    if sum(moved) != 1:
        raise CalibrationError(
            f"{path}: one of two projection_matrix needs a baseline in its last column and the "
            f"other none; {sum(moved)} have one"
        )
    every = every if moved[1] else every[::-1]
    names = [one.camera_name or file.stem for file, one in every]
    poses = [*rigs.ONE, _second_from_first(*every)]
    return rigs.assemble(path, reading, "ROS", names, [_ros_camera(*one) for one in every], poses)


def write_ros(path: Path, rig: Rig) -> list[Path]:
    """Write a file of one camera."""
    ((name, camera),) = rig.cameras.items()
    k, matrix = opencv_model.distortion(camera), opencv_model.camera_matrix(camera)
    models: dict[int, _RosModel] = {4: "equidistant", 5: "plumb_bob"}
    values = _RosCamera(
        image_width=camera.width_px,
        image_height=camera.height_px,
        camera_name=name,
        camera_matrix=matrix.tolist(),
        distortion_model=models.get(k.size, "rational_polynomial"),
        distortion_coefficients=k.tolist(),
        rectification_matrix=np.eye(3).tolist(),
        projection_matrix=np.hstack([matrix, np.zeros((3, 1))]).tolist(),
    ).values()
    fields.write_yaml(path, values | {"distortion_coefficients": fields.matrix_of(k)})
    return [path]


def _ros_camera(file: Path, one: _RosCamera) -> Camera:
    k, model = one.distortion_coefficients, one.distortion_model
    if len(k) not in _ROS_COUNTS[model]:
        raise CalibrationError(f"{file}: distortion_coefficients: {len(k)} are none of a {model}")
    size, where = (one.image_width, one.image_height), f"{file}: camera_matrix"
    return opencv_model.camera_of_matrix(
        where, one.camera_matrix, k, size, opencv_model.LENS_NAMES[model]
    )


def _second_from_first(
    first: tuple[Path, _RosCamera], second: tuple[Path, _RosCamera]
) -> RigidTransform:
    turns = []
    for file, one in (first, second):
        if one.rectification_matrix is None:
            raise CalibrationError(f"{file}: lacks rectification_matrix")
        turns.append(one.rectification_matrix)
    matrix = second[1].projection_matrix
    if matrix is None or min(matrix[0, 0], matrix[1, 1]) <= 0 or matrix[2, 3] != 0:
        raise CalibrationError(
            f"{second[0]}: projection_matrix is not of the form [f 0 cx fTx; 0 f cy fTy; 0 0 1 0]"
        )
    baseline = matrix[:, 3] / [matrix[0, 0], matrix[1, 1], 1.0]
    back = turns[1].inv()
    return RigidTransform.from_components(back.apply(baseline), back * turns[0])


def _is_ros(path: Path) -> bool:
    if path.is_dir():
        files = [file for file in sorted(path.iterdir()) if file.suffix.lower() in _YAML]
        return bool(files) and all(_is_ros(file) for file in files)
    if path.suffix.lower() not in _YAML:
        return False
    return {"camera_matrix", "image_width"} <= set(fields.read_yaml(path))


ROS = rigs.CalibrationFormat(
    name="ros",
    title="ROS camera_info YAML",
    holds=frozenset({rigs.K3, rigs.RATIONAL}),
    owns=_is_ros,
    read=read_ros,
    write=write_ros,
    max_cameras=1,
)
