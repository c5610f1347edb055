from typing import Literal

import numpy as np
import pytest

from alice_survey.sim.vehicle.coefficients import SHAPES
from alice_survey.sim.vehicle.vehicle import vehicle_from
from tests import oracles_shape as shape

RHO, BUOYANCY_KG = 1025.0, 52.1
BOTH = [shape.ALICE, shape.SPARUS2]


def test_alice_is_as_long_as_its_lift_implies() -> None:
    """Y_uv = -39.71 and M_uw = -8.498 hold for this hull and its nose."""
    assert shape.ALICE.outline.length_m == pytest.approx(1.96, abs=1e-12)
    assert shape.ALICE.outline.nose_x_m == 1.06
    assert shape.ALICE.outline.diameter_m == shape.SPARUS2.outline.diameter_m


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
    inside = shape.entrained_water(geometry, BUOYANCY_KG, RHO)
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


@pytest.mark.parametrize("geometry", BOTH)
def test_the_program_holds_what_follows_from_the_shapes(geometry: shape.Geometry) -> None:
    held = SHAPES[geometry.name]
    inside = shape.entrained_water(geometry, BUOYANCY_KG, RHO)
    water = [inside.mass_kg, inside.x_m, 0.0, 0.0, *inside.inertia_kg_m2]
    body = held["rigid_body"]
    np.testing.assert_allclose(
        [body["entrained_kg"], *body["entrained_cg_body_m"], *body["entrained_inertia_kg_m2"]],
        water, rtol=1e-10,
    )  # fmt: skip
    assert vehicle_from(geometry.name).hull == geometry.hull
    for name, values in {
        "computed": shape.estimate(geometry).values,
        "computed_hull": shape.part_coefficients(shape.parts(geometry, shape.Flow())[0]),
    }.items():
        for coefficient, value in held.get(name, {}).items():
            assert value == pytest.approx(values[coefficient], rel=1e-12), coefficient
    assert set(held["computed"]) == set(shape.estimate(geometry).values)
