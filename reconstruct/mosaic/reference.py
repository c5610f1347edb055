"""Patches of known reflectance in pictures, as `colour_reference.csv` names them.

A row is a circle on a grey card or on a patch of a chart: `image`, `x`, `y` of its middle (pixels
of the picture as taken, from 0 at the middle of the first pixel, as viewers show them),
`radius_px`, and its reflectance in linear light, 0 to 1, `red`, `green`, `blue`. A patch may have
rows in several pictures.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import read_csv
from alice_survey.core.errors import WorkspaceError
from alice_survey.core.frames import Array
from reconstruct.mosaic.picture_measures import BRIGHTEST, DARKEST, linear_table
from reconstruct.pictures.undistorted import Pictures
from reconstruct.stages import COLOUR_FILE

_NUMBERS = ("x", "y", "radius_px", "red", "green", "blue")
_MIN_PIXELS = 9
_MAX_BURNT = 0.01
"""Share of a patch's pixels that may be burnt out."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferencePatch:
    """What a picture shows of a patch of known reflectance."""

    image: str
    place: NDArray[np.float32]
    """(2,) x and y of its middle over the picture's width and height."""
    light: Array
    """(3,) mean linear light, BGR."""
    reflectance: Array
    """(3,) BGR."""


def read_references(workspace: Path, images: Sequence[str]) -> tuple[ReferencePatch, ...]:
    """Measure the patches that `colour_reference.csv` names; none without that file.

    Args:
        workspace: with finished pictures and model.
        images: pictures of the model.

    Raises:
        WorkspaceError: a row is wrong, or its patch cannot be used; the message names the line.
        ImageError: a picture cannot be read.
    """
    path = workspace / COLOUR_FILE
    if not path.is_file():
        return ()
    known, pictures = set(images), Pictures.still(workspace)
    found = []
    for line, row in read_csv(path, ("image", *_NUMBERS), fault=WorkspaceError)[1]:
        where = f"{path} line {line}"
        if row["image"] not in known:
            raise WorkspaceError(f"{where}: the model has no picture {row['image']!r}")
        found.append(_measured(where, row, pictures))
    if not found:
        raise WorkspaceError(f"{path}: has no patch; fill it or take it away")
    return tuple(found)


def _measured(where: str, row: dict[str, str], pictures: Pictures) -> ReferencePatch:
    try:
        x, y, radius, *rgb = (float(row[name]) for name in _NUMBERS)
    except ValueError:
        raise WorkspaceError(f"{where}: {', '.join(_NUMBERS)} must be numbers") from None
    if not all(0.0 < value <= 1.0 for value in rgb):
        raise WorkspaceError(f"{where}: red, green, blue must be reflectances above 0, at most 1")
    taken, usable = pictures.taken(row["image"]), pictures.usable(row["image"])
    height, width = taken.shape[:2]
    if not (radius > 0 and radius <= x + 0.5 <= width - radius and
            radius <= y + 0.5 <= height - radius):  # fmt: skip
        raise WorkspaceError(
            f"{where}: a circle of {radius:g} px about {x:g}, {y:g} is not within the picture of "
            f"{width} x {height} px"
        )
    rows, columns = np.mgrid[:height, :width]
    inside = np.hypot(columns - x, rows - y) <= radius
    inside &= True if usable is None else usable
    if inside.sum() < _MIN_PIXELS:
        raise WorkspaceError(
            f"{where}: {inside.sum()} pixels in the circle, masked ones left out; "
            f"{_MIN_PIXELS} are needed: raise radius_px"
        )
    light = linear_table()[taken[inside]].astype(np.float64)
    burnt = float((light > BRIGHTEST).any(axis=1).mean())
    mean = light.mean(axis=0)
    if burnt > _MAX_BURNT or (mean < DARKEST).any():
        state = f"{burnt:.0%} of the patch is burnt out" if burnt > _MAX_BURNT else "it is black"
        raise WorkspaceError(f"{where}: {state}: take another patch or picture")
    return ReferencePatch(
        image=row["image"],
        place=np.array([(x + 0.5) / width, (y + 0.5) / height], np.float32),
        light=mean,
        reflectance=np.array(rgb[::-1]),
    )
