"""Rows of the printed table about lines, dives and coverage."""

import math
from collections.abc import Sequence
from typing import Any

from alice_survey.core.config import VehicleConfig
from alice_survey.core.text_table import text_table
from alice_survey.kit.words import share
from camera_calib.rig import Rig
from missions.coverage.certificate import Certificate
from missions.exposure.settings_table import Setting, setting_from_json
from missions.exposure.storage import raw_bytes
from missions.lines.sweep import Sweep
from missions.route.energy import battery_wh, hotel_w, usable_wh
from missions.values.plan_file import Plan

_GROUP = "LINES AND DIVES"
_MAIN = (
    "footprint across", "footprint along", "pixel on the floor", "stereo swath", "line spacing",
    "side overlap", "interval", "forward overlap", "exposure", "blur", "focus, set in air",
    "sharp from, to", "f-number needed", "signal to noise", "gain", "pulse", "mean power",
    "write rate on a line",
)  # fmt: skip
"""Settings that a person sets or checks before a dive."""


def main_settings(plan_json: dict[str, Any]) -> str:
    """The main settings of a plan as one screen of text; all are in `settings.txt`.

    Args:
        plan_json: the contents of `plan.json`.
    """
    rows = [setting_from_json(row) for row in plan_json["details"]["imaging"]["rows"]]
    shown = {row.name: (row.name, row.text, row.bound_by) for row in rows}
    table = text_table(("setting", "value", "bound by"), [shown[n] for n in _MAIN if n in shown])
    return f"{table}\nEvery setting with its equation and source: plan/settings.txt, or --all\n"


def plan_rows(
    plan: Plan, seen: Certificate, sweep: Sweep | None, vehicle: VehicleConfig, rig: Rig
) -> tuple[Setting, ...]:
    """The main figures of the plan.

    Args:
        plan: the plan.
        seen: its certificate.
        sweep: how the direction of the lines was found; None where it was given.
        vehicle: its battery.
        rig: its cameras.
    """
    return (
        *_line_rows(plan, sweep),
        *_dive_rows(plan, vehicle),
        _data_row(plan, rig),
        _coverage_row(seen),
    )


def _line_rows(plan: Plan, sweep: Sweep | None) -> Sequence[Setting]:
    counts = dict.fromkeys(("survey", "cross", "closing", "fill", "tie"), 0)
    for line in plan.lines:
        counts[line.kind] += 1
    kinds = ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)
    heading = math.degrees(plan.lines[0].heading_rad)
    if sweep is None:
        why, bound = "as set", "line_heading_deg"
    else:
        minimum = math.degrees(sweep.width_heading_rad) % 180.0
        why = f"least total width along {minimum:.1f} deg; then turns, ways and current are counted"
        bound = "energy"
    return (
        _row("area", plan.area.survey.area, "m2", "as given, with margin_m", "[area]"),
        _row("line heading", heading, "deg", "least energy of all headings", bound, why),
        _row("lines", len(plan.lines), "", "width / spacing", "line spacing", kinds),
    )


def _dive_rows(plan: Plan, vehicle: VehicleConfig) -> Sequence[Setting]:
    usable = usable_wh(vehicle)
    longest = max(dive.energy_wh for dive in plan.dives)
    spots = sum(1 for dive in plan.dives for leg in dive.route.legs if leg.turn_rad)
    flown_m = sum(line.length_m for line in plan.lines)
    return (
        _row(
            "way", plan.length_m, "m", "lines, turns, ways from home and back", "lines",
            f"{flown_m:.0f} m on lines; {spots} turns on the spot",
        ),
        _row("duration", plan.duration_s / 60, "min", "way / speed + stops + dive", "speed_mps"),
        _row(
            "dives", len(plan.dives), "", "least number that the battery holds", "battery_wh",
            f"the longest takes {longest:.0f} of {usable:.0f} Wh "
            f"({vehicle.battery_reserve:.0%} of {battery_wh(vehicle):.0f} Wh are kept)",
        ),
        _row(
            "energy", plan.energy_wh, "Wh", "sum of power x time", "hotel_w, drag, current",
            _hotel_note(plan, vehicle),
        ),
    )  # fmt: skip


def _hotel_note(plan: Plan, vehicle: VehicleConfig) -> str:
    """What of the energy is hotel load, and where that load has no source."""
    load = hotel_w(vehicle)
    note = f"hotel load {load:g} W is {load * plan.duration_s / 3600 / plan.energy_wh:.0%} of it"
    if "hotel_w" in vehicle.model_fields_set or vehicle.file is not None:
        return note
    return (
        f"{note}, and is inferred: measure what your vehicle draws with its thrusters at rest, "
        "and set vehicle.hotel_w"
    )


def _data_row(plan: Plan, rig: Rig) -> Setting:
    stored = raw_bytes(rig.cameras[rig.reference], len(rig.cameras), plan.stations)
    return _row(
        "data", stored / 1e9, "GB", "stations x cameras x pixels", "stations",
        f"{plan.stations} stations, {plan.stations * len(rig.cameras)} pictures",
    )  # fmt: skip


def _coverage_row(seen: Certificate) -> Setting:
    often = seen.pattern.passes * seen.pattern.pictures
    return _row(
        "covered as requested", seen.share_at_overlap, "%", "union of real footprints", "lines",
        f"by every camera on {seen.pattern.passes} line{'s'[: seen.pattern.passes > 1]} and in "
        f"{often} pictures or more, as in an endless pattern of this spacing and step; "
        f"{share(seen.covered_share, 2)} is in some picture, "
        f"{share(seen.stereo_share, 2)} in stereo; the "
        f"place seen least is in {seen.fewest_pictures} pictures of a camera, the mean place "
        f"in {seen.mean_pictures:.1f} of all",
    )  # fmt: skip


def _row(
    name: str, value: float, unit: str, equation: str, bound_by: str, note: str = ""
) -> Setting:
    return Setting(
        group=_GROUP, name=name, value=value, unit=unit, equation=equation,
        source="this plan", bound_by=bound_by, note=note,
    )  # fmt: skip
