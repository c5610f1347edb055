"""Arrays of each view on disk between the steps of a stage, so that memory stays bounded.

What is kept is kept small: depth as a 16-bit logarithm, its deviation as an 8-bit one, colours with
half the resolution of brightness. A picture takes 5 bytes a pixel until its tile is fused.
"""

import io
import uuid
import zlib
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import atomic_path
from reconstruct.pictures.undistorted import WHOLE, Part

_DEPTH_STEP = 2e-5
"""Relative: depths are rounded by 0.02 mm at most at 2 m, and span a factor of 3.7. Where those of
a picture span more, as along a floor or past a foreground, steps are larger."""
_DEPTH_CODES = 65535
_MAX_RATIO = 16.0
"""Depths nearer or farther than the median by more than this are of wrong matches, and left out."""
_SIGMA_STEP = 0.05
_SIGMA_LEAST = 1e-6
"""Relative to the depth; 254 steps of 5 % reach a third of the depth."""
PICTURE, CHECKED, FACTORS = "picture", "checked", "factors"
"""Names in the store: of a picture as it is shown, of what is kept of its depth, and, of all views
in one array, of what takes their light away."""


StoredDepth = tuple[NDArray[np.uint16], NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32]]
"""(H, W) codes of depth, (H, W) codes of its relative deviation, and what the codes of either mean:
NaN for 0. Kernels that look at few pixels take it as it is."""


def pack(**arrays: Any) -> NDArray[Any]:
    """Arrays and numbers as one record, whose fields have their names."""
    values = {name: np.asarray(array) for name, array in arrays.items()}
    fields = [(name, value.dtype, value.shape) for name, value in values.items()]
    packed = np.zeros((), np.dtype(fields, align=True))
    for name, value in values.items():
        packed[name] = value
    return packed


def pack_mask(mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A mask (H, W), one bit a pixel."""
    return np.packbits(mask, axis=1)


@dataclass(frozen=True)
class ViewStore:
    """A folder with one file per view and name; a file is there whole or not at all.

    Files are not synced to the disk: those that a power cut leaves in part their sum tells.
    """

    folder: Path
    run: str = field(default_factory=lambda: uuid.uuid4().hex)
    """Distinguishes runs in a process that works for several: files may have changed."""

    def path(self, view: int, name: str) -> Path:
        """Where an array is kept."""
        return self.folder / f"{view:06d}.{name}.npy"

    def has(self, view: int, name: str) -> bool:
        """Whether an array was saved."""
        path = self.path(view, name)
        content = path.read_bytes() if path.is_file() else b""
        return bool(content) and content[-4:] == _sum(memoryview(content)[:-4])

    def save(self, view: int, name: str, array: NDArray[Any]) -> None:
        """Keep an array, or what `pack` gives."""
        content = io.BytesIO()
        np.save(content, array)
        content.write(_sum(content.getbuffer()))
        with atomic_path(self.path(view, name), lasting=False) as path:
            path.write_bytes(content.getbuffer())

    def load(self, view: int, name: str) -> NDArray[Any]:
        """The array saved before, read only where touched."""
        path = self.path(view, name)
        with path.open("rb") as file:
            head = file.read(10)
            head += file.read(int.from_bytes(head[8:], "little"))
        shape, fortran_order, dtype = _layout(head)
        return np.memmap(path, dtype, "r", len(head), shape, "F" if fortran_order else "C")

    def save_depth(
        self, view: int, name: str, depth: NDArray[np.float32], sigma: NDArray[np.float32],
        **more: NDArray[Any],
    ) -> None:  # fmt: skip
        """Keep depth (H, W) and its standard deviation, rounded; NaN where unknown."""
        level, share, ends = _codes(depth, sigma)
        self.save(view, name, pack(level=level, share=share, ends=ends, **more))

    def stored_depth(self, view: int, name: str, part: Part = WHOLE) -> StoredDepth:
        """Depth (H, W) and its standard deviation as they are stored, read only where touched."""
        kept = self.load(view, name)
        level, share = np.asarray(kept["level"][part]), np.asarray(kept["share"][part])
        return level, share, _depths(*kept["ends"].tolist()), _shares()

    def load_depth(
        self, view: int, name: str, part: Part = WHOLE
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Depth (H, W) and its standard deviation, NaN where unknown."""
        return decode_depth(self.stored_depth(view, name, part))

    def save_colour(self, view: int, colour: NDArray[np.uint8], **more: NDArray[Any]) -> None:
        """Keep a picture (H, W, 3) BGR: brightness in full, colour at half the resolution."""
        height, width = colour.shape[:2]
        even = cv2.copyMakeBorder(colour, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
        ycc = cv2.cvtColor(even, cv2.COLOR_BGR2YCrCb)
        half = (ycc.shape[1] // 2, ycc.shape[0] // 2)
        tint = cv2.resize(ycc[..., 1:], half, interpolation=cv2.INTER_AREA)
        self.save(view, PICTURE, pack(bright=ycc[:height, :width, 0], tint=tint, **more))

    def load_bright(self, view: int, part: Part = WHOLE) -> NDArray[np.uint8]:
        """Brightness (H, W) of a picture."""
        return np.asarray(self.load(view, PICTURE)["bright"][part])

    def load_colour(self, view: int, part: Part = WHOLE) -> NDArray[np.uint8]:
        """A picture (H, W, 3) BGR.

        A part starts with an even row and column; its outermost pixels have the tint of those
        inside.
        """
        bright = self.load_bright(view, part)
        first = tuple((side.start or 0) // 2 for side in part)
        half = tuple(slice(a, a + (n + 1) // 2) for a, n in zip(first, bright.shape, strict=True))
        tint = cv2.resize(self.load(view, PICTURE)["tint"][half], None, fx=2.0, fy=2.0)
        tint = tint[: bright.shape[0], : bright.shape[1]]
        return np.asarray(cv2.cvtColor(np.dstack([bright, tint]), cv2.COLOR_YCrCb2BGR))

    def load_mask(
        self, view: int, name: str, field: str, width: int, part: Part = WHOLE
    ) -> NDArray[np.bool_]:
        """A mask (H, W) of a picture of some width, that `pack_mask` made a field."""
        rows, columns = part
        bits = np.unpackbits(self.load(view, name)[field][rows], axis=1, count=width)
        return bits[:, columns].astype(np.bool_)


@lru_cache(maxsize=256)
def _layout(head: bytes) -> Any:
    """What the head of a file of `numpy.save` says, which takes longer to read than the file."""
    return np.lib.format.read_array_header_1_0(io.BytesIO(head[8:]))


def decode_depth(depth: StoredDepth) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depth (H, W) and its standard deviation, NaN where unknown."""
    level, share, depths, shares = depth
    found = depths[level]
    return found, found * shares[share]


def _sum(content: memoryview) -> bytes:
    return zlib.crc32(content).to_bytes(4, "little")


def _codes(
    depth: NDArray[np.float32], sigma: NDArray[np.float32]
) -> tuple[NDArray[np.uint16], NDArray[np.uint8], NDArray[np.float64]]:
    """Codes of depth and deviation, 0 where unknown; logarithm of the first depth, and its step."""
    known = np.isfinite(depth) & np.isfinite(sigma)
    middle = float(np.median(depth[known])) if known.any() else 1.0
    known &= (depth > middle / _MAX_RATIO) & (depth < middle * _MAX_RATIO)
    ends = np.array([depth[known].min(), depth[known].max()] if known.any() else [1.0, 1.0])
    minimum, maximum = np.log(ends.astype(np.float64))
    step = max(_DEPTH_STEP, float(maximum - minimum) / (_DEPTH_CODES - 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        level = np.rint((np.log(depth) - np.float32(minimum)) / np.float32(step)) + 1
        share = np.rint(np.log(sigma / depth / _SIGMA_LEAST) / _SIGMA_STEP) + 1
    return (
        np.where(known, np.clip(level, 1, _DEPTH_CODES), 0).astype(np.uint16),
        np.where(known, np.clip(share, 1, 255), 0).astype(np.uint8),
        np.array([minimum, step]),
    )


@lru_cache(maxsize=16)
def _depths(minimum: float, step: float) -> NDArray[np.float32]:
    codes = np.arange(_DEPTH_CODES + 1)
    depths = np.asarray(np.exp(minimum + (codes - 1) * step), np.float32)
    depths[0] = np.nan
    return depths


@lru_cache(maxsize=1)
def _shares() -> NDArray[np.float32]:
    shares = np.asarray(_SIGMA_LEAST * np.exp((np.arange(256) - 1) * _SIGMA_STEP), np.float32)
    shares[0] = np.nan
    return shares
