"""Calibration through the ports recovers a rig that differs from its design, and knows how well."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.config import CameraConfig, WaterConfig
from alice_survey.errors import CalibrationError
from camera_calib.calibrate import Board, StereoView, calibrate
from camera_calib.rig import Rig, design_rig

BOARD = Board(columns=11, rows=8, square_m=0.03)
DESIGN = design_rig(CameraConfig(), WaterConfig(), scale=4)


def built_rig() -> Rig:
    lens = {"k1": -0.06, "k2": 0.03, "p1": 4e-4, "p2": -3e-4, "k3": 0.004}
    left = replace(DESIGN.cameras["left"], fx_px=849.3, fy_px=849.9, cx_px=424.5, **lens)
    right = replace(DESIGN.cameras["right"], fx_px=845.1, cy_px=337.2, **lens)
    turn = Rotation.from_euler("xyz", [0.2, -0.3, 0.25], degrees=True)
    return replace(
        DESIGN,
        cameras={
            "left": replace(left, port_distance_m=0.0208),
            "right": replace(right, port_distance_m=0.0194),
        },
        cam_from_rig={
            "left": RigidTransform.identity(),
            "right": RigidTransform.from_components([-0.1001, 0.0003, -0.0002], turn),
        },
    )


def views_of(rig: Rig, count: int, noise_px: float, rng: np.random.Generator) -> list[StereoView]:
    centre = BOARD.points.mean(axis=0)
    views = []
    while len(views) < count:
        tilt = Rotation.from_rotvec(np.deg2rad(rng.uniform(-30, 30, 3)))
        range_m = rng.uniform(0.6, 1.6)
        place = range_m * np.array([rng.uniform(-0.2, 0.25), rng.uniform(-0.18, 0.18), 1.0])
        points = tilt.apply(BOARD.points - centre) + place
        pixels = [
            rig.cameras[name].project(rig.cam_from_rig[name].apply(points))
            for name in ("left", "right")
        ]
        inside = [np.all((p > 0) & (p < [846, 677])) for p in pixels]
        if all(inside):
            left, right = (p + rng.normal(0, noise_px, p.shape) for p in pixels)
            views.append(StereoView(name=str(len(views)), left=left, right=right))
    return views


def test_without_noise_the_rig_is_recovered_exactly() -> None:
    truth = built_rig()

    found = calibrate(views_of(truth, 15, 0.0, np.random.default_rng(1)), BOARD, DESIGN)

    assert found.rms_px < 1e-5
    for name in ("left", "right"):
        assert found.rig.cameras[name].fx_px == pytest.approx(truth.cameras[name].fx_px, abs=1e-2)
        distance_m = found.rig.cameras[name].port_distance_m
        assert distance_m == pytest.approx(truth.cameras[name].port_distance_m, abs=2e-5)
    assert found.rig.baseline_m == pytest.approx(truth.baseline_m, abs=1e-6)


def test_sigmas_match_the_errors_over_many_pools() -> None:
    """Errors divided by their sigmas have unit variance: the covariance is honest."""
    truth, ratios = built_rig(), []
    for seed in range(5):
        views = views_of(truth, 15, 0.05, np.random.default_rng([7, seed]))
        found = calibrate(views, BOARD, DESIGN).rig
        right = found.cam_from_rig["right"]
        expected = truth.cam_from_rig["right"]
        ratios += [
            (found.cameras["left"].fx_px - truth.cameras["left"].fx_px)
            / found.sigmas["left.fx_px"],
            (found.cameras["right"].cy_px - truth.cameras["right"].cy_px)
            / found.sigmas["right.cy_px"],
            (right.translation[0] - expected.translation[0]) / found.sigmas["right.x_m"],
            (right.rotation * expected.rotation.inv()).as_rotvec()[1]
            / found.sigmas["right.ry_rad"],
        ]
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.5


def test_outliers_do_not_pull_the_rig() -> None:
    truth, rng = built_rig(), np.random.default_rng(3)
    views = views_of(truth, 15, 0.05, rng)
    spoiled = views[0].left.copy()
    spoiled[::9] += 25.0
    views[0] = replace(views[0], left=spoiled)

    found = calibrate(views, BOARD, DESIGN).rig

    shift = found.cam_from_rig["right"].translation - truth.cam_from_rig["right"].translation
    assert np.abs(shift).max() < 3e-4


def test_too_few_views_are_refused() -> None:
    views = views_of(built_rig(), 3, 0.0, np.random.default_rng(1))
    with pytest.raises(CalibrationError, match="3 views"):
        calibrate(views, BOARD, DESIGN)
