"""The surface of a workspace, read by windows: its heights and their own errors; its rasters.

The mosaic shows a point along one ray: an error of height moves the point along it.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.windows import Window
from scipy.spatial import KDTree

from alice_survey.core.artefacts import need_stage, read_csv
from alice_survey.core.contents import taken_from
from alice_survey.core.errors import ReconstructionError
from alice_survey.core.frames import Array
from alice_survey.core.products import DEM, ERROR, RASTERS, SIGMA, Raster
from alice_survey.kit.document import OWN_AXES
from reconstruct.measure.errors import REACH_CELLS, SharedErrors, own_correlation, shared_errors
from reconstruct.planes import Plane, read_plane
from reconstruct.raster import DemGrid, grid_of, opened_raster, read_cells, small_cache
from reconstruct.views.model import WorldFrame, read_frame

SOURCE = "mosaic/mosaic_source.tif"
_TRACK = "sparse/track.csv"
_AXES = (("north_m", "east_m", "depth_m"), ("x_m", "y_m", "z_m"), ("x", "y", "z"))


def sight_lines(workspace: Path, plane: Plane, points: Array) -> Array | None:
    """How far a spot of the mosaic moves aside for each unit that its height is too large.

    The picture that painted it sees the spot along one ray; where the surface is too high the ray
    meets it earlier, nearer to the camera.

    Args:
        workspace: reconstructed.
        plane: of its rasters.
        points: (N, 3) right, up and out on the surface.

    Returns:
        (N, 2) right and up; 0 where no picture painted the spot; None without a mosaic.
    """
    source, track = workspace / SOURCE, workspace / _TRACK
    if not source.is_file() or not track.is_file():
        return None
    with small_cache(), opened_raster(source) as raster:
        names = json.loads(raster.tags().get("PICTURES", "[]"))
        numbers = np.array([int(value) for (value,) in raster.sample(points[:, :2], indexes=[1])])
    used_names = {names[n - 1] for n in numbers.tolist() if 0 < n <= len(names)}
    centres = camera_centres(track, plane, used_names)
    lines = np.zeros((len(points), 2))
    for n, point in enumerate(points):
        if 0 < numbers[n] <= len(names) and names[numbers[n] - 1] in centres:
            arm = centres[names[numbers[n] - 1]] - point
            lines[n] = arm[:2] / arm[2] if arm[2] > 0 else 0.0
    return lines


def camera_centres(track: Path, plane: Plane, used_names: set[str]) -> dict[str, Array]:
    """Centres (3,) of cameras, right, up and out, by picture."""
    header, rows = read_csv(track)
    axes = next((axes for axes in _AXES if axes[0] in header), _AXES[0])
    with taken_from(track):
        places = {
            row["image"]: plane.plane_from_world.apply([float(row[axis]) for axis in axes])
            for _, row in rows
            if row["image"] in used_names
        }
    return {name: np.array([right, up, -into]) for name, (up, right, into) in places.items()}


_PICKING = "not counted: how well a place was picked on the map"
_RESOLVED = "not counted: relief finer than about two cells, which the surface smooths"
_WINDOW_CELLS = 1024
"""Cells along the side of what is read at once."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Samples:
    """Heights at places, each between four cells."""

    places: Array
    """(N, 2) right (east) and up (north)."""
    height: Array
    """(N,) NaN where one of the cells is unknown."""
    cells: NDArray[np.int64]
    """(N, 4, 2) rows and columns of the cells."""
    weights: Array
    """(N, 4) of the cells."""
    own: Array
    """(N, 4) sigmas of their own errors."""
    shared: Array
    """(N,) variances by what all heights share."""
    sight: Array
    """(N, 2) how far a place moves aside with the own error of its height."""
    tilt: Array
    """(N, 2) rise of the surface to the right and up."""
    click: float = 0.0
    """Standard deviation of each coordinate of a place."""

    @property
    def points(self) -> Array:
        """(N, 3) right, up and out."""
        return np.column_stack([self.places, self.height])

    def own_covariances(self, step: int) -> Array:
        """Covariances (N - step,) of own errors of each sample and of the one `step` after it."""
        first, second = slice(None, len(self.places) - step), slice(step, None)
        apart = self.cells[first, :, None] - self.cells[second, None, :]
        together = own_correlation(np.linalg.norm(apart, axis=-1))
        here, there = self.weights * self.own, self.weights * self.own
        return np.asarray(np.einsum("na,nab,nb->n", here[first], together, there[second]))

    @property
    def sigma(self) -> Array:
        """(N,) of the heights."""
        return np.sqrt(self.own_covariances(0) + self.shared)

    def own_variance(self, motions: Array) -> float:
        """Variance by own errors of a figure with derivatives (N, 3) by the places' motions."""
        slopes = motions[:, 2] + (motions[:, :2] * self.sight).sum(axis=1)
        used = slopes != 0.0
        cells, cell_of = np.unique(self.cells[used].reshape(-1, 2), axis=0, return_inverse=True)
        kick = (slopes[used, None] * self.weights[used] * self.own[used]).ravel()
        kicks = np.bincount(cell_of.ravel(), kick, minlength=len(cells))
        i, j = KDTree(cells).query_pairs(REACH_CELLS + 0.5, output_type="ndarray").T
        fading = own_correlation(np.linalg.norm(cells[i] - cells[j], axis=1))
        own = float(kicks @ kicks + 2.0 * (kicks[i] * kicks[j] * fading).sum())
        return own + self.click_variance(motions)

    def click_variance(self, motions: Array) -> float:
        """The part of it by clicks that miss their places, on a surface that rises there."""
        moved = motions[:, :2] + motions[:, 2:] * np.nan_to_num(self.tilt)
        _, place = np.unique(self.places, axis=0, return_inverse=True)
        sums = [np.bincount(place.ravel(), part) for part in moved.T]
        return self.click**2 * float(np.square(sums).sum())


@dataclass(frozen=True, kw_only=True)
class MeasuredSurface:
    """The DEM of a workspace with its sigmas; nothing of it is held."""

    workspace: Path
    dem: Path
    sigma: Path
    grid: DemGrid
    frame: WorldFrame
    """Of the model."""
    plane: Plane
    errors: SharedErrors
    click: float = 0.0
    """Standard deviation of each coordinate of a place that is picked."""

    @classmethod
    def of(cls, workspace: Path) -> "MeasuredSurface":
        """Of a workspace.

        Raises:
            WorkspaceError: the surface is not there, or damaged.
        """
        dense = need_stage(workspace, "dense", "reconstruct")
        frame = read_frame(need_stage(workspace, "sparse", "reconstruct") / "frame.json")
        plane, grid = read_plane(dense), grid_of(dense / "dem.tif")
        east, south = grid.east_of(grid.columns), grid.north_of(grid.rows)
        bounds = (grid.west, float(south), float(east), grid.north)
        errors = shared_errors(workspace, plane, frame, bounds)
        return cls(
            workspace=workspace,
            dem=workspace / DEM.path,
            sigma=workspace / SIGMA.path,
            grid=grid,
            frame=frame,
            plane=plane,
            errors=replace(errors, notes=(*errors.notes, _PICKING, _RESOLVED)),
        )

    def picked_to(self, click: float) -> "MeasuredSurface":
        """The same, with places that are picked to so much in each coordinate; 0 is not known."""
        if not click:
            return self
        notes = (f"counted: places picked to {click:.2g} {self.unit} in each coordinate",
                 *(note for note in self.errors.notes if note != _PICKING))  # fmt: skip
        return replace(self, click=click, errors=replace(self.errors, notes=notes))

    @property
    def unit(self) -> str:
        """Of lengths."""
        return self.frame.unit

    @property
    def axes(self) -> tuple[str, str, str]:
        """What its coordinates are called."""
        if not self.plane.is_level:
            return "right", "up", "out"
        return ("east", "north", "up") if self.frame.name == "ned" else (*OWN_AXES, "up")

    def window(self, row: int, column: int, rows: int, columns: int) -> tuple[Array, Array]:
        """Heights and sigmas of own errors (rows, columns) of a window; NaN beyond the grid."""
        height, sigma = (
            read_cells(path, row, column, rows, columns) for path in (self.dem, self.sigma)
        )
        known = np.isfinite(height)
        places = self.places_of(*(np.flatnonzero(known.ravel()) // columns + row,
                                  np.flatnonzero(known.ravel()) % columns + column))  # fmt: skip
        sigma[~known] = np.nan
        sigma[known] = self.errors.own_sigma(places, sigma[known])
        return height, sigma

    def places_of(self, rows: NDArray[Any], columns: NDArray[Any]) -> Array:
        """Places (N, 2) of the middles of cells."""
        return np.column_stack([self.grid.east_of(columns + 0.5), self.grid.north_of(rows + 0.5)])

    def at(self, places: Array) -> Samples:
        """Heights at places (N, 2), close ones after each other."""
        x = (places[:, 0] - self.grid.west) / self.grid.cell - 0.5
        y = (self.grid.north - places[:, 1]) / self.grid.cell - 0.5
        left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        x, y = x - left, y - top
        cells = np.stack(
            [np.stack([top + down, left + right], axis=1) for down in (0, 1) for right in (0, 1)],
            axis=1,
        )
        weights = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=1)
        heights, own = np.full(weights.shape, np.nan), np.full(weights.shape, np.nan)
        for part in _runs(cells[:, 0]):
            low = cells[part].min(axis=(0, 1))
            rows, columns = cells[part].max(axis=(0, 1)) - low + 1
            height, sigma = self.window(int(low[0]), int(low[1]), int(rows), int(columns))
            index = tuple(np.moveaxis(cells[part] - low, 2, 0))
            heights[part], own[part] = height[index], sigma[index]
        # A cell of no weight need not be known.
        idle = weights == 0.0
        heights[idle & ~np.isfinite(heights)] = 0.0
        own[idle & ~np.isfinite(own)] = 0.0
        to_right = (1 - y) * (heights[:, 1] - heights[:, 0]) + y * (heights[:, 3] - heights[:, 2])
        up = (1 - x) * (heights[:, 0] - heights[:, 2]) + x * (heights[:, 1] - heights[:, 3])
        return Samples(
            places=places, height=(weights * heights).sum(axis=1), cells=cells, weights=weights,
            own=own, shared=self.errors.variance_of_heights(places),
            sight=np.zeros((len(places), 2)),
            tilt=np.column_stack([to_right, up]) / self.grid.cell,
        )  # fmt: skip

    def at_picks(self, places: Array) -> Samples:
        """Spots that were picked where the mosaic shows them; see `sight_lines`."""
        found = replace(self.at(places), click=self.click)
        lines = sight_lines(self.workspace, self.plane, found.points)
        return found if lines is None else replace(found, sight=lines)

    def known_at(self, places: Array) -> Samples:
        """The same where each must have a height.

        Raises:
            ReconstructionError: one has none.
        """
        found = self.at_picks(places)
        lost = np.flatnonzero(~np.isfinite(found.height))
        if len(lost):
            x, y = places[lost[0]]
            raise ReconstructionError(
                f"no height is known at {x:.3f} {self.axes[0]}, {y:.3f} {self.axes[1]}: choose a "
                "place on the surface"
            )
        return found


def _runs(cells: NDArray[np.int64]) -> Iterator[slice]:
    """Parts of a sequence of cells (N, 2), each within a window that may be read at once."""
    start = 0
    while start < len(cells):
        end = len(cells)
        while end - start > 1 and np.any(np.ptp(cells[start:end], axis=0) > _WINDOW_CELLS):
            end = start + (end - start + 1) // 2
        yield slice(start, end)
        start = end


def is_of_surface(workspace: Path, raster: Raster) -> bool:
    """Whether a raster is of the surface that is there now.

    Errors that were evaluated before the surface was made again, perhaps over another plane, have
    other cells.
    """
    dem = workspace / DEM.path
    if raster != ERROR or not dem.is_file():
        return True
    return grid_of(workspace / raster.path) == grid_of(dem)


def values_at(
    workspace: Path, place: Sequence[float], rasters: Sequence[Raster] = RASTERS
) -> Mapping[str, tuple[float, ...]]:
    """Values of rasters of a workspace at a place, by their files; of a mosaic red, green, blue.

    A raster that is not there, is of an earlier surface, does not reach the place or knows nothing
    there is left out.

    Args:
        workspace: reconstructed.
        place: right (east) and up (north).
        rasters: to look at.
    """
    found = {}
    for one in rasters:
        path = workspace / one.path
        if not path.is_file() or not is_of_surface(workspace, one):
            continue
        with small_cache(), opened_raster(path) as raster:
            row, column = raster.index(place[0], place[1])
            if not (0 <= row < raster.height and 0 <= column < raster.width):
                continue
            part = Window(int(column), int(row), 1, 1)
            bands = list(range(1, min(raster.count, 4) + 1))
            values = raster.read(bands, window=part)[:, 0, 0]
            seen = bool(raster.dataset_mask(window=part)[0, 0])
        if seen and np.isfinite(values).all():
            found[one.file] = tuple(float(value) for value in values[:3])
    return found
