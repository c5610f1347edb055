import math
from dataclasses import astuple
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter

from missions.route.turns import COLUMNS, prices_j
from missions.values.costs import Costs, leg_costs, mean_power
from missions.values.legs import Leg, Route
from tests.oracles_route import route_cost, route_cost_by_steps, sampled_leg, time_costs

angles = st.floats(-7.0, 7.0)
lengths = st.floats(0.01, 30.0)
places = st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4))


@st.composite
def legs(draw: st.DrawFn) -> Leg:
    kind = draw(st.sampled_from(["straight", "arc", "spot", "sway"]))
    start, heading, length = draw(places), draw(angles), draw(lengths)
    sign = draw(st.sampled_from([-1, 1]))
    more: dict[str, Any] = {}
    if kind == "spot":
        length, more = 0.0, {"turn_rad": sign * draw(st.floats(0.01, math.pi))}
    elif kind == "sway":
        length, more = min(length, 3.0), {"side_rad": sign * math.pi / 2}
    elif kind == "arc":
        curvature = draw(st.floats(0.1, 4.0))
        length, more = min(length, 6.2 / curvature), {"curvature_per_m": sign * curvature}
    else:
        more = {"line": draw(st.integers(-1, 9))}
    return Leg(start_ne_m=start, heading_rad=heading, length_m=length, **more)


@given(one=legs())
def test_a_leg_comes_back_from_json_as_it_was(one: Leg) -> None:
    adapter = TypeAdapter(Leg)
    assert adapter.validate_json(adapter.dump_json(one, exclude_defaults=True)) == one


@given(one=legs())
def test_a_leg_ends_where_its_circle_does(one: Leg) -> None:
    if one.length_m == 0.0:
        assert one.end_ne_m == one.start_ne_m
        return
    expected, _ = sampled_leg(one, 9)
    assert math.dist(one.end_ne_m, expected[-1]) < 1e-8
    if one.curvature_per_m:
        np.testing.assert_allclose(
            one.places(np.linspace(0.0, one.length_m, 9)), expected, atol=1e-8
        )


def uneven(seed: int, *, closed: bool = False) -> Costs:
    rng = np.random.default_rng(seed)
    way_w = rng.uniform(50, 150, 24)
    if closed:
        way_w[3:6] = np.inf
    return time_costs(0.25)._replace(
        line_w=rng.uniform(50, 150, 36),
        way_w=way_w,
        stop_w=40.0,
        arc_extra_w=30.0,
        sway_w=rng.uniform(50, 150, 12),
    )


@settings(deadline=None)
@given(many=st.lists(legs(), min_size=1, max_size=6), seed=st.integers(0, 1000))
def test_a_route_costs_what_its_legs_do(many: list[Leg], seed: int) -> None:
    route, costs = Route(legs=tuple(many)), uneven(seed)
    joules, seconds = route_cost(route, costs)

    expected_j, expected_s = route_cost_by_steps(route, costs, 0.002)

    assert seconds == pytest.approx(expected_s, rel=1e-12)
    assert joules == pytest.approx(expected_j, rel=1e-4)
    legs_j, legs_s = leg_costs(route, costs)
    assert legs_j.sum() == pytest.approx(joules) and legs_s.sum() == pytest.approx(seconds)
    # What compiled code compares ways between lines by.
    ways = [one for one in many if one.line < 0]
    rows = [(*one.start_ne_m, *astuple(one)[1:]) for one in ways]
    table = np.array(rows, np.float64).reshape(-1, COLUMNS)
    expected = route_cost(Route(legs=tuple(ways)), costs)[0]
    assert prices_j(costs, table[None])[0] == pytest.approx(expected, rel=1e-9)


def test_no_way_on_a_course_that_cannot_be_flown() -> None:
    costs = uneven(1, closed=True)
    shut = 4 * 2 * math.pi / 24
    for start, end, open_water in ((shut, shut, False), (0.0, 0.5, True), (0.0, 2.0, False)):
        mean = mean_power(costs.way_w, np.array([start]), np.array([end]))[0]
        assert math.isfinite(mean) == open_water
