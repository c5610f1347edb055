"""The table, JSON and plot of the price of approximations."""

import json
from pathlib import Path

import numpy as np
import pytest

from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.errors import AliceError
from camera_calib.approximation.report import draw_residuals, residual_report
from camera_calib.approximation.residual import COLMAP_PARAMETERS, approximations
from camera_calib.rig import design_rig, write_rig


def test_report_holds_every_approximation(tmp_path: Path) -> None:
    plot = tmp_path / "plot.png"
    text, data = residual_report(1.5, 2.5, plot=plot)

    assert plot.is_file()
    assert json.loads(json.dumps(data)) == data
    assert [one["model"] for one in data["approximations"]] == [
        "PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "OPENCV", "FULL_OPENCV",
    ]  # fmt: skip
    for one in data["approximations"]:
        assert f"{one['rms_px']:.3f} px" in text
        assert tuple(one["params"]) == COLMAP_PARAMETERS[one["model"]]
        spread = np.array(one["map_px"])
        assert spread.shape == (len(one["map_y_px"]), len(one["map_x_px"]))
        assert 0.3 * one["rms_px"] < spread.mean() < 3 * one["rms_px"]
        assert max(one["max_by_distance_px"]) == pytest.approx(one["max_px"])


def test_a_rig_and_a_survey_of_the_same_design_agree(tmp_path: Path) -> None:
    (tmp_path / "survey.toml").write_text("[camera]\nport_distance_m = 0.05\n")
    design = design_rig(CameraConfig(port_distance_m=0.05), WaterConfig())
    write_rig(tmp_path / "rig.json", design)

    of_survey = residual_report(1.0, 3.0, survey=tmp_path / "survey.toml")[1]
    of_rig = residual_report(1.0, 3.0, rig=tmp_path / "rig.json", camera="right")[1]

    assert of_rig["camera"] == "right"
    assert of_rig["approximations"] == of_survey["approximations"]
    assert of_rig["approximations"][0]["rms_px"] > 1.0


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_the_plot_depends_on_the_numbers_only(tmp_path: Path, suffix: str) -> None:
    camera = design_rig(CameraConfig(), WaterConfig()).cameras["left"]
    found = approximations(camera, 1.5, 2.5, distances_m=(1.5, 2.0, 2.5))[:2]
    paths = [tmp_path / "deep" / f"{name}{suffix}" for name in ("a", "b")]
    for path in paths:
        draw_residuals(camera, found, "two pinholes", path)

    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_each_fault_is_one_line(tmp_path: Path) -> None:
    rig = tmp_path / "rig.json"
    write_rig(rig, design_rig(CameraConfig(), WaterConfig()))
    (tmp_path / "survey.toml").write_text("")
    for options in (
        {"camera": "top"},
        {"rig": rig, "camera": "top"},
        {"rig": rig, "survey": tmp_path / "survey.toml"},
        {"rig": tmp_path / "none.json"},
        {"plot": tmp_path / "plot.bmp"},
    ):
        with pytest.raises(AliceError) as error:
            residual_report(1.5, 2.5, **options)
        assert "\n" not in str(error.value)
