"""Figures of lines, points and polygons on a surface, drawn by a person or read from a GIS file."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any, Literal

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.contents import one_line
from alice_survey.core.errors import ConfigError, ReconstructionError, WorkspaceError
from alice_survey.core.frames import Array
from alice_survey.core.products import MOSAIC
from alice_survey.core.run import progress
from missions.areas.files import DRIVERS, gdal_layers, gis_files
from reconstruct.measure.areas import (
    GridPart,
    PolygonOnGrid,
    SurfaceAreas,
    figures_of_all,
    mean_of_corners,
    noise_lift,
    not_more,
    plan_slopes,
    sigma_of_means,
    spread_to_cells,
    surface_within,
)
from reconstruct.measure.errors import FigureSlopes, PackedSlopes, sum_slopes
from reconstruct.measure.figures import (
    Measured,
    Measurement,
    as_csv,
    as_geojson,
    as_places,
    figure,
    of_points,
    plan_area,
    polyline,
    slopes_of,
)
from reconstruct.measure.surface import MeasuredSurface, Samples
from reconstruct.raster import crs_of, opened_raster

_MAX_SAMPLES = 20_000


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceProfile:
    """Heights along a line."""

    samples: Samples
    along: Array
    """(N,) distance from the start in plan."""
    corners: tuple[int, ...]
    """Samples that are the line's vertices."""


def profile(surface: MeasuredSurface, vertices: Sequence[Sequence[float]]) -> SurfaceProfile:
    """Heights along a line, a cell apart or less.

    Args:
        surface: to follow.
        vertices: two or more places, right (east) and up (north).

    Raises:
        ReconstructionError: it is too short or too long.
    """
    corners = as_places(vertices)
    if len(corners) < 2:
        raise ReconstructionError("a line needs two places that differ")
    sides = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    steps = np.ceil(sides / surface.grid.cell - 1e-9).astype(np.int64)
    if steps.sum() > _MAX_SAMPLES:
        raise ReconstructionError(
            f"a line over {steps.sum():,} cells: at most {_MAX_SAMPLES:,} are followed; "
            "measure it in parts"
        )
    parts = [
        start + (np.arange(count) / count)[:, None] * (end - start)
        for start, end, count in zip(corners[:-1], corners[1:], steps, strict=True)
    ]
    places = np.concatenate([*parts, corners[-1:]])
    along = np.concatenate([[0.0], np.cumsum(np.repeat(sides / steps, steps))])
    return SurfaceProfile(
        samples=surface.at(places), along=along, corners=(0, *np.cumsum(steps).tolist())
    )


def measure_line(
    surface: MeasuredSurface, vertices: Sequence[Sequence[float]]
) -> tuple[Measured, ...]:
    """Figures of a line through places of a surface.

    Args:
        surface: that it is on.
        vertices: two or more places, right (east) and up (north).

    Raises:
        ReconstructionError: a vertex has no height, or the line is too short or too long.
    """
    along = surface_length(surface, profile(surface, vertices))
    picks = surface.known_at(as_places(vertices))
    clicks = picks.click_variance(slopes_of(polyline, picks.points - picks.points.mean(axis=0)))
    along = replace(along, own=math.hypot(along.own, math.sqrt(clicks)))
    figures = _of_ends(surface, picks)
    return (*figures[:-3], along, *figures[-3:])


def measure_points(
    surface: MeasuredSurface, points: Sequence[Sequence[float]]
) -> tuple[tuple[Measured, ...], tuple[str, ...]]:
    """Figures of a line through points in space, such as of the mesh of a surface.

    Args:
        surface: whose errors the points share; a point has the own error of the surface there.
        points: two or more: right (east), up (north) and out (height).

    Returns:
        Figures, and what a reader must know of them.

    Raises:
        ReconstructionError: fewer than two points.
    """
    given = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    if len(given) < 2:
        raise ReconstructionError("a line needs two points")
    # the mesh is painted by other pictures than the mosaic, from about as far aside
    there = surface.at_picks(given[:, :2])
    apart = np.abs(there.height - given[:, 2]) > surface.grid.cell + 3.0 * there.sigma
    unlike = int((apart | ~np.isfinite(there.height)).sum())
    notes = () if not unlike else (
        f"{unlike} of {len(given)} points are not on the elevation model (a wall, an overhang, a "
        "filled gap): their own errors are not known, and not counted",
    )  # fmt: skip
    own = np.where(np.isfinite(there.own), there.own, 0.0)
    ends = replace(there, height=given[:, 2], own=own)
    return tuple(_of_ends(surface, ends)), notes


def _of_ends(surface: MeasuredSurface, ends: Samples) -> list[Measured]:
    figures = {
        "length": ("Length, from vertex to vertex", polyline, 1, None),
        "straight": ("Straight from start to end", lambda p: polyline(p[[0, -1]]), 1, None),
        "plan_length": ("Length in plan", _plan_length, 1, None),
        "height_difference": (
            "Height difference, end minus start", lambda p: float(p[-1, 2] - p[0, 2]), 1, None,
        ),
        "slope": ("Slope from start to end", _slope_deg, 0, "°"),
    }  # fmt: skip
    if len(ends.places) == 2:
        figures.pop("straight")
    return [of_points(surface, ends, name, *rest) for name, rest in figures.items()]


def surface_length(surface: MeasuredSurface, line: SurfaceProfile) -> Measured:
    """Length along the surface; NaN where a part of it is unknown.

    A step of length t in plan and a rise r is L = √(t² + r²) long. Noise of variance v in the rise
    makes it longer by v/2 d²L/dr² = v t² / (2 L³) in the mean, which is taken away.
    """
    samples = line.samples
    steps = np.diff(samples.points, axis=0)
    plan = np.linalg.norm(steps[:, :2], axis=1)
    lengths = np.linalg.norm(steps, axis=1)
    own, next_to = samples.own_covariances(0), samples.own_covariances(1)
    noise = np.maximum(own[:-1] + own[1:] - 2.0 * next_to, 0.0)
    noise *= not_more((steps[:, 2],), noise)
    added = noise * plan**2 / (2.0 * lengths**3)
    value = float((lengths - added).sum())
    slopes = np.zeros_like(samples.points)
    along = steps / lengths[:, None]
    slopes[:-1] -= along
    slopes[1:] += along
    name, title, nan = "surface_length", "Length along the surface", math.nan
    if not math.isfinite(value):
        return Measured(name=name, title=title, value=nan, own=nan, shared=nan, unit=surface.unit)
    gathered = FigureSlopes(surface.errors)
    gathered.add(samples.places, slopes, samples.own_variance(slopes))
    gathered.count_once(2.0 * float((added**2).sum()))
    return figure(surface, name, title, value, gathered.packed, 1)


def _plan_length(points: Array) -> float:
    return polyline(points[:, :2])


def _slope_deg(points: Array) -> float:
    """Steepness from the first to the last point; upwards is positive."""
    away = points[-1] - points[0]
    return math.degrees(math.atan2(away[2], math.hypot(away[0], away[1])))


_MAX_RIM_SAMPLES = 4000
_MIN_SHARE = 0.5
"""Share of a rim that must be there."""

Base = float | Literal["rim"]
"""Plane of a volume: level at a height, or fitted to the heights along the polygon's rim."""


def _upright(block: GridPart) -> Array:
    """(rows, columns, 3) 1, x and y of cells."""
    return np.stack([np.ones_like(block.x), block.x, block.y], axis=-1)


def _fit_sums(region: PolygonOnGrid) -> tuple[Array, Array]:
    """Normal equations (3, 3) and (3,) of the plane that fits, about the polygon's middle."""
    second, heights = np.zeros((3, 3)), np.zeros(3)
    for block in region.blocks():
        upright, weight = _upright(block), spread_to_cells(block.weight)
        used = weight > 0
        second += (weight[used, None] * upright[used]).T @ upright[used]
        heights += (weight[used] * block.height[used]) @ upright[used]
    return second, heights


def measure_polygon(
    surface: MeasuredSurface, vertices: Sequence[Sequence[float]], base: Base | None = "rim"
) -> tuple[tuple[Measured, ...], tuple[str, ...]]:
    """Figures of the surface within a polygon.

    Args:
        surface: that it is on.
        vertices: three or more places, right (east) and up (north).
        base: plane of the volume; None for no volume.

    Returns:
        Figures, and what a reader must know of them.

    Raises:
        ReconstructionError: it crosses itself, is too large, or no surface is known in it.
    """
    places = as_places(vertices)
    if len(places) < 3:
        raise ReconstructionError("a polygon needs three places that differ")
    polygon = shapely.Polygon(places)
    if not polygon.is_valid or not polygon.area > 0:
        raise ReconstructionError(
            "the polygon crosses itself or has no area: draw its corners in order"
        )
    areas, region = surface_within(surface, polygon), PolygonOnGrid(surface, polygon)
    notes = []
    if surface.click:
        notes.append("where corners were clicked is not counted in slope, height and volume")
    if areas.share < 0.999:
        notes.append(
            f"{areas.share:.1%} of the polygon is known: area of the surface, volume, slope and "
            "rugosity are of that part"
        )
    ring = _ring(surface, places)
    slope, aspect, mean, *volumes = _plane_figures(region, base)
    figures = [
        of_points(surface, ring, "plan_area", "Area in plan", plan_area, 2),
        *_of_surface(surface, [areas], [polygon]),
        slope,
        aspect,
        mean,
        of_points(surface, ring, "perimeter", "Perimeter in plan", _plan_length, 1),
        *volumes,
    ]
    if areas.noise > 0.1:
        notes.append(
            f"noise adds {areas.noise:.0%} to the area of the surface, which is taken away "
            "but for about as large a share of that: it is large for such small cells"
        )
    return tuple(figures), tuple(notes)


def _ring(surface: MeasuredSurface, places: Array) -> Samples:
    """Corners and the first again; own errors count where heights are known."""
    found = surface.at_picks(np.concatenate([places, places[:1]]))
    known = np.isfinite(found.height)
    height, own = np.where(known, found.height, 0.0), np.where(known[:, None], found.own, 0.0)
    return replace(found, height=height, own=own)


def _volume_plane(region: PolygonOnGrid, base: Base) -> tuple[Array, Samples | None, Array]:
    """The plane of a volume: at a height, or fitted to the rim.

    Returns:
        (3,) its height in the middle, and slopes; the rim that it is fitted to; and (3, N) how
        heights of that move it.
    """
    if base != "rim":
        return np.array([float(base), 0.0, 0.0]), None, np.zeros((3, 0))
    surface, ring = region.surface, region.polygon.exterior
    step = max(surface.grid.cell, ring.length / _MAX_RIM_SAMPLES)
    count = max(3, math.ceil(ring.length / step))
    places = shapely.get_coordinates(
        shapely.line_interpolate_point(ring, np.arange(count) / count, normalized=True)
    )
    known = np.isfinite(surface.at(places).height)
    if known.mean() < _MIN_SHARE or known.sum() < 3:
        raise ReconstructionError(
            f"only {known.mean():.0%} of the polygon's rim has a height, too little to fit the "
            "plane of the volume to it: give the plane's height, or draw the rim on the surface"
        )
    samples = surface.at(places[known])
    x, y = (samples.places - region.middle).T
    by_height = np.linalg.pinv(np.column_stack([np.ones(len(x)), x, y]))
    return by_height @ samples.height, samples, by_height


def _plane_figures(region: PolygonOnGrid, base: Base | None) -> list[Measured]:
    """Slope and aspect of the plane that fits, mean height, and volumes over a base."""
    surface, cell = region.surface, region.surface.grid.cell
    by_mean, *by_slopes = (FigureSlopes(surface.errors) for _ in range(3))
    titles = {"volume": "Volume above minus below the plane",
              "above": "Volume above the plane", "below": "Volume below the plane"}  # fmt: skip
    by_volume = {name: FigureSlopes(surface.errors) for name in titles}
    volume, by_plane, lift = dict.fromkeys(titles, 0.0), dict.fromkeys(titles, np.zeros(3)), 0.0
    if base is not None:
        plane, rim, by_rim = _volume_plane(region, base)
    second, heights = _fit_sums(region)
    inverse, (_, right, up) = np.linalg.inv(second), np.linalg.solve(second, heights)
    steep = float(np.hypot(right, up))
    # steepness in degrees and the way down, by the slopes to the right and up
    turn = np.array([[right, up], [-up, right]]) / max(steep, 1e-300)
    turn[0] /= 1.0 + steep**2
    turn[1] /= -max(steep, 1e-300)
    turn = np.rad2deg(turn)
    for block in region.blocks():
        upright, weight = _upright(block), spread_to_cells(block.all_weight)
        by_fit = weight[..., None] * upright @ inverse
        region.add(by_mean, block, _by_height(by_fit[..., 0]))
        for slopes, way in zip(by_slopes, turn, strict=True):
            region.add(slopes, block, _by_height(by_fit[..., 1:] @ way))
        if base is None:
            continue
        over = np.nan_to_num(mean_of_corners(block.height - upright @ plane))
        noise = noise_lift(over, np.nan_to_num(sigma_of_means(block.own)))
        lift += cell**2 * float((block.weight * noise).sum())
        middles = np.stack([mean_of_corners(upright[..., k]) for k in range(3)], axis=-1)
        parts = (np.ones_like(over), 1.0 * (over > 0), -1.0 * (over < 0))
        for name, part in zip(titles, parts, strict=True):
            volume[name] += cell**2 * float((block.weight * part * over).sum())
            moved = _by_height(cell**2 * spread_to_cells(block.all_weight * part))
            wider = plan_slopes(block.all_weight * part * over, cell)
            region.add(by_volume[name], block, moved + wider)
            share = (block.weight * part)[..., None] * middles
            by_plane[name] = by_plane[name] - cell**2 * share.sum(axis=(0, 1))
    down = math.degrees(math.atan2(-right, -up)) % 360.0
    found = [
        ("slope", "Slope of the plane that fits", math.degrees(math.atan(steep)), by_slopes[0], 0),
        ("aspect", "Aspect, the way down from north or up", down, by_slopes[1], 0),
        ("mean_height", "Mean height", float(heights[0] / second[0, 0]), by_mean, 1),
    ]
    for name, title in titles.items() if base is not None else ():
        if rim is not None:
            up = by_plane[name] @ by_rim
            motion = np.column_stack([np.zeros((len(up), 2)), up])
            by_volume[name].add(rim.places, motion, rim.own_variance(motion))
        found.append((name, title, volume[name], by_volume[name], 3))
    figures = [
        figure(surface, name, title, value, slopes.packed, power, None if power else "°")
        for name, title, value, slopes, power in found
    ]
    # noise near the plane lifts the parts above and below
    return figures[:4] + [replace(one, own=math.hypot(one.own, lift)) for one in figures[4:]]


def _by_height(slopes: Array) -> Array:
    """Derivatives by motions, of a figure that heights alone move."""
    found = np.zeros((*slopes.shape, 3))
    found[..., 2] = slopes
    return found


_LABELS = ("label", "class", "species", "name")
"""Attributes that are looked for, in this order and in any case, where none is named."""
_MAX_CORNERS = 200_000


@dataclass(frozen=True, kw_only=True, eq=False)
class LabelledPolygon:
    """A polygon of a file, or several that are one thing, in the plane of the rasters."""

    name: str
    label: str
    geometry: Any


_PolygonAreas = tuple[LabelledPolygon, PackedSlopes, SurfaceAreas | None]
"""A polygon, what moves its area in plan, and None where no surface is known in it."""


def _label(one: _PolygonAreas) -> str:
    return one[0].label


def measure_polygon_file(
    workspace: Path,
    file: Path,
    *,
    label: str | None = None,
    pick_sigma_px: float = 0.0,
    output: Path | None = None,
) -> tuple[str, dict[str, Any]]:
    """Measure the polygons of a GIS file, one by one and by label.

    Args:
        workspace: with a surface.
        file: GeoJSON, GeoPackage, shapefile or KML, in any coordinate system; without one in the
            coordinates of the workspace's rasters.
        label: attribute with the label of each polygon; one of `_LABELS` when None.
        pick_sigma_px: standard deviation of a corner, pixels of the mosaic.
        output: `.csv` or `.geojson` to write the polygons and their figures to.

    Returns:
        A table as text, and the figures as JSON values.

    Raises:
        ConfigError: the ending of output is another one.
        PlanError, WorkspaceError: the file cannot be read, or holds no polygon.
    """
    if output is not None and output.suffix.lower() not in (".csv", ".geojson"):
        raise ConfigError(f"{output}: results are written to a .csv or a .geojson")
    surface = MeasuredSurface.of(workspace)
    polygons = read_polygons(file, surface, label)
    surface = surface.picked_to(pick_sigma_px * _pixel(surface))
    notes, measured, faults = list(surface.errors.notes), [], []
    with progress.step("measure polygons", len(polygons)) as step:
        for polygon in polygons:
            areas = None
            try:
                areas = surface_within(surface, polygon.geometry)
                if areas.share < 0.999:
                    faults.append(
                        f"{polygon.name}: the surface is known in {areas.share:.1%} of it"
                    )
            except ReconstructionError as error:
                faults.append(f"{polygon.name}: {error}")
            by_plan = plan_slopes_of(surface, polygon.geometry)
            measured.append((polygon, by_plan, areas))
            step.advance()
    notes = [*faults, *notes]
    lines, each, labels = [], [], []
    for one in measured:
        figures = _figures(surface, [one])
        lines.append(_line(f"{one[0].name} ({one[0].label})", figures))
        each.append([figure.to_json() for figure in figures])
    known = _known_area(surface)
    for name, group in groupby(sorted(measured, key=_label), _label):
        same = list(group)
        figures = _figures(surface, same)
        covered = float(shapely.union_all([one.geometry for one, _, _ in same]).area) / known
        figures += (
            Measured(
                name="cover", title="Share of the known surface, in plan", value=covered,
                own=figures[0].own / known, shared=figures[0].shared / known, unit="",
            ),
        )  # fmt: skip
        lines.append(_line(f"all of {name!r}, {len(same)}", figures))
        values = [figure.to_json() for figure in figures]
        labels.append({"label": name, "count": len(same), "figures": values})
    if output is not None:
        _write(output, surface, polygons, each, notes)
    data = {
        "format": "alice-survey measure polygons",
        "version": 1,
        "file": str(file),
        "polygons": [
            {"name": polygon.name, "label": polygon.label, "figures": values}
            for polygon, values in zip(polygons, each, strict=True)
        ],
        "labels": labels,
        "notes": notes,
    }
    return "\n".join([*lines, *(f"note: {note}" for note in notes)]), data


def read_polygons(
    file: Path, surface: MeasuredSurface, label: str | None = None
) -> list[LabelledPolygon]:
    """The polygons of a file, in the plane of a surface's rasters.

    Raises:
        PlanError: the file is damaged, too large or of another kind.
        WorkspaceError: it holds no polygon, or has no such attribute.
    """
    kinds = [kind for kind in DRIVERS if kind != ".gpx"]  # it has no polygons
    if file.suffix.lower() not in kinds:
        raise WorkspaceError(f"{file}: polygons are read from {', '.join(kinds)}")
    with gis_files(file) as parts:
        found = [one for part in parts for one in _layers(part, file, surface, label)]
    if not found:
        raise WorkspaceError(f"{file}: it holds no polygon")
    corners = sum(int(shapely.get_num_coordinates(one.geometry)) for one in found)
    if corners > _MAX_CORNERS:
        raise WorkspaceError(f"{file}: {corners} corners; at most {_MAX_CORNERS}: simplify it")
    return found


def _layers(
    part: Path, shown: Path, surface: MeasuredSurface, label: str | None
) -> Iterator[LabelledPolygon]:
    """The polygons of all layers of a file that the user knows as `shown`."""
    from pyproj.exceptions import CRSError, ProjError

    for _, about, shapes, columns in gdal_layers(part, shown):
        fields = {field.lower(): n for n, field in enumerate(about["fields"].tolist())}
        if label is not None and label.lower() not in fields:
            known = ", ".join(fields) or "none"
            raise WorkspaceError(f"{shown}: no attribute {label!r}; there are {known}")
        names = _LABELS if label is None else (label.lower(),)
        column = next((columns[fields[name]] for name in names if name in fields), None)
        fixed = shapely.from_wkb(shapes, on_invalid="fix")
        read = shapely.make_valid(fixed, method="structure", keep_collapsed=False)
        for number, geometry in enumerate(read):
            parts = shapely.get_parts(shapely.get_parts(geometry))
            areal = [one for one in parts if one.geom_type == "Polygon" and one.area > 0]
            if not areal:
                continue
            text = shown.stem if column is None else column[number]
            try:
                placed = _place_polygon(shapely.union_all(areal), about["crs"], surface)
            except (CRSError, ProjError) as error:
                raise WorkspaceError(
                    f"{shown}: its coordinate system cannot be used: {one_line(error)}"
                ) from None
            if not np.isfinite(shapely.get_coordinates(placed)).all():
                raise WorkspaceError(f"{shown}: a corner has no place in the survey's coordinates")
            yield LabelledPolygon(
                name=f"polygon {number + 1}",
                label="" if text is None else str(text),
                geometry=placed,
            )


def _place_polygon(polygon: BaseGeometry, crs: str | None, surface: MeasuredSurface) -> Any:
    """A polygon in the plane of the rasters."""
    from pyproj import CRS, Transformer

    own = crs_of(surface.frame) if surface.plane.is_level else None
    if crs is None or own is None:
        return polygon
    to = Transformer.from_crs(CRS.from_user_input(crs), own.to_wkt(), always_xy=True)
    return shapely.transform(polygon, lambda xy: np.column_stack(to.transform(*xy.T)))


def plan_slopes_of(surface: MeasuredSurface, polygon: BaseGeometry) -> PackedSlopes:
    """What moves the area in plan of a polygon, whose corners a picture of the surface showed.

    Args:
        surface: that it is on.
        polygon: or several, with holes or without.
    """
    gathered = FigureSlopes(surface.errors)
    for places, slopes in _corners(polygon):
        found = surface.at_picks(places)
        known = np.isfinite(found.height)[:, None]
        samples = replace(
            found, own=np.where(known, found.own, 0.0), sight=np.where(known, found.sight, 0.0)
        )
        gathered.add(places, slopes, samples.own_variance(slopes))
    return gathered.packed


def _figures(surface: MeasuredSurface, parts: Sequence[_PolygonAreas]) -> tuple[Measured, ...]:
    """Area in plan of polygons together; where it is known that of the surface, and rugosity."""
    area = math.fsum(float(one.geometry.area) for one, _, _ in parts)
    by_plan = sum_slopes([(1.0, slopes) for _, slopes, _ in parts])
    plan = figure(surface, "plan_area", "Area in plan", area, by_plan, 2)
    known = [areas for _, _, areas in parts if areas is not None]
    if not known:
        return (plan,)
    return plan, *_of_surface(surface, known, [one.geometry for one, _, _ in parts])


def _of_surface(
    surface: MeasuredSurface, known: Sequence[SurfaceAreas], drawn: Sequence[BaseGeometry]
) -> tuple[Measured, Measured]:
    """Area of the surface within polygons as they were drawn, and its rugosity.

    Where corners were drawn wrongly the surface gains as the plan does, times its mean rugosity.
    """
    slanted, rugosity = figures_of_all(surface, known)
    gain = surface.click * math.sqrt(sum(map(_corner_gain, drawn)))
    return replace(slanted, own=math.hypot(slanted.own, rugosity.value * gain)), rugosity


def _corners(polygon: BaseGeometry) -> Iterator[tuple[Array, Array]]:
    """Corners (N, 2) of each ring, and (N, 3) how motions of these change the area in plan."""
    for part in shapely.get_parts(shapely.orient_polygons(polygon)):
        for ring in shapely.get_rings(part):
            places = shapely.get_coordinates(ring)[:-1]
            chord = np.roll(places, -1, axis=0) - np.roll(places, 1, axis=0)
            yield places, 0.5 * np.column_stack([chord[:, 1], -chord[:, 0], np.zeros(len(chord))])


def _corner_gain(polygon: BaseGeometry) -> float:
    """Variance of a polygon's area where each corner has a variance of 1 in each axis."""
    return math.fsum(float((slopes**2).sum()) for _, slopes in _corners(polygon))


def _pixel(surface: MeasuredSurface) -> float:
    """Side of a pixel of the mosaic, or of a cell where there is none."""
    path = surface.workspace / MOSAIC.path
    if not path.is_file():
        return surface.grid.cell
    with opened_raster(path) as raster:
        return float(raster.transform.a)


def _known_area(surface: MeasuredSurface) -> float:
    """Area in plan of the cells that have a height."""
    known = 0
    with opened_raster(surface.dem) as raster:
        for _, window in raster.block_windows(1):
            known += int(np.isfinite(raster.read(1, window=window)).sum())
    return max(known, 1) * surface.grid.cell**2


def _line(what: str, figures: Sequence[Measured]) -> str:
    texts = []
    for one in figures:
        scale, unit = (100.0, " %") if one.name == "cover" else (1.0, f" {one.unit}".rstrip())
        value, sigma = (f"{scale * number:.4g}" for number in (one.value, one.sigma))
        texts.append(f"{one.name.replace('_', ' ')} {value} +/- {sigma}{unit}")
    return f"{what}: {', '.join(texts)}"


def _write(
    output: Path,
    surface: MeasuredSurface,
    polygons: Sequence[LabelledPolygon],
    figures: Sequence[Sequence[dict[str, Any]]],
    notes: Sequence[str],
) -> None:
    rows = [
        Measurement(
            name=f"{one.name} ({one.label})", kind="polygon", geometry=one.geometry,
            figures=values, notes=notes,
        )
        for one, values in zip(polygons, figures, strict=True)
    ]  # fmt: skip
    datum = surface.frame.datum if surface.plane.is_level else None
    csv = output.suffix.lower() == ".csv"
    with atomic_path(output) as path:
        path.write_text(as_csv(rows) if csv else as_geojson(rows, datum, surface.unit))
