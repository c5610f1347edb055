"""The fused surface, by points on planes and spheres whose truth is known."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from reconstruct.dense.points import Points
from reconstruct.dense.surface_points import SURFACE_POINT, fuse_surface, settle
from tests.oracles_dense import fused
from tests.reconstruct.dense.test_surfaces import together

CELL_M, SIGMA_M = 0.01, 0.001
STATIONS = np.arange(40) // 2
NO_BOUND = np.array([-1e9, -1e9]), np.array([1e9, 1e9])


def seen(
    places: np.ndarray, normals: np.ndarray, rng: np.random.Generator, views: int = 8
) -> Points:
    """Points of views on a surface, off along the normal by one error for each view and cell."""
    count = len(places)
    order = np.sort(rng.integers(0, views, count))
    spots = np.column_stack([order, np.floor(places / CELL_M)])
    _, spot = np.unique(spots, axis=0, return_inverse=True)
    error = rng.normal(0, SIGMA_M, spot.max() + 1)[spot.reshape(-1)]
    return Points(
        enu=(places + error[:, None] * normals).astype(np.float32),
        normals=normals.astype(np.float32),
        colours=np.full((count, 3), (10, 200, 90), np.uint8),
        sigmas=np.full(count, SIGMA_M, np.float32),
        views=order.astype(np.int32),
    )


def fused_from(points: Points, origin: np.ndarray | None = None) -> np.ndarray:
    return fuse_surface(points, STATIONS, CELL_M, np.zeros(3) if origin is None else origin, 1.4)


def patch(normal: np.ndarray, rng: np.random.Generator, count: int = 20_000) -> Points:
    """A square of 0.3 m across a normal."""
    across = np.linalg.svd(normal[None])[2][1:]
    spots = rng.uniform(-0.15, 0.15, (count, 2))
    return seen(spots @ across, np.tile(normal, (count, 1)), rng)


@settings(max_examples=25, deadline=None)
@given(up=st.floats(-1.0, 1.0), azimuth=st.floats(0.0, 2 * math.pi))
def test_a_plane_is_found_whichever_way_it_faces(up: float, azimuth: float):
    rng = np.random.default_rng(1)
    level = math.sqrt(1.0 - up * up)
    normal = np.array([level * math.sin(azimuth), level * math.cos(azimuth), up])
    found = fused_from(patch(normal, rng), np.array([0.003, -0.002, 0.001]))
    off = found["enu"] @ normal
    np.testing.assert_allclose(found["normal"] @ normal, 1.0, atol=1e-4)
    assert np.abs(off).max() < 5 * SIGMA_M
    assert 0.3 < np.sqrt(np.mean((off / found["sigma"]) ** 2)) < 1.2
    # one direction or, next to the bound between two, some of each: never a gap, never double
    area = 0.3**2 / CELL_M**2
    assert area / math.sqrt(3) * 0.9 < len(found) < 1.35 * area
    assert (found["colour"] == (10, 200, 90)).all()
    assert (found["stations"] <= 4).all()
    assert np.median(found["views"]) >= 7


def test_a_ball_is_covered_from_all_sides_without_gaps():
    rng = np.random.default_rng(2)
    normals = rng.normal(size=(400_000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    radius = 0.25
    found = fused_from(seen(radius * normals, normals, rng))
    found = settle(found, CELL_M, *NO_BOUND)
    off = np.linalg.norm(found["enu"], axis=1) - radius
    assert np.sqrt(np.mean(off**2)) < 0.6 * SIGMA_M  # many points a cell
    assert abs(np.mean(off)) < 0.1 * SIGMA_M
    assert 0.3 < np.sqrt(np.mean((off / found["sigma"]) ** 2)) < 1.2
    gap = cKDTree(found["enu"]).query(radius * normals[::40])[0]
    assert np.max(gap) < 1.5 * CELL_M
    outwards = np.einsum("nk,nk->n", found["enu"], found["normal"]) / (radius + off)
    assert outwards.min() > 0.99


@pytest.mark.parametrize("shared", [1.0, 1.4, 2.0])
def test_cells_fused_from_points_of_one_direction_equal_their_slow_twin(shared: float):
    rng = np.random.default_rng(3)
    count = 600
    views = np.sort(rng.integers(0, 6, count)).astype(np.int32)
    places = np.column_stack([rng.uniform(0, 0.06, (count, 2)), rng.normal(0, 0.0008, count)])
    sigmas = rng.uniform(0.0005, 0.002, count).astype(np.float32)
    points = Points(
        enu=places.astype(np.float32),
        normals=np.tile(np.array([0, 0, 1], np.float32), (count, 1)),
        colours=np.zeros((count, 3), np.uint8),
        sigmas=sigmas,
        views=views,
    )
    found = fuse_surface(points, STATIONS, CELL_M, np.zeros(3), shared)
    assert len(found) == 36
    for one in found:
        middle = one["enu"][:2]
        inside = (np.abs(places[:, :2] - middle) < CELL_M / 2).all(axis=1)
        height, sigma, n, places_met = fused(
            points.enu[inside, 2], sigmas[inside], views[inside], STATIONS, shared
        )
        np.testing.assert_allclose(one["enu"][2], height, atol=1e-6)
        np.testing.assert_allclose(one["sigma"], sigma, rtol=1e-3)
        assert (one["views"], one["stations"]) == (n, places_met)
        assert (np.round(middle / CELL_M - 0.5, 3) % 1 == 0).all()


@pytest.mark.parametrize("slope_deg", [0.0, 30.0, 50.0, 70.0])
def test_a_slope_within_a_cell_is_no_scatter(slope_deg: float):
    """What a cell covers of a slope is 10 mm x tan; sigmas stay those of a level floor."""
    rng = np.random.default_rng(4)
    slope = math.radians(slope_deg)
    normal = np.array([math.sin(slope), 0.0, math.cos(slope)])
    found = fused_from(patch(normal, rng, 40_000))
    level = fused_from(patch(np.array([0.0, 0.0, 1.0]), rng, 40_000))
    assert np.median(found["sigma"]) == pytest.approx(np.median(level["sigma"]), rel=0.1)


def test_both_sides_of_a_thin_wall_stay_apart():
    rng = np.random.default_rng(5)
    north = np.array([0.0, 1.0, 0.0])
    one, other = patch(north, rng), patch(-north, rng)
    front = one._replace(enu=one.enu + np.array([0, 0.02, 0], np.float32))
    found = fused_from(together(front, other))
    ahead = found["normal"][:, 1] > 0
    np.testing.assert_allclose(found["enu"][ahead, 1], 0.02, atol=5 * SIGMA_M)
    np.testing.assert_allclose(found["enu"][~ahead, 1], 0.0, atol=5 * SIGMA_M)
    assert 0.45 < ahead.mean() < 0.55


def fused_floor(rng: np.random.Generator, side_m: float = 0.3) -> np.ndarray:
    spots = rng.uniform(-side_m / 2, side_m / 2, (int(2e5 * side_m**2), 2))
    places = np.column_stack([spots, np.zeros(len(spots))])
    up = np.tile([0.0, 0.0, 1.0], (len(spots), 1))
    return fused_from(seen(places, up, rng))


def test_small_patches_off_the_surface_go_unless_they_may_go_on_elsewhere():
    rng = np.random.default_rng(6)
    floor, stray = fused_floor(rng), fused_floor(rng, 0.1)
    stray["enu"][:, 2] += 0.2
    both = np.concatenate([floor, stray])
    found = settle(both, CELL_M, *NO_BOUND)
    assert len(found) == len(floor)
    np.testing.assert_array_equal(found["enu"], floor["enu"])
    near = settle(both, CELL_M, np.array([-0.06, -1.0]), np.array([1.0, 1.0]))
    assert len(near) == len(both)
    assert len(settle(both[:0], CELL_M, *NO_BOUND)) == 0


def test_sigmas_grow_where_neighbours_contradict_and_nowhere_else():
    rng = np.random.default_rng(7)
    floor = fused_floor(rng)
    flat = settle(floor, CELL_M, *NO_BOUND)
    np.testing.assert_allclose(np.median(flat["sigma"] / floor["sigma"]), 1.0, atol=0.02)
    east = floor["enu"][:, 0] > 0
    floor["enu"][east, 2] += 0.006  # half a cell
    found = settle(floor, CELL_M, *NO_BOUND)
    rim = np.abs(floor["enu"][:, 0]) < CELL_M
    away = np.abs(floor["enu"][:, 0]) > 3 * CELL_M
    assert 0.001 < np.median(found["sigma"][rim]) < 0.006
    np.testing.assert_allclose(found["sigma"][away], flat["sigma"][away], rtol=1e-6)


def test_tiles_agree_where_they_meet():
    rng = np.random.default_rng(8)
    normals = rng.normal([0.0, 0.0, 1.0], 0.6, (60_000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = seen(0.2 * normals, normals, rng)
    whole = fused_from(points)
    part = fused_from(Points._make(values[points.enu[:, 0] < 5 * CELL_M] for values in points))

    def own(found: np.ndarray) -> np.ndarray:
        return np.sort(found[found["enu"][:, 0] < 4 * CELL_M], order=("enu", "normal"))

    np.testing.assert_array_equal(own(part), own(whole))


def test_rims_are_as_unsure_as_their_neighbours_lie_to_one_side() -> None:
    cell = 0.01
    x, y = np.meshgrid(np.arange(60) * cell, np.arange(60) * cell)
    inside = np.ones(x.shape, bool)
    inside[20:26, 20:26] = False  # a hole has a rim too
    surface = np.zeros(inside.sum(), SURFACE_POINT)
    surface["enu"] = np.stack([x[inside], y[inside], np.zeros(inside.sum())], axis=1)
    surface["normal"] = [0.0, 0.0, 1.0]
    surface["sigma"] = 1e-4
    surface["views"], surface["stations"] = 4, 2

    found = settle(surface, cell, np.array([-1.0, -1.0]), np.array([2.0, 2.0]))

    sigma = np.full(inside.shape, np.nan)
    sigma[inside] = found["sigma"]
    np.testing.assert_allclose(sigma[30:50, 30:50], 1e-4, rtol=1e-4)
    # The centroid of half a disc of three cells is 4 * 3 / (3 pi) = 1.27 cells away.
    assert 0.7 * cell < sigma[30, 0] < 1.3 * cell
    assert sigma[30, 0] > sigma[30, 1] > 0.2 * cell
    assert sigma[30, 3] < 1.1e-4
    assert 0.3 * cell < sigma[22, 19] < 1.3 * cell
