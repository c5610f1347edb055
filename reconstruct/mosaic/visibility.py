"""How a view sees a grid over the surface, straight in the picture as taken.

Piles, walls, hulls and ladders stand off the heights of a plane and hide them. A DEM has one height
to a cell and leaves out where a wall stands. The cloud has all of the surface: its points off the
heights around are what a view meets first, where it does not see the heights themselves. They are
kept part by part of the cloud, so that a view reads those it may see.

Kernels find where a view shows each point of a surface, how well, and what it shows there.
"""

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.compiled import compiled
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array
from camera_calib.approximation.pinhole_warp import PinholeWarp
from camera_calib.water import CHANNELS, channel_cameras
from reconstruct.mosaic.grid import Float32, footprints, height_at_pixels
from reconstruct.pictures.undistorted import taken_nodes
from reconstruct.planes import Plane
from reconstruct.ply import read_header
from reconstruct.raster import DemGrid, grid_of, read_cells, small_cache
from reconstruct.views.model import View, enu_from_cam
from reconstruct.views.range_shift import (
    FAST,
    KernelLens,
    Nodes,
    RangeShift,
    as_nodes,
    between_nodes,
    no_shift,
    range_shift,
    warped_at,
)

_PART = 65_536
"""Points of the cloud, which lie together, to a part."""
_BLOCK_CELLS = 1024
"""Side of the parts of a DEM that are held at once, wherever a part of the cloud lies."""
_AROUND_CELLS = 2
"""Cells on each side of a point whose heights count as those around it."""
_OFF_CELLS = 3.0
"""Distance above or below all heights around a point, in cells, from which it is off them."""
_HIDES_SPACINGS = 4.0
"""Distance before a cell, in spacings of points, from which a point hides it."""
_SHRINK = 2
"""Pixels of a picture to one of those in which occluders are drawn."""
_COVER = 0.75
"""Half the side of the square that a point covers, in spacings of points."""
_MARGIN = 1.1
"""Reach of a frame over its own, for what a port bends."""
_TASK_MIB = 100


@dataclass(frozen=True, kw_only=True, eq=False)
class Occluders:
    """Points off the heights of a plane, in parts that stay on disk."""

    folder: Path
    numbers: NDArray[np.int64]
    """(C,) of the parts."""
    centres: Array
    """(C, 3) of spheres around them, in the plane's frame."""
    radii: Array
    """(C,)."""
    spacing: float
    """Of points."""

    def seen_by(self, view: View) -> Float32:
        """(N, 3) points of the parts that may reach into a view's frame, in the plane's frame."""
        middle = view.world_from_cam.inv().apply(self.centres)
        low, high = view.pinhole.slopes(np.array([(0, 0), view.pinhole.size_px]))
        slope = _MARGIN * float(np.hypot(*np.maximum(-low, high)))
        away = np.hypot(middle[:, 0], middle[:, 1]) - slope * middle[:, 2]
        near = (away < self.radii * math.hypot(1.0, slope)) & (middle[:, 2] > -self.radii)
        parts = [np.load(_part_path(self.folder, number)) for number in self.numbers[near]]
        return np.concatenate([np.empty((0, 3), np.float32), *parts])


def find_occluders(
    cloud: Path,
    spacing: float,
    plane: Plane,
    dem: Path,
    folder: Path,
    executor: Executor,
    label: str,
) -> None:
    """Write the points of a surface that are off the heights of a plane.

    Args:
        cloud: PLY of its points.
        spacing: of them.
        plane: whose heights.
        dem: they.
        folder: to write to.
        executor: where tasks run.
        label: of its progress.

    Raises:
        WorkspaceError: the cloud is missing or damaged.
    """
    folder.mkdir()
    parts = range(-(-read_header(cloud).count // _PART))
    find = partial(_off_heights, cloud, plane, dem, folder)
    found = executor.map(find, parts, label=label, task_mib=_TASK_MIB)
    kept = [(number, *sphere) for number, sphere in enumerate(found) if sphere is not None]
    with atomic_path(folder / "index.npz", lasting=False) as temporary:
        np.savez(
            temporary,
            numbers=np.array([number for number, *_ in kept], np.int64),
            centres=np.array([centre for _, centre, _ in kept]).reshape(-1, 3),
            radii=np.array([radius for *_, radius in kept]),
            spacing=np.array(spacing),
        )


def read_occluders(folder: Path) -> Occluders:
    """What `find_occluders` wrote."""
    with np.load(folder / "index.npz") as index:
        return Occluders(folder=folder, **index)


@small_cache()
def _off_heights(
    cloud: Path, plane: Plane, dem: Path, folder: Path, number: int
) -> tuple[Array, float] | None:
    """Write a part's points off the heights; a sphere around them, None where there are none."""
    header = read_header(cloud)
    rows = header.rows()[number * _PART : (number + 1) * _PART]
    east, north, up = (rows[axis] + header.offset[n] for n, axis in enumerate("xyz"))
    points = plane.plane_from_world.apply(np.column_stack([north, east, -up]).astype(np.float64))
    off = points[_are_off(points, dem)]
    if not len(off):
        return None
    np.save(_part_path(folder, number), off.astype(np.float32))
    centre = 0.5 * (off.min(axis=0) + off.max(axis=0))
    return centre, float(np.linalg.norm(off - centre, axis=1).max())


def _are_off(points: Array, dem: Path) -> NDArray[np.bool_]:
    """(N,) whether points (N, 3), north, east, down, are off all heights around them."""
    off, grid = np.zeros(len(points), np.bool_), grid_of(dem)
    column = np.floor((points[:, 1] - grid.west) / grid.cell).astype(np.int64)
    row = np.floor((grid.north - points[:, 0]) / grid.cell).astype(np.int64)
    blocks = np.stack([row, column], axis=1) // _BLOCK_CELLS
    _, block = np.unique(blocks, axis=0, return_inverse=True)
    side, limit = 2 * _AROUND_CELLS + 1, _OFF_CELLS * grid.cell
    for n in range(block.max(initial=-1) + 1):
        here = np.flatnonzero(block.reshape(-1) == n)
        top, left = row[here].min() - _AROUND_CELLS, column[here].min() - _AROUND_CELLS
        at = row[here] - top, column[here] - left
        size = (int(part.max()) + _AROUND_CELLS + 1 for part in at)
        heights = read_cells(dem, int(top), int(left), *size)
        known = np.isfinite(heights)
        highest = maximum_filter(np.where(known, heights, -np.inf), side)[at]
        lowest = minimum_filter(np.where(known, heights, np.inf), side)[at]
        up = -points[here, 2]
        off[here] = (up > highest + limit) | (up < lowest - limit)
    return off


def hidden_by(occluders: Occluders, view: View, points: Array) -> NDArray[np.bool_]:
    """(N,) whether occluders hide points (N, 3) of the plane's frame from a view."""
    standing = occluders.seen_by(view).astype(np.float64)
    hidden = np.zeros(len(points), np.bool_)
    if not len(standing) or not len(points):
        return hidden
    width, height = view.pinhole.size_px
    low, high = view.pinhole.slopes(np.array([(0, 0), (width, height)]))
    focal_px = width / float(high[0] - low[0])
    depth = view.world_from_cam.inv().apply(standing)[:, 2]
    drawn = _draw(
        view.project(standing) / _SHRINK,
        depth,
        _COVER * occluders.spacing * focal_px / _SHRINK,
        (-(-height // _SHRINK), -(-width // _SHRINK)),
    )
    pixels = np.nan_to_num(view.project(points) / _SHRINK, nan=-1.0)
    column, row = np.floor(pixels).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (row < drawn.shape[0]) & (column < drawn.shape[1])
    own = view.world_from_cam.inv().apply(points[inside])[:, 2]
    nearest = drawn[row[inside], column[inside]]
    hidden[inside] = nearest < own - _HIDES_SPACINGS * occluders.spacing
    return hidden


@compiled
def _draw(pixels: Array, depth: Array, cover: float, shape: tuple[int, int]) -> Float32:
    """(H, W) depth of the nearest point at each pixel, infinite where there is none.

    Args:
        pixels: (N, 2) columns and rows; NaN where not seen.
        depth: (N,).
        cover: half the side of a point's square at a depth of 1, px.
        shape: H and W.
    """
    drawn = np.full(shape, np.inf, np.float32)
    for n in range(len(depth)):
        x, y = pixels[n, 0], pixels[n, 1]
        if depth[n] <= 0.0 or math.isnan(x) or math.isnan(y):
            continue
        reach = cover / depth[n]
        if x + reach < 0 or y + reach < 0 or x - reach >= shape[1] or y - reach >= shape[0]:
            continue
        for row in range(max(0, math.floor(y - reach)), min(shape[0], math.floor(y + reach) + 1)):
            first, last = math.floor(x - reach), math.floor(x + reach) + 1
            for column in range(max(0, first), min(shape[1], last)):
                drawn[row, column] = min(drawn[row, column], np.float32(depth[n]))
    return drawn


def _part_path(folder: Path, number: int | np.int64) -> Path:
    return folder / f"{int(number):06d}.npy"


_SPACING_PX = 8.0
"""Spacing of nodes between which a lens is bilinear: within 0.001 px for the lenses of such
cameras."""
_HIDES_CELLS = 2.5
"""Height over a line of sight, in cells of the DEM, at which a cell hides what is behind it."""
_RIM_PX = 2.0


@dataclass(frozen=True, kw_only=True)
class Water:
    """What bends the colours behind a flat port; the index itself comes from the calibration."""

    temperature_c: float
    salinity_psu: float
    depth_m: float


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraOptics:
    """One camera, or one channel of it, from its pinhole's pixels to the picture as taken."""

    taken: Nodes
    """Pixels as taken; see `taken_nodes`."""
    shift: RangeShift
    size_px: tuple[int, int]
    """Width and height of the picture as taken."""


class SeenCells(NamedTuple):
    """Where and how well a view shows the cells of a grid, (H, W) each."""

    x: Float32
    """Column in the picture as taken, the first pixel's centre is 0; -1 where not seen."""
    y: Float32
    quality: Float32
    """0 where not seen."""
    range: Float32
    """Distance from the pinhole's centre; NaN where not seen."""

    def places(self, size_px: tuple[int, int]) -> Float32:
        """(H * W, 2) columns and rows as shares of the picture's width and height."""
        places = np.column_stack([self.x.ravel(), self.y.ravel()])
        return np.asarray((places + np.float32(0.5)) / np.array(size_px, np.float32))


@dataclass(frozen=True, kw_only=True, eq=False)
class Visible:
    """Cells of the DEM that a view sees over it."""

    cells: NDArray[np.bool_]
    west: float
    """East coordinate of the first column's outer edge."""
    north: float


class Ground:
    """A part of the DEM, and what each view sees of it."""

    def __init__(self, dem: Float32, around: DemGrid, stored: Path | None = None) -> None:
        """`dem` holds the heights of the cells of `around`; `stored` what is known of the plane."""
        self.dem = dem
        self.around = around
        self._stored = stored
        self._visible: dict[str, Visible] = {}

    def visible_from(self, view: View) -> Visible:
        """Cells that a view sees; a view that was not stored is traced in this part of the DEM."""
        if view.image not in self._visible:
            path = None if self._stored is None else visible_path(self._stored, view.image)
            if path is not None and path.is_file():
                with np.load(path) as stored:
                    self._visible[view.image] = Visible(**stored)
            else:
                self._visible[view.image] = visible_over(view, self.dem, self.around, self._stored)
        return self._visible[view.image]

    def surface(self, grid: DemGrid) -> "GridHeights":
        """Heights of a grid on it."""
        height = height_at_pixels(self.dem, self.around, grid)
        return GridHeights(grid=grid, height=height, ground=self)


@dataclass(frozen=True, kw_only=True, eq=False)
class GridHeights:
    """Heights of a grid."""

    grid: DemGrid
    height: Float32
    """(rows, columns) heights of the grid, up."""
    ground: Ground

    def part(self, rows: slice, columns: slice) -> "GridHeights":
        """A part of it."""
        grid = self.grid.window(
            rows.start, columns.start, rows.stop - rows.start, columns.stop - columns.start
        )
        height = np.ascontiguousarray(self.height[rows, columns])
        return replace(self, grid=grid, height=height)


def visible_over(view: View, dem: Float32, around: DemGrid, stored: Path | None = None) -> Visible:
    """Cells of a DEM that a view sees over it and past what stands off it.

    Args:
        view: the view.
        dem: heights.
        around: their cells.
        stored: folder of what is known of the plane; None where nothing stands off the DEM.
    """
    known = dem[np.isfinite(dem)]
    part = (0, 0, 0, 0)
    if len(known):
        part = _reach(view, (float(known.min()), float(known.max())), around)
    centre, cell = enu_from_cam(view, np.zeros(3))[:, 3], around.cell
    cells = visible_cells(dem, centre, around.west, around.north, cell, _HIDES_CELLS * cell, part)
    if stored is not None:
        rows, columns = np.nonzero(cells)
        points = np.column_stack([
            around.north_of(rows + 0.5), around.east_of(columns + 0.5), -dem[rows, columns]
        ])  # fmt: skip
        cells[rows, columns] = ~hidden_by(read_occluders(occluders_folder(stored)), view, points)
    return Visible(cells=cells, west=around.west, north=around.north)


def _reach(view: View, heights: tuple[float, float], around: DemGrid) -> tuple[int, int, int, int]:
    """Rows and columns of a DEM that a view may see."""
    west, east, south, north = footprints((view,), heights).boxes[0]
    rows = np.array([around.north - north, around.north - south]) / around.cell + [-2, 2]
    columns = np.array([west - around.west, east - around.west]) / around.cell + [-2, 2]
    top, bottom = np.clip(rows, 0, around.rows).astype(int).tolist()
    left, right = np.clip(columns, 0, around.columns).astype(int).tolist()
    return top, bottom, left, right


def occluders_folder(stored: Path) -> Path:
    """Folder of what stands off a plane's heights."""
    return stored / "occluders"


def visible_path(folder: Path, image: str) -> Path:
    """The file of the cells that a view sees."""
    return folder / f"{image}.seen.npz"


def store_visible(folder: Path, view: View, dem: Float32, around: DemGrid) -> None:
    """Write the cells of a DEM that a view sees, so that no tile has to ask again.

    Args:
        folder: for the file; the occluders of the plane are in it.
        view: the view.
        dem: all of the DEM that the view sees, and that may lie between it and that.
        around: its cells.
    """
    visible = visible_over(view, dem, around, folder)
    rows, columns = np.flatnonzero(visible.cells.any(1)), np.flatnonzero(visible.cells.any(0))
    top, left = (int(seen[0]) if len(seen) else 0 for seen in (rows, columns))
    cells = visible.cells[top : rows.max(initial=-1) + 1, left : columns.max(initial=-1) + 1]
    corner = around.window(top, left, *cells.shape)
    path = visible_path(folder, view.image)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path, lasting=False) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, cells=cells, west=corner.west, north=corner.north)


def camera_optics(warp: PinholeWarp, scaled: bool) -> CameraOptics:
    """Optics of a camera; without lengths in metres a port's range shift is not known."""
    size_px = warp.pinhole.size_px
    return CameraOptics(
        taken=as_nodes(taken_nodes(warp, _SPACING_PX), *size_px),
        shift=range_shift(warp) if scaled else no_shift(*size_px),
        size_px=warp.size_px,
    )


def channel_optics(warp: PinholeWarp, water: Water, scaled: bool) -> tuple[CameraOptics, ...]:
    """Optics of the blue, green and red channel of a camera behind a port, in the order of BGR.

    All see through the pinhole of green; the rays that they take through port and water differ by
    their indices, at the working range and beyond it.
    """
    cameras = channel_cameras(warp.camera, **vars(water))
    found = {n: camera_optics(replace(warp, camera=cameras[n]), scaled) for n in CHANNELS}
    return found["blue"], found["green"], found["red"]


_ALL: tuple[NDArray[np.bool_], int] = (np.ones((1, 1), np.bool_), 1)


def see(
    view: View,
    optics: CameraOptics,
    surface: GridHeights,
    requested: tuple[NDArray[np.bool_], int] = _ALL,
) -> SeenCells:
    """Look at a surface with a view; what the surface itself hides is not seen.

    Args:
        view: the view.
        optics: of its camera, or of a channel of it.
        surface: heights.
        requested: squares of the surface's grid to look at, and their side in its cells.
    """
    grid, cell = surface.grid, surface.ground.around.cell
    visible = surface.ground.visible_from(view)
    camera = enu_from_cam(view, np.zeros(3))
    east, north = float(grid.east_of(0.5)), float(grid.north_of(0.5))
    rotation = camera[:, :3].T
    cam_from_enu = np.column_stack([rotation, -rotation @ camera[:, 3]])
    lens = replace(view, shift=optics.shift).kernel_lens
    found = look_up(
        surface.height,
        (np.ascontiguousarray(requested[0]), requested[1]),
        visible.cells,
        ((visible.north - north) / cell - 0.5, (east - visible.west) / cell - 0.5),
        grid.cell / cell,
        np.ascontiguousarray(cam_from_enu),
        lens,
        view.pinhole.size_px,
        optics.taken,
        optics.size_px,
        (east, north),
        grid.cell,
        _RIM_PX,
    )
    return SeenCells(*found)


@compiled(error_model="numpy", fastmath=FAST)
def visible_cells(
    height: Float32,
    camera_enu: Array,
    west: float,
    north: float,
    cell: float,
    tolerance: float,
    part: tuple[int, int, int, int],
) -> NDArray[np.bool_]:
    """Which cells of a DEM a camera sees over the DEM itself.

    From each cell's centre the line to the camera is followed, cell by cell, until it is above
    all of the DEM; the DEM hides the cell where it rises above the line by more than a tolerance.

    Args:
        height: (H, W) up, NaN where unknown (there nothing hides).
        camera_enu: (3,) the camera's centre, in the coordinates of the DEM.
        west: east coordinate of the first column's outer edge.
        north: north coordinate of the first row's outer edge.
        cell: side of a cell.
        tolerance: in the unit of height.
        part: first row, last row and one, first column, last column and one of the cells to ask
            for; all of the DEM may hide them.

    Returns:
        (H, W); False where the height is unknown and beyond the part.
    """
    rows, columns = height.shape
    visible = np.zeros((rows, columns), np.bool_)
    top = -np.inf
    for row in range(rows):
        for column in range(columns):
            if height[row, column] > top:
                top = height[row, column]
    camera_column = (camera_enu[0] - west) / cell - 0.5
    camera_row = (north - camera_enu[1]) / cell - 0.5
    for row in range(part[0], part[1]):
        for column in range(part[2], part[3]):
            h = height[row, column]
            if math.isnan(h) or h >= camera_enu[2]:
                continue
            right, down = camera_column - column, camera_row - row
            steps = max(abs(right), abs(down))
            hidden = False
            if steps >= 1.0:
                rise = (camera_enu[2] - h) / steps
                right, down = right / steps, down / steps
                last = min(steps, (top - h) / rise)
                for n in range(1, math.floor(last) + 1):
                    r = math.floor(row + down * n + 0.5)
                    c = math.floor(column + right * n + 0.5)
                    if r < 0 or c < 0 or r >= rows or c >= columns:
                        break
                    if height[r, c] > h + rise * n + tolerance:
                        hidden = True
                        break
            visible[row, column] = not hidden
    return visible


@compiled(error_model="numpy", fastmath=FAST)
def look_up(
    height: Float32,
    requested: tuple[NDArray[np.bool_], int],
    visible: NDArray[np.bool_],
    first_cell: tuple[float, float],
    cells_per_pixel: float,
    cam_from_enu: Array,
    lens: KernelLens,
    warped_size: tuple[int, int],
    taken: Nodes,
    size: tuple[int, int],
    first_enu: tuple[float, float],
    pixel: float,
    rim: float,
) -> tuple[Float32, Float32, Float32, Float32]:
    """Where the picture as taken shows each pixel of a tile, and how well.

    A point goes through the port to the warped picture and from there to the picture as taken, so
    that colours are resampled once. The quality is the distance from the rim of the picture (1 in
    the middle, 0 at the rim) times the cosine of the angle to the vertical over the distance
    squared, so that the middle of near, steep views wins.

    Args:
        height: (H, W) up at the pixels' centres, NaN where unknown.
        requested: (h, w) whether to look at squares of pixels, and their side; beyond the last
            square the last one sees.
        visible: cells of the DEM that the view sees.
        first_cell: row and column of the first pixel's centre in `visible` (cell centres whole).
        cells_per_pixel: side of a pixel over side of a cell.
        cam_from_enu: (3, 4) transform to the camera.
        lens: of the view, or of a channel of it.
        warped_size: width and height of the warped picture, px.
        taken: pixels as taken at nodes spread evenly over the warped picture; NaN where there are
            none.
        size: width and height of the picture as taken, px.
        first_enu: east and north of the first pixel's centre.
        pixel: side of a pixel.
        rim: pixels of the picture at its edges that are not used.

    Returns:
        (H, W) x and y in OpenCV's pixels (-1 where not seen), the quality (0 where not seen) and
        the distance from the pinhole's centre (NaN where not seen).
    """
    rows, columns = height.shape
    x = np.full((rows, columns), -1.0, np.float32)
    y = np.full((rows, columns), -1.0, np.float32)
    quality = np.zeros((rows, columns), np.float32)
    ranges = np.full((rows, columns), np.nan, np.float32)
    t = cam_from_enu
    half = 0.5 * min(size[0], size[1])
    squares, side = requested
    pinhole, field, inverse_working = lens  # out of the loop: taking it apart costs time
    for row in range(rows):
        north = first_enu[1] - row * pixel
        cell_row = math.floor(first_cell[0] + row * cells_per_pixel + 0.5)
        if cell_row < 0 or cell_row >= visible.shape[0]:
            continue
        square_row = min(row // side, squares.shape[0] - 1)
        for column in range(columns):
            if not squares[square_row, min(column // side, squares.shape[1] - 1)]:
                continue
            up = height[row, column]
            if math.isnan(up):
                continue
            cell_column = math.floor(first_cell[1] + column * cells_per_pixel + 0.5)
            if cell_column < 0 or cell_column >= visible.shape[1]:
                continue
            if not visible[cell_row, cell_column]:
                continue
            east = first_enu[0] + column * pixel
            c = t[2, 0] * east + t[2, 1] * north + t[2, 2] * up + t[2, 3]
            if c <= 0.0:
                continue
            a = t[0, 0] * east + t[0, 1] * north + t[0, 2] * up + t[0, 3]
            b = t[1, 0] * east + t[1, 1] * north + t[1, 2] * up + t[1, 3]
            inverse = 1.0 / c
            u = pinhole[0] * a * inverse + pinhole[2]
            v = pinhole[1] * b * inverse + pinhole[3]
            u, v = warped_at(field, inverse_working, u, v, inverse)
            if u < 0.0 or v < 0.0 or u > warped_size[0] or v > warped_size[1]:
                continue
            u, v, _, _, _, _ = between_nodes(taken, u, v)
            inset = min(min(u, size[0] - u), min(v, size[1] - v)) - rim
            if not inset > 0.0:  # NaN as well
                continue
            distance = math.sqrt(a * a + b * b + c * c)
            # the camera's height over the point, along the third row of enu_from_cam
            cosine = -(t[0, 2] * a + t[1, 2] * b + t[2, 2] * c) / distance
            if cosine <= 0.05:
                continue
            x[row, column] = u - 0.5
            y[row, column] = v - 0.5
            quality[row, column] = inset / half * cosine / (distance * distance)
            ranges[row, column] = distance
    return x, y, quality, ranges
