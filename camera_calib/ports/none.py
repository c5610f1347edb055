"""No port: a camera in air, or one whose calibration in water absorbed its housing."""

from dataclasses import dataclass
from typing import ClassVar

from alice_survey.core.frames import Array
from camera_calib.ports.values import PortValues


@dataclass(frozen=True, kw_only=True)
class NoPort(PortValues):
    """Nothing between the lens and what it looks at; light goes straight to the pupil."""

    shape: ClassVar[str] = "none"
    parameters: ClassVar[tuple[str, ...]] = ()


NO_PORT = NoPort()


def bare_rays(points: Array, port: Array, rays: Array, turns: Array) -> None:
    """Rays in air (B, 3), to be filled in, of points (B, 3)."""
    rays[:] = points


def bare_leave(rays: Array, port: Array, points: Array, directions: Array) -> None:
    """Start (B, 3) and direction (B, 3), to be filled in, of unit rays (B, 3): both as they are."""
    points[:] = rays * 0.0
    directions[:] = rays


def bare_slopes(
    points: Array, turns: Array, port: Array, by_ray: Array, by_point: Array, by_port: Array
) -> None:
    """Slopes of pixels by the point, (B, 2, 3) to be filled in: those by the ray."""
    by_point[:] = by_ray
