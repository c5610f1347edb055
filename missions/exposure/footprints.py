"""Footprints through the flat port over the relief, the overlaps they give, and line spacing.

The sea floor rises and falls by `relief_m` about its mean, so that the altitude over ground goes
from `altitude_m - relief_m` (the top of the relief) to `altitude_m + relief_m`.
"""

import math
from dataclasses import dataclass

from alice_survey.core.config import PlanConfig
from camera_calib.camera import Camera
from camera_calib.fov.focus import axial_pixel_m
from camera_calib.rig import Rig
from missions.exposure.conflict import MAX_ALTITUDE_M, MIN_ALTITUDE_M, conflict, last_that_fits
from missions.values.footprint import common_swath, footprint_size_m, overlap, step_for_overlap


@dataclass(frozen=True, kw_only=True)
class FootprintAt:
    """What one camera and the pair see from one altitude."""

    altitude_m: float
    across_m: float
    """Width of the rectangle between the footprint's corners: what is surely seen."""
    along_m: float
    """Its length."""
    pixel_m: float
    """The central pixel on the sea floor (paraxial)."""
    stereo_across_m: float
    """Width that every camera surely sees on a line."""


@dataclass(frozen=True, kw_only=True)
class FootprintRange:
    """Footprints at the top of the relief, at its mean and at its bottom."""

    top: FootprintAt
    mean: FootprintAt
    bottom: FootprintAt


@dataclass(frozen=True, kw_only=True)
class Spacing:
    """How far apart lines lie, why, and how much neighbours overlap."""

    spacing_m: float
    bound_by: str
    mean_overlap: float
    """Side overlap of what one camera's pictures surely see, at the mean altitude."""
    top_overlap: float
    """The same at the top of the relief."""
    off_track_overlap: float
    """Side overlap at the top of the relief where two neighbours are each off by the track error,
    away from each other."""
    stereo_overlap: float
    """Least overlap of neighbouring stereo swaths at the mean altitude."""


def footprint_at(rig: Rig, altitude_m: float, step_m: float) -> FootprintAt:
    """Footprint, pixel and stereo swath from an altitude.

    Args:
        rig: its first camera is the reference.
        altitude_m: of the outer glass.
        step_m: from picture to picture; the swath of stereo depends on it at its edges.

    Raises:
        PlanError: part of the picture looks past the sea floor.
    """
    camera = rig.cameras[rig.reference]
    across_m, along_m = footprint_size_m(camera, altitude_m)
    return FootprintAt(
        altitude_m=altitude_m,
        across_m=across_m,
        along_m=along_m,
        pixel_m=pixel_on_floor_m(camera, altitude_m),
        stereo_across_m=common_swath(rig, altitude_m, step_m).across_m,
    )


def pixel_on_floor_m(camera: Camera, altitude_m: float) -> float:
    """Size of the central pixel on the sea floor (paraxial)."""
    at_glass_m, per_m = axial_pixel_m(camera)
    return at_glass_m + per_m * altitude_m


def altitude_for_pixel_m(camera: Camera, pixel_m: float) -> float:
    """The inverse of `pixel_on_floor_m`; negative where even the glass is too far."""
    at_glass_m, per_m = axial_pixel_m(camera)
    return (pixel_m - at_glass_m) / per_m


def top_altitude_m(plan: PlanConfig) -> float:
    """Altitude over the top of the relief.

    Raises:
        PlanError: the relief comes nearer to the glass than `MIN_ALTITUDE_M`.
    """
    top_m = plan.altitude_m - plan.relief_m
    if top_m >= MIN_ALTITUDE_M - 1e-9:
        return top_m
    leaves = "runs aground" if top_m <= 0 else f"leaves {top_m:.2f} m over its top"
    raise conflict(
        f"{plan.altitude_m:g} m altitude over relief of +-{plan.relief_m:g} m {leaves}; "
        f"{MIN_ALTITUDE_M:g} m is the minimum",
        ("altitude_m", "relief_m"),
        "plan.altitude_m", math.ceil(10 * (plan.relief_m + plan.least_clearance_m)) / 10,
    )  # fmt: skip


def footprint_range(rig: Rig, plan: PlanConfig, step_m: float) -> FootprintRange:
    """Footprints over the relief.

    Raises:
        PlanError: the relief comes too near to the glass, or part of a picture looks past the sea
            floor.
    """
    top, bottom = top_altitude_m(plan), plan.altitude_m + plan.relief_m
    return FootprintRange(
        top=footprint_at(rig, top, step_m),
        mean=footprint_at(rig, plan.altitude_m, step_m),
        bottom=footprint_at(rig, bottom, step_m),
    )


def line_spacing(rig: Rig, plan: PlanConfig, step_m: float) -> Spacing:
    """How far apart lines are to lie.

    `line_spacing_m` where it is set. Else the widest spacing `W (1 - O) - 2 e` for which two
    neighbours that are each off by the track error e still overlap by the side overlap O on the
    footprint W, at the top of the relief where `overlap_over_relief` is set; and no wider than
    stereo swaths reach, less 2 e.

    Args:
        rig: its first camera is the reference.
        plan: what is requested.
        step_m: from picture to picture.

    Raises:
        PlanError: no spacing gives the overlap; or as `footprint_range`.
    """
    prints = footprint_range(rig, plan, step_m)
    swath = common_swath(rig, plan.altitude_m, step_m)
    if swath.half_across_m <= 0:
        raise _no_common_view(rig, plan, plan.altitude_m, step_m)
    spacing_m, bound_by = plan.line_spacing_m, "line_spacing_m"
    if spacing_m is None:
        spacing_m, bound_by = _widest_spacing(rig, prints, plan, step_m)
    return Spacing(
        spacing_m=spacing_m,
        bound_by=bound_by,
        mean_overlap=overlap(prints.mean.across_m, spacing_m),
        top_overlap=overlap(prints.top.across_m, spacing_m),
        off_track_overlap=overlap(prints.top.across_m, spacing_m + 2 * plan.track_error_m),
        stereo_overlap=max(0.0, (2 * swath.half_across_m - spacing_m) / swath.across_m),
    )


def _widest_spacing(
    rig: Rig, prints: FootprintRange, plan: PlanConfig, step_m: float
) -> tuple[float, str]:
    """The widest spacing that overlaps as requested, and what bounds it."""
    print_, bound_by = prints.mean, "side_overlap"
    if plan.overlap_over_relief:
        print_, bound_by = prints.top, "side_overlap at the top of the relief"
    half_m = common_swath(rig, print_.altitude_m, step_m).half_across_m
    if half_m <= 0:
        raise _no_common_view(rig, plan, print_.altitude_m, step_m)
    widest_m, bound_by = min(
        (step_for_overlap(print_.across_m, plan.side_overlap), bound_by),
        (2 * half_m, "no gap in stereo"),
    )
    spacing_m = widest_m - 2 * plan.track_error_m
    if spacing_m < 0.1 * widest_m:
        raise conflict(
            f"lines that overlap by {plan.side_overlap:.0%} lie {widest_m:.2f} m apart; errors of "
            f"{plan.track_error_m:g} m on both sides leave {spacing_m:.2f} m",
            ("side_overlap", "track_error_m"),
            "plan.track_error_m", math.floor(250 * widest_m) / 1000,
        )  # fmt: skip
    return spacing_m, bound_by + (" and track_error_m" if plan.track_error_m > 0 else "")


def _no_common_view(rig: Rig, plan: PlanConfig, altitude_m: float, step_m: float) -> Exception:
    """The cameras' views do not meet on both sides of a line."""
    above_m = plan.altitude_m - altitude_m

    def meet(higher_m: float) -> bool:
        return common_swath(rig, higher_m, step_m * higher_m / altitude_m).half_across_m > 0

    raised_m = None
    if meet(MAX_ALTITUDE_M - above_m):
        needed_m = last_that_fits(meet, MAX_ALTITUDE_M - above_m, altitude_m)
        raised_m = math.ceil(100 * (needed_m + above_m)) / 100
    return conflict(
        f"from {altitude_m:.2f} m the cameras, {rig.baseline_m:g} m apart, have no view in common "
        "on both sides of a line",
        ("camera.baseline_m", "altitude_m"),
        "plan.altitude_m", raised_m,
    )  # fmt: skip
