"""Strobes: light that reaches a surface and the camera, directly and scattered once.

Positions are in the camera's frame, metres; strobes, camera and backscatter move with the vehicle,
so that the light in the water before a camera is computed once for a survey. Daylight is left out:
the survey is by night or deep. Three channels: red, green, blue.

From light at the pupil to grey values: lens, exposure, electrons, noise, gain, eight bits.

A pixel has a red, a green and a blue value of its own (no colour filter mosaic), each of one third
of the visible spectrum. Pixels `scale` times as large stand for `scale` squared of the sensor's,
added up. Grey values follow the sRGB curve, so that shadows keep their detail in eight bits. There
is one gain for all channels and all pictures of a survey, and no white balance.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from alice_survey.core.compiled import compiled
from alice_survey.core.config import CameraConfig, ImagingConfig
from alice_survey.core.frames import Array
from camera_calib.camera import Camera
from camera_calib.water import WAVELENGTH_NM, WaterOptics, phase_per_sr

LUMENS_PER_WATT = 683.0 * 106.86 / 300.0
"""White light of an even spectrum from 400 to 700 nm: 683 lm/W times the mean of the CIE photopic
curve, whose integral is 106.86 nm."""

_EDGE_RAD = math.radians(12.0)
"""Half the width over which the edge of a beam fades."""
_GRID = (25, 21)
_STEPS = 97
_DECAY = np.exp(-np.arange(4096) / 64.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraLight:
    """The strobes as one camera sees them, and the backscatter of the water."""

    positions_cam: Array
    """(S, 3) positions of the strobes."""
    axis_cam: Array
    """(3,) unit vector along which all strobes point."""
    beam_rad: float
    """Half the angle of the cone."""
    peak_w_per_sr: float
    """Radiant intensity of one strobe on its axis, in each channel."""
    attenuation_per_m: Array
    """(3,)."""
    reach_m: float
    """Path along the ray up to which `backscatter` is tabulated."""
    backscatter: Array
    """(rows, columns, steps, 3) radiance, W / (m^2 sr), of water up to the path
    `reach_m * (step / last)^2` along rays of an even grid of pixels over the whole frame."""


def camera_light(
    camera: Camera,
    body_from_cam: RigidTransform,
    imaging: ImagingConfig,
    water: WaterOptics,
    reach_m: float,
) -> CameraLight:
    """Put the strobes into a camera's frame and integrate the backscatter of its rays.

    Args:
        camera: the camera.
        body_from_cam: its place on the vehicle.
        imaging: strobes; they point down in the body's frame.
        water: optical properties.
        reach_m: longest path along a ray that will be requested.
    """
    positions = body_from_cam.inv().apply(np.asarray(imaging.strobes_body_m, dtype=np.float64))
    axis = body_from_cam.rotation.inv().apply([0.0, 0.0, 1.0])
    beam_rad = math.radians(imaging.strobe_beam_deg) / 2.0
    # A channel is a third of the spectrum.
    power_w = imaging.strobe_lumens / LUMENS_PER_WATT / 3.0
    peak = power_w / beam_solid_angle_sr(beam_rad)
    x = np.linspace(0.0, camera.width_px, _GRID[0])
    y = np.linspace(0.0, camera.height_px, _GRID[1])
    pixels = np.stack(np.meshgrid(x, y), axis=-1)
    origins, directions = camera.unproject(pixels)
    path = reach_m * (np.arange(_STEPS) / (_STEPS - 1.0)) ** 2
    table = np.stack([
        backscatter_along(o, d, path, positions, axis, beam_rad, peak, water)
        for o, d in zip(origins.reshape(-1, 3), directions.reshape(-1, 3), strict=True)
    ])  # fmt: skip
    return CameraLight(
        positions_cam=positions,
        axis_cam=axis,
        beam_rad=beam_rad,
        peak_w_per_sr=peak,
        attenuation_per_m=water.attenuation_per_m,
        reach_m=reach_m,
        backscatter=table.reshape(_GRID[1], _GRID[0], _STEPS, 3),
    )


def backscatter_along(
    origin: Array,
    direction: Array,
    path_m: Array,
    strobes: Array | Sequence[Sequence[float]],
    axis: Array,
    beam_rad: float,
    peak_w_per_sr: float,
    water: WaterOptics,
) -> Array:
    """Radiance that water scatters once from strobes into a ray, up to each of some paths.

    Every piece of the ray sends `E(s) b p(angle) exp(-c s) ds`, with `E` the light of each strobe
    there; a trapezium rule sums them.

    Args:
        origin: (3,) where the ray leaves the glass.
        direction: (3,) unit vector.
        path_m: (P,) rising paths along the ray, from 0.
        strobes: (S, 3) positions.
        axis: (3,) unit vector along which they point.
        beam_rad: half the angle of their cone.
        peak_w_per_sr: intensity on the axis.
        water: optical properties.

    Returns:
        (P, 3) W / (m^2 sr).
    """
    points = origin + path_m[:, None] * direction
    attenuation = water.attenuation_per_m
    sent = np.zeros((len(path_m), 3))
    for strobe in np.asarray(strobes, dtype=np.float64):
        away = points - strobe
        distance = np.linalg.norm(away, axis=1)
        cos_beam = away @ axis / distance
        turned = -(away @ direction) / distance
        strength = np.array([beam_profile(c, beam_rad) for c in cos_beam]) / distance**2
        travelled = distance + path_m
        sent += (strength * phase_per_sr(turned))[:, None] * np.exp(
            -travelled[:, None] * attenuation
        )
    sent *= peak_w_per_sr * water.scattering_per_m
    pieces = 0.5 * (sent[1:] + sent[:-1]) * np.diff(path_m)[:, None]
    return np.concatenate([np.zeros((1, 3)), np.cumsum(pieces, axis=0)])


def beam_solid_angle_sr(beam_rad: float) -> float:
    """Power of a strobe over its intensity on the axis: the integral of its profile."""
    angle = np.linspace(0.0, min(beam_rad + _EDGE_RAD, math.pi / 2.0), 20_001)
    profile = np.array([beam_profile(math.cos(a), beam_rad) for a in angle])
    return float(np.trapezoid(2.0 * math.pi * profile * np.sin(angle), angle))


@compiled
def beam_profile(cos_angle: float, beam_rad: float) -> float:
    """Intensity of a strobe off its axis over that on it: Lambert's cosine within a soft cone."""
    if cos_angle <= 0.0:
        return 0.0
    t = (beam_rad + _EDGE_RAD - math.acos(min(cos_angle, 1.0))) / (2.0 * _EDGE_RAD)
    t = min(max(t, 0.0), 1.0)
    return cos_angle * t * t * (3.0 - 2.0 * t)


@compiled(inline="always")
def _decay(x: float) -> float:
    """exp(-x), for x from 0, to 2e-14 of itself; exp(-64) beyond that."""
    x = min(x, 63.99)
    k = np.uint32(np.int32(x * 64.0))
    r = x - k / 64.0
    left: float = _DECAY[k] * (
        1.0 - r * (1.0 - r * (1.0 / 2 - r * (1.0 / 6 - r * (1.0 / 24 - r * (1.0 / 120)))))
    )
    return left


@compiled(error_model="numpy")
def add_direct(
    points: Array,
    normals: Array,
    path_m: Array,
    lit: Array,
    strobes: Array,
    axis: Array,
    beam_rad: float,
    peak: float,
    attenuation: Array,
    out: Array,
) -> None:
    """Add what strobes send to places, weakened on the way there and on the way to the camera.

    Irradiance of a surface is `I cos(incidence) / d^2 exp(-c d)`.

    Args:
        points: (3, N) in the frame of the strobes, metres.
        normals: (3, N) unit normals of the surface there.
        path_m: (N,) from there to the camera.
        lit: (S, N) how much of each strobe can be seen from there, 0 to 1.
        strobes: (S, 3) positions.
        axis: (3,) along which they point.
        beam_rad: half the angle of their cone.
        peak: intensity on the axis, W / sr.
        attenuation: (3,) 1 / m.
        out: (3, N) W / m^2, changed in place.
    """
    count = points.shape[1]
    x, y, z = points
    nx, ny, nz = normals
    distance, sent = np.empty(count), np.empty(count)
    full = math.cos(max(beam_rad - _EDGE_RAD, 0.0))
    # Each loop reads and writes few arrays, so that the compiler vectorises it.
    for k in range(len(strobes)):
        sx, sy, sz = strobes[k]
        for i in range(count):
            vx, vy, vz = sx - x[i], sy - y[i], sz - z[i]
            distance[i] = math.sqrt(vx * vx + vy * vy + vz * vz)
        for i in range(count):
            along = axis[0] * (x[i] - sx) + axis[1] * (y[i] - sy) + axis[2] * (z[i] - sz)
            sent[i] = along / distance[i]
        for i in range(count):
            cosine = sent[i]  # most are well within the cone, where no arc cosine is needed
            sent[i] = lit[k, i] * (cosine if cosine >= full else beam_profile(cosine, beam_rad))
        for i in range(count):
            along = nx[i] * (sx - x[i]) + ny[i] * (sy - y[i]) + nz[i] * (sz - z[i])
            sent[i] *= peak * max(along, 0.0) / (distance[i] * distance[i] * distance[i])
        for channel in range(3):
            received, per_m = out[channel], attenuation[channel]
            for i in range(count):
                received[i] += sent[i] * _decay(per_m * (distance[i] + path_m[i]))


@compiled
def backscatter_of_row(table: Array, row: float, out: Array) -> None:
    """Interpolate the backscatter between two rows of its grid.

    Args:
        table: see `CameraLight.backscatter`.
        row: place in the grid, 0 to rows - 1.
        out: (columns, steps, 3) W / (m^2 sr), overwritten.
    """
    i = min(int(row), len(table) - 2)
    v = row - i
    for j in range(out.shape[0]):
        for k in range(out.shape[1]):
            for channel in range(3):
                out[j, k, channel] = (1.0 - v) * table[i, j, k, channel] + v * (
                    table[i + 1, j, k, channel]
                )


@compiled(error_model="numpy")
def backscatter_at(of_row: Array, reach_m: float, column: float, path_m: float, out: Array) -> None:
    """Look up the backscatter of a ray: linear between rays of the grid and between paths.

    Args:
        of_row: what `backscatter_of_row` gave.
        reach_m: see `CameraLight`.
        column: place in the grid, 0 to columns - 1.
        path_m: along the ray; beyond the table's reach its last value counts.
        out: (3,) W / (m^2 sr), overwritten.
    """
    columns, steps, _ = of_row.shape
    step = math.sqrt(min(max(path_m / reach_m, 0.0), 1.0)) * (steps - 1)
    j, k = min(int(column), columns - 2), min(int(step), steps - 2)
    u, w = column - j, step - k
    for channel in range(3):
        near = (1.0 - u) * of_row[j, k, channel] + u * of_row[j + 1, k, channel]
        far = (1.0 - u) * of_row[j, k + 1, channel] + u * of_row[j + 1, k + 1, channel]
        out[channel] = near + w * (far - near)


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
