import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.config import CameraConfig, FlightConfig
from alice_survey.frames import Datum, attitude_from_rotation, rotation_from_attitude
from alice_survey.trajectory import Trajectory
from missions.navigation import (
    NAVIGATION_COLUMNS,
    NavigationLog,
    beam_ranges,
    dvl_altitude,
    navigate,
    write_navigation,
)
from missions.track import LevelFloor, gauss_markov

CAMERA = CameraConfig()
FLOOR = LevelFloor(depth_m=15.0)
PERFECT = FlightConfig(
    position_bias_sigma_m=0,
    position_walk_m_per_sqrt_s=0,
    depth_noise_m=0,
    altitude_noise_m=0,
    attitude_noise_deg=0,
    heading_bias_sigma_deg=0,
)


@dataclass(frozen=True)
class Slope:
    fall: float

    @property
    def bounds_ne_m(self) -> tuple[float, float, float, float]:
        return (-math.inf, math.inf, -math.inf, math.inf)

    def depth_at(self, points_ne: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(15.0 + self.fall * points_ne[..., 0])


@dataclass(frozen=True)
class Hills:
    """Relief of the size and length of the simulated sea floor's."""

    north_m: float
    east_m: float

    @property
    def bounds_ne_m(self) -> tuple[float, float, float, float]:
        return (-math.inf, math.inf, -math.inf, math.inf)

    def depth_at(self, points_ne: NDArray[np.float64]) -> NDArray[np.float64]:
        north, east = points_ne[..., 0] + self.north_m, points_ne[..., 1] + self.east_m
        return np.asarray(15.0 + 0.1 * np.sin(1.3 * north + 0.4 * east) + 0.1 * np.cos(1.7 * east))


def wandering(count: int = 400, seed: int = 0) -> Trajectory:
    """A track that swings in all six degrees of freedom."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(count) / 20.0
    swing = [gauss_markov(rng, s, 4.0, 0.05, count) for s in (0.03, 0.03, 0.4, 0.1)]
    rotation = rotation_from_attitude(swing[0], swing[1], 3.0 + swing[2])
    places = np.column_stack([0.2 * time_s, 0.1 * time_s, 12.9 + swing[3]])
    return Trajectory(time_s=time_s, ned_from_body=RigidTransform.from_components(places, rotation))


def errors_of(log: NavigationLog, truth: Trajectory) -> dict[str, NDArray[np.float64]]:
    glass = truth.ned_from_body.apply(np.array(CAMERA.position_body_m))
    off = log.position_ned - truth.ned_from_body.translation
    turned = log.attitude_rad - attitude_from_rotation(truth.ned_from_body.rotation)
    turned = np.angle(np.exp(1j * turned))
    return {
        "north": off[:, 0] / log.sigma_horizontal_m,
        "east": off[:, 1] / log.sigma_horizontal_m,
        "depth": off[:, 2] / log.sigma_depth_m,
        "roll": turned[:, 0] / log.sigma_attitude_rad,
        "pitch": turned[:, 1] / log.sigma_attitude_rad,
        "heading": turned[:, 2] / log.sigma_heading_rad,
        "altitude": (log.altitude_m - (15.0 - glass[:, 2])) / log.sigma_altitude_m,
    }


@pytest.mark.parametrize("walk", [0.005, 0.3])
def test_sigmas_are_true_over_many_seeds(walk: float) -> None:
    """Normalised errors have a variance of 1, at the start and at the end."""
    truth = wandering(count=60)
    errors = FlightConfig(position_walk_m_per_sqrt_s=walk)
    runs = [
        errors_of(navigate(truth, errors, FLOOR, CAMERA, np.random.default_rng(seed)), truth)
        for seed in range(400)
    ]
    for name in runs[0]:
        for moment in (0, len(truth.time_s) - 1):
            values = np.array([run[name][moment] for run in runs])
            # 400 draws: the standard deviation is known to 3.5 %.
            assert values.std() == pytest.approx(1.0, abs=0.13), (name, moment)
            assert abs(values.mean()) < 0.2, (name, moment)


def test_position_errors_are_correlated_in_time() -> None:
    """A bias and a walk, not white noise: neighbouring samples differ by far less than sigma."""
    truth = wandering()
    log = navigate(truth, FlightConfig(), FLOOR, CAMERA, np.random.default_rng(1))
    off = log.position_ned[:, :2] - truth.ned_from_body.translation[:, :2]

    steps = np.diff(off, axis=0)
    assert steps.std() == pytest.approx(0.005 * math.sqrt(0.05), rel=0.1)
    assert steps.std() < 0.01 * log.sigma_horizontal_m[0]
    expected = np.sqrt(0.3**2 + 0.005**2 * truth.time_s)
    np.testing.assert_allclose(log.sigma_horizontal_m, expected, rtol=1e-6)


def test_a_perfect_vehicle_knows_where_it_is() -> None:
    truth = wandering()
    log = navigate(truth, PERFECT, FLOOR, CAMERA, np.random.default_rng(1))

    np.testing.assert_allclose(log.position_ned, truth.ned_from_body.translation, atol=1e-12)
    glass = truth.ned_from_body.apply(np.array(CAMERA.position_body_m))
    np.testing.assert_allclose(log.altitude_m, 15.0 - glass[:, 2], atol=1e-5)
    assert log.sigma_altitude_m < 1e-4
    assert log.sigma_depth_m > 0


@pytest.mark.parametrize("tilt_deg", [0.0, 3.0, 10.0])
def test_the_dvl_gives_the_altitude_of_the_port(tilt_deg: float) -> None:
    """Over a level floor slant and lever arm are removed exactly, at any attitude."""
    tilt = math.radians(tilt_deg)
    rotation = rotation_from_attitude(np.array([tilt]), -0.7 * tilt, 2.0)
    truth = Trajectory(
        time_s=np.array([0.0]),
        ned_from_body=RigidTransform.from_components([[1.0, 2.0, 12.8]], rotation),
    )
    altitude, spread_m = dvl_altitude(truth, rotation, FLOOR, CAMERA)

    glass = truth.ned_from_body.apply(np.array(CAMERA.position_body_m))[0]
    assert altitude[0] == pytest.approx(15.0 - glass[2], abs=1e-5)
    assert spread_m < 1e-5


def test_an_attitude_error_moves_the_altitude_by_the_lever_arm() -> None:
    level = rotation_from_attitude(np.zeros(1), 0.0, 0.0)
    truth = Trajectory(
        time_s=np.array([0.0]),
        ned_from_body=RigidTransform.from_components([[0.0, 0.0, 12.9]], level),
    )
    pitched = rotation_from_attitude(np.zeros(1), 0.01, 0.0)
    right, _ = dvl_altitude(truth, level, FLOOR, CAMERA)
    wrong, _ = dvl_altitude(truth, pitched, FLOOR, CAMERA)

    # Bow up by 0.01 rad: the port, 0.96 m before the DVL, is believed 9.6 mm higher.
    assert wrong[0] - right[0] == pytest.approx(0.9645 * 0.01, abs=3e-4)


@pytest.mark.parametrize("fall", [-0.2, 0.0, 0.3])
def test_beams_meet_a_slope_where_they_should(fall: float) -> None:
    rng = np.random.default_rng(2)
    origin = rng.uniform([-5, -5, 11], [5, 5, 13], (50, 3))
    beam = Rotation.from_rotvec(rng.normal(0, 0.3, (50, 3))).apply([0.0, 0.0, 1.0])

    ranges = beam_ranges(Slope(fall), origin, beam)

    closed = (15.0 + fall * origin[:, 0] - origin[:, 2]) / (beam[:, 2] - fall * beam[:, 0])
    np.testing.assert_allclose(ranges, closed, atol=2e-5)


def test_over_hills_the_altitude_sigma_allows_for_what_the_beams_miss() -> None:
    errors, ratios = FlightConfig(), []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        hills = Hills(*rng.uniform(0, 20, 2))
        truth = wandering(count=100, seed=seed)
        log = navigate(truth, errors, hills, CAMERA, rng)
        glass = truth.ned_from_body.apply(np.array(CAMERA.position_body_m))
        altitude = hills.depth_at(glass[:, :2]) - glass[:, 2]
        ratios.append((log.altitude_m - altitude) / log.sigma_altitude_m)
        assert log.sigma_altitude_m > 2 * errors.altitude_noise_m

    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.4


def test_the_file_holds_the_log(tmp_path: Path) -> None:
    truth = wandering()
    log = navigate(truth, FlightConfig(), FLOOR, CAMERA, np.random.default_rng(1))
    datum = Datum(32.8236, 34.9553)
    write_navigation(tmp_path / "navigation.csv", log, datum)

    with (tmp_path / "navigation.csv").open() as file:
        reader = csv.DictReader(file)
        assert tuple(reader.fieldnames or ()) == NAVIGATION_COLUMNS
        rows = list(reader)
    values = {name: np.array([float(row[name]) for row in rows]) for name in NAVIGATION_COLUMNS}
    ned = datum.ned_from_geodetic(
        np.column_stack([values["latitude_deg"], values["longitude_deg"], values["depth_m"]])
    )
    np.testing.assert_allclose(ned, log.position_ned, atol=2e-5)
    assert all(len(row["latitude_deg"].partition(".")[2]) >= 9 for row in rows)
    assert np.all((values["heading_deg"] >= 0) & (values["heading_deg"] < 360))
    np.testing.assert_allclose(
        np.cos(np.deg2rad(values["heading_deg"]) - log.attitude_rad[:, 2]), 1.0, atol=1e-9
    )
    np.testing.assert_allclose(np.deg2rad(values["roll_deg"]), log.attitude_rad[:, 0], atol=1e-7)
    np.testing.assert_allclose(values["altitude_m"], log.altitude_m, atol=1e-5)
    assert values["sigma_heading_deg"][0] == pytest.approx(math.hypot(1.0, 0.3), abs=1e-5)
