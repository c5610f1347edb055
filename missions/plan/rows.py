"""The table of a plan's settings: each number with its equation and what bounds it."""

import itertools
import math
import textwrap
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from alice_survey.core.artefacts import json_values
from alice_survey.core.config import PlanConfig
from alice_survey.kit.words import text_table
from missions.exposure.light import MIDDLE_GREY, SEEN_SHARE
from missions.exposure.settings import ImagingSettings, ImagingSetup
from missions.exposure.strobe import BUS_SAG, BUS_V, WARM_SEA_C
from missions.values.footprint import step_for_overlap

WIDTH = 100
_MAIN = (
    "footprint across", "footprint along", "pixel on the floor", "stereo swath", "line spacing",
    "side overlap", "interval", "forward overlap", "exposure", "blur", "focus, set in air",
    "sharp from, to", "f-number needed", "signal to noise", "gain", "pulse", "mean power",
    "write rate on a line",
)  # fmt: skip
"""Settings that a person sets or checks before a dive."""

Row = tuple[str, float | tuple[float, ...], str, str, str, str]
"""Fields of a `Setting` from its name on, in order."""


@dataclass(frozen=True)
class Setting:
    """A number of the plan, where it comes from, and what kept it from being better."""

    group: str
    """Heading under which it stands."""
    name: str
    value: float | tuple[float, ...]
    """One number, or some: over the relief, over the channels (the note says which)."""
    unit: str
    """Unit of the value; `%` shows a share as percent."""
    equation: str
    """docs/imaging.md has its source."""
    bound_by: str
    """The setting or limit that a better value would break; empty where nothing does."""
    note: str = ""

    def to_json(self) -> dict[str, Any]:
        """All fields, and the text of the value, as JSON values; what is not finite is null."""
        return {**json_values(asdict(self)), "text": self.text}

    @property
    def text(self) -> str:
        """The value with its unit, to about three digits."""
        values = self.value if isinstance(self.value, tuple) else (self.value,)
        scale = 100.0 if self.unit == "%" else 1.0
        return f"{' / '.join(_number(scale * value) for value in values)} {self.unit}".rstrip()


def settings_table(rows: Sequence[Setting]) -> str:
    """Rows under the headings of their groups, with notes below each; no line exceeds `WIDTH`.

    A row has name, value, equation, and in brackets what a better value would break.
    """
    lines = []
    for group, some in itertools.groupby(rows, lambda row: row.group):
        lines += ["", group.upper()]
        for row in some:
            head = f"  {row.name:<24}{row.text:<24}  {row.equation} ({row.bound_by or '-'})"
            lines += textwrap.wrap(head, WIDTH, subsequent_indent=" " * 52)
            lines += textwrap.wrap(" " * 6 + row.note, WIDTH, subsequent_indent=" " * 6)
    return "\n".join(lines[1:])


def _number(value: float) -> str:
    """Three digits or so, never in powers of ten where a plain number is short."""
    if not math.isfinite(value):
        return "infinity" if value > 0 else "-"
    if value == 0:
        return "0"
    size = abs(value)
    if size >= 1e6 or size < 1e-4:
        return f"{value:.3g}"
    decimals = max(0, 2 - math.floor(math.log10(size)))
    text = f"{value:.{min(decimals, 5)}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def main_settings(plan_json: dict[str, Any]) -> str:
    """The main settings of a plan as one screen of text; all are in `settings.txt`.

    Args:
        plan_json: the contents of `plan.json`.
    """
    rows = plan_json["details"]["imaging"]["rows"]
    shown = {row["name"]: [row[key] for key in ("name", "text", "bound_by")] for row in rows}
    table = text_table(("setting", "value", "bound by"), [shown[n] for n in _MAIN if n in shown])
    return (
        f"{table}\nSeveral values: over the top / mean / bottom of the relief; of overlaps at the "
        "mean / over the\ntop / there with lines off track; of signal to noise in red / green / "
        "blue. Equations:\nplan/settings.txt, or --all\n"
    )


def imaging_rows(found: ImagingSettings, setup: ImagingSetup) -> tuple[Setting, ...]:
    """Settings of cameras, strobes and the pattern of lines.

    Args:
        found: the settings.
        setup: what they follow from.
    """
    groups = {
        "footprint and lines": _footprint_rows(found, setup),
        "frame rate": _rate_rows(found, setup.plan),
        "exposure": _exposure_rows(found, setup),
        "focus and aperture": _focus_rows(found, setup),
        "light": _light_rows(found, setup),
        "strobes": _strobe_rows(found),
        "data": _data_rows(found, setup),
    }
    return tuple(Setting(group, *row) for group, rows in groups.items() for row in rows)


def _footprint_rows(found: ImagingSettings, setup: ImagingSetup) -> list[Row]:
    plan, spacing, prints = setup.plan, found.spacing, found.footprints
    over = (prints.top, prints.mean, prints.bottom)
    is_given, note = plan.line_spacing_m is not None, ""
    if is_given and spacing.mean_overlap < plan.side_overlap - 1e-9:
        needed_m = step_for_overlap(prints.mean.across_m, plan.side_overlap)
        note = f"{plan.side_overlap:.0%} needs {needed_m - 2 * plan.track_error_m:.3f} m"
    return [
        ("footprint across", tuple(p.across_m for p in over), "m", "traced",
         "altitude_m", "over the top, mean and bottom of the relief, from "
         f"{' / '.join(f'{p.altitude_m:.3g}' for p in over)} m: the rectangle between the corners"),
        ("footprint along", tuple(p.along_m for p in over), "m", "traced",
         "altitude_m", ""),
        ("pixel on the floor", tuple(p.pixel_m * 1e3 for p in over), "mm", "D / f",
         "altitude_m", ""),
        ("stereo swath", tuple(p.stereo_across_m for p in over), "m", "seen by every camera",
         "baseline_m", ""),
        ("line spacing", spacing.spacing_m, "m", "as set" if is_given else "W (1 - O) - 2 e",
         spacing.bound_by, note),
        ("side overlap", (spacing.mean_overlap, spacing.top_overlap, spacing.off_track_overlap),
         "%", "1 - (s + 2 e) / W", "line spacing",
         "at the mean / over the top of the relief / there with lines each "
         f"{plan.track_error_m:g} m off"),
        ("stereo side overlap", spacing.stereo_overlap, "%", "(2 half swath - s) / swath",
         "line spacing", "of neighbouring stereo swaths, the smaller side"),
    ]  # fmt: skip


def _rate_rows(found: ImagingSettings, plan: PlanConfig) -> list[Row]:
    mean_m, step_m = found.footprints.mean.along_m, found.station_spacing_m
    top, papers_m = found.footprints.top.along_m, plan.altitude_m * (1.0 - plan.forward_overlap)
    return [
        ("interval", found.interval_s, "s", "L (1 - O) / u", "forward_overlap",
         f"{1 / found.interval_s:.3g} pictures a second, one every {step_m:.3g} m; the trigger "
         f"and the cameras take {1 / found.shortest_interval_s:.3g}"),
        ("forward overlap", (found.forward_overlap, max(0.0, 1.0 - step_m / top)), "%",
         "1 - u T / L", "interval", "at the mean / over the top of the relief"),
        ("the paper's rule", plan.speed_mps / papers_m, "Hz", "r = u / (H (1 - O))", "not used",
         f"it takes the altitude for the footprint, {plan.altitude_m:g} m for {mean_m:.3f} m: "
         f"{1.0 - papers_m / mean_m:.0%} overlap"),
    ]  # fmt: skip


def _exposure_rows(found: ImagingSettings, setup: ImagingSetup) -> list[Row]:
    plan, rates, exposure_s = setup.plan, found.blur, found.exposure_s
    return [
        ("exposure", exposure_s * 1e3, "ms", "blur allowed / |image motion|",
         "allowed_blur_px", f"for {plan.allowed_blur_px:g} px; at night only the strobe exposes"),
        ("blur", rates.combined * exposure_s, "px", "sqrt(speed^2 + roll^2 + pitch^2 + yaw^2)",
         "allowed_blur_px",
         f"in the worst pixel. From {plan.speed_mps:g} m/s {rates.speed * exposure_s:.2f} at the "
         f"centre, {rates.speed_worst * exposure_s:.2f} in a corner; "
         f"{rates.roll_pitch * exposure_s:.2f} from roll and pitch at "
         f"{plan.roll_pitch_rate_deg_s:g} deg/s (centre), {rates.yaw * exposure_s:.2f} from yaw "
         f"at {plan.yaw_rate_deg_s:g} deg/s (corner). With all signs at their worst "
         f"{rates.worst * exposure_s:.2f} px"),
    ]  # fmt: skip


def _focus_rows(found: ImagingSettings, setup: ImagingSetup) -> list[Row]:
    plan, focus, f_number = setup.plan, found.focus, setup.camera.f_number
    is_enough = focus.f_number_needed <= f_number
    return [
        ("focus, set in air", focus.focus_air_m, "m", "2 / (1/D_top + 1/D_bottom)",
         "relief_m",
         "equal blur at the top and the bottom of the relief; sharpest "
         f"{focus.focus_altitude_m:.2f} m below the glass. For the mean altitude alone it is "
         f"{focus.focus_mean_air_m:.2f} m from the pupil"),
        ("sharp from, to", (focus.near_altitude_m, focus.far_altitude_m), "m",
         "1 / (1/s +- c N / (f f'))", "sharp_px",
         f"altitudes in focus to {plan.sharp_px:g} px at F/{f_number:g}; the relief takes "
         f"{plan.altitude_m - plan.relief_m:.3g} to {plan.altitude_m + plan.relief_m:.3g} m"),
        ("blur at relief's ends", focus.blur_px, "px", "f f' / (N p) |1/D - 1/s|",
         "f_number" if is_enough else "sharp_px", ""),
        ("f-number needed", focus.f_number_needed, "", "N blur / sharp_px", "relief_m",
         f"F/{f_number:g} is set" + ("" if is_enough else ", which is too open")),
        ("diffraction", focus.airy_px, "px", "2.44 lambda N (f'/f) / p", "f_number",
         f"beyond F/{focus.f_number_diffraction:.3g} it exceeds {plan.sharp_px:g} px"),
    ]  # fmt: skip


def _light_rows(found: ImagingSettings, setup: ImagingSetup) -> list[Row]:
    light, limits, strobes, shade = found.light, setup.camera, setup.imaging, found.shadows
    corner = " / ".join(f"{value:.1f}" for value in light.snr_corner)
    return [
        ("electrons, centre", light.centre_e, "e", "pi L T / (4 N^2 n^2) p^2 t QE / (h nu)",
         "exposure",
         f"red / green / blue of a pixel over sand in Jerlov {setup.water.jerlov} water, "
         f"{len(strobes.strobes_body_m)} strobes of {strobes.strobe_lumens:g} lm, "
         f"F/{limits.f_number:g}; the brightest pixel fills {light.full_share:.1%} of the well"),
        ("electrons, corner", light.corner_e, "e", "the same, with cos^4", "lens, beam",
         ""),
        ("sharp light, centre", light.sharp_share, "%", f"exp(-{SEEN_SHARE:.3f} b s)", "water",
         "share of these electrons that is detail: the rest was scattered"),
        ("signal to noise", light.snr_centre, "", "sharp S / sqrt(S + read^2)", "electrons",
         f"at the centre; of the median pixel {light.snr_median:.1f}, in the corner {corner}"),
        ("gain", light.gain_db, "dB", "20 log10(grey x well / median)",
         "light" if light.gain_db > 0 else "full well",
         f"brings the median to {MIDDLE_GREY:.0%} of full scale (linear). Check it in the water: "
         "alice-survey plan gain PICTURES"),
        ("veil, centre", found.scatter.veil_share, "%", "B / (B + L)", "strobe places",
         "share of the light that the water throws back before it reached the floor. Strobes "
         f"light the axis from {found.scatter.lit_from_m:.2f} m below the glass on, "
         f"{found.scatter.lit_share:.0%} of it"),
        ("shadows", shade.length_m, "m", "h r / (H - h)",
         "strobe places",
         f"of a thing {shade.height_m:g} m high below the camera, by each strobe; their light "
         f"meets there at {shade.between_deg:.0f} deg{' from both sides' if shade.opposite else ''}"
         ),
    ]  # fmt: skip


def _strobe_rows(found: ImagingSettings) -> list[Row]:
    load = found.strobe
    return [
        ("pulse", load.pulse_s * 1e3, "ms", "t + 2 lead", "exposure",
         f"lit {load.lead_s * 1e3:g} ms before the exposure, out as long after it"),
        ("duty cycle", load.duty, "%", "pulse / interval", "interval",
         f"LEDs bear {load.duty_limit:.0%} in water of {WARM_SEA_C:g} C"),
        ("energy a trigger", load.frame_j, "J", "lm / (lm/W) x pulse / driver", "pulse",
         f"{load.count} strobes of {load.lit_w:.0f} W while lit, {load.peak_a:.1f} A from "
         f"{BUS_V:g} V"),
        ("capacitor, each", load.capacitor_f * 1e3, "mF", "2 E / (V^2 - V_low^2)", "pulse",
         f"feeds a pulse while its {BUS_V:g} V sag by {BUS_SAG:.0%}"),
        ("mean power", load.mean_w, "W", "energy / interval", "duty cycle",
         f"from the battery, on lines; solder point {load.solder_c:.0f} C, junction "
         f"{load.junction_c:.0f} C at most. Cameras and recorder are in vehicle.hotel_w"),
    ]  # fmt: skip


def _data_rows(found: ImagingSettings, setup: ImagingSetup) -> list[Row]:
    storage, rate_hz = found.storage, 1.0 / found.interval_s
    limits = {
        "camera.shortest_interval_s": 1.0 / setup.camera.shortest_interval_s,
        "a cable each": storage.own_link_hz,
        "disk": storage.disk_hz,
    }
    tightest = min(limits, key=lambda name: limits[name])
    return [
        ("one trigger", storage.station_bytes / 1e6, "MB", "width x height x cameras", "sensor",
         ""),
        ("write rate on a line", storage.bytes_per_s / 1e6, "MB/s", "bytes / interval",
         "interval",
         f"{rate_hz:.3g} triggers a second of at most {limits[tightest]:.3g} ({tightest}); all "
         f"cameras on one cable take {storage.shared_link_hz:.3g}"),
    ]  # fmt: skip
