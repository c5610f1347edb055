"""The plan solved the other way: for a resolution, the length of a dive or a frame rate."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from alice_survey.core.artefacts import json_values
from alice_survey.core.config import PlanConfig, SurveyConfig
from alice_survey.core.errors import AliceError, ConfigError, PlanError
from alice_survey.kit.words import text_table
from alice_survey.sim.vehicle.pilot.settings import turn_in_place_rate_rad_s
from missions.exposure.conflict import MAX_ALTITUDE_M, last_that_fits
from missions.exposure.focus import plan_focus
from missions.exposure.footprints import altitude_for_pixel_m, pixel_on_floor_m
from missions.exposure.light import darkness
from missions.exposure.settings import ImagingSettings, ImagingSetup, imaging_settings
from missions.plan.strength import survey_costs
from missions.route.energy import planned_vehicle, usable_wh
from missions.route.flyable import as_flown, without_stops
from missions.values.costs import time_costs
from missions.values.footprint import footprint_size_m, overlap

LENSES_MM = (12.5, 25.0)
"""Of the paper."""


@dataclass(frozen=True, kw_only=True)
class Option:
    """One lens at the altitude that gives a resolution, or at the speed that gives a rate."""

    setup: ImagingSetup
    """With its lens, altitude, speed, and the aperture as set or as the depth of field needs."""
    settings: ImagingSettings | None
    """None where none can be made."""
    against: str
    """What is against it; empty where nothing is."""

    @property
    def is_possible(self) -> bool:
        """Whether nothing is against it."""
        return not self.against

    @property
    def values(self) -> dict[str, float]:
        """Its figures by name; NaN where no settings can be made."""
        plan, camera, found = self.setup.plan, self.setup.camera, self.settings
        given = {
            "lens_mm": camera.focal_mm,
            "altitude_m": plan.altitude_m,
            "speed_mps": plan.speed_mps,
            "f_number": camera.f_number,
        }
        if found is None:
            return given | dict.fromkeys(_FOLLOWING, math.nan)
        hours = 1000.0 / found.line_spacing_m / plan.speed_mps / 3600.0
        following = (
            1e3 * found.pixel_m, found.footprint_across_m, found.footprints.mean.stereo_across_m,
            found.line_spacing_m, found.interval_s, 1e3 * found.exposure_s, found.light.gain_db,
            found.light.snr_median, found.light.needed_light, hours,
        )  # fmt: skip
        return given | dict(zip(_FOLLOWING, following, strict=True))

    def to_json(self, **more: float) -> dict[str, Any]:
        """Its figures as JSON values, and more of them."""
        found: dict[str, Any] = json_values({**self.values, **more})
        return {**found, "fits": self.is_possible, "why": self.against}


_FOLLOWING = (
    "pixel_mm", "across_m", "stereo_m", "spacing_m", "interval_s", "exposure_ms", "gain_db", "snr",
    "needed_light", "hours_per_1000_m2",
)  # fmt: skip
"""Figures that follow from settings: signal to noise and light are of the median pixel, hours those
on lines alone, without turns."""


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
        data["lenses"] = [option.to_json() for option in options]
        best = options[0].setup
        dived = config.model_copy(update={"camera": best.camera, "plan": best.plan})
    if dive_s is not None:
        area = area_for_dive(dived, dive_s)
        parts.append(_area_text(area, dived.camera.focal_mm, dived.plan.altitude_m, dive_s))
        data["dive"] = asdict(area)
    if rate_hz is not None:
        rates = speeds_for_rate(setup, rate_hz, lenses)
        kept = [overlap_at_rate(option, setup.plan.speed_mps, rate_hz) for option in rates]
        name = f"overlap at {setup.plan.speed_mps:g} m/s"
        shown = _option_table(_RATE_COLUMNS, rates, {name: [f"{share:.1%}" for share in kept]})
        parts.append(f"{rate_hz:g} pictures a second\n{shown}")
        data["rates"] = [
            option.to_json(forward_overlap=share) for option, share in zip(rates, kept, strict=True)
        ]
    if not parts:
        raise ConfigError("say what is given: a resolution (mm), a dive (s) or a rate (Hz)")
    return "\n\n".join(parts), data


def lenses_for_resolution(
    setup: ImagingSetup, seafloor_depth_m: float, resolution_mm: float, lenses: Sequence[float]
) -> list[Option]:
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
    options = [
        _lens_option(setup.with_camera(focal_mm=lens), max_m, resolution_mm) for lens in lenses
    ]
    possible = [option for option in options if option.is_possible]
    if possible:
        possible.sort(key=lambda one: one.values["hours_per_1000_m2"])
        return possible + [option for option in options if not option.is_possible]
    reasons = "; ".join(f"{o.setup.camera.focal_mm:g} mm: {o.against}" for o in options)
    fault = f"no lens gives {resolution_mm:g} mm a pixel ({reasons})"
    near = [
        (pixel_mm, option.setup.camera.focal_mm)
        for option in options
        if (pixel_mm := _nearest_resolution_mm(option.setup, max_m)) is not None
    ]
    if not near:
        raise PlanError(f"{fault}, and none fits at any altitude: change relief_m or the light")
    pixel_mm, lens = min(near, key=lambda one: abs(math.log(one[0] / resolution_mm)))
    raise PlanError(f"{fault}; {pixel_mm:g} mm fits, with the {lens:g} mm lens")


def _lens_option(setup: ImagingSetup, max_m: float, resolution_mm: float) -> Option:
    rig = setup.rig
    altitude = altitude_for_pixel_m(rig.cameras[rig.reference], resolution_mm * 1e-3)
    setup = setup.with_plan(altitude_m=math.floor(altitude * 1000) / 1000, line_spacing_m=None)
    altitude, min_m = setup.plan.altitude_m, _min_altitude_m(setup.plan)
    if altitude < min_m:
        against = f"{altitude:.2f} m is under the {min_m:.2f} m of relief_m and least_clearance_m"
        return Option(setup=setup, settings=None, against=against)
    if altitude >= max_m:
        against = f"{altitude:.2f} m is beyond the {max_m:g} m allowed"
        return Option(setup=setup, settings=None, against=against)
    return _option(setup)


def _min_altitude_m(plan: PlanConfig) -> float:
    return plan.relief_m + plan.least_clearance_m


def _option(setup: ImagingSetup) -> Option:
    """What follows from a setup, its aperture closed as the relief needs if diffraction allows."""
    limits, rig = setup.camera, setup.rig
    try:
        focus = plan_focus(rig.cameras[rig.reference], limits, setup.plan)
        if limits.f_number < focus.f_number_to_set <= focus.f_number_diffraction:
            setup = setup.with_camera(f_number=focus.f_number_to_set)
        settings = imaging_settings(rig, setup, quiet=True)
    except AliceError as error:
        return Option(setup=setup, settings=None, against=str(error).split(": ")[0])
    return Option(setup=setup, settings=settings, against=darkness(settings.light))


def _nearest_resolution_mm(setup: ImagingSetup, max_m: float) -> float | None:
    """The resolution nearest to a setup's at which its lens can be used, to about a fiftieth."""
    own = setup.rig.cameras["left"]
    tried = np.geomspace(_min_altitude_m(setup.plan), max_m, 50)
    tried = tried[np.argsort(np.abs(np.log(tried / max(setup.plan.altitude_m, 1e-3))))]
    for altitude in tried:
        pixel_mm = math.ceil(pixel_on_floor_m(own, float(altitude)) * 1e6) / 1e3
        if _lens_option(setup, max_m, pixel_mm).is_possible:
            return pixel_mm
    return None


def speeds_for_rate(setup: ImagingSetup, rate_hz: float, lenses: Sequence[float]) -> list[Option]:
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
    options = []
    for lens in lenses:
        own = setup.with_camera(focal_mm=lens)
        step_m = _along_m(own) * (1 - setup.plan.forward_overlap)
        # Intervals are whole milliseconds: the speed must not need a shorter one.
        options.append(_option(own.with_plan(speed_mps=math.floor(rate_hz * step_m * 1e4) / 1e4)))
    return options


def _along_m(setup: ImagingSetup) -> float:
    rig = setup.rig
    return footprint_size_m(rig.cameras[rig.reference], setup.plan.altitude_m)[1]


def overlap_at_rate(option: Option, speed_mps: float, rate_hz: float) -> float:
    """Forward overlap of pictures at a fixed rate, with the lens of an option."""
    return overlap(_along_m(option.setup), speed_mps / rate_hz)


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
    setup, plan = (
        ImagingSetup.of(config),
        without_stops(config.plan, planned_vehicle(config.vehicle)),
    )
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


_LENS_COLUMNS = {
    "lens_mm": ":g", "altitude_m": ":.2f", "f_number": ":.1f", "across_m": ":.2f",
    "stereo_m": ":.2f", "spacing_m": ":.2f", "interval_s": ":.2f", "exposure_ms": ":.2f",
    "gain_db": ":.1f", "snr": ":.1f", "hours_per_1000_m2": ":.2f",
}  # fmt: skip
_RATE_COLUMNS = {
    "lens_mm": ":g", "speed_mps": ":.3f", "exposure_ms": ":.2f", "gain_db": ":.1f", "snr": ":.1f"
}  # fmt: skip


def _lens_text(options: list[Option], resolution_mm: float) -> str:
    """A table of lenses, and the one to take."""
    best = options[0].values
    return (
        f"{resolution_mm:g} mm a pixel on the sea floor\n"
        f"{_option_table(_LENS_COLUMNS, options)}\n"
        f"take the {best['lens_mm']:g} mm lens at {best['altitude_m']:.2f} m with "
        f"F/{best['f_number']:g}: set camera.focal_mm, plan.altitude_m, camera.f_number; lines "
        f"{best['spacing_m']:.2f} m apart"
    )


def _option_table(
    columns: dict[str, str], options: Sequence[Option], more: dict[str, list[str]] | None = None
) -> str:
    """A table of options by figure and its format, more columns, and what is against each."""
    table = {
        name.replace("_", " "): [
            f"{{{form}}}".format(value) if math.isfinite(value) else "-"
            for value in (option.values[name] for option in options)
        ]
        for name, form in columns.items()
    }
    table |= more or {}
    table["fits"] = [option.against or "yes" for option in options]
    return text_table(list(table), list(zip(*table.values(), strict=True)))
