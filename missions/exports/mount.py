"""A vehicle's reference point and altimeter, relative to the glass that a plan's places are of.

A plan's places, depths and altitudes are of the left port's outer glass. A vehicle steers its own
reference point (COLA2: base_link; ArduSub: the origin of its EKF) and holds the altitude that its
altimeter (DVL, sounder) measures. The ways between are fixed lengths on the vehicle; here it is
level, as the plan assumes.
"""

from dataclasses import dataclass

import numpy as np

from alice_survey.core.frames import Array
from camera_calib.rig import Rig


@dataclass(frozen=True, kw_only=True)
class CameraMount:
    """Where glass and altimeter are on the vehicle; metres forward, right and down."""

    glass_body_m: tuple[float, float, float]
    """The left port's outer glass, from the vehicle's reference point."""
    altimeter_body_m: tuple[float, float, float]
    """The face of the sensor whose altitude the vehicle holds."""

    @property
    def reach_m(self) -> float:
        """Between glass and reference point, seen from above."""
        return float(np.hypot(*self.glass_body_m[:2]))

    def vehicle_ne(self, glass_ne: Array, heading_rad: Array) -> Array:
        """Places of the reference point, (N, 2), that bring the glass to its places.

        Args:
            glass_ne: (N, 2) north and east, metres.
            heading_rad: (N,) of the vehicle.
        """
        forward_m, right_m, _ = self.glass_body_m
        cos, sin = np.cos(heading_rad), np.sin(heading_rad)
        arm_ne = np.stack([forward_m * cos - right_m * sin, forward_m * sin + right_m * cos], 1)
        vehicle: Array = glass_ne - arm_ne
        return vehicle

    def vehicle_depth_m(self, glass_depth_m: float) -> float:
        """Depth of the reference point."""
        return glass_depth_m - self.glass_body_m[2]

    def altimeter_altitude_m(self, glass_altitude_m: float) -> float:
        """What the altimeter measures over a level sea floor."""
        return glass_altitude_m + self.glass_body_m[2] - self.altimeter_body_m[2]

    @property
    def about(self) -> str:
        """The convention, in words, for people who read a file."""
        forward_m, right_m, down_m = self.glass_body_m
        return (
            "Places are of the vehicle's reference point, altitudes of its altimeter, such that "
            f"the left port's glass ({forward_m:+.3f} m forward, {right_m:+.3f} m right, "
            f"{down_m:+.3f} m down of the reference point; altimeter "
            f"{self.altimeter_body_m[2]:+.3f} m down) flies the plan's lines."
        )


def mount_of(rig: Rig, altimeter_body_m: tuple[float, float, float]) -> CameraMount:
    """The mount of a rig.

    Args:
        rig: its reference camera's glass is what plans are of.
        altimeter_body_m: forward, right and down; the setting `camera.dvl_position_body_m`.
    """
    glass_cam = rig.cameras[rig.reference].front_cam
    glass_body = rig.body_from_cam(rig.reference).apply(glass_cam)
    forward_m, right_m, down_m = (float(value) for value in glass_body)
    return CameraMount(glass_body_m=(forward_m, right_m, down_m), altimeter_body_m=altimeter_body_m)
