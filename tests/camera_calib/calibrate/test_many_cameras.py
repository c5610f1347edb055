"""Rigs of many cameras, of other sizes, lenses and directions: from corners, and from pictures."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from alice_survey.core.errors import CalibrationError
from camera_calib.calibrate.detect_views import Detections
from camera_calib.calibrate.from_pictures import calibrate_task
from camera_calib.calibrate.options import CalibrateOptions, task_of
from camera_calib.calibrate.solve import calibrate_in_air
from camera_calib.calibration import Calibration, TargetView
from camera_calib.formats.rigs import rename_cameras
from camera_calib.freedom import POSE, move_rig, part_of_rig
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.rig import Covariance, Rig
from camera_calib.targets.target import parse_target
from tests.camera_calib.calibration_scenes import (
    built_rig,
    differences,
    in_air,
    scene,
    views_of_some,
)
from tests.reconstruct import rig_survey

TARGET = parse_target("chessboard 9x6 40mm")
NOISE_PX = 0.1


def four_cameras() -> Rig:
    """Two that look down, one that looks ahead and a fisheye that looks aside, behind ports."""
    return rename_cameras(rig_survey.four_cameras(), ["left", "right", "bow", "side"])


def seen_by(truth: Rig, count: int, rng: np.random.Generator) -> Detections:
    """Corners of the target in cameras that see it whole."""
    shown = views_of_some(truth, TARGET.points, count, rng)
    views = [
        TargetView(
            name=f"{v:02d}",
            pixels={n: p + rng.normal(0.0, NOISE_PX, p.shape) for n, p in pixels.items()},
        )
        for v, (_, pixels) in enumerate(shown)
    ]
    sizes = {name: (c.width_px, c.height_px) for name, c in truth.cameras.items()}
    return Detections(sizes=sizes, views=tuple(views), rejections=())


def calibrated(options: CalibrateOptions, found: Detections, start: Rig | None) -> Calibration:
    task = task_of(options, dict.fromkeys(found.sizes, "pictures"), TARGET, start)
    return calibrate_task(task, found)


def test_four_oblique_cameras_are_found_within_their_sigmas() -> None:
    """From nothing but corners; no view is seen by all of them."""
    truth, rng = in_air(four_cameras()), np.random.default_rng(5)
    lens = OpenCVLens(fx_px=540.0, fy_px=541.0, cx_px=285.0, cy_px=275.0, k1=-0.12)
    side = replace(truth.cameras["side"], lens=lens)
    truth = replace(truth, cameras={**truth.cameras, "side": side})
    found_corners = seen_by(truth, 40, rng)
    views, sizes = found_corners.views, found_corners.sizes
    assert {len(view.pixels) for view in views} >= {2, 3}

    found = calibrate_in_air(views, TARGET.points, sizes, "k2")

    assert list(found.rig.cameras) == list(truth.cameras)
    assert len(found.views) == 40 and not found.rejections
    assert found.rig.body_from_rig is None
    assert found.noise_px == pytest.approx(NOISE_PX, rel=0.05)
    errors, sigmas = differences(found.rig, truth), found.rig.sigmas
    over = np.array([errors[key] / sigmas[key] for key in errors])
    assert len(over) == 4 * 6 + 3 * 6
    assert np.abs(over).max() < 4.0
    assert 0.6 < np.sqrt(np.mean(over**2)) < 1.4
    for name in ("right", "bow", "side"):
        assert sigmas[f"{name}.x_m"] < 2e-3
        assert sigmas[f"{name}.rx_rad"] < 1e-3


def test_a_part_of_a_rig_has_the_covariance_of_its_own_poses() -> None:
    """The covariance of one random step of the rig is that of what its part does."""
    rig, names = in_air(four_cameras()), ["bow", "side"]
    fields = (*(f"{n}.{axis}" for n in ("right", "bow", "side") for axis in POSE), "side.cx_px")
    step = np.random.default_rng(4).normal(0.0, 1e-5, len(fields))
    known = Covariance(parameters=fields, matrix=np.outer(step, step))

    part = part_of_rig(replace(rig, covariance=known), names)

    ours, theirs = (r.cam_from_rig["side"] * r.cam_from_rig["bow"].inv() for r in (part, rig))
    np.testing.assert_allclose(ours.as_matrix(), theirs.as_matrix())
    assert part.body_from_cam("side").as_matrix() == pytest.approx(
        rig.body_from_cam("side").as_matrix()
    )
    off = differences(
        part_of_rig(replace(move_rig(rig, fields, step), covariance=known), names), part
    )
    assert list(off) == ["side.cx_px", *(f"side.{axis}" for axis in POSE)]
    np.testing.assert_allclose(
        part.covariance.matrix, np.outer(list(off.values()), list(off.values())), atol=1e-14
    )
    whole = part_of_rig(replace(rig, covariance=known), list(rig.cameras))
    assert whole.sigmas == pytest.approx(dict(zip(fields, np.abs(step), strict=True)), rel=1e-9)


def test_pictures_of_left_and_right_that_were_exchanged_are_a_warning() -> None:
    """Without a start by their names, with one by its poses; cameras that are right have none."""
    truth = in_air(built_rig())
    views = scene(truth, 12, [1, 2], NOISE_PX, TARGET.points, near_m=0.6, far_m=1.6)
    sizes = {name: (camera.width_px, camera.height_px) for name, camera in truth.cameras.items()}
    shown = Detections(sizes=sizes, views=tuple(views), rejections=())
    crossed = [dict(zip(v.pixels, [*v.pixels.values()][::-1], strict=True)) for v in views]
    swapped = [replace(v, pixels=pixels) for v, pixels in zip(views, crossed, strict=True)]
    exchanged, options = replace(shown, views=tuple(swapped)), CalibrateOptions(lens="k2")

    rig = calibrated(options, shown, None).rig
    sides = [[w for w in calibrated(options, one, start).warnings if "exchange" in w]
             for one in (shown, exchanged) for start in (None, rig)]  # fmt: skip

    assert [len(one) for one in sides] == [0, 0, 1, 1]


@pytest.mark.slow
def test_four_lenses_behind_four_ports_are_found_in_air_and_then_in_water() -> None:
    wet, rng = four_cameras(), np.random.default_rng(8)
    dry = in_air(wet)
    terms = "k2,side=fisheye"
    found_in_air = calibrated(CalibrateOptions(lens=terms), seen_by(dry, 30, rng), None).rig
    under_water = CalibrateOptions(
        lens=terms, water=True, port="flat,bow=dome,side=dome", dome_radius_mm="80,bow=60",
        glass_mm="6,left=10,bow=5", n_glass="1.52,right=1.49",
    )  # fmt: skip
    views = seen_by(wet, 30, rng)

    found = calibrated(under_water, views, found_in_air)

    errors, sigmas = differences(found.rig, wet), found.rig.sigmas
    over = np.array([errors[key] / sigmas[key] for key in sigmas])
    assert {f"{n}.dome_z_m" for n in ("bow", "side")} <= set(sigmas)
    assert np.abs(over).max() < 4.5
    assert 0.6 < np.sqrt(np.mean(over**2)) < 1.4
    assert 0.9 * NOISE_PX < found.noise_px < 1.1 * NOISE_PX
    again = calibrated(replace(under_water, port=None, lens=None), views, found.rig)
    assert [c.port.shape for c in again.rig.cameras.values()] == ["flat", "flat", "dome", "dome"]


@pytest.mark.parametrize(
    ("given", "fault"),
    [({"port": "flat,stern=dome"}, "no camera is called stern"),
     ({"port": "bow=dome"}, "there is none for left"),
     ({"port": "cube"}, "'cube' for left; choose none, flat, dome"),
     ({"port": "flat,dome"}, "two are for all"),
     ({"glass_mm": "5,bow=thick"}, "'thick' for bow is not a number from 0.5 to 500 mm"),
     ({"glass_mm": "0.006"}, "'0.006' for left is not a number from 0.5 to 500 mm"),
     ({"glass_mm": "5", "port_distance_mm": "0.02"}, "'0.02' for left is not .* mm"),
     ({"dome_radius_mm": "80,bow=2"}, "--dome-radius 80,bow=2: '2' for bow is not a number from 5"),
     ({"n_glass": "stern=1.5"}, "--n-glass stern=1.5: no camera is called stern"),
     ({"port_distance_mm": "nan"}, "'nan' for left is not a number"),
     ({"glass_mm": "5+-0"}, "'5.-0' for left is not a number"),
     ({"n_water": "1.34,bow=1.33"}, "one water"),
     ({"glass_mm": "left=5,right=5,bow=5"}, "needs --glass of side"),
     ({"port": "flat,bow=dome", "glass_mm": "5"}, "needs --dome-radius of bow")],
)  # fmt: skip
def test_a_wrong_port_or_number_of_one_is_named(given: dict[str, Any], fault: str) -> None:
    places = dict.fromkeys(four_cameras().cameras, "pictures")
    with pytest.raises(CalibrationError, match=fault):
        task_of(CalibrateOptions(water=True, **given), places, TARGET, None)


def test_numbers_of_ports_have_sigmas_where_they_are_found_again() -> None:
    options = CalibrateOptions(
        water=True, port="flat,bow=none", glass_mm="5+-0.1,side=6", n_glass="+-0.01", n_water="1.34"
    )
    rig = in_air(four_cameras())
    task = task_of(options, dict.fromkeys(rig.cameras, "p"), TARGET, rig)
    assert task.ports["bow"] == "none" and task.ports["side"] == "flat"
    assert task.port_values["left"] == pytest.approx({"glass_thickness_m": 0.005, "n_water": 1.34})
    sizes = {name: (one.width_px, one.height_px) for name, one in rig.cameras.items()}
    sigmas = task.sigmas_of(task.cameras(sizes))
    glass = {f"{n}.glass_thickness_m": 1e-4 for n in ("left", "right")}
    index = {f"{n}.n_glass": 0.01 for n in ("left", "right", "side")}
    assert sigmas == pytest.approx(glass | index)
