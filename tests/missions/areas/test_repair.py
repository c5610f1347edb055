import math
import re

import numpy as np
import pytest
import shapely
from shapely.geometry import MultiPolygon, Polygon

from alice_survey.core.config import AreaConfig
from alice_survey.core.errors import PlanError
from alice_survey.core.frames import Datum
from missions.areas.crs import LocalFrame
from missions.areas.raw import RawShapes, no_points
from missions.areas.survey import Repaired, repair, survey_area

FRAME = LocalFrame(datum=Datum(32.0, 34.0), seafloor_depth_m=15.0, datum_is_given=True)
SQUARE = ((0, 0), (10, 0), (10, 10), (0, 10))
PENTAGRAM = tuple((10 * math.cos(a), 10 * math.sin(a)) for a in np.arange(5) * math.radians(144))
"""It runs twice round its middle."""


def of_polygons(*polygons: tuple[object, ...]) -> Repaired:
    """Of polygons, each its outer ring and its holes."""
    raw = RawShapes(
        origin="test",
        geographic=False,
        polygons=tuple(tuple(np.array(ring, float) for ring in rings) for rings in polygons),
        points=no_points(),
    )
    return repair(raw, FRAME, geographic=False)


def box(north: float, east: float, height: float, width: float) -> np.ndarray:
    return shapely.get_coordinates(shapely.box(north, east, north + height, east + width))


@pytest.mark.parametrize(
    ("corners", "named"),
    [
        (((0, 0), (10, 10), (10, 0), (0, 10)), "north 5.00 m, east 5.00 m"),
        # The same bow tie with a corner where it crosses.
        (((0, 0), (5, 5), (10, 10), (10, 0), (5, 5), (0, 10)), "north 5.00 m, east 5.00 m"),
        (PENTAGRAM, "north "),
        (((0, 0), (0, 0), (1, 1)), "2 distinct corners"),
        (((1, 1), (1, 1), (1, 1)), "1 distinct corners"),
        (((0, 0), (5, 5), (10, 10)), "north "),
        (((0, 0), (0, 1e-5), (1e-5, 0)), "test"),
        (((0, 0), (4, 0), (4, 4), (4, 0)), "north 4.00 m, east 4.00 m"),
    ],
)
def test_a_faulty_ring_is_refused_with_its_place(
    corners: tuple[tuple[float, float], ...], named: str
) -> None:
    with pytest.raises(PlanError) as fault:
        of_polygons((corners,))
    assert named in str(fault.value)
    assert "\n" not in str(fault.value)
    with pytest.raises(PlanError):  # a hole as large as its polygon leaves nothing
        of_polygons((SQUARE, SQUARE))


@pytest.mark.parametrize(
    ("rings", "area_m2", "named"),
    [
        (((*SQUARE, (0, 0)),), 100, ""),
        ((SQUARE[::-1],), 100, ""),
        (((SQUARE[0], *SQUARE, SQUARE[-1]),), 100, ""),
        # Out 5 m and straight back; a spike whose way back goes on farther.
        (((*SQUARE[:2], (15, 0), (10, 0), *SQUARE[2:]),), 100, "1 part"),
        (((*SQUARE[:2], (15, 0), *SQUARE[1:]),), 100, "1 part"),
        # A last corner that overshoots the first edge by 4 mm.
        (((*SQUARE, (0.0, 5.0), (-0.004, 5.002), (0.004, 5.004)),), 100, "north "),
        ((SQUARE, box(4, 4, 2, 2)), 96, ""),
        ((SQUARE, box(0, 4, 2, 2)), 96, ""),
        ((SQUARE, box(-1, 4, 3, 2)), 96, "hole 1: 2 m2"),
        ((SQUARE, box(20, 4, 3, 2)), 100, "north 21"),
        ((SQUARE, box(4, 4, 0.01, 0.01)), 100, "hole 1: it is too small and left out near north 4"),
        ((SQUARE, box(4, 4, 2, 2), box(5, 5, 2, 2)), 93, ""),
        # Two rooms that touch in a corner, as one ring.
        ((((0, 0), (5, 5), (0, 10), (10, 10), (5, 5), (10, 0)),), 50, "2 parts"),
        # A hole that hangs on the shell's corner, as one ring.
        (((*SQUARE, (0, 0), (2, 4), (4, 4), (4, 2)),), 92, "1 part"),
    ],
)
def test_what_is_slightly_wrong_is_repaired_and_reported(
    rings: tuple[object, ...], area_m2: float, named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    shape = of_polygons(rings)
    assert shape.solid.is_valid
    assert shape.solid.area == pytest.approx(area_m2, abs=0.02)
    warnings = capsys.readouterr().err
    assert named in warnings
    assert warnings.count("warning:") == bool(named)


def test_parts_are_joined_and_overlaps_named(capsys: pytest.CaptureFixture[str]) -> None:
    both = of_polygons((SQUARE,), (box(8, 4, 4, 4),))
    assert both.solid.area == pytest.approx(100 + 16 - 8)
    warning = capsys.readouterr().err
    assert re.search(r" 8 m2 .*north 9\.00 m", warning)
    assert of_polygons((SQUARE,), (box(10.02, 0, 5, 10),)).solid.area == pytest.approx(150)
    assert capsys.readouterr().err == ""
    gap = of_polygons((SQUARE,), (box(10.005, 0, 5, 10),))
    assert len(gap.solid.geoms) == 1
    assert gap.solid.area == pytest.approx(150.05)
    assert "0.01 m" in capsys.readouterr().err
    seam = of_polygons((SQUARE,), (box(10 + 1e-9, 0, 5, 10),))
    assert len(seam.solid.geoms) == 1
    assert seam.solid.area == pytest.approx(150)
    assert capsys.readouterr().err == ""


def star(rng: np.random.Generator, corners: int, middle: np.ndarray, reach_m: float) -> np.ndarray:
    """A ring that is simple, and mostly concave."""
    angle = 2 * np.pi * (np.arange(corners) + rng.uniform(0, 0.9, corners)) / corners
    radius = reach_m * rng.uniform(0.2, 1.0, corners)
    return middle + np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])


def test_500_random_polygons_with_holes_keep_what_is_in_and_out(
    capsys: pytest.CaptureFixture[str],
) -> None:
    rng = np.random.default_rng(20210401)
    for _ in range(500):
        reach_m = 10 ** rng.uniform(0.5, 3)
        shell = star(rng, int(rng.integers(5, 30)), np.zeros(2), reach_m)
        holes = [
            star(rng, int(rng.integers(4, 9)), rng.uniform(-0.6, 0.6, 2) * reach_m, reach_m / 5)
            for _ in range(int(rng.integers(0, 5)))
        ]
        wkt = Polygon(shell[:, ::-1], [hole[:, ::-1] for hole in holes]).wkt
        clearance_m = float(rng.choice([0.0, 0.02 * reach_m]))
        config = AreaConfig(wkt=wkt, no_go_clearance_m=clearance_m)
        area = survey_area(config, turn_margin_m=0.05 * reach_m)
        assert area.survey.is_valid
        assert area.allowed.is_valid
        for shape in (area.survey, area.allowed):
            assert shape.intersection(area.no_go).area < 1e-6 * reach_m**2
        assert area.survey.difference(area.allowed).area < 1e-6 * reach_m**2
        if clearance_m:
            continue
        for point in rng.uniform(-reach_m, reach_m, (8, 2)):
            place = shapely.Point(point)
            if area.survey.boundary.distance(place) < 0.02:
                continue
            wanted = [Polygon(ring).contains(place) for ring in (shell, *holes)]
            assert area.survey.contains(place) == (wanted == [True] + [False] * len(holes))
    capsys.readouterr()


def test_500_rings_of_random_corners_are_planned_or_refused_with_a_place(
    capsys: pytest.CaptureFixture[str],
) -> None:
    rng = np.random.default_rng(5)
    refused = 0

    def coarse_ring(fewest: int, end: int) -> np.ndarray:
        """On a coarse grid, so that corners repeat, edges overlap, and holes touch."""
        return rng.integers(0, 5, (rng.integers(fewest, end), 2))

    for _ in range(500):
        polygons = [
            Polygon(coarse_ring(3, 7), [coarse_ring(3, 5) for _ in range(rng.integers(0, 2))])
            for _ in range(rng.integers(1, 3))
        ]
        try:
            area = survey_area(AreaConfig(wkt=MultiPolygon(polygons).wkt), turn_margin_m=1.0)
        except PlanError as error:
            assert re.fullmatch(r".*(north|distinct corners|leave).*", str(error))  # in one line
            refused += 1
            continue
        assert area.survey.is_valid
        assert area.survey.area >= 0.01
        hull = shapely.union_all([polygon.convex_hull for polygon in polygons])
        hull_ne = shapely.transform(hull, lambda xy: xy[:, ::-1])
        assert area.survey.difference(hull_ne.buffer(0.01)).area < 1e-6
    assert 100 < refused < 480
    capsys.readouterr()
