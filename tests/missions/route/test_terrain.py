"""The profile of the glass over a known sea floor."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alice_survey.core.errors import PlanError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.vehicle import vehicle_from
from missions.areas.bathymetry import read_bathymetry
from missions.route.terrain import (
    DepthProfile,
    TerrainLimits,
    depth_profile,
    envelope,
    highest_floor,
    line_profiles,
    reach_of,
)
from missions.values.line import Line
from tests.missions.areas.sites import floor_of, real_floor
from tests.oracles_energy import envelope as slow_envelope
from tests.oracles_energy import highest_within

REACH = reach_of(vehicle_from("alice").hull, (0.55, -0.05, 0.08), 0.7, 0.6)
EAST_M = np.broadcast_to((np.arange(160) + 0.5 - 80) * 0.5, (160, 160))
LIMITS = TerrainLimits(altitude_m=2.0, least_clearance_m=1.0, steepest_rad=math.radians(20.0))


def _line(start: tuple[float, float], end: tuple[float, float], stations: int = 61) -> Line:
    return Line(kind="survey", start_ne_m=start, end_ne_m=end, stations=stations)


def slopes_rad(profile: DepthProfile) -> Array:
    """(S - 1,) slopes of a profile, positive downwards."""
    slopes: Array = np.arctan2(np.diff(profile.depth_m), np.diff(profile.along_m))
    return slopes


profiles = st.integers(2, 40).flatmap(
    lambda n: st.tuples(
        st.lists(st.floats(0.01, 3.0), min_size=n, max_size=n),
        st.lists(st.floats(1.0, 30.0), min_size=n, max_size=n),
        st.floats(0.01, 3.0),
    )
)


@given(profiles)
@settings(max_examples=60, deadline=None)
def test_the_envelope_is_the_deepest_that_keeps_depth_and_slope(
    case: tuple[list[float], list[float], float],
) -> None:
    steps, wanted, slope = case
    along, wanted_m = np.cumsum(steps), np.array(wanted)

    found = envelope(along, wanted_m, slope)

    np.testing.assert_allclose(found, slow_envelope(along, wanted_m, slope), atol=1e-9)
    assert np.all(found <= wanted_m + 1e-9)
    assert np.all(np.abs(np.diff(found)) <= slope * np.diff(along) + 1e-9)
    # Each sample is held by a wanted depth: none could be deeper by itself.
    held = np.isclose(found, wanted_m, atol=1e-9)
    reached = (
        np.abs(found[:, None] - found[None]) >= slope * np.abs(along[:, None] - along[None]) - 1e-9
    )
    assert np.all((reached & held[None]).any(axis=1))


def test_a_slope_is_followed_above_its_highest_within_reach() -> None:
    """Along a slope of 0.2 the hull's nose or tail is over the highest floor."""
    floor = floor_of(14.0 - 0.2 * EAST_M)  # shoaling to the east
    line = _line((0.0, -15.0), (0.0, 15.0))
    up, down = line_profiles([line, line.reverse()], floor, REACH, LIMITS)
    # UTM's grid is turned by 1.1 deg and its scale is 0.9996 to 1 here.
    assert up.altitude_m == pytest.approx(2.0 + 0.2 * REACH.ahead_m, abs=0.02)
    assert down.altitude_m == pytest.approx(2.0 + 0.2 * REACH.astern_m, abs=0.02)
    assert up.clearance_m == pytest.approx(2.0, abs=1e-9)
    assert np.degrees(slopes_rad(up)) == pytest.approx(-math.degrees(math.atan(0.2)), abs=0.05)
    assert np.degrees(slopes_rad(down)) == pytest.approx(math.degrees(math.atan(0.2)), abs=0.05)


def test_before_a_cliff_the_glass_climbs_at_the_steepest_slope() -> None:
    cliff = np.where(EAST_M > 0.0, 8.0, 14.0)
    line = _line((0.0, -30.0), (0.0, 30.0), stations=121)
    (profile,) = line_profiles([line], floor_of(cliff), REACH, LIMITS)
    east = profile.along_m - 30.0
    steep = math.tan(LIMITS.steepest_rad)
    top = east > -REACH.ahead_m + 0.6
    np.testing.assert_allclose(profile.depth_m[top], 6.0, atol=1e-9)
    far = east < -REACH.ahead_m - 6.0 / steep - 1.0
    assert far.sum() > 5
    np.testing.assert_allclose(profile.depth_m[far], 12.0, atol=1e-9)
    climb = (profile.depth_m > 6.0 + 1e-9) & (profile.depth_m < 12.0 - 1e-9)
    assert climb.sum() > 20
    assert np.abs(slopes_rad(profile)).max() == pytest.approx(LIMITS.steepest_rad, abs=1e-9)
    assert profile.clearance_m.min() >= 2.0 - 1e-9
    assert profile.altitude_m.max() > 7.0  # at the foot of the cliff


@pytest.mark.parametrize(("rough_m", "off_m"), [(0.02, 0.01), (0.4, 0.3)])
def test_the_highest_floor_is_found_by_looking_everywhere(rough_m: float, off_m: float) -> None:
    """Two places a cell may pass next to a peak, by less than the floor changes in half a cell."""
    rng = np.random.default_rng(7)
    floor = floor_of(12.0 - 0.1 * EAST_M + rng.normal(0.0, rough_m, (160, 160)))
    places, headings = rng.uniform(-10, 10, (6, 2)), rng.uniform(0, 6.28, 6)

    found = highest_floor(floor, places, headings, REACH)

    reach = REACH.ahead_m, REACH.astern_m, REACH.aside_m
    exact = [
        highest_within(floor.depth_at, place.tolist(), heading, *reach, 0.05)
        for place, heading in zip(places, headings, strict=True)
    ]
    np.testing.assert_allclose(found, exact, atol=off_m)


def test_clearance_holds_between_stations_over_a_rough_floor() -> None:
    """Brute force: every 2 cm of the way, straight between stations, over the floor below it."""
    rng = np.random.default_rng(8)
    coarse = rng.uniform(8.0, 14.0, (12, 12))
    rows = np.linspace(0, 11, 160)
    smooth = np.array([np.interp(rows, np.arange(12), column) for column in coarse.T]).T
    smooth = np.array([np.interp(rows, np.arange(12), row) for row in smooth])
    floor = floor_of(smooth)
    for heading in (0.0, 0.7, 2.0):
        ahead = np.array([math.cos(heading), math.sin(heading)])
        line = _line(tuple(-25 * ahead), tuple(25 * ahead), stations=101)
        profile = line_profiles([line], floor, REACH, LIMITS)[0]
        fine = np.arange(0.0, 50.0, 0.02)
        glass = np.interp(fine, profile.along_m, profile.depth_m)
        places = -25 * ahead + fine[:, None] * ahead
        clearance = floor.depth_at(places) - glass
        assert clearance.min() >= LIMITS.altitude_m - 0.02
        assert np.abs(slopes_rad(profile)).max() <= LIMITS.steepest_rad + 1e-9
        assert clearance.min() < LIMITS.altitude_m + 0.6  # and it is not simply far above


def test_limits_that_cannot_be_kept_name_the_place() -> None:
    values = np.full((160, 160), 12.0)
    values[80:84, 90:94] = np.nan
    with pytest.raises(PlanError, match=r"floor\.tif .* line 1, .* m "):
        lines = [_line((north, -20.0), (north, 20.0)) for north in (20.0, -1.0)]
        line_profiles(lines, floor_of(values), REACH, LIMITS)
    shoal = np.full((160, 160), 12.0)
    shoal[:, 100:110] = 1.5
    with pytest.raises(PlanError, match=r"line 0, .* 0\.50 m "):
        line_profiles([_line((0.0, -20.0), (0.0, 20.0))], floor_of(shoal), REACH, LIMITS)
    with pytest.raises(PlanError, match=r"altitude_m 0\.8 .*least_clearance_m 1"):
        TerrainLimits(altitude_m=0.8, least_clearance_m=1.0, steepest_rad=0.3)


def test_stations_far_apart_see_all_between_them() -> None:
    """A ridge between two stations 10 m apart is flown over by both."""
    ridge = np.where(np.abs(EAST_M) < 1.0, 9.0, 12.0)
    sparse = line_profiles([_line((0.0, -15.0), (0.0, 15.0), 4)], floor_of(ridge), REACH, LIMITS)[0]
    np.testing.assert_allclose(sparse.depth_m, [10.0, 7.0, 7.0, 10.0], atol=1e-9)


def test_a_real_sea_floor_is_followed(shared_data: Path) -> None:
    path, datum = real_floor(shared_data)
    floor = read_bathymetry(path, datum, bounds_ne=(-120.0, -120.0, 120.0, 120.0))
    lines = [_line((north, -100.0), (north, 100.0), 401) for north in np.arange(-3.0, 4.0).tolist()]
    found = line_profiles(lines, floor, REACH, LIMITS)
    for line, profile in zip(lines, found, strict=True):
        fine = np.linspace(0.0, 200.0, 4001)
        places = np.column_stack([np.full(4001, line.start_ne_m[0]), fine - 100.0])
        clearance = floor.depth_at(places) - np.interp(fine, profile.along_m, profile.depth_m)
        assert 2.0 - 0.005 <= clearance.min() < 2.3
        assert profile.altitude_m.min() >= 2.0 - 1e-6
        assert np.abs(slopes_rad(profile)).max() <= LIMITS.steepest_rad + 1e-9
    whole = depth_profile(
        floor, found[0].along_m, lines[0].stations_ne, np.full(401, math.pi / 2), REACH, LIMITS, "x"
    )
    np.testing.assert_array_equal(whole.depth_m, found[0].depth_m)
