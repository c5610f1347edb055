"""Lines divided into dives: each fits the battery and the time, from home and home again.

Lines keep their order. Of all ways to divide them the one with the fewest dives is taken, and of
these the one that takes the least energy: a dynamic programme over the lines, exact, since the ways
between two lines of a dive are the same whatever dive they are in. What is between lines comes from
sums along the route through all of them; only the ways from home to each line and back are found
for each line, and only the chosen dives get their own route.

Tied dives share a line with the one before: they begin with its last line, flown again. That is
done where it takes no dive more and little energy.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.errors import PlanError
from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from missions.route.turns import Manoeuvre, legs_alone, legs_through, line_table, route_of
from missions.values.costs import Costs, leg_row_costs
from missions.values.line import Line
from missions.values.plan_file import Dive

DEAREST_TIE = 1.1
"""Tied dives may take so many times the energy of untied ones. Chosen: lines across tie them too.
"""
_J_PER_WH = 3600.0


@dataclass(frozen=True, kw_only=True)
class DiveLimits:
    """What one dive may take."""

    energy_j: float
    time_s: float
    """Time limit; may be infinite."""

    def hold(self, energy_j: float, time_s: float) -> bool:
        """Whether a dive fits."""
        return energy_j <= self.energy_j and time_s <= self.time_s


@dataclass(frozen=True, kw_only=True, eq=False)
class _Sums:
    """Energy, J, and time, s, (2, N) each, of a dive's parts."""

    home_to: Array
    """Sums from the surface at home to each line's start."""
    until: Array
    """Sums from the first line's start to each line's start."""
    through: Array
    """Sums from the first line's start to each line's end."""
    back: Array
    """Sums from each line's end to the surface at home."""

    def of(self, first: int, last: int) -> tuple[float, float]:
        """Energy and time of a dive along lines `first` to `last`."""
        energy, time = (
            self.home_to[:, first]
            + self.through[:, last]
            - self.until[:, first]
            + self.back[:, last]
        )
        return float(energy), float(time)


@progress.step("route the dives")
def split_dives(
    lines: Sequence[Line],
    how: Manoeuvre,
    *,
    home_ne: tuple[float, float],
    usable_wh: float,
    max_s: float | None,
    depth_m: float,
    tied: bool = False,
) -> tuple[Dive, ...]:
    """Divide lines into dives.

    Args:
        lines: in the order of flight.
        how: turns, what the vehicle takes, and where it may be.
        home_ne: where each dive begins and ends at the surface.
        usable_wh: of the battery.
        max_s: of a dive, descent and ascent included; None: as long as the battery lasts.
        depth_m: that the vehicle goes down to and comes up from, once a dive.
        tied: whether each begins with the last line of the one before, which is not a fill line:
            their `first_line` is its `last_line`. They are not where that takes more dives, or
            more energy than `DEAREST_TIE` allows.

    Raises:
        PlanError: a line does not fit a dive by itself, or a course cannot be flown in the current.
    """
    table, costs = line_table(lines), how.costs
    down_and_up = costs.dive_j(depth_m), costs.dive_s(depth_m)

    def dive(first: int, last: int, legs: Array | None = None) -> Dive:
        if legs is None:
            legs = legs_through(table[first : last + 1], how, home_ne=home_ne, first_line=first)
        energy_j, time_s = np.stack(leg_row_costs(legs[:, 2:], costs)).sum(axis=1) + down_and_up
        return Dive(
            first_line=first,
            last_line=last,
            route=route_of(legs),
            duration_s=float(time_s),
            energy_wh=float(energy_j) / _J_PER_WH,
        )

    limits = DiveLimits(energy_j=usable_wh * _J_PER_WH, time_s=math.inf if max_s is None else max_s)
    whole = legs_through(table, how, home_ne=home_ne)
    spent = np.stack(leg_row_costs(whole[:, 2:], costs))
    _check_flyable(whole, spent[0], lines, costs)
    if limits.hold(*(spent.sum(axis=1) + down_and_up)):
        return (dive(0, len(lines) - 1, whole),)

    sums = _sums(whole, spent, *legs_alone(table, how, home_ne), costs, depth_m)
    parted = _min_dives(sums, limits)
    if parted is None:
        raise PlanError(_line_too_long(lines, sums, limits, depth_m))
    if tied:
        parted = _tie(lines, sums, limits, parted)
    return tuple(dive(*ends) for ends in parted)


def _tie(
    lines: Sequence[Line], sums: _Sums, limits: DiveLimits, parted: list[tuple[int, int]]
) -> list[tuple[int, int]]:
    """Dives that share a line each, or those given where these would be more or dear."""
    fill = np.array([line.kind == "fill" for line in lines])
    joined = _min_dives(sums, limits, (np.flatnonzero(fill) + 1).tolist(), overlap=1)
    if joined is None or len(joined) > len(parted):
        return parted
    energy_j, apart_j = (sum(sums.of(*ends)[0] for ends in dives) for dives in (joined, parted))
    return joined if energy_j <= DEAREST_TIE * apart_j else parted


def _check_flyable(legs: Array, energy_j: Array, lines: Sequence[Line], costs: Costs) -> None:
    stopped = np.flatnonzero(~np.isfinite(energy_j))
    if not len(stopped):
        return
    north, east, course, _, _, line, _, _ = legs[stopped[0]]
    what = f"line {line:.0f} of {len(lines)}" if line >= 0 else "the way between lines"
    where = (
        f"{what} at {north:.1f} m north, {east:.1f} m east on course "
        f"{math.degrees(course) % 360.0:.0f} deg cannot be flown"
    )
    if costs.refused is not None:
        raise costs.refused(where)
    raise PlanError(f"{where}: its cost is infinite")


def _sums(
    whole: Array,
    spent: Array,
    alone: Array,
    begins: NDArray[np.int64],
    costs: Costs,
    depth_m: float,
) -> _Sums:
    """Sums along the route through all lines, and of the ways of dives along one line each.

    Args:
        whole: (L, 8) legs through all lines, from home to home.
        spent: (2, L) their energy and time.
        alone: legs along each line by itself, as of `legs_alone`.
        begins: rows at which their ways begin.
        costs: of the vehicle.
        depth_m: of a dive.
    """
    rows = np.flatnonzero(whole[:, 5] >= 0)
    before = np.concatenate([np.zeros((2, 1)), np.cumsum(spent, axis=1)], axis=1)
    one = np.cumsum(np.stack(leg_row_costs(alone[:, 2:], costs)), axis=1)
    one = np.concatenate([np.zeros((2, 1)), one], axis=1)
    on_line = begins[1::2] - 1
    surface = np.array([[costs.dive_j(depth_m)], [costs.dive_s(depth_m)]])
    return _Sums(
        home_to=one[:, on_line] - one[:, begins[:-1:2]] + surface,
        until=before[:, rows],
        through=before[:, rows + 1],
        back=one[:, begins[2::2]] - one[:, on_line + 1],
    )


def _min_dives(
    sums: _Sums, limits: DiveLimits, not_at: Sequence[int] = (), overlap: int = 0
) -> list[tuple[int, int]] | None:
    """First and last line of each dive; None where some line fits no dive by itself.

    For the best division of lines up to each: how many dives, what energy, where the last begins.

    Args:
        sums: along the lines.
        limits: of each dive.
        not_at: lines that no dive begins with.
        overlap: how many lines of the dive before each dive flies first.
    """
    count = sums.until.shape[1]
    may_begin = np.ones(count + 1, dtype=np.bool_)
    may_begin[list(not_at)] = False
    dives, spent = np.full(count + 1, np.inf), np.full(count + 1, np.inf)
    dives[0] = spent[0] = 0.0
    begins = np.zeros(count + 1, dtype=np.int64)
    limit = np.array([[limits.energy_j], [limits.time_s]])
    earliest = 0
    for last in range(count):
        # Beyond the first line that is too far back all earlier ones are: until only grows.
        while earliest < last and not limits.hold(
            *(sums.through[:, last] - sums.until[:, earliest])
        ):
            earliest += 1
        first = np.arange(earliest, last + 1)
        flown = np.maximum(first - overlap, 0)
        there = sums.through[:, [last]] + sums.back[:, [last]]
        dive = sums.home_to[:, flown] + there - sums.until[:, flown]
        first = first[may_begin[first] & (dive <= limit).all(axis=0)]
        if len(first):
            total = spent[first] + dive[0, first - earliest]
            best = np.lexsort((total, dives[first]))[0]
            begins[last + 1] = first[best]
            dives[last + 1], spent[last + 1] = dives[first[best]] + 1.0, total[best]
    if not math.isfinite(dives[count]):
        return None
    parted, end = [], count
    while end > 0:
        begin = int(begins[end])
        parted.append((max(begin - overlap, 0), end - 1))
        end = begin
    return parted[::-1]


def _line_too_long(lines: Sequence[Line], sums: _Sums, limits: DiveLimits, depth_m: float) -> str:
    """Which line fits no dive by itself, and what to do."""
    each = [sums.of(i, i) for i in range(len(lines))]
    over = [i for i, (energy, time) in enumerate(each) if not limits.hold(energy, time)]
    worst = max(over, key=lambda i: each[i][0])
    energy_j, time_s = each[worst]
    longest = f" and {limits.time_s:.0f} s" if math.isfinite(limits.time_s) else ""
    return (
        f"line {worst}, {lines[worst].length_m:.0f} m long, takes {energy_j / _J_PER_WH:.3g} Wh "
        f"and {time_s:.0f} s by itself, with the way from home and back and {depth_m:.0f} m down "
        f"and up, but a dive has {limits.energy_j / _J_PER_WH:.3g} Wh{longest}: raise "
        "vehicle.battery_wh or plan.dive_s, set plan.home_ne_m nearer to it, or lay shorter lines "
        "(plan.line_heading_deg, or parts)"
    )
