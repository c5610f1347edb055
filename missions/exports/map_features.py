"""What maps show of a plan: areas, home, lines and routes, of the left port's glass."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry
from shapely.geometry.polygon import orient

from alice_survey.core.frames import Array
from missions.exports.geometry import dive_of_line, lat_lon, line_depths_m, route_ne
from missions.values.plan_file import Plan


class MapFeature(NamedTuple):
    """A shape on a map."""

    role: str
    name: str
    about: dict[str, Any]
    shape: BaseGeometry
    """x = longitude, y = latitude, z = height, the negative depth; outer rings to the left."""


def map_features(plan: Plan) -> Iterator[MapFeature]:
    """Areas, home, lines and routes of a plan."""
    floor_m, glass_m = plan.seafloor_depth_m, plan.seafloor_depth_m - plan.altitude_m
    for role, name, area in (
        ("area", plan.name, plan.area.survey),
        ("allowed", "allowed area", plan.area.allowed),
        ("no_go", "no-go zone", plan.area.no_go),
    ):
        for part in area.geoms:
            edges = orient(shapely.transform(part, lambda ne: lon_lat(plan, ne, floor_m)))
            yield MapFeature(role, name, {}, shapely.force_3d(edges, -floor_m))
    home = lon_lat(plan, np.array([plan.home_ne_m]), 0.0)
    yield MapFeature("home", "home", {}, shapely.Point(np.append(home, 0.0)))
    dives = dive_of_line(plan)
    for index, line in enumerate(plan.lines):
        depths = line_depths_m(plan, index)
        about = {
            "line": index, "kind": line.kind, "dive": dives.get(index), "stations": line.stations,
            "length_m": round(line.length_m, 4), "depth_m": glass_m,
            "heading_deg": round(float(np.degrees(line.heading_rad)), 4),
            "altitude_m": plan.altitude_m, "speed_mps": plan.speed_mps,
        }  # fmt: skip
        ends = lon_lat(plan, np.array([line.start_ne_m, line.end_ne_m]), depths[0])
        heights = [-depths[0], -depths[-1]]
        shape = shapely.LineString(np.column_stack([ends, heights]))
        yield MapFeature("line", f"line {index}", about, shape)
    for number, dive in enumerate(plan.dives, start=1):
        about = {
            "dive": number, "length_m": round(dive.route.length_m, 4),
            "duration_s": round(dive.duration_s, 1), "energy_wh": round(dive.energy_wh, 2),
            "depth_m": glass_m,
        }  # fmt: skip
        shape = shapely.LineString(lon_lat(plan, route_ne(dive.route), glass_m))
        yield MapFeature("route", f"dive {number}", about, shapely.force_3d(shape, -glass_m))


def lon_lat(plan: Plan, points_ne: Array, depth_m: float) -> Array:
    """Longitudes and latitudes, (N, 2) degrees, to 1e-10 degrees, 0.01 mm."""
    return np.round(lat_lon(plan.datum, points_ne, depth_m)[:, ::-1], 10)
