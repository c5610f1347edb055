"""The camera and the ports of the project's design study, and what it found."""

import math

from camera_calib.camera import Camera
from tests.cameras import MANTA, changed

CAMERA = changed(MANTA, port_distance_m=0.0, glass_thickness_m=0.0)
STUDY = [
    # port mm, glass mm: at the pupil px, at the best point px, shift mm, tilted by 2 degrees px
    (5, 6, 0.18, 0.014, 1.3, 0.015),
    (20, 10, 0.92, 0.062, 6.9, 0.068),
    (50, 15, 2.44, 0.158, 18.0, 0.172),
    (100, 20, 5.02, 0.313, 38.0, 0.341),
]
"""Residual of a fixed warp at 2 m with 0.5 m of relief."""


def behind_port(distance_mm: float, glass_mm: float, tilt_deg: float = 0.0) -> Camera:
    tilt = math.radians(tilt_deg)
    return changed(
        CAMERA,
        port_distance_m=distance_mm / 1e3,
        glass_thickness_m=glass_mm / 1e3,
        normal=(math.sin(tilt), 0.0, math.cos(tilt)),
    )
