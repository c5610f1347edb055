"""Areas, cover and rugosity of the polygons of a GIS file on a survey's surface."""

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.contents import one_line
from alice_survey.core.errors import ConfigError, ReconstructionError, WorkspaceError
from alice_survey.core.products import MOSAIC
from alice_survey.core.run import progress
from missions.areas.safe import DRIVERS, gis_files
from reconstruct.measure.areas import SurfaceAreas, figures_of_all, surface_within
from reconstruct.measure.errors import FigureSlopes, PackedSlopes, sum_slopes
from reconstruct.measure.figures import Measured, Measurement, as_csv, as_geojson, figure
from reconstruct.measure.surface import MeasuredSurface
from reconstruct.raster import crs_of, opened_raster

_LABELS = ("label", "class", "species", "name")
"""Attributes that are looked for, in this order and in any case, where none is named."""
_MAX_CORNERS = 200_000


@dataclass(frozen=True, kw_only=True, eq=False)
class LabelledPolygon:
    """A polygon of a file, or several that are one thing, in the plane of the rasters."""

    name: str
    label: str
    geometry: BaseGeometry


@dataclass(frozen=True, kw_only=True, eq=False)
class _PolygonAreas:
    polygon: LabelledPolygon
    by_plan: PackedSlopes
    """What moves its area in plan."""
    surface: SurfaceAreas | None
    """None where no surface is known in it."""
    fault: str = ""


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
    sigma = pick_sigma_px * _pixel(surface)
    measured = []
    with progress.step("measure polygons", len(polygons)) as step:
        for polygon in polygons:
            measured.append(_measure(surface, polygon, sigma))
            step.advance()
    notes = [f"{one.polygon.name}: {one.fault}" for one in measured if one.fault]
    if pick_sigma_px:
        counted = f"counted: sigma of a corner, {pick_sigma_px:g} pixels of the mosaic"
        notes += [counted, *(n for n in surface.errors.notes if "place was picked" not in n)]
    else:
        notes += surface.errors.notes
    each = [_figures(surface, [one], sigma) for one in measured]
    known = _known_area(surface)
    labels = []
    for name, group in groupby(sorted(measured, key=_label), _label):
        same = list(group)
        figures = _figures(surface, same, sigma)
        covered = float(shapely.union_all([one.polygon.geometry for one in same]).area) / known
        cover = Measured(
            name="cover", title="Share of the known surface, in plan", value=covered,
            own=figures[0].own / known, shared=figures[0].shared / known, unit="",
        )  # fmt: skip
        labels.append((name, len(same), (*figures, cover)))
    if output is not None:
        _write(output, surface, measured, each, notes)
    data = {
        "format": "alice-survey measure polygons",
        "version": 1,
        "file": str(file),
        "polygons": [
            {"name": m.polygon.name, "label": m.polygon.label, "figures": _json(figures)}
            for m, figures in zip(measured, each, strict=True)
        ],
        "labels": [{"label": n, "count": c, "figures": _json(f)} for n, c, f in labels],
        "notes": notes,
    }
    lines = [
        _line(f"{one.polygon.name} ({one.polygon.label})", figures)
        for one, figures in zip(measured, each, strict=True)
    ]
    lines += [_line(f"all of {name!r}, {count}", figures) for name, count, figures in labels]
    return "\n".join([*lines, *(f"note: {note}" for note in notes)]), data


def read_polygons(
    file: Path, surface: MeasuredSurface, label: str | None = None
) -> list[LabelledPolygon]:
    """The polygons of a file, in the plane of a surface's rasters.

    Raises:
        PlanError: the file is damaged, too large or of another kind.
        WorkspaceError: it holds no polygon, or has no such attribute.
    """
    found: list[LabelledPolygon] = []
    if file.suffix.lower() not in DRIVERS:
        raise WorkspaceError(f"{file}: polygons are read from {', '.join(DRIVERS)}")
    with gis_files(file) as parts:
        for part in parts:
            found += _layers(part, file, surface, label)
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
    import pyogrio
    import pyogrio.raw
    from pyogrio.errors import DataLayerError, DataSourceError

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # rings that are not closed are closed below
        try:
            layers = [
                pyogrio.raw.read(part, layer=number, force_2d=True)
                for number, (_, kind) in enumerate(pyogrio.list_layers(part).tolist())
                if kind is not None
            ]
        except (DataSourceError, DataLayerError, UnicodeDecodeError, ValueError) as error:
            raise WorkspaceError(f"{shown}: cannot be read: {one_line(error)}") from None
        for about, _, shapes, columns in layers:
            read = shapely.make_valid(shapely.from_wkb(shapes, on_invalid="fix"))
            texts = _texts(about["fields"].tolist(), columns, label, shown)
            for number, geometry in enumerate(read):
                polygon = _polygons_of(geometry)
                if polygon is not None:
                    yield LabelledPolygon(
                        name=f"polygon {number + 1}",
                        label=texts[number] if texts else shown.stem,
                        geometry=_place_polygon(polygon, about["crs"], surface, shown),
                    )


def _texts(
    fields: Sequence[str], columns: Sequence[Any], label: str | None, shown: Path
) -> list[str] | None:
    """The labels of a layer's features; None where no attribute is one."""
    lower = [field.lower() for field in fields]
    if label is not None and label.lower() not in lower:
        known = ", ".join(fields) or "none"
        raise WorkspaceError(f"{shown}: no attribute {label!r}; there are {known}")
    names = [label.lower()] if label is not None else [name for name in _LABELS if name in lower]
    if not names:
        return None
    return ["" if value is None else str(value) for value in columns[lower.index(names[0])]]


def _polygons_of(geometry: BaseGeometry | None) -> BaseGeometry | None:
    """The polygons of a valid geometry; None where it has no area."""
    if geometry is None:
        return None
    parts = shapely.get_parts(shapely.get_parts(geometry))
    areal = [one for one in parts if one.geom_type == "Polygon" and one.area > 0]
    return shapely.union_all(areal) if areal else None


def _place_polygon(
    polygon: BaseGeometry, crs: str | None, surface: MeasuredSurface, shown: Path
) -> Any:
    """A polygon in the plane of the rasters."""
    from pyproj import CRS, Transformer
    from pyproj.exceptions import CRSError, ProjError

    own = crs_of(surface.frame) if surface.plane.is_level else None
    if crs is None or own is None:
        return polygon
    try:
        to = Transformer.from_crs(CRS.from_user_input(crs), own.to_wkt(), always_xy=True)
    except (CRSError, ProjError) as error:
        raise WorkspaceError(
            f"{shown}: its coordinate system cannot be used: {one_line(error)}"
        ) from None
    moved = shapely.transform(polygon, lambda xy: np.column_stack(to.transform(*xy.T)))
    if not np.isfinite(shapely.get_coordinates(moved)).all():
        raise WorkspaceError(f"{shown}: a corner has no place in the survey's coordinates")
    return moved


def _measure(surface: MeasuredSurface, polygon: LabelledPolygon, sigma: float) -> _PolygonAreas:
    by_plan = plan_slopes_of(surface, polygon.geometry, sigma)
    try:
        areas, _ = surface_within(surface, polygon.geometry)
    except ReconstructionError as error:
        return _PolygonAreas(polygon=polygon, by_plan=by_plan, surface=None, fault=str(error))
    fault = f"the surface is known in {areas.share:.1%} of it" if areas.share < 0.999 else ""
    return _PolygonAreas(polygon=polygon, by_plan=by_plan, surface=areas, fault=fault)


def plan_slopes_of(surface: MeasuredSurface, polygon: BaseGeometry, sigma: float) -> PackedSlopes:
    """What moves the area in plan of a polygon, whose corners a picture of the surface showed.

    Args:
        surface: that it is on.
        polygon: or several, with holes or without.
        sigma: of a corner in each axis.
    """
    gathered = FigureSlopes(surface.errors)
    for part in shapely.get_parts(shapely.orient_polygons(polygon)):
        for ring in shapely.get_rings(part):
            places = shapely.get_coordinates(ring)[:-1]
            chord = np.roll(places, -1, axis=0) - np.roll(places, 1, axis=0)
            slopes = 0.5 * np.column_stack([chord[:, 1], -chord[:, 0], np.zeros(len(chord))])
            found = surface.at_picks(places)
            known = np.isfinite(found.height)[:, None]
            samples = replace(
                found, own=np.where(known, found.own, 0.0), sight=np.where(known, found.sight, 0.0)
            )
            own = samples.own_variance(slopes) + sigma**2 * float((slopes**2).sum())
            gathered.add(places, slopes, own)
    return gathered.packed


def _figures(
    surface: MeasuredSurface, parts: Sequence[_PolygonAreas], sigma: float
) -> tuple[Measured, ...]:
    """Area in plan of polygons together, and where it is known that of the surface, and rugosity.

    Where corners were drawn wrongly the surface gains as the plan does, times its mean rugosity.
    """
    area = math.fsum(float(one.polygon.geometry.area) for one in parts)
    by_plan = sum_slopes([(1.0, one.by_plan) for one in parts])
    plan = figure(surface, "plan_area", "Area in plan", area, by_plan, 2)
    known = [one.surface for one in parts if one.surface is not None]
    if not known:
        return (plan,)
    slanted, rugosity = figures_of_all(surface, known)
    drawn = sigma * math.sqrt(sum(_corner_gain(one.polygon.geometry) for one in parts))
    own = math.hypot(slanted.own, rugosity.value * drawn)
    return plan, replace(slanted, own=own), rugosity


def _corner_gain(polygon: BaseGeometry) -> float:
    """Variance of a polygon's area where each corner has a variance of 1 in each axis."""
    total = 0.0
    for part in shapely.get_parts(polygon):
        for ring in shapely.get_rings(part):
            places = shapely.get_coordinates(ring)[:-1]
            total += float(((np.roll(places, -1, axis=0) - np.roll(places, 1, axis=0)) ** 2).sum())
    return total / 4.0


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


def _label(one: _PolygonAreas) -> str:
    return one.polygon.label


def _json(figures: Sequence[Measured]) -> list[dict[str, Any]]:
    return [one.to_json() for one in figures]


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
    measured: Sequence[_PolygonAreas],
    each: Sequence[tuple[Measured, ...]],
    notes: Sequence[str],
) -> None:
    rows = [
        Measurement(
            name=f"{one.polygon.name} ({one.polygon.label})", kind="polygon",
            places=shapely.get_coordinates(one.polygon.geometry).tolist(),
            figures=_json(figures), notes=notes, shape=one.polygon.geometry,
        )
        for one, figures in zip(measured, each, strict=True)
    ]  # fmt: skip
    datum = surface.frame.datum if surface.plane.is_level else None
    csv = output.suffix.lower() == ".csv"
    with atomic_path(output) as path:
        path.write_text(as_csv(rows) if csv else as_geojson(rows, datum, surface.unit))
