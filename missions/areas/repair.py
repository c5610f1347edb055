"""Check polygons ring by ring; repair small faults and report them, refuse the rest."""

from dataclasses import dataclass

import numpy as np
import shapely
from shapely.geometry import LineString, MultiPolygon, Point, Polygon
from shapely.geometry.base import BaseGeometry

from alice_survey.core.errors import PlanError, warn
from alice_survey.core.frames import Array
from missions.areas.crs import LocalFrame
from missions.areas.raw import RawShapes
from missions.values.area import multipolygon

SAME_PLACE_M = 1e-3
"""Corners nearer than this are one; a spike is not wider."""
SLIVER_M = 0.01
"""A part that is narrower everywhere is left out."""
_SLIGHT_M2 = 0.01
"""A loop of crossing edges up to this size is a slip of the hand; a larger one is a wrong order of
corners. Parts and holes below it are left out."""
_NO_SIZE_M2 = 1e-4
_NAMED = 3
GRID_M = 1e-6
"""Grid of corners where polygons are joined or cut: it closes the seams that rounding leaves."""
_SHARP = 1e3
"""Mitre limit with which a shape that is widened and narrowed keeps its corners."""
MITRE_LIMIT = 2.0
"""How far a corner of a widened shape may stand off, in widths: those sharper than 60 degrees are
cut off (1 / sin 30 degrees = 2)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Repaired:
    """Valid polygons, metres north and east."""

    solid: MultiPolygon
    """The polygons minus their holes."""
    holes: MultiPolygon
    """The holes minus the other polygons; may be empty."""


@dataclass(frozen=True, kw_only=True)
class _Reporter:
    """Names faults and their places."""

    origin: str
    frame: LocalFrame
    geographic: bool

    def at(self, point_ne: Array) -> str:
        return self.frame.place(point_ne, geographic=self.geographic)

    def line(self, name: str, text: str) -> str:
        return f"area: {self.origin}: {name + ': ' if name else ''}{text}"

    def refuse(self, name: str, text: str) -> PlanError:
        return PlanError(self.line(name, text))

    def warn(self, name: str, text: str) -> None:
        warn(self.line(name, text))


def repaired(
    raw: RawShapes, frame: LocalFrame, *, geographic: bool, overlaps: bool = True
) -> Repaired:
    """Check the polygons of a source.

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
    names: list[str] = []
    holes: list[BaseGeometry] = []
    for i, rings in enumerate(raw.polygons):
        name = raw.ring_name(i, 0)
        shell = _ring_area(rings[0], name, report)
        cuts = []
        for j, ring in enumerate(rings[1:], 1):
            hole = _hole(ring, shell, raw.ring_name(i, j), report)
            if hole is not None:
                cuts.append(hole)
        holes += cuts
        solid: BaseGeometry = shell
        if cuts:
            solid = shapely.difference(shell, shapely.union_all(cuts), grid_size=GRID_M)
        if solid.area < _SLIGHT_M2 and len(raw.polygons) > 1:
            report.warn(
                name,
                f"{solid.area:.2g} m2 at {report.at(_first(rings[0]))} is too small and left out",
            )
            continue
        solids.append(solid)
        names.append(name)
    if raw.polygons and not any(solid.area > 0 for solid in solids):
        raise report.refuse("", "its holes, or its size, leave nothing")
    solid = _joined(solids, names, report if overlaps else None)
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
    if len(corners) < 2:
        return corners
    steps = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    if steps.min() >= SAME_PLACE_M:
        back_m = float(np.linalg.norm(corners[-1] - corners[0]))
        return corners[:-1] if closed and back_m < SAME_PLACE_M else corners
    kept = [0]
    for i in range(1, len(corners)):
        if np.linalg.norm(corners[i] - corners[kept[-1]]) >= SAME_PLACE_M:
            kept.append(i)
    if closed and len(kept) > 1 and np.linalg.norm(corners[kept[-1]] - corners[0]) < SAME_PLACE_M:
        kept.pop()
    left: Array = corners[kept]
    return left


def _ring_area(ring: Array, name: str, report: _Reporter) -> Polygon | MultiPolygon:
    """What a ring encloses."""
    closed = len(ring) > 1 and np.linalg.norm(ring[0] - ring[-1]) < SAME_PLACE_M
    corners = distinct(ring, closed=True)
    if len(corners) < 3:
        raise report.refuse(name, f"{len(corners)} distinct corners; a polygon needs 3 or more")
    repeats = len(ring) - len(corners) - int(closed)
    if repeats > 0:
        report.warn(
            name,
            f"{repeats} corner{'s' if repeats > 1 else ''} repeating the one before left out, the "
            f"first at {report.at(_first_repeat(ring))}",
        )
    if MultiPolygon([Polygon(corners)]).convex_hull.area < _NO_SIZE_M2:
        raise report.refuse(
            name,
            f"{Polygon(corners).convex_hull.area:.2g} m2 is too small; its corners lie on one line "
            f"through {report.at(corners[0])}",
        )
    corners = _without_spikes(corners, name, report)
    if len(corners) < 3:
        raise report.refuse(name, f"its corners enclose nothing near {report.at(_first(ring))}")
    polygon = Polygon(corners)
    return polygon if polygon.is_valid else _uncrossed(polygon, name, report)


def _without_spikes(corners: Array, name: str, report: _Reporter) -> Array:
    """Leave out corners where the edge runs straight back over itself."""
    found = corners
    while len(found) >= 3:
        spikes = _spike_lengths_m(found)
        if not spikes.any():
            break
        tip = int(spikes.argmax())
        report.warn(
            name,
            f"a spike of {spikes[tip]:.3g} m without width at {report.at(found[tip])} is cut off",
        )
        found = distinct(np.delete(found, tip, axis=0), closed=True)
    return found


def _spike_lengths_m(corners: Array) -> Array:
    """(N,) lengths of the shorter edges at corners whose two edges lie on one another, else 0."""
    back = np.roll(corners, 1, axis=0) - corners
    on = np.roll(corners, -1, axis=0) - corners
    back_m, on_m = np.linalg.norm(back, axis=1), np.linalg.norm(on, axis=1)
    off_m = np.abs(back[:, 0] * on[:, 1] - back[:, 1] * on[:, 0]) / np.maximum(back_m, on_m)
    folded = ((back * on).sum(axis=1) > 0) & (off_m < SAME_PLACE_M)
    lengths: Array = np.where(folded, np.minimum(back_m, on_m), 0.0)
    return lengths


def _uncrossed(polygon: Polygon, name: str, report: _Reporter) -> Polygon | MultiPolygon:
    """A ring that meets itself: as it is meant where that is clear.

    The signed area of the ring counts a loop run the other way round as less, and one run twice as
    twice; where it equals the area of the repaired polygon, the ring only touches itself.
    """
    reason, _, text = shapely.is_valid_reason(polygon).partition("[")
    place = np.array([float(value) for value in text.rstrip("]").split()[:2]])
    repaired = multipolygon(shapely.make_valid(polygon, method="linework"))
    corners = shapely.get_coordinates(polygon)
    corners = corners - corners[0]
    north, east = corners[:-1].T
    signed = 0.5 * float(np.sum(north * corners[1:, 1] - corners[1:, 0] * east))
    wrong_m2 = abs(abs(signed) - repaired.area)
    where = report.at(place)
    if wrong_m2 > _SLIGHT_M2:
        what = "edges cross" if "intersection" in reason.lower() else reason.lower()
        raise report.refuse(name, f"{what} near {where}; list the corners in order round the edge")
    parts = [part for part in repaired.geoms if part.area > _SLIGHT_M2]
    if not parts:
        raise report.refuse(name, f"its edges enclose no size near {where}")
    kept = multipolygon(
        MultiPolygon(
            [Polygon(p.exterior, [r for r in p.interiors if Polygon(r).area > 1e-6]) for p in parts]
        )
    )
    if "ring self-intersection" in reason.lower():
        report.warn(
            name,
            f"the edge touches itself at {where}: taken as {len(parts)} part"
            f"{'s' if len(parts) > 1 else ''} with {sum(len(p.interiors) for p in parts)} holes",
        )
    else:
        report.warn(
            name,
            f"edges cross near {where}; the loop of {wrong_m2 / 2:.2g} m2 or less is left out",
        )
    return kept.geoms[0] if len(kept.geoms) == 1 else kept


def _hole(
    ring: Array, shell: Polygon | MultiPolygon, name: str, report: _Reporter
) -> Polygon | MultiPolygon | None:
    """A hole of a polygon; None where it has no size."""
    corners = distinct(ring, closed=True)
    if len(corners) < 3 or Polygon(corners).convex_hull.area < _SLIGHT_M2:
        size = Polygon(corners).convex_hull.area if len(corners) > 2 else 0.0
        report.warn(name, f"{size:.2g} m2 at {report.at(_first(ring))} is too small and left out")
        return None
    hole = _ring_area(ring, name, report)
    if shell.contains_properly(hole):
        return hole
    outside = hole.difference(shell)
    if not hole.intersects(shell) or hole.intersection(shell).area < 1e-6:
        report.warn(
            name,
            f"it lies outside of its polygon, near {report.at(_inside(hole))}: it stays a zone to "
            "keep out of",
        )
    elif outside.area > 1e-6:
        report.warn(
            name,
            f"{outside.area:.3g} m2 of it lie outside of its polygon, near "
            f"{report.at(_inside(outside))}: they are kept out of, too",
        )
    else:
        touch = hole.boundary.intersection(shell.boundary)
        report.warn(
            name, f"it touches the edge near {report.at(_inside(touch))}: it is cut from it"
        )
    return hole


def _joined(solids: list[BaseGeometry], names: list[str], report: _Reporter | None) -> MultiPolygon:
    """The union of a source's polygons; overlaps are reported."""
    if len(solids) <= 1:
        return multipolygon(solids[0]) if solids else MultiPolygon()
    tree = shapely.STRtree(solids)
    near = tree.query(solids, predicate="dwithin", distance=SLIVER_M).T.tolist()
    if all(i == j for i, j in near):
        return multipolygon(MultiPolygon([p for s in solids for p in multipolygon(s).geoms]))
    if report is not None:
        _warn_of_overlaps(solids, names, near, report)
    union = shapely.union_all(solids, grid_size=GRID_M)
    if all(solids[i].distance(solids[j]) <= GRID_M for i, j in near):
        return multipolygon(union)
    if report is not None:
        report.warn("", f"gaps narrower than {SLIVER_M:g} m between its polygons are closed")
    wider = union.buffer(SLIVER_M / 2, join_style="mitre", mitre_limit=_SHARP)
    closed = wider.buffer(-SLIVER_M / 2, join_style="mitre", mitre_limit=_SHARP)
    return multipolygon(closed)


def _warn_of_overlaps(
    solids: list[BaseGeometry], names: list[str], pairs: list[list[int]], report: _Reporter
) -> None:
    common = [(solids[i].intersection(solids[j]), names[i], names[j]) for i, j in pairs if i < j]
    overlaps = [overlap for overlap in common if overlap[0].area > _SLIGHT_M2]
    for shared, one, other in overlaps[:_NAMED]:
        report.warn(
            "",
            f"{one} and {other} overlap by {shared.area:.3g} m2 near {report.at(_inside(shared))}: "
            "taken together",
        )
    if len(overlaps) > _NAMED:
        report.warn("", f"{len(overlaps) - _NAMED} more overlaps of polygons: taken together")


def _inside(geometry: BaseGeometry) -> Array:
    point: Point = geometry.representative_point()
    return np.array([point.x, point.y])


def _first(ring: Array) -> Array:
    first: Array = ring[0]
    return first


def _first_repeat(ring: Array) -> Array:
    steps = np.linalg.norm(np.diff(ring, axis=0), axis=1)
    place: Array = ring[int((steps < SAME_PLACE_M).argmax())]
    return place


def buffered_line(points: Array, width_m: float) -> Polygon | MultiPolygon:
    """The strip along a line: flat ends, corners drawn out to no more than a width.

    A line whose last point is its first goes round without ends.
    """
    strip: Polygon | MultiPolygon = LineString(points).buffer(
        width_m / 2, cap_style="flat", join_style="mitre", mitre_limit=MITRE_LIMIT
    )
    return strip


def widened(geometry: MultiPolygon, by_m: float) -> MultiPolygon:
    """All places within a distance, with sharp corners kept sharp up to `MITRE_LIMIT`."""
    if by_m == 0.0 or geometry.is_empty:
        return geometry
    return multipolygon(geometry.buffer(by_m, join_style="mitre", mitre_limit=MITRE_LIMIT))
