"""Simulation of a window and its derivatives, against solvers and differences."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from alice_survey.core.frames import Array, rotation_from_attitude
from alice_survey.sim.vehicle.identification import sensitivity
from alice_survey.sim.vehicle.identification.problem import Parameters, free_parameters
from alice_survey.sim.vehicle.vehicle import vehicle_from
from tests.oracles_identification import integrated
from tests.oracles_navigation import jacobian

ALL = (
    "X_u", "K_p", "N_r", "X_uu", "Y_vv", "Z_ww_pos", "Z_ww_neg", "M_qq", "N_rr", "N_vv", "Y_uv",
    "Z_uw", "M_uw", "N_uv", "X_udot", "Y_vdot", "Y_rdot", "M_wdot", "K_pdot", "N_rdot", "current",
    "buoyancy", "trim", "bias", "gain",
)  # fmt: skip
ROWS, STEP_S = 41, 0.05


def a_record(rng: np.random.Generator) -> sensitivity.Record:
    time_s = np.arange(ROWS, dtype=float) * STEP_S
    attitude = rotation_from_attitude(
        0.1 * np.sin(time_s), 0.1 * np.cos(time_s), 0.5 + 0.2 * time_s
    ).as_quat()
    acceleration = np.zeros((ROWS, 6))
    acceleration[:, 3] = np.cos(2 * time_s)
    rps = rng.uniform(-30, 30, (ROWS, 5))
    return sensitivity.Record(time_s, rps, rng.normal(size=(ROWS, 6)), attitude, acceleration)


def run(
    parameters: Parameters,
    values: Array,
    record: sensitivity.Record,
    start: Array,
    *,
    given: tuple[int, ...] = (),
    slopes: bool = True,
    step_s: float = STEP_S,
) -> tuple[Array, Array, Array]:
    physics = sensitivity.with_given(parameters.physics(values), given)
    return sensitivity.simulate(
        physics, parameters.terms if slopes else None, record, start, step_s
    )


def a_start() -> Array:
    quaternion = rotation_from_attitude(0.2, -0.15, 0.6).as_quat()
    return np.concatenate([quaternion, [0.6, -0.2, 0.1, 0.1, -0.05, 0.2]])


def a_case() -> tuple[Parameters, Array, sensitivity.Record, Array]:
    parameters = free_parameters(vehicle_from("alice"), ALL)
    rng = np.random.default_rng(4)
    values = parameters.start * rng.uniform(0.8, 1.2, len(parameters.names))
    for name, value in (
        ("current_north_mps", 0.2), ("current_east_mps", -0.1), ("bias_v_mps", 0.02), ("X_u", -3.0),
        ("N_r", -2.0), ("trim_x_m", 0.004), ("net_buoyancy_n", 2.0),
    ):  # fmt: skip
        values[parameters.names.index(name)] = value
    return parameters, values, a_record(rng), a_start()


def test_a_window_is_what_the_simulators_equations_give() -> None:
    truth = vehicle_from("alice")
    parameters = free_parameters(truth, ("X_uu",))
    rps, load = np.array([25.0, -10.0, 12.0, 30.0, -20.0]), np.array([3.0, -2, 4, 0.1, 0.5, -1])
    time_s = np.arange(201.0) * STEP_S
    record = sensitivity.Record(
        time_s, np.tile(rps, (201, 1)), np.tile(load, (201, 1)), np.tile(a_start()[:4], (201, 1)),
        np.zeros((201, 6)),
    )  # fmt: skip
    exact = integrated(truth, a_start(), rps, time_s, load)
    fine = run(parameters, parameters.start, record, a_start(), slopes=False, step_s=0.01)[0]
    coarse = run(parameters, parameters.start, record, a_start(), slopes=False, step_s=0.05)[0]
    np.testing.assert_allclose(fine, exact, rtol=0, atol=2e-6)
    error, finer = np.abs(coarse - exact).max(), np.abs(fine - exact).max()
    # Of fourth order: a step five times as long has some 625 times the error.
    assert 200 < error / finer < 2000


@pytest.mark.parametrize("given", [(), (3, 4)])
def test_sensitivities_are_the_slopes_of_the_simulation(given: tuple[int, ...]) -> None:
    parameters, values, record, start = a_case()
    derivatives = run(parameters, values, record, start, given=given)[2]
    size = np.maximum(np.abs(values), 0.1)

    def outputs(change: Array) -> Array:
        moved = values + size * change
        return run(parameters, moved, record, start, given=given, slopes=False)[1]

    differences = np.moveaxis(jacobian(outputs, len(values)), 1, 2) / size
    for k, name in enumerate(parameters.names):
        scale = max(np.abs(differences[:, :, k]).max(), 1e-3)
        error = (derivatives[:, :, k] - differences[:, :, k]) / scale
        np.testing.assert_allclose(error, 0.0, atol=2e-5, err_msg=name)


def test_sensitivities_to_the_start_are_slopes_too() -> None:
    parameters, values, record, start = a_case()
    derivatives = run(parameters, values, record, start)[2][:, :, len(values) :]

    def outputs(change: Array) -> Array:
        turned = Rotation.from_quat(start[:4]) * Rotation.from_rotvec(change[:3])
        moved = np.concatenate([turned.as_quat(), start[4:] + change[3:]])
        return run(parameters, values, record, moved, slopes=False)[1]

    differences = np.moveaxis(jacobian(outputs, sensitivity.START, 1e-6), 1, 2)
    np.testing.assert_allclose(derivatives, differences, atol=2e-6)


def test_a_lagging_thruster_is_followed_exactly_between_rows() -> None:
    truth = vehicle_from("alice")
    parameters = free_parameters(truth, ("X_uu",))
    lag = np.array([t.time_constant_s for t in truth.thrusters])
    coarse_s, fine_s = np.arange(11.0) * 0.2, np.arange(201.0) * 0.01
    asked = np.array([30.0, 10.0, -20.0, 40.0, -40.0])

    def record(time_s: Array) -> sensitivity.Record:
        rps = asked * (1 - np.exp(-time_s[:, None] / lag))
        rows = len(time_s)
        attitude = np.tile(a_start()[:4], (rows, 1))
        return sensitivity.Record(time_s, rps, np.zeros((rows, 6)), attitude, np.zeros((rows, 6)))

    values = parameters.start
    few = run(parameters, values, record(coarse_s), a_start(), slopes=False, step_s=0.01)[0]
    many = run(parameters, values, record(fine_s), a_start(), slopes=False, step_s=0.01)[0]
    np.testing.assert_allclose(few, many[::20], atol=1e-7)


def test_a_given_motion_follows_the_log() -> None:
    parameters, values, record, start = a_case()
    states = run(parameters, values, record, start, given=(3,))[0]
    wanted = start[7] + np.concatenate([[0], np.cumsum(record.acceleration[:-1, 3])]) * STEP_S
    np.testing.assert_allclose(states[:, 7], wanted, atol=1e-9)
