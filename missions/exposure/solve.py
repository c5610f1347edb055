"""The plan solved the other way: from a resolution or a frame rate to settings."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from alice_survey.core.config import PlanConfig
from alice_survey.core.errors import AliceError, PlanError
from alice_survey.core.text_table import text_table
from missions.exposure.focus import largest_f_number, needed_f_number
from missions.exposure.footprints import altitude_for_pixel_m, footprint_at, pixel_on_floor_m
from missions.exposure.light import too_dark
from missions.exposure.settings import ImagingSetup, imaging_settings
from missions.exposure.ways_out import (
    HIGHEST_ALTITUDE_M,
    MAX_BLUR_PX,
    Way,
    conflict,
    less_overlap,
)


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


def min_altitude_m(plan: PlanConfig) -> float:
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
    highest_m = min(HIGHEST_ALTITUDE_M, seafloor_depth_m)
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
    min_m = min_altitude_m(setup.plan)
    if not min_m <= altitude < highest_m:
        why = (
            f"{altitude:.2f} m is under the {min_m:.2f} m of relief_m and least_clearance_m"
            if altitude < min_m
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
        needed_light=settings.light.needed_light,
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
    ways = list(_lens_ways(setup, deepest, resolution_mm, options))
    minimum = min_altitude_m(setup.plan)
    lowest, highest = (f(option.altitude_m for option in options) for f in (min, max))
    reasons = "; ".join(f"{o.lens_mm:g} mm: {o.why}" for o in options)
    fault = f"no lens gives {resolution_mm:g} mm a pixel ({reasons})"
    if not ways:
        return PlanError(f"{fault}, and none fits at any altitude: change relief_m or the light")
    if highest < minimum:
        limit = "relief_m + least_clearance_m"
    elif lowest > deepest:
        limit = "the highest altitude"
    elif any(not math.isnan(option.snr) for option in options):
        limit = "the light of the strobes"
    else:
        limit = "the depth of field over relief_m"
    return conflict(fault, ("the resolution", limit), ways)


def _lens_ways(
    setup: ImagingSetup, deepest: float, resolution_mm: float, options: list[LensOption]
) -> Iterator[Way]:
    """Other resolutions, blurs, lenses and clearances with which a lens would do."""
    plan, minimum = setup.plan, min_altitude_m(setup.plan)
    for option in options:
        nearest = _nearest_that_fits(setup, deepest, option)
        if nearest is not None:
            ratio = max(nearest.pixel_mm / resolution_mm, resolution_mm / nearest.pixel_mm)
            word = "coarser" if nearest.pixel_mm > resolution_mm else "finer"
            yield Way(
                change=f"resolution {nearest.pixel_mm:.3g} mm with the {option.lens_mm:g} mm lens",
                price=f"{ratio:.2f} times {word}, from {nearest.altitude_m:.2f} m",
                cost=ratio - 1.0,
                settings={"camera.focal_mm": option.lens_mm},
            )

    def fits(changed: ImagingSetup, lens_mm: float) -> bool:
        return _lens_option(changed, deepest, resolution_mm, lens_mm).fits

    for option in options:
        times = option.needed_light
        if not math.isfinite(times):
            continue
        blur_px = math.ceil(100 * plan.allowed_blur_px * times) / 100
        blurred = setup.with_plan(allowed_blur_px=blur_px)
        if blur_px > MAX_BLUR_PX or not fits(blurred, option.lens_mm):
            continue
        yield Way(
            change=f"allowed_blur_px {blur_px:g} with the {option.lens_mm:g} mm lens from "
            f"{option.altitude_m:.2f} m",
            price=f"{times:.2f} times the exposure and the blur",
            cost=times - 1.0,
            settings={"camera.focal_mm": option.lens_mm, "plan.allowed_blur_px": blur_px},
        )
    lowest, highest = (f(option.altitude_m for option in options) for f in (min, max))
    # At no distance in front of the port there is no lens to scale.
    if 0.0 < highest < minimum:
        lens = max(option.lens_mm for option in options)
        longer = math.ceil(10 * lens * minimum / highest) / 10
        if fits(setup, longer):
            yield Way(
                change=f"a lens of about {longer:g} mm, from {minimum:.2f} m",
                price=f"a footprint and its lines are {longer / lens:.2f} times smaller than "
                f"{lens:g} mm gives there",
                cost=longer / lens - 1.0,
                settings={"camera.focal_mm": longer},
            )
    elif lowest > deepest:
        lens = min(option.lens_mm for option in options)
        shorter = math.floor(10 * lens * deepest / lowest) / 10
        if fits(setup, shorter):
            yield Way(
                change=f"a lens of about {shorter:g} mm, from {deepest:g} m",
                price="a wider view through the flat port",
                cost=lens / shorter - 1.0,
                settings={"camera.focal_mm": shorter},
            )
    clearance = math.floor(100 * (highest - plan.relief_m)) / 100
    nearer = setup.with_plan(least_clearance_m=clearance)
    if 0.1 <= clearance < plan.least_clearance_m and any(
        fits(nearer, option.lens_mm) for option in options
    ):
        yield Way(
            change=f"least_clearance_m {clearance:g}",
            price=f"flown from {highest:.2f} m, nearer to the ground",
            cost=1.0 - clearance / plan.least_clearance_m,
            settings={"plan.least_clearance_m": clearance},
        )


def _nearest_that_fits(
    setup: ImagingSetup, highest_m: float, option: LensOption
) -> LensOption | None:
    """The altitude nearest to an option's that its lens can be used at, to about a fiftieth."""
    own = setup.with_camera(focal_mm=option.lens_mm).rig.cameras["left"]
    tried = np.geomspace(min_altitude_m(setup.plan), highest_m, 50)
    tried = tried[np.argsort(np.abs(np.log(tried / max(option.altitude_m, 1e-3))))]
    for altitude in tried:
        pixel_mm = math.ceil(pixel_on_floor_m(own, float(altitude)) * 1e6) / 1e3
        found = _lens_option(setup, highest_m, pixel_mm, option.lens_mm)
        if found.fits:
            return found
    return None


def speeds_for_rate(
    setup: ImagingSetup, rate_hz: float, lenses: Sequence[float]
) -> list[RateOption]:
    """Speed at which pictures at a fixed rate overlap as requested, u = r L (1 - O), for each lens.

    Raises:
        PlanError: cameras or trigger are slower than the rate.
    """
    if rate_hz > 1.0 / setup.camera.shortest_interval_s * (1 + 1e-9):
        raise _too_often(setup, rate_hz)
    return [_rate_option(setup, rate_hz, lens) for lens in lenses]


def _too_often(setup: ImagingSetup, rate_hz: float) -> PlanError:
    """The rate is beyond cameras or trigger: slower, or as fast with less overlap or higher."""
    plan, max_hz = setup.plan, 1.0 / setup.camera.shortest_interval_s
    share = max_hz / rate_hz
    own = setup.rig.cameras["left"]
    pixel_m = pixel_on_floor_m(own, plan.altitude_m)
    higher_m = math.ceil(100 * altitude_for_pixel_m(own, pixel_m / share)) / 100
    ways = [
        Way(
            change=f"a rate of {max_hz:g} Hz",
            price=f"{share:.0%} of the speed that {rate_hz:g} Hz would allow",
            cost=1.0 / share - 1.0,
            settings={},
        ),
        *less_overlap(
            plan, 1.0 - (1.0 - plan.forward_overlap) / share, f"{max_hz:g} Hz and ",
            "the same speed, ",
        ),
        Way(
            change=f"{max_hz:g} Hz and altitude_m {higher_m:g} instead of {plan.altitude_m:g}",
            price=f"the same speed, a pixel grows {1 / share:.2f} times",
            cost=(1.0 / share) ** 2 - 1.0,
            settings={"plan.altitude_m": higher_m},
        ),
    ]  # fmt: skip
    lens = setup.camera.focal_mm

    def goes(way: Way) -> bool:
        changes = {name.removeprefix("plan."): value for name, value in way.settings.items()}
        if changes.get("altitude_m", 0.0) > HIGHEST_ALTITUDE_M:
            return False
        return math.isfinite(_rate_option(setup.with_plan(**changes), max_hz, lens).exposure_ms)

    return conflict(
        f"{rate_hz:g} pictures a second are more than the {max_hz:g} that cameras and trigger take",
        ("the rate requested", "camera.shortest_interval_s"),
        filter(goes, ways),
    )


def _rate_option(setup: ImagingSetup, rate_hz: float, lens_mm: float) -> RateOption:
    setup, plan = setup.with_camera(focal_mm=lens_mm), setup.plan
    rig = setup.rig
    footprint = footprint_at(rig, plan.altitude_m, 1e-3)
    # Intervals are whole milliseconds: the speed must not need a shorter one.
    speed = math.floor(rate_hz * footprint.along_m * (1 - plan.forward_overlap) * 1e4) / 1e4
    option = partial(
        RateOption,
        lens_mm=lens_mm,
        speed_mps=speed,
        forward_overlap=max(0.0, 1.0 - plan.speed_mps / rate_hz / footprint.along_m),
    )
    try:
        settings = imaging_settings(rig, in_focus(setup.with_plan(speed_mps=speed)), quiet=True)
    except AliceError as error:
        return option(why=str(error).split(": ")[0])
    why = too_dark(settings.light)
    return option(
        exposure_ms=settings.exposure_s * 1e3,
        gain_db=settings.light.gain_db,
        snr=settings.light.snr_median,
        fits=not why,
        why=why,
    )


def lens_text(options: list[LensOption], resolution_mm: float) -> str:
    """A table of lenses, and the one to take."""
    best = options[0]
    rows = [
        [
            f"{o.lens_mm:g} mm", f"{o.altitude_m:.2f} m", *(
                _cell(v, d) for v, d in (
                    (o.f_number, 1), (o.across_m, 2), (o.stereo_m, 2), (o.spacing_m, 2),
                    (o.interval_s, 2), (o.exposure_ms, 2), (o.gain_db, 1),
                    (o.snr, 1), (o.hours_per_1000_m2, 2),
                )
            ), "yes" if o.fits else "no",
        ]
        for o in options
    ]  # fmt: skip
    header = (
        "lens", "altitude", "F", "across m", "stereo m", "lines m", "every s", "expose ms",
        "gain dB", "SNR", "h/1000 m2", "fits",
    )  # fmt: skip
    return "\n".join([
        f"{resolution_mm:g} mm a pixel on the sea floor",
        text_table(header, rows),
        *(f"{o.lens_mm:g} mm: {o.why}" for o in options if o.why),
        f"take the {best.lens_mm:g} mm lens at {best.altitude_m:.2f} m with F/{best.f_number:g}: "
        f"set camera.focal_mm, plan.altitude_m, camera.f_number; lines {best.spacing_m:.2f} m "
        "apart",
    ])  # fmt: skip


def rate_text(options: list[RateOption], rate_hz: float, speed_mps: float) -> str:
    """A table of speeds by lens."""
    rows = [
        [
            f"{o.lens_mm:g} mm", f"{o.speed_mps:.3f} m/s", f"{o.forward_overlap:.1%}",
            _cell(o.exposure_ms, 2), _cell(o.gain_db, 1), _cell(o.snr, 1),
            "yes" if o.fits else "no",
        ]
        for o in options
    ]  # fmt: skip
    header = (
        "lens", "largest speed", f"overlap at {speed_mps:g} m/s", "expose ms", "gain dB", "SNR",
        "fits",
    )  # fmt: skip
    return "\n".join([
        f"{rate_hz:g} pictures a second",
        text_table(header, rows),
        *(f"{o.lens_mm:g} mm: {o.why}" for o in options if o.why),
    ])  # fmt: skip


def _cell(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}" if math.isfinite(value) else "-"
