from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from camera_calib.approximation.pinhole_warp import Pinhole
from reconstruct.dense.depth import depth_in_reference, rectify
from reconstruct.views.model import View
from reconstruct.views.range_shift import no_shift
from tests.oracles_dense import pixels_of, port_view, view_at


def view(centre: list[float], rotvec: list[float], focal: float = 400.0) -> View:
    pinhole = Pinhole(
        width_px=320, height_px=240, fx_px=focal, fy_px=1.01 * focal, cx_px=163.0, cy_px=118.0
    )
    pose = RigidTransform.from_components(centre, Rotation.from_rotvec(rotvec))
    return view_at(pose, pinhole)


def transfer(homography: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    rows = np.column_stack([pixels, np.ones(len(pixels))]) @ homography.T
    return rows[:, :2] / rows[:, 2:]


@given(
    bearing=st.floats(0, 2 * np.pi),
    forward=st.floats(-0.1, 0.1),
    turns=st.lists(st.floats(-0.15, 0.15), min_size=6, max_size=6),
)
@settings(max_examples=40, deadline=None)
def test_any_pair_matches_on_rows_with_disparity_focal_times_base_over_range(
    bearing: float, forward: float, turns: list[float]
):
    base = [0.4 * np.cos(bearing), 0.4 * np.sin(bearing), forward]
    one, other = view([0, 0, 0], turns[:3]), view(base, turns[3:], focal=380.0)
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(-0.5, 0.5, (60, 2)), rng.uniform(1.7, 2.2, 60)])

    pair = rectify(one, other, points)

    assert pair is not None
    left = transfer(pair.rect_from_reference, one.project(points))
    right = transfer(pair.rect_from_partner, other.project(points))
    np.testing.assert_allclose(left[:, 1], right[:, 1], atol=1e-6)
    disparity = left[:, 0] - right[:, 0]
    inner = (disparity > 0) & (disparity < pair.disparities_px)
    assert inner.all()  # the search holds every point
    reach = pair.focal_px * pair.baseline / (disparity + pair.disparity_offset_px)
    sight = (points - one.world_from_cam.translation) @ _axis(one, other)
    np.testing.assert_allclose(reach, sight, rtol=1e-5)


def _axis(one: View, other: View) -> np.ndarray:
    base = other.world_from_cam.translation - one.world_from_cam.translation
    base = base / np.linalg.norm(base)
    sight = sum(v.world_from_cam.rotation.apply([0.0, 0, 1]) for v in (one, other))
    sight = sight - (sight @ base) * base
    return sight / np.linalg.norm(sight)


def test_depth_map_of_a_plane_comes_back():
    one, other = view([0, 0, 0], [0.05, -0.03, 0.4]), view([0.1, 0.35, 0.02], [0.0, 0.06, 0.3])
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(-0.5, 0.5, (60, 2)), np.full(60, 2.0)])
    pair = rectify(one, other, points)
    assert pair is not None
    # true disparity of the plane z = 2 at every virtual pixel
    inverse = np.linalg.inv(pair.rect_from_reference)
    grid = np.stack(np.meshgrid(np.arange(pair.width_px), np.arange(pair.height_px)), -1) + 0.5
    pixels = transfer(inverse, grid.reshape(-1, 2).astype(float))
    rays = one.at_depth(pixels, np.ones(len(pixels)))  # its centre is the origin
    world = rays * (2.0 / rays[:, 2:])
    right = transfer(pair.rect_from_partner, other.project(world))
    disparity = (grid.reshape(-1, 2)[:, 0] - right[:, 0]).reshape(grid.shape[:2])

    depth = depth_in_reference(one, other, pair, disparity.astype(np.float32))

    inside = np.isfinite(depth)
    assert inside.mean() > 0.3
    x, y = np.moveaxis(transfer(pair.rect_from_reference, pixels_of(one)), 1, 0)
    size = [pair.width_px, pair.height_px]
    reached = ((x > 1) & (y > 1) & (x < size[0] - 1) & (y < size[1] - 1)).reshape(240, 320)
    assert inside[reached].all()
    found = one.at_depth(pixels_of(one)[inside.ravel()], depth[inside].astype(float))
    np.testing.assert_allclose(found[:, 2], 2.0, atol=1e-3)


def test_no_pair_along_the_line_of_sight_or_face_to_face():
    points = np.array([[0.0, 0.0, 2.0], [0.1, 0.1, 2.1]])
    assert rectify(view([0, 0, 0], [0, 0, 0]), view([0, 0, 0.4], [0, 0, 0]), points) is None
    assert rectify(view([0, 0, 0], [0, 0, 0]), view([0.4, 0, 0], [0, np.pi, 0]), points) is None


def sea_floor(points: np.ndarray) -> np.ndarray:
    """Depth (N,) under points: half a metre of relief, smooth."""
    return 2.0 + 0.25 * np.sin(2.5 * points[:, 0]) * np.cos(1.5 * points[:, 1] + 0.4)


def spots(view: View, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World points of the sea floor that the warped picture shows at pixels, and their depth."""
    depth = np.full(len(pixels), 2.0)
    for _ in range(40):
        points = view.at_depth(pixels, depth)
        depth = depth + (sea_floor(points) - points[:, 2])
    return points, depth


@pytest.mark.parametrize("base_m", [0.1, 0.5])
def test_depth_through_a_tilted_port_is_exact(base_m: float):
    one = port_view([0, 0, 0], [1.0, -2.0, 30.0])
    other = port_view([base_m, 0.1, 0.02], [-1, 1, 28])
    points, true = spots(one, pixels_of(one))
    pair = rectify(one, other, points)
    assert pair is not None
    grid = np.stack(np.meshgrid(np.arange(pair.width_px), np.arange(pair.height_px)), -1) + 0.5
    grid = grid.reshape(-1, 2)
    seen, _ = spots(one, transfer(np.linalg.inv(pair.rect_from_reference), grid))
    right = transfer(pair.rect_from_partner, other.project(seen))
    disparity = (grid - right)[:, 0].reshape(pair.height_px, pair.width_px).astype(np.float32)

    depth = depth_in_reference(one, other, pair, disparity)
    here, there = (replace(v, shift=no_shift(*v.pinhole.size_px)) for v in (one, other))
    central = depth_in_reference(here, there, pair, disparity)

    known = np.isfinite(depth)
    assert known.mean() > 0.3
    assert np.abs(depth.ravel() - true)[known.ravel()].max() < 1e-5
    without = np.sqrt(np.mean((central.ravel() - true)[known.ravel()] ** 2))
    assert 2e-4 < without < 0.05
