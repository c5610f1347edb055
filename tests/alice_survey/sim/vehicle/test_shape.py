"""Shapes: their laws in closed form, sums of their parts, and what the program holds of them."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from alice_survey.sim.vehicle.coefficients import SHAPES
from alice_survey.sim.vehicle.vehicle import vehicle_from
from tests import oracles_shape as shape
from tests.oracles_hydrodynamics import Array, finned_circle, lamb_constants, reaction

RHO = 1025.0
SHARES = {part.name: shape.part_coefficients(part) for part in shape.parts(shape.ALICE)}
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
    hull = shape.part_coefficients(shape.parts(cylinder)[0])
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


BUOYANCY_KG = 52.1
BOTH = [shape.ALICE, shape.SPARUS2]


@pytest.mark.parametrize("end", ["bow", "stern"])
def test_lateral_thrusters_sit_as_far_out_as_they_fit(end: Literal["bow", "stern"]) -> None:
    """Points all over the thruster lie inside the hull; some do not when it moves 2 mm out."""
    x = shape.farthest_tunnel_x(shape.ALICE.outline, end)
    tunnel = next(t for t in shape.ALICE.tunnels if t.name == end)
    assert tunnel.x_m == pytest.approx(x, abs=6e-4)
    angle, y = np.meshgrid(np.linspace(0, 2 * np.pi, 181), np.linspace(-0.5, 0.5, 21))
    radius, side = shape.T200_DIAMETER_M / 2.0, shape.T200_LENGTH_M * y

    def clearance(at: float) -> float:
        along, up = at + radius * np.cos(angle), radius * np.sin(angle)
        return float(np.min(shape.ALICE.outline.radius_at(along) - np.hypot(side, up)))

    outward = 0.002 if end == "bow" else -0.002
    assert clearance(x) == pytest.approx(shape.SHELL_M, abs=1e-6)
    assert clearance(x + outward) < shape.SHELL_M < clearance(x - outward)


@pytest.mark.parametrize("geometry", BOTH)
def test_water_fills_what_the_dry_vehicle_leaves_and_balances_it(geometry: shape.Geometry) -> None:
    """Slices of 0.1 mm: mass, centre, inertia; and what is dry has its centre at the origin."""
    inside = shape.entrained_water(geometry, BUOYANCY_KG)
    assert inside.mass_kg == pytest.approx(RHO * geometry.envelope_volume_m3 - BUOYANCY_KG)
    dry = geometry.envelope_volume_m3 * geometry.envelope_x_m - inside.mass_kg * inside.x_m / RHO
    assert dry == pytest.approx(0.0, abs=1e-9)

    outline = geometry.outline
    x = np.arange(outline.tail_x_m, outline.nose_x_m, 1e-4) + 5e-5
    wet = (x > inside.nose_from_x_m) | (x < inside.tail_to_x_m)
    x, r = x[wet], outline.radius_at(x)[wet]
    mass = RHO * np.pi * r**2 * 1e-4
    assert mass.sum() == pytest.approx(inside.mass_kg, rel=1e-3)
    assert (mass @ x) / mass.sum() == pytest.approx(inside.x_m, abs=1e-3)
    pitch = mass @ ((x - inside.x_m) ** 2 + r**2 / 4.0)
    np.testing.assert_allclose(inside.inertia_kg_m2, [mass @ r**2 / 2.0, pitch, pitch], rtol=2e-3)
    assert outline.tail_x_m < inside.tail_to_x_m < 0 < inside.nose_from_x_m < outline.nose_x_m

    # The program holds what follows from the shapes.
    held = SHAPES[geometry.name]
    water = [inside.mass_kg, inside.x_m, 0.0, 0.0, *inside.inertia_kg_m2]
    body = held["rigid_body"]
    np.testing.assert_allclose(
        [body["entrained_kg"], *body["entrained_cg_body_m"], *body["entrained_inertia_kg_m2"]],
        water, rtol=1e-10,
    )  # fmt: skip
    assert vehicle_from(geometry.name).hull == geometry.hull
    for name, values in {
        "computed": shape.estimate(geometry).values,
        "computed_hull": shape.part_coefficients(shape.parts(geometry)[0]),
    }.items():
        for coefficient, value in held.get(name, {}).items():
            assert value == pytest.approx(values[coefficient], rel=1e-12), coefficient
    assert set(held["computed"]) == set(shape.estimate(geometry).values)


@pytest.mark.parametrize("fineness", [1.0 + 1e-9, 1.0000004, 1.000001, 1.01, 2.0, 8.52, 60.0])
def test_alpha_0_is_lambs_integral(fineness: float) -> None:
    assert shape.alpha_0(fineness, 1.0) == pytest.approx(
        lamb_constants(fineness, 1.0)[0], rel=1e-6 if fineness < 1.01 else 1e-9
    )


@pytest.mark.parametrize("extra", [0.05, 0.16, 0.5, 2.0, 20.0])
def test_finned_circles_agree_with_a_conformal_map(extra: float) -> None:
    radius, span = 0.115, 0.115 * (1.0 + extra)
    across, rolling = finned_circle(radius, span, RHO)
    r = np.array(radius)
    assert float(shape.finned_circle_section(r, span)) == pytest.approx(across, rel=1e-4)
    assert float(shape.finned_circle_roll(r, span)) == pytest.approx(rolling, rel=1e-3)


@pytest.mark.parametrize(
    ("reynolds", "friction"),
    # The line as tabled for ship models (Lewis, Principles of Naval Architecture II, 1988).
    [(1e5, 8.333e-3), (1e6, 4.688e-3), (1e7, 3.000e-3), (1e8, 2.083e-3), (1e9, 1.531e-3)],
)
def test_ittc57_is_the_published_line(reynolds: float, friction: float) -> None:
    assert shape.ittc57(reynolds) == pytest.approx(friction, rel=4e-4)


def test_drag_by_hand() -> None:
    """An ellipsoid of d / l = 1/4, C_f = 0.005: 0.11 + 0.08 + 0.01; cylinders, and their ends."""
    assert shape.ellipsoid_drag(2.0, 0.5, 0.005) == pytest.approx(0.20, rel=1e-12)
    assert shape.cylinder_across(10.0) == pytest.approx(1.2 * 0.75, rel=1e-12)
    assert shape.cylinder_across(1.0) == pytest.approx(1.2 * 0.58, rel=1e-12)
    assert shape.cylinder_across(1e4) == 1.2
    # The two branches meet within a per cent.
    assert shape.cylinder_across(57.49) == pytest.approx(1.2, rel=0.01)


def test_body_lift_is_the_papers() -> None:
    """Y_uv = -39.71 and M_uw = -8.498 hold for the hull of ALICE and its nose."""
    outline = shape.ALICE.outline
    assert outline.length_m == pytest.approx(1.96, abs=1e-12)
    assert (outline.nose_x_m, outline.diameter_m) == (1.06, shape.SPARUS2.outline.diameter_m)
    y_uv, z_uw, m_uw, n_uv = shape.body_lift(1.96, 0.23, 1.06).values()
    assert y_uv == z_uw == pytest.approx(-39.71, rel=1e-3)
    assert m_uw == pytest.approx(-8.498, rel=1e-3)
    assert n_uv == pytest.approx(8.498, rel=1e-3)
