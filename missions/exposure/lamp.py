"""The strobes' LEDs: from lumens to watts in red, green and blue.

White light of a blue LED under phosphor, by the table of CIE illuminant LED-B3 (phosphor-converted,
4103 K; CIE 015:2018, Colorimetry, 4th edition), the nearest that CIE publishes to the 4000 K of
ALICE's (Gutnik et al. 2021, section III.B). A LED of another maker differs by some per cent.
"""

from typing import Literal

import numpy as np

from alice_survey.core.frames import Array

Spectrum = Literal["led", "even"]

LAMP = "phosphor LED of 4100 K (CIE LED-B3)"

_LUMENS_PER_WATT = 683.0
_BANDS_NM = ((600.0, 700.0), (500.0, 600.0), (400.0, 500.0))
"""Bands of red, green and blue."""
LED_NM = np.arange(380.0, 781.0, 5.0)
LED_B3 = np.array([
    0, 0, 0.01, 0.02, 0.05, 0.11, 0.25, 0.56, 1.2, 2.37, 4.24, 7.17,
    12.11, 17.7, 18.87, 14.58, 9.9, 7.53, 6.02, 5.11, 5.17, 5.82, 6.77, 7.88,
    8.94, 9.82, 10.52, 11.06, 11.51, 11.93, 12.37, 12.83, 13.31, 13.79, 14.26, 14.68,
    15.08, 15.42, 15.72, 15.97, 16.18, 16.37, 16.5, 16.55, 16.5, 16.32, 16, 15.54,
    14.96, 14.27, 13.48, 12.62, 11.71, 10.78, 9.85, 8.93, 8.04, 7.2, 6.42, 5.69,
    5.02, 4.42, 3.88, 3.39, 2.95, 2.56, 2.22, 1.92, 1.65, 1.43, 1.23, 1.06,
    0.91, 0.78, 0.68, 0.58, 0.5, 0.43, 0.37, 0.32, 0.28,
])  # fmt: skip
"""CIE 015:2018, relative power of LED-B3, every 5 nm."""


def watts_per_lumen(spectrum: Spectrum) -> Array:
    """Radiant watts in red, green and blue for one lumen, (3,).

    Lumens are `683 integral(P V)`, with the CIE photopic curve as V = 1.019 exp(-285.4 (um -
    0.559)^2), which holds its integral to 0.1 %.

    Args:
        spectrum: of the LED, or even between 400 and 700 nm.
    """
    nm = np.linspace(380.0, 780.0, 801)
    power = np.interp(nm, LED_NM, LED_B3)
    if spectrum == "even":
        power = np.where((nm >= 400.0) & (nm <= 700.0), 1.0, 0.0)
    photopic = 1.019 * np.exp(-285.4 * (nm * 1e-3 - 0.559) ** 2)
    lumens = _LUMENS_PER_WATT * np.trapezoid(power * photopic, nm)
    bands = [(nm >= low) & (nm <= high) for low, high in _BANDS_NM]
    return np.array([np.trapezoid(power[band], nm[band]) / lumens for band in bands])
