"""The plan solved the other way: from a resolution, a dive's length or a frame rate to settings."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from alice_survey.base.config import SurveyConfig
from alice_survey.base.errors import AliceError, ConfigError, PlanError
from alice_survey.base.text_table import text_table
from camera_calib.fov.table import json_row
from camera_calib.rig import design_rig
from missions.exposure.conflicts import Way, conflict
from missions.exposure.footprints import altitude_for_pixel_m, footprint_at, pixel_on_floor_m
from missions.exposure.light import too_dark
from missions.exposure.settings import ImagingSettings, imaging_settings
from missions.exposure.solve_dive import DiveArea, area_for_dive, dive_of_energy_s
from missions.exposure.solve_lens import LensOption, in_focus, lenses_for_resolution, with_lens


@dataclass(frozen=True, kw_only=True)
class RateOption:
    """What a fixed frame rate asks of the speed, with one lens."""

    lens_mm: float
    speed_mps: float
    """At which the forward overlap is as asked."""
    forward_overlap: float
    """At the speed of the plan instead."""
    exposure_ms: float
    gain_db: float
    snr: float
    """Of the median pixel."""
    fits: bool
    why: str


def solve_report(
    config: SurveyConfig,
    *,
    resolution_mm: float | None = None,
    dive_s: float | None = None,
    dive_wh: float | None = None,
    rate_hz: float | None = None,
    lenses: Sequence[float] = (12.5, 25.0),
) -> tuple[str, dict[str, Any]]:
    """Settings for what is given, as text and as JSON values; each that is given has its part.

    Args:
        config: all else of the plan.
        resolution_mm: size of a pixel on the sea floor at the mean altitude: find altitude and
            lens.
        dive_s: time of a dive: find the area that fits; with a resolution, at its altitude and
            lens.
        dive_wh: energy of a dive: likewise, at the mean power of flying lines.
        rate_hz: pictures a second: find the speed.
        lenses: focal lengths at hand, mm.

    Raises:
        ConfigError: nothing is given.
        PlanError: no lens fits; the message names what conflicts and the ways out.
    """
    parts: list[str] = []
    data: dict[str, Any] = {}
    dived = config
    if resolution_mm is not None:
        options = lenses_for_resolution(config, resolution_mm, lenses)
        parts.append(_lens_text(options, resolution_mm))
        data["lenses"] = [json_row(asdict(option)) for option in options]
        dived = with_lens(config, options[0])
    if dive_s is not None:
        area = area_for_dive(dived, dive_s)
        parts.append(_area_text(area, dived))
        data["dive"] = asdict(area)
    if dive_wh is not None:
        seconds, watts = dive_of_energy_s(dived, dive_wh)
        area = area_for_dive(dived, seconds)
        parts.append(
            f"{dive_wh:g} Wh last {seconds:.0f} s at {watts:.0f} W\n{_area_text(area, dived)}"
        )
        data["energy"] = {"dive_wh": dive_wh, "mean_w": watts, **asdict(area)}
    if rate_hz is not None:
        rates = speeds_for_rate(config, rate_hz, lenses)
        parts.append(_rate_text(rates, rate_hz, config.plan.speed_mps))
        data["rates"] = [json_row(asdict(option)) for option in rates]
    if not parts:
        raise ConfigError("say what is given: a resolution (mm), a dive (s or Wh) or a rate (Hz)")
    return "\n\n".join(parts), data


def speeds_for_rate(
    config: SurveyConfig, rate_hz: float, lenses: Sequence[float]
) -> list[RateOption]:
    """Speed at which pictures at a fixed rate overlap as asked, u = r L (1 - O), for each lens.

    Raises:
        PlanError: cameras or trigger are slower than the rate.
    """
    if rate_hz > 1.0 / config.camera.shortest_interval_s * (1 + 1e-9):
        raise _too_often(config, rate_hz)
    return [_rate_option(config, rate_hz, lens) for lens in lenses]


def _too_often(config: SurveyConfig, rate_hz: float) -> PlanError:
    """The rate is beyond cameras or trigger: slower, or as fast with less overlap or higher."""
    plan, most_hz = config.plan, 1.0 / config.camera.shortest_interval_s
    share = most_hz / rate_hz
    ways = [
        Way(
            change=f"a rate of {most_hz:g} Hz",
            price=f"{share:.0%} of the speed that {rate_hz:g} Hz would allow",
            cost=1.0 / share - 1.0,
        )
    ]
    reached = 1.0 - (1.0 - plan.forward_overlap) / share
    if reached > 0:
        shown = math.floor(1000 * reached) / 1000
        ways.append(
            Way(
                change=f"{most_hz:g} Hz and forward_overlap {shown:g} instead of "
                f"{plan.forward_overlap:g}",
                price=f"the same speed, a point is seen {1 / (1 - shown):.1f} instead of "
                f"{1 / (1 - plan.forward_overlap):.1f} times on a line",
                cost=1.0 - share,
            )
        )
    own = design_rig(config.camera, config.water).cameras["left"]
    pixel_m = pixel_on_floor_m(own, plan.altitude_m)
    higher_m = math.ceil(100 * altitude_for_pixel_m(own, pixel_m / share)) / 100
    ways.append(
        Way(
            change=f"{most_hz:g} Hz and altitude_m {higher_m:g} instead of {plan.altitude_m:g}",
            price=f"the same speed, a pixel grows {1 / share:.2f} times",
            cost=(1.0 / share) ** 2 - 1.0,
        )
    )
    return conflict(
        f"{rate_hz:g} pictures a second are more than the {most_hz:g} that cameras and trigger "
        "take",
        ("the rate asked for", "camera.shortest_interval_s"),
        ways,
    )


def _rate_option(config: SurveyConfig, rate_hz: float, lens_mm: float) -> RateOption:
    camera = config.camera.model_copy(update={"focal_mm": lens_mm})
    rig = design_rig(camera, config.water)
    plan = config.plan
    footprint = footprint_at(rig, plan.altitude_m, 1e-3)
    # The interval is told in whole milliseconds: the speed must not ask for a shorter one.
    speed = math.floor(rate_hz * footprint.along_m * (1 - plan.forward_overlap) * 1e4) / 1e4
    reached = max(0.0, 1.0 - plan.speed_mps / rate_hz / footprint.along_m)
    settings: ImagingSettings | None = None
    why = ""
    try:
        moved = plan.model_copy(update={"speed_mps": speed})
        changed = in_focus(config.model_copy(update={"camera": camera, "plan": moved}))
        settings = imaging_settings(rig, changed, quiet=True)
        why = too_dark(settings.light)
    except AliceError as error:
        why = str(error).split(": ")[0]
    return RateOption(
        lens_mm=lens_mm,
        speed_mps=speed,
        forward_overlap=reached,
        exposure_ms=settings.exposure_s * 1e3 if settings else math.nan,
        gain_db=settings.light.gain_db if settings else math.nan,
        snr=settings.light.snr_median if settings else math.nan,
        fits=not why,
        why=why,
    )


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


def _area_text(area: DiveArea, config: SurveyConfig) -> str:
    return (
        f"a dive of {area.dive_s:g} s holds {area.area_m2:.0f} m2, such as {area.side_m:.1f} x "
        f"{area.side_m:.1f} m: {area.lines} lines {area.line_spacing_m:.3g} m apart at "
        f"{area.speed_mps:g} m/s, {area.cross_lines} across, turns of {area.turn_s:.0f} s, descent "
        f"and ascent; {config.camera.focal_mm:g} mm lens at {config.plan.altitude_m:.2f} m"
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
