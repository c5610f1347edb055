"""Pictures of a bent board: what a calibration that takes it as flat gets wrong."""

import json
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.executor import SERIAL
from alice_survey.core.frames import Array
from camera_calib.calibrate.from_pictures import calibrate_pictures
from camera_calib.calibrate.options import CalibrateOptions
from camera_calib.camera import Camera
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.rig import read_rig
from camera_calib.target_shape import BOW_X
from camera_calib.targets.target import parse_target
from tests.oracles_targets import light_through, to_srgb

TARGET = parse_target("chessboard 9x6 25mm")
BOW_M = 0.25e-3
NOISE, VIEWS = 0.02, 24
LENS = OpenCVLens(fx_px=812.0, fy_px=811.0, cx_px=322.0, cy_px=238.0, k1=-0.12, k2=0.08)
CAMERA = Camera(width_px=640, height_px=480, lens=LENS)


def depth_m(x_m: Array) -> Array:
    """Of the board, bent on a parabola over its width: 0 at its outer corners."""
    half_m = 0.5 * float(np.ptp(TARGET.points[:, 0]))
    return BOW_M * (1.0 - ((x_m - half_m) / half_m) ** 2)


def shoot(folder: Path) -> None:
    """Pictures of the board, tilted, near and far, all of it in the frame."""
    rng, taken = np.random.default_rng(2), 0
    folder.mkdir()
    while taken < VIEWS:
        turn = Rotation.from_euler("xyz", rng.uniform(-40, 40, 3), degrees=True)
        place = CAMERA.at_depth(rng.uniform([150, 120], [490, 360]), rng.uniform(0.32, 0.7))
        pose = RigidTransform.from_components(place - turn.apply(TARGET.points.mean(axis=0)), turn)
        pixels = CAMERA.project(pose.apply(TARGET.points))
        if np.all((pixels > 15) & (pixels < [625, 465])):
            light = light_through(TARGET, CAMERA, pose.inv(), 8, depth_m)
            picture = to_srgb(light + rng.normal(0.0, NOISE, light.shape))
            cv2.imwrite(str(folder / f"{taken:02d}.png"), picture)
            taken += 1


@pytest.mark.slow
def test_a_board_taken_as_flat_gives_another_focal_length(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The table in docs/cameras.md; both calibrations are of the same pictures."""
    dot = cv2.imencode(".png", np.zeros((1, 1), np.uint8))[1].tobytes()
    monkeypatch.setattr("camera_calib.judge.report.png_of", lambda _: dot)  # plots take seconds
    shoot(tmp_path / "pictures")
    off, sigma, rms_px = {}, {}, {}
    kinds: tuple[Literal["flat", "sheet"], ...] = ("flat", "sheet")
    for kind in kinds:
        options = CalibrateOptions(
            cameras=(f"camera={tmp_path / 'pictures'}",), target=TARGET.description,
            target_shape=kind,
            lens="opencv4", output=tmp_path / kind,
        )  # fmt: skip
        _, found = calibrate_pictures(options, executor=SERIAL)
        rig = read_rig(tmp_path / kind / "rig.json")
        off[kind] = rig.cameras["camera"].fx_px - LENS.fx_px
        sigma[kind], rms_px[kind] = rig.sigmas["camera.fx_px"], found["rms_px"]
        if kind == "sheet":
            bow = found["target_shape"][BOW_X]
            assert bow["value"] == pytest.approx(BOW_M, abs=4 * bow["sigma"])
            assert bow["sigma"] < 0.1 * BOW_M
        else:
            assert found["target_shape"] == {}
            verdicts = json.loads((tmp_path / kind / "report.json").read_text())["verdicts"]
            assert any("target" in v["text"] and v["level"] != "good" for v in verdicts)
    assert abs(off["flat"]) > 3.0 * sigma["sheet"]
    assert abs(off["sheet"]) < 3.0 * sigma["sheet"]
    assert 0.005 < rms_px["sheet"] < 0.7 * rms_px["flat"]
