"""Pixels of the mosaic, its tiles, the views that reach each, and the surface below them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.windows import Window

from alice_survey.core.errors import ReconstructionError
from alice_survey.core.frames import Array
from reconstruct.raster import DemGrid, grid_of, read_cells, tiles_of
from reconstruct.views.model import SparseModel, View, enu_from_cam, points_of_views

Float32 = NDArray[np.float32]

CELL_PX = 8
"""Pixels a side of the cells on which views are compared and seams are laid."""
ALIGNED_PX = 2 * CELL_PX
"""Blocks are a whole number of these, so that they share the pixels of their pyramids."""
_FLATTEST_SLOPE = 5.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Footprints:
    """What each view may see between the lowest and the highest cell of the DEM."""

    boxes: Array
    """(V, 4) west, east, south, north; infinite for views that reach the horizon."""
    reach: Array
    """(V,) how far off, on the ground, the DEM may hide something from a view."""


@dataclass(frozen=True, kw_only=True)
class Block:
    """A part of the mosaic and the views that may see it."""

    window: Window
    """Part of the mosaic, in its pixels, a margin included; it may reach beyond the mosaic's edges.
    """
    core: Window
    """The part of the mosaic that this block is to fill."""
    grid: DemGrid
    """Grid of the window's pixels."""
    views: tuple[int, ...]
    """Numbers of views."""
    reach: float
    """How far off, on the ground, the DEM may hide something in the window."""


def mosaic_grid(dem: DemGrid, pixel: float) -> DemGrid:
    """Pixels over the whole of a DEM."""
    rows, columns = (int(np.ceil(size * dem.cell / pixel)) for size in (dem.rows, dem.columns))
    return replace(dem, cell=pixel, rows=rows, columns=columns)


def footprints(views: tuple[View, ...], heights: tuple[float, float]) -> Footprints:
    """Boxes on the ground of all views, for a DEM between two heights."""
    found = [_footprint(view, heights) for view in views]
    boxes = np.array([box for box, _ in found]).reshape(-1, 4)
    slopes = np.array([slope for _, slope in found])
    return Footprints(boxes=boxes, reach=slopes * (heights[1] - heights[0]))


def _footprint(
    view: View, heights: tuple[float, float]
) -> tuple[tuple[float, float, float, float], float]:
    """What a view sees between two heights, and its flattest line of sight (ground per height)."""
    camera = enu_from_cam(view, np.zeros(3))
    w, h = view.pinhole.size_px
    corners = view.pinhole.slopes(np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]]))
    rays = np.column_stack([corners, np.ones(4)]) @ camera[:, :3].T
    if (rays[:, 2] > -0.2 * np.linalg.norm(rays[:, :2], axis=1)).any():
        return (-np.inf, np.inf, -np.inf, np.inf), _FLATTEST_SLOPE
    slope = float((np.linalg.norm(rays[:, :2], axis=1) / -rays[:, 2]).max())
    centre = camera[:, 3]
    reach = [(centre[2] - height) / -rays[:, 2:] for height in heights]
    ground = np.concatenate([centre[:2] + r * rays[:, :2] for r in reach])
    (west, south), (east, north) = ground.min(axis=0), ground.max(axis=0)
    return (float(west), float(east), float(south), float(north)), slope


def blocks_of(grid: DemGrid, seen: Footprints, size: int, margin: int) -> list[Block]:
    """Blocks that any view's footprint reaches, row by row, each with those views.

    Args:
        grid: of the mosaic.
        seen: by its views.
        size: pixels a side of a core.
        margin: pixels around it.
    """
    blocks = []
    for core in tiles_of(grid, size):
        window = Window(
            core.col_off - margin,
            core.row_off - margin,
            _align(core.width) + 2 * margin,
            _align(core.height) + 2 * margin,
        )
        part = grid.window(window.row_off, window.col_off, window.height, window.width)
        east, south = float(part.east_of(part.columns)), float(part.north_of(part.rows))
        b = seen.boxes
        reaching = np.flatnonzero(
            (b[:, 0] < east) & (b[:, 1] > part.west) & (b[:, 2] < part.north) & (b[:, 3] > south)
        )
        if not len(reaching):
            continue
        reach = float(seen.reach[reaching].max())
        blocks.append(
            Block(
                window=window,
                core=core,
                grid=part,
                views=tuple(int(n) for n in reaching),
                reach=min(reach, 512 * grid.cell),
            )
        )
    return blocks


def neighbours(blocks: Sequence[Block], side_px: int) -> list[list[Block]]:
    """Blocks whose cores start in the same square of so many pixels a side."""
    groups: dict[tuple[int, int], list[Block]] = {}
    for block in blocks:
        square = (block.core.row_off // side_px, block.core.col_off // side_px)
        groups.setdefault(square, []).append(block)
    return [groups[key] for key in sorted(groups)]


def in_passes(blocks: Sequence[Block]) -> list[list[tuple[Block, tuple[Window, ...]]]]:
    """Blocks in two passes of a chequerboard, each with its neighbours in the pass before.

    Returns:
        Passes that have any block: blocks of it, and the cores next to each.
    """
    rows, columns = (
        {offset: n for n, offset in enumerate(sorted({getattr(b.core, name) for b in blocks}))}
        for name in ("row_off", "col_off")
    )
    at = {(rows[b.core.row_off], columns[b.core.col_off]): b for b in blocks}
    passes: list[list[tuple[Block, tuple[Window, ...]]]] = [[], []]
    for (row, column), block in at.items():
        around = ((row - 1, column), (row, column - 1), (row, column + 1), (row + 1, column))
        later = (row + column) % 2
        cores = tuple(at[key].core for key in around if later and key in at)
        passes[later].append((block, cores))
    return [one for one in passes if one]


def coarse(grid: DemGrid, side_px: int = CELL_PX) -> DemGrid:
    """Cells of a number of pixels a side that cover a grid of pixels."""
    rows, columns = -(-grid.rows // side_px), -(-grid.columns // side_px)
    return replace(grid, cell=grid.cell * side_px, rows=rows, columns=columns)


def _align(pixels: int) -> int:
    return -(-int(pixels) // ALIGNED_PX) * ALIGNED_PX


def mean_pixel(model: SparseModel) -> float:
    """Median over the views of the side of a pixel on the ground."""
    sides = []
    for view, points in zip(model.views, points_of_views(model), strict=True):
        if len(points):
            depth = view.world_from_cam.inv().apply(points)[:, 2]
            sides.append(np.median(depth) / view.pinhole.focal_px)
    return float(np.median(sides))


def height_range(raster: rasterio.DatasetReader) -> tuple[float, float]:
    """Lowest and highest cell of a DEM.

    Raises:
        ReconstructionError: it has no cell.
    """
    low, high = np.inf, -np.inf
    for _, window in raster.block_windows(1):
        block = raster.read(1, window=window)
        if np.isfinite(block).any():
            low, high = min(low, float(np.nanmin(block))), max(high, float(np.nanmax(block)))
    if low > high:
        raise ReconstructionError(f"{raster.name} has no cell with a height to paint on")
    return low, high


def dem_around(dem: Path, grid: DemGrid, reach: float) -> tuple[Float32, DemGrid]:
    """The DEM of a grid and as far around it as something may hide it."""
    whole = grid_of(dem)
    margin = int(np.ceil(reach / whole.cell)) + 2
    left = max(0, int((grid.west - whole.west) / whole.cell) - margin)
    top = max(0, int((whole.north - grid.north) / whole.cell) - margin)
    right = int(np.ceil((grid.east_of(grid.columns) - whole.west) / whole.cell)) + margin
    bottom = int(np.ceil((whole.north - grid.north_of(grid.rows)) / whole.cell)) + margin
    size = min(whole.rows, bottom) - top, min(whole.columns, right) - left
    heights = read_cells(dem, top, left, *size).astype(np.float32)
    return heights, whole.window(top, left, *size)


def height_at_pixels(dem: Float32, around: DemGrid, grid: DemGrid) -> Float32:
    """Bilinear heights at the centres of a grid's pixels; NaN where a cell around is unknown.

    At the outer edge of the DEM the last cell's height is used for the half cell beyond its centre;
    farther out nothing is known.
    """
    columns = (grid.east_of(np.arange(grid.columns) + 0.5) - around.west) / around.cell - 0.5
    rows = (around.north - grid.north_of(np.arange(grid.rows) + 0.5)) / around.cell - 0.5
    x, y = np.meshgrid(columns.astype(np.float32), rows.astype(np.float32))
    height: Float32 = cv2.remap(dem, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    height[:, (columns < -0.5) | (columns > around.columns - 0.5)] = np.nan
    height[(rows < -0.5) | (rows > around.rows - 0.5)] = np.nan
    return height
