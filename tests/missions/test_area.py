import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from alice_survey.config import AreaConfig, parse_config
from alice_survey.errors import AliceError, PlanError
from missions.areas.shapes import area_datum, area_polygon, polygon_corners


def test_a_rectangle_lies_ahead_and_to_the_right_of_the_datum() -> None:
    polygon = area_polygon(AreaConfig(length_m=15.0, width_m=17.0, heading_deg=0.0))
    np.testing.assert_allclose(
        polygon_corners(polygon), [[0, 0], [15, 0], [15, 17], [0, 17]], atol=1e-12
    )

    east = area_polygon(AreaConfig(length_m=3.0, width_m=2.0, heading_deg=90.0))
    np.testing.assert_allclose(
        polygon_corners(east), [[0, 0], [0, 3], [-2, 3], [-2, 0]], atol=1e-12
    )


@given(
    length_m=st.floats(0.1, 1000),
    width_m=st.floats(0.1, 1000),
    heading_deg=st.floats(0, 360, exclude_max=True),
)
def test_a_rectangle_keeps_its_size_whatever_its_heading(
    length_m: float, width_m: float, heading_deg: float
) -> None:
    polygon = area_polygon(AreaConfig(length_m=length_m, width_m=width_m, heading_deg=heading_deg))
    assert polygon.area == pytest.approx(length_m * width_m)
    corners = polygon_corners(polygon)
    assert math.dist(corners[0], corners[1]) == pytest.approx(length_m)
    assert corners[0].tolist() == [0.0, 0.0]


def test_corners_in_latitude_and_longitude_come_back_from_the_sea_floor() -> None:
    local = AreaConfig(polygon_ne_m=((0, 0), (30, 5), (20, 40), (-10, 25)), seafloor_depth_m=40.0)
    corners = polygon_corners(area_polygon(local))
    geodetic = area_datum(local).geodetic_from_ned(np.column_stack([corners, np.full(4, 40.0)]))

    polygon = area_polygon(
        AreaConfig(
            polygon_latlon_deg=tuple((lat, lon) for lat, lon, _ in geodetic.tolist()),
            seafloor_depth_m=40.0,
        )
    )

    np.testing.assert_allclose(polygon_corners(polygon), corners, atol=1e-6)


def test_repeated_corners_are_left_out() -> None:
    polygon = area_polygon(AreaConfig(polygon_ne_m=((0, 0), (0, 0), (4, 0), (4, 3), (0, 0))))
    assert polygon_corners(polygon).tolist() == [[0, 0], [4, 0], [4, 3]]


@pytest.mark.parametrize(
    ("corners", "words"),
    [
        (((0, 0), (10, 10), (10, 0), (0, 10)), "edges cross near north 5.00 m, east 5.00 m"),
        (((0, 0), (0, 0), (1, 1)), "2 distinct corners"),
        (((1, 1), (1, 1), (1, 1)), "distinct corner"),
        (((0, 0), (5, 5), (10, 10)), "no size"),
        (((0, 0), (0, 1e-5), (1e-5, 0)), "distinct corner"),
        (((0, 0), (10, 0), (10, 1e6)), "corner 3 is 1000 km from the datum"),
    ],
)
def test_a_faulty_polygon_is_refused_with_its_place(
    corners: tuple[tuple[float, float], ...], words: str
) -> None:
    with pytest.raises(PlanError) as fault:
        area_polygon(AreaConfig(polygon_ne_m=corners))
    assert words in str(fault.value)
    assert "\n" not in str(fault.value)


def test_a_polygon_far_from_its_datum_is_refused() -> None:
    corners = ((10.0, 20.0), (10.0, 20.001), (10.001, 20.0))
    with pytest.raises(PlanError, match="km from the datum"):
        area_polygon(AreaConfig(polygon_latlon_deg=corners))


@pytest.mark.parametrize(
    ("area", "words"),
    [
        ({"polygon_ne_m": [[0, 0], [1, 1]]}, "3 corners"),
        ({"length_m": 0}, "length_m = 0"),
        ({"polygon_ne_m": [[0, 0], [1, float("nan")], [2, 0]]}, "nan"),
        ({"polygon_latlon_deg": [[95, 0], [1, 1], [2, 0]]}, "95"),
        (
            {
                "polygon_ne_m": [[0, 0], [1, 1], [2, 0]],
                "polygon_latlon_deg": [[0, 0], [1, 1], [2, 0]],
            },
            "not both",
        ),
    ],
)
def test_settings_refuse_areas_that_cannot_be(area: dict[str, object], words: str) -> None:
    with pytest.raises(AliceError) as fault:
        parse_config({"area": area}, "survey.toml")
    assert words in str(fault.value)
    assert "\n" not in str(fault.value)
