"""The map of coverage in square blocks, north up: only those that have changed are made again."""

import math

import numpy as np
from numpy.typing import NDArray

from missions.coverage.growing import OUTSIDE, GrowingCoverage

BLOCK = 256
"""Pixels a side; a pixel is a cell of the certificate, turned to north."""
Block = tuple[int, int]


class CoverageBlocks:
    """Blocks of a growing coverage, from its north-west corner on, with their versions."""

    def __init__(self, coverage: GrowingCoverage) -> None:
        """No block has changed yet."""
        self._coverage = coverage
        south, west, north, east = coverage.area.survey.bounds  # x is north
        self.cell_m = coverage.grid.cell_m
        self.north_m, self.west_m = float(north), float(west)
        side_m = BLOCK * self.cell_m
        self.rows = max(1, math.ceil((north - south) / side_m))
        self.columns = max(1, math.ceil((east - west) / side_m))
        self.versions: dict[Block, int] = {}
        """How often each block that may show something has changed."""

    def touch(self, window: NDArray[np.intp]) -> None:
        """Note that cells have changed.

        Args:
            window: (4,) first and last row and column of the coverage's grid, exclusive.
        """
        top, bottom, left, right = window.tolist()
        cells = np.array([[r, c] for r in (top, bottom) for c in (left, right)], dtype=np.float64)
        north, east = self._coverage.grid.places_of(cells).T
        side_m = BLOCK * self.cell_m
        rows = np.floor((self.north_m - np.array([north.max(), north.min()])) / side_m)
        columns = np.floor((np.array([east.min(), east.max()]) - self.west_m) / side_m)
        for row in range(max(0, int(rows[0])), min(self.rows - 1, int(rows[1])) + 1):
            for column in range(
                max(0, int(columns[0])), min(self.columns - 1, int(columns[1])) + 1
            ):
                self.versions[row, column] = self.versions.get((row, column), 0) + 1

    def bounds(self, block: Block) -> tuple[float, float, float, float]:
        """South, west, north and east of a block, metres."""
        side_m = BLOCK * self.cell_m
        north, west = self.north_m - block[0] * side_m, self.west_m + block[1] * side_m
        return north - side_m, west, north, west + side_m

    def classes(self, block: Block) -> NDArray[np.uint8]:
        """What each pixel of a block is, (BLOCK, BLOCK), as `GrowingCoverage.classes`.

        Raises:
            FileNotFoundError: there is no such block.
        """
        if not (0 <= block[0] < self.rows and 0 <= block[1] < self.columns):
            raise FileNotFoundError(f"block {block}")
        _, west, north, _ = self.bounds(block)
        middle = (np.arange(BLOCK) + 0.5) * self.cell_m
        north_m, east_m = np.meshgrid(north - middle, west + middle, indexing="ij")
        places = np.stack([north_m, east_m], axis=-1)
        found: NDArray[np.uint8] = self._coverage.grid.sampled(
            self._coverage.classes, places, OUTSIDE
        )
        return found
