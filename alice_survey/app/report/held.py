"""Contents of a workspace, read once and unchanged."""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np

from alice_survey.app import stages
from alice_survey.app.stages import finished_stages
from alice_survey.core.artefacts import JsonRecord, StageRecord
from alice_survey.core.frames import Array
from alice_survey.core.plane_settings import LEVEL
from alice_survey.core.records import (
    ChangeRecord,
    FrameRecord,
    PicturesRecord,
    PlaceRecord,
    PlaneRecord,
)
from missions.values.plan_file import Plan, read_plan

R = TypeVar("R", bound=JsonRecord)


@dataclass(frozen=True, kw_only=True, eq=False)
class Held:
    """The finished stages of a workspace and their files."""

    workspace: Path
    stages: Mapping[str, StageRecord]
    """Records of the finished stages except the report, by their folders."""

    @classmethod
    def of(cls, workspace: Path) -> "Held":
        """Read a workspace."""
        found = finished_stages(workspace)
        found.pop("report", None)
        return cls(workspace=workspace, stages=found)

    def has(self, *folders: str) -> bool:
        """Whether the stages of all these folders are finished."""
        return all(folder in self.stages for folder in folders)

    def file(self, path: str) -> Path | None:
        """A file of a finished stage or of a command; None where it is not there."""
        whole = self.workspace / path
        stage = path.split("/")[0]
        there = stage in self.stages or all(stage != one.folder for one in stages.STAGES)
        return whole if there and whole.is_file() else None

    def read(self, kind: type[R]) -> R | None:
        """A JSON file of a finished stage or of a command; None where it is not there."""
        file = self.file(kind.path)
        return None if file is None else kind.read(file)

    def rows(self, path: str) -> list[dict[str, str]]:
        """The rows of a CSV file; none where it is not there."""
        file = self.file(path)
        if file is None:
            return []
        with file.open(newline="", encoding="utf-8") as lines:
            return list(csv.DictReader(lines))

    @cached_property
    def plan(self) -> Plan | None:
        """The plan; None without one."""
        file = self.file("plan/plan.json")
        return None if file is None else read_plan(file)

    @property
    def name(self) -> str:
        """The survey's, else the folder's."""
        return (self.plan.name if self.plan else "") or self.workspace.resolve().name

    @cached_property
    def simulated(self) -> bool:
        """Whether its pictures are rendered."""
        pictures = self.read(PicturesRecord)
        return pictures is not None and pictures.source == "simulated"

    @cached_property
    def frame(self) -> FrameRecord:
        """Frame of the model's coordinates; as planned before there is one."""
        return self.read(FrameRecord) or FrameRecord(
            datum=None if self.plan is None else PlaceRecord(**asdict(self.plan.datum))
        )

    @cached_property
    def plane(self) -> PlaneRecord | None:
        """The plane of surface and mosaic where it is not the level one."""
        found = self.read(PlaneRecord)
        return None if found is None or found.name == LEVEL else found

    @property
    def unit(self) -> str:
        """Unit of lengths: metres, or units of a model without scale."""
        return "m" if self.frame.scaled else "unit"

    @cached_property
    def track(self) -> list[dict[str, str]]:
        """Rows of the camera track."""
        return self.rows("sparse/track.csv")

    @cached_property
    def earlier(self) -> Sequence[tuple[str, ChangeRecord]]:
        """Comparisons with earlier surveys, by their names."""
        files = sorted((self.workspace / "against").glob("*/change.json"))
        return [(file.parent.name, ChangeRecord.read(file)) for file in files]


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
