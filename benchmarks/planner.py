"""The planner and its peers: areas of 100 to 10,000 rows, and the search for the best heading.

    .venv/bin/python -m benchmarks.planner [--quick] [--angles] [--json FILE]

All planners lay lines over the same areas with the same spacing and angle; one meter measures all.
A peer is left out above 300 rows where it would take minutes. Ends with exit code 1 when a goal is
missed. `--angles` compares the heading that is found with the best of many (3,600), at full cost.
"""

import math
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import numpy as np

from benchmarks.figures import Figure, Findings, Goal, Parser, hand_over
from benchmarks.planner_areas import planned_area, shapes
from benchmarks.planner_peers import (
    MARGIN_M,
    PATTERN,
    PLANNERS,
    SAME_SHARE,
    Measured,
    measured,
    own_plan,
)
from missions.lines.lay import LineTask, lay_pattern
from missions.lines.sweep import best_heading
from missions.route.ways import Ways
from tests.oracles_route import time_costs

_ROWS = (100, 300, 3_000, 10_000)
_MAX_PEER_ROWS = 300
_ANGLE_ROWS, _ANGLES = 30, 3600
_QUICK_ANGLE_ROWS, _QUICK_ANGLES = 12, 600
_COVERED = 0.999
_ANGLE_GOAL = 1.005
_N_LOG_N = 1.15
"""Exponent of n log n between 100 and 10,000 rows is 1.15: log(200) / log(100)."""
_GOALS_S = {
    ("L, two holes", 300): 0.020,
    ("harbour, 56 piles", 100): 0.5,
    ("marina, 44 piles", 100): 0.5,
    ("quay, 24 piles", 100): 0.3,
}
_MAX_S = (10_000, 1.0)


def main() -> None:
    """Measure, print, and say which goals are missed."""
    parser = Parser(__doc__, quick="fewer rows and headings, smaller areas")
    parser.add_argument("--angles", action="store_true", help="search headings, not lines")
    options, about = parser.begin("numpy", "numba", "shapely", "coverage-path-planner")
    figures = list[Figure]()
    report: dict[str, Any] = {}
    if options.angles:
        for name in shapes():
            figures += _angle_figures(name, quick=options.quick)
    else:
        table = {}
        for rows in _ROWS[: 2 if options.quick else None]:
            for name, shape in shapes().items():
                area = planned_area(shape, rows, PATTERN.spacing_m, MARGIN_M)
                table[name, rows] = results = _compare(area, rows)
                print(f"{name}, {rows:,} rows: planned", flush=True)
                figures += _figures(name, rows, results)
        report["plans"] = [
            {"area": name, "rows": rows, **asdict(row)}
            for (name, rows), results in table.items()
            for row in results
        ]
        report["growth"] = growth = _growth(table)
        figures += [
            Figure(
                name=f"{name}: growth of time", value=exponent, unit="exponent of rows",
                goal=Goal(maximum=_N_LOG_N),
            )
            for name, exponent in growth.items()
        ]  # fmt: skip
    sys.exit(hand_over(options, about, Findings(figures=tuple(figures)), report))


def _compare(area: Any, rows: int) -> list[Measured]:
    repeats = 5 if rows <= _MAX_PEER_ROWS else 2
    planners = PLANNERS if rows <= _MAX_PEER_ROWS else {"alice-survey": own_plan}
    return [measured(name, plan(area, repeats), area) for name, plan in planners.items()]


def _figures(name: str, rows: int, results: list[Measured]) -> Iterator[Figure]:
    own, where = results[0], f"{name}, {rows:,} rows"
    limit_s = _GOALS_S.get((name, rows), _MAX_S[1] if rows == _MAX_S[0] else math.inf)
    time_goal = Goal(maximum=1e3 * limit_s) if math.isfinite(limit_s) else None
    none = Goal(maximum=0.0)
    yield Figure(name=f"{where}: time", value=1e3 * own.seconds, unit="ms", goal=time_goal)
    yield Figure(name=f"{where}: covered", value=own.covered, unit="1", goal=Goal(minimum=_COVERED))
    yield Figure(name=f"{where}: way outside", value=own.outside_m, unit="m", goal=none)
    yield Figure(name=f"{where}: way in holes", value=own.holes_m, unit="m", goal=none)
    yield Figure(name=f"{where}: way", value=own.path_m, unit="m")
    for peer in results[1:]:
        yield Figure(
            name=f"{where}: time", value=1e3 * own.seconds, unit="ms", peer=peer.planner,
            peer_value=1e3 * peer.seconds,
        )  # fmt: skip
        # Lines that end where their own middle meets the edge are shorter, and leave its corners
        # unseen: lengths are compared with peers that may be flown and see as much.
        is_like = peer.covered >= own.covered - SAME_SHARE and peer.outside_m + peer.holes_m == 0
        yield Figure(
            name=f"{where}: way", value=own.path_m, unit="m", peer=peer.planner,
            peer_value=peer.path_m, goal=Goal(maximum=1.0, of="ratio") if is_like else None,
        )  # fmt: skip


def _growth(table: dict[tuple[str, int], list[Measured]]) -> dict[str, float]:
    """Exponent of the time of the most rows over the fewest, by area."""
    counts = sorted({rows for _, rows in table})
    few, many = counts[0], counts[-1]
    ratios = {
        name: table[name, many][0].seconds / table[name, few][0].seconds
        for name in sorted({name for name, _ in table})
    }
    return {
        name: round(math.log(ratio) / math.log(many / few), 3) for name, ratio in ratios.items()
    }


def _angle_figures(name: str, *, quick: bool) -> Iterator[Figure]:
    """Cost of the heading found next to the best sampled one, and the search's time."""
    rows, sampled = (_QUICK_ANGLE_ROWS, _QUICK_ANGLES) if quick else (_ANGLE_ROWS, _ANGLES)
    peer = f"best of {sampled:,}"
    area = planned_area(shapes()[name], rows, PATTERN.spacing_m, MARGIN_M)
    north, east = area.rings_ne[0][0]
    task = LineTask(
        area=area,
        pattern=PATTERN,
        ways=Ways(area.allowed),
        costs=time_costs(0.2),
        home_ne=(float(north), float(east)),
        cross_lines=1,
        closing_line=True,
    )
    for _ in range(2):
        began = time.perf_counter()
        sweep = best_heading(task)
        seconds = time.perf_counter() - began
    headings = np.arange(sampled) * math.pi / sampled
    costs_j = [lay_pattern(task, h).energy_j for h in headings]
    yield Figure(
        name=f"{name}: cost at the heading found", value=sweep.cost_j, unit="s", peer=peer,
        peer_value=min(costs_j), goal=Goal(maximum=_ANGLE_GOAL, of="ratio"),
    )  # fmt: skip
    yield Figure(name=f"{name}: search for the heading", value=seconds, unit="s")


if __name__ == "__main__":
    main()
