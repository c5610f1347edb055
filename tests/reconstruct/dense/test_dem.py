import math

import numpy as np
import pytest

from reconstruct.dense.dem import (
    bin_points,
    fill_gaps,
    fuse_cells,
    fuse_points,
    slope_deg,
    without_strays,
)
from reconstruct.dense.points import Points
from reconstruct.raster import DemGrid, grid_over, round_cell
from tests.oracles_dense import fused, surfaces


def points(enu: np.ndarray, sigmas: np.ndarray, views: np.ndarray) -> Points:
    return Points(
        enu=enu.astype(np.float32),
        normals=np.tile(np.array([0, 0, 1], np.float32), (len(enu), 1)),
        colours=np.zeros((len(enu), 3), np.uint8),
        sigmas=sigmas.astype(np.float32),
        views=views.astype(np.int32),
    )


def test_grid_covers_its_boxes_on_whole_cells():
    grid = grid_over([(-1.23, 0.31, 2.0, 1.0), (0.0, -0.42, 1.1, 0.9)], 0.1)
    assert grid.west == pytest.approx(-0.5)
    assert grid.north == pytest.approx(2.0)
    assert (grid.rows, grid.columns) == (33, 15)
    assert grid.east_of(grid.columns) == pytest.approx(1.0)
    assert grid.north_of(grid.rows) == pytest.approx(-1.3)
    moved = grid.moved(10.0, -5.0).window(3, 2, 4, 5)
    assert moved.west == pytest.approx(9.7)
    assert moved.north == pytest.approx(-3.3)


@pytest.mark.parametrize(
    ("length", "cell"), [(0.004417, 0.0044), (0.0996, 0.1), (2.345, 2.3), (123.4, 120.0)]
)
def test_cells_have_two_digits(length: float, cell: float):
    assert round_cell(length) == pytest.approx(cell)


def test_bin_points_equals_a_dictionary_of_cells():
    rng = np.random.default_rng(1)
    enu = rng.uniform(-1, 4, (500, 3)).astype(np.float32)
    starts, order = bin_points(enu, 3.0, 0.0, 0.5, 6, 5)
    cells: dict[int, list[int]] = {n: [] for n in range(30)}
    for number, (east, north, _) in enumerate(enu.tolist()):
        row, column = math.floor((3.0 - north) / 0.5), math.floor(east / 0.5)
        if 0 <= row < 6 and 0 <= column < 5:
            cells[row * 5 + column].append(number)
    for cell, members in cells.items():
        assert order[starts[cell] : starts[cell + 1]].tolist() == members
    assert 0 < len(order) < 500


def test_fuse_cells_equals_its_slow_twin():
    rng = np.random.default_rng(2)
    sizes = rng.integers(0, 24, 200)
    starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    heights = rng.normal(0, 0.01, starts[-1]).astype(np.float32)
    heights[rng.random(len(heights)) < 0.3] += np.float32(0.4)
    heights[rng.random(len(heights)) < 0.1] += np.float32(0.3)
    sigmas = rng.uniform(0.002, 0.02, len(heights)).astype(np.float32)
    views = np.concatenate([np.sort(rng.integers(0, 4, n)) for n in sizes]).astype(np.int32)
    steepness = rng.exponential(3.0, len(heights)).astype(np.float32)
    steepness[rng.random(len(heights)) < 0.3] = np.nan

    stations = np.array([5, 5, 9, 2])

    height, sigma, count, met, number, lower = fuse_cells(
        starts, heights, sigmas, views, stations, steepness, 0.05, 3.0
    )

    for cell, size in enumerate(sizes):
        part = slice(starts[cell], starts[cell + 1])
        if size == 0:
            assert np.isnan(height[cell])
            assert count[cell] == number[cell] == 0
            continue
        parts = surfaces(heights[part], sigmas[part], stations[views[part]], steepness[part], 0.05)
        assert number[cell] == len(parts)
        results = [
            fused(heights[p], sigmas[p], views[p], stations, 3.0)
            for p in (starts[cell] + np.sort(members) for members in parts)
        ]
        h, s, n, places = results[0]
        np.testing.assert_allclose(height[cell], h, atol=2e-6)
        np.testing.assert_allclose(sigma[cell], s, rtol=1e-3)
        assert count[cell] == n
        assert met[cell] == places
        below = results[-1][0] if len(parts) > 1 else np.nan
        np.testing.assert_allclose(lower[cell], below, atol=2e-6)
    assert 20 < (number > 1).sum() < 150


def test_heights_are_up_and_rows_go_south():
    grid = DemGrid(west=0.0, north=2.0, cell=1.0, rows=2, columns=2)
    enu = np.array([[0.5, 1.5, -10.0], [1.5, 1.5, -11.0], [0.5, 0.5, -12.0]])
    found = fuse_points(grid, points(enu, np.full(3, 0.01), np.arange(3)), np.arange(3))
    np.testing.assert_allclose(found.height[[0, 0, 1], [0, 1, 0]], [-10, -11, -12])
    assert np.isnan(found.height[1, 1])
    assert found.count.tolist() == [[1, 1], [1, 0]]
    assert found.surfaces.tolist() == [[1, 1], [1, 0]]


def test_a_few_outliers_do_not_move_a_cell():
    rng = np.random.default_rng(3)
    grid = DemGrid(west=0.0, north=1.0, cell=1.0, rows=1, columns=1)
    enu = np.column_stack([rng.uniform(0.1, 0.9, (60, 2)), rng.normal(5.0, 0.003, 60)])
    stations = np.arange(6)
    clean = fuse_points(grid, points(enu, np.full(60, 0.003), np.arange(60) // 10), stations)
    enu[::6, 2] += 0.3
    dirty = fuse_points(grid, points(enu, np.full(60, 0.003), np.arange(60) // 10), stations)
    assert abs(dirty.height[0, 0] - clean.height[0, 0]) < 0.001
    assert abs(clean.height[0, 0] - 5.0) < 3 * clean.sigma[0, 0]
    assert 0.0005 < clean.sigma[0, 0] < 0.003  # six views, each 3 mm


def test_small_gaps_are_bridged_on_the_plane_and_large_ones_stay():
    rows, columns = np.mgrid[:30, :40]
    plane = (0.1 * rows - 0.05 * columns + 3.0).astype(np.float32)
    holed = plane.copy()
    holed[5:8, 5:8] = np.nan
    holed[12:26, 15:30] = np.nan
    sigma = np.where(np.isnan(holed), np.nan, 0.01).astype(np.float32)

    height, spread = fill_gaps(holed, sigma, 3)

    np.testing.assert_allclose(height[5:8, 5:8], plane[5:8, 5:8], atol=1e-5)
    assert (spread[5:8, 5:8] > 0.01).all()
    assert np.isnan(height[16:22, 19:26]).all()
    known = ~np.isnan(holed)
    np.testing.assert_array_equal(height[known], holed[known])
    edge = np.where(columns < 20, plane, np.nan).astype(np.float32)
    assert np.isnan(fill_gaps(edge, np.full_like(edge, 0.01), 3)[0][:, 20:]).all()


def test_strays_go_and_a_sheet_with_its_edge_stays():
    height = np.full((40, 40), np.nan, np.float32)
    height[:, :20] = 1.0
    height[30:32, 33:35] = 5.0
    kept = without_strays(height)
    assert kept[5:35, :20].all()
    assert not kept[:, 20:].any()


def test_slope_of_a_plane_is_its_tangent_and_unknown_next_to_gaps():
    rows, columns = np.mgrid[:9, :11]
    height = (0.3 * 0.01 * columns - 0.4 * 0.01 * rows).astype(np.float32)
    height[4, 5] = np.nan
    slope = slope_deg(height, 0.01)
    unknown = np.ones(height.shape, bool)
    unknown[1:-1, 1:-1] = False
    unknown[3:6, 4:7] = True
    np.testing.assert_array_equal(np.isnan(slope), unknown)
    np.testing.assert_allclose(slope[~unknown], np.rad2deg(np.arctan(0.5)), rtol=1e-4)
