"""The rasters of a workspace as layers of a map: their legends, their tiles."""

import os
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache

from rasterio.errors import RasterioError

from alice_survey.base.contents import one_line
from alice_survey.base.errors import WorkspaceError
from alice_survey.kit.document import PictureLayer
from alice_survey.report.colours import (
    MOSAIC_ABOUT,
    MOSAIC_FILE,
    MOSAIC_TITLE,
    TILE_PX,
    encoded,
    number_rasters,
    scale_of,
)
from alice_survey.report.held import Held
from alice_survey.view.paths import Workspace
from alice_survey.view.pyramid import Pyramid

_KEPT_TILES = 1000
_KEPT_PYRAMIDS = 12
_MOST_RENDERERS = 4
_ENDING_S = 3.0
"""Time to wait at the end for tiles in work."""
_DAMAGES = (RasterioError, IndexError, MemoryError)
"""Errors on reading a damaged raster, or one with too few bands."""
FILES = {"mosaic": MOSAIC_FILE} | {one.name: one.file for one in number_rasters("m")}
"""Files of the layers by their names, in the order in which a page shows them."""


class ChangedError(Exception):
    """The requested file was replaced meanwhile."""


class Layers:
    """Layers of a map of a workspace; threads may share it."""

    def __init__(self, workspace: Workspace) -> None:
        """Take a workspace."""
        self._workspace = workspace
        self._most_renderers = min(_MOST_RENDERERS, os.cpu_count() or 1)
        self._renderers = threading.BoundedSemaphore(self._most_renderers)
        # By the token of the file, so that a changed raster is read again.
        self._pyramid = lru_cache(_KEPT_PYRAMIDS)(self._read_pyramid)
        self._tile = lru_cache(_KEPT_TILES)(self._read_tile)

    def picture_layers(self) -> Sequence[PictureLayer]:
        """The layers that are there, for a page that asks for their tiles."""
        found: list[PictureLayer] = []
        for name in FILES:
            try:
                found.append(self._picture_layer(name, shown=not found))
            except FileNotFoundError:
                continue
        return found

    def _picture_layer(self, name: str, *, shown: bool) -> PictureLayer:
        with self._unchanged(name, None) as token:
            pyramid = self._pyramid(name, token)
        numbers, limits, full = pyramid.numbers, pyramid.limits, pyramid.levels[0]
        return PictureLayer(
            name=name,
            title=MOSAIC_TITLE if numbers is None else numbers.title,
            about=MOSAIC_ABOUT if numbers is None else numbers.about,
            west_m=pyramid.west, north_m=pyramid.north, pixel_m=pyramid.pixel,
            width_px=full.columns, height_px=full.rows, tile_px=TILE_PX,
            levels=len(pyramid.levels), tiles={}, shown=shown,
            scale=None if numbers is None or limits is None else scale_of(numbers, limits),
            sizes=[(s.columns, s.rows, s.east, s.north) for s in pyramid.levels],
            address=f"/tiles/{name}/{{}}.webp?v={token}",
        )  # fmt: skip

    def tile(self, name: str, level: int, x: int, y: int, token: str | None) -> tuple[bytes, str]:
        """A tile as WebP, and the token of the raster that it is of.

        Args:
            name: name of the layer.
            level: 0 is the coarsest, as on the report's page.
            x: column of the tile.
            y: row of the tile.
            token: token of the raster that the page has; None for the current one.

        Raises:
            FileNotFoundError: there is no such layer or no such tile.
            ChangedError: there is another raster by now, or it is being written to.
            WorkspaceError: it is damaged.
        """
        with self._unchanged(name, token) as now:
            return self._tile(name, now, level, x, y), now

    def close(self) -> None:
        """Wait briefly for the tiles in work."""
        for _ in range(self._most_renderers):
            self._renderers.acquire(timeout=_ENDING_S / self._most_renderers)

    @contextmanager
    def _unchanged(self, name: str, token: str | None) -> Iterator[str]:
        """The token of a layer's file, which is read within this block."""
        now = self._workspace.token(FILES[name])
        try:
            if token not in (None, now):
                raise ChangedError
            yield now
        except _DAMAGES as error:
            if self._workspace.token(FILES[name]) != now:
                raise ChangedError from None
            path = self._workspace.folder / FILES[name]
            raise WorkspaceError(
                f"{path}: is damaged ({one_line(error)}): delete it and run again"
            ) from error
        if self._workspace.token(FILES[name]) != now:
            raise ChangedError

    def _read_pyramid(self, name: str, token: str) -> Pyramid:
        unit = Held.of(self._workspace.folder).unit
        numbers = next((one for one in number_rasters(unit) if one.name == name), None)
        return Pyramid(self._workspace.file(FILES[name].split("/")), numbers)

    def _read_tile(self, name: str, token: str, level: int, x: int, y: int) -> bytes:
        with self._renderers:
            pyramid = self._pyramid(name, token)
            return encoded(pyramid.tile(len(pyramid.levels) - 1 - level, x, y))
