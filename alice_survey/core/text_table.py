"""Plain text tables, as the command line prints them."""

from collections.abc import Mapping, Sequence
from typing import Any


def text_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Rows under their header, columns as wide as their widest cell."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in [header, ["-" * width for width in widths], *rows]
    ]
    return "\n".join(lines)


def field_table(
    title: str,
    columns: Mapping[str, str],
    rows: Sequence[Mapping[str, Any]],
    notes: Sequence[str] = (),
) -> str:
    """A titled table of fields, and notes below it.

    Args:
        title: above it.
        columns: by heading the template of a cell, such as `{lens_mm:.4g} mm`.
        rows: fields by name; a cell with a NaN is `-`, infinite lengths are `unlimited`.
        notes: a line each.
    """
    cells = [
        [
            "-" if "nan" in cell else cell.replace("inf m", "unlimited")
            for cell in (template.format_map(row) for template in columns.values())
        ]
        for row in rows
    ]
    return "\n".join([title, text_table(list(columns), cells), *notes])
