"""Surfaces within annotations: how they were drawn against draws of vertices, and tables."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from alice_survey.core.errors import ConfigError
from reconstruct.annotations.marks import MarkMeasures, MeasuredMark
from reconstruct.annotations.store import change_annotations
from reconstruct.annotations.surfaces import MarkPart, MarkSurfaces, SurfaceFigures
from reconstruct.annotations.table import EACH, HEADER, part_in, table
from reconstruct.annotations.transfer import frame_of
from reconstruct.annotations.values import Annotation, AnnotationSet, DrawnShape, Label
from reconstruct.measure.surface import MeasuredSurface
from tests.alice_survey.app.report.tiny import SLOPE, tiny_workspace
from tests.reconstruct.measure.synthetic import grid, without_errors

PIXEL = 0.01
SIGMA_PX = 0.5


def ridge(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Level on the left, steep on the right: an outline counts more there."""
    return np.asarray(np.where(x > 0, 1.2 * x, 0.0) + 0.0 * y)


@pytest.fixture
def surface(tmp_path: Path) -> MeasuredSurface:
    return without_errors(tmp_path, grid(1.2, 0.01), ridge)


def no_pictures() -> Any:
    raise AssertionError("nothing was drawn in pictures")


def mark_of(shape: DrawnShape) -> MeasuredMark:
    measures = MarkMeasures(PIXEL, no_pictures, SIGMA_PX)
    (found,), lost = measures.of([Annotation(label="coral", shape=shape)])
    assert not lost
    return found


def whole(mark: MeasuredMark) -> MarkPart:
    part = part_in(mark)
    assert part is not None
    return part


def figures(surface: MeasuredSurface, *parts: MarkPart) -> SurfaceFigures:
    surfaces = MarkSurfaces(surface)
    for part in parts:
        surfaces.measure(part)
    found = surfaces.figures(parts)
    assert found is not None
    return found


RING = ((-0.4, -0.4), (0.1, -0.45), (0.42, -0.1), (0.3, 0.4), (-0.2, 0.35))
HOLE = ((0.0, 0.0), (0.0, 0.2), (0.15, 0.2), (0.15, 0.0))


def moved(shape: DrawnShape, rng: np.random.Generator) -> DrawnShape:
    """As it was drawn another time."""
    sigma = SIGMA_PX * PIXEL
    if shape.kind == "circle":
        return shape.model_copy(update={"radius": shape.radius + rng.normal(0, np.sqrt(2) * sigma)})
    if shape.kind == "rectangle":
        (w, s), (e, n) = np.array(shape.points)[[0, 2]] + rng.normal(0, sigma, (2, 2))
        return DrawnShape(kind="rectangle", points=((w, s), (e, s), (e, n), (w, n)))
    rings = [np.array(ring) + rng.normal(0, sigma, (len(ring), 2)) for ring in shape.rings]
    return shape.with_rings(rings)


@pytest.mark.parametrize(
    "shape",
    [
        DrawnShape(kind="polygon", points=RING),
        DrawnShape(kind="polygon", points=RING, holes=(HOLE,)),
        DrawnShape(kind="rectangle", points=((-0.3, -0.3), (0.4, -0.3), (0.4, 0.2), (-0.3, 0.2))),
        DrawnShape(kind="circle", points=((0.05, 0.0),), radius=0.3),
    ],
    ids=["polygon", "hole", "rectangle", "circle"],
)
def test_drawing_errs_as_its_sigmas_say(surface: MeasuredSurface, shape: DrawnShape) -> None:
    stated = figures(surface, whole(mark_of(shape)))
    rng = np.random.default_rng(11)
    drawn = [figures(surface, whole(mark_of(moved(shape, rng)))) for _ in range(150)]
    areas, ratios = ([getattr(one, name) for one in drawn] for name in ("area", "rugosity"))
    assert np.std(areas) / stated.area_sigma == pytest.approx(1.0, abs=0.2)
    assert np.std(ratios) / stated.rugosity_sigma == pytest.approx(1.0, abs=0.2)
    assert stated.area > 1.05 * shape.area


def test_what_a_square_cuts_off_adds_up(surface: MeasuredSurface) -> None:
    mark = mark_of(DrawnShape(kind="polygon", points=RING))
    parts = [
        part_in(mark, shapely.box(x, y, x + 0.5, y + 0.5)) for x in (-0.5, 0.0) for y in (-0.5, 0.0)
    ]
    assert all(part is not None and part.square for part in parts)
    all_of, sum_of = figures(surface, whole(mark)), figures(surface, *filter(None, parts))
    assert sum_of.area == pytest.approx(all_of.area, rel=1e-9)
    assert sum_of.rugosity == pytest.approx(all_of.rugosity, rel=1e-9)
    assert part_in(mark, shapely.box(3, 3, 4, 4)) is None
    assert part_in(mark, shapely.box(-1, -1, 1, 1)).key == whole(mark).key


def test_what_a_square_cuts_off_errs_as_its_sigma_says(surface: MeasuredSurface) -> None:
    shape, box = DrawnShape(kind="polygon", points=RING), shapely.box(0.0, -0.5, 0.5, 0.0)
    rng = np.random.default_rng(12)

    def cut(drawn: DrawnShape) -> SurfaceFigures:
        part = part_in(mark_of(drawn), box)
        assert part is not None and part.square
        return figures(surface, part)

    areas = [cut(moved(shape, rng)).area for _ in range(150)]
    assert np.std(areas) / cut(shape).area_sigma == pytest.approx(1.0, abs=0.2)


def test_a_surface_is_measured_once_and_forgotten_when_it_is_gone(surface: MeasuredSurface) -> None:
    first, second = (
        whole(mark_of(DrawnShape(kind="polygon", points=tuple((x + d, y) for x, y in RING))))
        for d in (0.0, 0.05)
    )
    surfaces = MarkSurfaces(surface)
    assert surfaces.waiting([first, second]) == [first, second]
    surfaces.measure(first)
    assert surfaces.waiting([first, second]) == [second]
    surfaces.measure(second)
    surfaces.keep([second])
    assert surfaces.waiting([first, second]) == [first]
    away = whole(mark_of(DrawnShape(kind="polygon", points=((5.0, 5.0), (6.0, 5.0), (6.0, 6.0)))))
    surfaces.measure(away)
    assert "no surface" in (surfaces.fault(away) or "") and surfaces.figures([away]) is None
    found = surfaces.figures([second, away])
    assert found is not None and found.known == pytest.approx(
        second.geometry.area / (second.geometry.area + 0.5), rel=1e-6
    )


@pytest.fixture
def reef(tmp_path: Path) -> Path:
    """A tilted plane, unknown in its south-western corner, with four annotations."""
    folder = tiny_workspace(tmp_path / "reef")

    def square(name: str, west: float, south: float, side: float, label: str) -> Annotation:
        return Annotation(
            id=name, label=label,
            shape=DrawnShape(kind="polygon", points=((west, south), (west + side, south),
                             (west + side, south + side), (west, south + side))),
        )  # fmt: skip

    labels = (Label(id="coral"), Label(id="sand", code="S"))
    point = Annotation(id="p", label="coral", shape=DrawnShape(kind="point", points=((0.5, 0.5),)))
    line = Annotation(
        id="l", label="coral", shape=DrawnShape(kind="polyline", points=((0.3, 0.5), (0.6, 0.5)))
    )
    ones = (square("a", 0.3, 0.4, 0.1, "coral"), square("b", 0.5, 0.6, 0.2, "coral"),
            square("c", 0.1, 0.1, 0.2, "sand"), point, line)  # fmt: skip
    change_annotations(
        folder, frame_of(folder), lambda _: AnnotationSet(labels=labels, annotations=ones), ""
    )
    return folder


def test_labels_have_the_surface_of_a_tilted_plane(reef: Path, tmp_path: Path) -> None:
    text, data = table(reef, csv_file=tmp_path / "cover.csv")
    slant = np.sqrt(1 + SLOPE**2)
    coral, sand = data["rows"]
    assert coral["surface"] == pytest.approx(slant * 0.05, rel=1e-4)
    assert coral["rugosity"] == pytest.approx(slant, rel=1e-4)
    assert 0 < coral["surface_sigma"] < 0.02 * coral["surface"]
    assert coral["surface_sigma"] > coral["sigma"]  # which the outline alone makes
    assert 0 < coral["rugosity_sigma"] < 0.02
    # a quarter of the sand is where nothing is known, less half a cell along its edges
    assert 0.7 < sand["surface_known"] < 0.78 and coral["surface_known"] == 1.0
    assert sand["surface"] / sand["surface_known"] == pytest.approx(slant * 0.04, rel=1e-3)
    assert "rugosity 1.03" in text and not data["without_surface"]
    lines = (tmp_path / "cover.csv").read_text().splitlines()
    assert lines[0] == ",".join(HEADER) and len(lines) == 3
    assert float(lines[1].split(",")[HEADER.index("surface")]) == coral["surface"]
    by_quadrats = table(reef, side=0.25)[1]["rows"]
    parts = [row["surface"] for row in by_quadrats if row["label"] == "coral" and row["area"]]
    assert len(parts) > 2 and sum(parts) == pytest.approx(coral["surface"], rel=1e-6)


def test_annotations_are_listed_one_by_one(reef: Path, tmp_path: Path) -> None:
    text, data = table(reef, each=True, csv_file=tmp_path / "each.csv")
    rows = {row["id"]: row for row in data["rows"]}
    assert list(rows) == ["a", "b", "c", "p", "l"]
    assert rows["b"]["surface"] == pytest.approx(np.sqrt(1 + SLOPE**2) * 0.04, rel=1e-4)
    assert rows["b"]["area"] == pytest.approx(0.04) and rows["b"]["east"] == pytest.approx(0.6)
    assert rows["p"]["area"] is None and rows["p"]["surface"] is None
    assert rows["l"]["length"] == pytest.approx(0.3) and rows["l"]["rugosity"] is None
    lines = (tmp_path / "each.csv").read_text().splitlines()
    assert lines[0] == ",".join(EACH) and len(lines) == 6
    assert len(text.splitlines()) == 5 and "coral p (mosaic): a point" in text
    json.dumps(data, allow_nan=False)
    with pytest.raises(ConfigError, match="one by one"):
        table(reef, each=True, side=0.5)


def test_without_an_elevation_model_areas_in_plan_are_left(reef: Path) -> None:
    (reef / "dense" / "dem.tif").unlink()
    text, data = table(reef)
    assert data["rows"][0]["surface"] is None and data["rows"][0]["area"] == pytest.approx(0.05)
    assert "without a surface" in text
