"""The heading of survey lines that costs least.

Two answers. For the total width of all cells it is exact: over a turn, the width across a direction
is half the sum of every edge's extent across it, so it is concave between the directions of edges
and least along one of them (rotating calipers carry this from convex areas, M. I. Shamos 1978, to
any area: W. H. Huang 2001 takes the same sum over cells).

For the full cost no formula is known: it jumps where a line more is needed, and turns, transits and
the current matter. A cheap estimate (energy of all pieces of lines, and of a turn to each)
is taken at many headings, at the directions of edges and just where the number of lines jumps; at
the best of these a close one (the tour is only improved, and fill lines are left out, which take
most of the time and differ little between good headings), then again near the best of all; the full
cost at the best of those.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import shapely

from alice_survey.core.errors import PlanError
from alice_survey.core.executor import progress
from alice_survey.core.frames import Array
from alice_survey.core.run.progress import step
from missions.lines import cells, hops, rows
from missions.lines.lay import LineTask, check_size, lay_pattern, survey_pieces
from missions.values.pattern import Pattern

_ESTIMATES = 1800
"""Headings at which the cost is estimated, a tenth of a degree apart, if lines are few."""
_FEW_ROWS = 400
_MIN_ESTIMATES = 360
_SPREAD = 45
"""Headings at which the close cost is taken whatever the estimate says."""
_BEST = 24
"""Best estimates at which it is taken."""
_REFINED = 4
"""Best close costs near which they are taken again."""
_TENTHS = (-3.0, -2.0, -1.0, 1.0, 2.0, 3.0)
"""Tenths of a degree on either side at which they are."""
_FEW_TENTHS = (-1.0, 1.0)
"""The same, where cells are many."""
_FULL = 16
"""Best close costs at which the full cost is taken."""
_MAX_HEADINGS = _SPREAD + 1 + _BEST + _REFINED * (_REFINED + len(_TENTHS)) + _FULL
_PROMISING = 1.15
"""A spread heading is taken if its estimate is at most this times the least."""
_FEW_CELLS = 20
"""With more cells, which take longer to order, proportionally fewer headings are tried."""
_FEW_EDGES = 300
"""With more edges of the area, fewer headings are estimated."""
_NEAR_RAD = math.radians(2.0)
_OFF_JUMP_RAD = 1e-9
"""A jump is left on the side of fewer lines by this."""


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """The best heading of survey lines; they are flown to and fro, so headings are in [0, pi)."""

    heading_rad: float
    cost_j: float
    """Energy of the whole flight from home to home, as lines are ordered (`missions.lines.hops`).
    """


@step("look for the best heading")
def best_heading(task: LineTask) -> Sweep:
    """Search the heading at which all lines cost least.

    Raises:
        PlanError: the area is too large, or cannot be flown at any heading.
    """
    check_size(task.area, task.pattern)
    width_heading, _ = min_width(task.site.survey)
    close: dict[float, float] = {}
    found: dict[float, float] = {}
    faults: list[PlanError] = []

    def take(costs_j: dict[float, float], headings: Array) -> Iterator[float]:
        for heading in np.unique(headings % math.pi).tolist():
            if heading in costs_j:
                continue
            try:
                costs_j[heading] = lay_pattern(task, heading, quick=costs_j is close).energy_j
            except PlanError as fault:
                faults.append(fault)
            yield heading

    def search() -> Iterator[float]:
        headings = _worthwhile(_headings(task), width_heading, task)
        estimates = estimate_j(task, headings)
        spread = np.append(np.arange(_SPREAD) * math.pi / _SPREAD, width_heading)
        spread = _worthwhile(spread, width_heading, task)
        promising = estimate_j(task, spread)
        spread = spread[promising <= _PROMISING * estimates.min()]
        best = headings[np.argmin(estimates)]
        share = min(1.0, _FEW_CELLS / _count_cells(task, float(best)))
        yield from take(close, spread[:: math.ceil(1 / share)])
        yield from take(close, _best(headings, estimates, _some(_BEST, share), math.radians(0.3)))
        for heading in _minimum(close, _some(_REFINED, share)):
            apart = np.abs((headings - heading + math.pi / 2) % math.pi - math.pi / 2)
            near = apart < _NEAR_RAD
            best = _best(headings[near], estimates[near], _REFINED, math.radians(0.05))
            yield from take(close, best)
            tenths = _TENTHS if share == 1.0 else _FEW_TENTHS
            yield from take(close, heading + math.radians(0.1) * np.array(tenths))
        yield from take(found, np.array(_minimum(close, _some(_FULL, share))))

    for _ in progress(search(), "headings tried", _MAX_HEADINGS):
        pass
    if not found:
        raise faults[0]
    best = _minimum(found, 1)[0]
    return Sweep(heading_rad=best, cost_j=found[best])


def _worthwhile(headings: Array, narrow: float, task: LineTask) -> Array:
    """Headings at which lines and a turn to each may cost little more than at a narrow heading.

    That spares thousands of short lines across a long strip.
    """
    costs, spacing_m = task.bounded, task.pattern.spacing_m
    known_j = float(estimate_j(replace(task, cross_lines=0), np.array([narrow]))[0])
    min_j = float(costs.line_w.min()) / costs.speed_mps * task.site.area_m2 / spacing_m
    turns = widths_m(task.site.survey, headings) / spacing_m
    kept = headings[min_j + turns * _turn_j(task) <= _PROMISING * known_j]
    return kept if len(kept) else np.array([narrow])


def _turn_j(task: LineTask) -> float:
    """Energy from the end of a line to the start of the next."""
    spacing_m = task.pattern.spacing_m
    start, goal = np.zeros((1, 3)), np.array([[0.0, spacing_m, math.pi]])
    return float(hops.hop_j(task.bounded, start, goal, np.array([spacing_m]))[0])


def _some(count: int, share: float) -> int:
    """A share of a count, at least 2."""
    return max(2, round(share * count))


def _count_cells(task: LineTask, heading_rad: float) -> int:
    """How many cells the survey lines of a heading have, at least 1."""
    pieces, _, _ = survey_pieces(task.site, heading_rad, task.pattern)
    return max(1, len(cells.chains(cells.followers(pieces))[0]) - 1)


def _minimum(costs_j: dict[float, float], count: int) -> list[float]:
    """The cheapest headings."""
    return sorted(costs_j, key=lambda x: (costs_j[x], x))[:count]


def min_width(edges: Array) -> tuple[float, float]:
    """The direction, in [0, pi), across which all cells together are narrowest, and that width.

    Args:
        edges: (E, 4) north and east of both ends of every edge of the area.
    """
    spans = edges[:, 2:] - edges[:, :2]
    directions = np.unique(np.arctan2(spans[:, 1], spans[:, 0]) % math.pi)
    widths = widths_m(edges, directions)
    minimum = int(np.argmin(np.round(widths, 9)))
    return float(directions[minimum]), float(widths[minimum])


def widths_m(edges: Array, headings: Array) -> Array:
    """Total width, (H,), of all cells across directions (H,)."""
    spans = edges[:, 2:] - edges[:, :2]
    widths = [np.abs(spans @ [-math.sin(x), math.cos(x)]).sum() / 2 for x in headings.tolist()]
    return np.array(widths)


def estimate_j(task: LineTask, headings: Array) -> Array:
    """Energy, (H,), of all pieces of lines and of a turn to each, at headings (H,)."""
    costs, totals = task.bounded, []
    for heading in headings.tolist():
        pieces, _, _ = survey_pieces(task.site, heading, task.pattern)
        width_m = np.ptp(rows.to_uv(task.site.survey, heading)[:, 1])
        linked = np.count_nonzero(cells.followers(pieces) >= 0)
        # From cell to cell the way is some turns long.
        count = 3 * len(pieces) - 2 * linked
        totals.append((np.sum(pieces[:, 2] - pieces[:, 1]), width_m, count))
    length_m, across_m, turns = np.array(totals).reshape(-1, 3).T
    both = hops.line_j(costs, 1.0, headings) + hops.line_j(costs, 1.0, headings + math.pi)
    across = hops.line_j(costs, across_m * task.cross_lines, headings + math.pi / 2)
    estimates: Array = length_m * both / 2 + across + turns * _turn_j(task)
    return estimates


def _headings(task: LineTask) -> Array:
    """Headings worth an estimate: evenly spread, along edges, and where the row count jumps."""
    site, pattern = task.site, task.pattern
    hull = shapely.get_coordinates(task.area.survey.convex_hull)
    north_0, east_0, north_1, east_1 = task.area.survey.bounds
    rows_most = math.hypot(north_1 - north_0, east_1 - east_0) / pattern.spacing_m
    effort = max(rows_most / _FEW_ROWS, len(site.survey) / _FEW_EDGES)
    count = int(np.clip(_ESTIMATES / effort, _MIN_ESTIMATES, _ESTIMATES))
    even = np.arange(count) * math.pi / count
    spans = site.survey[:, 2:] - site.survey[:, :2]
    lengths_m = np.hypot(*spans.T)
    longest = np.argsort(-lengths_m, kind="stable")[:count]
    longest = longest[lengths_m[longest] >= pattern.spacing_m]  # no line follows a shorter one
    edges = np.arctan2(spans[longest, 1], spans[longest, 0]) % math.pi
    jumps = _jumps(hull, pattern)
    if len(jumps) > count:
        jumps = jumps[np.linspace(0, len(jumps) - 1, count).astype(np.intp)]
    return np.unique(np.concatenate([even, edges, jumps]))


def _jumps(hull: Array, pattern: Pattern) -> Array:
    """Headings next to those at which the number of rows changes, on the side of fewer.

    Between two directions of the convex hull's edges the same two corners are outermost; the width
    is their distance times the sine of the angle between it and the heading.

    Args:
        hull: (N, 2) corners, closed.
        pattern: of the lines.
    """
    spans = np.diff(hull, axis=0)
    turns = np.unique(np.arctan2(spans[:, 1], spans[:, 0]) % math.pi)
    found = []
    for begin, end in zip(turns, np.append(turns[1:], turns[0] + math.pi), strict=True):
        middle = (begin + end) / 2
        across = hull @ np.array([-math.sin(middle), math.cos(middle)])
        north, east = hull[int(np.argmax(across))] - hull[int(np.argmin(across))]
        distance, bearing = math.hypot(north, east), math.atan2(east, north)
        minimum = (np.arange(1, distance / pattern.spacing_m + 2)) * pattern.spacing_m
        sine = (minimum - 2 * pattern.edge_m) / max(distance, 1e-9)
        angle = np.arcsin(sine[(sine > 0) & (sine < 1)])
        # The width grows from 0 on at the bearing, up to a quarter turn from it, and falls again.
        for heading in (bearing + angle - _OFF_JUMP_RAD, bearing - angle + _OFF_JUMP_RAD):
            inside = begin + (heading - begin) % math.pi
            found.append(inside[inside <= end] % math.pi)
    return np.concatenate(found)


def _best(headings: Array, estimates: Array, count: int, apart_rad: float) -> Array:
    """The headings of the least estimates, none within `apart_rad` of a better one."""
    chosen: list[float] = []
    for i in np.argsort(estimates, kind="stable").tolist():
        heading = float(headings[i])
        if all(
            abs((heading - c + math.pi / 2) % math.pi - math.pi / 2) >= apart_rad for c in chosen
        ):
            chosen.append(heading)
            if len(chosen) == count:
                break
    return np.array(chosen)
