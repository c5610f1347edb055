import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from alice_survey.config import FlightConfig, parse_config
from alice_survey.frames import attitude_from_rotation, interpolate_poses
from camera_calib.rig import design_rig
from missions.plan import Plan, make_plan
from missions.route import route_through
from missions.track import (
    Flight,
    LevelFloor,
    depth_clamped,
    fly_plan,
    gauss_markov,
    low_pass,
    smooth_way,
    triggers,
)

GLASS = (0.55, -0.05, 0.08)
EXACT = FlightConfig(
    track_sigma_m=0, altitude_sigma_m=0, heading_sigma_deg=0, roll_sigma_deg=0, pitch_sigma_deg=0
)


@dataclass(frozen=True)
class Slope:
    """A sea floor that falls to the north, with a ripple too short to follow."""

    fall: float = 0.1
    ripple_m: float = 0.0

    @property
    def bounds_ne_m(self) -> tuple[float, float, float, float]:
        return (-50.0, 50.0, -50.0, 50.0)

    def depth_at(self, points_ne: NDArray[np.float64]) -> NDArray[np.float64]:
        inside = np.abs(points_ne).max(axis=-1) <= 50.0
        wave = self.ripple_m * np.sin(2 * math.pi * points_ne[..., 1] / 0.5)
        return np.where(inside, 15.0 + self.fall * points_ne[..., 0] + wave, np.nan)


@lru_cache
def small_plan(heading_deg: float = 20.0) -> Plan:
    config = parse_config(
        {"area": {"length_m": 4.6, "width_m": 4.0, "heading_deg": heading_deg}}, "test"
    )
    return make_plan(config, design_rig(config.camera, config.water))


USUAL = FlightConfig()


def flown(errors: FlightConfig = USUAL, seed: int = 1) -> Flight:
    rng = np.random.default_rng(seed)
    return fly_plan(small_plan(), errors, LevelFloor(depth_m=15.0), GLASS, rng)


def glass_at(flight: Flight, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
    poses = interpolate_poses(flight.truth.time_s, flight.truth.ned_from_body, times_s)
    return np.asarray(poses.apply(np.array(GLASS)))


def test_without_errors_pictures_are_taken_exactly_where_planned() -> None:
    plan, flight = small_plan(), flown(EXACT)
    stations = np.vstack([line.stations_ne for line in plan.lines])

    taken = glass_at(flight, flight.trigger_s)

    np.testing.assert_allclose(taken[:, :2], stations, atol=1e-6)
    np.testing.assert_allclose(taken[:, 2], 13.0, atol=1e-9)
    poses = interpolate_poses(flight.truth.time_s, flight.truth.ned_from_body, flight.trigger_s)
    attitude = attitude_from_rotation(poses.rotation)
    headings = np.array([plan.lines[i].heading_rad for i in flight.trigger_line])
    np.testing.assert_allclose(np.cos(attitude[:, 2] - headings), 1.0, atol=1e-12)
    np.testing.assert_allclose(attitude[:, :2], 0.0, atol=1e-12)


def test_triggers_come_at_the_planned_interval_on_lines_only() -> None:
    plan, flight = small_plan(), flown()
    lines = np.array(flight.trigger_line)

    assert len(flight.trigger_s) == plan.stations
    assert np.all(np.diff(flight.trigger_s) > 0)
    for index, line in enumerate(plan.lines):
        times = flight.trigger_s[lines == index]
        assert len(times) == line.stations
        np.testing.assert_allclose(np.diff(times), plan.interval_s, atol=1e-6)
    assert flight.truth.time_s[0] == 0.0
    assert flight.trigger_s[0] == pytest.approx(plan.run_in_m / plan.speed_mps)
    assert flight.trigger_s[-1] < flight.truth.time_s[-1]


def test_the_flight_lasts_as_long_as_the_plan_says() -> None:
    plan, flight = small_plan(), flown()
    assert flight.truth.time_s[-1] == pytest.approx(plan.duration_s, abs=1 / 20)
    np.testing.assert_allclose(np.diff(flight.truth.time_s), 1 / 20, atol=1e-9)


def test_velocity_is_continuous_and_turns_are_bounded() -> None:
    plan = small_plan()
    route = route_through(plan.lines, plan.turn_radius_m, plan.run_in_m)
    step_s = 0.01
    along = np.arange(0.0, plan.duration_s, step_s) * plan.speed_mps
    places, headings = smooth_way(plan, route, along)

    velocity = np.diff(places, axis=0) / step_s
    speed = np.linalg.norm(velocity, axis=1)
    assert speed.max() <= plan.speed_mps * (1 + 1e-5)
    assert speed.min() > 0.85 * plan.speed_mps
    acceleration = np.linalg.norm(np.diff(velocity, axis=0), axis=1) / step_s
    centripetal = plan.speed_mps**2 / plan.turn_radius_m
    assert acceleration.max() < 1.5 * centripetal
    # A route of straights and arcs would jump by the whole centripetal acceleration.
    jerk = np.abs(np.diff(acceleration))
    assert jerk.max() < 0.1 * centripetal
    yaw_rate = np.diff(headings) / step_s
    assert np.abs(yaw_rate).max() < 1.1 * plan.speed_mps / plan.turn_radius_m
    assert np.abs(np.diff(yaw_rate)).max() < 0.1 * plan.speed_mps / plan.turn_radius_m


def test_smoothing_leaves_the_lines_alone() -> None:
    plan = small_plan()
    route = route_through(plan.lines, plan.turn_radius_m, plan.run_in_m)
    for index, start_m in route.line_starts_m().items():
        line = plan.lines[index]
        places, headings = smooth_way(
            plan, route, start_m + np.linspace(0.0, line.length_m, line.stations)
        )
        np.testing.assert_allclose(places, line.stations_ne, atol=1e-6)
        np.testing.assert_allclose(np.cos(headings - line.heading_rad), 1.0, atol=1e-12)
    assert route.length_m == pytest.approx(plan.length_m)


@settings(deadline=None, max_examples=5)
@given(correlation_s=st.floats(2.0, 20.0), sigma=st.floats(0.01, 10.0))
def test_gauss_markov_has_its_variance_and_correlation(correlation_s: float, sigma: float) -> None:
    rng = np.random.default_rng(5)
    step_s = correlation_s / 20
    count = 40_000  # 2,000 correlation times
    values = gauss_markov(rng, sigma, correlation_s, step_s, count)

    assert values.std() == pytest.approx(sigma, rel=0.1)
    omega = 2.1461932206205825 / correlation_s
    for lag in (1, 10, 20, 40):
        measured = np.mean(values[:-lag] * values[lag:]) / np.mean(values**2)
        t = omega * lag * step_s
        assert measured == pytest.approx((1 + t) * math.exp(-t), abs=0.06)
    assert (1 + omega * correlation_s) * math.exp(-omega * correlation_s) == pytest.approx(
        1 / math.e
    )


def test_gauss_markov_is_stationary_from_its_first_sample() -> None:
    draws = np.array(
        [gauss_markov(np.random.default_rng(i), 2.0, 8.0, 0.05, 40) for i in range(3000)]
    )
    for column in (0, 1, 20, 39):
        assert draws[:, column].std() == pytest.approx(2.0, rel=0.05)
        assert draws[:, column].mean() == pytest.approx(0.0, abs=0.15)


def test_gauss_markov_has_a_continuous_rate() -> None:
    values = gauss_markov(np.random.default_rng(2), 1.0, 8.0, 0.001, 20_000)
    rate = np.diff(values) / 0.001
    # Of first order the rate would grow without bound as the step falls; here it changes smoothly.
    assert np.abs(np.diff(rate)).max() < 0.1 * np.abs(rate).max()
    assert rate.std() == pytest.approx(2.146 / 8.0, rel=0.5)


def test_no_sigma_gives_no_error() -> None:
    assert not gauss_markov(np.random.default_rng(2), 0.0, 8.0, 0.05, 100).any()


def test_errors_have_the_sigmas_of_the_settings() -> None:
    errors = FlightConfig(correlation_s=1.0)
    exact = flown(EXACT.model_copy(update={"correlation_s": 1.0}))
    pooled: dict[str, list[NDArray[np.float64]]] = {k: [] for k in ("track", "alt", "r", "p", "h")}
    for seed in range(4):
        flight = flown(errors, seed)
        off = flight.glass_ned - exact.glass_ned
        attitude = attitude_from_rotation(flight.truth.ned_from_body.rotation)
        ideal = attitude_from_rotation(exact.truth.ned_from_body.rotation)
        right = np.stack([-np.sin(ideal[:, 2]), np.cos(ideal[:, 2])], axis=1)
        pooled["track"].append((off[:, :2] * right).sum(axis=1))
        pooled["alt"].append(off[:, 2])
        pooled["r"].append(np.rad2deg(attitude[:, 0]))
        pooled["p"].append(np.rad2deg(attitude[:, 1]))
        pooled["h"].append(np.rad2deg(np.angle(np.exp(1j * (attitude[:, 2] - ideal[:, 2])))))
        along = (off[:, :2] ** 2).sum(axis=1) - pooled["track"][-1] ** 2
        assert np.abs(along).max() < 1e-12

    for name, sigma in (("track", 0.05), ("alt", 0.03), ("r", 1.5), ("p", 1.5), ("h", 1.5)):
        assert np.concatenate(pooled[name]).std() == pytest.approx(sigma, rel=0.15)


def test_the_body_is_a_lever_arm_away_from_the_glass() -> None:
    flight = flown()
    np.testing.assert_allclose(
        flight.truth.ned_from_body.apply(np.array(GLASS)), flight.glass_ned, atol=1e-12
    )


def test_the_vehicle_follows_the_terrain_but_not_its_ripples() -> None:
    plan = small_plan()
    rng = np.random.default_rng(1)
    flight = fly_plan(plan, EXACT, Slope(), GLASS, rng)
    altitude = Slope().depth_at(flight.glass_ned[:, :2]) - flight.glass_ned[:, 2]
    on_lines = np.interp(flight.trigger_s, flight.truth.time_s, altitude)
    # A slope of 0.1 is followed; its kinks at turns are rounded.
    assert np.abs(on_lines - 2.0).max() < 0.05

    rippled = fly_plan(plan, EXACT, Slope(ripple_m=0.1), GLASS, rng)
    apart = rippled.glass_ned[:, 2] - flight.glass_ned[:, 2]
    assert np.sqrt(np.mean(apart**2)) < 0.2 * 0.1 / math.sqrt(2)
    climb = np.abs(np.diff(rippled.glass_ned[:, 2])) * 20
    assert climb.max() < 0.2 * plan.speed_mps


def test_low_pass_keeps_straight_lines_and_constants() -> None:
    ramp = 3.0 + 0.5 * np.arange(100.0)
    np.testing.assert_allclose(low_pass(ramp, 8)[10:-10], ramp[10:-10], atol=1e-12)
    np.testing.assert_allclose(low_pass(np.full(50, 7.0), 12.3), 7.0, atol=1e-12)
    assert low_pass(ramp, 0.2).tolist() == ramp.tolist()
    wave = np.sin(2 * math.pi * np.arange(400) / 8)
    assert np.abs(low_pass(wave, 16)[20:-20]).max() < 0.01


def test_beyond_its_bounds_the_floor_goes_on_level() -> None:
    points = np.array([[60.0, 0.0], [-70.0, 80.0], [10.0, 0.0]])
    np.testing.assert_allclose(depth_clamped(Slope(), points), [20.0, 10.0, 16.0], atol=1e-5)


def test_the_same_seed_flies_the_same_way() -> None:
    one, two, other = flown(seed=3), flown(seed=3), flown(seed=4)
    assert one.glass_ned.tobytes() == two.glass_ned.tobytes()
    assert one.glass_ned.tobytes() != other.glass_ned.tobytes()


def test_triggers_need_no_errors() -> None:
    plan = small_plan()
    route = route_through(plan.lines, plan.turn_radius_m, plan.run_in_m)
    times, lines = triggers(plan, route)
    places = route.places(times * plan.speed_mps)
    np.testing.assert_allclose(
        places, np.vstack([line.stations_ne for line in plan.lines]), atol=1e-5
    )
    assert lines == tuple(i for i, line in enumerate(plan.lines) for _ in range(line.stations))
