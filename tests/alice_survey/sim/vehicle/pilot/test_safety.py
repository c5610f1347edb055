"""Safety: each reason to abort, none without one, and what an abort does."""

import math

import numpy as np
import pytest

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.pilot import gains as g
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot.memory import PilotState, SafetyLimits, new_pilot
from tests.alice_survey.sim.vehicle.pilot.pilot_runs import launch, steered, straight

LIMITS = SafetyLimits(1.0, 20.0, math.radians(30.0), 20.0, 90.0, 3.0, 5000.0)
TICK_S = 0.05


def calm(altitude_m: float = 2.0, pitch_rad: float = 0.0, depth_m: float = 13.0) -> Array:
    estimate = np.zeros(vector.ESTIMATE)
    estimate[[vector.ALTITUDE, vector.PITCH, vector.DEPTH]] = altitude_m, pitch_rad, depth_m
    estimate[vector.CLEARANCE] = altitude_m
    return estimate


def watched(
    pilot: PilotState, estimate: Array, seconds: float, speed: float = 0.2, time_s: float = 0.0
) -> tuple[int, float]:
    """The reason, and after how long, while progress grows at a speed."""
    for k in range(round(seconds / TICK_S)):
        progress = time_s + speed * k * TICK_S
        reason = slot.watch(time_s, TICK_S, estimate, progress, LIMITS, pilot)
        if reason:
            return reason, (k + 1) * TICK_S
    return slot.NONE, math.nan


def pilot_in(phase: int) -> PilotState:
    pilot = new_pilot()
    pilot.memory[slot.FLOOR_KNOWN] = 1.0
    pilot.report[slot.PHASE] = phase
    return pilot


@pytest.mark.parametrize(
    ("estimate", "phase", "speed", "reason", "after_s"),
    [
        (calm(altitude_m=0.9), slot.FOLLOW, 0.2, slot.TOO_LOW, 10.0),
        (calm(altitude_m=0.9), slot.DIVE, 0.2, slot.TOO_LOW, 10.0),
        (calm(altitude_m=0.49), slot.FOLLOW, 0.2, slot.TOO_LOW, 1.0),
        (calm(altitude_m=0.49), slot.DIVE, 0.2, slot.TOO_LOW, 1.0),
        (calm(pitch_rad=0.6), slot.FOLLOW, 0.2, slot.TOO_STEEP, 1.0),
        (calm(pitch_rad=-0.6), slot.APPROACH, 0.2, slot.TOO_STEEP, 1.0),
        (calm(altitude_m=math.nan), slot.FOLLOW, 0.2, slot.NO_BOTTOM, 20.0),
        (calm(depth_m=20.1), slot.DIVE, 0.2, slot.TOO_DEEP, TICK_S),
        (calm(), slot.DIVE, 0.0, slot.NO_DIVE, 90.0),
        (calm(), slot.APPROACH, -0.1, slot.NO_APPROACH, 90.0),
        (calm(), slot.FOLLOW, 0.0005, slot.NO_PROGRESS, 90.0),
    ],
)
def test_each_reason_comes_after_its_time(
    estimate: Array, phase: int, speed: float, reason: int, after_s: float
) -> None:
    found, after = watched(pilot_in(phase), estimate, 120.0, speed)
    assert found == reason
    assert after == pytest.approx(after_s, abs=2.1 * TICK_S)


def test_without_bottom_lock_the_navigation_decides_if_it_may() -> None:
    blind, limits = calm(altitude_m=math.nan), LIMITS._replace(blind_sigma_m=0.5)
    for sigma_m, goes_on in ((0.4, True), (0.6, False), (math.nan, False)):
        pilot = pilot_in(slot.FOLLOW)
        pilot.memory[slot.SIGMA_M], pilot.memory[slot.LOST_S] = sigma_m, 30.0
        slot.mind_floor(10.0, blind, limits, pilot)
        assert pilot.memory[slot.PACE] == (1.0 if goes_on else 0.0)
        reason = slot.watch(0.0, TICK_S, blind, 1.0, limits, pilot)
        assert reason == (slot.NONE if goes_on else slot.NO_BOTTOM)


@pytest.mark.parametrize("lost", range(12))
def test_without_navigation_the_vehicle_pushes_itself_up(lost: int) -> None:
    flight = launch(straight(10.0), following=True)
    estimate, flown = calm(), (flight.path, flight.guidance, flight.gains, flight.pilot)
    assert steered(*flown, estimate)[2] > -1.0
    estimate[lost] = math.nan
    for _ in range(3):
        wrench = steered(*flown, estimate)
        expected = g.STEADY_SHARE * flight.gains.axes[g.HEAVE, g.MIN_FORCE]
        np.testing.assert_array_equal(wrench, [0, 0, expected, 0, 0, 0])
    assert flight.pilot.report[slot.PHASE] == slot.ABORT
    assert flight.pilot.report[slot.REASON] == slot.NO_NAVIGATION
    assert np.all(np.isfinite(flight.pilot.memory[: slot.BEST]))


def test_an_abort_takes_the_vehicle_to_the_surface() -> None:
    flight = launch(straight(50.0), following=True, current=(0.1, 90.0))
    flight.fly(20.0)
    flight.floor[0] -= 1.8  # a rock: 0.2 m below the port
    rows = flight.fly(90.0)
    assert rows.phases() == [slot.FOLLOW, slot.ABORT]
    assert rows.report[-1, slot.REASON] == slot.TOO_LOW
    low_s = rows.time_s[np.argmax(rows.report[:, slot.PHASE] == slot.ABORT)] - rows.time_s[0]
    assert 0.9 < low_s < 1.2
    assert rows.estimate[:, vector.CLEARANCE].min() > 0.1
    assert rows.report[-1, slot.AT_SURFACE] == 1.0
    assert rows.estimate[-1, vector.DEPTH] < 0.3
    # It rises at the speed that is allowed, without turning round.
    rising = -np.diff(rows.estimate[:, vector.DEPTH]) / TICK_S
    assert 0.8 < rising.max() / flight.gains.axes[g.HEAVE, g.FASTEST] < 1.2
    assert np.abs(rows.estimate[:, vector.HEADING]).max() < math.radians(15.0)


def test_without_the_bottom_it_stops_rises_as_the_floor_did_and_goes_on_when_it_hears() -> None:
    flight = launch(straight(50.0), following=True, slope=-0.4)
    flight.fly(60.0)
    floor = flight.floor.copy()
    flight.floor[2] = 0.0
    rows = flight.fly(15.0)
    north, depth = rows.estimate[:, vector.NORTH], rows.estimate[:, vector.DEPTH]
    clear = floor[0] + floor[1] * (north + 0.55) - depth - 0.08
    assert clear.min() > 1.8
    assert 0.005 < np.ptp(north[200:]) < 0.1  # at full speed: 1 m
    assert 0.2 < depth[0] - depth[-1] < 0.7
    flight.floor[2] = 1.0
    rows = flight.fly(30.0)
    assert rows.phases() == [slot.FOLLOW]
    assert rows.estimate[-1, vector.U] == pytest.approx(0.2, abs=0.02)
