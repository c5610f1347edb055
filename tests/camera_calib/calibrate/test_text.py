"""What a calibration says of itself in a few lines."""

from dataclasses import replace

import numpy as np
import pytest

from camera_calib.calibrate.results import calibration_text, port_tilt_deg
from camera_calib.calibrate.solve import calibrate_through_ports
from camera_calib.rig import Covariance, Rig
from camera_calib.targets.target import parse_target
from tests.camera_calib.calibration_scenes import (
    BOARD,
    DESIGN,
    board_poses,
    built_rig,
    tilted,
    views_of,
)
from tests.cameras import changed

TARGET = parse_target("chessboard 11x8 30mm")
VERDICTS = [{"level": "look", "text": "blurred"}, {"level": "good", "text": "fine"}]


def with_port(normal: tuple[float, float, float], covariance: list[list[float]]) -> Rig:
    camera = changed(DESIGN.cameras["left"], normal=normal)
    return replace(
        DESIGN,
        cameras={**DESIGN.cameras, "left": camera},
        covariance=Covariance(
            parameters=("left.normal_x", "left.normal_y"), matrix=np.array(covariance)
        ),
    )


def test_the_sigma_of_a_tilt_is_the_spread_of_drawn_tilts() -> None:
    covariance = [[4e-6, 1e-6], [1e-6, 1e-6]]
    rig = with_port(tilted(2.0, -3.0), covariance)
    mean = rig.cameras["left"].port.axis_cam[:2]
    drawn = np.random.default_rng(4).multivariate_normal(mean, covariance, 20_000)

    tilt_deg, sigma_deg = port_tilt_deg(rig, "left")

    angles = np.degrees(np.arcsin(np.linalg.norm(drawn, axis=1)))
    assert sigma_deg is not None
    assert tilt_deg == pytest.approx(angles.mean(), abs=0.01)
    assert sigma_deg == pytest.approx(angles.std(), rel=0.03)


def test_a_port_without_tilt_has_the_larger_sigma_and_a_held_one_none() -> None:
    rig = with_port((0.0, 0.0, 1.0), [[9e-6, 0.0], [0.0, 1e-6]])
    assert port_tilt_deg(rig, "left") == (0.0, pytest.approx(np.degrees(3e-3)))
    assert port_tilt_deg(rig, "right") == (0.0, None)


def test_ports_and_baseline_are_reported_in_millimetres_with_their_sigmas() -> None:
    rng, truth = np.random.default_rng(5), built_rig()
    views = views_of(truth, board_poses(truth, 8, rng), 0.1, rng)
    found = calibrate_through_ports(views, BOARD, truth, "held")

    lines = calibration_text(found, TARGET, VERDICTS).splitlines()

    sigma_mm = 1e3 * found.rig.sigmas["left.port_distance_m"]
    port = next(line for line in lines if line.startswith("left flat port: "))
    number, _, sigma = port.removeprefix("left flat port: ").split()[:3]
    assert float(number) == pytest.approx(21.2, abs=5 * sigma_mm)
    assert float(sigma) == pytest.approx(sigma_mm, rel=0.06)
    baseline = next(line for line in lines if line.startswith("baseline "))
    assert float(baseline.split()[1]) == pytest.approx(100.3, abs=0.1)
    assert float(baseline.split("= ")[1].split()[0]) == pytest.approx(100.3 / 30.0, abs=0.003)
