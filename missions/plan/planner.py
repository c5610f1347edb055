"""The plan of a survey: lines, stations and camera settings that image an area.

Altitude and all places are of the left port's outer glass.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np
import shapely.ops
from shapely.geometry import Point

from alice_survey.core.config import AreaConfig, CameraConfig, PlanConfig, SurveyConfig
from alice_survey.core.errors import PlanError, keep_warnings, warn
from alice_survey.sim.vehicle.pilot.settings import turn_in_place_rate_rad_s
from alice_survey.sim.vehicle.vehicle import POINT, Vehicle
from camera_calib.rig import Rig
from missions.areas.bathymetry import Bathymetry, mean_depth_m, read_bathymetry
from missions.areas.survey import survey_area
from missions.coverage.certificate import Certificate, certificate
from missions.coverage.stations import MAX_ALTITUDES, Stations, stations_of_plan, sure_pattern
from missions.exports.follower import Follower, follower_of, off_lines_m
from missions.exports.geometry import CameraMount
from missions.exports.waypoints import min_clearance_by_depth, waypoints
from missions.exposure.settings import ImagingSettings, ImagingSetup, imaging_settings
from missions.exposure.strobe import raw_bytes
from missions.plan.parts import plan_parts
from missions.plan.rows import Setting, imaging_rows
from missions.plan.strength import check_no_stops, check_turns, survey_costs, warn_of_swell
from missions.route import energy, terrain
from missions.route.turns import Zones
from missions.values.area import Area
from missions.values.costs import Costs
from missions.values.footprint import Swath, common_swath
from missions.values.line import Line
from missions.values.pattern import Pattern
from missions.values.plan_file import Dive, Plan

ByStation = tuple[tuple[float, ...], ...]
"""A value at each station of each line."""
_ENOUGH = 0.999
"""Share of the area that is to be covered at the overlap requested; below, the plan warns."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Planned:
    """A plan and what led to it."""

    plan: Plan
    imaging: ImagingSettings
    costs: Costs
    certificate: Certificate
    bathymetry: Bathymetry | None
    warnings: tuple[str, ...]
    """Warnings of the plan."""
    totals: dict[str, float]
    """Main figures by name, as pages show them."""
    rows: tuple[Setting, ...]
    """Every setting of cameras, strobes and the pattern of lines, with its equation and limit."""


def plan_survey(config: SurveyConfig, rig: Rig, *, max_cells: int | None = None) -> Planned:
    """Plan a survey.

    Args:
        config: the survey.
        rig: its cameras in water.
        max_cells: of the certificate of a large area, for a quick look; all else stays the same.

    Raises:
        PlanError: no plan meets the settings; the message names the numbers and, where one setting
            makes a plan possible, its value.
    """
    with keep_warnings() as warnings:
        plan = energy.plan_as_flown(config.plan, energy.planned_vehicle(config.vehicle))
        if plan.turn_radius_m > config.plan.arc_radius_m:
            warn(
                f"{config.vehicle.name} is steered by fins: turns are planned with a radius of "
                f"{plan.turn_radius_m:g} m and run-ins of {plan.run_in_m:g} m; long lines suit "
                "it better than short ones"
            )
        setup = ImagingSetup(
            plan=plan, camera=config.camera, water=config.water, imaging=config.imaging
        )
        imaging = imaging_settings(rig, setup)
        check_turns(plan)
        step_m = imaging.station_spacing_m
        stereo = common_swath(rig, plan.altitude_m, step_m)
        pattern = sure_pattern(rig, plan.altitude_m, imaging.line_spacing_m, step_m)
        area, bathymetry, depth_m = _site(config.area, plan, pattern, imaging)
        below_m = depth_m - plan.altitude_m
        _warn_of_spacing(plan, imaging, stereo)
        vehicle, glass_body_m = energy.sound_vehicle(config.vehicle), config.camera.position_body_m
        hull, clearance_m = vehicle.hull, config.area.no_go_clearance_m
        zones = None
        if not area.no_go.is_empty:
            zones = Zones(area, terrain.reach_of(hull, glass_body_m, 0.0, 0.0))
        home = _home(plan.home_ne_m, area)
        costs = survey_costs(config, imaging_w=imaging.imaging_w)
        flown = plan_parts(
            area,
            energy.without_stops(plan, vehicle),
            pattern,
            costs,
            home,
            usable_wh=energy.usable_wh(config.vehicle),
            depth_m=below_m,
            zones=zones,
        )
        lines, dives, sweep = flown.lines, flown.dives, flown.sweep
        check_no_stops(vehicle, plan, dives)
        _warn_of_hull(vehicle, zones, clearance_m, dives)
        reach = terrain.reach_of(
            hull,
            glass_body_m,
            max(stereo.port_m, stereo.starboard_m),
            max(stereo.ahead_m, stereo.astern_m),
        )
        depths_m, floors_m, figures = _terrain(lines, plan, reach, bathymetry)
        deepest_m, rating_m = max([below_m, *chain.from_iterable(depths_m)]), vehicle.depth_rating_m
        if rating_m is not None and deepest_m > rating_m:
            raise PlanError(
                f"{vehicle.name} is built for {rating_m:g} m and would fly at {deepest_m:.0f} m: "
                "choose another vehicle.name, or check area.seafloor_depth_m"
            )
        # A hull counts as high above its centre of buoyancy as it is deep below it.
        high_m = float(hull.points_body_m[:, 2].max()) + glass_body_m[2]
        shallowest_m = min(chain.from_iterable(depths_m), default=below_m)
        if shallowest_m < high_m:
            warn(
                f"the hull of {vehicle.name} reaches {high_m:.2f} m above the glass, which flies "
                f"{shallowest_m:.2f} m below the surface: it breaks the surface, and thrusters "
                "there draw air; lower plan.altitude_m or check area.seafloor_depth_m"
            )
        laid = Plan(
            name=config.name,
            area=area,
            home_ne_m=home,
            seafloor_depth_m=depth_m,
            altitude_m=plan.altitude_m,
            speed_mps=plan.speed_mps,
            interval_s=imaging.interval_s,
            exposure_s=imaging.exposure_s,
            strobe_pulse_s=imaging.strobe_pulse_s,
            strobe_lead_s=imaging.strobe_lead_s,
            footprint_m=(imaging.footprint_across_m, imaging.footprint_along_m),
            line_spacing_m=pattern.spacing_m,
            station_spacing_m=step_m,
            reached_forward_overlap=imaging.forward_overlap,
            reached_side_overlap=imaging.spacing.mean_overlap,
            lines=lines,
            dives=dives,
            turn_radius_m=plan.arc_radius_m,
            run_in_m=plan.run_in_m,
            length_m=sum(dive.route.length_m for dive in dives),
            duration_s=sum(dive.duration_s for dive in dives),
            energy_wh=sum(dive.energy_wh for dive in dives),
            coverage=math.nan,
            line_depths_m=depths_m,
            line_floors_m=floors_m,
            details={},
        )
        set_depth_m = config.area.seafloor_depth_m - plan.altitude_m
        warn_of_swell(
            energy.flight_conditions(plan, config.vehicle, config.sea, set_depth_m, glass_body_m),
            config.sea,
            laid,
        )
        if bathymetry is not None and figures is not None:
            ways_m = [
                terrain.way_depths_m(dive.route.legs, bathymetry, reach, plan.altitude_m)
                for dive in dives
            ]
            laid = replace(laid, way_depths_m=tuple(ways_m))
            follower = follower_of(config.vehicle, config.sea, plan.speed_mps)
            figures["by_depth"] = _by_depth(laid, plan, bathymetry, reach, config.camera, follower)
        stations = _stations(laid, bathymetry)
        seen = certificate(area, rig, stations, pattern, max_cells=max_cells)
        if seen.share_at_overlap < _ENOUGH:
            warn(
                f"{1 - seen.share_at_overlap:.2%} of the area gets less overlap than requested, "
                f"and {1 - seen.every_camera_share:.2%} is not seen by every camera: look at "
                "map.png, and give the vehicle more room, or raise the overlaps"
            )
        rows = imaging_rows(imaging, setup)
        about = {
            "imaging": {**imaging.to_json(), "rows": [row.to_json() for row in rows]},
            "heading": sweep
            and {"heading_deg": math.degrees(sweep.heading_rad), "cost_j": sweep.cost_j},
            "terrain": figures,
            "warnings": warnings,
        }
        details = json.loads(json.dumps(about))  # as they are read back
        finished = replace(laid, coverage=seen.share_at_overlap, details=details)
        planned = Planned(
            plan=finished,
            imaging=imaging,
            costs=costs,
            certificate=seen,
            bathymetry=bathymetry,
            warnings=(),
            totals=_totals(finished, seen, rig),
            rows=rows,
        )
    return replace(planned, warnings=tuple(warnings))


def _totals(plan: Plan, seen: Certificate, rig: Rig) -> dict[str, float]:
    """Main figures of a plan."""
    cameras = len(rig.cameras)
    own = ("stations", "duration_s", "energy_wh", "altitude_m")
    return {name: getattr(plan, name) for name in own} | {
        "area_m2": plan.area.survey.area,
        "lines": len(plan.lines),
        "pictures": plan.stations * cameras,
        "dives": len(plan.dives),
        "data_gb": raw_bytes(rig.cameras[rig.reference], cameras, plan.stations) / 1e9,
        "side_overlap": plan.reached_side_overlap,
        "at_overlap": seen.share_at_overlap,
    }


def _site(
    settings: AreaConfig, plan: PlanConfig, pattern: Pattern, imaging: ImagingSettings
) -> tuple[Area, Bathymetry | None, float]:
    """The area, its bathymetry where one is set, and the mean depth of the sea floor.

    Raises:
        PlanError: the area is smaller than a picture, or the vehicle would fly above the water.
    """
    outside_m = max(pattern.overhang_m, pattern.edge_m, 0.0)
    outside_m += max(pattern.spacing_m, pattern.step_m) / 2
    # Room for the widest turn: run-out, and a loop of three quarters of a turn.
    turn_margin_m = outside_m + plan.run_in_m + 3.0 * plan.arc_radius_m
    area = survey_area(settings, turn_margin_m=turn_margin_m, margin_m=plan.margin_m)
    bathymetry = area_bathymetry(settings, area, plan.altitude_m)
    across_m, along_m = imaging.footprint_across_m, imaging.footprint_along_m
    north_0, east_0, north_1, east_1 = area.survey.bounds
    diagonal_m = math.hypot(north_1 - north_0, east_1 - east_0)
    if diagonal_m < min(across_m, along_m):
        raise PlanError(
            f"area: {diagonal_m:.2g} m across is less than one picture of {across_m:.2f} x "
            f"{along_m:.2f} m: nothing to plan; plan.margin_m adds its surroundings"
        )
    depth_m = set_m = settings.seafloor_depth_m
    if bathymetry is not None:
        depth_m = mean_depth_m(bathymetry, area.survey)
        is_set = "seafloor_depth_m" in settings.model_fields_set
        if is_set and abs(depth_m - set_m) > max(0.5, 0.05 * set_m):
            warn(
                f"{bathymetry.name}: the sea floor of the area is {depth_m:.2f} m deep in the "
                f"mean, area.seafloor_depth_m is {set_m:g}: the plan uses {depth_m:.2f}; set "
                "area.seafloor_depth_m to it, for light and refraction"
            )
    if plan.altitude_m >= depth_m:
        raise PlanError(
            f"altitude_m {plan.altitude_m:g} is not below the surface over a sea floor at "
            f"{depth_m:g} m: lower plan.altitude_m or check area.seafloor_depth_m"
        )
    return area, bathymetry, depth_m


def _home(given: tuple[float, float] | None, area: Area) -> tuple[float, float]:
    """Where dives begin and end: as set, or at or near the area's corner nearest the datum.

    Corners at zones to keep out of count only where there are no others.

    Raises:
        PlanError: it is not where the vehicle may be.
    """
    if given is None:
        corners = area.corners_ne
        at_zone = shapely.distance(shapely.points(corners), area.no_go) <= 1e-6
        corners = corners[at_zone == at_zone.all()]
        # Of corners as far from the datum the most southerly, then the most westerly.
        distance = np.round(np.hypot(corners[:, 0], corners[:, 1]), 6)
        rank = np.lexsort((corners[:, 1], corners[:, 0], distance))
        nearest, _ = shapely.ops.nearest_points(area.allowed, Point(corners[rank[0]]))
        return round(float(nearest.x), 9), round(float(nearest.y), 9)
    away_m = float(area.allowed.distance(Point(given)))
    if away_m > 1e-6:
        raise PlanError(
            f"home at north {given[0]:g}, east {given[1]:g} m is {away_m:.1f} m outside of where "
            "the vehicle may be: move plan.home_ne_m, or widen area.turn_margin_m or allowed area"
        )
    return given


def area_bathymetry(settings: AreaConfig, area: Area, altitude_m: float) -> Bathymetry | None:
    """The bathymetry of an area and of what pictures see around it; None where none is set.

    Args:
        settings: name the file.
        area: of the plan.
        altitude_m: at which pictures are taken.
    """
    if settings.bathymetry_file is None:
        return None
    reach_m = 4.0 * altitude_m
    south, west, north, east = area.allowed.bounds
    return read_bathymetry(
        settings.bathymetry_file,
        area.datum,
        bounds_ne=(south - reach_m, west - reach_m, north + reach_m, east + reach_m),
        sense=settings.bathymetry_values,
        crs=settings.crs,
    )


def _terrain(
    lines: Sequence[Line], plan: PlanConfig, reach: terrain.Reach, bathymetry: Bathymetry | None
) -> tuple[ByStation, ByStation, dict[str, Any] | None]:
    """How lines follow a bathymetry: depths of glass and floor at each station, and figures."""
    if bathymetry is None:
        return (), (), None
    limits = terrain.TerrainLimits(
        altitude_m=plan.altitude_m,
        least_clearance_m=plan.least_clearance_m,
        steepest_rad=math.radians(plan.steepest_deg),
    )
    profiles = terrain.line_profiles(lines, bathymetry, reach, limits)
    depths, floors = (
        tuple(tuple(round(float(d), 4) for d in getattr(p, name)) for p in profiles)
        for name in ("depth_m", "floor_m")
    )
    return depths, floors, terrain.terrain_figures(profiles, limits, plan.relief_m)


def _by_depth(
    laid: Plan,
    plan: PlanConfig,
    bathymetry: Bathymetry,
    reach: terrain.Reach,
    camera: CameraConfig,
    follower: Follower,
) -> dict[str, float | None]:
    """How near the sea floor vehicles come that fly the way-points by depth, and COLA2's law."""
    rate_rad_s = turn_in_place_rate_rad_s(plan.turn_rate_limit_deg_s)
    mount = CameraMount(
        glass_body_m=camera.position_body_m, altimeter_body_m=camera.dvl_position_body_m
    )
    dives = [waypoints(laid, dive, mount, rate_rad_s, by_depth=True) for dive in laid.dives]
    steepest_rad = math.radians(plan.steepest_deg)
    off_m = float(off_lines_m(follower, laid, mount.glass_body_m[0]).max(initial=0.0))
    wider = replace(reach, aside_m=reach.aside_m + off_m)
    found = {
        name: min_clearance_by_depth(laid, dives, bathymetry, around, steepest_rad)
        for name, around in (("min_clearance_m", reach), ("cola2_min_clearance_m", wider))
    }
    known = {name: min_m if math.isfinite(min_m) else None for name, min_m in found.items()}
    return known | {"allowed_m": plan.least_clearance_m}


def _stations(plan: Plan, bathymetry: Bathymetry | None) -> Stations:
    """Where pictures are taken when the plan is flown exactly."""
    if bathymetry is None:
        return stations_of_plan(plan)
    places = np.vstack([line.stations_ne for line in plan.lines])
    stations = stations_of_plan(plan, bathymetry.depth_at(places))
    # As for a dive: from too high a place, what is seen is not what was requested.
    near = stations.altitude_m <= MAX_ALTITUDES * plan.altitude_m
    if not near.all():
        warn(
            f"{np.count_nonzero(~near)} of {len(near)} pictures are taken from more than "
            f"{MAX_ALTITUDES:g} times altitude_m, where the terrain is too steep to follow: they "
            "do not count as coverage; raise steepest_deg, turn the lines along the slope "
            "(line_heading_deg), or survey the steep part apart"
        )
    return stations.some(np.flatnonzero(near))


def _warn_of_hull(
    vehicle: Vehicle, zones: Zones | None, clearance_m: float, dives: Sequence[Dive]
) -> None:
    """The allowed area holds the camera: the hull behind it reaches farther."""
    if vehicle.hull == POINT:
        warn(f"{vehicle.name} has no [hull]: distances to floor and zones are those of one point")
    if zones is not None and clearance_m < zones.reach_m:
        touching, ways = zones.touching(dives)
        also = f", and for want of room on {touching} of {ways} ways between them" * bool(touching)
        warn(
            f"the hull reaches {zones.reach_m:.1f} m from the camera, which lines keep "
            f"{clearance_m:g} m off the no-go zones: it is over them where lines pass{also}; raise "
            "area.no_go_clearance_m unless the zones have room around what they keep off"
        )


def _warn_of_spacing(plan: PlanConfig, imaging: ImagingSettings, stereo: Swath) -> None:
    spacing_m, reached = imaging.line_spacing_m, imaging.spacing.mean_overlap
    gap = spacing_m - 2 * stereo.half_across_m
    if gap > 0:
        warn(
            f"lines {spacing_m:g} m apart leave gaps of {gap:.2f} m in stereo; at most "
            f"{2 * stereo.half_across_m:.2f} m apart do not"
        )
    needed_m = imaging.footprint_across_m * (1 - plan.side_overlap)
    if {"line_spacing_m", "side_overlap"} <= plan.model_fields_set and plan.line_spacing_m:
        warn(
            f"plan.line_spacing_m {spacing_m:g} and plan.side_overlap {plan.side_overlap:g} are "
            f"both set: line_spacing_m is used, lines overlap by {reached:.1%}; leave one out "
            f"({plan.side_overlap:.0%} needs {needed_m:.3f} m)"
        )
    elif reached < plan.side_overlap - 1e-9:
        warn(
            f"lines {spacing_m:g} m apart overlap by {reached:.1%}, less than the "
            f"{plan.side_overlap:.1%} requested, which needs {needed_m:.3f} m: leave out "
            "plan.line_spacing_m, and altitudes keep the overlap"
        )
