"""A vehicle as a value: matrices from its parts, coefficients by name, and the known vehicles."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alice_survey.core.config import COEFFICIENTS as SETS
from alice_survey.core.errors import VehicleError
from alice_survey.sim.vehicle import vehicle as files
from alice_survey.sim.vehicle.coefficients import Coefficients
from alice_survey.sim.vehicle.propulsion import add_thrust
from alice_survey.sim.vehicle.sea import GRAVITY
from alice_survey.sim.vehicle.vehicle import vehicle_from
from tests.alice_survey.sim.vehicle.motions import block
from tests.oracles_shape import ALICE, SPARUS2

Triple = tuple[float, float, float]
METRES = st.tuples(*[st.floats(-0.5, 0.5)] * 3)


@settings(deadline=None)
@given(
    masses=st.tuples(st.floats(1.0, 80.0), st.floats(0.0, 40.0)),
    places=st.tuples(METRES, METRES),
    nu=st.tuples(*[st.floats(-2.0, 2.0)] * 6).map(np.array),
)
def test_rigid_inertia_holds_the_energy_of_its_parts(
    masses: tuple[float, float], places: tuple[Triple, Triple], nu: np.ndarray
) -> None:
    """1/2 nu M nu is that of each part's centre of gravity and of its turning about it."""
    inertias = ((0.5, 7.5, 7.4), (0.1, 2.0, 2.1))
    body = replace(
        block(cg=places[0], dry_kg=masses[0], entrained_kg=masses[1]).rigid_body,
        inertia_kg_m2=inertias[0],
        entrained_cg_body_m=places[1],
        entrained_inertia_kg_m2=inertias[1],
    )
    linear, angular = nu[:3], nu[3:]
    energy = 0.0
    for mass, place, inertia in zip(masses, places, inertias, strict=True):
        speed = linear + np.cross(angular, place)
        energy += 0.5 * mass * speed @ speed + 0.5 * angular @ (np.array(inertia) * angular)
    matrix = body.mass_matrix
    assert 0.5 * nu @ matrix @ nu == pytest.approx(energy, rel=1e-9, abs=1e-12)
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
    """2 kg, 1 m ahead of the origin: 2 kg m^2 about y and z, and the coupling of v to r.

    On top of them 1, 6 and 7 kg m^2 about its own centre.
    """
    point = block(cg=(1.0, 0.0, 0.0), dry_kg=2.0, buoyancy_kg=2.0).rigid_body
    expected = np.diag([2.0, 2.0, 2.0, 0.0 + 1.0, 2.0 + 6.0, 2.0 + 7.0])
    expected[1, 5] = expected[5, 1] = 2.0  # turning to starboard moves the weight to starboard
    expected[2, 4] = expected[4, 2] = -2.0  # nose up moves it up
    np.testing.assert_array_equal(point.mass_matrix, expected)


def named(**values: float) -> Coefficients:
    return Coefficients(name="some", values=values)


def test_each_name_lands_in_its_row_and_column() -> None:
    for i, force in enumerate("XYZKMN"):
        for j, motion in enumerate("uvwpqr"):
            one = np.zeros((6, 6))
            one[i, j] = -2.0
            linear = named(**{f"{force}_{motion}": -2.0})
            np.testing.assert_array_equal(linear.linear, one)
            assert not linear.quadratic.any() and not linear.added_mass.any()
            quadratic = named(**{f"{force}_{motion}{motion}": -2.0})
            np.testing.assert_array_equal(quadratic.quadratic, one)
            assert not quadratic.linear.any() and not quadratic.added_mass.any()
            added = named(**{f"{force}_{motion}dot": -2.0})
            mirrored = one.T if i != j else 0.0 * one
            np.testing.assert_array_equal(added.added_mass, -(one + mirrored))
            assert not added.linear.any() and not added.quadratic.any()
    np.testing.assert_array_equal(named(Y_uv=-1, Z_uw=-2, M_uw=-3, N_uv=4).lift, [-1, -2, -3, 4])


def test_both_names_of_an_added_mass_share_their_mean() -> None:
    matrix = named(Y_rdot=-8.50, N_vdot=-8.55).added_mass
    assert matrix[1, 5] == matrix[5, 1] == pytest.approx(8.525)
    with pytest.raises(VehicleError, match=r"Y_rdot = -8\.5 .*N_vdot = -9"):
        _ = named(Y_rdot=-8.5, N_vdot=-9.0).added_mass
    with pytest.raises(VehicleError, match=r"Z_qdot .*M_wdot"):
        _ = named(Z_qdot=11.0, M_wdot=-11.0).added_mass


def test_replacing_an_added_mass_drops_its_mirror() -> None:
    before = named(Y_rdot=-8.5, X_uu=-7.0, K_vdot=-0.2)
    after = before.with_values("other", {"N_vdot": -2.5, "X_uu": -15.0})
    assert after.name == "other"
    assert dict(after.values) == {"N_vdot": -2.5, "X_uu": -15.0, "K_vdot": -0.2}
    assert after.added_mass[1, 5] == 2.5
    assert before.added_mass[1, 5] == 8.5  # the old set is as it was


def test_damping_may_differ_by_the_way_of_the_motion() -> None:
    """A value of one way counts instead of that of both; a new one of both drops those of one."""
    kinds = Coefficients(
        name="test", values={"Z_ww": -200.0, "Z_ww_neg": -260.0, "X_uu_pos": -5.0, "Y_vv": -9.0}
    )
    assert (kinds.quadratic[2, 2], kinds.quadratic_back[2, 2]) == (-200.0, -260.0)
    assert (kinds.quadratic[0, 0], kinds.quadratic_back[0, 0]) == (-5.0, 0.0)
    assert kinds.quadratic[1, 1] == kinds.quadratic_back[1, 1] == -9.0
    assert (kinds.value("Z_ww_pos"), kinds.value("Z_ww_neg")) == (-200.0, -260.0)
    both = kinds.with_values("both", {"Z_ww": -100.0})
    assert both.quadratic[2, 2] == both.quadratic_back[2, 2] == -100.0
    one = kinds.with_values("one", {"Z_ww_pos": -100.0})
    assert (one.quadratic[2, 2], one.quadratic_back[2, 2]) == (-100.0, -260.0)
    with pytest.raises(VehicleError, match="Z_w_neg"):
        Coefficients(name="test", values={"Z_w_neg": -1.0})


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


@pytest.mark.parametrize(
    ("known", "changes", "match"),
    [
        ("alice", {"cg_body_m = [0.0, 0.0, ": "cg_body_m = [0.0, 0.0, -"}, "cg_body_m"),
        (
            "bluerov2_heavy",
            {"cg_body_m = [0.0, 0.0, ": "cg_body_m = [0.0, 0.0, -"},
            "",
        ),  # its thrusters hold it level
        ("remus100", {"3.438, 3.45]": "3.438, 14.5]"}, r"inertia_kg_m2.* 14\.2"),
        ("remus100", {"3.438, 3.45]": "13.5, 13.5]"}, ""),  # two weights at its ends
        ("remus100", {"Y_vv = -": "Y_vv = "}, "Y_vv"),
    ],
)
def test_a_body_that_no_physics_allows_is_refused(
    known: str, changes: dict[str, str], match: str, tmp_path: Path
) -> None:
    text = (Path(files.__file__).parent / "fleet_files" / f"{known}.toml").read_text()
    for old, new in changes.items():
        assert text.count(old) == 1
        text = text.replace(old, new)
    own = tmp_path / "own.toml"
    own.write_text(text)
    if match:
        with pytest.raises(VehicleError, match=rf"own\.toml: .*{match}"):
            vehicle_from(str(own))
    else:
        assert vehicle_from(str(own)).thrusters
