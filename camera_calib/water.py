"""Optical properties of sea water: index of refraction, and attenuation by Jerlov type.

Jerlov's tables give K_d, the attenuation of daylight with depth. A beam from a strobe is weakened
more: by c = a + b (absorption and scattering). The two are related here by Kirk (1984),
K_d mu_0 = sqrt(a^2 + 0.256 a b), with mu_0 = 0.9, and by an assumption for each type on the share
of scattering at 550 nm, b / (a + b), rising from clear ocean to turbid coast as measurements of
these types do; b falls as 1 / wavelength, as it does for particles.

The index of refraction is that of `alice_survey.core.seawater` (Quan and Fry 1995).

Water and glass bend blue light more than red, so that a flat port shows each colour at its own
scale. A camera is calibrated for its green channel; the other channels see with the same lens and
port and with other indices.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from alice_survey.core.config import Jerlov
from alice_survey.core.errors import ConfigError
from alice_survey.core.frames import Array
from alice_survey.core.seawater import n_water, pressure_dbar
from alice_survey.kit.words import field_table
from camera_calib.camera import Camera

CHANNELS = ("red", "green", "blue")
WAVELENGTH_NM = np.array([600.0, 530.0, 460.0])
"""Wavelengths at the middle of the red, green and blue band."""

ASYMMETRY = 0.924
"""Mean cosine of the Henyey-Greenstein phase function: with it 1.7 % of the scattered light goes
backward, as in Petzold's measurements (1.8 %; Mobley 1994)."""

_TABLE_NM = np.linspace(400.0, 700.0, 13)
_DIFFUSE_PER_M: dict[Jerlov, tuple[float, ...]] = {
    "I": (.028, .022, .019, .018, .027, .043, .063, .089, .235, .305, .36, .42, .56),
    "II": (.096, .081, .068, .062, .07, .076, .089, .115, .26, .335, .4, .465, .61),
    "III": (.185, .16, .135, .116, .115, .116, .12, .148, .295, .375, .445, .52, .66),
    "1C": (.51, .36, .25, .17, .14, .13, .12, .15, .3, .37, .45, .51, .65),
    "3C": (.78, .54, .39, .29, .22, .2, .19, .21, .33, .4, .46, .56, .71),
    "5C": (1.1, .78, .56, .43, .36, .31, .3, .33, .4, .48, .54, .65, .8),
    "7C": (1.6, 1.2, .89, .71, .58, .49, .46, .46, .48, .54, .63, .78, .92),
    "9C": (2.4, 1.9, 1.6, 1.23, .99, .78, .63, .58, .6, .65, .76, .92, 1.1),
}  # fmt: skip
"""Jerlov (1976), Marine Optics, table XXVII: every 25 nm from 400 to 700."""
_SCATTERED_SHARE: dict[Jerlov, float] = {
    "I": 0.35, "II": 0.70, "III": 0.75, "1C": 0.75, "3C": 0.80, "5C": 0.83, "7C": 0.85, "9C": 0.86,
}  # fmt: skip
_REFERENCE = "green"
_BK7 = ((1.03961212, 6.00069867e-3), (0.231792344, 2.00179144e-2), (1.01046945, 103.560653))
"""B and C (square micrometres) of n^2 - 1 = sum B l^2 / (l^2 - C), relative to air at 20 C: SCHOTT
N-BK7 data sheet."""
_COLUMNS = {
    "channel": "{channel}",
    "wavelength": "{wavelength_nm:g} nm",
    "n_water": "{n_water:.5f}",
    "daylight K_d": "{diffuse_per_m:.3f} /m",
    "absorption": "{absorption_per_m:.3f} /m",
    "scattering": "{scattering_per_m:.3f} /m",
    "beam c": "{beam_per_m:.3f} /m",
}
_MEAN_COSINE = 0.9
_KIRK = 0.256


@dataclass(frozen=True, kw_only=True, eq=False)
class WaterOptics:
    """Absorption and scattering of water at some wavelengths, mostly red, green and blue."""

    absorption_per_m: Array
    """(W,)."""
    scattering_per_m: Array
    """(W,)."""

    @property
    def attenuation_per_m(self) -> Array:
        """(W,) beam attenuation: light that is scattered once counts as lost."""
        return self.absorption_per_m + self.scattering_per_m


def diffuse_attenuation_per_m(jerlov: Jerlov, wavelength_nm: Array) -> Array:
    """Jerlov's K_d, interpolated linearly between the table's wavelengths.

    Raises:
        ConfigError: a wavelength is beyond the table.
    """
    beyond = wavelength_nm[~((wavelength_nm >= _TABLE_NM[0]) & (wavelength_nm <= _TABLE_NM[-1]))]
    if beyond.size:
        raise ConfigError(
            f"wavelength {beyond.flat[0]:g} nm: Jerlov's table of attenuation spans "
            f"{_TABLE_NM[0]:g} to {_TABLE_NM[-1]:g} nm"
        )
    return np.interp(wavelength_nm, _TABLE_NM, _DIFFUSE_PER_M[jerlov])


def water_optics(jerlov: Jerlov, wavelength_nm: Array = WAVELENGTH_NM) -> WaterOptics:
    """Absorption and scattering of a Jerlov type (see the module), in the three channels if none.

    Raises:
        ConfigError: a wavelength is beyond Jerlov's table (400 to 700 nm).
    """
    ratio = _SCATTERED_SHARE[jerlov] / (1.0 - _SCATTERED_SHARE[jerlov])
    at_550 = float(diffuse_attenuation_per_m(jerlov, np.array([550.0]))[0])
    scattering_550 = ratio * _MEAN_COSINE * at_550 / math.sqrt(1.0 + _KIRK * ratio)
    scattering = scattering_550 * 550.0 / wavelength_nm
    diffuse = _MEAN_COSINE * diffuse_attenuation_per_m(jerlov, wavelength_nm)
    half = 0.5 * _KIRK * scattering
    return WaterOptics(
        absorption_per_m=np.sqrt(half**2 + diffuse**2) - half, scattering_per_m=scattering
    )


def phase_per_sr(cosine: Array) -> Array:
    """Henyey-Greenstein phase function: share of the scattered light per steradian.

    Args:
        cosine: cosine of the angle by which light is turned (1 is forward).
    """
    g = ASYMMETRY
    return (1.0 - g * g) / (4.0 * np.pi * (1.0 + g * g - 2.0 * g * cosine) ** 1.5)


def water_report(
    temperature_c: float, salinity_psu: float, depth_m: float, jerlov: str
) -> tuple[str, dict[str, Any]]:
    """Index and attenuation of the camera's channels, as text and as JSON values.

    `diffuse_per_m` is Jerlov's
    K_d of daylight; `beam_per_m`, the attenuation of a strobe's beam, absorption and scattering.

    Raises:
        ConfigError: the water is out of range, or the Jerlov type is unknown.
    """
    kind = next((name for name in _DIFFUSE_PER_M if name == jerlov), None)
    if kind is None:
        raise ConfigError(f"no Jerlov type {jerlov!r}: known are {', '.join(_DIFFUSE_PER_M)}")
    nm = WAVELENGTH_NM
    optics = water_optics(kind, nm)
    columns = {
        "wavelength_nm": nm,
        "n_water": n_water(temperature_c, salinity_psu, depth_m, nm),
        "diffuse_per_m": diffuse_attenuation_per_m(kind, nm),
        "absorption_per_m": optics.absorption_per_m,
        "scattering_per_m": optics.scattering_per_m,
        "beam_per_m": optics.attenuation_per_m,
    }
    rows: list[dict[str, Any]] = [
        {"channel": name} | {key: float(found[i]) for key, found in columns.items()}
        for i, name in enumerate(CHANNELS)
    ]
    pressure = float(pressure_dbar(depth_m))
    text = field_table(
        f"{temperature_c:g} C, {salinity_psu:g} psu, {depth_m:g} m deep ({pressure:.1f} dbar), "
        f"Jerlov {jerlov}",
        _COLUMNS,
        rows,
        ["n relative to air: Quan & Fry 1995, pressure after Millard & Seaver 1990; K_d: Jerlov "
         "1976; a and b from K_d after Kirk 1984"],
    )  # fmt: skip
    data = {
        "temperature_c": temperature_c,
        "salinity_psu": salinity_psu,
        "depth_m": depth_m,
        "pressure_dbar": pressure,
        "jerlov": jerlov,
        "rows": rows,
    }
    return text, data


def channel_cameras(
    camera: Camera,
    *,
    temperature_c: float,
    salinity_psu: float,
    depth_m: float,
    wavelengths_nm: Sequence[float] | Array = WAVELENGTH_NM,
) -> dict[str, Camera]:
    """The camera as its red, green and blue channels see.

    The camera's own indices, mostly calibrated, apply to green; for red and blue they change by as
    much as those of the water and of BK7 do.

    Args:
        camera: as calibrated; green.
        temperature_c: temperature of the water.
        salinity_psu: salinity of the water.
        depth_m: below the surface.
        wavelengths_nm: wavelengths of red, green and blue.

    Raises:
        ConfigError: water or wavelengths are out of range or not three.
    """
    nm = np.asarray(wavelengths_nm, dtype=np.float64)
    if nm.shape != (3,) or not np.all(np.diff(nm) < 0):
        raise ConfigError(f"wavelengths {nm} nm: give three, of red, green and blue, falling")
    water = n_water(temperature_c, salinity_psu, depth_m, nm)
    port = n_glass(nm)
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


def n_glass(wavelength_nm: ArrayLike) -> Array:
    """Index of refraction of a port's glass (BK7), relative to air, by Sellmeier's equation.

    Args:
        wavelength_nm: any shape, 380 to 1050.

    Raises:
        ConfigError: a wavelength is out of range.
    """
    nm = np.asarray(wavelength_nm, dtype=np.float64)
    if not np.all((nm >= 380.0) & (nm <= 1050.0)):
        raise ConfigError(f"wavelength {nm} nm: glasses are known from 380 to 1050 nm")
    square_um = (nm * 1e-3) ** 2
    terms = (b * square_um / (square_um - c) for b, c in _BK7)
    return np.sqrt(1.0 + sum(terms, start=np.zeros_like(square_um)))
