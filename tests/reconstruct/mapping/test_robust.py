"""Sigmas and weights of observations some of which are wrong."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate

from reconstruct.mapping.bundle import pixel_sigma, robust_weights, sigma_of, variance_of
from reconstruct.mapping.refraction import adjust_freely
from tests.reconstruct.mapping.test_mapper import camera_rms, mapped_scene
from tests.reconstruct.scenes import Scene, make_scene


@pytest.mark.parametrize("noise_px", [0.1, 0.3])
def test_the_sigma_of_pixels_is_found_from_residuals(noise_px: float) -> None:
    scene = make_scene(lines=1, stations=5, points=3000, noise_px=noise_px)
    found = pixel_sigma(adjust_freely(mapped_scene(scene)).model)
    assert found == pytest.approx(noise_px, rel=0.15)


def test_a_tenth_of_wrong_observations_hardly_moves_the_sigma() -> None:
    rng = np.random.default_rng(1)
    residuals, counts = rng.normal(0, 0.2, (20_000, 2)), np.full(20_000, 100_000)
    clean = sigma_of(residuals, counts, 0)
    assert clean == pytest.approx(0.2, rel=0.02)
    residuals[::10] = rng.normal(3, 2, (2000, 2))
    assert clean < sigma_of(residuals, counts, 0) < 1.15 * clean


def test_normal_residuals_keep_their_variance_and_most_of_their_efficiency() -> None:
    residuals = np.random.default_rng(2).normal(0, 0.3, (200_000, 2))
    weights = robust_weights(residuals, 0.3)
    scaled = variance_of(residuals, weights, 1.0) / weights.mean()

    def of(power: int) -> float:  # mean of weight^power times half of (r / sigma)^2 over the plane
        density = lambda e: np.exp(-e) * (1 + 2 * e / 4.096**2) ** (-2 * power) * e  # noqa: E731
        return float(integrate.quad(density, 0, 60)[0])

    efficiency = of(1) ** 2 / of(2)  # the mean slope by Stein's identity
    assert efficiency == pytest.approx(0.95, abs=1e-3)
    assert scaled == pytest.approx(0.3**2 / efficiency, rel=0.02)


def leaning(scene: Scene, share: float, by_px: float) -> Scene:
    """A scene in which some observations of the right camera lean one way, most at the rims."""
    rng = np.random.default_rng(5)
    pixels = []
    for record, seen in zip(scene.records, scene.pixels, strict=True):
        half = scene.rig.cameras[record.camera].width_px / 2
        wrong = (rng.random(len(seen)) < share) * (record.camera == "right")
        lean = by_px * ((seen[:, 0] - half) / half) ** 2 * wrong
        pixels.append(seen + lean[:, None] * [1.0, 0.0])
    return replace(scene, pixels=pixels)


def test_wrong_observations_that_lean_one_way_bend_no_block() -> None:
    """As the edges of shadows do, which go with the lamps; least squares is thrice as far off."""
    scene = make_scene(lines=3, stations=5, points=6000, noise_px=0.05, seed=3)
    clean = camera_rms(adjust_freely(mapped_scene(scene)), scene)
    wrong = leaning(scene, 0.1, 1.0)
    found = camera_rms(adjust_freely(mapped_scene(wrong)), scene)
    assert 0.3 * clean < found < 1.5 * clean
