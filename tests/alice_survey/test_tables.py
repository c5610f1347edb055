"""The `fov` command: options, files and faults."""

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from alice_survey.app.cli.main import app
from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.errors import AliceError, ConfigError
from camera_calib.fov.display import FovOptions, fov_report
from camera_calib.rig import design_rig, write_rig
from tests.refusals import refused


def rows(**options: Any) -> list[dict[str, float]]:
    return fov_report(FovOptions(**options))[1]["rows"]


def test_options_reach_the_rows() -> None:
    row = rows(lens_mm=[16.0], altitude_m=[1.5], n_water=1.345)[0]
    expected = {"lens_mm": 16.0, "altitude_m": 1.5, "n_water": 1.345}
    assert {key: row[key] for key in expected} == pytest.approx(expected)


def test_a_survey_s_settings_are_taken_unless_said_otherwise(tmp_path: Path) -> None:
    survey = tmp_path / "survey.toml"
    survey.write_text(
        "[camera]\nfocal_mm = 16.0\nport_distance_m = 0.05\n[water]\nn_water = 1.337\n"
        "[plan]\naltitude_m = 1.7\nspeed_mps = 0.3\nallowed_blur_px = 0.5\n"
    )
    _, data = fov_report(FovOptions(survey=survey))
    [row] = data["rows"]
    assert (row["lens_mm"], row["altitude_m"], row["n_water"]) == (16.0, 1.7, 1.337)
    assert row["port"] == "port 50 mm + glass 10 mm"
    [blur] = data["blur"]
    assert (blur["speed_mps"], blur["allowed_px"]) == (0.3, 0.5)
    other = rows(survey=survey, lens_mm=[8.0], n_water=1.35)[0]
    assert (other["lens_mm"], other["n_water"]) == (8.0, 1.35)


def test_a_rig_brings_lens_and_port_and_may_change_its_water(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "rig.json"
    write_rig(path, design_rig(CameraConfig(), WaterConfig(n_water=1.333)))
    row = rows(rig=path)[0]
    assert row["n_water"] == 1.333
    assert rows(rig=path, n_water=1.345)[0]["n_water"] == 1.345
    assert not capsys.readouterr().err

    write_rig(path, design_rig(CameraConfig(), WaterConfig(n_water=1.333), scale=4))
    quarter = rows(rig=path)[0]
    assert "846 px" in capsys.readouterr().err
    assert quarter["horizontal_m"] == pytest.approx(row["horizontal_m"], rel=2e-3)
    # The same sensor: the lens, and with it the blur circle in micrometres, is the same.
    assert quarter["lens_mm"] == pytest.approx(row["lens_mm"])
    assert quarter["corner_blur_px"] == pytest.approx(row["corner_blur_px"] / 4, rel=0.02)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"n_water": 2.0}, "n_water"),
        ({"rig": Path("rig.json"), "lens_mm": [12.5]}, "--lens"),
        ({"rig": Path("nowhere.json")}, "nowhere.json"),
        ({"lens_mm": [500.0], "altitude_m": [0.2]}, "500 mm"),
    ],
)
def test_faults_are_one_line(options: dict[str, object], named: str) -> None:
    with refused(AliceError, named):
        fov_report(FovOptions(**options))  # type: ignore[arg-type]


def test_files_are_written_or_refused(tmp_path: Path) -> None:
    fov_report(FovOptions(csv=tmp_path / "a.csv", plot=tmp_path / "a.png"))
    assert len((tmp_path / "a.csv").read_text().splitlines()) == 3
    assert (tmp_path / "a.png").stat().st_size > 50_000
    with pytest.raises(ConfigError):
        fov_report(FovOptions(csv=tmp_path / "a.png" / "a.csv"))


def test_a_failed_check_exits_with_3(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("camera_calib.fov.paper.PAPER_TABLE", ((12.5, "vertical", "m", "1.30"),))
    shown = CliRunner().invoke(app, ["fov", "--validate"])
    assert shown.exit_code == 3
