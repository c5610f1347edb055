"""The joint fit on logs simulated with hidden coefficients."""

import numpy as np
import pytest

from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.identification import output_error as fits
from alice_survey.sim.vehicle.identification.problem import free_parameters, make_windows, unit_of
from alice_survey.sim.vehicle.log import VehicleLog
from alice_survey.sim.vehicle.vehicle import vehicle_from
from tests.alice_survey.sim.vehicle.identification.manoeuvres import fly, hidden, measured

KNOWN = vehicle_from("alice")
DAMPING = ("X_uu", "Y_vv", "Z_ww", "N_rr")
QUICK_S = 0.05


def fitted(
    log: VehicleLog, free: tuple[str, ...], window_s: float | None = None
) -> fits.OutputErrorFit:
    windows = make_windows(log, KNOWN, window_s=window_s)
    return fits.fit_output_error(windows, free_parameters(KNOWN, free), max_step_s=QUICK_S)


def test_hidden_coefficients_and_current_are_recovered() -> None:
    truth = {
        "X_uu": -11.0, "Y_vv": -240.0, "Z_ww": -410.0, "N_rr": -75.0, "N_vv": -3.5,
        "X_udot": -12.0, "Y_vdot": -45.0, "Z_wdot": -40.0, "N_rdot": -8.0,
    }  # fmt: skip
    current = (0.13, -0.08)
    log = measured(fly(hidden(truth), duration_s=60.0, current=current), np.random.default_rng(5))
    fit = fitted(log, (*truth, "current"))
    found = dict(zip(fit.parameters.names, fit.values, strict=True))
    for name, value in truth.items():
        assert found[name] == pytest.approx(value, rel=0.05), name
    assert found["current_north_mps"] == pytest.approx(0.13, abs=0.01)
    assert found["current_east_mps"] == pytest.approx(-0.08, abs=0.01)
    # The noise is that of the sensors: DVL, gyro and attitude of `Noise`.
    np.testing.assert_allclose(fit.channel_sigma[:3], 0.01, rtol=0.15)
    np.testing.assert_allclose(fit.channel_sigma[3:6], 0.002, rtol=0.15)
    np.testing.assert_allclose(fit.channel_sigma[6:], 0.003, rtol=0.15)
    assert not fit.at_bound.any()


def test_drag_that_differs_up_and_down_is_told_apart() -> None:
    """The paper's ALICE rises 13 % slower than one Z_ww has it: 1.13^2 times the drag."""
    down = KNOWN.coefficients.values["Z_ww"]
    truth = {"Z_ww_pos": down, "Z_ww_neg": 1.277 * down}
    log = measured(fly(hidden(truth), duration_s=60.0), np.random.default_rng(8))
    fit = fitted(log, tuple(truth))
    found = dict(zip(fit.parameters.names, fit.values, strict=True))
    for name, value in truth.items():
        assert found[name] == pytest.approx(value, rel=0.03), name
    assert np.all(np.abs(fit.values - np.array([*truth.values()])) < 5.0 * fit.sigma)
    assert unit_of("Z_ww_neg") == unit_of("Z_ww")
    again = fit.parameters.coefficients(fit.values, "found")
    assert again.quadratic[2, 2] == found["Z_ww_pos"]
    assert again.quadratic_back[2, 2] == found["Z_ww_neg"]
    with pytest.raises(VehicleError, match="Z_ww stands for both ways"):
        free_parameters(KNOWN, ("Z_ww", "Z_ww_neg"))


@pytest.mark.slow
def test_sigmas_are_honest_over_many_logs() -> None:
    rng = np.random.default_rng(11)
    scores, damping, drift = [], [], []
    for _ in range(50):
        factors, current = rng.uniform(0.6, 1.6, 4), rng.uniform(-0.2, 0.2, 2)
        truth = {
            name: KNOWN.coefficients.values[name] * factor
            for name, factor in zip(DAMPING, factors, strict=True)
        }
        flown = fly(hidden(truth), duration_s=30.0, current=(current[0], current[1]))
        fit = fitted(measured(flown, rng), (*DAMPING, "current"))
        error = fit.values - np.array([*truth.values(), *current])
        scores.append(error / fit.sigma)
        damping.append(np.abs(error[:4] / np.array([*truth.values()])))
        drift.append(np.abs(error[4:]))
    assert np.max(damping) < 0.05
    assert np.max(drift) < 0.01
    score = np.array(scores)
    assert 0.75 < np.sqrt(np.mean(score**2)) < 1.3
    for each in np.sqrt(np.mean(score**2, axis=0)):
        assert 0.75 < each < 1.3


def test_unseen_pushes_widen_the_sigmas() -> None:
    scores = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        state = np.zeros(6)

        def push(rng: np.random.Generator = rng, state: Array = state) -> Array:
            # Gauss-Markov forces of 1.3 N and a moment of 0.4 N m, with 2 s of memory.
            state += -0.05 / 2.0 * state + np.array([0.3, 0.3, 0.3, 0, 0, 0.1]) * rng.normal(size=6)
            return state.copy()

        log = measured(fly(hidden({}), duration_s=60.0, push=push), rng)
        fit = fitted(log, DAMPING, window_s=6.0)
        error = fit.values - fit.parameters.start
        scores.append(error / fit.sigma)
    assert 0.6 < np.sqrt(np.mean(np.square(scores))) < 2.0


def test_parameters_that_a_log_does_not_determine_are_named() -> None:
    rest = fly(hidden({}), duration_s=5.0, asked=lambda time_s: np.zeros(5))
    with pytest.raises(VehicleError, match="X_uu, gain_X"):
        fitted(measured(rest, np.random.default_rng(0)), ("X_uu", "gain_X"))
    straight = fly(
        hidden({}), duration_s=10.0, asked=lambda time_s: np.array([20.0, 20.0, 0, 0, 0])
    )
    with pytest.raises(VehicleError, match=r"current_.*bias_"):
        fitted(straight, ("current", "bias_u_mps", "bias_v_mps", "bias_w_mps"))


@pytest.mark.parametrize(
    ("names", "named"),
    [
        (("X_zz",), "'X_zz'"),
        (("Y_rdot", "N_vdot"), "Y_rdot.*N_vdot"),
        (("X_uu", "X_uu"), "X_uu"),
    ],
)
def test_wrong_names_are_refused(names: tuple[str, ...], named: str) -> None:
    with pytest.raises(VehicleError, match=named):
        free_parameters(KNOWN, names)
