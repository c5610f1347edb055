"""Gains: where they put the poles, by the rule and on the linearised vehicle."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alice_survey.core.config import COEFFICIENTS as SETS
from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.dynamics import Body, add_coriolis, add_damping
from alice_survey.sim.vehicle.pilot import gains as g
from alice_survey.sim.vehicle.vehicle import Vehicle, vehicle_from
from tests.alice_survey.sim.vehicle import motions as m
from tests.alice_survey.sim.vehicle.pilot.pilot_runs import gains_of
from tests.oracles_navigation import jacobian

AXES = [("alice", axis) for axis in range(4)] + [("sparus2", axis) for axis in (0, 2, 3)]


@given(lag_s=st.floats(0.02, 3.0), decay_per_s=st.floats(0.0, 3.0), fastest=st.floats(0.1, 30.0))
@settings(deadline=None)
def test_poles_lie_where_they_are_placed(lag_s: float, decay_per_s: float, fastest: float) -> None:
    omega, rate, place = g.place_poles(lag_s, decay_per_s, fastest)
    if rate == 0.0:  # the water damps more than was wanted
        assert lag_s * (2 * omega * (1 / lag_s + decay_per_s - 2 * omega) + omega**2) <= decay_per_s
        return
    polynomial = [lag_s, 1.0 + lag_s * decay_per_s, decay_per_s + rate, place]
    real = 1 / lag_s + decay_per_s - 2 * omega
    # (s + real)(s + omega)^2, the damping ratio being 1.
    wanted = lag_s * np.polymul([1.0, real], [1.0, 2 * omega, omega**2])
    np.testing.assert_allclose(polynomial, wanted, rtol=1e-9, atol=1e-12)
    assert omega <= fastest * (1 + 1e-12)
    assert real >= omega * (1 - 1e-9)


@pytest.mark.parametrize(("name", "axis"), AXES)
def test_each_loop_is_damped_with_lag_integral_and_any_drag(name: str, axis: int) -> None:
    row = gains_of(name).axes[axis]
    # From no drag at all to what the axis meets at its greatest speed.
    nu = np.zeros(6)
    nu[g.DEGREES[axis]] = row[g.FASTEST] if axis else 0.3
    maximum = (
        g.linear_damping(gains_of(name).body, nu)[g.DEGREES[axis], g.DEGREES[axis]] / row[g.MASS]
    )
    for decay in np.linspace(0.0, maximum, 5):
        damped = [row[g.LAG], 1 + row[g.LAG] * decay, decay + row[g.RATE]]
        poles = np.roots([*damped, row[g.PLACE], row[g.INTEGRAL]])
        assert np.all(poles.real < 0)
        assert np.min(-poles.real / np.abs(poles)) > 0.45
    undamped = np.roots([row[g.LAG], 1.0, row[g.RATE], row[g.PLACE], row[g.INTEGRAL]])
    # Bounds on both sides: neither sluggish nor faster than the thrusters.
    assert 0.05 * row[g.BANDWIDTH] < np.min(np.abs(undamped)) < row[g.BANDWIDTH]
    assert np.max(np.abs(undamped)) < 1.2 / row[g.LAG]


def _slope(add: Callable[[Body, Array, Array], None], body: Body, nu: Array, step: float) -> Array:
    """(6, 6) slope of a force by velocity, by differences."""

    def force(change: Array) -> Array:
        made = np.zeros(6)
        add(body, nu + change, made)
        return made

    return jacobian(force, 6, step)


def _lateral_slopes(body: Body, nu: Array) -> Array:
    """(2, 2) slope of the acceleration of sway and yaw by both."""
    two = np.ix_([1, 5], [1, 5])
    slope = _slope(add_damping, body, nu, 1e-6) + _slope(add_coriolis, body, nu, 1e-6)
    return np.array(np.linalg.inv(body.mass[two]) @ slope[two])


def _whole_loop(gains: g.Gains, drift_mps: float, lag_scale: float) -> Array:
    """Closed loop of sway and yaw, coupled by the full model, slopes by differences.

    States: sway place, heading, sway, yaw rate, and the two lagging accelerations.
    """
    loop = np.zeros((6, 6))
    loop[0, [1, 2]] = 0.2, 1.0
    loop[1, 3] = 1.0
    loop[2:4, 2:4] = _lateral_slopes(gains.body, np.array([0.2, drift_mps, 0.0, 0.0, 0.0, 0.0]))
    # What feed-forward knows of inertia is exact: wanted accelerations come, after their lag.
    loop[2:4, 4:6] = np.eye(2)
    for i, axis in enumerate((g.SWAY, g.YAW)):
        row = gains.axes[axis]
        lag_s = lag_scale * row[g.LAG]
        loop[4 + i, i], loop[4 + i, 2 + i] = -row[g.PLACE] / lag_s, -row[g.RATE] / lag_s
        loop[4 + i, 4 + i] = -1.0 / lag_s
        if axis == g.SWAY:  # sway is fed the lateral part of the path's speed
            loop[4 + i, 1] -= row[g.RATE] * 0.2 / lag_s
    return loop


def test_sway_and_yaw_together_are_damped() -> None:
    for drift_mps in (0.0, 0.05, 0.1, 0.2):
        poles = np.linalg.eigvals(_whole_loop(gains_of("alice"), drift_mps, 1.0))
        assert np.all(poles.real < -0.1)
        assert np.min(-poles.real / np.abs(poles)) > 0.5
        assert np.max(np.abs(poles)) < 10.0
    for lag_scale in (0.5, 1.5, 2.0):
        poles = np.linalg.eigvals(_whole_loop(gains_of("alice"), 0.1, lag_scale))
        assert np.min(-poles.real / np.abs(poles)) > 0.3


@given(
    u=st.floats(-1.0, 1.0).filter(lambda u: abs(u) > 1e-3),
    v=st.floats(-0.5, 0.5),
    w=st.floats(-0.5, 0.5),
    r=st.floats(-0.5, 0.5),
)
@settings(deadline=None)
def test_slopes_are_those_of_the_forces(u: float, v: float, w: float, r: float) -> None:
    body = gains_of("alice").body
    nu = np.array([u, v, w, 0.0, 0.0, r])
    damping, coriolis = (_slope(add, body, nu, 1e-4) for add in (add_damping, add_coriolis))
    # The drag is piecewise quadratic: at a kink its slope is off by the step times the coefficient.
    np.testing.assert_allclose(g.linear_damping(body, nu), -damping, atol=0.1)
    np.testing.assert_allclose(g.linear_coriolis(body, nu), -coriolis, atol=1e-6)


@pytest.mark.parametrize("axis", range(4))
def test_authority_is_reached_and_not_exceeded_by_any_thrusts(axis: int) -> None:
    craft, rng = vehicle_from("alice"), np.random.default_rng(axis)
    matrix = craft.configuration_matrix[list(g.DEGREES)]
    upper = rng.uniform(10.0, 80.0, (matrix.shape[1],))
    lower = -rng.uniform(10.0, 40.0, (matrix.shape[1],))
    minimum, maximum = g.authority(matrix, lower, upper, axis)
    # Thrusts that push the other axes not at all form the null space of their rows: sample it.
    others = np.delete(matrix, axis, axis=0)
    null = np.linalg.svd(others)[2][np.linalg.matrix_rank(others) :].T
    draws = rng.standard_normal((20000, null.shape[1])) @ null.T
    draws[np.abs(draws) < 1e-12] = 1e-12
    room = np.where(draws > 0, upper / draws, lower / draws).min(axis=1)
    forces = (draws * room[:, None]) @ matrix[axis]
    assert minimum <= forces.min() + 1e-6
    assert maximum >= forces.max() - 1e-6
    assert forces.max() > 0.9 * maximum
    assert forces.min() < 0.9 * minimum


def _coupled_loop(body: Body, speed_mps: float, row: Array) -> Array:
    """Heading, sway, yaw rate, lag and integral; slopes of the kernels' forces by differences."""
    inverse = np.linalg.inv(body.mass[np.ix_([1, 5], [1, 5])])
    loop = np.zeros((5, 5))
    loop[0, 1] = loop[1, 3] = 1.0
    loop[2:4, 2:4] = _lateral_slopes(body, np.array([speed_mps, 0.0, 0.0, 0.0, 0.0, 0.0]))
    loop[2:4, 4] = inverse @ [0.0, row[g.MASS]]
    loop[4] = np.array([-row[g.INTEGRAL], -row[g.PLACE], 0.0, -row[g.RATE], -1.0]) / row[g.LAG]
    return loop


@pytest.mark.parametrize("name", ["alice", "sparus2"])
@pytest.mark.parametrize("coefficients", SETS)
@pytest.mark.parametrize("speed_mps", [0.1, 0.2, 0.5, 1.0])
def test_heading_is_damped_with_the_sway_that_it_brings(
    name: str, coefficients: str, speed_mps: float
) -> None:
    craft = vehicle_from(name, coefficients)
    if name == "sparus2" and speed_mps == 1.0:
        with pytest.raises(VehicleError, match="1 m/s"):
            g.gains_for(craft, speed_mps)
        return
    gains = g.gains_for(craft, speed_mps)
    poles = np.linalg.eigvals(_coupled_loop(gains.body, speed_mps, gains.axes[g.YAW]))
    ratio = np.min(-poles.real / np.abs(poles))
    # Only the slow thrusters of SPARUS II at speed give less than is wanted.
    minimum = g.MIN_HEADING_DAMPING if (name, speed_mps) == ("sparus2", 0.5) else g.HEADING_DAMPING
    assert minimum - 1e-4 <= ratio < 0.95
    oscillating = np.abs(poles[np.abs(poles.imag) > 1e-9])
    assert np.all(oscillating < 2 * math.pi * 5.0 / g.MIN_SAMPLES_PER_PERIOD)
    # Neither sluggish, nor faster than the thrusters.
    assert np.min(np.abs(poles)) > 0.01
    assert np.max(np.abs(poles)) < 1.2 / gains.axes[g.YAW, g.LAG]
    slower = _coupled_loop(gains.body, 0.5 * speed_mps, gains.axes[g.YAW])
    assert g.damping_ratio(slower) > g.MIN_HEADING_DAMPING - g.PASSING_DAMPING


@pytest.mark.parametrize(("name", "lost"), [("alice", "vertical"), ("sparus2", "port")])
def test_a_vehicle_that_cannot_be_controlled_is_refused(name: str, lost: str) -> None:
    with pytest.raises(VehicleError):
        g.gains_for(vehicle_from(name).weaken({lost: 0.0}), 0.2)


@pytest.mark.parametrize(("name", "axis"), AXES)
def test_greatest_speed_takes_three_quarters_of_the_force(name: str, axis: int) -> None:
    gains = gains_of(name)
    row, nu, force = gains.axes[axis], np.zeros(6), np.zeros(6)
    nu[g.DEGREES[axis]] = row[g.FASTEST]
    add_damping(gains.body, nu, force)
    share = -force[g.DEGREES[axis]] / min(-row[g.MIN_FORCE], row[g.MAX_FORCE])
    if axis == g.YAW and row[g.FASTEST] == pytest.approx(math.radians(30.0)):
        assert share < g.STEADY_SHARE  # bounded by the rate, not by the thrusters
    else:
        assert share == pytest.approx(g.STEADY_SHARE, rel=1e-9)


def test_without_lateral_thrusters_sway_has_no_gains() -> None:
    row = gains_of("sparus2").axes[g.SWAY]
    assert row[g.MASS] > 0
    assert not np.any(row[[g.RATE, g.PLACE, g.INTEGRAL, g.FASTEST]])


@pytest.mark.parametrize("name", ["alice", "sparus2"])
@pytest.mark.parametrize("decay_share", [0.0, 0.5, 1.0])
def test_a_wanted_speed_is_not_overshot(name: str, decay_share: float) -> None:
    """Of the linear loop; with less drag than is fed forward, too."""
    from scipy.signal import step

    row, body = gains_of(name).axes[g.SURGE], gains_of(name).body
    decay = g.linear_damping(body, np.array([0.2, 0, 0, 0, 0, 0]))[0, 0] / row[g.MASS]
    plant = [row[g.LAG], 1 + row[g.LAG] * decay * decay_share, decay * decay_share + row[g.RATE]]

    def overshoot(weight: float) -> float:
        top = [row[g.RATE] * weight + decay * decay_share, row[g.PLACE]]
        _, out = step((top, [*plant, row[g.PLACE]]), N=4000)
        return float(out.max()) - 1.0

    assert overshoot(row[g.WEIGHT]) < 0.05
    assert overshoot(1.0) > 0.1
    assert 0.0 < row[g.WEIGHT] < 0.5


def test_a_lost_lateral_thruster_makes_sway_as_slow_as_the_pair_that_helps_it() -> None:
    whole, lame = vehicle_from("alice"), vehicle_from("alice").weaken({"bow": 0.0})
    slow = g.gains_for(lame, 0.2).axes[g.SWAY]
    assert slow[g.LAG] > 2.0 * g.gains_for(whole, 0.2).axes[g.SWAY, g.LAG]
    assert slow[g.LAG] < 0.85


def growth(craft: Vehicle, speed_mps: float) -> float:
    """Fastest growth of heave, pitch rate and pitch, by differences of the equations of motion.

    Surge is held: its acceleration is cancelled by a force.
    """

    def slopes(motion: Array) -> Array:
        heave, turn, pitch = motion
        nu = np.array([speed_mps, 0.0, heave, 0.0, turn, 0.0])
        state = m.state_of(craft, nu, (0.0, pitch, 0.0))
        free, pushed = (m.rates(craft, state, push * m.U)[7:13] for push in (0.0, 1.0))
        slope = pushed - free
        return np.append((free - slope * free[0] / slope[0])[[2, 4]], turn)

    return float(np.linalg.eigvals(jacobian(slopes, 3, 1e-6)).real.max())


@pytest.mark.parametrize("name", ["alice", "sparus2"])
@pytest.mark.parametrize("coefficients", SETS)
def test_pitch_grows_above_that_speed_and_fades_below(name: str, coefficients: str) -> None:
    craft = vehicle_from(name, coefficients)
    speed_mps = g.pitch_divergence_speed_mps(craft)
    if coefficients == "calibrated":
        assert speed_mps == math.inf
        assert growth(craft, 1.0) < 0.0
        assert growth(craft, 3.0) < 0.0
        return
    assert growth(craft, 0.97 * speed_mps) < 0.0 < growth(craft, 1.03 * speed_mps)


def test_speeds_of_alice_are_the_documented_ones() -> None:
    speeds = [g.pitch_divergence_speed_mps(vehicle_from("alice", each)) for each in SETS]
    assert speeds == pytest.approx([0.316, 0.248, math.inf, 0.259], abs=0.0006)
