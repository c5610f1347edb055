import math

import numpy as np
import pytest
import shapely
import shapely.affinity
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from shapely.geometry import MultiPolygon, box

from missions.lines.fill import LENGTH, WIDTH, U, V, fill_table, lines_over, unseen
from missions.lines.lay import survey_pieces
from missions.lines.rows import Site, to_uv
from missions.values.area import multipolygon
from missions.values.line import Line
from missions.values.pattern import Pattern
from tests.oracles_lines import PATTERNS, STEREO, area_of, areas, as_string, points_in, seen_enough


def pieces_as_lines(pieces: np.ndarray, offsets: np.ndarray) -> list[Line]:
    """Pieces of heading north."""
    rows = [(offsets[int(i)], a, b, int(n) + 1) for i, a, b, n in pieces.tolist()]
    return [
        Line(kind="survey", start_ne_m=(a, v), end_ne_m=(b, v), stations=n) for v, a, b, n in rows
    ]


@settings(deadline=None, max_examples=25, suppress_health_check=[HealthCheck.filter_too_much])
@given(survey=areas, pattern=st.sampled_from(PATTERNS), margin_m=st.sampled_from([0.0, 3.0]))
def test_what_a_pattern_leaves_unseen_is_found(
    survey: MultiPolygon, pattern: Pattern, margin_m: float
) -> None:
    """Against dense points whose pictures are counted one by one."""
    assume(survey.area > 5.0)  # patches of 0.15 m do not resolve the edge of less
    area = area_of(survey, margin_m)
    pieces, offsets, cuts = survey_pieces(Site.of(area), 0.0, pattern)
    assume(len(pieces) > 0)
    patches = unseen(to_uv(Site.of(area).survey, 0.0), pattern, offsets, pieces, cuts, 0.15)

    points = points_in(survey, 60_000)
    lacking = ~seen_enough(pieces_as_lines(pieces, offsets), points, pattern)
    found = float((patches[:, LENGTH] * patches[:, WIDTH]).sum())
    # The points are as many as resolve this share of the area.
    assert found == pytest.approx(lacking.mean() * survey.area, abs=0.01 * survey.area)
    half = patches[:, [LENGTH, WIDTH]] / 2
    middles = patches[:, [U, V]]
    boxes = shapely.box(*(middles - half).T, *(middles + half).T)
    assert shapely.area(boxes).sum() == pytest.approx(found)
    inside = shapely.contains_xy(survey.buffer(1e-6), middles[:, 0], middles[:, 1])
    assert inside.all()


def test_corners_left_unseen_of_an_oblique_strip_are_found_whatever_the_size_of_patches() -> None:
    """Where it passes from row to row, corners are left that are thinner than patches."""
    strip = shapely.affinity.rotate(box(0, 0, 19.1, 0.13), -7.2, origin=(0, 0))
    pattern = Pattern(spacing_m=1.2, step_m=1.0, half_across_m=0.61, half_along_m=0.57)
    site = Site.of(area_of(strip, 0.5))
    pieces, offsets, cuts = survey_pieces(site, 0.0, pattern)
    points = points_in(strip, 400_000)
    lacking = ~seen_enough(pieces_as_lines(pieces, offsets), points, pattern)
    lacking_m2 = float(lacking.mean() * strip.area)
    assert 0.001 < lacking_m2 / strip.area < 0.002
    for finest_m in (0.15, 0.03, 0.001):
        patches = unseen(to_uv(site.survey, 0.0), pattern, offsets, pieces, cuts, finest_m)
        found_m2 = float((patches[:, LENGTH] * patches[:, WIDTH]).sum())
        assert found_m2 == pytest.approx(lacking_m2, rel=0.03)


def test_a_strip_next_to_a_no_go_zone_is_filled_with_one_line() -> None:
    """Rows run at offsets 0.5, 1.5, ...; the zone's side at 3.2 cuts the row of 3.5 off."""
    area = area_of(box(0, 0, 20, 10).difference(box(6, 3.2, 14, 6.8)))
    site = Site.of(area)
    pieces, offsets, cuts = survey_pieces(site, 0.0, STEREO)
    fills = fill_table(site, 0.0, STEREO, pieces, offsets, cuts)

    # The rows of 2.5 and 7.5 see to 3.1 and from 6.9: a strip of 0.1 m is left at each side.
    assert len(fills) == 2
    for north_0, east_0, north_1, east_1, _, steps in fills.tolist():
        assert east_0 == pytest.approx(east_1, abs=1e-9)
        side = 3.2 if east_0 < 5 else 6.8
        # It sees all of the strip from where it may be.
        assert (2.6 <= east_0 <= 3.2) if side == 3.2 else (6.8 <= east_0 <= 7.4)
        length = abs(north_1 - north_0)
        assert 6.5 < length < 9.5
        assert length / steps <= STEREO.step_m + 1e-9


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 10**6), pattern=st.sampled_from(PATTERNS), turn=st.floats(0, math.pi))
def test_lines_over_pieces_see_them(seed: int, pattern: Pattern, turn: float) -> None:
    """Pieces as a dive leaves them: some strips and spots anywhere in the area."""
    rng = np.random.default_rng(seed)
    area = area_of(box(0, 0, 20, 15).difference(box(8, 6, 11, 9)), 2.0)
    spots = [
        box(n, e, n + rng.uniform(0.1, 4), e + rng.uniform(0.1, 0.8))
        for n, e in rng.uniform(1, 15, (4, 2))
    ]
    turned = shapely.affinity.rotate(MultiPolygon(spots[:1]), turn, use_radians=True)
    pieces = multipolygon(shapely.union_all([*spots, turned]).intersection(area.survey))
    assume(pieces.area > 0.1)
    lines = lines_over(pieces, area, pattern)

    fence = area.allowed.buffer(1e-6)
    assert all(fence.contains(as_string(line)) for line in lines)
    assert {line.kind for line in lines} == {"fill"}
    # What may be left is a share of the whole area, whatever the pieces are of it.
    unseen = 1.0 - seen_enough(lines, points_in(pieces, 3000), pattern).mean()
    assert unseen * pieces.area <= 0.0004 * area.survey.area
    assert unseen < 0.02
    assert all(line.length_m <= (line.stations - 1) * pattern.step_m + 1e-9 for line in lines)
    assert sum(line.length_m for line in lines) < 60 * pattern.passes
