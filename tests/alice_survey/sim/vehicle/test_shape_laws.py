"""Added mass, drag and lift of single shapes against closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests import oracles_shape as parts
from tests.oracles_hydrodynamics import finned_circle, lamb_constants

RHO = 1025.0


def test_a_sphere_drags_half_of_its_displaced_mass() -> None:
    assert parts.alpha_0(0.3, 0.3) == pytest.approx(2.0 / 3.0, rel=1e-12)
    displaced = RHO * math.pi * 0.3**3 / 6.0
    assert parts.ellipsoid_mass(0.3, 0.3, RHO) == pytest.approx(displaced, rel=1e-13)
    assert parts.ellipsoid_axial(0.3, 0.3, RHO) == pytest.approx(displaced / 2.0, rel=1e-12)


@pytest.mark.parametrize("fineness", [1.0 + 1e-9, 1.0000004, 1.000001, 1.01, 2.0, 8.52, 60.0])
def test_alpha_0_is_lambs_integral(fineness: float) -> None:
    assert parts.alpha_0(fineness, 1.0) == pytest.approx(
        lamb_constants(fineness, 1.0)[0], rel=1e-6 if fineness < 1.01 else 1e-9
    )


def test_sections_by_hand() -> None:
    np.testing.assert_allclose(
        parts.circle_section(np.array([0.0, 0.115]), RHO), [0, RHO * math.pi * 0.115**2]
    )
    # An elliptic section of equal axes is a circle.
    assert parts.elliptic_section(0.23, RHO) == pytest.approx(
        float(parts.circle_section(np.array(0.115), RHO)), rel=1e-13
    )


@given(radius=st.floats(0.02, 0.2), extra=st.floats(1e-3, 3.0))
def test_finned_circles_between_circle_and_plate(radius: float, extra: float) -> None:
    span = radius * (1.0 + extra)
    finned = float(parts.finned_circle_section(np.array(radius), span, RHO))
    circle = float(parts.circle_section(np.array(radius), RHO))
    plate = RHO * math.pi * span**2
    assert circle < finned < plate
    roll = float(parts.finned_circle_roll(np.array(radius), span, RHO))
    wider = float(parts.finned_circle_roll(np.array(radius), 1.01 * span, RHO))
    assert 0 < roll < wider


@pytest.mark.parametrize("extra", [0.05, 0.16, 0.5, 2.0, 20.0])
def test_finned_circles_agree_with_a_conformal_map(extra: float) -> None:
    radius, span = 0.115, 0.115 * (1.0 + extra)
    across, rolling = finned_circle(radius, span, RHO)
    r = np.array(radius)
    assert float(parts.finned_circle_section(r, span, RHO)) == pytest.approx(across, rel=1e-4)
    assert float(parts.finned_circle_roll(r, span, RHO)) == pytest.approx(rolling, rel=1e-3)


def test_without_fins_a_finned_circle_is_a_circle() -> None:
    r = np.array([0.115])
    np.testing.assert_allclose(
        parts.finned_circle_section(r, 0.115, RHO), parts.circle_section(r, RHO)
    )
    np.testing.assert_allclose(parts.finned_circle_roll(r, 0.115, RHO), 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("reynolds", "friction"),
    # The line as tabled for ship models (Lewis, Principles of Naval Architecture II, 1988).
    [(1e5, 8.333e-3), (1e6, 4.688e-3), (1e7, 3.000e-3), (1e8, 2.083e-3), (1e9, 1.531e-3)],
)
def test_ittc57_is_the_published_line(reynolds: float, friction: float) -> None:
    assert parts.ittc57(reynolds) == pytest.approx(friction, rel=4e-4)


def test_ellipsoid_drag_by_hand() -> None:
    """d / l = 1/4, C_f = 0.005: 0.11 + 0.08 + 0.01."""
    assert parts.ellipsoid_drag(2.0, 0.5, 0.005) == pytest.approx(0.20, rel=1e-12)


def test_cylinder_across_by_hand_and_at_its_ends() -> None:
    assert parts.cylinder_across(10.0) == pytest.approx(1.2 * 0.75, rel=1e-12)
    assert parts.cylinder_across(1.0) == pytest.approx(1.2 * 0.58, rel=1e-12)
    assert parts.cylinder_across(1e4) == 1.2
    # The two branches meet within a per cent.
    assert parts.cylinder_across(57.49) == pytest.approx(1.2, rel=0.01)


def test_struts_lie_between_a_plate_edge_on_and_a_cylinder() -> None:
    thin, round_ = parts.strut_along(1.0, 1e-3, 1e5), parts.strut_along(0.1, 0.1, 3e4)
    friction = 1.328 / math.sqrt(1e5)
    assert thin * 1e-3 == pytest.approx(2.0 * friction, rel=2e-3)  # by its plan area, both sides
    assert 1.0 < round_ < 1.3


def test_body_lift_is_the_papers() -> None:
    y_uv, z_uw, m_uw, n_uv = parts.body_lift(1.96, 0.23, 1.06, RHO).values()
    assert y_uv == z_uw == pytest.approx(-39.71, rel=1e-3)
    assert m_uw == pytest.approx(-8.498, rel=1e-3)
    assert n_uv == pytest.approx(8.498, rel=1e-3)


def test_lift_behind_the_origin_turns_the_bow_back_into_the_flow() -> None:
    """Drifting to starboard going ahead (u, v > 0), water pushes the stern to port: N > 0, the bow
    to starboard, where the vehicle goes. In heave M < 0 puts the bow down in the same way."""
    x = parts.centre_of_pressure(1.06, 1.96)
    assert x == pytest.approx(-0.214, abs=1e-3)
    y_uv, z_uw, m_uw, n_uv = parts.body_lift(1.96, 0.23, 1.06, RHO).values()
    assert n_uv == pytest.approx(x * y_uv) and n_uv > 0
    assert m_uw == pytest.approx(-x * z_uw) and m_uw < 0
