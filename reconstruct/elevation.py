"""A height per cell with its sigma, as a value: read, sampled between cells, carried elsewhere."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from alice_survey.core.errors import ReconstructionError
from alice_survey.core.frames import Array
from reconstruct.planes import read_plane
from reconstruct.raster import DemGrid, grid_of, read_cells

_CELL_STEPS = 0.5
"""Steps of a ray's march over the grid, in cells."""
_SIGHT_STEPS = 256
"""Steps of the way from a place to a camera."""
_MAX_SAMPLES = 1_000_000
LEVEL = 1e-3
"""A ray that descends less meets no surface."""
_MARGIN_CELLS = 8
_MAX_CELLS = 4_000_000
_COARSE_CELLS = 256
"""Cells a side of a look at all of a DEM."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Elevation:
    """Square cells in rows from north to south, columns from west to east."""

    height: Array
    """(rows, columns), positive up; NaN where unknown."""
    sigma: Array
    """(rows, columns) standard deviation of the height; NaN where it is not stated."""
    west: float
    north: float
    """Outer edges of the first column and row."""
    cell: float

    @property
    def known(self) -> NDArray[np.bool_]:
        """Where there is a height."""
        return np.isfinite(self.height)

    def points(self, step: int = 1) -> Array:
        """(N, 3) east, north, up of known cells, of every `step`-th in both directions."""
        rows, columns = np.nonzero(self.known[::step, ::step])
        rows, columns = rows * step, columns * step
        east = self.west + (columns + 0.5) * self.cell
        north = self.north - (rows + 0.5) * self.cell
        return np.column_stack([east, north, self.height[rows, columns]])

    def at(self, field: Array, places_en: Array) -> Array:
        """A field of the grid, such as `height`, between cells.

        Args:
            field: (rows, columns).
            places_en: (..., 2) east and north.

        Returns:
            (...,) bilinear between the four cells around; NaN where one of them is unknown.
        """
        x = (places_en[..., 0] - self.west) / self.cell - 0.5
        y = (self.north - places_en[..., 1]) / self.cell - 0.5
        return map_coordinates(field, [y, x], np.float64, order=1, mode="constant", cval=np.nan)

    def met_by(self, starts: Array, ways: Array) -> Array:
        """Where rays first meet the surface from above, (N, 3) in the world; NaN where none does.

        Args:
            starts: (N, 3) north, east, down.
            ways: (N, 3) unit vectors.
        """
        found, heights = np.full(starts.shape, np.nan), self.height[self.known]
        down = np.flatnonzero(np.isfinite(starts).all(axis=1) & (ways[:, 2] > LEVEL))
        if not len(down) or not len(heights):
            return found
        high, low = heights.max() + self.cell, heights.min() - self.cell
        first = np.maximum((-high - starts[down, 2]) / ways[down, 2], 0.0)
        last = np.maximum((-low - starts[down, 2]) / ways[down, 2], first)
        steps = int(np.ceil(float((last - first).max()) / (_CELL_STEPS * self.cell))) + 2
        for part in _parts(len(down), steps):
            rows = down[part]
            along = np.linspace(first[part], last[part], steps, axis=1)
            points = starts[rows, None] + along[..., None] * ways[rows, None]
            over = -points[..., 2] - self.at(self.height, points[..., [1, 0]])
            with np.errstate(invalid="ignore"):
                crossed = (over[:, :-1] > 0) & (over[:, 1:] <= 0)
            hit = crossed.any(axis=1)
            n, at = np.arange(len(rows))[hit], crossed[hit].argmax(axis=1)
            share = over[n, at] / (over[n, at] - over[n, at + 1])
            found[rows[hit]] = points[n, at] + share[:, None] * (points[n, at + 1] - points[n, at])
        return found

    def hides(self, points: Array, clear: Array, eyes: Array) -> NDArray[np.bool_]:
        """Whether the surface stands in the way from points to eyes.

        Args:
            points: (N, 3) north, east, down, on the surface.
            clear: (N,) by which it must stand above the way.
            eyes: (N, 3) of each.
        """
        heights = self.height[self.known]
        found = np.zeros(len(points), np.bool_)
        if not len(heights):
            return found
        ways, lift = eyes - points, heights.max() + points[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):  # above all of it nothing hides
            share = np.clip(np.where(ways[:, 2] < 0, -lift / ways[:, 2], 1.0), 0.0, 1.0)
        steps = np.linspace(0.0, 1.0, _SIGHT_STEPS)[1:]
        for part in _parts(len(points), len(steps)):
            over = (share[part, None] * steps)[..., None] * ways[part, None] + points[part, None]
            floor = self.at(self.height, over[..., [1, 0]])
            with np.errstate(invalid="ignore"):
                found[part] = (floor + over[..., 2] > clear[part, None]).any(axis=1)
        return found


def _parts(rows: int, steps: int) -> Iterator[slice]:
    """Parts of rays of so many samples that fit into memory together."""
    size = max(1, _MAX_SAMPLES // steps)
    return (slice(start, start + size) for start in range(0, rows, size))


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredElevation:
    """The level DEM in a folder, of which parts are read."""

    folder: Path
    grid: DemGrid

    @classmethod
    def of(cls, dense: Path) -> "StoredElevation":
        """Of a finished `dense/`.

        Raises:
            ReconstructionError: its DEM is of another plane.
            WorkspaceError: a file is missing or damaged.
        """
        plane = read_plane(dense)
        if not plane.is_level:
            raise ReconstructionError(
                f"{dense / 'dem.tif'}: is of the plane {plane.name!r}, not level: name 'level' "
                "first in reconstruct.planes, and run 'alice-survey reconstruct' again"
            )
        return cls(folder=dense, grid=grid_of(dense / "dem.tif"))

    @property
    def whole(self) -> Elevation:
        """All of it."""
        return self._part(0, 0, self.grid.rows, self.grid.columns)

    def around(self, places_en: Array) -> Elevation:
        """The part that holds places (N, 2) and some cells around; NaN beyond the raster.

        Of more than some million cells every second, third, ... is read.
        """
        grid, known = self.grid, places_en[np.isfinite(places_en).all(axis=1)]
        ends = np.zeros((2, 2)) if not len(known) else np.stack([known.min(0), known.max(0)])
        x = np.clip((ends[:, 0] - grid.west) / grid.cell, -1.0, grid.columns + 1.0)
        y = np.clip((grid.north - ends[::-1, 1]) / grid.cell, -1.0, grid.rows + 1.0)
        left, top = (int(np.floor(one[0])) - _MARGIN_CELLS for one in (x, y))
        columns, rows = (int(np.ceil(np.ptp(one))) + 2 * _MARGIN_CELLS + 1 for one in (x, y))
        every = max(1, int(np.ceil(np.sqrt(rows * columns / _MAX_CELLS))))
        return self._part(top, left, rows + every, columns + every, every)

    def met_by(self, starts: Array, ways: Array) -> tuple[Elevation, Array]:
        """The part that rays may meet, and where they first do; see `Elevation.met_by`."""
        low, high = self._heights
        while True:
            down = ways[:, 2] > LEVEL
            reach = (np.array([[-high], [-low]]) - starts[down, 2]) / ways[down, 2]
            ends = starts[down] + np.maximum(reach, 0.0)[..., None] * ways[down]
            part = self.around(ends.reshape(-1, 3)[:, [1, 0]])
            heights = part.height[part.known]
            spare = part.cell + 0.5 * float(np.ptp(heights)) if len(heights) else 0.0
            nearer = (heights.min() - spare, heights.max() + spare) if spare else (low, high)
            if part.cell == self.grid.cell or nearer[1] - nearer[0] > 0.7 * (high - low):
                return part, part.met_by(starts, ways)
            low, high = nearer  # the rays go no farther than the floor that is below them

    def _part(self, row: int, column: int, rows: int, columns: int, every: int = 1) -> Elevation:
        height, sigma = (
            read_cells(self.folder / name, row, column, rows, columns, every)
            for name in ("dem.tif", "sigma.tif")
        )
        return Elevation(
            height=height, sigma=np.where(sigma > 0, sigma, np.nan),
            west=float(self.grid.east_of(column)), north=float(self.grid.north_of(row)),
            cell=every * self.grid.cell,
        )  # fmt: skip

    @cached_property
    def _heights(self) -> tuple[float, float]:
        """Heights below and above all of it, by a coarse look."""
        rows, columns = self.grid.rows, self.grid.columns
        every = max(1, max(rows, columns) // _COARSE_CELLS)
        coarse = read_cells(self.folder / "dem.tif", 0, 0, rows, columns, every)
        known = coarse[np.isfinite(coarse)]
        if not len(known):
            raise ReconstructionError("the model has no surface yet")
        spare = self.grid.cell + 0.5 * float(np.ptp(known))
        return float(known.min()) - spare, float(known.max()) + spare


def elevation_in(dense: Path) -> Elevation:
    """The level DEM and its standard deviation in a folder.

    Raises:
        ReconstructionError: its DEM is of another plane.
        WorkspaceError: a file is missing or damaged.
    """
    return StoredElevation.of(dense).whole
