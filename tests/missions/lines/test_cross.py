import itertools
import math

import numpy as np
import pytest
import shapely
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components
from shapely.geometry import MultiPolygon, Polygon, box

from missions.lines.cross import MIN_STEPS, stabs
from missions.values.line import Line
from missions.values.pattern import Pattern
from tests.oracles_lines import PATTERNS, STEREO, area_of, areas, as_string, lay

ARMS = Polygon([(0, 0), (30, 0), (30, 12), (14, 12), (14, 26), (0, 26)])
HOLES = Polygon([(6, 6), (10, 5), (11, 9), (7, 10)]), box(20, 3, 23, 7)


def of_kind(lines: list[Line], kind: str) -> list[Line]:
    return [line for line in lines if line.kind == kind]


def next_to(a: Line, b: Line, spacing_m: float) -> bool:
    """Whether survey lines lie side by side, one spacing apart, for more than a point."""
    one, two = as_string(a), as_string(b)
    beside = one.buffer(1.01 * spacing_m, cap_style="flat")
    return abs(one.distance(two) - spacing_m) < 1e-6 and two.intersection(beside).length > 1e-6


@settings(deadline=None, max_examples=60)
@given(
    survey=areas,
    heading=st.floats(0, math.pi),
    pattern=st.sampled_from(PATTERNS),
    cross_lines=st.integers(0, 3),
)
def test_every_survey_line_with_a_neighbour_is_crossed(
    survey: MultiPolygon, heading: float, pattern: Pattern, cross_lines: int
) -> None:
    assume(survey.area > 0.3 and len(area_of(survey).allowed.geoms) == 1)
    lines = lay(survey, heading, pattern, cross_lines=cross_lines, closing_line=False)
    crossing, grid = of_kind(lines, "cross"), of_kind(lines, "survey")
    if cross_lines == 0:
        assert not crossing
        return
    for line in grid:
        if line.stations - 1 < MIN_STEPS:
            continue
        if any(next_to(line, other, pattern.spacing_m) for other in grid):
            assert any(as_string(line).distance(as_string(x)) < 1e-6 for x in crossing)
    for line in crossing:
        turn = math.cos(line.heading_rad - heading)
        assert abs(turn) < 1e-9
        assert any(as_string(line).distance(as_string(x)) < 1e-6 for x in grid)


@pytest.mark.parametrize("heading", [0.0, 0.4, math.pi / 2])
def test_all_arms_of_an_area_are_tied_together(heading: float) -> None:
    """Lines that cross one another are one net; one cross line left an arm of this area out."""
    survey = ARMS.difference(HOLES[0]).difference(HOLES[1])
    lines = lay(survey, heading, closing_line=False)
    grid, crossing = of_kind(lines, "survey"), of_kind(lines, "cross")
    strings = np.array([as_string(line) for line in (*grid, *crossing)])
    nets, _ = connected_components(shapely.distance(strings[:, None], strings) < 1e-6)
    assert nets == 1
    assert len(crossing) <= 5


def test_a_rectangle_has_the_requested_cross_lines_evenly() -> None:
    for count in (1, 2, 4):
        crossing = of_kind(lay(box(0, 0, 20, 9), cross_lines=count, closing_line=False), "cross")
        norths = sorted(line.start_ne_m[0] for line in crossing)
        assert len(norths) == count
        np.testing.assert_allclose(norths, np.linspace(norths[0], norths[-1], count))
        assert np.mean(norths) == pytest.approx(10)
        assert norths[0] == pytest.approx(20 / (count + 1), abs=0.5)
        for line in crossing:
            assert 8 <= line.length_m <= 8 + STEREO.step_m


def test_cross_lines_are_moved_rather_than_added() -> None:
    """A notch, where the one cross line would lie, cuts the rows of one side: its place moves."""
    notched = box(0, 0, 20, 10).difference(box(8, 6, 12, 10))
    two = of_kind(lay(notched, cross_lines=2, closing_line=False), "cross")
    assert len(two) == 2
    moved = box(0, 0, 20, 10).union(box(0, 10, 3, 14))
    one = of_kind(lay(moved, closing_line=False), "cross")
    assert len(one) == 1
    assert one[0].start_ne_m[0] < 3.6
    assert one[0].length_m > 12


@settings(max_examples=100)
@given(st.lists(st.tuples(st.integers(0, 12), st.integers(0, 4)), min_size=1, max_size=7))
def test_the_fewest_places_meet_all_intervals(spans: list[tuple[int, int]]) -> None:
    intervals = np.array([(a, a + b) for a, b in spans], dtype=np.float64)
    found = stabs(intervals)
    for place in (found[:, 0], found.mean(axis=1), found[:, 1]):
        met = (intervals[:, :1] <= place) & (place <= intervals[:, 1:])
        assert met.any(axis=1).all()
    ends = np.unique(intervals[:, 1])
    fewer = itertools.combinations(ends, len(found) - 1)
    for places in map(np.array, fewer):
        met = (intervals[:, :1] <= places) & (places <= intervals[:, 1:])
        assert not met.any(axis=1).all()
