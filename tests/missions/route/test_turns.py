import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alice_survey.errors import PlanError
from missions.lines.line import Line
from missions.route.dubins import turn
from missions.route.legs import Leg
from missions.route.turns import route_through

places = st.tuples(st.floats(-10, 10), st.floats(-10, 10))
angles = st.floats(-math.pi, math.pi)


def line(start: tuple[float, float], end: tuple[float, float]) -> Line:
    return Line(kind="survey", start_ne_m=start, end_ne_m=end, stations=5)


def length(legs: list[Leg]) -> float:
    return sum(leg.length_m for leg in legs)


@settings(deadline=None, max_examples=200)
@given(start=places, goal=places, first=angles, last=angles, radius_m=st.floats(0.2, 3.0))
def test_a_turn_arrives_without_a_gap_or_a_kink(
    start: tuple[float, float],
    goal: tuple[float, float],
    first: float,
    last: float,
    radius_m: float,
) -> None:
    legs = turn(start, first, goal, last, radius_m)

    assert legs[0].start_ne_m == start
    assert legs[0].heading_rad == first
    for before, after in pairwise(legs):
        assert math.dist(before.end_ne_m, after.start_ne_m) < 1e-9
        assert math.cos(before.end_heading_rad - after.heading_rad) > 1 - 1e-12
    assert math.dist(legs[-1].end_ne_m, goal) < 1e-5
    assert math.cos(legs[-1].end_heading_rad - last) > 1 - 1e-9
    assert all(abs(leg.curvature_per_m) <= 1 / radius_m * (1 + 1e-12) for leg in legs)
    assert length(legs) >= math.dist(start, goal) - 1e-9


@settings(deadline=None, max_examples=60)
@given(start=places, goal=places, first=angles, last=angles)
def test_a_turn_is_as_long_either_way_round(
    start: tuple[float, float], goal: tuple[float, float], first: float, last: float
) -> None:
    there = length(turn(start, first, goal, last, 1.0))
    back = length(turn(goal, last + math.pi, start, first + math.pi, 1.0))
    assert there == pytest.approx(back, abs=1e-5)


@settings(deadline=None, max_examples=60)
@given(start=places, goal=places, first=angles, last=angles)
def test_no_path_of_straights_and_arcs_by_trial_is_shorter(
    start: tuple[float, float], goal: tuple[float, float], first: float, last: float
) -> None:
    """Slow twin: tangents of every pair of turning circles, by geometry in the plane."""
    best = math.inf
    for one in (1, -1):
        for two in (1, -1):
            c1 = np.array(start) + one * np.array([-math.sin(first), math.cos(first)])
            c2 = np.array(goal) + two * np.array([-math.sin(last), math.cos(last)])
            apart, bearing = math.dist(c1, c2), math.atan2(*(c2 - c1)[::-1])
            if one == two:
                course, straight = bearing, apart
            elif apart >= 2:
                course = bearing + one * math.asin(2 / apart)
                straight = math.sqrt(apart**2 - 4)
            else:
                continue
            arcs = (one * (course - first)) % (2 * math.pi) + (two * (last - course)) % (
                2 * math.pi
            )
            best = min(best, arcs + straight)

    assert length(turn(start, first, goal, last, 1.0)) <= best + 1e-5


def test_known_turns() -> None:
    u_turn = turn((0.0, 0.0), 0.0, (0.0, 1.0), math.pi, 0.5)
    assert length(u_turn) == pytest.approx(math.pi / 2)

    ahead = turn((0.0, 0.0), 0.3, (math.cos(0.3), math.sin(0.3)), 0.3, 0.5)
    assert length(ahead) == pytest.approx(1.0)

    wide = turn((0.0, 0.0), 0.0, (0.0, 5.0), math.pi, 0.5)
    assert length(wide) == pytest.approx(math.pi / 2 + 4.0)

    # Too close for a U-turn: out, round and back, a bulb of three arcs.
    bulb = turn((0.0, 0.0), 0.0, (0.0, 0.6), math.pi, 0.5)
    swing = math.acos((1 + 0.6) / 2)
    assert length(bulb) == pytest.approx(0.5 * (math.pi + 4 * swing))


def test_a_route_is_continuous_and_keeps_its_lines() -> None:
    lines = [
        line((0.0, 0.0), (0.0, 5.0)),
        line((1.0, 5.0), (1.0, 0.0)),
        line((1.6, 0.0), (1.6, 5.0)),
    ]
    route = route_through(lines, 0.5, 0.5)

    along = np.linspace(0.0, route.length_m, 20_001)
    places_ne = route.places(along)
    steps = np.linalg.norm(np.diff(places_ne, axis=0), axis=1)
    assert np.abs(steps / np.diff(along) - 1).max() < 1e-4
    headings = np.unwrap(route.headings_rad(along))
    assert np.abs(np.diff(headings) / np.diff(along)).max() <= 2.0 * (1 + 1e-6)

    starts = route.line_starts_m()
    assert list(starts) == [0, 1, 2]
    for index, start_m in starts.items():
        on_line = route.places(start_m + np.linspace(0.0, 5.0, 11))
        expected = np.linspace(lines[index].start_ne_m, lines[index].end_ne_m, 11)
        np.testing.assert_allclose(on_line, expected, atol=1e-5)
        run_in = route.places(np.array([start_m - 0.5]))[0]
        ahead = np.subtract(lines[index].end_ne_m, lines[index].start_ne_m) / 5.0
        np.testing.assert_allclose(run_in, lines[index].start_ne_m - 0.5 * ahead, atol=1e-5)


def test_a_route_goes_on_straight_beyond_its_ends() -> None:
    route = route_through([line((0.0, 0.0), (3.0, 0.0))], 0.5, 0.5)
    assert route.length_m == pytest.approx(4.0)
    np.testing.assert_allclose(
        route.places(np.array([-1.0, 0.0, 5.0])), [[-1.5, 0], [-0.5, 0], [4.5, 0]], atol=1e-12
    )


def test_parts_of_one_line_are_joined_straight() -> None:
    parts = [line((0.0, 0.0), (3.0, 0.0)), line((3.6, 0.0), (8.0, 0.0))]
    route = route_through(parts, 0.5, 0.5)

    assert route.length_m == pytest.approx(8.0 + 2 * 0.5)
    assert all(leg.curvature_per_m == 0 for leg in route.legs)


def test_without_lines_there_is_no_route() -> None:
    with pytest.raises(PlanError, match="no line"):
        route_through([], 0.5, 0.5)
