"""mrcal's camera models: a file that mrcal 2.2 wrote, and where mrcal projects points with it."""

import base64
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import CalibrationError
from camera_calib.camera import Camera
from camera_calib.formats.convert import detect
from camera_calib.formats.rigs import ReadOptions
from camera_calib.formats.yaml_files import read_mrcal, write_mrcal
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.rig import Rig
from tests.strategies_formats import fault_of

SAMPLE = """\
{
    'lensmodel':  'LENSMODEL_OPENCV8',

    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ 1500, 1510, 799.5, 601.2, -0.1, 0.02, 0.001, -0.002, 0.003, 0.01,
    0.002, 0.001,],

    # extrinsics are rt_fromref
    'extrinsics': [ 0.1, 0.2, 0.3, -0.4, 0.5, 0.6,],

    'imagersize': [ 1600, 1200,],


}
"""
POINTS_REF = np.array([[0.5, -0.3, 2.0], [-0.2, 0.4, 1.5], [0.9, 0.1, 3.0]])
PIXELS = np.array(
    [
        [1151.5115148283505, 743.7048677599128],
        [534.1337147375589, 1098.353701492926],
        [1256.0510349479828, 893.6728814753889],
    ]
)
"""`mrcal.project` of the points, moved to the camera by `mrcal.transform_point_rt`."""

fault = partial(fault_of, read_mrcal)


def rig_of(**lenses: OpenCVLens) -> Rig:
    poses = [RigidTransform.identity(), RigidTransform.from_translation([-0.1, 0.0, 0.0])]
    return Rig(
        cameras={name: Camera(width_px=9, height_px=8, lens=lens) for name, lens in lenses.items()},
        cam_from_rig=dict(zip(lenses, poses, strict=False)),
        body_from_rig=RigidTransform.identity(),
        source="a test",
    )


def test_points_are_seen_where_mrcal_sees_them(tmp_path: Path) -> None:
    folder = tmp_path / "rig"
    folder.mkdir()
    (folder / "b.cameramodel").write_text(SAMPLE)
    at_reference = SAMPLE.replace("0.1, 0.2, 0.3, -0.4, 0.5, 0.6", "0, 0, 0, 0, 0, 0")
    (folder / "a.cameramodel").write_text(at_reference)
    assert detect(folder).name == detect(folder / "a.cameramodel").name == "mrcal"
    rig = read_mrcal(folder, ReadOptions())
    assert list(rig.cameras) == ["a", "b"]
    seen = rig.cameras["b"].project(rig.cam_from_rig["b"].apply(POINTS_REF))
    np.testing.assert_allclose(seen, PIXELS + 0.5, atol=1e-9)


def test_what_was_measured_for_a_model_is_skipped_however_long(tmp_path: Path) -> None:
    path = tmp_path / "a.cameramodel"
    path.write_text(SAMPLE)
    plain = read_mrcal(path, ReadOptions())
    noise = base64.b85encode(np.random.default_rng(2).bytes(2_000_000))
    path.write_text(f"{SAMPLE.rstrip()[:-1]} 'optimization_inputs': {noise!r},\n\n}}\n")
    assert read_mrcal(path, ReadOptions()).cameras == plain.cameras
    assert "1 MiB" in fault(path, SAMPLE + "#" * (1 << 20))


@pytest.mark.parametrize(
    ("terms", "model"),
    [({}, "PINHOLE"), ({"p2": 1e-3}, "OPENCV4"), ({"k3": 0.1}, "OPENCV5"), ({"k6": 0.1}, "OPENCV8"),
     ({"s4": 0.1}, "OPENCV12")],
)  # fmt: skip
def test_the_smallest_model_that_holds_a_lens_is_written(
    tmp_path: Path, terms: dict[str, float], model: str
) -> None:
    rig = rig_of(left=OpenCVLens(fx_px=5, fy_px=6, cx_px=4, cy_px=3, **terms))
    (file,) = write_mrcal(tmp_path / "a.cameramodel", rig)
    assert f"'LENSMODEL_{model}'" in file.read_text()
    assert read_mrcal(file, ReadOptions()).cameras["cam0"] == rig.cameras["left"]


def test_a_rig_is_a_folder(tmp_path: Path) -> None:
    lens = OpenCVLens(fx_px=5, fy_px=6, cx_px=4, cy_px=3)
    files = write_mrcal(tmp_path / "rig", rig_of(left=lens, right=lens))
    assert [file.name for file in files] == ["left.cameramodel", "right.cameramodel"]
    with pytest.raises(CalibrationError, match="folder"):
        write_mrcal(tmp_path / "a.cameramodel", rig_of(left=lens, right=lens))


def test_faults_name_file_and_key(tmp_path: Path) -> None:
    path = tmp_path / "a.cameramodel"
    for old, new, named in (
        ("LENSMODEL_OPENCV8", "LENSMODEL_CAHVOR", "LENSMODEL_CAHVOR"),
        ("LENSMODEL_OPENCV8", "LENSMODEL_OPENCV5", "9 expected"),
        ("1500", "-1500", "intrinsics"),
        ("1500", "nan", "intrinsics"),
        ("0.6,]", "]", "extrinsics"),
        ("'imagersize'", "'size'", "imagersize"),
        ("1600, 1200", "1600.5, 1200", "imagersize"),
        ("{", "[", "YAML"),
        (SAMPLE, "__import__('os').system('true')", "mapping"),
    ):
        assert named in fault(path, SAMPLE.replace(old, new, 1))
    (tmp_path / "none").mkdir()
    fault(tmp_path / "none")
