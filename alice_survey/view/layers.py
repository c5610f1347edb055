"""The rasters of a workspace as layers of a map: their legends, their tiles."""

import os
import threading
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from rasterio.errors import RasterioError

from alice_survey.base.contents import one_line
from alice_survey.base.errors import WorkspaceError
from alice_survey.kit.document import PictureLayer
from alice_survey.report.colours import (
    MOSAIC_ABOUT,
    MOSAIC_FILE,
    MOSAIC_TITLE,
    TILE_PX,
    Numbers,
    Rgba,
    coloured,
    encoded,
    limits_of,
    number_rasters,
    scale_of,
)
from alice_survey.report.held import Held
from alice_survey.view.paths import OpenedFile, Workspace
from alice_survey.view.pyramid import (
    Pyramid,
    read_counts,
    read_numbers,
    read_painted,
    tiles_of_level,
)

_KEPT_BYTES = 48 << 20
"""Cache size of encoded tiles."""
_MOST_RENDERERS = 4
_MOSAIC = "mosaic"
_DAMAGES = (RasterioError, IndexError)
"""Errors on reading a damaged raster, or one with too few bands."""
NAMES = (_MOSAIC, *(numbers.name for numbers in number_rasters("m")))
"""Names of layers, in the order in which a page shows them."""
PATHS = (MOSAIC_FILE, *(numbers.file for numbers in number_rasters("m")))
"""Files of their rasters."""


class ChangedError(Exception):
    """The requested file was replaced meanwhile."""


@dataclass(kw_only=True)
class _Raster:
    """A raster that is shown, as long as its file stays as it is."""

    file: OpenedFile
    pyramid: Pyramid
    numbers: Numbers | None
    """Colouring of the raster; None for the mosaic."""
    users: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)
    limits: tuple[float, float] | None = None

    def coloured_between(self) -> tuple[float, float]:
        """Limits of the colours, computed on first use."""
        with self.lock:
            if self.limits is None:
                if self.numbers is None:
                    raise ValueError("a mosaic has colours of its own")
                with self.pyramid.opened() as raster:
                    self.limits = limits_of(raster, self.numbers)
            return self.limits


class Layers:
    """Layers of a map of a workspace; threads may share it."""

    def __init__(self, workspace: Workspace, stop: threading.Event | None = None) -> None:
        """Take a workspace; `stop` ends long work soon after it is set."""
        self._workspace, self._stop = workspace, stop or threading.Event()
        self._lock = threading.Lock()
        self._rasters: dict[str, _Raster] = {}
        self._tiles: OrderedDict[tuple[str, ...], bytes] = OrderedDict()
        self._tile_bytes = 0
        self._renderers = threading.BoundedSemaphore(min(_MOST_RENDERERS, os.cpu_count() or 1))

    def picture_layers(self) -> Sequence[PictureLayer]:
        """The layers that are there, for a page that asks for their tiles."""
        found: list[PictureLayer] = []
        for name in NAMES:
            try:
                found.append(self._picture_layer(name, shown=not found))
            except FileNotFoundError:
                continue
        return found

    def _picture_layer(self, name: str, *, shown: bool) -> PictureLayer:
        with self._used(name) as raster:
            pyramid, numbers = raster.pyramid, raster.numbers
            scale = None if numbers is None else scale_of(numbers, raster.coloured_between())
            return PictureLayer(
                name=name,
                title=MOSAIC_TITLE if numbers is None else numbers.title,
                about=MOSAIC_ABOUT if numbers is None else numbers.about,
                west_m=pyramid.west, north_m=pyramid.north, pixel_m=pyramid.pixel,
                width_px=pyramid.width, height_px=pyramid.height, tile_px=TILE_PX,
                levels=len(pyramid.levels), tiles={}, scale=scale, shown=shown,
                sizes=[(s.columns, s.rows, s.east, s.north) for s in pyramid.levels],
                address=f"/tiles/{name}/{{}}.webp?v={raster.file.token}",
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
        with self._used(name) as raster:
            if token is not None and token != raster.file.token:
                raise ChangedError
            key = (raster.file.token, name, str(level), str(x), str(y))
            kept = self._kept(key)
            if kept is None:
                with self._renderers:
                    kept = self._kept(key) or encoded(_painted(raster, level, x, y))
                if not raster.file.is_unchanged():
                    raise ChangedError
                self._keep(key, kept)
            return kept, raster.file.token

    def painted(self, name: str, level: int, x: int, y: int) -> Rgba:
        """A tile's pixels before they are encoded; see `tile`."""
        with self._used(name) as raster:
            return _painted(raster, level, x, y)

    def _kept(self, key: tuple[str, ...]) -> bytes | None:
        with self._lock:
            if key not in self._tiles:
                return None
            self._tiles.move_to_end(key)
            return self._tiles[key]

    def _keep(self, key: tuple[str, ...], tile: bytes) -> None:
        with self._lock:
            if key in self._tiles:
                return
            self._tiles[key] = tile
            self._tile_bytes += len(tile)
            while self._tile_bytes > _KEPT_BYTES:
                self._tile_bytes -= len(self._tiles.popitem(last=False)[1])

    def close(self) -> None:
        """Close all files that are no longer in use."""
        with self._lock:
            rasters = list(self._rasters.values())
            self._rasters.clear()
        for raster in rasters:
            self._give_back(raster)

    @contextmanager
    def _used(self, name: str) -> Iterator[_Raster]:
        """The raster of a layer as it is now; its file stays open within this block."""
        file = self._workspace.open(_file_of(name).split("/"))
        try:
            raster = self._take(name, file)
        except BaseException as error:
            unchanged = file.is_unchanged()
            file.close()
            raise self._fault(name, error, unchanged) from error
        try:
            yield raster
        except (*_DAMAGES, MemoryError) as error:
            raise self._fault(name, error, raster.file.is_unchanged()) from error
        finally:
            self._give_back(raster)

    def _take(self, name: str, file: OpenedFile) -> _Raster:
        """The raster that is known of a file, else a new one, which then owns the file."""
        known = self._known(name, file)
        if known is not None:
            return known
        numbers = _numbers(name, Held.of(self._workspace.folder).unit)
        read = read_painted if numbers is None else read_numbers
        if numbers is not None and numbers.counted:
            read = read_counts
        pyramid = Pyramid(file.path, read, stop=self._stop)
        known = self._known(name, file)  # another request may have been quicker
        if known is not None:
            return known
        raster = _Raster(file=file, pyramid=pyramid, numbers=numbers, users=2)  # this one, the next
        with self._lock:
            before = self._rasters.get(name)
            self._rasters[name] = raster
        if before is not None:
            self._give_back(before)
        return raster

    def _known(self, name: str, file: OpenedFile) -> _Raster | None:
        with self._lock:
            known = self._rasters.get(name)
            if known is None or known.file.token != file.token:
                return None
            known.users += 1
        file.close()
        return known

    def _give_back(self, raster: _Raster) -> None:
        with self._lock:
            raster.users -= 1
            if raster.users == 0:
                raster.file.close()

    def _fault(self, name: str, error: BaseException, unchanged: bool) -> BaseException:
        """Error to report for a fault in a raster."""
        if not isinstance(error, (*_DAMAGES, MemoryError)):
            return error
        if not unchanged:
            return ChangedError()
        path = self._workspace.folder / _file_of(name)
        return WorkspaceError(f"{path}: is damaged ({one_line(error)}): delete it and run again")


def _numbers(name: str, unit: str) -> Numbers | None:
    return next((numbers for numbers in number_rasters(unit) if numbers.name == name), None)


def _file_of(name: str) -> str:
    """Where the raster of a layer is.

    Raises:
        FileNotFoundError: no layer has this name.
    """
    if name == _MOSAIC:
        return MOSAIC_FILE
    numbers = _numbers(name, "m")
    if numbers is None:
        raise FileNotFoundError(name)
    return numbers.file


def _painted(raster: _Raster, level: int, x: int, y: int) -> Rgba:
    """A tile's pixels.

    Raises:
        FileNotFoundError: there is no such tile.
    """
    pyramid = raster.pyramid
    finest = len(pyramid.levels) - 1 - level
    if not 0 <= finest < len(pyramid.levels):
        raise FileNotFoundError(f"level {level}")
    size = pyramid.levels[finest]
    columns, rows = tiles_of_level(size)
    if not (0 <= x < columns and 0 <= y < rows):
        raise FileNotFoundError(f"tile {x}, {y}")
    left, top = x * TILE_PX, y * TILE_PX
    right, bottom = min(left + TILE_PX, size.columns), min(top + TILE_PX, size.rows)
    if raster.numbers is None:
        part = pyramid.part(finest, left, top, right, bottom)
        clear = part.weight < 0.5
        picture = np.dstack([*np.rint(part.values), np.where(clear, 0, 255)])
        return picture.astype(np.uint8)
    # One pixel more on each side, so that the shade has no seams.
    margin = (min(left, 1), min(top, 1), min(size.columns - right, 1), min(size.rows - bottom, 1))
    part = pyramid.part(
        finest, left - margin[0], top - margin[1], right + margin[2], bottom + margin[3]
    )
    values = np.where(part.weight > 0, part.values[0], np.nan)
    level_values = raster.numbers.levels(values)
    whole = coloured(level_values, raster.numbers, raster.coloured_between(), size.east)
    return whole[margin[1] : whole.shape[0] - margin[3], margin[0] : whole.shape[1] - margin[2]]
