"""Camera and strobe settings that an altitude, a speed and an overlap ask for.

The interval follows from the footprint; the exposure from the motion of the sea floor over the
sensor, from speed and attitude rates. While the vehicle moves with (u, 0, 0) and turns with (p, q,
r), a point of the sea floor at P in the body's frame moves by -(u, 0, 0) - (p, q, r) x P; the exact
flat-port camera's slopes take that to pixels a second. So a level camera sees `u / pixel` from
speed; about `H p / pixel` (the water's index within: pixel = D / f with D nearly H / n) at the
centre from roll or pitch; and `corner radius * r` at the corners from yaw, plus the sideways motion
of a camera ahead of the vehicle's centre.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from itertools import product
from typing import Any, Self

import numpy as np

from alice_survey.core.artefacts import json_values
from alice_survey.core.config import CameraConfig, ImagingConfig, PlanConfig, WaterConfig
from alice_survey.core.errors import PlanError, warn
from alice_survey.core.frames import Array
from camera_calib.rig import Rig, design_rig
from camera_calib.water import water_optics
from missions.exposure.conflict import conflict
from missions.exposure.focus import Focus, aperture_warning, plan_focus
from missions.exposure.footprints import FootprintRange, Spacing, footprint_range, line_spacing
from missions.exposure.light import (
    LightBudget,
    Scatter,
    Shadows,
    darkness,
    light_budget,
    scatter,
    shadows,
)
from missions.exposure.strobe import Storage, StrobeLoad, storage_load, strobe_load
from missions.values.footprint import footprint_size_m, overlap, step_for_overlap

EXPOSURE_STEP_S = 1e-5


def floor_to(value: float, step: float) -> float:
    """The largest multiple of a step that is not above the value (up to rounding)."""
    return round(math.floor(value / step + 1e-6) * step, 9)


def trigger_interval_s(limits: CameraConfig, plan: PlanConfig, along_m: float) -> float:
    """Longest interval between pictures that overlap as requested, in steps of 1 ms.

    Args:
        limits: the shortest interval of camera and trigger controller.
        plan: speed and forward overlap.
        along_m: footprint along the track.

    Raises:
        PlanError: the camera cannot take pictures as fast.
    """
    step_m, min_s = step_for_overlap(along_m, plan.forward_overlap), limits.shortest_interval_s
    interval_s = floor_to(step_m / plan.speed_mps, 1e-3)
    if interval_s < min_s:
        raise conflict(
            f"{plan.forward_overlap:.0%} forward overlap at {plan.speed_mps:g} m/s and "
            f"{plan.altitude_m:g} m altitude needs {plan.speed_mps / step_m:.3g} pictures a "
            f"second, the camera takes {1 / min_s:.3g}",
            ("forward_overlap x speed_mps / footprint", "camera.shortest_interval_s"),
            "plan.speed_mps", floor_to(step_m / min_s, 1e-3),
        )  # fmt: skip
    return interval_s


@dataclass(frozen=True, kw_only=True)
class BlurRates:
    """How fast the sea floor moves over the sensor, px/s."""

    speed: float
    """Motion at the centre, from speed over ground."""
    speed_worst: float
    """Motion from speed in the worst pixel: the port magnifies towards the corners."""
    roll_pitch: float
    """Motion at the centre, from roll and pitch, each at its rate, in quadrature."""
    yaw: float
    """Motion at the worst corner, from yaw."""
    combined: float
    """All, in quadrature (rates are taken for independent standard deviations), in the worst of
    the frame's centre, corners and middles of sides."""
    worst: float
    """All at once with the worst signs, at the same place."""


def blur_rates(rig: Rig, plan: PlanConfig, altitude_m: float) -> BlurRates:
    """Motion over the sensor of the reference camera over level ground.

    Args:
        rig: with its place on the vehicle.
        plan: speed and rates.
        altitude_m: of the outer glass.
    """
    camera = rig.cameras[rig.reference]
    w, h = float(camera.width_px), float(camera.height_px)
    centre = [camera.cx_px, camera.cy_px]
    corners = [[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]]
    sides = [[w / 2, 0.0], [w, h / 2], [w / 2, h], [0.0, h / 2]]
    pixels = np.array([centre, *corners, *sides])
    points_cam = camera.at_depth(pixels, camera.front_cam[2] + altitude_m)
    body_from_cam = rig.body_from_cam(rig.reference)
    points_body = body_from_cam.apply(points_cam)
    slopes = camera.project_jacobian(points_cam)[1]
    cam_from_body = body_from_cam.rotation.inv()
    about = math.radians(plan.roll_pitch_rate_deg_s)
    rates = np.diag([about, about, math.radians(plan.yaw_rate_deg_s)])

    def on_sensor(velocity_body: Array) -> Array:
        return np.asarray(np.einsum("nij,nj->ni", slopes, cam_from_body.apply(velocity_body)))

    forward = on_sensor(np.tile([-plan.speed_mps, 0.0, 0.0], (len(pixels), 1)))
    turning = np.stack([on_sensor(-np.cross(rate, points_body)) for rate in rates])
    size = np.linalg.norm(turning, axis=2)
    combined = np.sqrt((forward**2).sum(axis=1) + (size**2).sum(axis=0))
    worst = max(
        float(np.linalg.norm(forward + np.tensordot(signs, turning, 1), axis=1).max())
        for signs in product((-1.0, 1.0), repeat=3)
    )
    return BlurRates(
        speed=float(np.linalg.norm(forward[0])),
        speed_worst=float(np.linalg.norm(forward, axis=1).max()),
        roll_pitch=float(np.hypot(size[0, 0], size[1, 0])),
        yaw=float(size[2, 1:5].max()),
        combined=float(combined.max()),
        worst=worst,
    )


def exposure_for_rate(allowed_blur_px: float, rate_px_per_s: float) -> float:
    """Longest exposure, in steps of 10 us, in which the sea floor moves no more than allowed.

    Raises:
        PlanError: it is shorter than a step.
    """
    exposure_s = floor_to(allowed_blur_px / rate_px_per_s, EXPOSURE_STEP_S)
    if exposure_s < EXPOSURE_STEP_S:
        raise PlanError(
            f"the sea floor moves {rate_px_per_s:.3g} px a second over the sensor: "
            f"allowed_blur_px {allowed_blur_px:g} needs an exposure below "
            f"{EXPOSURE_STEP_S * 1e6:g} us: raise allowed_blur_px, or lower speed_mps or the rates"
        )
    return exposure_s


_DARK = 1000.0
"""More than so many times the light that a picture gets is none that it can be given."""


@dataclass(frozen=True, kw_only=True)
class ImagingSetup:
    """What imaging settings follow from: the overlaps requested, cameras, water and strobes."""

    plan: PlanConfig
    camera: CameraConfig
    water: WaterConfig
    imaging: ImagingConfig

    @property
    def rig(self) -> Rig:
        """The cameras as designed, in water."""
        return design_rig(self.camera, self.water)

    def with_camera(self, **values: float) -> Self:
        """The same setup with settings of the cameras changed."""
        return replace(self, camera=self.camera.model_copy(update=values))

    def with_plan(self, **values: float | None) -> Self:
        """The same setup with settings of the plan changed."""
        return replace(self, plan=self.plan.model_copy(update=values))


@dataclass(frozen=True, kw_only=True)
class ImagingSettings:
    """When to expose, for how long, with how much light, and how far apart lines lie."""

    footprint_across_m: float
    footprint_along_m: float
    pixel_m: float
    """The central pixel on the sea floor (paraxial)."""
    exposure_s: float
    blur_px: float
    """Blur in the worst pixel, from speed and attitude rates in quadrature."""
    interval_s: float
    shortest_interval_s: float
    """Shortest interval of camera and trigger controller."""
    station_spacing_m: float
    forward_overlap: float
    """Forward overlap as reached, of the rectangles that pictures surely see."""
    strobe_pulse_s: float
    strobe_lead_s: float
    strobe_duty: float
    """Share of the time for which the strobe is lit."""
    imaging_w: float
    """Mean power of the strobes from the battery while a line is flown; cameras and recorder are
    in `vehicle.hotel_w`."""
    footprints: FootprintRange
    spacing: Spacing
    blur: BlurRates
    focus: Focus
    light: LightBudget
    scatter: Scatter
    shadows: Shadows
    strobe: StrobeLoad
    storage: Storage

    @property
    def line_spacing_m(self) -> float:
        """How far apart lines lie."""
        return self.spacing.spacing_m

    def to_json(self) -> dict[str, Any]:
        """All fields as JSON values."""
        data: dict[str, Any] = json_values({f.name: getattr(self, f.name) for f in fields(self)})
        return data


def imaging_settings(rig: Rig, setup: ImagingSetup, *, quiet: bool = False) -> ImagingSettings:
    """Every setting of cameras, strobes and lines that meets the plan.

    Warns of what will be poor: an aperture too open, too little light, gaps over the relief, a
    cable too slow.

    Args:
        rig: the cameras in water; the first is the reference, whose outer glass the altitude is of.
        setup: plan, camera, water and strobes.
        quiet: without the warnings.

    Raises:
        PlanError: limits conflict: frame rate, altitude, focus, strobe or track error; the message
            names both, and the value of a setting that fits.
    """
    plan, limits, strobes = setup.plan, setup.camera, setup.imaging
    camera, altitude_m = rig.cameras[rig.reference], plan.altitude_m
    along_m = footprint_size_m(camera, altitude_m)[1]
    interval_s = trigger_interval_s(limits, plan, along_m)
    step_m = round(interval_s * plan.speed_mps, 9)
    prints = footprint_range(rig, plan, step_m)
    spacing = line_spacing(rig, plan, step_m)
    rates = blur_rates(rig, plan, altitude_m)
    exposure_s = exposure_for_rate(plan.allowed_blur_px, rates.combined)
    optics = water_optics(setup.water.jerlov)
    focus = plan_focus(camera, limits, plan)
    load = strobe_load(strobes, plan, exposure_s, interval_s)
    found = ImagingSettings(
        footprint_across_m=prints.mean.across_m,
        footprint_along_m=prints.mean.along_m,
        pixel_m=prints.mean.pixel_m,
        exposure_s=exposure_s,
        blur_px=rates.combined * exposure_s,
        interval_s=interval_s,
        shortest_interval_s=limits.shortest_interval_s,
        station_spacing_m=step_m,
        forward_overlap=overlap(along_m, step_m),
        strobe_pulse_s=load.pulse_s,
        strobe_lead_s=plan.strobe_lead_s,
        strobe_duty=load.duty,
        imaging_w=load.mean_w,
        footprints=prints,
        spacing=spacing,
        blur=rates,
        focus=focus,
        light=light_budget(rig, limits, strobes, optics, altitude_m, exposure_s),
        scatter=scatter(rig, strobes, optics, altitude_m),
        shadows=shadows(rig, strobes, altitude_m, plan.relief_m),
        strobe=load,
        storage=storage_load(camera, len(rig.cameras), interval_s),
    )
    if not quiet:
        for text in _warnings(found, setup):
            warn(text)
    return found


def _warnings(found: ImagingSettings, setup: ImagingSetup) -> Iterator[str]:
    """What will be poor."""
    plan, top, light = setup.plan, found.footprints.top, found.light
    if text := aperture_warning(found.focus, setup.camera, plan):
        yield text
    if fault := darkness(light):
        missing = "no light arrives"
        if light.needed_light < _DARK:
            missing = f"{light.needed_light:.1f} times the light is missing"
        yield (
            f"pictures will be {fault} in Jerlov {setup.water.jerlov} water: {missing}; lower "
            "altitude_m or speed_mps, or raise allowed_blur_px or the aperture"
        )
    if plan.altitude_m - plan.relief_m < plan.least_clearance_m:
        yield (
            f"relief of +-{plan.relief_m:g} m comes within {top.altitude_m:.2f} m of the glass; "
            f"least_clearance_m is {plan.least_clearance_m:g}: raise altitude_m to "
            f"{plan.relief_m + plan.least_clearance_m:g}"
        )
    across = top.across_m - found.line_spacing_m
    along = top.along_m - found.station_spacing_m
    if min(across, along) < 0:
        between = "lines" if across < along else "pictures"
        yield (
            f"over the top of the relief, {top.altitude_m:.2f} m below the glass, {between} leave "
            f"gaps of {-min(across, along):.2f} m: raise the overlap, or set overlap_over_relief"
        )
    if 1.0 / found.interval_s > found.storage.shared_link_hz:
        yield (
            f"{1 / found.interval_s:.3g} triggers a second are more than the "
            f"{found.storage.shared_link_hz:.3g} that one Gigabit cable carries of all cameras: "
            "give each a cable of its own"
        )
