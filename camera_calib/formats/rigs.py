"""Rigs assembled from files, and with parts removed or added."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import CalibrationError
from camera_calib.camera import Camera
from camera_calib.formats.fields import Fields, camera_name
from camera_calib.freedom import POSE
from camera_calib.ports.dome import DomePort
from camera_calib.ports.flat import FlatPort
from camera_calib.rig import Covariance, Rig


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
    """The one camera that is wanted."""
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
        CalibrationError: a name is invalid or occurs twice.
    """
    plain = [camera_name(path, name) for name in names]
    if len(set(plain)) != len(plain):
        raise CalibrationError(f"{path}: two cameras of one name ({', '.join(plain)})")
    rig_from_first = cam_from_rig[0].inv()
    poses = [pose * rig_from_first for pose in cam_from_rig]
    poses[0] = RigidTransform.identity()
    return Rig(
        cameras=dict(zip(plain, cameras, strict=True)),
        cam_from_rig={name: _scaled(p, reading) for name, p in zip(plain, poses, strict=True)},
        body_from_rig=None,
        source=f"{tool} file {path.name}",
    )


def file_each(path: Path, rig: Rig, suffix: str = ".yaml") -> list[Path]:
    """Files of formats that have one for each camera: the path, or those in it when it is a folder.

    Raises:
        CalibrationError: several cameras should go into one file.
    """
    if len(rig.cameras) == 1:
        return [path]
    if path.suffix:
        raise CalibrationError(
            f"{path}: {len(rig.cameras)} cameras have as many files: name a folder for them"
        )
    return [path / f"{name}{suffix}" for name in rig.cameras]


def default_names(count: int) -> list[str]:
    """Names for cameras whose file states none."""
    return ["left", "right"] if count == 2 else [f"cam{i}" for i in range(count)]


def only(rig: Rig, camera: str) -> Rig:
    """One camera of a rig, with its own pose on the vehicle and its share of the covariance.

    Raises:
        CalibrationError: there is no such camera.
    """
    if camera not in rig.cameras:
        raise CalibrationError(f"no camera {camera!r}; there are {', '.join(rig.cameras)}")
    kept = [name for name in _parameters(rig) if name.startswith(f"{camera}.")]
    # The pose in the rig was a parameter of this camera; alone it is the reference.
    kept = [name for name in kept if name.rsplit(".", 1)[1] not in POSE]
    return replace(
        rig,
        cameras={camera: rig.cameras[camera]},
        cam_from_rig={camera: RigidTransform.identity()},
        body_from_rig=_mount(rig, camera),
        covariance=_part(rig.covariance, kept),
    )


def renamed(rig: Rig, names: Sequence[str]) -> Rig:
    """The same rig with other names of its cameras, in order.

    Raises:
        CalibrationError: too few or too many names, one twice, or one that is invalid.
    """
    if len(names) != len(rig.cameras) or len(set(names)) != len(names):
        raise CalibrationError(
            f"--names {','.join(names)}: {len(rig.cameras)} different names expected, "
            f"for {', '.join(rig.cameras)}"
        )
    new = {
        old: camera_name(Path("--names"), name)
        for old, name in zip(rig.cameras, names, strict=True)
    }
    covariance = rig.covariance
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


def led_by(rig: Rig, camera: str) -> Rig:
    """The same rig with another first camera, which is its reference; without covariance.

    Raises:
        CalibrationError: there is no such camera.
    """
    if camera not in rig.cameras:
        raise CalibrationError(f"no camera {camera!r}; there are {', '.join(rig.cameras)}")
    names = [camera, *(name for name in rig.cameras if name != camera)]
    cameras = {name: rig.cameras[name] for name in names}
    return referenced(replace(rig, cameras=cameras, covariance=None))


def referenced(rig: Rig) -> Rig:
    """The same rig relative to its first camera, whose pose becomes the identity."""
    rig_from_first = rig.cam_from_rig[rig.reference].inv()
    poses = {name: pose * rig_from_first for name, pose in rig.cam_from_rig.items()}
    poses[rig.reference] = RigidTransform.identity()
    return replace(rig, cam_from_rig=poses, body_from_rig=_mount(rig, rig.reference))


def own_keys(fields: Fields, rig: Rig) -> Rig:
    """A rig with what only files of this project hold: mount, source and covariance."""
    if "body_from_rig" in fields:
        rig = replace(rig, body_from_rig=fields.pose("body_from_rig"))
    if "source" in fields:
        rig = replace(rig, source=str(fields.get("source")))
    if "covariance" in fields:
        names = fields.texts("covariance_parameters")
        matrix = fields.matrix("covariance", len(names), len(names))
        strange = {name.rsplit(".", 1)[0] for name in names} - set(rig.cameras)
        if strange:
            raise fields.fault("covariance_parameters", f"names no camera: {sorted(strange)[0]}")
        rig = replace(rig, covariance=Covariance(parameters=tuple(names), matrix=matrix))
    return rig


def with_port(rig: Rig, port: Mapping[str, Any]) -> Rig:
    """Every camera of a rig behind a port; the covariance of replaced numbers is dropped.

    Args:
        rig: cameras in air, or behind ports some of whose numbers change.
        port: by field of `FlatPort` or `DomePort`: lengths in metres, indices, `normal`.

    Raises:
        CalibrationError: a camera has a port of another shape, or a value is out of range.
    """
    changed = {"normal_x", "normal_y"} if "normal" in port else set()
    changed |= set(port)
    kept = [name for name in _parameters(rig) if name.rsplit(".", 1)[1] not in changed]
    return replace(
        rig,
        cameras={name: _with_port(camera, port) for name, camera in rig.cameras.items()},
        covariance=_part(rig.covariance, kept),
    )


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
    ports = {f"{name}.{p}" for name, camera in rig.cameras.items() for p in camera.port.parameters}
    kept = [name for name in _parameters(rig) if name not in ports]
    return replace(
        rig,
        cameras={name: camera.in_air() for name, camera in rig.cameras.items()},
        covariance=_part(rig.covariance, kept),
    )


def _scaled(pose: RigidTransform, reading: ReadOptions) -> RigidTransform:
    return RigidTransform.from_components(
        np.asarray(pose.translation) * reading.metres_per_unit, pose.rotation
    )


def _mount(rig: Rig, camera: str) -> RigidTransform | None:
    """The mount of a rig that another camera leads."""
    return None if rig.body_from_rig is None else rig.body_from_cam(camera)


def _parameters(rig: Rig) -> tuple[str, ...]:
    return () if rig.covariance is None else rig.covariance.parameters


def _part(covariance: Covariance | None, names: Sequence[str]) -> Covariance | None:
    if covariance is None or not names:
        return None
    at = [covariance.parameters.index(name) for name in names]
    return Covariance(parameters=tuple(names), matrix=covariance.matrix[np.ix_(at, at)])
