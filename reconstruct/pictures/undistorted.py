"""Pictures as the ideal pinholes of the sparse model see them: for dense stereo and mosaics."""

from copy import copy
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import compiled
from alice_survey.core.contents import taken_from
from alice_survey.core.errors import ImageError, WorkspaceError
from alice_survey.core.frames import Array
from alice_survey.core.records import CamerasRecord
from camera_calib.approximation.pinhole_warp import PinholeWarp, warp_from_json
from camera_calib.picture_files import read_pixels
from reconstruct.views.range_shift import FAST

Colour = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Float32 = NDArray[np.float32]
Part = tuple[slice, slice]
"""Rows and columns of a picture."""
WHOLE: Part = (slice(None), slice(None))
MOVING = "moving"
"""Folder in `dense` with masks of what moves."""
_ROWS = 256
"""Rows of a warp computed at a time, which bounds its memory."""
_CACHED_BYTES = 100_000_000
"""Pictures as taken that each process keeps."""
_BEYOND = 0.05
"""Share of a picture's size by which a warp is followed beyond its edges."""
SPLINE_REACH = 8
_TO_NODES = 3**0.5 * (3**0.5 - 2.0) ** np.abs(np.arange(-SPLINE_REACH, SPLINE_REACH + 1))
"""Levels to coefficients of a cubic B-spline (Unser, Aldroubi & Eden 1993), cut at 5e-5."""


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


def spline_nodes(picture: NDArray[Any]) -> Float32:
    """Coefficients of the cubic B-spline through a picture (H, W, ...), mirrored at its edges."""
    kernel = _TO_NODES / _TO_NODES.sum()
    nodes = cv2.sepFilter2D(picture, cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(nodes, np.float32)


_SIXTH, _HALF, _TWO_THIRDS = np.float32(1 / 6), np.float32(0.5), np.float32(2 / 3)
_ONE, _THREE_HALVES, _TWO = np.float32(1.0), np.float32(1.5), np.float32(2.0)
_Weights = tuple[np.float32, np.float32, np.float32, np.float32]


@compiled(error_model="numpy", fastmath=FAST)
def spline_weights(t: np.float32) -> tuple[_Weights, _Weights]:
    """The weights of a cubic B-spline at a share t of the way from the second node, and slopes."""
    s = _ONE - t
    u, v = _HALF * t - _ONE, _HALF * s - _ONE
    weights = (
        _SIXTH * s * s * s,
        t * t * u + _TWO_THIRDS,
        s * s * v + _TWO_THIRDS,
        _SIXTH * t * t * t,
    )
    slopes = (
        -_HALF * s * s,
        (_THREE_HALVES * t - _TWO) * t,
        (_TWO - _THREE_HALVES * s) * s,
        _HALF * t * t,
    )
    return weights, slopes


@compiled(error_model="numpy", fastmath=FAST)
def sample_spline(
    nodes: Float32, x: Float32, y: Float32, first: int, last: int, out: Float32
) -> None:
    """Values of a picture at places.

    Detail of 4 px and more comes out with less error than by Lanczos' kernel of 4 lobes, and of
    `cv2.remap`, which rounds places to 1/32 px.

    Args:
        nodes: (H, W, 3) of `spline_nodes`.
        x: (h, w) columns, the first pixel's centre is 0; negative where nothing is wanted.
        y: (h, w) rows.
        first: channel to start with.
        last: channel before which to stop.
        out: (h, w, 3), changed in place in those channels where something is wanted.
    """
    high, wide = nodes.shape[0] - 1, nodes.shape[1] - 1
    for row in range(x.shape[0]):
        for column in range(x.shape[1]):
            px, py = x[row, column], y[row, column]
            if px < 0.0:
                continue
            left, top = int(px), int(py)
            (a, b, c, d), _ = spline_weights(px - np.float32(left))
            down, _ = spline_weights(py - np.float32(top))
            i, j = np.uint64(abs(left - 1)), np.uint64(left)  # unsigned: not counted from the end
            k = np.uint64(wide - abs(wide - left - 1))
            m = np.uint64(wide - abs(wide - left - 2))
            for channel in range(first, last):
                total = np.float32(0.0)
                for n in range(4):
                    line = nodes[np.uint64(high - abs(high - abs(top + n - 1)))]
                    value = a * line[i, channel] + b * line[j, channel]
                    total += down[n] * (value + c * line[k, channel] + d * line[m, channel])
                out[row, column, channel] = total


def show_at(picture: Colour, x: Float32, y: Float32) -> Colour:
    """A picture as `sample_spline` finds it at places, (h, w, 3); black where x is negative."""
    shown = np.zeros((*x.shape, 3), np.float32)
    sample_spline(spline_nodes(picture), x, y, 0, 3, shown)
    return np.asarray(cv2.add(shown, 0.0, dtype=cv2.CV_8U), np.uint8)


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

    The warps of all cameras are kept (8 bytes a pixel each); of pictures the last few as taken.
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
        pixels = max(warp.size_px[0] * warp.size_px[1] for warp in self._warps.values())
        self.as_taken = lru_cache(maxsize=max(1, _CACHED_BYTES // (3 * pixels)))(self._read)
        """A picture as taken, see `_read`; the last few stay in memory."""

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

    def _read(self, image: str) -> Colour:
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
        inside = self._inside(self._stored[image].camera)[part]
        x, y = (np.where(inside, axis[part], np.float32(-1)) for axis in self.maps(image))
        return show_at(self.as_taken(image), x, y)

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
