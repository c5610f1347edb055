"""Altitude and lens for a resolution on the sea floor."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from alice_survey.base.config import PlanConfig
from alice_survey.base.errors import AliceError, PlanError
from missions.exposure.focus import largest_f_number, needed_f_number
from missions.exposure.footprints import altitude_for_pixel_m, footprint_at, pixel_on_floor_m
from missions.exposure.light import LEAST_SNR, light_for_snr_e, too_dark
from missions.exposure.settings import ImagingSetup, imaging_settings
from missions.exposure.ways_out import Way, conflict

_HIGHEST_M = 10.0


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
    hours_per_1000_m2: float = math.inf
    """Time on lines alone, without turns."""
    fits: bool = False
    why: str
    """What is against it; empty where nothing is."""


def least_altitude_m(plan: PlanConfig) -> float:
    """Lowest altitude that keeps `least_clearance_m` over the top of the relief."""
    return plan.relief_m + plan.least_clearance_m


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
        PlanError: none fits.
    """
    highest_m = min(_HIGHEST_M, seafloor_depth_m)
    options = [_lens_option(setup, highest_m, resolution_mm, lens) for lens in lenses]
    options.sort(key=lambda o: (not o.fits, o.hours_per_1000_m2, o.lens_mm))
    if not options[0].fits:
        raise _no_lens(setup, highest_m, resolution_mm, options)
    return options


def _lens_option(
    setup: ImagingSetup, highest_m: float, resolution_mm: float, lens_mm: float
) -> LensOption:
    setup = setup.with_camera(focal_mm=lens_mm)
    rig = setup.rig
    own = rig.cameras[rig.reference]
    altitude = math.floor(altitude_for_pixel_m(own, resolution_mm * 1e-3) * 1000) / 1000
    option = partial(LensOption, lens_mm=lens_mm, altitude_m=altitude)
    least_m = least_altitude_m(setup.plan)
    if not least_m <= altitude < highest_m:
        why = (
            f"{altitude:.2f} m is under the {least_m:.2f} m of relief_m and least_clearance_m"
            if altitude < least_m
            else f"{altitude:.2f} m is beyond the {highest_m:g} m allowed"
        )
        return option(pixel_mm=resolution_mm, why=why)
    changed = in_focus(setup.with_plan(altitude_m=altitude, line_spacing_m=None))
    try:
        settings = imaging_settings(rig, changed, quiet=True)
    except AliceError as error:
        return option(pixel_mm=resolution_mm, why=str(error).split(": ")[0])
    why = too_dark(settings.light)
    return option(
        pixel_mm=pixel_on_floor_m(own, altitude) * 1e3,
        f_number=changed.camera.f_number,
        across_m=settings.footprint_across_m,
        stereo_m=footprint_at(rig, altitude, settings.station_spacing_m).stereo_across_m,
        spacing_m=settings.line_spacing_m,
        interval_s=settings.interval_s,
        exposure_ms=settings.exposure_s * 1e3,
        gain_db=settings.light.gain_db,
        snr=settings.light.snr_median,
        hours_per_1000_m2=1000.0 / settings.line_spacing_m / setup.plan.speed_mps / 3600.0,
        fits=not why,
        why=why,
    )


def with_lens(setup: ImagingSetup, option: LensOption) -> ImagingSetup:
    """The setup with a lens, its aperture, and the altitude it needs; lines as then follows."""
    return setup.with_camera(focal_mm=option.lens_mm, f_number=option.f_number).with_plan(
        altitude_m=option.altitude_m, line_spacing_m=None
    )


def in_focus(setup: ImagingSetup) -> ImagingSetup:
    """The same setup with the aperture closed as the relief needs, if diffraction allows it."""
    camera, plan = setup.camera, setup.plan
    needed = math.ceil(10 * needed_f_number(setup.rig.cameras["left"], camera, plan) - 1e-9) / 10
    if not camera.f_number < needed <= largest_f_number(camera, plan.sharp_px):
        return setup
    return setup.with_camera(f_number=needed)


def _no_lens(
    setup: ImagingSetup, deepest: float, resolution_mm: float, options: list[LensOption]
) -> PlanError:
    """No lens gives the resolution within the limits: what each can, and what it would take."""
    ways = []
    plan, least = setup.plan, least_altitude_m(setup.plan)
    for option in options:
        nearest = _nearest_that_fits(setup, deepest, option)
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
    ways += _more_light(setup, options)
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
    clearance = math.floor(100 * (highest - plan.relief_m)) / 100
    if 0.1 <= clearance < plan.least_clearance_m:
        ways.append(
            Way(
                change=f"least_clearance_m {clearance:g}",
                price=f"flown from {highest:.2f} m, nearer to the ground",
                cost=1.0 - clearance / plan.least_clearance_m,
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


def _more_light(setup: ImagingSetup, options: list[LensOption]) -> list[Way]:
    """Blur and speed with which the options that are only too dark would do."""
    ways = []
    for option in options:
        if math.isnan(option.snr):
            continue
        noise_e = setup.camera.read_noise_e
        times = light_for_snr_e(LEAST_SNR, noise_e) / light_for_snr_e(option.snr, noise_e)
        blur_px = math.ceil(100 * setup.plan.allowed_blur_px * times) / 100
        ways.append(
            Way(
                change=f"allowed_blur_px {blur_px:g} with the {option.lens_mm:g} mm lens from "
                f"{option.altitude_m:.2f} m",
                price=f"{times:.2f} times the exposure and the blur",
                cost=times - 1.0,
            )
        )
    return ways


def _nearest_that_fits(
    setup: ImagingSetup, highest_m: float, option: LensOption
) -> LensOption | None:
    """The altitude nearest to an option's that its lens can be used at, to about a fiftieth."""
    own = setup.with_camera(focal_mm=option.lens_mm).rig.cameras["left"]
    tried = np.geomspace(least_altitude_m(setup.plan), highest_m, 50)
    tried = tried[np.argsort(np.abs(np.log(tried / max(option.altitude_m, 1e-3))))]
    for altitude in tried:
        pixel_mm = math.ceil(pixel_on_floor_m(own, float(altitude)) * 1e6) / 1e3
        found = _lens_option(setup, highest_m, pixel_mm, option.lens_mm)
        if found.fits:
            return found
    return None
