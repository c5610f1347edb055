"""Calibration from views: its modes, what it leaves out, what it says is not known."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import CalibrationError
from camera_calib.calibrate.adjust import adjust
from camera_calib.calibrate.observability import advice, held_effect
from camera_calib.calibrate.solve import (
    blank_camera,
    calibrate,
    calibrate_in_air,
    calibrate_in_water_alone,
    calibrate_through_ports,
    recalibrate,
)
from camera_calib.calibrate.start import locate
from camera_calib.calibration import TargetView
from camera_calib.freedom import Freedom, Prior, intrinsics, of_cameras, of_ports, pose_names, value
from camera_calib.ports.flat import FlatPort
from camera_calib.rig import Rig
from camera_calib.target_shape import usual_shape
from tests.camera_calib.calibration_scenes import (
    BOARD,
    DESIGN,
    board_poses,
    built_rig,
    in_air,
    posed_scene,
    scene,
    seen_in,
    views_of,
    with_pixels,
)

TRUTH = built_rig()
SIZES = {name: (camera.width_px, camera.height_px) for name, camera in TRUTH.cameras.items()}
NOISE_PX = 0.1


def scores(found: Rig, truth: Rig, *endings: str) -> list[float]:
    return [
        (value(found, name) - value(truth, name)) / sigma
        for name, sigma in found.sigmas.items()
        if name.endswith(endings)
    ]


def behind_ports(air: Rig) -> Rig:
    """Cameras calibrated in air behind the ports of the design."""
    lens = intrinsics("full")
    return replace(
        air,
        cameras={
            name: DESIGN.cameras[name].with_parameters({f: camera.parameter(f) for f in lens})
            for name, camera in air.cameras.items()
        },
    )


def test_in_air_from_nothing() -> None:
    air = in_air(TRUTH)
    found = calibrate_in_air(scene(air, 20, seed=2), BOARD, SIZES)

    assert found.rms_px == pytest.approx(NOISE_PX * np.sqrt(2), rel=0.05)
    assert found.noise_px == pytest.approx(NOISE_PX, rel=0.05)
    off = scores(found.rig, air, "_px", ".k1", "_m")
    assert 0.4 < np.sqrt(np.mean(np.square(off))) < 1.8
    assert found.rig.baseline_m == pytest.approx(air.baseline_m, abs=3e-5)
    assert found.rig.sigmas["left.fx_px"] < 1.5


def test_from_air_to_ports_with_the_prior() -> None:
    """The whole way of a user: a calibration in air, then housings in water."""
    rng = np.random.default_rng(4)
    air = in_air(TRUTH)
    dry = calibrate_in_air(views_of(air, board_poses(air, 20, rng), NOISE_PX, rng), BOARD, SIZES)
    views = views_of(TRUTH, board_poses(TRUTH, 20, rng), NOISE_PX, rng)
    start = behind_ports(dry.rig)

    prior = calibrate_through_ports(views, BOARD, start, "prior").rig
    free = calibrate_through_ports(views, BOARD, start, "free").rig

    off = scores(prior, TRUTH, "distance_m", "normal_x", "normal_y", "x_m", "y_m", "z_m", "_rad")
    assert 0.4 < np.sqrt(np.mean(np.square(off))) < 1.8
    for name in ("left.port_distance_m", "right.normal_x", "left.fx_px", "right.x_m"):
        assert prior.sigmas[name] < free.sigmas[name]
    assert prior.sigmas["left.fx_px"] < dry.rig.sigmas["left.fx_px"]


def test_from_water_alone_is_the_same_minimum_as_from_the_design() -> None:
    views = scene(TRUTH, 20, seed=6)
    blank = {
        name: blank_camera(
            size, "opencv5", FlatPort(n_water=1.34, port_distance_m=0.04, glass_thickness_m=0.01)
        )
        for name, size in SIZES.items()
    }
    alone = calibrate_in_water_alone(views, BOARD, blank)
    design = calibrate_through_ports(views, BOARD, DESIGN, "free")
    for name, sigma in design.rig.sigmas.items():
        assert value(alone.rig, name) == pytest.approx(value(design.rig, name), abs=0.01 * sigma)
    held = [line for line in alone.warnings if "n_water" in line]
    assert len(held) == 1
    assert "fx_px" in held[0]


def test_what_hangs_on_the_index_of_water_is_what_a_new_calibration_finds() -> None:
    views = scene(TRUTH, 20, seed=6)
    found = calibrate_through_ports(views, BOARD, DESIGN, "free")
    effect = held_effect(found, "n_water")
    other = calibrate(views, BOARD, found.rig.in_water(1.341), found.freedom).rig

    for name, slope in effect.slopes.items():
        moved = value(other, name) - value(found.rig, name)
        assert moved == pytest.approx(0.001 * slope, abs=0.03 * found.rig.sigmas[name])
    # Focal length times index is what water shows: f n stays.
    fx_px = found.rig.cameras["left"].fx_px
    assert effect.slopes["left.fx_px"] == pytest.approx(-fx_px / 1.34, rel=0.01)
    assert effect.sigma > 0.02


def test_cameras_with_an_index_to_be_found_look_into_one_water() -> None:
    sea = TRUTH.in_water(1.342)
    views = scene(sea, 12, seed=6)
    sigmas = {"left.n_water": 0.002, "right.n_water": 0.002}
    found = calibrate_through_ports(views, BOARD, TRUTH, "held", sigmas=sigmas).rig
    left, right = (camera.n_water for camera in found.cameras.values())
    assert left == pytest.approx(1.342, abs=4 * found.sigmas["left.n_water"])
    assert found.sigmas["left.n_water"] < 5e-4
    assert abs(left - right) < 0.002 * 0.002
    apart = Prior.around(TRUTH, {"left.n_glass": 0.01, "right.n_glass": 0.01}).covariance
    np.testing.assert_allclose(apart, 1e-4 * np.eye(2), rtol=1e-12)


def test_glass_with_a_sigma_is_adjusted_and_widens_the_rest() -> None:
    views = scene(TRUTH, 12, seed=6)
    sigmas = {"left.glass_thickness_m": 0.002, "right.glass_thickness_m": 0.002}
    known = calibrate_through_ports(views, BOARD, TRUTH, "held").rig
    wide = calibrate_through_ports(views, BOARD, TRUTH, "held", sigmas=sigmas).rig
    assert wide.sigmas["left.glass_thickness_m"] == pytest.approx(0.002, rel=0.1)
    # A part of r = t (d + g / G + w / W), G = sqrt(n_g^2 + (n_g^2 - 1) t^2), that is linear in t is
    # taken up by the board's distance; what is left is cubic: n_w A_w for d, and for the glass
    # (n_w / n_g) A_w - A_g, with A = (n^2 - 1) / (2 n^3).
    a_water, a_glass = ((n * n - 1) / (2 * n**3) for n in (1.34, 1.52))
    expected = 0.002 * abs(1.34 / 1.52 * a_water - a_glass) / (1.34 * a_water)
    spread = wide.sigmas["left.port_distance_m"] ** 2 - known.sigmas["left.port_distance_m"] ** 2
    assert np.sqrt(spread) == pytest.approx(expected, rel=0.2)


def test_a_pool_calibration_holds_in_the_sea() -> None:
    """Change the water, not the camera: the carried rig predicts pixels in the sea."""
    rng = np.random.default_rng(8)
    views = views_of(TRUTH, board_poses(TRUTH, 25, rng), 0.02, rng)
    pool = calibrate_through_ports(views, BOARD, DESIGN, "free").rig
    sea, carried = TRUTH.in_water(1.342), pool.in_water(1.342)
    poses = board_poses(sea, 10, rng)
    for view in views_of(sea, poses, 0.0, rng):
        misses = {}
        for name, rig in (("carried", carried), ("pool", pool)):
            found = seen_in(rig, locate(rig, view, BOARD), BOARD)
            off = [found[c] - seen for c, seen in view.pixels.items()]
            misses[name] = float(np.sqrt(np.mean(np.square(off))))
        assert misses["carried"] < 0.02
        assert misses["carried"] < misses["pool"]


def test_outliers_are_left_out_and_named() -> None:
    views = scene(TRUTH, 12, seed=3)
    spoiled = views[0].pixels["left"].copy()
    spoiled[::9] += 25.0
    wrong = views[3].pixels["right"][::-1].copy()
    dirty = [
        with_pixels(views[0], "left", spoiled), *views[1:3],
        with_pixels(views[3], "right", wrong), *views[4:],
    ]  # fmt: skip

    found = calibrate_through_ports(dirty, BOARD, TRUTH, "held")

    points = [r for r in found.rejections if r.points]
    whole = [r for r in found.rejections if not r.points]
    assert [(r.view, r.camera, r.points) for r in points] == [("00", "left", 10)]
    assert [(r.view, r.camera) for r in whole] == [("03", "right")]
    assert np.isnan(found.residuals_px[0, 0, ::9]).all()
    assert "right" not in found.views[3].pixels
    assert found.rejected is not None
    np.testing.assert_array_equal(found.rejected[0, 0, ::9], spoiled[::9])
    # Without noise of its own the result is that of the clean views.
    clean = calibrate_through_ports(
        [with_pixels(views[3], "right", None) if v == 3 else views[v] for v in range(12)],
        BOARD, TRUTH, "held",
    )  # fmt: skip
    for name, sigma in clean.rig.sigmas.items():
        assert value(found.rig, name) == pytest.approx(value(clean.rig, name), abs=0.3 * sigma)


def test_few_points_are_lost_to_normal_noise() -> None:
    views = scene(TRUTH, 25, seed=12, noise_px=0.3)
    assert calibrate_through_ports(views, BOARD, TRUTH, "held").rejections == ()


def test_views_of_one_camera_and_partial_boards_take_part() -> None:
    views = scene(TRUTH, 14, seed=5)
    gaps = views[1].pixels["left"].copy()
    gaps[40:] = np.nan
    row = np.full_like(gaps, np.nan)
    row[:11] = views[2].pixels["right"][:11]
    mixed = [
        with_pixels(views[0], "right", None), with_pixels(views[1], "left", gaps),
        with_pixels(views[2], "right", row), *views[3:],
    ]  # fmt: skip
    found = calibrate_through_ports(mixed, BOARD, DESIGN, "free")
    seen = np.isfinite(found.residuals_px[..., 0]).sum(axis=2)
    assert seen[0].tolist() == [88, 0]
    assert seen[1].tolist() == [40, 88]
    assert seen[2].tolist() == [88, 0]
    assert [(r.view, r.camera) for r in found.rejections] == [("02", "right")]
    off = scores(found.rig, TRUTH, "distance_m", "normal_x", "x_m", "_px")
    assert 0.3 < np.sqrt(np.mean(np.square(off))) < 2.0


def test_three_cameras_joined_in_a_chain() -> None:
    """The third camera shares views with the second only."""
    air = in_air(TRUTH)
    third = RigidTransform.from_translation([-0.2, 0.0, 0.0])
    rig = replace(
        air,
        cameras={**air.cameras, "far": air.cameras["left"]},
        cam_from_rig={**air.cam_from_rig, "far": third},
    )
    views = [
        with_pixels(view, "far" if v % 2 else "left", None)
        for v, view in enumerate(scene(rig, 24, seed=9, near_m=1.2))
    ]
    sizes = {**SIZES, "far": SIZES["left"]}
    found = calibrate_in_air(views, BOARD, sizes, "opencv4").rig
    np.testing.assert_allclose(
        found.cam_from_rig["far"].translation, [-0.2, 0, 0], atol=2e-4, rtol=0
    )


def test_parts_of_the_views_calibrate_alike_and_a_view_is_located() -> None:
    views, poses = posed_scene(TRUTH, 16, seed=10)
    whole = calibrate_through_ports(views, BOARD, DESIGN, "free")
    half = recalibrate(whole, whole.views[::2])
    assert half.rig.covariance is not None
    assert len(half.views) == 8
    assert half.rig.sigmas["left.fx_px"] > whole.rig.sigmas["left.fx_px"]
    off = scores(half.rig, whole.rig, "distance_m", "_px")
    assert np.abs(off).max() < 4
    pose = locate(half.rig, views[1], half.target_points)
    assert np.linalg.norm(pose.translation - poses[1].translation) < 3e-3


@pytest.mark.parametrize("tilt_deg", [0.0, 0.3])
def test_views_that_face_one_way_are_refused(tilt_deg: float) -> None:
    views = scene(in_air(TRUTH), 8, near_m=1.0, far_m=1.2, tilt_deg=tilt_deg)
    with pytest.raises(CalibrationError):
        calibrate_in_air(views, BOARD, SIZES)


def test_weak_views_give_warnings_that_name_what_is_missing() -> None:
    views = scene(TRUTH, 8, near_m=1.5, far_m=1.6, tilt_deg=8.0)
    weak = calibrate_through_ports(views, BOARD, TRUTH, "free")
    assert len(weak.warnings) >= 6
    lines = "\n".join(weak.warnings)
    assert "8 views" in lines and "left.port_distance_m" in lines

    strong = calibrate_through_ports(scene(TRUTH, 30), BOARD, TRUTH, "held")
    assert strong.warnings == ()


def test_parts_of_the_frame_without_points_are_named() -> None:
    """Four columns and three rows, y down."""
    camera = TRUTH.cameras["right"]
    everywhere = camera.pixel_centres(40).reshape(-1, 2)
    off = everywhere / [camera.width_px, camera.height_px] - [0.75, 1 / 3]
    pixels = np.stack([everywhere, everywhere])
    pixels[1, (off[:, 0] > 0) & (off[:, 1] < 0)] = np.nan
    (line,) = advice(TRUTH, np.tile(pixels, (25, 1, 1, 1)), RigidTransform.identity())
    assert line.startswith("right: no points in 1 of 12 parts of the frame (top far right)")


@pytest.mark.parametrize(
    ("work", "named"),
    [
        (lambda v: calibrate(v[:3], BOARD, TRUTH, Freedom(free=of_ports(TRUTH))), "3 view"),
        (lambda v: calibrate_in_air(v[:3], BOARD, SIZES), "3 view"),
        (
            lambda v: calibrate(
                [with_pixels(view, "right", None) for view in v],
                BOARD, TRUTH, Freedom(free=pose_names(TRUTH)),
            ),
            "right",
        ),
        (lambda v: calibrate_through_ports(v, BOARD, DESIGN, "prior"), "covariance"),
        (lambda v: calibrate_in_air(v, BOARD, SIZES, "mirror"), "mirror"),
        (
            lambda v: calibrate_in_air(
                [with_pixels(view, ("left", "right")[i % 2], None) for i, view in enumerate(v)],
                BOARD, SIZES,
            ),
            "left and right",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_calibrated_is_refused(
    work: Callable[[list[TargetView]], object], named: str
) -> None:
    with pytest.raises(CalibrationError, match=named):
        work(scene(TRUTH, 12))


def views_of_uneven_noise() -> tuple[list[TargetView], RigidTransform, np.ndarray]:
    """Half of the pictures three times as noisy: views, poses and noise (V, cameras)."""
    rng = np.random.default_rng(21)
    poses = board_poses(TRUTH, 20, rng)
    clean = views_of(TRUTH, poses, 0.0, rng)
    blur = np.where(rng.random((20, 2)) < 0.5, 0.05, 0.15)
    views = [
        replace(
            view,
            pixels={
                name: seen + rng.normal(0.0, blur[v, c], seen.shape)
                for c, (name, seen) in enumerate(view.pixels.items())
            },
        )
        for v, view in enumerate(clean)
    ]
    return views, poses, blur


def test_what_views_show_of_the_water_counts_pictures_as_the_calibration_did() -> None:
    """A prior as good as the views are said to be halves the variance."""
    views, _, blur = views_of_uneven_noise()
    found = calibrate_through_ports(views, BOARD, TRUTH, "free")
    assert found.blur is not None
    np.testing.assert_allclose(found.blur * found.noise_px, blur, rtol=0.35)
    stated = held_effect(found, "n_water").sigma
    alike = held_effect(replace(found, blur=None), "n_water").sigma

    prior = Prior.around(found.rig, dict.fromkeys(of_cameras(TRUTH, ["n_water"]), stated))
    # One step from where it starts: sigmas are those at the calibration itself.
    both = adjust(
        views, BOARD, found.rig, found.rig_from_target,
        Freedom(free=found.freedom.free, prior=prior), at_most=1, blur=found.blur,
        shape=found.shape,
    ).rig  # fmt: skip

    assert both.sigmas["left.n_water"] == pytest.approx(stated / np.sqrt(2), rel=0.05)
    assert alike > 1.15 * stated


def test_sharp_pictures_weigh_more_than_dull_ones() -> None:
    """Nearly as good as knowing which they are."""
    views, poses, blur = views_of_uneven_noise()
    found = calibrate_through_ports(views, BOARD, TRUTH, "held")
    true = blur / np.sqrt(np.mean(blur**2))
    alike, known, weighted = (
        adjust(views, BOARD, TRUTH, poses, found.freedom, blur=some, shape=usual_shape(BOARD))
        for some in (None, true, found.blur)
    )
    for name, sigma in found.rig.sigmas.items():
        assert weighted.rig.sigmas[name] < 0.9 * alike.rig.sigmas[name]
        assert weighted.rig.sigmas[name] == pytest.approx(known.rig.sigmas[name], rel=0.1)
        # Errors that go together are found to be few; how few is known to a tenth or so.
        assert sigma == pytest.approx(known.rig.sigmas[name], rel=0.25)
    assert found.noise_px == pytest.approx(np.sqrt(np.mean(blur**2)), rel=0.1)
    assert found.rejections == ()


@pytest.mark.parametrize("blind", ["left", "right"])
def test_a_view_of_one_camera_of_two_is_located(blind: str) -> None:
    views, poses = posed_scene(TRUTH, 1, seed=8, noise_px=0.0)
    view = with_pixels(views[0], blind, None)
    apart = locate(TRUTH, view, BOARD).inv() * poses[0]
    assert np.linalg.norm(apart.translation) < 1e-6
    assert apart.rotation.magnitude() < 1e-6
