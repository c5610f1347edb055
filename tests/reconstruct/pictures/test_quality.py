"""Quality figures follow the physics they stand for, and name what is wrong."""

import csv
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from alice_survey.core.errors import ImageError
from alice_survey.core.executor import SERIAL
from alice_survey.core.manifest import ImageRecord, write_manifest
from reconstruct.pictures.quality import PictureQuality, judge, measure, quality_report

Picture = NDArray[np.uint8]


def sea_floor(seed: int, shape: tuple[int, int] = (384, 512)) -> NDArray[np.float64]:
    """Reflectance with detail of all sizes (a spectrum of 1/f), about 0.1 to 0.9."""
    rng = np.random.default_rng(seed)
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(shape[1]), np.fft.fftfreq(shape[0])))
    spectrum = np.fft.fft2(rng.normal(size=shape)) / np.maximum(frequency, 1 / shape[1])
    pattern = np.fft.ifft2(spectrum).real
    return np.clip(0.45 + 0.13 * pattern / pattern.std(), 0.02, 0.98)


def taken(light: NDArray[np.float64], noise: float = 0.006, seed: int = 0) -> Picture:
    """What a camera records of light from 0 to 1."""
    noisy = light + noise * np.random.default_rng(seed).normal(size=light.shape)
    grey = np.clip(np.rint(255 * noisy), 0, 255).astype(np.uint8)
    return cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)


def test_blur_lowers_sharpness_in_order_and_haze_does_not() -> None:
    light = sea_floor(1)
    sharp = [measure(taken(cv2.GaussianBlur(light, (0, 0), s)))["sharpness"] for s in (0.5, 1, 2)]
    assert sharp[0] > 1.5 * sharp[1] > 2 * sharp[2]
    clear, hazy = measure(taken(light)), measure(taken(0.5 + 0.3 * light))
    assert hazy["sharpness"] == pytest.approx(clear["sharpness"], rel=0.15)
    assert hazy["contrast"] < 0.6 * clear["contrast"]
    assert hazy["veil"] > clear["veil"] + 0.2


def test_motion_blur_is_found_whatever_its_direction() -> None:
    light = sea_floor(2)
    still = measure(taken(light))["sharpness"]
    for kernel in (np.eye(9) / 9, np.full((1, 9), 1 / 9), np.full((9, 1), 1 / 9)):
        assert measure(taken(cv2.filter2D(light, -1, kernel)))["sharpness"] < 0.75 * still


def test_noise_is_measured_and_does_not_pass_for_detail() -> None:
    light = cv2.GaussianBlur(sea_floor(3), (0, 0), 1.5)
    quiet, loud = measure(taken(light, 0.004)), measure(taken(light, 0.03))
    assert quiet["noise"] == pytest.approx(0.004, rel=0.25)
    assert loud["noise"] == pytest.approx(0.03, rel=0.15)
    crisp = measure(taken(sea_floor(3), 0.004))["sharpness"]
    assert loud["sharpness"] < 0.7 * crisp


def test_shares_of_clipped_pixels_are_exact() -> None:
    pixels = np.full((96, 200, 3), 120, np.uint8)
    pixels[:24] = 0
    pixels[24:36, :, 2] = 255  # one channel suffices to lose colour
    figures = measure(pixels)
    assert (figures["dark_share"], figures["bright_share"]) == (0.25, 0.125)
    assert measure(pixels.astype(np.uint16) * 257)["bright_share"] == 0.125


def test_what_is_masked_does_not_count() -> None:
    whole = taken(sea_floor(5))
    mask = np.ones(whole.shape[:2], bool)
    mask[:192] = False
    spoilt = whole.copy()
    spoilt[:150] = 255
    assert measure(spoilt, mask)["bright_share"] == 0.0
    assert measure(spoilt, mask)["contrast"] == pytest.approx(
        measure(whole, mask)["contrast"], rel=0.02
    )
    with pytest.raises(ImageError):
        measure(whole, np.zeros(whole.shape[:2], bool))


def test_an_even_survey_has_no_outliers_and_an_odd_one_out_is_named() -> None:
    rng = np.random.default_rng(6)
    odd = PictureQuality(
        image="odd.png", camera="left", station=30, sharpness=0.4, contrast=0.1, veil=0.3,
        brightness=0.5, dark_share=0.0, bright_share=0.0, noise=0.01,
    )  # fmt: skip
    even = [
        replace(odd, image=f"{i}.png", station=i, sharpness=1 + 0.01 * rng.normal())
        for i in range(30)
    ]
    assert not any(q.flagged for q in judge(even))
    assert [q.image for q in judge([*even, odd]) if q.flagged] == ["odd.png"]


def test_each_fault_is_named_and_nothing_else(tmp_path: Path) -> None:
    """Of fourteen good pictures and one of each fault, one of them cut off."""
    images = tmp_path / "images"
    (images / "left").mkdir(parents=True)
    light = {f"good{i:02d}": sea_floor(10 + i) for i in range(14)}
    faults = {
        "blurred": cv2.GaussianBlur(sea_floor(30), (0, 0), 3),
        "dark": 0.04 * sea_floor(31),
        "hazy": 0.62 + 0.15 * sea_floor(32),
        "burnt": 2.6 * sea_floor(33),
    }
    for name, picture in (light | faults).items():
        cv2.imwrite(str(images / "left" / f"{name}.png"), taken(picture, seed=len(name)))
    whole = (images / "left" / "good00.png").read_bytes()
    (images / "left" / "cut.png").write_bytes(whole[: len(whole) // 2])
    names = [*light, *faults, "cut", "missing"]
    records = [
        ImageRecord(image=f"left/{name}.png", camera="left", station=i)
        for i, name in enumerate(names)
    ]
    write_manifest(images / "manifest.csv", records)
    text, figures = quality_report(tmp_path, SERIAL)
    reasons = {Path(f["image"]).stem: " ".join(f["reasons"]) for f in figures["flagged"]}
    assert set(reasons) == {"blurred", "dark", "hazy", "burnt", "cut", "missing"}
    for name, word in (
        ("blurred", "blurred"), ("dark", "dark"), ("hazy", "hazy"), ("burnt", "overexposed"),
        ("cut", "unreadable: corrupt"), ("missing", "unreadable: no such file"),
    ):  # fmt: skip
        assert word in reasons[name]
        assert f"left/{name}.png" in text
    assert (figures["pictures"], figures["unreadable"]) == (20, 2)
    with (tmp_path / "quality" / "quality.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 20
    assert rows[-1]["sharpness"] == ""
    assert all(math.isfinite(float(row["sharpness"])) for row in rows[:18])
    sheet = cv2.imread(str(tmp_path / "quality" / "quality.png"))
    assert sheet.shape[1] > 1000
