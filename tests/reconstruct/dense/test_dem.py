import numpy as np
import pytest

from reconstruct.dense.dem import (
    FusedCells,
    cells_over,
    fill_gaps,
    slope_deg,
    widen_at_rims,
    without_strays,
)
from reconstruct.dense.surface_points import SURFACE_POINT
from reconstruct.raster import DemGrid, grid_over
from tests.oracles_dense import projected

GRID = DemGrid(west=0.0, north=1.2, cell=0.1, rows=12, columns=15)


def surface(enu: np.ndarray, normals: np.ndarray, sigma: float = 0.01) -> np.ndarray:
    found = np.zeros(len(enu), SURFACE_POINT)
    found["enu"], found["normal"], found["sigma"] = enu, normals, sigma
    found["views"], found["stations"] = 4, 2
    return found


def plane_points(rise: tuple[float, float], shift: float, turn_deg: float) -> np.ndarray:
    """Points of a lattice of the cells' size that is shifted and turned, on a plane."""
    i, j = np.mgrid[-30:30, -30:30] * 0.1
    turn = np.deg2rad(turn_deg)
    east = np.cos(turn) * i - np.sin(turn) * j + shift
    north = np.sin(turn) * i + np.cos(turn) * j - 0.3 * shift
    up = 2.0 + rise[0] * east + rise[1] * north
    normal = np.array([-rise[0], -rise[1], 1.0]) / np.sqrt(1 + rise[0] ** 2 + rise[1] ** 2)
    enu = np.stack([east.ravel(), north.ravel(), up.ravel()], axis=1)
    return surface(enu, np.tile(normal, (len(enu), 1)))


@pytest.mark.parametrize("rise", [(0.0, 0.0), (0.4, -1.0), (-2.0, 1.5)])
@pytest.mark.parametrize(("shift", "turn_deg"), [(0.05, 0.0), (0.031, 0.0), (0.02, 37.0)])
def test_heights_of_a_plane_are_exact_wherever_its_points_lie(
    rise: tuple[float, float], shift: float, turn_deg: float
):
    """Cells between the points of a turned lattice may have too few of them; most have not."""
    found = cells_over(GRID, plane_points(rise, shift, turn_deg))
    east, north = np.meshgrid(GRID.east_of(np.arange(15) + 0.5), GRID.north_of(np.arange(12) + 0.5))
    known = np.isfinite(found.height)
    assert known.mean() > 0.99
    expected = 2.0 + rise[0] * east + rise[1] * north
    np.testing.assert_allclose(found.height[known], expected[known], atol=2e-5)
    slope = np.sqrt(1 + rise[0] ** 2 + rise[1] ** 2)  # errors are along the normal
    np.testing.assert_allclose(found.sigma[known], 0.01 * slope, rtol=1e-3)
    assert (found.count[known] == 4).all()
    assert (found.surfaces[known] == 1).all()


def test_cells_over_equals_its_slow_twin():
    rng = np.random.default_rng(2)
    count = 700
    enu = rng.uniform([-0.1, -0.1, 0.0], [1.6, 1.3, 0.1], (count, 3))
    enu[rng.random(count) < 0.3, 2] += 1.0
    enu[rng.random(count) < 0.2, 2] += 0.5
    normals = rng.normal([0.0, 0.0, 1.5], 0.5, (count, 3))
    normals[rng.random(count) < 0.05, 2] = 0.0
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    enu[np.abs(normals[:, 2]) < 0.18, 2] = -0.5  # feet of walls
    points = surface(enu, normals)
    points["sigma"] = rng.uniform(0.002, 0.02, count)
    points["shared"] = rng.uniform(0.0, 0.01, count)
    points["views"] = rng.integers(1, 9, count)
    points["stations"] = rng.integers(1, 4, count)

    found = cells_over(GRID, points)

    several = 0
    for row in range(GRID.rows):
        for column in range(GRID.columns):
            expected = projected(GRID, points, row, column)
            for name, value in expected.items():
                np.testing.assert_allclose(
                    getattr(found, name)[row, column], value, rtol=2e-4, atol=2e-5, err_msg=name
                )
            several += expected["surfaces"] > 1
    assert 20 < several < 170
    assert (np.isnan(found.height)).sum() < 15


def test_where_a_wall_stands_its_ends_are_within_reach():
    floor = plane_points((0.0, 0.0), 0.05, 0.0)
    up = np.arange(0.0, 1.0, 0.1)
    wall = surface(
        np.column_stack([np.full(10, 0.75), np.full(10, 0.45), up]),
        np.tile([0.0, -1.0, 0.05], (10, 1)) / np.hypot(1.0, 0.05),
    )
    found = cells_over(GRID, np.concatenate([floor, wall]))
    np.testing.assert_allclose(found.height, 2.0, atol=1e-5)
    unsure = found.sigma > 0.011
    assert (found.surfaces == np.where(unsure, 2, 1)).all()
    assert unsure[7, 7]
    assert unsure.sum() == 1
    assert 0.3 < found.sigma[7, 7] / 2.0 < 0.4  # the wall goes down by 2 m
    wall["enu"][:, 2] += 2.0
    found = cells_over(GRID, np.concatenate([floor, wall]))
    assert np.isnan(found.height[7, 7])  # what the wall carries is not known
    assert np.isnan(found.height).sum() == 1


def test_heights_at_rims_are_as_unsure_as_the_rim():
    """Rims lie anywhere, and the surface shows them off by a share of a cell."""
    rng = np.random.default_rng(5)
    cell, high, ratios = 0.1, 2.0, []
    east = (np.arange(12) + 0.5) * cell
    for _ in range(400):
        rim = 0.6 + cell * rng.uniform(-0.5, 0.5)
        found_rim = rim + rng.normal(0, cell / np.sqrt(12))
        true, shown = (np.where(east < x, high, 0.2 * east) for x in (rim, found_rim))
        cells = flat_cells(np.tile(shown, (3, 1)))
        found = widen_at_rims(cells, cell)
        near = found.sigma[1] > 0.011
        assert near.sum() == 2
        np.testing.assert_array_equal(found.surfaces[1], np.where(near, 2, 1))
        np.testing.assert_array_equal(found.height, cells.height)
        ratios.append((shown - true) / found.sigma[1])
    # the two cells next to the rim have all of the errors
    assert 0.85 < np.sqrt(np.mean(np.square(ratios)) * len(east) / 2) < 1.15
    assert np.abs(ratios).max() < 5.0


@pytest.mark.parametrize("rise", [0.0, 1.0, 5.0])
def test_slopes_creases_and_curves_are_no_rims(rise: float):
    rows, columns = np.mgrid[:20, :30] * 0.1
    for height in (rise * columns, rise * np.abs(columns - 1.5), rise * rows * columns / 3.0):
        found = widen_at_rims(flat_cells(height), 0.1)
        inner = np.s_[1:-1, 1:-1]  # beyond its own border nothing is known of a slope
        np.testing.assert_allclose(found.sigma[inner], 0.01, rtol=1e-5)
        assert (found.surfaces[inner] == 1).all()


def flat_cells(height: np.ndarray) -> FusedCells:
    known = np.isfinite(height)
    ones = np.where(known, 1, 0).astype(np.uint8)
    return FusedCells(
        height=height.astype(np.float32), sigma=np.where(known, 0.01, np.nan).astype(np.float32),
        count=ones.astype(np.uint16), stations=ones, surfaces=ones,
        lower=np.full(height.shape, np.nan, np.float32),
    )  # fmt: skip


def test_no_step_is_averaged():
    height = np.full((12, 20), 1.0, np.float32)
    height[:, 10:] = 1.5
    height[:, 9:12] = np.nan
    sigma = np.where(np.isnan(height), np.nan, 0.01).astype(np.float32)
    step, spread = fill_gaps(height, sigma, 3, 0.05, over_steps=True)  # 0.5 over 4 cells
    assert (step[3:9, 9:12] == 1.0).all()  # it lies behind the rim
    assert (spread[3:9, 9:12] > 0.25).all()  # half of what lies between
    left_out, _ = fill_gaps(height, sigma, 3, 0.05, over_steps=False)
    assert np.isnan(left_out[:, 9:12]).all()
    slope, _ = fill_gaps(height, sigma, 3, 0.2, over_steps=True)
    np.testing.assert_allclose(slope[3:9, 10], 1.25, atol=1e-6)


def test_grid_covers_its_boxes_on_whole_cells():
    grid = grid_over([(-1.23, 0.31, 2.0, 1.0), (0.0, -0.42, 1.1, 0.9)], 0.1)
    assert grid.west == pytest.approx(-0.5)
    assert grid.north == pytest.approx(2.0)
    assert (grid.rows, grid.columns) == (33, 15)
    assert grid.east_of(grid.columns) == pytest.approx(1.0)
    assert grid.north_of(grid.rows) == pytest.approx(-1.3)
    moved = grid.translate(10.0, -5.0).window(3, 2, 4, 5)
    assert moved.west == pytest.approx(9.7)
    assert moved.north == pytest.approx(-3.3)


def test_small_gaps_are_bridged_on_the_plane_and_large_ones_stay():
    rows, columns = np.mgrid[:30, :40]
    plane = (0.1 * rows - 0.05 * columns + 3.0).astype(np.float32)
    holed = plane.copy()
    holed[5:8, 5:8] = np.nan
    holed[12:26, 15:30] = np.nan
    sigma = np.where(np.isnan(holed), np.nan, 0.01).astype(np.float32)

    height, spread = fill_gaps(holed, sigma, 3, 1.0, over_steps=False)

    np.testing.assert_allclose(height[5:8, 5:8], plane[5:8, 5:8], atol=1e-5)
    np.testing.assert_allclose(spread[5:8, 5:8], 0.01, atol=1e-5)
    assert np.isnan(height[16:22, 19:26]).all()
    known = ~np.isnan(holed)
    np.testing.assert_array_equal(height[known], holed[known])
    edge = np.where(columns < 20, plane, np.nan).astype(np.float32)
    assert np.isnan(
        fill_gaps(edge, np.full_like(edge, 0.01), 3, 1.0, over_steps=False)[0][:, 20:]
    ).all()


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
