"""Colour through a flat port: a camera per channel.

Water and glass bend blue light more than red, so that a flat port shows each colour at its own
scale. A camera is calibrated for its green channel; the other channels see with the same lens and
port and with other indices.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from alice_survey.core.errors import ConfigError
from alice_survey.core.frames import Array
from alice_survey.core.seawater import n_water
from camera_calib.camera import Camera
from camera_calib.water import CHANNELS, WAVELENGTH_NM

_REFERENCE = "green"
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


def channel_cameras(
    camera: Camera,
    *,
    temperature_c: float,
    salinity_psu: float,
    depth_m: float,
    glass: str = "bk7",
    wavelengths_nm: Sequence[float] | Array = WAVELENGTH_NM,
) -> dict[str, Camera]:
    """The camera as its red, green and blue channels see.

    The camera's own indices, mostly calibrated, apply to green; for red and blue they change by as
    much as those of the water and the material do.

    Args:
        camera: as calibrated; green.
        temperature_c: temperature of the water.
        salinity_psu: salinity of the water.
        depth_m: below the surface.
        glass: material of the port, one of `glass.GLASSES`.
        wavelengths_nm: wavelengths of red, green and blue.

    Raises:
        ConfigError: water, material or wavelengths are out of range or not three.
    """
    nm = np.asarray(wavelengths_nm, dtype=np.float64)
    if nm.shape != (3,) or not np.all(np.diff(nm) < 0):
        raise ConfigError(f"wavelengths {nm} nm: give three, of red, green and blue, falling")
    water = n_water(temperature_c, salinity_psu, depth_m, nm)
    port = n_glass(glass, nm)
    green = CHANNELS.index(_REFERENCE)
    return {
        name: camera.with_parameters(
            {
                "n_water": camera.n_water + float(water[i] - water[green]),
                "n_glass": camera.parameter("n_glass") + float(port[i] - port[green]),
            }
        )
        if i != green and camera.port.parameters
        else camera
        for i, name in enumerate(CHANNELS)
    }


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
