"""OpenCV's own loader and projection agree with what is written, and its samples are read."""

import tempfile
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from scipy.spatial.transform import Rotation

from camera_calib.formats.opencv import read_opencv, write_opencv
from camera_calib.formats.rigs import ReadOptions
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.rig import Rig
from tests import strategies_formats

MATRIX = "!!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: "
GOOD = (
    "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\n"
    f"camera_matrix: {MATRIX}[ 530., 0., 319.5, 0., 531., 239.5, 0., 0., 1. ]\n"
)


fault = partial(strategies_formats.fault_of, read_opencv)


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("suffix", [".yml", ".xml"])
@settings(max_examples=25, deadline=None)
@given(rig=strategies_formats.rigs(lenses=strategies_formats.BOTH_LENSES))
def test_opencv_projects_as_we_do_from_what_its_loader_reads(suffix: str, rig: Rig) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"rig{suffix}"
        write_opencv(path, rig)
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        keys = ("M1", "D1", "M2", "D2", "R", "T", "camera_matrix", "distortion_coefficients")
        read = {key: storage.getNode(key).mat() for key in keys}
        sizes = [
            int(storage.getNode(key).real())
            for key in storage.root().keys()  # noqa: SIM118 - no dict
            if "image_" in key
        ]
        storage.release()

    first, *rest = rig.cameras.values()
    assert sizes[:2] == [first.width_px, first.height_px]
    zero = np.zeros(3)
    each = [("camera_matrix", "distortion_coefficients", zero, zero)]
    if rest:
        turn = Rotation.from_matrix(read["R"]).as_rotvec()
        each = [("M1", "D1", zero, zero), ("M2", "D2", turn, read["T"])]
    for (name, camera), (m, d, rvec, tvec) in zip(rig.cameras.items(), each, strict=True):
        assert (read[d].size == 4) == (camera.lens.model == "fisheye")
        seen = strategies_formats.opencv_pixels(
            strategies_formats.POINTS_RIG, rvec, tvec, read[m], read[d]
        )
        ours = camera.project(rig.cam_from_rig[name].apply(strategies_formats.POINTS_RIG))
        strategies_formats.assert_same_pixels(ours, seen + 0.5)


def test_opencvs_sample_calibration_of_one_camera_is_read(shared_data: Path) -> None:
    path = shared_data / "opencv_stereo" / "left_intrinsics.yml"
    (camera,) = read_opencv(path, ReadOptions()).cameras.values()

    assert (camera.width_px, camera.height_px) == (640, 480)
    assert camera.fx_px == camera.fy_px == 535.91573396163199
    assert camera.cx_px == pytest.approx(342.28315473308373 + 0.5, abs=1e-12)
    found = [camera.parameter(name) for name in ("k1", "k3")]
    assert found == [-0.26637260909660682, 0.23839153080878486]
    assert (camera.parameter("k4"), camera.parameter("s1"), camera.n_water) == (0.0, 0.0, 1.0)


def test_opencvs_sample_of_a_pair_asks_for_what_it_lacks(shared_data: Path, tmp_path: Path) -> None:
    path = shared_data / "opencv_stereo" / "intrinsics.yml"
    assert "--image-size" in fault(path)
    assert "--extrinsics" in fault(path, None, ReadOptions(image_size=(640, 480)))

    pose = write(
        tmp_path / "extrinsics.yml",
        f"%YAML:1.0\n---\nR: {MATRIX}[ 1., 0., 0., 0., 1., 0., 0., 0., 1. ]\n"
        "T: !!opencv-matrix\n   rows: 3\n   cols: 1\n   dt: d\n   data: [ -3.33, 0., 0. ]\n",
    )
    rig = read_opencv(
        path, ReadOptions(image_size=(640, 480), extrinsics=pose, metres_per_unit=0.025)
    )
    assert rig.baseline_m == pytest.approx(3.33 * 0.025, abs=1e-15)
    assert list(rig.cameras) == ["left", "right"]
    assert rig.cameras["right"].parameter("k1") == -0.16916358306948096
    # A list of pictures is no calibration.
    assert "camera_matrix" in fault(shared_data / "opencv_stereo" / "stereo_calib.xml")


@pytest.mark.parametrize(
    ("matrix", "k"), [("cameraMatrix", "distCoeffs"), ("Camera_Matrix", "Distortion_Coefficients")]
)
def test_other_common_keys_are_understood(tmp_path: Path, matrix: str, k: str) -> None:
    text = GOOD.replace("camera_matrix", matrix) + f"{k}: [ -0.1, 0.02, 0.001, -0.002 ]\n"
    (camera,) = read_opencv(write(tmp_path / "a.yml", text), ReadOptions()).cameras.values()
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (530, 531, 320, 240)
    found = [camera.parameter(name) for name in ("k1", "k2", "p1", "p2")]
    assert found == [-0.1, 0.02, 0.001, -0.002]


def test_four_coefficients_are_a_fisheyes_when_file_or_caller_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    four = GOOD + "distortion_coefficients: [ 0.1, 0.02, 0.003, 0.004 ]\n"
    path = write(tmp_path / "a.yml", four)
    fisheye = FisheyeLens(fx_px=530, fy_px=531, cx_px=320, cy_px=240, k1=0.1, k2=0.02, k3=0.003,
                          k4=0.004)  # fmt: skip
    assert read_opencv(path, ReadOptions(lens="fisheye")).cameras["cam0"].lens == fisheye
    assert capsys.readouterr().err == ""
    assert read_opencv(path, ReadOptions()).cameras["cam0"].lens.model == "opencv"
    assert "--lens fisheye" in capsys.readouterr().err
    for name in ("fisheye", "equidistant"):
        path = write(tmp_path / "a.yml", four + f"distortion_model: {name}\n")
        assert read_opencv(path, ReadOptions(lens="opencv")).cameras["cam0"].lens == fisheye
    assert "distortion_model" in fault(path, four + "distortion_model: fov\n")
    assert "--lens" in fault(path, four, ReadOptions(lens="fov"))
    assert "4 expected" in fault(path, GOOD + "D: [ 0., 0., 0., 0., 1. ]\n",
                                 ReadOptions(lens="fisheye"))  # fmt: skip


def test_a_tilted_sensor_is_refused_and_a_level_one_read(tmp_path: Path) -> None:
    coefficients = "distortion_coefficients: [" + ", ".join(["0.001"] * 12)
    level = write(tmp_path / "a.yml", GOOD + coefficients + ", 0., 0. ]\n")
    (camera,) = read_opencv(level, ReadOptions()).cameras.values()
    assert (camera.parameter("k6"), camera.parameter("s4")) == (0.001, 0.001)
    shown = fault(tmp_path / "b.yml", GOOD + coefficients + ", 0.01, 0. ]\n")
    assert "distortion_coefficients" in shown


def test_faults_name_file_and_key(tmp_path: Path) -> None:
    path = tmp_path / "bad.yml"
    matrix = "[ 530., 0., 319.5, 0., 531., 239.5, 0., 0., 1. ]"
    bent = f"M2: {MATRIX}{matrix}\nR: {MATRIX}[ 1., 0., 0., 0., 2., 0., 0., 0., 1. ]\n"
    for text, named in (
        (GOOD.replace("640", "6.5"), "image_width"),
        (GOOD.replace("319.5", "abc"), "camera_matrix"),
        (GOOD.replace("530., 0.", "530., 2."), "[fx 0 cx"),
        (GOOD.replace("530.", "-530."), "camera_matrix is of no camera"),
        (GOOD.replace("rows: 3", "rows: 2"), "3 x 3"),
        (GOOD.replace(", 1. ]", " ]"), "9"),
        (GOOD.replace("319.5", ".Nan"), "camera_matrix"),
        (GOOD + "distortion_coefficients: [ 1., 2. ]\n", "distortion_coefficients"),
        (GOOD.replace("camera_matrix", "M1") + bent + "T: [ 1., 0., 0. ]\n", "rotation"),
        (GOOD + "image_width: 3\n", "image_width twice"),
        ("%YAML:1.0\n---\na: 1\n", "camera_matrix"),
        ("%YAML:1.0\n---\n- 1\n- 2\n", "mapping"),
        ("%YAML:1.0\n---\na: [ 1., 2.\n", "line 4"),
        ("hello\n", "mapping"),
        ("a: 1\n---\nb: 1\n", "2"),
        ("\n", "empty"),
        (GOOD + "camera_names: [ a, b ]\n", "camera_names"),
    ):
        assert named in fault(path, text)


def test_no_entity_of_xml_is_ever_seen_by_the_parser(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def parsed(*_: object) -> None:
        raise AssertionError("the parser was called")

    monkeypatch.setattr(cv2, "FileStorage", parsed)
    bomb = '<?xml version="1.0"?>\n<!{} lol [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;">]>\n'
    for declaration in ("DOCTYPE", "doctype", " DOCTYPE", "ENTITY"):
        text = bomb.format(declaration) + "<opencv_storage><a>&b;</a></opencv_storage>\n"
        assert "DOCTYPE" in fault(tmp_path / "bomb.xml", text)
    fault(tmp_path / "deep.xml", "<a>" * 6000)
    fault(tmp_path / "deep.yml", "%YAML:1.0\n---\na: " + "[" * 6000)
    assert "1 MiB" in fault(tmp_path / "long.yml", "#" * (1 << 20) + "\n")
    (tmp_path / "wide.xml").write_bytes('<?xml version="1.0"?><!DOCTYPE a>'.encode("utf-16"))
    assert "UTF-8" in fault(tmp_path / "wide.xml")
