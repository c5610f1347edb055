"""JPEG files that end too early."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from camera_calib.picture_files import is_cut_short


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
