"""The paper's gain procedure: control pictures of a short dive show which gain to set.

Gain changes brightness, not the light that was caught: where shot and read noise are the limit the
report says so, and how much light is missing.
"""

import glob
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.errors import ImageError, warn
from alice_survey.core.executor import progress
from alice_survey.core.frames import Array
from alice_survey.kit.words import text_table
from camera_calib.picture_files import is_cut_short, read_pixels
from missions.exposure.light import MIDDLE_GREY

Floats = NDArray[np.float32]

_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
_ZONES = 5
"""Zones along each side of the frame: the lens's and the beam's fall-off is measured by them."""
_SAMPLES = 250_000
"""Pixels of a picture that percentiles are taken of, about."""
_HIGHLIGHT = 0.9
"""Share of full scale that the 99.5th percentile of the brightest zone may reach."""
_ACCEPTABLE_SNR = 10.0
"""Signal to noise of an acceptable picture (ISO 12232, noise-based speed)."""
_WHITE, _BLACK = 0.99, 0.002
"""Linear shares of full scale that count as clipped and as black."""
_MAX_CLIPPED = 0.5
_CLIPPED = 0.01
_LAPLACE = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]])
_LAPLACE_GAIN = 6.0
"""Root of the sum of its squares: white noise grows so much (Immerkaer 1996)."""
_TILE = 32


class PictureLevels(NamedTuple):
    """Levels of one control picture, linear, as shares of full scale."""

    median: float
    """Median of the mean of its channels."""
    bright: float
    """99.5th percentile of the brightest of 5 x 5 zones, of any channel."""
    clipped: float
    """Share of its pixels with a channel at full scale."""
    falloff: float
    """Mean of the four corner zones over the middle zone (medians)."""
    noise: float
    """Standard deviation where the picture is smoothest, about its median level."""


@dataclass(frozen=True, kw_only=True)
class GainAdvice:
    """The gain to set, and what it cannot correct; levels are medians over the pictures."""

    pictures: int
    skipped: int
    median: float
    bright: float
    clipped: float
    falloff: float
    snr: float
    """Median over noise."""
    change_db: float
    gain_db: float | None
    """Present gain and change; None where the present one is not known."""
    bound_by: str
    """`median`, or `highlights` where these allow no more."""
    advice: tuple[str, ...]


def gain_report(
    pictures: str | Path, *, present_gain_db: float | None = None, linear: bool = False
) -> tuple[str, dict[str, Any]]:
    """The gain to set, as text and as JSON values.

    Args:
        pictures: a folder, or a pattern such as `control/*.png`.
        present_gain_db: at which they were taken; the change is reported relative to it when None.
        linear: grey values are proportional to light; else they follow the sRGB curve.

    Raises:
        ImageError: no picture can be read, or all are black or white; the message says what to do.
    """
    advice = gain_advice(picture_files(pictures), present_gain_db=present_gain_db, linear=linear)
    return _text(advice, linear=linear), asdict(advice)


def picture_files(pictures: str | Path) -> list[Path]:
    """Files of pictures in a folder or of a pattern, in order.

    Raises:
        ImageError: there is none.
    """
    folder = Path(pictures)
    found = (
        folder.iterdir() if folder.is_dir() else map(Path, glob.glob(str(pictures), recursive=True))  # noqa: PTH207
    )
    files = sorted(file for file in found if file.suffix.lower() in _SUFFIXES)
    if not files:
        raise ImageError(
            f"{pictures}: no picture ({', '.join(_SUFFIXES)}): give a folder of control pictures "
            "or a quoted pattern"
        )
    return files


def gain_advice(
    files: Sequence[Path], *, present_gain_db: float | None = None, linear: bool = False
) -> GainAdvice:
    """The gain to set for pictures like these; as `gain_report`."""
    read = (read_linear(file, linear=linear) for file in progress(files, "control pictures"))
    levels = [picture_levels(picture) for picture in read if picture is not None]
    if not levels:
        raise ImageError(f"none of {len(files)} control pictures can be read: take them again")
    rows = np.array(levels)
    median, bright, clipped, falloff, _ = np.median(rows, axis=0).tolist()
    if bright <= 2 * _BLACK:
        raise ImageError(
            f"{len(levels)} control pictures are black ({bright:.2%} of full scale in their "
            "brightest zone): check that the lens is uncovered and the strobe fires within the "
            "exposure (triggers.csv), then take them again with 12 dB more gain"
        )
    if clipped > _MAX_CLIPPED or median >= _WHITE:
        raise ImageError(
            f"{len(levels)} control pictures are white ({clipped:.0%} of the pixels are clipped): "
            "lower the gain by 12 dB, or the exposure to a quarter, and take them again"
        )
    by_median, by_highlights = _db(MIDDLE_GREY / max(median, 1e-9)), _db(_HIGHLIGHT / bright)
    change_db = min(by_median, by_highlights)
    gain_db = None if present_gain_db is None else present_gain_db + change_db
    snr = float(np.median(rows[:, 0] / np.maximum(rows[:, 4], 1e-9)))
    advice = []
    if by_median - change_db > 0.05:
        advice.append(
            f"highlights allow {by_median - change_db:.1f} dB less than the median needs: light is "
            "uneven; move the strobes apart or accept dark edges"
        )
    if snr < _ACCEPTABLE_SNR:
        advice.append(
            f"signal to noise is {snr:.1f}, and gain cannot raise it: {_ACCEPTABLE_SNR:g} takes "
            f"{(_ACCEPTABLE_SNR / snr) ** 2:.1f} times the light: open the aperture, expose "
            "longer, or go lower"
        )
    if gain_db is not None and gain_db < 0:
        advice.append(
            f"the gain would be {gain_db:.1f} dB: set 0 dB, and the exposure to "
            f"{10 ** (gain_db / 20):.2f} of what it is, or close the aperture"
        )
    if clipped > _CLIPPED:
        advice.append(f"{clipped:.1%} of the pixels are clipped: check this gain with new pictures")
    darkest, brightest = float(rows[:, 0].min()), float(rows[:, 0].max())
    if brightest > 2 * max(darkest, 1e-9):
        advice.append(
            f"medians go from {darkest:.1%} to {brightest:.1%}: the altitude or the ground varied; "
            "take pictures at the survey's altitude"
        )
    return GainAdvice(
        pictures=len(levels),
        skipped=len(files) - len(levels),
        median=median,
        bright=bright,
        clipped=clipped,
        falloff=falloff,
        snr=snr,
        change_db=change_db,
        gain_db=gain_db,
        bound_by="median" if by_median <= by_highlights else "highlights",
        advice=tuple(advice),
    )


def read_linear(file: Path, *, linear: bool) -> Floats | None:
    """A picture as shares of full scale proportional to light, (H, W, C); None if unreadable.

    A picture of 16 bits without a value over 4095 is taken for one of 12, with a warning, as is
    said of each that cannot be read.
    """
    if is_cut_short(file):
        warn(f"{file}: the file ends early; left out")
        return None
    raw = read_pixels(file, cv2.IMREAD_UNCHANGED)
    if raw is None or raw.dtype not in (np.uint8, np.uint16) or raw.size == 0:
        warn(f"{file}: no picture of 8 or 16 bits, or it is damaged; left out")
        return None
    full = 255.0
    if raw.dtype == np.uint16:
        full = 65535.0
        if int(raw.max()) < 4096:
            warn(f"{file}: no value over 4095: taken for 12 bits")
            full = 4095.0
    stacked = raw[:, :, None] if raw.ndim == 2 else raw[:, :, :3]
    shares = np.minimum(np.arange(int(np.iinfo(raw.dtype).max) + 1) / full, 1.0)
    table = shares if linear else _from_srgb(shares)
    return np.asarray(table.astype(np.float32)[stacked])


def _from_srgb(encoded: Array) -> Array:
    """Linear light of sRGB values, 0 to 1 (IEC 61966-2-1)."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def picture_levels(picture: Floats) -> PictureLevels:
    """Levels of a linear picture (H, W, C)."""
    step = max(1, math.isqrt(picture.shape[0] * picture.shape[1] // _SAMPLES))
    thin = picture[::step, ::step]
    grey = thin.mean(axis=2, dtype=np.float32)
    zones = [
        [np.percentile(zone, [50.0, 99.5]) for zone in np.array_split(band, _ZONES, axis=1)]
        for band in np.array_split(grey, _ZONES)
    ]
    medians = np.array([[zone[0] for zone in row] for row in zones])
    row, column = np.unravel_index(int(medians.argmax()), medians.shape)
    brightest = np.array_split(np.array_split(thin, _ZONES)[row], _ZONES, axis=1)[column]
    last = _ZONES - 1
    corners = medians[[0, 0, last, last], [0, last, 0, last]].mean()
    median = float(np.median(grey))
    return PictureLevels(
        median=median,
        bright=float(np.percentile(brightest.max(axis=2), 99.5)),
        clipped=float((thin.max(axis=2) >= _WHITE).mean()),
        falloff=float(corners / max(medians[_ZONES // 2, _ZONES // 2], 1e-9)),
        noise=noise_sigma(picture),
    )


def noise_sigma(picture: Floats) -> float:
    """Noise of the mean of a picture's channels, where it is smoothest.

    Immerkaer's operator takes planes of light out; tiles of which the 10th percentile counts keep
    texture out, which would pass for noise. Shot noise grows with light, so tiles darker than the
    picture's median are left out.
    """
    grey = picture.mean(axis=2, dtype=np.float32)
    rough: Floats = cv2.filter2D(grey, cv2.CV_32F, _LAPLACE)[1:-1, 1:-1]
    rows, columns = (size // _TILE * _TILE for size in rough.shape)
    if min(rows, columns) == 0:
        return float(rough.std() / _LAPLACE_GAIN)
    tiles = rough[:rows, :columns].reshape(rows // _TILE, _TILE, columns // _TILE, _TILE)
    light = grey[1 : rows + 1, 1 : columns + 1].reshape(tiles.shape).mean(axis=(1, 3))
    sigma = np.sqrt((tiles**2).mean(axis=(1, 3))) / _LAPLACE_GAIN
    return float(np.percentile(sigma[light >= np.median(light)], 10.0))


def _text(found: GainAdvice, *, linear: bool) -> str:
    """The report as text."""
    change = f"change the gain by {found.change_db:+.1f} dB"
    if found.gain_db is not None:
        change = f"set the gain to {max(found.gain_db, 0.0):.1f} dB ({found.change_db:+.1f} dB)"
    rows = [
        ("median", f"{found.median:.2%}"),
        ("brightest zone, 99.5 %", f"{found.bright:.2%}"),
        ("clipped", f"{found.clipped:.2%}"),
        ("corners over middle", f"{found.falloff:.2f}"),
        ("signal to noise", f"{found.snr:.1f}"),
    ]
    curve = "linear" if linear else "sRGB curve undone"
    return "\n".join([
        f"{found.pictures} control pictures, {found.skipped} left out ({curve}; shares of full "
        "scale)",
        text_table(("level", "now"), rows),
        f"{change}, bound by the {found.bound_by}",
        *(f"  - {line}" for line in found.advice),
    ])  # fmt: skip


def _db(ratio: float) -> float:
    return 20.0 * math.log10(ratio)
