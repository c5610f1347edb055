"""The table of all benchmarks: medians and spread over the repeats, in Markdown and JSON."""

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from alice_survey.core.artefacts import atomic_path, write_json
from benchmarks.figures import markdown, number
from benchmarks.measured import Cost

DONE, MISSED, FAILED, LEFT_OUT = "done", "goal missed", "failed", "left out"


@dataclass(frozen=True, kw_only=True)
class Run:
    """One run of a part."""

    cost: Cost
    load_before: str
    report: dict[str, Any] | None
    """What it handed over; None where it ended before."""

    @property
    def trouble(self) -> str | None:
        """Why it is not a measurement, though goals may be missed; None where it is one."""
        ended = f"ended with exit code {self.cost.code}"
        if self.report is None:
            return f"{ended}: {self.cost.last_line()}"
        if self.report["failed"]:
            return "; ".join(self.report["failed"])
        if self.cost.code and not self.report["missed"]:
            return f"{ended} after its figures: {self.cost.last_line()}"
        return None


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of a part."""

    name: str
    command: str
    state: str
    reason: str | None = None
    """Why it failed or was left out."""
    runs: tuple[Run, ...] = ()
    figures: tuple[dict[str, Any], ...] = ()
    """As `summaries` has them."""
    missed: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    @property
    def good(self) -> bool:
        """Whether nothing failed or fell short."""
        return self.state in (DONE, LEFT_OUT)


def outcome(name: str, command: str, runs: Sequence[Run]) -> Outcome:
    """What a part's runs, one or more, come to."""
    reports = [run.report for run in runs if run.report is not None]
    trouble = next((run.trouble for run in runs if run.trouble is not None), None)
    missed = _each_once(goal for report in reports for goal in report["missed"])
    left_out = _each_once(what for report in reports for what in report["left_out"])
    figures = summaries([report["figures"] for report in reports])
    state, reason = DONE, None
    if trouble is not None:
        state, reason = FAILED, trouble
    elif missed:
        state = MISSED
    elif not figures:
        state, reason = LEFT_OUT, "; ".join(left_out) or "it measured nothing"
    return Outcome(
        name=name, command=command, state=state, reason=reason, runs=tuple(runs),
        figures=figures, missed=missed, left_out=left_out,
    )  # fmt: skip


def _each_once(texts: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(texts))


def summaries(repeats: Sequence[Sequence[Mapping[str, Any]]]) -> tuple[dict[str, Any], ...]:
    """Figures of the same name and peer over all repeats, in the order they first come in.

    Args:
        repeats: `figures` of each run's JSON.

    Returns:
        For each `name`, `unit`, `peer`, `goal`; `repeats` that have a number, `median`, `minimum`,
        `maximum`, `peer_median`, `ratio` (median of each repeat's own; None without a number); and
        how many repeats have the goal, `judged`, and met it, `met`.
    """
    by_key: dict[tuple[str, str | None], list[Mapping[str, Any]]] = {}
    for figures in repeats:
        for figure in figures:
            by_key.setdefault((figure["name"], figure["peer"]), []).append(figure)
    return tuple(_summary(rows) for rows in by_key.values())


def _summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    values = [row["value"] for row in rows if row["value"] is not None]
    goals = [row for row in rows if row["goal"] is not None]
    return {
        **{key: rows[0][key] for key in ("name", "unit", "peer")},
        "goal": goals[0]["goal"] if goals else None,
        "repeats": len(values),
        "median": _median(values),
        "minimum": min(values, default=None),
        "maximum": max(values, default=None),
        "peer_median": _median([row["peer_value"] for row in rows]),
        "ratio": _median([row["ratio"] for row in rows]),
        "judged": len(goals),
        "met": sum(row["met"] for row in goals),
    }


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


def write(folder: Path, about: Mapping[str, Any], outcomes: Sequence[Outcome]) -> None:
    """Write `table.md` and `table.json`, each whole or not at all.

    Args:
        folder: to write to.
        about: `date`, `command`, `quick`, `commit`, and `machine` with its versions.
        outcomes: of all parts.
    """
    versions = {**about["machine"]["versions"]}
    for part in outcomes:
        for run in part.runs:
            versions |= (run.report or about)["machine"]["versions"]
    whole = {**about, "machine": {**about["machine"], "versions": versions}}
    rows = [
        {**vars(part), "runs": [{**vars(run.cost), "log": str(run.cost.log)} for run in part.runs]}
        for part in outcomes
    ]
    write_json(folder / "table.json", {**whole, "parts": rows})
    with atomic_path(folder / "table.md") as temporary:
        temporary.write_text(_text(whole, outcomes), encoding="utf-8")


def _text(about: Mapping[str, Any], outcomes: Sequence[Outcome]) -> str:
    machine = about["machine"]
    versions = ", ".join(f"{name} {number}" for name, number in machine["versions"].items())
    quick = ", **quick: fewer and smaller cases than the figures are for**" * about["quick"]
    lines = [
        "# Benchmarks",
        "",
        f"- {about['date']}, by `{about['command']}`{quick}",
        f"- {machine['processor']}, {machine['cores']} cores, {machine['system']}",
        f"- {versions}",
        f"- sources: {about['commit'] or 'unknown'}",
        "",
        "A ratio is the value over the peer's of the same run; spread is least to most over the",
        "repeats; a goal is met where every repeat meets it.",
        "",
    ]
    parts = [
        {
            "part": part.name,
            "outcome": part.state if part.reason is None else f"{part.state}: {part.reason}",
            "runs, s": ", ".join(f"{run.cost.wall_s:.0f}" for run in part.runs),
            "load before": part.runs[0].load_before if part.runs else "",
            "command": f"`{part.command}`",
        }
        for part in outcomes
    ]
    lines += markdown(parts)
    for part in outcomes:
        if part.figures or part.missed or part.left_out:
            lines += [f"## {part.name}", "", *markdown(list(map(_figure_row, part.figures)))]
            lines += [f"- missed: {goal}" for goal in part.missed]
            lines += [f"- left out: {what}" for what in part.left_out]
    return "\n".join(lines) + "\n"


def _figure_row(figure: Mapping[str, Any]) -> dict[str, str]:
    met, judged = figure["met"], figure["judged"]
    spread = f"{number(figure['minimum'])} to {number(figure['maximum'])}"
    return {
        "figure": figure["name"],
        "median": number(figure["median"]),
        "spread": spread if figure["repeats"] > 1 else "",
        "unit": figure["unit"],
        "peer": figure["peer"] or "",
        "its median": number(figure["peer_median"]),
        "ratio": number(figure["ratio"]),
        "goal": figure["goal"] or "",
        "met": f"{'yes' if met == judged else 'NO'}, {met} of {judged}" if judged else "",
    }
