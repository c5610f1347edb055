"""The key figures of a survey, from whatever its workspace holds."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from alice_survey.app.report.held import Held, number
from alice_survey.core.frames import Array
from alice_survey.core.records import (
    ControlRecord,
    MappingRecord,
    MosaicRecord,
    ReferenceRecord,
    RegistrationRecord,
    ScoreRecord,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Figures:
    """Key figures of one survey; NaN or None where nothing is known."""

    held: Held

    @property
    def registered(self) -> int:
        """Pictures in the model."""
        return 0 if self.registration is None else self.registration.registered

    @property
    def total(self) -> int:
        """Pictures of the survey."""
        if self.registration is not None:
            return self.registration.total
        return len(self.held.rows("images/manifest.csv"))

    @cached_property
    def registration(self) -> RegistrationRecord | None:
        """Which pictures are in the model, and how it got its place."""
        return self.held.read(RegistrationRecord)

    @cached_property
    def mapping(self) -> MappingRecord:
        """How the model was made; empty without one."""
        return self.held.read(MappingRecord) or MappingRecord()

    @cached_property
    def stations(self) -> int:
        """Places at which pictures of the model were taken."""
        return len({row["station"] for row in self.held.track})

    @cached_property
    def surface(self) -> "Surface | None":
        """The DEM, block by block; None without one."""
        dem = self.held.file("dense/dem.tif")
        if dem is None:
            return None
        return _surface(self.held)

    @property
    def pixel_m(self) -> float:
        """Pixel of the mosaic, in the model's unit; NaN without one."""
        mosaic = self.held.read(MosaicRecord)
        return np.nan if mosaic is None else mosaic.pixel

    @cached_property
    def camera_sigmas(self) -> Array:
        """(N, 3) sigmas north, east, down of the track's pictures; NaN where none is stated."""
        names = ("sigma_north_m", "sigma_east_m", "sigma_depth_m")
        rows = [[number(row, name) for name in names] for row in self.held.track]
        return np.array(rows).reshape(-1, 3)

    @property
    def place_sigma_m(self) -> float:
        """Horizontal sigma of a camera on the Earth, root mean square; NaN of a model elsewhere."""
        if self.held.frame.datum is None:
            return np.nan
        level = self.camera_sigmas[:, :2]
        known = np.isfinite(level).all(axis=1)
        return float(np.sqrt((level[known] ** 2).sum(axis=1).mean())) if known.any() else np.nan

    @cached_property
    def truth(self) -> ScoreRecord | None:
        """Errors against the truth of a simulated survey."""
        return self.held.read(ScoreRecord)

    @cached_property
    def reference(self) -> ReferenceRecord | None:
        """Distances from a reference."""
        return self.held.read(ReferenceRecord)

    @cached_property
    def control(self) -> ControlRecord | None:
        """Check points and scale bars."""
        return self.held.read(ControlRecord)


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Figures of the DEM."""

    area: float
    """Area of its known cells, square units."""
    cell: float
    low: float
    high: float
    sigma_median: float
    """Sigma of the heights; NaN where none is stated."""
    sigma_95: float
    stations_median: float
    """Stations that see a cell."""
    covered: float
    """Share of the planned area with a height; NaN without a plan."""


def _surface(held: Held) -> Surface:
    import rasterio

    dense = held.workspace / "dense"
    heights, sigmas, stations = [], [], []
    known = requested = reached = 0
    area = planned_area(held) if held.plane is None else None
    with (
        rasterio.open(dense / "dem.tif") as dem,
        rasterio.open(dense / "sigma.tif") as sigma,
        rasterio.open(dense / "stations.tif") as seen,
    ):
        cell = float(dem.transform.a)
        for _, window in dem.block_windows(1):
            block = dem.read(1, window=window)
            there = np.isfinite(block)
            known += int(there.sum())
            heights.append(_thin(block[there]))
            sigmas.append(_thin(sigma.read(1, window=window)[there]))
            stations.append(_thin(seen.read(1, window=window)[there]))
            if area is not None:
                inside = _inside(area, dem.window_transform(window), block.shape)
                requested += int(inside.sum())
                reached += int((inside & there).sum())
    if area is not None:  # what lies beyond the raster counts too
        requested = max(requested, round(area.area / cell**2))
    height, spread = np.concatenate(heights), np.concatenate(sigmas)
    spread = spread[np.isfinite(spread)]
    low, high = np.percentile(height, [0.5, 99.5]) if len(height) else (np.nan, np.nan)
    return Surface(
        area=known * cell**2,
        cell=cell,
        low=float(low),
        high=float(high),
        sigma_median=float(np.median(spread)) if len(spread) else np.nan,
        sigma_95=float(np.percentile(spread, 95)) if len(spread) else np.nan,
        stations_median=float(np.median(np.concatenate(stations))) if known else np.nan,
        covered=reached / requested if requested else np.nan,
    )


_KEPT = 16
"""Step between the cells that enter medians: half a million of a DEM of 3,000 by 3,000."""


def _thin(values: Array) -> Array:
    return values[::_KEPT].astype(np.float64)


def planned_area(held: Held) -> Any | None:
    """The area that the plan is to cover, on the map's axes (east, north); None without a plan."""
    import shapely

    if held.plan is None:
        return None
    return shapely.transform(held.plan.area.survey, lambda rows: rows[:, ::-1])


def _inside(area: Any, transform: Any, size: tuple[int, int]) -> Any:
    import shapely

    rows, columns = np.mgrid[: size[0], : size[1]] + 0.5
    east = transform.c + transform.a * columns
    north = transform.f + transform.e * rows
    return shapely.contains_xy(area, east, north)
