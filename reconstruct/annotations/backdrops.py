"""The pictures that annotation tools show: the mosaic, its tiles, the pictures of a survey."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePath

import numpy as np
import rasterio
import shapely
from PIL import Image

from alice_survey.core.artefacts import read_csv
from alice_survey.core.errors import WorkspaceError
from alice_survey.core.manifest import read_manifest
from alice_survey.core.records import CamerasRecord
from reconstruct.annotations.values import Affine, Annotation, DrawnShape
from reconstruct.raster import opened_raster

MOSAIC = "mosaic.tif"


@dataclass(frozen=True, kw_only=True)
class Backdrop:
    """One picture, and where it lies."""

    name: str
    width_px: int
    height_px: int
    plane: Affine | None
    """From its pixels to the plane of the mosaic; None for a picture as taken."""

    def to_pixels(self, shape: DrawnShape) -> DrawnShape:
        """A shape of the workspace in this backdrop's pixels."""
        return shape if self.plane is None else shape.moved(self.plane.inverse)

    def from_pixels(self, shape: DrawnShape) -> DrawnShape:
        """The way back."""
        return shape if self.plane is None else shape.moved(self.plane)

    @property
    def image(self) -> str | None:
        """The picture of the manifest that it is; None on the mosaic."""
        return self.name if self.plane is None else None


class Backdrops:
    """All backdrops of a workspace, by the names that tools know them by."""

    def __init__(self, mosaic: Sequence[Backdrop], images: Mapping[str, tuple[int, int]]) -> None:
        """Take them.

        Args:
            mosaic: the mosaic as a whole, or its tiles; empty while there is none.
            images: width and height of the pictures of the manifest.
        """
        self.mosaic, self._images = tuple(mosaic), dict(images)

    @cached_property
    def _by_name(self) -> dict[str, Backdrop]:
        pictures = (
            Backdrop(name=name, width_px=size[0], height_px=size[1], plane=None)
            for name, size in self._images.items()
        )
        return {backdrop.name: backdrop for backdrop in (*self.mosaic, *pictures)}

    @cached_property
    def _by_last_name(self) -> dict[str, list[Backdrop]]:
        found: dict[str, list[Backdrop]] = {}
        for name, backdrop in self._by_name.items():
            for key in {PurePath(name).name, PurePath(name).stem}:
                found.setdefault(key, []).append(backdrop)
        return found

    def named(self, name: str) -> Backdrop:
        """The backdrop that a tool calls so: its name, or the end of its path, or its stem.

        Raises:
            WorkspaceError: there is none, or there are several.
        """
        path = PurePath(name.replace("\\", "/"))
        for count in range(len(path.parts)):
            backdrop = self._by_name.get("/".join(path.parts[count:]))
            if backdrop is not None:
                return backdrop
        matches = self._by_last_name.get(path.name) or self._by_last_name.get(path.stem) or []
        if len(matches) == 1:
            return matches[0]
        if matches:
            raise WorkspaceError(
                f"{name!r} may be {matches[0].name} or {matches[1].name}: name it with its folder"
            )
        known = next(iter(self._by_name), "none")
        raise WorkspaceError(
            f"{name!r} is neither the mosaic, one of its tiles, nor a picture of the survey (such "
            f"as {known}): give the folder of tiles with --tiles, or the workspace of that survey"
        )

    def of(self, annotation: Annotation) -> Backdrop | None:
        """The backdrop on which an annotation is drawn best: the tile that holds most of it.

        None where no backdrop shows it.
        """
        if annotation.image is not None:
            return self._by_name.get(annotation.image)
        if len(self.mosaic) == 1:
            return self.mosaic[0]
        if not self.mosaic:
            return None
        box = shapely.box(*annotation.shape.geometry.bounds)
        shares = [_share(box, backdrop) for backdrop in self.mosaic]
        best = int(np.argmax(shares))
        return self.mosaic[best] if shares[best] > 0 else None

    def __iter__(self) -> Iterator[Backdrop]:
        """All backdrops."""
        return iter(self._by_name.values())


def _share(box: shapely.Polygon, backdrop: Backdrop) -> float:
    """Share of a box's extent that a backdrop shows, between 0 and 1."""
    if backdrop.plane is None:
        return 0.0
    corners = backdrop.plane.apply(np.array([[0.0, 0.0], [backdrop.width_px, backdrop.height_px]]))
    (west, north), (east, south) = corners
    left, bottom, right, top = box.bounds
    shares = [
        1.0 if high == low and first <= low <= last
        else max(0.0, min(high, last) - max(low, first)) / max(high - low, 1e-300)
        for low, high, first, last in ((left, right, west, east), (bottom, top, south, north))
    ]  # fmt: skip
    return shares[0] * shares[1]


def backdrops_of(workspace: Path, tiles: Path | None = None) -> Backdrops:
    """The backdrops of a workspace.

    Args:
        workspace: folder of the survey.
        tiles: folder that `mosaic-tiles` wrote; its tiles take the mosaic's place.

    Raises:
        WorkspaceError: a file is missing or damaged.
    """
    images: dict[str, tuple[int, int]] = {}
    cameras = CamerasRecord.made(workspace / "sparse" / "cameras.json")
    manifest = workspace / "images" / "manifest.csv"
    if manifest.is_file():
        sizes: dict[str, tuple[int, int]] = {}
        if cameras is not None:
            sizes = {
                name: (int(one["camera"]["width_px"]), int(one["camera"]["height_px"]))
                for name, one in cameras.cameras.items()
            }
        for record in read_manifest(manifest):
            if record.camera not in sizes:
                sizes[record.camera] = _size(manifest.parent / record.image)
            images[record.image] = sizes[record.camera]
    return Backdrops(_tiles(tiles) if tiles is not None else _whole(workspace), images)


def _size(path: Path) -> tuple[int, int]:
    try:
        with Image.open(path) as picture:
            return picture.size
    except (OSError, Image.DecompressionBombError):
        raise WorkspaceError(f"{path}: missing, or no picture that can be decoded") from None


def _whole(workspace: Path) -> list[Backdrop]:
    path = workspace / "mosaic" / MOSAIC
    if not path.is_file():
        return []
    with opened_raster(path) as raster:
        return [_backdrop(MOSAIC, raster.width, raster.height, raster.transform)]


def _backdrop(name: str, width: int, height: int, t: rasterio.Affine) -> Backdrop:
    return Backdrop(
        name=name, width_px=width, height_px=height,
        plane=Affine(scale=float(t.a), flipped=True, shift=(float(t.c), float(t.f))),
    )  # fmt: skip


def _tiles(folder: Path) -> list[Backdrop]:
    wanted = ("tile", "width_px", "height_px", "pixel", "west", "north")
    path = folder / "tiles.csv"
    _, rows = read_csv(path, wanted, fault=WorkspaceError)
    found = []
    for line, row in rows:
        try:
            west, north, pixel = (float(row[name]) for name in ("west", "north", "pixel"))
            width, height = int(row["width_px"]), int(row["height_px"])
        except ValueError as error:
            raise WorkspaceError(f"{path} line {line}: {error}") from None
        found.append(
            _backdrop(row["tile"], width, height, rasterio.Affine(pixel, 0, west, 0, -pixel, north))
        )
    return found
