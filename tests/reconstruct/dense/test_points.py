from dataclasses import replace

import cv2
import numpy as np
import pytest

from reconstruct.dense.points import block_bounds, part_in_box, points_in_box, points_of_pixels
from reconstruct.dense.view_store import ViewStore, pack, pack_mask
from reconstruct.pictures.undistorted import WHOLE
from reconstruct.views.range_shift import no_shift
from tests import oracles_dense

EVERYWHERE = (-100.0, 100.0, -100.0, 100.0)
SCENE = oracles_dense.Scene(
    depth_of=lambda n, e: 12.0 + 0.2 * n - 0.1 * e + 0.0 * n * e, paint=oracles_dense.position_code
)
OFFSET = np.array([3.0, -2.0, -12.0])
VIEW = oracles_dense.stereo_views(np.array([0.2]), np.array([0.1]))[0]


def depth_of(view) -> np.ndarray:
    cam = view.world_from_cam.inv().apply(oracles_dense.hits(view, SCENE).reshape(-1, 3))
    return cam[:, 2].reshape(view.pinhole.size_px[::-1]).astype(np.float32)


def gathered(view, box=EVERYWHERE, factors=None, depth=None):
    depth = depth_of(view) if depth is None else depth
    colour = np.zeros((*depth.shape, 3), np.uint8)
    colour[...] = (100, 50, 20)
    known = np.isfinite(depth)
    factors = np.ones((2, 2, 3), np.float32) if factors is None else factors
    blocks = block_bounds(known, points_of_pixels(view, depth, known))
    sigma = np.full_like(depth, 0.01)
    return points_in_box(view, 7, depth, sigma, known, colour, factors, OFFSET, box, blocks)


def test_points_lie_where_the_rays_hit():
    points = gathered(VIEW)
    world = oracles_dense.hits(VIEW, SCENE).reshape(-1, 3)
    enu = np.column_stack([world[:, 1], world[:, 0], -world[:, 2]]) - OFFSET
    np.testing.assert_allclose(points.enu, enu, atol=2e-6)
    assert (points.views == 7).all()
    np.testing.assert_array_equal(points.colours[0], [20, 50, 100])


def test_normals_are_those_of_the_plane_and_point_to_the_camera():
    normals = gathered(VIEW).normals
    known = np.isfinite(normals).all(axis=1)
    assert known.mean() > 0.95
    # depth = 12 + 0.2 n - 0.1 e, so up = -12 - 0.2 n + 0.1 e with normal (-0.1, 0.2, 1)
    expected = np.array([-0.1, 0.2, 1.0]) / np.linalg.norm([0.1, 0.2, 1.0])
    np.testing.assert_allclose(normals[known], np.tile(expected, (known.sum(), 1)), atol=2e-3)


def test_boxes_share_no_point_and_miss_none():
    everything = gathered(VIEW)
    middle = float(np.median(everything.enu[:, 0]))
    west = gathered(VIEW, (-100.0, middle, -100.0, 100.0))
    east = gathered(VIEW, (middle, 100.0, -100.0, 100.0))
    assert len(west.enu) + len(east.enu) == len(everything.enu)
    assert min(len(west.enu), len(east.enu)) > 1000
    assert west.enu[:, 0].max() <= middle <= east.enu[:, 0].max()


def test_unknown_depth_gives_no_point_and_no_normal_next_to_it():
    depth = depth_of(VIEW)
    depth[100:110, 50:60] = np.nan
    points = gathered(VIEW, depth=depth)
    assert len(points.enu) == depth.size - 100
    rim = 4 * sum(VIEW.pinhole.size_px) - 16
    assert (~np.isfinite(points.normals[:, 0])).sum() == pytest.approx(rim + 80, abs=2)


def test_colours_take_the_factors_of_their_place():
    factors = np.ones((2, 2, 3), np.float32)
    factors[:, 1] = 2.0
    colours = gathered(VIEW, factors=factors).colours.reshape(*VIEW.pinhole.size_px[::-1], 3)
    np.testing.assert_allclose(colours[:, 0, 2], 100, atol=1)
    np.testing.assert_allclose(colours[:, -1, 2], 200, atol=1)
    np.testing.assert_allclose(colours[:, VIEW.pinhole.width_px // 2, 0], 30, atol=1)


def test_points_through_a_tilted_port_lie_where_the_exact_rays_hit():
    view = oracles_dense.port_view([0.2, -0.1, 0.0], [2.0, -1.0, 40.0])
    depth = oracles_dense.plane_depth(view, 1.6)  # far from the range at which the picture is exact
    points = gathered(view, depth=depth).enu + OFFSET
    np.testing.assert_allclose(points[:, 2], -1.6, atol=1e-6)
    back = view.project(points[:, [1, 0, 2]] * [1, 1, -1])
    np.testing.assert_allclose(back, oracles_dense.pixels_of(view), atol=2e-3)
    bare = gathered(replace(view, shift=no_shift(*view.pinhole.size_px)), depth=depth).enu + OFFSET
    assert 5e-4 < np.abs(bare - points).max() < 0.05


def test_the_part_of_a_view_that_meets_a_box_gives_what_the_whole_view_gives(tmp_path):
    """From a store, for a view through a port, whose pixels show other places at other depths."""
    view = oracles_dense.port_view([0.2, 0.1, 10.0], [2.0, -3.0, 40.0])
    depth = depth_of(view)
    rng = np.random.default_rng(4)
    colour = cv2.GaussianBlur(rng.integers(0, 255, (*depth.shape, 3), np.uint8), (0, 0), 2.0)
    store = ViewStore(tmp_path)
    store.save_depth(7, "fine", depth, np.full_like(depth, 0.01))
    store.save(7, "checked", pack(inside=pack_mask(rng.random(depth.shape) > 0.1)))
    store.save_colour(7, colour)
    chosen = np.isfinite(depth) & (rng.random(depth.shape) > 0.3)
    rows, columns = np.nonzero(chosen)
    pixels = np.column_stack([columns, rows]).astype(float) + 0.5
    world = view.at_depth(pixels, depth[rows, columns].astype(float))
    np.testing.assert_allclose(points_of_pixels(view, depth, chosen), world, rtol=0, atol=1e-11)
    blocks = block_bounds(np.isfinite(depth), points_of_pixels(view, depth, np.isfinite(depth)))
    east, north = world[:, 1] - OFFSET[0], world[:, 0] - OFFSET[1]
    factors = rng.uniform(0.5, 1.5, (5, 6, 3)).astype(np.float32)

    def points(box, part):
        return points_in_box(
            view, 7, *store.load_depth(7, "fine", part),
            store.load_mask(7, "checked", "inside", view.pinhole.width_px, part),
            store.load_colour(7, part),
            factors, OFFSET, box, blocks, part,
        )  # fmt: skip

    sizes = []
    for at_east, at_north in ((0.05, 0.5), (0.5, 0.5), (0.97, 0.03)):
        middle = np.quantile(east, at_east), np.quantile(north, at_north)
        side = 0.15 * np.ptp(east)
        box = (middle[0] - side, middle[0] + side, middle[1] - side, middle[1] + side)
        part = part_in_box(view, OFFSET, box, blocks)
        assert part is not None
        found, whole = points(box, part), points(box, WHOLE)
        for name in ("enu", "normals", "sigmas", "views"):
            np.testing.assert_array_equal(getattr(found, name), getattr(whole, name))
        assert np.abs(found.colours.astype(int) - whole.colours).max() <= 1
        assert len(found.enu) > 200
        sizes.append(store.load_depth(7, "fine", part)[0].size)
    assert max(sizes) < 0.6 * depth.size
    assert part_in_box(view, OFFSET, (1e3, 2e3, 1e3, 2e3), blocks) is None
