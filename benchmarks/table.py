"""The table of all benchmarks: medians and spread over the repeats, in Markdown and JSON."""

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from alice_survey.core.artefacts import atomic_path, write_json
from benchmarks.runs import Run

DONE, MISSED, FAILED, LEFT_OUT = "done", "goal missed", "failed", "left out"


@dataclass(frozen=True, kw_only=True)
class Summary:
    """One figure over all repeats; None where none of them has a number."""

    name: str
    unit: str
    repeats: int
    """That have a number."""
    median: float | None
    minimum: float | None
    maximum: float | None
    peer: str | None
    peer_median: float | None
    ratio: float | None
    """Median of each repeat's own."""
    goal: str | None
    judged: int
    """Repeats that have the goal."""
    met: int
    """Of those."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of a part."""

    name: str
    command: str
    state: str
    reason: str | None
    """Why it failed or was left out."""
    wall_s: tuple[float, ...]
    load_before: str | None
    load_after: str | None
    figures: tuple[Summary, ...]
    missed: tuple[str, ...]
    left_out: tuple[str, ...]
    versions: Mapping[str, str]

    @property
    def good(self) -> bool:
        """Whether nothing failed or fell short."""
        return self.state in (DONE, LEFT_OUT)


def left_out(name: str, command: str, reason: str) -> Outcome:
    """A part that cannot run."""
    return Outcome(
        name=name, command=command, state=LEFT_OUT, reason=reason, wall_s=(), load_before=None,
        load_after=None, figures=(), missed=(), left_out=(), versions={},
    )  # fmt: skip


def outcome(name: str, command: str, runs: Sequence[Run]) -> Outcome:
    """What a part's runs, one or more, come to."""
    reports = [run.report for run in runs if run.report is not None]
    trouble = next((run.trouble for run in runs if run.trouble is not None), None)
    missed = _each_once(miss for report in reports for miss in report["missed"])
    lacking = _each_once(what for report in reports for what in report["left_out"])
    figures = summaries([report["figures"] for report in reports])
    state, reason = DONE, None
    if trouble is not None:
        state, reason = FAILED, trouble
    elif missed:
        state = MISSED
    elif not figures:
        state, reason = LEFT_OUT, "; ".join(lacking) or "it measured nothing"
    return Outcome(
        name=name,
        command=command,
        state=state,
        reason=reason,
        wall_s=tuple(run.wall_s for run in runs),
        load_before=runs[0].load_before,
        load_after=runs[-1].load_after,
        figures=figures,
        missed=missed,
        left_out=lacking,
        versions={k: v for report in reports for k, v in report["machine"]["versions"].items()},
    )


def summaries(repeats: Sequence[Sequence[Mapping[str, Any]]]) -> tuple[Summary, ...]:
    """Figures of the same name and peer over all repeats, in the order they first come in.

    Args:
        repeats: `figures` of each run's JSON.
    """
    by_key: dict[tuple[str, str | None], list[Mapping[str, Any]]] = {}
    for figures in repeats:
        for figure in figures:
            by_key.setdefault((figure["name"], figure["peer"]), []).append(figure)
    return tuple(_summary(name, peer, rows) for (name, peer), rows in by_key.items())


def _summary(name: str, peer: str | None, rows: Sequence[Mapping[str, Any]]) -> Summary:
    values = [row["value"] for row in rows if row["value"] is not None]
    goals = [row for row in rows if row["goal"] is not None]
    return Summary(
        name=name,
        unit=rows[0]["unit"],
        repeats=len(values),
        median=_median(values),
        minimum=min(values, default=None),
        maximum=max(values, default=None),
        peer=peer,
        peer_median=_median([row["peer_value"] for row in rows]),
        ratio=_median([row["ratio"] for row in rows]),
        goal=goals[0]["goal"] if goals else None,
        judged=len(goals),
        met=sum(row["met"] for row in goals),
    )


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


def _each_once(texts: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(texts))


def write(folder: Path, about: Mapping[str, Any], outcomes: Sequence[Outcome]) -> None:
    """Write `table.md` and `table.json`, each whole or not at all.

    Args:
        folder: to write to.
        about: `date`, `command`, `quick`, `commit`, and `machine` with its versions.
        outcomes: of all parts.
    """
    versions = {**about["machine"]["versions"]}
    for part in outcomes:
        versions |= part.versions
    whole = {**about, "machine": {**about["machine"], "versions": versions}}
    parts = [{**asdict(part), "versions": dict(part.versions)} for part in outcomes]
    write_json(folder / "table.json", {**whole, "parts": parts})
    with atomic_path(folder / "table.md") as temporary:
        temporary.write_text(markdown(whole, outcomes), encoding="utf-8")


def markdown(about: Mapping[str, Any], outcomes: Sequence[Outcome]) -> str:
    """The table for people."""
    machine = about["machine"]
    versions = ", ".join(f"{name} {number}" for name, number in machine["versions"].items())
    lines = [
        "# Benchmarks",
        "",
        f"- {about['date']}, by `{about['command']}`"
        + (", **quick: fewer and smaller cases than the figures are for**" * about["quick"]),
        f"- {machine['processor']}, {machine['cores']} cores, {machine['system']}",
        f"- {versions}",
    ]
    if about["commit"] is not None:
        lines.append(f"- sources: {about['commit']}")
    lines += [
        "",
        "A ratio is the value over the peer's of the same run; spread is least to most over the",
        "repeats; a goal is met where every repeat meets it. Load: 1, 5 and 15 minutes.",
        "",
        "| part | outcome | runs, s | load before | load after | command |",
        "|---|---|---|---|---|---|",
        *(_part_row(part) for part in outcomes),
    ]
    for part in outcomes:
        lines += _section(part)
    return "\n".join(lines) + "\n"


def _part_row(part: Outcome) -> str:
    seconds = ", ".join(f"{s:.0f}" for s in part.wall_s) or "-"
    loads = [(load or "-").removesuffix(" (1, 5, 15 min)") for load in
             (part.load_before, part.load_after)]  # fmt: skip
    state = part.state if part.reason is None else f"{part.state}: {part.reason}"
    cells = (part.name, state, seconds, *loads)
    return _row([*(_safe(cell) for cell in cells), f"`{_safe(part.command)}`"])


def _section(part: Outcome) -> list[str]:
    if not (part.figures or part.missed or part.left_out):
        return []
    lines = ["", f"## {part.name}", ""]
    if part.figures:
        lines += [
            "| figure | median | spread | unit | peer | its median | ratio | goal | met |",
            "|---|---|---|---|---|---|---|---|---|",
            *(_figure_row(figure) for figure in part.figures),
            "",
        ]
    lines += [f"- missed: {miss}" for miss in part.missed]
    lines += [f"- left out: {what}" for what in part.left_out]
    return lines if lines[-1] else lines[:-1]


def _figure_row(figure: Summary) -> str:
    met = "-"
    if figure.goal is not None:
        met = f"{'yes' if figure.met == figure.judged else 'NO'}, {figure.met} of {figure.judged}"
    spread = f"{number(figure.minimum)} to {number(figure.maximum)}"
    return _row(
        [
            _safe(figure.name),
            number(figure.median),
            spread if figure.repeats > 1 else "-",
            figure.unit,
            _safe(figure.peer or "-"),
            number(figure.peer_median),
            number(figure.ratio),
            figure.goal or "-",
            met,
        ]
    )


def number(value: float | None) -> str:
    """Four digits; whole numbers in full."""
    if value is None:
        return "-"
    if value == 0 or 1e4 <= abs(value) < 1e12:
        return f"{value:,.0f}"
    digits = f"{value:.4g}"
    return digits if math.isfinite(value) else "-"


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _safe(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
