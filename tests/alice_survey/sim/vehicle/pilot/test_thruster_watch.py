"""Failures that commanded and turned speeds show, and none where there is none."""

import numpy as np
import pytest

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.pilot.command import Failure, ThrusterWatch
from alice_survey.sim.vehicle.vehicle import vehicle_from

TICK_S = 0.05
STRETCH = 100
(STERN,) = (t for t in vehicle_from("alice").thrusters if t.name == "stern")


def turned(command_rps: Array, *, share: float = 1.0, slower: float = 1.0) -> Array:
    """Speeds (T,) of a propeller with a lag, a dead band and what is left of it."""
    maximum, speed, speeds = STERN.most_rps * np.sqrt(share), 0.0, []
    for command in command_rps.tolist():
        speeds.append(speed)
        wanted = 0.0 if abs(command) < STERN.dead_band_rps else np.clip(command, -maximum, maximum)
        speed += (wanted - speed) * TICK_S / (slower * STERN.time_constant_s)
    return np.array(speeds)


def commands(seconds: float, size_rps: float, seed: int = 0) -> Array:
    """Commands (T,) that wander as those of a pilot in gusts."""
    rng, value, found = np.random.default_rng(seed), 0.0, []
    for _ in range(round(seconds / TICK_S)):
        value += -TICK_S / 2.0 * value + size_rps * np.sqrt(TICK_S) * rng.normal()
        found.append(value)
    return np.array(found)


def judged(command_rps: Array, rps: Array) -> list[Failure]:
    watch = ThrusterWatch([STERN], TICK_S)
    found = []
    for first in range(0, len(command_rps), STRETCH):
        part = slice(first, first + STRETCH)
        end_s = (first + STRETCH) * TICK_S
        found += watch.judge(end_s, command_rps[part, None], rps[part, None])
    return found


@pytest.mark.parametrize("size_rps", [3.0, 20.0, 60.0])
@pytest.mark.parametrize("slower", [0.5, 1.0, 2.0])
def test_a_sound_thruster_is_never_suspected(size_rps: float, slower: float) -> None:
    """For 20 min, with a lag of half to twice what is known."""
    asked = commands(1200.0, size_rps)
    assert np.abs(asked).max() > 2.0 * size_rps
    assert judged(asked, turned(asked, slower=slower)) == []


def test_a_thruster_that_stands_still_is_found_in_ten_seconds() -> None:
    asked = commands(60.0, 30.0, seed=3)
    speeds = turned(asked)
    speeds[400:] = 0.0
    (found,) = judged(asked, speeds)
    assert found.thruster == "stern"
    assert found.left == 0.0
    assert 25.0 <= found.time_s <= 45.0


def test_a_weak_thruster_is_found_by_what_is_left_of_it() -> None:
    """A quarter of the thrust is half of the speed."""
    asked = np.full(600, 0.98 * STERN.most_rps)
    (found,) = judged(asked, turned(asked, share=0.25))
    assert found.left == pytest.approx(0.25, abs=0.01)
    modest = 0.4 * asked
    assert judged(modest, turned(modest, share=0.25)) == []  # it gives what is asked


def test_a_failure_that_passes_is_none() -> None:
    asked = np.full(600, 30.0)
    speeds = turned(asked)
    speeds[200:290] = 0.0  # 4.5 s, a rope thrown off
    assert judged(asked, speeds) == []
