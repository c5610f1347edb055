"""The rig: cameras behind their ports, fixed to each other and to the vehicle; `rig.json`."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.artefacts import read_json, write_json
from alice_survey.config import CameraConfig, WaterConfig
from alice_survey.errors import CalibrationError
from alice_survey.frames import BODY_FROM_NADIR_CAM, Array, pose_from_json, pose_to_json
from camera_calib.flat_port import FlatPortCamera, camera_from_json

_FORMAT = {"format": "alice-survey rig", "version": 2}


@dataclass(frozen=True, kw_only=True, eq=False)
class Covariance:
    """How well calibrated parameters are known, and together."""

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

    @property
    def correlation(self) -> Array:
        """(P, P); rows of a parameter without variance are 0."""
        sigma = np.sqrt(np.diag(self.matrix))
        scale = np.divide(1.0, sigma, out=np.zeros_like(sigma), where=sigma > 0)
        correlation: Array = self.matrix * np.outer(scale, scale)
        return correlation


@dataclass(frozen=True, kw_only=True)
class Rig:
    """Cameras that move as one body. The first is the reference: its frame is the rig's."""

    cameras: Mapping[str, FlatPortCamera]
    cam_from_rig: Mapping[str, RigidTransform]
    body_from_rig: RigidTransform
    """Pose of the reference camera's entrance pupil on the vehicle (the lever arm)."""
    source: str
    """Where the numbers come from, in words; it is printed with every result."""
    covariance: Covariance | None = None
    """Of the calibrated parameters; None for a design."""

    def __post_init__(self) -> None:
        if not self.cameras or set(self.cameras) != set(self.cam_from_rig):
            raise CalibrationError("rig: every camera needs one pose and every pose a camera")

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
        """Pose of a camera on the vehicle."""
        return self.body_from_rig * self.cam_from_rig[camera].inv()

    def in_water(self, n_water: float) -> "Rig":
        """The same rig in other water: a pool calibration carried to the sea."""
        cameras = {name: replace(c, n_water=n_water) for name, c in self.cameras.items()}
        return replace(self, cameras=cameras)


def design_rig(camera: CameraConfig, water: WaterConfig, scale: int = 1) -> Rig:
    """The stereo rig as drawn: two equal cameras, parallel, nadir, left on the port side.

    The left port's outer glass is at `camera.position_body_m`; the pupil lies behind it.

    Args:
        camera: design values.
        water: its index of refraction.
        scale: pixels are this many times larger.
    """
    focal_px = camera.focal_mm * 1e3 / camera.pixel_um
    one = FlatPortCamera(
        width_px=camera.width_px,
        height_px=camera.height_px,
        fx_px=focal_px,
        fy_px=focal_px,
        cx_px=camera.width_px / 2,
        cy_px=camera.height_px / 2,
        port_distance_m=camera.port_distance_m,
        glass_thickness_m=camera.glass_thickness_m,
        n_glass=camera.n_glass,
        n_water=water.n_water,
    ).reduced(scale)
    x, y, z = camera.position_body_m
    pupil = (x, y, z - camera.port_distance_m - camera.glass_thickness_m)
    return Rig(
        cameras={"left": one, "right": one},
        cam_from_rig={
            "left": RigidTransform.identity(),
            "right": RigidTransform.from_translation([-camera.baseline_m, 0.0, 0.0]),
        },
        body_from_rig=RigidTransform.from_components(pupil, BODY_FROM_NADIR_CAM),
        source="design values",
    )


def write_rig(path: Path, rig: Rig) -> None:
    """Write `rig.json` (format in docs/formats.md)."""
    cameras = {
        name: {**camera.to_json(), "cam_from_rig": pose_to_json(rig.cam_from_rig[name])}
        for name, camera in rig.cameras.items()
    }
    body: dict[str, Any] = {
        **_FORMAT,
        "source": rig.source,
        "cameras": cameras,
        "body_from_rig": pose_to_json(rig.body_from_rig),
        "sigmas": rig.sigmas,
    }
    if rig.covariance is not None:
        body["covariance"] = {
            "parameters": list(rig.covariance.parameters),
            "matrix": rig.covariance.matrix.tolist(),
        }
    write_json(path, body)


def read_rig(path: Path) -> Rig:
    """Read `rig.json`.

    Raises:
        CalibrationError: a key is missing or a value is wrong; the message names the file.
    """
    data = read_json(path)
    try:
        if {key: data[key] for key in _FORMAT} != _FORMAT:
            raise CalibrationError(f"is no rig file of version {_FORMAT['version']}")
        poses = {name: pose_from_json(c["cam_from_rig"]) for name, c in data["cameras"].items()}
        cameras = {
            name: camera_from_json({k: v for k, v in c.items() if k != "cam_from_rig"})
            for name, c in data["cameras"].items()
        }
        return Rig(
            cameras=cameras,
            cam_from_rig=poses,
            body_from_rig=pose_from_json(data["body_from_rig"]),
            source=str(data["source"]),
            covariance=_covariance_from_json(data.get("covariance")),
        )
    except (KeyError, TypeError, ValueError, AttributeError, CalibrationError) as error:
        what = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise CalibrationError(f"{path}: {what}") from None


def _covariance_from_json(data: dict[str, Any] | None) -> Covariance | None:
    if data is None:
        return None
    return Covariance(
        parameters=tuple(map(str, data["parameters"])),
        matrix=np.array(data["matrix"], dtype=np.float64),
    )
