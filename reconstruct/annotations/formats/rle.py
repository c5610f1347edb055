"""Masks of COCO: run lengths down the columns, plain or packed, to outlines along pixel edges.

Runs are of zeros and ones in turn, zeros first. Packed, each is 5 bits a character from 48 on, the
lowest first, with a bit for more; from the third on it is the difference to the run two before.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rasterio.features
from numpy.typing import NDArray

from alice_survey.core.errors import WorkspaceError
from reconstruct.annotations.values import signed_area

Ring = tuple[tuple[float, float], ...]
_MAX_PX = 100_000_000
"""Pixels of the box around a mask."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Mask:
    """The box around what is set."""

    left: int
    top: int
    pixels: NDArray[np.uint8]
    """(rows, columns), 1 where set."""


def unpacked(text: str) -> list[int]:
    """Runs of a packed mask.

    Raises:
        WorkspaceError: it is cut short, or has other characters.
    """
    runs: list[int] = []
    value = shift = 0
    for character in text.encode("utf-8", "replace"):
        bits = character - 48
        if not 0 <= bits < 64 or shift > 60:
            raise WorkspaceError("a mask with a character that packed run lengths do not have")
        value |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        if bits & 16:
            value -= 1 << shift
        if len(runs) > 2:
            value += runs[-2]
        runs.append(value)
        value = shift = 0
    if shift:
        raise WorkspaceError("a mask whose packed run lengths are cut short")
    return runs


def packed(runs: Sequence[int]) -> str:
    """The way back."""
    text = []
    for n, run in enumerate(runs):
        value = int(run) - (int(runs[n - 2]) if n > 2 else 0)
        more = True
        while more:
            bits, value = value & 31, value >> 5
            more = value != (-1 if bits & 16 else 0)
            text.append(chr(bits + (32 if more else 0) + 48))
    return "".join(text)


def decoded(runs: Sequence[int], height: int, width: int) -> Mask | None:
    """The mask of run lengths; None where nothing is set.

    Raises:
        WorkspaceError: runs do not make up the picture, or the box is too large.
    """
    lengths = np.array(runs, dtype=np.int64)
    if (lengths < 0).any() or int(lengths.sum()) != height * width:
        raise WorkspaceError(
            f"a mask of {int(lengths.sum())} pixels for a picture of {width} x {height}"
        )
    ends = np.cumsum(lengths)
    first, last = (ends - lengths)[1::2], ends[1::2] - 1
    first, last = first[last >= first], last[last >= first]
    if not len(first):
        return None
    left, right = int(first[0] // height), int(last[-1] // height)
    whole = bool((first // height != last // height).any())
    top = 0 if whole else int((first % height).min())
    bottom = height - 1 if whole else int((last % height).max())
    size = (right - left + 1, bottom - top + 1)
    if size[0] * size[1] > _MAX_PX:
        raise WorkspaceError(
            f"a mask of {size[0]} x {size[1]} pixels: at most {_MAX_PX} are taken: cut the "
            "picture into tiles"
        )
    marks = np.zeros(size, dtype=np.uint8)
    for start, end in zip(first.tolist(), last.tolist(), strict=True):
        for column in range(start // height, end // height + 1):
            low = max(start - column * height, 0) - top
            marks[column - left, low : min(end - column * height, height - 1) - top + 1] = 1
    return Mask(left=left, top=top, pixels=np.ascontiguousarray(marks.T))


def encoded(mask: NDArray[np.uint8]) -> list[int]:
    """Run lengths of a mask (height, width)."""
    flat = np.concatenate([[0], (mask.T.ravel() > 0).astype(np.int8), [-1]])
    changes = np.flatnonzero(np.diff(flat))
    runs: list[int] = np.diff(np.concatenate([[0], changes])).tolist()
    return runs


def outlines(mask: Mask) -> list[tuple[Ring, tuple[Ring, ...]]]:
    """Polygons with their holes that cover exactly the pixels set, largest first.

    Pixels that touch at a corner alone are of two polygons.
    """
    found = []
    for geometry, value in rasterio.features.shapes(mask.pixels, connectivity=4):
        if value == 1:
            rings = [
                tuple((x + mask.left, y + mask.top) for x, y in ring[:-1])
                for ring in geometry["coordinates"]
            ]
            found.append((rings[0], tuple(rings[1:])))
    return sorted(found, key=lambda one: -abs(signed_area(one[0])))
