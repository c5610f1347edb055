"""Noise of channels: its size and correlation."""

import numpy as np
import pytest

from alice_survey.sim.vehicle.identification.noise import (
    autocovariance,
    correlated_information,
    noise_sigma,
)
from tests.oracles_identification import dense_information


def test_noise_is_found_under_a_smooth_motion() -> None:
    rng = np.random.default_rng(1)
    time_s = np.arange(4000) * 0.05
    series = 2 * np.sin(0.3 * time_s) + rng.normal(0, 0.02, 4000)
    series[1000] = 50.0
    series[::7] = np.nan
    assert noise_sigma(series) == pytest.approx(0.02, rel=0.05)
    assert np.isnan(noise_sigma(np.full(10, np.nan)))


def test_a_process_is_known_by_its_autocovariance() -> None:
    rng = np.random.default_rng(3)
    decay = 0.9
    runs = []
    for _ in range(4):
        series = np.empty(5000)
        series[0] = rng.normal() / np.sqrt(1 - decay**2)
        for i in range(1, 5000):
            series[i] = decay * series[i - 1] + rng.normal()
        runs.append(series)
    lags = autocovariance(runs)
    expected = decay ** np.arange(30) / (1 - decay**2)
    np.testing.assert_allclose(lags[:30], expected, rtol=0.25, atol=0.1 * expected[0])
    assert lags.sum() == pytest.approx(np.sum(decay ** np.arange(200)) / (1 - decay**2), rel=0.2)


@pytest.mark.parametrize("count", [1, 6, 60])
def test_information_is_that_of_the_written_out_matrix(count: int) -> None:
    rng = np.random.default_rng(4)
    lags = 0.8 ** np.arange(count, dtype=float)
    runs = [rng.normal(size=(rows, 3)) for rows in (40, 25)]
    expected = sum(dense_information(run, lags) for run in runs)
    np.testing.assert_allclose(correlated_information(runs, lags), expected, rtol=1e-10, atol=1e-9)
