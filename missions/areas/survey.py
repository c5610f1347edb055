"""From settings, shapes and files, to the area to survey and where the vehicle may be."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from shapely.geometry import LineString, MultiPolygon, Point, Polygon
from shapely.geometry.base import BaseGeometry

from alice_survey.core.config import AreaConfig
from alice_survey.core.errors import PlanError, warn
from alice_survey.core.frames import Array, Datum
from alice_survey.kit.words import count
from missions.areas.crs import LocalFrame, middle
from missions.areas.files import Role, read_area_file, read_wkt
from missions.areas.raw import RawShapes, closed_as_polygons, from_rings, is_closed, no_points
from missions.values.area import Area, multipolygon

SAME_PLACE_M = 1e-3
"""Corners nearer than this are one; a spike is not wider."""
SLIVER_M = 0.01
"""A part that is narrower everywhere is left out."""
_SLIGHT_M2 = 0.01
"""A loop of crossing edges up to this size is a slip of the hand; a larger one is a wrong order of
corners. Parts and holes below it are left out."""
_NO_SIZE_M2 = 1e-4
GRID_M = 1e-6
"""Grid of corners where polygons are joined or cut: it closes the seams that rounding leaves."""
_SHARP = 1e3
"""Mitre limit with which a shape that is widened and narrowed keeps its corners."""
MITRE_LIMIT = 2.0
"""How far a corner of a widened shape may stand off, in widths: those sharper than 60 degrees are
cut off (1 / sin 30 degrees = 2)."""
_SMALL_SHARE = 1e-6
_POLAR_DEG = 66.6
"""Few dive so far north or south: coordinates may be swapped."""
_LOCAL_SETTINGS = ("no_go_ne_m", "allowed_ne_m")


@dataclass(frozen=True, kw_only=True, eq=False)
class Repaired:
    """Valid polygons, metres north and east."""

    solid: MultiPolygon
    """The polygons minus their holes."""
    holes: MultiPolygon
    """The holes minus the other polygons; may be empty."""


@dataclass(frozen=True, kw_only=True)
class _Reporter:
    """Names a source and its places."""

    origin: str
    frame: LocalFrame
    geographic: bool

    def text(self, name: str, text: str, place: Array | BaseGeometry | None = None) -> str:
        """A line on a ring of the source, and where."""
        text = f"area: {self.origin}: {name + ': ' if name else ''}{text}"
        if place is None:
            return text
        if isinstance(place, BaseGeometry):
            point = place.representative_point()
            place = np.array([point.x, point.y])
        return f"{text} near {self.frame.place(place, geographic=self.geographic)}"


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
        no_go=_zone_shapes(settings, "no_go"),
        allowed=next(iter(_zone_shapes(settings, "allowed")), None),
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
    zones = [(raw.origin, widen(shape.holes, clearance_m))]
    zones += [(zone.origin, _zone(zone, frame, clearance_m)) for zone in given.no_go]
    no_go = _union([zone for _, zone in zones])
    requested = widen(shape.solid, margin_m)
    survey = _less(requested, no_go)
    if survey.is_empty:
        names = " and ".join(name for name, zone in zones if not zone.is_empty)
        raise PlanError(
            f"area: the zones to keep out of ({names}) leave nothing of the {requested.area:.4g} "
            "m2 to survey: shrink them or lower no_go_clearance_m"
        )
    if allowed_raw is None:
        margin = settings.turn_margin_m if settings.turn_margin_m is not None else turn_margin_m
        allowed = _less(widen(requested, margin), no_go)
    else:
        if settings.turn_margin_m is not None:
            warn(f"area: turn_margin_m is not used: {allowed_raw.origin} says where to be")
        reach = _polygons(allowed_raw, frame, settings.corridor_width_m)
        allowed = _less(reach.solid, no_go)
    area = Area(datum=frame.datum, survey=survey, allowed=allowed, no_go=no_go)
    if allowed_raw is not None:
        _check_inside(area, raw, frame, allowed_raw.origin)
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
            f"area: {raw.origin}: it holds {_contents(raw)}; an area needs a polygon or a line"
        )
    local = frame.localise(raw)
    shape = repair(local, frame, geographic=raw.geographic)
    if len(raw.points):
        warn(f"area: {raw.origin}: {_contents(replace(raw, polygons=(), lines=()))} left out")
    if not raw.lines:
        return shape
    strips = [
        corridor_strip(line, corridor_width_m, local.origin, local.line_name(i))
        for i, line in enumerate(local.lines)
    ]
    if raw.polygons:
        warn(
            f"area: {raw.origin}: it holds {_contents(raw)}: lines become corridors of "
            f"{corridor_width_m:g} m width next to the polygons"
        )
    solid = _union([shape.solid, *(multipolygon(strip) for strip in strips)])
    return Repaired(solid=solid, holes=_less(shape.holes, solid))


def _zone(raw: RawShapes, frame: LocalFrame, clearance_m: float) -> MultiPolygon:
    """Where not to be: polygons, lines and points with the clearance around them."""
    local = frame.localise(raw)
    marks: list[BaseGeometry] = [LineString(line) for line in local.lines]
    marks += [Point(*point) for point in local.points.tolist()]
    if marks and clearance_m == 0.0:
        raise PlanError(
            f"area: {raw.origin}: it holds {_contents(raw)}: set no_go_clearance_m, how far to "
            "keep from lines and points"
        )
    shape = repair(local, frame, geographic=raw.geographic, overlaps=False)
    around = [multipolygon(mark.buffer(clearance_m)) for mark in marks]
    return _union([widen(shape.solid, clearance_m), *around])


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


def _contents(raw: RawShapes) -> str:
    counts = {"polygon": len(raw.polygons), "line": len(raw.lines), "point": len(raw.points)}
    return " and ".join(count(n, what) for what, n in counts.items() if n) or "nothing"


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


def corridor_strip(points: Array, width_m: float, origin: str, name: str) -> BaseGeometry:
    """The strip along a line: flat ends, corners drawn out to no more than a width.

    A line whose last point is its first goes round without ends.

    Raises:
        PlanError: the line has no length.
    """
    apart = distinct(points, closed=False)
    if len(apart) < 2:
        raise PlanError(f"area: {origin}: {name}: {len(apart)} distinct points; it needs 2 or more")
    return LineString(apart).buffer(
        width_m / 2, cap_style="flat", join_style="mitre", mitre_limit=MITRE_LIMIT
    )


def _survey_shapes(settings: AreaConfig) -> RawShapes:
    """The shape to survey, as it was given; a rectangle at the datum unless there is another.

    Raises:
        PlanError: a file or text cannot be read.
    """
    if settings.file is not None:
        return read_area_file(settings.file, settings.layer, settings.crs)
    if settings.wkt is not None:
        return read_wkt("wkt", settings.wkt, settings.crs)
    if settings.corridor_ne_m is not None:
        line = np.asarray(settings.corridor_ne_m, dtype=np.float64)
        return RawShapes(
            origin="corridor_ne_m", geographic=False, lines=(line,), points=no_points()
        )
    if settings.polygon_ne_m is not None:
        return from_rings("polygon_ne_m", [settings.polygon_ne_m], geographic=False)
    if settings.polygon_latlon_deg is not None:
        return from_rings("polygon_latlon_deg", [settings.polygon_latlon_deg], geographic=True)
    return from_rings("rectangle", [_rectangle(settings)], geographic=False)


def _with_closed_lines(raw: RawShapes, settings: AreaConfig) -> RawShapes:
    """Shapes whose closed lines are polygons where that is set; warns where nothing is."""
    ours = [line for line in raw.lines if is_closed(line)]
    drawn = settings.file is not None or settings.wkt is not None
    if not (ours and drawn) or settings.closed_lines == "corridor":
        return raw
    if settings.closed_lines == "inside":
        return closed_as_polygons(raw)
    what = "a line that closes is" if len(ours) == 1 else f"{len(ours)} lines that close are"
    warn(
        f"area: {raw.origin}: {what} surveyed as a corridor of {settings.corridor_width_m:g} m "
        "along the line, not what lies inside: set area.closed_lines = 'inside' for that, or "
        "'corridor' if it is meant"
    )
    return raw


def _zone_shapes(settings: AreaConfig, role: Role) -> tuple[RawShapes, ...]:
    """The zones to keep out of, or where the vehicle may be, by source; none where none is set.

    Raises:
        PlanError: a file cannot be read.
    """
    key = f"{role}_ne_m"
    rings, file = getattr(settings, key), getattr(settings, f"{role}_file")
    if role == "allowed" and rings is not None:
        rings = [rings]
    zones = []
    if rings:
        zones.append(from_rings(key, rings, geographic=False))
    if file is not None:
        zones.append(read_area_file(file, None, settings.crs, role=role))
    return tuple(zones)


def _rectangle(settings: AreaConfig) -> Array:
    """Corners (4, 2): the length along the heading, the width to the right of it."""
    heading = math.radians(settings.heading_deg)
    along = settings.length_m * np.array([math.cos(heading), math.sin(heading)])
    right = settings.width_m * np.array([-math.sin(heading), math.cos(heading)])
    return np.array([0 * along, along, along + right, right])


def repair(
    raw: RawShapes, frame: LocalFrame, *, geographic: bool, overlaps: bool = True
) -> Repaired:
    """Make the polygons of a source valid where it is clear what is meant.

    Args:
        raw: shapes in metres north and east; its lines and points do not count.
        frame: to name places in.
        geographic: whether the shapes were given in degrees, to name places so.
        overlaps: whether to warn of polygons that overlap.

    Returns:
        Their union; corners keep their order where nothing had to be repaired or joined.

    Raises:
        PlanError: a polygon has fewer than 3 distinct corners, no size, or edges that cross; the
            message names the polygon and the place.
    """
    report = _Reporter(origin=raw.origin, frame=frame, geographic=geographic)
    solids: list[BaseGeometry] = []
    holes: list[BaseGeometry] = []
    for i, rings in enumerate(raw.polygons):
        solid: BaseGeometry = _ring_area(rings[0], raw.ring_name(i, 0), report)
        cuts = []
        for j, ring in enumerate(rings[1:], 1):
            name, corners = raw.ring_name(i, j), distinct(ring, closed=True)
            if len(corners) < 3 or Polygon(corners).convex_hull.area < _SLIGHT_M2:
                warn(report.text(name, "it is too small and left out", ring[0]))
                continue
            cuts.append(_ring_area(ring, name, report))
            outside = cuts[-1].difference(solid)
            if outside.area > _NO_SIZE_M2:
                text = f"{outside.area:.3g} m2 of it lie outside of its polygon: kept out of, too,"
                warn(report.text(name, text, outside))
        holes += cuts
        if cuts:
            solid = shapely.difference(solid, shapely.union_all(cuts), grid_size=GRID_M)
        if solid.area < _SLIGHT_M2 and len(raw.polygons) > 1:
            text = f"{solid.area:.2g} m2 are too small and left out"
            warn(report.text(raw.ring_name(i, 0), text, rings[0][0]))
        else:
            solids.append(solid)
    if raw.polygons and not any(solid.area > 0 for solid in solids):
        raise PlanError(report.text("", "its holes, or its size, leave nothing"))
    solid = _join(solids, report if overlaps else None)
    left: BaseGeometry = MultiPolygon()
    if holes:
        left = shapely.difference(shapely.union_all(holes), solid, grid_size=GRID_M)
    return Repaired(solid=solid, holes=without_slivers(multipolygon(left)))


def without_slivers(geometry: MultiPolygon) -> MultiPolygon:
    """Leave out parts narrower than `SLIVER_M` everywhere."""
    parts = geometry.geoms
    kept = [p for p in parts if not p.buffer(-SLIVER_M / 2, join_style="mitre").is_empty]
    return geometry if len(kept) == len(parts) else MultiPolygon(kept)


def distinct(corners: Array, *, closed: bool) -> Array:
    """Leave out points that repeat their predecessor (of a ring, the first one's is the last)."""
    kept: list[Array] = []
    for corner in corners:
        if not kept or np.linalg.norm(corner - kept[-1]) >= SAME_PLACE_M:
            kept.append(corner)
    if closed and len(kept) > 1 and np.linalg.norm(kept[-1] - kept[0]) < SAME_PLACE_M:
        kept.pop()
    return np.array(kept).reshape(-1, 2)


def _ring_area(ring: Array, name: str, report: _Reporter) -> Polygon | MultiPolygon:
    """What a ring encloses, made valid where it is clear what is meant.

    The signed area of a ring counts a loop run the other way round as less, and one run twice as
    twice; where it equals the area of the repaired polygon, the ring only touches itself or runs
    straight back over itself.

    Raises:
        PlanError: it encloses nothing, or its edges cross.
    """
    corners = distinct(ring, closed=True)
    if len(corners) < 3:
        text = f"{len(corners)} distinct corners; a polygon needs 3 or more"
        raise PlanError(report.text(name, text, ring[0] if len(ring) else None))
    polygon = Polygon(corners)
    if polygon.is_valid and polygon.area >= _NO_SIZE_M2:
        return polygon
    valid = multipolygon(shapely.make_valid(polygon, method="linework"))
    # Of the corners less the first: products of large coordinates round.
    north, east = (corners - corners[0]).T
    signed = 0.5 * float(np.sum(north * np.roll(east, -1) - np.roll(north, -1) * east))
    reason, _, place = shapely.is_valid_reason(polygon).partition("[")
    where = np.array([float(x) for x in place.rstrip("]").split()[:2]] or corners[0])
    if abs(abs(signed) - valid.area) > _SLIGHT_M2:
        text = f"{reason.lower()} (list the corners in order round the edge)"
        raise PlanError(report.text(name, text, where))
    parts = [part for part in valid.geoms if part.area > _SLIGHT_M2]
    if not parts:
        raise PlanError(report.text(name, "its corners enclose nothing", where))
    kept = multipolygon(
        MultiPolygon(
            [Polygon(p.exterior, [r for r in p.interiors if Polygon(r).area > 1e-6]) for p in parts]
        )
    )
    some = count(len(parts), "part")
    warn(report.text(name, f"taken as {some} of {kept.area:.4g} m2: its edge meets itself", where))
    return kept.geoms[0] if len(kept.geoms) == 1 else kept


def _join(solids: list[BaseGeometry], report: _Reporter | None) -> MultiPolygon:
    """The union of a source's polygons, gaps below `SLIVER_M` closed; overlaps are reported."""
    if len(solids) <= 1:
        return multipolygon(solids[0]) if solids else MultiPolygon()
    tree = shapely.STRtree(solids)
    near = tree.query(solids, predicate="dwithin", distance=SLIVER_M).T.tolist()
    if all(i == j for i, j in near):
        return multipolygon(MultiPolygon([p for s in solids for p in multipolygon(s).geoms]))
    common = shapely.union_all([solids[i].intersection(solids[j]) for i, j in near if i < j])
    if report is not None and common.area > _SLIGHT_M2:
        text = f"its polygons overlap by {common.area:.3g} m2 and are taken together"
        warn(report.text("", text, common))
    union = shapely.union_all(solids, grid_size=GRID_M)
    if all(solids[i].distance(solids[j]) <= GRID_M for i, j in near):
        return multipolygon(union)
    if report is not None:
        warn(report.text("", f"gaps narrower than {SLIVER_M:g} m between its polygons are closed"))
    wider = union.buffer(SLIVER_M / 2, join_style="mitre", mitre_limit=_SHARP)
    closed = wider.buffer(-SLIVER_M / 2, join_style="mitre", mitre_limit=_SHARP)
    return multipolygon(closed)


def widen(geometry: MultiPolygon, by_m: float) -> MultiPolygon:
    """All places within a distance, with sharp corners kept sharp up to `MITRE_LIMIT`."""
    if by_m == 0.0 or geometry.is_empty:
        return geometry
    return multipolygon(geometry.buffer(by_m, join_style="mitre", mitre_limit=MITRE_LIMIT))
