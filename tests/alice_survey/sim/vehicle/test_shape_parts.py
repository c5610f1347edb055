"""Signs and sums: the elements of parts against brute force, and by hand."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests import oracles_shape as shape
from tests.oracles_hydrodynamics import Array, reaction

RHO = 1025.0
SHARES = {
    part.name: shape.part_coefficients(part) for part in shape.parts(shape.ALICE, shape.Flow())
}
TRIPLES = st.tuples(*3 * [st.floats(-1.0, 1.0)]).map(np.array)


@given(point=TRIPLES, other=TRIPLES, direction=TRIPLES, nu=st.integers(0, 5))
def test_elements_react_as_brute_force_says(
    point: Array, other: Array, direction: Array, nu: int
) -> None:
    if np.linalg.norm(direction) < 1e-3:
        direction = np.array([1.0, 0.0, 0.0])
    direction = direction / np.linalg.norm(direction)
    points, amounts = np.array([point, other]), np.array([3.0, 5.0])
    motion = np.eye(6)[nu]
    np.testing.assert_allclose(
        -shape.inertia_of(points, direction, amounts) @ motion,
        reaction(points, direction, amounts, motion, 1), atol=1e-12,
    )  # fmt: skip
    for sign in (1.0, -1.0):
        np.testing.assert_allclose(
            sign * shape.drag_of(points, direction, amounts)[:, nu],
            reaction(points, direction, amounts, sign * motion, 2), atol=1e-12,
        )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "sign"),
    [
        # The mast sits above (z < 0) and aft (x < 0).
        ("K_vdot", -1),  # speeding up to starboard, water pushes it to port: rolls to port
        ("N_pdot", 1),  # rolling to starboard moves it to starboard: pushed to port, aft: N > 0
        ("K_rdot", 1),
        ("M_udot", 1),  # speeding up ahead, it is pushed back, above: bow up
        ("M_uu", 1),
        ("K_vv", -1),  # drifting to starboard, pushed to port above: rolls to port
        ("K_rr", 1),  # bow to starboard swings it to port: pushed to starboard: rolls to starboard
        ("K_pp", -1),
        ("Y_pp", -1),  # rolling to starboard, pushed to port
        # More of the hull is ahead of the origin.
        ("Y_rdot", -1),
        ("N_vdot", -1),  # speeding up to starboard, the bow lags
        ("Z_qdot", 1),
        ("M_wdot", 1),  # speeding up downwards, the bow lags upwards
        ("N_vv", -1),
        ("M_ww", 1),
        ("N_rr", -1),
        ("M_qq", -1),
        ("M_uw", -1),
        ("N_uv", 1),
    ],
)
def test_signs_by_hand(name: str, sign: int) -> None:
    assert np.sign(shape.estimate(shape.ALICE).values[name]) == sign


def test_the_mast_by_hand() -> None:
    """Its strips integrate over its height, from z_0 to z_1: z, z^2 and |z|^3."""
    mast, share = shape.ALICE.mast, SHARES["mast"]
    z_0, z_1 = -mast.root_z_m, -mast.root_z_m + mast.height_m
    section = RHO * np.pi / 4.0 * mast.chord_m**2
    mass = section * mast.height_m
    assert share["Y_vdot"] == pytest.approx(-mass)
    assert share["K_vdot"] == pytest.approx(-section * (z_1**2 - z_0**2) / 2.0)
    assert share["K_pdot"] == pytest.approx(-section * (z_1**3 - z_0**3) / 3.0)
    assert share["N_pdot"] == pytest.approx(-mast.x_m * -mast.middle_z_m * mass)
    assert share["M_udot"] == pytest.approx(-share["X_udot"] * (0.23 + mast.height_m) / 2.0)
    drag = -share["Y_vv"] / mast.height_m
    assert share["K_vv"] == pytest.approx(-drag * (z_1**2 - z_0**2) / 2.0)
    assert share["K_pp"] == pytest.approx(-drag * (z_1**4 - z_0**4) / 4.0)
    assert share["K_rr"] == pytest.approx(-share["K_vv"] * mast.x_m**2)


def test_strips_of_a_cylinder_in_closed_form() -> None:
    """Mass rho pi r^2 l, its moments, and the drag's; mounts too short to count."""
    low, high, r = -0.7, 0.9, 0.1
    cylinder = replace(
        shape.SPARUS2, outline=shape.Outline(x_m=(low, high), radius_m=(r, r)),
        mount=shape.SPARUS2.mount._replace(aft_x_m=0.2, fore_x_m=0.2 + 1e-12, tip_y_m=0.11),
    )  # fmt: skip
    hull = shape.part_coefficients(shape.parts(cylinder, shape.Flow())[0])
    section = RHO * np.pi * r**2
    assert hull["Y_vdot"] == pytest.approx(-section * 1.6)
    assert hull["Z_wdot"] == pytest.approx(-section * 1.6)
    assert hull["N_vdot"] == pytest.approx(-section * (high**2 - low**2) / 2.0)
    assert hull["M_wdot"] == pytest.approx(section * (high**2 - low**2) / 2.0)
    assert hull["N_rdot"] == pytest.approx(-section * (high**3 - low**3) / 3.0)
    drag = -hull["Y_vv"] / 1.6
    assert drag == pytest.approx(0.5 * RHO * 1.2 * (0.58 + 0.17 * np.log10(8.0) ** 1.6) * 0.2)
    assert hull["N_vv"] == pytest.approx(-drag * (high**2 - low**2) / 2.0)
    assert hull["N_rr"] == pytest.approx(-drag * (high**4 + low**4) / 4.0)
    assert hull["Y_rr"] == pytest.approx(-drag * (high**3 + low**3) / 3.0)
