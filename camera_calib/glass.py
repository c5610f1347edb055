"""Index of refraction of what ports are made of, by wavelength."""

import numpy as np
from numpy.typing import ArrayLike

from alice_survey.base.errors import ConfigError
from alice_survey.base.frames import Array

_SELLMEIER: dict[str, tuple[tuple[float, float], ...]] = {
    "bk7": (
        (1.03961212, 6.00069867e-3),
        (0.231792344, 2.00179144e-2),
        (1.01046945, 103.560653),
    ),
    "fused-silica": (
        (0.6961663, 0.0684043**2),
        (0.4079426, 0.1162414**2),
        (0.8974794, 9.896161**2),
    ),
    "sapphire": (
        (1.4313493, 0.0726631**2),
        (0.65054713, 0.1193242**2),
        (5.3414021, 18.028251**2),
    ),
    "pmma": ((1.1819, 0.011313),),
    "polycarbonate": ((1.4182, 0.021304),),
}
"""B and C (square micrometres) of n^2 - 1 = sum B l^2 / (l^2 - C), relative to air at 20 C: SCHOTT
N-BK7 data sheet; Malitson (1965); Malitson and Dodge (1972), ordinary ray, as of a window cut
across its axis; Sultanova, Kasarova and Nikolov (2009) for both plastics."""

GLASSES = tuple(_SELLMEIER)
"""Materials of ports whose dispersion is known."""


def n_glass(material: str, wavelength_nm: ArrayLike) -> Array:
    """Index of refraction of a port's material, relative to air, by Sellmeier's equation.

    Args:
        material: one of `GLASSES`.
        wavelength_nm: any shape, 380 to 1050.

    Raises:
        ConfigError: the material is unknown or a wavelength out of range.
    """
    if material not in _SELLMEIER:
        raise ConfigError(f"no glass {material!r}: known are {', '.join(GLASSES)}")
    nm = np.asarray(wavelength_nm, dtype=np.float64)
    if not np.all((nm >= 380.0) & (nm <= 1050.0)):
        raise ConfigError(f"wavelength {nm} nm: glasses are known from 380 to 1050 nm")
    square_um = (nm * 1e-3) ** 2
    terms = (b * square_um / (square_um - c) for b, c in _SELLMEIER[material])
    index: Array = np.sqrt(1.0 + sum(terms, start=np.zeros_like(square_um)))
    return index
