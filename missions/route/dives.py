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

from alice_survey.base.errors import PlanError
from alice_survey.base.frames import Array
from alice_survey.base.run import progress
from missions.route.turns import Turns, route_through
from missions.route.ways import Ways
from missions.values.costs import Costs, leg_costs
from missions.values.legs import Route
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
    *,
    ways: Ways | None,
    costs: Costs,
    home_ne: tuple[float, float],
    turn_radius_m: float,
    run_in_m: float,
    turns: Turns,
    usable_wh: float,
    longest_s: float | None,
    depth_m: float,
    split: bool,
    tied: bool = False,
) -> tuple[Dive, ...]:
    """Divide lines into dives.

    Args:
        lines: in the order of flight.
        ways: inside the allowed area; None: nothing is forbidden.
        costs: of the vehicle.
        home_ne: where each dive begins and ends at the surface.
        turn_radius_m: of arcs.
        run_in_m: straight before and after a line.
        turns: how to turn.
        usable_wh: of the battery.
        longest_s: of a dive, descent and ascent included; None: as long as the battery lasts.
        depth_m: that the vehicle goes down to and comes up from, once a dive.
        split: whether there may be more than one.
        tied: whether each begins with the last line of the one before, which is not a fill line:
            their `first_line` is its `last_line`. They are not where that takes more dives, or
            more energy than `DEAREST_TIE` allows.

    Raises:
        PlanError: a line does not fit a dive by itself; or all do not and may not be split; or a
            course cannot be flown in the current.
    """

    def routed(first: int, last: int) -> Route:
        return route_through(
            lines[first : last + 1],
            turn_radius_m,
            run_in_m,
            ways=ways,
            costs=costs,
            turns=turns,
            home_ne=home_ne,
            first_line=first,
        )

    limits = DiveLimits(
        energy_j=usable_wh * _J_PER_WH, time_s=math.inf if longest_s is None else longest_s
    )
    down_and_up = costs.dive_j(depth_m), costs.dive_s(depth_m)
    whole = routed(0, len(lines) - 1)
    legs = np.stack(leg_costs(whole, costs))
    _check_flyable(whole, legs[0], lines, costs)
    energy_j, time_s = legs.sum(axis=1) + down_and_up
    if limits.hold(energy_j, time_s):
        return (_dive(0, len(lines) - 1, whole, float(energy_j), float(time_s)),)

    sums = _sums(whole, legs, [routed(i, i) for i in range(len(lines))], costs, depth_m)
    if not split:
        raise PlanError(_too_large(lines, sums, limits, float(energy_j), float(time_s)))
    parted = _least_dives(sums, limits)
    if parted is None:
        raise PlanError(_line_too_long(lines, sums, limits, depth_m))
    if tied:
        parted = _tied(lines, sums, limits, parted)
    dives = []
    for first, last in parted:
        route = routed(first, last)
        energy_j, time_s = np.stack(leg_costs(route, costs)).sum(axis=1) + down_and_up
        dives.append(_dive(first, last, route, float(energy_j), float(time_s)))
    return tuple(dives)


def _tied(
    lines: Sequence[Line], sums: _Sums, limits: DiveLimits, parted: list[tuple[int, int]]
) -> list[tuple[int, int]]:
    """Dives that share a line each, or those given where these would be more or dear."""
    fill = np.array([line.kind == "fill" for line in lines])
    joined = _least_dives(sums, limits, (np.flatnonzero(fill) + 1).tolist(), overlap=1)
    if joined is None or len(joined) > len(parted):
        return parted
    energy_j, apart_j = (sum(sums.of(*dive)[0] for dive in dives) for dives in (joined, parted))
    return joined if energy_j <= DEAREST_TIE * apart_j else parted


def _dive(first: int, last: int, route: Route, energy_j: float, time_s: float) -> Dive:
    return Dive(
        first_line=first,
        last_line=last,
        route=route,
        duration_s=time_s,
        energy_wh=energy_j / _J_PER_WH,
    )


def _check_flyable(route: Route, energy_j: Array, lines: Sequence[Line], costs: Costs) -> None:
    stopped = np.flatnonzero(~np.isfinite(energy_j))
    if not len(stopped):
        return
    leg = route.legs[int(stopped[0])]
    what = f"line {leg.line} of {len(lines)}" if leg.line >= 0 else "the way between lines"
    where = (
        f"{what} at {leg.start_ne_m[0]:.1f} m north, {leg.start_ne_m[1]:.1f} m east on course "
        f"{math.degrees(leg.heading_rad) % 360.0:.0f} deg cannot be flown"
    )
    if costs.refused is not None:
        raise costs.refused(where)
    raise PlanError(f"{where}: its cost is infinite")


def _sums(whole: Route, legs: Array, alone: Sequence[Route], costs: Costs, depth_m: float) -> _Sums:
    """Sums along the route through all lines, and of the ways of dives along one line each.

    Args:
        whole: route through all lines, from home to home.
        legs: (2, L) energy and time of its legs.
        alone: for each line the route along it by itself.
        costs: of the vehicle.
        depth_m: of a dive.
    """
    before = np.concatenate([np.zeros((2, 1)), np.cumsum(legs, axis=1)], axis=1)
    rows = np.array([i for i, leg in enumerate(whole.legs) if leg.line >= 0])
    joint = Route(legs=tuple(leg for route in alone for leg in route.legs))
    spent = np.stack(leg_costs(joint, costs))
    spent = np.concatenate([np.zeros((2, 1)), np.cumsum(spent, axis=1)], axis=1)
    on_line = np.array([i for i, leg in enumerate(joint.legs) if leg.line >= 0])
    starts = np.cumsum([0, *(len(route.legs) for route in alone)])
    surface = np.array([[costs.dive_j(depth_m)], [costs.dive_s(depth_m)]])
    return _Sums(
        home_to=spent[:, on_line] - spent[:, starts[:-1]] + surface,
        until=before[:, rows],
        through=before[:, rows + 1],
        back=spent[:, starts[1:]] - spent[:, on_line + 1],
    )


def _least_dives(
    sums: _Sums, limits: DiveLimits, not_at: Sequence[int] = (), overlap: int = 0
) -> list[tuple[int, int]] | None:
    """First and last line of each dive; None where some line fits no dive by itself.

    Of the best division of lines up to each: how many dives, what energy, where the last begins.

    Args:
        sums: along the lines.
        limits: of each dive.
        not_at: lines that no dive begins with.
        overlap: how many lines of the dive before each dive flies first.
    """
    count = sums.until.shape[1]
    energy_j, time_s = limits.energy_j, limits.time_s
    dives, spent = np.zeros(count + 1), np.zeros(count + 1)
    begins = np.zeros(count + 1, dtype=np.intp)
    earliest = 0
    for last in range(count):
        through = sums.through[:, last] + sums.back[:, last]
        # Beyond the first line that is too far back all earlier ones are: until only grows.
        while earliest < last and (
            sums.through[0, last] - sums.until[0, earliest] > energy_j
            or sums.through[1, last] - sums.until[1, earliest] > time_s
        ):
            earliest += 1
        first = np.arange(earliest, last + 1)
        first = first[~np.isin(first, not_at)]
        flown = np.maximum(first - overlap, 0)
        dive_j = sums.home_to[0, flown] + through[0] - sums.until[0, flown]
        dive_s = sums.home_to[1, flown] + through[1] - sums.until[1, flown]
        fits = (dive_j <= energy_j) & (dive_s <= time_s) & np.isfinite(dives[first])
        if not fits.any():
            dives[last + 1] = spent[last + 1] = math.inf
            continue
        least = dives[first][fits].min()
        total = np.where(fits & (dives[first] == least), spent[first] + dive_j, np.inf)
        best = int(np.argmin(total))
        dives[last + 1], spent[last + 1] = least + 1, total[best]
        begins[last + 1] = first[best]
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
    line, (energy, time) = lines[worst], each[worst]
    ways = []
    if energy > limits.energy_j:
        ways.append(f"a battery with {_wh(energy)} above its reserve (vehicle.battery_wh)")
    if time > limits.time_s:
        ways.append(f"plan.dive_s of {time:.0f} s")
    ways += ["plan.home_ne_m nearer to it", "shorter lines (plan.line_heading_deg, or parts)"]
    return (
        f"line {worst}, {line.length_m:.0f} m long, takes {_numbers(energy, time)} by itself, with "
        f"the way from home and back and {depth_m:.0f} m down and up, but a dive has "
        f"{_allowed(limits)}"
        + (f" ({len(over)} lines are too long)" if len(over) > 1 else "")
        + f": it needs {', or '.join(ways)}"
    )


def _too_large(
    lines: Sequence[Line], sums: _Sums, limits: DiveLimits, energy_j: float, time_s: float
) -> str:
    """How much fits one dive, and the ways out."""
    fitting = [i for i in range(len(lines)) if limits.hold(*sums.of(0, i))]
    last = fitting[-1] if fitting else -1
    done = sum(line.length_m for line in lines[: last + 1])
    share = done / max(sum(line.length_m for line in lines), 1e-9)
    parted = _least_dives(sums, limits)
    ways = []
    if parted is not None:
        ways.append(f"split_dives = true ({len(parted)} dives)")
    if energy_j > limits.energy_j:
        ways.append(f"a battery with {_wh(energy_j)} above its reserve (vehicle.battery_wh)")
    if time_s > limits.time_s:
        ways.append(f"plan.dive_s = {math.ceil(time_s)}")
    ways.append(f"survey no more than the {share:.0%} that fit")
    return (
        f"{len(lines)} lines take {_numbers(energy_j, time_s)}, but one dive has "
        f"{_allowed(limits)}: the first {last + 1} lines fit ({done:.0f} m, {share:.0%}); "
        + ", or ".join(ways)
    )


def _numbers(energy_j: float, time_s: float) -> str:
    return f"{_wh(energy_j)} and {time_s / 3600.0:.2f} h"


def _allowed(limits: DiveLimits) -> str:
    longest = f" and {limits.time_s / 3600.0:.2f} h" if math.isfinite(limits.time_s) else ""
    return f"{_wh(limits.energy_j)}{longest}"


def _wh(energy_j: float) -> str:
    value = energy_j / _J_PER_WH
    return f"{value:.0f} Wh" if value >= 100.0 else f"{value:.3g} Wh"
