"""The index of water by other formulas, written apart from the package's."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def fresh_density_kg_m3(temperature_c: Array, pressure_dbar: Array | float = 0.0) -> Array:
    """Pure water after Kell (1975): density at one atmosphere, and isothermal compressibility."""
    t = temperature_c
    at_surface = (
        999.83952 + 16.945176 * t - 7.9870401e-3 * t**2 - 46.170461e-6 * t**3
        + 105.56302e-9 * t**4 - 280.54253e-12 * t**5
    ) / (1.0 + 16.879850e-3 * t)  # fmt: skip
    per_bar = 1e-6 * (
        50.88630 + 0.717582 * t + 0.7819867e-3 * t**2 + 31.62214e-6 * t**3
        - 0.1323594e-6 * t**4 + 0.634575e-9 * t**5
    ) / (1.0 + 21.65928e-3 * t)  # fmt: skip
    # Tait: stiffness grows by about 6.6 times the pressure (Dymond and Malhotra 1988).
    squeezed = np.log1p(6.6 * per_bar * np.asarray(pressure_dbar) / 10.0) / 6.6
    return at_surface * (1.0 + squeezed)


def n_fresh_iapws(temperature_c: Array, density_kg_m3: Array, wavelength_nm: Array) -> Array:
    """Pure water relative to vacuum: IAPWS R9-97 (Harvey, Gallagher and Levelt Sengers 1998)."""
    rho, theta = density_kg_m3 / 1000.0, (temperature_c + 273.15) / 273.15
    wave2 = (wavelength_nm / 589.0) ** 2
    lorentz = rho * (
        0.244257733 + 9.74634476e-3 * rho - 3.73234996e-3 * theta
        + 2.68678472e-4 * wave2 * theta + 1.58920570e-3 / wave2
        + 2.45934259e-3 / (wave2 - 0.2292020**2) + 0.900704920 / (wave2 - 5.432937**2)
        - 1.66626219e-2 * rho**2
    )  # fmt: skip
    return np.sqrt((1.0 + 2.0 * lorentz) / (1.0 - lorentz))


def n_air(wavelength_nm: Array) -> Array:
    """Standard air relative to vacuum: Ciddor (1996)."""
    wavenumber2 = (1e3 / wavelength_nm) ** 2
    return 1.0 + 1e-8 * (5792105.0 / (238.0185 - wavenumber2) + 167917.0 / (57.362 - wavenumber2))


def n_sea_millard_seaver(
    temperature_c: Array, salinity_psu: Array, pressure_dbar: Array, wavelength_nm: Array
) -> Array:
    """All 27 terms of Millard and Seaver (1990, table 1); 500 to 700 nm, relative to air."""
    t, s, p, um = temperature_c, salinity_psu, pressure_dbar, wavelength_nm / 1e3
    fresh = (
        1.3280657 - 4.5536802e-3 * um**2 + 2.5471707e-3 / um**2 + 7.501966e-6 / um**4
        + 2.802632e-6 / um**6 - 5.2883907e-6 * t - 3.0738272e-6 * t**2 + 3.0124687e-8 * t**3
        - 2.0883178e-10 * t**4 + 1.0508621e-5 * t * um + 2.1282248e-7 * t**2 * um
        - 1.705881e-9 * t**3 * um
    )  # fmt: skip
    salt = (
        1.9029121e-4 * s + 2.4239607e-6 * s / um**2 - 7.3960297e-7 * s * t
        + 8.9818478e-9 * s * t**2 + 1.2078804e-10 * s * t**3 - 3.589495e-7 * s * t * um
    )  # fmt: skip
    pressed = (
        1.5868383e-6 * p - 1.574074e-11 * p**2 + 1.0712063e-8 * p / um**2 - 9.4834486e-9 * p * t
        + 1.0100326e-10 * p * t**2 + 5.8085198e-15 * p**2 * t**2
    )  # fmt: skip
    both = -1.1177517e-9 * p * s + 5.7311268e-11 * p * t * s - 1.5460458e-12 * p * t**2 * s
    return fresh + salt + pressed + both
