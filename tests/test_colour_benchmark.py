"""The judge of the benchmark of colours: its formula, and what it says of known errors."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.colour import compared
from benchmarks.colour_difference import delta_e_2000, lab_from_rgb
from benchmarks.colour_peers import grey_world, sea_thru

PAIRS = np.loadtxt(Path(__file__).parent / "data" / "ciede2000_pairs.csv", delimiter=",")
"""Sharma, Wu and Dalal 2005, table 1: L*, a*, b* of two colours, and their difference."""


def test_differences_are_those_published() -> None:
    found = delta_e_2000(PAIRS[:, :3], PAIRS[:, 3:6])
    np.testing.assert_allclose(found, PAIRS[:, 6], atol=1e-4)
    np.testing.assert_allclose(delta_e_2000(PAIRS[:, 3:6], PAIRS[:, :3]), found, atol=1e-9)


def test_white_is_white_and_grey_has_no_colour() -> None:
    lab = lab_from_rgb(np.array([[1.0, 1.0, 1.0], [0.1841865, 0.1841865, 0.1841865]]))
    np.testing.assert_allclose(lab, [[100, 0, 0], [50, 0, 0]], atol=0.01)


def test_brightness_alone_is_forgiven_and_a_cast_is_not() -> None:
    true = np.random.default_rng(1).uniform(0.05, 0.6, (500, 3))
    assert compared(0.6 * true, true).median < 0.05
    assert compared(true * [1.0, 1.0, 1.3], true).median > 2.0
    shade = np.random.default_rng(2).uniform(0.7, 1.3, (500, 1))
    shaded = compared(true * shade, true)
    assert shaded.median > 2.0
    assert shaded.median_at_true_lightness < 1e-6


@pytest.mark.parametrize("peer", [grey_world, sea_thru])
def test_peers_take_a_cast_away(peer: object) -> None:
    rng = np.random.default_rng(3)
    ranges = [rng.uniform(1.0, 3.0) + 0.4 * np.indices((60, 80))[1] / 80 for _ in range(8)]
    albedo = [np.repeat(rng.uniform(0.02, 0.6, (60, 80, 1)), 3, axis=2) for _ in ranges]
    lost = np.array([0.2, 0.25, 0.5])
    shown = [
        j * np.exp(-lost * r[..., None]) + 0.05 * (1 - np.exp(-r[..., None] * [1.0, 0.9, 0.8]))
        for j, r in zip(albedo, ranges, strict=True)
    ]
    found = peer(shown, ranges)  # type: ignore[operator]
    casts = [np.log(p.mean(axis=(0, 1)) / p.mean()) for p in (shown, found) for p in p]
    before, after = np.abs(casts[:8]).max(axis=1), np.abs(casts[8:]).max(axis=1)
    assert np.median(after) < 0.4 * np.median(before)
