"""Surfaces of known shape as the rasters of a workspace, and draws of their errors."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from alice_survey.core.frames import Array
from reconstruct.adjustment.uncertainty import SharedMotions
from reconstruct.measure.errors import on_lattice, own_correlation
from reconstruct.measure.surface import MeasuredSurface
from reconstruct.planes import LEVEL_PLANE
from reconstruct.raster import DemGrid, tiled_raster
from reconstruct.views.model import WorldFrame

FRAME = WorldFrame(name="model", datum=None, scaled=True, vertical_datum="a test's")
Heights = Callable[[Array, Array], Array]


@dataclass(frozen=True, kw_only=True, eq=False)
class Sigmas:
    own: float = 0.0
    """Of every cell alone."""
    shift: float = 0.0
    """Of all heights together."""
    tilt: float = 0.0
    """Of the slopes to the right and up, rad."""
    scale: float = 0.0
    """Of the logarithm of the scale, which the motions hold."""
    bend: float = 0.0
    """Sagitta of a parabola over the surface."""


def grid(side: float, cell: float) -> DemGrid:
    cells = round(side / cell)
    return DemGrid(west=-side / 2, north=side / 2, cell=cell, rows=cells, columns=cells)


def write(path: Path, cells: DemGrid, values: Array) -> Path:
    with tiled_raster(path, cells, FRAME, "float32", np.nan, "a test's", "m") as raster:
        raster.write(values.astype(np.float32), 1)
    return path


class Drawn:
    """A true surface, and measured ones whose errors are as stated."""

    def __init__(self, folder: Path, cells: DemGrid, truth: Heights, sigmas: Sigmas) -> None:
        self._folder, self.cells, self.truth, self._sigmas = folder, cells, truth, sigmas
        rows, columns = np.arange(cells.rows), np.arange(cells.columns)
        self._x, self._y = np.meshgrid(cells.east_of(columns + 0.5), cells.north_of(rows + 0.5))
        places = np.random.default_rng(0).uniform(-0.6, 0.6, (1500, 2)) * cells.cell * cells.rows
        shared = SharedMotions(
            np.column_stack([places, truth(*places.T)]), self._motions(places), np.eye(5),
            np.zeros((len(places), 3, 3)),
        )  # fmt: skip
        half = cells.cell * cells.rows / 2
        self.errors = on_lattice(shared, (-half, -half, half, half), 33)
        variance = self.errors.variance_of_heights(
            np.column_stack([self._x.ravel(), self._y.ravel()])
        )
        self._sigma = np.sqrt(variance + sigmas.own**2).reshape(self._x.shape)
        apart = np.hypot(*np.meshgrid(np.arange(-8, 9), np.arange(-8, 9)))
        self._fading = own_correlation(apart)

    def _motions(self, places: Array) -> Array:
        """(N, 3, 5): shift, two tilts, scale, bend; each leaves the middle where it is."""
        s, (x, y) = self._sigmas, places.T
        half = self.cells.cell * self.cells.rows / 2
        height = np.nan_to_num(self.truth(x, y))
        found = np.zeros((len(places), 3, 5))
        found[:, 2, 0] = s.shift
        found[:, 2, 1], found[:, 0, 1] = s.tilt * x, -s.tilt * height
        found[:, 2, 2], found[:, 1, 2] = s.tilt * y, -s.tilt * height
        found[:, :, 3] = s.scale * np.column_stack([x, y, height])
        found[:, 2, 4] = s.bend * (x**2 + y**2) / half**2
        return found

    def surface(self, heights: Array) -> MeasuredSurface:
        dem = write(self._folder / "dem.tif", self.cells, heights)
        sigma = write(self._folder / "sigma.tif", self.cells, self._sigma)
        return MeasuredSurface(
            workspace=self._folder, dem=dem, sigma=sigma, grid=self.cells, frame=FRAME,
            plane=LEVEL_PLANE, errors=self.errors,
        )  # fmt: skip

    @property
    def true(self) -> MeasuredSurface:
        """The true heights, with the sigmas of a measured surface."""
        return self.surface(self.truth(self._x, self._y))

    def draw(self, rng: np.random.Generator) -> tuple[MeasuredSurface, Callable[[Array], Array]]:
        """A measured surface, and where a place on the truth is found in it."""
        sizes = rng.normal(size=5)

        def moved(places: Array) -> Array:
            motion = self._motions(places) @ sizes
            return np.asarray(places + motion[:, :2])

        # the material that is found at a cell came from where its motion says
        here = np.column_stack([self._x.ravel(), self._y.ravel()])
        motion = self._motions(here) @ sizes
        from_x, from_y = (here - motion[:, :2]).T
        shared = (self.truth(from_x, from_y) + motion[:, 2]).reshape(self._x.shape)
        white = rng.normal(size=(self.cells.rows, self.cells.columns))
        # white noise under the root of the spectrum of its correlation, on a torus
        steps = (np.minimum(np.arange(n), n - np.arange(n)) for n in white.shape[::-1])
        spectrum = np.fft.fft2(own_correlation(np.hypot(*np.meshgrid(*steps)))).real
        own = np.fft.ifft2(np.fft.fft2(white) * np.sqrt(np.maximum(spectrum, 0.0))).real
        return self.surface(shared + self._sigmas.own * own), moved


def without_errors(folder: Path, cells: DemGrid, truth: Heights) -> MeasuredSurface:
    return Drawn(folder, cells, truth, Sigmas()).true
