"""Kalibr's camchain: the keys and conventions of its wiki, read back apart from our reader."""

import tempfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from scipy.spatial.transform import RigidTransform, Rotation

from camera_calib.formats.convert import detect
from camera_calib.formats.rigs import ReadOptions
from camera_calib.formats.robots import read_kalibr, write_kalibr
from camera_calib.rig import Rig
from tests import strategies_formats

EXAMPLE = (strategies_formats.DATA / "camchain.yaml").read_text()


fault = partial(strategies_formats.fault_of, read_kalibr)


@settings(max_examples=50, deadline=None)
@given(
    rig=strategies_formats.rigs(
        strategies_formats.RADTAN, lenses=strategies_formats.BOTH_LENSES, maximum=3
    )
)
def test_opencv_projects_as_we_do_from_the_chain(rig: Rig) -> None:
    """Kalibr's radtan and equidistant are OpenCV's first four terms and its fisheye."""
    with tempfile.TemporaryDirectory() as folder:
        write_kalibr(Path(folder) / "camchain.yaml", rig)
        chain = yaml.safe_load((Path(folder) / "camchain.yaml").read_text())

    assert list(chain) == [f"cam{i}" for i in range(len(rig.cameras))]
    cam_from_rig = np.eye(4)
    for i, ((name, camera), entry) in enumerate(
        zip(rig.cameras.items(), chain.values(), strict=True)
    ):
        is_fisheye = camera.lens.model == "fisheye"
        model = "equidistant" if is_fisheye else "radtan"
        assert (entry["camera_model"], entry["distortion_model"]) == ("pinhole", model)
        assert entry["resolution"] == [camera.width_px, camera.height_px]
        assert entry["cam_overlaps"] == [other for other in range(len(chain)) if other != i]
        assert ("T_cn_cnm1" in entry) == (i > 0)
        cam_from_rig = np.array(entry.get("T_cn_cnm1", np.eye(4))) @ cam_from_rig
        fx, fy, cx, cy = entry["intrinsics"]
        seen = strategies_formats.opencv_pixels(
            strategies_formats.POINTS_RIG,
            Rotation.from_matrix(cam_from_rig[:3, :3]).as_rotvec(),
            cam_from_rig[:3, 3],
            np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
            np.pad(entry["distortion_coeffs"], (0, 0 if is_fisheye else 1)),
        )
        ours = camera.project(rig.cam_from_rig[name].apply(strategies_formats.POINTS_RIG))
        strategies_formats.assert_same_pixels(ours, seen + 0.5)


def test_an_example_like_that_of_the_wiki_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "camchain.yaml"
    path.write_text(EXAMPLE)
    assert detect(path).name == "kalibr"
    rig = read_kalibr(path, ReadOptions())

    assert list(rig.cameras) == ["cam0", "stereo_cam1", "cam2"]
    first = rig.cameras["cam0"]
    assert (first.fx_px, first.fy_px) == (461.629, 460.152)
    assert (first.cx_px, first.cy_px) == pytest.approx((363.18, 246.549), abs=1e-12)
    assert (first.width_px, first.height_px, first.n_water) == (752, 480, 1.0)
    # 1e-05, without a dot, is text to a YAML 1.1 parser
    lens = first.lens
    found = [lens.parameter(name) for name in ("k1", "k2", "p1", "p2")]
    assert found == [-0.27695497, 0.06712482, 8.7538e-4, 1e-05]
    assert rig.cameras["cam2"].parameter("k1") == 0.0
    # The chain: cam1 at (0, -0.1, 0) of cam0, cam2 at (0, 0.5, 0) of cam1, whose y is cam0's x.
    centre = rig.cam_from_rig["stereo_cam1"].inv().translation
    np.testing.assert_allclose(centre, [0.0, -0.1, 0.0], atol=1e-15)
    centre = rig.cam_from_rig["cam2"].inv().translation
    np.testing.assert_allclose(centre, [0.5, -0.1, 0.0], atol=1e-15)
    assert "cam0.T_cam_imu, cam0.timeshift_cam_imu" in capsys.readouterr().err


def test_rounded_rotations_are_made_rotations(tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    path.write_text(EXAMPLE.replace("[1.0, 0.0, 0.0, 0.0]", "[0.9999, 0.0, 0.0, 0.0]"))
    pose = read_kalibr(path, ReadOptions()).cam_from_rig["cam2"]
    assert isinstance(pose, RigidTransform)
    np.testing.assert_allclose(np.linalg.det(pose.rotation.as_matrix()), 1.0, atol=1e-14)


def test_faults_name_file_and_key(tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    deep = f"[{', '.join(['[' * 70 + '1, 2' + ']' * 70] * 4)}]"  # numpy has at most 64 dimensions
    for old, new, named in (
        ("distortion_model: none", "distortion_model: fov", "cam1.distortion_model"),
        ("distortion_model: none", "distortion_model: equidistant", "cam1.distortion_coeffs"),
        ("pinhole", "spherical", "cam0.camera_model"),
        ("pinhole", "omni", "cam0.intrinsics"),
        (", 1e-05]", "]", "cam0.distortion_coeffs"),
        ("461.629", "fast", "cam0.intrinsics"),
        ("461.629", "-461.629", "cam0.intrinsics"),
        ("[461.629, 460.152, 362.680, 246.049]", deep, "cam0.intrinsics"),
        ("[752, 480]", "[752]", "cam0.resolution"),
        ("[752, 480]", "[752.5, 480]", "cam0.resolution.0"),
        ("T_cn_cnm1", "T_c1_c0", "cam1.T_cn_cnm1"),
        ("[0.0, -1.0", "[0.0, 1.0", "cam1.T_cn_cnm1"),
        ("1.0]\n  rostopic: /s", "2.0]\n  rostopic: /s", "0 0 0 1"),
        ("cam1:", "cam7:", "cam0"),
        ("/stereo/cam1/", "/cam0/", ""),
        (EXAMPLE, "a: 1\n", "cam0"),
        (EXAMPLE, "- 1\n", "mapping"),
        (EXAMPLE, "cam0:\n  a: [1\n", "line 3"),
        (EXAMPLE, "a: 1\na: 2\n", "a twice"),
        (EXAMPLE, "a: &x [1]\nb: *x\n", "alias"),
    ):
        assert named in fault(path, EXAMPLE.replace(old, new, 1))


def test_yaml_constructs_nothing(tmp_path: Path) -> None:
    made = tmp_path / "made"
    fault(tmp_path / "a.yaml", f"cam0: !!python/object/apply:pathlib.Path.touch\n- {made}\n")
    assert not made.exists()
