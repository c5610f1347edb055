"""Camera and strobe settings that an altitude, a speed and an overlap ask for.

Every number stands as a row (`Setting`) with its equation, its source and the limit that bound it.
"""

from dataclasses import dataclass, fields, replace
from typing import Any, Self

from alice_survey.core.artefacts import json_values
from alice_survey.core.config import (
    CameraConfig,
    ImagingConfig,
    PlanConfig,
    SurveyConfig,
    WaterConfig,
)
from alice_survey.core.errors import PlanError, warn
from camera_calib.rig import Rig, design_rig
from camera_calib.water import water_optics
from missions.exposure.focus import Focus, focus_rows, plan_focus, too_open
from missions.exposure.footprints import (
    FootprintRange,
    Spacing,
    footprint_range,
    footprint_rows,
    line_spacing,
    spacing_rows,
)
from missions.exposure.light import (
    LightBudget,
    light_budget,
    light_rows,
    scatter,
    scatter_rows,
    shadows,
    too_dark,
)
from missions.exposure.settings_table import Setting
from missions.exposure.storage import Storage, storage_load, storage_rows
from missions.exposure.strobe import StrobeLoad, strobe_load, strobe_rows
from missions.exposure.trigger import (
    EXPOSURE_STEP_S,
    BlurRates,
    PaperRule,
    blur_rates,
    exposure_for_rate,
    exposure_rows,
    interval_for_overlap_s,
    paper_rule,
    too_fast,
    trigger_rows,
)
from missions.values.footprint import footprint_size_m, overlap

_DARK = 1000.0
"""More than so many times the light that a picture gets is none that it can be given."""


@dataclass(frozen=True, kw_only=True)
class ImagingSetup:
    """What imaging settings follow from: the overlaps wanted, cameras, water and strobes."""

    plan: PlanConfig
    camera: CameraConfig
    water: WaterConfig
    imaging: ImagingConfig

    @classmethod
    def of(cls, survey: SurveyConfig) -> Self:
        """The setup of a survey."""
        return cls(
            plan=survey.plan, camera=survey.camera, water=survey.water, imaging=survey.imaging
        )

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
    spacing: Spacing
    blur: BlurRates
    focus: Focus
    light: LightBudget
    strobe: StrobeLoad
    storage: Storage
    rows: tuple[Setting, ...]

    @property
    def line_spacing_m(self) -> float:
        """How far apart lines lie."""
        return self.spacing.spacing_m

    def to_json(self) -> dict[str, Any]:
        """All fields as JSON values."""
        data = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "rows"}
        return {**json_values(data), "rows": [row.to_json() for row in self.rows]}


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
            names both and the cheapest ways out.
    """
    plan, limits, strobes, jerlov = setup.plan, setup.camera, setup.imaging, setup.water.jerlov
    camera, altitude_m = rig.cameras[rig.reference], plan.altitude_m
    along_m = footprint_size_m(camera, altitude_m)[1]
    interval_s = interval_for_overlap_s(along_m, plan)
    if interval_s < limits.shortest_interval_s:
        raise too_fast(camera, limits, plan, along_m)
    step_m = round(interval_s * plan.speed_mps, 9)
    prints = footprint_range(rig, plan, step_m)
    spacing = line_spacing(rig, plan, step_m)
    rates = blur_rates(rig, plan, altitude_m)
    exposure_s = exposure_for_rate(plan.allowed_blur_px, rates.combined)
    if exposure_s < EXPOSURE_STEP_S:
        raise PlanError(
            f"the sea floor moves {rates.combined:.3g} px a second over the sensor: "
            f"allowed_blur_px {plan.allowed_blur_px:g} needs an exposure below "
            f"{EXPOSURE_STEP_S * 1e6:g} us: raise allowed_blur_px, or lower speed_mps or the rates"
        )
    focus = plan_focus(camera, limits, plan)
    optics = water_optics(jerlov)
    budget = light_budget(rig, limits, strobes, optics, altitude_m, exposure_s)
    veil = scatter(rig, strobes, optics, altitude_m)
    shade = shadows(rig, strobes, altitude_m, plan.relief_m)
    load = strobe_load(strobes, plan, exposure_s, interval_s)
    storage = storage_load(camera, len(rig.cameras), interval_s)
    mean = prints.mean
    rows = (
        *footprint_rows(prints),
        *spacing_rows(spacing, plan, prints),
        *trigger_rows(plan, limits, along_m, prints.top.along_m, interval_s),
        *exposure_rows(plan, rates, exposure_s, mean.pixel_m),
        *focus_rows(focus, camera, limits, plan),
        *light_rows(budget, strobes, limits, jerlov, exposure_s),
        *scatter_rows(veil, shade),
        *strobe_rows(load),
        *storage_rows(storage, limits, interval_s),
    )
    if not quiet:
        for text in (
            too_open(focus, limits, plan),
            _dark(budget, jerlov),
            _near(plan),
            _gaps(spacing, prints, step_m),
            _slow_cable(storage, interval_s),
        ):
            if text:
                warn(text)
    return ImagingSettings(
        footprint_across_m=mean.across_m,
        footprint_along_m=mean.along_m,
        pixel_m=mean.pixel_m,
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
        spacing=spacing,
        blur=rates,
        focus=focus,
        light=budget,
        strobe=load,
        storage=storage,
        rows=rows,
    )


def _dark(budget: LightBudget, jerlov: str) -> str:
    """What to do about too little light; empty where there is enough."""
    fault = too_dark(budget)
    if not fault:
        return ""
    missing = "no light arrives"
    if budget.needed_light < _DARK:
        missing = f"{budget.needed_light:.1f} times the light is missing"
    return (
        f"pictures will be {fault} in Jerlov {jerlov} water: {missing}; lower altitude_m or "
        "speed_mps, or raise allowed_blur_px or the aperture"
    )


def _near(plan: PlanConfig) -> str:
    """Where the top of the relief comes nearer than is wanted of charted ground; else empty."""
    top_m = plan.altitude_m - plan.relief_m
    if top_m >= plan.least_clearance_m:
        return ""
    return (
        f"relief of +-{plan.relief_m:g} m comes within {top_m:.2f} m of the glass; "
        f"least_clearance_m is {plan.least_clearance_m:g}: raise altitude_m to "
        f"{plan.relief_m + plan.least_clearance_m:g}"
    )


def _gaps(spacing: Spacing, prints: FootprintRange, step_m: float) -> str:
    """Where the top of the relief is not seen by neighbours; empty where all is."""
    across, along = prints.top.across_m - spacing.spacing_m, prints.top.along_m - step_m
    if min(across, along) >= 0:
        return ""
    between = "lines" if across < along else "pictures"
    return (
        f"over the top of the relief, {prints.top.altitude_m:.2f} m below the glass, {between} "
        f"leave gaps of {-min(across, along):.2f} m: raise the overlap, or set overlap_over_relief"
    )


def _slow_cable(storage: Storage, interval_s: float) -> str:
    """Where one cable cannot carry all cameras; empty where it can."""
    if 1.0 / interval_s <= storage.shared_link_hz:
        return ""
    return (
        f"{1 / interval_s:.3g} triggers a second are more than the {storage.shared_link_hz:.3g} "
        "that one Gigabit cable carries of all cameras: give each a cable of its own"
    )
