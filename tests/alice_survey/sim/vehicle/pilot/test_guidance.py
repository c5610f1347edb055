"""Guidance: one tick against its twin, settings, and closed loops in currents."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.pilot import gains as g
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot import settings as settings_of
from alice_survey.sim.vehicle.pilot.steering import hear_floor, write_point
from alice_survey.sim.vehicle.vehicle import vehicle_from
from tests import oracles_guidance as oracle
from tests.alice_survey.sim.vehicle.pilot import pilot_runs as runs
from tests.alice_survey.sim.vehicle.pilot.pilot_runs import gains_of, steered, straight

TICK_S = 0.05
MOTIONS = arrays(np.float64, 12, elements=st.floats(-1.0, 1.0))
SCALES = np.array([0.3, 0.3, 3.0, 0.3, 0.2, 0.5, 0.4, 0.2, 0.1, 0.1, 0.1, 0.3])
MIDDLE = np.array([10.0, 0.0, 13.0, 0.0, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0, 0.0, 0.0])


def estimate_of(motion: Array, cross_m: float = 0.0) -> Array:
    """An estimate about the middle of a straight path to the north."""
    estimate = np.append(MIDDLE + SCALES * motion, [2.0, 2.0])
    estimate[vector.EAST] += cross_m
    return estimate


@given(motion=MOTIONS)
@settings(deadline=None)
def test_followed_point_moves_as_rotations_say(motion: Array) -> None:
    guidance = runs.guidance_along("alice", "sway")
    estimate, pilot = estimate_of(motion), slot.new_pilot()
    write_point(estimate, guidance, pilot)
    place, velocity, _ = oracle.point_motion(estimate, guidance)
    np.testing.assert_allclose(pilot.point[:2], place[:2], atol=1e-12)
    np.testing.assert_allclose(pilot.point[2:4], velocity, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "controller"), [("alice", "sway"), ("alice", "los"), ("sparus2", "los")]
)
@given(motion=MOTIONS, cross_m=st.floats(-1.5, 1.5))
@settings(deadline=None, max_examples=60)
def test_a_tick_asks_for_what_its_twin_asks(
    name: str, controller: runs.Controller, motion: Array, cross_m: float
) -> None:
    path, gains = straight(20.0), gains_of(name)
    guidance = runs.guidance_along(name, controller)
    estimate = estimate_of(motion, cross_m)
    place, _, _ = oracle.point_motion(estimate, guidance)
    pilot = slot.new_pilot()
    pilot.report[[slot.PHASE, slot.ALONG]] = slot.FOLLOW, place[0]
    expected, cross = oracle.follow_demand(estimate, path, guidance, gains, place[0])
    assume(abs(abs(cross) - guidance.near_m) > 1e-9)
    wrench = steered(path, guidance, gains, pilot, estimate)
    accelerations = pilot.demand[[slot.ACC_SURGE, slot.ACC_SWAY, slot.ACC_YAW]]
    np.testing.assert_allclose(accelerations, expected, atol=1e-9)
    assert pilot.report[slot.CROSS] == pytest.approx(cross, abs=1e-9)
    full = oracle.wrench(gains, pilot.demand)
    if controller == "los":
        full[1] = 0.0
    np.testing.assert_allclose(wrench, full, atol=1e-9)


def test_the_floor_is_smoothed_as_its_transfer_function_says() -> None:
    guidance = runs.guidance_along("alice", "sway")
    rng = np.random.default_rng(2)
    heard = 15.0 + 0.02 * np.arange(800) * TICK_S + 0.05 * rng.standard_normal(800)
    pilot, smoothed = slot.new_pilot(), []
    estimate = np.zeros(vector.ESTIMATE)
    for depth in heard:
        estimate[vector.DEPTH], estimate[vector.ALTITUDE] = 13.0, depth - 13.0
        hear_floor(estimate, TICK_S, guidance, pilot)
        smoothed.append(pilot.memory[slot.FLOOR])
    expected = oracle.smoothed_floor(heard, guidance.floor_rate_rad_s, TICK_S)
    # A tick ends when the next begins.
    np.testing.assert_allclose(smoothed[:-1], expected[1:], atol=0.001)
    # A constant slope is followed without lag, and noise is taken away.
    ramp = 15.0 + 0.02 * np.arange(800) * TICK_S
    assert np.abs(np.array(smoothed[400:]) - ramp[400:]).max() < 0.03
    assert pilot.memory[slot.FLOOR_SLOPE] == pytest.approx(0.02, abs=0.01)


def test_the_offset_has_its_closed_form_without_a_current_along() -> None:
    # sin of the crab angle (U - sqrt(U^2 + 4 c^2)) / (2 c), from c sin^2 - U sin - c = 0.
    speed, across = 0.2, 0.1
    sine = (speed - math.hypot(speed, 2 * across)) / (2 * across)
    expected = -2.0 * math.tan(math.asin(sine))
    assert oracle.los_offset_m(2.0, speed, across) == pytest.approx(expected, rel=1e-12)
    assert oracle.los_offset_m(2.0, speed, across, 1e-9) == pytest.approx(expected, rel=1e-6)
    assert oracle.los_offset_m(2.0, speed, -across) == pytest.approx(-expected, rel=1e-12)
    assert oracle.los_offset_m(2.0, speed, 0.0) == 0.0


@pytest.mark.parametrize("name", ["alice", "sparus2"])
def test_look_ahead_is_the_shortest_that_damps(name: str) -> None:
    gains = gains_of(name)
    shortest = settings_of.min_look_ahead_m(gains, 0.2, 0.55)
    ratios = [
        g.damping_ratio(settings_of.los_loop(gains, 0.2, 0.55, shortest * f))
        for f in (0.8, 1.0, 1.25)
    ]
    assert ratios[0] < ratios[1] < ratios[2]
    assert ratios[1] == pytest.approx(settings_of.LOS_DAMPING_RATIO, abs=1e-3)
    # About the least that the literature takes: 1.5 to 2.5 lengths of the vessel.
    assert 1.0 < shortest / settings_of.CONTROL_LENGTH_M < 2.0


@pytest.mark.parametrize(
    ("coefficients", "expected_m"),
    [("calibrated", 2.87), ("estimated", 1.79), ("cfd", 1.97), ("computed", 1.74)],
)
def test_look_ahead_hangs_on_the_coefficients_as_documented(
    coefficients: str, expected_m: float
) -> None:
    gains = g.gains_for(vehicle_from("sparus2", coefficients), 0.2)
    assert settings_of.min_look_ahead_m(gains, 0.2, 0.0) == pytest.approx(expected_m, abs=0.006)
    with_port = settings_of.min_look_ahead_m(gains, 0.2, 0.55)
    assert with_port == pytest.approx(2.23 if coefficients == "calibrated" else 1.6, abs=0.006)


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize(
    ("name", "speed_mps", "towards_deg"),
    [
        ("sparus2", 0.1, 90.0), ("sparus2", 0.05, 270.0), ("sparus2", 0.1, 45.0),
        ("sparus2", 0.1, 135.0), ("alice", 0.1, 90.0),
    ],
)  # fmt: skip
def test_los_settles_at_the_offset_that_the_current_gives(
    name: str, speed_mps: float, towards_deg: float
) -> None:
    flight = runs.launch(
        runs.straight(100.0), name, "los", current=(speed_mps, towards_deg), following=True
    )
    rows = flight.fly(300.0)
    settled = rows.cross_m[-600:]
    across = speed_mps * math.sin(math.radians(towards_deg))
    along = speed_mps * math.cos(math.radians(towards_deg))
    expected = oracle.los_offset_m(flight.guidance.look_ahead_m, 0.2, across, along)
    assert abs(expected) > 0.3
    assert settled.mean() == pytest.approx(expected, rel=0.02)
    assert np.ptp(settled) < 0.05 * abs(expected)
    crab = math.atan2(expected, flight.guidance.look_ahead_m)
    assert -rows.heading_error_rad[-1] == pytest.approx(crab, abs=0.01)


@pytest.mark.parametrize("towards_deg", [90.0, 0.0, 225.0])
def test_sway_holds_lines_and_heading_in_a_current(towards_deg: float) -> None:
    flight = runs.launch(runs.lawnmower(4, 8.0), current=(0.1, towards_deg))
    rows = flight.fly(420.0)
    assert rows.phases() == [slot.DIVE, slot.APPROACH, slot.FOLLOW, slot.ASCEND, slot.DONE]
    lines = rows.on_lines()
    assert sorted(set(lines.report[:, slot.LINE])) == [0, 1, 2, 3]
    assert 1e-5 < rms(lines.cross_m) < 0.03
    assert 1e-4 < rms(lines.heading_error_rad) < math.radians(1.0)
    assert np.all(lines.report[:, slot.BY_SWAY] == 1.0)
    assert rms(lines.estimate[:, vector.ALTITUDE] - 2.0) < 0.05
    turns = runs.Rows(rows.table[(rows.report[:, slot.PHASE] == slot.FOLLOW)])
    assert 0.0 < np.abs(turns.cross_m).max() < 0.12
    # Lines last as long as their length at the wanted speed over ground.
    assert len(lines.table) * 0.05 == pytest.approx(4 * 8.0 / 0.2, rel=0.02)


@pytest.mark.parametrize("towards_deg", [90.0, 0.0])
def test_a_vehicle_without_sway_flies_every_line_in_order(towards_deg: float) -> None:
    flight = runs.launch(runs.lawnmower(4, 8.0), "sparus2", "los", current=(0.1, towards_deg))
    rows = flight.fly(420.0)
    assert rows.phases() == [slot.DIVE, slot.APPROACH, slot.FOLLOW, slot.ASCEND, slot.DONE]
    following = rows.report[rows.report[:, slot.PHASE] == slot.FOLLOW]
    legs = following[:, slot.LEG].astype(int)
    assert set(np.diff(legs)) <= {0, 1}
    assert legs[0] == 0
    assert legs[-1] == 4 * 3 + 3 - 1
    assert not np.any(following[:, slot.BY_SWAY])
    assert not np.any(rows.wrench[:, 1])
    for line in range(4):
        seconds = 0.05 * np.count_nonzero(following[:, slot.LINE] == line)
        assert 0.6 * 8.0 / 0.2 < seconds < 1.6 * 8.0 / 0.2


@pytest.mark.parametrize(
    ("name", "speed_mps", "current"),
    [
        ("alice", 0.2, (0.0, 0.0)), ("alice", 0.5, (0.0, 0.0)), ("alice", 1.0, (0.0, 0.0)),
        ("sparus2", 0.2, (0.05, 0.0)), ("sparus2", 0.2, (0.05, 180.0)),
    ],
)  # fmt: skip
def test_speed_is_reached_without_overshoot(
    name: str, speed_mps: float, current: tuple[float, float]
) -> None:
    path = runs.straight(100.0, speed_mps=speed_mps)
    controller: runs.Controller = "sway" if name == "alice" else "los"
    flight = runs.launch(path, name, controller, current=current, following=True)
    surge = flight.fly(60.0).estimate[:, vector.U]
    assert surge.max() < 1.05 * speed_mps
    assert surge[-200:].mean() == pytest.approx(speed_mps, rel=0.01 if name == "alice" else 0.02)
    assert name != "alice" or np.argmax(surge > 0.9 * speed_mps) * 0.05 < 15.0


def test_carried_off_it_goes_back_to_where_it_left_the_path() -> None:
    flight = runs.launch(runs.straight(40.0), following=True)
    left = flight.fly(60.0).report[-1, slot.ALONG]
    flight.state[1] += 12.0
    rows = flight.fly(150.0)
    assert rows.phases() == [slot.APPROACH, slot.FOLLOW]
    back = np.argmax(np.diff(rows.report[:, slot.PHASE]) > 0) + 1
    resumed = rows.report[back:]
    # From before the place, on the path when there.
    assert resumed[0, slot.ALONG] == pytest.approx(left - flight.guidance.way_in_m, abs=0.3)
    there = np.argmax(resumed[:, slot.ALONG] > left)
    assert np.abs(resumed[there:, slot.CROSS]).max() < 0.03


def test_a_current_too_strong_for_the_vehicle_ends_in_an_explained_abort() -> None:
    flight = runs.launch(runs.straight(40.0), "sparus2", "los", current=(2.5, 90.0))
    rows = flight.fly(400.0)
    assert rows.phases()[-1] == slot.ABORT
    assert rows.report[-1, slot.REASON] in (slot.NO_DIVE, slot.NO_APPROACH)
    assert rows.report[-1, slot.AT_SURFACE] == 1.0


@pytest.mark.parametrize("name", ["alice", "sparus2"])
def test_fast_paths_slow_down_for_turns_that_are_too_tight(name: str) -> None:
    controller: runs.Controller = "sway" if name == "alice" else "los"
    flight = runs.launch(
        runs.lawnmower(3, 8.0, speed_mps=0.5),
        name,
        controller,
        following=True,
        at_ned=(-0.5, 0.0, 0.0),
    )
    rows = flight.fly(110.0)
    yaw = flight.gains.axes[g.YAW, g.FASTEST]
    on_arcs = rows.report[(rows.report[:, slot.LEG].astype(int) % 4) == 3]
    middle = (on_arcs[:, slot.ALONG] > 0.6) & (on_arcs[:, slot.ALONG] < 1.0)
    assert np.count_nonzero(middle) > 10
    limit = min(yaw, flight.gains.axes[g.SWAY, g.FASTEST] / 0.55 if name == "alice" else yaw) / 2.0
    assert on_arcs[middle, slot.TARGET_SURGE].max() < 1.1 * limit
    assert rows.on_lines().report[:, slot.TARGET_SURGE].max() == pytest.approx(0.5, abs=0.01)
    # Braking begins before the turn.
    run_outs = rows.report[(rows.report[:, slot.LEG].astype(int) % 4) == 2]
    assert run_outs[:, slot.TARGET_SURGE].min() < 0.5 * (0.5 + limit)
