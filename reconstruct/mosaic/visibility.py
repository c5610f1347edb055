"""How a view sees a grid over the surface, straight in the picture as taken."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import atomic_path
from camera_calib.approximation.dispersion import channel_cameras
from camera_calib.approximation.pinhole_warp import PinholeWarp
from camera_calib.water import CHANNELS
from reconstruct.mosaic.grid import Float32, footprints, height_at_pixels
from reconstruct.mosaic.occluders import hidden_by, read_occluders
from reconstruct.mosaic.ortho import look_up, visible_cells
from reconstruct.pictures.undistorted import taken_nodes
from reconstruct.raster import DemGrid
from reconstruct.views.model import View, enu_from_cam
from reconstruct.views.range_shift import Nodes, RangeShift, as_nodes, no_shift, range_shift

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


@dataclass(frozen=True, kw_only=True, eq=False)
class SeenCells:
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
                self._visible[view.image] = _load_visible(path)
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
        return replace(self, grid=grid, height=self.height[rows, columns])


def visible_over(view: View, dem: Float32, around: DemGrid, stored: Path | None = None) -> Visible:
    """Cells of a DEM that a view sees over it and past what stands off it.

    Args:
        view: the view.
        dem: heights.
        around: their cells.
        stored: folder of what is known of the plane; None where nothing stands off the DEM.
    """
    known = np.isfinite(dem)
    part = (0, 0, 0, 0)
    if known.any():
        part = _reached(view, (float(dem[known].min()), float(dem[known].max())), around)
    cells = visible_cells(
        dem,
        enu_from_cam(view, np.zeros(3))[:, 3],
        around.west,
        around.north,
        around.cell,
        _HIDES_CELLS * around.cell,
        part,
    )
    if stored is not None:
        rows, columns = np.nonzero(cells)
        points = np.column_stack([
            around.north_of(rows + 0.5), around.east_of(columns + 0.5), -dem[rows, columns]
        ])  # fmt: skip
        cells[rows, columns] = ~hidden_by(read_occluders(occluders_folder(stored)), view, points)
    return Visible(cells=cells, west=around.west, north=around.north)


def _reached(
    view: View, heights: tuple[float, float], around: DemGrid
) -> tuple[int, int, int, int]:
    """Rows and columns of a DEM that a view may see."""
    west, east, south, north = footprints((view,), heights).boxes[0]
    edge = 2.0 * around.cell
    rows = (np.array([around.north - north - edge, around.north - south + edge])) / around.cell
    columns = (np.array([west - edge - around.west, east + edge - around.west])) / around.cell
    r = np.clip(rows, 0, around.rows).astype(int)
    c = np.clip(columns, 0, around.columns).astype(int)
    return int(r[0]), int(r[1]), int(c[0]), int(c[1])


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
    rows, columns = np.flatnonzero(visible.cells.any(axis=1)), np.flatnonzero(visible.cells.any(0))
    if len(rows):
        top, left = int(rows[0]), int(columns[0])
        cells = visible.cells[top : rows[-1] + 1, left : columns[-1] + 1]
    else:
        top, left, cells = 0, 0, np.zeros((0, 0), np.bool_)
    path = visible_path(folder, view.image)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez(
            file,
            bits=np.packbits(cells),
            shape=np.array(cells.shape),
            corner=np.array([around.west + left * around.cell, around.north - top * around.cell]),
        )


def _load_visible(path: Path) -> Visible:
    with np.load(path) as stored:
        high, wide = (int(n) for n in stored["shape"])
        cells = np.unpackbits(stored["bits"], count=high * wide).astype(np.bool_)
        west, north = (float(v) for v in stored["corner"])
    return Visible(cells=cells.reshape(high, wide), west=west, north=north)


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
    cameras = channel_cameras(
        warp.camera,
        temperature_c=water.temperature_c,
        salinity_psu=water.salinity_psu,
        depth_m=water.depth_m,
    )
    found = {n: camera_optics(replace(warp, camera=cameras[n]), scaled) for n in CHANNELS}
    return found["blue"], found["green"], found["red"]


_ALL: tuple[NDArray[np.bool_], int] = (np.ones((1, 1), np.bool_), 1)


def see(
    view: View,
    optics: CameraOptics,
    surface: GridHeights,
    wanted: tuple[NDArray[np.bool_], int] = _ALL,
) -> SeenCells:
    """Look at a surface with a view; what the surface itself hides is not seen.

    Args:
        view: the view.
        optics: of its camera, or of a channel of it.
        surface: heights.
        wanted: squares of the surface's grid to look at, and their side in its cells.
    """
    grid, cell = surface.grid, surface.ground.around.cell
    visible = surface.ground.visible_from(view)
    camera = enu_from_cam(view, np.zeros(3))
    east, north = float(grid.east_of(0.5)), float(grid.north_of(0.5))
    rotation = camera[:, :3].T
    cam_from_enu = np.column_stack([rotation, -rotation @ camera[:, 3]])
    lens = replace(view, shift=optics.shift).kernel_lens
    x, y, quality, ranges = look_up(
        surface.height,
        wanted,
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
    return SeenCells(x=x, y=y, quality=quality, range=ranges)
