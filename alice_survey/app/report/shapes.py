"""Lines, outlines and points of a survey for its map: plan, flight, cameras, footprints."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from alice_survey.app.report.held import Held, number, planned_area
from alice_survey.core.artefacts import read_json
from alice_survey.core.frames import Array
from alice_survey.kit.document import ShapeLayer
from alice_survey.kit.words import sigma_length
from reconstruct.views.model import datum_of

_BLUE, _ORANGE, _GREEN, _RED, _BLACK = "#0072b2", "#e69f00", "#009e73", "#d55e00", "#333333"
"""Okabe and Ito's palette, safe for the colour-blind."""
_MAX_VERTICES = 4000
"""Most points of a track on the map."""
_MAX_SHAPES = {"polygon": 4000, "line": 4000, "point": 20_000}
"""Most shapes of a layer: some 4 MB of the page each."""

Shape = Sequence[tuple[float, float]]
Named = Sequence[tuple[Shape, str]]
"""Shapes, and what is shown when one is chosen."""


def shape_layers(held: Held) -> Iterator[ShapeLayer]:
    """All shapes that a workspace holds, the lowest first.

    They lie on the level map: there are none where surface and mosaic are of another plane.
    """
    if held.plane is not None:
        return
    area = planned_area(held)
    rings = [] if area is None else [np.array(part.exterior.coords) for part in area.geoms]
    lines = () if held.plan is None else held.plan.lines
    planned: Named = [
        (_pairs(np.array([line.start_ne_m, line.end_ne_m])[:, ::-1]),
         f"line {n}, {line.stations} stations")
        for n, line in enumerate(lines, 1)
    ]  # fmt: skip
    track = held.rows("flight/truth/track.csv")
    places = np.array([[number(row, "east_m"), number(row, "north_m")] for row in track])
    flown = [(_pairs(places[:: max(1, len(places) // _MAX_VERTICES)]), "")] if track else []
    made = (
        _layer("area", "Area to survey", "As given in the plan.", "polygon",
               [(_pairs(ring), "") for ring in rings], colour=_BLACK, dashed=True),
        _layer("footprints", "Footprints", "Surface that each picture shows.", "polygon",
               list(_footprints(held)), colour=_GREEN, shown=False),
        _layer("plan", "Plan", "Survey lines as planned.", "line", planned, colour=_BLUE,
               dashed=True, shown=not held.has("mosaic")),
        _layer("flown", "Flown", "Where the vehicle really was (simulated).", "line", flown,
               colour=_ORANGE, shown=not held.has("mosaic")),
        _layer("cameras", "Cameras", "Where pictures were taken, from the model.", "point",
               _cameras(held), colour=_BLUE, shown=not track and not held.has("mosaic")),
        _layer("unplaced", "Lost pictures" if held.has("sparse") else "Pictures",
               "Pictures that are not in a model, where navigation has them.", "point",
               _unplaced_pictures(held), colour=_RED if held.has("sparse") else _BLUE),
    )  # fmt: skip
    yield from (layer for layer in made if layer.shapes)


def _layer(
    name: str,
    title: str,
    about: str,
    kind: Literal["line", "polygon", "point"],
    found: Named,
    **how: Any,
) -> ShapeLayer:
    """A layer of at most so many shapes, evenly taken; it says what was left out."""
    step = -(-len(found) // _MAX_SHAPES[kind])
    kept = found[:: max(step, 1)]
    if step > 1:
        about = f"{about} One of {step} is shown."
    return ShapeLayer(
        name=name, title=title, about=about, kind=kind, shapes=[shape for shape, _ in kept],
        texts=[text for _, text in kept], **how,
    )  # fmt: skip


def camera_place(row: Mapping[str, str]) -> Array:
    """Right and up on the map: east and north, or of a model without a place its own y and x."""
    columns = (("east_m", "north_m"), ("y_m", "x_m"), ("y", "x"))
    names = next(names for names in columns if names[0] in row)
    return np.array([number(row, name) for name in names])


def _pairs(east_north: Array) -> list[tuple[float, float]]:
    return [(round(float(e), 4), round(float(n), 4)) for e, n in east_north]


def _cameras(held: Held) -> list[tuple[Shape, str]]:
    found: list[tuple[Shape, str]] = []
    for row in held.track:
        place = camera_place(row)[None]
        sigma = np.hypot(number(row, "sigma_north_m"), number(row, "sigma_east_m"))
        text = (
            f"{row['image']}: {row['points']} points, {number(row, 'reprojection_px'):.2f} px; "
            f"sigma {sigma_length(float(sigma), held.unit)} level"
        )
        found.append((_pairs(place), text))
    return found


def _unplaced_pictures(held: Held) -> list[tuple[Shape, str]]:
    datum = held.frame.datum
    if datum is None:
        return []
    there = {row["image"] for row in held.track}
    rows = [row for row in held.rows("images/manifest.csv") if row["image"] not in there]
    rows = [row for row in rows if row.get("latitude_deg") and row.get("longitude_deg")]
    if not rows:
        return []
    places = np.array([[number(r, "latitude_deg"), number(r, "longitude_deg")] for r in rows])
    ned = datum_of(datum).ned_from_geodetic(np.column_stack([places, np.zeros(len(rows))]))
    return [
        (_pairs(place[None, 1::-1]), f"{row['image']}: not in a model")
        for place, row in zip(ned, rows, strict=True)
    ]


def _footprints(held: Held) -> Iterator[tuple[Shape, str]]:
    file = held.file("mosaic/footprints.geojson")
    if file is None:
        return
    datum = held.frame.datum
    for feature in read_json(file)["features"]:
        facts: dict[str, str] = feature["properties"]
        for ring in (feature["geometry"] or {}).get("coordinates", []):
            corners = np.asarray(ring, dtype=np.float64)
            if datum is not None and held.frame.name == "ned":
                level = np.column_stack([corners[:, 1::-1], np.zeros(len(corners))])
                corners = datum_of(datum).ned_from_geodetic(level)[:, 1::-1]
            area = float(next(facts[name] for name in facts if name.startswith("area_")))
            yield _pairs(corners[:, :2]), f"{facts['image']}: {area:.2f} {held.unit}²"
