"""One way for every benchmark to hand its figures over: options, goals, and the JSON they end in.

A file that `--json FILE` writes holds `machine`, `quick`, `figures` (each with `name`, `value`,
`unit`, `peer`, `peer_value`, `ratio`, `goal`, `met`), `missed` (goals, in words), `failed` (work
that went wrong), `left_out` (what could not be measured, and why) and, by names of its own, the
rows that the benchmark prints. What is not a number is null.
"""

import argparse
import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from benchmarks.machine import heading, load, machine


@dataclass(frozen=True, kw_only=True)
class Goal:
    """Bounds of a figure, or of its ratio to a peer's."""

    minimum: float | None = None
    maximum: float | None = None
    of: Literal["value", "ratio"] = "value"

    def __post_init__(self) -> None:
        if self.minimum is None and self.maximum is None:
            raise ValueError("a goal needs a bound")

    def __str__(self) -> str:
        subject = "ratio " if self.of == "ratio" else ""
        if self.minimum is None:
            return f"{subject}<= {self.maximum:.6g}"
        if self.maximum is None:
            return f"{subject}>= {self.minimum:.6g}"
        return f"{subject}{self.minimum:.6g} to {self.maximum:.6g}"

    def is_met(self, number: float) -> bool:
        """Whether a number lies within; NaN never does."""
        above = self.minimum is None or number >= self.minimum
        return above and (self.maximum is None or number <= self.maximum)


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One measured number; name and peer together occur once in a run."""

    name: str
    value: float
    unit: str
    peer: str | None = None
    """What was measured next to it, in the same run unless it says otherwise."""
    peer_value: float | None = None
    goal: Goal | None = None

    def __post_init__(self) -> None:
        if (self.peer is None) != (self.peer_value is None):
            raise ValueError(f"{self.name}: a peer has a value, and a value a peer")
        if self.goal is not None and self.goal.of == "ratio" and self.peer is None:
            raise ValueError(f"{self.name}: a goal of a ratio needs a peer")

    @property
    def ratio(self) -> float | None:
        """The value over the peer's; NaN where that is zero."""
        if self.peer_value is None:
            return None
        return self.value / self.peer_value if self.peer_value else math.nan

    @property
    def met(self) -> bool | None:
        """Whether the goal is met; None without one."""
        if self.goal is None:
            return None
        number = self.value if self.goal.of == "value" else self.ratio
        return number is not None and self.goal.is_met(number)

    def miss(self) -> str:
        """What it is and should be, in words."""
        compared = "" if self.ratio is None else f" ({self.ratio:.4g} x {self.peer})"
        return f"{self.name}: {self.value:.6g} {self.unit}{compared}, goal {self.goal}"


@dataclass(frozen=True, kw_only=True)
class Findings:
    """What a benchmark, or a part of it, has to say."""

    figures: tuple[Figure, ...] = ()
    failed: tuple[str, ...] = ()
    """Work that went wrong, in words."""
    left_out: tuple[str, ...] = ()
    """What could not be measured, and why."""

    def __add__(self, other: "Findings") -> "Findings":
        return Findings(
            figures=self.figures + other.figures,
            failed=self.failed + other.failed,
            left_out=self.left_out + other.left_out,
        )

    @property
    def missed(self) -> list[str]:
        """Goals that are missed, in words."""
        return [figure.miss() for figure in self.figures if figure.met is False]


class Parser(argparse.ArgumentParser):
    """The options that every benchmark has."""

    def __init__(self, doc: str | None, *, quick: str, work: str = "") -> None:
        """A parser.

        Args:
            doc: of the benchmark; its first line counts.
            quick: what `--quick` leaves out.
            work: what the folder of `--work` is for, where one is needed.
        """
        super().__init__(description=(doc or "").splitlines()[0])
        self.add_argument("--quick", action="store_true", help=quick)
        self.add_argument("--json", type=Path, help="write all figures to this file")
        if work:
            self.add_argument("--work", type=Path, required=True, help=work)

    def begin(self, *packages: str) -> tuple[argparse.Namespace, dict[str, Any]]:
        """Read the options, make the folder to work in, and print what it runs on.

        Args:
            packages: whose versions count.

        Returns:
            The options, and what `machine` knows.
        """
        options = self.parse_args()
        if "work" in options:
            options.work.mkdir(parents=True, exist_ok=True)
        about = machine(packages)
        print(f"{heading(about)}\n", flush=True)
        return options, about


def hand_over(
    options: argparse.Namespace,
    about: Mapping[str, Any],
    findings: Findings,
    rows: Mapping[str, Any] | None = None,
) -> int:
    """Print load, figures, what was left out, missed and failed; write the JSON where requested.

    Args:
        options: of a `Parser`.
        about: as `benchmarks.machine.machine` has it, from before the work.
        findings: all of them.
        rows: what else to keep, by name.

    Returns:
        The exit code: 1 when a goal was missed or work failed.
    """
    print(f"load after: {load()}")
    if options.json is not None:
        report = {
            "machine": dict(about),
            "quick": options.quick,
            "figures": [_as_row(figure) for figure in findings.figures],
            "missed": findings.missed,
            "failed": list(findings.failed),
            "left_out": list(findings.left_out),
            **(rows or {}),
        }
        options.json.write_text(json.dumps(plain(report), indent=2, allow_nan=False) + "\n")
    rows_of_figures = [
        {
            "figure": figure.name,
            "value": number(figure.value),
            "unit": figure.unit,
            "peer": figure.peer or "",
            "its value": number(figure.peer_value),
            "ratio": number(figure.ratio),
            "goal": "" if figure.goal is None else str(figure.goal),
        }
        for figure in findings.figures
    ]
    print(*markdown(rows_of_figures), sep="\n")
    for what in findings.left_out:
        print(f"left out: {what}")
    for miss in findings.missed:
        print(f"missed: {miss}")
    for failure in findings.failed:
        print(f"failed: {failure}")
    return 1 if findings.missed or findings.failed else 0


def _as_row(figure: Figure) -> dict[str, Any]:
    return {
        **dataclasses.asdict(figure),
        "ratio": figure.ratio,
        "goal": None if figure.goal is None else str(figure.goal),
        "met": figure.met,
    }


def plain(data: Any) -> Any:
    """The same for JSON, which has no NaN (null here) and no types of numpy."""
    if isinstance(data, np.generic):
        data = data.item()
    if isinstance(data, Mapping):
        return {key: plain(value) for key, value in data.items()}
    if isinstance(data, (list, tuple)):
        return [plain(value) for value in data]
    if isinstance(data, float) and not math.isfinite(data):
        return None
    return data


def markdown(rows: Sequence[Mapping[str, str]]) -> list[str]:
    """Rows of the same keys in Markdown, an empty line after them; nothing for no row."""
    if not rows:
        return []
    cells = [[value.replace("|", "\\|").replace("\n", " ") or "-" for value in row.values()]
             for row in rows]  # fmt: skip
    return [f"| {' | '.join(row)} |" for row in ([*rows[0]], ["---"] * len(rows[0]), *cells)] + [""]


def number(value: float | None) -> str:
    """Four digits; whole numbers in full."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:,.0f}" if value == 0 or 1e4 <= abs(value) < 1e12 else f"{value:.4g}"
