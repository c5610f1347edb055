import math
from pathlib import Path

import pytest

from alice_survey.core.config import CameraConfig
from alice_survey.core.errors import ConfigError
from camera_calib.fov.display import draw_fov, fov_csv_rows, fov_text
from camera_calib.fov.table import blur_table, fov_table

PORT = CameraConfig()


@pytest.mark.parametrize(
    ("lens_mm", "altitude_m", "coc_px"), [(12.5, 1.0, 1.0), (12.5, 9.0, 3.0), (50.0, 0.2, 1.0)]
)
def test_what_does_not_exist_is_neither_nan_nor_inf(
    lens_mm: float, altitude_m: float, coc_px: float
) -> None:
    """A frame that is nowhere sharp, one that is sharp to infinity, and no stereo."""
    rows = fov_table([lens_mm], [altitude_m], 1.34, PORT, coc_px)
    text = fov_text(rows, blur_table(rows, [0.5], [3e-3], 1.0))
    assert f"{rows[0].pixel_centre_mm:.3f}" in text
    assert "nan" not in text and "inf " not in text
    assert ("unlimited" in text) == math.isinf(rows[0].far_altitude_m)


def test_csv_has_each_lens_altitude_speed_and_exposure_once() -> None:
    rows = fov_table([12.5, 25.0], [1.0, 2.0], 1.34, PORT)
    read = fov_csv_rows(rows, blur_table(rows, [0.2, 0.5], [1e-3], 1.0))
    keys = [(r["lens_mm"], r["altitude_m"], r["speed_mps"]) for r in read]
    assert keys == [(f, a, v) for f in (12.5, 25.0) for a in (1.0, 2.0) for v in (0.2, 0.5)]
    for line in read:
        assert line["blur_px"] == pytest.approx(line["speed_mps"] / line["pixel_centre_mm"])
    assert read[0]["frame_near_altitude_m"] is None  # nowhere sharp


def draw(path: Path) -> bytes:
    draw_fov(path, lambda altitudes: fov_table([12.5, 16.0], altitudes, 1.34, PORT), [2.0])
    return path.read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["svg", "png", "pdf"])
def test_plots_are_the_same_each_time(tmp_path: Path, suffix: str) -> None:
    first, again = (draw(tmp_path / f"{name}.{suffix}") for name in "ab")
    assert first == again
    assert b"CreationDate" not in first


def test_plots_that_cannot_be_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for path in (tmp_path / "a.bmp", tmp_path / "file" / "a.png"):
        with pytest.raises(ConfigError):
            draw(path)
