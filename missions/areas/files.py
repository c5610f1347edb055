"""Areas in files: GeoJSON, KML, KMZ, GeoPackage, shapefile, well-known text, QGroundControl's plan.

GDAL, through pyogrio, reads them; it is loaded only when a file is read. Heights are left out.
Keys of plans are those of QGroundControl's developer guide, "Plan File Format": complex items hold
`polygon`, or `polyline` and `CorridorWidth`; a geofence holds `polygons` and `circles`, each with
`inclusion`.
"""

import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from alice_survey.core.contents import as_line, one_line
from alice_survey.core.errors import PlanError, warn
from alice_survey.core.frames import Array
from missions.areas.crs import (
    LOCAL,
    check_finite,
    check_latitudes,
    geographic_shapes,
    parse_crs,
    usable_crs,
)
from missions.areas.raw import RawLine, RawShapes, from_geometries, no_points
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
    return _placed(path, chosen, crs, role)


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


def _placed(path: Path, layer: _Layer, crs: str | None, role: Role) -> RawShapes:
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
    data = read_json(path)
    if not (isinstance(data, dict) and data.get("fileType") == "Plan"):
        raise PlanError(f"area: {path}: not a QGroundControl plan: its fileType is not 'Plan'")
    usual = {"survey": "mission", "no_go": "exclusion", "allowed": "inclusion"}[role]
    chosen = layer or usual
    if chosen not in LAYERS:
        raise PlanError(f"area: {path}: a plan has the layers {', '.join(LAYERS)}, not {layer!r}")
    origin = path.name
    layers = {
        "mission": _mission(data, origin),
        "inclusion": _fence(data, origin, inclusion=True),
        "exclusion": _fence(data, origin, inclusion=False),
    }
    found = layers[chosen]
    if found.is_empty:
        others = [name for name in LAYERS if not layers[name].is_empty]
        raise PlanError(
            f"area: {path}: no shapes in its layer {chosen!r}"
            + (f"; there are some in {' and '.join(others)}" if others else "")
        )
    if role != "survey":
        return found
    fence = ""
    if chosen == "mission" and not layers["inclusion"].is_empty:
        fence = "its inclusion fence is not used; to stay inside it set allowed_file to the file"
    exclusion = layers["exclusion"]
    zones = exclusion if chosen != "exclusion" and not exclusion.is_empty else None
    return replace(found, no_go=zones, unused_fence=fence)


def _mission(data: dict[str, Any], origin: str) -> RawShapes:
    polygons = []
    lines = []
    for i, item in enumerate(_list(data, origin, "mission", "items"), 1):
        if not isinstance(item, dict):
            raise _broken(origin, f"mission item {i}")
        kind = item.get("complexItemType")
        name = f"item {i} ({kind})"
        if kind in ("survey", "StructureScan"):
            polygons.append((_corners(item.get("polygon"), origin, name),))
        elif kind == "CorridorScan":
            width_m = _number(item.get("CorridorWidth"), origin, f"{name}, CorridorWidth")
            points = _corners(item.get("polyline"), origin, name)
            lines.append(RawLine(points=points, width_m=width_m))
    return RawShapes(
        origin=origin,
        geographic=True,
        polygons=tuple(polygons),
        lines=tuple(lines),
        points=no_points(),
    )


def _fence(data: dict[str, Any], origin: str, *, inclusion: bool) -> RawShapes:
    polygons = []
    for name, fence in _fences(data, origin, "polygons", inclusion=inclusion):
        polygons.append((_corners(fence.get("polygon"), origin, name),))
    for name, fence in _fences(data, origin, "circles", inclusion=inclusion):
        circle = fence.get("circle")
        if not isinstance(circle, dict):
            raise _broken(origin, name)
        centre = _corners([circle.get("center")], origin, name)
        radius_m = _number(circle.get("radius"), origin, f"{name}, radius")
        polygons.append((_circle(centre[0], radius_m, outside=not inclusion),))
    return RawShapes(origin=origin, geographic=True, polygons=tuple(polygons), points=no_points())


def _fences(
    data: dict[str, Any], origin: str, key: str, *, inclusion: bool
) -> Iterator[tuple[str, dict[str, Any]]]:
    if "geoFence" not in data:
        return
    for i, fence in enumerate(_list(data, origin, "geoFence", key), 1):
        if not isinstance(fence, dict) or not isinstance(fence.get("inclusion"), bool):
            raise _broken(origin, f"geoFence.{key} {i}")
        if fence["inclusion"] == inclusion:
            yield f"geoFence.{key} {i}", fence


def _circle(centre_deg: Array, radius_m: float, *, outside: bool) -> Array:
    """Corners (64, 2) of a polygon inside of a circle, or around it where that is the safe side."""
    from pyproj import Geod

    reach_m = radius_m / np.cos(np.pi / _CIRCLE_CORNERS) if outside else radius_m
    azimuths = np.arange(_CIRCLE_CORNERS) * 360.0 / _CIRCLE_CORNERS
    lat, lon = (np.full(_CIRCLE_CORNERS, value) for value in centre_deg)
    lon, lat, _ = Geod(ellps="WGS84").fwd(lon, lat, azimuths, np.full(_CIRCLE_CORNERS, reach_m))
    return np.column_stack([lat, lon])


def _list(data: dict[str, Any], origin: str, section: str, key: str) -> list[Any]:
    part = data.get(section)
    found = part.get(key, []) if isinstance(part, dict) else None
    if not isinstance(found, list):
        raise _broken(origin, f"{section}.{key}")
    return found


def _corners(value: Any, origin: str, name: str) -> Array:
    """(N, 2) latitudes and longitudes."""
    try:
        corners = np.array([[float(lat), float(lon)] for lat, lon, *_ in value])
    except (TypeError, ValueError, OverflowError):
        raise _broken(origin, name) from None
    corners = corners.reshape(-1, 2)
    check_finite(corners, origin, name)
    check_latitudes(corners, origin, name)
    return corners


def _number(value: Any, origin: str, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < _MAX_M:
        raise PlanError(f"area: {origin}: {name} is {value!r:.60}; it must be above 0")
    return float(value)


def _broken(origin: str, name: str) -> PlanError:
    return PlanError(f"area: {origin}: {name} is not as QGroundControl writes it")
