"""Optical properties of sea water by Jerlov type, for the camera's three colour channels.

Jerlov's tables give K_d, the attenuation of daylight with depth. A beam from a strobe is weakened
more: by c = a + b (absorption and scattering). The two are joined here by Kirk's relation (1984),
K_d mu_0 = sqrt(a^2 + 0.256 a b), with mu_0 = 0.9, and by an assumption for each type on the share
of scattering at 550 nm, b / (a + b), rising from clear ocean to turbid coast as measurements of
these types do; b falls as 1 / wavelength, as it does for particles.
"""

import math
from dataclasses import dataclass

import numpy as np

from alice_survey.config import Jerlov
from alice_survey.frames import Array

CHANNELS = ("red", "green", "blue")
WAVELENGTH_NM = np.array([600.0, 530.0, 460.0])
"""At the middle of the red, green and blue band."""

ASYMMETRY = 0.924
"""Mean cosine of the Henyey-Greenstein phase function: with it 1.7 % of the scattered light goes
backward, as in Petzold's measurements (1.8 %; Mobley 1994, section 3.10)."""

_TABLE_NM = np.array([450.0, 550.0, 650.0])
_DIFFUSE_PER_M: dict[Jerlov, tuple[float, float, float]] = {
    "I": (0.019, 0.063, 0.36),
    "II": (0.068, 0.089, 0.40),
    "III": (0.135, 0.12, 0.445),
    "1C": (0.25, 0.12, 0.45),
    "3C": (0.39, 0.19, 0.46),
    "5C": (0.56, 0.30, 0.54),
    "7C": (0.89, 0.46, 0.63),
    "9C": (1.6, 0.63, 0.76),
}
_SCATTERED_SHARE: dict[Jerlov, float] = {
    "I": 0.35, "II": 0.70, "III": 0.75, "1C": 0.75, "3C": 0.80, "5C": 0.83, "7C": 0.85, "9C": 0.86,
}  # fmt: skip
_MEAN_COSINE = 0.9
_KIRK = 0.256


@dataclass(frozen=True, kw_only=True, eq=False)
class WaterOptics:
    """How water absorbs and scatters light in red, green and blue."""

    absorption_per_m: Array
    """(3,)."""
    scattering_per_m: Array
    """(3,)."""

    @property
    def attenuation_per_m(self) -> Array:
        """(3,) beam attenuation: light that is scattered once counts as lost to the beam."""
        return self.absorption_per_m + self.scattering_per_m


def diffuse_attenuation_per_m(jerlov: Jerlov, wavelength_nm: Array) -> Array:
    """Jerlov's K_d, straight between the table's wavelengths."""
    return np.interp(wavelength_nm, _TABLE_NM, _DIFFUSE_PER_M[jerlov])


def water_optics(jerlov: Jerlov) -> WaterOptics:
    """Absorption and scattering of a Jerlov type in the three channels (see the module)."""
    ratio = _SCATTERED_SHARE[jerlov] / (1.0 - _SCATTERED_SHARE[jerlov])
    at_550 = float(diffuse_attenuation_per_m(jerlov, np.array([550.0]))[0])
    scattering_550 = ratio * _MEAN_COSINE * at_550 / math.sqrt(1.0 + _KIRK * ratio)
    scattering = scattering_550 * 550.0 / WAVELENGTH_NM
    diffuse = _MEAN_COSINE * diffuse_attenuation_per_m(jerlov, WAVELENGTH_NM)
    half = 0.5 * _KIRK * scattering
    return WaterOptics(
        absorption_per_m=np.sqrt(half**2 + diffuse**2) - half,
        scattering_per_m=scattering,
    )


def phase_per_sr(cosine: Array, asymmetry: float = ASYMMETRY) -> Array:
    """Henyey-Greenstein phase function: share of the scattered light per steradian.

    Args:
        cosine: of the angle by which light is turned (1 is forward).
        asymmetry: mean cosine.
    """
    g = asymmetry
    phase: Array = (1.0 - g * g) / (4.0 * np.pi * (1.0 + g * g - 2.0 * g * cosine) ** 1.5)
    return phase
