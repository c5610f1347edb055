"""From settings, shapes and files, to the area to survey and where the vehicle may be."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from shapely.geometry import LineString, MultiPolygon, Point
from shapely.geometry.base import BaseGeometry

from alice_survey.core.config import AreaConfig
from alice_survey.core.errors import PlanError, warn
from alice_survey.core.frames import Array, Datum
from missions.areas.crs import LocalFrame, middle
from missions.areas.files import read_area_file, read_wkt
from missions.areas.raw import RawLine, RawShapes, from_rings, no_points
from missions.areas.repair import (
    GRID_M,
    Repaired,
    buffered_line,
    distinct,
    repaired,
    widened,
    without_slivers,
)
from missions.values.area import Area, multipolygon

_SMALL_SHARE = 1e-6
_POLAR_DEG = 66.6
"""Few dive so far north or south: coordinates may be swapped."""
_LOCAL_SETTINGS = ("no_go_ne_m", "allowed_ne_m")


@dataclass(frozen=True, kw_only=True, eq=False)
class GivenShapes:
    """The shapes of an area as settings and files have them, and the frame they are planned in."""

    survey: RawShapes
    no_go: tuple[RawShapes, ...]
    """By source."""
    allowed: RawShapes | None
    frame: LocalFrame


def given_shapes(settings: AreaConfig) -> GivenShapes:
    """Read the shapes of an area.

    Raises:
        PlanError: a file or text cannot be read.
    """
    survey = _with_closed_lines(_survey_shapes(settings), settings)
    return GivenShapes(
        survey=survey,
        no_go=(*_no_go_shapes(settings), *([] if survey.no_go is None else [survey.no_go])),
        allowed=_allowed_shapes(settings),
        frame=_local_frame(settings, survey),
    )


def survey_area(settings: AreaConfig, *, turn_margin_m: float, margin_m: float = 0.0) -> Area:
    """What to survey and where the vehicle may be.

    Holes of the survey area and zones to keep out of, widened by `no_go_clearance_m`, are left out
    of both. Edges are straight between corners, on the sea floor.

    Args:
        settings: shapes, or the files that hold them.
        turn_margin_m: how far the vehicle may leave the survey area where the settings say neither
            that nor an allowed shape.
        margin_m: what is added to the survey area on every side.

    Raises:
        PlanError: a shape cannot be used; the message names the source and the place.
    """
    given = given_shapes(settings)
    raw, allowed_raw, frame = given.survey, given.allowed, given.frame
    shape = _polygons(raw, frame, settings.corridor_width_m)
    clearance_m = settings.no_go_clearance_m
    zones = [(raw.origin, widened(shape.holes, clearance_m))]
    zones += [(zone.origin, _zone(zone, frame, clearance_m)) for zone in given.no_go]
    no_go = _union([zone for _, zone in zones])
    wanted = widened(shape.solid, margin_m)
    survey = _less(wanted, no_go)
    if survey.is_empty:
        names = " and ".join(name for name, zone in zones if not zone.is_empty)
        raise PlanError(
            f"area: the zones to keep out of ({names}) leave nothing of the {wanted.area:.4g} m2 "
            "to survey: shrink them or lower no_go_clearance_m"
        )
    if allowed_raw is None:
        margin = settings.turn_margin_m if settings.turn_margin_m is not None else turn_margin_m
        allowed = _less(widened(wanted, margin), no_go)
        if raw.unused_fence:
            warn(f"area: {raw.origin}: {raw.unused_fence}")
    else:
        if settings.turn_margin_m is not None:
            warn(f"area: turn_margin_m is not used: {allowed_raw.origin} says where to be")
        reach = _polygons(allowed_raw, frame, settings.corridor_width_m)
        allowed = _less(reach.solid, no_go)
    area = Area(datum=frame.datum, survey=survey, allowed=allowed, no_go=no_go)
    if allowed_raw is None:
        _check_parts(area, margin_m=margin)
    else:
        _check_inside(area, raw, frame, allowed_raw.origin)
        _check_parts(area, given=allowed_raw.origin)
    return area


def _local_frame(settings: AreaConfig, raw: RawShapes) -> LocalFrame:
    """The frame that the area is planned in: at the datum that is set, else at the middle.

    Raises:
        PlanError: half a datum is set for shapes in degrees.
    """
    names = {"latitude_deg", "longitude_deg"}
    given = names & settings.model_fields_set
    if raw.geographic and len(given) == 1:
        (missing,) = names - given
        raise PlanError(f"area: the datum needs {missing}, too; or leave out {given.pop()}")
    if given or not raw.geographic:
        datum = Datum(settings.latitude_deg, settings.longitude_deg)
    else:
        datum = middle(raw)
        latitude_deg, longitude_deg = datum.latitude_deg, datum.longitude_deg
        if abs(latitude_deg) > _POLAR_DEG >= abs(longitude_deg):
            warn(
                f"area: {raw.origin} lies at latitude {latitude_deg:.6g}, longitude "
                f"{longitude_deg:.6g}: if these are swapped, correct the file; if not, set the "
                "datum there (latitude_deg, longitude_deg)"
            )
        local = [name for name in _LOCAL_SETTINGS if getattr(settings, name)]
        if local:
            warn(
                f"area: {' and '.join(local)} count{'s' if len(local) == 1 else ''} from the "
                f"middle of {raw.origin}, {datum.latitude_deg:.6f}, {datum.longitude_deg:.6f}: set "
                "latitude_deg and longitude_deg to make that sure"
            )
    return LocalFrame(
        datum=datum,
        seafloor_depth_m=settings.seafloor_depth_m,
        datum_is_given=bool(given) or not raw.geographic,
    )


def _polygons(raw: RawShapes, frame: LocalFrame, corridor_width_m: float) -> Repaired:
    """The polygons of a source and the corridors along its lines."""
    if raw.is_empty or not (raw.polygons or raw.lines):
        raise PlanError(
            f"area: {raw.origin}: it holds {_counted(raw)}; an area needs a polygon or a line"
        )
    local = frame.localised(raw)
    shape = repaired(local, frame, geographic=raw.geographic)
    if len(raw.points):
        warn(f"area: {raw.origin}: {_counted(replace(raw, polygons=(), lines=()))} left out")
    if not raw.lines:
        return shape
    widths_m = [line.width_m or corridor_width_m for line in local.lines]
    strips = [
        corridor_strip(line.points, width_m, local.origin, local.line_name(i))
        for i, (line, width_m) in enumerate(zip(local.lines, widths_m, strict=True))
    ]
    if raw.polygons:
        widths = " and ".join(f"{width_m:g} m" for width_m in sorted(set(widths_m)))
        warn(
            f"area: {raw.origin}: it holds {_counted(raw)}: lines become corridors of {widths} "
            "width next to the polygons"
        )
    solid = _union([shape.solid, *(multipolygon(strip) for strip in strips)])
    return Repaired(solid=solid, holes=_less(shape.holes, solid))


def _zone(raw: RawShapes, frame: LocalFrame, clearance_m: float) -> MultiPolygon:
    """Where not to be: polygons, lines and points with the clearance around them."""
    local = frame.localised(raw)
    marks: list[BaseGeometry] = [LineString(line.points) for line in local.lines]
    marks += [Point(*point) for point in local.points.tolist()]
    if marks and clearance_m == 0.0:
        raise PlanError(
            f"area: {raw.origin}: it holds {_counted(raw)}: set no_go_clearance_m, how far to keep "
            "from lines and points"
        )
    shape = repaired(local, frame, geographic=raw.geographic, overlaps=False)
    around = [multipolygon(mark.buffer(clearance_m)) for mark in marks]
    return _union([widened(shape.solid, clearance_m), *around])


def _union(shapes: Sequence[MultiPolygon]) -> MultiPolygon:
    """All of several shapes; a single one stays as it is, corner by corner."""
    filled = [shape for shape in shapes if not shape.is_empty]
    if len(filled) <= 1:
        return filled[0] if filled else MultiPolygon()
    return multipolygon(shapely.union_all(filled, grid_size=GRID_M))


def _less(shape: MultiPolygon, taken: MultiPolygon) -> MultiPolygon:
    """A shape without another; it stays as it is, corner by corner, where they do not meet."""
    if taken.is_empty or not shape.intersects(taken):
        return shape
    # On a micrometre's grid: edges that coincide but for the last bit make GEOS's later overlays of
    # the two wrong by whole faces.
    return without_slivers(multipolygon(shapely.difference(shape, taken, grid_size=GRID_M)))


def _counted(raw: RawShapes) -> str:
    counts = {"polygon": len(raw.polygons), "line": len(raw.lines), "point": len(raw.points)}
    parts = [f"{n} {what}{'s' if n > 1 else ''}" for what, n in counts.items() if n]
    return " and ".join(parts) or "nothing"


def _check_parts(area: Area, *, margin_m: float = 0.0, given: str = "") -> None:
    """Warn of parts of the allowed area that are out of reach of each other.

    Args:
        area: to check.
        margin_m: by which the allowed area is wider than the survey area.
        given: what says where the vehicle may be, where it is not that margin.
    """
    parts = [part for part in area.allowed.geoms if part.intersects(area.survey)]
    if len(parts) > 1:
        gap_m = _widest_gap_m(parts)
        advice = (
            f"join them in {given} for one dive"
            if given
            else f"turn_margin_m = {_joining_m(margin_m, gap_m):g} joins them where no zone to "
            "keep out of lies between, or set an allowed shape"
        )
        warn(
            f"area: the vehicle may be in {len(parts)} parts up to {gap_m:.3g} m apart and cannot "
            f"pass between them: each has dives of its own; {advice}"
        )


def _joining_m(margin_m: float, gap_m: float) -> float:
    """The margin at which parts that are a gap apart meet, up to the next decimetre."""
    return math.ceil(10.0 * (margin_m + gap_m / 2) - 1e-6) / 10.0


def _check_inside(area: Area, raw: RawShapes, frame: LocalFrame, given: str) -> None:
    """Warn of parts of the survey area outside of the allowed one.

    Raises:
        PlanError: the two areas have nothing in common.
    """
    outside = _less(area.survey, area.allowed)
    share = outside.area / area.survey.area
    if share > 1.0 - _SMALL_SHARE:
        raise PlanError(
            f"area: {given}: the vehicle may be nowhere in the area to survey, "
            f"{area.survey.distance(area.allowed):.4g} m from it: check both"
        )
    if share > _SMALL_SHARE:
        largest = max(outside.geoms, key=lambda part: part.area).representative_point()
        place = frame.place((largest.x, largest.y), geographic=raw.geographic)
        warn(
            f"area: {share:.2%} of the area to survey lie outside of {given}, most of it near "
            f"{place}: only what is seen from inside is covered there"
        )


def _widest_gap_m(parts: Sequence[BaseGeometry]) -> float:
    """The widest of the gaps to bridge to make all parts one.

    That is the longest edge of their minimum spanning tree (Prim's algorithm).
    """
    nearest = np.full(len(parts), math.inf)
    nearest[0] = 0.0
    waiting = list(range(len(parts)))
    widest = 0.0
    while waiting:
        i = min(waiting, key=lambda k: nearest[k])
        waiting.remove(i)
        widest = max(widest, float(nearest[i]))
        for k in waiting:
            nearest[k] = min(nearest[k], parts[i].distance(parts[k]))
    return widest


def corridor_strip(points: Array, width_m: float, origin: str, name: str) -> BaseGeometry:
    """The strip along a line.

    Raises:
        PlanError: the line has no length.
    """
    apart = distinct(points, closed=False)
    if len(apart) < 2:
        raise PlanError(f"area: {origin}: {name}: {len(apart)} distinct points; it needs 2 or more")
    return buffered_line(apart, width_m)


def _survey_shapes(settings: AreaConfig) -> RawShapes:
    """The shape to survey, as it was given; a rectangle at the datum unless there is another.

    Raises:
        PlanError: a file or text cannot be read.
    """
    if settings.file is not None:
        return read_area_file(settings.file, settings.layer, settings.crs)
    if settings.wkt is not None:
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


def _with_closed_lines(raw: RawShapes, settings: AreaConfig) -> RawShapes:
    """Shapes whose closed lines are polygons where that is set; warns where nothing is."""
    ours = [line for line in raw.lines if line.width_m is None and line.is_closed]
    drawn = settings.file is not None or settings.wkt is not None
    if not (ours and drawn) or settings.closed_lines == "corridor":
        return raw
    if settings.closed_lines == "inside":
        lines = tuple(line for line in raw.lines if not any(line is one for one in ours))
        return replace(
            raw, lines=lines, polygons=(*raw.polygons, *((line.points,) for line in ours))
        )
    what = "a line that closes is" if len(ours) == 1 else f"{len(ours)} lines that close are"
    warn(
        f"area: {raw.origin}: {what} surveyed as a corridor of {settings.corridor_width_m:g} m "
        "along the line, not what lies inside: set area.closed_lines = 'inside' for that, or "
        "'corridor' if it is meant"
    )
    return raw


def _no_go_shapes(settings: AreaConfig) -> list[RawShapes]:
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
        zones.append(
            read_area_file(settings.no_go_file, settings.no_go_layer, settings.crs, role="no_go")
        )
    return zones


def _allowed_shapes(settings: AreaConfig) -> RawShapes | None:
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
