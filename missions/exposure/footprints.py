"""Footprints through the flat port over the relief, the overlaps they give, and line spacing.

The sea floor rises and falls by `relief_m` about its mean, so that the altitude over ground goes
from `altitude_m - relief_m` (the top of the relief) to `altitude_m + relief_m`.
"""

import math
from dataclasses import dataclass

import numpy as np
from shapely.affinity import translate

from alice_survey.core.config import PlanConfig
from camera_calib.camera import Camera
from camera_calib.fov.focus import axial_pixel_m
from camera_calib.rig import Rig
from missions.exposure.settings_table import Setting, settings_of
from missions.exposure.ways_out import (
    HIGHEST_ALTITUDE_M,
    MIN_ALTITUDE_M,
    Way,
    conflict,
    min_that_fits,
)
from missions.values.footprint import (
    camera_swath,
    common_swath,
    footprint_polygon,
    footprint_size_m,
    level_pose,
    overlap,
    step_for_overlap,
)

_PORT = (
    "exact flat port: Snell's law at both faces of the glass (camera_calib.camera); paraxial "
    "pixel: D = d + g/n_glass + a/n_water"
)
_GEOMETRY = "geometry of level footprints"


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
    area_overlap: float
    """Share of the area of one camera's picture that the picture abeam on the next line sees too,
    at the mean altitude."""
    swath_overlap: float
    """Side overlap of what one camera surely sees on a line, between its pictures."""
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
    safe_m = math.ceil(10 * (plan.relief_m + plan.least_clearance_m)) / 10
    flat_m = math.floor(100 * (plan.altitude_m - MIN_ALTITUDE_M) + 1e-9) / 100
    leaves = "runs aground" if top_m <= 0 else f"leaves {top_m:.2f} m over its top"
    raise conflict(
        f"{plan.altitude_m:g} m altitude over relief of +-{plan.relief_m:g} m {leaves}; "
        f"{MIN_ALTITUDE_M:g} m is the least",
        ("altitude_m", "relief_m"),
        [
            Way(
                change=f"altitude_m {safe_m:g}",
                price=f"least_clearance_m of {plan.least_clearance_m:g} m is kept, a pixel grows "
                f"{safe_m / plan.altitude_m:.1f} times",
                cost=safe_m / plan.altitude_m - 1.0,
                settings={"plan.altitude_m": safe_m},
            ),
            Way(
                change=f"relief_m {flat_m:g}, where the site is as flat as that",
                price="a wrong guess ends the dive",
                cost=1.0 - flat_m / plan.relief_m,
                settings={"plan.relief_m": flat_m},
            ),
            Way(
                change="area.bathymetry_file, so that lines follow the terrain",
                price="relief_m is then only what the chart does not show",
                cost=1.0,
                settings={"plan.relief_m": 0.0},
            ),
        ],
    )


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
    if plan.line_spacing_m is not None:
        return _spacing(rig, prints, plan, plan.line_spacing_m, "line_spacing_m", step_m)
    print_, where = prints.mean, "side_overlap"
    if plan.overlap_over_relief:
        print_, where = prints.top, "side_overlap at the top of the relief"
        swath = common_swath(rig, prints.top.altitude_m, step_m)
    options = [
        (step_for_overlap(print_.across_m, plan.side_overlap), where),
        (2 * swath.half_across_m, "no gap in stereo"),
    ]
    widest_m, bound_by = min(options)
    if swath.half_across_m <= 0:
        raise _no_common_view(rig, plan, print_.altitude_m, step_m)
    spacing_m = widest_m - 2 * plan.track_error_m
    if spacing_m < 0.1 * widest_m:
        raise _too_far_off_track(rig, plan, print_, widest_m, step_m)
    if plan.track_error_m > 0:
        bound_by += " and track_error_m"
    return _spacing(rig, prints, plan, spacing_m, bound_by, step_m)


def _spacing(
    rig: Rig,
    prints: FootprintRange,
    plan: PlanConfig,
    spacing_m: float,
    bound_by: str,
    step_m: float,
) -> Spacing:
    """All overlaps that a spacing gives."""
    camera, swath = rig.cameras[rig.reference], common_swath(rig, plan.altitude_m, step_m)
    one = camera_swath(rig, rig.reference, plan.altitude_m, step_m)
    pose = level_pose(camera, np.zeros(2), plan.altitude_m, plan.altitude_m, 0.0)
    picture = footprint_polygon(camera, pose, plan.altitude_m)
    abeam = translate(picture, yoff=spacing_m)
    apart_m = spacing_m + 2 * plan.track_error_m
    return Spacing(
        spacing_m=spacing_m,
        bound_by=bound_by,
        mean_overlap=overlap(prints.mean.across_m, spacing_m),
        top_overlap=overlap(prints.top.across_m, spacing_m),
        off_track_overlap=overlap(prints.top.across_m, apart_m),
        area_overlap=picture.intersection(abeam).area / picture.area,
        swath_overlap=overlap(one.across_m, spacing_m),
        stereo_overlap=max(0.0, (2 * swath.half_across_m - spacing_m) / swath.across_m),
    )


def _no_common_view(rig: Rig, plan: PlanConfig, altitude_m: float, step_m: float) -> Exception:
    """The cameras' views do not meet on both sides of a line."""
    above_m = plan.altitude_m - altitude_m
    needed_m = min_that_fits(
        lambda higher_m: (
            common_swath(rig, higher_m, step_m * higher_m / altitude_m).half_across_m > 0
        ),
        altitude_m,
        HIGHEST_ALTITUDE_M - above_m,
    )
    ways = []
    if needed_m is not None:
        raised_m = math.ceil(100 * (needed_m + above_m)) / 100
        ways.append(
            Way(
                change=f"altitude_m {raised_m:g}",
                price=f"a pixel grows {raised_m / plan.altitude_m:.2f} times",
                cost=raised_m / plan.altitude_m - 1.0,
                settings={"plan.altitude_m": raised_m},
            )
        )
    return conflict(
        f"from {altitude_m:.2f} m the cameras, {rig.baseline_m:g} m apart, have no view in common "
        "on both sides of a line",
        ("camera.baseline_m", "altitude_m"),
        ways,
    )


def _too_far_off_track(
    rig: Rig, plan: PlanConfig, print_: FootprintAt, widest_m: float, step_m: float
) -> Exception:
    """The allowance for track errors leaves nothing of the spacing."""
    allowed_m = math.floor(250 * widest_m) / 1000
    ratio = plan.track_error_m / (0.25 * widest_m)
    higher_m = math.ceil(10 * plan.altitude_m * ratio) / 10
    fits = math.floor(100 * (1.0 - 4.0 * plan.track_error_m / print_.across_m)) / 100
    ways = [
        Way(
            change=f"track_error_m {allowed_m:g}",
            price="the vehicle must hold its lines so well; half the spacing is allowance",
            cost=1.0 - 1.0 / ratio,
            settings={"plan.track_error_m": allowed_m},
        ),
        Way(
            change=f"altitude_m {higher_m:g}",
            price=f"a pixel grows {ratio:.1f} times",
            cost=ratio - 1.0,
            settings={"plan.altitude_m": higher_m},
        ),
    ]
    if fits > 0:
        ways.append(
            Way(
                change=f"side_overlap {fits:g}",
                price=f"instead of {plan.side_overlap:.0%}",
                cost=(plan.side_overlap - fits) / max(plan.side_overlap, 1e-9),
                settings={"plan.side_overlap": fits},
            )
        )
    return conflict(
        f"lines that overlap by {plan.side_overlap:.0%} lie {widest_m:.2f} m apart; errors of "
        f"{plan.track_error_m:g} m on both sides leave {widest_m - 2 * plan.track_error_m:.2f} m",
        ("side_overlap", "track_error_m"),
        ways,
    )


def footprint_rows(prints: FootprintRange) -> list[Setting]:
    """Footprint, pixel and stereo swath, each over the relief."""
    over = (prints.top, prints.mean, prints.bottom)
    top, mean, bottom = over
    where = f"from {top.altitude_m:.3g} / {mean.altitude_m:.3g} / {bottom.altitude_m:.3g} m"
    return settings_of("footprint and lines", [
        ("footprint across", tuple(p.across_m for p in over), "m", "traced", _PORT,
         "altitude_m", f"{where} altitude: top, mean and bottom of the relief. The rectangle "
         "between the corners, which is surely seen; the sides bulge beyond it"),
        ("footprint along", tuple(p.along_m for p in over), "m", "traced", _PORT,
         "altitude_m", ""),
        ("pixel on the floor", tuple(p.pixel_m * 1e3 for p in over), "mm", "D / f", _PORT,
         "altitude_m", ""),
        ("stereo swath", tuple(p.stereo_across_m for p in over), "m", "seen by every camera", _PORT,
         "baseline_m", ""),
    ])  # fmt: skip


def spacing_rows(spacing: Spacing, plan: PlanConfig, prints: FootprintRange) -> list[Setting]:
    """Line spacing, and the side overlap it gives."""
    given = plan.line_spacing_m is not None
    across_m = prints.mean.across_m
    note = ""
    if given and spacing.mean_overlap < plan.side_overlap - 1e-9:
        wanted = step_for_overlap(across_m, plan.side_overlap) - 2 * plan.track_error_m
        note = f"{plan.side_overlap:.0%}, as requested, needs {wanted:.3f} m"
    elif given and math.isclose(spacing.spacing_m, 1.0) and math.isclose(plan.altitude_m, 2.0):
        note = "the paper flew 1 m lines at 2 m and states 45 %: " + _papers_overlap(across_m)
    return settings_of("footprint and lines", [
        ("line spacing", spacing.spacing_m, "m", "as set" if given else "W (1 - O) - 2 e",
         _GEOMETRY, spacing.bound_by, note),
        ("side overlap", (spacing.mean_overlap, spacing.top_overlap, spacing.off_track_overlap),
         "%", "1 - (s + 2 e) / W", _GEOMETRY, "line spacing",
         f"at the mean / over the top of the relief / there with lines each "
         f"{plan.track_error_m:g} m off (track_error_m). All of the rectangles between the "
         f"corners; by area whole pictures share {spacing.area_overlap:.1%}, "
         f"and the swaths that lines surely see {spacing.swath_overlap:.1%}, at the mean"),
        ("stereo side overlap", spacing.stereo_overlap, "%", "(2 half swath - s) / swath",
         _GEOMETRY, "line spacing",
         "least of neighbouring stereo swaths; headings alternate, so that like sides meet"),
    ])  # fmt: skip


def _papers_overlap(across_m: float) -> str:
    """What lines 1 m apart give with this footprint, and what 45 % would take."""
    return (
        f"1 m gives {overlap(across_m, 1.0):.1%} with this footprint of {across_m:.3f} m; 45 % "
        f"needs lines {step_for_overlap(across_m, 0.45):.3f} m apart, or a footprint of "
        f"{1.0 / 0.55:.2f} m"
    )
