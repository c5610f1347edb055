"""What a workspace holds, read once and as it is."""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.base.artefacts import read_json, read_stage
from alice_survey.base.frames import Array

STAGES = (
    "plan", "flight", "pool", "images", "calibration", "mapping", "sparse", "dense", "mosaic",
    "mesh", "evaluation",
)  # fmt: skip
"""In the order in which they are made."""
LOOSE = ("quality", "reference", "against")
"""Folders that commands write next to the stages."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Held:
    """The finished stages of a workspace and their files."""

    workspace: Path
    stages: Mapping[str, Mapping[str, Any]]
    """By name, what each `stage.json` says."""

    @classmethod
    def of(cls, workspace: Path) -> "Held":
        """Look at a workspace."""
        found = {name: read_stage(workspace / name) for name in STAGES}
        return cls(workspace=workspace, stages={n: s for n, s in found.items() if s is not None})

    def has(self, *stages: str) -> bool:
        """Whether all of these stages are finished."""
        return all(stage in self.stages for stage in stages)

    def file(self, path: str) -> Path | None:
        """A file of a finished stage or of a command; None where it is not there."""
        whole = self.workspace / path
        stage = path.split("/")[0]
        there = stage in self.stages or stage not in STAGES
        return whole if there and whole.is_file() else None

    def json(self, path: str) -> dict[str, Any]:
        """The content of a JSON file; empty where it is not there."""
        file = self.file(path)
        if file is None:
            return {}
        found: dict[str, Any] = read_json(file)
        return found

    def rows(self, path: str) -> list[dict[str, str]]:
        """The rows of a CSV file; none where it is not there."""
        file = self.file(path)
        if file is None:
            return []
        with file.open(newline="", encoding="utf-8") as lines:
            return list(csv.DictReader(lines))

    @property
    def name(self) -> str:
        """The survey's, else the folder's."""
        return str(self.json("plan/plan.json").get("name") or self.workspace.resolve().name)

    @cached_property
    def simulated(self) -> bool:
        """Whether its pictures are rendered."""
        return self.json("images/survey.json").get("source") == "simulated"

    @cached_property
    def unit(self) -> str:
        """Of lengths: metres, or units of a model without scale."""
        return "m" if self.json("sparse/frame.json").get("scaled", True) else "unit"

    @cached_property
    def track(self) -> list[dict[str, str]]:
        """Rows of the camera track."""
        return self.rows("sparse/track.csv")

    @cached_property
    def earlier(self) -> Sequence[tuple[str, dict[str, Any]]]:
        """Comparisons with earlier surveys, by their names."""
        files = sorted((self.workspace / "against").glob("*/change.json"))
        return [(file.parent.name, read_json(file)) for file in files]


def known_column(rows: Sequence[Mapping[str, str]], start: str) -> Array:
    """The numbers of a column whose name begins so, without empty cells.

    Such as "area_" for `area_m2`, and for the `area_units2` of a model without scale.
    """
    name = next((name for name in (rows[0] if rows else {}) if name.startswith(start)), "")
    values = np.array([number(row, name) for row in rows], dtype=np.float64)
    known: Array = values[np.isfinite(values)]
    return known


def number(row: Mapping[str, str], name: str) -> float:
    """A cell as a number; NaN where it is empty or missing."""
    text = row.get(name) or ""
    return float(text) if text else math.nan
