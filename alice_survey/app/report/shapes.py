"""Lines, outlines and points of a survey for its map: plan, flight, cameras, footprints."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from alice_survey.app.report.held import Held, known_column, number, planned_area
from alice_survey.core.artefacts import read_json
from alice_survey.core.frames import Array, Datum
from alice_survey.core.records import FrameRecord
from alice_survey.kit.document import ShapeLayer
from alice_survey.kit.words import length
from reconstruct.views.model import datum_of

_BLUE, _ORANGE, _GREEN, _RED, _BLACK = "#0072b2", "#e69f00", "#009e73", "#d55e00", "#333333"
"""Okabe and Ito's palette, safe for the colour-blind."""
_MAX_VERTICES = 4000
"""Most points of a track on the map."""
_MAX_OUTLINES, _MAX_POINTS = 4000, 20_000
"""Most shapes on the map: some 4 MB of the page each."""

Shape = Sequence[tuple[float, float]]


def shape_layers(held: Held) -> Iterator[ShapeLayer]:
    """All shapes that a workspace holds, the lowest first.

    They lie on the level map: there are none where surface and mosaic are of another plane.
    """
    if held.plane is not None:
        return
    area = planned_area(held)
    if area is not None:
        yield ShapeLayer(
            name="area", title="Area to survey", about="As given in the plan.", kind="polygon",
            shapes=[_pairs(np.array(part.exterior.coords)) for part in area.geoms],
            colour=_BLACK, dashed=True,
        )  # fmt: skip
    footprints, every = thin_shapes(list(_footprints(held)), _MAX_OUTLINES)
    if footprints:
        yield ShapeLayer(
            name="footprints", title="Footprints", kind="polygon", colour=_GREEN, shown=False,
            about=f"Sea floor that each picture shows{every}.",
            shapes=[outline for outline, _ in footprints], texts=[text for _, text in footprints],
        )  # fmt: skip
    lines = () if held.plan is None else held.plan.lines
    if lines:
        yield ShapeLayer(
            name="plan", title="Plan", about="Survey lines as planned.", kind="line",
            shapes=[
                _pairs(np.array([line.start_ne_m, line.end_ne_m])[:, ::-1]) for line in lines
            ],
            texts=[f"line {n}, {line.stations} stations" for n, line in enumerate(lines, 1)],
            colour=_BLUE, dashed=True,
        )  # fmt: skip
    flown = held.rows("flight/truth/track.csv")
    if flown:
        places = np.array([[number(row, "east_m"), number(row, "north_m")] for row in flown])
        step = max(1, len(places) // _MAX_VERTICES)
        yield ShapeLayer(
            name="flown", title="Flown", about="Where the vehicle really was (simulated).",
            kind="line", shapes=[_pairs(places[::step])], colour=_ORANGE,
        )  # fmt: skip
    cameras, every = thin_shapes(_cameras(held), _MAX_POINTS)
    if cameras:
        yield ShapeLayer(
            name="cameras", title="Cameras", kind="point", colour=_BLUE, shown=not flown,
            about=f"Where pictures were taken, from the model{every}.",
            shapes=[place for place, _ in cameras], texts=[text for _, text in cameras],
        )  # fmt: skip
    lost, every = thin_shapes(_lost_pictures(held), _MAX_POINTS)
    if lost:
        yield ShapeLayer(
            name="lost", title="Lost pictures", kind="point", colour=_RED,
            about=f"Pictures that are not in the model, where navigation has them{every}.",
            shapes=[place for place, _ in lost], texts=[text for _, text in lost],
        )  # fmt: skip


def camera_place(row: Mapping[str, str]) -> Array:
    """Right and up on the map: east and north, or of a model without a place its own y and x."""
    columns = (("east_m", "north_m"), ("y_m", "x_m"), ("y", "x"))
    names = next(names for names in columns if names[0] in row)
    return np.array([number(row, name) for name in names])


def thin_shapes(
    shapes: Sequence[tuple[Shape, str]], maximum: int
) -> tuple[Sequence[tuple[Shape, str]], str]:
    """At most this many shapes, evenly taken, and words on what was left out."""
    step = -(-len(shapes) // maximum)
    return (shapes, "") if step <= 1 else (shapes[::step], f"; one of {step} is shown")


def _pairs(east_north: Array) -> list[tuple[float, float]]:
    return [(round(float(e), 4), round(float(n), 4)) for e, n in east_north]


def _cameras(held: Held) -> list[tuple[Shape, str]]:
    found: list[tuple[Shape, str]] = []
    for row in held.track:
        place = camera_place(row)[None]
        sigma = np.hypot(number(row, "sigma_north_m"), number(row, "sigma_east_m"))
        text = (
            f"{row['image']}: {row['points']} points, {number(row, 'reprojection_px'):.2f} px; "
            f"sigma {length(float(sigma), held.unit)} level"
        )
        found.append((_pairs(place), text))
    return found


def _lost_pictures(held: Held) -> list[tuple[Shape, str]]:
    datum = _datum(held)
    if datum is None or not held.has("sparse"):
        return []
    there = {row["image"] for row in held.track}
    rows = [row for row in held.rows("images/manifest.csv") if row["image"] not in there]
    rows = [row for row in rows if row.get("latitude_deg") and row.get("longitude_deg")]
    if not rows:
        return []
    places = np.array([[number(r, "latitude_deg"), number(r, "longitude_deg")] for r in rows])
    ned = datum.ned_from_geodetic(np.column_stack([places, np.zeros(len(rows))]))
    return [
        (_pairs(place[None, 1::-1]), f"{row['image']}: not in the model")
        for place, row in zip(ned, rows, strict=True)
    ]


def _footprints(held: Held) -> Iterator[tuple[Shape, str]]:
    file = held.file("mosaic/footprints.geojson")
    if file is None:
        return
    datum = _datum(held)
    for feature in read_json(file)["features"]:
        facts: dict[str, str] = feature["properties"]
        for ring in (feature["geometry"] or {}).get("coordinates", []):
            corners = np.asarray(ring, dtype=np.float64)
            if datum is not None and held.frame.name == "ned":
                level = np.column_stack([corners[:, 1::-1], np.zeros(len(corners))])
                corners = datum.ned_from_geodetic(level)[:, 1::-1]
            area = float(known_column([facts], "area_")[0])
            yield _pairs(corners[:, :2]), f"{facts['image']}: {area:.2f} {held.unit}²"


def _datum(held: Held) -> Datum | None:
    frame = held.read(FrameRecord)
    return None if frame is None or frame.datum is None else datum_of(frame.datum)
