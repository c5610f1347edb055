"""How long the studio takes to plan again, next to a whole `plan` in the same run.

    .venv/bin/python -m benchmarks.studio [--quick] [--json FILE]

A re-plan is what a page waits for when a setting changes: the draft of `survey.toml`, the plan, and
its JSON; warm, of one core, the median of some with another setting each. The whole stage plans,
certifies on the fine grid, and writes maps, page and missions for vehicles. Two areas: that of the
template that the tutorial starts from, and a strip of 10,000 swaths. Ends with exit code 1 when a
goal is missed.
"""

import argparse
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic_core import to_json

from alice_survey.base.config import SurveyConfig
from alice_survey.base.errors import collected_by
from alice_survey.base.executor import SERIAL
from alice_survey.survey import template_text
from benchmarks.figures import Figure, Findings, Goal, add_options, hand_over
from benchmarks.machine import heading, machine
from missions.plan.draft import Draft, drafted
from missions.plan.preview import preview
from missions.plan.run import run_plan

_GOALS_S = {"tutorial": 0.5, "10,000 swaths": 2.0}
_SPACING_M = 0.25
_SWATH_M = 6.0
_ALTITUDES_M = (0.8, 0.82, 0.81, 0.805, 0.815)
"""Of re-plans over the strip; over the tutorial's area 2.5 times as high."""


@dataclass(frozen=True, kw_only=True)
class Replan:
    """How long an area takes to plan."""

    area: str
    swaths: int
    stations: int
    cpu_s: float
    """Of a re-plan: draft, plan and JSON."""
    first_s: float
    """The same, of the first, cold."""
    megabytes: float
    """Of its JSON."""
    whole_s: float
    """Of the stage `plan`."""

    def figures(self) -> list[Figure]:
        """Computing of a re-plan, next to the whole stage."""
        most = _GOALS_S.get(self.area)
        goal = None if most is None else Goal(most=most)
        return [
            Figure(name=f"{self.area}: re-plan", value=self.cpu_s, unit="s", goal=goal),
            Figure(
                name=f"{self.area}: re-plan over a whole plan", value=self.cpu_s, unit="s",
                peer="stage plan", peer_value=self.whole_s, goal=Goal(most=0.5, of="ratio"),
            ),
        ]  # fmt: skip


def main() -> None:
    """Measure, print, and say which goals are missed."""
    options = _options()
    about = machine(("numpy", "numba", "shapely", "tomlkit"))
    print(heading(about), "\n", flush=True)
    swaths = 1_000 if options.quick else 10_000
    rows = [replanned("tutorial", {}, 2.5), replanned(f"{swaths:,} swaths", _strip(swaths), 1.0)]
    print(_table(rows), flush=True)
    figures = tuple(figure for row in rows for figure in row.figures())
    found = Findings(figures=figures)
    sys.exit(hand_over(options, about, found, {"replans": [asdict(row) for row in rows]}))


def _strip(swaths: int) -> dict[str, dict[str, Any]]:
    """Settings of a strip that lines cross, as many as are wanted."""
    return {
        "area": {"length_m": swaths * _SPACING_M - 0.01, "width_m": _SWATH_M},
        "plan": {"line_spacing_m": _SPACING_M, "line_heading_deg": 90.0, "speed_mps": 0.1,
                 "relief_m": 0.05},
        "camera": {"focal_mm": 8.0},
    }  # fmt: skip


def replanned(name: str, settings: dict[str, dict[str, Any]], scale: float) -> Replan:
    """Plan an area again and again as the studio does, and once as the command line does."""
    text = drafted(template_text(), Path("survey.toml"), settings).text
    times_s, draft, size = [], None, 0
    for altitude_m in (_ALTITUDES_M[0], *_ALTITUDES_M):
        began = time.process_time()
        draft = drafted(text, Path("survey.toml"), {"plan": {"altitude_m": scale * altitude_m}})
        found = preview(draft.config)
        size = len(to_json(found, inf_nan_mode="null"))
        times_s.append(time.process_time() - began)
        if not found["ok"]:
            raise RuntimeError(found["error"])
    assert isinstance(draft, Draft)
    return Replan(
        area=name,
        swaths=sum(line["kind"] == "survey" for line in found["lines"]),
        stations=found["totals"]["stations"],
        cpu_s=float(np.median(times_s[1:])),
        first_s=times_s[0],
        megabytes=size / 1e6,
        whole_s=_whole_s(draft.config),
    )


def _whole_s(config: SurveyConfig) -> float:
    """Computing of the stage `plan`."""
    with tempfile.TemporaryDirectory() as folder, collected_by(lambda _, __: None):
        began = time.process_time()
        run_plan(Path(folder), Path(folder), SERIAL, survey=config)
        return time.process_time() - began


def _table(rows: list[Replan]) -> str:
    lines = [
        "| area | swaths | stations | re-plan, s | first, s | JSON, MB | whole plan, s | ratio |"
    ]
    lines.append("|---" * 8 + "|")
    lines += [
        f"| {row.area} | {row.swaths:,} | {row.stations:,} | {row.cpu_s:.3f} | {row.first_s:.2f} "
        f"| {row.megabytes:.2f} | {row.whole_s:.2f} | {row.cpu_s / row.whole_s:.3f} |"
        for row in rows
    ]
    return "\n".join(lines)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Benchmark of the studio.")
    add_options(parser, quick="a strip of 1,000 swaths")
    return parser.parse_args()


if __name__ == "__main__":
    main()
