"""A vehicle as a value: its matrices from its parts, by hand and by other methods."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alice_survey.core.errors import VehicleError
from alice_survey.sim.vehicle.propulsion import add_thrust
from alice_survey.sim.vehicle.sea import GRAVITY
from alice_survey.sim.vehicle.vehicle import RigidBody, vehicle_from
from tests.alice_survey.sim.vehicle.motions import block

METRES = st.tuples(*[st.floats(-0.5, 0.5)] * 3)


@settings(deadline=None)
@given(
    masses=st.tuples(st.floats(1.0, 80.0), st.floats(0.0, 40.0)),
    cg=METRES,
    cg_inside=METRES,
    nu=st.tuples(*[st.floats(-2.0, 2.0)] * 6),
)
def test_rigid_inertia_holds_the_energy_of_its_parts(
    masses: tuple[float, float],
    cg: tuple[float, float, float],
    cg_inside: tuple[float, float, float],
    nu: tuple[float, ...],
) -> None:
    """1/2 nu M nu is that of each part's centre of gravity and of its turning about it."""
    inertias = ((0.5, 7.5, 7.4), (0.1, 2.0, 2.1))
    body = RigidBody(
        dry_kg=masses[0],
        buoyancy_kg=50.0,
        entrained_kg=masses[1],
        cg_body_m=cg,
        inertia_kg_m2=inertias[0],
        entrained_cg_body_m=cg_inside,
        entrained_inertia_kg_m2=inertias[1],
    )
    linear, angular = np.array(nu[:3]), np.array(nu[3:])
    energy = 0.0
    for mass, place, inertia in zip(masses, (cg, cg_inside), inertias, strict=True):
        speed = linear + np.cross(angular, place)
        energy += 0.5 * mass * speed @ speed + 0.5 * angular @ (np.array(inertia) * angular)
    matrix = body.mass_matrix
    assert 0.5 * np.array(nu) @ matrix @ np.array(nu) == pytest.approx(energy, rel=1e-9, abs=1e-12)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-13)


def test_the_plant_holds_weight_buoyancy_and_inertia() -> None:
    vehicle = block({"X_udot": -3.0}, dry_kg=52.5, buoyancy_kg=52.0, entrained_kg=20.0)
    body = vehicle.plant.body
    assert body.weight_n == 52.5 * GRAVITY and body.buoyancy_n == 52.0 * GRAVITY
    assert vehicle.mass[0, 0] == 52.5 + 20.0 + 3.0
    np.testing.assert_allclose(body.mass_inverse @ vehicle.mass, np.eye(6), atol=1e-14)


def test_an_inertia_that_is_not_positive_is_refused() -> None:
    with pytest.raises(VehicleError, match=r"'given'.* -20"):
        _ = block({"Y_vdot": 70.0}).mass


@pytest.mark.parametrize("name", ["alice", "sparus2"])
def test_configuration_matrix_is_the_thrusters_at_work(name: str) -> None:
    """Each column is the wrench of one thruster at rest in the water, per newton of its thrust."""
    vehicle = vehicle_from(name)
    matrix = vehicle.configuration_matrix
    assert matrix.shape == (6, len(vehicle.thrusters))
    for i, thruster in enumerate(vehicle.thrusters):
        rps, wrench = np.zeros(len(vehicle.thrusters)), np.zeros(6)
        rps[i] = 0.8 * thruster.most_rps
        add_thrust(vehicle.plant.propulsion, rps, np.zeros(6), wrench)
        push = wrench[:3] @ thruster.direction_body
        assert push > 0.5
        np.testing.assert_allclose(wrench, matrix[:, i] * push, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(matrix[:3, i], thruster.direction_body)


def test_rigid_inertia_of_two_weights_by_hand() -> None:
    """2 kg, 1 m ahead of the origin: 2 kg m^2 about y and z, and the coupling of v to r."""
    point = RigidBody(
        dry_kg=2.0,
        buoyancy_kg=2.0,
        entrained_kg=0.0,
        cg_body_m=(1.0, 0.0, 0.0),
        inertia_kg_m2=(0.0, 0.0, 0.0),
    )
    expected = np.diag([2.0, 2.0, 2.0, 0.0, 2.0, 2.0])
    expected[1, 5] = expected[5, 1] = 2.0  # turning to starboard moves the weight to starboard
    expected[2, 4] = expected[4, 2] = -2.0  # nose up moves it up
    np.testing.assert_array_equal(point.mass_matrix, expected)
