"""The interactive map of a plan: its layers, and the numbers that its script starts from.

Stations and footprints are not listed: the script derives them from the lines. Detail below a
five-thousandth of the map's width is left out.
"""

import base64
import io
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from shapely.geometry import LineString, MultiPolygon

from alice_survey.core.config import SeaConfig
from alice_survey.core.frames import Array
from alice_survey.kit.document import PictureLayer, Scale, ShapeLayer, SurveyMap
from camera_calib.rig import Rig
from missions.areas.bathymetry import Bathymetry
from missions.coverage.certificate import Certificate
from missions.exports.geometry import footprint_outline, rings_ne, route_ne
from missions.values.plan_file import Plan

KINDS = ("survey", "cross", "closing", "fill", "tie")
COLOURS = {
    "survey": "#1b4f72", "cross": "#6c3483", "closing": "#117a65", "fill": "#b9770e",
    "tie": "#c0392b",
    "area": "#c8553d", "allowed": "#566573", "no_go": "#b03a2e", "way": "#7f8c8d",
    "footprint": "#2e86c1", "contour": "#5d6d7e", "current": "#2471a3", "missed": "#d35400",
    "home": "#1e8449",
}  # fmt: skip
"""Colours of all maps of a plan."""
_RAMP = (
    "#f7fcf0", "#ddf1d9", "#bfe6c4", "#93d3c0", "#60bbc8", "#3597c1", "#1474b0", "#084c8d",
)  # fmt: skip
_DETAIL = 1 / 5000
_FINEST_M = 0.005
_MAX_CELLS = 420
"""Most cells on a side of the picture of counts."""
_MAX_COUNT = 254
"""Highest number of pictures in the picture of counts, where 255 is outside of the area."""
_CONTOURS = 10
_CONTOUR_POINTS = 160
"""Points on each side of the grid that contours are drawn from."""
_MIN_RELIEF_M = 0.01
_OPAQUE, _MISSED_OPACITY = 215, 190
"""Opacities out of 255."""

Layer = PictureLayer | ShapeLayer
Extent = tuple[float, float, float, float]
"""North and east of the south-west corner, then of the north-east corner."""


def plan_map(
    plan: Plan,
    rig: Rig,
    certificate: Certificate,
    bathymetry: Bathymetry | None,
    sea: SeaConfig,
    more: Sequence[Layer] = (),
) -> SurveyMap:
    """The layers of a plan's map.

    Args:
        plan: the plan.
        rig: its cameras; footprints are of the first.
        certificate: how many pictures see each place.
        bathymetry: for contours, or None.
        sea: for the current.
        more: layers over the counts.
    """
    outline = footprint_outline(plan, rig)
    extent = map_extent(plan, outline)
    detail_m = max(_FINEST_M, max(extent[2] - extent[0], extent[3] - extent[1]) * _DETAIL)
    layers = [*_coverage_layers(certificate), *more, *_area_layers(plan, detail_m)]
    if bathymetry is not None:
        layers += contour_layer(bathymetry, extent, detail_m)
    camera = f"Footprints ({rig.reference} camera)"
    layers.append(_derived("footprints", camera, "polygon", "footprint", shown=False))
    layers += _dive_layers(plan, detail_m)
    layers.append(_derived("stations", "Stations", "point", "survey", shown=True))
    layers.append(
        ShapeLayer(
            name="home", title="Home", about="Launch and recovery.", kind="point", group="Lines",
            colour=COLOURS["home"], shapes=[_places(np.array(home)) for home in plan.homes_ne_m],
            texts=[_north_east(home) for home in plan.homes_ne_m],
        )
    )  # fmt: skip
    if sea.current_mps > 0 and sea.current_file is None:
        layers.append(_current_layer(sea, extent))
    return SurveyMap(
        layers=layers,
        unit="m",
        origin="North is up; the datum is at 0, 0.",
        geodetic=geodetic_fit(plan, extent),
    )


def station_data(plan: Plan, rig: Rig, certificate: Certificate) -> dict[str, Any]:
    """What the map's script starts from, as JSON values.

    `lines` holds, by layer and in the order of its shapes, the number of the line, of its first
    station, and of its stations.
    """
    outline = footprint_outline(plan, rig)
    first = np.cumsum([0, *(line.stations for line in plan.lines)]).tolist()
    return {
        "lines": {
            name: [[index, first[index], plan.lines[index].stations] for index in indices]
            for name, _, _, indices in _lines_by_layer(plan)
        },
        "outline": np.round(outline, 4).tolist(),
        "across": plan.footprint_m[0],
        "spacing": plan.line_spacing_m,
        "counts": counts_data(certificate),
    }


def _derived(name: str, title: str, kind: Any, colour: str, shown: bool) -> ShapeLayer:
    """A layer that the map's script fills."""
    return ShapeLayer(
        name=name, title=title, about="Drawn where the screen has room for each.", kind=kind,
        shapes=[], colour=COLOURS[colour], shown=shown, group="Pictures",
    )  # fmt: skip


def _lines_by_layer(plan: Plan) -> Iterator[tuple[str, int, str, list[int]]]:
    """Name of a layer, number of its dive, kind of its lines, and their indices in the plan."""
    for number, dive in enumerate(plan.dives, start=1):
        own = range(dive.first_line, dive.last_line + 1)
        for kind in KINDS:
            indices = [index for index in own if plan.lines[index].kind == kind]
            if indices:
                yield f"dive-{number}-{kind}", number, kind, indices


def _dive_layers(plan: Plan, detail_m: float) -> Iterator[ShapeLayer]:
    several = len(plan.dives) > 1
    lines = list(_lines_by_layer(plan))
    for number, dive in enumerate(plan.dives, start=1):
        group = f"Dive {number}" if several else "Lines"
        way = route_ne(dive.route, detail_m)
        yield ShapeLayer(
            name=f"dive-{number}-way", title="Way between lines", about="", kind="line",
            group=group, colour=COLOURS["way"], width=1.1,
            shapes=[_places(_simplified(way, detail_m))],
            texts=[
                f"Dive {number}: lines {dive.first_line} to {dive.last_line}, "
                f"{dive.route.length_m:.0f} m, {dive.duration_s / 60:.0f} min, "
                f"{dive.energy_wh:.0f} Wh"
            ],
        )  # fmt: skip
        for name, of, kind, indices in lines:
            if of != number:
                continue
            ends = [plan.lines[i] for i in indices]
            yield ShapeLayer(
                name=name, about="", kind="line", group=group, colour=COLOURS[kind], width=1.7,
                title=f"{len(ends)} {kind} line{'s' if len(ends) > 1 else ''}",
                shapes=[_places(np.array([line.start_ne_m, line.end_ne_m])) for line in ends],
                texts=[
                    f"Line {i}, dive {number}: {line.length_m:.2f} m, heading "
                    f"{math.degrees(line.heading_rad):.1f}°, {line.stations} stations"
                    for i, line in zip(indices, ends, strict=True)
                ],
            )  # fmt: skip


def _area_layers(plan: Plan, detail_m: float) -> Iterator[ShapeLayer]:
    area = plan.area
    for name, title, shape, dashed, fill, width in (
        ("allowed", "The vehicle may be within", area.allowed, True, 0.0, 1.2),
        ("no_go", "No-go zones", area.no_go, False, 0.2, 1.2),
        ("area", "Survey area", area.survey, True, 0.0, 2.2),
    ):
        shapes = [_places(ring) for ring in _rings(shape, detail_m)]
        if shapes:
            yield ShapeLayer(
                name=name, title=title, about="", kind="polygon", shapes=shapes, group="Areas",
                colour=COLOURS[name], dashed=dashed, fill=fill, width=width,
            )  # fmt: skip


def _current_layer(sea: SeaConfig, extent: Extent) -> ShapeLayer:
    """An arrow in the south-east corner that points where the current flows."""
    south, west, north, east = extent
    size = max(north - south, east - west)
    towards = math.radians(sea.current_towards_deg)
    ahead = 0.035 * size * np.array([math.cos(towards), math.sin(towards)])
    right = 0.4 * np.array([-ahead[1], ahead[0]])
    middle = np.array([south - 0.05 * size, east - 0.05 * size])
    tip, neck = middle + ahead, middle + 0.4 * ahead
    arrow = np.array([middle - ahead, tip, neck + right, tip, neck - right])
    text = f"{sea.current_mps:g} m/s towards {sea.current_towards_deg:g}°"
    return ShapeLayer(
        name="current", title=f"Current, {text}", about="", kind="line", shapes=[_places(arrow)],
        texts=[text], colour=COLOURS["current"], group="Sea",
    )  # fmt: skip


def map_extent(plan: Plan, outline: Array) -> Extent:
    """Least and greatest north and east of all that is drawn."""
    ends = np.array([end for line in plan.lines for end in (line.start_ne_m, line.end_ne_m)])
    reach = float(np.linalg.norm(outline, axis=1).max())
    points = np.vstack([plan.area.allowed_corners_ne[:, :2], plan.area.corners_ne[:, :2]])
    low = np.round(np.minimum(points.min(axis=0), ends.min(axis=0) - reach), 3)
    high = np.round(np.maximum(points.max(axis=0), ends.max(axis=0) + reach), 3)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def geodetic_fit(plan: Plan, extent: Extent) -> tuple[list[float], list[float]]:
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
    # Fitted in units of the map's size, so that no term is lost in another.
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
    return factors[:, 0].tolist(), factors[:, 1].tolist()


def _places(points_ne: Array) -> list[tuple[float, float]]:
    """East and north of places (..., 2), to a millimetre."""
    pairs = np.round(points_ne.reshape(-1, 2)[:, ::-1], 3)
    return [(east, north) for east, north in pairs.tolist()]


def _north_east(place_ne: tuple[float, float]) -> str:
    return f"{place_ne[0]:.2f} m N, {place_ne[1]:.2f} m E"


def _rings(geometry: MultiPolygon, detail_m: float) -> Iterator[Array]:
    for polygon in geometry.geoms:
        for ring in rings_ne(polygon):
            yield _simplified(np.vstack([ring, ring[:1]]), detail_m)


def _simplified(points_ne: Array, detail_m: float) -> Array:
    """A line without what cannot be seen."""
    return np.asarray(LineString(points_ne).simplify(detail_m).coords)


def contour_layer(bathymetry: Bathymetry, extent: Extent, detail_m: float) -> Iterator[ShapeLayer]:
    """Lines of equal depth over the map, at round depths."""
    from contourpy import contour_generator  # here, as few maps need it

    north_0, east_0, north_1, east_1 = extent
    norths = np.linspace(north_0, north_1, _CONTOUR_POINTS)
    easts = np.linspace(east_0, east_1, _CONTOUR_POINTS)
    grid = np.stack(np.meshgrid(norths, easts, indexing="ij"), axis=-1)
    depth = bathymetry.depth_at(grid)
    known = np.extract(np.isfinite(depth), depth)
    if not len(known) or np.ptp(known) < _MIN_RELIEF_M:
        return
    step = _round_up(float(np.ptp(known)) / _CONTOURS)
    generator = contour_generator(
        x=norths, y=easts, z=np.ma.masked_invalid(depth.T), line_type="Separate"
    )
    shapes, texts = [], []
    for number in range(math.ceil(known.min() / step), math.floor(known.max() / step) + 1):
        level = round(number * step, 9)
        for path in generator.lines(level):
            points: Any = path
            if len(points) > 1:
                shapes.append(_places(_simplified(points, detail_m)))
                texts.append(f"{level:g} m")
    if shapes:
        yield ShapeLayer(
            name="contours", title="Depth", about="", kind="line", shapes=shapes, texts=texts,
            colour=COLOURS["contour"], width=0.9, group="Sea",
        )  # fmt: skip


def _round_up(step: float) -> float:
    """1, 2 or 5 times a power of ten, not below a step."""
    power = 10.0 ** math.floor(math.log10(step))
    return float(next(k * power for k in (1, 2, 5, 10) if k * power >= step * (1 - 1e-9)))


def _coverage_layers(seen: Certificate) -> list[Layer]:
    """How many pictures see each place, and where that is below the requested overlap."""
    rgb, corner, pixel_m = counts_picture(seen)
    pictures, met = rgb[..., 0], rgb[..., 2] > 0
    within = pictures < 255
    maximum = max(1, min(int(np.percentile(seen.pictures[seen.inside], 99.0)), _MAX_COUNT))
    steps = np.minimum((pictures / maximum * (len(_RAMP) - 1)).astype(int), len(_RAMP) - 1)
    palette = np.array([[*_channels(colour), _OPAQUE] for colour in _RAMP], dtype=np.uint8)
    counts = palette[steps] * within[..., None].astype(np.uint8)
    missed = np.zeros_like(counts)
    missed[within & ~met] = [*_channels(COLOURS["missed"]), _MISSED_OPACITY]
    scale = Scale(label="pictures that see a place", low=0, high=maximum, colours=_RAMP)

    return [
        picture_layer(
            counts, corner, pixel_m, name="counts", title="Pictures that see a place",
            about="Of all cameras.", scale=scale, shown=True,
        ),
        picture_layer(
            missed, corner, pixel_m, name="missed", title="Below the requested overlap", about="",
            shown=True,
        ),
    ]  # fmt: skip


def picture_layer(
    rgba: NDArray[np.uint8], corner_ne: tuple[float, float], pixel_m: float, **more: Any
) -> PictureLayer:
    """A layer of one picture.

    Args:
        rgba: (H, W, 4) with north up.
        corner_ne: upper left.
        pixel_m: side of a pixel.
        more: fields of the layer.
    """
    rows, columns = rgba.shape[:2]
    return PictureLayer(
        west_m=corner_ne[1], north_m=corner_ne[0], pixel_m=pixel_m, width_px=columns,
        height_px=rows, tile_px=max(rows, columns), levels=1, tiles={"0/0/0": _png(rgba)},
        base=False, group="Pictures", **more,
    )  # fmt: skip


def _channels(colour: str) -> list[int]:
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]


def counts_picture(seen: Certificate) -> tuple[NDArray[np.uint8], tuple[float, float], float]:
    """Counts with north up: red pictures, green lines, blue 1 at the requested overlap.

    Cells become larger ones that show the worst of them.

    Returns:
        The (H, W, 3) picture, red 255 outside of the area; north and east of its upper left
        corner; and the side of a pixel, metres.
    """
    grid = seen.grid
    block = max(1, math.ceil(max(grid.rows, grid.columns) / _MAX_CELLS))
    inside = _blocks(seen.inside, block, fill=False)
    pictures = np.where(inside, _blocks(seen.pictures, block, fill=0), 65535).min(axis=(1, 3))
    lines = np.where(inside, _blocks(seen.least_lines, block, fill=0), 65535).min(axis=(1, 3))
    met = (_blocks(seen.at_overlap, block, fill=True) | ~inside).all(axis=(1, 3))
    within = inside.any(axis=(1, 3))
    cells = np.zeros((*within.shape, 3), dtype=np.uint8)
    cells[..., 0] = np.where(within, np.minimum(pictures, _MAX_COUNT), 255)
    cells[..., 1] = np.where(within, np.minimum(lines, _MAX_COUNT), 0)
    cells[..., 2] = np.where(within, met, 0)
    corners = grid.places_of(block * np.array([[0, 0], [0, 1], [1, 0], [1, 1]]) * within.shape)
    low, high = corners.min(axis=0), corners.max(axis=0)
    # Half the side of a cell that lies diagonally: no cell falls between pixels.
    aslant = abs(math.sin(2.0 * grid.heading_rad)) > 1e-9
    pixel_m = grid.cell_m * block / (2.0 if aslant else 1.0)
    rows, columns = np.maximum(np.ceil((high - low) / pixel_m - 1e-6).astype(int), 1)
    norths = high[0] - pixel_m * (np.arange(rows) + 0.5)
    easts = low[1] + pixel_m * (np.arange(columns) + 0.5)
    places = np.stack(np.meshgrid(norths, easts, indexing="ij"), axis=-1)
    row, column = np.moveaxis(np.floor(grid.cells_of(places) / block).astype(int), -1, 0)
    on = (row >= 0) & (column >= 0) & (row < within.shape[0]) & (column < within.shape[1])
    rgb = np.zeros((rows, columns, 3), dtype=np.uint8)
    rgb[..., 0] = 255
    rgb[on] = cells[row[on], column[on]]
    return rgb, (float(high[0]), float(low[1])), pixel_m


def counts_data(seen: Certificate, *, optimized: bool = True) -> dict[str, Any]:
    """The counts for the script, which reads those under the pointer.

    Args:
        seen: holds them.
        optimized: whether time is taken to make the picture smaller.
    """
    rgb, (north, west), pixel_m = counts_picture(seen)
    png = base64.b64encode(_png(rgb, optimized=optimized)).decode("ascii")
    return {"png": f"data:image/png;base64,{png}", "north": north, "west": west, "pixel": pixel_m}


def _blocks(cells: NDArray[Any], block: int, *, fill: int | bool) -> NDArray[Any]:
    """Cells in blocks, (rows, block, columns, block); beyond the last cell stands `fill`."""
    rows, columns = (-(-size // block) for size in cells.shape)
    padded = np.full((rows * block, columns * block), fill, dtype=cells.dtype)
    padded[: cells.shape[0], : cells.shape[1]] = cells
    return padded.reshape(rows, block, columns, block)


def _png(pixels: NDArray[np.uint8], *, optimized: bool = True) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG", optimize=optimized)
    return buffer.getvalue()
