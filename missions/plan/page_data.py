"""What the page's map is drawn from, small enough to travel in the page.

Places are whole millimetres north and east of the datum. Stations and footprints are not listed:
they follow from the lines. Detail below a five-thousandth of the map's width is left out.
"""

import base64
import io
import math
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, MultiPolygon

from alice_survey.base.config import SeaConfig
from alice_survey.base.frames import Array
from camera_calib.rig import Rig
from missions.areas.bathymetry import Bathymetry
from missions.coverage.certificate import Certificate
from missions.exports.geometry import footprint_outline, rings_ne, route_ne
from missions.values.plan_file import Plan

KINDS = ("survey", "cross", "closing", "fill")
_DETAIL = 1 / 5000
_FINEST_M = 0.005
_MOST_CELLS = 420
"""A side of the picture of counts."""
_MOST_COUNT = 254
"""Of pictures in the picture of counts, whose 255 is beyond the area."""
_CONTOURS = 10
_CONTOUR_POINTS = 160
"""On each side of the grid that contours are drawn from."""
_LEAST_RELIEF_M = 0.01


def page_data(
    plan: Plan,
    rig: Rig,
    certificate: Certificate | None,
    bathymetry: Bathymetry | None,
    sea: SeaConfig | None,
) -> dict[str, Any]:
    """The map's data as JSON values.

    Args:
        plan: the plan.
        rig: its cameras; footprints are of the first.
        certificate: how many pictures see each place, or None.
        bathymetry: of contours, or None.
        sea: of the current, or None.
    """
    outline = footprint_outline(plan, rig)
    north_0, east_0, north_1, east_1 = _extent(plan, outline)
    detail_m = max(_FINEST_M, max(north_1 - north_0, east_1 - east_0) * _DETAIL)
    dive_of = {
        line: number
        for number, dive in enumerate(plan.dives, start=1)
        for line in range(dive.first_line, dive.last_line + 1)
    }
    extent = (north_0, east_0, north_1, east_1)
    current = sea is not None and sea.current_mps > 0 and sea.current_file is None
    return {
        "extent": list(extent),
        "geo": _geodetic_fit(plan, extent),
        "areas": {
            name: _rings(getattr(plan.area, name), detail_m)
            for name in ("survey", "allowed", "no_go")
        },
        "home": _mm(np.array(plan.home_ne_m)),
        "kinds": list(KINDS),
        "lines": [
            [
                KINDS.index(line.kind),
                *_mm(np.array([line.start_ne_m, line.end_ne_m])),
                line.stations,
                dive_of.get(index, 0),
            ]
            for index, line in enumerate(plan.lines)
        ],
        "routes": [
            _path(LineString(route_ne(dive.route, detail_m)), detail_m) for dive in plan.dives
        ],
        "outline": _mm(outline),
        "across": plan.footprint_m[0],
        "spacing": plan.line_spacing_m,
        "camera": rig.reference,
        "contours": [] if bathymetry is None else _contours(bathymetry, extent, detail_m),
        "current": {"mps": sea.current_mps, "towards_deg": sea.current_towards_deg}
        if sea is not None and current
        else None,
        "coverage": None if certificate is None else _counts(certificate),
    }


def _extent(plan: Plan, outline: Array) -> tuple[float, float, float, float]:
    """Least and greatest north and east of all that is drawn."""
    ends = [end for line in plan.lines for end in (line.start_ne_m, line.end_ne_m)]
    reach = float(np.linalg.norm(outline, axis=1).max())
    points = np.vstack([plan.area.allowed_corners_ne[:, :2], plan.area.corners_ne[:, :2]])
    ends_ne = np.array(ends)
    low = np.minimum(points.min(axis=0), ends_ne.min(axis=0) - reach)
    high = np.maximum(points.max(axis=0), ends_ne.max(axis=0) + reach)
    return (
        round(float(low[0]), 3),
        round(float(low[1]), 3),
        round(float(high[0]), 3),
        round(float(high[1]), 3),
    )


def _geodetic_fit(plan: Plan, extent: tuple[float, float, float, float]) -> dict[str, list[float]]:
    """Latitude and longitude as polynomials of second order in north and east, degrees.

    Args:
        plan: whose datum and depth count.
        extent: of the map; the fit reaches as far again beyond it.

    Returns:
        For each the six factors of 1, n, e, n n, n e, e e. What is left of higher order is 0.2 mm
        within a kilometre of the datum at 60 degrees of latitude, 1.2 mm at 78.
    """
    north_0, east_0, north_1, east_1 = extent
    size = max(north_1 - north_0, east_1 - east_0, 1.0)
    norths = np.linspace(north_0 - size / 2, north_1 + size / 2, 9)
    easts = np.linspace(east_0 - size / 2, east_1 + size / 2, 9)
    n, e = (axis.ravel() for axis in np.meshgrid(norths, easts))
    depth_m = plan.seafloor_depth_m - plan.altitude_m
    rows = plan.datum.geodetic_from_ned(np.column_stack([n, e, np.full(len(n), depth_m)]))
    # Fitted in units of the map's size, so that no term drowns in another.
    scaled = np.column_stack(
        [np.ones(len(n)), n / size, e / size, (n / size) ** 2, n * e / size**2, (e / size) ** 2]
    )
    degree = np.array([1.0, size, size, size**2, size**2, size**2])
    start = np.array([plan.datum.latitude_deg, plan.datum.longitude_deg])
    # Across the antimeridian longitudes go on, beyond 180.
    turned = (rows[:, :2] - start + 180.0) % 360.0 - 180.0
    factors, *_ = np.linalg.lstsq(scaled, turned, rcond=None)
    factors = factors / degree[:, None]
    factors[0] += start
    return {"lat": factors[:, 0].tolist(), "lon": factors[:, 1].tolist()}


def _mm(points: Array) -> list[int]:
    """Places as whole millimetres in one row: north, east, north, east, ..."""
    return [int(value) for value in np.round(1000.0 * points).ravel()]


def _rings(geometry: MultiPolygon, detail_m: float) -> list[list[list[int]]]:
    return [
        [_path(shapely.LinearRing(ring), detail_m) for ring in rings_ne(polygon)]
        for polygon in geometry.geoms
    ]


def _path(line: LineString, detail_m: float) -> list[int]:
    """A line without what cannot be seen."""
    return _mm(shapely.get_coordinates(line.simplify(detail_m)))


def _contours(
    bathymetry: Bathymetry, extent: tuple[float, float, float, float], detail_m: float
) -> list[dict[str, Any]]:
    """Lines of equal depth over the map, at round depths."""
    from contourpy import contour_generator  # beneath matplotlib; here, as few maps need it

    north_0, east_0, north_1, east_1 = extent
    norths = np.linspace(north_0, north_1, _CONTOUR_POINTS)
    easts = np.linspace(east_0, east_1, _CONTOUR_POINTS)
    grid = np.stack(np.meshgrid(norths, easts, indexing="ij"), axis=-1)
    depth = bathymetry.depth_at(grid)
    known = np.extract(np.isfinite(depth), depth)
    if not len(known) or np.ptp(known) < _LEAST_RELIEF_M:
        return []
    step = _round_up(float(np.ptp(known)) / _CONTOURS)
    generator = contour_generator(
        x=norths, y=easts, z=np.ma.masked_invalid(depth.T), line_type="Separate"
    )
    result = []
    for number in range(math.ceil(known.min() / step), math.floor(known.max() / step) + 1):
        level = round(number * step, 9)
        paths = [_path(LineString(path), detail_m) for path in _separate(generator.lines(level))]
        if paths:
            result.append({"depth": level, "paths": paths})
    return result


def _separate(lines: Any) -> list[Array]:
    return [path for path in lines if len(path) > 1]


def _round_up(step: float) -> float:
    """1, 2 or 5 times a power of ten, not below a step."""
    power = 10.0 ** math.floor(math.log10(step))
    return float(next(k * power for k in (1, 2, 5, 10) if k * power >= step * (1 - 1e-9)))


def _counts(seen: Certificate) -> dict[str, Any]:
    """Counts as a picture: red pictures, green lines, blue 1 where as asked; red 255 beyond.

    Several cells become one that tells the worst of them.
    """
    grid = seen.grid
    block = max(1, math.ceil(max(grid.rows, grid.columns) / _MOST_CELLS))
    inside = _blocks(seen.inside, block, fill=False)
    pictures = np.where(inside, _blocks(seen.pictures, block, fill=0), 65535).min(axis=(1, 3))
    lines = np.where(inside, _blocks(seen.least_lines, block, fill=0), 65535).min(axis=(1, 3))
    asked = (_blocks(seen.at_overlap, block, fill=True) | ~inside).all(axis=(1, 3))
    within = inside.any(axis=(1, 3))
    rgb = np.zeros((*within.shape, 3), dtype=np.uint8)
    rgb[..., 0] = np.where(within, np.minimum(pictures, _MOST_COUNT), 255)
    rgb[..., 1] = np.where(within, np.minimum(lines, _MOST_COUNT), 0)
    rgb[..., 2] = np.where(within, asked, 0)
    most = int(np.percentile(seen.pictures[seen.inside], 99.0))
    return {
        "png": f"data:image/png;base64,{_png(rgb)}",
        "origin": list(grid.origin_ne),
        "heading": grid.heading_rad,
        "cell": grid.cell_m * block,
        "rows": int(within.shape[0]),
        "columns": int(within.shape[1]),
        "most": max(1, min(most, _MOST_COUNT)),
    }


def _blocks(cells: NDArray[Any], block: int, *, fill: int | bool) -> NDArray[Any]:
    """Cells in blocks, (rows, block, columns, block); beyond the last cell stands `fill`."""
    rows, columns = (-(-size // block) for size in cells.shape)
    padded = np.full((rows * block, columns * block), fill, dtype=cells.dtype)
    padded[: cells.shape[0], : cells.shape[1]] = cells
    return padded.reshape(rows, block, columns, block)


def _png(rgb: NDArray[np.uint8]) -> str:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(rgb).save(buffer, format="PNG", optimize=True)
    return base64.b64encode(buffer.getvalue()).decode("ascii")
