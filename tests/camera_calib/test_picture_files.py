"""Picture files that end too early, or state more than they hold."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from camera_calib.picture_files import (
    MAX_PIXELS,
    MAX_PIXELS_JPEG,
    is_cut_short,
    pixels_too_many,
    read_pixels,
)
from tests.fuzz.cameras import png_of


@pytest.mark.parametrize("progressive", [False, True])
def test_a_jpeg_cut_anywhere_in_its_scans_is_noticed(progressive: bool, tmp_path: Path) -> None:
    noise = np.random.default_rng(2).integers(0, 255, (64, 96, 3), dtype=np.uint8)
    path = tmp_path / "a.JPG"
    Image.fromarray(noise).save(path, "JPEG", progressive=progressive)
    whole = path.read_bytes()
    assert not is_cut_short(path)
    for end in (len(whole) // 2, len(whole) * 9 // 10, len(whole) - 2):
        path.write_bytes(whole[:end])
        assert is_cut_short(path)
    path.write_bytes(whole + b"padding of a camera")
    assert not is_cut_short(path)


def test_other_files_are_left_to_their_decoders(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"no picture")
    Image.new("L", (8, 8)).save(tmp_path / "b.png")
    for name in ("a.jpg", "b.png", "missing.jpg"):
        assert not is_cut_short(tmp_path / name)


def test_pictures_are_not_decoded_to_more_than_a_bound(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    for side, maximum in ((10_000, 0), (12_000, MAX_PIXELS), (50_000, MAX_PIXELS_JPEG)):
        path.write_bytes(png_of(side, side))
        assert pixels_too_many(path) == maximum
        assert read_pixels(path, cv2.IMREAD_COLOR) is None


def test_pictures_are_read_as_opencv_reads_them(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    pixels = np.random.default_rng(1).integers(0, 65535, (5, 7, 3)).astype(np.uint16)
    cv2.imwrite(str(path), pixels)
    read = read_pixels(path, cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(read, pixels)
    assert pixels_too_many(path) == 0
    for name in ("missing.png", "text.png"):
        (tmp_path / "text.png").write_text("no picture")
        assert pixels_too_many(tmp_path / name) == 0
        assert read_pixels(tmp_path / name, cv2.IMREAD_UNCHANGED) is None
