"""The plan solved the other way: altitude and lens for a resolution on the sea floor."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from alice_survey.core.artefacts import json_values
from alice_survey.core.config import SurveyConfig, change_section
from alice_survey.core.errors import AliceError, PlanError
from alice_survey.kit.words import text_table
from missions.exposure.conflict import MAX_ALTITUDE_M
from missions.exposure.focus import plan_focus
from missions.exposure.footprints import altitude_for_pixel_m, pixel_on_floor_m
from missions.exposure.light import darkness
from missions.exposure.settings import ImagingSettings, ImagingSetup, imaging_settings

_COLUMNS = {
    "lens_mm": ":g", "altitude_m": ":.2f", "f_number": ":.1f", "across_m": ":.2f",
    "stereo_m": ":.2f", "spacing_m": ":.2f", "interval_s": ":.2f", "exposure_ms": ":.2f",
    "gain_db": ":.1f", "snr": ":.1f", "hours_per_1000_m2": ":.2f",
}  # fmt: skip
"""Figures of the table: signal to noise is of the median pixel, hours those on lines alone."""


@dataclass(frozen=True, kw_only=True)
class LensOption:
    """One lens at the altitude that gives a resolution."""

    setup: ImagingSetup
    """With its lens, altitude, and the aperture as set or as the depth of field needs."""
    settings: ImagingSettings | None
    """None where none can be made."""
    against: str
    """What is against it; empty where nothing is."""

    @property
    def values(self) -> dict[str, float]:
        """Its figures by name; NaN where no settings can be made."""
        plan, camera, found = self.setup.plan, self.setup.camera, self.settings
        given = {
            "lens_mm": camera.focal_mm, "altitude_m": plan.altitude_m,
            "speed_mps": plan.speed_mps, "f_number": camera.f_number,
        }  # fmt: skip
        if found is None:
            return dict.fromkeys(_COLUMNS, math.nan) | given
        return given | {
            "pixel_mm": 1e3 * found.pixel_m,
            "across_m": found.footprint_across_m,
            "stereo_m": found.footprints.mean.stereo_across_m,
            "spacing_m": found.line_spacing_m,
            "interval_s": found.interval_s,
            "exposure_ms": 1e3 * found.exposure_s,
            "gain_db": found.light.gain_db,
            "snr": found.light.snr_median,
            "needed_light": found.light.needed_light,
            "hours_per_1000_m2": 1000.0 / found.line_spacing_m / plan.speed_mps / 3600.0,
        }


def solve_report(
    setup: ImagingSetup, max_m: float, resolution_mm: float, lenses: Sequence[float]
) -> tuple[str, dict[str, Any]]:
    """A table of lenses and the one to take, as text and as JSON values; as `solve_lenses`."""
    options = solve_lenses(setup, max_m, resolution_mm, lenses)
    best = options[0].values
    rows = [
        [
            *(
                f"{{{form}}}".format(one.values[name]) if math.isfinite(one.values[name]) else "-"
                for name, form in _COLUMNS.items()
            ),
            one.against or "yes",
        ]
        for one in options
    ]
    header = [*(name.replace("_", " ") for name in _COLUMNS), "fits"]
    text = (
        f"{resolution_mm:g} mm a pixel on the sea floor\n{text_table(header, rows)}\n"
        f"take the {best['lens_mm']:g} mm lens at {best['altitude_m']:.2f} m with "
        f"F/{best['f_number']:g}: set camera.focal_mm, plan.altitude_m, camera.f_number; lines "
        f"{best['spacing_m']:.2f} m apart"
    )
    lenses_json = [
        {**json_values(one.values), "fits": not one.against, "why": one.against} for one in options
    ]
    return text, {"lenses": lenses_json}


def solve_lenses(
    setup: ImagingSetup, max_m: float, resolution_mm: float, lenses: Sequence[float]
) -> list[LensOption]:
    """Altitude and what follows for each lens, the one that surveys fastest first.

    Args:
        setup: all else of cameras, water, strobes and plan.
        max_m: depth of the sea floor: the highest altitude, or what `plan.altitude_m` allows.
        resolution_mm: size of a pixel on the sea floor.
        lenses: focal lengths, mm.

    Raises:
        PlanError: none fits; with the nearest resolution that does.
    """
    for lens in lenses:  # as the setting is checked
        change_section(SurveyConfig(), "camera", focal_mm=lens)
    max_m = min(MAX_ALTITUDE_M, max_m)
    options = [_option(setup.with_camera(focal_mm=lens), max_m, resolution_mm) for lens in lenses]
    if any(not option.against for option in options):
        return sorted(options, key=lambda one: (bool(one.against), _hours(one)))
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


def _hours(option: LensOption) -> float:
    """What lenses that fit are ranked by; the others keep their order."""
    return 0.0 if option.against else option.values["hours_per_1000_m2"]


def _option(setup: ImagingSetup, max_m: float, resolution_mm: float) -> LensOption:
    """What follows from a lens, its aperture closed as the relief needs if diffraction allows."""
    camera = setup.rig.cameras["left"]
    altitude_m = math.floor(altitude_for_pixel_m(camera, resolution_mm * 1e-3) * 1000) / 1000
    setup = setup.with_plan(altitude_m=altitude_m, line_spacing_m=None)
    min_m, against = _min_altitude_m(setup), ""
    if altitude_m < min_m:
        against = f"{altitude_m:.2f} m is under the {min_m:.2f} m of relief_m and least_clearance_m"
    elif altitude_m >= max_m:
        against = f"{altitude_m:.2f} m is beyond the {max_m:g} m allowed"
    if against:
        return LensOption(setup=setup, settings=None, against=against)
    limits, rig = setup.camera, setup.rig
    try:
        focus = plan_focus(rig.cameras[rig.reference], limits, setup.plan)
        if limits.f_number < focus.f_number_to_set <= focus.f_number_diffraction:
            setup = setup.with_camera(f_number=focus.f_number_to_set)
        settings = imaging_settings(rig, setup, quiet=True)
    except AliceError as error:
        return LensOption(setup=setup, settings=None, against=str(error).split(": ")[0])
    return LensOption(setup=setup, settings=settings, against=darkness(settings.light))


def _min_altitude_m(setup: ImagingSetup) -> float:
    return setup.plan.relief_m + setup.plan.least_clearance_m


def _nearest_resolution_mm(setup: ImagingSetup, max_m: float) -> float | None:
    """The resolution nearest to a setup's at which its lens can be used, to about a fiftieth."""
    own = setup.rig.cameras["left"]
    tried = np.geomspace(_min_altitude_m(setup), max_m, 50)
    tried = tried[np.argsort(np.abs(np.log(tried / max(setup.plan.altitude_m, 1e-3))))]
    for altitude in tried:
        pixel_mm = math.ceil(pixel_on_floor_m(own, float(altitude)) * 1e6) / 1e3
        if not _option(setup, max_m, pixel_mm).against:
            return pixel_mm
    return None
