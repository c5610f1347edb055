"""The trade of line direction against the current: in words, numbers and a picture."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.artefacts import json_values
from alice_survey.core.config import SurveyConfig
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.steady import drag_power
from missions.exposure.settings import ImagingSetup, imaging_settings
from missions.exposure.ways_out import ConflictError
from missions.plan.ready import with_tried_ways
from missions.route.energy import (
    FlightConditions,
    Manner,
    course_power,
    course_powers,
    flight_conditions,
    motion,
    usable_wh,
)


@dataclass(frozen=True, kw_only=True)
class LinePower:
    """What lines take that are laid and flown in one way, mean of there and back."""

    name: str
    drag_w: float
    """Power that damping takes from the hull, without body lift."""
    lift_w: float
    """Power that body lift takes from it in addition."""
    thrusters_w: float
    """Electrical power; infinite if it cannot be flown both ways."""
    line_w: float
    """Power of the whole vehicle."""
    crab_deg: float
    """Angle of the heading off the course."""

    def to_json(self) -> dict[str, Any]:
        """The powers as numbers; None where it cannot be flown."""
        values: dict[str, Any] = json_values(self)
        return values


def three_ways(
    flown: FlightConditions, *, imaging_w: float = 0.0
) -> tuple[LinePower, LinePower, LinePower]:
    """Lines along the current, across it held by sway, and across it crabbing.

    Args:
        flown: vehicle, speed and current.
        imaging_w: mean power of strobes while on lines.
    """
    craft, current, speed = flown.craft, flown.current_ne_mps, flown.speed_mps
    towards = math.atan2(current[1], current[0])
    body = craft.plant.body
    bare = body._replace(lift=np.zeros(4))
    other_w = flown.hotel_w + imaging_w
    cases: tuple[tuple[str, float, Manner], ...] = (
        ("along the current", 0.0, "held"),
        ("across, held by sway", math.pi / 2, "held"),
        ("across, crabbing", math.pi / 2, "crab"),
    )
    ways = []
    for name, off, manner in cases:
        courses = towards + off + np.array([0.0, math.pi])
        moved = motion(courses, speed, current, manner)
        drag = float(drag_power(bare, moved.nu).mean())
        thrusters = float(course_power(craft, courses, speed, current, manner).mean())
        ways.append(
            LinePower(
                name=name,
                drag_w=drag,
                lift_w=float(drag_power(body, moved.nu).mean()) - drag,
                thrusters_w=thrusters,
                line_w=thrusters + other_w,
                crab_deg=math.degrees(float(np.abs(moved.crab_rad).mean())),
            )
        )
    return ways[0], ways[1], ways[2]


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
        A table, and its numbers.

    Courses that cannot be flown have no power: "-" in the table, None in the numbers.
    """
    lines_w = course_powers(flown)[0] + flown.hotel_w + imaging_w
    speed, current = flown.speed_mps, flown.current_ne_mps
    size, towards_deg = math.hypot(*current), math.degrees(math.atan2(current[1], current[0])) % 360
    ways = three_ways(flown, imaging_w=imaging_w)
    mean_w = both_ways_w(lines_w)
    headings_deg: Array = np.linspace(0.0, 180.0, len(mean_w), endpoint=False)
    flyable = np.flatnonzero(np.isfinite(mean_w))
    range_text, range_data = _range(headings_deg[flyable], mean_w[flyable], battery_wh, speed)
    if len(flyable) < len(mean_w):
        range_text.append(
            f"  lines can be flown both ways on {len(flyable)} of {len(mean_w)} headings"
        )
    manner = "held by sway" if flown.manner == "held" else "crabbing"
    rows = [
        f"  {way.name:22s}{way.drag_w:8.2f}{way.lift_w:8.2f}{_watts(way.thrusters_w):>12s}"
        f"{_watts(way.line_w):>9s}{way.crab_deg:8.0f}"
        for way in ways
    ]
    text = "\n".join(
        [
            f"energy: {flown.craft.name} at {speed:g} m/s over ground in a current of "
            f"{size:.2f} m/s towards {towards_deg:03.0f} deg, lines {manner}",
            f"  {'lines, there and back':22s}{'drag W':>8s}{'lift W':>8s}{'thrusters W':>12s}"
            f"{'total W':>9s}{'crab':>8s}",
            *rows,
            f"  in the totals: hotel load {flown.hotel_w:g} W, lights {imaging_w:.1f} W",
            *range_text,
        ]
    )
    data = {
        "current_mps": size,
        "current_towards_deg": towards_deg,
        "speed_mps": speed,
        "lines": manner,
        "ways": [way.to_json() for way in ways],
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


def current_report(config: SurveyConfig, plot: Path | None) -> tuple[str, dict[str, Any]]:
    """`alice-survey plan current`: what the current costs, with the survey's own strobes.

    Args:
        config: of the survey.
        plot: picture to draw, PNG, PDF or SVG; None for none.

    Returns:
        As of `energy_report`.

    Raises:
        PlanError: cameras and strobes cannot do it, or the picture cannot be written.
    """
    setup, flown = ImagingSetup.of(config), flight_conditions(config)
    try:
        imaging_w = imaging_settings(setup.rig, setup, quiet=True).imaging_w
    except ConflictError as found:
        raise with_tried_ways(found, config, setup.rig) from None
    text, data = energy_report(flown, usable_wh(config.vehicle), imaging_w=imaging_w)
    if plot is None:
        return text, data
    draw_trade(plot, flown, imaging_w=imaging_w)
    return f"{text}\n{plot}", {**data, "plot": str(plot)}


def draw_trade(path: Path, flown: FlightConditions, *, imaging_w: float = 0.0) -> None:
    """Draw the power of the thrusters on lines and between, by course.

    Args:
        path: of a picture, PNG, PDF or SVG.
        flown: vehicle, speed and current.
        imaging_w: mean power of strobes while on lines.

    Raises:
        ConfigError: the picture cannot be written.
    """
    from alice_survey.kit.figure import check_figure_path, figure_style, new_figure, save_figure

    check_figure_path(path)
    (lines_w, way_w), current = course_powers(flown), flown.current_ne_mps
    size = math.hypot(*current)
    towards = math.atan2(current[1], current[0])
    figure = new_figure(6.4, 6.4)
    with figure_style():
        axes = figure.add_subplot(projection="polar")
    axes.set_theta_zero_location("N")
    axes.set_theta_direction(-1)
    manner = "heading held" if flown.manner == "held" else "crabbing"
    _draw_course(axes, lines_w, "C0", f"on lines ({manner})")
    _draw_course(axes, way_w, "C1", "between lines")
    mean_w = both_ways_w(lines_w)
    _draw_course(axes, np.concatenate([mean_w, mean_w]), "C0", "lines, there and back", "--")
    seen = np.concatenate([lines_w, way_w])
    if not np.any(np.isfinite(seen)):
        axes.set_yticklabels([])
        axes.text(
            0.5, 0.7, "no course can be flown\nin this current", transform=axes.transAxes,
            ha="center", bbox={"facecolor": "white", "edgecolor": "none"},
        )  # fmt: skip
    maximum = float(np.max(seen[np.isfinite(seen)], initial=1.0))
    axes.set_ylim(0.0, 1.05 * maximum)
    axes.set_rlabel_position((math.degrees(towards) + 45.0) % 360.0)
    if size > 0.0:
        axes.annotate(
            "", xy=(towards, 0.45 * maximum), xytext=(towards + math.pi, 0.45 * maximum),
            arrowprops={"arrowstyle": "-|>", "color": "0.35", "lw": 1.8}, zorder=5,
        )  # fmt: skip
        axes.text(
            towards, 0.72 * maximum, f"current\n{size:.2f} m/s", color="0.35", ha="center",
            va="center", bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5},
        )  # fmt: skip
    axes.set_title(
        f"Electrical power of {flown.craft.name}'s thrusters, W, by course\n"
        f"{flown.speed_mps:g} m/s over ground; on top come {flown.hotel_w:g} W of hotel load and "
        f"{imaging_w:.1f} W of lights",
        fontsize=10,
    )
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, -0.17), ncols=3, fontsize=8)
    save_figure(figure, path)


def _draw_course(axes: Any, power_w: Array, colour: str, label: str, style: str = "-") -> None:
    course = np.linspace(0.0, 2 * math.pi, len(power_w) + 1)
    closed = np.append(power_w, power_w[0])
    axes.plot(
        course, np.where(np.isfinite(closed), closed, np.nan), style, color=colour, label=label
    )


def _watts(power_w: float) -> str:
    return f"{power_w:.2f}" if math.isfinite(power_w) else "-"
