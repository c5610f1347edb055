import math
from itertools import pairwise

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import box

from missions.route.turns import ends_of, turns_inside
from missions.route.ways import OPEN_WATER, Place, Ways
from missions.values.area import multipolygon
from missions.values.legs import Leg

places = st.tuples(st.floats(-10, 10), st.floats(-10, 10))
angles = st.floats(-math.pi, math.pi)


def turn(
    start: Place, first: float, goal: Place, last: float, radius_m: float, ways: Ways = OPEN_WATER
) -> list[Leg]:
    ends = np.array([[*start, first]]), np.array([[*goal, last]])
    pieces = np.concatenate(turns_inside(ways, *ends, radius_m)).T
    legs, heading = [], first
    for curvature, length_m in pieces.tolist():
        bend = {"length_m": length_m, "curvature_per_m": curvature}
        legs.append(Leg(start_ne_m=start, heading_rad=heading, **bend))
        here = np.array([[*start, heading]]), np.array([curvature]), np.array([length_m])
        heading, start = float(ends_of(*here)[0, 2]), legs[-1].end_ne_m
    return legs


def length(legs: list[Leg]) -> float:
    return sum(leg.length_m for leg in legs)


@settings(deadline=None, max_examples=200)
@given(start=places, goal=places, first=angles, last=angles, radius_m=st.floats(0.2, 3.0))
def test_a_turn_arrives_without_a_gap_or_a_kink(
    start: Place, goal: Place, first: float, last: float, radius_m: float
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
    assert length(legs) >= math.dist(start, goal) - 1e-5  # as far as it may miss the goal


@settings(deadline=None, max_examples=60)
@given(start=places, goal=places, first=angles, last=angles)
def test_a_turn_is_as_long_either_way_round_and_no_trial_is_shorter(
    start: Place, goal: Place, first: float, last: float
) -> None:
    """Slow twin: tangents of every pair of turning circles, by geometry in the plane."""
    there = length(turn(start, first, goal, last, 1.0))
    back = length(turn(goal, last + math.pi, start, first + math.pi, 1.0))
    assert there == pytest.approx(back, abs=1e-5)
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
            arcs = (one * (course - first)) % math.tau + (two * (last - course)) % math.tau
            best = min(best, arcs + straight)
    assert there <= best + 1e-5


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


def test_a_turn_keeps_out_of_forbidden_water() -> None:
    # A rock on the half circle between leaves the ways round it.
    free = turn((0.0, 0.0), 0.0, (0.0, 2.0), math.pi, 1.0)
    assert length(free) == pytest.approx(math.pi)

    rock = box(0.8, 0.8, 1.2, 1.2)
    water = Ways(multipolygon(box(-9, -9, 9, 9).difference(rock)))
    other = turn((0.0, 0.0), 0.0, (0.0, 2.0), math.pi, 1.0, water)
    assert length(other) > length(free)
    places = np.concatenate([leg.places(np.linspace(0, leg.length_m, 500)) for leg in other])
    assert shapely.distance(rock, shapely.points(places)).min() > 0
    assert math.dist(other[-1].end_ne_m, (0.0, 2.0)) < 1e-9

    tight = Ways(multipolygon(box(-0.5, -0.5, 0.5, 2.5)))
    _, none = turns_inside(tight, np.zeros((1, 3)), np.array([[0.0, 2.0, math.pi]]), 1.0)
    assert np.isinf(none).all()
