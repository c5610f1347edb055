"""Blocks whose seams are solved at once stay small where many pictures see each spot."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reconstruct.mosaic.grid import CELL_PX, Footprints, blocks_of, in_passes
from reconstruct.mosaic.paint import MosaicSetup, PaintTask, label_path_of_core, settled_around
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


def test_cells_of_neighbours_are_where_they_lie(tmp_path: Path) -> None:
    """Each block's cells hold their own place in the survey as the number of their view."""
    blocks = blocks_of(GRID, seen_by(1), 1024, 256)
    survey = MosaicSetup(
        workspace=tmp_path, scratch=tmp_path, dem=tmp_path / "dem.tif", sights=tmp_path,
        scaled=True, water=None,
    )  # fmt: skip
    columns = GRID.columns // CELL_PX
    for block in blocks:
        rows = np.arange(block.core.height // CELL_PX) + block.core.row_off // CELL_PX
        across = np.arange(block.core.width // CELL_PX) + block.core.col_off // CELL_PX
        label = rows[:, None] * columns + across + 1
        np.save(label_path_of_core(survey, block.core), label.astype(np.int32))
    for block, cores in in_passes(blocks)[1]:
        nothing: Any = None
        task = PaintTask(
            survey=survey, block=block, views=(), colour=nothing, even=True, settled=cores
        )
        settled = settled_around(task)
        rows = np.arange(settled.shape[0]) + block.window.row_off // CELL_PX
        across = np.arange(settled.shape[1]) + block.window.col_off // CELL_PX
        place = rows[:, None] * columns + across
        np.testing.assert_array_equal(settled[settled >= 0], place[settled >= 0])
        assert (settled >= 0).sum() == len(cores) * (1024 // CELL_PX) * (256 // CELL_PX)
