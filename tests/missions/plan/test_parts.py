"""Parts that the vehicle cannot pass between have dives of their own."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import shapely
from scipy.sparse.csgraph import connected_components
from shapely.geometry import LineString, MultiPolygon, box
from shapely.geometry.base import BaseGeometry

from alice_survey.core.config import parse_config
from alice_survey.core.errors import PlanError
from camera_calib.rig import Rig, design_rig
from missions.exports.geometry import footprint_outline, footprints_ne
from missions.fly.simulation import one_dive, path_of
from missions.plan.parts import parts_of
from missions.values.plan_file import Dive, Plan
from tests.missions.flown_plans import planned
from tests.oracles_lines import area_of, as_string

APART = MultiPolygon([box(0, 0, 6, 5), box(42, 0, 48, 5), box(84, 0, 90, 5)]).wkt


@pytest.fixture(scope="module")
def plan() -> Plan:
    return planned(parse_config({"area": {"wkt": APART}}, "test"))


def test_every_part_is_covered_by_a_dive_that_stays_in_it(plan: Plan) -> None:
    assert len(plan.dives) == 3
    assert plan.coverage == pytest.approx(1.0, abs=1e-3)
    flown = [i for dive in plan.dives for i in range(dive.first_line, dive.last_line + 1)]
    assert flown == list(range(len(plan.lines)))
    parts = list(plan.area.allowed.geoms)
    for dive in plan.dives:
        way = LineString([p for leg in dive.route.legs for p in (leg.start_ne_m, leg.end_ne_m)])
        assert sum(part.buffer(1e-5).covers(way) for part in parts) == 1
        assert math.dist(dive.route.legs[-1].end_ne_m, dive.home_ne_m) < 1e-6
        for leg in (leg for leg in dive.route.legs if leg.line >= 0):
            assert leg.start_ne_m == pytest.approx(plan.lines[leg.line].start_ne_m, abs=1e-6)
            assert dive.first_line <= leg.line <= dive.last_line
    assert plan.duration_s == pytest.approx(sum(dive.duration_s for dive in plan.dives))


def test_the_next_part_is_entered_where_the_way_to_it_is_shortest(plan: Plan) -> None:
    homes = plan.homes_ne_m
    assert homes == [dive.home_ne_m for dive in plan.dives]
    assert homes[0] == plan.home_ne_m
    for before, after in pairwise(homes):
        part = min(plan.area.allowed.geoms, key=lambda p: p.distance(shapely.Point(after)))
        assert math.dist(before, after) == pytest.approx(part.distance(shapely.Point(before)))


def test_dives_of_parts_are_flown_one_by_one(plan: Plan) -> None:
    with pytest.raises(PlanError, match=r"vehicle\.dive = 1 to 3"):
        path_of(plan)
    second = plan.dives[1]
    own = set(range(second.first_line, second.last_line + 1))
    assert set(path_of(one_dive(plan, 2)).line) - {-1} == own


def test_parts_that_touch_are_one() -> None:
    area = area_of(MultiPolygon([box(0, 0, 5, 5), box(5, 5, 9, 9)]), 0.0)
    assert len(parts_of(area, (0.0, 0.0))) == 1
    far = area_of(MultiPolygon([box(20, 0, 25, 5), box(0, 0, 5, 5)]), 1.0)
    (first, home), (second, entry) = parts_of(far, (0.0, 0.0))
    assert first.survey.bounds == (0, 0, 5, 5)
    assert second.survey.bounds == (20, 0, 25, 5)
    assert (home, entry) == ((0.0, 0.0), (19.0, 0.0))


def _seen_by(plan: Plan, rig: Rig, dive: Dive) -> BaseGeometry:
    """What the first camera's pictures of a dive see."""
    outline = footprint_outline(plan, rig)
    lines = plan.lines[dive.first_line : dive.last_line + 1]
    return shapely.union_all(
        [shapely.Polygon(r) for line in lines for r in footprints_ne(line, outline)]
    )


def test_pictures_of_neighbouring_dives_overlap_by_a_line() -> None:
    """Along a whole line, by all that it sees."""
    area = {"length_m": 12.0, "width_m": 40.0}
    lines = {"cross_lines": 0, "closing_line": False, "line_heading_deg": 0.0}
    config = parse_config({"area": area, "plan": {"dive_s": 1600.0, **lines}}, "test")
    plan, rig = planned(config), design_rig(config.camera, config.water)
    assert len(plan.dives) >= 3
    assert sum(d.last_line - d.first_line + 1 for d in plan.dives) == len(plan.lines)
    assert plan.dives[0].first_line == 0
    for before, after in pairwise(plan.dives):
        assert after.first_line == before.last_line + 1
        shared, again = plan.lines[before.last_line], plan.lines[after.first_line]
        both = _seen_by(plan, rig, before).intersection(_seen_by(plan, rig, after)).area
        swath_m2 = plan.footprint_m[0] * shared.length_m
        assert again == replace(shared, kind="tie")
        assert 1.0 < both / swath_m2 < 2.0
    for dive in plan.dives:
        assert dive.duration_s <= 1600.0
        flown = [leg.line for leg in dive.route.legs if leg.line >= 0]
        assert flown == list(range(dive.first_line, dive.last_line + 1))


@pytest.mark.parametrize("cross_lines", [0, 1])
def test_cross_lines_tie_all_dives(cross_lines: int, capsys: pytest.CaptureFixture[str]) -> None:
    wanted = {"dive_s": 500.0, "cross_lines": cross_lines}
    plan = planned(parse_config({"plan": wanted}, "test"))
    assert len(plan.dives) >= 4
    lines_of = [dive.last_line - dive.first_line + 1 for dive in plan.dives]
    owner = np.repeat(np.arange(len(plan.dives)), lines_of)
    strings = np.array([as_string(line) for line in plan.lines])
    crossing = np.array([line.kind == "cross" for line in plan.lines])
    one, other = np.nonzero(crossing[:, None] & shapely.intersects(strings[:, None], strings))
    ties = np.zeros((len(plan.dives), len(plan.dives)))
    ties[owner[one], owner[other]] = 1
    together, _ = connected_components(ties, directed=False)
    assert together == (1 if cross_lines else len(plan.dives))
    assert ("tied" in capsys.readouterr().err) == (not cross_lines)
