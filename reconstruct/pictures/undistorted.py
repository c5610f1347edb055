"""Pictures as the ideal pinholes of the sparse model see them: for dense stereo and mosaics."""

from copy import copy
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.contents import taken_from
from alice_survey.core.errors import ImageError, WorkspaceError
from alice_survey.core.frames import Array
from alice_survey.core.records import CamerasRecord
from camera_calib.approximation.pinhole_warp import PinholeWarp, warp_from_json
from camera_calib.picture_files import read_pixels
from reconstruct.pictures.normalise import Grey, normalise

Colour = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Part = tuple[slice, slice]
"""Rows and columns of a picture."""
WHOLE: Part = (slice(None), slice(None))
MOVING = "moving"
"""Folder in `dense` with masks of what moves."""
_ROWS = 256
"""Rows of a warp computed at a time, which bounds its memory."""
_BEYOND = 0.05
"""Share of a picture's size by which a warp is followed beyond its edges."""


def read_colour(path: Path) -> Colour:
    """Read a picture as (H, W, 3) BGR bytes, pixels as stored (an EXIF orientation is not obeyed).

    Raises:
        ImageError: it is missing or cannot be decoded.
    """
    picture = read_pixels(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if picture is None:
        raise ImageError(f"{path}: missing, or no picture that can be decoded")
    return picture


def read_mask(path: Path, size: tuple[int, int]) -> Mask:
    """Read a mask, (H, W): True where the picture may be used.

    Args:
        path: a picture that is 0 where its partner is to be left out.
        size: width and height it must have.

    Raises:
        ImageError: it is missing, cannot be decoded or is of another size.
    """
    mask = read_pixels(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if mask is None:
        raise ImageError(f"{path}: missing, or no mask that can be decoded")
    if mask.shape[::-1] != size:
        raise ImageError(
            f"{path}: mask of {mask.shape[1]} x {mask.shape[0]} pixels for a picture of "
            f"{size[0]} x {size[1]}"
        )
    return np.asarray(mask > 0)


def undistortion_maps(warp: PinholeWarp) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where each pixel of the pinhole's picture lies in the picture as taken.

    Returns:
        x and y in OpenCV's pixels (the first pixel's centre is 0, 0) for `cv2.remap`; -10 where the
        camera does not see what the pinhole would.
    """
    width, height = warp.pinhole.size_px
    x = np.empty((height, width), np.float32)
    y = np.empty((height, width), np.float32)
    columns = np.arange(width) + 0.5
    for top in range(0, height, _ROWS):
        rows = np.arange(top, min(top + _ROWS, height)) + 0.5
        pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        source = _where_invertible(warp, pixels) - 0.5
        source = np.where(np.isfinite(source), source, -10.0).reshape(len(rows), width, 2)
        x[top : top + _ROWS], y[top : top + _ROWS] = source[..., 0], source[..., 1]
    return x, y


def taken_nodes(warp: PinholeWarp, spacing_px: float) -> Array:
    """Where nodes of the pinhole's picture lie in the picture as taken.

    Args:
        warp: of a camera's pictures.
        spacing_px: largest distance of nodes; between them a bilinear value is off by the square
            of it times an eighth of the second derivative of the distortion.

    Returns:
        (rows, columns, 2) pixels as taken at nodes spread evenly over the pinhole's picture, the
        first and last on its outer edges; NaN where the camera does not see what the pinhole would.
    """
    width, height = warp.pinhole.size_px
    x = np.linspace(0.0, width, int(np.ceil(width / spacing_px)) + 1)
    y = np.linspace(0.0, height, int(np.ceil(height / spacing_px)) + 1)
    pixels = np.stack(np.meshgrid(x, y), axis=-1)
    return _where_invertible(warp, pixels.reshape(-1, 2)).reshape(pixels.shape)


def _where_invertible(warp: PinholeWarp, pixels: Array) -> Array:
    """Pixels as taken; NaN beyond the radius at which a polynomial distortion folds back."""
    taken = warp.from_pinhole(pixels)
    # a little beyond the edges, so that what is between nodes is known up to them
    margin = np.array(warp.size_px) * _BEYOND
    inside = np.all((taken >= -margin) & (taken <= np.array(warp.size_px) + margin), axis=1)
    back = np.full_like(taken, np.nan)
    back[inside] = warp.to_pinhole(taken[inside])
    with np.errstate(invalid="ignore"):
        folded = ~(np.linalg.norm(back - pixels, axis=1) < 0.5)
    return np.where((inside & folded)[:, None], np.nan, taken)


def moving_path(folder: Path, image: str) -> Path:
    """The mask (0 = leave out) of what moves in a picture; there where anything does."""
    return (folder / image).with_suffix(".png")


class Pictures:
    """Pictures of a workspace without refraction and distortion, computed on request.

    The warps of all cameras are kept (8 bytes a pixel each); pictures are not.
    """

    def __init__(self, images: Path, cameras_json: Path) -> None:
        """Use `open`; take a folder of pictures and the file of their cameras."""
        stored = CamerasRecord.read(cameras_json)
        with taken_from(cameras_json):
            self._warps = {name: warp_from_json(warp) for name, warp in stored.cameras.items()}
        self._images, self._stored = images, stored.images
        self._moving: Path | None = None
        self._maps = lru_cache(maxsize=None)(lambda camera: undistortion_maps(self._warps[camera]))
        self._inside = lru_cache(maxsize=None)(self._camera_inside)

    @classmethod
    def open(cls, workspace: Path) -> "Pictures":
        """The pictures of a workspace whose `sparse/` is finished; a process reads them once.

        Raises:
            WorkspaceError: `sparse/cameras.json` is missing or wrong.
        """
        path = workspace / "sparse" / "cameras.json"
        written_ns = path.stat().st_mtime_ns if path.is_file() else 0
        return _open_once(workspace / "images", path, written_ns)

    @classmethod
    def still(cls, workspace: Path) -> "Pictures":
        """As `open`, with what moves masked as well where the dense stage found it."""
        pictures = copy(cls.open(workspace))
        pictures._moving = workspace / "dense" / MOVING
        return pictures

    def warp(self, image: str) -> PinholeWarp:
        """The camera that took a picture, and its pinhole.

        Raises:
            WorkspaceError: no picture of that name is in the model.
        """
        try:
            return self._warps[self._stored[image].camera]
        except KeyError:
            raise WorkspaceError(f"no picture {image!r} in sparse/cameras.json") from None

    def as_taken(self, image: str) -> Colour:
        """A picture as taken, (H, W, 3) BGR.

        Raises:
            ImageError: the file is missing, cannot be decoded or is of another size.
        """
        warp, path = self.warp(image), self._images / image
        taken = read_colour(path)
        if taken.shape[1::-1] != warp.size_px:
            raise ImageError(
                f"{path}: {taken.shape[1]} x {taken.shape[0]} pixels, but its camera has "
                f"{warp.size_px[0]} x {warp.size_px[1]}"
            )
        return taken

    def usable(self, image: str) -> Mask | None:
        """The mask of a picture as taken, (H, W), True where it may be used; None without one.

        Raises:
            ImageError: the mask is missing, cannot be decoded or is of another size.
        """
        mask = self._stored[image].mask
        paths = [self._images / mask] if mask else []
        moving = None if self._moving is None else moving_path(self._moving, image)
        if moving is not None and moving.is_file():
            paths.append(moving)
        masks = [read_mask(path, self.warp(image).size_px) for path in paths]
        return np.logical_and.reduce(masks) if masks else None

    def maps(self, image: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Where each pixel of a picture's pinhole lies in it as taken; see `undistortion_maps`."""
        return self._maps(self._stored[image].camera)

    def colour(self, image: str, part: Part = WHOLE) -> Colour:
        """A picture as its pinhole sees it, (H, W, 3) BGR; black where there is nothing.

        Args:
            image: its name.
            part: rows and columns of the pinhole's picture.

        Raises:
            ImageError: the file is missing, cannot be decoded or is of another size.
        """
        taken = self.as_taken(image)
        x, y = (axis[part] for axis in self.maps(image))
        # OpenCV's cubic kernel misplaces fine texture by up to 0.045 px, Lanczos' by 0.009
        warped: Colour = cv2.remap(taken, x, y, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
        inside = self._inside(self._stored[image].camera)[part]
        return np.where(inside[..., None], warped, np.uint8(0))

    def grey(self, image: str) -> Grey:
        """A picture as its pinhole sees it, (H, W), of even light and contrast."""
        return normalise(self.colour(image))

    def valid(self, image: str, part: Part = WHOLE) -> Mask:
        """Where `colour` shows something that may be used, (H, W)."""
        inside: Mask = self._inside(self._stored[image].camera)[part]
        taken = self.usable(image)
        if taken is None:
            return inside.copy()
        x, y = (axis[part] for axis in self.maps(image))
        warped = cv2.remap(taken.astype(np.uint8), x, y, cv2.INTER_NEAREST)
        return np.asarray(inside & (warped > 0))

    def _camera_inside(self, camera: str) -> Mask:
        width, height = self._warps[camera].size_px
        x, y = self._maps(camera)
        return np.asarray((x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1))


@lru_cache(maxsize=1)
def _open_once(images: Path, cameras_json: Path, written_ns: int) -> Pictures:
    return Pictures(images, cameras_json)
