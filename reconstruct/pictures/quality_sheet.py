"""A sheet of the quality of a survey's pictures: figures in their order, and the worst ones."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from alice_survey.base.errors import ImageError
from alice_survey.kit.figure import INKS, Axes, figure_style, new_figure, plain_name, save_figure
from reconstruct.pictures.files import decode
from reconstruct.pictures.quality import PictureQuality

_MOST_SHOWN = 8
_ACROSS = 4
_THUMBNAIL_PX = 420
_STRIPS = (
    ("sharpness", "sharpness"),
    ("contrast", "contrast"),
    ("veil", "veil"),
    ("brightness", "brightness"),
)


@figure_style()
def plot_quality(path: Path, images: Path, found: Sequence[PictureQuality]) -> None:
    """Draw figures of all pictures in their order, and thumbnails of the worst with the reason.

    Args:
        path: PNG to write.
        images: folder of the pictures.
        found: all pictures, judged.
    """
    worst = worst_first(found)[:_MOST_SHOWN]
    rows = -(-len(worst) // _ACROSS)
    figure = new_figure(5.2 + 2.6 * rows, 12)
    if not rows:
        _strips(figure, found)
    else:
        upper, lower = figure.subfigures(2, 1, height_ratios=[5.2, 2.6 * rows])
        _strips(upper, found)
        panels = lower.subplots(rows, _ACROSS, squeeze=False).ravel()
        for panel in panels:
            panel.axis("off")
        for panel, quality in zip(panels, worst, strict=False):
            _thumbnail(panel, images, quality)
    save_figure(figure, path)


def worst_first(found: Sequence[PictureQuality]) -> list[PictureQuality]:
    """Flagged pictures: unreadable ones, then those with the most reasons, then by sharpness."""
    flagged = [quality for quality in found if quality.flagged]
    return sorted(
        flagged,
        key=lambda q: (not np.isnan(q.sharpness), -len(q.reasons), q.sharpness, q.image),
    )


def _strips(figure: Any, found: Sequence[PictureQuality]) -> None:
    axes = figure.subplots(len(_STRIPS), 1, sharex=True)
    cameras = sorted({quality.camera for quality in found})
    order = np.arange(len(found))
    flagged = np.array([quality.flagged for quality in found])
    for axis, (name, label) in zip(axes, _STRIPS, strict=True):
        values = np.array([getattr(quality, name) for quality in found])
        for camera in cameras:
            own = np.array([quality.camera == camera for quality in found])
            axis.plot(order[own], values[own], ".", markersize=4, label=camera)
        axis.plot(order[flagged], values[flagged], "o", mfc="none", mec=INKS[1], markersize=8)
        axis.set_ylabel(label)
        gone = np.isnan(values)
        if gone.any():  # an empty line without clipping has no extent, and no layout
            axis.plot(order[gone], np.zeros(gone.sum()), "x", color=INKS[1], clip_on=False)
        axis.set_ylim(0, 1.15 * np.nanmax(values, initial=1e-3))
    axes[0].set_title(
        f"{len(found)} pictures in their order; {flagged.sum()} to look at (crosses: unreadable)"
    )
    axes[0].legend(loc="lower right", ncols=len(cameras))
    axes[-1].set_xlabel("picture")
    axes[-1].xaxis.get_major_locator().set_params(integer=True)


def _thumbnail(panel: Axes, images: Path, quality: PictureQuality) -> None:
    panel.set_title(
        plain_name(f"{quality.image}\n" + "\n".join(_short(r) for r in quality.reasons)),
        fontsize=8,
    )
    try:
        pixels = decode(images / quality.image)
    except (ImageError, OSError):
        panel.text(0.5, 0.5, "cannot be shown", ha="center", va="center", color="0.4")
        return
    if pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    shrink = _THUMBNAIL_PX / max(pixels.shape[:2])
    small = cv2.resize(pixels, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    colours = cv2.COLOR_GRAY2RGB if small.ndim == 2 else cv2.COLOR_BGR2RGB
    panel.imshow(cv2.cvtColor(small, colours))


def _short(reason: str) -> str:
    return reason if len(reason) <= 54 else reason[:53] + "…"
