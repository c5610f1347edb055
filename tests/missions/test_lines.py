import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from shapely.geometry import Point, Polygon
from shapely.ops import unary_union

from alice_survey.config import CameraConfig, WaterConfig
from alice_survey.errors import PlanError
from camera_calib.rig import design_rig
from missions.areas.shapes import polygon_corners
from missions.coverage.footprints import covered_share
from missions.footprint import (
    Swath,
    common_swath,
    footprint_polygon,
    glass_point_cam,
    level_pose,
)
from missions.lines.lawnmower import (
    across_range,
    cross_lines,
    longer_side_heading,
    space_lines,
    survey_lines,
)
from missions.lines.line import Line

RIG = design_rig(CameraConfig(), WaterConfig())
STEP_M = 0.47
STEREO = common_swath(RIG, 2.0, STEP_M)


@st.composite
def polygons(draw: st.DrawFn) -> Polygon:
    """Star-shaped areas, mostly concave, of a few metres to some tens."""
    count = draw(st.integers(3, 9))
    size = draw(st.floats(2.0, 12.0))
    phase = draw(st.floats(0.0, 6.28))
    radii = draw(st.lists(st.floats(0.25, 1.0), min_size=count, max_size=count))
    angles = phase + 2 * math.pi * np.arange(count) / count
    corners = size * np.array(radii)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    polygon = Polygon(corners + draw(st.floats(-50.0, 50.0)))
    assume(polygon.is_valid and polygon.area > 1.0)
    return polygon


def lay(
    polygon: Polygon, heading: float, wanted_m: float, swath: Swath = STEREO, exact: bool = False
) -> tuple[list[Line], float]:
    low, high = across_range(polygon, heading)
    spacing = space_lines(
        high - low, swath, largest_m=wanted_m, exact_m=wanted_m if exact else None
    )
    return survey_lines(polygon, heading, spacing, STEP_M), spacing.spacing_m


def across(line: Line, heading: float) -> float:
    return float(np.array([-math.sin(heading), math.cos(heading)]) @ line.start_ne_m)


def angle_between(a: float, b: float) -> float:
    return abs((a - b + math.pi) % (2 * math.pi) - math.pi)


@settings(deadline=None, max_examples=20)
@given(polygon=polygons(), heading=st.floats(0.0, 6.28), wanted_m=st.floats(0.5, 1.2))
def test_both_cameras_see_the_whole_of_any_area(
    polygon: Polygon, heading: float, wanted_m: float
) -> None:
    """Slow twin of the certificate: real footprints of both cameras at each station, united."""
    lines, _ = lay(polygon, heading, wanted_m)
    depth_m, seen = 15.0, []
    left, right = RIG.cameras["left"], RIG.cameras["right"]
    for line in lines:
        for place in line.stations_ne:
            pose = level_pose(left, place, 2.0, depth_m, line.heading_rad)
            other = pose * RIG.cam_from_rig["right"].inv()
            seen.append(
                footprint_polygon(left, pose, depth_m).intersection(
                    footprint_polygon(right, other, depth_m)
                )
            )
    share = polygon.intersection(unary_union(seen)).area / polygon.area

    assert share >= 0.999
    promised = covered_share(polygon, lines, STEREO, STEP_M)
    assert promised == pytest.approx(1.0, abs=1e-9)
    assert promised <= share + 1e-9


@settings(deadline=None, max_examples=40)
@given(
    polygon=polygons(),
    heading=st.floats(0.0, 6.28),
    wanted_m=st.floats(0.3, 1.5),
    exact=st.booleans(),
)
def test_lines_are_parallel_evenly_spaced_and_to_and_fro(
    polygon: Polygon, heading: float, wanted_m: float, exact: bool
) -> None:
    lines, spacing_m = lay(polygon, heading, wanted_m, exact=exact)

    if exact:
        assert spacing_m == wanted_m
    else:
        assert spacing_m <= wanted_m + 1e-9
    offsets = [across(line, heading) for line in lines]
    rows = np.unique(np.round(offsets, 6))
    if len(rows) > 1:
        np.testing.assert_allclose(np.diff(rows), spacing_m, atol=1e-5)
    assert angle_between(lines[0].heading_rad, heading) < 1e-6
    for before, after in pairwise(lines):
        turned = angle_between(before.heading_rad, after.heading_rad)
        same_row = abs(across(before, heading) - across(after, heading)) < 1e-5
        assert turned == pytest.approx(0.0 if same_row else math.pi, abs=1e-6)


@settings(deadline=None, max_examples=40)
@given(polygon=polygons(), heading=st.floats(0.0, 6.28))
def test_stations_are_evenly_spaced_and_end_with_their_line(
    polygon: Polygon, heading: float
) -> None:
    lines, spacing_m = lay(polygon, heading, 1.0)
    near = polygon.buffer(STEP_M + math.hypot(spacing_m, STEREO.half_across_m * 2))

    for line in lines:
        stations = line.stations_ne
        assert line.stations >= 2
        assert stations[0].tolist() == list(line.start_ne_m)
        assert stations[-1].tolist() == list(line.end_ne_m)
        steps = np.linalg.norm(np.diff(stations, axis=0), axis=1)
        np.testing.assert_allclose(steps, STEP_M, atol=1e-8)
        assert all(near.covers(Point(*place)) for place in stations)


def test_the_papers_lines() -> None:
    polygon = Polygon([(0, 0), (15, 0), (15, 17), (0, 17)])
    assert longer_side_heading(polygon) == pytest.approx(math.pi / 2)
    lines, spacing_m = lay(polygon, math.pi / 2, 1.0, exact=True)

    assert spacing_m == 1.0
    assert len(lines) == 15
    assert [line.start_ne_m[0] for line in lines] == pytest.approx(np.arange(0.5, 15.5))
    assert all(line.stations == 38 for line in lines)
    # Lines start before the area and end behind it.
    assert lines[0].start_ne_m[1] == pytest.approx(-0.195)
    assert lines[0].end_ne_m[1] == pytest.approx(17.195)


def test_the_outermost_lines_see_the_sides_and_no_line_is_wasted() -> None:
    for width_m in np.linspace(0.3, 6.0, 58):
        spacing = space_lines(float(width_m), STEREO, largest_m=1.0, exact_m=None)
        last_m = spacing.first_m + (spacing.count - 1) * spacing.spacing_m
        assert spacing.first_m <= STEREO.half_across_m + 1e-9 or spacing.count == 1
        assert width_m - last_m <= STEREO.half_across_m + 1e-9
        if spacing.count > 1:
            fewer = (width_m - 2 * STEREO.half_across_m) / max(spacing.count - 2, 1e-12)
            assert fewer > 1.0


def test_a_line_has_the_parts_of_its_area() -> None:
    """A U: the lines across its arms come in two parts, flown one after the other."""
    arms = Polygon([(0, 0), (20, 0), (20, 6), (12, 6), (12, 3), (8, 3), (8, 6), (0, 6)])
    lines, _ = lay(arms, 0.0, 1.0)

    counts: dict[float, int] = {}
    for line in lines:
        offset = round(across(line, 0.0), 6)
        counts[offset] = counts.get(offset, 0) + 1
    assert {offset: count for offset, count in counts.items() if offset > 3.6} == {
        offset: 2 for offset in counts if offset > 3.6
    }
    assert all(count == 1 for offset, count in counts.items() if offset < 2.4)
    two = [line for line in lines if across(line, 0.0) > 3.6][:2]
    assert angle_between(two[0].heading_rad, two[1].heading_rad) < 1e-9
    assert min(two[0].length_m, two[1].length_m) == pytest.approx(8.0, abs=2 * STEP_M)


def test_a_narrow_notch_does_not_split_a_line() -> None:
    notched = Polygon([(0, 0), (10, 0), (10, 3), (5.3, 3), (5.3, 1), (5.0, 1), (5.0, 3), (0, 3)])
    lines, _ = lay(notched, 0.0, 1.0)
    assert len({round(across(line, 0.0), 6) for line in lines}) == len(lines)


@given(
    length_m=st.floats(3.0, 30.0),
    ratio=st.floats(0.1, 0.95),
    heading=st.floats(0.0, math.pi, exclude_max=True),
)
def test_lines_follow_the_longer_side(length_m: float, ratio: float, heading: float) -> None:
    ahead = length_m * np.array([math.cos(heading), math.sin(heading)])
    right = ratio * length_m * np.array([-math.sin(heading), math.cos(heading)])
    polygon = Polygon([0 * ahead, ahead, ahead + right, right])

    found = longer_side_heading(polygon)
    assert 0 <= found < math.pi
    assert abs(math.sin(found - heading)) < 1e-6


def test_of_a_square_lines_follow_the_first_side() -> None:
    square = Polygon([(0, 0), (4, 0), (4, 4), (0, 4)])
    assert longer_side_heading(square) == 0.0


@settings(deadline=None, max_examples=40)
@given(polygon=polygons(), heading=st.floats(0.0, 6.28), count=st.integers(1, 3))
def test_cross_lines_cross(polygon: Polygon, heading: float, count: int) -> None:
    corner = polygon_corners(polygon)[0]
    here = (float(corner[0]), float(corner[1]))
    lines = cross_lines(polygon, heading, count, STEP_M, here)

    offsets = {round(across(line, heading + math.pi / 2), 5) for line in lines}
    assert 1 <= len(offsets) <= count
    for line in lines:
        assert line.kind == "cross"
        assert abs(math.cos(line.heading_rad - heading)) < 1e-6
    # The nearest end of the nearest row comes first.
    ends = [lines[0].start_ne_m, lines[-1].end_ne_m]
    assert math.dist(here, lines[0].start_ne_m) <= min(math.dist(here, end) for end in ends) + 1e-9


def test_a_cross_line_runs_from_edge_to_edge() -> None:
    polygon = Polygon([(0, 0), (15, 0), (15, 17), (0, 17)])
    (line,) = cross_lines(polygon, math.pi / 2, 1, STEP_M, (14.5, 17.0))

    assert line.start_ne_m[1] == pytest.approx(8.5)
    assert line.start_ne_m[0] >= 15.0 - 1e-9
    assert line.end_ne_m[0] <= 1e-9


def test_a_line_turned_round_is_the_same_line() -> None:
    line = Line(kind="survey", start_ne_m=(0.0, 0.0), end_ne_m=(3.0, 4.0), stations=6)
    assert line.length_m == 5.0
    assert line.heading_rad == pytest.approx(math.atan2(4, 3))
    back = line.reversed()
    assert angle_between(back.heading_rad, line.heading_rad) == pytest.approx(math.pi)
    np.testing.assert_allclose(back.stations_ne, line.stations_ne[::-1], atol=1e-15)


def test_an_area_for_a_hundred_thousand_stations_is_refused() -> None:
    big = Polygon([(0, 0), (2000, 0), (2000, 2000), (0, 2000)])
    with pytest.raises(PlanError, match="split the area") as fault:
        lay(big, 0.0, 1.0)
    assert "\n" not in str(fault.value)


def test_glass_and_pose_agree_with_the_lines_reference() -> None:
    """A station is a place of the left port's outer glass, whatever the heading."""
    line = Line(kind="survey", start_ne_m=(1.0, 2.0), end_ne_m=(1.0, 8.0), stations=3)
    place: NDArray[np.float64] = line.stations_ne[1]
    pose = level_pose(RIG.cameras["left"], place, 2.0, 15.0, line.heading_rad)
    glass = pose.apply(glass_point_cam(RIG.cameras["left"]))
    np.testing.assert_allclose(glass, [1.0, 5.0, 13.0], atol=1e-12)
