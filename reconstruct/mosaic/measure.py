"""What is asked once of every view: its picture, what the surface hides from it, its footprint."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rasterio.windows import Window

from reconstruct.mosaic.footprints import PictureFootprint, picture_footprint
from reconstruct.mosaic.grid import Float32, footprints
from reconstruct.mosaic.picture_measures import PictureMeasures, measure_picture
from reconstruct.mosaic.visibility import store_visible
from reconstruct.raster import DemGrid, opened_raster
from reconstruct.views.model import View, enu_from_cam

_MOST_CELLS = 16_000_000
"""Of the DEM for one view; views that see more, to the horizon, are looked at block by block."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewTask:
    """A view to measure."""

    workspace: Path
    scratch: Path
    """For what tiles will ask for."""
    view: View
    heights: tuple[float, float]
    """Lowest and highest cell of the DEM."""


def measure_view(task: ViewTask) -> tuple[PictureMeasures, PictureFootprint]:
    """Measure a picture and where it lies; write its small copy and what it sees of the DEM."""
    facts = measure_picture((task.workspace, task.scratch, task.view.image))
    dem, grid, whole = _part_seen(task)
    if whole:
        store_visible(task.scratch, task.view, dem, grid)
    return facts, picture_footprint(task.view, dem, grid)


def _part_seen(task: ViewTask) -> tuple[Float32, DemGrid, bool]:
    """The DEM below a view and all that it may see, coarser where that is a lot; whether it is."""
    west, east, south, north = footprints((task.view,), task.heights).boxes[0]
    camera = enu_from_cam(task.view, np.zeros(3))[:, 3]
    with opened_raster(task.workspace / "dense" / "dem.tif") as raster:
        t = raster.transform
        columns = [min(west, camera[0]), max(east, camera[0])]
        rows = [max(north, camera[1]), min(south, camera[1])]
        c0, c1 = np.clip((np.array(columns) - t.c) / t.a + [-3, 4], 0, raster.width).astype(int)
        r0, r1 = np.clip((t.f - np.array(rows)) / t.a + [-3, 4], 0, raster.height).astype(int)
        window = Window(int(c0), int(r0), int(c1 - c0), int(r1 - r0))
        coarser = int(np.ceil(np.sqrt(window.width * window.height / _MOST_CELLS)))
        shape = -(-window.height // max(coarser, 1)), -(-window.width // max(coarser, 1))
        dem = raster.read(1, window=window, out_shape=shape) if min(shape) else np.empty(
            shape, np.float32
        )  # fmt: skip
    cell = t.a * max(coarser, 1)
    grid = DemGrid(
        west=t.c + window.col_off * t.a, north=t.f - window.row_off * t.a, cell=cell,
        rows=dem.shape[0], columns=dem.shape[1],
    )  # fmt: skip
    return dem, grid, coarser <= 1
