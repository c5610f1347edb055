"""The area to survey as a polygon in the local frame.

Polygons are shapely's with x = north and y = east, the order of NED: only files and maps that want
east first swap them.
"""

import math

import numpy as np
import shapely
from shapely.geometry import Polygon

from alice_survey.config import AreaConfig
from alice_survey.errors import PlanError
from alice_survey.frames import Array, Datum
from missions.areas.raw import RawLine, RawShapes, from_rings, no_points

_SAME_CORNER_M = 1e-3
_FARTHEST_M = 20_000.0
"""From the datum: beyond, a flat local frame is no longer one."""


def survey_shapes(settings: AreaConfig) -> RawShapes:
    """The shape to survey, as it was given; a rectangle at the datum unless there is another.

    Raises:
        PlanError: a file or text cannot be read.
    """
    if settings.file is not None:
        from missions.areas.files import read_area_file

        return read_area_file(settings.file, settings.layer, settings.crs)
    if settings.wkt is not None:
        from missions.areas.files import read_wkt

        return read_wkt("wkt", settings.wkt, settings.crs)
    for name in ("corridor_ne_m", "corridor_latlon_deg"):
        points = getattr(settings, name)
        if points is not None:
            line = RawLine(points=np.asarray(points, dtype=np.float64))
            return RawShapes(
                origin=name, geographic="latlon" in name, lines=(line,), points=no_points()
            )
    for name in ("polygon_ne_m", "polygon_latlon_deg"):
        corners = getattr(settings, name)
        if corners is not None:
            return from_rings(name, [corners], geographic="latlon" in name)
    return from_rings("rectangle", [_rectangle(settings)], geographic=False)


def no_go_shapes(settings: AreaConfig) -> list[RawShapes]:
    """The zones to keep out of, by source.

    Raises:
        PlanError: a file cannot be read.
    """
    zones = []
    for name in ("no_go_ne_m", "no_go_latlon_deg"):
        rings = getattr(settings, name)
        if rings:
            zones.append(from_rings(name, rings, geographic="latlon" in name))
    if settings.no_go_file is not None:
        from missions.areas.files import read_area_file

        zones.append(
            read_area_file(settings.no_go_file, settings.no_go_layer, settings.crs, role="no_go")
        )
    return zones


def allowed_shapes(settings: AreaConfig) -> RawShapes | None:
    """Where the vehicle may be, or None where the settings do not say it.

    Raises:
        PlanError: a file cannot be read.
    """
    for name in ("allowed_ne_m", "allowed_latlon_deg"):
        corners = getattr(settings, name)
        if corners is not None:
            return from_rings(name, [corners], geographic="latlon" in name)
    if settings.allowed_file is None:
        return None
    from missions.areas.files import read_area_file

    return read_area_file(
        settings.allowed_file, settings.allowed_layer, settings.crs, role="allowed"
    )


def _rectangle(settings: AreaConfig) -> Array:
    """Corners (4, 2): the length along the heading, the width to the right of it."""
    heading = math.radians(settings.heading_deg)
    along = settings.length_m * np.array([math.cos(heading), math.sin(heading)])
    right = settings.width_m * np.array([-math.sin(heading), math.cos(heading)])
    corners: Array = np.array([0 * along, along, along + right, right])
    return corners if settings.datum_at == "corner" else corners - (along + right) / 2


def area_datum(area: AreaConfig) -> Datum:
    """The origin of the local frame."""
    return Datum(area.latitude_deg, area.longitude_deg)


def area_polygon(area: AreaConfig) -> Polygon:
    """The area to survey.

    A rectangle has its first corner at the datum, its length along the heading and its width to the
    right of it. Corners in latitude and longitude are taken to lie on the sea floor.

    Returns:
        A valid polygon with x = north and y = east, metres; its corners are in the given order,
        without repeats.

    Raises:
        PlanError: fewer than 3 distinct corners, no size, edges that cross, or a corner too far
            from the datum; the message names the corner or the place.
    """
    corners = _distinct(_corners_ne(area))
    if len(corners) < 3:
        raise PlanError(f"area: {len(corners)} distinct corners; a polygon needs 3 or more")
    far = np.linalg.norm(corners, axis=1)
    if far.max() > _FARTHEST_M:
        raise PlanError(
            f"area: corner {int(far.argmax()) + 1} is {far.max() / 1e3:.0f} km from the datum "
            f"({area.latitude_deg:g}, {area.longitude_deg:g}); at most "
            f"{_FARTHEST_M / 1e3:.0f} km: move the datum or check the corner"
        )
    polygon = Polygon(corners)
    if polygon.convex_hull.area < 1e-4:
        raise PlanError(
            f"area: {polygon.convex_hull.area:.2g} m2 is no size; its corners lie on one line"
        )
    if not polygon.is_valid:
        raise PlanError(f"area: {_fault(polygon)}; list the corners in order round the edge")
    return polygon


def polygon_corners(polygon: Polygon) -> Array:
    """The outer corners of a polygon, (N, 2) north and east, not closed."""
    return np.asarray(polygon.exterior.coords, dtype=np.float64)[:-1, :2]


def _corners_ne(area: AreaConfig) -> Array:
    if area.polygon_ne_m is not None:
        return np.asarray(area.polygon_ne_m, dtype=np.float64)
    if area.polygon_latlon_deg is not None:
        lat_lon = np.asarray(area.polygon_latlon_deg, dtype=np.float64)
        depth_m = np.full((len(lat_lon), 1), area.seafloor_depth_m)
        return area_datum(area).ned_from_geodetic(np.hstack([lat_lon, depth_m]))[:, :2]
    heading = math.radians(area.heading_deg)
    along = area.length_m * np.array([math.cos(heading), math.sin(heading)])
    right = area.width_m * np.array([-math.sin(heading), math.cos(heading)])
    return np.array([0 * along, along, along + right, right])


def _distinct(corners: Array) -> Array:
    """Leave out corners that repeat their predecessor (the first one's is the last)."""
    before = np.roll(corners, 1, axis=0)
    repeats = np.linalg.norm(corners - before, axis=1) < _SAME_CORNER_M
    if np.linalg.norm(corners[0] - corners[-1]) < _SAME_CORNER_M:
        repeats[0], repeats[-1] = False, len(corners) > 1
    kept: Array = corners[~repeats]
    return kept


def _fault(polygon: Polygon) -> str:
    """What shapely finds wrong, such as `Self-intersection[1 2]`, in words."""
    reason, _, place = shapely.is_valid_reason(polygon).partition("[")
    north, east = (float(value) for value in place.rstrip("]").split())
    what = "edges cross" if "intersection" in reason.lower() else reason.lower()
    return f"{what} near north {north:.2f} m, east {east:.2f} m"
