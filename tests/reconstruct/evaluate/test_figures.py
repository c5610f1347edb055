"""Doming and lengths give back what was put in, with sigmas that hold."""

import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from reconstruct.evaluate.figures import compare_lengths, fit_doming


def places(rng: np.random.Generator, count: int = 20_000) -> np.ndarray:
    return rng.uniform([-3, 5], [3, 9], (count, 2))


def test_the_height_of_a_dome_is_found_whatever_tilt_and_shift() -> None:
    xy = places(np.random.default_rng(1))
    radius2 = ((xy - [0, 7]) ** 2).sum(axis=1)
    flat = 0.3 + 0.02 * xy[:, 0] - 0.01 * xy[:, 1]
    found = fit_doming(xy, flat - 0.004 * radius2)
    # Blocks of medians end half a block before the edge.
    assert found.radius_m == pytest.approx(math.hypot(3, 2), rel=0.12)
    assert found.dome_m == pytest.approx(0.004 * found.radius_m**2, rel=0.02)
    assert fit_doming(xy, flat).dome_m == pytest.approx(0, abs=1e-6)
    bowl = fit_doming(xy, flat + 0.004 * radius2)
    assert bowl.dome_m == pytest.approx(-found.dome_m, rel=1e-3)


def test_a_trough_is_not_a_dome_but_is_reported() -> None:
    xy = places(np.random.default_rng(2))
    saddle = fit_doming(xy, 0.003 * ((xy[:, 0]) ** 2 - (xy[:, 1] - 7) ** 2))
    assert abs(saddle.dome_m) < 0.02 * 0.003 * saddle.radius_m**2
    assert abs(saddle.bend_m) == pytest.approx(0.003 * saddle.radius_m**2, rel=0.05)


def test_outliers_do_not_bend_a_model() -> None:
    rng = np.random.default_rng(3)
    xy = places(rng)
    errors = 0.001 * rng.normal(size=len(xy))
    wild = rng.random(len(xy)) < 0.1
    errors[wild] += rng.uniform(0, 0.5, wild.sum())
    assert abs(fit_doming(xy, errors).dome_m) < 0.001


def test_sigma_of_the_dome_holds_for_correlated_errors() -> None:
    xy = np.argwhere(np.ones((120, 120))).astype(np.float64) * 0.05
    ratios = []
    for seed in range(60):
        noise = gaussian_filter(np.random.default_rng(seed).normal(size=(120, 120)), 3)
        found = fit_doming(xy, 1e-3 * noise.ravel())
        ratios.append(found.dome_m / found.sigma_m)
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.4


def test_lengths_find_scale_and_noise_and_nothing_in_a_moved_model() -> None:
    rng = np.random.default_rng(4)
    true = rng.uniform(0, 5, (300, 3))
    turned = Rotation.random(rng=rng).apply(true) + np.array([10, -4, 2])
    exact = compare_lengths(turned, true, np.random.default_rng(5))
    assert abs(exact["scale_error_ppm"]) < 0.1
    assert exact["rms_mm"] == 0
    grown = compare_lengths(1.0005 * turned, true, np.random.default_rng(5))
    assert grown["scale_error_ppm"] == pytest.approx(500, abs=0.5)
    noisy = compare_lengths(true + 1e-3 * rng.normal(size=true.shape), true, rng)
    assert noisy["rms_mm"] == pytest.approx(math.sqrt(2), rel=0.1)
    assert compare_lengths(true[:2], true[:2], rng) == {}
