"""How long to expose: motion of the sea floor over the sensor from speed and attitude rates.

While the vehicle moves with (u, 0, 0) and turns with (p, q, r), a point of the sea floor at P in
the body's frame moves by -(u, 0, 0) - (p, q, r) x P; the exact flat-port camera's slopes take that
to pixels a second. So a level camera sees `u / pixel` from speed; about `H p / pixel` (the water's
index within: pixel = D / f with D nearly H / n) at the centre from roll or pitch; and
`corner radius * r` at the corners from yaw, plus the sideways motion of a camera ahead of the
vehicle's centre.
"""

from dataclasses import dataclass
from itertools import product
from math import radians

import numpy as np

from alice_survey.base.config import PlanConfig
from alice_survey.base.frames import Array
from camera_calib.rig import Rig
from missions.exposure.settings_table import Setting
from missions.exposure.trigger import floor_to
from missions.values.footprint import glass_point_cam

EXPOSURE_STEP_S = 1e-5
PAPER_EXPOSURE_S = 3e-3
PAPER_SPEEDS_MPS = (0.2, 0.5)
_MODEL = "rigid-body motion through camera_calib.flat_port's slopes"


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
    points_cam = camera.at_depth(pixels, glass_point_cam(camera)[2] + altitude_m)
    body_from_cam = rig.body_from_cam(rig.reference)
    points_body = body_from_cam.apply(points_cam)
    slopes = camera.project_jacobian(points_cam)[1]
    cam_from_body = body_from_cam.rotation.inv()
    about = radians(plan.roll_pitch_rate_deg_s)
    rates = np.diag([about, about, radians(plan.yaw_rate_deg_s)])

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


def exposure_for_blur(allowed_blur_px: float, speed_mps: float, pixel_m: float) -> float:
    """Longest exposure that blurs the central pixel by no more than allowed, in steps of 10 us."""
    return exposure_for_rate(allowed_blur_px, speed_mps / pixel_m)


def exposure_for_rate(allowed_blur_px: float, rate_px_per_s: float) -> float:
    """Longest exposure, in steps of 10 us, in which the sea floor moves no more than allowed."""
    return floor_to(allowed_blur_px / rate_px_per_s, EXPOSURE_STEP_S)


def exposure_rows(
    plan: PlanConfig, rates: BlurRates, exposure_s: float, pixel_m: float
) -> list[Setting]:
    """Exposure, the blur it leaves, and the paper's 3 ms next to it."""
    attitude = plan.yaw_rate_deg_s > 0 or plan.roll_pitch_rate_deg_s > 0
    papers = PAPER_EXPOSURE_S * 1e3
    papers_blur = [u * PAPER_EXPOSURE_S / pixel_m for u in PAPER_SPEEDS_MPS]
    sharp_s = [pixel_m / u * 1e3 for u in PAPER_SPEEDS_MPS]
    return [
        Setting(
            group="exposure",
            name="exposure",
            value=exposure_s * 1e3,
            unit="ms",
            equation="blur allowed / |image motion|",
            source=_MODEL,
            bound_by="allowed_blur_px",
            note=f"for {plan.allowed_blur_px:g} px. At night only the strobe's pulse exposes: a "
            "longer shutter with the same light blurs no more"
            + ("; attitude rates shorten it" if attitude else ""),
        ),
        Setting(
            group="exposure",
            name="blur",
            value=rates.combined * exposure_s,
            unit="px",
            equation="sqrt(speed^2 + roll^2 + pitch^2 + yaw^2)",
            source=_MODEL,
            bound_by="allowed_blur_px",
            note=f"in the worst pixel. From {plan.speed_mps:g} m/s {rates.speed * exposure_s:.2f} "
            f"at the centre and {rates.speed_worst * exposure_s:.2f} in a corner, where the port "
            "magnifies; "
            f"{rates.roll_pitch * exposure_s:.2f} from roll and pitch at "
            f"{plan.roll_pitch_rate_deg_s:g} deg/s (centre), {rates.yaw * exposure_s:.2f} from yaw "
            f"at {plan.yaw_rate_deg_s:g} deg/s (corner); in quadrature, since the rates are "
            f"independent standard deviations. With all signs at their worst "
            f"{rates.worst * exposure_s:.2f} px",
        ),
        Setting(
            group="exposure",
            name=f"the paper's {papers:g} ms",
            value=tuple(papers_blur),
            unit="px",
            equation="u t / pixel",
            source="Gutnik et al. 2021, section VII.A",
            bound_by="not used",
            note=f"{papers:g} ms blurs {papers_blur[0]:.2f} px at {PAPER_SPEEDS_MPS[0]:g} m/s and "
            f"{papers_blur[1]:.2f} px at {PAPER_SPEEDS_MPS[1]:g} m/s, not none; 1 px needs "
            f"{sharp_s[0]:.2f} and {sharp_s[1]:.2f} ms. It is right for those who allow "
            f"{papers_blur[1]:.1f} px",
        ),
    ]
