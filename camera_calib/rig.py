"""The rig: cameras behind their ports, fixed to each other and to the vehicle; `rig.json`."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict
from scipy.spatial.transform import RigidTransform

from alice_survey.core.artefacts import check_type, read_json, write_json
from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.contents import Location, as_line, in_workspace, one_line
from alice_survey.core.errors import CalibrationError, warn
from alice_survey.core.frames import BODY_FROM_NADIR_CAM, Array, pose_from_json, pose_to_json
from camera_calib.camera import Camera, camera_from_json
from camera_calib.optics import LENSES, PORTS

_FORMAT = {"format": "alice-survey rig", "version": 2}
_NORM_TOLERANCE = 1e-3
"""Tolerance of the length of a quaternion in a file that was typed or rounded."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Covariance:
    """Joint covariance of calibrated parameters.

    Example:
        >>> import alice_survey as alice
        >>> known = alice.Covariance(parameters=("left.fx_px",), matrix=np.array([[0.25]]))
        >>> known.sigmas
        {'left.fx_px': 0.5}
    """

    parameters: tuple[str, ...]
    """Names such as `left.fx_px`, `left.normal_x` or `right.rx_rad` (see docs/formats.md)."""
    matrix: Array
    """(P, P), in the products of the parameters' units."""

    def __post_init__(self) -> None:
        count = len(self.parameters)
        if len(set(self.parameters)) != count or self.matrix.shape != (count, count):
            raise CalibrationError(
                f"covariance: {self.matrix.shape} values for {count} parameters, or a name twice"
            )
        if not np.all(np.isfinite(self.matrix)) or np.any(np.diag(self.matrix) < 0):
            raise CalibrationError("covariance: a value is not finite or a variance negative")

    @property
    def sigmas(self) -> dict[str, float]:
        """Standard deviations by name."""
        return dict(zip(self.parameters, np.sqrt(np.diag(self.matrix)).tolist(), strict=True))

    def without(self, *fields: str) -> "Covariance | None":
        """Covariance without some parameters of every camera, marginalised; None of no others."""
        kept = [n for n in self.parameters if n.rpartition(".")[2] not in fields]
        return self.marginal(kept) if kept else None

    def marginal(self, names: Iterable[str]) -> "Covariance":
        """Covariance of some of the parameters alone."""
        kept = tuple(names)
        at = [self.parameters.index(name) for name in kept]
        return Covariance(parameters=kept, matrix=self.matrix[np.ix_(at, at)])

    @property
    def correlation(self) -> Array:
        """(P, P); rows of a parameter without variance are 0."""
        sigma = np.sqrt(np.diag(self.matrix))
        scale = np.divide(1.0, sigma, out=np.zeros_like(sigma), where=sigma > 0)
        return np.asarray(self.matrix * np.outer(scale, scale))


@dataclass(frozen=True, kw_only=True)
class Rig:
    """Cameras that move as one body. The first is the reference: its frame is the rig's.

    Example:
        >>> import alice_survey as alice
        >>> config = alice.SurveyConfig()
        >>> rig = alice.design_rig(config.camera, config.water)
        >>> list(rig.cameras), round(rig.baseline_m, 3)
        (['left', 'right'], 0.1)
    """

    cameras: Mapping[str, Camera]
    cam_from_rig: Mapping[str, RigidTransform]
    body_from_rig: RigidTransform | None
    """Pose of the reference camera's entrance pupil on the vehicle (the mount); None: unknown."""
    source: str
    """Where the numbers come from, in words; it is printed with every result."""
    covariance: Covariance | None = None
    """Covariance of the calibrated parameters; None for a design."""

    def __post_init__(self) -> None:
        if not self.cameras or set(self.cameras) != set(self.cam_from_rig):
            raise CalibrationError("rig: every camera needs one pose and every pose a camera")

    def __repr__(self) -> str:
        return f"rig: {', '.join(self.cameras)} ({self.source})"

    @property
    def sigmas(self) -> dict[str, float]:
        """Standard deviations of calibrated parameters by name, such as `left.fx_px`."""
        return {} if self.covariance is None else self.covariance.sigmas

    @property
    def reference(self) -> str:
        """Name of the camera whose frame is the rig's."""
        return next(iter(self.cameras))

    @property
    def baseline_m(self) -> float:
        """Distance between the first two cameras; NaN when there is one."""
        names = list(self.cameras)
        if len(names) < 2:
            return float("nan")
        second = self.cam_from_rig[names[1]].inv().translation
        return float(((second - self.cam_from_rig[names[0]].inv().translation) ** 2).sum() ** 0.5)

    def body_from_cam(self, camera: str) -> RigidTransform:
        """Pose of a camera on the vehicle.

        Raises:
            CalibrationError: it is not known.
        """
        if self.body_from_rig is None:
            raise CalibrationError(
                f"{self.source}: how the rig is mounted on the vehicle is unknown: state it with "
                "'alice-survey camera convert RIG NEW --mount nadir-bow-up --lever 0.55 -0.05 0.08'"
            )
        return self.body_from_rig * self.cam_from_rig[camera].inv()

    def in_water(self, n_water: float) -> "Rig":
        """The same rig in other water: a pool calibration carried to the sea.

        The estimate of the old water's index does not apply to the new one: it leaves the
        covariance.
        """
        cameras = {name: camera.in_water(n_water) for name, camera in self.cameras.items()}
        covariance = None if self.covariance is None else self.covariance.without("n_water")
        return replace(self, cameras=cameras, covariance=covariance)


def rig_with_mount(rig: Rig | None) -> Rig | None:
    """The rig where its place on the vehicle is known, else None."""
    return None if rig is None or rig.body_from_rig is None else rig


def design_rig(camera: CameraConfig, water: WaterConfig, scale: int = 1) -> Rig:
    """The stereo rig as designed: two equal cameras, parallel, nadir, left on the port side.

    The left port's outer glass is at `camera.position_body_m`; the pupil lies behind it.

    Args:
        camera: design values.
        water: its index of refraction.
        scale: pixels are this many times larger.

    Example:
        >>> import alice_survey as alice
        >>> config = alice.SurveyConfig()
        >>> alice.design_rig(config.camera, config.water, scale=4).cameras["left"].width_px
        846
    """
    focal_px = camera.focal_mm * 1e3 / camera.pixel_um
    middle = {"cx_px": camera.width_px / 2, "cy_px": camera.height_px / 2}
    one = Camera(
        width_px=camera.width_px,
        height_px=camera.height_px,
        lens=LENSES[camera.lens](fx_px=focal_px, fy_px=focal_px, **middle),
        port=PORTS[camera.port].from_design(camera, water.n_water),
    ).downscale(scale)
    ahead, right, down = camera.position_body_m
    pupil = (ahead, right, down - float(one.front_cam[2]))
    return Rig(
        cameras={"left": one, "right": one},
        cam_from_rig={
            "left": RigidTransform.identity(),
            "right": RigidTransform.from_translation([-camera.baseline_m, 0.0, 0.0]),
        },
        body_from_rig=RigidTransform.from_components(pupil, BODY_FROM_NADIR_CAM),
        source="design values",
    )


def write_rig(path: str | Path, rig: Rig) -> None:
    """Write `rig.json` (format in docs/formats.md).

    Example:
        >>> import alice_survey as alice
        >>> config = alice.SurveyConfig()
        >>> alice.write_rig("rig.json", alice.design_rig(config.camera, config.water))
    """
    path = Path(path)
    cameras = {
        name: {**camera.to_json(), "cam_from_rig": pose_to_json(rig.cam_from_rig[name])}
        for name, camera in rig.cameras.items()
    }
    body: dict[str, Any] = {
        **_FORMAT,
        "source": rig.source,
        "cameras": cameras,
        "body_from_rig": None if rig.body_from_rig is None else pose_to_json(rig.body_from_rig),
        "sigmas": rig.sigmas,
    }
    if rig.covariance is not None:
        body["covariance"] = {
            "parameters": list(rig.covariance.parameters),
            "matrix": rig.covariance.matrix.tolist(),
        }
    write_json(path, body)


class _FilePart(BaseModel):
    """A part of `rig.json`, whose values are of the stated types."""

    model_config = ConfigDict(strict=True, allow_inf_nan=False, extra="allow")


class _StoredPose(_FilePart):
    translation_m: tuple[float, float, float]
    quaternion_xyzw: tuple[float, float, float, float]

    def value(self, what: str) -> RigidTransform:
        length = float(np.linalg.norm(self.quaternion_xyzw))
        if abs(length - 1.0) > _NORM_TOLERANCE:
            raise CalibrationError(f"{what}.quaternion_xyzw has the norm {length:g}, not 1")
        return pose_from_json(self.model_dump())


class _StoredCamera(_FilePart):
    cam_from_rig: _StoredPose
    """All other values are those of `Camera`."""


class _StoredCovariance(_FilePart):
    parameters: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]

    def value(self) -> Covariance:
        if any(len(row) != len(self.parameters) for row in self.matrix):
            raise CalibrationError("covariance: as many columns of matrix as parameters are needed")
        return Covariance(parameters=self.parameters, matrix=np.array(self.matrix, ndmin=2))


class _RigFile(_FilePart):
    cameras: dict[str, _StoredCamera]
    body_from_rig: _StoredPose | None
    source: str
    covariance: _StoredCovariance | None = None


def read_rig(path: Location) -> Rig:
    """Read `rig.json`, or the calibrated one of a workspace.

    Raises:
        CalibrationError: a key is missing or a value is wrong; the message names the file.

    Example:
        >>> import alice_survey as alice
        >>> config = alice.SurveyConfig()
        >>> alice.write_rig("drawn.json", alice.design_rig(config.camera, config.water))
        >>> alice.read_rig("drawn.json").reference
        'left'
    """
    path = in_workspace(path, "calibration/rig.json")
    data = read_json(path)
    try:
        if not isinstance(data, dict) or data.get("format") != _FORMAT["format"]:
            raise CalibrationError(f'is not a rig file: "format" is not "{_FORMAT["format"]}"')
        if data.get("version") != _FORMAT["version"]:
            raise CalibrationError(
                f"is a rig file of version {data.get('version')}; this program reads version "
                f"{_FORMAT['version']}: calibrate again, or change the file by docs/formats.md"
            )
        file = check_type(_RigFile, data)
        # Sigmas are written for people: the covariance holds them.
        if lost := data.keys() - {*_FORMAT, *_RigFile.model_fields, "sigmas"}:
            warn(f"{path}: not read: {as_line(', '.join(sorted(lost)))}")
        return Rig(
            cameras={name: _camera(name, one) for name, one in file.cameras.items()},
            cam_from_rig={
                name: one.cam_from_rig.value(f"{name}: cam_from_rig")
                for name, one in file.cameras.items()
            },
            body_from_rig=(
                None if file.body_from_rig is None else file.body_from_rig.value("body_from_rig")
            ),
            source=file.source,
            covariance=None if file.covariance is None else file.covariance.value(),
        )
    except (ValueError, CalibrationError) as error:
        raise CalibrationError(f"{path}: {one_line(error)}") from None


def _camera(name: str, stored: _StoredCamera) -> Camera:
    try:
        return camera_from_json(dict(stored.model_extra or {}))
    except CalibrationError as error:
        raise CalibrationError(f"{name}: {str(error).removeprefix('camera: ')}") from None
