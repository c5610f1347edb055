import itertools

import numpy as np
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from alice_survey.core.config import CameraConfig, WaterConfig
from camera_calib.rig import design_rig
from missions.coverage.certificate import Certificate, certificate
from missions.coverage.growing import AT_OVERLAP, OUTSIDE, SEEN, STEREO, GrowingCoverage
from missions.coverage.stations import Stations, at_once, plan_pattern
from tests.oracles_coverage import area_of, lawnmower, plan_of

RIG = design_rig(CameraConfig(), WaterConfig())
AREA = area_of(shapely.box(0, 0, 4, 3) - shapely.box(1.5, 1.0, 2.1, 1.7))
PATTERN = plan_pattern(plan_of(AREA, lawnmower(4.0, 3.0, 1.0, 0.46)), RIG)
CELL_M = 0.06


def same(one: Certificate, other: Certificate) -> None:
    for name in ("pictures", "least_pictures", "least_lines", "pairs", "inside"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    assert one.to_json() == other.to_json()


@st.composite
def dives(draw: st.DrawFn) -> tuple[Stations, list[int]]:
    """Stations all over an area, on lines that are left and come back to, and where to cut them."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(1, 40))
    runs = draw(st.lists(st.tuples(st.integers(-1, 3), st.integers(1, 6)), min_size=1, max_size=12))
    line = np.repeat([r[0] for r in runs], [r[1] for r in runs])
    line = np.resize(line, count)
    stations = Stations(
        glass_ne=rng.uniform([-1, -1], [5, 4], (count, 2)),
        altitude_m=rng.uniform(0.5, 2.5, count),
        # Some look past the sea floor.
        attitude_rad=np.column_stack(
            [rng.normal(0, 0.1, count), np.where(rng.random(count) < 0.1, 1.5, 0.0),
             rng.uniform(0, 6.3, count)]
        ),
        line=line.astype(np.intp),
    )  # fmt: skip
    return stations, draw(st.lists(st.integers(0, count), max_size=5))


@settings(max_examples=40, deadline=None)
@given(dives())
def test_counted_piece_by_piece_is_counted_at_once(dive: tuple[Stations, list[int]]) -> None:
    stations, cuts = dive
    whole = certificate(AREA, RIG, stations, PATTERN, cell_m=CELL_M)
    ends = [0, *sorted(cuts), len(stations)]
    growing = GrowingCoverage(AREA, RIG, PATTERN, CELL_M)
    shares = [0.0]
    for first, last in itertools.pairwise(ends):
        before = growing.classes.copy()
        top, bottom, left, right = growing.add(stations.some(np.arange(first, last)))
        changed = before != growing.classes
        changed[top:bottom, left:right] = False
        assert not changed.any()
        shares.append(growing.covered_share)
    assert np.all(np.diff(shares) >= 0)
    same(growing.certificate(), whole)
    assert growing.covered_share == whole.covered_share
    assert growing.stereo_share == whole.stereo_share
    assert growing.share_at_overlap == whole.share_at_overlap
    np.testing.assert_array_equal(growing.classes == OUTSIDE, ~whole.inside)
    for bit, mask in (
        (SEEN, whole.pictures > 0), (STEREO, whole.pairs > 0), (AT_OVERLAP, whole.at_overlap)
    ):  # fmt: skip
        np.testing.assert_array_equal((growing.classes & bit > 0)[whole.inside], mask[whole.inside])


@settings(max_examples=25, deadline=None)
@given(dives(), st.integers(0, 2**32 - 1))
def test_what_is_to_come_is_added_without_being_kept(
    dive: tuple[Stations, list[int]], seed: int
) -> None:
    stations, _ = dive
    rng = np.random.default_rng(seed)
    cut = int(rng.integers(0, len(stations) + 1))
    first, second = (stations.some(np.arange(*ends)) for ends in ((0, cut), (cut, len(stations))))
    growing = GrowingCoverage(AREA, RIG, PATTERN, CELL_M)
    growing.add(first)
    same(growing.certificate(second), certificate(
        AREA, RIG, at_once([first, second]), PATTERN, cell_m=CELL_M))  # fmt: skip
    same(growing.certificate(), certificate(AREA, RIG, first, PATTERN, cell_m=CELL_M))


def test_an_update_works_on_its_own_window_alone() -> None:
    """However long the dive was, a picture changes no more cells than it shows."""
    area = area_of(shapely.box(0, 0, 40, 30))
    growing = GrowingCoverage(area, RIG, PATTERN, 0.1)
    windows = []
    for place in ([5.0, 5.0], [20.0, 15.0], [39.0, 29.0]):
        station = Stations(
            glass_ne=np.array([place]), altitude_m=np.array([2.0]),
            attitude_rad=np.zeros((1, 3)), line=np.array([0]),
        )  # fmt: skip
        top, bottom, left, right = growing.add(station)
        windows.append((bottom - top) * (right - left))
    assert 100 < max(windows) < 40**2
    assert growing.inside.size > 100_000
