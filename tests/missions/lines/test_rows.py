from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, box

from alice_survey.core.frames import Array
from missions.lines.rows import lay_rows, reaches, rooms, row_offsets, to_uv
from missions.route.ways import edges_of
from missions.values.area import multipolygon
from tests.oracles_lines import areas, reaches_by_shapely


def spans(begins: NDArray[np.int64], counts: NDArray[np.int64], found: Array, row: int) -> Array:
    return found[begins[row] : begins[row] + counts[row]]


def turned(survey: shapely.Geometry, heading: float) -> Array:
    return to_uv(edges_of(multipolygon(survey)), heading)


@settings(deadline=None, max_examples=60)
@given(survey=areas, heading=st.floats(0, 6.28), half_m=st.floats(0.1, 1.0))
def test_a_row_reaches_as_far_as_the_area_in_its_strip(
    survey: MultiPolygon, heading: float, half_m: float
) -> None:
    edges = turned(survey, heading)
    offsets = row_offsets(edges[:, 1].min(), edges[:, 1].max(), 1.0, 0.0, 1)
    found = reaches(edges, offsets, half_m)
    for row, offset in enumerate(offsets.tolist()):
        mine = spans(*found, row)
        oracle = reaches_by_shapely(survey, heading, offset, half_m)
        # Where parts come within a hair of each other the two may split them differently.
        joined = shapely.union_all([box(a - 1e-5, 0, b + 1e-5, 1) for a, b in mine.tolist()])
        wanted = shapely.union_all([box(a - 1e-5, 0, b + 1e-5, 1) for a, b in oracle.tolist()])
        assert joined.symmetric_difference(wanted).area < 1e-4


@settings(deadline=None, max_examples=60)
@given(survey=areas, heading=st.floats(0, 6.28), share=st.floats(0.01, 0.99))
def test_rooms_are_where_a_row_is_inside(
    survey: MultiPolygon, heading: float, share: float
) -> None:
    edges = turned(survey, heading)
    low, high = edges[:, 1].min(), edges[:, 1].max()
    offset = low + share * (high - low)
    found = spans(*rooms(edges, np.array([offset])), 0)
    local = shapely.affinity.rotate(survey, -heading, origin=(0, 0), use_radians=True)
    u = np.linspace(*local.bounds[::2], 400)
    inside = shapely.contains_xy(local, u, np.full(400, offset))
    near = shapely.distance(local.boundary, shapely.points(u, offset)) < 1e-6
    mine = ((u[:, None] >= found[:, 0]) & (u[:, None] <= found[:, 1])).any(axis=1)
    assert (mine == inside)[~near].all()


def test_a_row_may_follow_the_edge_of_the_allowed_area_on_either_side() -> None:
    edges = turned(box(0, 0, 10, 5), 0.0)
    begins, counts, found = rooms(edges, np.array([0.0, 5.0]))
    assert counts.tolist() == [1, 1]
    np.testing.assert_allclose(found[begins[:2]], [[0, 10], [0, 10]], atol=1e-6)
    _, counts, _ = rooms(edges, np.array([-1e-3, 5.0 + 1e-3]))
    assert counts.tolist() == [0, 0]


def lay(survey: shapely.Geometry, allowed: shapely.Geometry, **changes: Any) -> tuple[Array, Array]:
    wanted: dict[str, Any] = {"half_m": 0.5, "overhang_m": 0.2, "step_m": 0.5, "min_steps": 1}
    wanted |= changes
    offsets = np.array([0.5])
    return lay_rows(turned(survey, 0.0), turned(allowed, 0.0), offsets, *wanted.values())


@pytest.mark.parametrize(("room_m", "over_m"), [(5.0, 0.4), (0.2, 0.2)])
def test_a_piece_is_whole_steps_long_or_without_room_has_shorter_ones(
    room_m: float, over_m: float
) -> None:
    pieces, cuts = lay(box(0, 0, 10.2, 1), box(-room_m, -5, 10.2 + room_m, 5))
    np.testing.assert_allclose(pieces, [[0, -over_m, 10.2 + over_m, 22]], atol=1e-9)
    assert len(cuts) == 0


def test_a_no_go_zone_parts_a_piece_and_leaves_a_cut() -> None:
    allowed = box(-5, -5, 20, 5).difference(box(4, -1, 6, 2))
    pieces, cuts = lay(box(0, 0, 10, 1), allowed)
    assert len(pieces) == 2
    assert pieces[0, 2] == pytest.approx(4)
    assert pieces[1, 1] == pytest.approx(6)
    np.testing.assert_allclose(cuts, [[0, 4, 6]], atol=1e-9)


def test_pieces_less_than_two_steps_apart_become_one_where_that_is_allowed() -> None:
    survey = box(0, 0, 4, 1).union(box(5.2, 0, 9, 1))
    wide = box(-5, -5, 20, 5)
    assert len(lay(survey, wide)[0]) == 1
    assert len(lay(survey, wide.difference(box(4.4, -1, 4.6, 2)))[0]) == 2
    assert len(lay(survey, wide, step_m=0.3)[0]) == 2


def test_a_wish_for_a_single_place_that_cannot_be_met_is_a_cut() -> None:
    """Two spots, each to be seen by one picture; one of them lies in a no-go zone."""
    survey = box(0, 0, 0.2, 1).union(box(8, 0, 8.2, 1))
    allowed = box(-5, -5, 20, 5).difference(box(-2, -5, 2, 5))
    pieces, cuts = lay(survey, allowed, overhang_m=-0.2)
    assert len(pieces) == 1
    np.testing.assert_allclose(cuts, [[0, 0.1, 0.1]], atol=1e-9)
