"""Known backscatter and attenuation, and whether two views of each spot determine them."""

import numpy as np
import pytest

from reconstruct.light.solve import GRID, LightSamples
from reconstruct.light.water import growth_at, solve_water

CAMERAS = ["left"] * 12 + ["right"] * 12
FALL_OFF = np.array([0.8, 0.5, 0.7])
GROWTH = np.array([0.9, 0.6, 0.8])
MIDDLE_M = 2.0
NODE_X, NODE_Y = np.meshgrid(np.linspace(0, 1, GRID[1]), np.linspace(0, 1, GRID[0]))


def veil(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Light that the water adds at the middle range."""
    return (0.05 + 0.08 * (x - 0.5) ** 2 + 0.02 * y)[..., None] * [1.2, 1.0, 0.5]


def direct(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Of a white floor at the middle range."""
    return np.exp(-1.2 * ((x - 0.5) ** 2 + (y - 0.5) ** 2))[..., None] * [0.6, 1.0, 0.9]


def survey(
    low_m: float, high_m: float, *, spread: float = 2.0, shade: float = 0.05, hue: float = 0.15
) -> tuple[LightSamples, dict[str, np.ndarray]]:
    """Spots at ranges of their own; slopes shade views in all channels alike."""
    rng = np.random.default_rng(8)
    count = 12_000
    views = rng.integers(0, len(CAMERAS), (count, 2))
    views = views[views[:, 0] != views[:, 1]].astype(np.int32)
    count = len(views)
    places = rng.uniform(0, 1, (count, 2, 2))
    ranges = rng.uniform(low_m, high_m, (count, 2))
    albedo = rng.uniform(0.08, 0.5, (count, 1, 1)) * np.exp(rng.normal(0, hue, (count, 1, 3)))
    x, y = places[..., 0], places[..., 1]
    light = albedo * direct(x, y) * np.exp(-(ranges - MIDDLE_M)[..., None] * FALL_OFF)
    light *= ((MIDDLE_M / ranges) ** spread)[..., None]
    light *= np.exp(rng.normal(0, shade, (count, 2, 1)))
    light += veil(x, y) * growth_at(GROWTH, ranges, MIDDLE_M)
    light *= np.exp(rng.normal(0, 0.004, light.shape))
    known = {"places": places, "levels": np.log(light), "ranges": ranges}
    samples = LightSamples(views=views, **{k: v.astype(np.float32) for k, v in known.items()})
    # the darkest spots send light of their own
    dark = veil(NODE_X, NODE_Y) + 0.05 * direct(NODE_X, NODE_Y)
    return samples, {"left": dark, "right": dark}


@pytest.mark.parametrize("spread", [0.0, pytest.param(2.0, marks=pytest.mark.slow)])
def test_water_is_found_under_a_lamp_and_in_daylight(spread: float) -> None:
    samples, dark = survey(1.2, 3.0, spread=spread)
    found = solve_water(samples, dark, CAMERAS)
    # errors of lightness, which channels share, leave their differences alone
    assert (found.fall_off_sigma > found.to_green_sigma).all()
    apart = FALL_OFF - FALL_OFF[1]
    np.testing.assert_allclose(found.fall_off - found.fall_off[1], apart, atol=0.05)
    assert abs(found.spread - spread) < 0.5
    for name in ("left", "right"):
        wrong = found.added[name] / veil(NODE_X, NODE_Y) - 1.0
        assert np.abs(wrong).mean() < 0.1
        assert np.abs(dark[name] / veil(NODE_X, NODE_Y) - 1.0).mean() > 0.3


@pytest.mark.slow
def test_errors_of_fall_off_are_as_large_as_stated() -> None:
    samples, dark = survey(1.5, 2.6)
    found = solve_water(samples, dark, CAMERAS)
    apart = found.fall_off - found.fall_off[1] - (FALL_OFF - FALL_OFF[1])
    assert (np.abs(apart[[0, 2]]) < 3.0 * found.to_green_sigma[[0, 2]]).all()
    assert found.to_green_sigma[1] == 0
    assert (found.to_green_sigma < 0.1).all()


@pytest.mark.slow
def test_growth_with_range_matters_where_ranges_differ_much() -> None:
    samples, dark = survey(0.5, 4.0)
    found = solve_water(samples, dark, CAMERAS)
    ranges = np.array([0.7, 3.5])
    true = growth_at(GROWTH, ranges, MIDDLE_M)
    here, middle = (
        growth_at(found.growth, at, found.middle_range) for at in (ranges, np.array(MIDDLE_M))
    )
    np.testing.assert_allclose(here / middle, true, rtol=0.12)
    assert (np.abs(true - 1) > 0.14).all()


def test_what_overlaps_do_not_say_is_not_taken_away() -> None:
    samples, dark = survey(1.5, 2.6)
    found = solve_water(samples.part(slice(40)), dark, CAMERAS)
    assert not found.share.any()
    assert all(not level.any() for level in found.added.values())
    assert np.isinf(found.share_sigma).all()
