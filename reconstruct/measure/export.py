"""Measurements as tables and maps for other programs."""

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from alice_survey.core.frames import Array, Datum

_HEADER = ("name", "kind", "figure", "value", "sigma", "unit", "sigma_own", "sigma_shared",
           "notes", "places")  # fmt: skip
_GEOMETRIES = {"point": "Point", "line": "LineString", "points": "LineString"}


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
                 shared, "; ".join(one.notes), _well_known(one)]
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
    features = []
    for one in measurements:
        places = np.asarray(one.places, dtype=np.float64)[:, :2]
        if datum is not None:
            places = np.round(datum.lon_lat_from_en(places), 9)
        if one.kind == "polygon":
            places = _counter_clockwise(places)
            coordinates: Any = [[*places.tolist(), places[0].tolist()]]
        else:
            coordinates = places.tolist() if len(places) > 1 else places[0].tolist()
        kind = "Polygon" if one.kind == "polygon" else _GEOMETRIES[one.kind]
        figures = {}
        for figure in one.figures:
            figures[figure["name"]] = figure["value"]
            figures[f"{figure['name']}_sigma"] = figure["sigma"]
            figures[f"{figure['name']}_unit"] = figure["unit"]
        features.append(
            {
                "type": "Feature",
                "geometry": {"type": kind, "coordinates": coordinates},
                "properties": {
                    "name": one.name, "kind": one.kind, **figures, "notes": list(one.notes),
                },
            }
        )  # fmt: skip
    whole: dict[str, Any] = {"type": "FeatureCollection", "features": features}
    if datum is None:
        whole["coordinates"] = f"of the model or its plane, in {unit}, not longitude and latitude"
    return json.dumps(whole, indent=1, allow_nan=False) + "\n"


def _counter_clockwise(places: Array) -> Array:
    x, y = places.T
    turns = float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())
    return places if turns >= 0 else places[::-1]


def _well_known(one: Measurement) -> str:
    places = list(one.places) + ([one.places[0]] if one.kind == "polygon" else [])
    texts = ", ".join(" ".join(f"{value:.6g}" for value in place) for place in places)
    if one.kind == "polygon":
        return f"POLYGON (({texts}))"
    return f"POINT ({texts})" if len(places) == 1 else f"LINESTRING ({texts})"


def _digits(number: float | None) -> str:
    return "" if number is None or not math.isfinite(number) else f"{number:.9g}"


def _plain(name: str) -> str:
    """A name that a spreadsheet does not take for a formula."""
    return f"'{name}" if name[:1] in "=+-@\t\r" else name
