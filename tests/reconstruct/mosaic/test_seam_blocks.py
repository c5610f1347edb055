"""Blocks whose seams are solved at once stay small where many pictures see each spot."""

import numpy as np
import pytest

from reconstruct.mosaic.grid import CELL_PX, Footprints
from reconstruct.mosaic.run import seam_blocks
from reconstruct.raster import DemGrid

GRID = DemGrid(north=0.0, west=0.0, cell=0.004, rows=4096, columns=6144)


def seen_by(pictures: int) -> Footprints:
    """Pictures that all see the whole survey."""
    south, east = -GRID.rows * GRID.cell, GRID.columns * GRID.cell
    boxes = np.tile([0.0, east, south, 0.0], (pictures, 1))
    return Footprints(boxes=boxes, reach=np.full(pictures, 0.1))


@pytest.mark.parametrize(("pictures", "side"), [(20, 2048), (300, 1024), (5000, 512)])
def test_blocks_hold_no_more_than_fits(pictures: int, side: int) -> None:
    blocks = seam_blocks(GRID, seen_by(pictures))
    assert max(block.core.height for block in blocks) == side
    assert sum(b.core.height * b.core.width for b in blocks) == GRID.rows * GRID.columns
    if side > 512:
        assert max(len(b.views) * b.grid.rows * b.grid.columns for b in blocks) < 13e6 * CELL_PX**2
