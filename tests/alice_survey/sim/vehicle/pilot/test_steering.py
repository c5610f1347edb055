"""Steering: inner loops by matrices, stops against their twin, and in closed loops."""

import math
from functools import cache

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.pilot import gains as g
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot import steering
from alice_survey.sim.vehicle.pilot.settings import Guidance
from alice_survey.sim.vehicle.pilot.steering import STOP_M, STOP_RAD, ramp
from tests import oracles_guidance as oracle
from tests.alice_survey.sim.vehicle.pilot import pilot_runs as runs

TICK_S = 0.05
QUARTER = math.pi / 2
SPOTS = runs.with_stops(
    [("go", 3.0, 0), ("spot", QUARTER), ("go", 1.0), ("spot", QUARTER), ("go", 3.0, 1)]
)
STEPS = runs.with_stops([("go", 3.0, 0), ("step", 1.0), ("spot", math.pi), ("go", 3.0, 1)])
MOTIONS = arrays(np.float64, 12, elements=st.floats(-1.0, 1.0))
SCALES = np.array([0.2, 0.2, 1.0, 0.1, 0.1, 0.15, 0.2, 0.2, 0.1, 0.05, 0.05, 0.2])


@given(goal=st.floats(0.02, 20.0), maximum=st.floats(0.05, 0.5), acceleration=st.floats(0.02, 0.5))
@settings(deadline=None, max_examples=60)
def test_a_reference_goes_as_far_as_the_closed_form_says(
    goal: float, maximum: float, acceleration: float
) -> None:
    at, speed, time_s = 0.0, 0.0, 0.0
    top = min(maximum, math.sqrt(goal * acceleration))
    total_s = goal / top + top / acceleration
    while at < goal:
        before, last = at, speed
        at, speed, quicken = ramp(at, speed, goal, maximum, acceleration, TICK_S)
        time_s += TICK_S
        assert before <= at <= goal
        assert 0.0 <= speed <= maximum + 1e-12
        assert abs(quicken) <= acceleration + 1e-12
        assert speed - last <= acceleration * TICK_S + 1e-12
        # Held for a tick, and late by less than two of them.
        here = oracle.trapezoid(goal, maximum, acceleration, time_s)
        assert abs(at - here) <= 2.0 * top * TICK_S
        assert time_s < total_s + 1.0
    assert speed == 0.0
    assert time_s > total_s - 3 * TICK_S - 2.0 * math.sqrt(2.0 * TICK_S**2)


@cache
def along_steps() -> Guidance:
    return runs.guidance_of(STEPS, "alice", "sway")


@pytest.mark.parametrize(("leg", "progress"), [(1, 0.4), (2, 0.8), (0, 2.7)])
@given(motion=MOTIONS, share=st.floats(0.0, 1.0))
@settings(deadline=None, max_examples=60)
def test_a_tick_of_a_stop_asks_for_what_its_twin_asks(
    leg: int, progress: float, motion: Array, share: float
) -> None:
    path, gains, pilot, guidance = STEPS, runs.gains_of("alice"), slot.new_pilot(), along_steps()
    fastest = (0.2, guidance.step_mps, guidance.turn_in_place_rad_s)[leg]
    slowing = (guidance.stop_mps2, guidance.step_mps2, guidance.turn_in_place_rad_s2)[leg]
    goal = (path.length_m[0], path.length_m[1], abs(path.turn_rad[2]))[leg]
    speed = share * fastest
    pilot.report[[slot.PHASE, slot.LEG, slot.ALONG]] = slot.FOLLOW, leg, progress
    pilot.memory[[slot.STANDING, slot.REF, slot.REF_SPEED]] = 1.0, progress, speed
    pilot.memory[[slot.RAMP, slot.RAMP_SPEED]] = progress, speed
    _, rate, quicken = ramp(progress, speed, goal, fastest, slowing, TICK_S)
    # What thrusters that lag make of it.
    rate = speed + (rate - speed) * TICK_S / gains.axes[(g.SURGE, g.SWAY, g.YAW)[leg], g.LAG]
    after = min(progress + rate * TICK_S, goal)
    start, course = np.array([path.start_n[leg], path.start_e[leg]]), path.heading_rad[leg]
    ahead = np.array([math.cos(course), math.sin(course)])
    if leg == 2:
        sense = math.copysign(1.0, path.turn_rad[leg])
        place, moves, quickens = start, np.zeros(2), np.zeros(2)
        turning = np.array([course + sense * after, sense * rate, sense * quicken])
    else:
        place, moves, quickens = start + after * ahead, rate * ahead, quicken * ahead
        turning = np.array([course + path.side_rad[leg], 0.0, 0.0])
    estimate = np.append(SCALES * motion, [2.0, 2.0])
    estimate[[vector.NORTH, vector.EAST]] += place - np.array([0.55, 0.0])
    estimate[vector.DEPTH] += 13.0
    estimate[vector.HEADING] += turning[0]
    # Near enough that the reference does not wait.
    point, _, _ = oracle.point_motion(estimate, guidance)
    behind = start + progress * ahead - point[:2] if leg < 2 else np.zeros(2)
    assume(behind @ ahead < 0.3)
    assume(abs(SCALES[5] * motion[5]) + 0.05 < math.radians(20.0))
    expected = oracle.standing_demand(
        estimate, guidance, gains, path.speed_mps, place, moves, quickens, turning
    )
    wrench = runs.steered(path, guidance, gains, pilot, estimate)
    found = pilot.demand[[slot.ACC_SURGE, slot.ACC_SWAY, slot.ACC_YAW]]
    np.testing.assert_allclose(found, expected, atol=1e-9)
    np.testing.assert_allclose(wrench, oracle.wrench(gains, pilot.demand), atol=1e-9)


def glass_of(flight: runs.Flight, rows: runs.Rows) -> Array:
    """(T, 2) where the followed point is."""
    heading, lever = rows.estimate[:, vector.HEADING], flight.guidance.point_body_m
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    across = np.stack([-np.sin(heading), np.cos(heading)], axis=1)
    return np.asarray(rows.estimate[:, :2] + lever[0] * ahead + lever[1] * across)


def on_leg(rows: runs.Rows, leg: int) -> Array:
    following = rows.report[:, slot.PHASE] == slot.FOLLOW
    return np.asarray(following & (rows.report[:, slot.LEG] == leg))


@pytest.mark.parametrize("current", [(0.0, 0.0), (0.1, 30.0), (0.2, 90.0)])
def test_alice_turns_on_the_spot_about_her_port(current: tuple[float, float]) -> None:
    flight = runs.launch(SPOTS, current=current, at_ned=(-1.2, 0.05, 0.0), following=True)
    rows = flight.fly(90.0)
    assert rows.phases()[-1] == slot.ASCEND
    glass = glass_of(flight, rows)
    for leg in (1, 3):
        on = on_leg(rows, leg)
        away = np.linalg.norm(
            glass[on] - [SPOTS.start_n[leg], SPOTS.start_e[leg]], axis=1
        )  # fmt: skip
        assert 0.005 < away.max() < 0.2
        rate = np.rad2deg(rows.estimate[on, vector.R])
        assert 13.0 < rate.max() < 20.0
        assert rate.min() > -3.0
        # Six seconds at full rate and the ramp of it; then it is left at once.
        assert 6.5 < on.sum() * TICK_S < 11.0
        end = rows.estimate[on, vector.HEADING][-1]
        turned = math.remainder(end - SPOTS.heading_rad[leg] - QUARTER, 2 * math.pi)
        assert abs(turned) < 1.5 * STOP_RAD
    after = rows.on_lines()
    second = after.report[:, slot.LINE] == 1
    assert np.abs(after.cross_m[second]).max() < 0.1


@pytest.mark.parametrize("current", [(0.0, 0.0), (0.1, 30.0), (0.2, 90.0)])
def test_alice_steps_aside_with_her_heading_held(current: tuple[float, float]) -> None:
    flight = runs.launch(STEPS, current=current, at_ned=(-1.2, 0.05, 0.0), following=True)
    rows = flight.fly(90.0)
    assert rows.phases()[-1] == slot.ASCEND
    on, glass = on_leg(rows, 1), glass_of(flight, rows)
    assert np.abs(np.rad2deg(rows.estimate[on, vector.HEADING])).max() < 4.0
    assert np.abs(glass[on, 0] - 3.0).max() < 0.2
    np.testing.assert_allclose(glass[on][-1], [3.0, 1.0], atol=1.5 * STOP_M)
    sideways = np.diff(glass[on, 1]) / TICK_S
    assert 0.12 < sideways.max() < 0.2
    # 1 m at 0.15 m/s, and two ramps.
    assert 6.7 < on.sum() * TICK_S < 12.0


def test_a_stop_is_left_though_the_sea_does_not_let_the_vehicle_rest() -> None:
    path, gains, pilot = SPOTS, runs.gains_of("alice"), slot.new_pilot()
    guidance = runs.guidance_of(path, "alice", "sway")
    pilot.report[[slot.PHASE, slot.LEG]] = slot.FOLLOW, 1
    pilot.memory[[slot.STANDING, slot.REF, slot.RAMP]] = 1.0, QUARTER, QUARTER
    estimate = np.zeros(vector.ESTIMATE)
    # The port 0.25 m beyond its place, for ever.
    estimate[[vector.NORTH, vector.EAST]] = 3.25 - 0.05, -0.55
    estimate[[vector.HEADING, vector.DEPTH]] = QUARTER, 13.0
    estimate[[vector.ALTITUDE, vector.CLEARANCE]] = 2.0
    tick = 0
    while pilot.report[slot.LEG] < 2.0:
        runs.steered(path, guidance, gains, pilot, estimate, tick * TICK_S)
        tick += 1
        assert tick < 600
    # 0.1 m (1 + t / 5 s) reaches 0.25 m after 7.5 s.
    assert (tick - 1) * TICK_S == pytest.approx(7.5, abs=0.2)


DEMANDS = arrays(np.float64, 8, elements=st.floats(-0.6, 0.6))


@pytest.mark.parametrize("name", ["alice", "sparus2"])
@given(demand=DEMANDS)
@settings(deadline=None)
def test_wrench_is_that_of_the_matrices(name: str, demand: Array) -> None:
    gains, pilot, wrench = runs.gains_of(name), slot.new_pilot(), np.full(6, 9.0)
    pilot.demand[:8] = demand
    steering.write_wrench(np.zeros(14), 0.05, gains, pilot, wrench)
    np.testing.assert_allclose(wrench, oracle.wrench(gains, demand), atol=1e-9)
    # Roll and pitch are not requested, nor sway where nothing gives it.
    assert wrench[3] == wrench[4] == 0.0
    assert name == "alice" or wrench[1] == 0.0


@given(demand=DEMANDS)
@settings(deadline=None)
def test_saturated_axes_are_flagged(demand: Array) -> None:
    gains, pilot, wrench = runs.gains_of("alice"), slot.new_pilot(), np.zeros(6)
    pilot.demand[:8] = demand * np.array([1, 1, 1, 1, 5, 5, 5, 20])
    steering.write_wrench(np.zeros(14), 0.05, gains, pilot, wrench)
    for axis, degree in enumerate(g.DEGREES):
        full = pilot.demand[slot.FULL_SURGE + axis]
        ends = gains.axes[axis, [g.MIN_FORCE, g.MAX_FORCE]]
        if full == 0.0:
            assert ends[0] <= wrench[degree] <= ends[1]
        else:
            assert wrench[degree] == ends[int(full > 0)]


@settings(deadline=None)
@given(error=st.floats(-2, 2), speed=st.floats(-1, 1), feed=st.floats(-1, 1))
@pytest.mark.parametrize("axis", [g.SWAY, g.HEAVE, g.YAW])
def test_place_loop_near_the_place_is_the_placed_one(
    axis: int, error: float, speed: float, feed: float
) -> None:
    gains = runs.gains_of("alice")
    row = gains.axes[axis]
    maximum = 100.0
    steady, acceleration = steering.place_demand(gains, axis, error, speed, feed, 0.0, maximum)
    # Whatever the share of the inner loop: rate on the speed, place on the place.
    expected = row[g.RATE] * (feed - speed) + row[g.PLACE] * error
    assert acceleration == pytest.approx(expected, abs=1e-12)
    cut, _ = steering.place_demand(gains, axis, error, speed, feed, 0.0, 0.05)
    assert abs(cut - feed) <= 0.05 + 1e-12
    assert steady - feed == pytest.approx(row[g.PLACE] / row[g.INNER] * error)


def _hold(gains: g.Gains, push: float, seconds: float, maximum: float) -> tuple[Array, Array]:
    """Sway of a bare mass with lag, pushed by a force; offsets and the integral over time."""
    row, dt_s = gains.axes[g.SWAY], 0.05
    place = speed = force = total = 0.0
    places, totals, full = [], [], 0.0
    for _ in range(round(seconds / dt_s)):
        _, acceleration = steering.place_demand(gains, g.SWAY, -place, speed, 0.0, total, 1.0)
        total += steering.place_sum_step(gains, g.SWAY, -place, full, dt_s)
        asked = row[g.MASS] * acceleration
        full = 1.0 if asked > maximum else (-1.0 if asked < -maximum else 0.0)
        asked = min(max(asked, -maximum), maximum)
        for _ in range(50):
            force += (asked - force) * dt_s / 50 / row[g.LAG]
            speed += (force + push) / row[g.MASS] * dt_s / 50
            place += speed * dt_s / 50
        places.append(place)
        totals.append(total)
    return np.array(places), np.array(totals)


def test_integral_takes_away_what_a_steady_force_leaves() -> None:
    gains = runs.gains_of("alice")
    row = gains.axes[g.SWAY]
    places, totals = _hold(gains, 4.0, 60.0, 80.0)
    # At first the force over the stiffness, in the end nothing, and the integral holds the force.
    assert 0.5 * 4.0 / (row[g.MASS] * row[g.PLACE]) < places.max()
    assert places.max() < 1.2 * 4.0 / (row[g.MASS] * row[g.PLACE])
    assert abs(places[-1]) < 1e-4
    assert totals[-1] * row[g.INNER] * row[g.MASS] == pytest.approx(-4.0, rel=1e-3)
