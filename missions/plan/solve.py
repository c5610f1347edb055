"""The plan solved the other way: for a resolution, the length of a dive or a frame rate."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from alice_survey.core.artefacts import json_values
from alice_survey.core.config import PlanConfig, SurveyConfig
from alice_survey.core.errors import AliceError, ConfigError, PlanError
from alice_survey.core.text_table import text_table
from alice_survey.sim.vehicle.pilot.settings import turn_in_place_rate_rad_s
from missions.exposure.conflict import MAX_ALTITUDE_M, last_that_fits
from missions.exposure.focus import plan_focus
from missions.exposure.footprints import altitude_for_pixel_m, footprint_at, pixel_on_floor_m
from missions.exposure.light import darkness
from missions.exposure.settings import ImagingSetup, imaging_settings
from missions.plan.strength import survey_costs
from missions.route.energy import craft_of, usable_wh
from missions.route.flyable import as_flown, without_stops
from missions.values.costs import time_costs

LENSES_MM = (12.5, 25.0)
"""Of the paper."""


@dataclass(frozen=True, kw_only=True)
class LensOption:
    """One lens at the altitude that gives a resolution.

    What follows from the altitude is NaN where no settings can be made there.
    """

    lens_mm: float
    altitude_m: float
    pixel_mm: float
    f_number: float = math.nan
    """F-number as set, or as the depth of field needs."""
    across_m: float = math.nan
    stereo_m: float = math.nan
    spacing_m: float = math.nan
    interval_s: float = math.nan
    exposure_ms: float = math.nan
    gain_db: float = math.nan
    snr: float = math.nan
    """Signal to noise of the median pixel."""
    needed_light: float = math.nan
    """Times the light that the median pixel needs."""
    hours_per_1000_m2: float = math.inf
    """Time on lines alone, without turns."""
    fits: bool = False
    why: str
    """What is against it; empty where nothing is."""


@dataclass(frozen=True, kw_only=True)
class RateOption:
    """The speed that a fixed frame rate needs, with one lens."""

    lens_mm: float
    speed_mps: float
    """Speed at which the forward overlap is as requested."""
    forward_overlap: float
    """Forward overlap at the speed of the plan instead."""
    exposure_ms: float = math.nan
    gain_db: float = math.nan
    snr: float = math.nan
    """Signal to noise of the median pixel; it and the two above are NaN where no settings can be
    made."""
    fits: bool = False
    why: str


@dataclass(frozen=True, kw_only=True)
class DiveArea:
    """The area that a dive covers."""

    dive_s: float
    """Time that it takes; less than what is given where the battery ends it."""
    energy_wh: float
    usable_wh: float
    """What a dive may take of the battery."""
    area_m2: float
    side_m: float
    """Side of a square of that area."""
    lines: int
    line_spacing_m: float
    speed_mps: float
    turn_s: float
    cross_lines: int


def solve_report(
    config: SurveyConfig,
    *,
    resolution_mm: float | None = None,
    dive_s: float | None = None,
    rate_hz: float | None = None,
    lenses: Sequence[float] = LENSES_MM,
) -> tuple[str, dict[str, Any]]:
    """Settings for what is given, as text and as JSON values; each that is given has its part.

    Args:
        config: all else of the survey.
        resolution_mm: size of a pixel on the sea floor at the mean altitude: find altitude and
            lens.
        dive_s: time of a dive: find the area that fits; with a resolution, at its altitude and
            lens.
        rate_hz: pictures a second: find the speed.
        lenses: available focal lengths, mm.

    Raises:
        ConfigError: nothing is given.
        PlanError: no lens fits.
    """
    parts: list[str] = []
    data: dict[str, Any] = {}
    setup, dived = ImagingSetup.of(config), config
    if resolution_mm is not None:
        options = lenses_for_resolution(setup, config.area.seafloor_depth_m, resolution_mm, lenses)
        parts.append(_lens_text(options, resolution_mm))
        data["lenses"] = json_values(options)
        best = options[0]
        taken = setup.with_camera(focal_mm=best.lens_mm, f_number=best.f_number).with_plan(
            altitude_m=best.altitude_m, line_spacing_m=None
        )
        dived = config.model_copy(update={"camera": taken.camera, "plan": taken.plan})
    if dive_s is not None:
        area = area_for_dive(dived, dive_s)
        parts.append(_area_text(area, dived.camera.focal_mm, dived.plan.altitude_m, dive_s))
        data["dive"] = asdict(area)
    if rate_hz is not None:
        rates = speeds_for_rate(setup, rate_hz, lenses)
        parts.append(_rate_text(rates, rate_hz, setup.plan.speed_mps))
        data["rates"] = json_values(rates)
    if not parts:
        raise ConfigError("say what is given: a resolution (mm), a dive (s) or a rate (Hz)")
    return "\n\n".join(parts), data


def lenses_for_resolution(
    setup: ImagingSetup, seafloor_depth_m: float, resolution_mm: float, lenses: Sequence[float]
) -> list[LensOption]:
    """Altitude and what follows for each lens, the one that surveys fastest first.

    Args:
        setup: all else of cameras, water, strobes and plan.
        seafloor_depth_m: the highest altitude is at the surface, or what `plan.altitude_m` allows.
        resolution_mm: size of a pixel on the sea floor.
        lenses: focal lengths, mm.

    Raises:
        PlanError: none fits; with the nearest resolution that does.
    """
    max_m = min(MAX_ALTITUDE_M, seafloor_depth_m)
    options = [_lens_option(setup, max_m, resolution_mm, lens) for lens in lenses]
    options.sort(key=lambda o: (not o.fits, o.hours_per_1000_m2, o.lens_mm))
    if options[0].fits:
        return options
    reasons = "; ".join(f"{o.lens_mm:g} mm: {o.why}" for o in options)
    found = [
        near for option in options if (near := _nearest_that_fits(setup, max_m, option)) is not None
    ]
    if not found:
        raise PlanError(
            f"no lens gives {resolution_mm:g} mm a pixel ({reasons}), and none fits at any "
            "altitude: change relief_m or the light"
        )
    best = min(found, key=lambda o: abs(math.log(o.pixel_mm / resolution_mm)))
    raise PlanError(
        f"no lens gives {resolution_mm:g} mm a pixel ({reasons}); {best.pixel_mm:g} mm fits, with "
        f"the {best.lens_mm:g} mm lens"
    )


def _lens_option(
    setup: ImagingSetup, max_m: float, resolution_mm: float, lens_mm: float
) -> LensOption:
    setup = setup.with_camera(focal_mm=lens_mm)
    rig, plan = setup.rig, setup.plan
    own = rig.cameras[rig.reference]
    altitude = math.floor(altitude_for_pixel_m(own, resolution_mm * 1e-3) * 1000) / 1000
    option = partial(LensOption, lens_mm=lens_mm, altitude_m=altitude)
    min_m = plan.relief_m + plan.least_clearance_m
    if altitude < min_m:
        why = f"{altitude:.2f} m is under the {min_m:.2f} m of relief_m and least_clearance_m"
        return option(pixel_mm=resolution_mm, why=why)
    if altitude >= max_m:
        return option(
            pixel_mm=resolution_mm, why=f"{altitude:.2f} m is beyond the {max_m:g} m allowed"
        )
    changed = _in_focus(setup.with_plan(altitude_m=altitude, line_spacing_m=None))
    try:
        settings = imaging_settings(rig, changed, quiet=True)
    except AliceError as error:
        return option(pixel_mm=resolution_mm, why=str(error).split(": ")[0])
    why = darkness(settings.light)
    return option(
        pixel_mm=pixel_on_floor_m(own, altitude) * 1e3,
        f_number=changed.camera.f_number,
        across_m=settings.footprint_across_m,
        stereo_m=settings.footprints.mean.stereo_across_m,
        spacing_m=settings.line_spacing_m,
        interval_s=settings.interval_s,
        exposure_ms=settings.exposure_s * 1e3,
        gain_db=settings.light.gain_db,
        snr=settings.light.snr_median,
        needed_light=settings.light.needed_light,
        hours_per_1000_m2=1000.0 / settings.line_spacing_m / plan.speed_mps / 3600.0,
        fits=not why,
        why=why,
    )


def _in_focus(setup: ImagingSetup) -> ImagingSetup:
    """The same setup with the aperture closed as the relief needs, if diffraction allows it."""
    limits, rig = setup.camera, setup.rig
    try:
        focus = plan_focus(rig.cameras[rig.reference], limits, setup.plan)
    except PlanError:
        return setup
    if not limits.f_number < focus.f_number_to_set <= focus.f_number_diffraction:
        return setup
    return setup.with_camera(f_number=focus.f_number_to_set)


def _nearest_that_fits(setup: ImagingSetup, max_m: float, option: LensOption) -> LensOption | None:
    """The altitude nearest to an option's that its lens can be used at, to about a fiftieth."""
    own = setup.with_camera(focal_mm=option.lens_mm).rig.cameras["left"]
    tried = np.geomspace(setup.plan.relief_m + setup.plan.least_clearance_m, max_m, 50)
    tried = tried[np.argsort(np.abs(np.log(tried / max(option.altitude_m, 1e-3))))]
    for altitude in tried:
        pixel_mm = math.ceil(pixel_on_floor_m(own, float(altitude)) * 1e6) / 1e3
        found = _lens_option(setup, max_m, pixel_mm, option.lens_mm)
        if found.fits:
            return replace(found, pixel_mm=pixel_mm)
    return None


def speeds_for_rate(
    setup: ImagingSetup, rate_hz: float, lenses: Sequence[float]
) -> list[RateOption]:
    """Speed at which pictures at a fixed rate overlap as requested, u = r L (1 - O), for each lens.

    Raises:
        PlanError: cameras or trigger are slower than the rate.
    """
    max_hz = 1.0 / setup.camera.shortest_interval_s
    if rate_hz > max_hz * (1 + 1e-9):
        raise PlanError(
            f"{rate_hz:g} pictures a second are more than the {max_hz:g} that cameras and trigger "
            "take (camera.shortest_interval_s)"
        )
    return [_rate_option(setup.with_camera(focal_mm=lens), rate_hz) for lens in lenses]


def _rate_option(setup: ImagingSetup, rate_hz: float) -> RateOption:
    rig, plan = setup.rig, setup.plan
    along_m = footprint_at(rig, plan.altitude_m, 1e-3).along_m
    # Intervals are whole milliseconds: the speed must not need a shorter one.
    speed = math.floor(rate_hz * along_m * (1 - plan.forward_overlap) * 1e4) / 1e4
    option = partial(
        RateOption,
        lens_mm=setup.camera.focal_mm,
        speed_mps=speed,
        forward_overlap=max(0.0, 1.0 - plan.speed_mps / rate_hz / along_m),
    )
    try:
        settings = imaging_settings(rig, _in_focus(setup.with_plan(speed_mps=speed)), quiet=True)
    except AliceError as error:
        return option(why=str(error).split(": ")[0])
    why = darkness(settings.light)
    return option(
        exposure_ms=settings.exposure_s * 1e3,
        gain_db=settings.light.gain_db,
        snr=settings.light.snr_median,
        fits=not why,
        why=why,
    )


def area_for_dive(config: SurveyConfig, dive_s: float) -> DiveArea:
    """The largest square that a dive holds, with its turns, cross lines, descent and ascent.

    Lines of length a lie s apart: `n = ceil(a / s)` of them and `n - 1` turns, the cross lines and
    the way home at the survey's speed. Energy is the mean of there and back on the best heading,
    and in turns the most that turning takes. A real area takes longer the more it is cut up: then
    `alice-survey plan` gives time and energy.

    Args:
        config: the survey.
        dive_s: time of the dive; the battery may end it before.

    Raises:
        PlanError: the dive or the battery is too short for one line of one picture's length.
    """
    config = as_flown(config)
    setup, plan = ImagingSetup.of(config), without_stops(config.plan, craft_of(config.vehicle))
    settings = imaging_settings(setup.rig, setup, quiet=True)
    flying = survey_costs(config, imaging_w=settings.imaging_w)
    depth_m, spacing = config.area.seafloor_depth_m - plan.altitude_m, settings.line_spacing_m
    dive_down_s, turn = time_costs(plan.speed_mps).dive_s(depth_m), turn_s(plan, spacing)
    line_w = float(np.min((flying.line_w + np.roll(flying.line_w, len(flying.line_w) // 2)) / 2))
    way_w = float(np.max(flying.way_w[np.isfinite(flying.way_w)]))
    turn_w = way_w + flying.arc_extra_w
    if plan.turns != "arcs":
        turn_w = max(turn_w, flying.stop_w)
    usable_j = usable_wh(config.vehicle) * 3600.0

    def needs(side_m: float) -> tuple[float, float]:
        """Time and energy."""
        lines = max(1, math.ceil(side_m / spacing - 1e-9))
        along_s = side_m / plan.speed_mps
        turns_s = (lines - 1 + plan.cross_lines) * turn
        lines_s = (lines + plan.cross_lines) * along_s
        energy_j = flying.dive_j(depth_m) + lines_s * line_w + turns_s * turn_w + along_s * way_w
        return dive_down_s + lines_s + turns_s + along_s, energy_j

    def holds(side_m: float) -> bool:
        time_s, energy_j = needs(side_m)
        return time_s <= dive_s and energy_j <= usable_j

    smallest = settings.footprint_along_m
    min_s, min_j = needs(smallest)
    if min_s > dive_s:
        raise PlanError(
            f"a dive of {dive_s:g} s is too short: {dive_down_s:.0f} s go down and up, and one "
            f"picture's length takes {min_s:.0f} s in all: give a longer dive"
        )
    if min_j > usable_j:
        raise PlanError(
            f"one picture's length takes {min_j / 3600:.3g} Wh with the way down and up, the "
            f"battery has {usable_j / 3600:.3g} above its reserve: raise vehicle.battery_wh"
        )
    beyond = 2.0 * math.sqrt(dive_s * plan.speed_mps * spacing) + smallest
    side_m = last_that_fits(holds, smallest, beyond, 1e-3)
    time_s, energy_j = needs(side_m)
    ended = needs(side_m + 2e-3)[1] > usable_j
    return DiveArea(
        dive_s=time_s if ended else dive_s,
        energy_wh=energy_j / 3600.0,
        usable_wh=usable_j / 3600.0,
        area_m2=side_m * side_m,
        side_m=side_m,
        lines=max(1, math.ceil(side_m / spacing - 1e-9)),
        line_spacing_m=spacing,
        speed_mps=plan.speed_mps,
        turn_s=turn,
        cross_lines=plan.cross_lines,
    )


def turn_s(plan: PlanConfig, spacing_m: float) -> float:
    """Time from the end of a line to the start of the next, with its run-in.

    Arcs of radius R: a half circle and a straight where lines are 2 R apart or more, else Dubins'
    three arcs `R (pi + 4 acos((2 R + s) / (4 R)))`; on the spot: two right angles and the way
    between. `turns = "auto"` takes the quicker.
    """
    rate_rad_s = turn_in_place_rate_rad_s(plan.turn_rate_limit_deg_s)
    costs, radius = time_costs(plan.speed_mps, turn_rate_rad_s=rate_rad_s), plan.arc_radius_m
    if spacing_m >= 2 * radius:
        arcs = math.pi * radius + spacing_m - 2 * radius
    else:
        arcs = radius * (math.pi + 4 * math.acos((2 * radius + spacing_m) / (4 * radius)))
    run_in = plan.run_in_m / plan.speed_mps
    by_arcs = arcs / plan.speed_mps + run_in
    by_stops = 2 * costs.stop_j(math.pi / 2) + spacing_m / plan.speed_mps + run_in
    return {"arcs": by_arcs, "spot": by_stops}.get(plan.turns, min(by_arcs, by_stops))


def _area_text(area: DiveArea, lens_mm: float, altitude_m: float, given_s: float) -> str:
    dive = f"a dive of {area.dive_s:.6g} s"
    if area.dive_s < given_s:
        dive = f"the battery ends a dive after {area.dive_s:.0f} of {given_s:g} s, which"
    return (
        f"{dive} holds {area.area_m2:.0f} m2, such as {area.side_m:.1f} x "
        f"{area.side_m:.1f} m: {area.lines} lines {area.line_spacing_m:.3g} m apart at "
        f"{area.speed_mps:g} m/s, {area.cross_lines} across, turns of {area.turn_s:.0f} s, descent "
        f"and ascent; {area.energy_wh:.0f} of {area.usable_wh:.0f} Wh; {lens_mm:g} mm lens at "
        f"{altitude_m:.2f} m"
    )


def _lens_text(options: list[LensOption], resolution_mm: float) -> str:
    """A table of lenses, and the one to take."""
    best = options[0]
    columns = {
        "lens mm": "lens_mm:g", "altitude m": "altitude_m:.2f", "F": "f_number:.1f",
        "across m": "across_m:.2f", "stereo m": "stereo_m:.2f", "lines m": "spacing_m:.2f",
        "every s": "interval_s:.2f", "expose ms": "exposure_ms:.2f", "gain dB": "gain_db:.1f",
        "SNR": "snr:.1f", "h/1000 m2": "hours_per_1000_m2:.2f", "fits": "fits",
    }  # fmt: skip
    return "\n".join([
        f"{resolution_mm:g} mm a pixel on the sea floor",
        *_option_table(columns, options),
        f"take the {best.lens_mm:g} mm lens at {best.altitude_m:.2f} m with F/{best.f_number:g}: "
        f"set camera.focal_mm, plan.altitude_m, camera.f_number; lines {best.spacing_m:.2f} m "
        "apart",
    ])  # fmt: skip


def _rate_text(options: list[RateOption], rate_hz: float, speed_mps: float) -> str:
    """A table of speeds by lens."""
    columns = {
        "lens mm": "lens_mm:g", "largest m/s": "speed_mps:.3f",
        f"overlap at {speed_mps:g} m/s": "forward_overlap:.1%", "expose ms": "exposure_ms:.2f",
        "gain dB": "gain_db:.1f", "SNR": "snr:.1f", "fits": "fits",
    }  # fmt: skip
    return "\n".join([f"{rate_hz:g} pictures a second", *_option_table(columns, options)])


def _option_table(
    columns: dict[str, str], options: Sequence[LensOption] | Sequence[RateOption]
) -> list[str]:
    """A table of options by header and `field:format`, and what is against each."""

    def cell(option: LensOption | RateOption, column: str) -> str:
        field, _, form = column.partition(":")
        value = getattr(option, field)
        if not form:
            return "yes" if value else "no"
        return format(value, form) if math.isfinite(value) else "-"

    rows = [[cell(option, column) for column in columns.values()] for option in options]
    return [
        text_table(list(columns), rows),
        *(f"{option.lens_mm:g} mm: {option.why}" for option in options if option.why),
    ]
