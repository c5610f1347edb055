"""Covariances by leaving out stretches, against straight lines fitted to known noise."""

import numpy as np
import pytest

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.identification import output_error as fits

ROWS, WINDOW = 2000, 50
NOTHING = np.zeros((2, 2))


def noise(rng: np.random.Generator, decay: float) -> Array:
    """A first-order process, (ROWS,), of unit variance."""
    values = rng.normal(size=ROWS)
    for i in range(1, ROWS):
        values[i] = decay * values[i - 1] + np.sqrt(1 - decay**2) * values[i]
    return values


def fitted(rng: np.random.Generator, decay: float) -> tuple[Array, fits.Stretches]:
    """Error of a level and of a factor on a slow motion, and what stretches of the log say."""
    slopes = np.column_stack([np.ones(ROWS), np.sin(np.arange(ROWS) / 40.0)])
    residuals = noise(rng, decay)
    error = -np.linalg.lstsq(slopes, residuals, rcond=None)[0]
    residuals = residuals + slopes @ error
    windows = [np.arange(WINDOW, dtype=float) for _ in range(ROWS // WINDOW)]
    number = np.concatenate(fits.stretch_numbers(windows))
    assert number.max() == 9
    return error, fits.in_stretches(residuals, slopes, number)


@pytest.mark.parametrize("decay", [0.0, 0.8, 0.95])
def test_errors_are_as_large_as_they_are_said_to_be(decay: float) -> None:
    rng = np.random.default_rng(1)
    scores, white, effects = [], [], []
    for _ in range(200):
        error, stretches = fitted(rng, decay)
        covariance = fits.jackknife_covariance(stretches, NOTHING)
        assert covariance is not None
        scores.append(error / np.sqrt(np.diag(covariance)))
        inverse = np.linalg.inv(stretches.information.sum(axis=0))
        white.append(error / np.sqrt(np.diag(inverse)))
        effects.append(fits.design_effect(stretches, NOTHING))
    rms, rms_white = (np.sqrt(np.mean(np.square(z))) for z in (scores, white))
    assert 0.85 < rms < 1.25
    # A process with this memory counts (1 + a) / (1 - a) times in its mean.
    counts = (1 + decay) / (1 - decay)
    assert rms_white**2 == pytest.approx(counts, rel=0.25)
    assert np.mean(effects) == pytest.approx(counts, rel=0.3)
    assert min(effects) >= 1.0


def test_stretches_keep_windows_whole_and_cut_a_single_one() -> None:
    windows = [np.linspace(0.0, 5.0, 51) for _ in range(41)]
    numbers = fits.stretch_numbers(windows)
    assert all(len(set(number.tolist())) == 1 for number in numbers)
    counts = np.bincount([number[0] for number in numbers])
    assert len(counts) == 10
    assert set(counts.tolist()) <= {4, 5}
    (whole,) = fits.stretch_numbers([np.linspace(0.0, 60.0, 601)])
    assert np.bincount(whole).tolist() == [60] * 9 + [61]
    many = np.array([n[0] for n in fits.stretch_numbers([np.linspace(0.0, 5.0, 51)] * 1000)])
    assert many.max() == 19
    few = [number[0] for number in fits.stretch_numbers([np.linspace(0.0, 5.0, 51)] * 6)]
    assert few == list(range(6))


def test_few_stretches_give_no_spread_and_a_prior_stays() -> None:
    _, stretches = fitted(np.random.default_rng(2), 0.8)
    few = fits.Stretches(scores=stretches.scores[:4], information=stretches.information[:4])
    assert fits.jackknife_covariance(few, NOTHING) is None
    assert fits.design_effect(few, NOTHING) == 1.0
    free = fits.jackknife_covariance(stretches, NOTHING)
    held = fits.jackknife_covariance(stretches, np.diag([1e6, 1e-6]))
    assert free is not None and held is not None
    # A parameter that the prior holds is not moved by noise; another is, as before.
    assert held[0, 0] < 1e-2 * free[0, 0]
    assert held[1, 1] == pytest.approx(free[1, 1], rel=0.3)
