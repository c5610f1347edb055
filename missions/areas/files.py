"""Areas in files: GeoJSON, KML, KMZ, GeoPackage, shapefile, well-known text, QGroundControl's plan.

GDAL, through pyogrio, reads them; it is loaded only when a file is read. Heights are left out.
Keys of plans are those of QGroundControl's developer guide, "Plan File Format": complex items hold
`polygon`, or `polyline` and `CorridorWidth`; a geofence holds `polygons` and `circles`, each with
`inclusion`.
"""

import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import shapely
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, StrictBool, ValidationError
from shapely.geometry.base import BaseGeometry

from alice_survey.core.contents import as_line, first_fault, one_line
from alice_survey.core.errors import PlanError, warn
from alice_survey.core.frames import Array
from missions.areas.crs import (
    LOCAL,
    check_latitudes,
    geographic_shapes,
    parse_crs,
    usable_crs,
)
from missions.areas.raw import RawLine, RawShapes, from_geometries, from_rings
from missions.areas.safe import (
    DRIVERS,
    MAX_CORNERS,
    gis_files,
    read_bytes,
    read_geojson,
    read_json,
)

Role = Literal["survey", "no_go", "allowed"]
_DEEPEST = 20
_SRID = re.compile(r"\s*SRID\s*=\s*(\d+)\s*;", re.IGNORECASE)
SUFFIXES = (*DRIVERS, ".wkt", ".plan")


LAYERS = ("mission", "inclusion", "exclusion")
_CIRCLE_CORNERS = 64
_MAX_M = 1e6
_Place = Annotated[
    tuple[float, float], BeforeValidator(lambda x: x[:2] if isinstance(x, list) else x)
]
"""Latitude and longitude; a height is left out."""
_Places = tuple[_Place, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Layer:
    name: str
    shapes: RawShapes
    """Shapes in the file's own coordinates, y (north) before x (east)."""
    crs: str | None


def read_area_file(
    path: Path, layer: str | None, crs: str | None, *, role: Role = "survey"
) -> RawShapes:
    """Read the shapes of a file.

    Args:
        path: a file of one of the kinds in `SUFFIXES`, recognised by its suffix.
        layer: which of its layers, where several hold shapes.
        crs: coordinate system for a file that states none; `local` for metres east and north of
            the datum.
        role: what the shapes are for.

    Returns:
        Shapes in latitude and longitude (WGS 84), or north and east where the system is `local`.

    Raises:
        PlanError: it cannot be read, is of another kind, states no coordinate system while crs is
            None, holds several layers while layer is None, or coordinates that cannot be.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise PlanError(
            f"area: {path}: {suffix or 'no ending'!r} files are not read; those that are: "
            f"{', '.join(SUFFIXES)}"
        )
    if suffix == ".plan":
        return _read_qgc_plan(path, layer, role)
    if suffix == ".wkt":
        if layer is not None:
            raise PlanError(f"area: {path}: it has no layers: leave out layer")
        try:
            text = read_bytes(path).decode("utf-8-sig")
        except UnicodeDecodeError:
            raise PlanError(f"area: {path}: it is not text") from None
        return read_wkt(path.name, text, crs)
    chosen = _choose(path, _layers(path), layer, role)
    return _in_wgs84(path, chosen, crs, role)


def read_wkt(origin: str, text: str, crs: str | None) -> RawShapes:
    """Shapes of well-known text: x before y, as everybody writes it.

    Args:
        origin: what messages call it.
        text: a polygon, line, or several; `SRID=32636;` may come before it.
        crs: system of its coordinates; None or `local`: metres east and north of the datum.

    Raises:
        PlanError: it is not well-known text, or crs is unknown or contradicts the SRID.
    """
    match = _SRID.match(text)
    if match:
        text = text[match.end() :]
        stated = f"EPSG:{match.group(1)}"
        try:
            parse_crs(stated)
        except PlanError:
            raise PlanError(
                f"area: {origin}: SRID={match.group(1)[:20]} is not a known coordinate system"
            ) from None
        if crs is not None and parse_crs(stated) != parse_crs(crs):
            raise PlanError(f"area: {origin}: it says SRID={match.group(1)} and crs is {crs}")
        crs = stated
    if _depth(text) > _DEEPEST:
        raise PlanError(f"area: {origin}: not well-known text: it nests over {_DEEPEST} brackets")
    try:
        geometry = _geometry(shapely.from_wkt, text.strip(), origin)
    except shapely.errors.ShapelyError as error:
        what = as_line(str(error)) or "it cannot be read"
        raise PlanError(
            f"area: {origin}: not well-known text such as POLYGON ((0 0, 30 0, 30 20, 0 0)): {what}"
        ) from None
    shapes = from_geometries(origin, [geometry])
    _refuse_corners(shapes.origin, len(shapes.coordinates))
    if shapes.is_empty:
        raise PlanError(f"area: {origin}: it is empty")
    if crs is None or crs == LOCAL:
        return shapes
    return geographic_shapes(shapes, parse_crs(crs))


def _depth(text: str) -> int:
    """How many brackets are open at once; GEOS recurses for each, and ends the program."""
    deepest = depth = 0
    for bracket in re.findall(r"[()]", text):
        depth += 1 if bracket == "(" else -1
        deepest = max(deepest, depth)
    return deepest


def _geometry(read: Callable[..., Any], content: str | bytes, where: str) -> BaseGeometry:
    """A geometry that shapely reads, if need be by closing its rings.

    Raises:
        ShapelyError: it cannot be read.
    """
    geometry: BaseGeometry | None
    try:
        with np.errstate(invalid="ignore"):  # NaN is reported with its corner later
            geometry = read(content)
    except shapely.errors.ShapelyError:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            geometry = read(content, on_invalid="fix")
        if geometry is None:
            raise
        warn(f"area: {where}: a ring that is not closed is closed")
    return geometry


def _layers(path: Path) -> list[_Layer]:
    """All layers of a file that GDAL reads, after a look at what it is."""
    driver = DRIVERS[path.suffix.lower()]
    with gis_files(path) as files:
        layers = [layer for file in files for layer in _gdal_layers(file, path, driver)]
    if driver != "GeoJSON" or read_geojson(path).get("crs") is not None:
        return layers
    # RFC 7946 makes it WGS 84, yet older writers left out other systems: the numbers show which.
    return [
        _Layer(name=found.name, shapes=found.shapes, crs=found.crs if _degrees(found) else None)
        for found in layers
    ]


def _degrees(layer: _Layer) -> bool:
    if layer.shapes.is_empty:
        return True
    lat, lon = layer.shapes.coordinates.T
    return bool((np.abs(lat) <= 360.0).all() and (np.abs(lon) <= 360.0).all())


def _gdal_layers(file: Path, shown: Path, driver: str) -> list[_Layer]:
    """The layers with geometry of a file that lies at `file` and that the user knows as `shown`."""
    import pyogrio
    import pyogrio.raw
    from pyogrio.errors import DataLayerError, DataSourceError

    layers = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            names = pyogrio.list_layers(file)
            for i, (name, kind) in enumerate(names.tolist()):
                if kind is None:
                    continue
                info = pyogrio.read_info(file, layer=i)
                if info["driver"].removeprefix("LIB") != driver:
                    raise PlanError(f"area: {shown}: not {driver} but {info['driver']}")
                meta, _, wkb, _ = pyogrio.raw.read(file, layer=i, columns=[], force_2d=True)
                shapes = _shapes(wkb, shown.name, several=len(names) > 1, layer=str(name))
                layers.append(_Layer(name=str(name), shapes=shapes, crs=meta["crs"]))
        # pyogrio lets names that are not UTF-8 through, and trips over a damaged coordinate system.
        except (
            DataSourceError, DataLayerError, UnicodeDecodeError, UnboundLocalError, ValueError,
            MemoryError,
        ) as error:  # fmt: skip
            text = one_line(error).replace(str(file), shown.name)
            raise PlanError(f"area: {shown}: cannot be read: {text}") from None
    for text in dict.fromkeys(str(w.message).splitlines()[0] for w in caught):
        if not text.startswith("Non closed ring"):  # reported with its feature
            warn(f"area: {shown.name}: {text}")
    return layers


def _shapes(wkb: Sequence[bytes | None], file: str, *, several: bool, layer: str) -> RawShapes:
    origin = f"{file}, layer {layer}" if several else file
    geometries = []
    for i, blob in enumerate(wkb, 1):
        if blob is None:
            continue
        where = f"{origin}: feature {i}"
        try:
            geometries.append(_geometry(shapely.from_wkb, blob, where))
        except shapely.errors.ShapelyError as error:
            raise PlanError(f"area: {where}: {str(error).strip().splitlines()[0]}") from None
    shapes = from_geometries(origin, geometries)
    _refuse_corners(shapes.origin, len(shapes.coordinates))
    return shapes


def _refuse_corners(origin: str, count: int) -> None:
    if count > MAX_CORNERS:
        raise PlanError(
            f"area: {origin}: {count} corners; at most {MAX_CORNERS}: simplify it, or cut "
            "out the part to survey"
        )


def _choose(path: Path, layers: list[_Layer], layer: str | None, role: Role) -> _Layer:
    """The layer that is requested, or the only one with usable shapes.

    Raises:
        PlanError: there is none, or there are several to choose from.
    """
    if layer is not None:
        found = [one for one in layers if one.name == layer]
        if not found:
            names = ", ".join(repr(one.name) for one in layers) or "none"
            raise PlanError(f"area: {path}: no layer {layer!r}; there are {names}: set layer")
        if len(found) > 1:
            raise PlanError(f"area: {path}: {len(found)} layers are named {layer!r}: rename one")
        return found[0]
    usable = [
        one
        for one in layers
        if one.shapes.polygons or one.shapes.lines or (role == "no_go" and len(one.shapes.points))
    ]
    if not usable:
        points = sum(len(one.shapes.points) for one in layers)
        held = f"{points} point{'s' if points > 1 else ''} only" if points else "no shapes"
        raise PlanError(f"area: {path}: it holds {held}; an area needs a polygon or a line")
    if len(usable) > 1:
        names = ", ".join(repr(one.name) for one in usable)
        cure = "set layer to one of them" if role == "survey" else "save one as a file of its own"
        raise PlanError(f"area: {path}: shapes in the layers {names}: {cure}")
    return usable[0]


def _in_wgs84(path: Path, layer: _Layer, crs: str | None, role: Role) -> RawShapes:
    """The shapes of a layer in WGS 84, by the file's own system or, without one, by `crs`."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        own = None if layer.crs is None else CRS.from_user_input(layer.crs)
    except CRSError as error:
        raise PlanError(
            f"area: {path}: its coordinate system cannot be read: {one_line(error)}"
        ) from None
    if crs == LOCAL and (own is None or not _is_map(own)):
        return layer.shapes
    if own is None or (crs is not None and not _is_map(own)):
        if crs is None:
            raise PlanError(
                f"area: {path}: it does not say its coordinate system: set crs, such as "
                f"EPSG:32636, or {LOCAL!r} for metres east and north of the datum"
            )
        return geographic_shapes(layer.shapes, parse_crs(crs))
    if crs is not None and role == "survey" and (crs == LOCAL or parse_crs(crs) != own):
        warn(f"area: {path}: crs = {crs} is not used: the file is in {own.name}")
    return geographic_shapes(layer.shapes, usable_crs(own, path.name))


def _is_map(crs: Any) -> bool:
    flat = crs.to_2d()
    return bool(flat.is_geographic or flat.is_projected)


class _Json(BaseModel):
    """A part of a plan; what is not read of it is not looked at."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class _QgcItem(_Json):
    kind: str | None = Field(None, alias="complexItemType")
    polygon: _Places = ()
    polyline: _Places = ()
    width_m: float = Field(1.0, alias="CorridorWidth", gt=0, lt=_MAX_M)


class _Circle(_Json):
    centre: _Place = Field(alias="center")
    radius: float = Field(gt=0, lt=_MAX_M)


class _Zone(_Json):
    inclusion: StrictBool
    polygon: _Places = ()
    circle: _Circle | None = None


class _QgcMission(_Json):
    items: tuple[_QgcItem, ...] = ()


class _Fence(_Json):
    polygons: tuple[_Zone, ...] = ()
    circles: tuple[_Zone, ...] = ()


class _QgcPlan(_Json):
    file_type: Literal["Plan"] = Field(alias="fileType")
    mission: _QgcMission = _QgcMission()
    fence: _Fence = Field(_Fence(), alias="geoFence")

    def layer(self, name: str, origin: str) -> RawShapes:
        """The shapes of one of `LAYERS`."""
        if name == "mission":
            areas = [x.polygon for x in self.mission.items if x.kind in ("survey", "StructureScan")]
            rings = [np.array(polygon).reshape(-1, 2) for polygon in areas if polygon]
            lines = tuple(
                RawLine(points=np.array(x.polyline).reshape(-1, 2), width_m=x.width_m)
                for x in self.mission.items
                if x.kind == "CorridorScan" and x.polyline
            )
        else:
            inclusion, lines = name == "inclusion", ()
            zones = [zone for zone in self.fence.polygons if zone.inclusion == inclusion]
            rings = [np.array(zone.polygon).reshape(-1, 2) for zone in zones if zone.polygon]
            rings += [
                _corners_of_circle(zone.circle, outside=not inclusion)
                for zone in self.fence.circles
                if zone.inclusion == inclusion and zone.circle is not None
            ]
        shapes = replace(from_rings(origin, rings, geographic=True), lines=lines)
        for number, corners in enumerate([*rings, *(line.points for line in lines)], 1):
            check_latitudes(corners, origin, f"{name} {number}")
        return shapes


def _read_qgc_plan(path: Path, layer: str | None, role: Role) -> RawShapes:
    """The shapes of one layer of a plan.

    Args:
        path: the `.plan` file.
        layer: one of `LAYERS`; None takes what fits the role: the mission's items for the survey
            area (and the exclusion fences as zones to keep out of), the inclusion fences for the
            allowed area, the exclusion fences for zones.
        role: what the shapes are for.

    Raises:
        PlanError: it is not a plan, or holds nothing of that kind.
    """
    try:
        plan = _QgcPlan.model_validate(read_json(path))
    except ValidationError as error:
        fault = first_fault(error)
        raise PlanError(f"area: {path}: not as QGroundControl writes it: {fault}") from None
    chosen = layer or {"survey": "mission", "no_go": "exclusion", "allowed": "inclusion"}[role]
    if chosen not in LAYERS:
        raise PlanError(f"area: {path}: a plan has the layers {', '.join(LAYERS)}, not {layer!r}")
    layers = {name: plan.layer(name, path.name) for name in LAYERS}
    found, exclusion = layers[chosen], layers["exclusion"]
    if found.is_empty:
        others = " and ".join(name for name in LAYERS if not layers[name].is_empty)
        raise PlanError(
            f"area: {path}: no shapes in its layer {chosen!r}"
            + (f"; there are some in {others}" if others else "")
        )
    if role != "survey":
        return found
    fence = ""
    if chosen == "mission" and not layers["inclusion"].is_empty:
        fence = "its inclusion fence is not used; to stay inside it set allowed_file to the file"
    zones = exclusion if chosen != "exclusion" and not exclusion.is_empty else None
    return replace(found, no_go=zones, unused_fence=fence)


def _corners_of_circle(circle: _Circle, *, outside: bool) -> Array:
    """Corners (64, 2) of a polygon inside of a circle, or around it where that is the safe side."""
    from pyproj import Geod

    reach_m = circle.radius / np.cos(np.pi / _CIRCLE_CORNERS) if outside else circle.radius
    azimuths = np.arange(_CIRCLE_CORNERS) * 360.0 / _CIRCLE_CORNERS
    lat, lon = (np.full(_CIRCLE_CORNERS, value) for value in circle.centre)
    lon, lat, _ = Geod(ellps="WGS84").fwd(lon, lat, azimuths, np.full(_CIRCLE_CORNERS, reach_m))
    return np.column_stack([lat, lon])
