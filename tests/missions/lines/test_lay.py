import math
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from shapely.geometry import MultiPolygon, box

from alice_survey.core.errors import PlanError
from missions.lines.hops import comparable, hop_j
from missions.lines.lay import lay_lines, lay_pattern, order_lines, stops
from missions.route.ways import Ways
from missions.values.costs import Costs
from missions.values.line import Line
from missions.values.pattern import Pattern
from tests import oracles_lines
from tests.oracles_route import time_costs, way_m

COURSES = np.arange(16) * 2 * np.pi / 16
CURRENT = time_costs(0.2)._replace(
    line_w=80 + 40 * np.cos(COURSES - 1) ** 2 + 20 * np.cos(COURSES - 2),
    way_w=70 + 20 * np.cos(COURSES - 2),
    stop_w=60.0,
    sway_w=90 + 30 * np.cos(COURSES - 2),
)


def across(line: Line, heading: float) -> float:
    north, east = line.start_ne_m
    return -math.sin(heading) * north + math.cos(heading) * east


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.filter_too_much])
@given(
    survey=oracles_lines.areas,
    heading=st.floats(0, 6.28),
    pattern=st.sampled_from(oracles_lines.PATTERNS),
    kinds=st.fixed_dictionaries({
        "margin_m": st.sampled_from([0.5, 3.0]), "cross_lines": st.integers(0, 2),
        "closing_line": st.booleans(),
    }),
)  # fmt: skip
def test_lines_of_any_area_cover_it_and_stay_inside(
    survey: MultiPolygon, heading: float, pattern: Pattern, kinds: dict[str, Any]
) -> None:
    area = oracles_lines.area_of(survey, kinds["margin_m"])
    # The planner refuses an area that is less than a picture across.
    picture_m2 = 4.0 * pattern.half_across_m * pattern.half_along_m
    assume(survey.area > picture_m2 and len(area.allowed.geoms) == 1)
    lines = oracles_lines.lay(survey, heading, pattern, **kinds)

    fence = area.allowed.buffer(1e-6)
    assert all(fence.contains(oracles_lines.as_string(line)) for line in lines)
    assert all(line.length_m <= (line.stations - 1) * pattern.step_m + 1e-9 for line in lines)
    points = oracles_lines.points_in(survey, 5000)
    main = [line for line in lines if line.kind in ("survey", "fill")]
    # Dense points count the boxes that pictures see: an oracle that knows nothing of rows.
    assert oracles_lines.seen_enough(main, points, pattern).mean() >= 0.999
    grid = [line for line in lines if line.kind == "survey"]
    offsets = np.array([across(line, heading) for line in grid]) / pattern.spacing_m
    np.testing.assert_allclose(
        (offsets - offsets[0] + 0.5) % 1.0, 0.5, atol=1e-9 / pattern.spacing_m
    )
    once = [line for line in lines if line.kind != "closing"]
    assert len({frozenset([line.start_ne_m, line.end_ne_m]) for line in once}) == len(once)
    closing = [line for line in lines if line.kind == "closing"]
    assert len(closing) == int(kinds["closing_line"] and len(grid) > 1)
    if closing:
        assert closing[0].end_ne_m == pytest.approx(grid[0].start_ne_m, abs=1e-9)
        middle = (grid[0].length_m + grid[0].length_m / (grid[0].stations - 1)) / 2
        assert 0 < closing[0].length_m <= middle + 1e-9


@pytest.mark.parametrize(
    "seeds", [range(100), pytest.param(range(100, 500), marks=pytest.mark.slow)]
)
def test_areas_never_crash_and_lines_never_leave_the_allowed_area(seeds: range) -> None:
    unreachable = 0
    for seed in seeds:
        rng = np.random.default_rng([77, seed])
        survey = oracles_lines.random_area(rng)
        area = oracles_lines.area_of(survey, float(rng.choice([0.0, 0.5, 3.0])))
        home = area.allowed.representative_point()
        try:
            heading = float(rng.uniform(0, 7))
            kinds: Any = {"cross_lines": int(rng.integers(3)), "closing_line": rng.integers(2) > 0}
            lines = lay_lines(
                oracles_lines.line_task(
                    area, oracles_lines.PATTERNS[seed % 3], home_ne=(home.x, home.y), **kinds
                ),
                heading,
            )
        except PlanError as error:
            assert "not connected" in str(error) or "can be flown" in str(error)
            unreachable += 1
            continue
        fence = area.allowed.buffer(1e-6)
        assert lines
        assert all(fence.contains(oracles_lines.as_string(line)) for line in lines)
    assert 0 < unreachable < len(seeds) / 2


def test_every_part_is_tied_by_cross_lines() -> None:
    parts = MultiPolygon([box(0, 0, 6, 6), box(10, 0, 18, 7)])
    lines = oracles_lines.lay(parts, 0.0, margin_m=4.0, cross_lines=2)
    crossing = [oracles_lines.as_string(line) for line in lines if line.kind == "cross"]
    for part in parts.geoms:
        own = [line for line in crossing if line.distance(part) == 0]
        assert len(own) == 2
        rows = [oracles_lines.as_string(line) for line in lines if line.kind == "survey"]
        for row in [row for row in rows if row.intersection(part).length > 1]:
            assert all(row.crosses(line) for line in own)


@pytest.mark.parametrize("costs", [time_costs(0.2), CURRENT])
def test_the_cost_is_that_of_the_lines_flown_by_hand(costs: Costs) -> None:
    area = oracles_lines.area_of(oracles_lines.ELL_WITH_HOLES)
    task = oracles_lines.line_task(area, costs=costs, home_ne=(-2.0, -2.0))
    lines, cost = lay_lines(task, 0.4), lay_pattern(task, 0.4).energy_j
    by_hand = oracles_lines.flight_by_hand(lines, partial(way_m, task.ways), costs, task.home_ne)
    assert by_hand == pytest.approx(cost, rel=1e-6)


def test_the_order_is_better_than_rows_one_after_the_other() -> None:
    """The old way flew every row over all parts before the next row."""
    area = oracles_lines.area_of(oracles_lines.ELL_WITH_HOLES)
    ways, costs = Ways(area.allowed), comparable(time_costs(0.2))
    lines = oracles_lines.lay(oracles_lines.ELL_WITH_HOLES, 0.0, cross_lines=0, closing_line=False)
    rows = sorted(lines, key=lambda x: (round(across(x, 0.0), 6), x.start_ne_m))
    plain = [line if i % 2 else line.reverse() for i, line in enumerate(rows)]
    hops_j = []
    for some in (lines, plain):
        table = np.array([(*x.start_ne_m, *x.end_ne_m, x.heading_rad) for x in some])
        leave, enter = stops(table, np.zeros(2))
        ways_m = ways.lengths_m(leave[:, :2], enter[:, :2])
        hops_j.append(hop_j(costs, leave, enter, ways_m).sum())
    assert hops_j[0] < 0.8 * hops_j[1]


def test_any_lines_are_put_in_order() -> None:
    area = oracles_lines.area_of(box(0, 0, 20, 20))
    ways, costs, home = Ways(area.allowed), time_costs(0.2), (0.0, 0.0)
    rng = np.random.default_rng(4)
    lines = [
        Line(kind="fill", start_ne_m=(a, b), end_ne_m=(a + 1, b + c / 5), stations=9)
        for a, b, c in rng.uniform(2, 15, (12, 3)).tolist()
    ]
    for some in (lines[:5], lines):
        sorted_lines = order_lines(some, ways, costs, home)
        ends = {frozenset([x.start_ne_m, x.end_ne_m]) for x in sorted_lines}
        assert ends == {frozenset([x.start_ne_m, x.end_ne_m]) for x in some}
        mine = oracles_lines.flight_by_hand(sorted_lines, partial(way_m, ways), costs, home)
        assert mine < oracles_lines.flight_by_hand(some, partial(way_m, ways), costs, home)


def test_parts_without_a_way_between_are_refused() -> None:
    with pytest.raises(PlanError, match=r"area\.turn_margin_m"):
        oracles_lines.lay(MultiPolygon([box(0, 0, 5, 5), box(20, 0, 25, 5)]), margin_m=1.0)


def test_too_many_stations_are_refused() -> None:
    with pytest.raises(PlanError, match="2000000"):
        oracles_lines.lay(box(0, 0, 2000, 2000))


def test_ten_thousand_rows_are_laid() -> None:
    wide = Pattern(spacing_m=1.0, step_m=8.0, half_across_m=0.6, half_along_m=4.5)
    area = oracles_lines.area_of(box(0, 0, 40, 9_999))
    lines = lay_lines(oracles_lines.line_task(area, wide, cross_lines=0, closing_line=False), 0.0)
    assert len(lines) == 9_999
