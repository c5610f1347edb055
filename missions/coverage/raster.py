"""Footprints on a grid of points: which pictures see the middle of each cell, exactly.

Nothing is smeared: a cell counts as seen when its middle lies within a footprint, whose border is
traced through the flat port. What is found is therefore true at every middle of a cell, and a hole
that holds a circle of 0.71 cells radius cannot be missed.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array, rotation_from_attitude
from camera_calib.rig import Rig
from missions.values.area import Area

_POINTS_PER_SIDE = 16
"""Points on each side of a footprint's border. Chords this short leave out less than 1e-4 of its
width."""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Square cells in rows along a heading; the cell (0, 0) is at the corner astern to port."""

    origin_ne: tuple[float, float]
    """North and east of that corner, metres."""
    heading_rad: float
    """The way in which rows count; columns count to the right of it."""
    cell_m: float
    rows: int
    columns: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.rows, self.columns

    @cached_property
    def axes(self) -> Array:
        """(2, 2): north and east of the ways in which rows and columns count."""
        c, s = math.cos(self.heading_rad), math.sin(self.heading_rad)
        return np.array([[c, s], [-s, c]])

    @cached_property
    def middles_ne(self) -> Array:
        """(rows, columns, 2): north and east of the middles of the cells."""
        row, column = np.indices(self.shape) + 0.5
        return self.places_of(np.stack([row, column], axis=-1))

    def cells_of(self, points_ne: Array) -> Array:
        """Row and column, (..., 2), of places (..., 2); the middle of a cell is at a half."""
        return np.asarray((points_ne - np.array(self.origin_ne)) @ self.axes.T / self.cell_m)

    def places_of(self, cells: Array) -> Array:
        """The inverse of `cells_of`."""
        return np.array(self.origin_ne) + self.cell_m * (cells @ self.axes)

    def sample(self, values: NDArray[Any], places_ne: Array, outside: float) -> NDArray[Any]:
        """Values, (rows, columns), of the cells that hold places (..., 2), or a value outside."""
        cells = np.floor(self.cells_of(places_ne)).astype(np.int64)
        row, column = cells[..., 0], cells[..., 1]
        on = (row >= 0) & (row < self.rows) & (column >= 0) & (column < self.columns)
        found = np.full(on.shape, outside, values.dtype)
        found[on] = values[row[on], column[on]]
        return found

    def part(self, row: int, column: int, rows: int, columns: int) -> "Grid":
        """Some of its cells, from a row and a column on; what is beyond its ends is left out."""
        north, east = self.places_of(np.array([float(row), float(column)]))
        return Grid(
            origin_ne=(float(north), float(east)),
            heading_rad=self.heading_rad,
            cell_m=self.cell_m,
            rows=min(rows, self.rows - row),
            columns=min(columns, self.columns - column),
        )


def grid_over(area: Area, cell_m: float) -> Grid:
    """A grid over the survey area, along the longer side of the smallest rectangle round it.

    A grid that turns with the area gives the same certificate whichever way the area lies.
    """
    box = shapely.get_coordinates(shapely.oriented_envelope(area.survey))
    sides = np.diff(box[:3], axis=0)
    side = sides[int(np.argmax(np.linalg.norm(sides, axis=1)))]
    heading = math.atan2(side[1], side[0]) % math.pi
    heading = 0.0 if math.pi - heading < 1e-12 else heading
    bare = Grid(origin_ne=(0.0, 0.0), heading_rad=heading, cell_m=cell_m, rows=1, columns=1)
    corners = bare.cells_of(area.corners_ne)
    low, high = corners.min(axis=0), corners.max(axis=0)
    # A side of a whole number of cells has that many, whatever the rounding.
    counts = np.maximum(np.ceil(high - low - 1e-9).astype(int), 1)
    origin = bare.places_of((low + high - counts) / 2)
    return Grid(
        origin_ne=(float(origin[0]), float(origin[1])),
        heading_rad=heading,
        cell_m=cell_m,
        rows=int(counts[0]),
        columns=int(counts[1]),
    )


def north_up(
    area: Area, pixel_m: float, max_px: int
) -> tuple[Array, tuple[float, float, float, float]]:
    """Pixels of a picture of the survey area with north up.

    Args:
        area: it.
        pixel_m: side of a pixel, if no side of the picture has more than `max_px` of them.
        max_px: on the longer side.

    Returns:
        Their middles, (rows, columns, 2), and south, west, north and east of the picture.
    """
    south, west, north, east = area.survey.bounds  # x is north
    pixel_m = max(pixel_m, max(north - south, east - west) / max_px)
    rows, columns = (max(1, math.ceil(m / pixel_m - 1e-6)) for m in (north - south, east - west))
    places = np.meshgrid(
        north - pixel_m * (np.arange(rows) + 0.5), west + pixel_m * (np.arange(columns) + 0.5),
        indexing="ij",
    )  # fmt: skip
    bounds = (north - rows * pixel_m, west, north, west + columns * pixel_m)
    return np.stack(places, axis=-1), bounds


def inside(area: Area, grid: Grid) -> NDArray[np.bool_]:
    """Which middles of cells, (rows, columns), lie in the survey area."""
    survey = shapely.transform(area.survey, grid.cells_of)
    shapely.prepare(survey)
    columns = np.arange(grid.columns) + 0.5
    return np.array([shapely.contains_xy(survey, row + 0.5, columns) for row in range(grid.rows)])


def border_rays_body(rig: Rig, points_per_side: int = _POINTS_PER_SIDE) -> tuple[Array, Array]:
    """Where the rays of each picture's border leave the glass, and their ways in water.

    Args:
        rig: its cameras.
        points_per_side: of the border.

    Returns:
        Points about the left port's outer glass, (cameras, points, 3) metres, and unit rays of the
        same shape, both in the vehicle's axes.
    """
    glass = rig.body_from_cam(rig.reference).apply(rig.cameras[rig.reference].front_cam)
    points, rays = [], []
    for name, camera in rig.cameras.items():
        body_from_cam = rig.body_from_cam(name)
        points_cam, rays_cam = camera.unproject(camera.border(points_per_side))
        points.append(body_from_cam.apply(points_cam) - glass)
        rays.append(body_from_cam.rotation.apply(rays_cam))
    return np.stack(points), np.stack(rays)


def footprints_ne(
    points_body: Array, rays_body: Array, glass_ne: Array, altitude_m: Array, attitude_rad: Array
) -> Array:
    """Borders of all cameras' pictures on a sea floor that is level below each station.

    Args:
        points_body: (C, P, 3) from `border_rays_body`.
        rays_body: (C, P, 3) the same way.
        glass_ne: (S, 2).
        altitude_m: (S,) of the glass.
        attitude_rad: (S, 3) roll, pitch, heading.

    Returns:
        (S, C, P, 2) north and east; NaN where a ray never reaches the sea floor.
    """
    turn = rotation_from_attitude(*attitude_rad.T).as_matrix()
    points = np.einsum("sij,cpj->scpi", turn, points_body)
    rays = np.einsum("sij,cpj->scpi", turn, rays_body)
    height = altitude_m[:, None, None] - points[..., 2]
    reach = np.full(height.shape, np.nan)
    np.divide(height, rays[..., 2], out=reach, where=(rays[..., 2] > 0.0) & (height > 0.0))
    return np.asarray(glass_ne[:, None, None] + points[..., :2] + reach[..., None] * rays[..., :2])


def footprint_offsets(
    points_body: Array, rays_body: Array, altitude_m: Array, attitude_rad: Array
) -> tuple[Array, NDArray[np.intp]]:
    """Borders about the glass, each traced once for stations in a row that are alike but in place.

    Args:
        points_body: (C, P, 3) from `border_rays_body`.
        rays_body: (C, P, 3) the same way.
        altitude_m: (S,) of the glass.
        attitude_rad: (S, 3) roll, pitch, heading.

    Returns:
        (K, C, P, 2) north and east, as of `footprints_ne`; and (S,) which of them each station has.
    """
    pose = np.column_stack([altitude_m, attitude_rad])
    new = np.append(np.ones(min(len(pose), 1), bool), (pose[1:] != pose[:-1]).any(axis=1))
    offsets = footprints_ne(
        points_body, rays_body, np.zeros((new.sum(), 2)), altitude_m[new], attitude_rad[new]
    )
    return offsets, np.cumsum(new) - 1


@compiled(nogil=True)
def count_pictures(
    offsets: Array,
    which: NDArray[np.intp],
    glass: Array,
    line: NDArray[np.intp],
    first: int,
    pictures: NDArray[np.uint16],
    lines: NDArray[np.uint16],
    last: NDArray[np.int32],
    stamp: NDArray[np.int32],
    pairs: NDArray[np.uint16],
) -> None:
    """Add stations to what has seen the middle of each cell; the counts saturate at 65535.

    A station whose border holds a NaN sees nothing. Stations must come line by line: all of one
    line before those of the next.

    Args:
        offsets: (K, C, P, 2) borders of pictures about the glass, in rows and columns of the grid.
        which: (S,) which of them each station has.
        glass: (S, 2) places of the glass, the same way.
        line: (S,) of each station, -1 of none: that counts as a picture, not as a line.
        first: how many stations were added before.
        pictures: (C, rows, columns) how many of each camera; added to.
        lines: (C, rows, columns) how many lines of each camera; added to.
        last: (C, rows, columns) line that saw it last, -1 at first; kept from call to call.
        stamp: (rows, columns) picture that saw it last, -1 at first; kept the same way.
        pairs: (rows, columns) how many stations see it with all cameras at once; added to.
    """
    cameras, points = offsets.shape[1:3]
    rows, columns = stamp.shape
    border = np.empty((points, 2))
    crossing = np.empty((rows, points), np.int32)
    found = np.zeros(rows, np.int32)
    for s in range(len(which)):
        for c in range(cameras):
            for p in range(points):
                border[p, 0] = glass[s, 0] + offsets[which[s], c, p, 0]
                border[p, 1] = glass[s, 1] + offsets[which[s], c, p, 1]
            low, high = math.inf, -math.inf
            left, right = math.inf, -math.inf
            whole = True
            for p in range(points):
                whole = whole and math.isfinite(border[p, 0]) and math.isfinite(border[p, 1])
                low, high = min(low, border[p, 0]), max(high, border[p, 0])
                left, right = min(left, border[p, 1]), max(right, border[p, 1])
            if not whole or high < 0.0 or low > rows or right < 0.0 or left > columns:
                continue
            top = math.ceil(max(low, 0.0) - 0.5)
            bottom = math.ceil(min(high, float(rows)) - 0.5)
            for i in range(top, bottom):
                found[i] = 0
            for p in range(points):
                q = p + 1 if p + 1 < points else 0
                r0, c0, r1, c1 = border[p, 0], border[p, 1], border[q, 0], border[q, 1]
                if r1 < r0:
                    r0, c0, r1, c1 = r1, c1, r0, c0
                # Middles at i + 0.5 with r0 <= i + 0.5 < r1: each corner counts once.
                start = math.ceil(max(r0, 0.0) - 0.5)
                for i in range(start, math.ceil(min(r1, float(rows)) - 0.5)):
                    place = c0 + (i + 0.5 - r0) / (r1 - r0) * (c1 - c0)
                    column = math.ceil(min(max(place, 0.0), float(columns)) - 0.5)
                    k = found[i]
                    while k > 0 and crossing[i, k - 1] > column:
                        crossing[i, k] = crossing[i, k - 1]
                        k -= 1
                    crossing[i, k] = column
                    found[i] += 1
            before = (first + s) * cameras + c - 1
            for i in range(top, bottom):
                for k in range(0, found[i] - 1, 2):
                    for j in range(crossing[i, k], crossing[i, k + 1]):
                        if pictures[c, i, j] < 65535:
                            pictures[c, i, j] += 1
                        if line[s] >= 0 and last[c, i, j] != line[s]:
                            last[c, i, j] = line[s]
                            if lines[c, i, j] < 65535:
                                lines[c, i, j] += 1
                        if c == 0 or stamp[i, j] == before:
                            stamp[i, j] = before + 1
                            if c == cameras - 1 and pairs[i, j] < 65535:
                                pairs[i, j] += 1
