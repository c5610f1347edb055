"""Currents: directions, interpolation and its slopes, random series, files."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alice_survey.core.errors import AliceError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import sea

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
        value = at(sea.constant_current(0.2, towards_deg), time_s, depth_m)
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
