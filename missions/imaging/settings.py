"""Camera and strobe settings that an altitude, a speed and an overlap ask for."""

import math
from dataclasses import asdict, dataclass
from typing import Any

from alice_survey.config import CameraConfig, PlanConfig
from alice_survey.errors import PlanError
from camera_calib.flat_port import FlatPortCamera
from camera_calib.fov.table import apparent_distance_m
from missions.footprint import footprint_size_m, overlap, step_for_overlap

_EXPOSURE_STEP_S = 1e-5
_INTERVAL_STEP_S = 1e-3


@dataclass(frozen=True, kw_only=True)
class PaperRule:
    """What the paper's frame rate r = u / (H (1 - O)) gives (its section VII.A).

    It takes the altitude H for the footprint along the track, which holds for no lens of the paper.
    """

    rate_hz: float
    interval_s: float
    wanted_forward_overlap: float
    forward_overlap: float
    """What it really gives with this footprint."""


@dataclass(frozen=True, kw_only=True)
class ImagingSettings:
    """When to expose, for how long, and with how much light."""

    footprint_across_m: float
    footprint_along_m: float
    pixel_m: float
    """The central pixel on the sea floor (paraxial)."""
    exposure_s: float
    blur_px: float
    """At the centre, from the speed."""
    interval_s: float
    station_spacing_m: float
    forward_overlap: float
    """As reached, on the middle column."""
    strobe_pulse_s: float
    strobe_lead_s: float
    strobe_duty: float
    """Share of the time for which the strobe is lit."""
    paper_rule: PaperRule

    def to_json(self) -> dict[str, Any]:
        """All fields as JSON values."""
        return asdict(self)


def imaging_settings(
    camera: FlatPortCamera, limits: CameraConfig, plan: PlanConfig
) -> ImagingSettings:
    """Exposure, interval and strobe that meet the plan.

    Args:
        camera: the reference camera, in water.
        limits: what the camera can do.
        plan: altitude (of the outer glass), speed, overlap and allowed blur.

    Raises:
        PlanError: the camera cannot take pictures as fast as the plan needs.
    """
    across_m, along_m = footprint_size_m(camera, plan.altitude_m)
    pixel_m = apparent_distance_m(camera, plan.altitude_m) / camera.fx_px
    exposure_s = exposure_for_blur(plan.allowed_blur_px, plan.speed_mps, pixel_m)
    interval_s = _floor(
        step_for_overlap(along_m, plan.forward_overlap) / plan.speed_mps, _INTERVAL_STEP_S
    )
    if interval_s < limits.shortest_interval_s:
        raise PlanError(
            f"{plan.forward_overlap:.0%} forward overlap at {plan.speed_mps:g} m/s and "
            f"{plan.altitude_m:g} m altitude needs a picture every {interval_s:.3f} s; the "
            f"camera's shortest is {limits.shortest_interval_s:g} s: lower speed_mps or "
            "forward_overlap"
        )
    pulse_s = exposure_s + 2 * plan.strobe_lead_s
    if pulse_s > interval_s:
        raise PlanError(
            f"a strobe pulse of {pulse_s:.4f} s (exposure {exposure_s:.4f} s, lead "
            f"{plan.strobe_lead_s:g} s) does not fit the interval of {interval_s:.3f} s: lower "
            "strobe_lead_s or allowed_blur_px"
        )
    spacing_m = round(interval_s * plan.speed_mps, 9)
    return ImagingSettings(
        footprint_across_m=across_m,
        footprint_along_m=along_m,
        pixel_m=pixel_m,
        exposure_s=exposure_s,
        blur_px=plan.speed_mps * exposure_s / pixel_m,
        interval_s=interval_s,
        station_spacing_m=spacing_m,
        forward_overlap=overlap(along_m, spacing_m),
        strobe_pulse_s=pulse_s,
        strobe_lead_s=plan.strobe_lead_s,
        strobe_duty=pulse_s / interval_s,
        paper_rule=paper_rule(
            plan.speed_mps, plan.altitude_m, plan.forward_overlap, footprint_along_m=along_m
        ),
    )


def exposure_for_blur(allowed_blur_px: float, speed_mps: float, pixel_m: float) -> float:
    """Longest exposure that blurs the central pixel by no more than allowed, in steps of 10 us."""
    return _floor(allowed_blur_px * pixel_m / speed_mps, _EXPOSURE_STEP_S)


def paper_rule(
    speed_mps: float, altitude_m: float, forward_overlap: float, *, footprint_along_m: float
) -> PaperRule:
    """The paper's frame rate and the overlap that it really gives."""
    rate_hz = speed_mps / (altitude_m * (1.0 - forward_overlap))
    return PaperRule(
        rate_hz=rate_hz,
        interval_s=1.0 / rate_hz,
        wanted_forward_overlap=forward_overlap,
        forward_overlap=overlap(footprint_along_m, speed_mps / rate_hz),
    )


def raw_bytes(camera: FlatPortCamera, cameras: int, stations: int) -> int:
    """Size of all pictures as the sensor gives them, one byte a pixel."""
    return camera.width_px * camera.height_px * cameras * stations


def _floor(value: float, step: float) -> float:
    """The largest multiple of a step that is not above the value (up to rounding)."""
    return round(math.floor(value / step + 1e-6) * step, 9)
