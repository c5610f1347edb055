"""Added mass, drag and lift of single shapes against closed forms."""

import numpy as np
import pytest

from tests import oracles_shape as parts
from tests.oracles_hydrodynamics import finned_circle, lamb_constants

RHO = 1025.0


@pytest.mark.parametrize("fineness", [1.0 + 1e-9, 1.0000004, 1.000001, 1.01, 2.0, 8.52, 60.0])
def test_alpha_0_is_lambs_integral(fineness: float) -> None:
    assert parts.alpha_0(fineness, 1.0) == pytest.approx(
        lamb_constants(fineness, 1.0)[0], rel=1e-6 if fineness < 1.01 else 1e-9
    )


@pytest.mark.parametrize("extra", [0.05, 0.16, 0.5, 2.0, 20.0])
def test_finned_circles_agree_with_a_conformal_map(extra: float) -> None:
    radius, span = 0.115, 0.115 * (1.0 + extra)
    across, rolling = finned_circle(radius, span, RHO)
    r = np.array(radius)
    assert float(parts.finned_circle_section(r, span, RHO)) == pytest.approx(across, rel=1e-4)
    assert float(parts.finned_circle_roll(r, span, RHO)) == pytest.approx(rolling, rel=1e-3)


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


def test_body_lift_is_the_papers() -> None:
    y_uv, z_uw, m_uw, n_uv = parts.body_lift(1.96, 0.23, 1.06, RHO).values()
    assert y_uv == z_uw == pytest.approx(-39.71, rel=1e-3)
    assert m_uw == pytest.approx(-8.498, rel=1e-3)
    assert n_uv == pytest.approx(8.498, rel=1e-3)
