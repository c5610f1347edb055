"""Measurements as tables and maps for other programs."""

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from alice_survey.core.frames import Datum

_HEADER = ("name", "kind", "figure", "value", "sigma", "unit", "sigma_own", "sigma_shared",
           "notes", "places")  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """What was measured where."""

    name: str
    kind: str
    """`point`, `line`, `points` in space, or `polygon`."""
    places: Sequence[Sequence[float]]
    """Right (east) and up (north), of points in space also out (height)."""
    figures: Sequence[Mapping[str, Any]]
    """As `Measured.to_json`; values that are not known are None."""
    notes: Sequence[str] = ()
    shape: BaseGeometry | None = None
    """Of a polygon with holes or of several parts, in the same coordinates."""

    @property
    def geometry(self) -> BaseGeometry:
        """As shapely has it."""
        if self.shape is not None:
            return self.shape
        if len(self.places) == 1:
            return shapely.Point(self.places[0])
        make = shapely.Polygon if self.kind == "polygon" else shapely.LineString
        return make(self.places)


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

    def placed(places: Any) -> Any:
        return places if datum is None else np.round(datum.lon_lat_from_en(places), 11)

    features = []
    for one in measurements:
        geometry = shapely.transform(shapely.force_2d(one.geometry), placed)
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
