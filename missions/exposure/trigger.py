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
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from alice_survey.core.config import CameraConfig, PlanConfig
from alice_survey.core.errors import PlanError
from alice_survey.core.frames import Array
from camera_calib.camera import Camera
from camera_calib.rig import Rig
from missions.exposure.settings_table import Setting, settings_of
from missions.exposure.ways_out import (
    HIGHEST_ALTITUDE_M,
    MIN_ALTITUDE_M,
    Way,
    conflict,
    less_overlap,
    min_that_fits,
)
from missions.values.footprint import (
    footprint_size_m,
    overlap,
    step_for_overlap,
)

EXPOSURE_STEP_S = 1e-5
PAPER_EXPOSURE_S = 3e-3
PAPER_SPEEDS_MPS = (0.2, 0.5)
_MODEL = "rigid-body motion through camera_calib.camera's slopes"


@dataclass(frozen=True, kw_only=True)
class PaperRule:
    """What the paper's frame rate r = u / (H (1 - O)) gives (its section VII.A).

    It takes the altitude H for the footprint along the track, which fits no lens of the paper.
    """

    rate_hz: float
    interval_s: float
    wanted_forward_overlap: float
    forward_overlap: float
    """What it really gives with this footprint."""


def interval_for_overlap_s(along_m: float, plan: PlanConfig) -> float:
    """Longest interval between pictures that overlap as requested, in steps of 1 ms."""
    return floor_to(step_for_overlap(along_m, plan.forward_overlap) / plan.speed_mps, 1e-3)


def paper_rule(plan: PlanConfig, footprint_along_m: float) -> PaperRule:
    """The paper's frame rate and the overlap that it really gives."""
    rate_hz = plan.speed_mps / (plan.altitude_m * (1.0 - plan.forward_overlap))
    return PaperRule(
        rate_hz=rate_hz,
        interval_s=1.0 / rate_hz,
        wanted_forward_overlap=plan.forward_overlap,
        forward_overlap=overlap(footprint_along_m, plan.speed_mps / rate_hz),
    )


def floor_to(value: float, step: float) -> float:
    """The largest multiple of a step that is not above the value (up to rounding)."""
    return round(math.floor(value / step + 1e-6) * step, 9)


def too_fast(camera: Camera, limits: CameraConfig, plan: PlanConfig, along_m: float) -> PlanError:
    """The camera cannot take pictures as fast as overlap, speed and altitude need."""
    min_s = limits.shortest_interval_s
    needed_s = step_for_overlap(along_m, plan.forward_overlap) / plan.speed_mps

    def ways() -> Iterator[Way]:
        speed = floor_to(step_for_overlap(along_m, plan.forward_overlap) / min_s, 1e-3)
        if speed > 0:
            yield Way(
                change=f"speed_mps {speed:g} instead of {plan.speed_mps:g}",
                price=f"lines take {plan.speed_mps / speed:.2f} times as long",
                cost=plan.speed_mps / speed - 1.0,
                settings={"plan.speed_mps": speed},
            )
        yield from less_overlap(plan, 1.0 - plan.speed_mps * min_s / along_m)
        longer_m = min_s * plan.speed_mps / (1.0 - plan.forward_overlap)
        min_m = min_that_fits(
            lambda altitude_m: footprint_size_m(camera, altitude_m)[1] >= longer_m,
            MIN_ALTITUDE_M, HIGHEST_ALTITUDE_M,
        )  # fmt: skip
        if min_m is not None:
            altitude_m = math.ceil(min_m * 100) / 100
            yield Way(
                change=f"altitude_m {altitude_m:g} instead of {plan.altitude_m:g}",
                price=f"a pixel grows {altitude_m / plan.altitude_m:.2f} times and light falls",
                cost=(altitude_m / plan.altitude_m) ** 2 - 1.0,
                settings={"plan.altitude_m": altitude_m},
            )

    return conflict(
        f"{plan.forward_overlap:.0%} forward overlap at {plan.speed_mps:g} m/s and "
        f"{plan.altitude_m:g} m altitude needs {1 / needed_s:.3g} pictures a second (one every "
        f"{needed_s:.3f} s), the camera takes {1 / min_s:.3g} (every {min_s:g} s)",
        ("forward_overlap x speed_mps / footprint", "camera.shortest_interval_s"),
        ways(),
    )


def trigger_rows(
    plan: PlanConfig, limits: CameraConfig, along_m: float, along_top_m: float, interval_s: float
) -> list[Setting]:
    """Frame rate by footprint and by the paper's rule, each with the overlap it gives."""
    rule = paper_rule(plan, along_m)
    step_m = plan.speed_mps * interval_s
    length = "shorter" if along_m < plan.altitude_m else "longer"
    return settings_of("frame rate", [
        ("interval", interval_s, "s", "L (1 - O) / u", "geometry of level footprints",
         "forward_overlap",
         f"{1 / interval_s:.3g} pictures a second, one every {step_m:.3g} m; the trigger "
         f"and the cameras take {1 / limits.shortest_interval_s:.3g} (the paper's 10 fps)"),
        ("forward overlap", (overlap(along_m, step_m), overlap(along_top_m, step_m)), "%",
         "1 - u T / L", "geometry of level footprints", "interval",
         "at the mean / over the top of the relief"),
        ("the paper's rule", rule.rate_hz, "Hz", "r = u / (H (1 - O))",
         "Gutnik et al. 2021, section VII.A", "not used",
         f"NOT {rule.wanted_forward_overlap:.0%}: the paper's rule gives "
         f"{rule.forward_overlap:.0%} overlap, with the picture's short side along the track. "
         f"It takes the altitude of {plan.altitude_m:g} m for the footprint, which is "
         f"{along_m:.3f} m ({length}): {rule.wanted_forward_overlap:.0%} needs "
         f"{1 / interval_s:.2f} Hz"),
    ])  # fmt: skip


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
    return settings_of("exposure", [
        ("exposure", exposure_s * 1e3, "ms", "blur allowed / |image motion|", _MODEL,
         "allowed_blur_px",
         f"for {plan.allowed_blur_px:g} px. At night only the strobe's pulse exposes: a "
         "longer shutter with the same light blurs no more"
         + ("; attitude rates shorten it" if attitude else "")),
        ("blur", rates.combined * exposure_s, "px", "sqrt(speed^2 + roll^2 + pitch^2 + yaw^2)",
         _MODEL, "allowed_blur_px",
         f"in the worst pixel. From {plan.speed_mps:g} m/s {rates.speed * exposure_s:.2f} "
         f"at the centre and {rates.speed_worst * exposure_s:.2f} in a corner, where the port "
         "magnifies; "
         f"{rates.roll_pitch * exposure_s:.2f} from roll and pitch at "
         f"{plan.roll_pitch_rate_deg_s:g} deg/s (centre), {rates.yaw * exposure_s:.2f} from yaw "
         f"at {plan.yaw_rate_deg_s:g} deg/s (corner); in quadrature, since the rates are "
         f"independent standard deviations. With all signs at their worst "
         f"{rates.worst * exposure_s:.2f} px"),
        (f"the paper's {papers:g} ms", tuple(papers_blur), "px", "u t / pixel",
         "Gutnik et al. 2021, section VII.A", "not used",
         f"{papers:g} ms blurs {papers_blur[0]:.2f} px at {PAPER_SPEEDS_MPS[0]:g} m/s and "
         f"{papers_blur[1]:.2f} px at {PAPER_SPEEDS_MPS[1]:g} m/s, not none; 1 px needs "
         f"{sharp_s[0]:.2f} and {sharp_s[1]:.2f} ms. It is right for those who allow "
         f"{papers_blur[1]:.1f} px"),
    ])  # fmt: skip
