import csv
import io
from pathlib import Path

import pytest

from alice_survey.base.config import CameraConfig
from alice_survey.base.errors import ConfigError
from camera_calib.fov.angles import angle_table
from camera_calib.fov.paper import PaperValidation, validate_paper
from camera_calib.fov.plot import draw_fov
from camera_calib.fov.table import FovChoices, blur_table, fov_table
from camera_calib.fov.text import (
    TextTable,
    as_csv,
    as_markdown,
    as_text,
    fov_csv_rows,
    fov_tables,
    validation_csv_rows,
    validation_tables,
)

PORT = CameraConfig()
NO_PORT = CameraConfig(port_distance_m=0.0, glass_thickness_m=0.0)


@pytest.fixture(scope="module")
def validation() -> PaperValidation:
    return validate_paper()


def test_text_holds_every_value_and_marks_wide_lenses() -> None:
    rows = fov_table([12.5, 25.0], [2.0], 1.33, NO_PORT)
    text = as_text(fov_tables(rows, blur_table(rows, [0.5], [3e-3], 1.0)))
    for value in (
        "1.427 x 1.163 m", "0.741 x 0.596 m", "0.444", "65.2", "1.504 m", "1.753 m to 2.328 m",
        "3.38 px", "0.888 ms", "2.66 mm",
    ):  # fmt: skip
        assert value in text
    assert "(!)" not in text
    assert "(!)" in as_text(fov_tables(fov_table([8.0], [2.0], 1.34, PORT)))
    assert fov_tables([]) == []


def test_what_does_not_exist_is_said_in_words() -> None:
    nowhere = as_text(fov_tables(fov_table([12.5], [1.0], 1.34, PORT)))
    assert "nowhere" in nowhere
    endless = as_text(fov_tables(fov_table([12.5], [9.0], 1.34, PORT, FovChoices(coc_px=3.0))))
    assert "to infinity" in endless
    assert "unlimited" in endless
    apart = as_text(fov_tables(fov_table([50.0], [0.2], 1.34, PORT)))
    assert "0.0%    -" in apart
    for text in (nowhere, endless, apart):
        assert "nan" not in text
        assert "inf " not in text


def test_markdown_is_a_table_with_bars_escaped() -> None:
    table = TextTable(title="T", header=("a", "b"), cells=(("1|2", "3"),), notes=("note",))
    assert as_markdown([table]).splitlines() == [
        "### T", "", "| a | b |", "| --- | --- |", "| 1\\|2 | 3 |", "", "note",
    ]  # fmt: skip


def test_csv_has_each_lens_altitude_speed_and_exposure_once() -> None:
    rows = fov_table([12.5, 25.0], [1.0, 2.0], 1.34, PORT)
    blur = blur_table(rows, [0.2, 0.5], [1e-3], 1.0)
    read = list(csv.DictReader(io.StringIO(as_csv(fov_csv_rows(rows, blur)))))
    keys = [(float(r["lens_mm"]), float(r["altitude_m"]), float(r["speed_mps"])) for r in read]
    assert keys == [(f, a, v) for f in (12.5, 25.0) for a in (1.0, 2.0) for v in (0.2, 0.5)]
    for line in read:
        way_mm = float(line["speed_mps"]) * 1.0
        assert float(line["blur_px"]) == pytest.approx(way_mm / float(line["pixel_centre_mm"]))
    assert read[0]["frame_near_altitude_m"] == ""  # nowhere sharp
    assert as_csv([]) == "\n"


def test_the_validation_says_pass_or_fail_and_why(validation: PaperValidation) -> None:
    text = as_text(validation_tables(validation))
    assert text.count("pass") >= 6 + 7
    assert "FAIL " not in text
    assert "n 1.33" in text and "n 1.34" in text
    rows = validation_csv_rows(validation)
    assert len(rows) == 6 + len(validation.claims)
    assert {row["verdict"] for row in rows} == {"pass"}
    markdown = as_markdown(validation_tables(validation))
    assert markdown.count("### ") == 3
    widths = {line.count(" | ") for line in markdown.splitlines() if line.startswith("| 40 deg")}
    assert widths == {9}


def draw(path: Path, *, paper: bool) -> str:
    draw_fov(
        path,
        lambda altitudes, asked: fov_table([12.5, 16.0], altitudes, 1.34, PORT, asked),
        [2.0],
        FovChoices(),
        speeds_mps=[0.2],
        exposures_s=[3e-3],
        allowed_px=1.0,
        angles=angle_table(PORT, 1.34, angles_deg=[40.0, 70.0, 100.0]),
        paper=paper,
    )
    return path.read_text() if path.suffix == ".svg" else ""


def test_a_plot_names_its_curves_and_is_the_same_each_time(tmp_path: Path) -> None:
    svg = draw(tmp_path / "a.svg", paper=True)
    for words in ("12.5 mm wide", "16 mm high", "paper<", "0.2 m/s", "best pinhole, rms", "F/4"):
        assert words in svg
    assert draw(tmp_path / "b.svg", paper=True) == svg
    assert "paper<" not in draw(tmp_path / "c.svg", paper=False)


@pytest.mark.parametrize(("suffix", "magic"), [("png", b"\x89PNG"), ("pdf", b"%PDF")])
def test_plots_are_written_by_suffix_without_dates(
    tmp_path: Path, suffix: str, magic: bytes
) -> None:
    draw(tmp_path / f"a.{suffix}", paper=True)
    draw(tmp_path / f"b.{suffix}", paper=True)
    data = (tmp_path / f"a.{suffix}").read_bytes()
    assert data.startswith(magic)
    assert data == (tmp_path / f"b.{suffix}").read_bytes()
    assert b"CreationDate" not in data


def test_plots_that_cannot_be_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"\.png, \.svg, \.pdf"):
        draw(tmp_path / "a.bmp", paper=True)
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="cannot be written"):
        draw(tmp_path / "file" / "a.png", paper=True)
