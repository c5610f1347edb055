"""Routes of whole plans, as the tests ask for them."""

from collections.abc import Sequence
from typing import Any

from missions.route.turns import Manoeuvre, Turns, legs_through, line_table, route_of
from missions.route.ways import OPEN_WATER, Ways
from missions.values.costs import Costs, time_costs
from missions.values.legs import Route
from missions.values.line import Line

PAPER_COSTS = time_costs(0.2)  # Gutnik et al. 2021, section VII.A


def route_through(
    lines: Sequence[Line],
    turn_radius_m: float,
    run_in_m: float,
    *,
    ways: Ways = OPEN_WATER,
    costs: Costs = PAPER_COSTS,
    turns: Turns = "auto",
    **ends: Any,
) -> Route:
    """The route along all lines in order; other arguments as of `legs_through`."""
    how = Manoeuvre(costs, turn_radius_m, run_in_m, turns, ways)
    return route_of(legs_through(line_table(lines), how, **ends))
