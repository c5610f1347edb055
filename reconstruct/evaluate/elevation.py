"""A height per cell with its sigma, as a value: read, sampled between cells, carried elsewhere."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from alice_survey.base.artefacts import need_stage
from alice_survey.base.errors import ReconstructionError
from alice_survey.base.frames import Array, Datum
from reconstruct.placing.alignment import align_rigid
from reconstruct.planes import read_plane
from reconstruct.raster import opened_raster
from reconstruct.views.model import WorldFrame, read_frame

_CELL_STEPS = 0.5
"""Steps of a ray's march over the grid, in cells."""


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
            places_en: (N, 2) east and north.

        Returns:
            (N,) bilinear between the four cells around; NaN where one of them is unknown.
        """
        rows, columns = field.shape
        x = (places_en[:, 0] - self.west) / self.cell - 0.5
        y = (self.north - places_en[:, 1]) / self.cell - 0.5
        with np.errstate(invalid="ignore"):
            inside = (x >= 0) & (y >= 0) & (x <= columns - 1) & (y <= rows - 1)
        x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
        column = np.minimum(x.astype(np.int64), max(columns - 2, 0))
        row = np.minimum(y.astype(np.int64), max(rows - 2, 0))
        right, down = np.minimum(column + 1, columns - 1), np.minimum(row + 1, rows - 1)
        x, y = x - column, y - row
        upper = (1 - x) * field[row, column] + x * field[row, right]
        lower = (1 - x) * field[down, column] + x * field[down, right]
        between: Array = np.where(inside, (1 - y) * upper + y * lower, np.nan)
        return between

    def hit(self, start: Array, direction: Array, lift: float = 0.0) -> Array | None:
        """Where a ray first meets the surface, (3,) in the world; None where it does not.

        Args:
            start: (3,) north, east, down.
            direction: (3,) unit vector.
            lift: height by which the surface is raised.
        """
        down, known = float(direction[2]), self.height[self.known]
        if down <= 1e-6 or not len(known):
            return None
        first = max(0.0, (-known.max() - lift - self.cell - start[2]) / down)
        last = (-known.min() - lift + self.cell - start[2]) / down
        along = np.arange(first, last + self.cell, _CELL_STEPS * self.cell)
        points = start + along[:, None] * direction
        over = -points[:, 2] - self.at(self.height, points[:, [1, 0]]) - lift
        crossed = np.flatnonzero((over[:-1] > 0) & (over[1:] <= 0))
        if not len(crossed):
            return None
        n = crossed[0]
        share = over[n] / (over[n] - over[n + 1])
        met: Array = points[n] + share * (points[n + 1] - points[n])
        return met


def read_elevation(workspace: Path) -> tuple[Elevation, WorldFrame]:
    """The DEM of a workspace and the frame it lies in.

    Raises:
        WorkspaceError: the surface is not there.
        ReconstructionError: it is empty.
    """
    dense = need_stage(workspace, "dense", "reconstruct")
    frame = read_frame(need_stage(workspace, "sparse", "reconstruct") / "frame.json")
    elevation = elevation_in(dense)
    if not elevation.known.any():
        raise ReconstructionError(f"{dense / 'dem.tif'}: holds no height")
    return elevation, frame


def elevation_in(dense: Path) -> Elevation:
    """The level DEM and its standard deviation in a folder.

    Raises:
        ReconstructionError: its DEM is of another plane.
        WorkspaceError: a file is missing or damaged.
    """
    plane = read_plane(dense)
    if not plane.is_level:
        raise ReconstructionError(
            f"{dense / 'dem.tif'}: is of the plane {plane.name!r}, not level: name 'level' first "
            "in reconstruct.planes, and run 'alice-survey reconstruct' again"
        )
    with opened_raster(dense / "dem.tif") as source:
        height = source.read(1).astype(np.float64)
        transform = source.transform
    with opened_raster(dense / "sigma.tif") as source:
        sigma = source.read(1).astype(np.float64)
    return Elevation(
        height=height,
        sigma=np.where(sigma > 0, sigma, np.nan),
        west=float(transform.c),
        north=float(transform.f),
        cell=float(transform.a),
    )


def enu_from_enu(target: Datum, source: Datum) -> RigidTransform:
    """Local east, north, up of one datum from that of another: rigid, both are tangent planes."""
    corners = 100.0 * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    ned = corners[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    moved = target.ned_from_geodetic(source.geodetic_from_ned(ned))
    return align_rigid(corners, moved[:, [1, 0, 2]] * [1.0, 1.0, -1.0])
