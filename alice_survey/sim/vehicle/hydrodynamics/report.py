"""The paper's tables of coefficients next to values from shape: text, CSV, JSON, figure."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.artefacts import write_csv
from alice_survey.core.errors import ConfigError
from alice_survey.core.text_table import text_table
from alice_survey.sim.vehicle.hydrodynamics.geometry import ALICE
from alice_survey.sim.vehicle.hydrodynamics.paper_tables import TABLES
from alice_survey.sim.vehicle.hydrodynamics.parts import Flow, estimate, part_coefficients, parts

_MARKS = {"reproduced": 1.0, "near": 5.0}
"""Differences in per cent up to which a row counts as reproduced, and as near."""


@dataclass(frozen=True, kw_only=True)
class CoefficientRow:
    """One row of the paper and the value computed for it."""

    table: str
    coefficient: str
    part: str
    printed: float
    paper: float
    """Printed value with its sign corrected."""
    computed: float
    difference_percent: float
    """Difference relative to the paper's size; positive is a greater value."""
    mark: str
    """`reproduced` within 1 %, `near` within 5 %, else `no`."""
    paper_other: float | None
    """CFD (table IV) or calibrated at sea (table V)."""
    factor: float | None
    """Calibration factor as printed, table V."""

    @property
    def label(self) -> str:
        """The coefficient, and the hull where it is of the hull alone."""
        return self.coefficient + (" hull" if self.part == "hull" else "")


def coefficient_rows() -> tuple[CoefficientRow, ...]:
    """Every row of the paper's three tables."""
    whole = estimate(ALICE).values
    hull = next(part_coefficients(p) for p in parts(ALICE, Flow()) if p.name == "hull")
    rows = []
    for row in TABLES:
        computed = (hull if row.part == "hull" else whole)[row.coefficient]
        difference = 100.0 * (computed - row.value) / abs(row.value)
        marks = [mark for mark, limit in _MARKS.items() if abs(difference) <= limit]
        rows.append(
            CoefficientRow(
                table=row.table, coefficient=row.coefficient, part=row.part, printed=row.printed,
                paper=row.value, computed=computed, difference_percent=difference,
                mark=(*marks, "no")[0], paper_other=row.other, factor=row.factor,
            )
        )  # fmt: skip
    return tuple(rows)


def coefficients_report(
    csv: Path | None = None, plot: Path | None = None
) -> tuple[str, dict[str, Any]]:
    """The paper's three tables next to ALICE's coefficients from shape.

    Args:
        csv: file to write the rows to.
        plot: figure of the ratios to the paper's values to draw.

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
            draw_ratios(plot, rows)
    except OSError as error:
        raise ConfigError(f"{error.filename}: cannot be written: {error.strerror}") from None
    counts = {mark: sum(row.mark == mark for row in rows) for mark in (*_MARKS, "no")}
    table = text_table(
        ("table", "coefficient", "printed", "paper", "computed", "difference", "CFD, at sea", ""),
        [
            (
                row.table, row.label, f"{row.printed:g}", f"{row.paper:g}", f"{row.computed:.4g}",
                f"{row.difference_percent:+.1f} %",
                "" if row.paper_other is None else f"{row.paper_other:g}", row.mark,
            )
            for row in rows
        ],
    )  # fmt: skip
    data = {
        "rows": [asdict(row) for row in rows],
        "counts": counts,
        "computed": dict(estimate(ALICE).values),
    }
    return f"{table}\nHow each differs: docs/vehicle-comparison.md", data


def draw_ratios(path: Path, rows: Sequence[CoefficientRow]) -> None:
    """Draw the computed values over the paper's, on a logarithmic axis.

    Raises:
        ConfigError: the suffix is not one of a figure.
    """
    from alice_survey.kit.figure import INKS, check_figure_path, figure_style, new_figure
    from alice_survey.kit.figure import save_figure as save

    check_figure_path(path)
    with figure_style():
        figure = new_figure(9.0)
        axes = figure.subplots()
        labels = [f"{row.table} {row.label}" for row in rows]
        for mark, colour in zip((*_MARKS, "no"), (INKS[2], INKS[4], INKS[1]), strict=True):
            chosen = [i for i, row in enumerate(rows) if row.mark == mark]
            ratios = np.array([rows[i].computed / rows[i].paper for i in chosen])
            axes.plot(ratios, chosen, "o", color=colour, label=mark)
        axes.set_xscale("log")
        axes.axvline(1.0, color="black", lw=1.0, zorder=1)
        axes.set_yticks(range(len(labels)), labels, fontsize=6.5)
        axes.invert_yaxis()
        axes.set_xlabel("computed from the shape over the paper's value")
        axes.legend(loc="lower right")
        save(figure, path)
