import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from shapely.geometry import Polygon

from alice_survey.core.config import AreaConfig
from alice_survey.core.errors import PlanError
from alice_survey.core.frames import Datum
from missions.areas.survey import survey_area
from missions.values.area import Area
from tests.missions.areas.sites import area_of

SQUARE = ((0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 10.0))
RING = {"polygon_latlon_deg": ((10.0, 20.0), (10.0, 20.001), (10.001, 20.0))}


def corners_ne(area: Area) -> np.ndarray:
    (polygon,) = area.survey.geoms
    return np.asarray(polygon.exterior.coords)[:-1]


def square(north: float, east: float, side: float) -> tuple[tuple[float, float], ...]:
    return tuple((north + a * side, east + b * side) for a, b in ((0, 0), (1, 0), (1, 1), (0, 1)))


@given(
    length_m=st.floats(0.1, 1000),
    width_m=st.floats(0.1, 1000),
    heading_deg=st.floats(0, 360, exclude_max=True),
)
def test_a_rectangle_keeps_its_size_whatever_its_heading(
    length_m: float, width_m: float, heading_deg: float
) -> None:
    area = area_of(length_m=length_m, width_m=width_m, heading_deg=heading_deg)
    assert area.survey.area == pytest.approx(length_m * width_m)
    corners = corners_ne(area)
    side = corners[1] - corners[0]
    assert np.linalg.norm(side) == pytest.approx(length_m)
    heading = math.radians(heading_deg)
    assert side / length_m == pytest.approx([math.cos(heading), math.sin(heading)], abs=1e-9)
    np.testing.assert_allclose(corners[0], 0.0, atol=1e-9 * (length_m + width_m))


def test_the_allowed_area_is_a_turn_margin_larger_without_the_no_go_zones() -> None:
    area = area_of(polygon_ne_m=SQUARE, no_go_ne_m=(square(4, 4, 2), square(11, 11, 1)))
    assert area.survey.area == pytest.approx(100 - 4)
    assert area.allowed.area == pytest.approx(16**2 - 4 - 1)
    assert area.no_go.area == pytest.approx(5)
    wider = area_of(polygon_ne_m=SQUARE, turn_margin_m=5.0)
    assert wider.allowed.area == pytest.approx(20**2)


def test_a_clearance_widens_the_no_go_zones_everywhere() -> None:
    area = area_of(polygon_ne_m=SQUARE, no_go_ne_m=(square(4, 4, 2),), no_go_clearance_m=1.5)
    assert area.no_go.area == pytest.approx(25)
    assert area.survey.area == pytest.approx(100 - 25)
    assert area.survey.distance(Polygon(square(4, 4, 2))) == pytest.approx(1.5)
    hole = "POLYGON ((0 0, 10 0, 10 10, 0 10, 0 0), (4 4, 6 4, 6 6, 4 6, 4 4))"
    assert area_of(wkt=hole, no_go_clearance_m=1.5).survey.equals(area.survey)


def test_a_margin_widens_the_area_to_survey_but_no_hole() -> None:
    settings = AreaConfig(polygon_ne_m=SQUARE, no_go_ne_m=(square(4, 4, 2), square(10, 0, 2)))
    area = survey_area(settings, turn_margin_m=3.0, margin_m=1.0)
    assert area.survey.area == pytest.approx(12**2 - 4 - 2)
    assert area.allowed.area == pytest.approx(18**2 - 4 - 4)


@given(angle_deg=st.floats(5, 175), margin_m=st.floats(0.1, 20))
def test_margins_reach_everywhere_and_run_away_nowhere(angle_deg: float, margin_m: float) -> None:
    tip = math.radians(angle_deg) / 2
    triangle = ((0.0, 0.0), *((30 * math.cos(a), 30 * math.sin(a)) for a in (-tip, tip)))
    settings = AreaConfig(polygon_ne_m=triangle)
    area = survey_area(settings, turn_margin_m=margin_m)
    disc = area.survey.buffer(margin_m * (1 - 1e-9))
    assert disc.difference(area.allowed).area < 1e-6 * area.allowed.area
    corners = shapely.points(shapely.get_coordinates(area.allowed))
    farthest = shapely.distance(corners, area.survey).max()
    # 1 / sin 30 degrees = 2 along the bisector; a corner cut there is sqrt(5) off at the most.
    assert margin_m * (1 - 1e-9) <= farthest <= margin_m * math.sqrt(5) * (1 + 1e-9)


def test_a_corridor_has_its_width_flat_ends_and_goes_round() -> None:
    line = area_of(corridor_ne_m=((0, 0), (30, 0)), corridor_width_m=4.0)
    assert line.survey.bounds == pytest.approx((0, -2, 30, 2))
    bent = area_of(corridor_ne_m=((0, 0), (30, 0), (30, 20)), corridor_width_m=4.0)
    assert bent.survey.area == pytest.approx(4 * 50)
    ring = area_of(corridor_ne_m=(*square(0, 0, 20), (0, 0)), corridor_width_m=2.0)
    assert ring.survey.area == pytest.approx(22**2 - 18**2)
    # What a corridor goes round is not a zone to keep out of.
    assert ring.no_go.is_empty


def test_wkt_without_crs_is_local_with_east_first() -> None:
    area = area_of(wkt="POLYGON Z ((0 0 7, 30 0 7, 30 20 7, 0 20 7, 0 0 7))")
    assert area.survey.bounds == pytest.approx((0, 0, 20, 30))
    assert area.datum == Datum(32.8236, 34.9553)


def test_parts_holes_and_islands() -> None:
    wkt = (
        "MULTIPOLYGON (((0 0, 30 0, 30 30, 0 30, 0 0), (5 5, 25 5, 25 25, 5 25, 5 5)),"
        "((10 10, 15 10, 15 15, 10 15, 10 10)))"
    )
    area = area_of(wkt=wkt)
    assert area.survey.area == pytest.approx(900 - 400 + 25)
    assert len(area.survey.geoms) == 2
    # The island in the hole is to be surveyed, so it is not a zone to keep out of.
    assert area.no_go.area == pytest.approx(400 - 25)


def test_parts_join_where_their_margins_meet() -> None:
    wkt = "MULTIPOLYGON (((0 0,10 0,10 10,0 10,0 0)),((30 0,40 0,40 10,30 10,30 0)))"
    assert len(area_of(wkt=wkt).allowed.geoms) == 2
    assert len(area_of(wkt=wkt, turn_margin_m=9.99).allowed.geoms) == 2
    assert len(area_of(wkt=wkt, turn_margin_m=3.0 + 7.0).allowed.geoms) == 1


def test_an_allowed_area_may_leave_out_some_but_not_all(capsys: pytest.CaptureFixture[str]) -> None:
    area = area_of(polygon_ne_m=SQUARE, allowed_ne_m=((-5, -5), (5, -5), (5, 15), (-5, 15)))
    warning = capsys.readouterr().err
    assert "50.00%" in warning
    assert "north 7.50 m, east 5.00 m" in warning
    assert area.allowed.area == pytest.approx(200)
    assert area.survey.area == pytest.approx(100)
    area_of(polygon_ne_m=SQUARE, allowed_ne_m=square(-5, -5, 20), turn_margin_m=2.0)
    assert "turn_margin_m" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"corridor_ne_m": ((3, 4), (3, 4.0001))}, "corridor_ne_m"),
        ({"polygon_ne_m": SQUARE, "no_go_ne_m": (square(-1, -1, 12),)}, "no_go_ne_m"),
        ({"polygon_ne_m": SQUARE, "allowed_ne_m": square(50, 0, 10)}, "40 m"),
        ({"polygon_ne_m": SQUARE, "allowed_ne_m": ()}, "allowed_ne_m: 0 distinct corners"),
        ({**RING, "latitude_deg": 10.0}, "longitude_deg"),
        ({**RING, "latitude_deg": 32.0, "longitude_deg": 34.0}, r"1 at \(10, 20\) is \d+ km"),
        # Latitude and longitude are swapped.
        ({**RING, "latitude_deg": 20.0, "longitude_deg": 10.0}, r"2 at \(10, 20\.001\) is \d+ km"),
        ({"polygon_latlon_deg": ((10, 20), (10, 21), (11, 20))}, r"corner \d at .* km"),
        ({"polygon_ne_m": ((0, 0), (10, 0), (10, 1e6))}, r"corner 3 .* is 1000 km"),
    ],
)
def test_areas_with_nothing_left_or_far_from_their_datum_are_refused(
    settings: dict[str, Any], named: str
) -> None:
    with pytest.raises(PlanError, match=named):
        area_of(**settings)


@pytest.mark.parametrize("text", ["POINT (5 5)", "LINESTRING (-5 15, 15 -5)"])
def test_marks_are_zones_as_wide_as_the_clearance(text: str, tmp_path: Path) -> None:
    file = tmp_path / "wreck.wkt"
    file.write_text(text)
    area = area_of(polygon_ne_m=SQUARE, no_go_file=file, no_go_clearance_m=2.0)
    mark = shapely.from_wkt(text)
    assert area.no_go.distance(mark) == 0
    assert area.allowed.distance(mark) == pytest.approx(2.0, rel=0.01)
    with pytest.raises(PlanError, match="no_go_clearance_m"):
        area_of(polygon_ne_m=SQUARE, no_go_file=file)


def test_corners_in_latitude_and_longitude_come_back_from_the_sea_floor() -> None:
    local = AreaConfig(polygon_ne_m=((0, 0), (30, 5), (20, 40), (-10, 25)), seafloor_depth_m=40.0)
    area = survey_area(local, turn_margin_m=3.0)
    corners = corners_ne(area)
    geodetic = area.datum.geodetic_from_ned(np.column_stack([corners, np.full(4, 40.0)]))
    datum = {"latitude_deg": 32.8236, "longitude_deg": 34.9553, "seafloor_depth_m": 40.0}
    again = area_of(polygon_latlon_deg=geodetic[:, :2].tolist(), **datum)
    np.testing.assert_allclose(corners_ne(again), corners, atol=1e-6)


def test_without_a_datum_that_of_a_geographic_shape_is_its_middle(
    capsys: pytest.CaptureFixture[str],
) -> None:
    ring = ((10.0, 20.0), (10.0, 20.001), (10.0010002, 20.0))
    area = area_of(polygon_latlon_deg=ring, no_go_ne_m=(square(-40, -40, 5),))
    assert area.datum == Datum(10.0005, 20.0005)
    assert "no_go_ne_m" in capsys.readouterr().err
    given = area_of(polygon_latlon_deg=ring, latitude_deg=10.0, longitude_deg=20.0)
    assert given.datum == Datum(10.0, 20.0)
    assert given.survey.area == pytest.approx(area.survey.area + 25, rel=1e-6)


LOOP = "LINESTRING (0 0, 20 0, 20 10, 0 10, {})"


@pytest.mark.parametrize("end", ["0 0", "0 0.5"])
def test_what_a_closed_line_encloses_is_surveyed_on_request(
    end: str, capsys: pytest.CaptureFixture[str]
) -> None:
    strip = area_of(wkt=LOOP.format(end)).survey.area
    said = capsys.readouterr().err
    assert "corridor of 5 m" in said and "closed_lines = 'inside'" in said
    assert strip == pytest.approx(5.0 * 60.0, rel=0.1)
    inside = area_of(wkt=LOOP.format(end), closed_lines="inside").survey
    assert inside.area == pytest.approx(200.0, abs=0.1)
    assert area_of(wkt=LOOP.format(end), closed_lines="corridor").survey.area == strip
    assert not capsys.readouterr().err
