"""The plan of a survey: lines, stations and camera settings that image an area.

Altitude and all places are of the left port's outer glass.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import shapely
from shapely.geometry import Polygon

from alice_survey.artefacts import Stage, run_stage, write_json
from alice_survey.config import SurveyConfig
from alice_survey.errors import PlanError, warn
from alice_survey.frames import Array
from camera_calib.rig import Rig, design_rig
from missions.areas.area import Area, multipolygon
from missions.areas.shapes import area_datum, area_polygon, polygon_corners
from missions.coverage.footprints import covered_share
from missions.exports.geojson import write_geojson, write_lines
from missions.footprint import Swath, common_swath, joint_swath, overlap, step_for_overlap
from missions.imaging.settings import ImagingSettings, imaging_settings, raw_bytes
from missions.lines.lawnmower import (
    LineSpacing,
    across_range,
    cross_lines,
    longer_side_heading,
    space_lines,
    survey_lines,
)
from missions.lines.line import Line
from missions.maps.plan_map import draw_plan
from missions.plan_file import Dive, Plan, read_plan
from missions.route.turns import route_through

__all__ = ["Plan", "make_plan", "read_plan", "run_plan"]


def run_plan(workspace: Path, config: SurveyConfig, threads: int) -> bool:
    """Stage `plan`: write plan.json, plan.geojson, lines.csv and map.png.

    Returns:
        True when work was done, False when the plan was up to date.

    Raises:
        PlanError: no plan meets the settings.
    """
    stage = Stage(
        name="plan",
        version=2,
        settings={
            "name": config.name,
            "area": config.area.model_dump(mode="json"),
            "camera": config.camera.model_dump(mode="json"),
            "water": config.water.model_dump(mode="json"),
            "plan": config.plan.model_dump(mode="json"),
        },
    )

    def work(folder: Path) -> None:
        rig = design_rig(config.camera, config.water)
        plan = make_plan(config, rig)
        write_json(folder / "plan.json", plan.to_json())
        write_geojson(folder / "plan.geojson", plan, rig)
        write_lines(folder / "lines.csv", plan)
        draw_plan(folder / "map.png", plan, rig)

    return run_stage(workspace, stage, work)


def make_plan(config: SurveyConfig, rig: Rig) -> Plan:
    """Plan a survey.

    Args:
        config: the survey.
        rig: its cameras in water.

    Raises:
        PlanError: no plan meets the settings; the message names the numbers.
    """
    wanted = config.plan
    camera = rig.cameras[rig.reference]
    area = area_polygon(config.area)
    imaging = imaging_settings(rig, config)
    step_m = imaging.station_spacing_m
    stereo = common_swath(rig, wanted.altitude_m, step_m)
    _check_altitude(config, stereo)
    _check_turns(config)
    polygon = area.buffer(wanted.margin_m, join_style="mitre") if wanted.margin_m else area
    heading = _heading(config, area)
    low, high = across_range(polygon, heading)
    _check_smallest(area, imaging)
    spacing = space_lines(
        high - low,
        stereo,
        largest_m=min(
            step_for_overlap(imaging.footprint_across_m, wanted.side_overlap),
            2 * stereo.half_across_m,
        ),
        exact_m=wanted.line_spacing_m,
    )
    side_overlap = overlap(imaging.footprint_across_m, spacing.spacing_m)
    _warn_of_spacing(config, spacing, side_overlap, stereo)
    lines = _all_lines(config, polygon, heading, spacing, step_m)
    route = route_through(lines, wanted.turn_radius_m, wanted.run_in_m)
    stations = sum(line.stations for line in lines)
    coverage = covered_share(area, lines, stereo, step_m)
    if coverage < 0.999 and spacing.spacing_m <= 2 * stereo.half_across_m:
        warn(
            f"every camera surely sees only {coverage:.1%} of the area: a picture every "
            f"{step_m:.3g} m leaves gaps at its corners, raise forward_overlap"
        )
    return Plan(
        name=config.name,
        area=Area(
            datum=area_datum(config.area),
            survey=multipolygon(area),
            allowed=multipolygon(area.buffer(3.0, join_style="mitre")),
            no_go=multipolygon(shapely.MultiPolygon()),
        ),
        home_ne_m=route.legs[0].start_ne_m,
        seafloor_depth_m=config.area.seafloor_depth_m,
        altitude_m=wanted.altitude_m,
        speed_mps=wanted.speed_mps,
        interval_s=imaging.interval_s,
        exposure_s=imaging.exposure_s,
        strobe_pulse_s=imaging.strobe_pulse_s,
        strobe_lead_s=imaging.strobe_lead_s,
        footprint_m=(imaging.footprint_across_m, imaging.footprint_along_m),
        line_spacing_m=spacing.spacing_m,
        station_spacing_m=step_m,
        forward_overlap=imaging.forward_overlap,
        side_overlap=side_overlap,
        lines=tuple(lines),
        dives=(
            Dive(
                first_line=0,
                last_line=len(lines) - 1,
                route=route,
                duration_s=route.length_m / wanted.speed_mps,
                energy_wh=0.0,
            ),
        ),
        energy_wh=0.0,
        turn_radius_m=wanted.turn_radius_m,
        run_in_m=wanted.run_in_m,
        length_m=route.length_m,
        duration_s=route.length_m / wanted.speed_mps,
        coverage=coverage,
        details={
            "imaging": imaging.to_json(),
            "area_m2": area.area,
            "wanted_forward_overlap": wanted.forward_overlap,
            "wanted_side_overlap": wanted.side_overlap,
            "stereo_swath_m": stereo.across_m,
            "stereo_side_overlap": _stereo_side_overlap(stereo, spacing.spacing_m),
            "mosaic_swath_m": joint_swath(rig, wanted.altitude_m, step_m).across_m,
            "turn_rate_deg_s": math.degrees(wanted.speed_mps / wanted.turn_radius_m),
            "pictures": stations * len(rig.cameras),
            "raw_bytes": raw_bytes(camera, len(rig.cameras), stations),
            "raw_bytes_per_s": raw_bytes(camera, len(rig.cameras), 1) / imaging.interval_s,
        },
    )


def _heading(config: SurveyConfig, area: Polygon) -> float:
    if config.plan.line_heading_deg is not None:
        return math.radians(config.plan.line_heading_deg)
    return longer_side_heading(area)


def _all_lines(
    config: SurveyConfig, polygon: Polygon, heading: float, spacing: LineSpacing, step_m: float
) -> list[Line]:
    """Survey lines, from the end nearest to the area's first corner, then cross lines."""
    lines = survey_lines(polygon, heading, spacing, step_m)
    if config.plan.line_heading_deg is None:
        corner = polygon_corners(polygon)[0]
        other = survey_lines(polygon, heading + math.pi, spacing, step_m)
        if _reach(other, corner) < _reach(lines, corner) - 1e-6:
            lines = other
    crossing = cross_lines(
        polygon, lines[0].heading_rad, config.plan.cross_lines, step_m, lines[-1].end_ne_m
    )
    return lines + crossing


def _reach(lines: Sequence[Line], corner: Array) -> float:
    return math.dist(lines[0].start_ne_m, corner)


def _stereo_side_overlap(stereo: Swath, spacing_m: float) -> float:
    """Least overlap of neighbouring stereo swaths: headings alternate, so like sides meet."""
    return max(0.0, (2 * stereo.half_across_m - spacing_m) / stereo.across_m)


def _check_altitude(config: SurveyConfig, stereo: Swath) -> None:
    plan, depth_m = config.plan, config.area.seafloor_depth_m
    if plan.altitude_m >= depth_m:
        raise PlanError(
            f"altitude_m {plan.altitude_m:g} is not below the surface over a sea floor at "
            f"{depth_m:g} m: lower plan.altitude_m or check area.seafloor_depth_m"
        )
    if stereo.half_across_m <= 0:
        raise PlanError(
            f"at {plan.altitude_m:g} m altitude the cameras, {config.camera.baseline_m:g} m apart, "
            "have no view in common on both sides of a line: raise plan.altitude_m"
        )


def _check_turns(config: SurveyConfig) -> None:
    plan = config.plan
    rate_deg_s = math.degrees(plan.speed_mps / plan.turn_radius_m)
    if rate_deg_s > plan.turn_rate_limit_deg_s:
        raise PlanError(
            f"turns of {plan.turn_radius_m:g} m radius at {plan.speed_mps:g} m/s need "
            f"{rate_deg_s:.0f} deg/s; turn_rate_limit_deg_s is {plan.turn_rate_limit_deg_s:g}: "
            "raise turn_radius_m or lower speed_mps"
        )


def _check_smallest(area: Polygon, imaging: ImagingSettings) -> None:
    least_m = min(imaging.footprint_across_m, imaging.footprint_along_m)
    north_0, east_0, north_1, east_1 = area.bounds
    diagonal_m = math.hypot(north_1 - north_0, east_1 - east_0)
    if diagonal_m < least_m:
        raise PlanError(
            f"area: {diagonal_m:.2g} m across is less than one picture of "
            f"{imaging.footprint_across_m:.2f} x {imaging.footprint_along_m:.2f} m: nothing to plan"
        )


def _warn_of_spacing(
    config: SurveyConfig, spacing: LineSpacing, side_overlap: float, stereo: Swath
) -> None:
    if spacing.count < 2:
        return
    if spacing.spacing_m > 2 * stereo.half_across_m:
        warn(
            f"lines {spacing.spacing_m:g} m apart leave gaps of "
            f"{spacing.spacing_m - 2 * stereo.half_across_m:.2f} m in stereo; at most "
            f"{2 * stereo.half_across_m:.2f} m apart do not"
        )
    if side_overlap < config.plan.side_overlap - 1e-9:
        wanted_m = step_for_overlap(
            spacing.spacing_m / (1 - side_overlap), config.plan.side_overlap
        )
        warn(
            f"lines {spacing.spacing_m:g} m apart overlap by {side_overlap:.1%}, less than the "
            f"{config.plan.side_overlap:.1%} asked for, which needs {wanted_m:.3f} m"
        )
