"""A report as a PDF that can be cited: numbered figures and tables, vector plots, page numbers.

Typst sets the pages: it is one wheel without libraries of the system, and it tags the PDF for
screen readers (PDF/UA-1). Text reaches it as data and is never read as markup.
"""

import json
import re
import tempfile
from collections.abc import Iterator
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from alice_survey.kit.document import Figure, Report, Section
from alice_survey.kit.figure import WIDTH_IN
from alice_survey.kit.page import numeric_columns, png_size

_TEMPLATE = Path(__file__).with_name("paper.typ")
_STANDARD: Final = "ua-1"
_LONG_WORD = re.compile(r"\S{28,}")
_SVG_WIDTH = re.compile(rb'<svg[^>]* width="([0-9.]+)pt"')
_PIXELS_HIGH = 0.85
"""Greatest height of a bitmap, over the width of the text."""
_BREAKS = re.compile(r"([/_.,;:=-])(?=\w)")


def render_pdf(report: Report, date: datetime) -> bytes:
    """Set a report on A4 pages; the same report and date give the same bytes.

    Args:
        report: its content; links to files and interactive parts are left out.
        date: date of the document.

    Returns:
        The PDF, tagged for screen readers.
    """
    import typst

    with tempfile.TemporaryDirectory(prefix="alice-survey-") as name:
        folder = Path(name)
        data = _data(report, folder)
        data["date"] = {
            part: getattr(date, part)
            for part in ("year", "month", "day", "hour", "minute", "second")
        }
        (folder / "report.json").write_text(json.dumps(data, allow_nan=False), encoding="utf-8")
        main = folder / "main.typ"
        main.write_bytes(_TEMPLATE.read_bytes())
        content: bytes = typst.compile(
            main,
            root=folder,
            font_paths=[_fonts()],
            ignore_system_fonts=True,
            pdf_standards=[_STANDARD],
        )
    return content


def _fonts() -> Path:
    """Fonts that come with matplotlib: those of the figures, with the letters of most scripts."""
    from matplotlib import get_data_path

    return Path(get_data_path()) / "fonts" / "ttf"


def _data(report: Report, folder: Path) -> dict[str, Any]:
    files = _FigureFiles(folder)
    return {
        "title": report.title,
        "subtitle": report.subtitle,
        "author": "alice-survey",
        "version": f"alice-survey {version('alice-survey')}",
        "summary": dict(report.summary),
        "facts": [list(fact) for fact in report.facts],
        "verdicts": [[verdict.level, verdict.text] for verdict in report.verdicts],
        "citation": [list(row) for row in report.citation],
        "footer": report.footer,
        "sections": [
            {
                "title": section.title,
                "text": list(section.text),
                "figures": [files.figure(figure) for figure in _figures(report, section)],
                "tables": [
                    {
                        "title": table.title,
                        "header": list(table.header),
                        "rows": [[_breakable(cell) for cell in row] for row in table.rows],
                        "numeric": numeric_columns(table),
                    }
                    for table in section.tables
                ],
            }
            for section in report.sections
        ],
    }


def _figures(report: Report, section: Section) -> Iterator[Figure]:
    if section.scene == "map" and report.map is not None:
        yield from report.map.stills
    if section.scene == "mesh" and report.mesh is not None:
        yield report.mesh.still
    yield from section.figures


class _FigureFiles:
    """Figures as files next to the template."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._count = folder, 0

    def figure(self, figure: Figure) -> dict[str, Any]:
        self._count += 1
        name = f"figure-{self._count}.{'svg' if figure.svg else 'png'}"
        (self._folder / name).write_bytes(figure.svg or figure.png)
        words = ("title", "alt", "shows", "good", "otherwise")
        texts = {word: getattr(figure, word) for word in words}
        return {"file": name, "share": _width_share(figure)} | texts


def _width_share(figure: Figure) -> float:
    """Width in print, as a share of the text's: vectors keep their size, pixels fit the page."""
    found = _SVG_WIDTH.search(figure.svg)
    if found:
        return min(1.0, float(found[1]) / (72.0 * WIDTH_IN))
    width, height = png_size(figure.png)
    return min(1.0, _PIXELS_HIGH * width / height)


def _breakable(cell: str) -> str:
    """A cell whose long words may break after punctuation."""
    return _LONG_WORD.sub(lambda word: _BREAKS.sub("\\1\u200b", word[0]), cell)
