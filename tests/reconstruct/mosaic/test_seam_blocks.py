"""Blocks whose seams are solved at once stay small where many pictures see each spot."""

import numpy as np
import pytest

from reconstruct.mosaic.grid import CELL_PX, Footprints, blocks_of, in_passes
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


def test_neighbours_are_laid_in_turn() -> None:
    """Of two blocks that share an edge one comes later and knows the other."""
    strip = Footprints(
        boxes=np.array([[0.0, 7.0, -16.0, 0.0], [17.0, 24.0, -9.0, -1.0]]), reach=np.zeros(2)
    )
    blocks = blocks_of(GRID, strip, 1024, 256)
    first, second = in_passes(blocks)
    assert {id(block) for block, _ in first + second} == {id(block) for block in blocks}
    assert all(not cores for _, cores in first)
    done = [block.core for block, _ in first]
    for block, cores in second:
        away = [
            (abs(core.row_off - block.core.row_off), abs(core.col_off - block.core.col_off))
            for core in done
        ]
        touching = [core for core, off in zip(done, away, strict=True) if set(off) == {0, 1024}]
        assert touching
        assert set(map(str, touching)) <= set(map(str, cores))
    places = {(b.core.row_off, b.core.col_off) for b, _ in second}
    assert not any((r + 1024, c) in places or (r, c + 1024) in places for r, c in places)
