"""Rows of the table of imaging settings, and the table as text of 100 columns."""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from alice_survey.kit.words import share

WIDTH = 100
_COLUMNS = (23, 24, 31, 16)
_GAP = "  "


Row = tuple[str, float | tuple[float, ...], str, str, str, str, str]
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
    source: str
    bound_by: str
    """The setting or limit that a better value would break; empty where nothing does."""
    note: str = ""

    def to_json(self) -> dict[str, Any]:
        """All fields as JSON values; what is not finite is null."""
        row = asdict(self)
        values = self.value if isinstance(self.value, tuple) else (self.value,)
        cleaned = [v if math.isfinite(v) else None for v in values]
        return {**row, "value": cleaned if isinstance(self.value, tuple) else cleaned[0]}

    @property
    def text(self) -> str:
        """The value with its unit, to about three digits."""
        values = self.value if isinstance(self.value, tuple) else (self.value,)
        if self.unit == "%":
            return " / ".join(_percent(v) for v in values) + " %"
        return f"{' / '.join(_number(v) for v in values)} {self.unit}".rstrip()


def settings_of(group: str, rows: Sequence[Row]) -> list[Setting]:
    """The settings of one group."""
    return [Setting(group, *row) for row in rows]


def setting_from_json(row: dict[str, Any]) -> Setting:
    """The inverse of `Setting.to_json`; what was not finite is NaN."""
    values = row["value"] if isinstance(row["value"], list) else [row["value"]]
    known = tuple(math.nan if value is None else float(value) for value in values)
    return Setting(**{**row, "value": known})


def settings_table(rows: Sequence[Setting]) -> str:
    """Rows under the headings of their groups, with notes below each; no line exceeds `WIDTH`."""
    header = ("setting", "value", "equation [source]", "bound by")
    lines = [_line(header), _line(tuple("-" * width for width in _COLUMNS))]
    sources: list[str] = []
    group = ""
    for row in rows:
        if row.group != group:
            group = row.group
            lines += ["", group.upper()]
        if row.source not in sources:
            sources.append(row.source)
        equation = f"{row.equation} [{sources.index(row.source) + 1}]".strip()
        lines += _wrapped((row.name, row.text, equation, row.bound_by or "-"))
        if row.note:
            lines += textwrap.wrap(row.note, WIDTH, initial_indent="    ", subsequent_indent="    ")
    lines += ["", "SOURCES"]
    for number, source in enumerate(sources, 1):
        lines += textwrap.wrap(
            source, WIDTH, initial_indent=f"[{number}] ", subsequent_indent="    "
        )
    return "\n".join(lines)


def _wrapped(cells: tuple[str, ...]) -> list[str]:
    """A row of the table, on as many lines as its longest cell needs."""
    parts = [textwrap.wrap(cell, width) for cell, width in zip(cells, _COLUMNS, strict=True)]
    height = max(len(part) for part in parts)
    return [_line(tuple(p[i] if i < len(p) else "" for p in parts)) for i in range(height)]


def _line(cells: tuple[str, ...]) -> str:
    return _GAP.join(c.ljust(w) for c, w in zip(cells, _COLUMNS, strict=True)).rstrip()


def _percent(part: float) -> str:
    """As other numbers; but 100 is all of it."""
    text = _number(100.0 * part)
    return share(part, 2).removesuffix(" %") if text == "100" and part < 1.0 else text


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
