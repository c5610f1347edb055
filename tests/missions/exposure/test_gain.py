from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alice_survey.core.errors import ImageError
from alice_survey.sim.seafloor.light import develop
from missions.exposure.gain import gain_advice, gain_report, noise_sigma, picture_files, read_linear

SIZE = (160, 200)
FULL_WELL = 9000.0


def scene(median_e: float, falloff: float = 0.0, noisy: bool = True, seed: int = 1) -> np.ndarray:
    """Electrons of a textured floor, (H, W, 3)."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    r2 = ((x / SIZE[1] - 0.5) ** 2 + (y / SIZE[0] - 0.5) ** 2) * 4
    light = np.exp(-falloff * r2) * (1 + 0.1 * np.sin(x / 23.0) * np.cos(y / 31.0))
    electrons = np.repeat((median_e / np.median(light) * light)[:, :, None], 3, axis=2)
    if noisy:
        electrons = rng.poisson(electrons) + 12.0 * rng.standard_normal(electrons.shape)
    return electrons.astype(np.float32)


def taken(folder: Path, median_e: float, gain_db: float, count: int = 3, **how: Any) -> Path:
    """Control pictures as the simulator's sensor writes them."""
    for i in range(count):
        picture = develop(scene(median_e, seed=i, **how), 10 ** (gain_db / 20) / FULL_WELL)
        cv2.imwrite(str(folder / f"{i}.png"), picture)
    return folder


@settings(max_examples=15, deadline=None)
@given(median_e=st.floats(150, 2000), present_db=st.floats(0, 12))
def test_the_gain_of_the_advice_brings_the_median_to_the_target(
    tmp_path_factory: pytest.TempPathFactory, median_e: float, present_db: float
) -> None:
    folder = taken(tmp_path_factory.mktemp("control"), median_e, present_db)
    advice = gain_advice(picture_files(folder), present_gain_db=present_db)
    assert advice.gain_db is not None
    expected = 20 * np.log10(0.2 * FULL_WELL / median_e)
    assert advice.gain_db == pytest.approx(expected, abs=0.5)
    assert advice.bound_by == "median"


def test_uneven_light_is_bound_by_its_highlights(tmp_path: Path) -> None:
    advice = gain_advice(picture_files(taken(tmp_path, 400.0, 0.0, falloff=4.0)))
    assert advice.bound_by == "highlights"
    assert advice.bright * 10 ** (advice.change_db / 20) == pytest.approx(0.9)
    assert advice.falloff < 0.15


def test_where_light_is_the_limit_it_is_said(tmp_path: Path) -> None:
    data = gain_report(taken(tmp_path, 40.0, 20.0), present_gain_db=20.0)[1]
    assert data["snr"] < 10
    assert f"{data['snr']:.1f}" in data["advice"][0]


def test_plenty_of_light_is_bound_by_the_exposure(tmp_path: Path) -> None:
    text, data = gain_report(taken(tmp_path, 4000.0, 0.0), present_gain_db=0.0)
    assert data["gain_db"] == pytest.approx(20 * np.log10(0.2 * 9000 / 4000), abs=0.2)
    assert "0.0 dB" in text and "0.45" in text


@pytest.mark.parametrize("sigma", [0.002, 0.01, 0.05])
def test_noise_is_found_under_a_gradient(sigma: float) -> None:
    rng = np.random.default_rng(5)
    slope = np.linspace(0.2, 0.6, SIZE[1])[None, :, None] * np.ones((SIZE[0], 1, 1))
    noisy = (slope + sigma * rng.standard_normal(slope.shape)).astype(np.float32)
    assert noise_sigma(noisy) == pytest.approx(sigma, rel=0.15)


def test_depths_and_curves_of_pictures_agree(tmp_path: Path) -> None:
    share = np.tile(np.linspace(0, 1, SIZE[1]), (SIZE[0], 1))
    cv2.imwrite(str(tmp_path / "a8.png"), np.round(share * 255).astype(np.uint8))
    cv2.imwrite(str(tmp_path / "b16.png"), np.round(share * 65535).astype(np.uint16))
    cv2.imwrite(str(tmp_path / "c12.png"), np.round(share * 4095).astype(np.uint16))
    for file in picture_files(tmp_path):
        read = read_linear(file, linear=True)
        assert read is not None
        np.testing.assert_allclose(read[..., 0], share, atol=0.6 / 255)
    curved = read_linear(tmp_path / "b16.png", linear=False)
    assert curved is not None
    np.testing.assert_allclose(curved[0, -1, 0], 1.0)
    middle = SIZE[1] // 2
    assert curved[0, middle, 0] == pytest.approx(
        ((share[0, middle] + 0.055) / 1.055) ** 2.4, rel=1e-3
    )


def test_damaged_pictures_are_named_and_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    taken(tmp_path, 300.0, 6.0)
    (tmp_path / "junk.png").write_bytes(b"\x89PNG\r\n\x1a\n and no more")
    whole = tmp_path / "cut.jpg"
    cv2.imwrite(str(whole), np.full((*SIZE, 3), 90, np.uint8))
    whole.write_bytes(whole.read_bytes()[:-200])
    assert gain_report(tmp_path)[1]["skipped"] == 2
    errors = capsys.readouterr().err
    assert "junk.png" in errors
    assert "cut.jpg" in errors


def test_pictures_that_say_nothing_or_are_none_are_refused(tmp_path: Path) -> None:
    for pictures in (tmp_path, str(tmp_path / "*.png")):
        with pytest.raises(ImageError):
            gain_report(pictures)
    for level in (0, 255):
        cv2.imwrite(str(tmp_path / "a.png"), np.full((*SIZE, 3), level, np.uint8))
        with pytest.raises(ImageError, match="12 dB"):
            gain_report(tmp_path)
    (tmp_path / "a.png").write_bytes(b"junk")
    with pytest.raises(ImageError, match="none of 1"):
        gain_report(tmp_path)
