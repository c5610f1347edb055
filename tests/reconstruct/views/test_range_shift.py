"""The shift with distance that a warp to one pinhole leaves."""

import pickle
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.config import CameraConfig, WaterConfig
from camera_calib.approximation.pinhole_warp import PinholeWarp, best_warp
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.lenses.values import LensValues
from camera_calib.ports.dome import DomePort
from camera_calib.rig import design_rig
from reconstruct.views.range_shift import RangeShift, range_shift
from tests.cameras import changed
from tests.oracles_dense import view_at


def warp_of(distance_m: float, tilt_deg: float) -> PinholeWarp:
    camera = design_rig(CameraConfig(port_distance_m=distance_m), WaterConfig(), scale=4)
    left = camera.cameras[camera.reference]
    tilt = np.deg2rad(tilt_deg)
    return best_warp(changed(left, normal=(np.sin(tilt), 0.0, np.cos(tilt))), 1.5, 2.5)


def behind_dome(x_m: float, y_m: float, z_m: float, lens: LensValues | None = None) -> PinholeWarp:
    left = warp_of(0.02, 0.0).camera
    dome = DomePort(
        dome_x_m=x_m, dome_y_m=y_m, dome_z_m=z_m, outer_radius_m=0.05, glass_thickness_m=0.005
    )
    return best_warp(replace(left, port=dome, lens=left.lens if lens is None else lens), 1.5, 2.5)


FISHEYE = FisheyeLens(fx_px=450.0, fy_px=450.0, cx_px=420.0, cy_px=340.0, k1=-0.02)
WARPS = {
    **{f"flat {d} m, {t} deg": warp_of(d, t) for d in (0.0, 0.02, 0.1) for t in (0.0, 2.0)},
    "centred dome": behind_dome(0.0, 0.0, 0.0),
    "dome 5 mm ahead": behind_dome(0.0, 0.0, 0.005),
    "dome off its axis": behind_dome(0.012, -0.01, 0.02),
    "fisheye behind a dome": behind_dome(0.003, 0.0, -0.004, FISHEYE),
}


@pytest.mark.parametrize("warp", WARPS.values(), ids=WARPS)
def test_the_shift_is_exact_at_every_distance(warp: PinholeWarp) -> None:
    """Against points traced through the port: the field is linear in inverse depth."""
    shift = range_shift(warp)
    rng = np.random.default_rng(3)
    taken = rng.uniform(0.02, 0.98, (500, 2)) * warp.size_px
    warped = warp.to_pinhole(taken)
    inside = ((warped > 0) & (warped < warp.pinhole.size_px)).all(axis=1)
    assert inside.mean() > 0.9
    taken, warped = taken[inside], warped[inside]
    for depth_m in (0.6, 1.5, 2.0, 2.5, 6.0):
        spots = warp.camera.at_depth(taken, depth_m)
        points = warp.pinhole_from_cam.apply(spots)
        ideal, depth = warp.pinhole.project(points), points[:, 2]
        field = warp.lines(taken)[1] * warp.pinhole.focal_px
        exact = field * (1 / depth - 1 / warp.working_depth_m)[:, None]
        np.testing.assert_allclose(warped + exact, ideal, atol=1e-8)
        np.testing.assert_allclose(warp.to_pinhole(taken, depth_m), ideal, atol=1e-8)
        moved = np.abs(ideal - warped).max()
        np.testing.assert_allclose(shift.ideal(warped, depth), ideal, atol=2e-3 * moved + 1e-9)
        np.testing.assert_allclose(shift.warp(ideal, depth), warped, atol=3e-3 * moved + 1e-9)


def test_rays_through_a_dome_that_is_centred_on_the_pupil_meet_there() -> None:
    warp = behind_dome(0.0, 0.0, 0.0)
    np.testing.assert_allclose(warp.centre_m, 0.0, atol=1e-12)
    assert warp.largest_offset_m == 0.0
    assert not range_shift(warp).nodes.any()
    assert warp.pinhole.fx_px == pytest.approx(warp.camera.fx_px)


@cache
def tilted_shift() -> RangeShift:
    return range_shift(warp_of(0.1, 2.0))


@given(x=st.floats(0, 846), y=st.floats(0, 677), depth=st.floats(0.8, 10.0))
def test_kernels_and_scales_agree(x: float, y: float, depth: float) -> None:
    shift = tilted_shift()
    pixel = np.array([[x, y]])
    ideal = shift.ideal(pixel, depth)[0]
    np.testing.assert_allclose(shift.warp(ideal[None], depth)[0], [x, y], atol=1e-5)
    half = shift.scale(0.5, 0.25).ideal(pixel * [0.5, 0.25], depth)[0]
    np.testing.assert_allclose(half, ideal * [0.5, 0.25], atol=1e-9)


def test_a_view_sees_points_through_its_port() -> None:
    """A view's pixel of a point is that of the exact camera, carried to the warped picture."""
    warp = warp_of(0.1, 2.0)
    rng = np.random.default_rng(5)
    size = [warp.camera.width_px, warp.camera.height_px]
    taken = rng.uniform(0.05, 0.95, (200, 2)) * size
    spots = warp.camera.at_depth(taken, rng.uniform(1.2, 3.0, 200))
    view = view_at(RigidTransform.identity(), warp.pinhole, range_shift(warp))
    points = warp.pinhole_from_cam.apply(spots)
    np.testing.assert_allclose(view.project(points), warp.to_pinhole(taken), atol=5e-3)
    assert np.abs(view.pinhole.project(points) - warp.to_pinhole(taken)).max() > 0.2
    depth = points[:, 2]
    np.testing.assert_allclose(view.at_depth(view.project(points), depth), points, atol=1e-6)


@given(
    matrix=st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4),
    largest=st.floats(0.01, 0.9),
    depth=st.sampled_from([0.5, 1.0, 4.0, np.inf]),
)
def test_the_contraction_is_the_fields_own_and_below_one_the_inverse_exists(
    matrix: list[float], largest: float, depth: float
) -> None:
    """A field that is linear in the pixel: its slopes and the inverse map are known."""
    slopes = np.array(matrix).reshape(2, 2)
    size = np.linalg.norm(slopes, ord=2)
    if size < 1e-3:
        return
    step = 1.0 / depth - 0.5
    slopes = slopes / size * largest / abs(step)
    x, y = np.linspace(-400, 400, 33), np.linspace(-300, 300, 25)
    nodes = np.stack(np.meshgrid(x, y), axis=-1) @ slopes.T
    shift = RangeShift(nodes=nodes, width_px=800.0, height_px=600.0, inverse_working=0.5)
    assert shift.contraction(np.array([2.0, depth])) == pytest.approx([0.0, largest], rel=1e-6)
    warped = np.random.default_rng(0).uniform([100, 100], [700, 500], (40, 2))
    ideal = warped + step * (warped - [400, 300]) @ slopes.T
    np.testing.assert_allclose(shift.ideal(warped, depth), ideal, atol=1e-9)
    np.testing.assert_allclose(shift.warp(ideal, depth), warped, atol=1e-4)


def test_poses_reach_other_processes_to_the_last_bit() -> None:
    rng = np.random.default_rng(4)
    for _ in range(200):
        pose = RigidTransform.from_components(rng.normal(size=3), Rotation.random(rng=rng)).inv()
        copy = pickle.loads(pickle.dumps(pose))  # noqa: S301 (its own)
        np.testing.assert_array_equal(copy.as_matrix(), pose.as_matrix())
        np.testing.assert_array_equal(copy.rotation.as_quat(), pose.rotation.as_quat())
