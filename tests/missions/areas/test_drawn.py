"""Shapes drawn into settings and files, and read back."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alice_survey.core.config import AreaConfig
from alice_survey.core.errors import PlanError, collected_by
from missions.areas.drawn import (
    FILES,
    DrawnPolygon,
    DrawnShapes,
    area_drawing,
    area_settings,
    drawing_of_file,
)
from missions.areas.survey import survey_area

SQUARE = DrawnPolygon(outer=((0, 0), (10, 0), (10, 10), (0, 10)))
HOLED = DrawnPolygon(outer=SQUARE.outer, holes=(((4, 4), (6, 4), (6, 6)),))
ZONE = DrawnPolygon(outer=((2, 2), (3, 2), (3, 3)))


def places() -> st.SearchStrategy[tuple[float, float]]:
    metres = st.floats(-400, 400).map(lambda x: round(x, 4))
    return st.tuples(metres, metres)


def polygons() -> st.SearchStrategy[DrawnPolygon]:
    ring = st.lists(places(), min_size=3, max_size=7, unique=True).map(tuple)
    return st.builds(DrawnPolygon, outer=ring, holes=st.lists(ring, max_size=2).map(tuple))


def drawings() -> st.SearchStrategy[DrawnShapes]:
    many = st.lists(polygons(), max_size=3).map(tuple)
    lines = st.lists(st.lists(places(), min_size=2, max_size=4, unique=True).map(tuple), max_size=2)
    return st.builds(DrawnShapes, survey=many, no_go=many, allowed=many, corridors=lines.map(tuple))


def drawn(shapes: DrawnShapes, before: AreaConfig, folder: Path) -> AreaConfig:
    """Settings with shapes drawn, their files written and named by their paths."""
    values, files = area_settings(shapes, before)
    for name, text in files.items():
        (folder / name).write_text(text)
    kept = before.model_dump(exclude_unset=True) | values
    named = [key for key, value in kept.items() if isinstance(value, str) and value in files]
    found = kept | {key: folder / kept[key] for key in named}
    return AreaConfig.model_validate({k: v for k, v in found.items() if v is not None})


def assert_same(one: DrawnShapes, other: DrawnShapes, within_m: float) -> None:
    for role in ("survey", "no_go", "allowed"):
        rings = [[p.rings for p in getattr(shapes, role)] for shapes in (one, other)]
        flat = [[ring for polygon in polygons for ring in polygon] for polygons in rings]
        assert [len(ring) for ring in flat[0]] == [len(ring) for ring in flat[1]]
        for a, b in zip(*flat, strict=True):
            np.testing.assert_allclose(a, b, atol=within_m, rtol=0)
    for a, b in zip(one.corridors, other.corridors, strict=True):
        np.testing.assert_allclose(a, b, atol=within_m, rtol=0)


@settings(max_examples=40, deadline=None)
@given(shapes=drawings(), lat=st.sampled_from([None, -41.5, 32.8]), depth_m=st.floats(1, 500))
def test_shapes_are_read_back_to_a_millimetre(
    tmp_path_factory: pytest.TempPathFactory, shapes: DrawnShapes, lat: Any, depth_m: float
) -> None:
    folder = tmp_path_factory.mktemp("drawn")
    datum = {} if lat is None else {"latitude_deg": lat, "longitude_deg": 12.0}
    before = AreaConfig(seafloor_depth_m=depth_m, **datum)
    if not (shapes.survey or shapes.corridors):
        with pytest.raises(PlanError, match="nothing is drawn"):
            area_settings(shapes, before)
        return
    with collected_by(lambda *_: None):
        after = drawn(shapes, before, folder)
        again = area_drawing(after)
        assert_same(again.shapes, shapes, 5e-4)
        assert again.datum == area_drawing(before).datum
        assert area_settings(again.shapes, after) == ({}, {})


def test_settings_hold_what_they_can() -> None:
    plain = DrawnShapes(survey=(SQUARE,), no_go=(ZONE, ZONE), allowed=(SQUARE,))
    values, files = area_settings(plain, AreaConfig())
    assert not files
    assert values["polygon_ne_m"] == [[0, 0], [10, 0], [10, 10], [0, 10]]
    assert values["no_go_ne_m"] == 2 * [[[2, 2], [3, 2], [3, 3]]]
    assert values["allowed_ne_m"] == values["polygon_ne_m"]

    line = DrawnShapes(corridors=(((0, 0), (20, 5)),))
    values, files = area_settings(line, AreaConfig(polygon_ne_m=SQUARE.outer))
    assert not files
    assert values == {"polygon_ne_m": None, "corridor_ne_m": [[0, 0], [20, 5]]}


def test_files_hold_holes_and_parts_and_pin_the_datum(tmp_path: Path) -> None:
    parts = DrawnShapes(survey=(HOLED,), allowed=(SQUARE, ZONE))
    values, files = area_settings(parts, AreaConfig())
    assert values["file"] == FILES["survey"] and values["allowed_file"] == FILES["allowed"]
    assert (values["latitude_deg"], values["longitude_deg"]) == (32.8236, 34.9553)
    assert files.keys() == {FILES["survey"], FILES["allowed"]}

    after = drawn(DrawnShapes(survey=(HOLED,), no_go=(ZONE,)), AreaConfig(), tmp_path)
    area = survey_area(after, turn_margin_m=2.0)
    assert area.survey.area == pytest.approx(100.0 - 2.0 - 0.5, abs=1e-3)
    assert area.survey.bounds == pytest.approx((0, 0, 10, 10), abs=1e-4)
    assert area.no_go.area == pytest.approx(2.5, abs=1e-3)


def test_unchanged_roles_keep_their_settings_and_files(tmp_path: Path) -> None:
    file = tmp_path / "reef.wkt"
    file.write_text("SRID=32636;POLYGON ((683000 3633000, 683050 3633000, 683050 3633030))")
    before = AreaConfig(file=file, crs="EPSG:32636")
    now = area_drawing(before)
    assert area_settings(now.shapes, before) == ({}, {})
    rounded = [
        DrawnPolygon(outer=tuple((round(n, 3), round(e, 3)) for n, e in p.outer))
        for p in now.shapes.survey
    ]
    assert area_settings(now.shapes.model_copy(update={"survey": rounded}), before) == ({}, {})

    # A zone alone is drawn: the file stays, and its middle is set as the datum that zones count to.
    values, files = area_settings(now.shapes.model_copy(update={"no_go": (ZONE,)}), before)
    assert values.keys() == {"no_go_ne_m", "latitude_deg", "longitude_deg"} and not files
    assert values["latitude_deg"] == now.datum.latitude_deg


def test_marks_that_cannot_be_drawn_are_carried_over(tmp_path: Path) -> None:
    file = tmp_path / "wrecks.geojson"
    file.write_text(
        '{"type": "GeometryCollection", "geometries": ['
        '{"type": "Point", "coordinates": [34.95535, 32.82365]},'
        '{"type": "LineString", "coordinates": [[34.9554, 32.8237], [34.95545, 32.8237]]}]}'
    )
    datum = {"latitude_deg": 32.8236, "longitude_deg": 34.9553}
    before = AreaConfig(no_go_file=file, no_go_clearance_m=1.0, **datum)
    shapes = area_drawing(before).shapes.model_copy(update={"no_go": (ZONE,)})
    after = drawn(shapes, before, tmp_path)
    assert after.no_go_file == tmp_path / FILES["no_go"]
    zones = [survey_area(one, turn_margin_m=2.0).no_go for one in (before, after)]
    assert zones[0].difference(zones[1].buffer(1e-3)).is_empty
    assert zones[1].area > zones[0].area + 1.0


@pytest.mark.parametrize("corner", [(1e6, 0.0), (3e4, 0.0), (0.0, -2.1e4)])
def test_corners_out_of_reach_are_refused(corner: tuple[float, float]) -> None:
    far = DrawnPolygon(outer=(*SQUARE.outer, corner), holes=(ZONE.outer,))
    with pytest.raises(PlanError, match="km from the datum"):
        area_settings(DrawnShapes(survey=(far,)), AreaConfig())


def test_a_dropped_file_counts_to_the_datum_or_to_its_middle(tmp_path: Path) -> None:
    file = tmp_path / "reef.geojson"
    file.write_text(
        '{"type": "Polygon", "coordinates": [[[35.0, 33.0], [35.001, 33.0], [35.001, 33.001]]]}'
    )
    with pytest.raises(PlanError, match="km from the datum"):
        drawing_of_file(file, AreaConfig(), datum=area_drawing(AreaConfig()).datum)
    found = drawing_of_file(file, AreaConfig(), datum=None)
    assert (found.datum.latitude_deg, found.datum.longitude_deg) == (33.0005, 35.0005)
    (polygon,) = found.shapes.survey
    assert np.abs(polygon.outer).max() < 60.0
    zone = drawing_of_file(file, AreaConfig(), role="no_go", datum=found.datum).shapes
    assert zone.no_go == (polygon,) and not zone.survey
