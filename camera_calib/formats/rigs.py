"""What every format has, and rigs assembled from files, and with parts removed or added."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import CalibrationError
from camera_calib.camera import Camera
from camera_calib.formats.fields import camera_name, plain_name
from camera_calib.freedom import part_of_rig
from camera_calib.optics import PORTS
from camera_calib.ports.dome import DomePort
from camera_calib.ports.flat import FlatPort
from camera_calib.rig import Rig

K3, RATIONAL, PRISM, COVARIANCE, MOUNT = "k3", "rational", "prism", "covariance", "mount"
PINHOLE = frozenset({K3, RATIONAL, PRISM})
PORTED = PINHOLE | {*PORTS}
ALL = PORTED | {COVARIANCE, MOUNT}
ONE = (RigidTransform.identity(),)
"""Pose of a camera alone."""


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """Values that a file may lack."""

    image_size: tuple[int, int] | None = None
    """Width and height, px."""
    extrinsics: Path | None = None
    """File that holds R and T when they are not with the intrinsics."""
    metres_per_unit: float = 1.0
    """Length of one unit of the file's translations."""
    camera: str | None = None
    """The one camera to read."""
    lens: str | None = None
    """Lens of cameras whose file does not name it: a key of `LENS_NAMES`."""

    def size(self, path: Path) -> tuple[int, int]:
        """Width and height for a file that does not state them.

        Raises:
            CalibrationError: nothing states them.
        """
        if self.image_size is None:
            raise CalibrationError(f"{path}: lacks image_width and image_height: give --image-size")
        return self.image_size


def refuse_writing(path: Path, _: Rig) -> list[Path]:
    """The writer of a format that is only read."""
    raise CalibrationError(f"{path}: this format is only read: name another with --to")


@dataclass(frozen=True)
class CalibrationFormat:
    """One tool's format: how it is recognised, read and written, and what it holds."""

    name: str
    title: str
    owns: Callable[[Path, Mapping[str, Any]], bool]
    """Whether a file or folder is of this format, of which it has the top values if it is YAML."""
    read: Callable[[Path, ReadOptions], Rig]
    write: Callable[[Path, Rig], list[Path]] = refuse_writing
    holds: frozenset[str] = ALL
    """More than fisheyes and k1 k2 p1 p2: terms, ports, and what belongs to the rig."""
    max_cameras: int | None = None
    """Cameras that it holds; None: any number."""
    suffix: str = ""
    """Ending of new files that are of this format if none is named."""
    files: Callable[[Path, Rig], list[Path]] = lambda path, _: [path]
    """The files that writing a rig to a path would replace."""


def assemble(
    path: Path,
    reading: ReadOptions,
    tool: str,
    names: Sequence[str],
    cameras: Sequence[Camera],
    cam_from_rig: Sequence[RigidTransform],
) -> Rig:
    """A rig of cameras and poses in the units of a file; the first camera becomes the reference.

    Raises:
        CalibrationError: a name occurs twice.
    """
    plain = [plain_name(name) for name in names]
    if len(set(plain)) != len(plain):
        raise CalibrationError(f"{path}: two cameras of one name ({', '.join(plain)})")
    poses = [
        RigidTransform.from_components(
            np.asarray(pose.translation) * reading.metres_per_unit, pose.rotation
        )
        for pose in cam_from_rig
    ]
    rig = Rig(
        cameras=dict(zip(plain, cameras, strict=True)),
        cam_from_rig=dict(zip(plain, poses, strict=True)),
        body_from_rig=None,
        source=f"{tool} file {path.name}",
    )
    return refer_to_first(rig)


def only(rig: Rig, camera: str) -> Rig:
    """One camera of a rig, with its own pose on the vehicle and its share of the covariance.

    Raises:
        CalibrationError: there is no such camera.
    """
    _check_known(rig, camera)
    part = part_of_rig(rig, [camera])
    known = part.covariance
    return replace(part, covariance=known if known is not None and known.parameters else None)


def led_by(rig: Rig, camera: str) -> Rig:
    """The same rig with another first camera, which is its reference; without covariance.

    Raises:
        CalibrationError: there is no such camera.
    """
    _check_known(rig, camera)
    names = [camera, *(name for name in rig.cameras if name != camera)]
    return replace(part_of_rig(rig, names), covariance=None)


def _check_known(rig: Rig, camera: str) -> None:
    if camera not in rig.cameras:
        raise CalibrationError(f"no camera {camera!r}; there are {', '.join(rig.cameras)}")


def rename_cameras(rig: Rig, names: Sequence[str]) -> Rig:
    """The same rig with other names of its cameras, in order.

    Raises:
        CalibrationError: too few or too many names, one twice, or one that is invalid.
    """
    if len(names) != len(rig.cameras) or len(set(names)) != len(names):
        raise CalibrationError(
            f"--names {','.join(names)}: {len(rig.cameras)} different names expected, "
            f"for {', '.join(rig.cameras)}"
        )
    plain = [camera_name(Path("--names"), name) for name in names]
    new, covariance = dict(zip(rig.cameras, plain, strict=True)), rig.covariance
    if covariance is not None:
        parts = (name.rsplit(".", 1) for name in covariance.parameters)
        covariance = replace(
            covariance, parameters=tuple(f"{new[camera]}.{what}" for camera, what in parts)
        )
    return replace(
        rig,
        cameras={new[name]: camera for name, camera in rig.cameras.items()},
        cam_from_rig={new[name]: pose for name, pose in rig.cam_from_rig.items()},
        covariance=covariance,
    )


def refer_to_first(rig: Rig) -> Rig:
    """The same rig relative to its first camera, whose pose becomes the identity."""
    rig_from_first = rig.cam_from_rig[rig.reference].inv()
    poses = {name: pose * rig_from_first for name, pose in rig.cam_from_rig.items()}
    poses[rig.reference] = RigidTransform.identity()
    mount = None if rig.body_from_rig is None else rig.body_from_cam(rig.reference)
    return replace(rig, cam_from_rig=poses, body_from_rig=mount)


def with_port(rig: Rig, port: Mapping[str, Any]) -> Rig:
    """Every camera of a rig behind a port; the covariance of replaced numbers is dropped.

    Args:
        rig: cameras in air, or behind ports some of whose numbers change.
        port: by field of `FlatPort` or `DomePort`: lengths in metres, indices.

    Raises:
        CalibrationError: a camera has a port of another shape, or a value is out of range.
    """
    cameras = {name: _with_port(camera, port) for name, camera in rig.cameras.items()}
    covariance = rig.covariance and rig.covariance.without(*port)
    return replace(rig, cameras=cameras, covariance=covariance)


def _with_port(camera: Camera, port: Mapping[str, Any]) -> Camera:
    if not camera.port.parameters:
        kind = DomePort if "outer_radius_m" in port else FlatPort
        return replace(camera, port=kind(**{"n_water": 1.0, **port}))
    unknown = set(port) - set(asdict(camera.port))
    if unknown:
        raise CalibrationError(
            f"{camera.port.words}: has no {', '.join(sorted(unknown))}: convert with --drop-port "
            "first, then state the other port"
        )
    return replace(camera, port=replace(camera.port, **dict(port)))


def in_air(rig: Rig) -> Rig:
    """The cameras of a rig without their ports; the covariance of these is dropped."""
    ports = {name for camera in rig.cameras.values() for name in camera.port.parameters}
    cameras = {name: camera.in_air() for name, camera in rig.cameras.items()}
    covariance = rig.covariance and rig.covariance.without(*ports)
    return replace(rig, cameras=cameras, covariance=covariance)
