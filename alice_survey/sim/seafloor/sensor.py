"""From light at the pupil to grey values: lens, exposure, electrons, noise, gain, eight bits.

A pixel has a red, a green and a blue value of its own (no colour filter mosaic), each of one third
of the visible spectrum. Pixels `scale` times as large stand for `scale` squared of the sensor's,
added up. Grey values follow the sRGB curve, so that shadows keep their detail in eight bits. There
is one gain for all channels and all pictures of a survey, and no white balance.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.config import CameraConfig
from alice_survey.core.frames import Array
from camera_calib.water import WAVELENGTH_NM

Floats = NDArray[np.float32]

PORT_TRANSMITTANCE = 0.955
"""Fresnel's loss at square incidence: 0.4 % from water to glass, 4.3 % from glass to air."""
LENS_TRANSMITTANCE = 0.9
_PLANCK_C_J_M = 1.98644586e-25
MIDDLE_GREY = 0.2
"""Share of the full scale, before the sRGB curve, that the median of a nominal picture gets."""


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Conversion of light to electrons, for one exposure time."""

    electrons_per_radiance: tuple[float, float, float]
    """Electrons in a pixel on the axis for 1 W / (m^2 sr) in water, red, green and blue."""
    full_well_e: float
    read_noise_e: float


def make_sensor(camera: CameraConfig, n_water: float, exposure_s: float, scale: int) -> Sensor:
    """The sensor behind lens and port.

    Image irradiance of a lens is pi L T / (4 N^2) times cos^4 off the axis (which the renderer
    applies); radiance falls by n^2 when light leaves water for air (it spreads over a larger solid
    angle).

    Args:
        camera: pixel, lens, and noise as designed.
        n_water: index of the water.
        exposure_s: exposure time.
        scale: pixels are this many times larger than the sensor's.
    """
    radiance = PORT_TRANSMITTANCE / n_water**2
    irradiance = np.pi * radiance * LENS_TRANSMITTANCE / (4.0 * camera.f_number**2)
    energy_j = irradiance * (camera.pixel_um * 1e-6 * scale) ** 2 * exposure_s
    electrons = camera.quantum_efficiency * energy_j * WAVELENGTH_NM * 1e-9 / _PLANCK_C_J_M
    red, green, blue = (float(e) for e in electrons)
    return Sensor(
        electrons_per_radiance=(red, green, blue),
        full_well_e=camera.full_well_e * scale**2,
        read_noise_e=camera.read_noise_e * scale,
    )


def expose(radiance: Floats, sensor: Sensor, rng: np.random.Generator | None) -> Floats:
    """Electrons of a picture.

    Args:
        radiance: (H, W, 3) W / (m^2 sr) in water, with the lens's fall-off.
        sensor: the sensor.
        rng: source of shot noise (Poisson) and read noise (normal); None for neither.

    Returns:
        (H, W, 3), at most the full well.
    """
    mean = radiance * np.asarray(sensor.electrons_per_radiance, dtype=np.float32)
    if rng is None:
        return np.minimum(mean, np.float32(sensor.full_well_e))
    read = np.float32(sensor.read_noise_e) * rng.standard_normal(mean.shape, np.float32)
    caught = np.minimum(mean, np.float32(4.0 * sensor.full_well_e))
    # How many numbers a draw takes depends on its mean's last digits, which differ from machine to
    # machine: with a stream for each row, what follows elsewhere is the same.
    for row, own in zip(caught, rng.spawn(len(caught)), strict=True):
        row[:] = own.poisson(row)
    np.minimum(caught, np.float32(sensor.full_well_e), out=caught)
    caught += read
    return caught


def nominal_gain(nominal_electrons: Array, sensor: Sensor) -> float:
    """The survey's gain: share of full scale per electron.

    Args:
        nominal_electrons: (..., 3) electrons over the frame for a flat sea floor of mean colour at
            the planned altitude.
        sensor: its full well limits the gain from below: full scale is never beyond it.
    """
    middle = float(np.median(nominal_electrons.mean(axis=-1)))
    return max(MIDDLE_GREY / max(middle, 1e-3), 1.0 / sensor.full_well_e)


def develop(electrons: Floats, gain: float) -> NDArray[np.uint8]:
    """Grey values: gain, sRGB curve, eight bits; channels red, green, blue become blue, green, red.

    Args:
        electrons: (H, W, 3).
        gain: share of the full scale per electron.

    Returns:
        (H, W, 3) as OpenCV orders channels.
    """
    table = _curve()
    index = np.clip(
        electrons * np.float32(gain * (len(table) - 1)) + np.float32(0.5), 0, len(table) - 1
    )
    return np.ascontiguousarray(table[index.astype(np.uint16)][..., ::-1])


def _curve() -> NDArray[np.uint8]:
    linear = np.linspace(0.0, 1.0, 65_536)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.floor(255.0 * encoded + 0.5).astype(np.uint8)
