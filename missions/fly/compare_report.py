"""The comparison of both configurations as a table next to the paper's figures."""

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from alice_survey.base.artefacts import write_csv, write_json
from alice_survey.base.config import SeaConfig, SurveyConfig, changed, parse_current
from alice_survey.base.errors import ConfigError
from alice_survey.base.executor import Executor, local_executor
from alice_survey.base.text_table import text_table
from camera_calib.rig import design_rig
from missions.fly.compare import (
    IMPROVED,
    ORIGINAL,
    PAPER,
    VARIANTS,
    Case,
    CaseResult,
    Outcome,
    Summary,
    default_cases,
    fly_all,
    summarised,
)
from missions.fly.compare_plots import draw_case
from missions.fly.simulation import flight_settings
from missions.plan.planner import plan_survey
from missions.values.plan_file import Plan

_PAPER_SPACING_M = 1.0
_HEADER = (
    "configuration", "lines: true", "believed", "route: true", "believed", "heading", "roll",
    "(worst)", "surge", "(worst)", "yaw rate", "energy", "duration", "complete",
)  # fmt: skip
_UNITS = ("", "m", "m", "m", "m", "deg", "deg", "deg", "m/s", "m/s", "deg/s", "Wh", "s", "")


def compare_report(
    config: SurveyConfig,
    out: Path,
    *,
    currents: Sequence[str] = (),
    swell: str | None = None,
    seed: int | None = None,
    flights: int = 5,
    executor: Executor | None = None,
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

    Returns:
        Text, and the same as values for JSON.

    Raises:
        ConfigError: a current or swell is not of that form, or the folder cannot be written.
    """
    # Turns that both forms of the vehicle can fly.
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
    outcomes = list(fly_all(settings, plan, cases, seeds, executor or local_executor()))
    results = [_result(plan, case, outcomes) for case in cases]
    text = "\n\n".join([
        _heading(plan, config.sea, seeds), *(_table(result) for result in results),
        "Why they differ from the paper: docs/vehicle-comparison.md",
    ])  # fmt: skip
    data = _data(plan, seeds, results)
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
    rows += [_paper_row(name) for name in (ORIGINAL, IMPROVED)]
    rows += [_row(name, summary) for name, summary in result.summaries.items()]
    return f"{result.title}\n{text_table(_HEADER, rows)}"


def _paper_row(name: str) -> tuple[str, ...]:
    paper = PAPER[name]

    def span(key: str) -> str:
        if key not in paper:
            return ""
        least, most = paper[key]
        return (
            f"{most:g}"
            if least == most
            else (f"< {most:g}" if not least else f"{least:g}-{most:g}")
        )

    return (
        f"paper, {name}", span("cross_track_rms_m"), "", "", "", "", span("roll_in_turns_deg"), "",
        span("surge_in_turns_mps"), "", span("yaw_in_turns_deg_s"), "", "", "",
    )  # fmt: skip


def _row(name: str, summary: Summary) -> tuple[str, ...]:
    def cell(key: str, digits: int) -> str:
        mean, sd = summary[key]["mean"], summary[key].get("sd")
        return f"{mean:.{digits}f}" + (f" ±{sd:.{digits}f}" if sd is not None else "")

    def most(key: str, digits: int) -> str:
        return f"({summary[key]['most']:.{digits}f})"

    return (
        name,
        cell("lines_true_m", 3),
        cell("lines_believed_m", 3),
        cell("route_true_m", 3),
        cell("route_believed_m", 3),
        cell("heading_rms_deg", 1),
        cell("turn_roll_peak_deg", 1),
        most("turn_roll_worst_deg", 1),
        cell("turn_surge_peak_mps", 2),
        most("turn_surge_worst_mps", 2),
        cell("turn_yaw_peak_deg_s", 0),
        cell("survey_energy_wh", 1),
        cell("survey_s", 0),
        f"{summary['complete']['mean']:.0%}",
    )


def _data(plan: Plan, seeds: Sequence[int], results: Sequence[CaseResult]) -> dict[str, Any]:
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
            for variant in VARIANTS
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


def _result(plan: Plan, case: Case, outcomes: Sequence[Outcome]) -> CaseResult:
    mine = tuple(outcome for outcome in outcomes if outcome.case == case)
    turned = math.radians(case.towards_deg) - plan.lines[0].heading_rad
    return CaseResult(
        case=case,
        across_mps=case.current_mps * math.sin(turned),
        along_mps=case.current_mps * math.cos(turned),
        outcomes=mine,
        summaries={
            variant.name: summarised([o for o in mine if o.variant == variant.name])
            for variant in VARIANTS
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
