"""Shapes of an area as somebody draws them: from settings, and back into settings and files.

One polygon, one corridor, zones and an allowed area of plain polygons stand in the settings
themselves, in metres; what these cannot hold (holes, several parts, many corners) goes into GeoJSON
files next to them. Shapes that were not changed leave their settings and files as they are.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import ConfigDict, Field

from alice_survey.core.config import AreaConfig, Config
from alice_survey.core.errors import PlanError
from alice_survey.core.frames import Array, Datum
from missions.areas.crs import MAX_M, LocalFrame, middle
from missions.areas.files import Role, read_area_file
from missions.areas.raw import RawShapes
from missions.areas.survey import GivenShapes, corridor_strip, given_shapes

FILES = {
    "survey": "drawn-area.geojson", "no_go": "drawn-no-go.geojson",
    "allowed": "drawn-allowed.geojson",
}  # fmt: skip
"""Names of the files that hold drawn shapes."""
_KEYS = {
    "survey": ("polygon_ne_m", "polygon_latlon_deg", "corridor_ne_m", "wkt", "layer", "file"),
    "no_go": ("no_go_ne_m", "no_go_file"),
    "allowed": ("allowed_ne_m", "allowed_file"),
}  # fmt: skip
"""Settings of each role: the first holds plain polygons, the last names a file."""
_NEED_CRS = ("file", "wkt", "no_go_file", "allowed_file")
_MAX_INLINE = 100
"""Corners of the shapes that one setting holds; a file holds more."""
_DECIMALS, _DEGREE_DECIMALS = 4, 11
"""A tenth of a millimetre; about a micrometre."""
_SAME_M = 6e-4
"""Corners this near are the same: what is drawn may be rounded to a millimetre."""
_MAX_CORNERS = 200_000

Metres = Annotated[float, Field(ge=-1e6, le=1e6)]
Place = tuple[Metres, Metres]
Open = tuple[Place, ...]


class DrawnPolygon(Config):
    """A polygon as a page sends it, north and east of the datum, metres; its rings are open."""

    outer: Open = Field(min_length=3, max_length=_MAX_CORNERS)
    holes: tuple[Open, ...] = ()

    @property
    def rings(self) -> tuple[Open, ...]:
        """Outer ring and holes."""
        return (self.outer, *self.holes)


class DrawnShapes(Config):
    """All shapes of an area, as a page sends them."""

    model_config = ConfigDict(extra="ignore")

    survey: tuple[DrawnPolygon, ...] = ()
    no_go: tuple[DrawnPolygon, ...] = ()
    allowed: tuple[DrawnPolygon, ...] = ()
    """Where the vehicle may be; empty: the survey area and room to turn."""
    corridors: tuple[Open, ...] = ()
    """Lines along which a strip is surveyed."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AreaDrawing:
    """The shapes of an area's settings, ready to be drawn."""

    shapes: DrawnShapes
    datum: Datum
    """To which they count."""
    marks: tuple[Sequence[Array], Array] = ((), np.empty((0, 2)))
    """Lines, (N, 2) each, and points, (N, 2), to keep away from; a file's, which cannot be drawn.
    """


def area_drawing(settings: AreaConfig) -> AreaDrawing:
    """The shapes of an area's settings.

    Args:
        settings: of the area. Lines in an allowed area are the polygons that they cover.

    Raises:
        PlanError: a file or text cannot be read.
    """
    return _drawing(given_shapes(settings), settings)


def area_settings(
    shapes: DrawnShapes, settings: AreaConfig, datum: Datum | None = None
) -> tuple[dict[str, Any], dict[str, str]]:
    """Settings and files for drawn shapes.

    Args:
        shapes: wanted, in the frame of `area_drawing(settings)`.
        settings: of the area so far.
        datum: to which the shapes count from now on; None: as so far.

    Returns:
        The settings that change, None of those to take out; and the contents of files to write, by
        their names next to the settings. Both are empty where the shapes are the settings' own.

    Raises:
        PlanError: nothing is left to survey, or a corner is not where it can be.
    """
    if not (shapes.survey or shapes.corridors):
        raise PlanError("area: nothing is drawn to survey: draw a polygon or a corridor")
    try:
        given = given_shapes(settings)
        now, frame = _drawing(given, settings), given.frame
    except PlanError:  # whatever was there before cannot be read: all is drawn again
        own = Datum(settings.latitude_deg, settings.longitude_deg)
        now = AreaDrawing(shapes=DrawnShapes(), datum=own)
        frame = LocalFrame(
            datum=own, seafloor_depth_m=settings.seafloor_depth_m, datum_is_given=True
        )
    if datum is not None:
        frame = replace(frame, datum=datum, datum_is_given=True)
    values: dict[str, Any] = {}
    files: dict[str, str] = {}
    lines = {"survey": shapes.corridors, "no_go": now.marks[0], "allowed": ()}
    for role, keys in _KEYS.items():
        polygons = getattr(shapes, role)
        same = _same(polygons, getattr(now.shapes, role))
        if role == "survey":
            same = same and _same_lines(shapes.corridors, now.shapes.corridors)
        if not same:
            points = now.marks[1] if role == "no_go" else ()
            values |= {key: None for key in keys if key in settings.model_fields_set}
            values |= _store(role, polygons, lines[role], points, frame, files)
    if not values:
        return {}, {}
    if len(settings.datum_given) < 2 and (not frame.datum_is_given or "file" in values):
        values["latitude_deg"] = frame.datum.latitude_deg
        values["longitude_deg"] = frame.datum.longitude_deg
    if settings.crs is not None and not _needs_crs(settings, values):
        values["crs"] = None
    return values, files


def drawing_of_file(
    path: Path, settings: AreaConfig, *, role: Role = "survey", datum: Datum | None
) -> AreaDrawing:
    """The shapes of a file, to be drawn.

    Args:
        path: of a kind that areas are read from.
        settings: of the area so far.
        role: what the shapes are for.
        datum: that they count to; None: the middle of the file, or the datum so far where the file
            is in metres.

    Raises:
        PlanError: the file cannot be read, or lies too far from the datum.
    """
    raw = read_area_file(path, None, None, role=role)
    if datum is None:
        datum = middle(raw) if raw.geographic else area_drawing(settings).datum
    frame = LocalFrame(datum=datum, seafloor_depth_m=settings.seafloor_depth_m, datum_is_given=True)
    given = GivenShapes(
        survey=raw if role == "survey" else replace(raw, polygons=(), lines=()),
        no_go=(raw,) if role == "no_go" else (),
        allowed=raw if role == "allowed" else None,
        frame=frame,
    )
    return _drawing(given, settings)


def _drawing(given: GivenShapes, settings: AreaConfig) -> AreaDrawing:
    frame, width_m = given.frame, settings.corridor_width_m
    survey = frame.localise(given.survey)
    zones = [frame.localise(zone) for zone in given.no_go]
    room: list[DrawnPolygon] = []
    if given.allowed is not None:
        allowed = frame.localise(given.allowed)
        ways = [corridor_strip(x, width_m, allowed.origin, "line") for x in allowed.lines]
        room = [*_polygons(allowed), *_polygons_of_strips(ways)]
    points = [zone.points for zone in zones if len(zone.points)]
    return AreaDrawing(
        shapes=DrawnShapes(
            survey=tuple(_polygons(survey)),
            no_go=tuple(polygon for zone in zones for polygon in _polygons(zone)),
            allowed=tuple(room),
            corridors=tuple(_round(line) for line in survey.lines),
        ),
        datum=frame.datum,
        marks=(
            [line for zone in zones for line in zone.lines],
            np.concatenate([np.empty((0, 2)), *points]),
        ),
    )


def _polygons(raw: RawShapes) -> Iterator[DrawnPolygon]:
    """The polygons of a source in local metres; rings of fewer than three corners hold nothing."""
    for rings in raw.polygons:
        outer, *holes = (_open(ring) for ring in rings)
        if len(outer) >= 3:
            yield DrawnPolygon(outer=outer, holes=tuple(hole for hole in holes if len(hole) >= 3))


def _polygons_of_strips(strips: Iterable[Any]) -> Iterator[DrawnPolygon]:
    for strip in strips:
        for part in getattr(strip, "geoms", [strip]):
            outer, *holes = (_open(np.asarray(r.coords)) for r in (part.exterior, *part.interiors))
            yield DrawnPolygon(outer=outer, holes=tuple(holes))


def _open(ring: Array) -> Open:
    closed = len(ring) > 1 and np.allclose(ring[0], ring[-1], atol=1e-9, rtol=0.0)
    return _round(ring[:-1] if closed else ring)


def _round(points: Array) -> Open:
    rows = (np.round(np.asarray(points)[:, :2], _DECIMALS) + 0.0).tolist()
    return tuple((north, east) for north, east in rows)


def _same(one: Sequence[DrawnPolygon], other: Sequence[DrawnPolygon]) -> bool:
    return len(one) == len(other) and all(
        _same_lines(a.rings, b.rings) for a, b in zip(one, other, strict=True)
    )


def _same_lines(one: Sequence[Open], other: Sequence[Open]) -> bool:
    return len(one) == len(other) and all(
        len(a) == len(b) and bool(np.all(np.abs(np.subtract(a, b)) <= _SAME_M))
        for a, b in zip(one, other, strict=True)
    )


def _store(
    role: str,
    polygons: Sequence[DrawnPolygon],
    lines: Sequence[Any],
    points: Sequence[Array] | Array,
    frame: LocalFrame,
    files: dict[str, str],
) -> dict[str, Any]:
    """Settings that hold the shapes of a role, or name a file that does, which is added."""
    key, file_key = _KEYS[role][0], _KEYS[role][-1]
    rings = [_as_lists(polygon.outer) for polygon in polygons]
    corners = sum(map(len, (*rings, *lines)))
    if corners <= _MAX_INLINE and not (any(p.holes for p in polygons) or len(points)):
        if not lines and (role == "no_go" or len(rings) < 2):
            return {key: rings if role == "no_go" else rings[0]} if rings else {}
        if role == "survey" and not rings and len(lines) == 1:
            return {"corridor_ne_m": _as_lists(lines[0])}
    files[FILES[role]] = _geojson(frame, polygons, [np.array(line) for line in lines], points)
    more = {"closed_lines": "corridor"} if role == "survey" and lines else {}
    return {file_key: FILES[role], **more}


def _needs_crs(settings: AreaConfig, values: Mapping[str, Any]) -> bool:
    """Whether a text or file is left, besides those that are drawn, that may not say its system."""
    kept = (values.get(name, getattr(settings, name)) for name in _NEED_CRS)
    return any(value is not None and value not in FILES.values() for value in kept)


def _as_lists(places: Open) -> list[list[float]]:
    return [list(place) for place in _round(np.array(places))]


def _geojson(
    frame: LocalFrame,
    polygons: Sequence[DrawnPolygon],
    lines: Sequence[Array] = (),
    points: Sequence[Array] | Array = (),
) -> str:
    """Shapes as GeoJSON (RFC 7946), a feature a line, in the order and direction of their corners.

    Raises:
        PlanError: a corner is too far from the datum.
    """

    def degrees(places: Any) -> list[list[float]]:
        array = np.asarray(places, dtype=np.float64).reshape(-1, 2)
        far = np.flatnonzero(~(np.hypot(*array.T) <= MAX_M))
        if len(far):
            raise PlanError(
                f"area: a corner at north {array[far[0], 0]:g}, east {array[far[0], 1]:g} m is "
                f"more than {MAX_M / 1e3:.0f} km from the datum: draw nearer to it, or move "
                "the datum"
            )
        lat_lon = frame.latlon_from_ne(array)
        rows: list[list[float]] = np.round(lat_lon[:, ::-1], _DEGREE_DECIMALS).tolist()
        return rows

    def close(ring: Open) -> list[list[float]]:
        corners = degrees(ring)
        return [*corners, corners[0]]

    geometries = [
        *({"type": "Polygon", "coordinates": [close(r) for r in p.rings]} for p in polygons),
        *({"type": "LineString", "coordinates": degrees(line)} for line in lines),
        *({"type": "Point", "coordinates": degrees(point)[0]} for point in points),
    ]
    features = [
        json.dumps({"type": "Feature", "properties": {}, "geometry": geometry})
        for geometry in geometries
    ]
    return '{"type": "FeatureCollection", "features": [\n' + ",\n".join(features) + "\n]}\n"
