"""Lines divided into dives: fewest, then least energy, each within battery and time."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from alice_survey.core.errors import PlanError
from missions.route.dives import DEAREST_TIE, split_dives
from missions.route.turns import Manoeuvre, legs_alone, line_table, route_of
from missions.route.ways import Ways
from missions.values.area import multipolygon
from missions.values.costs import Costs
from missions.values.line import Line
from missions.values.plan_file import Dive
from tests.oracles_energy import best_parting
from tests.oracles_route import inside, lawn, route_cost, route_through, time_costs

HOME = (-2.0, -1.0)
WAYS = Ways(shapely.MultiPolygon([shapely.box(-6, -6, 60, 40)]))
COSTS = time_costs(0.2)
"""1 W whatever it does: Wh are hours."""


def _split(lines: list[Line], usable_wh: float, **options: Any) -> tuple[Dive, ...]:
    how = Manoeuvre(options.pop("costs", COSTS), 0.5, 0.5, ways=options.pop("ways", WAYS))
    settings: dict[str, Any] = {"home_ne": HOME, "max_s": None, "depth_m": 3.0} | options
    return split_dives(lines, how, usable_wh=usable_wh, **settings)


def _of_dive(lines: list[Line], first: int, last: int, costs: Costs = COSTS) -> tuple[float, float]:
    """A dive's energy and time, by its own route."""
    route = route_through(lines[first : last + 1], ways=WAYS, costs=costs, home_ne=HOME)
    energy, time = route_cost(route, costs)
    return energy + costs.dive_j(3.0), time + costs.dive_s(3.0)


def test_what_fits_is_one_dive_from_home_to_home() -> None:
    lines = lawn(6, 12.0, 1.0)
    (dive,) = _split(lines, 10.0)
    energy, time = _of_dive(lines, 0, 5)
    assert (dive.first_line, dive.last_line) == (0, 5)
    assert dive.energy_wh == pytest.approx(energy / 3600)
    assert dive.duration_s == pytest.approx(time)
    assert dive.route.legs[0].start_ne_m == pytest.approx(HOME)
    assert dive.route.legs[-1].end_ne_m == pytest.approx(HOME, abs=1e-6)


@given(
    count=st.integers(2, 9),
    energy=st.floats(1.02, 6.0),
    time=st.none() | st.floats(1.02, 6.0),
    lengths=st.lists(st.floats(2.0, 25.0), min_size=9, max_size=9),
)
@settings(max_examples=40, deadline=None)
def test_no_parting_is_better(
    count: int, energy: float, time: float | None, lengths: list[float]
) -> None:
    """Against all partings of up to nine lines, by dives' own routes."""
    lines = [lawn(count, length, 1.0)[i] for i, length in enumerate(lengths[:count])]
    alone = np.array([_of_dive(lines, i, i) for i in range(count)])
    usable_j, max_s = energy * alone[:, 0].max(), time and time * alone[:, 1].max()
    known: dict[tuple[int, int], tuple[float, float]] = {}

    def cost(first: int, last: int) -> tuple[float, float]:
        if (first, last) not in known:
            known[first, last] = _of_dive(lines, first, last)
        return known[first, last]

    dives = _split(lines, usable_j / 3600, max_s=max_s)

    best = best_parting(count, cost, usable_j, np.inf if max_s is None else max_s)
    assert best is not None
    assert len(dives) == best[0]
    assert sum(dive.energy_wh for dive in dives) * 3600 == pytest.approx(best[1], rel=1e-9)
    assert [d.first_line for d in dives] == [0, *(d.last_line + 1 for d in dives[:-1])]
    assert dives[-1].last_line == count - 1
    for dive in dives:
        assert dive.energy_wh * 3600 <= usable_j * (1 + 1e-9)
        assert max_s is None or dive.duration_s <= max_s * (1 + 1e-9)
        numbers = [leg.line for leg in dive.route.legs if leg.line >= 0]
        assert numbers == list(range(dive.first_line, dive.last_line + 1))


@pytest.mark.slow
@given(
    count=st.integers(2, 8),
    energy=st.floats(1.05, 6.0),
    lengths=st.lists(st.floats(2.0, 25.0), min_size=8, max_size=8),
    fill=st.integers(0, 7),
)
@settings(max_examples=25, deadline=None)
def test_tied_dives_share_a_line_and_no_such_parting_is_better(
    count: int, energy: float, lengths: list[float], fill: int
) -> None:
    """Each begins with the last line of the one before, unless that takes a dive more."""
    lines = [lawn(count, length, 1.0)[i] for i, length in enumerate(lengths[:count])]
    lines = [replace(line, kind="fill") if i == fill else line for i, line in enumerate(lines)]
    usable_j = energy * max(_of_dive(lines, i, i)[0] for i in range(count))

    def cost(first: int, last: int) -> tuple[float, float]:
        if first and lines[first - 1].kind == "fill":
            return np.inf, np.inf
        return _of_dive(lines, max(first - 1, 0), last)

    apart = _split(lines, usable_j / 3600)
    tied = _split(lines, usable_j / 3600, tied=True)

    best = best_parting(count, cost, usable_j, np.inf)
    assert len(tied) == len(apart)
    apart_j = 3600 * sum(dive.energy_wh for dive in apart)
    if best is None or best[0] > len(apart) or best[1] > DEAREST_TIE * apart_j:
        assert tied == apart
        return
    assert sum(dive.energy_wh for dive in tied) * 3600 == pytest.approx(best[1], rel=1e-9)
    assert [d.first_line for d in tied] == [0, *(d.last_line for d in tied[:-1])]
    for dive in tied:
        assert dive.energy_wh * 3600 <= usable_j * (1 + 1e-9)


def test_ways_home_round_a_hole_count_whole() -> None:
    """Home behind a wall: dives are no longer than what their routes take."""
    wall = shapely.box(3, -5.9, 3.2, 30)
    ways = Ways(multipolygon(shapely.box(-6, -6, 60, 40).difference(wall)))
    lines = [
        Line(kind="survey", start_ne_m=(n, 0.0), end_ne_m=(n, 12.0), stations=25)
        for n in (4.0, 5.0, 6.0, 7.0)
    ]
    dives = _split(lines, 0.18, ways=ways, home_ne=(0.0, 5.0))
    assert len(dives) > 1
    assert all(dive.energy_wh <= 0.18 for dive in dives)
    for dive in dives:
        along = np.linspace(0.0, dive.route.length_m, 2000)
        assert all(inside(ways, dive.route.places(along)))
        assert dive.route.length_m > 12 + 2 * 15  # round the end of the wall, there and back


def test_a_line_that_fits_no_dive_is_named() -> None:
    lines = [*lawn(3, 12.0, 1.0), *lawn(1, 36.0, 1.0)]
    with pytest.raises(PlanError) as caught:
        _split(lines, 0.09)
    text = str(caught.value)
    alone = _of_dive(lines, 3, 3)[0] / 3600
    found = re.match(r"line 3, 36 m long, takes ([\d.]+) Wh", text)
    assert found is not None
    assert float(found[1]) == pytest.approx(alone, abs=1e-3)
    for named in ("0.09 Wh", "home_ne_m", "vehicle.battery_wh"):
        assert named in text
    assert "\n" not in text
    with pytest.raises(PlanError, match=r"plan\.dive_s"):
        _split(lines, 1e6, max_s=300.0)


def test_a_course_against_too_much_current_is_refused() -> None:
    line_w = np.ones(8)
    line_w[[7, 0, 1]] = np.inf  # northwards
    costs = COSTS._replace(line_w=line_w)
    with pytest.raises(PlanError, match=r"line 0 .* 0 deg"):
        _split(lawn(4, 12.0, 1.0), 10.0, costs=costs)


@pytest.mark.parametrize("turns", ["auto", "arcs", "spot", "sway"])
def test_ways_along_single_lines_are_the_routes_through_them(turns: Any) -> None:
    room = shapely.box(-6, -6, 60, 40).difference(shapely.box(3, -3, 5, 4.5))
    ways, lines = Ways(multipolygon(room)), lawn(8, 2.5, 1.0)
    for line in list(lines):
        (n, e), (n_2, e_2) = line.start_ne_m, line.end_ne_m
        lines.append(replace(line, start_ne_m=(n + 6.0, e), end_ne_m=(n_2 + 6.0, e_2)))
    how: dict[str, Any] = {"ways": ways, "costs": COSTS, "turns": turns, "home_ne": HOME}
    legs, begins = legs_alone(line_table(lines), Manoeuvre(COSTS, 0.5, 0.5, turns, ways), HOME)
    assert (len(begins), begins[0], begins[-1]) == (2 * len(lines) + 1, 0, len(legs))
    corners = 0
    parts = np.split(legs, begins[1:-1])
    for i, (line, out, back) in enumerate(zip(lines, parts[::2], parts[1::2], strict=True)):
        expected = route_through([line], first_line=i, **how)
        assert route_of(np.concatenate([out, back])) == expected
        assert out[-1, 5] == i and not (out[:-1, 5] >= 0).any() and not (back[:, 5] >= 0).any()
        corners += len(out) > 6
    assert corners > 0 or turns == "arcs"
