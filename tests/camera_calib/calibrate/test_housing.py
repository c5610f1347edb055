"""Housings told apart: by focal lengths in water and in air, and by what each leaves."""

from dataclasses import replace
from functools import cache

import pytest

from alice_survey.core.errors import CalibrationError
from camera_calib.calibrate.detect_views import Detections
from camera_calib.calibrate.from_pictures import calibrate_task
from camera_calib.calibrate.options import CalibrateOptions, task_of
from camera_calib.calibrate.results import calibration_text
from camera_calib.calibrate.solve import calibrate_in_air
from camera_calib.calibration import Calibration
from camera_calib.judge.judgement import judge, verdicts
from camera_calib.ports.dome import DomePort
from camera_calib.ports.flat import FlatPort
from camera_calib.ports.values import PortValues
from camera_calib.rig import Rig
from camera_calib.targets.target import parse_target
from tests.camera_calib.calibration_scenes import BOARD, built_rig, in_air, scene

TRUTH = built_rig()
TARGET = parse_target("chessboard 11x8 30mm")
SIZES = {name: (camera.width_px, camera.height_px) for name, camera in TRUTH.cameras.items()}
NOISE_PX = 0.1

FLAT = FlatPort(port_distance_m=0.025, glass_thickness_m=0.006, n_glass=1.49)
CENTRED = DomePort(outer_radius_m=0.08, glass_thickness_m=0.006)
OFF = replace(CENTRED, dome_x_m=0.002, dome_z_m=0.006)


@cache
def dry() -> Rig:
    return calibrate_in_air(scene(in_air(TRUTH), 12, seed=4), BOARD, SIZES).rig


def through(port: PortValues) -> Detections:
    wet = replace(TRUTH, cameras={n: replace(c, port=port) for n, c in TRUTH.cameras.items()})
    return Detections(views=tuple(scene(wet, 10, seed=5)), sizes=SIZES, rejections=())


def calibrated(options: CalibrateOptions, found: Detections) -> Calibration:
    places = dict.fromkeys(SIZES, "pictures")
    return calibrate_task(task_of(options, places, TARGET, dry()), found)


@pytest.mark.parametrize(
    ("port", "kind", "ratio"), [(FLAT, "flat", 1.34), (CENTRED, "none", 1.0), (OFF, "dome", 0.98)]
)
def test_the_housing_is_found(port: PortValues, kind: str, ratio: float) -> None:
    found = calibrated(CalibrateOptions(water=True, port="auto", glass_mm="6"), through(port))
    assert {camera.port.shape for camera in found.rig.cameras.values()} == {kind}
    for value in found.focal_ratios.values():
        assert value == pytest.approx(ratio, abs=0.01)
    assert 0.8 * NOISE_PX < found.noise_px < 1.2 * NOISE_PX
    said = verdicts(judge(found, None))
    if kind == "dome":
        assert [v.level for v in said if "from its prior" in v.text] == ["good"]
        for camera in found.rig.cameras.values():
            for name in ("dome_x_m", "dome_z_m"):
                assert camera.parameter(name) == pytest.approx(getattr(port, name), abs=3e-4)
    text = calibration_text(found, parse_target("chessboard 9x6 25mm"), [])
    assert ("same camera" in text) == (kind == "none")
    fixed = [line for line in text.splitlines() if line.split()[1:3] == ["6", "(fixed)"]]
    assert len(fixed) == (0 if kind == "none" else len(TRUTH.cameras))
    assert not [v for v in said if v.level == "bad" and "focal lengths" in v.text]


BARE = CalibrateOptions(water=True, port="none")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "port", "named"),
    [
        (CalibrateOptions(water=True, glass_mm="6"), CENTRED, "--port dome"),
        (BARE, FLAT, "--port flat"),
        (BARE, OFF, "from its prior"),
    ],
)
def test_another_housing_is_bad(options: CalibrateOptions, port: PortValues, named: str) -> None:
    """A dome taken for a flat port, a flat port for a dome, and a dome off its centre for none."""
    try:
        found = calibrated(options, through(port))
    except CalibrationError as error:
        assert options is not BARE and named in str(error)
    else:
        said = [v for v in verdicts(judge(found, None)) if named in v.text]
        assert {v.level for v in said} == {"bad"}
