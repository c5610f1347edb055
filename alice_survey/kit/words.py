"""Numbers as people read them: two or three digits, and a unit that fits."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

_SIGMA_DIGITS = 2
_UNITS = ("mm", "m", "px", "deg", "ppm", "l")


def length(metres: float | None, unit: str = "m", significant: int = 3) -> str:
    """`0.364 mm`, `2.40 cm`, `41.0 m`; in units of the model where it has no scale."""
    if metres is None or not math.isfinite(metres):
        return "unknown"
    if unit != "m":
        return f"{metres:.{significant}g} {unit}"
    factor, name = _length_unit(metres)
    return f"{digits(factor * metres, significant)} {name}"


def sigma_length(metres: float | None, unit: str = "m") -> str:
    """As `length`, with the two digits that a sigma has."""
    return length(metres, unit, _SIGMA_DIGITS)


def length_with_sigma(metres: float, sigma_m: float) -> str:
    """`4.6 ± 49 mm`: a length and its sigma in one unit."""
    factor, name = _length_unit(max(abs(metres), sigma_m))
    return f"{with_sigma(factor * metres, factor * sigma_m)} {name}"


def _length_unit(metres: float) -> tuple[float, str]:
    size = abs(metres)
    if size < 0.01:
        return 1e3, "mm"
    if size < 1.0:
        return 1e2, "cm"
    return (1.0, "m") if size < 1e4 else (1e-3, "km")


def with_sigma(value: float, sigma: float, sign: str = "") -> str:
    """`849.31 ± 0.46`: two digits of the sigma, and the value to the same place."""
    if not (math.isfinite(sigma) and sigma > 0):
        return f"{value:{sign}.6g} ± {sigma:.2g}"
    places = max(0, _SIGMA_DIGITS - 1 - math.floor(math.log10(sigma)))
    return f"{value:{sign}.{places}f} ± {sigma:.{places}f}"


def millimetres(value: float | None) -> str:
    """As `length`, of millimetres."""
    return length(None if value is None else 1e-3 * value)


def digits(value: float, significant: int = 3) -> str:
    """A number with this many digits and never an exponent."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    rounded = float(f"{value:.{significant - 1}e}")  # 99.96 has one digit more than it seems
    places = max(0, significant - 1 - math.floor(math.log10(abs(rounded))))
    return f"{value:.{places}f}"


def share(value: float | None, places: int = 1) -> str:
    """`99.8 %`; never 100 % of what is incomplete: 0.9998 is `99.9 %`."""
    if value is None or not math.isfinite(value):
        return "unknown"
    text = f"{100 * value:.{places}f}"
    if float(text) == 100.0:
        text = "100" if value >= 1.0 else f"{100 - 0.1**places:.{places}f}"
    return f"{text} %"


def parts(value: float | None) -> str:
    """Error of a scale: `+98 ppm`, `0.51 %`."""
    if value is None or not math.isfinite(value):
        return "unknown"
    return f"{1e6 * value:+.0f} ppm" if abs(value) < 1e-3 else f"{100 * value:+.2f} %"


def parts_with_sigma(value: float, sigma: float) -> str:
    """Error of a scale: `+0.07 ± 0.56 %`, value and sigma in one unit."""
    factor, name = (1e6, "ppm") if max(abs(value), sigma) < 1e-3 else (1e2, "%")
    return f"{with_sigma(factor * value, factor * sigma, '+')} {name}"


def duration(seconds: float) -> str:
    """`51 s`, `14 min`, `2.3 h`."""
    if seconds < 120:
        return f"{seconds:.0f} s" if seconds >= 10 else f"{seconds:.1f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def count(number: int, one: str, many: str = "") -> str:
    """`1 picture`, `1,876,280 points`."""
    return f"{number:,} {one if number == 1 else many or one + 's'}"


def figure_rows(values: Mapping[str, Any], of: str = "") -> Iterator[tuple[str, str]]:
    """Name and text of each figure of nested JSON values: `surface rms_mm` as `surface rms`, in mm.

    Args:
        values: by names that end with their unit, or groups of them.
        of: the group that they are of.
    """
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from figure_rows(value, f"{of}{key} ".replace("_", " "))
            continue
        stem, _, unit = key.rpartition("_")
        name, unit = (stem, f" {unit}") if unit in _UNITS else (key, "")
        each = [v for v in (value if isinstance(value, list) else [value]) if v is not None]
        texts = [digits(v, 4) if isinstance(v, float) else f"{v:,}" for v in each]
        yield f"{of}{name}".replace("_", " "), ", ".join(texts) + unit if texts else "unknown"


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
