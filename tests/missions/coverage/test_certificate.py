import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from alice_survey.core.config import SurveyConfig
from alice_survey.core.errors import PlanError
from alice_survey.core.executor import local_executor
from alice_survey.core.frames import Array
from missions.coverage import certificate as module
from missions.coverage.certificate import Certificate, certificate
from missions.coverage.holes import find_holes, geodetic
from missions.coverage.raster import border_rays_body, footprints_ne, grid_over
from missions.coverage.raster import inside as cells_inside
from missions.coverage.stations import Stations, stations_of_lines, stations_of_plan, sure_pattern
from missions.plan.planner import plan_survey
from missions.values.footprint import footprint_size_m
from missions.values.pattern import Pattern
from tests.missions.exports.plans import RIG
from tests.oracles_coverage import (
    DATUM,
    area_of,
    counts_at,
    footprint_polygons,
    lawnmower,
    middles_ne,
    pinhole_rig,
    shifted,
    stations_at,
)
from tests.strategies_areas import areas

ONCE = Pattern(spacing_m=1.0, step_m=1.0, half_across_m=0.5, half_along_m=0.5)
ASKED = Pattern(spacing_m=1.0, step_m=0.5, half_across_m=0.6, half_along_m=0.55)


def shares_of(certificate: Certificate, counts: NDArray[np.uint16]) -> Array:
    """Share of the area, (N,), that is seen 0, 1, 2, ... times."""
    return np.bincount(counts[certificate.inside]) / certificate.inside.sum()


def misjudged_m2(certificate: Certificate, shape: BaseGeometry) -> float:
    """The most that counting middles of cells can be wrong by for a shape.

    Only cells that its outline passes through can be: no more than 2 sqrt(2) times its length in
    cells, and four.
    """
    cell_m = certificate.grid.cell_m
    return float((2 * math.sqrt(2) * shape.length / cell_m + 4) * cell_m**2)


def test_one_rectangle_covers_its_own_area() -> None:
    """2 x 1 m from 1 m altitude, aligned with a grid of 5 cm: not one cell is misjudged."""
    rig = pinhole_rig(2.0, 1.0)
    area = area_of(shapely.box(0, 0, 5, 5))

    seen = certificate(area, rig, stations_at([(2.5, 2.5)]), ONCE, cell_m=0.05)

    assert seen.grid.shape == (100, 100)
    assert seen.covered_share == pytest.approx(2.0 / 25.0, abs=1e-12)
    assert (seen.stations, seen.taken, seen.fewest_pictures) == (1, 1, 0)
    assert shares_of(seen, seen.pictures) == pytest.approx([0.92, 0.08], abs=1e-12)
    higher = certificate(area, rig, stations_at([(2.5, 2.5)], 1.5), ONCE, cell_m=0.05)
    assert higher.covered_share == pytest.approx(1.5**2 * 2.0 / 25.0, abs=0.003)


def test_stereo_is_what_both_cameras_see_at_once() -> None:
    """Two cameras 0.5 m apart see 1.5 of 2 m together; a second station may not stand in."""
    rig = pinhole_rig(2.0, 1.0, baseline_m=0.5)
    area = area_of(shapely.box(0, 0, 5, 5))

    one = certificate(area, rig, stations_at([(2.5, 2.0)]), ONCE, cell_m=0.05)
    assert one.covered_share * 25 == pytest.approx(2.5, abs=1e-9)
    assert one.stereo_share * 25 == pytest.approx(1.5, abs=1e-9)
    assert one.every_camera_share == one.stereo_share

    # 1.75 m to starboard: a quarter of a metre is seen by the right camera from the first station
    # and by the left from the second, but by both from none. The right one looks past the area.
    two = certificate(area, rig, stations_at([(2.5, 2.0), (2.5, 3.75)]), ONCE, cell_m=0.05)
    assert two.stereo_share * 25 == pytest.approx(3.0, abs=1e-9)
    assert two.every_camera_share * 25 == pytest.approx(3.25, abs=1e-9)
    assert two.covered_share * 25 == pytest.approx(4.0, abs=1e-9)


@pytest.mark.parametrize("roll_deg", [-20.0, 10.0])
def test_a_roll_moves_the_picture_as_a_mirror_does(roll_deg: float) -> None:
    """Edges of a pinhole's picture lie at the tangents of half the view plus and less the roll."""
    rig = pinhole_rig(2.0, 1.0)
    area = area_of(shapely.box(-1.5, -4, 1.5, 4))
    attitude = np.array([[math.radians(roll_deg), 0.0, 0.0]])

    seen = certificate(area, rig, stations_at([(0, 0)], attitude_rad=attitude), ONCE, cell_m=0.02)

    middle = middles_ne(seen)
    east = middle[..., 1][(np.abs(middle[..., 0]) < 0.03) & (seen.pictures > 0)]
    # Rolled to starboard (positive), the camera under the hull looks to port.
    edges = np.tan(np.array([-math.pi / 4, math.pi / 4]) - math.radians(roll_deg))
    assert east.min() == pytest.approx(edges[0], abs=0.02)
    assert east.max() == pytest.approx(edges[1], abs=0.02)


@settings(deadline=None, max_examples=12)
@given(seed=st.integers(0, 10**6))
def test_shares_are_those_of_the_union_of_polygons(seed: int) -> None:
    rng = np.random.default_rng(seed)
    area = area_of(Polygon([(0, 0), (7, 1), (8, 6), (3, 4), (-1, 6)]))
    count = 25
    stations = Stations(
        glass_ne=rng.uniform(0, 6, (count, 2)),
        altitude_m=rng.uniform(1.5, 2.5, count),
        attitude_rad=np.column_stack([rng.normal(0, 0.1, (count, 2)), rng.uniform(-3, 3, count)]),
        line=rng.integers(0, 4, count),
    )

    seen = certificate(area, RIG, stations, ONCE)

    polygons = footprint_polygons(RIG, stations)
    any_camera = unary_union([*polygons["left"], *polygons["right"]])
    both = unary_union([a & b for a, b in zip(polygons["left"], polygons["right"], strict=True)])
    for share, shape in ((seen.covered_share, any_camera), (seen.stereo_share, both)):
        within = shape.intersection(area.survey)
        max_m2 = misjudged_m2(seen, within) + misjudged_m2(seen, area.survey)
        error_m2 = abs(share * area.survey.area - within.area)
        assert error_m2 <= max_m2
        assert error_m2 < 2e-3 * area.survey.area  # as it is in practice


@settings(deadline=None, max_examples=12)
@given(turn=st.floats(-3.1, 3.1), north=st.floats(-300, 300), east=st.floats(-300, 300))
def test_turning_and_moving_everything_changes_nothing(
    turn: float, north: float, east: float
) -> None:
    shape = Polygon([(0, 0), (9, 0), (9, 3), (4, 5), (0, 5)])
    lines = lawnmower(9, 5, 1.7, 0.6)
    home = stations_of_lines(lines, 2.0)
    c, s = math.cos(turn), math.sin(turn)
    turned = replace(
        home,
        glass_ne=home.glass_ne @ np.array([[c, s], [-s, c]]) + [north, east],
        attitude_rad=home.attitude_rad + np.array([0.0, 0.0, turn]),
    )
    moved = shapely.affinity.affine_transform(shape, [c, -s, s, c, north, east])

    here = certificate(area_of(shape), RIG, home, ONCE)
    there = certificate(area_of(moved), RIG, turned, ONCE)

    assert there.grid.cell_m == pytest.approx(here.grid.cell_m)
    assert there.area_m2 == pytest.approx(here.area_m2)
    # The grid turns with the area; cells differ where rounding puts a middle across an edge.
    for name in ("covered_share", "stereo_share", "share_at_overlap", "mean_pictures"):
        assert getattr(there, name) == pytest.approx(getattr(here, name), abs=2e-3)
    assert 0.5 < here.share_at_overlap < here.covered_share < 1.0


@settings(deadline=None, max_examples=25)
@given(
    altitude_m=st.floats(1.0, 5.0), forward=st.floats(0.0, 0.85), side=st.floats(0.05, 0.8),
    shift=st.floats(0.0, 1.0),
)  # fmt: skip
def test_an_endless_pattern_is_seen_as_often_as_it_promises(
    altitude_m: float, forward: float, side: float, shift: float
) -> None:
    across_m, along_m = footprint_size_m(RIG.cameras["left"], altitude_m)
    step_m, spacing_m = along_m * (1 - forward), across_m * (1 - side)
    asked = sure_pattern(RIG, altitude_m, spacing_m, step_m)
    if 2 * asked.half_across_m < spacing_m or 2 * asked.half_along_m < step_m:
        return  # gaps are requested
    north_m, east_m = 2 * along_m, 2 * across_m
    lines = lawnmower(north_m, east_m, spacing_m, step_m, over_m=2 * across_m)
    stations = stations_of_lines(lines, altitude_m)
    stations = shifted(stations, shift * step_m, shift * spacing_m)

    seen = certificate(area_of(shapely.box(0, 0, north_m, east_m)), RIG, stations, asked)

    assert seen.share_at_overlap == 1.0
    assert seen.fewest_lines >= asked.passes
    assert seen.fewest_pictures >= asked.passes * asked.pictures
    # ... and nowhere near twice as often as it must be, or than the mean over places.
    assert seen.fewest_lines <= max(asked.passes + 1, across_m / spacing_m + 1e-6)


def test_a_line_left_out_is_the_hole() -> None:
    area = area_of(shapely.box(0, 0, 15, 17))
    lines = lawnmower(15, 17, 1.0, 0.46, over_m=1.0)
    asked = sure_pattern(RIG, 2.0, 1.0, 0.46)
    whole = certificate(area, RIG, stations_of_lines(lines, 2.0), asked)
    assert whole.share_at_overlap == 1.0
    assert find_holes(whole) == ()
    left_out = 8
    rest = stations_of_lines([line for i, line in enumerate(lines) if i != left_out], 2.0)

    seen = certificate(area, RIG, rest, asked)
    holes = find_holes(seen)

    polygons = footprint_polygons(RIG, rest)
    unseen = area.survey - unary_union([*polygons["left"], *polygons["right"]])
    assert len(holes) == 1
    hole = holes[0]
    assert hole.unseen_m2 == pytest.approx(unseen.area, abs=misjudged_m2(seen, unseen))
    assert hole.unseen_m2 == pytest.approx(unseen.area, rel=0.1)
    assert hole.area_m2 == pytest.approx((1 - seen.share_at_overlap) * 255.0, rel=0.01)
    assert hole.outline.area == pytest.approx(hole.area_m2, rel=0.02)
    assert hole.length_m == pytest.approx(15.0, abs=0.05)
    assert hole.fewest_pictures == 0
    east = lines[left_out].start_ne_m[1]
    assert hole.outline.centroid.y == pytest.approx(east, abs=0.15)
    assert shapely.Point(7.0, east).within(hole.outline)
    # The place in latitude and longitude is the one in metres.
    back = DATUM.ned_from_geodetic(np.array([[hole.latitude_deg, hole.longitude_deg, 0.0]]))[0]
    np.testing.assert_allclose(back[:2], hole.place_ne, atol=1e-3)
    assert hole.outline.contains(shapely.Point(hole.place_ne))


def test_holes_come_worst_first_and_touching_cells_are_one() -> None:
    rig = pinhole_rig(2.0, 2.0)
    area = area_of(shapely.box(0, 0, 8, 8))
    places = [(n, e) for n in (1, 3, 5, 7) for e in (1, 3, 5, 7)]
    missing = {(1, 1), (3, 3), (7, 5), (7, 7)}
    stations = stations_at([place for place in places if place not in missing])

    holes = find_holes(certificate(area, rig, stations, ONCE, cell_m=0.1))

    assert [round(hole.area_m2, 6) for hole in holes] == [8.0, 8.0]
    assert sorted(hole.outline.area for hole in holes) == pytest.approx([8.0, 8.0])
    assert all(hole.outline.is_valid for hole in holes)
    shapes = sorted(shapely.normalize(hole.outline).wkt for hole in holes)
    squares = [shapely.box(0, 0, 2, 2) | shapely.box(2, 2, 4, 4), shapely.box(6, 4, 8, 8)]
    for wkt, expected in zip(shapes, squares, strict=True):
        assert shapely.from_wkt(wkt).symmetric_difference(expected).area < 1e-9
    assert geodetic(holes[0].outline, area.datum).is_valid


def test_faults_name_the_numbers() -> None:
    area = area_of(shapely.box(0, 0, 3, 4))
    with pytest.raises(PlanError, match="-1 m"):
        certificate(area, RIG, stations_at([(0, 0)]), ONCE, cell_m=-1.0)
    with pytest.raises(PlanError, match=r"1e-06 m.* 0\.0008"):
        certificate(area, RIG, stations_at([(0, 0)]), ONCE, cell_m=1e-6)
    with pytest.raises(ValueError):
        stations_at([(math.nan, 0.0)])
    with pytest.raises(ValueError):
        stations_at([(0.0, 0.0)], altitude_m=np.ones(2))


def test_shares_do_not_alias_with_steps_and_lines() -> None:
    """Steps of eight twentieths of a footprint: by closed form 2.8 pictures on 1.39 lines."""
    rig = pinhole_rig(1.0, 1.12)
    asked = sure_pattern(rig, 1.0, 0.72, 0.4)
    stations = stations_of_lines(lawnmower(16, 14.4, 0.72, 0.4, over_m=2.0), 1.0)

    seen = certificate(area_of(shapely.box(0, 0, 16, 14.4)), rig, stations, asked)

    on_a_line, lines = {2: 0.2, 3: 0.8}, {1: 2 - 1 / 0.72, 2: 1 / 0.72 - 1}
    shares = np.zeros(7)
    for (n, p), (m, q) in itertools.product(on_a_line.items(), lines.items()):
        shares[n * m] += p * q
    assert shares_of(seen, seen.pictures) == pytest.approx(shares, abs=6e-3)
    by_lines = shares_of(seen, seen.least_lines)
    assert by_lines == pytest.approx([0.0, *lines.values()], abs=6e-3)


@pytest.mark.parametrize(("spacing_m", "step_m"), [(0.5, 0.25), (0.4, 0.2), (1.0, 0.5)])
def test_rectangles_are_seen_exactly_as_often_as_they_fit(spacing_m: float, step_m: float) -> None:
    """Of 2 x 1 m footprints without bulge: passes = 2 / spacing, pictures = 1 / step."""
    rig = pinhole_rig(2.0, 1.0)
    asked = sure_pattern(rig, 1.0, spacing_m, step_m)
    assert (asked.passes, asked.pictures) == (round(2 / spacing_m), round(1 / step_m))
    stations = stations_of_lines(lawnmower(3, 4, spacing_m, step_m, over_m=2.0), 1.0)
    stations = shifted(stations, 0.0123, 0.0171)  # off the grid, so that no middle lies on an edge

    seen = certificate(area_of(shapely.box(0, 0, 3, 4)), rig, stations, asked)

    assert seen.share_at_overlap == 1.0
    assert np.all(seen.least_lines[seen.inside] == asked.passes)
    assert np.all(seen.least_pictures[seen.inside] == asked.passes * asked.pictures)


def test_shares_of_the_papers_mission_are_those_of_a_finer_grid() -> None:
    config = SurveyConfig()
    planned = plan_survey(config, RIG)
    seen, stations = planned.certificate, stations_of_plan(planned.plan)
    fine = certificate(
        planned.plan.area, RIG, stations, seen.pattern, cell_m=seen.grid.cell_m / 7.37
    )

    assert seen.inside.sum() < 1.05 * 80_000
    for kind in ("pictures", "least_pictures", "least_lines", "pairs"):
        ours, shares = (shares_of(one, getattr(one, kind)) for one in (seen, fine))
        assert ours == pytest.approx(shares[: len(ours)], abs=3e-3)
    assert seen.mean_pictures == pytest.approx(fine.mean_pictures, abs=0.01)


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


@settings(deadline=None, max_examples=60)
@given(shape=areas())
def test_cells_inside_are_those_whose_middle_is_inside(shape: MultiPolygon) -> None:
    area = area_of(shape)
    grid = grid_over(area, 0.17)

    mask = cells_inside(area, grid)

    rows, columns = np.meshgrid(np.arange(grid.rows), np.arange(grid.columns), indexing="ij")
    middles = grid.places_of(np.stack([rows + 0.5, columns + 0.5], axis=-1))
    expected = shapely.contains_xy(area.survey, middles[..., 0], middles[..., 1])
    edge = shapely.distance(shapely.points(middles), area.survey.boundary) < 1e-9
    np.testing.assert_array_equal(mask[~edge], expected[~edge])
    # The grid reaches over all of the area.
    cells = grid.cells_of(area.corners_ne)
    assert cells.min() >= -1e-6
    assert np.all(cells.max(axis=0) <= np.array(grid.shape) + 1e-6)


@pytest.mark.slow
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
