"""No port: a camera in air, or one whose calibration in water absorbed its housing."""

from dataclasses import dataclass
from typing import ClassVar

from alice_survey.core.compiled import compiled_ieee
from alice_survey.core.frames import Array
from camera_calib.ports.values import PortValues


@dataclass(frozen=True, kw_only=True)
class NoPort(PortValues):
    """Nothing between the lens and what it looks at; light goes straight to the pupil."""

    shape: ClassVar[str] = "none"
    kind: ClassVar[int] = 0
    parameters: ClassVar[tuple[str, ...]] = ()


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
