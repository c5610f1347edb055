"""Lens profiles of action cameras are read as what they are: a start."""

import json
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from camera_calib.formats.convert import detect
from camera_calib.formats.gyroflow import read_gyroflow
from camera_calib.formats.rigs import ReadOptions
from camera_calib.freedom import Prior, intrinsics, of_cameras
from tests.strategies_formats import POINTS_RIG, fault_of

MATRIX = np.array([[2357.0, 0.0, 2676.5], [0.0, 2356.0, 2319.5], [0.0, 0.0, 1.0]])
K = np.array([0.03, 0.06, -0.04, 0.01])
PROFILE: dict[str, Any] = {
    "name": "GoPro_HERO11 Black_Wide_8by7",
    "camera_brand": "GoPro",
    "camera_model": "HERO11 Black",
    "lens_model": "Wide",
    "calib_dimension": {"w": 5312, "h": 4648},
    "orig_dimension": {"w": 5312, "h": 4648},
    "output_dimension": {"w": 5312, "h": 2988},
    "input_horizontal_stretch": 1.0,
    "digital_lens": None,
    "fisheye_params": {
        "RMS_error": 0.96,
        "camera_matrix": MATRIX.tolist(),
        "distortion_coeffs": K.tolist(),
    },
}

fault = partial(fault_of, read_gyroflow)


def test_a_profile_projects_as_opencvs_fisheye_at_any_size(tmp_path: Path) -> None:
    path = tmp_path / "gopro.json"
    path.write_text(json.dumps(PROFILE))
    assert detect(path).name == "gyroflow"
    seen, _ = cv2.fisheye.projectPoints(POINTS_RIG[:, None], np.zeros(3), np.zeros(3), MATRIX, K)
    for scale, size in ((1, None), (2, (2656, 2324))):
        rig = read_gyroflow(path, ReadOptions(image_size=size))
        (camera,) = rig.cameras.values()
        np.testing.assert_allclose(camera.project(POINTS_RIG) * scale, seen[:, 0] + 0.5, atol=1e-8)
        assert (camera.width_px * scale, camera.height_px * scale) == (5312, 4648)
    assert rig.source.startswith("start of a calibration")
    assert "GoPro HERO11 Black Wide" in rig.source


def test_a_profile_is_a_weak_prior(tmp_path: Path) -> None:
    """Another copy of the camera has its own numbers: those of the profile are not held."""
    path = tmp_path / "gopro.json"
    path.write_text(json.dumps(PROFILE))
    rig = read_gyroflow(path, ReadOptions(image_size=(2656, 2324)))
    (name,) = rig.cameras
    prior = Prior.of_rig(rig, of_cameras(rig, intrinsics("fisheye")))
    assert prior.parameters == tuple(f"{name}.{p}" for p in intrinsics("fisheye"))
    assert 0.01 < rig.sigmas[f"{name}.fx_px"] / rig.cameras[name].fx_px < 0.1
    assert 0.005 < rig.sigmas[f"{name}.cx_px"] / 2656 < 0.05
    assert rig.sigmas[f"{name}.k1"] >= 0.02


def test_a_standard_model_is_a_pinhole(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    params = PROFILE["fisheye_params"] | {"distortion_coeffs": [0.1, 0.0, 0.0, 0.0, 0.2, 0, 0, 0]}
    path.write_text(json.dumps(PROFILE | {"distortion_model": "opencv_standard",
                                          "fisheye_params": params}))  # fmt: skip
    (camera,) = read_gyroflow(path, ReadOptions()).cameras.values()
    assert camera.lens.model == "opencv"
    assert [camera.parameter(name) for name in ("k1", "k3")] == [0.1, 0.2]


def test_faults_name_file_and_key(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    for change, named in (
        ({"digital_lens": "gopro_superview"}, "digital_lens"),
        ({"input_horizontal_stretch": 1.33}, "input_horizontal_stretch"),
        ({"distortion_model": "poly3"}, "poly3"),
        ({"calib_dimension": None}, "calib_dimension"),
        ({"fisheye_params": {}}, "camera_matrix"),
    ):
        assert named in fault(path, json.dumps(PROFILE | change))
    assert "shape" in fault(path, json.dumps(PROFILE), ReadOptions(image_size=(1920, 1080)))
