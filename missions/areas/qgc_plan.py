"""Areas in QGroundControl's `.plan` files: survey, corridor and structure items, and geofences.

Keys as in QGroundControl's developer guide, "Plan File Format": complex items hold `polygon`, or
`polyline` and `CorridorWidth`; a geofence holds `polygons` and `circles`, each with `inclusion`.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from alice_survey.core.errors import PlanError
from alice_survey.core.frames import Array
from missions.areas.crs import check_finite, check_latitudes
from missions.areas.raw import RawLine, RawShapes, no_points
from missions.areas.safe import read_json

LAYERS = ("mission", "inclusion", "exclusion")
_CIRCLE_CORNERS = 64
_MAX_M = 1e6


def read_qgc_plan(
    path: Path, layer: str | None, role: Literal["survey", "no_go", "allowed"]
) -> RawShapes:
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
        raise PlanError(f"area: {path}: no QGroundControl plan: its fileType is not 'Plan'")
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
