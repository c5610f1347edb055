import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import Polygon

from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.executor import local_executor
from camera_calib.rig import design_rig
from missions.coverage import certificate as module
from missions.coverage.certificate import certificate
from missions.coverage.raster import border_rays_body, footprints_ne, grid_over, inside
from missions.coverage.stations import Stations
from missions.values.pattern import Pattern
from tests.oracles_coverage import area_of, counts_at, footprint_polygons, middles_ne

RIG = design_rig(CameraConfig(), WaterConfig())
ASKED = Pattern(spacing_m=1.0, step_m=0.5, half_across_m=0.6, half_along_m=0.55)


def wandering(count: int, seed: int, side_m: float = 6.0) -> Stations:
    """Stations of a vehicle that leans, rises and turns at random."""
    rng = np.random.default_rng(seed)
    return Stations(
        glass_ne=rng.uniform(0, side_m, (count, 2)),
        altitude_m=rng.uniform(1.0, 3.0, count),
        attitude_rad=np.column_stack(
            [rng.normal(0, 0.15, (count, 2)), rng.uniform(-math.pi, math.pi, count)]
        ),
        line=rng.integers(-1, 5, count),
    )


def test_footprints_are_those_of_poses_and_rays() -> None:
    stations = wandering(40, 1)
    borders = footprints_ne(
        *border_rays_body(RIG), stations.glass_ne, stations.altitude_m, stations.attitude_rad
    )

    expected = footprint_polygons(RIG, stations)
    for camera, name in enumerate(RIG.cameras):
        for border, polygon in zip(borders[:, camera], expected[name], strict=True):
            np.testing.assert_allclose(border, polygon.exterior.coords[:-1], atol=1e-9)


def test_counts_are_those_of_polygons_at_every_cell() -> None:
    area = area_of(shapely.box(0, 0, 6, 5))
    stations = wandering(60, 2)
    seen = certificate(area, RIG, stations, ASKED, cell_m=0.1)

    expected = counts_at(middles_ne(seen).reshape(-1, 2), RIG, stations)
    shape = seen.grid.shape
    pictures = [count.reshape(shape) for count in expected["pictures"].values()]
    lines = [count.reshape(shape) for count in expected["lines"].values()]
    np.testing.assert_array_equal(seen.pictures, sum(pictures))
    np.testing.assert_array_equal(seen.least_pictures, np.min(pictures, axis=0))
    np.testing.assert_array_equal(seen.least_lines, np.min(lines, axis=0))
    np.testing.assert_array_equal(seen.pairs, expected["pairs"].reshape(shape))
    assert seen.pictures.max() > 6


@st.composite
def stars(draw: st.DrawFn) -> Polygon:
    """A star-shaped polygon, with a hole at times."""
    count = draw(st.integers(3, 12))
    radii = draw(st.lists(st.floats(1.0, 5.0), min_size=count, max_size=count))
    turned = draw(st.floats(0, 6.3))
    angles = turned + 2 * math.pi * np.arange(count) / count
    star = Polygon(np.array(radii)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)]))
    inner = star.buffer(-0.4)
    if draw(st.booleans()) and isinstance(inner, Polygon) and not inner.is_empty:
        return Polygon(star.exterior, [shapely.affinity.scale(inner, 0.6, 0.6).exterior])
    return star


@settings(deadline=None, max_examples=60)
@given(star=stars())
def test_cells_inside_are_those_whose_middle_is_inside(star: Polygon) -> None:
    area = area_of(shapely.union_all([star, shapely.affinity.translate(star, 20.0, 3.0)]))
    grid = grid_over(area, 0.17)

    mask = inside(area, grid)

    rows, columns = np.meshgrid(np.arange(grid.rows), np.arange(grid.columns), indexing="ij")
    middles = grid.places_of(np.stack([rows + 0.5, columns + 0.5], axis=-1))
    expected = shapely.contains_xy(area.survey, middles[..., 0], middles[..., 1])
    edge = shapely.distance(shapely.points(middles), area.survey.boundary) < 1e-9
    np.testing.assert_array_equal(mask[~edge], expected[~edge])
    # The grid reaches over all of the area.
    cells = grid.cells_of(area.corners_ne)
    assert cells.min() >= -1e-6
    assert np.all(cells.max(axis=0) <= np.array(grid.shape) + 1e-6)


def test_tiles_chunks_and_threads_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    area = area_of(Polygon([(0, 0), (6, 1), (5, 6), (-1, 4)]))
    stations = wandering(50, 3)
    whole = certificate(area, RIG, stations, ASKED, cell_m=0.11)
    monkeypatch.setattr(module, "_TILE", 17)
    monkeypatch.setattr(module, "_CHUNK", 7)

    tiled = certificate(area, RIG, stations, ASKED, cell_m=0.11, executor=local_executor(2))

    for name in ("pictures", "least_pictures", "least_lines", "pairs"):
        within = whole.inside
        np.testing.assert_array_equal(getattr(tiled, name)[within], getattr(whole, name)[within])
    assert tiled.to_json() == whole.to_json()


def test_a_picture_past_the_sea_floor_sees_nothing() -> None:
    area = area_of(shapely.box(-3, -3, 3, 3))
    level = wandering(3, 4)
    rolled = level.attitude_rad.copy()
    rolled[1] = [math.radians(75.0), 0.0, 0.0]
    stations = replace(level, attitude_rad=rolled)

    seen = certificate(area, RIG, stations, ASKED)
    others = certificate(area, RIG, stations.some(np.array([0, 2])), ASKED, cell_m=seen.grid.cell_m)

    assert (seen.blind, others.blind) == (1, 0)
    np.testing.assert_array_equal(seen.pictures, others.pictures)
    assert seen.stations == 3
