"""The joint fit: hidden coefficients recovered, its prior, and covariances by stretches."""

import math

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2

from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.identification import output_error
from alice_survey.sim.vehicle.identification.problem import free_parameters, make_windows, unit_of
from alice_survey.sim.vehicle.log import VehicleLog
from alice_survey.sim.vehicle.vehicle import vehicle_from
from tests.alice_survey.sim.vehicle.identification.manoeuvres import Noise, fly, hidden, measured
from tests.oracles_navigation import jacobian

KNOWN = vehicle_from("alice")
DAMPING = ("X_uu", "Y_vv", "Z_ww", "N_rr")
QUICK_S = 0.05


def fitted(
    log: VehicleLog, free: tuple[str, ...], window_s: float | None = None
) -> output_error.OutputErrorFit:
    windows = make_windows(log, KNOWN, window_s=window_s)
    return output_error.fit_output_error(windows, free_parameters(KNOWN, free), max_step_s=QUICK_S)


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


@pytest.mark.slow
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


@pytest.mark.slow
def test_sigmas_are_honest_over_many_logs() -> None:
    rng = np.random.default_rng(11)
    scores, damping, drift = [], [], []
    for _ in range(20):
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
    squares = np.square(scores).sum(axis=0)
    low, high = (chi2.ppf(share, len(scores)) for share in (2e-4, 1.0 - 2e-4))
    assert np.all((squares > low) & (squares < high))
    assert 0.75 < np.sqrt(np.mean(np.square(scores))) < 1.3


@pytest.mark.slow
def test_unseen_pushes_widen_the_sigmas() -> None:
    scores = []
    for seed in range(5):
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
        (("Z_ww", "Z_ww_neg"), "Z_ww stands for both ways"),
    ],
)
def test_wrong_names_are_refused(names: tuple[str, ...], named: str) -> None:
    with pytest.raises(VehicleError, match=named):
        free_parameters(KNOWN, names)


@pytest.mark.slow
def test_the_start_counts_where_a_log_says_little(monkeypatch: pytest.MonkeyPatch) -> None:
    """In 10 s of noise, linear and quadratic drag look alike: the log alone splits them badly."""
    monkeypatch.setattr(output_error, "_CONFIRMED", -math.inf)  # the prior by itself
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
        for fits, prior in ((free, None), (held, output_error.PriorSigmas())):
            fits.append(
                output_error.fit_output_error(windows, parameters, max_step_s=QUICK_S, prior=prior)
            )
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
    prior = output_error.prior_of(parameters, windows, output_error.PriorSigmas())
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
    assert output_error.prior_of(parameters, windows, None) is None
    current = free_parameters(known, ("current",))
    assert output_error.prior_of(current, windows, output_error.PriorSigmas()) is None


def test_priors_are_read() -> None:
    assert output_error.read_prior("none") is None
    assert output_error.read_prior("") == output_error.PriorSigmas()
    assert output_error.read_prior("0.2") == output_error.PriorSigmas(
        damping=0.2, added_mass=0.2, lift=0.2, gain=0.2
    )
    for wrong in ("wide", "0.5,0.2", "0", "nan", "-1"):
        with pytest.raises(VehicleError):
            output_error.read_prior(wrong)


ROWS, WINDOW = 2000, 50
NOTHING = np.zeros((2, 2))


def noise(rng: np.random.Generator, decay: float) -> Array:
    """A first-order process, (ROWS,), of unit variance."""
    draws = rng.normal(size=ROWS)
    draws[1:] *= np.sqrt(1 - decay**2)
    return np.asarray(lfilter([1.0], [1.0, -decay], draws))


def line_fitted(rng: np.random.Generator, decay: float) -> tuple[Array, output_error.Stretches]:
    """Error of a level and of a factor on a slow motion, and what stretches of the log say."""
    slopes = np.column_stack([np.ones(ROWS), np.sin(np.arange(ROWS) / 40.0)])
    residuals = noise(rng, decay)
    error = -np.linalg.lstsq(slopes, residuals, rcond=None)[0]
    residuals = residuals + slopes @ error
    windows = [np.arange(WINDOW, dtype=float) for _ in range(ROWS // WINDOW)]
    number = np.concatenate(output_error.stretch_numbers(windows))
    assert number.max() == 9
    return error, output_error.in_stretches(residuals, slopes, number)


@pytest.mark.parametrize("decay", [0.0, 0.8, 0.95])
def test_errors_are_as_large_as_they_are_said_to_be(decay: float) -> None:
    rng = np.random.default_rng(1)
    scores, white, effects = [], [], []
    for _ in range(200):
        error, stretches = line_fitted(rng, decay)
        covariance = output_error.jackknife_covariance(stretches, NOTHING)
        assert covariance is not None
        scores.append(error / np.sqrt(np.diag(covariance)))
        inverse = np.linalg.inv(stretches.information.sum(axis=0))
        white.append(error / np.sqrt(np.diag(inverse)))
        effects.append(output_error.design_effect(stretches, NOTHING))
    rms, rms_white = (np.sqrt(np.mean(np.square(z))) for z in (scores, white))
    # The largest of two spreads: on the wide side.
    assert 0.7 < rms < 1.05
    # A process with this memory counts (1 + a) / (1 - a) times in its mean.
    counts = (1 + decay) / (1 - decay)
    assert rms_white**2 == pytest.approx(counts, rel=0.25)
    assert np.mean(effects) == pytest.approx(counts, rel=0.3)
    assert min(effects) >= 1.0


def test_stretches_keep_windows_whole_and_cut_a_single_one() -> None:
    windows = [np.linspace(0.0, 5.0, 51) for _ in range(41)]
    numbers = output_error.stretch_numbers(windows)
    assert all(len(set(number.tolist())) == 1 for number in numbers)
    counts = np.bincount([number[0] for number in numbers])
    assert len(counts) == 10
    assert set(counts.tolist()) <= {4, 5}
    (whole,) = output_error.stretch_numbers([np.linspace(0.0, 60.0, 601)])
    assert np.bincount(whole).tolist() == [60] * 9 + [61]
    many = output_error.stretch_numbers(windows[:1] * 1000)
    assert np.concatenate(many).max() == 19
    few = [number[0] for number in output_error.stretch_numbers(windows[:6])]
    assert few == list(range(6))


def test_few_stretches_give_no_spread_and_a_prior_stays() -> None:
    _, stretches = line_fitted(np.random.default_rng(2), 0.8)
    few = output_error.Stretches(scores=stretches.scores[:4], information=stretches.information[:4])
    assert output_error.jackknife_covariance(few, NOTHING) is None
    assert output_error.design_effect(few, NOTHING) == 1.0
    free = output_error.jackknife_covariance(stretches, NOTHING)
    held = output_error.jackknife_covariance(stretches, np.diag([1e6, 1e-6]))
    assert free is not None and held is not None
    # A parameter that the prior holds is not moved by noise; another is, as before.
    assert held[0, 0] < 1e-2 * free[0, 0]
    assert held[1, 1] == pytest.approx(free[1, 1], rel=0.3)
