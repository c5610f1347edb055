from pathlib import Path

import cv2
import numpy as np
import pytest

from reconstruct.pictures.normalise import even_light, normalise, read_deep

TEXTURE = np.random.default_rng(1).normal(1.0, 0.1, (240, 320)).clip(0.5, 1.5)
Y, X = np.mgrid[:240, :320]
LAMP = np.exp(-2.0 * ((X - 160) ** 2 + (Y - 120) ** 2) / 192**2)


def test_lamp_light_is_divided_out() -> None:
    assert LAMP.max() / LAMP.min() > 4
    ratio = even_light(np.rint(150.0 * TEXTURE * LAMP).astype(np.uint8))
    inner = (slice(20, -20), slice(20, -20))
    tiles = ratio[inner].reshape(5, 40, 7, 40).mean(axis=(1, 3))
    assert 0.97 < tiles.min() <= tiles.max() < 1.03
    assert np.corrcoef(ratio[inner].ravel(), TEXTURE[inner].ravel())[0, 1] > 0.99


@pytest.mark.parametrize("gain", [0.5, 0.9, 1.1])
def test_exposure_does_not_matter(gain: float) -> None:
    one, other = (
        even_light(np.rint(level * TEXTURE).astype(np.uint8)) for level in (100.0, 100.0 * gain)
    )
    assert np.abs(one - other).mean() < 0.01


def test_a_dark_frame_stays_quiet() -> None:
    dark = np.random.default_rng(2).poisson(0.3, (120, 160)).astype(np.uint8)
    ratio = even_light(dark)
    assert np.isfinite(ratio).all()
    assert ratio.mean() < 0.2  # not blown up to the contrast of a lit picture
    assert even_light(np.zeros((50, 60), np.uint8)).max() == 0


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_dim_pictures_of_16_bits_keep_their_contrast(tmp_path: Path, suffix: str) -> None:
    """A picture that fills a hundredth of its range has 2 grey levels in 8 bits."""
    scene = TEXTURE * LAMP
    taken = np.rint(0.01 * 65535 * scene).astype(np.uint16)
    path = tmp_path / f"dim.{suffix}"
    assert cv2.imwrite(str(path), taken)
    deep = read_deep(path)
    np.testing.assert_array_equal(deep, taken)
    bright = normalise(np.rint(150 * scene).astype(np.uint8)).astype(float)
    inner = (slice(60, -60), slice(80, -80))

    def likeness(grey: np.ndarray) -> float:
        return float(np.corrcoef(grey[inner].ravel(), bright[inner].ravel())[0, 1])

    assert likeness(normalise(deep)) > 0.97
    assert likeness(normalise((taken >> 8).astype(np.uint8))) < 0.9
    assert normalise(deep).dtype == np.uint8
