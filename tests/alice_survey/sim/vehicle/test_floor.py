"""The sea floor under the vehicle: depths and beams against closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.sea import FloorGrid, floor_depth, floor_range, level_floor


def tilted(at_origin: float, per_north: float, per_east: float) -> FloorGrid:
    """A plane of depths over -50 to 50 m, which bilinear cells hold exactly."""
    places = np.arange(-50.0, 50.5, 0.5)
    depth = at_origin + per_north * places[:, None] + per_east * places[None, :]
    return FloorGrid(-50.0, -50.0, 0.5, depth)


def unit(vector: Array) -> Array:
    result: Array = vector / np.linalg.norm(vector)
    return result


def test_depths_at_nodes_between_them_and_beyond_the_edges() -> None:
    """Rows go north, columns east; the value in the middle of a cell is the mean of its corners."""
    floor = FloorGrid(10.0, -4.0, 2.0, np.array([[1.0, 2.0, 3.0], [5.0, 7.0, 8.0]]))
    for i in range(2):
        for j in range(3):
            assert floor_depth(floor, 10.0 + 2 * i, -4.0 + 2 * j) == floor.depth_m[i, j]
    assert floor_depth(floor, 11.0, -3.0) == (1.0 + 2.0 + 5.0 + 7.0) / 4
    assert floor_depth(floor, 10.5, -4.0) == 2.0
    assert floor_depth(floor, -99.0, -99.0) == 1.0
    assert floor_depth(floor, 99.0, 99.0) == 8.0
    assert floor_depth(floor, 99.0, -3.0) == 6.0
    assert floor_depth(level_floor(7.5), 1e6, -1e6) == 7.5


@settings(deadline=None)
@given(
    place=st.tuples(st.floats(-20.0, 20.0), st.floats(-20.0, 20.0)),
    altitude=st.floats(0.05, 8.0),
    slopes=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
    lean=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
)
def test_range_along_a_beam_to_a_slope(
    place: tuple[float, float],
    altitude: float,
    slopes: tuple[float, float],
    lean: tuple[float, float],
) -> None:
    """Closed form: the altitude straight down, over how fast the beam gains on the floor."""
    floor = tilted(40.0, *slopes)
    north, east = place
    depth = 40.0 + slopes[0] * north + slopes[1] * east - altitude
    beam = unit(np.array([*lean, 1.0]))
    gaining = beam[2] - slopes[0] * beam[0] - slopes[1] * beam[1]
    expected = altitude / gaining
    found = floor_range(floor, north, east, depth, beam[0], beam[1], beam[2], 30.0)
    if expected < 29.9:
        assert found == pytest.approx(expected, abs=1e-6)
    elif expected > 30.1:
        assert math.isnan(found)


def test_a_beam_ends_on_the_near_side_of_a_ridge() -> None:
    """A ridge 2 m high, 4 m wide at its foot, sides of 45 degrees, in front of a level floor: a
    beam that would meet the ridge, leave it and meet the floor beyond ends on the near side."""
    north = np.arange(0.0, 40.0, 0.25)
    ridge = 10.0 - np.clip(2.0 - np.abs(north - 10.0), 0.0, None)
    floor = FloorGrid(0.0, 0.0, 0.25, np.tile(ridge[:, None], (1, 5)))
    # From (2, 9 m deep), falling 1 in 40: at north x its depth is 9 + (x - 2) / 40; the near side
    # has the depth 18 - x there.
    beam = unit(np.array([1.0, 0.0, 1.0 / 40.0]))
    meets = (18.0 - 9.0 + 2.0 / 40.0) / (1.0 + 1.0 / 40.0)
    expected = (meets - 2.0) / beam[0]
    found = floor_range(floor, 2.0, 0.5, 9.0, beam[0], beam[1], beam[2], 60.0)
    assert found == pytest.approx(expected, abs=1e-6)
    beyond = floor_range(level_floor(10.0), 2.0, 0.5, 9.0, beam[0], beam[1], beam[2], 60.0)
    assert beyond == pytest.approx(1.0 / beam[2], abs=1e-6)


@settings(deadline=None)
@given(
    north=st.floats(-49.0, 49.0),
    east=st.floats(-49.0, 49.0),
    slopes=st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
)
def test_depths_of_a_plane(north: float, east: float, slopes: tuple[float, float]) -> None:
    depth = floor_depth(tilted(20.0, *slopes), north, east)
    assert depth == pytest.approx(20.0 + slopes[0] * north + slopes[1] * east, abs=1e-9)


def test_no_echo_is_nan() -> None:
    floor = level_floor(10.0)
    assert floor_range(floor, 0.0, 0.0, 8.0, 0.0, 0.0, 1.0, 5.0) == pytest.approx(2.0, abs=1e-6)
    assert math.isnan(floor_range(floor, 0.0, 0.0, 8.0, 0.0, 0.0, 1.0, 1.9))  # too far
    assert math.isnan(floor_range(floor, 0.0, 0.0, 8.0, 1.0, 0.0, 0.0, 50.0))  # level
    assert math.isnan(floor_range(floor, 0.0, 0.0, 8.0, 0.0, 0.0, -1.0, 50.0))  # upwards
    assert math.isnan(floor_range(floor, 0.0, 0.0, 10.1, 0.0, 0.0, 1.0, 50.0))  # below the floor
    assert math.isnan(floor_range(floor, 0.0, 0.0, 10.0, 0.0, 0.0, 1.0, 50.0))  # on the floor
