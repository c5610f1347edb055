"""OpenCV's FileStorage: YAML and XML with the keys of its calibration and stereo samples.

One camera has `camera_matrix` and `distortion_coefficients` (also of ROS and of MATLAB's exports),
two have `M1 D1 M2 D2` and the second's pose `R T` in the first (x2 = R x1 + T), as the sample
`stereo_calib.cpp` names them. What OpenCV lacks has keys of our own, so that nothing is lost:
`port`, `port1`, `port2`, `camera_names`, `body_from_rig`, `source`, `covariance`. Four coefficients
are k1 k2 p1 p2 of a pinhole or k1 to k4 of `cv2.fisheye`: `distortion_model` (with 1 or 2 where the
lenses of a pair differ) or the caller says which; without either it is a pinhole.
"""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.errors import CalibrationError, warn
from camera_calib.camera import Camera
from camera_calib.formats.fields import Fields, read_storage
from camera_calib.formats.opencv_model import (
    FISHEYE,
    LENS_NAMES,
    camera_matrix,
    distortion,
    is_fisheye,
    read_camera,
    read_port,
)
from camera_calib.formats.rigs import ReadOptions, assemble, default_names, own_keys
from camera_calib.optics import PORTS
from camera_calib.ports.flat import FlatPort
from camera_calib.rig import Rig

_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K")
_DISTORTION = ("distortion_coefficients", "distCoeffs", "Distortion_Coefficients", "D")
_PAIR = ("M{}", "K{}", "cameraMatrix{}", "camera_matrix{}")
_PAIR_DISTORTION = ("D{}", "distCoeffs{}", "distortion_coefficients{}")
_WIDTH = ("image_width", "image_Width")
_HEIGHT = ("image_height", "image_Height")


def read_opencv(path: Path, reading: ReadOptions) -> Rig:
    """Read one camera or a stereo pair.

    Raises:
        CalibrationError: a key is missing or wrong; the message names file and key.
    """
    fields = read_storage(path)
    if fields.first(*_MATRIX) is not None:
        cameras = [_numbered(fields, "", reading)]
        poses = [RigidTransform.identity()]
    else:
        cameras = [_numbered(fields, number, reading) for number in ("1", "2")]
        other = fields if reading.extrinsics is None else read_storage(reading.extrinsics)
        poses = [RigidTransform.identity(), _second_pose(other, fields, reading)]
    rig = assemble(path, reading, "OpenCV", _names(fields, len(cameras)), cameras, poses)
    return own_keys(fields, rig)


def write_opencv(path: Path, rig: Rig) -> list[Path]:
    """Write one camera or two as YAML, or as XML when the path ends so.

    Raises:
        CalibrationError: the rig has more than two cameras.
    """
    names = list(rig.cameras)
    if len(names) > 2:
        raise CalibrationError(
            f"{path}: OpenCV's stereo files hold two cameras, the rig has {len(names)}: "
            "choose one with --camera"
        )
    suffix = ".xml" if path.suffix.lower() == ".xml" else ".yml"
    storage = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    sizes = {(camera.width_px, camera.height_px) for camera in rig.cameras.values()}
    for i, camera in enumerate(rig.cameras.values(), start=1):
        number = str(i) if len(sizes) > 1 else ""
        if i == 1 or number:
            storage.write(f"image_width{number}", camera.width_px)
            storage.write(f"image_height{number}", camera.height_px)
    if len(names) == 1:
        camera = rig.cameras[names[0]]
        storage.write("camera_matrix", camera_matrix(camera))
        storage.write("distortion_coefficients", distortion(camera)[None])
        _write_lens(storage, "", camera)
        _write_port(storage, "port", camera)
    else:
        for i, camera in enumerate(rig.cameras.values(), start=1):
            storage.write(f"M{i}", camera_matrix(camera))
            storage.write(f"D{i}", distortion(camera)[None])
            _write_lens(storage, str(i), camera)
        second_from_first = rig.cam_from_rig[names[1]]
        storage.write("R", second_from_first.rotation.as_matrix())
        storage.write("T", second_from_first.translation[:, None])
        for i, camera in enumerate(rig.cameras.values(), start=1):
            _write_port(storage, f"port{i}", camera)
    _write_texts(storage, "camera_names", names)
    storage.write("source", rig.source)
    if rig.body_from_rig is not None:
        storage.write("body_from_rig", rig.body_from_rig.as_matrix())
    if rig.covariance is not None:
        _write_texts(storage, "covariance_parameters", list(rig.covariance.parameters))
        storage.write("covariance", rig.covariance.matrix)
    text = storage.releaseAndGetString()
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return [path]


def _write_port(storage: Any, key: str, camera: Camera) -> None:
    if not camera.port.parameters:
        return
    storage.startWriteStruct(key, cv2.FileNode_MAP)
    storage.write("shape", camera.port.shape)
    for name, value in asdict(camera.port).items():
        storage.write(name, np.array([value]) if isinstance(value, tuple) else value)
    storage.endWriteStruct()


def _write_lens(storage: Any, number: str, camera: Camera) -> None:
    if is_fisheye(camera):
        storage.write(f"distortion_model{number}", FISHEYE)


def _write_texts(storage: Any, key: str, texts: list[str]) -> None:
    storage.startWriteStruct(key, cv2.FileNode_SEQ)
    for text in texts:
        storage.write("", text)
    storage.endWriteStruct()


def _numbered(fields: Fields, number: str, reading: ReadOptions) -> Camera:
    matrix = fields.first(*(key.format(number) for key in (_PAIR if number else _MATRIX)))
    if matrix is None:
        wanted = f"camera_matrix, or M{number} of a stereo pair"
        raise CalibrationError(f"{fields.path}: lacks {wanted}: is it a calibration?")
    every = _PAIR_DISTORTION if number else _DISTORTION
    k = fields.first(*(key.format(number) for key in every))
    named = fields.first(f"distortion_model{number}", "distortion_model")
    name = (reading.lens if named is None else fields.text(named)) or "opencv"
    if name not in LENS_NAMES:
        raise fields.fault(named or "--lens", f"is {name}; {', '.join(LENS_NAMES)} can be read")
    lens = LENS_NAMES[name]
    unsure = named is None and reading.lens is None
    if k is not None and unsure and fields.vector(k, 4, 5, 8, 12, 14).size == 4:
        warn(f"{fields.path}: {k} taken for k1 k2 p1 p2: a fisheye needs --lens fisheye")
    camera = read_camera(fields, matrix, k, _size(fields, number, reading), lens)
    key = f"port{number}"
    if key not in fields:
        return camera
    port = fields.fields(key)
    shape = port.text("shape") if "shape" in port else FlatPort.shape
    if shape not in PORTS:
        raise port.fault("shape", f"is {shape}; {' or '.join(PORTS)} expected")
    return read_port(fields, key, camera, PORTS[shape])


def _size(fields: Fields, number: str, reading: ReadOptions) -> tuple[int, int]:
    for end in (number, ""):
        width = fields.first(*(key + end for key in _WIDTH))
        height = fields.first(*(key + end for key in _HEIGHT))
        if width is not None and height is not None:
            return fields.size(width), fields.size(height)
    return reading.size(fields.path)


def _second_pose(fields: Fields, first: Fields, reading: ReadOptions) -> RigidTransform:
    if reading.extrinsics is None and "R" not in first and "T" not in first:
        raise CalibrationError(
            f"{first.path}: lacks R and T of the second camera: "
            "name the file that holds them with --extrinsics"
        )
    rotation = fields.rotation("R", fields.matrix("R", 3, 3))
    return RigidTransform.from_components(fields.vector("T", 3), rotation)


def _names(fields: Fields, count: int) -> list[str]:
    if count == 1 and "camera_name" in fields:
        return [fields.text("camera_name")]
    if "camera_names" not in fields:
        return default_names(count)
    names = fields.texts("camera_names")
    if len(names) != count:
        raise fields.fault("camera_names", f"has {len(names)} names for {count} cameras")
    return names
