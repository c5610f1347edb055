"""Paths: places, headings, and progress that passes every leg."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from alice_survey.core.errors import VehicleError
from alice_survey.sim.vehicle.pilot.path import Path, advance, heading_at, path_from_legs, place_at
from tests import oracles_guidance as oracle
from tests.alice_survey.sim.vehicle.pilot.pilot_runs import lawnmower, with_stops

MOWER = lawnmower(4, 5.0)


def arc(curvature_per_m: float, length_m: float, heading_rad: float = 0.3) -> Path:
    return path_from_legs(
        [(1.0, -2.0)], [heading_rad], [length_m], [curvature_per_m], [-1], 2.0, 0.2
    )


@given(curvature=st.floats(-3.0, 3.0), length=st.floats(0.1, 20.0), share=st.floats(-0.5, 1.5))
@example(curvature=1.0, length=0.5, share=-5e-324)
@settings(deadline=None, max_examples=40)
def test_places_are_those_reached_by_walking(curvature: float, length: float, share: float) -> None:
    path = arc(curvature, length)
    along = share * length
    n, e, heading, k = place_at(path, 0, along)
    place, expected = oracle.walked(path, 0, along)
    np.testing.assert_allclose([n, e], place, atol=1e-6 * (1 + length))
    assert heading == pytest.approx(expected, abs=1e-12)
    # Beyond its ends a leg goes on straight.
    assert k == (curvature if 0.0 <= along <= length else 0.0)


@given(curvature=st.floats(-2.0, 2.0), share=st.floats(0.05, 0.95), cross=st.floats(-0.35, 0.35))
@settings(deadline=None, max_examples=40)
def test_progress_is_the_projection(curvature: float, share: float, cross: float) -> None:
    path = arc(curvature, 1.4)
    n, e, heading, _ = place_at(path, 0, share * 1.4)
    place = np.array([n - cross * math.sin(heading), e + cross * math.cos(heading)])
    along = 0.5
    for _ in range(60):
        _, along, _ = advance(path, 0, along, place[0], place[1], 0.1)
    assert along == pytest.approx(oracle.nearest(path, 0, place), abs=2e-4)


@given(seed=st.integers(0, 10**6))
@settings(deadline=None, max_examples=15)
def test_no_leg_is_skipped_however_wild_the_position(seed: int) -> None:
    rng = np.random.default_rng(seed)
    leg, along, maximum, over = 0, 0.0, 0.02, False
    seen, total = [0], 0.0
    place = np.zeros(2)
    for _ in range(4000):
        if rng.random() < 0.05:
            place = rng.uniform([-3.0, -3.0], [8.0, 6.0])
        before = leg
        leg, along, over = advance(MOWER, leg, along, place[0], place[1], maximum)
        assert leg in (before, before + 1)
        now = MOWER.begins_m[leg] + along
        assert abs(now - total) <= maximum + 1e-12
        total = now
        if leg != before:
            seen.append(leg)
    assert seen == list(range(leg + 1))
    assert over == (leg == len(seen) - 1 and total >= MOWER.begins_m[-1] + MOWER.length_m[-1])


STOPS = with_stops([
    ("go", 3.0, 0), ("spot", math.pi / 2), ("go", 1.0), ("step", 2.0), ("step", -1.0),
    ("spot", -2.0), ("go", 3.0, 1),
])  # fmt: skip


def test_progress_does_not_pass_a_stop_and_headings_do_not_look_beyond() -> None:
    leg, along, over = 0, 2.9, False
    for _ in range(50):
        leg, along, over = advance(STOPS, leg, along, 9.0, 0.0, 0.05)
    assert (leg, along, over) == (0, 3.0, False)
    assert heading_at(STOPS, 0, 3.7) == (0.0, 0.0)
    assert heading_at(STOPS, 2, -0.4) == (pytest.approx(math.pi / 2), 0.0)
    assert heading_at(STOPS, 2, 1.4) == (pytest.approx(math.pi / 2), 0.0)


@pytest.mark.parametrize(
    "change",
    [
        {"turn_rad": [0.0, 1.0, 0.0]}, {"side_rad": [0.0, 1.0, 0.0]},
        {"side_rad": [0.0, math.pi / 2, 0.0]}, {"length_m": [5.0, 0.0, 5.0]},
        {"turn_rad": [0.0, 1.0]}, {"side_rad": [0.0, math.nan, 0.0]},
        {"start_ne_m": [(0.0, 0.0), (5.0, 0.1), (6.0, 0.0)]}, {"heading_rad": [0.0, 0.1, 0.0]},
        {"curvature_per_m": [0.0, math.nan, 0.0]}, {"line": [0]}, {"speed_mps": 0.0},
        {"start_ne_m": [], "heading_rad": [], "length_m": [], "curvature_per_m": [], "line": []},
    ],
)  # fmt: skip
def test_a_path_that_makes_no_sense_is_refused(change: dict[str, object]) -> None:
    good: dict[str, object] = {
        "start_ne_m": [(0.0, 0.0), (5.0, 0.0), (6.0, 0.0)], "heading_rad": [0.0, 0.0, 0.0],
        "length_m": [5.0, 1.0, 5.0], "curvature_per_m": [0.0, 0.0, 0.0], "line": [0, -1, 1],
        "altitude_m": 2.0, "speed_mps": 0.2,
    }  # fmt: skip
    path_from_legs(**good)  # type: ignore[arg-type]
    with pytest.raises(VehicleError):
        path_from_legs(**{**good, **change})  # type: ignore[arg-type]
