"""A measured figure with its sigma, and the figures of a few points.

Tables and maps of measurements are for other programs.
"""

import csv
import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from alice_survey.core.frames import Array, Datum
from reconstruct.measure.errors import FigureSlopes, PackedSlopes
from reconstruct.measure.surface import MeasuredSurface, Samples


@dataclass(frozen=True, kw_only=True)
class Measured:
    """A figure and how well it is known."""

    name: str
    title: str
    value: float
    own: float
    """Standard deviation by own errors of cells."""
    shared: float
    """Standard deviation by what poses, calibration and scale do to all."""
    unit: str
    """Empty of a ratio."""

    @property
    def sigma(self) -> float:
        """Standard deviation."""
        return math.hypot(self.own, self.shared)

    def to_json(self) -> dict[str, Any]:
        """The figure with its sigma, as JSON holds them."""
        return {**vars(self), "sigma": self.sigma}


def figure(
    surface: MeasuredSurface, name: str, title: str, value: float, slopes: PackedSlopes, power: int,
    unit: str | None = None,
) -> Measured:  # fmt: skip
    """A figure of a surface.

    Args:
        surface: that it is of.
        name: plain word.
        title: for readers.
        value: of the figure.
        slopes: its derivatives by the surface's motions.
        power: of a length that it is: it grows so with the scale.
        unit: where it is no power of a length.
    """
    scale = power * value * surface.errors.scale_sigma
    lengths = surface.unit + ("", "", "²", "³")[power] if power else ""
    return Measured(
        name=name, title=title, value=value, own=math.sqrt(max(slopes.own, 0.0)),
        shared=math.hypot(math.sqrt(slopes.shared), scale),
        unit=lengths if unit is None else unit,
    )  # fmt: skip


def slopes_of(value: Callable[[Array], float], points: Array) -> Array:
    """Derivatives (N, 3) of a figure of points (N, 3), by central differences."""
    slope = np.zeros_like(points)
    step = 1e-6 * max(1.0, float(np.abs(points).max()))
    for n, axis in np.ndindex(*points.shape):
        ends = []
        for sign in (1.0, -1.0):
            moved = points.copy()
            moved[n, axis] += sign * step
            ends.append(value(moved))
        slope[n, axis] = (ends[0] - ends[1]) / (2 * step)
    return slope


def of_points(
    surface: MeasuredSurface, samples: Samples, name: str, title: str,
    value: Callable[[Array], float], power: int, unit: str | None = None,
) -> Measured:  # fmt: skip
    """A figure of points of a surface, which is a function of their coordinates."""
    centred = samples.points - samples.points.mean(axis=0)
    slopes, gathered = slopes_of(value, centred), FigureSlopes(surface.errors)
    gathered.add(samples.places, slopes, samples.own_variance(slopes))
    return figure(surface, name, title, value(centred), gathered.packed, power, unit)


def polyline(points: Array) -> float:
    """Length of the line through points (N, D)."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def polygon_area(points: Array) -> float:
    """Area of the closed polygon through points (N, 3): the length of its vector area."""
    local = points - points.mean(axis=0)
    return 0.5 * float(np.linalg.norm(np.cross(local, np.roll(local, -1, axis=0)).sum(axis=0)))


def plan_area(points: Array) -> float:
    """Area (not negative) of the polygon through points (N, 2 or 3), seen along the third axis."""
    x, y = (points[:, axis] - points[:, axis].mean() for axis in range(2))
    return 0.5 * abs(float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()))


def as_places(vertices: Sequence[Sequence[float]]) -> Array:
    """Places (N, 2) without repeated ones."""
    places = np.asarray(vertices, dtype=np.float64).reshape(-1, 2)
    kept = np.ones(len(places), np.bool_)
    kept[1:] = np.any(np.diff(places, axis=0) != 0.0, axis=1)
    return places[kept]


_HEADER = ("name", "kind", "figure", "value", "sigma", "unit", "sigma_own", "sigma_shared",
           "notes", "places")  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """What was measured where."""

    name: str
    kind: str
    """`point`, `line`, `points` in space, or `polygon`."""
    geometry: BaseGeometry
    """Right (east) and up (north), of points in space also out (height)."""
    figures: Sequence[Mapping[str, Any]]
    """As `Measured.to_json`; values that are not known are None."""
    notes: Sequence[str] = ()


def geometry_of(kind: str, places: Sequence[Sequence[float]]) -> BaseGeometry:
    """What was drawn, as shapely has it."""
    if len(places) == 1:
        return shapely.Point(places[0])
    return (shapely.Polygon if kind == "polygon" else shapely.LineString)(places)


def as_csv(measurements: Sequence[Measurement]) -> str:
    """A row for every figure, with its sigma and the places as well-known text."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(_HEADER)
    for one in measurements:
        for figure in one.figures:
            numbers = (figure["value"], figure["sigma"], figure["own"], figure["shared"])
            value, sigma, own, shared = (_digits(number) for number in numbers)
            rows.writerow(
                [_plain(one.name), one.kind, figure["title"], value, sigma, figure["unit"], own,
                 shared, "; ".join(one.notes), one.geometry.wkt]
            )  # fmt: skip
    return text.getvalue()


def as_geojson(measurements: Sequence[Measurement], datum: Datum | None, unit: str) -> str:
    """A feature for every measurement, in longitude and latitude (RFC 7946) where placed.

    Args:
        measurements: to write.
        datum: of the places; None of a model without place, or of a plane, whose own coordinates
            are written then.
        unit: of lengths.
    """

    def to_lon_lat(places: Any) -> Any:
        return places if datum is None else np.round(datum.lon_lat_from_en(places), 11)

    features = []
    for one in measurements:
        geometry = shapely.transform(shapely.force_2d(one.geometry), to_lon_lat)
        figures = {}
        for figure in one.figures:
            figures[figure["name"]] = figure["value"]
            figures[f"{figure['name']}_sigma"] = figure["sigma"]
            figures[f"{figure['name']}_unit"] = figure["unit"]
        features.append(
            {
                "type": "Feature",
                "geometry": shapely.geometry.mapping(shapely.orient_polygons(geometry)),
                "properties": {
                    "name": one.name, "kind": one.kind, **figures, "notes": list(one.notes),
                },
            }
        )  # fmt: skip
    whole: dict[str, Any] = {"type": "FeatureCollection", "features": features}
    if datum is None:
        whole["coordinates"] = f"of the model or its plane, in {unit}, not longitude and latitude"
    return json.dumps(whole, indent=1, allow_nan=False) + "\n"


def _digits(number: float | None) -> str:
    return "" if number is None or not math.isfinite(number) else f"{number:.9g}"


def _plain(name: str) -> str:
    """A name that a spreadsheet does not take for a formula."""
    return f"'{name}" if name[:1] in "=+-@\t\r" else name
