"""The prior towards the start: what it holds where a log says little, and leaves where it does."""

import math

import numpy as np
import pytest

from alice_survey.core.errors import VehicleError
from alice_survey.sim.vehicle.identification.output_error import (
    PriorSigmas,
    fit_output_error,
    prior_of,
    read_prior,
)
from alice_survey.sim.vehicle.identification.problem import free_parameters, make_windows
from alice_survey.sim.vehicle.vehicle import vehicle_from
from tests.alice_survey.sim.vehicle.identification.manoeuvres import Noise, fly, hidden, measured
from tests.oracles_navigation import jacobian

KNOWN = vehicle_from("alice")
QUICK_S = 0.05


def test_where_a_log_says_little_the_start_is_kept_and_where_much_the_log() -> None:
    """In 10 s of noise, linear and quadratic drag look alike: the log alone splits them badly."""
    truth = {"X_uu": -12.0, "X_u": -3.0, "N_rr": -70.0}
    start = {"X_uu": -14.0, "X_u": -4.0}
    flown = fly(
        hidden(truth), duration_s=10.0,
        asked=lambda time_s: np.array([25.0, 25.0 + 8.0 * np.sign(np.sin(time_s)), 0, 0, 0]),
    )  # fmt: skip
    parameters = free_parameters(hidden(start), ("X_uu", "X_u", "N_rr"))
    free, held = [], []
    for seed in range(4):
        noisy = measured(flown, np.random.default_rng(seed), Noise(velocity_mps=0.15))
        windows = make_windows(noisy, KNOWN)
        for fits, prior in ((free, None), (held, PriorSigmas())):
            fits.append(fit_output_error(windows, parameters, max_step_s=QUICK_S, prior=prior))
    off, off_held = (
        np.sqrt(np.mean([np.log(fit.values[1] / -3.0) ** 2 for fit in fits]))
        for fits in (free, held)
    )
    assert 0.3 < off < 1.5
    assert 0.02 < off_held < 0.5 * off
    for alone, fit in zip(free, held, strict=True):
        # The turns say how fast the yaw is damped: there the prior is nothing next to the log.
        assert fit.values[2] == pytest.approx(alone.values[2], rel=0.01)
        share = np.diag(fit.prior_covariance) / np.diag(fit.covariance)
        assert share[2] < 0.01
        assert 0.2 < share[1] < 0.8
        assert not fit.at_bound.any()


def test_what_has_a_prior_and_how_wide() -> None:
    log = fly(KNOWN, duration_s=10.0)
    names = ("X_uu", "X_u", "K_v", "Y_uv", "X_udot", "gain_X", "current")
    known = hidden({"X_u": 0.0, "K_v": 0.0, "K_vv": 0.0})
    parameters = free_parameters(known, names)
    windows = make_windows(log, KNOWN)
    prior = prior_of(parameters, windows, PriorSigmas())
    assert prior is not None
    speed = math.sqrt(np.mean(log.velocity_body[:, 0] ** 2))
    values = known.coefficients.values
    expected = [0.5, 0.5 * abs(values["X_uu"]) * speed, math.inf]
    np.testing.assert_allclose(prior.sigma[:3], expected, rtol=1e-6)
    assert prior.sigma[3] == pytest.approx(0.5 * abs(values["Y_uv"]))
    assert prior.sigma[4:6].tolist() == [0.3, 1.0]
    assert np.isinf(prior.sigma[6:]).all()
    assert prior.logarithmic.tolist() == [True, False, False, False, True, True, False, False]
    at = parameters.start * 1.3
    at[1] = -0.5
    slope = np.diag(jacobian(lambda change: prior.residuals(at + change), len(at), 1e-6))
    np.testing.assert_allclose(prior.slopes(at), slope, rtol=1e-5, atol=1e-9)
    assert prior.residuals(at)[0] == pytest.approx(math.log(1.3) / 0.5)
    assert prior_of(parameters, windows, None) is None
    assert prior_of(free_parameters(known, ("current",)), windows, PriorSigmas()) is None


def test_priors_are_read() -> None:
    assert read_prior("none") is None
    assert read_prior("") == PriorSigmas()
    assert read_prior("0.2") == PriorSigmas(damping=0.2, added_mass=0.2, lift=0.2, gain=0.2)
    for wrong in ("wide", "0.5,0.2", "0", "nan", "-1"):
        with pytest.raises(VehicleError):
            read_prior(wrong)
