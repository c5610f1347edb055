"""Figures of surfaces of known shape: closed forms, sigmas against draws of noise."""

import math
import tracemalloc
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterio.windows import Window
from scipy.special import ellipe

from alice_survey.core.frames import Array
from reconstruct.measure.areas import covered_shares, figures_of_all, surface_within
from reconstruct.measure.errors import own_correlation
from reconstruct.measure.figures import Measured
from reconstruct.measure.shapes import measure_line, measure_polygon, profile
from reconstruct.measure.surface import MeasuredSurface
from reconstruct.raster import DemGrid, tiled_raster
from tests.reconstruct.measure.synthetic import FRAME, Drawn, Sigmas, grid, without_errors

SQUARE = [(-0.4, -0.4), (0.4, -0.4), (0.4, 0.4), (-0.4, 0.4)]
SLANTED = [(-0.41, -0.32), (0.33, -0.4), (0.4, 0.21), (0.02, 0.43), (-0.35, 0.3)]


def named(figures: Sequence[Measured]) -> dict[str, Measured]:
    return {figure.name: figure for figure in figures}


def ramp(x: Array, y: Array) -> Array:
    return np.asarray(0.3 * x - 0.4 * y - 10.0)


def waves(x: Array, y: Array) -> Array:
    return np.asarray(0.02 * np.sin(2 * np.pi * x / 0.2) + 0.0 * y)


def hills(x: Array, y: Array) -> Array:
    return np.asarray(0.05 * np.sin(9 * x) * np.cos(7 * y) + 0.1 * x - 10.0)


def test_a_tilted_plane_has_the_figures_of_geometry(tmp_path: Path) -> None:
    surface = without_errors(tmp_path, grid(1.0, 0.01), ramp)
    found = named(measure_polygon(surface, SLANTED, -10.2)[0])
    shape = shapely.Polygon(SLANTED)
    area = shape.area
    assert found["plan_area"].value == pytest.approx(area, rel=1e-9)
    assert found["rugosity"].value == pytest.approx(np.sqrt(1.25), rel=1e-6)
    assert found["surface_area"].value == pytest.approx(np.sqrt(1.25) * area, rel=1e-6)
    assert found["slope"].value == pytest.approx(np.degrees(np.arctan(0.5)), abs=1e-3)
    # down is west and north: 0.3 of each metre to the east goes up, 0.4 to the north goes down
    assert found["aspect"].value == pytest.approx(360 - np.degrees(np.arctan2(0.3, 0.4)), abs=1e-3)
    height = ramp(*shapely.get_coordinates(shape.centroid)[0]) + 10.2
    assert found["volume"].value == pytest.approx(height * area, rel=1e-5)
    over_rim = named(measure_polygon(surface, SLANTED, "rim")[0])
    for name in ("volume", "above", "below"):
        assert over_rim[name].value == pytest.approx(0.0, abs=1e-6 * area)
    line = named(measure_line(surface, [(-0.2, 0.1), (0.2, 0.4)]))
    rise = 0.3 * 0.4 - 0.4 * 0.3
    assert line["height_difference"].value == pytest.approx(rise, abs=1e-6)
    line = named(measure_line(surface, [(0.0, -0.2), (0.0, 0.3)]))
    assert line["slope"].value == pytest.approx(-np.degrees(np.arctan(0.4)), abs=1e-3)
    for name in ("length", "surface_length"):
        assert line[name].value == pytest.approx(0.5 * np.sqrt(1.16), rel=1e-5)


def test_a_hemisphere_has_its_area_and_volume(tmp_path: Path) -> None:
    def dome(x: Array, y: Array) -> Array:
        return np.sqrt(np.maximum(0.3**2 - x**2 - y**2, 0.0))

    surface = without_errors(tmp_path, grid(1.0, 0.004), dome)
    found = named(measure_polygon(surface, SQUARE, 0.0)[0])
    assert found["above"].value == pytest.approx(2 / 3 * np.pi * 0.3**3, rel=2e-3)
    assert found["below"].value == pytest.approx(0.0, abs=1e-9)
    # a vertical rim is steeper than any cell: seen from above, all that is less than 70° steep
    angles = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    cap = 0.3 * np.sin(np.radians(70)) * np.column_stack([np.cos(angles), np.sin(angles)])
    found = named(measure_polygon(surface, cap.tolist(), None)[0])
    assert found["surface_area"].value == pytest.approx(
        2 * np.pi * 0.3**2 * (1 - np.cos(np.radians(70))), rel=2e-3
    )
    assert "volume" not in found
    rim = named(measure_polygon(surface, cap.tolist(), "rim")[0])
    height = 0.3 * (1 - np.cos(np.radians(70)))
    volume = np.pi * height**2 * (3 * 0.3 - height) / 3
    assert rim["volume"].value == pytest.approx(volume, rel=5e-3)


def test_waves_are_as_rough_as_their_arc_is_long(tmp_path: Path) -> None:
    surface = without_errors(tmp_path, grid(1.0, 0.004), waves)
    steep = 2 * np.pi * 0.02 / 0.2
    # the arc of a sine over its length: 2/π √(1 + k²) E(k² / (1 + k²))
    arc = 2 / np.pi * np.sqrt(1 + steep**2) * ellipe(steep**2 / (1 + steep**2))
    found = named(measure_polygon(surface, SQUARE, None)[0])
    assert found["rugosity"].value == pytest.approx(arc, rel=1e-3)
    line = named(measure_line(surface, [(-0.4, 0.01), (0.4, 0.01)]))
    assert line["surface_length"].value == pytest.approx(arc * 0.8, rel=2e-3)
    square = named(measure_polygon(surface, [(0, 0), (0.2, 0), (0.2, 0.2), (0, 0.2)], None)[0])
    assert square["rugosity"].value == pytest.approx(arc, rel=2e-3)
    assert square["plan_area"].value == pytest.approx(0.04, rel=1e-9)


def test_noise_makes_no_floor_rougher(tmp_path: Path) -> None:
    """Without the correction a level floor would be 1 + v of slope noise v a side."""
    cells, rng = grid(1.0, 0.01), np.random.default_rng(5)
    for sigma in (0.001, 0.002):
        drawn = Drawn(tmp_path, cells, lambda x, y: 0.0 * x, Sigmas(own=sigma))
        noise = 2 * sigma**2 * float(1 - own_correlation(np.array(1.0))) / 0.01**2
        rough, line = [], []
        for _ in range(4):
            surface, _ = drawn.draw(rng)
            rough.append(named(measure_polygon(surface, SQUARE, None)[0])["rugosity"].value - 1)
            found = named(measure_line(surface, [(-0.4, 0.0), (0.4, 0.0)]))
            line.append(found["surface_length"].value / 0.8 - 1)
        assert abs(np.mean(rough)) < 0.15 * noise, (sigma, np.mean(rough) / noise)
        assert abs(np.mean(line)) < 0.25 * noise, (sigma, np.mean(line) / noise)


def test_clicks_are_in_the_sigmas_of_what_their_places_decide(tmp_path: Path) -> None:
    """Against moves of each coordinate, over a slope; what clicks do is all that errs."""
    surface = without_errors(tmp_path, grid(1.0, 0.05), lambda x, y: 0.3 * x - 0.2 * y)
    line = np.array([(-0.31, -0.22), (0.05, 0.13), (0.36, 0.17)])
    corners = np.array([(-0.3, -0.3), (0.3, -0.2), (0.25, 0.3), (-0.2, 0.25)])

    def all_of(surface: MeasuredSurface, line: Array, corners: Array) -> dict[str, Measured]:
        areas = named(measure_polygon(surface, corners.tolist(), None)[0])
        kept = {name: areas[name] for name in ("plan_area", "surface_area", "perimeter")}
        return kept | named(measure_line(surface, line.tolist()))

    click, step = 0.004, 1e-4
    stated = all_of(surface.picked_to(click), line, corners)
    gains = dict.fromkeys(stated, 0.0)
    for places in (line, corners):
        for at in np.ndindex(places.shape):
            ends = []
            for sign in (1, -1):
                places[at] += sign * step
                ends.append(all_of(surface, line, corners))
                places[at] -= sign * step
            for name in gains:
                gains[name] += ((ends[0][name].value - ends[1][name].value) / (2 * step)) ** 2
    for name, one in stated.items():
        assert one.sigma == pytest.approx(click * gains[name] ** 0.5, rel=0.03), name


SLOW, OWN = pytest.mark.slow, Sigmas(own=0.0012)
SHARED = Sigmas(shift=0.004, tilt=0.002, scale=0.002, bend=0.004)


@pytest.mark.parametrize(
    "sigmas",
    [replace(SHARED, own=0.0012), *(pytest.param(s, marks=SLOW) for s in (OWN, SHARED))],
    ids=["all", "own", "shared"],
)  # fmt: skip
def test_errors_are_as_large_as_their_sigmas(sigmas: Sigmas, tmp_path: Path) -> None:
    drawn, rng = Drawn(tmp_path, grid(1.0, 0.0125), hills, sigmas), np.random.default_rng(7)
    places = np.array([(-0.31, -0.22), (0.05, 0.13), (0.36, 0.17)])
    exact = without_errors(tmp_path, drawn.cells, hills)

    def all_of(surface: MeasuredSurface, line: Array, corners: Array) -> dict[str, Measured]:
        lengths = named(measure_line(surface, line.tolist()))
        over_rim = named(measure_polygon(surface, corners.tolist(), "rim")[0])
        areas = named(measure_polygon(surface, corners.tolist(), -10.05)[0])
        by_line = {f"line {name}": one for name, one in lengths.items()}
        return by_line | areas | {"rim": over_rim["volume"]}

    true = all_of(exact, places, np.array(SLANTED))
    misses, stated = defaultdict(list), defaultdict(list)
    for _ in range(40):
        surface, moved = drawn.draw(rng)
        for name, one in all_of(surface, moved(places), moved(np.array(SLANTED))).items():
            misses[name].append(one.value - true[name].value)
            stated[name].append(one.sigma)
    ratios = {
        name: float(np.sqrt(np.mean(np.square(errors))) / np.mean(stated[name]))
        for name, errors in misses.items()
        if np.mean(stated[name]) > 1e-6
    }
    wanted = {"line length", "line height_difference", "line surface_length", "surface_area",
              "rugosity", "rim", "volume", "mean_height"}  # fmt: skip
    assert wanted <= ratios.keys()
    # 40 draws know a sigma to 11 %
    for name in ("above", "below"):  # noise near the plane counts in full
        assert ratios.pop(name, 1.0) < 1.4
    wrong = {name: ratio for name, ratio in ratios.items() if not 0.7 < ratio < 1.4}
    assert not wrong, ratios


def test_a_scale_known_apart_counts_by_the_dimension(tmp_path: Path) -> None:
    surface = without_errors(tmp_path, grid(1.0, 0.02), hills)
    surface = replace(surface, errors=replace(surface.errors, scale_sigma=0.01))
    found = named(measure_polygon(surface, SQUARE, -10.2)[0])
    line = named(measure_line(surface, [(-0.3, 0.0), (0.3, 0.2)]))
    powers = {"plan_area": 2, "surface_area": 2, "volume": 3, "rugosity": 0}
    for one, power in [*((found[k], n) for k, n in powers.items()), (line["length"], 1),
                       (line["slope"], 0)]:  # fmt: skip
        assert one.sigma == pytest.approx(0.01 * power * abs(one.value), rel=1e-9, abs=1e-12)


def test_parts_of_a_large_polygon_add_up(tmp_path: Path) -> None:
    """More blocks than one, against the same polygon cut in two."""
    drawn = Drawn(tmp_path, grid(12.0, 0.02), hills, Sigmas(own=0.001))
    surface: MeasuredSurface = drawn.draw(np.random.default_rng(1))[0]
    left, right, whole = (
        named(measure_polygon(surface, [(a, -3.0), (b, -3.0), (b, -1.0), (a, -1.0)], -10.2)[0])
        for a, b in ((-5.5, 0.105), (0.105, 5.5), (-5.5, 5.5))
    )
    for name in ("surface_area", "volume", "above", "below", "plan_area"):
        both = left[name].value + right[name].value
        assert both == pytest.approx(whole[name].value, rel=1e-6)
    own = np.hypot(left["volume"].own, right["volume"].own)
    assert own == pytest.approx(whole["volume"].own, rel=0.01)


def test_a_profile_passes_its_corners(tmp_path: Path) -> None:
    surface = without_errors(tmp_path, grid(1.0, 0.01), hills)
    corners = [(-0.3, -0.2), (0.1, 0.1), (0.1, 0.4)]
    found = profile(surface, corners)
    np.testing.assert_allclose(found.samples.places[list(found.corners)], corners, atol=1e-12)
    np.testing.assert_allclose(found.along[list(found.corners)], [0.0, 0.5, 0.8], atol=1e-12)
    assert np.diff(found.along).max() <= 0.01 + 1e-12
    true = hills(*found.samples.places.T)
    assert np.abs(found.samples.height - true).max() < 2e-4


def test_memory_does_not_grow_with_the_raster(tmp_path: Path) -> None:
    """Of a surface of a thousand million cells only what is measured is read."""
    cells = DemGrid(west=0.0, north=400.0, cell=0.01, rows=40_000, columns=32_768)
    heights = np.full((512, 512), 2.0, np.float32)
    for name in ("dem", "sigma"):
        with tiled_raster(tmp_path / f"{name}.tif", cells, FRAME, "float32", np.nan, "") as raster:
            raster.write(heights if name == "dem" else 0.001 * heights, 1,
                         window=Window(2048, 2048, 512, 512))  # fmt: skip
    (tmp_path / "small").mkdir()
    drawn = Drawn(tmp_path / "small", grid(1.0, 0.1), ramp, Sigmas(shift=0.001))
    surface = replace(
        drawn.true, dem=tmp_path / "dem.tif", sigma=tmp_path / "sigma.tif", grid=cells
    )
    west, north = 20.48, 400.0 - 20.48
    corners = [(west + x, north - y) for x, y in ((0.5, 0.5), (0.5, 4.5), (4.5, 4.5), (4.5, 0.5))]
    tracemalloc.start()
    found = named(measure_polygon(surface, corners, 1.5)[0])
    line = named(measure_line(surface, [corners[0], corners[2]]))
    profile(surface, [(1.0, 1.0), (150.0, 100.0)])
    maximum = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found["volume"].value == pytest.approx(0.5 * 16.0, rel=1e-6)
    assert line["length"].value == pytest.approx(4.0 * np.sqrt(2), rel=1e-6)
    assert maximum < 400e6 < 4 * cells.rows * cells.columns / 10


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
    polygon = shapely.make_valid(shapely.Polygon(outer))
    if rng.random() < 0.5:
        polygon = shapely.difference(polygon, shapely.make_valid(shapely.Polygon(hole)))
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
