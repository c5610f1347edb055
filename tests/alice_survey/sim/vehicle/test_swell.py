"""Swell: linear waves over a level floor, by their closed forms and limits."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from alice_survey.sim.vehicle import sea


def at(current: sea.Current, time_s: float, depth_m: float) -> np.ndarray:
    out = np.zeros(6)
    sea.current_at(current, time_s, depth_m, out)
    return out[:2]


@given(period_s=st.floats(1.0, 30.0), depth_m=st.floats(0.5, 500.0))
def test_wave_numbers_obey_the_dispersion_relation(period_s: float, depth_m: float) -> None:
    k = sea.wave_number(period_s, depth_m)
    omega = 2 * math.pi / period_s
    assert k > 0
    assert sea.GRAVITY * k * math.tanh(k * depth_m) == pytest.approx(omega**2, rel=1e-9)


def test_swell_is_added_to_the_current_along_its_way() -> None:
    depth_m, period_s, towards = 15.0, 6.0, math.radians(30.0)
    current = sea.with_swell(sea.constant_current(0.1, 90.0), 0.5, period_s, 30.0, depth_m, 60.0)
    maximum = float(sea.orbital_speed_mps(0.5, period_s, depth_m, 12.5))
    for time_s in (0.0, 1.0, 17.3, 42.0):
        waves = at(current, time_s, 12.5) - [0.0, 0.1]
        along = waves @ [math.cos(towards), math.sin(towards)]
        across = waves @ [-math.sin(towards), math.cos(towards)]
        expected = maximum * math.cos(2 * math.pi * time_s / period_s)
        # Straight pieces between times and between layers.
        assert along == pytest.approx(expected, abs=0.012 * maximum)
        assert across == pytest.approx(0.0, abs=1e-12)


def test_a_varying_current_is_kept_under_the_waves() -> None:
    grid = np.array([[[0.1, 0.0], [0.0, 0.0]], [[0.3, 0.1], [0.0, 0.2]]])
    varying = sea.Current(np.array([0.0, 40.0]), np.array([0.0, 10.0]), grid)
    calm = sea.with_swell(varying, 0.0, 6.0, 0.0, 10.0, 40.0)
    for time_s in (0.0, 13.0, 40.0):
        for depth_m in (0.0, 3.0, 10.0):
            np.testing.assert_allclose(
                at(calm, time_s, depth_m), at(varying, time_s, depth_m), atol=1e-12
            )


def test_deep_and_shallow_water_are_the_known_limits() -> None:
    omega = 2 * math.pi / 4.0
    assert sea.wave_number(4.0, 200.0) == pytest.approx(omega**2 / sea.GRAVITY, rel=1e-12)
    long = 2 * math.pi / 60.0
    assert sea.wave_number(60.0, 2.0) == pytest.approx(
        long / math.sqrt(sea.GRAVITY * 2.0), rel=2e-3
    )


def test_deep_water_orbits_are_circles_that_shrink_with_depth() -> None:
    """At the surface the speed is that of a circle of the wave's height, once a period."""
    k = sea.wave_number(5.0, 300.0)
    speeds = sea.orbital_speed_mps(1.0, 5.0, 300.0, np.array([0.0, 1.0 / k]))
    assert speeds[0] == pytest.approx(math.pi / 5.0, rel=1e-9)
    assert speeds[1] == pytest.approx(math.pi / 5.0 / math.e, rel=1e-9)
