"""Routes of whole plans, as the tests ask for them."""

from collections.abc import Sequence
from typing import Any

from missions.route.turns import legs_through, line_table, route_of
from missions.values.legs import Route
from missions.values.line import Line


def route_through(
    lines: Sequence[Line], turn_radius_m: float, run_in_m: float, **how: Any
) -> Route:
    """The route along all lines in order; arguments as of `legs_through`."""
    return route_of(legs_through(line_table(lines), turn_radius_m, run_in_m, **how))
