"""Index of refraction of sea and fresh water by temperature, salinity, depth and wavelength.

At the surface it is the formula of Quan and Fry (1995, Applied Optics 34(18), 3477-3480), a fit to
the tables of Austin and Halikas (1976), which are relative to air (Zhang, Hu and He 2009, Optics
Express 17, 5698). Relative to air is what a port with air behind it needs: `n_air` is 1 in all
camera models here. What pressure adds are the pressure terms of Millard and Seaver (1990, Deep-Sea
Research 37(12), 1909-1926), good to 8e-5 at 11 km; pressure follows from depth after Saunders
(1981, Journal of Physical Oceanography 11, 573-574) at 45 degrees of latitude.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from alice_survey.core.errors import ConfigError, warn

GREEN_NM = 530.0
"""Wavelength that stands for a whole camera when none is named: the middle of green."""

_KNOWN_C, _KNOWN_PSU, _FIT_SIGMA = 1.0, 1.0, 4e-5
"""Sigmas of temperature, salinity and formula behind an index that nobody measured."""

_FIT = {
    "temperature_c": (0.0, 30.0, "C"),
    "salinity_psu": (0.0, 35.0, "psu"),
    "wavelength_nm": (400.0, 700.0, "nm"),
}
"""Range in which Quan and Fry's formula was fitted."""

_REACH = {
    "temperature_c": (-2.0, 35.0, "C"),
    "salinity_psu": (0.0, 43.0, "psu"),
    "depth_m": (0.0, 11_000.0, "m"),
    "wavelength_nm": (380.0, 750.0, "nm"),
}
"""Range within 1e-4 of IAPWS R9-97 (pure water) and Millard and Seaver (salt)."""


def n_water(
    temperature_c: ArrayLike,
    salinity_psu: ArrayLike,
    depth_m: ArrayLike,
    wavelength_nm: ArrayLike = GREEN_NM,
) -> NDArray[np.float64]:
    """Index of refraction of water, relative to air at the surface.

    Outside the range of the fit (0 to 30 C, 0 to 35 psu, 400 to 700 nm) it is extrapolated with a
    warning, to about 1e-4; inside, it is good to 4e-5.

    Args:
        temperature_c: temperature of the water, -2 to 35.
        salinity_psu: 0 (fresh) to 43.
        depth_m: below the surface, 0 to 11,000.
        wavelength_nm: in air, 380 to 750.

    Returns:
        Indices, in the shape that the arguments broadcast to.

    Raises:
        ConfigError: a value is not finite or beyond what the formulas reach.

    Example:
        >>> import alice_survey as alice
        >>> float(alice.n_water(22.0, 35.0, 15.0).round(4))
        1.3414
    """
    given = (temperature_c, salinity_psu, depth_m, wavelength_nm)
    t, s, depth, nm = (np.asarray(value, dtype=np.float64) for value in given)
    values = {"temperature_c": t, "salinity_psu": s, "depth_m": depth, "wavelength_nm": nm}
    for name, (minimum, maximum, unit) in _REACH.items():
        wrong = values[name][~((values[name] >= minimum) & (values[name] <= maximum))]
        if wrong.size:
            raise ConfigError(
                f"{name} = {wrong.flat[0]:g}: the index of water is known from {minimum:g} to "
                f"{maximum:g} {unit}"
            )
    for name, (minimum, maximum, unit) in _FIT.items():
        beyond = values[name][(values[name] < minimum) | (values[name] > maximum)]
        if beyond.size:
            warn(
                f"{name} = {beyond.flat[0]:g} is beyond the {minimum:g} to {maximum:g} {unit} of "
                "Quan and Fry's index of sea water: it is extrapolated, to about 1e-4"
            )
    deeper = _by_pressure(t, s, pressure_dbar(depth), nm)
    index: NDArray[np.float64] = _at_surface(t, s, nm) + deeper
    return index


def n_water_sigma(
    temperature_c: float = 20.0, salinity_psu: float = 35.0, wavelength_nm: float = GREEN_NM
) -> float:
    """Sigma of an index that follows from a water's temperature and salinity as divers know them.

    These are taken as known to 1 degree and 1 psu; their effects follow from the slopes of Quan and
    Fry's formula, which itself is good to 4e-5.
    """
    t, s, nm = np.float64(temperature_c), np.float64(salinity_psu), np.float64(wavelength_nm)
    warmer = _at_surface(t + _KNOWN_C, s, nm) - _at_surface(t - _KNOWN_C, s, nm)
    saltier = _at_surface(t, s + _KNOWN_PSU, nm) - _at_surface(t, s - _KNOWN_PSU, nm)
    return math.hypot(warmer / 2, saltier / 2, _FIT_SIGMA)


def pressure_dbar(depth_m: ArrayLike) -> NDArray[np.float64]:
    """Pressure of sea water above that of the atmosphere (Saunders 1981).

    The latitude is taken as 45 degrees: elsewhere pressure is at most 0.3 % off, 2e-5 of the index
    at 6000 m. Fresh water weighs 3 % less.
    """
    c1 = 5.92e-3 + 5.25e-3 * math.sin(math.radians(45.0)) ** 2
    c2 = 2.21e-6
    depth = np.asarray(depth_m, dtype=np.float64)
    return ((1 - c1) - np.sqrt((1 - c1) ** 2 - 4 * c2 * depth)) / (2 * c2)


def _at_surface(t: Any, s: Any, nm: Any) -> Any:
    """Index at the surface: Quan and Fry (1995), equation 3."""
    return (
        1.31405
        + (1.779e-4 - 1.05e-6 * t + 1.6e-8 * t**2) * s
        - 2.02e-6 * t**2
        + (15.868 + 0.01155 * s - 0.00423 * t) / nm
        - 4382.0 / nm**2
        + 1.1455e6 / nm**3
    )


def _by_pressure(t: Any, s: Any, p: Any, nm: Any) -> Any:
    """Pressure term of the index: regions III and IV of Millard and Seaver (1990), table 1."""
    pure = 1.5868383e-6 + 1.0712063e-8 / (nm * 1e-3) ** 2 - 9.4834486e-9 * t + 1.0100326e-10 * t**2
    salt = -1.1177517e-9 + 5.7311268e-11 * t - 1.5460458e-12 * t**2
    curved = -1.574074e-11 + 5.8085198e-15 * t**2
    return p * (pure + salt * s) + p**2 * curved
