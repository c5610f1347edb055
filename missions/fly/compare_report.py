"""The comparison of both configurations next to the paper's figures: as a table and pictures."""

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.artefacts import write_csv, write_json
from alice_survey.core.config import SeaConfig, SurveyConfig, changed, parse_current
from alice_survey.core.errors import ConfigError
from alice_survey.core.executor import Executor, local_executor
from alice_survey.core.frames import Array
from alice_survey.core.text_table import text_table
from alice_survey.kit.figure import Axes, figure_style, new_figure, save_figure
from camera_calib.rig import design_rig
from missions.fly.compare import (
    EQUAL,
    IMPROVED,
    ORIGINAL,
    PAPER,
    Case,
    CaseResult,
    Outcome,
    Summary,
    Trace,
    Variant,
    default_cases,
    fly_all,
    summarised,
    variants_of,
)
from missions.fly.flight_plots import BAND, draw_lines
from missions.fly.flight_route import whole_route
from missions.fly.simulation import flight_settings
from missions.plan.planner import plan_survey
from missions.values.plan_file import Plan

_PAPER_SPACING_M = 1.0
_HEADER = (
    "configuration", "lines: true", "believed", "route: true", "believed", "heading", "roll",
    "(worst)", "surge", "(worst)", "yaw rate", "energy", "duration", "complete",
)  # fmt: skip
_UNITS = ("", "m", "m", "m", "m", "deg", "deg", "deg", "m/s", "m/s", "deg/s", "Wh", "s", "")
_AROUND_M = 3.2
"""Margin around the lines that a map shows: the turns, not the way in."""
_COLUMNS = 3
"""Most variants that a figure shows."""
_COLOURS = ("#c0392b", "#ca6f1e", "#1b4f72")
_PAPER, _WAY = "#5d6d7e", "#aab7b8"


def compare_report(
    config: SurveyConfig,
    out: Path,
    *,
    currents: Sequence[str] = (),
    swell: str | None = None,
    seed: int | None = None,
    flights: int = 5,
    executor: Executor | None = None,
    vehicles: Sequence[str] = (),
) -> tuple[str, dict[str, Any]]:
    """Fly a survey by both configurations, and write table, figures and pictures.

    Args:
        config: the survey; lines are 1 m apart, as the paper's, where it does not say.
        out: folder to write.
        currents: `SPEED@DIRECTION`; `default_cases` when left out.
        swell: `HEIGHT@PERIOD`, m and s, of waves that travel across the lines in all currents.
        seed: of the first flight; the survey's when left out.
        flights: of each variant in each current.
        executor: where tasks run; all cores of this machine when left out.
        vehicles: names or files of the vehicles to compare; the paper's two configurations when
            left out.

    Returns:
        Text, and the same as values for JSON.

    Raises:
        ConfigError: a current or swell is not of that form, or the folder cannot be written.
    """
    variants = variants_of(vehicles)
    # Turns that all can fly.
    config = changed(config, "plan", turns="arcs")
    if config.plan.line_spacing_m is None:
        config = changed(config, "plan", line_spacing_m=_PAPER_SPACING_M)
    plan = plan_survey(config, design_rig(config.camera, config.water)).plan
    cases = [_case(text) for text in currents] or list(default_cases(plan))
    if swell is not None:
        cases = [_with_swell(plan, case, swell) for case in cases]
    first = config.seed if seed is None else seed
    seeds = list(range(first, first + flights))
    settings = flight_settings(config)
    outcomes = list(fly_all(settings, plan, cases, seeds, executor or local_executor(), variants))
    results = [_result(plan, case, outcomes, variants) for case in cases]
    text = "\n\n".join([
        _heading(plan, config.sea, seeds), *(_table(result) for result in results),
        *(["Why they differ from the paper: docs/vehicle-comparison.md"] if not vehicles else []),
    ])  # fmt: skip
    data = _data(plan, seeds, results, variants)
    try:
        out.mkdir(parents=True, exist_ok=True)
        write_json(out / "compare.json", data)
        _write_flights(out / "flights.csv", outcomes)
        (out / "compare.txt").write_text(text + "\n", encoding="utf-8")
        for result in results:
            draw_case(out / f"compare_{_file_name(result.case)}.png", plan, result)
    except OSError as error:
        raise ConfigError(f"{error.filename}: cannot be written: {error.strerror}") from None
    return f"{text}\n\nwrote {out}", data


def _heading(plan: Plan, sea: SeaConfig, seeds: Sequence[int]) -> str:
    size = [max(axis) - min(axis) for axis in plan.area.corners_ne.T]
    return (
        f"{size[0]:g} x {size[1]:g} m, {len(plan.lines)} lines {plan.line_spacing_m:g} m apart, "
        f"{plan.altitude_m:g} m above the sea floor at {plan.speed_mps:g} m/s; current varying by "
        f"{sea.current_sigma_mps:g} m/s, gusts of {'/'.join(f'{g:g}' for g in sea.gust_n)} N; "
        f"{len(seeds)} flight{'s' if len(seeds) > 1 else ''} of each, the same water for all.\n"
        "Cross-track rms of the body's origin, on lines and on the whole route; roll, surge and "
        "yaw rate: mean peak of the turns, (worst of all); mean ± standard deviation over flights."
    )


def _table(result: CaseResult) -> str:
    rows: list[tuple[str, ...]] = [_UNITS]
    rows += [_paper_row(name) for name in (ORIGINAL, IMPROVED) if name in result.summaries]
    rows += [_row(name, summary) for name, summary in result.summaries.items()]
    return f"{result.title}\n{text_table(_HEADER, rows)}"


def _paper_row(name: str) -> tuple[str, ...]:
    paper = PAPER[name]

    def span(key: str) -> str:
        if key not in paper:
            return ""
        minimum, maximum = paper[key]
        return (
            f"{maximum:g}"
            if minimum == maximum
            else (f"< {maximum:g}" if not minimum else f"{minimum:g}-{maximum:g}")
        )

    return (
        f"paper, {name}", span("cross_track_rms_m"), "", "", "", "", span("roll_in_turns_deg"), "",
        span("surge_in_turns_mps"), "", span("yaw_in_turns_deg_s"), "", "", "",
    )  # fmt: skip


def _row(name: str, summary: Summary) -> tuple[str, ...]:
    def cell(key: str, digits: int) -> str:
        mean, sd = summary[key]["mean"], summary[key].get("sd")
        return f"{mean:.{digits}f}" + (f" ±{sd:.{digits}f}" if sd is not None else "")

    def maximum(key: str, digits: int) -> str:
        return f"({summary[key]['most']:.{digits}f})"

    return (
        name,
        cell("lines_true_m", 3),
        cell("lines_believed_m", 3),
        cell("route_true_m", 3),
        cell("route_believed_m", 3),
        cell("heading_rms_deg", 1),
        cell("turn_roll_peak_deg", 1),
        maximum("turn_roll_worst_deg", 1),
        cell("turn_surge_peak_mps", 2),
        maximum("turn_surge_worst_mps", 2),
        cell("turn_yaw_peak_deg_s", 0),
        cell("survey_energy_wh", 1),
        cell("survey_s", 0),
        f"{summary['complete']['mean']:.0%}",
    )


def _data(
    plan: Plan,
    seeds: Sequence[int],
    results: Sequence[CaseResult],
    variants: Sequence[Variant],
) -> dict[str, Any]:
    return {
        "paper": PAPER,
        "followed_point": "body origin",
        "plan": {
            "lines": len(plan.lines),
            "line_spacing_m": plan.line_spacing_m,
            "speed_mps": plan.speed_mps,
            "altitude_m": plan.altitude_m,
        },
        "seeds": list(seeds),
        "variants": {
            variant.name: {**asdict(variant), "failed": list(variant.failed)}
            for variant in variants
        },
        "cases": [
            {
                "current": result.case.name,
                "across_mps": result.across_mps,
                "along_mps": result.along_mps,
                "look_ahead_m": {o.variant: o.look_ahead_m for o in result.outcomes},
                "variants": {
                    name: {
                        figure: {key: _known(value) for key, value in values.items()}
                        for figure, values in summary.items()
                    }
                    for name, summary in result.summaries.items()
                },
            }
            for result in results
        ],
    }


def _result(
    plan: Plan, case: Case, outcomes: Sequence[Outcome], variants: Sequence[Variant]
) -> CaseResult:
    mine = tuple(outcome for outcome in outcomes if outcome.case == case)
    turned = math.radians(case.towards_deg) - plan.lines[0].heading_rad
    return CaseResult(
        case=case,
        across_mps=case.current_mps * math.sin(turned),
        along_mps=case.current_mps * math.cos(turned),
        outcomes=mine,
        summaries={
            variant.name: summarised([o for o in mine if o.variant == variant.name])
            for variant in variants
            if any(o.variant == variant.name for o in mine)
        },
    )


def _case(text: str) -> Case:
    speed, towards = parse_current(text)
    if speed is None or towards is None or speed < 0.0 or not math.isfinite(speed + towards):
        raise ConfigError(f"current {text!r}: give SPEED@DIRECTION with a speed of 0 or more")
    return Case(current_mps=speed, towards_deg=towards)


def _with_swell(plan: Plan, case: Case, text: str) -> Case:
    height, _, period = text.partition("@")
    try:
        found = replace(
            case, swell_m=float(height), swell_s=float(period),
            swell_towards_deg=math.degrees(plan.lines[0].heading_rad) + 90.0,
        )  # fmt: skip
    except ValueError:
        found = case
    if found is case or not (0.0 <= found.swell_m < math.inf and 0.0 < found.swell_s < math.inf):
        raise ConfigError(f"swell {text!r}: give HEIGHT@PERIOD, m and s, as 0.5@6")
    return found


def _write_flights(path: Path, outcomes: Sequence[Outcome]) -> None:
    names = list(asdict(outcomes[0].figures))
    write_csv(
        path,
        [
            "configuration", "current_mps", "towards_deg", "swell_m", "swell_s", "seed", "ending",
            "look_ahead_m", *names,
        ],
        (
            [
                o.variant, o.case.current_mps, o.case.towards_deg, o.case.swell_m,
                o.case.swell_s, o.seed, o.ending,
                round(o.look_ahead_m, 6),
                *(round(value, 6) for value in asdict(o.figures).values()),
            ]
            for o in outcomes
        ),
    )  # fmt: skip


def _file_name(case: Case) -> str:
    swell = f"_swell_{case.swell_m:g}m" if case.swell_m > 0.0 else ""
    return f"{case.current_mps:g}mps_{case.towards_deg:g}deg{swell}".replace(".", "p")


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


@figure_style()
def draw_case(path: Path, plan: Plan, result: CaseResult) -> None:
    """Draw the tracks over the plan, cross-track and roll along the mission, and bars.

    The tracks are of the first flight, the bars of all.
    """
    figure = new_figure(11, 15)
    grid = figure.add_gridspec(3, 3, height_ratios=(1.6, 1, 1))
    shown = [name for name in (ORIGINAL, EQUAL, IMPROVED) if name in result.summaries]
    shown = shown or list(result.summaries)[:_COLUMNS]
    colours = dict(zip(shown, _COLOURS, strict=False))
    traced = {o.variant: o for o in result.outcomes if o.trace is not None}
    first = None
    for column, name in enumerate(shown):
        chart = figure.add_subplot(grid[0, column], sharex=first, sharey=first)
        first = first or chart
        _draw_track(chart, plan, traced[name], colours[name], column == 0)
    cross, roll = (figure.add_subplot(grid[row, :2]) for row in (1, 2))
    _draw_strip(cross, traced, colours, "cross_m")
    cross.set_ylabel("true cross-track, m")
    cross.axhspan(-0.12, 0.12, color=BAND, zorder=0, label="paper's rms, improved (shaded)")
    _legend(cross)
    _draw_strip(roll, traced, colours, "roll_deg")
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
        _draw_bars(figure.add_subplot(bars[row]), result, colours, title, paper, figures)
    figure.suptitle(f"{plan.name}, {result.title}", x=0.01, ha="left", fontsize=12, weight="bold")
    save_figure(figure, path, dpi=110)


def _draw_track(axes: Axes, plan: Plan, outcome: Outcome, colour: str, labelled: bool) -> None:
    draw_lines(axes, plan)
    route = whole_route(plan)
    way = route.places(np.linspace(0.0, route.length_m, 4000))
    axes.plot(way[:, 1], way[:, 0], color=_WAY, lw=0.8, zorder=1, label="planned route")
    track = _traced(outcome).true_ne
    axes.plot(track[:, 1], track[:, 0], color=colour, lw=1.1, label="true track")
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


def _draw_strip(
    axes: Axes, traced: dict[str, Outcome], colours: dict[str, str], field: str
) -> None:
    for name, colour in colours.items():
        trace = _traced(traced[name])
        if not len(trace.time_s):  # it never came to the route
            continue
        share = trace.time_s / trace.time_s[-1]
        values: Array = getattr(trace, field)
        axes.plot(share, values, color=colour, lw=0.8, label=name)
    axes.axhline(0, color="#7f8c8d", lw=0.6)
    axes.grid(visible=False, axis="x")
    axes.margins(x=0.005)


def _draw_bars(
    axes: Axes,
    result: CaseResult,
    colours: dict[str, str],
    title: str,
    paper: str,
    figures: tuple[str, ...],
) -> None:
    """Bars of some figures of each variant, with their spread, next to the paper's span."""
    width = 0.8 / (1 + len(figures))
    top = 0.0
    for i, (name, colour) in enumerate(colours.items()):
        printed = PAPER.get(name, PAPER[ORIGINAL] if name == EQUAL else {}).get(paper)
        if printed is not None:
            minimum, maximum = printed
            bottom = 0.0 if minimum == maximum else minimum
            axes.bar(
                i - 0.4 + width / 2, maximum - bottom, width * 0.9, bottom=bottom, color=_PAPER,
                hatch="//", edgecolor="white", lw=0, label="paper" if i == 0 else None,
            )  # fmt: skip
            text = (
                f"{maximum:g}"
                if minimum == maximum
                else (f"{minimum:g}-{maximum:g}" if minimum else f"<{maximum:g}")
            )
            axes.annotate(
                text, (i - 0.4 + width / 2, maximum), ha="center", va="bottom", fontsize=7.5
            )
            top = max(top, maximum)
        for j, figure in enumerate(figures):
            found = result.summaries[name][figure]
            x = i - 0.4 + (j + 1.5) * width
            axes.bar(
                x, found["mean"], width * 0.9, yerr=found.get("sd"), color=colour,
                alpha=1.0 if j == 0 else 0.5, error_kw={"lw": 0.9, "capsize": 2},
            )  # fmt: skip
            reach = found["mean"] + found.get("sd", 0.0)
            axes.annotate(
                f"{found['mean']:.2f}" if reach < 2 else f"{found['mean']:.1f}", (x, reach),
                xytext=(0, 1), textcoords="offset points", ha="center", va="bottom", fontsize=7.5,
            )  # fmt: skip
            top = max(top, reach)
    axes.set_ylim(0, 1.2 * top)
    axes.set_xticks(range(len(colours)), list(colours), fontsize=8)
    said = " (full: lines, pale: whole route; hatched: paper)" if len(figures) > 1 else ""
    axes.set_title(title + said, loc="left", fontsize=8.5)
    axes.tick_params(axis="y", labelsize=7.5)
    axes.grid(visible=False, axis="x")


def _legend(axes: Axes) -> None:
    axes.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncol=4, fontsize=8, frameon=False,
        borderaxespad=0.0,
    )  # fmt: skip


def _traced(outcome: Outcome) -> Trace:
    if outcome.trace is None:
        raise ValueError(f"the flight of seed {outcome.seed} was not traced")
    return outcome.trace
