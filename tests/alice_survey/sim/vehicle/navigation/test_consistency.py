"""Are navigation's errors as large as it states? Many runs over one track."""

from functools import cache

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from alice_survey.sim.vehicle.navigation.sensors import FOLLOWED, DvlSpec, SensorSuite, UsblSpec
from alice_survey.sim.vehicle.navigation.tick import LOG_COLUMNS
from alice_survey.sim.vehicle.sea import FloorGrid, level_floor
from tests.alice_survey.sim.vehicle.navigation.navigation_runs import (
    Array,
    Run,
    fly,
    straight,
    track,
)

RUNS = 50
DURATION_S = 600.0
SUITES = {
    "default": SensorSuite(),
    "drop-out": SensorSuite(dvl_dropouts_s=((200.0, 230.0),)),
    "usbl": SensorSuite(usbl=UsblSpec(rate_hz=0.2, boat_ned_m=(10.0, 5.0, 1.0))),
}
EACH = ["default", *(pytest.param(n, marks=pytest.mark.slow) for n in ("drop-out", "usbl"))]
SPACING_M = 0.1


@cache
def runs(name: str) -> list[Run]:
    """Ten minutes of lawnmower at 0.2 m/s with six turns, rolling, pitching and crabbing."""
    sensors, truth = SUITES[name].pack(), track(DURATION_S)
    return [fly(sensors, truth, level_floor(15.0), seed) for seed in range(RUNS)]


@pytest.mark.slow
@pytest.mark.parametrize("name", SUITES)
@pytest.mark.parametrize("states", [slice(0, 25), slice(0, 15), slice(0, 9)])
def test_errors_are_as_large_as_the_covariance_says(name: str, states: slice) -> None:
    nees = np.array([run.nees(states) for run in runs(name)])
    size = states.stop - states.start
    low, high = (chi2.ppf(share, RUNS * size) / RUNS for share in (0.025, 0.975))
    mean = nees.mean(axis=0)
    assert np.mean((mean > low) & (mean < high)) >= 0.9


@pytest.mark.parametrize("name", EACH)
def test_innovations_are_white_and_of_unit_variance(name: str) -> None:
    # Compass, depth, the four beams, and what USBL there is; outliers stand far out.
    for place in (0, 1, 2, 3, 4, 5, 12, 13):
        series = [run.innovations[:, place] for run in runs(name)]
        due = [values[np.isfinite(values) & (np.abs(values) < 5.0)] for values in series]
        if not due[0].size:
            continue
        square = np.concatenate(due)
        count = square.size
        # Four standard deviations of the mean square and of the correlation of white numbers.
        assert np.mean(square**2) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / count) + 0.01)
        together = np.mean([np.mean(values[1:] * values[:-1]) for values in due])
        assert abs(together) < 4.0 / np.sqrt(count) + 0.01


@pytest.mark.parametrize("name", EACH)
def test_sigmas_of_the_log_are_those_of_the_errors(name: str) -> None:
    truth = runs(name)[0].truth
    angles = Rotation.from_quat(truth[:, 3:7]).as_euler("ZYX")[:, ::-1]
    # Runs are independent, epochs of a run are not: 50 draws of each, good to 10 %.
    for columns, expected in (((0, 1, 2), truth[:, :3]), ((3, 4, 5), angles)):
        for axis, column in enumerate(columns):
            ratios = []
            for run in runs(name):
                error = run.log[::100, column] - expected[::100, axis]
                if column >= 3:
                    error = (error + np.pi) % (2 * np.pi) - np.pi
                ratios.append(error / run.log[::100, 13 + column])
            rms = np.sqrt(np.mean(np.square(ratios)))
            assert 0.7 < rms < 1.35, LOG_COLUMNS[column]


def relief(height_m: float, width_m: float, seed: int = 5) -> FloorGrid:
    """A rough floor about 15 m deep: smoothed noise."""
    rough = gaussian_filter(np.random.default_rng(seed).standard_normal((400, 400)), width_m * 10)
    return FloorGrid(-10.0, -10.0, SPACING_M, 15.0 + height_m * rough / rough.std())


def slope(rise: float) -> FloorGrid:
    """A floor that falls to the north."""
    depth = 15.0 + rise * (np.arange(400) * SPACING_M - 10.0)
    return FloorGrid(-10.0, -10.0, SPACING_M, np.repeat(depth[:, None], 400, axis=1))


def altitude_error(run: Run, floor: FloorGrid) -> tuple[Array, Array]:
    """Error and sigma of the altitude above the floor straight below the followed point."""
    place = run.sensors.place[FOLLOWED]
    point = run.truth[:, :3] + Rotation.from_quat(run.truth[:, 3:7]).apply(place)
    north, east = (floor.spacing_m * np.arange(count) for count in floor.depth_m.shape)
    depth_at = RegularGridInterpolator((floor.north_m + north, floor.east_m + east), floor.depth_m)
    altitude = run.log[:, LOG_COLUMNS.index("altitude_m")]
    error: Array = altitude - (depth_at(point[:, :2]) - point[:, 2])
    return error, run.log[:, LOG_COLUMNS.index("sigma_altitude_m")]


@pytest.mark.parametrize(
    ("floor", "low", "high"),
    [
        (slope(0.0), 0.8, 1.25),
        # Relief as wide as the beams are apart: a ping's own plane follows part of what strays from
        # the mean slope.
        (relief(0.15, 1.0), 0.35, 1.1),
        (relief(0.1, 0.3), 0.75, 1.25),
        # A slope is a plane.
        (slope(0.1), 0.7, 1.25),
        (slope(0.5), 0.7, 1.25),
    ],
)
def test_altitude_errs_as_the_beams_say(floor: FloorGrid, low: float, high: float) -> None:
    flights = [fly(SensorSuite().pack(), track(300.0), floor, seed) for seed in range(6)]
    error, sigma = np.hstack([altitude_error(run, floor) for run in flights])
    known = np.isfinite(error)
    assert known.mean() > 0.99
    assert low < np.sqrt(np.mean((error[known] / sigma[known]) ** 2)) < high


def wall(height_m: float) -> FloorGrid:
    """A level floor that a wall, oblique to the track, ends at."""
    north, east = np.meshgrid(*2 * [np.arange(400) * SPACING_M - 10.0], indexing="ij")
    return FloorGrid(-10.0, -10.0, SPACING_M, 15.0 + height_m * (0.8 * north + 0.6 * east > 5.0))


@pytest.mark.parametrize(
    ("floor", "most_optimistic", "least_m"),
    [
        (slope(0.0), 0.05, -0.1), (relief(0.1, 0.3), 0.15, -0.6), (relief(0.3, 0.5), 0.1, -1.5),
        (wall(6.0), 0.05, -1.2),
    ],
)  # fmt: skip
def test_clearance_is_rarely_less_than_heard_also_above_the_edge_of_a_wall(
    floor: FloorGrid, most_optimistic: float, least_m: float
) -> None:
    """With the hull wholly over what is high, as the plan has it, a wall costs a margin alone."""
    run = fly(SensorSuite().pack(), track(300.0), floor, 3)
    places = floor.north_m + floor.spacing_m * np.arange(len(floor.depth_m))
    depth_at = RegularGridInterpolator((places, places), floor.depth_m, method="nearest")
    turns = Rotation.from_quat(run.truth[:, 3:7])
    low = [run.truth[:, :3] + turns.apply(point) for point in run.sensors.low]
    true = np.min([depth_at(point[:, :2]) - point[:, 2] for point in low], axis=0)
    error = run.log[:, LOG_COLUMNS.index("clearance_m")] - true
    error = error[np.isfinite(error) & (true < 3.0)]
    assert len(error) > 1000 and np.mean(error > 0.0) < most_optimistic
    assert np.quantile(error, 0.01) > least_m


def test_altitude_is_carried_by_depth_and_given_up_in_time() -> None:
    dvl = DvlSpec(outlier_probability=0.0)
    suite = SensorSuite(dvl=dvl, dvl_dropouts_s=((30.0, 40.0),), altitude_age_s=3.0)
    truth = straight(60.0, 0.1)
    # Sinks by 2 cm/s all the while.
    truth[:, 2] += 0.02 * np.arange(len(truth)) * 0.05 - 1.0
    truth[:, 9] = 0.02
    floor = slope(0.0)
    run = fly(suite.pack(), truth, floor, 1)
    error, sigma = altitude_error(run, floor)
    heard = np.flatnonzero(np.isfinite(run.log[:600, LOG_COLUMNS.index("altitude_m")]))[-1]
    assert heard == 599
    last_ping = 599 - 599 % 4
    known = np.isfinite(error[600:800])
    assert known.sum() == last_ping + 60 - 599
    assert not known[last_ping + 61 - 600 :].any()
    assert np.abs(error[600 : 600 + known.sum()]).max() < 5.0 * sigma[599]
    assert np.all(np.isfinite(error[804:]))
