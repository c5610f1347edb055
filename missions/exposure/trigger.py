"""How often to take a picture, and how long to expose.

The interval follows from the footprint, with the paper's rule next to it; the exposure from the
motion of the sea floor over the sensor, from speed and attitude rates. While the vehicle moves with
(u, 0, 0) and turns with (p, q, r), a point of the sea floor at P in the body's frame moves by
-(u, 0, 0) - (p, q, r) x P; the exact flat-port camera's slopes take that to pixels a second. So a
level camera sees `u / pixel` from speed; about `H p / pixel` (the water's index within: pixel = D /
f with D nearly H / n) at the centre from roll or pitch; and `corner radius * r` at the corners from
yaw, plus the sideways motion of a camera ahead of the vehicle's centre.
"""

import math
from dataclasses import dataclass
from itertools import product

import numpy as np

from alice_survey.core.config import CameraConfig, PlanConfig
from alice_survey.core.errors import PlanError
from alice_survey.core.frames import Array
from camera_calib.rig import Rig
from missions.exposure.conflict import conflict
from missions.values.footprint import overlap, step_for_overlap

EXPOSURE_STEP_S = 1e-5


@dataclass(frozen=True, kw_only=True)
class PaperRule:
    """What the paper's frame rate r = u / (H (1 - O)) gives (its section VII.A).

    It takes the altitude H for the footprint along the track, which fits no lens of the paper.
    """

    rate_hz: float
    interval_s: float
    forward_overlap: float
    """What it really gives with this footprint."""


def paper_rule(plan: PlanConfig, footprint_along_m: float) -> PaperRule:
    """The paper's frame rate and the overlap that it really gives."""
    rate_hz = plan.speed_mps / (plan.altitude_m * (1.0 - plan.forward_overlap))
    return PaperRule(
        rate_hz=rate_hz,
        interval_s=1.0 / rate_hz,
        forward_overlap=overlap(footprint_along_m, plan.speed_mps / rate_hz),
    )


def floor_to(value: float, step: float) -> float:
    """The largest multiple of a step that is not above the value (up to rounding)."""
    return round(math.floor(value / step + 1e-6) * step, 9)


def trigger_interval_s(limits: CameraConfig, plan: PlanConfig, along_m: float) -> float:
    """Longest interval between pictures that overlap as requested, in steps of 1 ms.

    Args:
        limits: the shortest interval of camera and trigger controller.
        plan: speed and forward overlap.
        along_m: footprint along the track.

    Raises:
        PlanError: the camera cannot take pictures as fast.
    """
    step_m, min_s = step_for_overlap(along_m, plan.forward_overlap), limits.shortest_interval_s
    interval_s = floor_to(step_m / plan.speed_mps, 1e-3)
    if interval_s < min_s:
        raise conflict(
            f"{plan.forward_overlap:.0%} forward overlap at {plan.speed_mps:g} m/s and "
            f"{plan.altitude_m:g} m altitude needs {plan.speed_mps / step_m:.3g} pictures a "
            f"second, the camera takes {1 / min_s:.3g}",
            ("forward_overlap x speed_mps / footprint", "camera.shortest_interval_s"),
            "plan.speed_mps", floor_to(step_m / min_s, 1e-3),
        )  # fmt: skip
    return interval_s


@dataclass(frozen=True, kw_only=True)
class BlurRates:
    """How fast the sea floor moves over the sensor, px/s."""

    speed: float
    """Motion at the centre, from speed over ground."""
    speed_worst: float
    """Motion from speed in the worst pixel: the port magnifies towards the corners."""
    roll_pitch: float
    """Motion at the centre, from roll and pitch, each at its rate, in quadrature."""
    yaw: float
    """Motion at the worst corner, from yaw."""
    combined: float
    """All, in quadrature (rates are taken for independent standard deviations), in the worst of
    the frame's centre, corners and middles of sides."""
    worst: float
    """All at once with the worst signs, at the same place."""


def blur_rates(rig: Rig, plan: PlanConfig, altitude_m: float) -> BlurRates:
    """Motion over the sensor of the reference camera over level ground.

    Args:
        rig: with its place on the vehicle.
        plan: speed and rates.
        altitude_m: of the outer glass.
    """
    camera = rig.cameras[rig.reference]
    w, h = float(camera.width_px), float(camera.height_px)
    centre = [camera.cx_px, camera.cy_px]
    corners = [[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]]
    sides = [[w / 2, 0.0], [w, h / 2], [w / 2, h], [0.0, h / 2]]
    pixels = np.array([centre, *corners, *sides])
    points_cam = camera.at_depth(pixels, camera.front_cam[2] + altitude_m)
    body_from_cam = rig.body_from_cam(rig.reference)
    points_body = body_from_cam.apply(points_cam)
    slopes = camera.project_jacobian(points_cam)[1]
    cam_from_body = body_from_cam.rotation.inv()
    about = math.radians(plan.roll_pitch_rate_deg_s)
    rates = np.diag([about, about, math.radians(plan.yaw_rate_deg_s)])

    def on_sensor(velocity_body: Array) -> Array:
        pixels_per_s: Array = np.einsum("nij,nj->ni", slopes, cam_from_body.apply(velocity_body))
        return pixels_per_s

    forward = on_sensor(np.tile([-plan.speed_mps, 0.0, 0.0], (len(pixels), 1)))
    turning = np.stack([on_sensor(-np.cross(rate, points_body)) for rate in rates])
    size = np.linalg.norm(turning, axis=2)
    combined = np.sqrt((forward**2).sum(axis=1) + (size**2).sum(axis=0))
    worst = max(
        float(np.linalg.norm(forward + np.tensordot(signs, turning, 1), axis=1).max())
        for signs in product((-1.0, 1.0), repeat=3)
    )
    return BlurRates(
        speed=float(np.linalg.norm(forward[0])),
        speed_worst=float(np.linalg.norm(forward, axis=1).max()),
        roll_pitch=float(np.hypot(size[0, 0], size[1, 0])),
        yaw=float(size[2, 1:5].max()),
        combined=float(combined.max()),
        worst=worst,
    )


def exposure_for_rate(allowed_blur_px: float, rate_px_per_s: float) -> float:
    """Longest exposure, in steps of 10 us, in which the sea floor moves no more than allowed.

    Raises:
        PlanError: it is shorter than a step.
    """
    exposure_s = floor_to(allowed_blur_px / rate_px_per_s, EXPOSURE_STEP_S)
    if exposure_s < EXPOSURE_STEP_S:
        raise PlanError(
            f"the sea floor moves {rate_px_per_s:.3g} px a second over the sensor: "
            f"allowed_blur_px {allowed_blur_px:g} needs an exposure below "
            f"{EXPOSURE_STEP_S * 1e6:g} us: raise allowed_blur_px, or lower speed_mps or the rates"
        )
    return exposure_s
