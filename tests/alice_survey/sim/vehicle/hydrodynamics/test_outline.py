import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from alice_survey.sim.vehicle.hydrodynamics.geometry import Outline

CYLINDER = Outline(x_m=(-0.7, 0.9), radius_m=(0.1, 0.1))
CONE = Outline(x_m=(0.0, 0.6), radius_m=(0.2, 0.0))
BLUNT = Outline(x_m=(-0.5, -0.3, 0.4, 0.4, 0.5), radius_m=(0.0, 0.1, 0.1, 0.05, 0.0))


def test_cylinder_by_hand() -> None:
    assert CYLINDER.length_m == pytest.approx(1.6)
    assert CYLINDER.volume_m3 == pytest.approx(math.pi * 0.01 * 1.6, rel=1e-13)
    assert CYLINDER.volume_x_m == pytest.approx(0.1, rel=1e-12)
    assert CYLINDER.side_area_m2 == pytest.approx(0.2 * 1.6, rel=1e-13)
    assert CYLINDER.side_fullness == pytest.approx(1.0, rel=1e-13)
    assert CYLINDER.frontal_area_m2 == pytest.approx(math.pi * 0.01, rel=1e-13)
    assert CYLINDER.wetted_area_m2 == pytest.approx(2 * math.pi * 0.1 * (1.6 + 0.1), rel=1e-13)


def test_cone_by_hand() -> None:
    assert CONE.volume_m3 == pytest.approx(math.pi * 0.04 * 0.6 / 3, rel=1e-13)
    assert CONE.volume_x_m == pytest.approx(0.15, rel=1e-13)
    assert CONE.side_fullness == pytest.approx(0.5 * 0.2 * 0.6 * 2 / (0.6 * 0.4), rel=1e-13)
    slope = math.hypot(0.6, 0.2)
    assert CONE.wetted_area_m2 == pytest.approx(math.pi * 0.2 * (slope + 0.2), rel=1e-13)


@pytest.mark.parametrize("outline", [CYLINDER, CONE, BLUNT])
@pytest.mark.parametrize("power", [0, 1, 2])
def test_strips_integrate_what_coefficients_need(outline: Outline, power: int) -> None:
    """r, r^2 and r |x|^3 against adaptive quadrature, kinks given."""
    x, r, w = outline.strips(breaks_m=(0.123,))
    knots = sorted({*outline.x_m, max(0.0, outline.tail_x_m)})
    for f in (lambda x, r: r * abs(x) ** 3, lambda x, r: r**2 * x**power):

        def integrand(at: float, f: object = f) -> float:
            return float(f(at, outline.radius_at(np.array([at]))[0]))  # type: ignore[operator]

        exact = sum(
            quad(integrand, low, high, epsabs=1e-15)[0]
            for low, high in itertools.pairwise(knots)
            if high > low
        )
        assert np.sum(w * f(x, r)) == pytest.approx(exact, rel=1e-9, abs=1e-13)


@given(tail=st.floats(-2.0, -0.1), nose=st.floats(0.1, 2.0))
def test_stretching_scales_lengths_alone(tail: float, nose: float) -> None:
    stretched = BLUNT.stretch(tail, nose)
    scale = (nose - tail) / BLUNT.length_m
    assert stretched.tail_x_m == tail and stretched.nose_x_m == nose
    assert stretched.volume_m3 == pytest.approx(scale * BLUNT.volume_m3, rel=1e-9)
    assert stretched.side_fullness == pytest.approx(BLUNT.side_fullness, rel=1e-9)
    moved = tail + scale * (BLUNT.volume_x_m - BLUNT.tail_x_m)
    assert stretched.volume_x_m == pytest.approx(moved, abs=1e-9)
