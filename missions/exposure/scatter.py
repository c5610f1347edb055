"""Two strobes next to a camera: light that the water throws back, and the shadows they cast."""

import math
from dataclasses import dataclass

import numpy as np

from alice_survey.base.config import ImagingConfig
from alice_survey.base.frames import Array
from camera_calib.rig import Rig
from camera_calib.water import WaterOptics, phase_per_sr
from missions.exposure.light import cone_intensity, floor_radiance, watts_per_lumen
from missions.exposure.settings_table import Setting
from missions.values.footprint import glass_point_cam

_STEPS = 400
_SOURCE = "missions.exposure.scatter: single scattering, Henyey-Greenstein 0.924 (Petzold)"


@dataclass(frozen=True, kw_only=True)
class Scatter:
    """What the water between strobes, camera and floor does to a picture's middle."""

    veil_share: tuple[float, float, float]
    """Light scattered once over all light, at the middle of the frame; red, green, blue."""
    lit_from_m: float
    """Distance below the glass from which any strobe lights the axis of the camera."""
    seen_lit_from_m: float
    """Distance below the glass from which any strobe lights any of the field of view."""
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
    """Backscatter on the axis of the reference camera, single scattering.

    Every piece of the ray sends `E(s) b p(angle) exp(-c s) ds` (as `seafloor.light`, summed here by
    the trapezium rule on a finer grid near the glass).

    Args:
        rig: with its place on the vehicle.
        imaging: the strobes; they point straight down.
        water: of the three channels.
        altitude_m: of the outer glass.
    """
    camera = rig.cameras[rig.reference]
    strobes = _strobes_cam(rig, imaging)
    half_beam = math.radians(imaging.strobe_beam_deg) / 2
    glass_z = float(glass_point_cam(camera)[2])
    path = altitude_m * (np.arange(_STEPS + 1) / _STEPS) ** 2
    points = np.stack([0 * path, 0 * path, glass_z + path], axis=1)
    power = imaging.strobe_lumens * watts_per_lumen("planck")
    sent = np.zeros((len(path), 3))
    lit = np.zeros(len(path), dtype=bool)
    for strobe in strobes:
        away = points - strobe
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        cos_beam = away[:, 2] / distance
        strength = cone_intensity(cos_beam, half_beam) / distance**2
        lit |= strength > 0
        turned = strength * phase_per_sr(-cos_beam)
        loss = np.exp(-(distance + path)[:, None] * water.attenuation_per_m)
        sent += turned[:, None] * power * water.scattering_per_m * loss
    veil = np.trapezoid(sent, path, axis=0)
    centre = np.array([camera.cx_px, camera.cy_px])
    signal = floor_radiance(rig, imaging, water, altitude_m, centre)
    share = veil / (veil + signal)
    return Scatter(
        veil_share=(float(share[0]), float(share[1]), float(share[2])),
        lit_from_m=min(
            max(0.0, _reach(strobe) / math.tan(half_beam) + strobe[2] - glass_z)
            for strobe in strobes
        ),
        seen_lit_from_m=_field_lit_from_m(rig, strobes, half_beam, altitude_m),
        lit_share=float(np.sum(np.diff(path) * (lit[1:] & lit[:-1])) / altitude_m),
    )


def _field_lit_from_m(rig: Rig, strobes: Array, half_beam: float, altitude_m: float) -> float:
    """First distance below the glass at which a cone of light meets the field of view."""
    camera = rig.cameras[rig.reference]
    outer, directions = camera.unproject(camera.border(16))
    glass_z = float(glass_point_cam(camera)[2])
    for below_m in np.linspace(0.0, altitude_m, 801):
        z = glass_z + below_m
        spots = outer + ((z - outer[:, 2]) / directions[:, 2])[:, None] * directions
        for strobe in strobes:
            radius = (z - strobe[2]) * math.tan(half_beam)
            nearest = _nearest_in_frame(spots[:, :2], strobe[:2])
            if radius > 0 and nearest <= radius:
                return float(below_m)
    return float(altitude_m)


def _nearest_in_frame(border: Array, place: Array) -> float:
    """Distance from a place to a frame that is given by points of its border; 0 inside."""
    low, high = border.min(axis=0), border.max(axis=0)
    outside = np.maximum(np.maximum(low - place, place - high), 0.0)
    return float(np.hypot(*outside))


def shadows(rig: Rig, imaging: ImagingConfig, altitude_m: float, height_m: float) -> Shadows:
    """Shadows of an object on a level floor below the camera.

    Args:
        rig: with its place on the vehicle.
        imaging: the strobes.
        altitude_m: of the outer glass.
        height_m: of the object.
    """
    camera = rig.cameras[rig.reference]
    floor_z = float(glass_point_cam(camera)[2]) + altitude_m
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


def scatter_rows(water: Scatter, shade: Shadows) -> list[Setting]:
    """Veiling light and shadows."""
    return [
        Setting(
            group="light",
            name="veil, centre",
            value=water.veil_share,
            unit="%",
            equation="B / (B + L)",
            source=_SOURCE,
            bound_by="strobe places",
            note="share of the light that the water throws back before it reached the floor, red / "
            f"green / blue. Strobes light the axis from {water.lit_from_m:.2f} m below the glass "
            f"on, the field of view from {water.seen_lit_from_m:.2f} m; {water.lit_share:.0%} of "
            "the water on the axis is lit",
        ),
        Setting(
            group="light",
            name="shadows",
            value=shade.length_m,
            unit="m",
            equation="h r / (H - h)",
            source="geometry of the strobes' places",
            bound_by="strobe places",
            note=f"of a thing {shade.height_m:g} m high below the camera, by each strobe; their "
            f"light meets there at {shade.between_deg:.0f} deg"
            + (" from both sides: each lights the other's shadow" if shade.opposite else ""),
        ),
    ]
