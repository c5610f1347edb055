"""Housings told apart: by focal lengths in water and in air, and by what each leaves."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from alice_survey.core.errors import CalibrationError
from benchmarks.camera_housings import PARTS, run_trial
from camera_calib.calibrate.detect_views import Detections
from camera_calib.calibrate.from_pictures import calibrate_task
from camera_calib.calibrate.options import CalibrateOptions, task_of
from camera_calib.calibrate.results import calibration_text
from camera_calib.calibrate.solve import calibrate_in_air
from camera_calib.calibration import Calibration, TargetView
from camera_calib.camera import Camera
from camera_calib.freedom import USUAL_LENS
from camera_calib.judge.judgement import judge, verdicts
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.lenses.values import LensValues
from camera_calib.ports.dome import DomePort
from camera_calib.ports.flat import FlatPort
from camera_calib.ports.values import PortValues
from camera_calib.rig import Rig
from camera_calib.targets.target import parse_target
from tests.camera_calib.calibration_scenes import BOARD, built_rig, in_air, scene
from tests.camera_calib.housing_scenes import GLASS_M, INDICES, KINDS, Housing
from tests.oracles_dome import ray_to

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
    ("port", "kind"),
    [
        *(pytest.param(*p, marks=pytest.mark.slow) for p in ((FLAT, "flat"), (CENTRED, "none"))),
        (OFF, "dome"),
    ],
)
def test_the_housing_is_found(port: PortValues, kind: str) -> None:
    found = calibrated(CalibrateOptions(water=True, port="auto", glass_mm="6"), through(port))
    assert {camera.port.shape for camera in found.rig.cameras.values()} == {kind}
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
    assert not [v for v in said if "--port auto" in v.text]


BARE = CalibrateOptions(water=True, port="none")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "port", "named"),
    [
        (CalibrateOptions(water=True, glass_mm="6"), CENTRED, "another port"),
        (BARE, FLAT, "--port auto"),
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


AIR = Camera(
    width_px=1440, height_px=1080,
    lens=OpenCVLens(fx_px=2425.0, fy_px=2424.0, cx_px=735.0, cy_px=560.0, k1=-0.35, k2=0.3),
)  # fmt: skip
SMALL = parse_target("chessboard 8x6 30mm")
ACRYLIC = DomePort(
    dome_x_m=0.0017, dome_y_m=-0.0025, dome_z_m=-0.007, outer_radius_m=0.047302,
    glass_thickness_m=0.00375, n_glass=1.495, n_water=1.333,
)  # fmt: skip


def seen_by_tracing(
    port: DomePort | None, count: int, seed: int, lens: LensValues = AIR.lens
) -> Detections:
    """Corners of a board stretched by 0.35 %, smooth errors of 0.1 px in each picture included."""
    rng, views = np.random.default_rng([46, seed]), []
    wide = AIR.fx_px / lens.fx_px
    points = SMALL.points * [1.00175, 0.99825, 1.0]
    kernel = np.exp(-cdist(points, points, "sqeuclidean") / (2.0 * 0.08**2))
    smooth = np.linalg.cholesky(kernel + 1e-9 * np.eye(len(points)))
    while len(views) < count:
        turn = Rotation.from_euler("xyz", rng.uniform(-35.0, 35.0, 3), degrees=True)
        place = rng.uniform([-0.2 * wide, -0.15 * wide, 0.5], [0.2 * wide, 0.15 * wide, 1.1])
        cam = turn.apply(points - points.mean(axis=0)) + place
        rays = cam if port is None else np.array([ray_to(port, point) for point in cam])
        pixels = replace(AIR, lens=lens).project(rays)
        if np.all(cam[:, 2] > 0.1) and np.all((pixels > 3.0) & (pixels < [1437.0, 1077.0])):
            errors = rng.normal(0.0, 0.05, pixels.shape)
            errors += 0.1 * smooth @ rng.normal(size=pixels.shape)
            views.append(TargetView(name=f"{len(views):02d}", pixels={"camera": pixels + errors}))
    return Detections(views=tuple(views), sizes={"camera": (1440, 1080)}, rejections=())


def alone(found: Detections, start: Rig | None = None, **given: Any) -> Calibration:
    options = CalibrateOptions(water=start is not None, **given)
    return calibrate_task(task_of(options, {"camera": "x"}, SMALL, start), found)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_a_dome_off_its_centre_is_found_by_all_views_and_by_halves(seed: int) -> None:
    air = alone(seen_by_tracing(None, 24, seed), lens="opencv5").rig
    whole = seen_by_tracing(ACRYLIC, 24, seed + 10)
    for views in (whole.views, whole.views[::2], whole.views[1::2]):
        found = alone(
            replace(whole, views=views), air, port="auto", dome_radius_mm="47.302",
            glass_mm="3.75", n_glass="1.495", n_water="1.333",
        )  # fmt: skip
        port = found.rig.cameras["camera"].port
        assert port.shape == "dome"
        for axis in ("dome_x_m", "dome_y_m", "dome_z_m"):
            sigma = found.rig.sigmas[f"camera.{axis}"]
            assert 5e-5 < sigma < 1.5e-3
            assert abs(getattr(port, axis) - getattr(ACRYLIC, axis)) < 4.0 * sigma
        said = verdicts(judge(found, None))
        assert not [v for v in said if v.level == "bad" and "(p = " in v.text]
        assert not [v for v in said if "--port auto" in v.text]


@pytest.mark.slow
def test_a_housing_that_strains_the_calibration_in_air_is_charged_for_it() -> None:
    """A dome 1.1 mm off, for which no port at all fits, if it drags the lens from its prior."""
    air = alone(seen_by_tracing(None, 24, 1), lens="opencv5").rig
    off = {name: 0.15 * getattr(ACRYLIC, name) for name in ("dome_x_m", "dome_y_m", "dome_z_m")}
    found = alone(
        seen_by_tracing(replace(ACRYLIC, **off), 16, 11), air, port="auto",
        dome_radius_mm="47.302", glass_mm="3.75", n_glass="1.495", n_water="1.333",
    )  # fmt: skip
    assert found.rig.cameras["camera"].port.shape == "dome"


@pytest.mark.slow
@pytest.mark.parametrize(("port_m", "kind"), [(0.0008, "flat"), (0.06, "flat")])
def test_a_flat_port_that_is_compared_is_not_impossible(port_m: float, kind: str) -> None:
    port = FlatPort(port_distance_m=port_m, glass_thickness_m=0.006, n_glass=1.49)
    found = calibrated(CalibrateOptions(water=True, port="auto", glass_mm="6"), through(port))
    assert {camera.port.shape for camera in found.rig.cameras.values()} == {kind}
    assert not [v for v in verdicts(judge(found, None)) if v.level == "bad"]


def test_the_lens_is_found_by_what_it_leaves() -> None:
    fisheye = FisheyeLens(fx_px=560.0, fy_px=560.0, cx_px=719.0, cy_px=541.0, k1=0.02, k2=-0.01)
    for lens, model in ((fisheye, "fisheye"), (AIR.lens, "opencv")):
        found = alone(seen_by_tracing(None, 14, 3, lens))
        camera = found.rig.cameras["camera"]
        assert camera.lens.model == model
        assert abs(camera.fx_px - lens.fx_px) < 5.0 * found.rig.sigmas["camera.fx_px"]
        best = min(found.housing_trials, key=lambda trial: trial.criterion)
        assert best.lens == USUAL_LENS[model]
        assert {one.lens for one in found.housing_trials} == set(USUAL_LENS.values())


def test_rays_to_a_board_are_those_of_another_tracer() -> None:
    centre, points = np.array([0.001, -0.002, 0.006]), np.array([[0.1, 0.2, 0.6], [-0.3, 0.1, 0.5]])
    rays = Housing(inner_m=0.07, centre=centre).rays_to(points)
    shift = dict(zip(("dome_x_m", "dome_y_m", "dome_z_m"), centre.tolist(), strict=True))
    port = DomePort(
        **shift, outer_radius_m=0.07 + GLASS_M, glass_thickness_m=GLASS_M,
        n_glass=INDICES[1], n_water=INDICES[2],
    )  # fmt: skip
    expected = [ray_to(port, point) for point in points]
    np.testing.assert_allclose(rays / np.linalg.norm(rays, axis=1)[:, None], expected, atol=1e-13)
    plane = FlatPort(
        port_distance_m=0.07, glass_thickness_m=GLASS_M, n_glass=INDICES[1], n_water=INDICES[2]
    )
    flat = Housing(inner_m=0.07, centre=np.zeros(3), normal=np.array([0.0, 0.0, 1.0]))
    seen = replace(AIR, port=plane).project(points)
    np.testing.assert_allclose(AIR.project(flat.rays_to(points)), seen, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_lens_and_port_are_chosen_rightly_by_all_views_and_by_halves(kind: str) -> None:
    row = run_trial(3, kind)
    assert all(row[f"{part}: right"] for part in PARTS), row
