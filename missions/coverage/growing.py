"""The certificate of coverage, picture by picture: what a dive has seen while it is flown.

Stations are counted once, when they come, so that an update costs the same after hours as after a
minute. At every moment the counts are those of `certificate` over all stations so far, to the cell:
the tiles, their grids and the kernel are the same, and a line that is left and flown on later
counts once, as there.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.errors import PlanError
from alice_survey.core.frames import Array
from camera_calib.rig import Rig
from missions.coverage.certificate import (
    Certificate,
    TileCounts,
    assembled,
    reaches_m,
    tiles_of,
)
from missions.coverage.raster import border_rays_body, grid_over, inside
from missions.coverage.stations import Stations, at_once
from missions.values.area import Area
from missions.values.pattern import Pattern

SEEN, STEREO, AT_OVERLAP = 1, 2, 4
"""Bits of what a cell is: in some picture, in all cameras' at once, at the overlap requested."""
_CLASSES = 8
OUTSIDE = 255
"""A cell whose middle is outside of the survey area."""


@dataclass(kw_only=True, eq=False)
class _Tile:
    here: tuple[slice, slice]
    inside: NDArray[np.bool_]
    counts: TileCounts


class GrowingCoverage:
    """What is seen of an area by the stations so far."""

    def __init__(self, area: Area, rig: Rig, pattern: Pattern, cell_m: float) -> None:
        """Nothing seen yet.

        Args:
            area: what must be seen.
            rig: its cameras, in water.
            pattern: the overlap requested.
            cell_m: side of a cell; that of the plan's certificate.

        Raises:
            PlanError: the area lies between middles of cells.
        """
        self.area, self.rig, self.pattern = area, rig, pattern
        self.grid = grid_over(area, cell_m)
        self.inside = inside(area, self.grid)
        if not self.inside.any():
            raise PlanError(f"the area holds no point of a grid of {cell_m:.3g} m")
        self._rays = border_rays_body(rig)
        self.restart()

    def restart(self) -> None:
        """Forget all stations."""
        cameras = len(self._rays[0])
        self._tiles = [
            _Tile(here=here, inside=self.inside[here], counts=TileCounts.of(part, cameras))
            for here, part in tiles_of(self.grid, self.inside)
        ]
        self.stations, self.blind = 0, 0
        self._line = -1
        self._flown: dict[int, list[Stations]] = {}
        self.classes = np.where(self.inside, np.uint8(0), np.uint8(OUTSIDE))
        """(rows, columns) bits of what each cell is, or `OUTSIDE`."""
        self._cells = np.bincount(self.classes[self.inside], minlength=_CLASSES)

    @property
    def covered_share(self) -> float:
        """Share of the area that is in at least one picture."""
        return self._share(SEEN)

    @property
    def stereo_share(self) -> float:
        """Share of the area that all cameras see at once at some station."""
        return self._share(STEREO)

    @property
    def share_at_overlap(self) -> float:
        """Share of the area that is covered at the overlap requested."""
        return self._share(AT_OVERLAP)

    def _share(self, bit: int) -> float:
        chosen = (np.arange(_CLASSES) & bit) > 0
        return int(self._cells[chosen].sum()) / int(self._cells.sum())

    def add(self, stations: Stations) -> NDArray[np.intp]:
        """Count stations that follow those before.

        Args:
            stations: in the order of time.

        Returns:
            (4,) first and last row and column, exclusive, of the cells that may have changed.
        """
        reach_m = reaches_m(self._rays, stations)
        sees = np.isfinite(reach_m)
        self.stations += len(stations)
        self.blind += int((~sees).sum())
        stations, reach_m = stations.some(sees), reach_m[sees]
        for group in _by_line(stations):
            self._count(stations.some(group))
        window = self._window(stations, reach_m)
        self._classify(window)
        return window

    def certificate(self, more: Stations | None = None) -> Certificate:
        """What has been seen, and what it will be with more stations.

        Args:
            more: stations that follow, line by line; they are not kept. Stations of the line that
                is flown now go on with it.
        """
        reach_m = np.empty(0) if more is None else reaches_m(self._rays, more)
        sees = np.isfinite(reach_m)
        tiles = []
        for tile in self._tiles:
            counts = tile.counts
            if more is not None and sees.any():
                counts, line, flown = counts.copy(), self._line, dict(self._flown)
                for group in _by_line(kept := more.some(sees)):
                    line = self._go_on(counts, line, flown, kept.some(group))
            tiles.append((tile.here, counts.summary(tile.inside)))
        return assembled(
            self.area, self.pattern, tuple(self.rig.cameras), self.grid, self.inside, tiles,
            stations=self.stations + len(reach_m), blind=self.blind + int((~sees).sum()),
        )  # fmt: skip

    def _count(self, stations: Stations) -> None:
        """Count stations of one line, or of none."""
        before = self._flown
        for tile in self._tiles:
            flown = dict(before)
            line = self._go_on(tile.counts, self._line, flown, stations)
        self._line, self._flown = line, flown

    def _go_on(
        self, counts: TileCounts, line: int, flown: dict[int, list[Stations]], stations: Stations
    ) -> int:
        """Count stations of one line, or of none, in a tile.

        Args:
            counts: of the tile; added to.
            line: that was counted last.
            flown: stations of each line so far; added to.
            stations: to count.

        Returns:
            The line that is counted last now.
        """
        number = int(stations.line[0])
        if number >= 0 and number != line and number in flown:
            counts.return_to(self._rays, at_once(flown[number]))
        counts.add(self._rays, stations)
        if number < 0:
            return line
        flown[number] = [*flown.get(number, ()), stations]
        return number

    def _window(self, stations: Stations, reach_m: Array) -> NDArray[np.intp]:
        if not len(stations):
            return np.zeros(4, np.intp)
        cells = self.grid.cells_of(stations.glass_ne)
        reach = reach_m[:, None] / self.grid.cell_m + 1.0
        low = np.clip(np.floor((cells - reach).min(axis=0)), 0, self.grid.shape)
        high = np.clip(np.ceil((cells + reach).max(axis=0)), 0, self.grid.shape)
        found: NDArray[np.intp] = np.stack([low, high], axis=1).ravel().astype(np.intp)
        return found

    def _classify(self, window: NDArray[np.intp]) -> None:
        """Bring the classes of the cells in a window up to date."""
        top, bottom, left, right = window.tolist()
        for tile in self._tiles:
            rows, columns = tile.here
            r0, r1 = max(top, rows.start), min(bottom, rows.stop)
            c0, c1 = max(left, columns.start), min(right, columns.stop)
            if r0 >= r1 or c0 >= c1:
                continue
            here = (slice(r0, r1), slice(c0, c1))
            part = (slice(r0 - rows.start, r1 - rows.start),
                    slice(c0 - columns.start, c1 - columns.start))  # fmt: skip
            counts = tile.counts
            pictures = counts.pictures[(slice(None), *part)]
            often = pictures.min(axis=0) >= self.pattern.passes * self.pattern.pictures
            often &= counts.lines[(slice(None), *part)].min(axis=0) >= self.pattern.passes
            found = np.where((pictures > 0).any(axis=0), np.uint8(SEEN), np.uint8(0))
            found |= np.where(counts.pairs[part] > 0, np.uint8(STEREO), np.uint8(0))
            found |= np.where(often, np.uint8(AT_OVERLAP), np.uint8(0))
            within = self.inside[here]
            old = self.classes[here][within]
            self._cells = (
                self._cells
                - np.bincount(old, minlength=_CLASSES)
                + np.bincount(found[within], minlength=_CLASSES)
            )
            self.classes[here] = np.where(within, found, OUTSIDE)


def _by_line(stations: Stations) -> list[NDArray[np.intp]]:
    """Indices of stations that follow one another and are of one line, or of none."""
    if not len(stations):
        return []
    return np.split(np.arange(len(stations)), np.flatnonzero(np.diff(stations.line)) + 1)
