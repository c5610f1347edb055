"""No port: a camera in air, or one whose calibration in water absorbed its housing."""

from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from alice_survey.core.compiled import compiled_ieee
from alice_survey.core.config import CameraConfig
from alice_survey.core.frames import Array
from camera_calib.ports.values import PortValues, Vector


@dataclass(frozen=True, kw_only=True)
class NoPort(PortValues):
    """Nothing between the lens and what it looks at; light goes straight to the pupil."""

    shape: ClassVar[str] = "none"
    kind: ClassVar[int] = 0
    parameters: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def guess(cls) -> Self:
        """The only one."""
        return cls()

    @classmethod
    def from_design(cls, camera: CameraConfig, n_water: float) -> Self:
        """The only one."""
        return cls()

    @property
    def settings(self) -> dict[str, Any]:
        """None."""
        return {}

    @property
    def n_water(self) -> float:
        """1: nothing is known of what is looked through."""
        return 1.0

    @property
    def values(self) -> Array:
        """Nothing, (0,)."""
        return np.zeros(0)

    @property
    def refracts(self) -> bool:
        """Never."""
        return False

    @property
    def front_cam(self) -> Vector:
        """The pupil."""
        return 0.0, 0.0, 0.0

    @property
    def magnification(self) -> float:
        """1."""
        return 1.0

    def clearance(self, points_cam: Array) -> tuple[Array, Array]:
        """Distance (N,) before the pupil, along the axis, and that axis (N, 3)."""
        return points_cam[:, 2], np.tile(self.axis_cam, (len(points_cam), 1))

    @property
    def words(self) -> str:
        """What the port is, in a few words."""
        return "no port"


NO_PORT = NoPort()


@compiled_ieee
def bare_rays(points: Array, rays: Array) -> None:
    """Rays in air (B, 3), to be filled in, of points (B, 3)."""
    for j in range(len(points)):
        rays[j, 0], rays[j, 1], rays[j, 2] = points[j, 0], points[j, 1], points[j, 2]


@compiled_ieee
def bare_leave(rays: Array, points: Array, directions: Array) -> None:
    """Start (B, 3) and direction (B, 3), to be filled in, of unit rays (B, 3): both as they are."""
    for j in range(len(rays)):
        for axis in range(3):
            points[j, axis] = rays[j, axis] * 0.0
            directions[j, axis] = rays[j, axis]
