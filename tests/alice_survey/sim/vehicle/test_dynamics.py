"""The equations of motion: at one instant against the textbook's twin, and over time."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from alice_survey.core.config import COEFFICIENTS as SETS
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import dynamics
from alice_survey.sim.vehicle.propulsion import add_thrust
from alice_survey.sim.vehicle.sea import GRAVITY, Current, sheared_current
from alice_survey.sim.vehicle.vehicle import Vehicle, vehicle_from
from tests import oracles_dynamics as oracle
from tests.alice_survey.sim.vehicle import motions as m

DEEP = (0.0, 0.0, 1000.0)

VELOCITIES = arrays(np.float64, 6, elements=st.floats(-3.0, 3.0))
ATTITUDES = st.tuples(st.floats(-3.1, 3.1), st.floats(-1.4, 1.4), st.floats(-3.1, 3.1))


@settings(deadline=None)
@given(nu=VELOCITIES)
@pytest.mark.parametrize("coefficients", SETS)
def test_kernels_and_matrices_match_the_textbook(coefficients: str, nu: Array) -> None:
    """Coriolis matrices are skew and do no work; damping is the sum of its terms by names."""
    vehicle = m.alice(coefficients)
    body, turned, damped = vehicle.plant.body, np.zeros(6), np.zeros(6)
    dynamics.add_coriolis(body, nu, turned)
    dynamics.add_damping(body, nu, damped)
    masses = (vehicle.rigid_body.mass_matrix, vehicle.coefficients.added_mass, vehicle.mass)
    rigid, added, _ = matrices = [dynamics.coriolis_matrix(mass, nu) for mass in masses]
    for mass, matrix, force in zip(masses, matrices, (rigid @ nu, added @ nu, turned), strict=True):
        np.testing.assert_allclose(matrix, -matrix.T, atol=1e-12)
        assert abs(nu @ force) < 1e-12 * (1.0 + np.abs(mass).max() * np.linalg.norm(nu) ** 3)
    textbook = sum(part.coriolis(nu) @ nu for part in oracle.parts(vehicle))
    textbook = textbook + oracle.added_coriolis(oracle.added_mass(vehicle), nu) @ nu
    np.testing.assert_allclose(-turned, textbook, atol=1e-9)
    np.testing.assert_allclose((rigid + added) @ nu, textbook, atol=1e-9)
    by_names = oracle.damping_force(vehicle, nu)
    np.testing.assert_allclose(damped, by_names, atol=1e-10)
    np.testing.assert_allclose(-m.damping_matrix(body, nu) @ nu, by_names, atol=1e-10)


@pytest.mark.parametrize("coefficients", SETS)
def test_damping_takes_power_at_any_velocity(coefficients: str) -> None:
    """The least of 20,000 draws, over what the diagonal alone takes; a search for it finds
    0.87, 0.77 and 0.89 of the diagonal's for the paper's three sets and 0.67 for the computed one
    (all terms are cubic, so that only the direction of a velocity counts)."""
    vehicle = m.alice(coefficients)
    diagonal = -np.diag(vehicle.plant.body.quadratic)
    rng = np.random.default_rng(5)
    draws = rng.standard_normal((20_000, 6)) * np.exp(rng.uniform(-4, 1, (20_000, 6)))
    power = m.drag_power(vehicle.plant.body, draws / np.cbrt(diagonal))
    shares = power / np.sum(np.abs(draws) ** 3, axis=1)
    assert 0.6 < shares.min() < 0.95
    assert shares.max() < 10.0


@settings(deadline=None)
@given(nu=VELOCITIES, attitude=ATTITUDES)
@pytest.mark.parametrize("coefficients", SETS)
def test_energy_falls_by_what_damping_takes(
    coefficients: str, nu: Array, attitude: tuple[float, float, float]
) -> None:
    """In still water without thrust: d/dt (kinetic + potential) = - nu D(nu) nu."""
    vehicle = m.alice(coefficients)
    state = m.state_of(vehicle, nu, attitude)
    rate = m.rates(vehicle, state)
    cg_ned = m.rotations(state).apply(np.array(vehicle.rigid_body.cg_body_m))
    spin = m.rotations(state).apply(nu[3:])
    cg_sinks = rate[2] + np.cross(spin, cg_ned)[2]
    body = vehicle.plant.body
    power = nu @ vehicle.mass @ rate[7:13] + body.buoyancy_n * rate[2] - body.weight_n * cg_sinks
    damping = nu @ m.damping_matrix(body, nu) @ nu
    assert power == pytest.approx(-damping, abs=1e-9 * (1.0 + damping + np.abs(vehicle.mass).max()))
    assert power <= 1e-9 * (1.0 + damping)


@settings(deadline=None)
@given(
    draw=arrays(np.float64, 27, elements=st.floats(-1.0, 1.0)),
    cg=st.tuples(*[st.floats(-0.05, 0.05)] * 3),
    cg_inside=st.tuples(*[st.floats(-0.1, 0.1)] * 3),
)
def test_rates_match_newtons_law_over_ground(
    draw: Array, cg: tuple[float, float, float], cg_inside: tuple[float, float, float]
) -> None:
    """In a current that changes with depth and time, against an independent derivation."""
    nu, load, attitude = 3.0 * draw[:6], 10.0 * draw[6:12], (*(draw[12:15] * [3.1, 1.4, 3.1]),)
    speeds, command = np.round(40.0 * draw[15:20], 6), 90.0 * draw[20:25]
    net_kg, time_s = 2.0 * draw[25], 30.0 + 30.0 * draw[26]
    plain = m.alice()
    dry_kg = plain.rigid_body.dry_kg + net_kg
    rigid = replace(plain.rigid_body, dry_kg=dry_kg, cg_body_m=cg, entrained_cg_body_m=cg_inside)
    vehicle = replace(plain, rigid_body=rigid)
    position = (1.0, -2.0, 7.0)
    state = m.state_of(vehicle, nu, attitude, position, speeds)
    rate = m.rates(vehicle, state, load, m.SHEAR_AND_TIDE, time_s, command)

    rotation = oracle.ned_from_body(np.array(attitude))
    velocity, by_time, by_depth = oracle.water(m.SHEAR_AND_TIDE, time_s, position[2])
    eta = np.array([*position, *attitude])
    nu_ground = nu + np.array([*(rotation.T @ velocity), 0, 0, 0])
    eta_rate, nu_ground_rate, speed_rates = oracle.derivative(
        time_s, eta, nu_ground, speeds, command, load, vehicle, m.SHEAR_AND_TIDE
    )
    water_rate = rotation.T @ (by_time + by_depth * eta_rate[2]) - np.cross(
        nu[3:], rotation.T @ velocity
    )
    nu_ground_rate[:3] -= water_rate
    np.testing.assert_allclose(rate[:3], eta_rate[:3], atol=1e-10)
    np.testing.assert_allclose(rate[7:13], nu_ground_rate, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(rate[13:], speed_rates, atol=1e-10)
    # Quaternion rates as a rotation a little later.
    later = state.copy()
    later[3:7] += 1e-6 * rate[3:7]
    turned = (m.attitudes(later) - np.array(attitude)) / 1e-6
    assert np.allclose(np.sin(turned * 1e-6), np.sin(eta_rate[3:] * 1e-6), atol=1e-9)
    assert rate[3:7] @ state[3:7] == pytest.approx(0.0, abs=1e-12)


@settings(max_examples=25, deadline=None)
@given(nu=VELOCITIES, attitude=ATTITUDES, net_kg=st.sampled_from([-1.0, 0.0, 1.0]))
@pytest.mark.parametrize("coefficients", SETS)
def test_no_motion_gains_energy(
    coefficients: str, nu: Array, attitude: tuple[float, float, float], net_kg: float
) -> None:
    plain = m.alice(coefficients)
    heavy = replace(plain.rigid_body, dry_kg=plain.rigid_body.dry_kg + net_kg)
    vehicle = replace(plain, rigid_body=heavy)
    states = m.advance(vehicle, m.state_of(vehicle, nu, attitude), 3.0, 0.005)
    angles = m.attitudes(states)
    energies = np.array([
        oracle.energy(vehicle, np.concatenate([state[:3], angle]), state[7:13])
        for state, angle in zip(states[::10], angles[::10], strict=True)
    ])  # fmt: skip
    assert np.all(np.isfinite(energies))
    assert np.max(np.diff(energies)) < 1e-6 * (1.0 + np.ptp(energies))


def test_neutral_vehicle_stays_at_rest_when_level() -> None:
    """No acceleration at any heading: weight and buoyancy in one line."""
    for heading in np.linspace(-3.0, 3.0, 7):
        rate = m.rates(m.alice(), m.state_of(m.alice(), attitude_rad=(0.0, 0.0, heading)))
        np.testing.assert_allclose(rate, 0.0, atol=1e-14)


def test_weight_above_buoyancy_sinks_by_both_inertias() -> None:
    """1 kg too heavy: Z = g, over mass with the water inside and added mass."""
    vehicle = m.block({"Z_wdot": -40.0}, dry_kg=51.0, entrained_kg=9.0)
    rate = m.rates(vehicle, m.state_of(vehicle))
    assert rate[m.Z] == pytest.approx(GRAVITY / (51.0 + 9.0 + 40.0), rel=1e-12)
    np.testing.assert_allclose(np.delete(rate, m.Z), 0.0, atol=1e-15)


def pushed(vehicle: Vehicle, axis: Array, newtons: float = 1.0) -> Array:
    return m.advance(vehicle, m.state_of(vehicle), 2.0, load=newtons * axis)[-1]


def test_each_push_moves_the_vehicle_its_way() -> None:
    """X north, Y to starboard (east), Z down, K starboard side down, M nose up, N to starboard."""
    vehicle = m.block(cg=(0.0, 0.0, 0.01))
    assert pushed(vehicle, m.U)[0] > 0.01
    assert pushed(vehicle, m.V)[1] > 0.01
    assert pushed(vehicle, m.W)[2] > 5.01
    rolled, pitched, turned = (pushed(vehicle, axis) for axis in (m.P, m.Q, m.R))
    assert m.rotations(rolled).apply([0.0, 1.0, 0.0])[2] > 0.01  # the starboard side is lower
    assert m.attitudes(rolled)[0] > 0.01
    assert m.rotations(pitched).apply([1.0, 0.0, 0.0])[2] < -0.01  # the nose is higher
    assert m.attitudes(pitched)[1] > 0.01
    assert m.rotations(turned).apply([1.0, 0.0, 0.0])[1] > 0.01  # the bow is east of north
    assert m.attitudes(turned)[2] > 0.01


def test_restoring_moments_by_hand() -> None:
    """52 kg, centre of gravity 3 cm low: 5 degrees of roll and of pitch are pushed back."""
    low = m.block(cg=(0.0, 0.0, 0.03), dry_kg=52.0, buoyancy_kg=52.0)
    angle = math.radians(5.0)
    moment = 52.0 * GRAVITY * 0.03 * math.sin(angle)
    # Free to sway, the body turns about its centre of gravity.
    for axis, attitude in ((0, (angle, 0.0, 0.0)), (1, (0.0, angle, 0.0))):
        inertia = low.rigid_body.inertia_kg_m2[axis]
        rate = m.rates(low, m.state_of(low, attitude_rad=attitude))
        assert rate[m.K + axis] == pytest.approx(-moment / inertia, rel=1e-9)
    # A heavier nose pitches down, a heavier starboard side rolls to it.
    for cg, axis, expected in (((0.02, 0.0, 0.0), m.M, -1 / 6.0), ((0.0, 0.02, 0.0), m.K, 1.0)):
        off = m.block(cg=cg)
        rate = m.rates(off, m.state_of(off))
        assert rate[axis] == pytest.approx(50.0 * GRAVITY * 0.02 * expected, rel=1e-9)


def test_munk_moment_turns_the_body_broadside() -> None:
    """u = 1, v = 0.1 (a drift to starboard): N = (Y_vdot - X_udot) u v turns the bow away, to port.

    Added mass 3 and 70 kg: N = (3 - 70) 0.1 = -6.7 N m on 7 + 1 kg m^2; in pitch the bow turns
    away from a heave to below, upwards.
    """
    slender = m.block(
        {"X_udot": -3.0, "Y_vdot": -70.0, "Z_wdot": -70.0, "N_rdot": -1.0, "M_qdot": -1.0}
    )
    rate = m.rates(slender, m.state_of(slender, np.array([1.0, 0.1, 0, 0, 0, 0])))
    assert rate[m.N] == pytest.approx(-6.7 / 8.0, rel=1e-12)
    rate = m.rates(slender, m.state_of(slender, np.array([1.0, 0, 0.1, 0, 0, 0])))
    assert rate[m.M] == pytest.approx(6.7 / 7.0, rel=1e-12)


def test_body_lift_opposes_drift_and_weathercocks_going_ahead() -> None:
    """The centre of lift lies 0.2 m behind the origin; astern the lift still opposes the drift."""
    hull = m.block({"Y_uv": -40.0, "N_uv": 8.0, "Z_uw": -40.0, "M_uw": -8.0})
    for u, across, force, turn, expected in (
        (m.U, m.V, m.Y, m.N, 0.8 / 7.0), (m.U, m.W, m.Z, m.M, -0.8 / 6.0),
        (-m.U, m.V, m.Y, m.N, -0.8 / 7.0),
    ):  # fmt: skip
        rate = m.rates(hull, m.state_of(hull, u + 0.1 * across))
        assert rate[[force, turn]] == pytest.approx([-4.0 / 50.0, expected])


@pytest.mark.parametrize("newtons", [2.0, -6.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_from_rest_the_speed_follows_a_hyperbolic_tangent(axis: int, newtons: float) -> None:
    """m u' = X + X_uu u |u|: u = u_T tanh(t sqrt(X |X_uu|) / m), u_T = sqrt(X / |X_uu|)."""
    vehicle = m.block({"X_uu": -15.0, "Y_vv": -320.0, "Z_ww": -200.0, "Y_vdot": -23.0})
    drag, mass = -vehicle.coefficients.quadratic[axis, axis], vehicle.mass[axis, axis]
    start = m.state_of(vehicle, position_ned=DEEP)
    states = m.advance(vehicle, start, 30.0, 0.01, newtons * np.eye(6)[axis])
    time_s = np.arange(len(states)) * 0.01
    terminal = math.copysign(math.sqrt(abs(newtons) / drag), newtons)
    expected = terminal * np.tanh(time_s * math.sqrt(abs(newtons) * drag) / mass)
    np.testing.assert_allclose(states[:, 7 + axis], expected, atol=1e-9)
    assert states[-1, 7 + axis] == pytest.approx(terminal, rel=0.05)


@pytest.mark.parametrize("coefficients", SETS)
@pytest.mark.parametrize(("axis", "newtons"), [(0, 0.6), (0, -8.0), (1, 4.0), (2, 5.0), (2, -5.0)])
def test_terminal_speed_of_the_whole_vehicle(axis: int, newtons: float, coefficients: str) -> None:
    """At u = sqrt(X / |X_uu|) nothing changes any more: the low centre of gravity holds against
    M_uu, M_ww (in pitch) and the mast's K_vv (in roll), a yaw moment against N_vv."""
    vehicle = m.alice(coefficients)
    quadratic = vehicle.coefficients.quadratic
    speed = math.copysign(math.sqrt(abs(newtons) / -quadratic[axis, axis]), newtons)
    nu, load = np.zeros(6), np.zeros(6)
    nu[axis], load[axis] = speed, newtons
    moments = quadratic[3:, axis] * speed * abs(speed)
    load[5] = -moments[2]
    low = vehicle.plant.body.weight_n * vehicle.rigid_body.cg_body_m[2]
    tilt = (math.asin(moments[0] / low), math.asin(moments[1] / low), 0.7)
    rate = m.rates(vehicle, m.state_of(vehicle, nu, tilt), load)
    np.testing.assert_allclose(rate[7:], 0.0, atol=1e-13)
    assert abs(speed) > 0.05 and max(np.abs(tilt[:2])) < 0.5
    # It gets there by itself, but for swings in pitch that die out slowly. (Faster than some
    # 0.5 m/s the Munk moment outweighs the low centre of gravity, and a pilot has to hold the nose;
    # in sway it turns the vehicle.)
    if axis == 2 or newtons == 0.6:
        start = m.state_of(vehicle, 0.8 * nu, tilt, DEEP)
        end = m.advance(vehicle, start, 150.0, 0.02, load)[-1]
        assert end[7 + axis] == pytest.approx(speed, rel=2e-3)
        np.testing.assert_allclose(np.delete(end[7:13], axis), 0.0, atol=0.02)


@settings(max_examples=20, deadline=None)
@given(
    speed=st.floats(0.0, 1.0),
    towards_deg=st.floats(0.0, 360.0),
    attitude=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-3.0, 3.0)),
    surge=st.floats(-1.0, 1.0),
)
def test_a_uniform_current_carries_the_motion_along(
    speed: float, towards_deg: float, attitude: tuple[float, float, float], surge: float
) -> None:
    """Galilean invariance: the same motion in the water, the current's way added to the track."""
    vehicle = vehicle_from("alice")
    state = m.state_of(vehicle, np.array([surge, 0.1, -0.1, 0.2, 0.1, -0.3]), attitude)
    commands = np.array([30.0, -20.0, 15.0, 25.0, -30.0])
    still = m.advance(vehicle, state, 5.0, command_rps=commands)[-1]
    current = m.constant_current(speed, towards_deg)
    carried = m.advance(vehicle, state, 5.0, command_rps=commands, current=current)[-1]
    direction = math.radians(towards_deg)
    along = 5.0 * speed * np.array([math.cos(direction), math.sin(direction), 0.0])
    np.testing.assert_allclose(carried[:3] - along, still[:3], atol=1e-11)
    np.testing.assert_allclose(carried[3:], still[3:], atol=1e-12)


def test_water_inside_the_nose_is_carried_where_it_is() -> None:
    """Water inside the hull is pushed along at its own centre as any other: nothing turns, and the
    drained part alone lags, by its low centre of gravity."""
    tide = Current(np.array([0.0, 10.0]), np.zeros(1), np.array([[[0.0, 0.0]], [[0.3, 1.0]]]))
    plain = m.block({"Y_vdot": -70.0}, entrained_kg=25.0)
    inside = replace(plain.rigid_body, entrained_cg_body_m=(0.33, -0.02, 0.01))
    flooded = replace(plain, rigid_body=inside)
    for attitude in ((0.0, 0.0, 0.0), (0.2, -0.3, 1.0)):
        rate = m.rates(flooded, m.state_of(flooded, attitude_rad=attitude), current=tide)
        np.testing.assert_allclose(rate[7:13], 0.0, atol=1e-15)
    neutral = m.alice()
    rate = m.rates(neutral, m.state_of(neutral), current=tide)
    low = neutral.rigid_body.dry_kg * neutral.rigid_body.cg_body_m[2]
    wrench = neutral.mass @ rate[7:13]
    np.testing.assert_allclose(wrench, [0, 0, 0, low * 0.1, -low * 0.03, 0], atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("vehicle", "seconds", "at_10_ms", "at_5_ms"),
    [(m.alice(), 20, 5e-6, 1e-6), (vehicle_from("alice"), 12, 2e-5, 5e-6)],
)
def test_runge_kutta_agrees_with_an_adaptive_method(
    vehicle: Vehicle, seconds: int, at_10_ms: float, at_5_ms: float
) -> None:
    """All thrusters at work, reversed at will every 4 s, pushes besides, in a current that changes
    with depth and time; positions in m, attitudes in rad, velocities in m/s and rad/s.

    In open water the largest error over a minute is 1.2e-6 at 10 ms, the simulator's step, and
    2.6e-7 at 5 ms. With all laws thrust has a kink where a propeller in a stream reverses (it falls
    by |n| u_a), so that the error hangs on how steps fall about each reversal: up to 1e-5 and 2e-6
    (3.4e-7 and 2.3e-8 without reversals); `benchmarks.vehicle --only accuracy` has the minute.
    """
    rng = np.random.default_rng(3)
    times = np.arange(0.0, seconds + 1.0, 4.0)
    commands = rng.uniform(-0.7, 0.9, (len(times) - 1, 5)) * np.array([40, 40, 30, 40, 40])
    loads = rng.uniform(-1, 1, (len(times) - 1, 6)) * np.array([3, 3, 3, 0.5, 0.5, 0.5])
    nu, attitude = np.array([0.3, -0.05, 0.04, 0.05, -0.03, 0.1]), (0.1, -0.05, 0.7)
    start = np.array([0.0, 0.0, 5.0, *attitude])
    eta, velocity, speeds = oracle.integrate(
        vehicle, m.SHEAR_AND_TIDE, start, nu, np.zeros(5), times, commands, loads
    )
    assert np.all(np.ptp(velocity, axis=0) > 0.05)
    truth = Rotation.from_matrix([oracle.ned_from_body(row[3:]) for row in eta])

    worst = []
    for step_s in (0.01, 0.005):
        rows = [m.state_of(vehicle, nu, attitude)]
        for i, time_s in enumerate(times[:-1]):
            rows.append(
                m.advance(
                    vehicle, rows[-1], 4.0, step_s, loads[i], m.SHEAR_AND_TIDE, time_s, commands[i]
                )[-1]
            )
        states = np.array(rows)
        errors = (
            np.abs(states[:, :3] - eta[:, :3]).max(),
            (m.rotations(states).inv() * truth).magnitude().max(),
            np.abs(states[:, 7:13] - velocity).max(),
            np.abs(states[:, 13:] - speeds).max(),
        )
        worst.append(max(errors))
    assert 1e-9 < worst[0] < at_10_ms
    assert 1e-10 < worst[1] < at_5_ms


def test_the_step_is_of_fourth_order() -> None:
    """Halving the step divides the error by 16, on a motion in which nothing changes sign."""
    vehicle = vehicle_from("alice")
    state = m.state_of(vehicle, np.array([0.6, 0.2, 0.15, 0.1, 0.1, 0.3]), (0.3, 0.2, 0.5))
    state[13:] = 20.0
    load = np.array([4.0, 9.0, 9.0, 1.5, 4.0, 9.0])
    commands = np.full(5, 40.0)

    def end(step_s: float) -> Array:
        return m.advance(vehicle, state, 0.64, step_s, load, m.SHEAR_AND_TIDE, 0.0, commands)[-1]

    best = end(0.00125)
    errors = [np.abs(end(step) - best).max() for step in (0.04, 0.02, 0.01)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all((orders > 3.7) & (orders < 4.4)), orders


def test_it_rises_slower_than_it_sinks_where_drag_differs() -> None:
    """At 1.277 times the drag upwards the terminal speed is 13 % less, as of the paper's ALICE."""
    vehicle = m.block({"Z_ww_pos": -200.0, "Z_ww_neg": -1.277 * 200.0, "Y_vv": -300.0})
    ends = [
        m.advance(vehicle, m.state_of(vehicle, position_ned=DEEP), 60.0, 0.02, newtons * m.W)[-1, 9]
        for newtons in (5.0, -5.0)
    ]
    assert ends[0] == pytest.approx(math.sqrt(5.0 / 200.0), rel=1e-6)
    assert ends[0] / -ends[1] == pytest.approx(1.13, abs=1e-3)
    turning = m.state_of(vehicle, np.array([0.3, -0.2, -0.4, 0.1, 0.2, -0.3]), (0.1, 0.2, 0.3))
    eta = np.concatenate([turning[:3], (0.1, 0.2, 0.3)])
    _, expected, _ = oracle.derivative(
        0.0, eta, turning[7:13], np.zeros(0), np.zeros(0), np.zeros(6), vehicle,
        m.constant_current(0.0, 0.0),
    )  # fmt: skip
    np.testing.assert_allclose(m.rates(vehicle, turning)[7:13], expected, atol=1e-12)


@pytest.mark.parametrize("held_up", ["by a push", "by thrusters"])
def test_it_comes_to_rest_at_the_surface(held_up: str) -> None:
    """A push upwards lifts the hull out by as much as the buoyancy that it loses there; thrusters
    that push it up lose their water as well: F (1 - dry) = dry B."""
    vehicle = vehicle_from("alice") if held_up == "by thrusters" else m.block({"Z_ww": -200.0})
    load, command = np.zeros(6), np.zeros(vehicle.actuators)
    if held_up == "by thrusters":
        up = vehicle.configuration_matrix[2] < -0.5
        down = vehicle.configuration_matrix[2] > 0.5
        command[up], command[down] = 15.0, -15.0
        assert np.any(up | down)
    else:
        load[2] = -50.0
    start = m.state_of(vehicle, position_ned=(0.0, 0.0, 0.5))
    states = m.advance(vehicle, start, 120.0, 0.01, load, command_rps=command)
    body, at = vehicle.plant.body, states[-4000:].mean(axis=0)
    dry = -at[2] / 0.2
    pushed_n = -load[2]
    if held_up == "by thrusters":
        pushes = np.zeros(6)
        add_thrust(vehicle.plant.propulsion, at[13:], np.zeros(6), pushes)
        pushed_n = -pushes[2] * (1.0 - dry)
    net_n = body.buoyancy_n - body.weight_n
    assert pushed_n > 1.0
    assert dry == pytest.approx((pushed_n + net_n) / body.buoyancy_n, rel=0.05)


@pytest.mark.parametrize(
    ("coefficients", "holds"), [("estimated", False), ("cfd", False), ("calibrated", True)]
)
def test_a_disturbed_course_follows_the_linear_equations(coefficients: str, holds: bool) -> None:
    """Ahead at 1 m/s, v and r alone, by hand: the Munk moment (m_x - m_y) u v drives the bow away,
    so that the bare hull does not hold its course. The calibrated set does, only since its X_udot
    exceeds its Y_vdot."""
    named = vehicle_from("alice", coefficients).coefficients.values
    kept = ("X_udot", "Y_vdot", "Y_rdot", "N_rdot", "Y_uv", "N_uv")
    vehicle = m.block({name: named[name] for name in kept}, entrained_kg=20.0)
    m_x, m_y = 70.0 - named["X_udot"], 70.0 - named["Y_vdot"]
    m_yr, i_z = -named["Y_rdot"], 7.0 - named["N_rdot"]
    inertia = np.array([[m_y, m_yr], [m_yr, i_z]])
    slopes = np.array([[named["Y_uv"], -m_x], [named["N_uv"] + m_x - m_y, -m_yr]])
    system = np.linalg.solve(inertia, slopes)
    assert bool(np.max(np.linalg.eigvals(system).real) < 0.0) is holds

    states = m.advance(vehicle, m.state_of(vehicle, m.U + 1e-7 * m.V), 6.0, 0.01)
    for i in (100, 300, 600):
        expected = expm(system * i * 0.01) @ [1e-7, 0.0]
        np.testing.assert_allclose(states[i, [8, 12]], expected, rtol=1e-5)


@pytest.mark.parametrize(("axis", "name"), [(0, "X_uu"), (1, "Y_vv"), (2, "Z_ww"), (5, "N_rr")])
def test_coasting_down_follows_the_hyperbola(axis: int, name: str) -> None:
    """m u' = X_uu u |u| from u_0: u = u_0 / (1 + |X_uu| u_0 t / m)."""
    added = {0: "X_udot", 1: "Y_vdot", 2: "Z_wdot", 5: "N_rdot"}[axis]
    vehicle = m.block({name: -15.0, added: -8.0}, entrained_kg=20.0)
    inertia = vehicle.mass[axis, axis]
    start = np.zeros(6)
    start[axis] = 0.9
    states = m.advance(vehicle, m.state_of(vehicle, start), 20.0, 0.01)
    time_s = np.arange(len(states)) * 0.01
    np.testing.assert_allclose(
        states[:, 7 + axis], 0.9 / (1.0 + 15.0 * 0.9 * time_s / inertia), rtol=1e-9
    )
    if axis < 3:
        run = inertia / 15.0 * np.log(1.0 + 15.0 * 0.9 * time_s / inertia)
        np.testing.assert_allclose(states[:, axis] - states[0, axis], run, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("coefficients", SETS)
@pytest.mark.parametrize("axis", [0, 1])
def test_small_roll_and_pitch_swing_like_a_pendulum(axis: int, coefficients: str) -> None:
    """Omega^2 = W BG (M^-1)_ii: with M^-1, as the body is free to sway and surge meanwhile."""
    vehicle = m.alice(coefficients)
    attitude = (1e-4, 0.0, 0.0) if axis == 0 else (0.0, 1e-4, 0.0)
    states = m.advance(vehicle, m.state_of(vehicle, attitude_rad=attitude), 30.0, 0.01)
    angle = m.attitudes(states)[:, axis]
    time_s = np.arange(len(angle)) * 0.01
    down = np.flatnonzero((angle[:-1] > 0) & (angle[1:] <= 0))
    crossings = time_s[down] + 0.01 * angle[down] / (angle[down] - angle[down + 1])
    low = vehicle.plant.body.weight_n * vehicle.rigid_body.cg_body_m[2]
    stiffness = low * np.linalg.inv(vehicle.mass)[3 + axis, 3 + axis]
    period = 2.0 * math.pi / math.sqrt(stiffness)
    assert len(crossings) >= 3
    np.testing.assert_allclose(np.diff(crossings), period, rtol=2e-4)
    # Damping of higher order leaves small swings nearly alone.
    assert 0.9e-4 < np.abs(angle[-round(period / 0.01) :]).max() <= 1.0001e-4


def test_a_vehicle_at_rest_takes_on_a_current_as_it_coasts_down() -> None:
    """Held over ground in 0.4 m/s abeam, then let go: v_r = v_0 / (1 + |Y_vv| v_0 t / m)."""
    vehicle = m.block({"Y_vv": -200.0, "Y_vdot": -70.0})
    current = m.constant_current(0.4, 90.0)
    states = m.advance(vehicle, m.state_of(vehicle, -0.4 * m.V), 60.0, 0.02, current=current)
    over_ground = m.rotations(states).apply(states[:, 7:10]) + 0.4 * np.eye(3)[1]
    lagging = 0.4 / (1.0 + 200.0 * 0.4 * np.arange(len(states)) * 0.02 / 120.0)
    np.testing.assert_allclose(over_ground[:, 1], 0.4 - lagging, atol=1e-9)
    np.testing.assert_allclose(over_ground[:, [0, 2]], 0.0, atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(attitude=st.tuples(st.floats(-3.0, 3.0), st.floats(-1.4, 1.4), st.floats(-3.0, 3.0)))
def test_a_balanced_vehicle_follows_water_that_speeds_up(
    attitude: tuple[float, float, float],
) -> None:
    """As heavy as the water it displaces and balanced, it moves as a drop of water: exactly."""
    vehicle = m.block(
        {"X_udot": -3.0, "Y_vdot": -70.0, "Z_wdot": -60.0, "Y_rdot": -9.0, "Y_vv": -200.0},
        entrained_kg=20.0,
    )
    tide = Current(
        np.array([0.0, 10.0, 20.0]),
        np.array([0.0, 10.0]),
        np.array([[[0.0, 0.0]] * 2, [[0.3, -0.1], [0.5, 0.1]], [[-0.2, 0.4], [0.0, 0.6]]]),
    )
    states = m.advance(
        vehicle, m.state_of(vehicle, attitude_rad=attitude), 20.0, 0.01, current=tide
    )
    np.testing.assert_allclose(states[:, 7:13], 0.0, atol=1e-13)
    # At 5 m, half way: (0.4, 0) after 10 s and (-0.1, 0.5) after 20 s, trapezoids between.
    np.testing.assert_allclose(states[-1, :3], [2.0 + 1.5, 2.5, 5.0], atol=1e-10)


def test_light_and_heavy_bodies_in_water_that_speeds_up() -> None:
    """(m + m_a) v' = (m_displaced + m_a) V': a bubble with m_a of half its displacement starts with
    three times the water's acceleration, a heavy body with hardly more than none (Batchelor, An
    Introduction to Fluid Dynamics, 1967, 6.8)."""
    tide = Current(np.array([0.0, 10.0]), np.zeros(1), np.array([[[0.0, 0.0]], [[1.0, 0.0]]]))
    half = {"X_udot": -25.0, "Y_vdot": -25.0, "Z_wdot": -25.0}
    for dry_kg, share in ((1e-9, 3.0), (50.0, 1.0), (100.0, 0.6), (7475.0, 0.01)):
        body = m.block(half, dry_kg=dry_kg)
        relative = m.rates(body, m.state_of(body), current=tide)[m.X]
        assert relative + 0.1 == pytest.approx(0.1 * share, rel=1e-9)


def test_sinking_through_shear_a_vehicle_lags_behind_the_current() -> None:
    """At a steady rate w of descent the current changes by V_z w: Y_vv v |v| = m_rigid V_z w.

    The added mass has no part in it, as the velocity relative to the water is steady.
    """
    vehicle = m.block(
        {"Y_vv": -200.0, "Z_ww": -200.0, "Y_vdot": -70.0, "Z_wdot": -70.0}, entrained_kg=10.0
    )
    shear = sheared_current(np.array([0.0, 1000.0]), np.array([[0.0, 90.0], [50.0, 90.0]]))
    states = m.advance(vehicle, m.state_of(vehicle), 120.0, 0.02, 8.0 * m.W, current=shear)
    sinking = math.sqrt(8.0 / 200.0)
    lagging = -math.sqrt(60.0 * 0.05 * sinking / 200.0)
    np.testing.assert_allclose(states[-1, 7:13], lagging * m.V + sinking * m.W, atol=1e-6)
