"""The planner and its peers: areas of 100 to 10,000 rows, and the search for the best heading.

    .venv/bin/python -m benchmarks.planner [--quick] [--angles] [--json FILE]

All planners lay lines over the same areas with the same spacing and angle; one meter measures all.
A peer is left out above 300 rows where it would take minutes. Ends with exit code 1 when a goal is
missed. `--angles` compares the heading that is found with the best of many (3,600), at full cost.
"""

import argparse
import math
import sys
import time
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from benchmarks.figures import Figure, Findings, Goal, add_options, hand_over
from benchmarks.machine import heading, machine
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
from missions.lines.hops import comparable
from missions.lines.lay import laid
from missions.lines.rows import Site
from missions.lines.sweep import best_heading
from missions.route.ways import Ways
from missions.values.costs import time_costs

_ROWS = (100, 300, 3_000, 10_000)
_MAX_PEER_ROWS = 300
_ANGLE_ROWS = 30
_ANGLES = 3600
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
_HEAD = (
    "| area | rows | planner | time, ms | path, m | turns | covered | outside, m | in holes, m "
    "| time ratio | path ratio |\n" + "|---" * 11 + "|"
)


@dataclass(frozen=True, kw_only=True)
class Angle:
    """The heading that is found next to the best of many."""

    area: str
    seconds: float
    cost_s: float
    best_s: float
    """Of the sampled headings."""
    width_m: float
    sampled_width_m: float
    """Least of the sampled headings."""
    sampled: int
    """Headings."""

    @property
    def ratio(self) -> float:
        """Cost that is found over the best sampled."""
        return self.cost_s / self.best_s

    def figures(self) -> list[Figure]:
        """Cost and width next to the best sampled ones, and the time of the search."""
        peer = f"best of {self.sampled:,}"
        return [
            Figure(
                name=f"{self.area}: cost at the heading found", value=self.cost_s, unit="s",
                peer=peer, peer_value=self.best_s, goal=Goal(maximum=_ANGLE_GOAL, of="ratio"),
            ),
            Figure(
                name=f"{self.area}: least total width", value=self.width_m, unit="m", peer=peer,
                peer_value=self.sampled_width_m, goal=Goal(maximum=self.sampled_width_m + 1e-9),
            ),
            Figure(name=f"{self.area}: search for the heading", value=self.seconds, unit="s"),
        ]  # fmt: skip


def main() -> None:
    """Measure, print, and say which goals are missed."""
    options = _options()
    packages = ("numpy", "numba", "shapely", "coverage-path-planner", "opencoverage")
    about, report, figures = machine(packages), dict[str, Any](), list[Figure]()
    print(heading(about), "\n", flush=True)
    if options.angles:
        angles = (
            _angles(_QUICK_ANGLE_ROWS, _QUICK_ANGLES)
            if options.quick
            else _angles(_ANGLE_ROWS, _ANGLES)
        )
        print(_angle_table(angles), "\n", flush=True)
        report["angles"] = [asdict(row) for row in angles]
        figures += [figure for row in angles for figure in row.figures()]
    else:
        table = {}
        print(_HEAD, flush=True)
        for rows in _ROWS[: 2 if options.quick else None]:
            for name, shape in shapes().items():
                results = _compared(planned_area(shape, rows, PATTERN.spacing_m, MARGIN_M), rows)
                table[name, rows] = results
                print(_rows_table(name, rows, results), flush=True)
                figures += _figures(name, rows, results)
        report["plans"] = [
            {"area": name, "rows": rows, **asdict(row)}
            for (name, rows), results in table.items()
            for row in results
        ]
        report["growth"] = growth = _growth(table)
        print("\nTime grows as rows to the power of:", growth)
        figures += [
            Figure(
                name=f"{name}: growth of time", value=g, unit="exponent of rows",
                goal=Goal(maximum=_N_LOG_N),
            )
            for name, g in growth.items()
        ]  # fmt: skip
    sys.exit(hand_over(options, about, Findings(figures=tuple(figures)), report))


def _compared(area: Any, rows: int) -> list[Measured]:
    repeats = 5 if rows <= _MAX_PEER_ROWS else 2
    planners = PLANNERS if rows <= _MAX_PEER_ROWS else {"alice-survey": own_plan}
    return [measured(name, plan(area, repeats), area) for name, plan in planners.items()]


def _figures(name: str, rows: int, results: list[Measured]) -> list[Figure]:
    own, where = results[0], f"{name}, {rows:,} rows"
    limit_s = _GOALS_S.get((name, rows), _MAX_S[1] if rows == _MAX_S[0] else math.inf)
    time_goal = Goal(maximum=1e3 * limit_s) if math.isfinite(limit_s) else None
    none = Goal(maximum=0.0)
    alone = [
        Figure(name=f"{where}: time", value=1e3 * own.seconds, unit="ms", goal=time_goal),
        Figure(name=f"{where}: covered", value=own.covered, unit="1", goal=Goal(minimum=_COVERED)),
        Figure(name=f"{where}: way outside", value=own.outside_m, unit="m", goal=none),
        Figure(name=f"{where}: way in holes", value=own.holes_m, unit="m", goal=none),
        Figure(name=f"{where}: way", value=own.path_m, unit="m"),
    ]
    compared = []
    for peer in results[1:]:
        compared += [
            Figure(
                name=f"{where}: time", value=1e3 * own.seconds, unit="ms", peer=peer.planner,
                peer_value=1e3 * peer.seconds,
            ),
            Figure(
                name=f"{where}: way", value=own.path_m, unit="m", peer=peer.planner,
                peer_value=peer.path_m,
                goal=Goal(maximum=1.0, of="ratio") if _as_good(peer, own) else None,
            ),
        ]  # fmt: skip
    return [*alone, *compared]


def _as_good(peer: Measured, own: Measured) -> bool:
    """Whether a peer's plan may be flown and sees as much, so that lengths may be compared.

    Lines that end where their own middle meets the edge are shorter, and leave its corners unseen.
    """
    return peer.covered >= own.covered - SAME_SHARE and peer.outside_m + peer.holes_m == 0


def _growth(table: dict[tuple[str, int], list[Measured]]) -> dict[str, float]:
    """Exponent of the time of the most rows over the fewest, by area."""
    names = {name for name, _ in table}
    counts = sorted({rows for _, rows in table})
    few, many = counts[0], counts[-1]
    return {
        name: round(
            math.log(table[name, many][0].seconds / table[name, few][0].seconds)
            / math.log(many / few),
            3,
        )
        for name in sorted(names)
    }


def _angles(rows: int, sampled: int) -> list[Angle]:
    costs = time_costs(0.2)
    found = []
    for name, shape in shapes().items():
        area = planned_area(shape, rows, PATTERN.spacing_m, MARGIN_M)
        ways = Ways(area.allowed)
        north, east = area.rings_ne[0][0]
        home = (float(north), float(east))
        for _ in range(2):
            began = time.perf_counter()
            sweep = best_heading(area, PATTERN, ways, costs, home, cross_lines=1, closing_line=True)
            seconds = time.perf_counter() - began
        headings = np.arange(sampled) * math.pi / sampled
        site, bounded = Site.of(area), comparable(costs)
        costs_j = [
            laid(site, h, PATTERN, ways, bounded, home, cross_lines=1, closing_line=True).energy_j
            for h in headings
        ]
        edges = np.concatenate([np.diff(ring, axis=0) for ring in area.rings_ne])
        across = np.abs(
            edges[:, 1] * np.cos(headings)[:, None] - edges[:, 0] * np.sin(headings)[:, None]
        )
        found.append(
            Angle(
                area=name,
                seconds=seconds,
                cost_s=sweep.cost_j,
                best_s=min(costs_j),
                width_m=sweep.width_m,
                sampled_width_m=float(across.sum(axis=1).min() / 2),
                sampled=sampled,
            )
        )
        print(f"{name}: {found[-1].ratio:.4f}", flush=True)
    return found


def _angle_table(rows: list[Angle]) -> str:
    lines = [
        f"| area | search, ms | cost, s | best of {rows[0].sampled:,}, s | ratio | width, m "
        "| sampled, m |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row.area} | {1e3 * row.seconds:.0f} | {row.cost_s:.0f} | {row.best_s:.0f} "
        f"| {row.ratio:.4f} | {row.width_m:.3f} | {row.sampled_width_m:.3f} |"
        for row in rows
    ]
    return "\n".join(lines)


def _rows_table(name: str, rows: int, results: list[Measured]) -> str:
    own = results[0]
    return "\n".join(
        f"| {name} | {rows:,} | {row.planner} | {1e3 * row.seconds:.2f} | {row.path_m:,.0f} "
        f"| {row.turns:,} | {row.covered:.3%} | {row.outside_m:.3g} | {row.holes_m:.3g} "
        f"| {own.seconds / row.seconds:.2f} | {own.path_m / row.path_m:.4f} |"
        for row in results
    )


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Benchmarks of the planner.")
    add_options(parser, quick="fewer rows and headings, smaller areas")
    parser.add_argument("--angles", action="store_true", help="search headings, not lines")
    return parser.parse_args()


if __name__ == "__main__":
    main()
