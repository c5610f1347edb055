"""Calibrations of robots' tools: Kalibr, EuRoC, ROS's camera_info, ORB-SLAM and the ZED.

Kalibr's chain (https://github.com/ethz-asl/kalibr/wiki/yaml-formats): `T_cn_cnm1` takes points of
the camera before (cam0 for cam1) to this camera, `radtan` has k1 k2 p1 p2 with OpenCV's meaning,
`equidistant` k1 to k4 of OpenCV's `fisheye`, and pixels count from the centre of the first one.
`omni`, `ds` and `eucm` (V. Usenko, N. Demmel, D. Cremers 2018, "The Double Sphere Camera Model",
sections 2 and 3) become the nearest fisheye. OpenVINS writes the same behind `%YAML:1.0`, poses as
`T_imu_cam`. A `sensor.yaml` of EuRoC's is one such camera, `T_BS` its pose on the body.

ROS's camera_info YAML: a file for each camera, as `camera_calibration_parsers` reads and writes
(http://wiki.ros.org/camera_calibration_parsers), or messages as `ros2 topic echo` prints them; the
meaning is that of `sensor_msgs/CameraInfo`. A stereo pair has no pose as such: each camera has the
rotation R to the rectified pair, and the second's projection P has -f B in its last column.
From both follows the second camera's pose in the first, R2^T R1 and R2^T (P2[:, 3] / f).

ORB-SLAM3's settings: `Camera1.fx` and so on; `Stereo.T_c1_c2` takes points of the second camera to
the first, `Stereo.b` is the baseline of a rectified pair. The ZED's `SN*.conf` has a section for
each camera and size of pictures, and of the right camera's pose -T_x (mm), T_y, T_z and a rotation
vector RX, CV, RZ, as stereolabs' zed-stereo-calibration writes them.
"""

import re
from collections.abc import Callable, Mapping
from configparser import ConfigParser
from configparser import Error as ConfigParserError
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.contents import as_line
from alice_survey.core.errors import CalibrationError, warn
from alice_survey.core.frames import Array
from camera_calib.camera import Camera
from camera_calib.formats import fields, opencv_model, rigs
from camera_calib.lenses.fisheye import COEFFICIENTS as FISHEYE_COEFFICIENTS
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.rig import Rig


def _eucm(r2: Any, z: Any, a: float, b: float) -> Any:
    return a * np.sqrt(b * r2 + z * z) + (1.0 - a) * z


def _omni(r2: Any, z: Any, xi: float) -> Any:
    return z + xi * np.sqrt(r2 + z * z)


_DEPTHS: Mapping[str, tuple[int, Callable[..., Any]]] = {
    "pinhole": (0, lambda _, z: z),
    "omni": (1, _omni),
    "ds": (2, lambda r2, z, xi, a: _eucm(r2, _omni(r2, z, xi), a, 1.0)),
    "eucm": (2, _eucm),
}
"""By Kalibr's projections: how many intrinsics come before the focal lengths, and by what x and y
of a ray are divided, from its r^2 and z and these."""


class _BodyPose(fields.FileModel):
    cam_from_body: fields.Pose | None = fields.keys("T_cam_imu")
    body_from_cam: fields.Pose | None = fields.keys("T_imu_cam", "T_BS")


class _KalibrCamera(opencv_model.CameraKeys):
    pose: fields.Pose | None = fields.keys("T_cn_cnm1")
    camera_model: Literal["pinhole", "omni", "ds", "eucm"]
    distortion_model: Literal["radtan", "radial-tangential", "equidistant", "none"]
    intrinsics: fields.Numbers
    resolution: tuple[fields.Pixels, fields.Pixels]
    cam_overlaps: Any = None
    rostopic: Any = None

    def camera(self, path: Path, prefix: str, reading: rigs.ReadOptions) -> Camera:
        """The camera in air, or the fisheye that comes nearest to it."""
        projection, model, where = self.camera_model, self.distortion_model, f"{path}: {prefix}"
        count, depth = _DEPTHS[projection]
        k = np.zeros(0) if self.coefficients is None or model == "none" else self.coefficients
        for key, found, expected in (
            ("intrinsics", self.intrinsics, count + 4),
            ("distortion_coeffs", k, 4 * (model != "none")),
        ):  # fmt: skip
            if len(found) != expected:
                raise CalibrationError(f"{where}{key}: {len(found)}; {expected} expected")
        own, flat, size = self.intrinsics[:count], self.intrinsics[count:], self.resolution
        where, lens = f"{where}intrinsics", opencv_model.LENS_NAMES[model]
        plain = opencv_model.camera_of_numbers(where, [*flat, *k], size, lens)
        if projection == "pinhole":
            return plain
        w = depth(0.0, 1.0, *own)
        first = opencv_model.camera_of_numbers(where, flat / [w, w, 1.0, 1.0], size, FisheyeLens)

        def project(rays: Array) -> Array:
            across = rays[..., :2]
            ahead = depth(np.sum(across**2, axis=-1), rays[..., 2], *own)
            return plain.project(np.concatenate([across, ahead[..., None]], axis=-1))

        name = f"{path}: {prefix}camera_model {projection}"
        return opencv_model.nearest_camera(name, first, FISHEYE_COEFFICIENTS, project)


def read_kalibr(path: Path, reading: rigs.ReadOptions) -> Rig:
    """Read a chain of cameras, or a `sensor.yaml` of EuRoC's or the folder of several.

    Raises:
        CalibrationError: a key is missing or wrong, or a model cannot be read.
    """
    entries = _kalibr_entries(path)
    every = [_KalibrCamera.check(path, values, prefix) for _, prefix, values in entries]
    is_chain = all(one.pose is not None for one in every[1:])
    known = {*_KalibrCamera.known_keys(), *(() if is_chain else _BodyPose.known_keys())}
    fields.name_unread(
        path, (prefix + key for _, prefix, values in entries for key in values if key not in known)
    )
    cameras, poses, names, bodies = [], list(rigs.ONE), [], []
    for one, (name, prefix, values) in zip(every, entries, strict=True):
        cameras.append(one.camera(path, prefix, reading))
        topic = str(one.rostopic).removesuffix("/image_raw")
        names.append(name if topic == str(one.rostopic) else topic)
        if not is_chain:
            body = _BodyPose.check(path, values, prefix)
            inverse = body.body_from_cam
            pose = body.cam_from_body if inverse is None else inverse.inv()
            if pose is None:
                raise CalibrationError(f"{path}: lacks {prefix}T_cn_cnm1, T_cam_imu or T_imu_cam")
            bodies.append(pose)
            poses[1:] = [pose * bodies[0].inv() for pose in bodies[1:]]
        elif len(names) > 1 and one.pose is not None:
            poses.append(one.pose * poses[-1])
    return rigs.assemble(path, reading, "Kalibr", names, cameras, poses)


def _kalibr_entries(path: Path) -> list[tuple[str, str, dict[str, Any]]]:
    """Name, prefix of keys and values of each camera."""
    if path.is_dir():
        files = fields.yaml_files(path)
        return [(f.parent.name, f"{f.parent.name}: ", fields.read_values(f)) for f in files]
    top = fields.read_values(path)
    if "intrinsics" in top:
        return [(path.parent.name if path.stem == "sensor" else path.stem, "", top)]
    chain = [f"cam{i}" for i in range(sum(re.fullmatch(r"cam\d+", key) is not None for key in top))]
    if not chain or set(chain) - set(top):
        raise CalibrationError(f"{path}: lacks cam0, or a camera of the chain is left out")
    fields.name_unread(path, (key for key in top if key not in chain))
    return [(name, f"{name}.", top[name]) for name in chain]


def write_kalibr(path: Path, rig: Rig) -> list[Path]:
    """Write a chain of cameras in the order of the rig."""
    names, chain = list(rig.cameras), {}
    for i, (name, camera) in enumerate(rig.cameras.items()):
        before = rig.cam_from_rig[names[max(i - 1, 0)]]
        pose = (rig.cam_from_rig[name] * before.inv()).as_matrix().tolist()
        chain[f"cam{i}"] = ({"T_cn_cnm1": pose} if i else {}) | {
            "cam_overlaps": [other for other in range(len(names)) if other != i],
            "camera_model": "pinhole",
            "distortion_coeffs": opencv_model.distortion(camera)[:4].tolist(),
            "distortion_model": "equidistant" if opencv_model.is_fisheye(camera) else "radtan",
            "intrinsics": opencv_model.focal_and_centre(camera),
            "resolution": [camera.width_px, camera.height_px],
            "rostopic": f"/{name}/image_raw",
        }
    fields.write_yaml(path, chain)
    return [path]


class _RosCamera(opencv_model.CameraKeys):
    rectification: fields.Turn | None = fields.keys("rectification_matrix", "R", "r")
    projection: fields.Matrix34 | None = fields.keys("projection_matrix", "P", "p")
    header: dict[str, Any] = Field(default_factory=dict)


def read_ros(path: Path, reading: rigs.ReadOptions) -> Rig:
    """Read one camera or a stereo pair: a file, or a folder of files, with messages of each.

    Raises:
        CalibrationError: a key is missing or wrong, or there are more than two cameras.
    """
    files = fields.yaml_files(path) if path.is_dir() else [path]
    found: dict[tuple[Path, str], tuple[Path, _RosCamera]] = {}
    for file in files:
        for document in fields.read_documents(file):
            same = file, repr(document | {"header": None})
            if same not in found:
                found[same] = file, _RosCamera.check(file, document, "", ())
    every = list(found.values())
    if not 1 <= len(every) <= 2:
        raise CalibrationError(f"{path}: {len(every)} cameras in .yaml files; 1 or 2 expected")
    moved = [one.projection is not None and bool(one.projection[:, 3].any()) for _, one in every]
    if len(every) == 1:
        if moved[0]:
            warn(f"{path}: baseline left out: give the folder of both files to read a pair")
        poses = list(rigs.ONE)
    elif sum(moved) == 1:
        every = every if moved[1] else every[::-1]
        poses = [*rigs.ONE, _second_from_first(*every)]
    else:
        raise CalibrationError(
            f"{path}: {sum(moved)} projection_matrix have a baseline; 1 expected"
        )
    names = [str(one.name or one.header.get("frame_id") or file.stem) for file, one in every]
    names = names if len(set(names)) == len(names) else ["cam0", "cam1"]
    cameras = [one.camera(file, "", reading) for file, one in every]
    return rigs.assemble(path, reading, "ROS", names, cameras, poses)


def write_ros(path: Path, rig: Rig) -> list[Path]:
    """Write a file of one camera."""
    ((name, camera),) = rig.cameras.items()
    k, matrix = opencv_model.distortion(camera), opencv_model.camera_matrix(camera)
    document = {
        "image_width": camera.width_px,
        "image_height": camera.height_px,
        "camera_name": name,
        "camera_matrix": fields.matrix_of(matrix),
        "distortion_model": {4: "equidistant", 5: "plumb_bob"}.get(k.size, "rational_polynomial"),
        "distortion_coefficients": fields.matrix_of(k),
        "rectification_matrix": fields.matrix_of(np.eye(3)),
        "projection_matrix": fields.matrix_of(np.hstack([matrix, np.zeros((3, 1))])),
    }
    fields.write_yaml(path, document)
    return [path]


def _second_from_first(
    first: tuple[Path, _RosCamera], second: tuple[Path, _RosCamera]
) -> RigidTransform:
    turns = []
    for file, one in (first, second):
        if one.rectification is None:
            raise CalibrationError(f"{file}: lacks rectification_matrix")
        turns.append(one.rectification)
    matrix = second[1].projection
    if matrix is None or min(matrix[0, 0], matrix[1, 1]) <= 0 or matrix[2, 3] != 0:
        raise CalibrationError(
            f"{second[0]}: projection_matrix is not of the form [f 0 cx fTx; 0 f cy fTy; 0 0 1 0]"
        )
    baseline = matrix[:, 3] / [matrix[0, 0], matrix[1, 1], 1.0]
    back = turns[1].inv()
    return RigidTransform.from_components(back.apply(baseline), back * turns[0])


class _OrbSettings(fields.FileModel):
    width: fields.Pixels | None = fields.keys("Camera.width")
    height: fields.Pixels | None = fields.keys("Camera.height")
    kind: Literal["PinHole", "KannalaBrandt8", "Rectified"] = Field("PinHole", alias="Camera.type")
    first_from_second: fields.Pose | None = fields.keys("Stereo.T_c1_c2")
    baseline: float | None = fields.keys("Stereo.b")


def read_orbslam(path: Path, reading: rigs.ReadOptions) -> Rig:
    """Read ORB-SLAM's settings of one camera or of a pair.

    Raises:
        CalibrationError: a key is missing or wrong.
    """
    values, known = fields.read_values(path), {*_OrbSettings.known_keys()}
    one = _OrbSettings.check(path, values)
    size = (one.width, one.height) if one.width and one.height else reading.size(path)
    lens, cameras, poses = opencv_model.LENS_NAMES[one.kind], [], list(rigs.ONE)
    for part in ("Camera.", "Camera1.", "Camera2."):
        keys = {part + name: name for name in opencv_model.Terms.known_keys()}
        own = {name: values[key] for key, name in keys.items() if key in values}
        if "fx" in own:
            cameras.append(opencv_model.camera_of_terms(path, part, own, size, lens))
            known |= {*keys}
    if one.kind == "Rectified" and one.baseline is not None:
        cameras = [cameras[0]] * 2
        poses.append(RigidTransform.from_translation([-one.baseline, 0.0, 0.0]))
    elif len(cameras) > 1 and one.first_from_second is not None:
        poses.append(one.first_from_second.inv())
    else:
        known -= {"Stereo.b", "Stereo.T_c1_c2"}
    if len(cameras) != len(poses):
        raise CalibrationError(f"{path}: {len(cameras)} cameras with fx, {len(poses)} poses")
    lost = (key if key.startswith("Camera") else key.split(".")[0] for key in {*values} - known)
    fields.name_unread(path, sorted(lost))
    return rigs.assemble(path, reading, "ORB-SLAM", ["left", "right"][: len(poses)], cameras, poses)


_ZED_SIZES = {
    "2K": (2208, 1242), "FHD": (1920, 1080), "HD": (1280, 720), "VGA": (672, 376),
    "FHD1200": (1920, 1200), "SVGA": (960, 600), "4K": (3840, 2160), "QHDPLUS": (3200, 1800),
}  # fmt: skip
"""Width and height of pictures by the endings of sections."""


def read_zed(path: Path, reading: rigs.ReadOptions) -> Rig:
    """Read the pair of a ZED for one size of pictures, which `reading` may state.

    Raises:
        CalibrationError: a value is missing or wrong, or none of several sizes is stated.
    """
    parser = ConfigParser(interpolation=None, inline_comment_prefixes=("#", ";"))
    try:
        parser.read_string(fields.read_text(path))
    except ConfigParserError as error:
        raise CalibrationError(f"{path}: not valid INI: {as_line(str(error))}") from None
    parts = {name.upper(): dict(parser[name]) for name in parser.sections()}
    sizes = {end: size for end, size in _ZED_SIZES.items() if f"LEFT_CAM_{end}" in parts}
    chosen = [end for end, size in sizes.items() if reading.image_size in (None, size)]
    if len(chosen) != 1:
        listed = ", ".join(f"{w} {h}" for w, h in sizes.values())
        raise CalibrationError(f"{path}: choose a size of pictures with --image-size: {listed}")
    (end,), cameras = chosen, []
    for side in ("LEFT", "RIGHT"):
        values = parts.get(f"{side}_CAM_{end}", {}) | parts.pop(f"{side}_DISTO", {})
        lens = FisheyeLens if "k4" in values and "p1" not in values else OpenCVLens
        prefix = f"{side}_CAM_{end}."
        cameras.append(opencv_model.camera_of_terms(path, prefix, values, sizes[end], lens))
    turns = {size: [f"{axis}_{size.lower()}" for axis in ("rx", "cv", "rz")] for size in _ZED_SIZES}
    model = fields.numbers_model(("baseline",), ("ty", "tz", *turns[end]))
    found = model.check(path, parts.pop("STEREO", {}), "STEREO.", set[str]().union(*turns.values()))
    numbers = np.array([*found.model_dump().values()])
    fields.name_unread(path, (name for name in parts if "_CAM_" not in name))
    shift, turn = numbers[:3] * [-1e-3, 1e-3, 1e-3], Rotation.from_rotvec(numbers[3:])
    pose = RigidTransform.from_components(shift, turn)
    return rigs.assemble(path, reading, "ZED", ["left", "right"], cameras, [*rigs.ONE, pose])
