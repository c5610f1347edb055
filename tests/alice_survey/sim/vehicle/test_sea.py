"""Currents, swell and the sea floor: interpolation, closed forms and limits, files."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from alice_survey.core.errors import AliceError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import sea
from alice_survey.sim.vehicle.sea import FloorGrid, floor_depth, floor_range, level_floor
from tests.alice_survey.sim.vehicle import motions

TIMES, DEPTHS = np.array([0.0, 7.0, 10.0, 31.0]), np.array([-1.0, 2.0, 2.5, 20.0, 21.0])

GRID = sea.Current(TIMES, DEPTHS, np.random.default_rng(2).normal(0.0, 0.3, (4, 5, 2)))


def at(current: sea.Current, time_s: float, depth_m: float) -> Array:
    out = np.full(6, np.nan)
    sea.current_at(current, time_s, depth_m, out)
    return out


@pytest.mark.parametrize(
    ("towards_deg", "north", "east"),
    [(0.0, 0.2, 0.0), (90.0, 0.0, 0.2), (180.0, -0.2, 0.0), (270.0, 0.0, -0.2), (-90.0, 0.0, -0.2)],
)
def test_the_direction_is_the_one_it_flows_towards(
    towards_deg: float, north: float, east: float
) -> None:
    for time_s, depth_m in ((0.0, 0.0), (1e5, -3.0), (-5.0, 1e4)):
        value = at(motions.constant_current(0.2, towards_deg), time_s, depth_m)
        np.testing.assert_allclose(value, [north, east, 0, 0, 0, 0], atol=1e-16)


@settings(deadline=None)
@given(
    cell=st.tuples(st.integers(-1, 3), st.integers(-1, 4)),
    within=st.tuples(st.floats(0.05, 0.95), st.floats(0.05, 0.95)),
)
def test_slopes_are_those_of_the_values(cell: tuple[int, int], within: tuple[float, float]) -> None:
    """Inside each cell and beyond each end (cell -1 and the last)."""
    long_times = np.array([-5.0, *TIMES, 40.0])
    long_depths = np.array([-9.0, *DEPTHS, 30.0])
    i, j = cell[0] + 1, cell[1] + 1
    time_s = long_times[i] + within[0] * (long_times[i + 1] - long_times[i])
    depth_m = long_depths[j] + within[1] * (long_depths[j + 1] - long_depths[j])
    value, h = at(GRID, time_s, depth_m), 1e-5
    by_time = (at(GRID, time_s + h, depth_m) - at(GRID, time_s - h, depth_m))[:2] / (2 * h)
    by_depth = (at(GRID, time_s, depth_m + h) - at(GRID, time_s, depth_m - h))[:2] / (2 * h)
    np.testing.assert_allclose(value[2:4], by_time, atol=1e-9)
    np.testing.assert_allclose(value[4:6], by_depth, atol=1e-9)
    if not 0 <= cell[0] < 3:
        assert not value[2:4].any()
    if not 0 <= cell[1] < 4:
        assert not value[4:6].any()


def test_a_random_series_has_the_spread_and_memory_asked_for() -> None:
    """20 hours with a memory of 60 s: some 600 independent draws a component."""
    mean = sea.sheared_current(np.array([0.0, 10.0]), np.array([[0.1, 0.0], [0.3, 0.0]]))
    series = sea.varying_current(mean, 0.05, 60.0, 72_000.0, np.random.default_rng(4))
    assert series.time_s[0] == 0.0 and series.time_s[-1] >= 72_000.0
    steps = np.diff(series.time_s)
    np.testing.assert_allclose(steps, steps[0])
    random = series.velocity_ne_mps - mean.velocity_ne_mps
    np.testing.assert_allclose(random[:, 0], random[:, 1], atol=1e-15)  # alike at all depths
    for axis in range(2):
        process = random[:, 0, axis]
        assert abs(process.mean()) < 4 * 0.05 * math.sqrt(2.0 / 1200.0)
        assert 0.045 < process.std() < 0.055
        lag = round(60.0 / steps[0])
        correlation = np.corrcoef(process[:-lag], process[lag:])[0, 1]
        assert 0.25 < correlation < 0.48  # 1 / e = 0.37
    assert abs(np.corrcoef(random[:, 0, 0], random[:, 0, 1])[0, 1]) < 0.15


@settings(deadline=None, max_examples=20)
@given(times=st.integers(1, 4), depths=st.integers(1, 4), seed=st.integers(0, 99))
def test_a_file_gives_its_values_in_whatever_order(
    tmp_path_factory: pytest.TempPathFactory, times: int, depths: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    values = rng.normal(0.0, 0.2, (times, depths, 2)).round(6)
    rows = [
        f"{10.0 * i},{2.5 * j + 1},{values[i, j, 0]},{values[i, j, 1]}"
        for i in range(times)
        for j in range(depths)
    ]
    path = tmp_path_factory.mktemp("current") / "current.csv"
    header = "time_s,depth_m,north_mps,east_mps"
    path.write_text("\n".join([header, *rng.permutation(rows)]) + "\n")
    current = sea.read_current(path)
    np.testing.assert_array_equal(current.velocity_ne_mps, values)
    np.testing.assert_array_equal(current.time_s, 10.0 * np.arange(times))
    np.testing.assert_array_equal(current.depth_m, 2.5 * np.arange(depths) + 1)


def test_shear_is_linear_between_and_constant_beyond() -> None:
    shear = sea.sheared_current(np.array([2.0, 12.0]), np.array([[0.1, 0.0], [0.4, 90.0]]))
    np.testing.assert_allclose(at(shear, 3.0, 0.0), [0.1, 0.0, 0, 0, 0, 0], atol=1e-16)
    np.testing.assert_allclose(at(shear, 3.0, 99.0), [0.0, 0.4, 0, 0, 0, 0], atol=1e-16)
    middle = at(shear, 3.0, 7.0)
    np.testing.assert_allclose(middle, [0.05, 0.2, 0.0, 0.0, -0.01, 0.04], atol=1e-15)


@settings(deadline=None)
@given(time_s=st.floats(-5.0, 40.0), depth_m=st.floats(-5.0, 30.0))
def test_interpolation_is_numpys_along_either_axis(time_s: float, depth_m: float) -> None:
    value = at(GRID, time_s, depth_m)
    for axis in range(2):
        by_depth = [np.interp(depth_m, DEPTHS, row) for row in GRID.velocity_ne_mps[:, :, axis]]
        assert value[axis] == pytest.approx(np.interp(time_s, TIMES, by_depth), abs=1e-12)


@pytest.mark.parametrize(
    "rows", ["", "0,1,0.1", "0,1,0.1,x", "0,1,0.1,0\n0,2,0.1,0\n9,1,0.1,0", "0,1,0.1,0\n0,1,0.1,0"]
)
def test_a_file_with_gaps_is_refused(tmp_path: Path, rows: str) -> None:
    path = tmp_path / "current.csv"
    path.write_text(f"time_s,depth_m,north_mps,east_mps\n{rows}\n")
    with pytest.raises(AliceError, match=r"current\.csv"):
        sea.read_current(path)


@given(period_s=st.floats(1.0, 30.0), depth_m=st.floats(0.5, 500.0))
def test_wave_numbers_obey_the_dispersion_relation(period_s: float, depth_m: float) -> None:
    k = sea.wave_number(period_s, depth_m)
    omega = 2 * math.pi / period_s
    assert k > 0
    assert sea.GRAVITY * k * math.tanh(k * depth_m) == pytest.approx(omega**2, rel=1e-9)


def test_swell_is_added_to_the_current_along_its_way() -> None:
    depth_m, period_s, towards = 15.0, 6.0, math.radians(30.0)
    current = sea.with_swell(
        motions.constant_current(0.1, 90.0), 0.5, period_s, 30.0, depth_m, 60.0
    )
    maximum = float(sea.orbital_speed_mps(0.5, period_s, depth_m, 12.5))
    for time_s in (0.0, 1.0, 17.3, 42.0):
        waves = at(current, time_s, 12.5)[:2] - [0.0, 0.1]
        along = waves @ [math.cos(towards), math.sin(towards)]
        across = waves @ [-math.sin(towards), math.cos(towards)]
        expected = maximum * math.cos(2 * math.pi * time_s / period_s)
        # Straight pieces between times and between layers.
        assert along == pytest.approx(expected, abs=0.012 * maximum)
        assert across == pytest.approx(0.0, abs=1e-12)


def test_a_varying_current_is_kept_under_the_waves() -> None:
    grid = np.array([[[0.1, 0.0], [0.0, 0.0]], [[0.3, 0.1], [0.0, 0.2]]])
    varying = sea.Current(np.array([0.0, 40.0]), np.array([0.0, 10.0]), grid)
    calm = sea.with_swell(varying, 0.0, 6.0, 0.0, 10.0, 40.0)
    for time_s in (0.0, 13.0, 40.0):
        for depth_m in (0.0, 3.0, 10.0):
            np.testing.assert_allclose(
                at(calm, time_s, depth_m)[:2], at(varying, time_s, depth_m)[:2], atol=1e-12
            )


def test_deep_and_shallow_water_are_the_known_limits() -> None:
    omega = 2 * math.pi / 4.0
    assert sea.wave_number(4.0, 200.0) == pytest.approx(omega**2 / sea.GRAVITY, rel=1e-12)
    long = 2 * math.pi / 60.0
    assert sea.wave_number(60.0, 2.0) == pytest.approx(
        long / math.sqrt(sea.GRAVITY * 2.0), rel=2e-3
    )


def test_deep_water_orbits_are_circles_that_shrink_with_depth() -> None:
    """At the surface the speed is that of a circle of the wave's height, once a period."""
    k = sea.wave_number(5.0, 300.0)
    speeds = sea.orbital_speed_mps(1.0, 5.0, 300.0, np.array([0.0, 1.0 / k]))
    assert speeds[0] == pytest.approx(math.pi / 5.0, rel=1e-9)
    assert speeds[1] == pytest.approx(math.pi / 5.0 / math.e, rel=1e-9)


def tilted(at_origin: float, per_north: float, per_east: float) -> FloorGrid:
    """A plane of depths over -50 to 50 m, which bilinear cells hold exactly."""
    places = np.arange(-50.0, 50.5, 0.5)
    depth = at_origin + per_north * places[:, None] + per_east * places[None, :]
    return FloorGrid(-50.0, -50.0, 0.5, depth)


def unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector)


def test_depths_at_nodes_between_them_and_beyond_the_edges() -> None:
    """Rows go north, columns east; the value in the middle of a cell is the mean of its corners."""
    floor = FloorGrid(10.0, -4.0, 2.0, np.array([[1.0, 2.0, 3.0], [5.0, 7.0, 8.0]]))
    for i in range(2):
        for j in range(3):
            assert floor_depth(floor, 10.0 + 2 * i, -4.0 + 2 * j) == floor.depth_m[i, j]
    assert floor_depth(floor, 11.0, -3.0) == (1.0 + 2.0 + 5.0 + 7.0) / 4
    assert floor_depth(floor, 10.5, -4.0) == 2.0
    assert floor_depth(floor, -99.0, -99.0) == 1.0
    assert floor_depth(floor, 99.0, 99.0) == 8.0
    assert floor_depth(floor, 99.0, -3.0) == 6.0
    assert floor_depth(level_floor(7.5), 1e6, -1e6) == 7.5


@settings(deadline=None)
@given(
    place=arrays(np.float64, 2, elements=st.floats(-20.0, 20.0)),
    altitude=st.floats(0.05, 8.0),
    tilts=arrays(np.float64, 4, elements=st.floats(-0.5, 0.5)),
)
def test_range_along_a_beam_to_a_slope(place: Array, altitude: float, tilts: Array) -> None:
    """Closed form: the altitude straight down, over how fast the beam gains on the floor."""
    slopes, beam = tilts[:2], unit(np.array([*tilts[2:], 1.0]))
    depth = 40.0 + float(slopes @ place) - altitude
    expected = altitude / (beam[2] - slopes @ beam[:2])
    floor = tilted(40.0, *slopes)
    found = floor_range(floor, place[0], place[1], depth, beam[0], beam[1], beam[2], 30.0)
    if expected < 29.9:
        assert found == pytest.approx(expected, abs=1e-6)
    elif expected > 30.1:
        assert math.isnan(found)


def test_a_beam_ends_on_the_near_side_of_a_ridge() -> None:
    """A ridge 2 m high, 4 m wide at its foot, sides of 45 degrees, in front of a level floor: a
    beam that would meet the ridge, leave it and meet the floor beyond ends on the near side."""
    north = np.arange(0.0, 40.0, 0.25)
    ridge = 10.0 - np.clip(2.0 - np.abs(north - 10.0), 0.0, None)
    floor = FloorGrid(0.0, 0.0, 0.25, np.tile(ridge[:, None], (1, 5)))
    # From (2, 9 m deep), falling 1 in 40: at north x its depth is 9 + (x - 2) / 40; the near side
    # has the depth 18 - x there.
    beam = unit(np.array([1.0, 0.0, 1.0 / 40.0]))
    meets = (18.0 - 9.0 + 2.0 / 40.0) / (1.0 + 1.0 / 40.0)
    expected = (meets - 2.0) / beam[0]
    found = floor_range(floor, 2.0, 0.5, 9.0, beam[0], beam[1], beam[2], 60.0)
    assert found == pytest.approx(expected, abs=1e-6)
    beyond = floor_range(level_floor(10.0), 2.0, 0.5, 9.0, beam[0], beam[1], beam[2], 60.0)
    assert beyond == pytest.approx(1.0 / beam[2], abs=1e-6)


@settings(deadline=None)
@given(
    north=st.floats(-49.0, 49.0),
    east=st.floats(-49.0, 49.0),
    slopes=st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
)
def test_depths_of_a_plane(north: float, east: float, slopes: tuple[float, float]) -> None:
    depth = floor_depth(tilted(20.0, *slopes), north, east)
    assert depth == pytest.approx(20.0 + slopes[0] * north + slopes[1] * east, abs=1e-9)


def test_no_echo_is_nan() -> None:
    floor = level_floor(10.0)
    assert floor_range(floor, 0.0, 0.0, 8.0, 0.0, 0.0, 1.0, 5.0) == pytest.approx(2.0, abs=1e-6)
    assert math.isnan(floor_range(floor, 0.0, 0.0, 8.0, 0.0, 0.0, 1.0, 1.9))  # too far
    assert math.isnan(floor_range(floor, 0.0, 0.0, 8.0, 1.0, 0.0, 0.0, 50.0))  # level
    assert math.isnan(floor_range(floor, 0.0, 0.0, 8.0, 0.0, 0.0, -1.0, 50.0))  # upwards
    assert math.isnan(floor_range(floor, 0.0, 0.0, 10.1, 0.0, 0.0, 1.0, 50.0))  # below the floor
    assert math.isnan(floor_range(floor, 0.0, 0.0, 10.0, 0.0, 0.0, 1.0, 50.0))  # on the floor
