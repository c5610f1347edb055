import math
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import LineString, MultiPolygon, Point, box

from alice_survey.core.errors import PlanError
from missions.route.ways import OPEN_WATER, TOUCH_M, Ways, edges_of
from missions.values.area import multipolygon
from missions.values.legs import Leg
from tests.oracles_route import inside, min_way_m, sampled_leg, way_m
from tests.strategies_areas import areas, places_in

seeds = st.integers(0, 2**32 - 1)
RING = multipolygon(box(0, 0, 100, 50).difference(box(40, 10, 60, 40)))


def arc_free(
    ways: Ways, north: float, east: float, heading: float, curvature: float, length: float
) -> bool:
    start = np.array([[north, east, heading]])
    return bool(ways.arcs_free(start, np.array([curvature]), np.array([length]))[0])


@settings(deadline=None, max_examples=60)
@given(area=areas(), seed=seeds)
def test_straights_are_inside_as_shapely_finds(area: MultiPolygon, seed: int) -> None:
    rng = np.random.default_rng(seed)
    low_n, low_e, high_n, high_e = area.bounds
    anywhere = rng.uniform((low_n - 1, low_e - 1), (high_n + 1, high_e + 1), (40, 2))
    places = np.concatenate([anywhere, places_in(area, rng, 40)])
    starts, ends = places[rng.permutation(80)], places[rng.permutation(80)]
    ways = Ways(area)

    free = ways.free_many(starts, ends)

    straights = shapely.linestrings(np.stack([starts, ends], axis=1))
    # Whatever lies in the area is free, and nothing is that leaves it by more than is allowed.
    certainly = shapely.covers(area, straights)
    perhaps = shapely.covers(area.buffer(1.01 * TOUCH_M, join_style="mitre"), straights)
    np.testing.assert_array_equal(free, shapely.covers(ways._water, straights))
    assert not np.any(certainly & ~free)
    assert not np.any(free & ~perhaps)
    np.testing.assert_array_equal(ways.free_many(ends, starts), free)
    points = shapely.points(places)
    np.testing.assert_array_equal(inside(ways, places), shapely.distance(area, points) <= TOUCH_M)


@settings(deadline=None, max_examples=60)
@given(area=areas(), seed=seeds)
def test_ways_are_as_short_as_by_trying_all_corners(area: MultiPolygon, seed: int) -> None:
    places = places_in(area, np.random.default_rng(seed), 6)
    ways = Ways(area)

    distances = ways.distances_m(places, places)

    np.testing.assert_allclose(distances, distances.T, atol=1e-9)
    twice = np.concatenate([places, places])
    np.testing.assert_allclose(ways.between_m(twice), np.tile(distances, (2, 2)), atol=1e-9)
    np.testing.assert_allclose(
        ways.lengths_m(places, places[::-1]), np.diag(distances[:, ::-1]), rtol=1e-12
    )
    for i in range(3):
        a, b = tuple(places[i].tolist()), tuple(places[i + 3].tolist())
        expected = min_way_m(area, a, b)
        assert distances[i, i + 3] == pytest.approx(expected, abs=1e-5)
        assert way_m(ways, a, b) == pytest.approx(expected, abs=1e-5)
        if math.isinf(expected):
            with pytest.raises(PlanError, match=r"area\.turn_margin_m"):
                ways.path_ne(a, b)
            continue
        path = ways.path_ne(a, b)
        assert tuple(path[0]) == a and tuple(path[-1]) == b
        assert ways.free_many(path[:-1], path[1:]).all()
        lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
        assert lengths.sum() == pytest.approx(expected, abs=1e-5)
        assert len(lengths) == 1 or lengths.min() > TOUCH_M
    straight = np.linalg.norm(places[:, None] - places[None], axis=2)
    assert np.all(distances >= straight - 1e-12)
    # No detour over a third place is shorter.
    over = (distances[:, :, None] + distances[None]).min(axis=1)
    assert np.all(distances <= over + 1e-6)


@settings(deadline=None, max_examples=80)
@given(
    area=areas(),
    seed=seeds,
    heading=st.floats(-4, 7),
    radius=st.floats(0.2, 5),
    side=st.sampled_from([-1, 1]),
    turned=st.floats(0.01, 6.28),
)
def test_arcs_are_inside_as_their_samples_are(
    area: MultiPolygon, seed: int, heading: float, radius: float, side: int, turned: float
) -> None:
    ways = Ways(area)
    for place in places_in(area, np.random.default_rng(seed), 8).tolist():
        arc: dict[str, Any] = {"length_m": radius * turned, "curvature_per_m": side / radius}
        leg = Leg(start_ne_m=(place[0], place[1]), heading_rad=heading, **arc)
        holds = arc_free(ways, *leg.start_ne_m, heading, leg.curvature_per_m, leg.length_m)

        places, bend = sampled_leg(leg, 300)
        track = LineString(places)
        if holds:
            assert area.buffer(TOUCH_M + bend).covers(track)
        else:
            assert not area.buffer(-bend - 1e-9).covers(track)


def test_touching_is_allowed_up_to_a_micrometre() -> None:
    ways = Ways(RING)
    along = [((0.0, 0.0), (100.0, 0.0)), ((40.0, 0.0), (40.0, 50.0)), ((0.0, 10.0), (100.0, 10.0))]
    for a, b in along:
        shift = np.array([b[1] - a[1], b[0] - a[0]]) / math.dist(a, b)
        for sign in (-1, 1):
            near = sign * 0.5e-6 * shift
            assert ways.free(tuple(a + near), tuple(b + near))
    assert ways.free((40 + 0.9e-6, 0.0), (40 + 0.9e-6, 50.0))
    assert not ways.free((40 + 1.1e-6, 0.0), (40 + 1.1e-6, 50.0))
    assert not ways.free((-1.1e-6, 0.0), (50.0, 0.0))
    assert inside(ways, np.array([[-0.9e-6, 3.0], [-1.1e-6, 3.0]])) == [True, False]


def test_arcs_may_graze_an_edge() -> None:
    ways = Ways(RING)
    # A circle of 10 m radius round (30, 25) touches the hole at north 40.
    for off, allowed in ((0.0, True), (0.4e-6, True), (-1e-3, True), (1.1e-6, False)):
        assert arc_free(ways, 20.0 + off, 25.0, math.pi / 2, -0.1, 20 * math.pi) == allowed
    # Straights of no curvature are as straights.
    assert arc_free(ways, 0.0, 0.0, 0.0, 0.0, 100.0)
    assert not arc_free(ways, 0.0, 25.0, 0.0, 0.0, 100.0)


def test_the_way_round_a_box_is_known() -> None:
    ways = Ways(RING)
    assert way_m(ways, (10.0, 25.0), (90.0, 25.0)) == pytest.approx(
        2 * math.hypot(30, 15) + 20, abs=1e-12
    )
    path = ways.path_ne((10.0, 20.0), (90.0, 20.0))
    np.testing.assert_allclose(path, [[10, 20], [40, 10], [60, 10], [90, 20]])
    # From corner to corner no place comes twice.
    np.testing.assert_allclose(
        ways.path_ne((40.0, 10.0), (60.0, 40.0)), [[40, 10], [60, 10], [60, 40]]
    )
    np.testing.assert_allclose(ways.path_ne((3.0, 3.0), (3.0, 3.0)), [[3, 3], [3, 3]])


def test_parts_that_are_apart_have_no_way() -> None:
    ways = Ways(multipolygon(shapely.union_all([box(0, 0, 5, 5), box(6, 0, 9, 5)])))
    distances = ways.distances_m(np.array([[1.0, 1.0]]), np.array([[4.0, 4.0], [7.0, 1.0]]))
    assert distances[0, 0] == pytest.approx(math.sqrt(18))
    assert math.isinf(distances[0, 1])
    with pytest.raises(PlanError, match=r"1\.00 m east to 7\.00 m north"):
        ways.path_ne((1.0, 1.0), (7.0, 1.0))
    with pytest.raises(PlanError, match=r"5\.50 m north"):
        ways.path_ne((1.0, 1.0), (5.5, 1.0))


def test_open_water_has_no_edge() -> None:
    assert OPEN_WATER.free((-1e6, 0.0), (1e6, 5.0))
    assert arc_free(OPEN_WATER, -1e6, 0.0, 0.3, 0.1, 50.0)


def test_ways_that_order_lines_are_hardly_shorter_than_those_flown() -> None:
    piles = shapely.union_all([Point(n, e).buffer(0.6) for n in (8, 16, 24) for e in (5, 10, 15)])
    pier = box(12, 18, 14, 30)
    ways = Ways(multipolygon(box(0, 0, 32, 30).difference(piles).difference(pier)))
    places = places_in(ways.allowed, np.random.default_rng(3), 40)
    exact = ways.between_m(places)

    coarse, sketch = ways.coarse, ways.sketch

    assert len(edges_of(coarse.allowed)) < len(edges_of(ways.allowed)) / 3
    assert len(edges_of(sketch.allowed)) < len(edges_of(coarse.allowed)) / 3
    for fewer, per_zone_m in ((coarse, 0.15), (sketch, 2.0)):
        lacking = exact - fewer.between_m(places)
        assert np.all(lacking >= -1e-9)
        assert np.all(lacking <= 9 * per_zone_m)
        assert lacking.max() > 1e-3
    # The pier is no small zone: a way round it stays one.
    across = np.array([[11.0, 29.0], [15.0, 29.0]])
    assert sketch.between_m(across)[0, 1] == pytest.approx(ways.between_m(across)[0, 1], abs=0.1)
