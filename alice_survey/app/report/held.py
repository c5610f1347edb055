"""Contents of a workspace, read once and unchanged, and the key figures in them."""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from alice_survey.app import stages
from alice_survey.app.stages import finished_stages
from alice_survey.core.artefacts import JsonRecord, StageRecord
from alice_survey.core.config import LEVEL
from alice_survey.core.records import (
    ChangeRecord,
    FrameRecord,
    MosaicRecord,
    PicturesRecord,
    PlaceRecord,
    PlaneRecord,
    RegistrationRecord,
)
from alice_survey.kit.words import count
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
        """Frame of the model's coordinates; of the plan or the pictures before there is one."""
        pictures = self.read(PicturesRecord)
        place = None if pictures is None else pictures.datum
        if self.plan is not None:
            place = PlaceRecord(**asdict(self.plan.datum))
        return self.read(FrameRecord) or FrameRecord(datum=place)

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

    @cached_property
    def registration(self) -> RegistrationRecord | None:
        """Which pictures are in the model, and how it got its place."""
        return self.read(RegistrationRecord)

    @property
    def pictures(self) -> str:
        """Pictures of the model, and the places at which they were taken."""
        number = 0 if self.registration is None else self.registration.registered
        stations = len({row["station"] for row in self.track})
        return f"{count(number, 'picture')} taken at {count(stations, 'station')}"

    @cached_property
    def surface(self) -> "Surface | None":
        """The DEM, block by block; None without one."""
        return None if self.file("dense/dem.tif") is None else _surface(self)

    @property
    def pixel_m(self) -> float:
        """Pixel of the mosaic, in the model's unit; NaN without one."""
        mosaic = self.read(MosaicRecord)
        return math.nan if mosaic is None else mosaic.pixel

    @property
    def place_sigma_m(self) -> float:
        """Horizontal sigma of a camera on the Earth, root mean square; NaN of a model elsewhere."""
        names = ("sigma_north_m", "sigma_east_m")
        rows = [] if self.frame.datum is None else self.track
        level = np.array([[number(row, name) for name in names] for row in rows]).reshape(-1, 2)
        known = level[np.isfinite(level).all(axis=1)]
        return float(np.sqrt((known**2).sum(axis=1).mean())) if len(known) else math.nan


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Figures of the DEM, of the planned area alone where there is a plan."""

    area: float
    """Area of all known cells, square units."""
    cell: float
    low: float
    high: float
    sigma_median: float
    """Sigma of the heights; NaN where none is stated."""
    sigma_95: float
    unchecked: float
    """Share of the cells that fewer than three stations see."""
    covered: float
    """Share of the planned area with a height; NaN without a plan."""


def _surface(held: Held) -> Surface:
    import rasterio
    import shapely

    dense = held.workspace / "dense"
    kept = []
    known = requested = reached = 0
    area = planned_area(held) if held.plane is None else None
    with (
        rasterio.open(dense / "dem.tif") as dem,
        rasterio.open(dense / "sigma.tif") as sigma,
        rasterio.open(dense / "stations.tif") as seen,
    ):
        cell = float(dem.transform.a)
        for _, window in dem.block_windows(1):
            blocks = [raster.read(1, window=window) for raster in (dem, sigma, seen)]
            there = np.isfinite(blocks[0])
            known += int(there.sum())
            judged = there
            if area is not None:
                rows, columns = np.mgrid[: there.shape[0], : there.shape[1]] + 0.5
                cells = dem.window_transform(window)
                east, north = cells.c + cells.a * columns, cells.f + cells.e * rows
                inside = shapely.contains_xy(area, east, north)
                requested += int(inside.sum())
                judged = there & inside
                reached += int(judged.sum())
            kept.append(np.stack([block[judged][::_KEPT].astype(np.float64) for block in blocks]))
    if area is not None:  # what lies beyond the raster counts too
        requested = max(requested, round(area.area / cell**2))
    height, spread, stations = np.concatenate(kept, axis=1)
    low, high = np.percentile(height, [0.5, 99.5]) if len(height) else (math.nan, math.nan)
    spread = spread[np.isfinite(spread)]
    middle, most = np.percentile(spread, [50, 95]) if len(spread) else (math.nan, math.nan)
    return Surface(
        area=known * cell**2, cell=cell, low=float(low), high=float(high),
        sigma_median=float(middle), sigma_95=float(most),
        unchecked=float(np.mean(stations < _MIN_STATIONS)) if len(height) else math.nan,
        covered=reached / requested if requested else math.nan,
    )  # fmt: skip


_MIN_STATIONS = 3
"""Stations that must see a point, so that more than one pair checks its height."""
_KEPT = 16
"""Step between the cells that enter medians: half a million of a DEM of 3,000 by 3,000."""


def planned_area(held: Held) -> Any | None:
    """The area that the plan is to cover, on the map's axes (east, north); None without a plan."""
    import shapely

    if held.plan is None:
        return None
    return shapely.transform(held.plan.area.survey, lambda rows: rows[:, ::-1])


def number(row: Mapping[str, str], name: str) -> float:
    """A cell as a number; NaN where it is empty or missing."""
    text = row.get(name) or ""
    return float(text) if text else math.nan
