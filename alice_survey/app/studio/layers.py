"""The rasters of a workspace as layers of a map, whose tiles pages request."""

import contextlib
import os
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache

from rasterio.errors import RasterioError

from alice_survey.app.report.held import Held
from alice_survey.app.report.rasters import MAP_RASTERS, Pyramid, encode_webp
from alice_survey.app.studio.files import Workspace, stale_page
from alice_survey.core.contents import one_line
from alice_survey.core.errors import WorkspaceError
from alice_survey.kit.document import PictureLayer
from reconstruct.measure.surface import is_of_surface

_KEPT_TILES = 1000
_KEPT_PYRAMIDS = 12
_MAX_RENDERERS = 4
_DAMAGES = (RasterioError, IndexError, MemoryError)
"""Errors on reading a damaged raster, or one with too few bands."""
_LAYERS = {one.name: one for one in MAP_RASTERS}


class Layers:
    """Layers of a map of a workspace; threads may share it."""

    def __init__(self, workspace: Workspace) -> None:
        """Take a workspace, whose rasters are shown."""
        self._workspace = workspace
        self._renderers = threading.BoundedSemaphore(min(_MAX_RENDERERS, os.cpu_count() or 1))
        # By the token of the file, so that a changed raster is read again.
        self._pyramid = lru_cache(_KEPT_PYRAMIDS)(self._read_pyramid)
        self._tile = lru_cache(_KEPT_TILES)(self._read_tile)

    def picture_layers(self) -> Sequence[PictureLayer]:
        """The layers that are there, for a page that requests their tiles."""
        found: list[PictureLayer] = []
        for name, raster in _LAYERS.items():
            with contextlib.suppress(FileNotFoundError):
                with self._check_unchanged(name, None) as token:
                    pyramid = self._pyramid(name, token)
                address = f"/tiles/{name}/{{}}.webp?v={token}"
                if is_of_surface(self._workspace.folder, raster):
                    found.append(pyramid.layer(shown=not found, address=address))
        return found

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
            StaleError: there is another raster by now, or it is being written to.
            WorkspaceError: it is damaged.
        """
        with self._check_unchanged(name, token) as now:
            return self._tile(name, now, level, x, y), now

    @contextmanager
    def _check_unchanged(self, name: str, token: str | None) -> Iterator[str]:
        """The token of a layer's file, which is read within this block."""
        if name not in _LAYERS:
            raise FileNotFoundError(name)
        path = _LAYERS[name].file
        with self._workspace.check_unchanged(path) as (now,):
            if not now:
                raise FileNotFoundError(path)
            if token not in (None, now):
                raise stale_page()
            try:
                yield now
            except _DAMAGES as error:
                text = f"{path}: is damaged ({one_line(error)}): delete it and run again"
                raise WorkspaceError(text) from error

    def _read_pyramid(self, name: str, token: str) -> Pyramid:
        unit, raster = Held.of(self._workspace.folder).unit, _LAYERS[name]
        return Pyramid(self._workspace.file(raster.path.parts), raster, unit)

    def _read_tile(self, name: str, token: str, level: int, x: int, y: int) -> bytes:
        with self._renderers:
            pyramid = self._pyramid(name, token)
            return encode_webp(pyramid.tile(len(pyramid.levels) - 1 - level, x, y))
