import math
from itertools import pairwise

import numpy as np
import pytest
import shapely
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from shapely.geometry import MultiPolygon, box

from alice_survey.core.errors import PlanError
from missions.route.turns import MAX_SWAY_M, Turns, ends_of, turns_inside
from missions.route.ways import OPEN_WATER, TOUCH_M, Place, Ways
from missions.values.area import multipolygon
from missions.values.costs import SETTLE_S
from missions.values.legs import Leg, Route
from missions.values.line import Line
from tests.oracles_route import (
    PAPER_COSTS,
    farthest_outside_m,
    lawn,
    line_starts_m,
    route_cost,
    route_through,
    time_costs,
    turn_counts,
    way_m,
)
from tests.strategies_areas import areas, places_in

MODES: tuple[Turns, ...] = ("auto", "arcs", "spot", "sway")


def line(start: tuple[float, float], end: tuple[float, float]) -> Line:
    return Line(kind="survey", start_ne_m=start, end_ne_m=end, stations=5)


def check_joints(route: Route) -> None:
    """No gap, a heading without a jump, and a kink of the course only where the vehicle stops."""
    for leg in route.legs:
        if leg.turn_rad:
            assert leg.length_m == leg.curvature_per_m == leg.side_rad == 0.0
            assert abs(leg.turn_rad) <= math.pi
        elif leg.side_rad:
            assert abs(leg.side_rad) == math.pi / 2
            assert leg.curvature_per_m == 0.0
            assert leg.length_m <= MAX_SWAY_M
        assert leg.length_m > 0.0 or leg.turn_rad
    for before, after in pairwise(route.legs):
        assert math.dist(before.end_ne_m, after.start_ne_m) < 1e-6
        arriving = before.end_heading_rad + before.side_rad
        leaving = after.heading_rad + after.side_rad
        assert abs(math.remainder(arriving - leaving, 2 * math.pi)) < 1e-6
        if all(leg.kind in ("straight", "arc") for leg in (before, after)):
            kink = math.remainder(before.end_heading_rad - after.heading_rad, 2 * math.pi)
            assert abs(kink) < 1e-6


def random_lines(area: MultiPolygon, ways: Ways, seed: int, count: int) -> list[Line]:
    """Lines inside one part of an area; none if it has too little room."""
    places = places_in(area, np.random.default_rng(seed), 40)
    lines: list[Line] = []
    for a, b in zip(places[::2].tolist(), places[1::2].tolist(), strict=True):
        start, end = (a[0], a[1]), (b[0], b[1])
        if math.dist(start, end) < 0.2 or not ways.free(start, end):
            continue
        if lines and math.isinf(way_m(ways, lines[0].start_ne_m, start)):
            continue
        lines.append(line(start, end))
    return lines[:count]


@settings(deadline=None, max_examples=80)
@given(
    area=areas(),
    seed=st.integers(0, 2**32 - 1),
    turns=st.sampled_from(MODES),
    radius_m=st.floats(0.2, 1.5),
    run_in_m=st.floats(0.1, 1.0),
    from_home=st.booleans(),
)
def test_a_route_stays_inside_and_never_jumps(
    area: MultiPolygon, seed: int, turns: Turns, radius_m: float, run_in_m: float, from_home: bool
) -> None:
    ways = Ways(area)
    lines = random_lines(area, ways, seed, 6)
    assume(len(lines) > 1)
    home = tuple(lines[-1].stations_ne[2].tolist()) if from_home else None

    route = route_through(lines, radius_m, run_in_m, ways=ways, turns=turns, home_ne=home)

    check_joints(route)
    assert farthest_outside_m(area, route) <= 1.01 * TOUCH_M
    flown = [leg for leg in route.legs if leg.line >= 0]
    assert [leg.line for leg in flown] == list(range(len(lines)))
    for leg, wanted in zip(flown, lines, strict=True):
        assert leg.start_ne_m == wanted.start_ne_m
        assert math.dist(leg.end_ne_m, wanted.end_ne_m) < 1e-9
    if home is not None:
        assert math.dist(route.legs[0].start_ne_m, home) < 1e-9
        assert math.dist(route.legs[-1].end_ne_m, home) < 1e-6


@settings(deadline=None, max_examples=40)
@given(area=areas(), seed=st.integers(0, 2**32 - 1), sway_w=st.floats(0.1, 10.0))
def test_auto_is_as_cheap_as_any_way_of_turning(
    area: MultiPolygon, seed: int, sway_w: float
) -> None:
    ways = Ways(area)
    lines = random_lines(area, ways, seed, 5)
    assume(len(lines) > 1)
    rng = np.random.default_rng(seed)
    line_w, way_w, step_w = rng.uniform(50, 150, (3, 36))
    costs = time_costs(0.2)._replace(
        line_w=line_w, way_w=way_w, stop_w=float(rng.uniform(30, 100)), sway_w=sway_w * step_w
    )

    def price(turns: Turns) -> float:
        route = route_through(lines, 0.5, 0.3, ways=ways, costs=costs, turns=turns)
        return route_cost(route, costs)[0]

    assert price("auto") <= min(map(price, MODES)) * (1 + 1e-9)


@pytest.mark.parametrize("turns", MODES)
def test_turns_are_flown_as_requested(turns: Turns, capsys: pytest.CaptureFixture[str]) -> None:
    lines = lawn(6, 10.0, 1.0)
    route = route_through(lines, turns=turns)

    counts = {"auto": (5, 0, 0), "arcs": (5, 0, 0), "spot": (0, 10, 0), "sway": (0, 5, 5)}
    assert turn_counts(route) == counts[turns]
    assert capsys.readouterr().err == ""
    check_joints(route)


def test_turns_take_the_time_of_their_closed_forms() -> None:
    """At 0.2 m/s, with run-ins and run-outs of 0.5 m."""

    def turn_s(turns: Turns, apart_m: float) -> float:
        two, three = (
            route_cost(route_through(lawn(n, 10.0, apart_m), turns=turns), PAPER_COSTS)[1]
            for n in (2, 3)
        )
        return three - two - 10.0 / 0.2

    for apart_m in (1.0, 2.0):
        arcs, spot = (turn_s(turns, apart_m) for turns in ("arcs", "spot"))
        assert arcs == pytest.approx((math.pi * 0.5 + apart_m) / 0.2)
        # Half a turn in all at 15 deg/s, and the time of two stops.
        way_m = 0.5 + math.hypot(apart_m, 0.5)
        assert spot == pytest.approx(12.0 + 2.0 * SETTLE_S + way_m / 0.2)
        assert turn_s("auto", apart_m) == min(arcs, spot)
    # Dubins' three arcs join half circles where lines are two radii apart, and 7/3 pi R at none.
    assert turn_s("arcs", 1.0 - 1e-9) == pytest.approx(turn_s("arcs", 1.0), abs=1e-3)
    assert turn_s("arcs", 1e-9) == pytest.approx((7 / 3 * math.pi * 0.5 + 1.0) / 0.2)


def test_a_sway_step_keeps_the_heading_and_then_turns() -> None:
    route = route_through(lawn(2, 10.0, 1.0), turns="sway")

    kinds = [(leg.kind, leg.line) for leg in route.legs]
    assert kinds == [
        ("straight", -1), ("straight", 0), ("straight", -1), ("sway", -1), ("spot", -1),
        ("straight", -1), ("straight", 1), ("straight", -1),
    ]  # fmt: skip
    step = route.legs[3]
    assert step.heading_rad == pytest.approx(math.pi / 2)  # east, to starboard of north
    assert step.side_rad == -math.pi / 2
    assert step.length_m == pytest.approx(1.0)
    assert abs(route.legs[4].turn_rad) == pytest.approx(math.pi)

    # Lines one way: no turn; a next line that begins earlier: it steps at once and runs in longer.
    same = route_through([line((0, 0), (5, 0)), line((6, -1), (9, -1))], turns="sway")
    assert turn_counts(same)[1:] == (0, 1)
    assert same.legs[3].side_rad == math.pi / 2
    early = route_through([line((0, 0), (9, 0)), line((5, 1), (0, 1))], turns="sway")
    assert [leg.kind for leg in early.legs[1:5]] == ["straight", "sway", "spot", "straight"]
    assert early.legs[4].length_m == pytest.approx(4.0)
    check_joints(same)
    check_joints(early)


def test_what_has_no_room_is_flown_otherwise_with_a_warning(
    capsys: pytest.CaptureFixture[str],
) -> None:
    lines = lawn(5, 10.0, 1.0)
    tight = Ways(multipolygon(box(0.0, -0.1, 10.0, 4.1)))

    route = route_through(lines, ways=tight, turns="arcs")

    arcs, spots, steps = turn_counts(route)
    assert arcs == 0
    assert spots + steps >= 8
    assert farthest_outside_m(tight.allowed, route) <= TOUCH_M
    warned = capsys.readouterr().err
    assert "4 of 4 turns" in warned
    assert warned.count("\n") == 1

    far = route_through(lawn(3, 10.0, MAX_SWAY_M + 0.1), turns="sway")
    assert turn_counts(far)[2] == 0
    assert "2 of 2 turns" in capsys.readouterr().err

    auto = route_through(lines, ways=tight)
    assert turn_counts(auto)[0] == 0
    assert capsys.readouterr().err == ""


def test_a_vehicle_without_sway_never_steps() -> None:
    costs = time_costs(0.2)._replace(sway_w=np.full(4, np.inf))
    tight = Ways(multipolygon(box(0.0, -0.1, 10.0, 4.1)))
    for turns in MODES:
        route = route_through(lawn(5, 10, 1.0), ways=tight, costs=costs, turns=turns)
        assert turn_counts(route)[2] == 0


def test_the_way_between_lines_goes_round_a_hole() -> None:
    area = multipolygon(box(-3, -3, 23, 13).difference(box(8, 2, 12, 8)))
    ways = Ways(area)
    lines = [line((0.0, 5.0), (7.0, 5.0)), line((13.0, 5.0), (20.0, 5.0))]

    for turns in MODES:
        route = route_through(lines, ways=ways, turns=turns, home_ne=(-2.0, -2.0))
        check_joints(route)
        assert farthest_outside_m(area, route) <= TOUCH_M
        between = route.starts_m[next(i for i, leg in enumerate(route.legs) if leg.line == 1)]
        between -= line_starts_m(route)[0] + 7.0
        shortest = way_m(ways, (7.0, 5.0), (12.5, 5.0)) + 0.5
        assert between == pytest.approx(shortest)
    # A part of the line beyond the hole is no more straight on than any other line.
    assert turn_counts(route_through(lines))[1] == 0


def test_what_cannot_be_flown_is_refused() -> None:
    apart = multipolygon(box(-1, -1, 11, 3)).union(box(-1, 5, 11, 9))
    ways = Ways(multipolygon(apart))
    lines = [line((0.0, 0.0), (9.0, 0.0)), line((9.0, 6.0), (0.0, 6.0))]
    with pytest.raises(PlanError, match=r"9\.00 m north, 0\.00 m east"):
        route_through(lines, ways=ways)
    with pytest.raises(PlanError, match="line 1 "):
        route_through([lines[0], line((1.0, 1.0), (1.0, 1.0))])
    with pytest.raises(PlanError, match=r"1 of 1 lines .* line 3"):
        route_through([line((0.0, 0.0), (0.0, 8.0))], ways=ways, first_line=3)
    with pytest.raises(PlanError, match=r"20\.00 m north, 0\.00 m east"):
        route_through(lines[:1], ways=ways, home_ne=(20.0, 0.0))


def test_ten_thousand_lines_have_a_route() -> None:
    count = 10_000
    ways = Ways(multipolygon(box(-3, -3, 23, 10_003)))
    route = route_through(lawn(count, 20.0, 1.0), ways=ways)
    assert turn_counts(route)[0] == count - 1
    # Run-in, line and run-out of each, and half circles between.
    assert route.length_m == pytest.approx(21.0 * count + (count - 1) * math.pi / 2)


def test_parts_of_one_line_are_joined_straight() -> None:
    parts = [line((0.0, 0.0), (3.0, 0.0)), line((3.6, 0.0), (8.0, 0.0))]
    route = route_through(parts)

    assert route.length_m == pytest.approx(8.0 + 2 * 0.5)
    assert all(leg.curvature_per_m == 0 for leg in route.legs)


def test_a_route_is_continuous_and_keeps_its_lines() -> None:
    ends = (((0.0, 0.0), (0.0, 5.0)), ((1.0, 5.0), (1.0, 0.0)), ((1.6, 0.0), (1.6, 5.0)))
    lines = [line(*both) for both in ends]
    route = route_through(lines)

    along = np.linspace(0.0, route.length_m, 20_001)
    places_ne = route.places(along)
    steps = np.linalg.norm(np.diff(places_ne, axis=0), axis=1)
    assert np.abs(steps / np.diff(along) - 1).max() < 1e-4
    assert max(abs(leg.curvature_per_m) for leg in route.legs) <= 2.0 * (1 + 1e-6)

    starts = line_starts_m(route)
    assert list(starts) == [0, 1, 2]
    for index, start_m in starts.items():
        on_line = route.places(start_m + np.linspace(0.0, 5.0, 11))
        expected = np.linspace(lines[index].start_ne_m, lines[index].end_ne_m, 11)
        np.testing.assert_allclose(on_line, expected, atol=1e-5)
        run_in = route.places(np.array([start_m - 0.5]))[0]
        ahead = np.subtract(lines[index].end_ne_m, lines[index].start_ne_m) / 5.0
        np.testing.assert_allclose(run_in, lines[index].start_ne_m - 0.5 * ahead, atol=1e-5)


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
