from pathlib import Path

import numpy as np
import pytest

from alice_survey.core.errors import VehicleError
from alice_survey.sim.vehicle import vehicle as files
from alice_survey.sim.vehicle.vehicle import SETS, vehicle_from
from tests.oracles_shape import ALICE, SPARUS2

NAMES = ("alice", "sparus2")
GEOMETRIES = {shape.name: shape for shape in (ALICE, SPARUS2)}
STARBOARD, PORT, VERTICAL, BOW, STERN = range(5)


@pytest.mark.parametrize("name", NAMES)
def test_the_water_inside_counts_once_with_every_set(name: str) -> None:
    """The rigid body is one and the same: its surge inertia is dry mass and water."""
    bodies = [vehicle_from(name, each).rigid_body for each in SETS]
    assert all(body == bodies[0] for body in bodies)
    surge = bodies[0].mass_matrix[0, 0]
    assert surge == pytest.approx(52.0 + bodies[0].entrained_kg)
    geometry = GEOMETRIES[name]
    envelope = vehicle_from(name).density_kg_m3 * geometry.envelope_volume_m3
    assert bodies[0].entrained_kg + bodies[0].buoyancy_kg == pytest.approx(envelope)


def test_thrust_turns_and_rolls_as_by_hand() -> None:
    b = vehicle_from("alice").configuration_matrix
    assert b.shape == (6, 5)
    np.testing.assert_allclose(b[0], [1, 1, 0, 0, 0])
    np.testing.assert_allclose(b[1], [0, 0, 0, 1, 1])
    np.testing.assert_allclose(b[2], [0, 0, 1, 0, 0])
    # Ahead on the starboard side turns the bow to port, N = -y X.
    assert b[5, STARBOARD] == -0.167 == -b[5, PORT]
    # To starboard at the bow turns the bow to starboard; at the stern to port.
    assert b[5, BOW] > 0.9 and -0.8 < b[5, STERN] < -0.7
    # Against the turn of the propeller: port turns by the right hand, so that the hull rolls to
    # port (K < 0); both together cancel.
    assert b[3, PORT] == pytest.approx(-b[3, STARBOARD]) and b[3, PORT] < -0.01
    assert np.linalg.matrix_rank(b[[0, 1, 2, 5]]) == 4


def test_lateral_thrusters_sit_in_their_tunnels() -> None:
    alice = vehicle_from("alice")
    for thruster in alice.thrusters[BOW:]:
        tunnel = next(t for t in GEOMETRIES["alice"].tunnels if t.name == thruster.name)
        assert thruster.position_body_m == (tunnel.x_m, 0.0, 0.0)
        assert thruster.diameter_m == tunnel.diameter_m
    for name in NAMES:
        pod = GEOMETRIES[name].pod
        for thruster in vehicle_from(name).thrusters[:2]:
            x, y, z = thruster.position_body_m
            assert pod.outline.tail_x_m < x < pod.outline.nose_x_m
            assert abs(y) == pytest.approx(pod.y_m, abs=1e-3) and z == 0.0


def test_a_geometry_gives_hull_water_and_coefficients_to_any_file(tmp_path: Path) -> None:
    """A file that names a shape, with one number of its own; and one that names none there is."""
    own = tmp_path / "own.toml"
    alice = (Path(files.__file__).parent / "fleet_files" / "alice.toml").read_text()
    own.write_text(alice.replace('name = "alice"', 'name = "own"').replace("= 60.0", "= 20.0"))
    craft, known = vehicle_from(str(own), "computed"), vehicle_from("alice", "computed")
    assert (craft.name, craft.hotel_w) == ("own", 20.0)
    assert craft.hull == known.hull and craft.rigid_body == known.rigid_body
    assert craft.coefficients is known.coefficients
    own.write_text(alice.replace('geometry = "alice"', 'geometry = "nautilus"'))
    with pytest.raises(VehicleError, match=r"'nautilus' is not known; known: alice, sparus2"):
        vehicle_from(str(own))
    own.write_text(alice.replace('"estimated", "cfd", ', ""))
    with pytest.raises(VehicleError, match="'cfd' are not known; known: calibrated, computed"):
        vehicle_from(str(own), "cfd")
