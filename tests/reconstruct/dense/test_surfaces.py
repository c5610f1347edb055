"""Cells with several surfaces, by synthetic points whose truth is known."""

import math
from typing import Any

import numpy as np
import pytest

from reconstruct.dense.dem import FusedCells, cells_over
from reconstruct.dense.points import Points, join_points
from reconstruct.dense.surface_points import fuse_surface, surfaces_of
from reconstruct.raster import DemGrid
from tests.oracles_dense import surfaces

CELL_M, SIGMA_M = 0.01, 0.002
STATIONS = np.arange(40) // 2
"""Two views a station."""


def sheet(
    rng: np.random.Generator,
    *,
    up_m: float = 0.0,
    slope_deg: float = 0.0,
    views: range = range(12),
    per_view: int = 6,
    noise_m: float = SIGMA_M,
    cells: int = 30,
) -> Points:
    """Points of views, as many in each of a row of cells, on a plane that rises to the north.

    Args:
        rng: of places and noise.
        up_m: height in the middle of the cells.
        slope_deg: of the plane.
        views: that see it.
        per_view: points of each in a cell.
        noise_m: of heights.
        cells: along the row.
    """
    count = len(views) * per_view * cells
    east = CELL_M * (np.arange(count) % cells + rng.uniform(0.001, 0.999, count))
    north = CELL_M * rng.uniform(0.001, 0.999, count)
    rise = math.tan(math.radians(slope_deg))
    up = up_m + rise * (north - CELL_M / 2) + rng.normal(0, noise_m, count)
    normal = np.array([0.0, -rise, 1.0]) / math.hypot(rise, 1.0)
    return Points(
        enu=np.column_stack([east, north, up]).astype(np.float32),
        normals=np.tile(normal, (count, 1)).astype(np.float32),
        colours=np.zeros((count, 3), np.uint8),
        sigmas=np.full(count, SIGMA_M * normal[2], np.float32),
        views=np.repeat(np.array(views, np.int32), per_view * cells),
    )


def together(*sheets: Points) -> Points:
    """Points of several sheets, in the order of their views."""
    joined = join_points(list(sheets))
    return Points._make(values[np.argsort(joined.views, kind="stable")] for values in joined)


def fused(points: Points, cells: int = 30) -> FusedCells:
    grid = DemGrid(west=0.0, north=CELL_M, cell=CELL_M, rows=1, columns=cells)
    return cells_over(grid, fuse_surface(points, STATIONS, CELL_M, np.zeros(3), 1.4))


def test_an_overhang_above_the_floor_is_two_surfaces():
    rng = np.random.default_rng(1)
    floor = sheet(rng, up_m=-5.0, slope_deg=20.0, views=range(12))
    roof = sheet(rng, up_m=-4.9, views=range(6, 10), per_view=3)  # fewer points, yet what is seen
    found = fused(together(floor, roof))
    assert (found.surfaces == 2).all()
    np.testing.assert_allclose(found.height, -4.9, atol=5 * SIGMA_M / math.sqrt(12))
    np.testing.assert_allclose(found.lower, -5.0, atol=1.5e-3)
    assert (found.count == 4).all()
    assert (found.stations == 2).all()
    assert (found.sigma < SIGMA_M).all()  # of the roof alone


@pytest.mark.parametrize("slope_deg", [0.0, 30.0, 60.0, 75.0, 79.0])
@pytest.mark.parametrize("per_view", [1, 6])
def test_one_surface_is_one_however_steep_and_noisy(slope_deg: float, per_view: int):
    rng = np.random.default_rng(3)
    found = fused(sheet(rng, slope_deg=slope_deg, per_view=per_view, views=range(8), cells=2000),
                  cells=2000)  # fmt: skip
    assert (found.surfaces == 1).all()
    assert np.isnan(found.lower).all()


@pytest.mark.parametrize("slope_deg", [81.0, 85.0, 89.0])
def test_a_cell_in_which_a_wall_stands_has_the_height_of_what_is_level(slope_deg: float):
    rng = np.random.default_rng(4)
    found = fused(together(sheet(rng, slope_deg=slope_deg, per_view=40), sheet(rng, up_m=0.5)))
    np.testing.assert_allclose(found.height, 0.5, atol=1.5e-3)
    assert (found.surfaces == 2).mean() > 0.95
    assert 0.15 < np.median(found.sigma) < 0.35  # the wall goes down by 0.5 m and more


def test_undersides_do_not_count():
    rng = np.random.default_rng(5)
    floor, roof = sheet(rng, up_m=-5.0), sheet(rng, up_m=-4.0, views=range(4))
    found = fused(together(floor, roof._replace(normals=-roof.normals)))
    assert (found.surfaces == 1).all()
    np.testing.assert_allclose(found.height, -5.0, atol=1e-3)


def test_what_one_station_sees_is_no_second_surface():
    rng = np.random.default_rng(6)
    floor = sheet(rng, up_m=-5.0, views=range(2, 12))
    wrong = sheet(rng, up_m=-4.8, views=range(2), per_view=4)  # both views of one station
    found = fused(together(floor, wrong))
    assert (found.surfaces == 1).all()
    np.testing.assert_allclose(found.height, -5.0, atol=1e-3)
    assert (found.count == 10).all()


@pytest.mark.parametrize(("gap_m", "surfaces"), [(0.012, 1), (0.045, 2)])
def test_a_gap_that_noise_and_cell_explain_divides_nothing(gap_m: float, surfaces: int):
    """Five sigmas of a difference are 14 mm; the cell is 10 mm."""
    rng = np.random.default_rng(8)
    found = fused(together(sheet(rng, up_m=-5.0), sheet(rng, up_m=-5.0 + gap_m)))
    assert (found.surfaces == surfaces).all()


@pytest.mark.parametrize("seed", range(40))
def test_surfaces_of_a_cell_are_those_of_its_slow_twin(seed: int):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 40))
    heights = rng.normal(0, 2e-3, count) + rng.choice([0.0, 0.018, 0.05, 0.12], count)
    sigmas = rng.uniform(2e-4, 2e-3, count)
    steepness = np.where(rng.random(count) < 0.3, np.nan, rng.uniform(0, 2, count))
    rows: list[Any] = [values.astype(np.float32) for values in (heights, sigmas, steepness)]
    places = rng.integers(0, 4, count)
    found, surface = surfaces_of(rows[0], rows[1], places, rows[2], CELL_M)
    expected = surfaces(rows[0], rows[1], places, rows[2], CELL_M)
    assert [sorted(np.flatnonzero(surface == n)) for n in range(found)] == [
        sorted(members) for members in expected
    ]
