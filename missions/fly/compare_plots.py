"""A picture of both configurations in the same sea, next to what the paper reports."""

from pathlib import Path

import numpy as np

from alice_survey.base.frames import Array
from alice_survey.kit.figure import Axes, figure_style, new_figure, save_figure
from missions.fly.compare import EQUAL, IMPROVED, ORIGINAL, PAPER, CaseResult, Outcome, Trace
from missions.fly.flight_plots import BAND, draw_lines
from missions.fly.flight_route import whole_route
from missions.values.plan_file import Plan

_AROUND_M = 3.2
"""Margin around the lines that a map shows: the turns, not the way in."""
_COLOURS = {ORIGINAL: "#c0392b", EQUAL: "#ca6f1e", IMPROVED: "#1b4f72"}
_PAPER, _WAY = "#5d6d7e", "#aab7b8"


@figure_style()
def draw_case(path: Path, plan: Plan, result: CaseResult) -> None:
    """Draw the tracks over the plan, cross-track and roll along the mission, and bars.

    The tracks are of the first flight, the bars of all.
    """
    figure = new_figure(11, 15)
    grid = figure.add_gridspec(3, 3, height_ratios=(1.6, 1, 1))
    shown = [name for name in (ORIGINAL, EQUAL, IMPROVED) if name in result.summaries]
    traced = {o.variant: o for o in result.outcomes if o.trace is not None}
    first = None
    for column, name in enumerate(shown):
        chart = figure.add_subplot(grid[0, column], sharex=first, sharey=first)
        first = first or chart
        _draw_track(chart, plan, traced[name], column == 0)
    cross, roll = (figure.add_subplot(grid[row, :2]) for row in (1, 2))
    _draw_strip(cross, traced, shown, "cross_m")
    cross.set_ylabel("true cross-track, m")
    cross.axhspan(-0.12, 0.12, color=BAND, zorder=0, label="paper's rms, improved (shaded)")
    _legend(cross)
    _draw_strip(roll, traced, shown, "roll_deg")
    roll.set_ylabel("roll, °")
    _legend(roll)
    cross.sharex(roll)
    roll.set_xlabel("share of the route flown")
    bars = grid[1:, 2].subgridspec(3, 1)
    for row, (title, paper, figures) in enumerate(
        (
            ("cross-track rms, m", "cross_track_rms_m", ("lines_true_m", "route_true_m")),
            ("peak roll in turns, mean, °", "roll_in_turns_deg", ("turn_roll_peak_deg",)),
            ("peak surge in turns, mean, m/s", "surge_in_turns_mps", ("turn_surge_peak_mps",)),
        )
    ):
        _draw_bars(figure.add_subplot(bars[row]), result, shown, title, paper, figures)
    figure.suptitle(f"{plan.name}, {result.title}", x=0.01, ha="left", fontsize=12, weight="bold")
    save_figure(figure, path, dpi=110)


def _draw_track(axes: Axes, plan: Plan, outcome: Outcome, labelled: bool) -> None:
    draw_lines(axes, plan)
    route = whole_route(plan)
    way = route.places(np.linspace(0.0, route.length_m, 4000))
    axes.plot(way[:, 1], way[:, 0], color=_WAY, lw=0.8, zorder=1, label="planned route")
    track = _trace(outcome).true_ne
    axes.plot(track[:, 1], track[:, 0], color=_COLOURS[outcome.variant], lw=1.1, label="true track")
    figures = outcome.figures
    axes.set_title(
        f"{outcome.variant}: {figures.lines_true_m:.2f} m rms on lines, "
        f"{figures.route_true_m:.2f} on the route",
        loc="left", fontsize=9.5,
    )  # fmt: skip
    corners = np.array([end for line in plan.lines for end in (line.start_ne_m, line.end_ne_m)])
    (south, west), (north, east) = corners.min(axis=0), corners.max(axis=0)
    axes.set_xlim(west - _AROUND_M, east + _AROUND_M)
    axes.set_ylim(south - _AROUND_M, north + _AROUND_M)
    if labelled:
        axes.legend(loc="upper left", fontsize=7.5, frameon=True, framealpha=0.85)


def _draw_strip(axes: Axes, traced: dict[str, Outcome], names: list[str], field: str) -> None:
    for name in names:
        trace = _trace(traced[name])
        if not len(trace.time_s):  # it never came to the route
            continue
        share = trace.time_s / trace.time_s[-1]
        values: Array = getattr(trace, field)
        axes.plot(share, values, color=_COLOURS[name], lw=0.8, label=name)
    axes.axhline(0, color="#7f8c8d", lw=0.6)
    axes.grid(visible=False, axis="x")
    axes.margins(x=0.005)


def _draw_bars(
    axes: Axes,
    result: CaseResult,
    names: list[str],
    title: str,
    paper: str,
    figures: tuple[str, ...],
) -> None:
    """Bars of some figures of each variant, with their spread, next to the paper's span."""
    width = 0.8 / (1 + len(figures))
    top = 0.0
    for i, name in enumerate(names):
        printed = PAPER.get(name, PAPER[ORIGINAL] if name == EQUAL else {}).get(paper)
        if printed is not None:
            least, most = printed
            bottom = 0.0 if least == most else least
            axes.bar(
                i - 0.4 + width / 2, most - bottom, width * 0.9, bottom=bottom, color=_PAPER,
                hatch="//", edgecolor="white", lw=0, label="paper" if i == 0 else None,
            )  # fmt: skip
            text = (
                f"{most:g}" if least == most else (f"{least:g}-{most:g}" if least else f"<{most:g}")
            )
            axes.annotate(text, (i - 0.4 + width / 2, most), ha="center", va="bottom", fontsize=7.5)
            top = max(top, most)
        for j, figure in enumerate(figures):
            found = result.summaries[name][figure]
            x = i - 0.4 + (j + 1.5) * width
            axes.bar(
                x, found["mean"], width * 0.9, yerr=found.get("sd"), color=_COLOURS[name],
                alpha=1.0 if j == 0 else 0.5, error_kw={"lw": 0.9, "capsize": 2},
            )  # fmt: skip
            reach = found["mean"] + found.get("sd", 0.0)
            axes.annotate(
                f"{found['mean']:.2f}" if reach < 2 else f"{found['mean']:.1f}", (x, reach),
                xytext=(0, 1), textcoords="offset points", ha="center", va="bottom", fontsize=7.5,
            )  # fmt: skip
            top = max(top, reach)
    axes.set_ylim(0, 1.2 * top)
    axes.set_xticks(range(len(names)), names, fontsize=8)
    said = " (full: lines, pale: whole route; hatched: paper)" if len(figures) > 1 else ""
    axes.set_title(title + said, loc="left", fontsize=8.5)
    axes.tick_params(axis="y", labelsize=7.5)
    axes.grid(visible=False, axis="x")


def _legend(axes: Axes) -> None:
    axes.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncol=4, fontsize=8, frameon=False,
        borderaxespad=0.0,
    )  # fmt: skip


def _trace(outcome: Outcome) -> Trace:
    if outcome.trace is None:
        raise ValueError(f"the flight of seed {outcome.seed} was not traced")
    return outcome.trace
