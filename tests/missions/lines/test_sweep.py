import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import MultiPolygon, Polygon, box

from alice_survey.core.errors import PlanError
from missions.lines.lay import lay_pattern
from missions.lines.sweep import best_heading, min_width, widths_m
from missions.route.ways import edges_of
from missions.values.costs import Costs
from tests.oracles_lines import ELL, ELL_WITH_HOLES, area_of, areas, line_task
from tests.oracles_route import time_costs

ALONG = np.arange(16) * 2 * np.pi / 16
CALM = time_costs(0.2)
NORTHWARD = CALM._replace(line_w=1 + 2 * np.sin(ALONG) ** 2, way_w=np.ones(16), sway_w=np.ones(16))
"""A current along north: courses across it cost thrice as much."""
QUAD = Polygon([(0, 0), (9, 2), (12, 9), (-1, 8)])


@settings(deadline=None, max_examples=60)
@given(survey=areas, heading=st.floats(0, math.pi))
def test_no_direction_is_narrower_than_the_least_width(
    survey: MultiPolygon, heading: float
) -> None:
    edges = edges_of(survey)
    best, width = min_width(edges)
    sampled = widths_m(edges, np.append(np.arange(720) * math.pi / 720, heading))
    assert width <= sampled.min() + 1e-9
    assert widths_m(edges, np.array([best]))[0] == pytest.approx(width, abs=1e-9)


@pytest.mark.parametrize(
    ("shape", "costs", "count"),
    [
        (ELL, CALM, 400),
        *(
            pytest.param(shape, costs, 400, marks=pytest.mark.slow)
            for shape, costs in [
                (QUAD, CALM),
                (box(0, 0, 15, 17), CALM),
                (QUAD, NORTHWARD),
                (ELL, NORTHWARD),
                (box(0, 0, 15, 17), NORTHWARD),
            ]
        ),
        # The search leaves fill lines out until it compares the best headings.
        pytest.param(ELL_WITH_HOLES, CALM, 120, marks=pytest.mark.slow),
    ],
)
def test_no_sampled_heading_is_much_better(shape: Polygon, costs: Costs, count: int) -> None:
    task = line_task(area_of(shape), costs=costs)
    sweep = best_heading(task)
    headings = (np.arange(count) + 0.123) * math.pi / count
    sampled = [lay_pattern(task, heading).energy_j for heading in headings]
    assert sweep.cost_j <= 1.005 * min(sampled)
    again = lay_pattern(task, sweep.heading_rad).energy_j
    assert again == pytest.approx(sweep.cost_j, rel=1e-12)
    assert max(sampled) > 1.02 * sweep.cost_j


def test_lines_turn_into_the_current() -> None:
    area = area_of(box(0, 0, 15, 17))
    calm, current = (
        best_heading(line_task(area, costs=costs, cross_lines=0, closing_line=False))
        for costs in (CALM, NORTHWARD)
    )
    assert abs(math.sin(calm.heading_rad)) > 0.99
    assert abs(math.sin(current.heading_rad)) < 0.1


def test_headings_that_cannot_be_flown_are_refused() -> None:
    parts = area_of(MultiPolygon([box(0, 0, 5, 5), box(20, 0, 25, 5)]), 1.0)
    with pytest.raises(PlanError, match=r"area\.turn_margin_m"):
        best_heading(line_task(parts, cross_lines=0, closing_line=False))


def test_the_width_of_a_convex_area_is_that_between_its_outermost_corners() -> None:
    edges, corners = edges_of(MultiPolygon([QUAD])), np.array(QUAD.exterior.coords)
    for heading in np.linspace(0, math.pi, 50):
        across = corners @ np.array([-math.sin(heading), math.cos(heading)])
        assert widths_m(edges, np.array([heading]))[0] == pytest.approx(np.ptp(across), abs=1e-12)
