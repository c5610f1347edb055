"""Altitude and lens for a resolution on the sea floor."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alice_survey.base.config import SurveyConfig
from alice_survey.base.errors import AliceError, PlanError
from camera_calib.rig import design_rig
from missions.exposure.conflicts import Way, conflict
from missions.exposure.focus import largest_f_number, needed_f_number
from missions.exposure.footprints import altitude_for_pixel_m, footprint_at, pixel_on_floor_m
from missions.exposure.light import LEAST_SNR, light_for_snr_e, too_dark
from missions.exposure.settings import imaging_settings

_HIGHEST_M = 10.0


@dataclass(frozen=True, kw_only=True)
class LensOption:
    """One lens at the altitude that gives a resolution."""

    lens_mm: float
    altitude_m: float
    pixel_mm: float
    f_number: float
    """As set, or as the depth of field needs."""
    across_m: float
    stereo_m: float
    spacing_m: float
    interval_s: float
    exposure_ms: float
    gain_db: float
    snr: float
    """Of the median pixel."""
    hours_per_1000_m2: float
    """On lines alone, without turns."""
    fits: bool
    why: str
    """What is against it; empty where nothing is."""


def least_altitude_m(config: SurveyConfig) -> float:
    """Lowest altitude that keeps `least_clearance_m` over the top of the relief."""
    return config.plan.relief_m + config.plan.least_clearance_m


def _deepest_m(config: SurveyConfig) -> float:
    """Highest altitude: what `plan.altitude_m` allows, below the surface."""
    return min(_HIGHEST_M, config.area.seafloor_depth_m)


def lenses_for_resolution(
    config: SurveyConfig, resolution_mm: float, lenses: Sequence[float]
) -> list[LensOption]:
    """Altitude and what follows for each lens, the one that surveys fastest first.

    Raises:
        PlanError: none fits.
    """
    options = [_lens_option(config, resolution_mm, lens) for lens in lenses]
    options.sort(key=lambda o: (not o.fits, o.hours_per_1000_m2, o.lens_mm))
    if not options[0].fits:
        raise _no_lens(config, resolution_mm, options)
    return options


def _lens_option(config: SurveyConfig, resolution_mm: float, lens_mm: float) -> LensOption:
    """One lens; fields beyond the altitude are NaN where no plan can be made there."""
    camera = config.camera.model_copy(update={"focal_mm": lens_mm})
    rig = design_rig(camera, config.water)
    own = rig.cameras[rig.reference]
    altitude = math.floor(altitude_for_pixel_m(own, resolution_mm * 1e-3) * 1000) / 1000
    least, deepest = least_altitude_m(config), _deepest_m(config)
    if not least <= altitude < deepest:
        why = (
            f"{altitude:.2f} m is under the {least:.2f} m of relief_m and least_clearance_m"
            if altitude < least
            else f"{altitude:.2f} m is beyond the {deepest:g} m allowed"
        )
        return _no_option(lens_mm, altitude, resolution_mm, why)
    plan = config.plan.model_copy(update={"altitude_m": altitude, "line_spacing_m": None})
    changed = in_focus(config.model_copy(update={"camera": camera, "plan": plan}))
    try:
        settings = imaging_settings(rig, changed, quiet=True)
    except AliceError as error:
        return _no_option(lens_mm, altitude, resolution_mm, str(error).split(": ")[0])
    why = too_dark(settings.light)
    return LensOption(
        lens_mm=lens_mm,
        altitude_m=altitude,
        pixel_mm=pixel_on_floor_m(own, altitude) * 1e3,
        f_number=changed.camera.f_number,
        across_m=settings.footprint_across_m,
        stereo_m=footprint_at(rig, altitude, settings.station_spacing_m).stereo_across_m,
        spacing_m=settings.line_spacing_m,
        interval_s=settings.interval_s,
        exposure_ms=settings.exposure_s * 1e3,
        gain_db=settings.light.gain_db,
        snr=settings.light.snr_median,
        hours_per_1000_m2=1000.0 / settings.line_spacing_m / plan.speed_mps / 3600.0,
        fits=not why,
        why=why,
    )


def with_lens(config: SurveyConfig, option: LensOption) -> SurveyConfig:
    """The survey with a lens, its aperture, and the altitude it needs; lines as then follows."""
    camera = config.camera.model_copy(
        update={"focal_mm": option.lens_mm, "f_number": option.f_number}
    )
    plan = config.plan.model_copy(update={"altitude_m": option.altitude_m, "line_spacing_m": None})
    return config.model_copy(update={"camera": camera, "plan": plan})


def in_focus(config: SurveyConfig) -> SurveyConfig:
    """The same with the aperture closed as far as the relief needs, if diffraction allows it."""
    camera, plan = config.camera, config.plan
    own = design_rig(camera, config.water).cameras["left"]
    needed = math.ceil(10 * needed_f_number(own, camera, plan) - 1e-9) / 10
    if not camera.f_number < needed <= largest_f_number(camera, plan.sharp_px):
        return config
    return config.model_copy(update={"camera": camera.model_copy(update={"f_number": needed})})


def _no_option(lens_mm: float, altitude_m: float, pixel_mm: float, why: str) -> LensOption:
    nan = math.nan
    return LensOption(
        lens_mm=lens_mm, altitude_m=altitude_m, pixel_mm=pixel_mm, f_number=nan, across_m=nan,
        stereo_m=nan, spacing_m=nan, interval_s=nan, exposure_ms=nan, gain_db=nan, snr=nan,
        hours_per_1000_m2=math.inf, fits=False, why=why,
    )  # fmt: skip


def _no_lens(config: SurveyConfig, resolution_mm: float, options: list[LensOption]) -> PlanError:
    """No lens gives the resolution within the limits: what each can, and what it would take."""
    ways = []
    least, deepest = least_altitude_m(config), _deepest_m(config)
    for option in options:
        nearest = _nearest_that_fits(config, option)
        if nearest is not None:
            ratio = max(nearest.pixel_mm / resolution_mm, resolution_mm / nearest.pixel_mm)
            word = "coarser" if nearest.pixel_mm > resolution_mm else "finer"
            ways.append(
                Way(
                    change=f"resolution {nearest.pixel_mm:.3g} mm with the {option.lens_mm:g} mm "
                    "lens",
                    price=f"{ratio:.2f} times {word}, from {nearest.altitude_m:.2f} m",
                    cost=ratio - 1.0,
                )
            )
    ways += _more_light(config, options)
    lowest, highest = (f(option.altitude_m for option in options) for f in (min, max))
    # At no distance in front of the port there is no lens to scale.
    if 0.0 < highest < least:
        lens = max(option.lens_mm for option in options)
        longer = math.ceil(10 * lens * least / highest) / 10
        ways.append(
            Way(
                change=f"a lens of about {longer:g} mm, from {least:.2f} m",
                price=f"a footprint and its lines are {longer / lens:.2f} times smaller than "
                f"{lens:g} mm gives there",
                cost=longer / lens - 1.0,
            )
        )
    elif lowest > deepest:
        lens = min(option.lens_mm for option in options)
        shorter = math.floor(10 * lens * deepest / lowest) / 10
        ways.append(
            Way(
                change=f"a lens of about {shorter:g} mm, from {deepest:g} m",
                price="a wider view through the flat port",
                cost=lens / shorter - 1.0,
            )
        )
    clearance = math.floor(100 * (highest - config.plan.relief_m)) / 100
    if 0.1 <= clearance < config.plan.least_clearance_m:
        ways.append(
            Way(
                change=f"least_clearance_m {clearance:g}",
                price=f"flown from {highest:.2f} m, nearer to the ground",
                cost=1.0 - clearance / config.plan.least_clearance_m,
            )
        )
    reasons = "; ".join(f"{o.lens_mm:g} mm: {o.why}" for o in options)
    fault = f"no lens gives {resolution_mm:g} mm a pixel ({reasons})"
    if not ways:
        return PlanError(f"{fault}, and none fits at any altitude: change relief_m or the light")
    if highest < least:
        limit = "relief_m + least_clearance_m"
    elif lowest > deepest:
        limit = "the highest altitude"
    elif any(not math.isnan(option.snr) for option in options):
        limit = "the light of the strobes"
    else:
        limit = "the depth of field over relief_m"
    return conflict(fault, ("the resolution", limit), ways)


def _more_light(config: SurveyConfig, options: list[LensOption]) -> list[Way]:
    """Blur and speed with which the options that are only too dark would do."""
    ways = []
    for option in options:
        if math.isnan(option.snr):
            continue
        noise_e = config.camera.read_noise_e
        times = light_for_snr_e(LEAST_SNR, noise_e) / light_for_snr_e(option.snr, noise_e)
        blur_px = math.ceil(100 * config.plan.allowed_blur_px * times) / 100
        ways.append(
            Way(
                change=f"allowed_blur_px {blur_px:g} with the {option.lens_mm:g} mm lens from "
                f"{option.altitude_m:.2f} m",
                price=f"{times:.2f} times the exposure and the blur",
                cost=times - 1.0,
            )
        )
    return ways


def _nearest_that_fits(config: SurveyConfig, option: LensOption) -> LensOption | None:
    """The altitude nearest to an option's that its lens can be used at, to about a fiftieth."""
    camera = config.camera.model_copy(update={"focal_mm": option.lens_mm})
    own = design_rig(camera, config.water).cameras["left"]
    tried = np.geomspace(least_altitude_m(config), _deepest_m(config), 50)
    tried = tried[np.argsort(np.abs(np.log(tried / max(option.altitude_m, 1e-3))))]
    for altitude in tried:
        pixel_mm = math.ceil(pixel_on_floor_m(own, float(altitude)) * 1e6) / 1e3
        found = _lens_option(config, pixel_mm, option.lens_mm)
        if found.fits:
            return found
    return None
