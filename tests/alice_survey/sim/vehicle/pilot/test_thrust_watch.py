"""Thrusters that push nothing are found by force, those that do not turn by their speed."""

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.pilot import command
from alice_survey.sim.vehicle.vehicle import Vehicle, vehicle_from
from tests.alice_survey.sim.vehicle.identification.manoeuvres import fly, survey_like

TICK_S, STRETCH = 0.05, 100
ALICE = vehicle_from("alice")
NAMES = tuple(thruster.name for thruster in ALICE.thrusters)
GUST_N = np.array([0.5, 0.5, 0.5, 0.0, 0.0, 0.1])
SOUND_S = 60.0


def without(name: str) -> Vehicle:
    """ALICE with a thruster that turns and makes neither thrust nor torque."""
    fields = [f"{k}_{w}" for k in ("kt", "kq") for w in ("forward", "reverse")]
    fields += ["advance_slope", "torque_slope"]
    nothing: dict[str, Any] = dict.fromkeys(fields, 0.0) | dict.fromkeys(fields[:2], 1e-9)
    kept = (replace(t, **nothing) if t.name == name else t for t in ALICE.thrusters)
    return replace(ALICE, thrusters=tuple(kept))


@cache
def flown(name: str, seed: int, duration_s: float = 60.0) -> tuple[Array, Array]:
    """What navigation and thrusters say, (T, 12) and (T, n), of a vehicle in gusts of 2 s."""
    rng, gust = np.random.default_rng(seed), np.zeros(6)
    truth = without(name)
    kept = math.exp(-TICK_S / 2.0)

    def push() -> Array:
        gust[:] = kept * gust + math.sqrt(1.0 - kept**2) * GUST_N * rng.normal(size=6)
        return gust

    begin_s = float(rng.uniform(0.0, 120.0))
    log = fly(
        truth, duration_s=duration_s, push=push, asked=lambda time_s: survey_like(time_s + begin_s)
    )
    motion = np.column_stack([log.velocity_body, log.rates_body])
    motion += rng.normal(size=motion.shape) * ([0.001] * 3 + [0.0005] * 3)
    angles = Rotation.from_quat(log.quaternion_xyzw).as_euler("ZYX")[:, ::-1]
    rps = np.column_stack([log.rpm[one] / 60.0 for one in NAMES])
    return np.column_stack([log.position_ned, angles, motion]), rps


def judged(
    watch: command.ThrustWatch, begin_s: float, flight: tuple[Array, Array], water_mps: float = 0.0
) -> tuple[list[command.Failure], list[Array]]:
    found, sums = [], []
    for first in range(0, len(flight[0]), STRETCH):
        part = slice(first, first + STRETCH)
        end_s = begin_s + (first + STRETCH) * TICK_S
        current = np.array([water_mps, 0.0])
        found += watch.judge(
            end_s, command.NavigatedStretch(flight[0][part], current, 0.05), flight[1][part]
        )
        sums.append(watch.sums.copy())
    return found, sums


def test_sound_thrusters_add_up_to_less_than_chance_allows() -> None:
    """The stated rate of false alarms rests on it: a sum is above x no more often than exp(-x)."""
    sums = []
    for seed in range(6):
        found, own = judged(command.ThrustWatch(ALICE, TICK_S), 0.0, flown("", seed, 120.0))
        assert found == []
        sums += own
    table = np.array(sums)
    assert table.shape == (6 * 24, len(NAMES))
    assert 0.0 < table.max() < 6.0
    for above in (1.0, 2.0, 4.0):
        assert np.mean(table > above) < math.exp(-above)
    alarm = command.ThrustWatch(ALICE, TICK_S).alarm
    # Lorden's bound for each of the thrusters, by the stated hours of all.
    assert math.exp(alarm) * command.WATCHED_S / 3600.0 / len(NAMES) == pytest.approx(
        command.FALSE_ALARM_H
    )


@pytest.mark.parametrize("name", NAMES)
def test_a_thruster_that_pushes_nothing_is_found_in_two_minutes(name: str) -> None:
    delays = []
    for seed in range(3):
        watch = command.ThrustWatch(ALICE, TICK_S)
        assert judged(watch, 0.0, flown("", seed))[0] == []
        found, _ = judged(watch, SOUND_S, flown(name, 10 + seed, 120.0))
        assert found == [
            command.Failure(time_s=found[0].time_s, thruster=name, left=0.0, turns=True)
        ]
        delays.append(found[0].time_s - SOUND_S)
    assert 5.0 <= min(delays) <= max(delays) <= 120.0


def test_a_model_that_is_off_and_a_wrong_current_are_no_failure() -> None:
    """Drag of 1.3 times, thrust of 0.8, and a current of 0.1 m/s that is not there."""
    values = ALICE.coefficients.values
    draggy = ALICE.with_coefficients(
        ALICE.coefficients.with_values(
            "draggy", {name: 1.3 * values[name] for name in ("X_uu", "Y_vv", "Z_ww", "N_rr")}
        )
    )
    strong = replace(
        ALICE,
        thrusters=tuple(
            replace(t, kt_forward=1.25 * t.kt_forward, kt_reverse=1.25 * t.kt_reverse)
            for t in ALICE.thrusters
        ),
    )
    for believed, water_mps in ((draggy, 0.0), (strong, 0.0), (ALICE, 0.1)):
        for seed in range(2):
            flight = flown("", seed, 120.0)
            found, sums = judged(command.ThrustWatch(believed, TICK_S), 0.0, flight, water_mps)
            assert found == []
            assert np.max(sums) < 8.0


STERN = ALICE.thrusters[NAMES.index("stern")]


def turned(command_rps: Array, *, share: float = 1.0, slower: float = 1.0) -> Array:
    """Speeds (T,) of a propeller with a lag, a dead band and what is left of it."""
    maximum, step = STERN.most_rps * np.sqrt(share), TICK_S / (slower * STERN.time_constant_s)
    reached = np.clip(command_rps, -maximum, maximum)
    wanted = np.where(np.abs(command_rps) < STERN.dead_band_rps, 0.0, reached)
    return np.asarray(lfilter([0.0, step], [1.0, step - 1.0], wanted))


def commands(seconds: float, size_rps: float, seed: int = 0) -> Array:
    """Commands (T,) that wander as those of a pilot in gusts."""
    draws = np.random.default_rng(seed).normal(size=round(seconds / TICK_S))
    return np.asarray(lfilter([size_rps * np.sqrt(TICK_S)], [1.0, TICK_S / 2.0 - 1.0], draws))


def found_by_speed(command_rps: Array, rps: Array) -> list[command.Failure]:
    watch = command.ThrusterWatch([STERN], TICK_S)
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
    assert found_by_speed(asked, turned(asked, slower=slower)) == []


def test_a_thruster_that_stands_still_is_found_in_ten_seconds() -> None:
    asked = commands(60.0, 30.0, seed=3)
    speeds = turned(asked)
    speeds[400:] = 0.0
    (found,) = found_by_speed(asked, speeds)
    assert found.thruster == "stern"
    assert found.left == 0.0
    assert 25.0 <= found.time_s <= 45.0


def test_a_weak_thruster_is_found_by_what_is_left_of_it() -> None:
    """A quarter of the thrust is half of the speed."""
    asked = np.full(600, 0.98 * STERN.most_rps)
    (found,) = found_by_speed(asked, turned(asked, share=0.25))
    assert found.left == pytest.approx(0.25, abs=0.01)
    modest = 0.4 * asked
    assert found_by_speed(modest, turned(modest, share=0.25)) == []  # it gives what is asked


def test_a_failure_that_passes_is_none() -> None:
    asked = np.full(600, 30.0)
    speeds = turned(asked)
    speeds[200:290] = 0.0  # 4.5 s, a rope thrown off
    assert found_by_speed(asked, speeds) == []
