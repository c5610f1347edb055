import numpy as np
import pytest

from alice_survey.core.errors import ConfigError
from camera_calib.water import GLASSES, n_glass

LINES_NM = [486.13, 587.56, 656.27]


@pytest.mark.parametrize(
    ("material", "at_587_6_nm", "abbe", "abbe_tolerance"),
    [
        # data sheets of the makers and handbooks
        ("bk7", 1.51680, 64.17, 0.02),
        ("fused-silica", 1.45846, 67.82, 0.05),
        ("sapphire", 1.76817, 72.3, 0.3),
    ],
)
def test_index_and_dispersion_are_those_of_data_sheets(
    material: str, at_587_6_nm: float, abbe: float, abbe_tolerance: float
) -> None:
    f, d, c = n_glass(material, LINES_NM)
    assert d == pytest.approx(at_587_6_nm, abs=2e-5)
    assert (d - 1) / (f - c) == pytest.approx(abbe, abs=abbe_tolerance)


@pytest.mark.parametrize(
    ("material", "measured"),
    [
        ("pmma", [1.502, 1.497, 1.491, 1.489, 1.486]),
        ("polycarbonate", [1.612, 1.599, 1.585, 1.580, 1.575]),
    ],
)
def test_plastics_are_as_measured(material: str, measured: list[float]) -> None:
    """Sultanova, Kasarova and Nikolov (2009), table 1; measured to 0.001."""
    index = n_glass(material, [436.8, 486.1, 587.6, 632.8, 703.0])
    np.testing.assert_allclose(index, measured, atol=1e-3)


@pytest.mark.parametrize("material", GLASSES)
def test_index_falls_with_wavelength(material: str) -> None:
    index = n_glass(material, np.linspace(380, 750, 100))
    assert np.all(np.diff(index) < 0)


def test_unknown_glass_and_invisible_light_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"ice.*bk7"):
        n_glass("ice", 530.0)
    with pytest.raises(ConfigError, match="380 to 1050 nm"):
        n_glass("bk7", 0.53)
