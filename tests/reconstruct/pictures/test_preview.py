"""A preview of an import says what the import then finds."""

from datetime import timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from alice_survey.core.errors import ImageError, NavigationError
from reconstruct.pictures.importing import cameras_in, import_images, preview_import
from tests.reconstruct.pictures.dated import BEGAN, counts, navigation, take


def test_it_finds_what_the_import_finds(tmp_path: Path) -> None:
    folder = tmp_path / "dive"
    for n in range(7):
        take(folder / f"a{n}.jpg", 10 * n, model="GoPro", place=float(n))
    for n in range(3):
        take(folder / f"b{n}.jpg", 200 + n, model="Sony", px=96)
    (folder / "notes.txt").write_text("words")
    cv2.imwrite(str(folder / "a0_mask.png"), np.full((48, 64), 255, np.uint8))
    log = navigation(tmp_path / "dive.csv", 61)
    found = preview_import([folder], navigation=log)
    made = import_images(tmp_path / "w", [folder], navigation=log)
    assert counts(found) == counts(made) == {"camera": 7, "camera-2": 3}
    shown = [(c.device, c.width_px, c.height_px) for c in found.cameras.values()]
    assert shown == [("GoPro", 64, 48), ("Sony", 96, 48)]
    assert found.kinds == made.kinds and found.pictures == 10
    assert found.positions == 7
    assert found.first_utc == "2024-07-01T12:00:00+00:00"
    assert found.last_utc == "2024-07-01T12:03:22+00:00"
    assert made.positions == 7 and "7 of 10 picture times" in found.navigation
    assert len(found.warnings) == 1 and "notes.txt" in found.warnings[0]
    size_mb = sum(path.stat().st_size for path in folder.glob("*.jpg")) / 1e6
    assert found.size_mb == pytest.approx(size_mb, rel=1e-9)


def test_time_zone_and_offset_tie_a_log_as_the_import_does(tmp_path: Path) -> None:
    for n in range(3):
        take(tmp_path / "dive" / f"{n}.jpg", n)
    log = navigation(tmp_path / "dive.csv", 61, BEGAN - timedelta(hours=2))
    ties: list[dict[str, Any]] = [{}, {"clock_offset_s": -7200.0}, {"time_zone": "Europe/Oslo"}]
    for tie, inside in zip(ties, (0, 3, 3), strict=True):
        found = preview_import([tmp_path / "dive"], navigation=log, **tie)
        assert f"{inside} of 3 picture times" in found.navigation
    assert found.first_utc == "2024-07-01T10:00:00+00:00"
    with pytest.raises(NavigationError):
        preview_import([tmp_path / "dive"], time_zone="Nowhere")


def test_many_pictures_are_sampled_with_first_and_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("reconstruct.pictures.importing._MAX_HEADERS", 5)
    for n in range(23):
        take(tmp_path / f"{n}.jpg", n, model="GoPro" if n < 12 else "Sony")
    found = preview_import([tmp_path])
    assert (found.pictures, found.looked_at) == (23, 5)
    assert found.last_utc == "2024-07-01T12:00:22+00:00"
    assert sum(counts(found).values()) == pytest.approx(23, abs=1)


def test_folders_of_a_rig_are_recognised(tmp_path: Path) -> None:
    for n in range(5):
        take(tmp_path / "left" / f"{n}.jpg", n)
        take(tmp_path / "right" / f"{n}.jpg", 100 + n)
    (tmp_path / ".cache").mkdir()
    rig = cameras_in(tmp_path)
    assert rig == {"left": tmp_path / "left", "right": tmp_path / "right"}
    assert counts(preview_import(cameras=rig)) == {"left": 5, "right": 5}
    (tmp_path / "right" / "4.jpg").unlink()
    assert cameras_in(tmp_path) == {}
    take(tmp_path / "right" / "4.jpg", 9)
    take(tmp_path / "own.jpg", 0)
    assert cameras_in(tmp_path) == {}


def test_what_cannot_be_read_is_said(tmp_path: Path) -> None:
    for n in range(4):
        take(tmp_path / "dive" / f"{n}.jpg", n)
    (tmp_path / "dive" / "bad.jpg").write_bytes(b"no picture")
    found = preview_import([tmp_path / "dive"])
    assert any("bad.jpg" in line for line in found.warnings) and len(found.cameras) == 1
    (tmp_path / "empty").mkdir()
    for arguments in ([tmp_path / "empty"], [tmp_path / "none"], []):
        with pytest.raises(ImageError):
            preview_import(arguments)
