import numpy as np
import pytest

from alice_survey.core.config import CameraConfig
from alice_survey.sim.seafloor.light import (
    MIDDLE_GREY,
    Sensor,
    develop,
    expose,
    make_sensor,
    nominal_gain,
)
from camera_calib.targets.corners import linear_light


def plain(read_noise_e: float = 0.0, full_well_e: float = 1e5) -> Sensor:
    return Sensor(
        electrons_per_radiance=(1000.0, 1000.0, 1000.0),
        full_well_e=full_well_e,
        read_noise_e=read_noise_e,
    )


def even(radiance: float, side: int = 300) -> np.ndarray:
    return np.full((side, side, 3), radiance, dtype=np.float32)


@pytest.mark.parametrize("radiance", [0.02, 0.5, 8.0])
def test_shot_noise_has_the_variance_of_its_mean(radiance: float) -> None:
    electrons = expose(even(radiance), plain(), np.random.default_rng(1))
    mean, count = 1000 * radiance, electrons.size
    assert electrons.mean() == pytest.approx(mean, abs=5 * np.sqrt(mean / count))
    assert electrons.var() == pytest.approx(electrons.mean(), rel=5 * np.sqrt(2 / count) + 0.005)


def test_read_noise_adds_its_variance() -> None:
    quiet = expose(even(1.0), plain(), np.random.default_rng(1))
    noisy = expose(even(1.0), plain(read_noise_e=20.0), np.random.default_rng(1))
    assert noisy.var() - quiet.var() == pytest.approx(400.0, rel=0.05)


def test_electrons_of_a_known_exposure() -> None:
    """1 W / (m^2 sr) through f/4, 3.69 um, 2 ms, 530 nm: counted by hand."""
    sensor = make_sensor(CameraConfig(), 1.34, 0.002, 1)
    image_w_per_m2 = np.pi / (4 * 16) * 0.9 * 0.955 / 1.34**2
    photons = image_w_per_m2 * 3.69e-6**2 * 0.002 / (6.62607015e-34 * 299_792_458 / 530e-9)
    assert sensor.electrons_per_radiance[1] == pytest.approx(0.5 * photons, rel=1e-6)


def test_large_pixels_add_small_ones() -> None:
    one, four, longer = (
        make_sensor(CameraConfig(), 1.34, exposure_s, scale)
        for exposure_s, scale in ((0.002, 1), (0.002, 4), (0.004, 1))
    )
    electrons = np.array(one.electrons_per_radiance)
    np.testing.assert_allclose(four.electrons_per_radiance, 16 * electrons)
    np.testing.assert_allclose(longer.electrons_per_radiance, 2 * electrons)
    assert four.full_well_e == 16 * one.full_well_e
    assert four.read_noise_e == 4 * one.read_noise_e


def test_grey_values_follow_the_srgb_curve_and_back() -> None:
    grey = develop(np.full((1, 1, 3), 0.2140 * 1e4, dtype=np.float32), 1e-4)
    assert grey.tolist() == [[[127, 127, 127]]]
    ramp = np.linspace(0, 1, 1001, dtype=np.float32)
    linear = linear_light(develop(np.dstack([ramp] * 3), 1.0))[0, :, 0]
    np.testing.assert_allclose(linear, ramp, atol=0.0046)
    assert np.all(np.diff(linear) >= 0)


def test_the_gain_puts_the_nominal_median_at_middle_grey() -> None:
    nominal = np.random.default_rng(0).uniform(50.0, 150.0, (9, 11, 3))
    gain = nominal_gain(nominal, plain())
    assert np.median(nominal.mean(axis=-1)) * gain == pytest.approx(MIDDLE_GREY)
    assert nominal_gain(1e6 * nominal, plain()) == 1e-5  # never beyond the full well


def test_the_noise_hardly_depends_on_how_a_machine_rounds() -> None:
    """Draws of a Poisson number are rejected by what it counts: one more shifts all that follow."""
    rng = np.random.default_rng(3)
    light = rng.uniform(0.05, 3.0, (240, 320, 3)).astype(np.float32)
    rounded = light * (1.0 + 1e-5 * rng.standard_normal(light.shape)).astype(np.float32)
    assert np.any(rounded != light)
    one, other = (expose(some, plain(5.0), np.random.default_rng(7)) for some in (light, rounded))
    far = np.abs(one - other) > 1.5
    assert far.mean() < 0.15
    assert far.any(axis=(1, 2)).mean() < 0.5


def test_channels_come_as_opencv_has_them() -> None:
    red = np.zeros((1, 1, 3), dtype=np.float32)
    red[..., 0] = 1.0
    assert develop(red, 1.0).tolist() == [[[0, 0, 255]]]
