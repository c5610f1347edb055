import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alice_survey.sim.seafloor.terrain import CERAMIC, ROCK, SAND
from alice_survey.sim.seafloor.texture import (
    SAND_ALBEDO,
    Texture,
    add_octave,
    near_specks,
    noise,
    speck,
)
from tests.oracles_seafloor import gradient_noise

PIXEL_M = 0.00042
"""At 2 m, full resolution."""
TEXTURE = Texture(seed=0xC0FFEE42)


def plane(
    step_m: float, count: int, origin: tuple[float, float, float] = (1.1, -2.3, 15.0)
) -> np.ndarray:
    north, east = np.mgrid[:count, :count] * step_m
    return np.stack([north + origin[0], east + origin[1], 0 * north + origin[2]], -1).reshape(-1, 3)


def albedo(points: np.ndarray, footprint_m: float, material: float = SAND) -> np.ndarray:
    one = np.ones(len(points), dtype=np.float32)
    return TEXTURE.albedo(points, one * np.float32(material), one * np.float32(footprint_m))


@settings(max_examples=60, deadline=None)
@given(
    place=st.tuples(*[st.floats(-6000.0, 6000.0)] * 3),
    lattice=st.sampled_from([0.0002, 0.009, 0.5]),
    seed=st.integers(0, 2**32 - 1),
)
def test_noise_is_that_of_its_slow_twin(
    place: tuple[float, float, float], lattice: float, seed: int
) -> None:
    out = np.empty(3, dtype=np.float32)
    x, y, z = (np.full(3, p) for p in place)
    noise(x, y, z, lattice, seed, out)
    # 6 km over 0.2 mm leave 1e-8 of a cell.
    assert out[0] == pytest.approx(gradient_noise(*place, lattice, seed), abs=3e-6)
    assert out[0] == out[1] == out[2]


def test_noise_has_the_strength_it_states_and_no_mean() -> None:
    points = np.random.default_rng(3).uniform(-10, 10, (3, 200_000))
    out = np.empty(points.shape[1], dtype=np.float32)
    noise(*points, 0.01, 7, out)
    assert out.std() == pytest.approx(0.48, abs=0.01)
    assert abs(out.mean()) < 0.005
    assert np.abs(out).max() < 2.5


@settings(max_examples=200, deadline=None)
@given(place=st.tuples(*[st.floats(-3.0, 3.0)] * 3), share=st.floats(0.0, 1.0))
def test_specks_cover_between_nothing_and_all(
    place: tuple[float, float, float], share: float
) -> None:
    cover, back, gloom, own = speck(*place, 0.03, share, 0.001, 0.0, 99)
    assert all(0.0 <= share <= 1.0 for share in (cover, back, gloom))
    assert 0 <= own < 2**16
    if share == 0.0:
        assert cover == gloom == 0.0


def test_bare_sand_has_the_mean_colour_that_exposure_counts_on() -> None:
    colours = albedo(plane(0.05, 200), 0.001)
    np.testing.assert_allclose(colours.mean(axis=0), SAND_ALBEDO, rtol=0.08)


@pytest.mark.parametrize("step_m", [PIXEL_M, 4 * PIXEL_M])
def test_samples_do_not_alias(step_m: float) -> None:
    """Detail finer than the samples does not come back as coarse patterns, nor near Nyquist."""
    count, fine = 96, 8
    coarse = albedo(plane(step_m, count), step_m)[:, 1].reshape(count, count)
    shift = (1.1 - (fine - 1) / 2 * step_m / fine, -2.3 - (fine - 1) / 2 * step_m / fine, 15.0)
    dense = albedo(plane(step_m / fine, count * fine, shift), step_m / fine)[:, 1]
    mean = dense.reshape(count, fine, count, fine).mean(axis=(1, 3))
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(count), np.fft.fftfreq(count)))
    window = np.outer(np.hanning(count), np.hanning(count))
    spectra = [np.fft.fft2((a - a.mean()) * window) for a in (coarse, mean)]
    low = (frequency < 0.15) & (frequency > 0.0)
    difference = np.abs(spectra[0] - spectra[1])[low] ** 2
    assert difference.sum() < 0.1 * (np.abs(spectra[1])[low] ** 2).sum()
    power = np.abs(spectra[0]) ** 2
    assert power[frequency > 0.45].sum() < 0.03 * power.sum()
    assert power[(frequency > 0.1) & (frequency < 0.3)].sum() > 0.02 * power.sum()


@pytest.mark.parametrize(
    ("footprint_m", "left"), [(0.0025, 1.0), (0.00333, 0.5), (0.005, 0.0), (0.02, 0.0)]
)
def test_octaves_fade_before_samples_are_too_far_apart(footprint_m: float, left: float) -> None:
    total, waves = np.zeros((2, 400), dtype=np.float32)
    places = np.random.default_rng(2).uniform(-1.0, 1.0, (3, 400))
    noise(*places, 0.01, 7, waves)
    add_octave(total, *places, 0.01, 7, 0.5, np.full(400, footprint_m, dtype=np.float32))
    np.testing.assert_allclose(total, 0.5 * left * waves, atol=2e-3)


def test_specks_end_smoothly_within_their_cell() -> None:
    cell_m = 0.03

    def covers(places: np.ndarray) -> list[float]:
        return [speck(*place, cell_m, 1.0, 1e-4, 0.0, 5)[0] for place in places]

    for axis in range(3):
        at = np.random.default_rng(axis).uniform(-1.0, 1.0, (3600, 3))
        at[:, axis] = cell_m * np.round(at[:, axis] / cell_m) + 1e-9
        assert max(covers(at)) == 0.0
    assert 0.005 < np.mean(covers(np.random.default_rng(9).uniform(-1, 1, (3000, 3)))) < 0.2


@pytest.mark.parametrize("apart_m", [0.0002, 0.01])
def test_no_speck_is_passed_over(apart_m: float) -> None:
    """The quick choice of places has all that a speck changes, and few others."""
    at = np.random.default_rng(1).uniform(-1.0, 1.0, (20_000, 3))
    chosen = np.empty(len(at), dtype=bool)
    apart = np.full(len(at), apart_m, dtype=np.float32)
    near_specks(*np.ascontiguousarray(at.T), 0.032, 0.45, apart, np.uint32(5), chosen)
    found = [speck(*p, 0.032, 0.45, apart_m, 0.0, np.uint32(5)) for p in at]
    changed = np.array([cover > 0.0 or gloom > 0.0 for cover, _, gloom, _ in found])
    assert np.all(chosen[changed])
    assert 0.01 < changed.mean() < chosen.mean() < 3.0 * changed.mean()


def test_a_place_has_one_colour_in_any_order_of_evaluation() -> None:
    points = plane(0.0018, 80)
    order = np.random.default_rng(0).permutation(len(points))
    straight, shuffled = albedo(points, 0.0018), albedo(points[order], 0.0018)
    np.testing.assert_allclose(shuffled, straight[order], atol=2e-6)
    np.testing.assert_array_equal(albedo(points, 0.0018), straight)
    material, footprint = (np.full(len(points), v, np.float32) for v in (0.0, 0.0018))
    other = Texture(seed=1).albedo(points, material, footprint)
    assert np.abs(other - straight).max() > 0.05


@pytest.mark.parametrize("material", [SAND, ROCK, CERAMIC])
def test_reflectances_are_possible_and_vary(material: float) -> None:
    colours = albedo(plane(0.0018, 300), 0.0009, material)
    assert colours.min() >= 0.01
    assert colours.max() <= 0.95
    assert np.all(colours.std(axis=0) > 0.02)


def test_detail_goes_on_below_a_pixel_of_the_full_resolution() -> None:
    """Within one pixel of 0.42 mm reflectance varies by a few percent."""
    pixels = np.random.default_rng(4).uniform(-2, 2, (300, 1, 3)) + plane(PIXEL_M / 8, 8, (0, 0, 0))
    colours = albedo(pixels.reshape(-1, 3), PIXEL_M / 8).reshape(300, 64, 3)
    within = colours.std(axis=1).mean() / colours.mean()
    assert 0.01 < within < 0.2
