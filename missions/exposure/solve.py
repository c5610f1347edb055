"""The plan solved the other way: from a resolution, a dive's length or a frame rate to settings."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from alice_survey.base.artefacts import json_values
from alice_survey.base.config import PlanConfig
from alice_survey.base.errors import AliceError, ConfigError, PlanError
from alice_survey.base.text_table import text_table
from alice_survey.vehicle.limits import spot_rate_rad_s
from missions.exposure.focus import largest_f_number, needed_f_number
from missions.exposure.footprints import altitude_for_pixel_m, footprint_at, pixel_on_floor_m
from missions.exposure.light import LEAST_SNR, light_for_snr_e, too_dark
from missions.exposure.settings import ImagingSetup, imaging_settings
from missions.exposure.ways_out import HIGHEST_ALTITUDE_M, Way, conflict, less_overlap
from missions.values.costs import time_costs


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
    area_m2: float
    side_m: float
    """Side of a square of that area."""
    lines: int
    line_spacing_m: float
    speed_mps: float
    turn_s: float
    cross_lines: int


def solve_report(
    setup: ImagingSetup,
    seafloor_depth_m: float,
    *,
    resolution_mm: float | None = None,
    dive_s: float | None = None,
    battery_s: float = math.inf,
    rate_hz: float | None = None,
    lenses: Sequence[float] = (12.5, 25.0),
) -> tuple[str, dict[str, Any]]:
    """Settings for what is given, as text and as JSON values; each that is given has its part.

    Args:
        setup: all else of cameras, water, strobes and plan.
        seafloor_depth_m: below the surface.
        resolution_mm: size of a pixel on the sea floor at the mean altitude: find altitude and
            lens.
        dive_s: time of a dive: find the area that fits; with a resolution, at its altitude and
            lens.
        battery_s: how long the battery lasts: no dive is longer.
        rate_hz: pictures a second: find the speed.
        lenses: available focal lengths, mm.

    Raises:
        ConfigError: nothing is given.
        PlanError: no lens fits; the message names what conflicts and the ways out.
    """
    parts: list[str] = []
    data: dict[str, Any] = {}
    dived = setup
    if resolution_mm is not None:
        options = lenses_for_resolution(setup, seafloor_depth_m, resolution_mm, lenses)
        parts.append(_lens_text(options, resolution_mm))
        data["lenses"] = json_values(options)
        dived = with_lens(setup, options[0])
    if dive_s is not None:
        area = area_for_dive(dived, seafloor_depth_m, min(dive_s, battery_s))
        parts.append(_area_text(area, dived))
        if battery_s < dive_s:
            parts.append(
                f"the battery lasts {battery_s:.0f} s of the {dive_s:g} s (vehicle.battery_wh, "
                "battery_reserve, hotel_w)"
            )
        data["dive"] = asdict(area)
    if rate_hz is not None:
        rates = speeds_for_rate(setup, rate_hz, lenses)
        parts.append(_rate_text(rates, rate_hz, setup.plan.speed_mps))
        data["rates"] = json_values(rates)
    if not parts:
        raise ConfigError("say what is given: a resolution (mm), a dive (s) or a rate (Hz)")
    return "\n\n".join(parts), data


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
    ways = list(_lens_ways(setup, deepest, resolution_mm, options))
    least = least_altitude_m(setup.plan)
    lowest, highest = (f(option.altitude_m for option in options) for f in (min, max))
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


def _lens_ways(
    setup: ImagingSetup, deepest: float, resolution_mm: float, options: list[LensOption]
) -> Iterator[Way]:
    """Other resolutions, blurs, lenses and clearances with which a lens would do."""
    plan, least = setup.plan, least_altitude_m(setup.plan)
    for option in options:
        nearest = _nearest_that_fits(setup, deepest, option)
        if nearest is not None:
            ratio = max(nearest.pixel_mm / resolution_mm, resolution_mm / nearest.pixel_mm)
            word = "coarser" if nearest.pixel_mm > resolution_mm else "finer"
            yield Way(
                change=f"resolution {nearest.pixel_mm:.3g} mm with the {option.lens_mm:g} mm lens",
                price=f"{ratio:.2f} times {word}, from {nearest.altitude_m:.2f} m",
                cost=ratio - 1.0,
            )
    noise_e = setup.camera.read_noise_e
    for option in options:
        if math.isnan(option.snr):
            continue
        times = light_for_snr_e(LEAST_SNR, noise_e) / light_for_snr_e(option.snr, noise_e)
        blur_px = math.ceil(100 * plan.allowed_blur_px * times) / 100
        yield Way(
            change=f"allowed_blur_px {blur_px:g} with the {option.lens_mm:g} mm lens from "
            f"{option.altitude_m:.2f} m",
            price=f"{times:.2f} times the exposure and the blur",
            cost=times - 1.0,
        )
    lowest, highest = (f(option.altitude_m for option in options) for f in (min, max))
    # At no distance in front of the port there is no lens to scale.
    if 0.0 < highest < least:
        lens = max(option.lens_mm for option in options)
        longer = math.ceil(10 * lens * least / highest) / 10
        yield Way(
            change=f"a lens of about {longer:g} mm, from {least:.2f} m",
            price=f"a footprint and its lines are {longer / lens:.2f} times smaller than "
            f"{lens:g} mm gives there",
            cost=longer / lens - 1.0,
        )
    elif lowest > deepest:
        lens = min(option.lens_mm for option in options)
        shorter = math.floor(10 * lens * deepest / lowest) / 10
        yield Way(
            change=f"a lens of about {shorter:g} mm, from {deepest:g} m",
            price="a wider view through the flat port",
            cost=lens / shorter - 1.0,
        )
    clearance = math.floor(100 * (highest - plan.relief_m)) / 100
    if 0.1 <= clearance < plan.least_clearance_m:
        yield Way(
            change=f"least_clearance_m {clearance:g}",
            price=f"flown from {highest:.2f} m, nearer to the ground",
            cost=1.0 - clearance / plan.least_clearance_m,
        )


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
    plan, most_hz = setup.plan, 1.0 / setup.camera.shortest_interval_s
    share = most_hz / rate_hz
    own = setup.rig.cameras["left"]
    pixel_m = pixel_on_floor_m(own, plan.altitude_m)
    higher_m = math.ceil(100 * altitude_for_pixel_m(own, pixel_m / share)) / 100
    ways = [
        Way(
            change=f"a rate of {most_hz:g} Hz",
            price=f"{share:.0%} of the speed that {rate_hz:g} Hz would allow",
            cost=1.0 / share - 1.0,
        ),
        *less_overlap(
            plan, 1.0 - (1.0 - plan.forward_overlap) / share, f"{most_hz:g} Hz and ",
            "the same speed, ",
        ),
        Way(
            change=f"{most_hz:g} Hz and altitude_m {higher_m:g} instead of {plan.altitude_m:g}",
            price=f"the same speed, a pixel grows {1 / share:.2f} times",
            cost=(1.0 / share) ** 2 - 1.0,
        ),
    ]  # fmt: skip
    return conflict(
        f"{rate_hz:g} pictures a second are more than the {most_hz:g} that cameras and trigger "
        "take",
        ("the rate requested", "camera.shortest_interval_s"),
        ways,
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


def area_for_dive(setup: ImagingSetup, seafloor_depth_m: float, dive_s: float) -> DiveArea:
    """The largest square that a dive holds, with its turns, cross lines, descent and ascent.

    Lines of length a lie s apart: `n = ceil(a / s)` of them and `n - 1` turns, the cross lines and
    the way home at the survey's speed. A real area takes longer the more it is cut up: then
    `alice-survey plan` gives the time.

    Raises:
        PlanError: the dive is too short for one line of one picture's length.
    """
    settings, plan = imaging_settings(setup.rig, setup, quiet=True), setup.plan
    costs = time_costs(plan.speed_mps)
    dive_down_s = costs.dive_s(seafloor_depth_m - plan.altitude_m)
    spacing = settings.line_spacing_m
    turn = turn_s(plan, spacing)

    def needed_s(side_m: float) -> float:
        lines = max(1, math.ceil(side_m / spacing - 1e-9))
        crossing = plan.cross_lines * (side_m / plan.speed_mps + turn)
        home = side_m / plan.speed_mps
        flown = lines * side_m / plan.speed_mps + (lines - 1) * turn
        return dive_down_s + flown + crossing + home

    smallest = settings.footprint_along_m
    if needed_s(smallest) > dive_s:
        raise PlanError(
            f"a dive of {dive_s:g} s is too short: {dive_down_s:.0f} s go down and up, and one "
            f"picture's length takes {needed_s(smallest):.0f} s in all: give a longer dive"
        )
    low, high = smallest, 2.0 * math.sqrt(dive_s * plan.speed_mps * spacing) + smallest
    while high - low > 1e-3:
        middle = (low + high) / 2
        low, high = (middle, high) if needed_s(middle) <= dive_s else (low, middle)
    return DiveArea(
        dive_s=dive_s,
        area_m2=low * low,
        side_m=low,
        lines=max(1, math.ceil(low / spacing - 1e-9)),
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
    rate_rad_s = spot_rate_rad_s(plan.turn_rate_limit_deg_s)
    costs, radius = time_costs(plan.speed_mps, turn_rate_rad_s=rate_rad_s), plan.arc_radius_m
    if spacing_m >= 2 * radius:
        arcs = math.pi * radius + spacing_m - 2 * radius
    else:
        arcs = radius * (math.pi + 4 * math.acos((2 * radius + spacing_m) / (4 * radius)))
    run_in = plan.run_in_m / plan.speed_mps
    by_arcs = arcs / plan.speed_mps + run_in
    by_spot = 2 * costs.spot_j(math.pi / 2) + spacing_m / plan.speed_mps + run_in
    return {"arcs": by_arcs, "spot": by_spot}.get(plan.turns, min(by_arcs, by_spot))


def _lens_text(options: list[LensOption], resolution_mm: float) -> str:
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


def _area_text(area: DiveArea, setup: ImagingSetup) -> str:
    return (
        f"a dive of {area.dive_s:.6g} s holds {area.area_m2:.0f} m2, such as {area.side_m:.1f} x "
        f"{area.side_m:.1f} m: {area.lines} lines {area.line_spacing_m:.3g} m apart at "
        f"{area.speed_mps:g} m/s, {area.cross_lines} across, turns of {area.turn_s:.0f} s, descent "
        f"and ascent; {setup.camera.focal_mm:g} mm lens at {setup.plan.altitude_m:.2f} m"
    )


def _rate_text(options: list[RateOption], rate_hz: float, speed_mps: float) -> str:
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
