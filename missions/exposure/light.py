"""Light budget: from the strobes' lumens to electrons in a pixel, channel by channel.

And of two strobes next to a camera: light that the water throws back, and the shadows they cast.

Each strobe sends `I(angle) = I_0 cos(angle)` within its cone, `I_0 = P / (pi sin^2(half cone))`.
A level floor of reflectance rho (Lambert) at the distances d from a strobe and s along the pixel's
ray gets `E = sum I cos(in) / d^2 exp(-k d)` and sends back `L = rho E / pi exp(-m s)`; of the
scattering b, k = c - LIT_SHARE b and m = c - SEEN_SHARE b leave out what is scattered forward
(below). Light that counts as detail is `L = rho E / pi exp(-c s)`. On
the way to the sensor L falls by `T_port / n^2`; it gives the irradiance `pi L T_lens / (4 N^2)
cos^4`.

Assumed: no daylight; each channel takes 100 nm of the LEDs' spectrum (`watts_per_lumen`), with the
water of its middle, and has the whole quantum efficiency; sand as in the simulator. The
simulator (`alice_survey.sim.seafloor`) computes by ray, with a soft edge of the cone, an even
spectrum and all scattered light lost but for the veil: its pictures have the light of `c` both
ways, and lack the blur of what is scattered on the way from the floor. Tests compare
the two on these terms.

Scattering forward turns most light by a few degrees only. Turned by the angle t on its way, it is
lost to the point or the pixel that it was sent to, but neighbours' light arrives in its place. Of
light scattered once, the share that arrives is, averaged over the place of the turn:

- on a level floor, from a strobe that shines as the cosine of its angle: `pi integral p(t) (sin t +
  t cos t) dt` from 0 to 90 degrees. In the plane through strobe, turn and point, with the angles u
  and v of the light's two legs against the straight line between strobe and point, u + v = t, a
  volume `dV / (r1^2 r2^2) = du dv dphi / d`, and intensity and incidence are weakened by cos u and
  cos v on average over phi; the integral of cos u cos v over u is half the bracket.
- in a camera that looks down on that floor, lit as cos^4 by a strobe at its side: `pi integral p(t)
  cos t (sin t cos t + t) dt`, as the floor is darker where turned light comes from.

Turns follow each other independently (small angles; Wells 1973, AGARD LS-61), so that n turns keep
the n-th power, and a path x that has `exp(-c x)` of its light unscattered has `exp(-(c - share b)
x)` in all: the form of Gordon's quasi-single scattering (1973, Applied Optics 12, 2803). Longer
ways of turned light are left out. A Monte Carlo of photons judges it in `tests/missions/exposure`.

What is turned on its way from the floor lights a pixel with its neighbours' light: it counts in
electrons, and blurs; only what stays within the pixel's own cone is detail.
"""

import math
from dataclasses import dataclass

import numpy as np

from alice_survey.core.config import CameraConfig, ImagingConfig
from alice_survey.core.frames import Array
from camera_calib.rig import Rig
from camera_calib.water import ASYMMETRY, WAVELENGTH_NM, WaterOptics, phase_per_sr

FLOOR_REFLECTANCE = np.array([0.40, 0.345, 0.255])
"""Red, green and blue of bare sand, as `alice_survey.sim.seafloor.texture.SAND_ALBEDO`."""
PORT_TRANSMITTANCE = 0.955
"""Fresnel at square incidence: 0.4 % from water to glass, 4.3 % from glass to air."""
LENS_TRANSMITTANCE = 0.9
"""Inferred: coated lens."""
MIDDLE_GREY = 0.2
"""Share of full scale, linear, that the median is brought to; as in the simulator."""

MIN_SNR = 5.0
"""Below it detail of a pixel is lost in noise (Rose 1948, J. Opt. Soc. Am. 38, 196)."""

_PLANCK_J_S, _LIGHT_M_S = 6.62607015e-34, 299_792_458.0
_GRID = (13, 11)
_STEPS = 400
"""Pieces of a ray of which scattered light is summed."""
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
"""Relative power of CIE illuminant LED-B3, every 5 nm: white light of a blue LED under phosphor,
4103 K (CIE 015:2018, Colorimetry, 4th edition), the nearest that CIE publishes to the 4000 K of
ALICE's (Gutnik et al. 2021, section III.B). A LED of another maker differs by some per cent."""
_ANGLES = np.linspace(0.0, math.pi / 2, 20_001)
_PHASE = phase_per_sr(np.cos(_ANGLES))

LIT_SHARE = float(
    math.pi * np.trapezoid(_PHASE * (np.sin(_ANGLES) + _ANGLES * np.cos(_ANGLES)), _ANGLES)
)
"""Share of the scattered light of a strobe that still lights the floor where it would have."""
SEEN_SHARE = float(
    math.pi
    * np.trapezoid(
        _PHASE * np.cos(_ANGLES) * (np.sin(_ANGLES) * np.cos(_ANGLES) + _ANGLES), _ANGLES
    )
)
"""Share of the scattered light of the floor that a pixel's neighbours give it back."""


def share_within(angle_rad: float) -> float:
    """Share of scattered light that is turned by less than an angle (Henyey-Greenstein)."""
    g = ASYMMETRY
    # 1 + g^2 - 2 g cos without its cancellation at small angles.
    far = math.sqrt((1.0 - g) ** 2 + 4.0 * g * math.sin(angle_rad / 2) ** 2)
    return (1.0 - g * g) / (2.0 * g) * (far - (1.0 - g)) / (far * (1.0 - g))


def watts_per_lumen() -> Array:
    """Radiant watts of an LED in red, green and blue for one lumen, (3,).

    Lumens are `683 integral(P V)`, with the CIE photopic curve as V = 1.019 exp(-285.4 (um -
    0.559)^2), which holds its integral to 0.1 %.
    """
    nm = np.linspace(380.0, 780.0, 801)
    power = np.interp(nm, LED_NM, LED_B3)
    photopic = 1.019 * np.exp(-285.4 * (nm * 1e-3 - 0.559) ** 2)
    lumens = _LUMENS_PER_WATT * np.trapezoid(power * photopic, nm)
    bands = [(nm >= low) & (nm <= high) for low, high in _BANDS_NM]
    return np.array([np.trapezoid(power[band], nm[band]) / lumens for band in bands])


@dataclass(frozen=True, kw_only=True)
class LightBudget:
    """Electrons of a pixel over level sand, and what follows for gain, aperture and exposure."""

    centre_e: tuple[float, float, float]
    """Red, green and blue, at the middle of the frame."""
    corner_e: tuple[float, float, float]
    """Electrons in the darkest corner."""
    median_e: float
    """Median of the mean of the channels over the frame."""
    sharp_share: tuple[float, float, float]
    """Share of the electrons at the middle that came from the floor unscattered, and are detail."""
    snr_centre: tuple[float, float, float]
    """Detail over shot noise, of all light from the floor, and read noise."""
    snr_median: float
    snr_corner: tuple[float, float, float]
    needed_light: float
    """Times the light with which the median pixel reaches `MIN_SNR`; infinite in the dark."""
    full_share: float
    """Brightest over full well."""
    gain_db: float
    """Gain that brings the median to middle grey of the full scale; 0 dB puts the full well there.
    """


def cone_intensity(cos_angle: Array, half_beam_rad: float) -> Array:
    """Intensity over radiant power, 1/sr: Lambert's cosine within a cone."""
    inside = np.where(cos_angle >= math.cos(half_beam_rad), cos_angle, 0.0)
    return inside / (math.pi * math.sin(half_beam_rad) ** 2)


@dataclass(frozen=True, kw_only=True, eq=False)
class FloorRadiance:
    """Radiance in water that the floor sends to pixels (...), W / (m^2 sr), by channel."""

    total: Array
    """(..., 3) with what the water scatters on the way from neighbours of the pixel's point."""
    sharp: Array
    """(..., 3) within the pixel's own cone."""


def floor_radiance(
    rig: Rig, imaging: ImagingConfig, water: WaterOptics, altitude_m: float, pixels: Array
) -> FloorRadiance:
    """Light that level sand sends to the reference camera.

    Without the lens's fall-off and the water's own light.

    Args:
        rig: with its place on the vehicle.
        imaging: the strobes; they point straight down.
        water: of the three channels.
        altitude_m: of the outer glass.
        pixels: (..., 2).
    """
    camera = rig.cameras[rig.reference]
    floor_z = float(camera.front_cam[2]) + altitude_m
    outer, directions = camera.unproject(pixels)
    path = (floor_z - outer[..., 2]) / directions[..., 2]
    points = outer + path[..., None] * directions
    down = rig.body_from_cam(rig.reference).inv().rotation.apply([0.0, 0.0, 1.0])
    power = imaging.strobe_lumens * watts_per_lumen()
    half_beam = math.radians(imaging.strobe_beam_deg) / 2
    irradiance = np.zeros((*path.shape, 3))
    for strobe in _strobes_cam(rig, imaging):
        away = points - strobe
        distance = np.linalg.norm(away, axis=-1)
        cos_beam = away @ down / distance
        # The floor is level: light meets it at the angle at which it leaves the strobe.
        falls = cone_intensity(cos_beam, half_beam) * cos_beam / distance**2
        loss = np.exp(-distance[..., None] * weakened_per_m(water, LIT_SHARE))
        irradiance += falls[..., None] * power * loss
    sent = FLOOR_REFLECTANCE / math.pi * irradiance
    # A circle as large as the pixel, in water.
    cone_rad = 1.0 / (math.sqrt(math.pi) * camera.fx_px * camera.n_water)
    sharp = weakened_per_m(water, share_within(cone_rad))
    return FloorRadiance(
        total=sent * np.exp(-path[..., None] * weakened_per_m(water, SEEN_SHARE)),
        sharp=sent * np.exp(-path[..., None] * sharp),
    )


def weakened_per_m(water: WaterOptics, kept: float) -> Array:
    """Attenuation (3,) of light of which a share of what is scattered counts as kept."""
    return water.absorption_per_m + (1.0 - kept) * water.scattering_per_m


def electrons_per_radiance(limits: CameraConfig, n_water: float, exposure_s: float) -> Array:
    """Electrons in a pixel on the axis for 1 W / (m^2 sr) in water, (3,)."""
    in_air = PORT_TRANSMITTANCE / n_water**2
    irradiance = math.pi * in_air * LENS_TRANSMITTANCE / (4.0 * limits.f_number**2)
    energy_j = irradiance * (limits.pixel_um * 1e-6) ** 2 * exposure_s
    photon_j = _PLANCK_J_S * _LIGHT_M_S / (WAVELENGTH_NM * 1e-9)
    return limits.quantum_efficiency * energy_j / photon_j


def lens_falloff(rig: Rig, pixels: Array) -> Array:
    """cos^4 of the angle in air between the axis and the rays of pixels (..., 2)."""
    camera = rig.cameras[rig.reference]
    offset = (pixels - [camera.cx_px, camera.cy_px]) / [camera.fx_px, camera.fy_px]
    return np.asarray(1.0 / (1.0 + (offset**2).sum(axis=-1)) ** 2)


def light_budget(
    rig: Rig,
    limits: CameraConfig,
    imaging: ImagingConfig,
    water: WaterOptics,
    altitude_m: float,
    exposure_s: float,
) -> LightBudget:
    """Electrons, noise, and the gain, aperture and exposure that follow.

    Args:
        rig: with its place on the vehicle.
        limits: lens and sensor.
        imaging: the strobes.
        water: of the three channels.
        altitude_m: of the outer glass.
        exposure_s: in which the strobes shine.
    """
    camera = rig.cameras[rig.reference]
    w, h = float(camera.width_px), float(camera.height_px)
    columns, rows = np.linspace(0, w, _GRID[0]), np.linspace(0, h, _GRID[1])
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1)
    gather = electrons_per_radiance(limits, camera.n_water, exposure_s)
    radiance = floor_radiance(rig, imaging, water, altitude_m, pixels)
    gather = gather * lens_falloff(rig, pixels)[..., None]
    electrons, sharp = radiance.total * gather, radiance.sharp * gather
    means = electrons.mean(axis=-1)
    darkest = min(((0, 0), (0, -1), (-1, 0), (-1, -1)), key=lambda at: float(means[at]))
    centre = (_GRID[1] // 2, _GRID[0] // 2)
    median, brightest = float(np.median(means)), float(electrons.max())
    median_share = float(np.median(sharp.mean(axis=-1))) / max(median, 1e-30)
    noise_e = limits.read_noise_e
    return LightBudget(
        centre_e=_triple(electrons[centre]),
        corner_e=_triple(electrons[darkest]),
        median_e=median,
        sharp_share=_triple(sharp[centre] / np.maximum(electrons[centre], 1e-30)),
        snr_centre=_triple(signal_to_noise(electrons[centre], noise_e, sharp[centre])),
        snr_median=float(signal_to_noise(np.array(median), noise_e, median_share * median)),
        snr_corner=_triple(signal_to_noise(electrons[darkest], noise_e, sharp[darkest])),
        needed_light=_needed_light(median, median_share, noise_e),
        full_share=brightest / limits.full_well_e,
        gain_db=20.0 * math.log10(MIDDLE_GREY * limits.full_well_e / max(median, 1e-9)),
    )


def signal_to_noise(electrons: Array, read_noise_e: float, sharp: Array | float) -> Array:
    """Detail over noise: sharp electrons over the shot noise of all and the read noise."""
    return sharp / np.sqrt(electrons + read_noise_e**2)


def darkness(budget: LightBudget) -> str:
    """What to say where the median pixel is lost in noise; empty where it does not."""
    if budget.snr_median >= MIN_SNR:
        return ""
    return f"too dark, signal to noise {budget.snr_median:.1f} of {MIN_SNR:g}"


def light_for_snr_e(snr: float, read_noise_e: float, sharp_share: float) -> float:
    """Electrons that have a signal to noise, if a share of them is sharp: see `signal_to_noise`."""
    level = snr / sharp_share
    return (level**2 + math.sqrt(level**4 + 4.0 * level**2 * read_noise_e**2)) / 2.0


def _needed_light(median_e: float, sharp_share: float, read_noise_e: float) -> float:
    if not min(median_e, sharp_share) > 0.0:
        return math.inf
    return light_for_snr_e(MIN_SNR, read_noise_e, sharp_share) / median_e


def _triple(values: Array) -> tuple[float, float, float]:
    red, green, blue = (float(v) for v in values)
    return red, green, blue


@dataclass(frozen=True, kw_only=True)
class Scatter:
    """What the water between strobes, camera and floor does to a picture's middle."""

    veil_share: tuple[float, float, float]
    """Light thrown back over all light, at the middle of the frame; red, green, blue."""
    lit_from_m: float
    """Distance below the glass from which any strobe lights the axis of the camera."""
    lit_share: float
    """Share of the water column on the axis, from glass to floor, that a strobe lights."""


@dataclass(frozen=True, kw_only=True)
class Shadows:
    """What the strobes' places do to an object on the floor below the camera."""

    length_m: tuple[float, ...]
    """Length of the shadow that each strobe casts of an object."""
    height_m: float
    """Height of that object."""
    between_deg: float
    """Angle at the floor between the two strobes' light (the largest of any two); 0 of one."""
    opposite: bool
    """Whether two strobes stand on opposite sides, so that each lights the other's shadow."""


def scatter(rig: Rig, imaging: ImagingConfig, water: WaterOptics, altitude_m: float) -> Scatter:
    """Backscatter on the axis of the reference camera, and the water that is lit.

    Args:
        rig: with its place on the vehicle.
        imaging: the strobes; they point straight down.
        water: of the three channels.
        altitude_m: of the outer glass.
    """
    camera = rig.cameras[rig.reference]
    strobes = _strobes_cam(rig, imaging)
    half_beam = math.radians(imaging.strobe_beam_deg) / 2
    glass_z = float(camera.front_cam[2])
    veil = veil_radiance(rig, imaging, water, altitude_m, weakened_per_m(water, LIT_SHARE))
    centre = np.array([camera.cx_px, camera.cy_px])
    signal = floor_radiance(rig, imaging, water, altitude_m, centre).total
    share = np.divide(veil, veil + signal, out=np.zeros(3), where=veil + signal > 0)
    path = _axis_paths(altitude_m)
    reached = [strobe[2] + _reach(strobe) / math.tan(half_beam) - glass_z for strobe in strobes]
    lit = np.any([path >= start for start in reached], axis=0)
    return Scatter(
        veil_share=_triple(share),
        lit_from_m=max(0.0, min(reached)),
        lit_share=float(np.sum(np.diff(path) * (lit[1:] & lit[:-1])) / altitude_m),
    )


def veil_radiance(
    rig: Rig,
    imaging: ImagingConfig,
    water: WaterOptics,
    altitude_m: float,
    attenuation_per_m: Array,
) -> Array:
    """Radiance (3,) that water throws back along the axis of the reference camera, W / (m^2 sr).

    Every piece of the ray sends `E(s) b p(angle) exp(-k s) ds` (as `seafloor.light`, summed here by
    the trapezium rule on a finer grid near the glass).

    Args:
        rig: with its place on the vehicle.
        imaging: the strobes; they point straight down.
        water: of the three channels.
        altitude_m: of the outer glass.
        attenuation_per_m: (3,) of light to and from the water.
    """
    half_beam = math.radians(imaging.strobe_beam_deg) / 2
    path = _axis_paths(altitude_m)
    glass_z = float(rig.cameras[rig.reference].front_cam[2])
    points = np.stack([0 * path, 0 * path, glass_z + path], axis=1)
    sent = np.zeros((len(path), 3))
    for strobe in _strobes_cam(rig, imaging):
        away = points - strobe
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        cos_beam = away[:, 2] / distance
        turned = cone_intensity(cos_beam, half_beam) / distance**2 * phase_per_sr(-cos_beam)
        sent += turned[:, None] * np.exp(-(distance + path)[:, None] * attenuation_per_m)
    power = imaging.strobe_lumens * watts_per_lumen()
    return np.trapezoid(sent, path, axis=0) * power * water.scattering_per_m


def _axis_paths(altitude_m: float) -> Array:
    """Paths along the axis from glass to floor, close to each other near the glass."""
    return altitude_m * (np.arange(_STEPS + 1) / _STEPS) ** 2


def shadows(rig: Rig, imaging: ImagingConfig, altitude_m: float, height_m: float) -> Shadows:
    """Shadows of an object on a level floor below the camera.

    Args:
        rig: with its place on the vehicle.
        imaging: the strobes.
        altitude_m: of the outer glass.
        height_m: of the object.
    """
    camera = rig.cameras[rig.reference]
    floor_z = float(camera.front_cam[2]) + altitude_m
    strobes = _strobes_cam(rig, imaging)
    lengths = [
        height_m * _reach(s) / (floor_z - s[2] - height_m)
        if floor_z - s[2] > height_m
        else math.inf
        for s in strobes
    ]
    sideways = strobes[:, :2] @ strobes[:, :2].T
    to_strobes = strobes - np.array([0.0, 0.0, floor_z])
    unit = to_strobes / np.linalg.norm(to_strobes, axis=1)[:, None]
    cosines = np.clip(unit @ unit.T, -1.0, 1.0)
    return Shadows(
        length_m=tuple(lengths),
        height_m=height_m,
        between_deg=float(np.degrees(np.arccos(cosines.min()))),
        opposite=bool(sideways.min() < 0),
    )


def _strobes_cam(rig: Rig, imaging: ImagingConfig) -> Array:
    """Strobes in the reference camera's frame, (S, 3)."""
    places = np.asarray(imaging.strobes_body_m, dtype=np.float64)
    return np.asarray(rig.body_from_cam(rig.reference).inv().apply(places), dtype=np.float64)


def _reach(strobe: Array) -> float:
    """Distance of a strobe from the camera's axis."""
    return float(np.hypot(strobe[0], strobe[1]))
