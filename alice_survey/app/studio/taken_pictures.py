"""Pictures as taken, decoded once into bounded memory, and tiles of them."""

import threading
from collections import OrderedDict
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.app.studio.paths import Workspace
from alice_survey.core.artefacts import read_stage
from alice_survey.core.manifest import ImageRecord, read_manifest
from reconstruct.pictures.undistorted import Colour, read_colour

TILE_PX = 512
_MAX_BYTES = 500_000_000
"""Of decoded pictures that are kept; the last one is, whatever its size."""
_QUALITY = 95
_GREY = np.array([0.114, 0.587, 0.299])


class TakenPictures:
    """Pictures of a workspace's `images/`; threads may share it."""

    def __init__(self, workspace: Workspace) -> None:
        """Take a workspace; it need not have any."""
        self._workspace = workspace
        self._lock = threading.Lock()
        self._kept: OrderedDict[tuple[str, str], Colour] = OrderedDict()
        self._decoding: dict[tuple[str, str], threading.Lock] = {}
        self._records: tuple[str, dict[str, ImageRecord]] = ("", {})

    def records(self) -> dict[str, ImageRecord]:
        """What the manifest says, by name; nothing where there are no pictures yet."""
        folder = self._workspace.folder / "images"
        if read_stage(folder) is None or not self._workspace.has("images/manifest.csv"):
            return {}
        token = self._workspace.token("images/manifest.csv")
        if self._records[0] != token:
            read = read_manifest(folder / "manifest.csv")
            self._records = token, {record.image: record for record in read}
        return self._records[1]

    def path(self, name: str) -> Path:
        """The file of a picture.

        Raises:
            FileNotFoundError: the manifest names no such picture, or the file is a link or not
                there.
        """
        if name not in self.records():
            raise FileNotFoundError(name)
        return self._workspace.file(("images", *name.split("/")))

    def token(self, name: str) -> str:
        """Token of a picture's file; see `path`."""
        self.path(name)
        return self._workspace.token(f"images/{name}")

    def colour(self, name: str) -> Colour:
        """(H, W, 3) BGR as taken.

        Raises:
            ImageError: it cannot be decoded.
            FileNotFoundError: see `path`.
        """
        key = name, self.token(name)
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
            mine = self._decoding.setdefault(key, threading.Lock())
        with mine:  # of two that want it, one decodes
            with self._lock:
                if key in self._kept:
                    return self._kept[key]
            pixels = read_colour(self.path(name))
            with self._lock:
                self._kept[key] = pixels
                while len(self._kept) > 1 and self._bytes() > _MAX_BYTES:
                    self._kept.popitem(last=False)
                self._decoding.pop(key, None)
        return pixels

    def grey(self, name: str) -> NDArray[np.uint8]:
        """(H, W) as taken; see `colour`."""
        return np.asarray(cv2.cvtColor(self.colour(name), cv2.COLOR_BGR2GRAY), np.uint8)

    def _bytes(self) -> int:
        return sum(picture.nbytes for picture in self._kept.values())

    def size(self, name: str) -> tuple[int, int]:
        """Width and height, without decoding the picture where its header says so."""
        from PIL import Image

        with Image.open(self.path(name)) as image:
            return image.size

    def tile(self, name: str, halvings: int, column: int, row: int) -> bytes:
        """A tile as WebP, each of its pixels the mean of those of the picture that it covers.

        Args:
            name: of the picture.
            halvings: 0 is full resolution.
            column: of the tile.
            row: of the tile.

        Raises:
            FileNotFoundError: no such tile.
            ImageError: the picture cannot be decoded.
        """
        picture = self.colour(name)
        side = TILE_PX << halvings
        part = picture[row * side : (row + 1) * side, column * side : (column + 1) * side]
        if halvings >= levels_of(picture.shape[1], picture.shape[0]) or not part.size:
            raise FileNotFoundError(name)
        if halvings:
            size = tuple(-(-length >> halvings) if length else 0 for length in part.shape[1::-1])
            part = cv2.resize(part, size, interpolation=cv2.INTER_AREA)
        return _webp(part)


def _webp(pixels: Colour) -> bytes:
    data: bytes = cv2.imencode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])[1].tobytes()
    return data


def levels_of(width: int, height: int) -> int:
    """Levels of tiles, halved until one tile holds the picture."""
    return max(1, int(np.ceil(np.log2(max(width, height) / TILE_PX))) + 1)
