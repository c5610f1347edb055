"""Kalibr's camchain YAML: pinhole cameras with radtan or equidistant distortion, in a chain.

The format is that of https://github.com/ethz-asl/kalibr/wiki/yaml-formats: `T_cn_cnm1` takes points
of the camera before (cam0 for cam1) to this camera, `radtan` has k1 k2 p1 p2 with OpenCV's meaning,
`equidistant` k1 to k4 of OpenCV's `fisheye`, and pixels count from the centre of the first one.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import CalibrationError, warn
from camera_calib.camera import Camera
from camera_calib.formats.fields import Fields, read_yaml, write_yaml
from camera_calib.formats.opencv_model import (
    HALF_PIXEL,
    LENS_NAMES,
    counted_from_centre,
    distortion,
    is_fisheye,
)
from camera_calib.formats.rigs import ReadOptions, assemble
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.rig import Rig

_NOT_HELD = ("T_cam_imu", "T_imu_cam", "timeshift_cam_imu")
_TOPIC = re.compile(r"/(?P<name>[A-Za-z0-9][A-Za-z0-9_./-]*)/image_raw")


def read_kalibr(path: Path, reading: ReadOptions) -> Rig:
    """Read a chain of cameras.

    Raises:
        CalibrationError: a key is missing or wrong, or a model is not held here.
    """
    top = read_yaml(path)
    count = sum(f"cam{i}" in top for i in range(len(top.values)))
    if count == 0 or f"cam{count - 1}" not in top:
        raise CalibrationError(f"{path}: lacks cam0, or a camera of the chain is left out")
    cameras, poses, names = [], [RigidTransform.identity()], []
    for i in range(count):
        fields = top.fields(f"cam{i}")
        cameras.append(_camera(fields))
        names.append(_name(fields, f"cam{i}"))
        if i > 0:
            poses.append(fields.pose("T_cn_cnm1") * poses[-1])
        left_out = [key for key in _NOT_HELD if key in fields]
        if left_out:
            warn(f"{path}: cam{i}: {', '.join(left_out)} left out: a rig holds no IMU")
    return assemble(path, reading, "Kalibr", names, cameras, poses)


def write_kalibr(path: Path, rig: Rig) -> list[Path]:
    """Write a chain of cameras in the order of the rig."""
    chain: dict[str, Any] = {}
    names = list(rig.cameras)
    for i, (name, camera) in enumerate(rig.cameras.items()):
        entry: dict[str, Any] = {}
        if i > 0:
            before = rig.cam_from_rig[names[i - 1]]
            entry["T_cn_cnm1"] = (rig.cam_from_rig[name] * before.inv()).as_matrix().tolist()
        entry["cam_overlaps"] = [other for other in range(len(names)) if other != i]
        entry["camera_model"] = "pinhole"
        entry["distortion_coeffs"] = distortion(camera)[:4].tolist()
        entry["distortion_model"] = "equidistant" if is_fisheye(camera) else "radtan"
        centre = [camera.cx_px - HALF_PIXEL, camera.cy_px - HALF_PIXEL]
        entry["intrinsics"] = [camera.fx_px, camera.fy_px, *centre]
        entry["resolution"] = [camera.width_px, camera.height_px]
        entry["rostopic"] = f"/{name}/image_raw"
        chain[f"cam{i}"] = entry
    write_yaml(path, chain)
    return [path]


def _camera(fields: Fields) -> Camera:
    if fields.text("camera_model") != "pinhole":
        raise fields.fault("camera_model", f"is {fields.text('camera_model')}; pinhole expected")
    model = fields.text("distortion_model")
    if model not in ("radtan", "equidistant", "none"):
        raise fields.fault("distortion_model", f"is {model}; radtan, equidistant or none expected")
    k = np.zeros(0) if model == "none" else fields.numbers("distortion_coeffs", 4)
    width, height = fields.numbers("resolution", 2)
    size = Fields(
        path=fields.path,
        prefix=f"{fields.prefix}resolution: ",
        values={"width": width, "height": height},
    )
    return counted_from_centre(
        fields,
        "intrinsics",
        (size.size("width"), size.size("height")),
        LENS_NAMES.get(model, OpenCVLens),
        fields.numbers("intrinsics", 4),
        k,
    )


def _name(fields: Fields, default: str) -> str:
    topic = fields.values.get("rostopic")
    found = _TOPIC.fullmatch(topic) if isinstance(topic, str) else None
    return default if found is None else found["name"]
