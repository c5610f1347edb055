"""Tables of fields of view as plain text and CSV."""

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from alice_survey.core.artefacts import json_values
from alice_survey.core.text_table import text_table
from camera_calib.fov.angles import RELIEF, AngleRow
from camera_calib.fov.paper import PAPER_RULE, PaperCheck, PaperClaim, PaperValidation
from camera_calib.fov.table import FISHEYE_FOV_DEG, TRUSTED_FOV_DEG, BlurRow, FovRow


@dataclass(frozen=True, kw_only=True)
class TextTable:
    """A titled table of words, and notes below it."""

    title: str
    header: tuple[str, ...]
    cells: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()


def as_text(tables: Iterable[TextTable]) -> str:
    """The tables one below the other, in columns of spaces."""
    return "\n\n".join(_columns(t) for t in tables)


def as_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """One line per row, with the first row's keys as header; None is an empty cell."""
    out = io.StringIO()
    writer = csv.DictWriter(out, fieldnames=list(rows[0]) if rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()


def fov_csv_rows(rows: Sequence[FovRow], blur: Sequence[BlurRow]) -> list[dict[str, Any]]:
    """Each lens and altitude with each speed and exposure, flat."""
    per_row = len(blur) // max(len(rows), 1)
    return [
        json_values(row) | json_values(moving)
        for i, row in enumerate(rows)
        for moving in blur[i * per_row : (i + 1) * per_row]
    ]


def validation_csv_rows(validation: PaperValidation) -> list[dict[str, Any]]:
    """Every check and claim, flat."""
    rule = PAPER_RULE.partition(";")[0]
    checks: list[tuple[PaperCheck | PaperClaim, str, str, str]] = [
        (c, f"{c.quantity} of the {c.lens_mm:g} mm lens: {c.paper} {c.unit}", rule,
         f"within {c.tolerance:g} {c.unit}")
        for c in validation.table
    ]  # fmt: skip
    checks += [(c, c.claim, c.assumption, _bounds(c)) for c in validation.claims]
    return [
        {"claim": claim, "verdict": _verdict(c), "computed": f"{c.computed:.4f} {c.unit}",
         "assumption": assumption, "rule": bound}
        for c, claim, assumption, bound in checks
    ]  # fmt: skip


def fov_tables(rows: Sequence[FovRow], blur: Sequence[BlurRow] = ()) -> list[TextTable]:
    """Footprint and resolution, stereo, focus and depth of field, and motion blur."""
    if not rows:
        return []
    return [_footprints(rows), _focus(rows), *([_blur(blur)] if blur else [])]


def validation_tables(validation: PaperValidation) -> list[TextTable]:
    """The paper's table, its claims, and the flat port against the angle."""
    return [_checks(validation.table), _claims(validation.claims), angles_table(validation.angles)]


def _footprints(rows: Sequence[FovRow]) -> TextTable:
    first = rows[0]
    notes = [f"n_water {first.n_water:g}, {first.port}; altitude of the port's outer glass"]
    if math.isfinite(first.baseline_m):
        notes.append(
            f"stereo: with the rig's next camera, {first.baseline_m * 1e3:.1f} mm away; share of "
            f"the footprint that both see; depth sigma for {first.match_sigma_px:g} px of "
            "disparity noise"
        )
    notes.append(
        "footprint: across the middle of the frame; surely: the rectangle between its corners, "
        "which plans count on"
    )
    if any(not row.within_trusted_fov for row in rows):
        notes.append(f"(!) wider than {TRUSTED_FOV_DEG:g} deg: the paper trusts no flat port here")
    widest = max(rows, key=lambda row: row.diagonal_air_deg)
    if widest.diagonal_air_deg > FISHEYE_FOV_DEG:
        notes.append(
            f"a lens of {widest.diagonal_air_deg:.0f} deg is made as a fisheye, which sees more "
            "than a straight lens of its focal length: calibrate it with a fisheye lens model, and "
            "give its rig.json with --rig"
        )
    return TextTable(
        title="Footprint and resolution",
        header=(
            "lens", "altitude", "footprint", "surely", "pixel centre/mean/corner",
            "diagonal air/water", "stereo", "depth sigma",
        ),
        cells=tuple(
            (
                f"{r.lens_mm:.4g} mm",
                f"{r.altitude_m:g} m",
                f"{r.horizontal_m:.3f} x {r.vertical_m:.3f} m",
                f"{r.sure_horizontal_m:.3f} x {r.sure_vertical_m:.3f} m",
                f"{r.pixel_centre_mm:.3f} / {r.pixel_mean_mm:.3f} / {r.pixel_corner_mm:.3f} mm",
                f"{r.diagonal_air_deg:.1f} / {r.diagonal_water_deg:.1f} deg"
                + ("" if r.within_trusted_fov else " (!)"),
                _known(r.stereo_overlap, f"{r.stereo_overlap:.1%}"),
                _known(r.depth_sigma_mm, f"{r.depth_sigma_mm:.2f} mm"),
            )
            for r in rows
        ),
        notes=tuple(notes),
    )  # fmt: skip


def _focus(rows: Sequence[FovRow]) -> TextTable:
    first = rows[0]
    return TextTable(
        title=f"Focus and depth of field at F/{first.f_number:g}, blur circle {first.coc_px:g} px",
        header=(
            "lens", "altitude", "focus in air", "set to", "sharp at the centre", "depth of field",
            "sharp in the whole frame", "blur centre/corner", "hyperfocal air/altitude",
        ),
        cells=tuple(
            (
                f"{r.lens_mm:.4g} mm",
                f"{r.altitude_m:g} m",
                f"{r.focus_air_m:.3f} m",
                f"{r.focus_set_m:.3f} m",
                _span(r.near_altitude_m, r.far_altitude_m),
                _known(r.depth_of_field_m, f"{r.depth_of_field_m:.3f} m", "unlimited"),
                _span(r.frame_near_altitude_m, r.frame_far_altitude_m),
                f"{r.floor_blur_px:.2f} / {r.corner_blur_px:.2f} px",
                f"{r.hyperfocal_air_m:.2f} / {r.hyperfocal_altitude_m:.2f} m",
            )
            for r in rows
        ),
        notes=(
            "focus in air: distance from the entrance pupil at which to focus in air so that the "
            "sea floor is sharp in water; sharp from and to: altitudes",
            "thin lens of a flat field; a flat port bends the field, so that a corner is blurred "
            "when the centre is sharp",
        ),
    )  # fmt: skip


def _blur(blur: Sequence[BlurRow]) -> TextTable:
    return TextTable(
        title="Motion blur",
        header=(
            "lens", "altitude", "speed", "exposure", "blur",
            f"longest exposure for {blur[0].allowed_px:g} px",
        ),
        cells=tuple(
            (
                f"{b.lens_mm:.4g} mm",
                f"{b.altitude_m:g} m",
                f"{b.speed_mps:g} m/s",
                f"{b.exposure_s * 1e3:g} ms",
                f"{b.blur_px:.2f} px",
                f"{b.longest_exposure_s * 1e3:.3f} ms",
            )
            for b in blur
        ),
        notes=("of the central pixel; exposure of the shutter, or of the strobe if that is short",),
    )  # fmt: skip


def _checks(checks: Sequence[PaperCheck]) -> TextTable:
    return TextTable(
        title="The paper's table of fields of view at 2 m",
        header=("lens", "quantity", "computed", "paper", "difference", "allowed", ""),
        cells=tuple(
            (
                f"{c.lens_mm:g} mm",
                c.quantity,
                f"{c.computed:.4f} {c.unit}",
                f"{c.paper} {c.unit}",
                f"{c.difference:+.4f}",
                f"{c.tolerance:g}",
                _verdict(c),
            )
            for c in checks
        ),
        notes=(f"rule: {PAPER_RULE}",),
    )


def _claims(claims: Sequence[PaperClaim]) -> TextTable:
    return TextTable(
        title="The paper's further claims",
        header=("claim", "verdict", "computed", "allowed", "if"),
        cells=tuple(
            (c.claim, _verdict(c), f"{c.computed:.4g} {c.unit}", _bounds(c), c.assumption)
            for c in claims
        ),
        notes=("other readings of these claims, and why they differ: docs/paper-optics.md",),
    )


def _bounds(claim: PaperClaim) -> str:
    bounds = f"at most {claim.maximum:g} {claim.unit}"
    return f"{claim.minimum:g} to {claim.maximum:g} {claim.unit}" if claim.minimum else bounds


def _verdict(check: PaperCheck | PaperClaim) -> str:
    return "pass" if check.passed else "FAIL"


def angles_table(angles: Sequence[AngleRow]) -> TextTable:
    """Effects of the port against the lens's angle."""
    first = angles[0]
    return TextTable(
        title=(
            f"A flat port against the lens's angle: n {first.n_water:g}, {first.port}, "
            f"{first.altitude_m:g} m"
        ),
        header=(
            "in air", "lens", "in water", "incidence", "displacement", "viewpoint", "residual rms",
            "max", "blue - red", "corner blur",
        ),
        cells=tuple(
            (
                f"{a.fov_air_deg:g} deg",
                f"{a.lens_mm:.2f} mm",
                f"{a.fov_water_deg:.1f} deg",
                f"{a.fov_air_deg / 2:g} deg",
                f"{a.displacement_px:.0f} px, {a.displacement_percent:.1f} %",
                f"{a.viewpoint_shift_mm:+.2f} mm",
                f"{a.residual_rms_px:.3f} px",
                f"{a.residual_max_px:.2f} px",
                f"{a.chromatic_px:.1f} px",
                f"{a.corner_blur_px:.2f} px",
            )
            for a in angles
        ),
        notes=(
            "one sensor, lenses to fit; angles of the diagonal; displacement of the corner from a "
            "paraxial pinhole; viewpoint: where corner rays meet the axis minus where central ones "
            "do",
            f"residual of the best virtual pinhole over relief of +/-{RELIEF:.0%}; blue - red in "
            "the corner; corner blur when the centre is in focus",
        ),
    )  # fmt: skip


def _known(value: float, text: str, unbounded: str = "-") -> str:
    if math.isfinite(value):
        return text
    return unbounded if math.isinf(value) else "-"


def _span(near: float, far: float) -> str:
    if math.isnan(near):
        return "nowhere"
    return f"{near:.3f} m to " + _known(far, f"{far:.3f} m", "infinity")


def _columns(table: TextTable) -> str:
    return "\n".join([table.title, text_table(table.header, table.cells), *table.notes])
