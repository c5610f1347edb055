"""Reports on the quality of a survey's pictures: a table, and a sheet of the worst."""

import math
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from alice_survey.core.artefacts import read_stage, refuse_links, write_csv
from alice_survey.core.errors import ImageError
from alice_survey.core.executor import Executor
from alice_survey.core.manifest import read_manifest
from alice_survey.kit.figure import INKS, Axes, figure_style, new_figure, plain_name, save_figure
from reconstruct.pictures.files import decode
from reconstruct.pictures.quality import (
    MeasureTask,
    PictureQuality,
    add_overlap,
    judge,
    measure_file,
)

_NUMBERS = tuple(f.name for f in fields(PictureQuality) if f.type in (float, "float"))
_HEADER = ("image", "camera", "station", *_NUMBERS, "reasons")
_MAX_SHOWN = 8
_ACROSS = 4
_THUMBNAIL_PX = 420
_STRIPS = ("sharpness", "contrast", "veil", "brightness")


@figure_style()
def plot_quality(path: Path, images: Path, found: Sequence[PictureQuality]) -> None:
    """Draw figures of all pictures in their order, and thumbnails of the worst with the reason.

    Args:
        path: PNG to write.
        images: folder of the pictures.
        found: all pictures, judged.
    """
    worst = worst_first(found)[:_MAX_SHOWN]
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
    for axis, name in zip(axes, _STRIPS, strict=True):
        values = np.array([getattr(quality, name) for quality in found])
        for camera in cameras:
            own = np.array([quality.camera == camera for quality in found])
            axis.plot(order[own], values[own], ".", markersize=4, label=camera)
        axis.plot(order[flagged], values[flagged], "o", mfc="none", mec=INKS[1], markersize=8)
        axis.set_ylabel(name)
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


def quality_report(workspace: Path, executor: Executor) -> tuple[str, dict[str, Any]]:
    """Measure all pictures of a workspace and write `quality/quality.csv` and `quality.png`.

    Args:
        workspace: with `images/manifest.csv`; a finished `sparse/` adds the overlaps.
        executor: where tasks run that read pictures.

    Returns:
        The list of flagged pictures as text, and figures as JSON values.

    Raises:
        ImageError: there is no manifest, or it names no picture.
    """
    refuse_links(workspace, workspace / "quality")
    images = workspace / "images"
    records = read_manifest(images / "manifest.csv")
    if not records:
        raise ImageError(f"{images / 'manifest.csv'} names no picture")
    tasks = [MeasureTask(images=images, record=record) for record in records]
    found = list(executor.map(measure_file, tasks, label="picture quality"))
    if read_stage(workspace / "sparse") is not None:
        found = add_overlap(found, workspace / "sparse")
    found = judge(found)
    folder = workspace / "quality"
    write_csv(folder / "quality.csv", _HEADER, (_row(quality) for quality in found))
    plot_quality(folder / "quality.png", images, found)
    return _text(found, folder), _figures(found)


def _row(quality: PictureQuality) -> list[Any]:
    numbers = [getattr(quality, name) for name in _NUMBERS]
    cells = ["" if math.isnan(number) else f"{number:.6g}" for number in numbers]
    return [
        quality.image, quality.camera, quality.station, *cells, "; ".join(quality.reasons)
    ]  # fmt: skip


def _text(found: Sequence[PictureQuality], folder: Path) -> str:
    flagged = [quality for quality in found if quality.flagged]
    lines = [f"{q.image}: {'; '.join(q.reasons)}" for q in flagged]
    lines.append(
        f"{len(found)} pictures, {len(flagged)} to look at (all are still used where they can be); "
        f"{folder / 'quality.csv'}"
    )
    return "\n".join(lines)


def _figures(found: Sequence[PictureQuality]) -> dict[str, Any]:
    medians = {}
    for name in _NUMBERS:
        values = np.array([getattr(q, name) for q in found])
        if np.isfinite(values).any():
            medians[name] = round(float(np.nanmedian(values)), 6)
    return {
        "pictures": len(found),
        "unreadable": sum(math.isnan(q.sharpness) for q in found),
        "flagged": [{"image": q.image, "reasons": list(q.reasons)} for q in found if q.flagged],
        "median": medians,
    }
