"""What the direction of lines costs in a current."""

import math
from typing import Any

import numpy as np

from alice_survey.core.config import SurveyConfig
from alice_survey.core.frames import Array
from missions.exposure.settings import ImagingSetup, imaging_settings
from missions.exposure.ways_out import ConflictError
from missions.plan.ready import with_tried_ways
from missions.route.energy import (
    FlightConditions,
    course_powers,
    flight_conditions,
    usable_wh,
)


def both_ways_w(power_w: Array) -> Array:
    """(K / 2,) mean power of lines flown there and back, by heading from north to south."""
    half = len(power_w) // 2
    mean: Array = (power_w[:half] + power_w[half:]) / 2
    return mean


def energy_report(
    flown: FlightConditions, battery_wh: float, *, imaging_w: float = 0.0
) -> tuple[str, dict[str, Any]]:
    """What line direction costs in the expected current.

    Args:
        flown: vehicle, speed and current.
        battery_wh: what a dive may take of the battery.
        imaging_w: mean power of strobes while on lines.

    Returns:
        Text, and its numbers; None where no course can be flown.
    """
    lines_w = course_powers(flown)[0] + flown.hotel_w + imaging_w
    speed, current = flown.speed_mps, flown.current_ne_mps
    size, towards_deg = math.hypot(*current), math.degrees(math.atan2(current[1], current[0])) % 360
    mean_w = both_ways_w(lines_w)
    headings_deg: Array = np.linspace(0.0, 180.0, len(mean_w), endpoint=False)
    flyable = np.flatnonzero(np.isfinite(mean_w))
    range_text, range_data = _range(headings_deg[flyable], mean_w[flyable], battery_wh, speed)
    if len(flyable) < len(mean_w):
        range_text.append(
            f"  lines can be flown both ways on {len(flyable)} of {len(mean_w)} headings"
        )
    manner = "held by sway" if flown.manner == "held" else "crabbing"
    text = "\n".join(
        [
            f"energy: {flown.craft.name} at {speed:g} m/s over ground in a current of "
            f"{size:.2f} m/s towards {towards_deg:03.0f} deg, lines {manner}",
            f"  there and back, with hotel load {flown.hotel_w:g} W, lights {imaging_w:.1f} W",
            *range_text,
        ]
    )
    data = {
        "current_mps": size,
        "current_towards_deg": towards_deg,
        "speed_mps": speed,
        "lines": manner,
        **range_data,
        "headings": len(mean_w),
        "headings_flyable": len(flyable),
        "usable_wh": battery_wh,
        "hotel_w": flown.hotel_w,
        "imaging_w": imaging_w,
    }
    return text, data


def _range(
    headings_deg: Array, mean_w: Array, battery_wh: float, speed_mps: float
) -> tuple[list[str], dict[str, float | None]]:
    """Best and worst of the headings that can be flown, and how far the battery reaches."""
    names = ("best_heading_deg", "best_w", "worst_heading_deg", "worst_w", "hours", "line_m")
    if not len(mean_w):
        return [], dict.fromkeys(names)
    best, worst = int(np.argmin(mean_w)), int(np.argmax(mean_w))
    hours = battery_wh / float(mean_w[best])
    line_m = hours * 3600.0 * speed_mps
    text = [
        f"  least on {headings_deg[best]:.0f} deg ({mean_w[best]:.1f} W), most on "
        f"{headings_deg[worst]:.0f} deg ({mean_w[worst]:.1f} W)",
        f"  {battery_wh:.0f} Wh to use: {hours:.1f} h, {line_m / 1e3:.1f} km of lines on the best "
        "heading",
    ]
    values = (headings_deg[best], mean_w[best], headings_deg[worst], mean_w[worst], hours, line_m)
    return text, {name: float(value) for name, value in zip(names, values, strict=True)}


def current_report(config: SurveyConfig) -> tuple[str, dict[str, Any]]:
    """`alice-survey plan current`: what the current costs, with the survey's own strobes.

    Args:
        config: of the survey.

    Returns:
        As of `energy_report`.

    Raises:
        PlanError: cameras and strobes cannot do it.
    """
    setup, flown = ImagingSetup.of(config), flight_conditions(config)
    try:
        imaging_w = imaging_settings(setup.rig, setup, quiet=True).imaging_w
    except ConflictError as found:
        raise with_tried_ways(found, config, setup.rig) from None
    return energy_report(flown, usable_wh(config.vehicle), imaging_w=imaging_w)
