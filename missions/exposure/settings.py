"""Camera and strobe settings that an altitude, a speed and an overlap ask for."""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, Self

from alice_survey.core.artefacts import json_values
from alice_survey.core.config import (
    CameraConfig,
    ImagingConfig,
    PlanConfig,
    WaterConfig,
)
from alice_survey.core.errors import warn
from camera_calib.rig import Rig, design_rig
from camera_calib.water import water_optics
from missions.exposure.focus import Focus, aperture_warning, plan_focus
from missions.exposure.footprints import (
    FootprintRange,
    Spacing,
    footprint_range,
    line_spacing,
)
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
from missions.exposure.trigger import (
    BlurRates,
    PaperRule,
    blur_rates,
    exposure_for_rate,
    paper_rule,
    trigger_interval_s,
)
from missions.values.footprint import footprint_size_m, overlap

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
    frame_j: float
    """Battery energy of the strobes for one trigger."""
    paper_rule: PaperRule
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
        frame_j=load.frame_j,
        paper_rule=paper_rule(plan, along_m),
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
