"""The report of `fov`: what a lens sees, and the check of the paper: text, CSV and a figure."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.artefacts import json_values, write_csv
from alice_survey.core.config import CameraConfig, SurveyConfig, load_config, parse_config
from alice_survey.core.errors import ConfigError, file_faults, warn
from alice_survey.kit.words import field_table
from camera_calib.formats.rigs import led_by
from camera_calib.fov.paper import (
    PAPER_RULE,
    RELIEF,
    PaperValidation,
    paper_settings,
    validate_paper,
)
from camera_calib.fov.table import (
    FISHEYE_FOV_DEG,
    TRUSTED_FOV_DEG,
    BlurRow,
    FovRow,
    blur_table,
    fov_table,
    rig_fov_table,
)
from camera_calib.rig import Rig, read_rig

PAPER_LENSES_MM = (12.5, 25.0)
PAPER_EXPOSURE_MS = 3.0
_LENS = {"lens": "{lens_mm:.4g} mm", "altitude": "{altitude_m:g} m"}
_FOOTPRINT = _LENS | {
    "footprint": "{horizontal_m:.3f} x {vertical_m:.3f} m",
    "guaranteed": "{sure_horizontal_m:.3f} x {sure_vertical_m:.3f} m",
    "pixel centre/mean/corner": "{pixel_centre_mm:.3f} / {pixel_mean_mm:.3f} / "
    "{pixel_corner_mm:.3f} mm",
    "diagonal air/water": "{diagonal_air_deg:.1f} / {diagonal_water_deg:.1f} deg{mark}",
    "stereo": "{stereo_overlap:.1%}",
    "depth sigma": "{depth_sigma_mm:.2f} mm",
}
_FOCUS = _LENS | {
    "focus in air": "{focus_air_m:.3f} m",
    "sharp at the centre": "{near_altitude_m:.3f} to {far_altitude_m:.3f} m",
    "depth of field": "{depth_of_field_m:.3f} m",
    "sharp in the whole frame": "{frame_near_altitude_m:.3f} to {frame_far_altitude_m:.3f} m",
    "blur centre/corner": "{floor_blur_px:.2f} / {corner_blur_px:.2f} px",
    "hyperfocal air/altitude": "{hyperfocal_air_m:.2f} / {hyperfocal_altitude_m:.2f} m",
}
_BLUR = _LENS | {
    "speed": "{speed_mps:g} m/s",
    "exposure": "{exposure_ms:g} ms",
    "blur": "{blur_px:.2f} px",
    "longest exposure": "{longest_exposure_ms:.3f} ms for {allowed_px:g} px",
}
_CLAIMS = {name: f"{{{name}}}" for name in ("claim", "verdict", "computed", "allowed", "if")}
_ANGLES = {
    "in air": "{fov_air_deg:g} deg",
    "lens": "{lens_mm:.2f} mm",
    "in water": "{fov_water_deg:.1f} deg",
    "displacement": "{displacement_px:.0f} px, {displacement_percent:.1f} %",
    "viewpoint": "{viewpoint_shift_mm:+.2f} mm",
    "residual rms": "{residual_rms_px:.3f} px",
    "max": "{residual_max_px:.2f} px",
    "blue - red": "{chromatic_px:.1f} px",
    "corner blur": "{corner_blur_px:.2f} px",
}


_PANELS = (
    ("Footprint", "m", {"horizontal_m": "wide", "vertical_m": "high"}),
    ("Pixel on the sea floor", "mm", {"pixel_centre_mm": "centre", "pixel_corner_mm": "corner"}),
    ("Sharp at the centre", "m", {"near_altitude_m": "from", "far_altitude_m": "to"}),
)
"""Title, unit, and fields with their names in the legend."""
_CURVE_POINTS = 30


def fov_text(rows: Sequence[FovRow], blur: Sequence[BlurRow] = ()) -> str:
    """Footprint and resolution, stereo, focus and depth of field, and motion blur."""
    first = rows[0]
    marked = [vars(r) | {"mark": "" if r.within_trusted_fov else " (!)"} for r in rows]
    tables = [
        field_table("Footprint and resolution", _FOOTPRINT, marked, list(_footprint_notes(rows))),
        field_table(
            f"Focus and depth of field at F/{first.f_number:g}, blur circle {first.coc_px:g} px",
            _FOCUS, marked,
            ["focus in air: distance from the entrance pupil at which to focus in air so that the "
             "sea floor is sharp in water; sharp: altitudes",
             "thin lens of a flat field; a flat port bends the field, so that a corner is blurred "
             "when the centre is sharp"],
        ),
    ]  # fmt: skip
    if blur:
        in_ms = [
            vars(b)
            | {"exposure_ms": 1e3 * b.exposure_s, "longest_exposure_ms": 1e3 * b.longest_exposure_s}
            for b in blur
        ]
        note = "of the central pixel; exposure of the shutter, or of the strobe if that is short"
        tables.append(field_table("Motion blur", _BLUR, in_ms, [note]))
    return "\n\n".join(tables)


def _footprint_notes(rows: Sequence[FovRow]) -> Iterator[str]:
    first = rows[0]
    yield f"n_water {first.n_water:g}, {first.port}; altitude of the port's outer glass"
    if math.isfinite(first.baseline_m):
        yield (
            f"stereo: with the rig's next camera, {first.baseline_m * 1e3:.1f} mm away; share of "
            f"the footprint that both see; depth sigma for {first.match_sigma_px:g} px of "
            "disparity noise"
        )
    yield (
        "footprint: across the middle of the frame; guaranteed: the rectangle between its corners, "
        "which plans count on"
    )
    if any(not row.within_trusted_fov for row in rows):
        yield f"(!) wider than {TRUSTED_FOV_DEG:g} deg: the paper trusts no flat port here"
    widest_deg = max(row.diagonal_air_deg for row in rows)
    if widest_deg > FISHEYE_FOV_DEG:
        yield (
            f"a lens of {widest_deg:.0f} deg is made as a fisheye, which sees more than a straight "
            "lens of its focal length: calibrate it with a fisheye lens model, and give its "
            "rig.json with --rig"
        )


def validation_text(validation: PaperValidation) -> str:
    """The paper's table, its claims, and the flat port against the angle."""
    first = validation.angles[0]
    tables = (
        field_table(
            "The paper's table of fields of view at 2 m, and its further claims", _CLAIMS,
            validation_rows(validation),
            [f"rule of the table: {PAPER_RULE}",
             "other readings of these claims, and why they differ: docs/paper-optics.md"],
        ),
        field_table(
            f"A flat port against the lens's angle: n {first.n_water:g}, {first.port}, "
            f"{first.altitude_m:g} m",
            _ANGLES, [vars(row) for row in validation.angles],
            ["one sensor, lenses to fit; angles of the diagonal; displacement of the corner from a "
             "paraxial pinhole; viewpoint: where corner rays meet the axis minus where central "
             "ones do",
             f"residual of the best virtual pinhole over relief of +/-{RELIEF:.0%}; blue - red in "
             "the corner; corner blur when the centre is in focus"],
        ),
    )  # fmt: skip
    return "\n\n".join(tables)


def fov_csv_rows(rows: Sequence[FovRow], blur: Sequence[BlurRow]) -> list[dict[str, Any]]:
    """Each lens and altitude with each speed and exposure, flat."""
    per_row = len(blur) // len(rows)
    return [json_values(rows[i // per_row]) | json_values(one) for i, one in enumerate(blur)]


def validation_rows(validation: PaperValidation) -> list[dict[str, str]]:
    """Every check and claim in words, flat."""
    words = [
        (f"{c.quantity} of the {c.lens_mm:g} mm lens: {c.paper} {c.unit}",
         f"within {c.tolerance:g} {c.unit}", "rule of the table")
        for c in validation.table
    ]  # fmt: skip
    words += [
        (c.claim, (f"{c.minimum:g} to " if c.minimum else "at most ") + f"{c.maximum:g} {c.unit}",
         c.assumption)
        for c in validation.claims
    ]  # fmt: skip
    found = [
        ("pass" if c.passed else "FAIL", f"{c.computed:.4f} {c.unit}") for c in validation.checks
    ]
    return [
        dict(zip(_CLAIMS, (claim, *result, *rest), strict=True))
        for (claim, *rest), result in zip(words, found, strict=True)
    ]


def draw_fov(
    path: Path, table: Callable[[Sequence[float]], list[FovRow]], altitudes_m: Sequence[float]
) -> None:
    """Draw footprint, pixel and depth of field of lenses against altitude.

    Args:
        path: ends in .png, .svg or .pdf; the same input gives the same bytes.
        table: rows of all lenses at given altitudes.
        altitudes_m: altitudes of interest; the curves go some way beyond them.

    Raises:
        ConfigError: another suffix, or the file cannot be written.
    """
    from alice_survey.kit.figure import (
        INKS,
        check_figure_path,
        figure_style,
        new_figure,
        save_figure,
    )

    check_figure_path(path)
    high = 1.5 * max(altitudes_m)
    heights = np.linspace(max(0.25 * min(altitudes_m), 0.01), high, _CURVE_POINTS).tolist()
    curves, marked = (
        {lens_mm: list(rows) for lens_mm, rows in groupby(table(at), lambda r: round(r.lens_mm, 6))}
        for at in (heights, altitudes_m)
    )
    with figure_style():
        figure = new_figure(4.4, 13.0)
        for axes, (title, unit, fields) in zip(figure.subplots(1, 3), _PANELS, strict=True):
            for i, (lens_mm, rows) in enumerate(curves.items()):
                for style, (field, label) in zip(("-", "--"), fields.items(), strict=True):
                    ink = INKS[i % len(INKS)]
                    shown = np.minimum([getattr(row, field) for row in rows], 2.0 * high)
                    axes.plot(heights, shown, style, color=ink, label=f"{lens_mm:.4g} mm {label}")
                    points = [getattr(row, field) for row in marked[lens_mm]]
                    axes.plot(altitudes_m, points, "o", ms=4, color=ink)
            axes.set(title=title, ylabel=unit, xlabel="altitude of the outer glass, m")
            axes.set_xlim(left=0)
            axes.set_ylim(bottom=0)
            axes.legend(fontsize=9)
        first = next(iter(marked.values()))[0]
        figure.suptitle(
            f"n {first.n_water:.4g}, {first.port}; F/{first.f_number:g} focused on the sea floor"
        )
        save_figure(figure, path, dpi=120)


@dataclass(frozen=True, kw_only=True)
class FovOptions:
    """Options of `fov`; None or empty is the survey's, or else the paper's."""

    lens_mm: Sequence[float] = ()
    altitude_m: Sequence[float] = ()
    speed_mps: Sequence[float] = ()
    exposure_ms: Sequence[float] = ()
    survey: Path | None = None
    rig: Path | None = None
    rig_camera: str | None = None
    n_water: float | None = None
    csv: Path | None = None
    plot: Path | None = None
    """Files to write the rows and draw the curves to."""


def fov_report(options: FovOptions) -> tuple[str, Any]:
    """FOV, resolution, focus, stereo and blur as text and JSON values."""
    settings = _settings(options)
    rig = _rig(options, settings.water.n_water)
    camera = settings.camera if rig is None else _with_pixels_of(rig, settings.camera)
    lenses = options.lens_mm or ((camera.focal_mm,) if options.survey else PAPER_LENSES_MM)

    def table(altitudes_m: Sequence[float]) -> list[FovRow]:
        if rig is not None:
            return rig_fov_table(rig, altitudes_m, camera)
        return fov_table(lenses, altitudes_m, settings.water.n_water, camera)

    altitudes = options.altitude_m or (settings.plan.altitude_m,)
    speeds = options.speed_mps or (settings.plan.speed_mps,)
    exposures = [ms * 1e-3 for ms in options.exposure_ms or (PAPER_EXPOSURE_MS,)]
    allowed = settings.plan.allowed_blur_px
    rows = table(altitudes)
    blur = blur_table(rows, speeds, exposures, allowed)
    if options.csv is not None:
        _write(options.csv, fov_csv_rows(rows, blur))
    if options.plot is not None:
        draw_fov(options.plot, table, altitudes)
    data = {
        "source": "design values" if rig is None else rig.source,
        "rows": json_values(rows),
        "blur": json_values(blur),
    }
    return fov_text(rows, blur), data


def validation_report(options: FovOptions) -> tuple[str, Any]:
    """The paper's claims on optics, with `passed`: whether every check that has a rule does.

    Raises:
        ConfigError: an option was given: the claims bring their own lenses, water and altitude.
    """
    if options != FovOptions(csv=options.csv, plot=options.plot):
        raise ConfigError(
            "--validate checks the paper's own lenses, water and altitude: leave out all options "
            "but --plot, --csv and --json"
        )
    validation = validate_paper()
    if options.csv is not None:
        _write(options.csv, validation_rows(validation))
    if options.plot is not None:
        camera, n_water, altitude = paper_settings()
        draw_fov(
            options.plot,
            lambda heights: fov_table(PAPER_LENSES_MM, heights, n_water, camera),
            [altitude],
        )
    return validation_text(validation), validation.to_json()


def _settings(options: FovOptions) -> SurveyConfig:
    """The survey's settings, overridden by the command line."""
    survey = SurveyConfig() if options.survey is None else load_config(options.survey)
    if options.n_water is None:
        return survey
    water = {"jerlov": survey.water.jerlov, "n_water": options.n_water}
    return parse_config(survey.model_dump(mode="json") | {"water": water}, "options")


def _rig(options: FovOptions, n_water: float) -> Rig | None:
    if options.rig is None:
        if options.rig_camera is not None:
            raise ConfigError("--camera names a camera of a rig: give --rig too")
        return None
    if options.lens_mm:
        raise ConfigError(f"{options.rig} has lenses of its own: leave out --lens")
    rig = read_rig(options.rig)
    if options.rig_camera is not None:
        rig = led_by(rig, options.rig_camera)
    elif len(rig.cameras) > 2:
        first, *others = rig.cameras
        warn(f"of the rig's cameras, this is {first}; --camera shows {', '.join(others)}")
    return rig if options.n_water is None else rig.in_water(n_water)


def _with_pixels_of(rig: Rig, camera: CameraConfig) -> CameraConfig:
    """The settings' sensor with the pixels of a rig's pictures: a rig has no pixel pitch."""
    width_px = rig.cameras[rig.reference].width_px
    if width_px == camera.width_px:
        return camera
    pixel_um = camera.pixel_um * camera.width_px / width_px
    warn(
        f"the rig's pictures are {width_px} px wide and the settings' {camera.width_px}: pixels of "
        f"{pixel_um:.4g} um (the same sensor) are taken for the depth of field; pixel_um under "
        "[camera] of --survey sets it"
    )
    return camera.model_copy(update={"pixel_um": pixel_um})


def _write(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    with file_faults(path, ConfigError, "written"):
        write_csv(path, list(rows[0]), [list(row.values()) for row in rows])
