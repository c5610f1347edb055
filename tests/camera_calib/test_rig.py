import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.errors import AliceError, CalibrationError
from camera_calib.rig import Covariance, Rig, design_rig, read_rig, write_rig
from tests.cameras import changed

CONFIG = CameraConfig(position_body_m=(0.5, -0.06, 0.09))
COVARIANCE = np.array([[0.09, 0.001], [0.001, 0.0001]])


@pytest.fixture
def rig() -> Rig:
    return design_rig(CONFIG, WaterConfig())


def calibrated(rig: Rig) -> Rig:
    """A rig as a calibration leaves it: nothing is nominal."""
    rng = np.random.default_rng(3)
    right = RigidTransform.from_components(
        [-0.1003, 0.0004, -0.0002], Rotation.from_rotvec(rng.normal(0, 0.01, 3))
    )
    left = changed(rig.cameras["left"], k1=-0.05, p1=1e-4, normal=(0.01, 0.0, (1 - 1e-4) ** 0.5))
    return replace(
        rig,
        cameras={"left": left, "right": rig.cameras["right"]},
        cam_from_rig={"left": RigidTransform.identity(), "right": right},
        covariance=Covariance(parameters=("left.fx_px", "left.k1"), matrix=COVARIANCE),
        source="a test",
    )


def test_the_design_has_glass_and_cameras_where_the_settings_say(rig: Rig) -> None:
    glass = rig.body_from_cam("left").apply([0.0, 0.0, 0.02 + 0.01])
    np.testing.assert_allclose(glass, [0.5, -0.06, 0.09], atol=1e-12)
    apart = rig.body_from_cam("right").translation - rig.body_from_cam("left").translation
    np.testing.assert_allclose(apart, [0.0, 0.1, 0.0], atol=1e-12)
    assert rig.baseline_m == pytest.approx(0.1)
    assert rig.reference == "left"
    for name in ("left", "right"):  # they look down with the image's top to the bow
        turn = rig.body_from_cam(name).rotation.as_matrix()
        np.testing.assert_allclose(turn, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    camera = rig.cameras["left"]
    assert camera.fx_px == pytest.approx(12.5 / 3.69e-3)
    assert (camera.cx_px, camera.cy_px) == (1692.0, 1355.0)
    assert camera.n_water == 1.34
    small = design_rig(CONFIG, WaterConfig(), scale=4)
    point = np.array([0.3, -0.2, 2.0])
    for name in rig.cameras:
        np.testing.assert_allclose(
            small.cameras[name].project(point) * 4, rig.cameras[name].project(point), atol=1e-9
        )
    assert small.baseline_m == rig.baseline_m


def test_a_rig_in_other_water_forgets_only_how_well_the_index_was_known(rig: Rig) -> None:
    names = ("left.fx_px", "left.n_water", "left.k1", "right.n_water")
    root = np.random.default_rng(1).normal(size=(4, 4))
    found = replace(rig, covariance=Covariance(parameters=names, matrix=root @ root.T))
    sea = found.in_water(1.34)
    assert sea.covariance.parameters == ("left.fx_px", "left.k1")
    np.testing.assert_array_equal(sea.covariance.matrix, (root @ root.T)[np.ix_([0, 2], [0, 2])])


def test_a_rig_file_gives_back_what_was_written(tmp_path: Path, rig: Rig) -> None:
    before = calibrated(rig)
    write_rig(tmp_path / "rig.json", before)
    after = read_rig(tmp_path / "rig.json")

    assert after.cameras == before.cameras
    assert list(after.cameras) == ["left", "right"]
    assert after.source == "a test"
    assert after.sigmas == pytest.approx({"left.fx_px": 0.3, "left.k1": 0.01})
    np.testing.assert_array_equal(after.covariance.matrix, COVARIANCE)
    assert after.baseline_m == pytest.approx(before.baseline_m, abs=1e-15)
    for name in before.cameras:
        np.testing.assert_allclose(
            after.body_from_cam(name).as_matrix(),
            before.body_from_cam(name).as_matrix(),
            atol=1e-15,
        )


@pytest.mark.parametrize("text", [None, "{", "[1, 2]"])
def test_a_missing_or_broken_rig_file_is_named(tmp_path: Path, text: str | None) -> None:
    if text is not None:
        (tmp_path / "rig.json").write_text(text)
    with pytest.raises(AliceError, match=r"rig\.json"):
        read_rig(tmp_path / "rig.json")


def test_every_camera_needs_a_pose(rig: Rig) -> None:
    for changes in ({"cam_from_rig": {"left": RigidTransform.identity()}}, {"cameras": {}}):
        with pytest.raises(CalibrationError):
            replace(rig, **changes)


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (("cameras", "left", "fx_px"), "3387.5", "left: fx_px = '3387.5'"),
        (("cameras", "left", "fx_px"), 1e300, "1e+07 px"),
        (("cameras", "left", "width_px"), 640.5, "width_px = 640.5"),
        (("cameras", "left", "n_water"), 5, "n_water = 5: 1 to 2"),
        (("cameras", "left", "glass_thickness_m"), 6, "glass_thickness_m = 6: 0 to 0.5 m"),
        (("cameras", "left", "port_distance_m"), 20.0, "0 to 5 m"),
        (("cameras", "left", "normal"), [0.0, 0.0, 1.0, 0.0], "normal"),
        (("cameras", "right", "cam_from_rig", "translation_m"), [0, 0, float("nan")], "right"),
        (("version",), 1, "version"),
        (("covariance", "matrix"), [[0.1, 0.0], [0.0]], "covariance"),
        (("covariance", "parameters"), ["left.fx_px"], "covariance"),
        (("cameras", "left", "k9"), 0.1, "k9"),
        (("cameras",), {}, "camera"),
        (("body_from_rig",), {"quaternion_xyzw": [0, 0, 0, 1]}, "translation_m"),
        (("body_from_rig", "quaternion_xyzw"), [0, 0, 0, 0], "norm"),
    ],
)
def test_a_wrong_value_of_a_rig_file_is_named(
    place: tuple[str, ...], value: object, words: str, tmp_path: Path, rig: Rig
) -> None:
    path = tmp_path / "rig.json"
    write_rig(path, calibrated(rig))
    data = json.loads(path.read_text())
    inner = data
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    path.write_text(json.dumps(data))

    with pytest.raises(CalibrationError) as error:
        read_rig(path)

    assert str(error.value).startswith(f"{path}: ")
    assert words in str(error.value)
    assert "\n" not in str(error.value)
