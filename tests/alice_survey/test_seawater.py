import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from alice_survey.core.errors import ConfigError
from alice_survey.core.seawater import GREEN_NM, n_water, n_water_sigma, pressure_dbar
from tests.oracles_water import fresh_density_kg_m3, n_air, n_fresh_iapws, n_sea_millard_seaver


def test_anchors_of_the_levant_sea(capsys: pytest.CaptureFixture[str]) -> None:
    """S = 39, 24 C: the project's design figures, one unit of the last digit."""
    got = n_water(24.0, 39.0, 0.0, [460.0, 530.0, 610.0])

    np.testing.assert_allclose(got, [1.3455, 1.3419, 1.3391], atol=5.1e-5)
    warning = capsys.readouterr().err
    assert warning.count("\n") == 1
    assert "salinity_psu = 39" in warning and "0 to 35 psu" in warning
    n_water(24.0, 35.0, 0.0, 530.0)
    assert capsys.readouterr().err == ""


def test_fresh_water_is_that_of_iapws() -> None:
    """Quan and Fry state 1.5e-5; the tables that they fit differ from IAPWS by up to 4e-5."""
    t, nm = np.meshgrid(np.linspace(0.0, 30.0, 31), np.linspace(400.0, 700.0, 31))
    absolute = n_fresh_iapws(t, fresh_density_kg_m3(t), nm)

    miss = n_water(t, 0.0, 0.0, nm) - absolute / n_air(nm)

    assert 1e-6 < np.abs(miss).max() < 4e-5
    assert np.sqrt(np.mean(miss**2)) < 2e-5
    # It is relative to air: compared with indices relative to vacuum it is 2.8e-4 x 1.33 short.
    assert (n_water(t, 0.0, 0.0, nm) - absolute).mean() == pytest.approx(-3.7e-4, abs=0.2e-4)


def test_the_oracles_agree_with_published_values() -> None:
    """The release's table for checking programs, and handbook values of water at 20 C."""
    published = n_fresh_iapws(np.array(25.0), np.array(997.047435), np.array([226.50, 589.30]))
    np.testing.assert_allclose(published, [1.39277824, 1.33285819], rtol=0, atol=1e-8)
    assert float(fresh_density_kg_m3(np.array(20.0))) == pytest.approx(998.2041, abs=1e-3)
    # Compressibility of water at 20 C: 4.59e-10 per Pa.
    squeezed = fresh_density_kg_m3(np.array(20.0), 100.0) / fresh_density_kg_m3(np.array(20.0))
    assert float(squeezed) - 1.0 == pytest.approx(4.59e-4, rel=0.01)


@pytest.mark.parametrize(("salinity", "bound"), [(20.0, 3e-5), (35.0, 5e-5), (43.0, 6e-5)])
def test_salt_water_is_that_of_millard_and_seaver(salinity: float, bound: float) -> None:
    """Also where the salinity is extrapolated."""
    t, nm = np.meshgrid(np.linspace(0.0, 30.0, 16), np.linspace(500.0, 700.0, 21))
    other = n_sea_millard_seaver(t, np.array(salinity), np.array(0.0), nm)

    miss = n_water(t, salinity, 0.0, nm) - other

    assert np.abs(miss).max() < bound
    # Salt itself raises the index fifty times as much as the two formulas differ.
    assert np.all(n_water(t, salinity, 0.0, nm) - n_water(t, 0.0, 0.0, nm) > 30 * bound)


@pytest.mark.parametrize("temperature_c", [0.0, 10.0, 20.0, 30.0])
def test_pressure_raises_the_index_as_it_does_the_density(temperature_c: float) -> None:
    """IAPWS with compressed fresh water; Millard and Seaver state 2.7e-5 at up to 11 km."""
    t, nm = np.array(temperature_c), np.array(530.0)
    for depth_m in (10.0, 100.0, 1000.0, 5000.0):
        p = pressure_dbar(depth_m)
        compressed = n_fresh_iapws(t, fresh_density_kg_m3(t, p), nm)
        expected = float(compressed - n_fresh_iapws(t, fresh_density_kg_m3(t), nm))
        got = float(n_water(t, 0.0, depth_m, nm) - n_water(t, 0.0, 0.0, nm))
        assert got == pytest.approx(expected, rel=0.035)
        # About 1.5e-5 for every 10 dbar (neutrino telescopes use 1.45e-5 a bar: Schuster 2002).
        assert got == pytest.approx(1.5e-6 * float(p), rel=0.11)


def test_pressure_is_that_of_a_column_of_sea_water() -> None:
    """Saunders (1981); his check value is 7500 dbar at 7321.45 m, 30 degrees of latitude."""
    assert pressure_dbar(0.0) == 0.0
    assert float(pressure_dbar(7321.45)) == pytest.approx(7500.0, rel=2e-3)
    # Near the surface: density times gravity at 45 degrees.
    assert float(pressure_dbar(10.0)) == pytest.approx(1027.0 * 9.806 * 10.0 / 1e4, rel=2e-3)


@given(t=st.floats(0, 30), s=st.floats(0, 35), depth=st.floats(0, 6000), nm=st.floats(400, 690))
def test_index_grows_with_salt_and_depth_and_falls_with_wavelength(
    t: float, s: float, depth: float, nm: float
) -> None:
    here = float(n_water(t, s, depth, nm))

    assert 1.329 < here < 1.362
    assert float(n_water(t, s, depth, nm + 10.0)) < here
    assert float(n_water(t, s, depth + 10.0, nm)) > here + 1.0e-5
    if s <= 34:
        assert float(n_water(t, s + 1.0, depth, nm)) > here + 1.5e-4


def test_arguments_broadcast() -> None:
    table = n_water([[5.0], [15.0], [25.0]], 30.0, 10.0, [460.0, 530.0])
    each = [[n_water(t, 30.0, 10.0, nm) for nm in (460.0, 530.0)] for t in (5.0, 15.0, 25.0)]
    np.testing.assert_array_equal(table, each, strict=True)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ((36.0, 35.0, 0.0, 530.0), "temperature_c = 36.*-2 to 35"),
        ((math.nan, 35.0, 0.0, 530.0), "temperature_c = nan"),
        ((20.0, -1.0, 0.0, 530.0), "salinity_psu = -1"),
        ((20.0, 330.0, 0.0, 530.0), "salinity_psu = 330"),
        ((20.0, 35.0, -5.0, 530.0), "depth_m = -5"),
        ((20.0, 35.0, math.inf, 530.0), "depth_m = inf"),
        ((20.0, 35.0, 0.0, 0.53), "wavelength_nm = 0.53"),
    ],
)
def test_absurd_water_is_refused(arguments: tuple[float, ...], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        n_water(*arguments)


@pytest.mark.parametrize(
    ("temperature_c", "salinity_psu"), [(20.0, 35.0), (4.0, 0.0), (30.0, 39.0)]
)
def test_the_sigma_of_an_index_is_that_of_water_known_to_a_degree_and_a_psu(
    temperature_c: float, salinity_psu: float
) -> None:
    """Derivatives of Quan and Fry's formula, written out."""
    t, s, nm = temperature_c, salinity_psu, GREEN_NM
    by_t = (-1.05e-6 + 3.2e-8 * t) * s - 4.04e-6 * t - 0.00423 / nm
    by_s = 1.779e-4 - 1.05e-6 * t + 1.6e-8 * t**2 + 0.01155 / nm
    expected = math.hypot(by_t, by_s, 4e-5)
    assert n_water_sigma(t, s) == pytest.approx(expected, rel=1e-6)
    assert 1.8e-4 < expected < 2.4e-4
