"""ROS's camera_info YAML: a file for each camera, as `camera_calibration_parsers` reads and writes.

Keys are those of http://wiki.ros.org/camera_calibration_parsers, their meaning that of
`sensor_msgs/CameraInfo`. A stereo pair has no pose as such: each camera has the rotation R to the
rectified pair (`rectification_matrix`), and the second's projection P has -f B in its last column.
From both follows the second camera's pose in the first, R2^T R1 and R2^T (P2[:, 3] / f).
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.errors import CalibrationError, warn
from alice_survey.core.frames import Array
from camera_calib.camera import Camera
from camera_calib.formats.fields import Fields, read_yaml, write_yaml
from camera_calib.formats.opencv_model import (
    LENS_NAMES,
    camera_matrix,
    distortion,
    is_fisheye,
    read_camera,
)
from camera_calib.formats.rigs import ReadOptions, assemble, file_each
from camera_calib.rig import Rig

_MODELS = {"plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}
SUFFIXES = (".yaml", ".yml")


def read_ros(path: Path, reading: ReadOptions) -> Rig:
    """Read a file of one camera, or a folder that holds those of a stereo pair.

    Raises:
        CalibrationError: a key is missing or wrong, or the folder does not hold one or two files.
    """
    if not path.is_dir():
        fields = read_yaml(path)
        if "projection_matrix" in fields and np.any(_projection(fields)[:, 3]):
            warn(f"{path}: baseline left out: give the folder of both files to read a pair")
        return assemble(path, reading, "ROS", [_name(fields, 0, 1)], [_camera(fields)], _ONE)
    files = [file for file in sorted(path.iterdir()) if file.suffix.lower() in SUFFIXES]
    if not 1 <= len(files) <= 2:
        raise CalibrationError(f"{path}: {len(files)} .yaml files; 1, or 2 of a pair, expected")
    every = [read_yaml(file) for file in files]
    if len(every) == 1:
        return read_ros(files[0], reading)
    moved = [bool(np.any(_projection(fields)[:, 3])) for fields in every]
    if sum(moved) != 1:
        raise CalibrationError(
            f"{path}: one of two projection_matrix needs a baseline in its last column and the "
            f"other none; {sum(moved)} have one"
        )
    first, second = every if moved[1] else every[::-1]
    return assemble(
        path,
        reading,
        "ROS",
        [_name(first, 0, 2), _name(second, 1, 2)],
        [_camera(first), _camera(second)],
        [RigidTransform.identity(), _second_from_first(first, second)],
    )


def write_ros(path: Path, rig: Rig) -> list[Path]:
    """Write a file of one camera, or into a folder those of a stereo pair, rectified as by OpenCV.

    Raises:
        CalibrationError: the rig has more than two cameras, or two that cannot be rectified.
    """
    names = list(rig.cameras)
    if len(names) > 2:
        raise CalibrationError(
            f"{path}: ROS has pairs of cameras, the rig has {len(names)}: choose one with --camera"
        )
    if len(names) == 1:
        camera = rig.cameras[names[0]]
        projection = np.hstack([camera_matrix(camera), np.zeros((3, 1))])
        write_yaml(path, _document(names[0], camera, np.eye(3), projection))
        return [path]
    files = file_each(path, rig)
    first, second = rig.cameras.values()
    size = (first.width_px, first.height_px)
    second_from_first = rig.cam_from_rig[names[1]]
    if size != (second.width_px, second.height_px):
        raise CalibrationError(f"{path}: ROS rectifies pairs of one picture size only")
    if float(np.linalg.norm(second_from_first.translation)) == 0.0:
        raise CalibrationError(f"{path}: the cameras have no baseline to rectify along")
    # A fisheye is rectified to the pinhole of its focal length: no such picture holds all of it.
    k1, k2 = (np.zeros(5) if is_fisheye(one) else distortion(one) for one in (first, second))
    _, _, p1, p2, *_ = cv2.stereoRectify(
        camera_matrix(first), k1, camera_matrix(second), k2, size,
        second_from_first.rotation.as_matrix(), second_from_first.translation[:, None],
        flags=cv2.CALIB_ZERO_DISPARITY, alpha=0.0,
    )  # fmt: skip
    axis = int(np.argmax(np.abs(p2[:2, 3])))
    r1, r2, line = _rectified(second_from_first, axis)
    p2[:, 3] = p2[axis, axis] * line
    pieces = zip(files, names, (first, second), (r1, r2), (p1, p2), strict=True)
    for file, name, camera, rotation, projection in pieces:
        write_yaml(file, _document(name, camera, rotation, projection))
    return files


_ONE = (RigidTransform.identity(),)


def _camera(fields: Fields) -> Camera:
    model = fields.text("distortion_model") if "distortion_model" in fields else "plumb_bob"
    if model not in _MODELS:
        raise fields.fault("distortion_model", f"is {model}; {' or '.join(_MODELS)} expected")
    key = "distortion_coefficients"
    k = fields.vector(key, 0, *_MODELS[model])
    size = (fields.size("image_width"), fields.size("image_height"))
    return read_camera(fields, "camera_matrix", key if k.size else None, size, LENS_NAMES[model])


def _projection(fields: Fields) -> Array:
    return fields.matrix("projection_matrix", 3, 4)


def _name(fields: Fields, index: int, count: int) -> str:
    if "camera_name" in fields:
        return fields.text("camera_name")
    return fields.path.stem if count == 2 else f"cam{index}"


def _rectification(fields: Fields) -> Rotation:
    key = "rectification_matrix"
    return fields.rotation(key, fields.matrix(key, 3, 3))


def _second_from_first(first: Fields, second: Fields) -> RigidTransform:
    projection = _projection(second)
    if min(projection[0, 0], projection[1, 1]) <= 0 or projection[2, 3] != 0:
        raise second.fault(
            "projection_matrix", "is not of the form [f 0 cx fTx; 0 f cy fTy; 0 0 1 0]"
        )
    baseline = projection[:, 3] / [projection[0, 0], projection[1, 1], 1.0]
    back = _rectification(second).inv()
    return RigidTransform.from_components(back.apply(baseline), back * _rectification(first))


def _rectified(second_from_first: RigidTransform, axis: int) -> tuple[Array, Array, Array]:
    """Rotations of both cameras to a pair with its baseline along x (0) or y (1), and that line.

    Each takes half of the turn between the cameras, then both what is left to the axis, as
    `cv2.stereoRectify` does; that one takes turns below 1e-5 rad for none, so that the pose could
    not be recovered from its rotations.
    """
    half = Rotation.from_rotvec(-0.5 * second_from_first.rotation.as_rotvec())
    shift = half.apply(second_from_first.translation)
    length = float(np.linalg.norm(shift))
    line = np.zeros(3)
    line[axis] = np.sign(shift[axis])
    across = np.cross(shift / length, line)
    sine = float(np.linalg.norm(across))
    angle = np.arctan2(sine, shift @ line / length)
    level = Rotation.from_rotvec(across * (angle / sine if sine > 0 else 0.0))
    second = level * half
    first = second * second_from_first.rotation
    return first.as_matrix(), second.as_matrix(), line * length


def _document(name: str, camera: Camera, rotation: Array, projection: Array) -> Any:
    k = distortion(camera)
    model = {4: "equidistant", 5: "plumb_bob"}.get(k.size, "rational_polynomial")
    return {
        "image_width": camera.width_px,
        "image_height": camera.height_px,
        "camera_name": name,
        "camera_matrix": _matrix(camera_matrix(camera)),
        "distortion_model": model,
        "distortion_coefficients": _matrix(k[None]),
        "rectification_matrix": _matrix(rotation),
        "projection_matrix": _matrix(projection),
    }


def _matrix(values: Array) -> dict[str, Any]:
    rows, columns = values.shape
    return {"rows": rows, "cols": columns, "data": values.ravel().tolist()}
