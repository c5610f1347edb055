"""The paper's tables of coefficients next to values from shape: text, CSV, JSON, figure."""

from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from alice_survey.base.artefacts import write_csv
from alice_survey.base.errors import ConfigError
from alice_survey.base.text_table import text_table
from alice_survey.vehicle.hydrodynamics.comparison import (
    CLOSE_PERCENT,
    NEAR_PERCENT,
    CoefficientRow,
    coefficient_rows,
)
from alice_survey.vehicle.hydrodynamics.geometry import ALICE, Geometry
from alice_survey.vehicle.hydrodynamics.parts import estimate

_TITLES = {
    "III": "Table III, estimated by the paper",
    "IV": "Table IV, estimated by the paper next to its CFD",
    "V": "Table V, before and after the paper's calibration at sea",
}
_OTHER = {"III": "", "IV": "CFD", "V": "at sea"}


def coefficients_report(
    csv: Path | None = None, plot: Path | None = None
) -> tuple[str, dict[str, Any]]:
    """The paper's three tables next to ALICE's coefficients from shape.

    Args:
        csv: file to write the rows to.
        plot: figure of the vehicle and its coefficients to draw.

    Returns:
        Text, and the same as values for JSON.

    Raises:
        ConfigError: a file cannot be written.
    """
    rows = coefficient_rows()
    try:
        if csv is not None:
            header = [field.name for field in fields(CoefficientRow)]
            write_csv(csv, header, [list(asdict(row).values()) for row in rows])
        if plot is not None:
            from alice_survey.vehicle.hydrodynamics.plot import draw_coefficients

            draw_coefficients(plot, ALICE, rows)
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


def _text(rows: Sequence[CoefficientRow], counts: dict[str, int]) -> str:
    blocks = []
    for table, title in _TITLES.items():
        cells = [
            (
                row.coefficient + (" hull" if row.part == "hull" else ""),
                f"{row.printed:g}",
                f"{row.paper:g}",
                f"{row.computed:.4g}",
                f"{row.difference_percent:+.1f} %",
                *([] if table == "III" else [f"{row.paper_other:g}"]),
                row.mark,
                row.equation,
            )
            for row in rows
            if row.table == table
        ]
        other = [_OTHER[table]] if _OTHER[table] else []
        header = (
            "coefficient", "printed", "paper", "computed", "difference", *other, "", "equation",
        )  # fmt: skip
        blocks.append(f"{title}\n{text_table(header, cells)}")
    outline = ALICE.outline
    blocks.append(
        f"{len(rows)} rows: {counts['reproduced']} within {CLOSE_PERCENT:g} %, {counts['near']} "
        f"within {NEAR_PERCENT:g} %, {counts['no']} not reproduced (docs/vehicle-comparison.md). "
        "Signs are those of x forward, y starboard, z down.\n"
        f"Hull {outline.length_m:.2f} x {outline.diameter_m:.2f} m, side "
        f"{outline.side_fullness:.3f} of length times diameter, envelope "
        f"{1e3 * ALICE.envelope_volume_m3:.1f} L."
    )
    return "\n\n".join(blocks)
