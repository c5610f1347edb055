"""The table of water; its scattering and absorption are tested with the light of the sea floor."""

from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from alice_survey.core.config import Jerlov
from alice_survey.core.errors import ConfigError
from camera_calib.water import (
    diffuse_attenuation_per_m,
    water_optics,
)

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
def test_attenuation_beyond_the_table_is_not_made_up(nm: float) -> None:
    with pytest.raises(ConfigError, match="400 to 700 nm"):
        water_optics("II", np.array([530.0, nm]))
