"""What a calibration says of itself in a few lines."""

import pytest

from camera_calib.calibrate.results import calibration_text
from camera_calib.calibrate.solve import calibrate_through_ports
from camera_calib.targets.target import parse_target
from tests.camera_calib.calibration_scenes import BOARD, built_rig, scene

TARGET = parse_target("chessboard 11x8 30mm")
VERDICTS = [{"level": "look", "text": "blurred"}, {"level": "good", "text": "fine"}]


def test_ports_and_baseline_are_reported_in_millimetres_with_their_sigmas() -> None:
    truth = built_rig()
    found = calibrate_through_ports(scene(truth, 8, seed=5), BOARD, truth, "held")

    lines = calibration_text(found, TARGET, VERDICTS).splitlines()

    sigma_mm = 1e3 * found.rig.sigmas["left.port_distance_m"]
    port = next(line for line in lines if line.startswith("left.port_distance"))
    _, number, _, sigma, unit, *_ = port.split()
    assert float(number) == pytest.approx(21.2, abs=5 * sigma_mm)
    assert float(sigma) == pytest.approx(sigma_mm, rel=0.06)
    assert unit == "mm"
    baseline = next(line for line in lines if line.startswith("baseline "))
    assert float(baseline.split()[1]) == pytest.approx(100.3, abs=0.1)
    assert float(baseline.split("= ")[1].split()[0]) == pytest.approx(100.3 / 30.0, abs=0.003)
