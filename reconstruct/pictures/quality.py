"""How good the pictures of a survey are: sharpness, exposure, contrast and noise.

Every picture is measured by itself, then compared with the survey: what lies far from the median of
all is listed with the reason. Nothing is left out of the reconstruction because of it.
"""

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import refuse_links, stage_command, write_csv
from alice_survey.core.block_solver import MAD_TO_SIGMA
from alice_survey.core.errors import ImageError, why
from alice_survey.core.executor import Executor
from alice_survey.core.manifest import ImageRecord, read_manifest
from alice_survey.kit.words import count
from reconstruct.pictures.files import decode
from reconstruct.pictures.normalise import even_light
from reconstruct.pictures.undistorted import read_mask

NAN = math.nan
MAX_BRIGHT = 0.25
"""Share of burnt-out pixels from which a picture is bad by itself."""
MAX_DARK = 0.5
"""Share of black pixels from which a picture is bad by itself."""
OUTLIER_SIGMAS = 4.0
"""Robust standard deviations from the survey's median from which a picture stands out ..."""
OUTLIER_FACTOR = 1.6
"""... if it is also worse by this factor: in an even survey small differences are not a fault."""

_BLOCK_PX = 48
_SMOOTHEST_PERCENT = 10
"""Blocks so smooth show hardly anything but noise."""
_FINE_PX, _MID_PX, _COARSE_PX = 1.0, 2.0, 5.0
_JUDGED = ("sharpness", "contrast", "brightness", "veil")


@dataclass(frozen=True, kw_only=True)
class PictureQuality:
    """One picture. NaN (an empty cell) where it could not be read."""

    image: str
    camera: str
    station: int
    sharpness: float = NAN
    """Detail of 1 px over detail of 2 to 5 px, noise taken off: blur lowers it, haze does not."""
    contrast: float = NAN
    """Relative amplitude of detail of 2 to 5 px: haze, defocus and darkness lower it."""
    veil: float = NAN
    """Darkest level of a neighbourhood over its mean: nears 1 where water scatters light back."""
    brightness: float = NAN
    """Median grey level, 0 to 1."""
    dark_share: float = NAN
    """Share of pixels that are black in all channels."""
    bright_share: float = NAN
    """Share of pixels that are burnt out in a channel."""
    noise: float = NAN
    """Standard deviation of the grey level where the picture is smoothest, 0 to 1."""
    reasons: tuple[str, ...] = field(default=())

    @property
    def flagged(self) -> bool:
        """Whether anything is wrong with it."""
        return bool(self.reasons)


def measure_file(images: Path, record: ImageRecord) -> PictureQuality:
    """Read and measure one picture; a file that cannot be used gives the reason, never an error."""
    path = images / record.image
    bare = PictureQuality(image=record.image, camera=record.camera, station=record.station)
    try:
        pixels = decode(path) if path.is_file() else None
        if pixels is None:
            raise ImageError("no such file")
        mask = None
        if record.mask:
            mask = read_mask(images / record.mask, (pixels.shape[1], pixels.shape[0]))
        figures: dict[str, Any] = dict(measure(pixels, mask))
        return replace(bare, **figures)
    except (ImageError, OSError) as error:
        text = why(error).removeprefix(f"{path}: ")
        return replace(bare, reasons=(f"unreadable: {text}",))


def measure(pixels: NDArray[Any], mask: NDArray[np.bool_] | None = None) -> dict[str, float]:
    """The figures of `PictureQuality` that come from pixels.

    Detail is measured in blocks of the picture divided by its blurred background (so that uneven
    lamps do not count), and the median block stands for the picture (so that a fish does not).

    Args:
        pixels: (H, W) or (H, W, 3) BGR, 8 or 16 bits.
        mask: (H, W) True where the picture may be used.

    Raises:
        ImageError: too little is left outside of the mask.
    """
    eight = _in_eight_bits(pixels)
    grey = cv2.cvtColor(eight, cv2.COLOR_BGR2GRAY) if eight.ndim == 3 else eight
    use = np.full(grey.shape, True) if mask is None else mask
    blocks = np.asarray(_blocks_of(use).all(axis=(1, 3)))
    if not blocks.any():
        raise ImageError(
            f"no block of {_BLOCK_PX} px is free of the mask: nothing of it can be measured"
        )
    sharp, contrast = _detail(eight, blocks)
    level = grey.astype(np.float32) / 255.0
    mean = _per_block(level)[blocks]
    channels = eight.reshape(*grey.shape, -1)[use]
    smooth = cv2.GaussianBlur(level, (0, 0), _FINE_PX)  # the darkest pixel is otherwise noise
    darkest = _blocks_of(smooth).min(axis=(1, 3))[blocks]
    return {
        "sharpness": sharp,
        "contrast": contrast,
        "veil": float(np.median(darkest / np.maximum(mean, 1e-3))),
        "brightness": float(np.median(level[use])),
        "dark_share": float((channels.max(axis=1) <= 2).mean()),
        "bright_share": float((channels.max(axis=1) >= 254).mean()),
        "noise": _noise(level, blocks),
    }


def sharpness(pixels: NDArray[Any]) -> float:
    """The figure of `PictureQuality` of a picture, (H, W) or (H, W, 3) BGR, without a mask."""
    eight = _in_eight_bits(pixels)
    blocks = np.asarray(_blocks_of(np.full(eight.shape[:2], True)).all(axis=(1, 3)))
    return _detail(eight, blocks)[0]


def _in_eight_bits(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    if pixels.dtype == np.uint8:
        return pixels
    full = float(np.iinfo(pixels.dtype).max)
    return (pixels.astype(np.float32) * (255.0 / full)).round().astype(np.uint8)


def _detail(eight: NDArray[np.uint8], blocks: NDArray[np.bool_]) -> tuple[float, float]:
    """Sharpness and contrast of some blocks of a picture."""
    ratio = even_light(eight)
    noise = _noise(ratio, blocks)
    fine = ratio - cv2.GaussianBlur(ratio, (0, 0), _FINE_PX)
    band = cv2.GaussianBlur(ratio, (0, 0), _MID_PX) - cv2.GaussianBlur(ratio, (0, 0), _COARSE_PX)
    fine_energy = float(np.median(_per_block(fine**2)[blocks])) - _fine_gain() * noise**2
    band_energy = float(np.median(_per_block(band**2)[blocks]))
    sharp = math.sqrt(max(fine_energy, 0.0) / band_energy) if band_energy > 0 else 0.0
    return sharp, math.sqrt(band_energy)


def _blocks_of(values: NDArray[Any]) -> NDArray[Any]:
    """(rows, block, columns, block) view of a picture, its remainder cut off."""
    rows, columns = max(values.shape[0] // _BLOCK_PX, 1), max(values.shape[1] // _BLOCK_PX, 1)
    height, width = min(_BLOCK_PX, values.shape[0]), min(_BLOCK_PX, values.shape[1])
    return values[: rows * height, : columns * width].reshape(rows, height, columns, width)


def _per_block(values: NDArray[np.float32]) -> NDArray[np.float64]:
    return np.asarray(_blocks_of(values).mean(axis=(1, 3), dtype=np.float64))


def _noise(values: NDArray[np.float32], blocks: NDArray[np.bool_]) -> float:
    """Standard deviation of white noise, from the smoothest blocks.

    The mask of Immerkaer (1996, "Fast noise variance estimation") is blind to planes and edges
    along the axes; its gain for white noise is 6.
    """
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32) / 6.0
    residual = np.abs(cv2.filter2D(values, cv2.CV_32F, mask, borderType=cv2.BORDER_REFLECT))
    per_block = _per_block(residual)[blocks] * math.sqrt(math.pi / 2)
    return float(np.percentile(per_block, _SMOOTHEST_PERCENT))


def _fine_gain() -> float:
    """Variance that the filter of the finest detail leaves of white noise of variance 1."""
    spike = np.zeros((33, 33), dtype=np.float32)
    spike[16, 16] = 1.0
    return float(((spike - cv2.GaussianBlur(spike, (0, 0), _FINE_PX)) ** 2).sum())


def judge(found: Sequence[PictureQuality]) -> list[PictureQuality]:
    """Add the reasons: limits for any picture, and what stands out of the survey.

    Medians are those of a picture's own camera: two cameras may have different lenses and lamps.
    """
    by_camera: dict[str, list[PictureQuality]] = defaultdict(list)
    for quality in found:
        by_camera[quality.camera].append(quality)
    spreads = {
        camera: {name: _middle(pictures, name) for name in _JUDGED}
        for camera, pictures in by_camera.items()
    }
    return [replace(q, reasons=q.reasons + _reasons(q, spreads[q.camera])) for q in found]


def _middle(pictures: Sequence[PictureQuality], name: str) -> tuple[float, float]:
    """Median and robust standard deviation of the logarithm of a figure, over readable pictures."""
    values = np.array([getattr(p, name) for p in pictures])
    values = np.log(np.maximum(values[np.isfinite(values)], 1e-6))
    if not values.size:
        return NAN, NAN
    middle = float(np.median(values))
    return middle, MAD_TO_SIGMA * float(np.median(np.abs(values - middle)))


def _reasons(quality: PictureQuality, spreads: dict[str, tuple[float, float]]) -> tuple[str, ...]:
    if math.isnan(quality.sharpness):
        return ()
    reasons = []
    if quality.bright_share > MAX_BRIGHT:
        reasons.append(f"overexposed: {quality.bright_share:.0%} of its pixels are burnt out")
    if quality.dark_share > MAX_DARK:
        reasons.append(f"underexposed: {quality.dark_share:.0%} of its pixels are black")
    veil, veil_sigma = spreads["veil"]
    veiled = math.log(max(quality.veil, 1e-6)) > veil + OUTLIER_SIGMAS * veil_sigma
    pale = "hazy" if veiled and quality.bright_share <= MAX_BRIGHT else "pale"
    for name, word in (("sharpness", "blurred"), ("contrast", pale), ("brightness", "dark")):
        middle, sigma = spreads[name]
        below = middle - math.log(max(getattr(quality, name), 1e-6))
        if below > max(OUTLIER_SIGMAS * sigma, math.log(OUTLIER_FACTOR)):
            reasons.append(f"{word}: {name} is {math.exp(-below):.2f} of the survey's median")
    return tuple(reasons)


_NUMBERS = tuple(f.name for f in fields(PictureQuality) if f.type in (float, "float"))
_HEADER = ("image", "camera", "station", *_NUMBERS, "reasons")
_STRIPS = ("sharpness", "contrast", "veil", "brightness")


def plot_quality(path: Path, found: Sequence[PictureQuality]) -> None:
    """Draw figures of all pictures in their order, the flagged ones in circles."""
    from alice_survey.kit.figure import figure_style, save_figure

    with figure_style():
        save_figure(_quality_figure(found), path)


def _quality_figure(found: Sequence[PictureQuality]) -> Any:
    from alice_survey.kit.figure import INKS, new_figure

    figure = new_figure(5.2, 12)
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
    return figure


def quality_report(workspace: Path, executor: Executor) -> tuple[str, dict[str, Any]]:
    """Measure all pictures of a workspace and write `quality/quality.csv` and `quality.png`.

    Args:
        workspace: with `images/manifest.csv`.
        executor: where tasks run that read pictures.

    Returns:
        The list of flagged pictures as text, and figures as JSON values.

    Raises:
        ImageError: there is no manifest, or it names no picture.
    """
    refuse_links(workspace, workspace / "quality")
    images = workspace / "images"
    if not images.is_dir():
        raise ImageError(f"no {images}: run {stage_command('import-images', workspace)!r} first")
    records = read_manifest(images / "manifest.csv")
    if not records:
        raise ImageError(f"{images / 'manifest.csv'} names no picture")
    found = judge(
        list(executor.map(partial(measure_file, images), records, label="picture quality"))
    )
    folder = workspace / "quality"
    write_csv(folder / "quality.csv", _HEADER, (_row(quality) for quality in found))
    plot_quality(folder / "quality.png", found)
    flagged = [quality for quality in found if quality.flagged]
    lines = [f"{q.image}: {'; '.join(q.reasons)}" for q in flagged]
    lines.append(
        f"{count(len(found), 'picture')}, {len(flagged)} to look at (all are still used where they "
        f"can be); {folder / 'quality.csv'}"
    )
    medians = {}
    for name in _NUMBERS:
        values = np.array([getattr(q, name) for q in found])
        if np.isfinite(values).any():
            medians[name] = round(float(np.nanmedian(values)), 6)
    return "\n".join(lines), {
        "pictures": len(found),
        "unreadable": sum(math.isnan(q.sharpness) for q in found),
        "flagged": [{"image": q.image, "reasons": list(q.reasons)} for q in flagged],
        "median": medians,
    }


def _row(quality: PictureQuality) -> list[Any]:
    numbers = [getattr(quality, name) for name in _NUMBERS]
    cells = ["" if math.isnan(number) else f"{number:.6g}" for number in numbers]
    return [
        quality.image, quality.camera, quality.station, *cells, "; ".join(quality.reasons)
    ]  # fmt: skip
