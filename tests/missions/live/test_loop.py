"""The pilot's loop against the closed loop, and its safe states."""

import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from alice_survey.core.config import SurveyConfig
from alice_survey.sim.vehicle.pilot.memory import SIGMA_M
from missions.live.mission import LinkState, Odometry
from missions.values.flight import trigger_times
from tests.missions.flown_plans import flown
from tests.missions.live.flights import FLOOR_M, LoopFlight, small_plan

GRACE_TICKS = 100


@pytest.mark.slow
def test_loop_flies_as_the_closed_loop_does() -> None:
    flight = LoopFlight()
    while flight.loop.state != LinkState.OVER and flight.vehicle.tick < 6000:
        flight.tick()
    closed = flown(small_plan(), SurveyConfig())

    assert flight.loop.ending == "complete" == closed.ending
    assert flight.vehicle.tick == pytest.approx(len(closed.flown.time_s), rel=0.1)
    times = np.array([row[0] for row in flight.mission.rows])
    line = np.array([row[3] for row in flight.mission.rows])
    glass = np.array(flight.glass)
    trigger_s, trigger_line = trigger_times(flight.plan, times, line, glass[:, :2])
    assert trigger_line == closed.trigger_line == (0,) * 6 + (1,) * 6
    # Lines are at east 0 and 1, with stations 0.8 m apart: pictures are taken there, straight.
    north, east, depth = (np.interp(trigger_s, times, axis) for axis in glass.T)
    there = np.array([*np.linspace(0, 4, 6), *np.linspace(4, 0, 6)])
    np.testing.assert_allclose(north, there, atol=0.08)  # where it stops, a little before
    np.testing.assert_allclose(east, [0.0] * 6 + [1.0] * 6, atol=0.06)
    # The dive still settles at the first station, in the closed loop too.
    np.testing.assert_allclose(FLOOR_M - depth, flight.plan.altitude_m, atol=0.12)
    assert np.mean(FLOOR_M - depth) == pytest.approx(flight.plan.altitude_m, abs=0.03)
    assert np.ptp(east[:6]) > 1e-4


@cache
def on_its_first_line(**limits: Any) -> LoopFlight:
    flight = LoopFlight(**limits)
    flight.until("follow")
    flight.ticks(100)
    assert flight.command.state == LinkState.FLYING
    assert np.abs(flight.command.rps).max() > 1.0
    return flight


@pytest.fixture
def following() -> LoopFlight:
    """A vehicle that follows its first line."""
    return deepcopy(on_its_first_line())


def is_off(flight: LoopFlight) -> bool:
    command = flight.command
    return not np.any(command.wrench) and not np.any(command.rps) and not np.any(command.thrust_n)


def test_nothing_is_commanded_before_odometry() -> None:
    flight = LoopFlight()
    for _ in range(300):
        flight.tick(odometry="none")
        assert flight.command.state == LinkState.WAITING
        assert is_off(flight)
    flight.tick()
    assert flight.command.state == LinkState.FLYING


def test_odometry_that_returns_is_flown_by_again(following: LoopFlight) -> None:
    states = []
    for _ in range(60):
        following.tick(odometry="none")
        states.append(following.command.state)
        assert is_off(following) == (following.command.state == LinkState.HELD)
    # Half a second old at most, then off.
    assert states.count(LinkState.FLYING) == 10
    assert states[10:] == [LinkState.HELD] * 50
    following.tick()
    assert following.command.state == LinkState.FLYING
    assert not is_off(following)
    assert following.command.why == ""


def test_lost_odometry_ends_at_the_surface(following: LoopFlight) -> None:
    began = following.truth[2]
    following.ticks(10 + GRACE_TICKS + 5, odometry="none")
    assert following.command.state == LinkState.GIVEN_UP
    assert following.command.wrench[2] < -5.0
    assert not np.any(following.command.wrench[[0, 1, 3, 4, 5]])
    for _ in range(6000):
        following.tick(odometry="none")
        if following.truth[2] < 0.3:
            break
    assert following.truth[2] < 0.3 < began
    # For good: odometry at depth would not have taken the mission up again.
    following.tick()
    assert following.command.state == LinkState.OVER
    assert following.loop.ending.startswith("given up: the latest odometry is")
    assert is_off(following)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("position_ned", math.nan), ("velocity_body", math.inf), ("rates_body", math.nan),
        ("quaternion_xyzw", 0.0),
    ],
)  # fmt: skip
def test_odometry_that_is_not_a_number_is_refused(
    following: LoopFlight, field: str, value: float
) -> None:
    for _ in range(20):
        odometry = following.true_odometry()
        spoilt = np.full_like(getattr(odometry, field), value)
        following.tick(odometry=replace(odometry, **{field: spoilt}))
        assert np.all(np.isfinite(following.command.rps))
    assert following.command.state == LinkState.HELD
    assert is_off(following)
    assert following.loop.refused == {"odometry is not a number": 20}


def moved(odometry: Odometry, east_m: float) -> Odometry:
    return replace(odometry, position_ned=odometry.position_ned + east_m * np.eye(3)[1])


_FAULTS: dict[str, tuple[float, Callable[[Odometry, Odometry], Odometry]]] = {
    "frozen": (0.6, lambda now, first: replace(first, stamp_s=now.stamp_s)),
    "jumped": (0.6, lambda now, first: moved(now, 30.0)),
    "jumped a little": (0.6, lambda now, first: moved(now, 3.0)),
    "too fast": (0.6, lambda now, first: replace(now, velocity_body=np.array([100.0, 0.0, 0.0]))),
    "wrong velocity": (
        12.0, lambda now, first: replace(now, velocity_body=now.velocity_body + 0.5 * np.eye(3)[0])
    ),
    "north for east": (
        12.0, lambda now, first: replace(now, position_ned=now.position_ned[[1, 0, 2]])
    ),
    "100 s of a mission older": (0.6, lambda now, first: replace(now, stamp_s=now.stamp_s - 100)),
}  # fmt: skip
"""Odometry that is wrong from a moment on, and within how many seconds nothing is flown by it."""


@pytest.mark.parametrize(
    "fault", [pytest.param(f, marks=() if " for " in f else pytest.mark.slow) for f in _FAULTS]
)
def test_odometry_that_is_fresh_but_wrong_ends_the_mission(
    following: LoopFlight, fault: str
) -> None:
    """Held, then given up, and an end in bounded time, at the surface of the simulated sea."""
    within_s, spoil = _FAULTS[fault]
    first = following.true_odometry()
    begun = following.truth[:3].copy()
    for _ in range(20 * 3600):
        following.tick(odometry=spoil(following.true_odometry(), first))
        if following.command.state != LinkState.FLYING:
            break
    assert following.command.state == LinkState.HELD
    went_m = np.linalg.norm(following.truth[:3] - begun)
    assert went_m < 0.1 + 0.5 * within_s
    while following.loop.state != LinkState.OVER and following.vehicle.tick < 20 * 3600:
        following.tick(odometry=spoil(following.true_odometry(), first))
    assert following.loop.ending.startswith("given up: odometry")
    assert is_off(following)
    assert -0.2 < following.truth[2] < 0.3


def test_good_odometry_is_flown_by_through_noise_and_fixes(following: LoopFlight) -> None:
    """Errors as a filter has them: noise, a fix that moves it by 4 of its sigmas, a gap of 1 s."""
    rng = np.random.default_rng(7)
    for i in range(600):
        now = following.true_odometry()
        east_m = 2.0 * (i > 200) + 0.01 * rng.standard_normal()
        noisy = replace(moved(now, east_m), sigma_m=0.5)
        following.tick(odometry="none" if 400 < i < 420 else noisy)
    assert not following.loop.refused
    assert following.command.state == LinkState.FLYING


def test_odometry_says_how_well_it_knows_its_place(following: LoopFlight) -> None:
    for _ in range(2):
        following.tick(odometry=replace(following.true_odometry(), sigma_m=0.07))
    assert following.loop.pilot.state.memory[SIGMA_M] == 0.07
    following.tick()
    assert following.loop.pilot.state.memory[SIGMA_M] == math.inf


@pytest.mark.parametrize("on_loss", ["surface", pytest.param("drift", marks=pytest.mark.slow)])
def test_a_lost_vehicle_comes_to_an_end(on_loss: str) -> None:
    flight = deepcopy(on_its_first_line(on_loss=on_loss))
    begun_s = flight.now_s
    while flight.loop.state != LinkState.OVER and flight.now_s < begun_s + 3600.0:
        flight.tick(odometry="none")
    assert flight.loop.state == LinkState.OVER
    # Three times the 60 s that 6 m take at the slowest rate of ascent.
    assert flight.now_s - begun_s == pytest.approx(0.5 + 5.0 + 180.0, abs=1.0)
    assert is_off(flight)
    assert flight.truth[2] > -0.2


@pytest.mark.parametrize("jump_s", [-30.0, 0.8, 3600.0])
def test_clock_that_jumps_is_survived(following: LoopFlight, jump_s: float) -> None:
    """What was heard before the jump is forgotten; odometry on the new clock is flown by."""
    following.clock_offset_s += jump_s
    following.tick(odometry="none")
    assert following.command.state == LinkState.HELD
    assert is_off(following)
    assert "jumped" in following.command.why
    following.tick()
    assert following.command.state == LinkState.FLYING
    assert following.loop.jumps == 1


def test_pilot_without_altitude_stops_and_surfaces(following: LoopFlight) -> None:
    """The same as the closed loop without bottom lock: 20 s on hold, then up."""
    for _ in range(round((2.0 + 20.0) / 0.05) + 5):
        following.tick(altitude=False)
    assert following.mission.phase == "abort"
    assert math.isnan(following.loop.estimate[12])
    speed = np.hypot(*following.truth[7:9])
    assert speed < 0.05
    following.until("abort")
    for _ in range(4000):
        following.tick(altitude=False)
        if following.loop.state == LinkState.OVER:
            break
    assert following.loop.ending == (
        "aborted: the DVL did not hear the bottom for longer than is allowed"
    )


def test_altitude_is_that_of_a_level_floor_below_a_tilted_vehicle() -> None:
    """Roll and pitch move altimeter and glass; the depth of the floor comes back."""
    flight = LoopFlight()
    flight.vehicle.sense()
    for roll, pitch in ((0.0, 0.0), (0.2, -0.1), (-0.15, 0.2)):
        turn = Rotation.from_euler("ZYX", [1.0, pitch, roll])
        flight.truth[3:7] = turn.as_quat()
        flight.truth[2] = 3.0
        flight.vehicle.tick += 1
        flight.loop.hear_odometry(flight.true_odometry(), flight.now_s)
        flight.loop.hear_range(flight.now_s, flight.true_range(), flight.now_s)
        flight.loop.tick(flight.now_s)
        point = turn.apply(SurveyConfig().camera.position_body_m)
        estimate = flight.loop.estimate
        assert estimate[12] == pytest.approx(6.0 - 3.0 - point[2], abs=1e-9)
        hull = turn.apply(flight.vehicle.vehicle.hull.points_body_m)[:, 2].max()
        assert 6.0 - 3.0 - hull - 0.1 < estimate[13] <= 6.0 - 3.0 - hull


def test_thruster_that_stands_still_is_found(following: LoopFlight) -> None:
    """Speeds heard of the thrusters: the stern one stands still, and the pilot goes on without."""
    names = following.mission.thrusters
    stern = names.index("stern")
    for _ in range(400):
        following.vehicle.weaken({"stern": 0.0})
        following.loop.hear_thrusters(following.vehicle.world.state[13:].copy(), following.now_s)
        following.tick()
    assert [one.thruster for one in following.loop.failures] == ["stern"]
    assert following.command.rps[stern] == 0.0
    assert following.command.state == LinkState.FLYING


def test_drift_leaves_the_thrusters_off() -> None:
    flight = deepcopy(on_its_first_line(on_loss="drift"))
    flight.ticks(10 + GRACE_TICKS + 200, odometry="none")
    assert flight.command.state == LinkState.GIVEN_UP
    assert is_off(flight)
