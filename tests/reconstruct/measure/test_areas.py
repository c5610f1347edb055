"""Shares of cells against shapely, and sums over several polygons against draws of errors."""

import math
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from reconstruct.measure.areas import covered_shares, figures_of_all, surface_within
from tests.reconstruct.measure.synthetic import Drawn, Sigmas, grid, without_errors
from tests.reconstruct.measure.test_figures import hills

ROWS, COLUMNS = 12, 16


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), corners=st.integers(3, 40), whole=st.booleans())
def test_squares_are_covered_as_shapely_cuts_them(seed: int, corners: int, whole: bool) -> None:
    """Of polygons with holes that reach beyond the squares, some with corners on their sides."""
    rng = np.random.default_rng(seed)
    middle, reach = rng.uniform([0, 0], [COLUMNS, ROWS]), rng.uniform(0.1, 12.0)
    turns = np.sort(rng.uniform(0, 2 * np.pi, corners))
    out = reach * rng.uniform(0.5, 1.0, corners)
    outer = middle + out[:, None] * np.column_stack([np.cos(turns), np.sin(turns)])
    hole = middle + 0.3 * (outer - middle)
    if whole:
        outer = np.round(outer)
    polygon = shapely.make_valid(shapely.Polygon(outer, [hole] if rng.random() < 0.5 else []))
    parts = [p for p in shapely.get_parts(polygon) if p.geom_type == "Polygon"]
    turned = [shapely.orient_polygons(part, exterior_cw=True) for part in parts]
    rings = [shapely.get_coordinates(ring) for part in turned for ring in shapely.get_rings(part)]
    if not rings:
        return
    y, x = np.mgrid[:ROWS, :COLUMNS]
    cut = sum(shapely.area(shapely.intersection(shapely.box(x, y, x + 1, y + 1), p)) for p in parts)
    np.testing.assert_allclose(covered_shares(rings, (ROWS, COLUMNS)), cut, atol=1e-9)


@pytest.mark.parametrize(
    "sigmas", [Sigmas(own=0.0012), Sigmas(tilt=0.002, scale=0.002, bend=0.004)],
    ids=["own", "shared"],
)  # fmt: skip
def test_the_sigma_of_a_sum_is_that_of_draws(sigmas: Sigmas, tmp_path: Path) -> None:
    """What a scale does to one polygon it does to the other: sigmas add, and not their squares."""
    drawn, rng = Drawn(tmp_path, grid(1.0, 0.0125), hills, sigmas), np.random.default_rng(3)
    shapes = [shapely.box(-0.4, -0.35, -0.1, 0.3), shapely.box(0.1, -0.3, 0.4, 0.4)]
    exact = without_errors(tmp_path, drawn.cells, hills)
    true = sum(surface_within(exact, one).surface for one in shapes)
    missed, stated, apart = [], [], []
    for _ in range(40):
        surface, moved = drawn.draw(rng)
        there = [shapely.Polygon(moved(shapely.get_coordinates(one))) for one in shapes]
        parts = [surface_within(surface, one) for one in there]
        area = figures_of_all(surface, parts)[0]
        missed.append(area.value - true)
        stated.append(area.sigma)
        apart.append(math.hypot(*(figures_of_all(surface, [one])[0].sigma for one in parts)))
    ratio = float(np.sqrt(np.mean(np.square(missed))) / np.mean(stated))
    assert 0.7 < ratio < 1.4  # 40 draws know a sigma to 11 %
    together = np.mean(stated) / np.mean(apart)
    assert together == pytest.approx(1.0 if sigmas.own else np.sqrt(2), abs=0.12)
