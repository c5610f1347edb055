"""The paper's tables of coefficients beside what follows from shape: text, CSV and JSON."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from alice_survey.base.artefacts import write_csv
from alice_survey.base.errors import ConfigError
from alice_survey.base.text_table import text_table
from alice_survey.vehicle.hydrodynamics.entrained import Entrained, entrained_water
from alice_survey.vehicle.hydrodynamics.estimate import estimate, part_coefficients
from alice_survey.vehicle.hydrodynamics.geometry import ALICE, Geometry
from alice_survey.vehicle.hydrodynamics.paper_tables import TABLES, PaperRow
from alice_survey.vehicle.hydrodynamics.parts import Flow, parts
from alice_survey.vehicle.hydrodynamics.reasons import Evidence, equation, reason

CLOSE_PERCENT, NEAR_PERCENT = 1.0, 5.0
"""Differences up to which a row counts as reproduced, and as near."""
_TITLES = {
    "III": "Table III, estimated by the paper",
    "IV": "Table IV, estimated by the paper beside its CFD",
    "V": "Table V, before and after the paper's calibration at sea",
}
_OTHER = {"III": "", "IV": "CFD", "V": "at sea"}


@dataclass(frozen=True, kw_only=True)
class ReportRow:
    """One row of the paper and what is computed for it."""

    table: str
    coefficient: str
    part: str
    printed: float
    paper: float
    """With its sign mended."""
    computed: float
    difference_percent: float
    """Of the paper's size; positive is a greater value."""
    mark: str
    """`reproduced` within 1 %, `near` within 5 %, else `no`."""
    paper_other: float | None
    """CFD or calibrated."""
    equation: str
    sign: str
    """Why its sign was mended, if it was."""
    reason: str
    """Why it is not reproduced, if it is not."""
    remark: str
    """What else is to be said of it."""


def report_rows(geometry: Geometry = ALICE, flow: Flow | None = None) -> tuple[ReportRow, ...]:
    """Every row of the paper's three tables."""
    flow = flow or Flow()
    whole = estimate(geometry, flow).values
    shares = {part.name: part_coefficients(part) for part in parts(geometry, flow)}
    evidence = Evidence(geometry=geometry, flow=flow, shares=shares)
    rows = []
    for row in TABLES:
        computed = (shares["hull"] if row.part == "hull" else whole)[row.coefficient]
        difference = 100.0 * (computed - row.value) / abs(row.value)
        mark = _mark(difference)
        rows.append(
            ReportRow(
                table=row.table,
                coefficient=row.coefficient,
                part=row.part,
                printed=row.printed,
                paper=row.value,
                computed=computed,
                difference_percent=difference,
                mark=mark,
                paper_other=row.other,
                equation=equation(row),
                sign=row.mended,
                reason=reason(row, evidence) if mark == "no" else "",
                remark=_remark(row),
            )
        )
    return tuple(rows)


def coefficients_report(
    csv: Path | None = None, plot: Path | None = None
) -> tuple[str, dict[str, Any]]:
    """The paper's three tables beside ALICE's coefficients from shape.

    Args:
        csv: file to write the rows to.
        plot: picture of the vehicle and its coefficients to draw.

    Returns:
        Text, and the same as values for JSON.

    Raises:
        ConfigError: a file cannot be written.
    """
    rows = report_rows()
    try:
        if csv is not None:
            header = [field.name for field in fields(ReportRow)]
            write_csv(csv, header, [list(asdict(row).values()) for row in rows])
        if plot is not None:
            _draw(plot, rows)
    except OSError as error:
        raise ConfigError(f"{error.filename}: cannot be written: {error.strerror}") from None
    counts = {mark: sum(row.mark == mark for row in rows) for mark in ("reproduced", "near", "no")}
    data = {
        "geometry": _geometry(ALICE),
        "rows": [asdict(row) for row in rows],
        "counts": counts,
        "computed": dict(estimate(ALICE).values),
    }
    return _text(rows, counts), data


def _draw(path: Path, rows: Sequence[ReportRow]) -> None:
    from alice_survey.vehicle import fleet
    from alice_survey.vehicle.hydrodynamics.plot import draw_coefficients

    draw_coefficients(path, ALICE, _inside(), fleet.vehicle("alice").thrusters, rows)


def _mark(difference_percent: float) -> str:
    if abs(difference_percent) <= CLOSE_PERCENT:
        return "reproduced"
    return "near" if abs(difference_percent) <= NEAR_PERCENT else "no"


def _remark(row: PaperRow) -> str:
    if row.factor is None or row.printed_other is None:
        return ""
    if row.coefficient == "X_udot":
        return (
            f"at sea {row.printed_other - row.printed:+.1f} kg: about the "
            f"{_inside().mass_kg:.1f} kg of water inside the hull, which here belong to the rigid "
            "body with every set; no slender hull has more added mass along than across"
        )
    product = row.factor * row.printed
    if abs(product - row.printed_other) <= 0.005 * abs(row.printed_other):
        return ""
    return (
        f"the printed factor {row.factor:g} x {row.printed:g} gives {product:.4g}, not "
        f"{row.printed_other:g}"
    )


def _inside() -> Entrained:
    from alice_survey.vehicle import fleet

    alice = fleet.vehicle("alice")
    return entrained_water(ALICE, alice.rigid_body.buoyancy_kg, alice.density_kg_m3)


def _geometry(geometry: Geometry) -> dict[str, Any]:
    outline = geometry.outline
    return {
        "name": geometry.name,
        "length_m": outline.length_m,
        "diameter_m": outline.diameter_m,
        "nose_x_m": outline.nose_x_m,
        "tail_x_m": outline.tail_x_m,
        "side_area_m2": outline.side_area_m2,
        "side_fullness": outline.side_fullness,
        "wetted_area_m2": outline.wetted_area_m2,
        "envelope_volume_m3": geometry.envelope_volume_m3,
        "tunnels_x_m": {tunnel.name: tunnel.x_m for tunnel in geometry.tunnels},
    }


def _text(rows: Sequence[ReportRow], counts: dict[str, int]) -> str:
    notes: list[str] = []

    def cite(text: str) -> str:
        if not text:
            return ""
        if text not in notes:
            notes.append(text)
        return f"[{notes.index(text) + 1}]"

    blocks = []
    for table, title in _TITLES.items():
        cells = [
            (
                row.coefficient + (" hull" if row.part == "hull" else ""),
                f"{row.paper:g}",
                f"{row.computed:.4g}",
                f"{row.difference_percent:+.1f} %",
                *([] if table == "III" else [f"{row.paper_other:g}"]),
                row.mark,
                cite(row.sign) + cite(row.reason) + cite(row.remark),
                row.equation,
            )
            for row in rows
            if row.table == table
        ]
        other = [_OTHER[table]] if _OTHER[table] else []
        header = ("coefficient", "paper", "computed", "difference", *other, "", "notes", "equation")
        blocks.append(f"{title}\n{text_table(header, cells)}")
    outline = ALICE.outline
    blocks.append(
        f"{len(rows)} rows: {counts['reproduced']} within {CLOSE_PERCENT:g} %, {counts['near']} "
        f"within {NEAR_PERCENT:g} %, {counts['no']} not reproduced (see notes). Signs are those of "
        f"x forward, y starboard, z down.\nHull {outline.length_m:.2f} x {outline.diameter_m:.2f} "
        f"m, side {outline.side_fullness:.3f} of length times diameter, envelope "
        f"{1e3 * ALICE.envelope_volume_m3:.1f} L. The paper states 1.6 m, its tables hold for "
        "1.96 m."
    )
    blocks.append("\n".join(f"[{i + 1}] {note}" for i, note in enumerate(notes)))
    return "\n\n".join(blocks)
