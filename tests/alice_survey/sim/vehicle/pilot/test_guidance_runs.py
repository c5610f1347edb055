"""Guidance in a closed loop: true state, exact wrench with its lag, full dynamics, currents."""

import math
from typing import Literal

import numpy as np
import pytest

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.pilot import gains as g
from alice_survey.sim.vehicle.pilot import memory as safety
from alice_survey.sim.vehicle.pilot import memory as slot
from tests.alice_survey.sim.vehicle.pilot import pilot_runs as runs
from tests.oracles_guidance import los_offset_m


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
    expected = los_offset_m(flight.guidance.look_ahead_m, 0.2, across, along)
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
    controller: Literal["sway", "los"] = "sway" if name == "alice" else "los"
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
    assert rows.report[-1, slot.REASON] in (safety.NO_DIVE, safety.NO_APPROACH)
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
