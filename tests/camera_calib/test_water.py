"""Index, attenuation and colours of water and glass; scattering is tested with the sea floor."""

from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from alice_survey.core.config import Jerlov
from alice_survey.core.errors import ConfigError
from alice_survey.core.seawater import n_water
from camera_calib.camera import Camera
from camera_calib.water import channel_cameras, diffuse_attenuation_per_m, n_glass, water_optics
from tests.cameras import MANTA, changed

JERLOV_1976_PER_M = {
    # at 450, 550 and 650 nm
    "I": (0.019, 0.063, 0.36),
    "II": (0.068, 0.089, 0.40),
    "III": (0.135, 0.12, 0.445),
    "1C": (0.25, 0.12, 0.45),
    "3C": (0.39, 0.19, 0.46),
    "5C": (0.56, 0.30, 0.54),
    "7C": (0.89, 0.46, 0.63),
    "9C": (1.6, 0.63, 0.76),
}
PURE_WATER_PER_M = {
    # absorption, Pope and Fry (1997)
    425.0: 0.00478, 475.0: 0.0114, 525.0: 0.0417, 575.0: 0.0772, 625.0: 0.2834, 675.0: 0.448,
    700.0: 0.624,
}  # fmt: skip


@pytest.mark.parametrize("jerlov", get_args(Jerlov))
def test_daylight_fades_as_in_jerlovs_table(jerlov: Jerlov) -> None:
    nm = np.array([450.0, 550.0, 650.0])
    np.testing.assert_array_equal(diffuse_attenuation_per_m(jerlov, nm), JERLOV_1976_PER_M[jerlov])


def test_the_clearest_sea_is_nearly_pure_water() -> None:
    """Jerlov (1976) has a little less absorption at the red end than Pope and Fry (1997)."""
    nm = np.array(list(PURE_WATER_PER_M))
    pure = np.array(list(PURE_WATER_PER_M.values()))
    clearest = water_optics("I", nm).absorption_per_m
    assert np.all(clearest > 0.8 * pure)
    np.testing.assert_allclose(clearest[-3:], pure[-3:], rtol=0.2)
    for jerlov in get_args(Jerlov)[1:]:
        assert np.all(diffuse_attenuation_per_m(jerlov, nm) > 0.9 * pure)


@given(jerlov=st.sampled_from(get_args(Jerlov)), nm=st.floats(400, 700))
def test_optics_of_any_wavelength_obey_kirks_relation(jerlov: Jerlov, nm: float) -> None:
    wave = np.array([nm])
    optics = water_optics(jerlov, wave)
    a, b = optics.absorption_per_m, optics.scattering_per_m
    np.testing.assert_allclose(
        0.9 * diffuse_attenuation_per_m(jerlov, wave), np.sqrt(a**2 + 0.256 * a * b), rtol=1e-9
    )
    at_550 = water_optics(jerlov, np.array([550.0])).scattering_per_m
    np.testing.assert_allclose(b * nm, at_550 * 550.0, rtol=1e-12)
    assert np.all(a > 0)
    np.testing.assert_allclose(optics.attenuation_per_m, a + b)


@pytest.mark.parametrize("nm", [399.0, 701.0, np.nan])
def test_light_beyond_the_tables_is_refused(nm: float) -> None:
    with pytest.raises(ConfigError, match="400 to 700 nm"):
        water_optics("II", np.array([530.0, nm]))
    with pytest.raises(ConfigError, match="380 to 1050 nm"):
        n_glass(nm / 1e3)


LINES_NM = [486.13, 587.56, 656.27]


def test_index_and_dispersion_of_glass_are_those_of_its_data_sheet() -> None:
    f, d, c = n_glass(LINES_NM)
    assert d == pytest.approx(1.51680, abs=2e-5)
    assert (d - 1) / (f - c) == pytest.approx(64.17, abs=0.02)
    assert np.all(np.diff(n_glass(np.linspace(380, 750, 100))) < 0)


ALICE = changed(MANTA, n_water=1.3419)
LEVANT: dict[str, Any] = {"temperature_c": 24.0, "salinity_psu": 39.0, "depth_m": 15.0}
SEA: dict[str, Any] = {"temperature_c": 20.0, "salinity_psu": 35.0, "depth_m": 10.0}
RANGE_M = 2.0


def shift_px(green: Camera, channel: Camera, pixel: tuple[float, float]) -> np.ndarray:
    """Where a channel sees what green sees at a pixel, minus that pixel."""
    return channel.project(green.at_depth(np.array(pixel), RANGE_M)) - np.array(pixel)


def test_shifts_are_those_of_the_design_study() -> None:
    """+2.9 / -2.3 px at 1000 px and +8.1 / -6.3 px in the corner (610, 530, 460 nm at 2 m)."""
    cameras = channel_cameras(ALICE, **LEVANT, wavelengths_nm=[610.0, 530.0, 460.0])
    green = cameras["green"]
    for name, at_1000_px, corner_px in (("blue", 2.9, 8.1), ("red", -2.3, -6.3)):
        right = shift_px(green, cameras[name], (1692.0 + 1000.0, 1355.0))
        assert right[0] == pytest.approx(at_1000_px, abs=0.05)
        corner = -shift_px(green, cameras[name], (0.0, 0.0))
        outward = corner @ np.array([1692.0, 1355.0]) / np.hypot(1692.0, 1355.0)
        assert outward == pytest.approx(corner_px, abs=0.06)


def test_from_fresh_water_to_the_sea_the_corner_moves() -> None:
    """15 px, at 20 C and at 24 C with 39 psu: why a calibration is carried by its index."""
    pool = changed(ALICE, n_water=float(n_water(20.0, 0.0, 0.0)))
    sea = changed(ALICE, n_water=float(n_water(24.0, 39.0, 0.0)))
    moved = np.linalg.norm(shift_px(sea, pool, (0.0, 0.0)))
    assert moved == pytest.approx(15.0, abs=0.2)


def test_green_keeps_what_was_calibrated() -> None:
    camera = changed(ALICE, n_water=1.337, n_glass=1.49)
    cameras = channel_cameras(camera, **SEA, wavelengths_nm=[620, 540, 450])

    assert cameras["green"] == camera
    water, port = n_water(20, 35, 10, [620, 540, 450]), n_glass([620, 540, 450])
    assert cameras["blue"].n_water - 1.337 == pytest.approx(water[2] - water[1], abs=1e-15)
    assert cameras["red"].n_water - 1.337 == pytest.approx(water[0] - water[1], abs=1e-15)
    assert cameras["blue"].parameter("n_glass") - 1.49 == pytest.approx(
        port[2] - port[1], abs=1e-15
    )
    assert changed(cameras["blue"], n_water=1.337, n_glass=1.49) == camera
