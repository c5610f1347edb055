"""The certificate of coverage: what all pictures together see of the survey area."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.errors import PlanError, warn
from alice_survey.core.executor import SERIAL, Executor
from alice_survey.core.frames import Array
from camera_calib.rig import Rig
from missions.coverage.raster import (
    Grid,
    border_rays_body,
    count_pictures,
    footprint_offsets,
    grid_over,
    inside,
)
from missions.coverage.stations import Stations
from missions.values.area import Area
from missions.values.footprint import footprint_size_m
from missions.values.pattern import Pattern

_CELLS_PER_FOOTPRINT = 20.0
_MIN_CELLS = 40_000
"""Fewest cells of a small area, so that its shares are finely resolved."""
_MAX_CELLS = 16_000_000
_SIZES = 0.005 * np.array([0, 1, -1, 2, -2, 3, -3, 4, -4, 5, -5, 6, -6])
"""Changes of a cell's size that are tried."""
_PLACES = 300
"""Cells in a row that are looked at for that."""
_COARSE = 0.8
"""Share of the cells of a quick look above which its grid is taken as coarser than usual."""
_FEW_POINTS = 4
"""Points on each side of a border for such a grid."""
_TILE, _TILE_MIB = 2048, 90
"""Cells a side that are worked on at once, and the memory that they take for two cameras."""
_CHUNK = 8192
"""Stations whose borders are kept at once: about 17 MB for two cameras."""

Counts = NDArray[np.uint16]


@dataclass(frozen=True, kw_only=True, eq=False)
class Certificate:
    """What was or will be seen of an area, at the middle of every cell of a grid over it.

    Shares are of the cells whose middle lies in the survey area.
    """

    area: Area
    pattern: Pattern
    cameras: tuple[str, ...]
    stations: int
    """Number of stations, at which every camera took a picture."""
    blind: int
    """Stations of these whose pictures look past the sea floor: they count as seeing nothing."""
    grid: Grid
    inside: NDArray[np.bool_]
    """(rows, columns) whether the middle of the cell lies in the survey area."""
    pictures: Counts
    """(rows, columns) how many pictures of all cameras see it."""
    least_pictures: Counts
    """(rows, columns) how many pictures of the camera that sees it least often."""
    least_lines: Counts
    """(rows, columns) how many lines see it, of the camera for which they are fewest."""
    pairs: Counts
    """(rows, columns) stations that see it with all cameras at once."""
    estimated: bool = False
    """Whether it is a quick look: cells are larger than usual, and borders have fewer points."""

    @property
    def taken(self) -> int:
        """Pictures of all cameras."""
        return self.stations * len(self.cameras)

    @property
    def area_m2(self) -> float:
        """Size of the survey area."""
        return float(self.area.survey.area)

    @property
    def at_overlap(self) -> NDArray[np.bool_]:
        """Where, (rows, columns), the area is covered at the overlap requested.

        Every camera sees such a place on as many lines, and in as many pictures, as it does
        everywhere in an endless pattern.
        """
        often = self.least_pictures >= self.pattern.passes * self.pattern.pictures
        return often & (self.least_lines >= self.pattern.passes)

    @property
    def covered_share(self) -> float:
        """Share of the area that is in at least one picture."""
        return self._share(self.pictures > 0)

    @property
    def every_camera_share(self) -> float:
        """Share of the area that is in at least one picture of every camera."""
        return self._share(self.least_pictures > 0)

    @property
    def stereo_share(self) -> float:
        """Share of the area that all cameras see at once at some station."""
        return self._share(self.pairs > 0)

    @property
    def share_at_overlap(self) -> float:
        """Share of the area that is covered at the overlap requested."""
        return self._share(self.at_overlap)

    @property
    def fewest_pictures(self) -> int:
        """Fewest pictures of any camera that see any place of the area."""
        return int(self.least_pictures[self.inside].min())

    @property
    def fewest_lines(self) -> int:
        """Fewest lines on which any camera sees any place of the area."""
        return int(self.least_lines[self.inside].min())

    @property
    def mean_pictures(self) -> float:
        """Mean number of pictures, of all cameras, that see a place of the area."""
        return float(self.pictures[self.inside].mean())

    def _share(self, mask: NDArray[np.bool_]) -> float:
        return int(np.count_nonzero(mask & self.inside)) / int(np.count_nonzero(self.inside))

    def to_json(self) -> dict[str, Any]:
        """The figures, without map and holes."""
        return {
            "area_m2": self.area_m2,
            "cell_m": self.grid.cell_m,
            "cameras": list(self.cameras),
            "stations": self.stations,
            "pictures": self.taken,
            "asked_for": {
                "lines": self.pattern.passes,
                "pictures_of_each_camera": self.pattern.passes * self.pattern.pictures,
            },
            "covered_share": self.covered_share,
            "every_camera_share": self.every_camera_share,
            "stereo_share": self.stereo_share,
            "share_at_overlap": self.share_at_overlap,
            "fewest_pictures_of_a_camera": self.fewest_pictures,
            "fewest_lines": self.fewest_lines,
            "mean_pictures": self.mean_pictures,
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class _Tile:
    """A part of the area whose views are counted."""

    grid: Grid
    rays: tuple[Array, Array]
    stations: Stations
    """Line by line, and none that is blind."""


def certificate(
    area: Area,
    rig: Rig,
    stations: Stations,
    pattern: Pattern,
    *,
    cell_m: float | None = None,
    max_cells: int | None = None,
    executor: Executor = SERIAL,
) -> Certificate:
    """Certify what pictures see of an area.

    Args:
        area: what must be seen.
        rig: its cameras, in water.
        stations: where pictures are taken.
        pattern: the overlap requested.
        cell_m: of the grid; left out, about a twentieth of a footprint, less for a small area, and
            more where that would be over 16 million cells.
        max_cells: of the grid where `cell_m` is left out, for a quick look. Where that makes the
            cells larger, borders are traced at fewer points: to 0.2 % of a footprint's width.
        executor: where the parts of a large area are worked on.

    Raises:
        PlanError: `cell_m` is not positive, or would make too large a grid.
    """
    grid = grid_over(area, _cell_m(area, rig, stations, pattern, cell_m, max_cells))
    mask = inside(area, grid)
    if not mask.any():  # the area is a sliver between middles of cells
        raise PlanError(
            f"an area of {area.survey.area:.3g} m2 holds no point of a grid of {grid.cell_m:.3g} m"
        )
    order = np.argsort(stations.line, kind="stable")
    stations = stations.some(order)
    coarse = max_cells is not None and grid.rows * grid.columns > _COARSE * max_cells
    rays = border_rays_body(rig, _FEW_POINTS) if coarse else border_rays_body(rig)
    reach_m = _reaches_m(rays, stations)
    blind = int(np.count_nonzero(np.isnan(reach_m)))
    # Beyond its reach a place may be by rounding.
    glass, reach = grid.cells_of(stations.glass_ne), (reach_m + 1e-6) / grid.cell_m
    places, tasks = [], []
    for row, column in itertools.product(range(0, grid.rows, _TILE), range(0, grid.columns, _TILE)):
        part = grid.part(row, column, _TILE, _TILE)
        here = (slice(row, row + part.rows), slice(column, column + part.columns))
        if mask[here].any():
            off = glass - np.clip(glass, (row, column), (row + part.rows, column + part.columns))
            near = np.hypot(*off.T) <= reach
            places.append(here)
            tasks.append(_Tile(grid=part, rays=rays, stations=stations.some(near)))
    maps = {
        name: np.zeros(grid.shape, np.uint16)
        for name in ("pictures", "least_pictures", "least_lines", "pairs")
    }
    found = executor.map(
        _count_views, tasks, label="count the views of each place", task_mib=_TILE_MIB
    )
    for here, tile in zip(places, found, strict=True):
        for name, counts in tile.items():
            maps[name][here] = counts
    return Certificate(
        area=area,
        pattern=pattern,
        cameras=tuple(rig.cameras),
        stations=len(stations),
        blind=blind,
        estimated=coarse,
        grid=grid,
        inside=mask,
        **maps,
    )


def _cell_m(
    area: Area,
    rig: Rig,
    stations: Stations,
    pattern: Pattern,
    asked_m: float | None,
    max_cells: int | None,
) -> float:
    """The side of a cell.

    Raises:
        PlanError: the one requested is not positive or too small.
    """
    boxed_m2 = float(area.survey.oriented_envelope.area)
    min_m = math.sqrt(boxed_m2 / _MAX_CELLS)
    if asked_m is not None:
        if not asked_m >= min_m or math.isinf(asked_m):
            raise PlanError(
                f"cells of {asked_m:g} m: choose {min_m:.3g} m or more for a grid of "
                f"{_MAX_CELLS:.0e} cells at most"
            )
        return asked_m
    fine_m = math.sqrt(boxed_m2 / _MIN_CELLS)
    altitude_m = float(np.median(stations.altitude_m)) if len(stations) else 0.0
    if altitude_m > 0:
        camera = rig.cameras[rig.reference]
        fine_m = min(fine_m, min(footprint_size_m(camera, altitude_m)) / _CELLS_PER_FOOTPRINT)
    if fine_m < min_m:
        warn(
            f"the certificate's grid has cells of {min_m:.3g} m instead of {fine_m:.3g} m, "
            f"{_MAX_CELLS / 1e6:.0f} million of them: holes under {1.4 * min_m:.2g} m may be "
            "missed; certify parts of the area, or choose cell_m"
        )
    if max_cells is not None:
        min_m = max(min_m, math.sqrt(boxed_m2 / max_cells))
    return _out_of_step(fine_m, (pattern.step_m, pattern.spacing_m), min_m)


def _out_of_step(cell_m: float, periods_m: tuple[float, ...], min_m: float) -> float:
    """A cell size near this one that is incommensurate with steps and line spacing.

    Where a step is a whole number of cells, all steps are looked at in the same few places, and
    shares are those of these places (aliasing). Of a few sizes the one is taken at which places
    within a step are spread most evenly: with the least star discrepancy (Niederreiter 1992,
    "Random number generation and quasi-Monte Carlo methods", theorem 2.6).
    """
    sizes = cell_m * (1.0 + _SIZES)
    sizes = np.unique(np.maximum(sizes, min_m)) if sizes.min() < min_m else sizes
    even = (np.arange(_PLACES) + 0.5) / _PLACES
    uneven = [
        sum(
            float(np.abs(np.sort(np.arange(_PLACES) * (size / period_m) % 1.0) - even).max())
            for period_m in periods_m
        )
        for size in sizes
    ]
    return float(sizes[int(np.argmin(uneven))])


def _chunks(count: int) -> Iterator[slice]:
    return (slice(start, start + _CHUNK) for start in range(0, count, _CHUNK))


def _reaches_m(rays: tuple[Array, Array], stations: Stations) -> Array:
    """How far from the glass, (S,), a station sees; NaN where it looks past the sea floor."""
    reaches = [np.empty(0)]
    for rows in _chunks(len(stations)):
        offsets, which = footprint_offsets(
            *rays, stations.altitude_m[rows], stations.attitude_rad[rows]
        )
        reaches.append(np.sqrt((offsets**2).sum(axis=-1).max(axis=(1, 2)))[which])
    return np.concatenate(reaches)


def _count_views(tile: _Tile) -> dict[str, Counts]:
    """Count the views of each cell of a part of the area, by the certificate's maps."""
    grid, stations = tile.grid, tile.stations
    shape = (len(tile.rays[0]), *grid.shape)
    pictures, lines = np.zeros(shape, np.uint16), np.zeros(shape, np.uint16)
    last, stamp = np.full(shape, -1, np.int32), np.full(grid.shape, -1, np.int32)
    pairs = np.zeros(grid.shape, np.uint16)
    for rows in _chunks(len(stations)):
        offsets, which = footprint_offsets(
            *tile.rays, stations.altitude_m[rows], stations.attitude_rad[rows]
        )
        count_pictures(
            grid.cells_of(offsets + np.array(grid.origin_ne)), which,
            np.ascontiguousarray(grid.cells_of(stations.glass_ne[rows])), stations.line[rows],
            rows.start, pictures, lines, last, stamp, pairs,
        )  # fmt: skip
    total = np.minimum(pictures.sum(axis=0, dtype=np.uint32), 65535).astype(np.uint16)
    return {
        "pictures": total,
        "least_pictures": pictures.min(axis=0),
        "least_lines": lines.min(axis=0),
        "pairs": pairs,
    }
