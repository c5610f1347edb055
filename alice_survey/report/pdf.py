"""A report for print: the same words, plots and tables as the page, with stills of what moves."""

import io
from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path
from typing import Any

from alice_survey.base.run import progress
from alice_survey.kit.document import Figure, Level, PictureLayer, Report, Scale, Section, Table

_MARGIN_MM = 16.0
_INK, _SOFT, _BLUE, _LINE = "#22313a", "#5d6d77", "#1b6ca8", "#dde5e9"
_LEVELS: dict[Level, tuple[str, str]] = {
    "good": ("Good", "#2e7d4f"),
    "look": ("Look", "#8f5600"),
    "bad": ("Bad", "#b3261e"),
}
_SIZE = 9.0
_MOST_HEIGHT_MM = 215.0
"""Of a picture on its page."""
_WIDE_CELL = 34
"""Letters from which a column may break its lines."""


@progress.step("write the PDF")
def write_pdf(report: Report, path: Path) -> None:
    """Write a report as A4 pages; the same report gives the same bytes."""
    from reportlab.lib.pagesizes import A4
    from reportlab.lib.units import mm
    from reportlab.platypus import SimpleDocTemplate

    document = SimpleDocTemplate(
        str(path),
        pagesize=A4,
        leftMargin=_MARGIN_MM * mm,
        rightMargin=_MARGIN_MM * mm,
        topMargin=_MARGIN_MM * mm,
        bottomMargin=_MARGIN_MM * mm,
        title=report.title,
        author="alice-survey",
        subject=report.subtitle,
        invariant=1,
    )
    width = A4[0] - 2 * _MARGIN_MM * mm
    parts = list(_parts(report, width))
    document.build(parts, onFirstPage=_footer(report), onLaterPages=_footer(report))


def _footer(report: Report) -> Any:
    from reportlab.lib.units import mm

    def draw(canvas: Any, document: Any) -> None:
        canvas.saveState()
        canvas.setFont(_fonts()[0], 7.5)
        canvas.setFillColor(_SOFT)
        canvas.drawString(_MARGIN_MM * mm, 9 * mm, report.title)
        right = document.pagesize[0] - _MARGIN_MM * mm
        canvas.drawRightString(right, 9 * mm, f"page {document.page}")
        canvas.restoreState()

    return draw


def _fonts() -> tuple[str, str]:
    """Names of a plain and a bold font that has all letters: the one that comes with matplotlib."""
    from matplotlib import get_data_path
    from reportlab.pdfbase import pdfmetrics
    from reportlab.pdfbase.ttfonts import TTFont

    names = ("DejaVuSans", "DejaVuSans-Bold")
    for name in names:
        if name not in pdfmetrics.getRegisteredFontNames():
            file = Path(get_data_path()) / "fonts" / "ttf" / f"{name}.ttf"
            pdfmetrics.registerFont(TTFont(name, str(file)))
    return names


def _styles() -> dict[str, Any]:
    from reportlab.lib.colors import HexColor
    from reportlab.lib.styles import ParagraphStyle

    plain, bold = _fonts()
    body = ParagraphStyle(
        "body", fontName=plain, fontSize=_SIZE, leading=1.4 * _SIZE, textColor=HexColor(_INK)
    )

    def like(name: str, **changes: Any) -> Any:
        return ParagraphStyle(name, parent=body, **changes)

    return {
        "body": body,
        "title": like("title", fontName=bold, fontSize=20, leading=24),
        "soft": like("soft", textColor=HexColor(_SOFT), spaceAfter=8),
        "lead": like("lead", fontSize=10.5, leading=15, spaceAfter=5),
        "h2": like(
            "h2", fontName=bold, fontSize=13.5, leading=17, textColor=HexColor(_BLUE),
            spaceBefore=14, spaceAfter=5, keepWithNext=1,
        ),
        "h3": like("h3", fontName=bold, fontSize=10, spaceBefore=8, spaceAfter=2, keepWithNext=1),
        "cell": like("cell", fontSize=7.6, leading=10),
        "number": like("number", fontSize=7.6, leading=10, alignment=2),
        "head": like("head", fontName=bold, fontSize=7.6, leading=10, textColor=HexColor(_SOFT)),
    }  # fmt: skip


def _parts(report: Report, width: float) -> Iterator[Any]:
    from reportlab.platypus import Paragraph, Spacer

    styles = _styles()
    yield Paragraph(escape(report.title), styles["title"])
    yield Paragraph(escape(report.subtitle), styles["soft"])
    for question, answer in report.summary.items():
        yield Paragraph(f"<b>{escape(question)}.</b> {escape(answer)}", styles["lead"])
    yield Spacer(1, 6)
    yield _grid(
        [[Paragraph(escape(label), styles["cell"]), Paragraph(escape(value), styles["number"])]
         for label, value in report.facts],
        [0.45 * width, 0.3 * width],
    )  # fmt: skip
    yield Paragraph("Verdicts", styles["h2"])
    for verdict in report.verdicts:
        word, colour = _LEVELS[verdict.level]
        yield Paragraph(
            f'<font color="{colour}"><b>{word}</b></font>  {escape(verdict.text)}', styles["body"]
        )
    for section in report.sections:
        yield from _section(report, section, styles, width)


def _section(
    report: Report, section: Section, styles: dict[str, Any], width: float
) -> Iterator[Any]:
    from reportlab.platypus import Paragraph

    yield Paragraph(escape(section.title), styles["h2"])
    for text in section.text:
        yield Paragraph(escape(text), styles["body"])
    if section.scene == "map" and report.map is not None:
        for layer in report.map.layers:
            if isinstance(layer, PictureLayer):
                yield from _layer(layer, styles, width)
    if section.scene == "mesh" and report.mesh is not None:
        yield Paragraph(escape(report.mesh.about), styles["body"])
        yield _picture(report.mesh.still.png, width)
    for table in section.tables:
        yield from _table(table, styles, width)
    for figure in section.figures:
        yield from _figure(figure, styles, width)


def _layer(layer: PictureLayer, styles: dict[str, Any], width: float) -> Iterator[Any]:
    from reportlab.platypus import KeepTogether, Paragraph

    words = f"<b>{escape(layer.title)}.</b> {escape(layer.about)}"
    if layer.scale is not None:
        scale = layer.scale
        words += f" Colours from {scale.low:.3g} to {scale.high:.3g} ({escape(scale.label)})."
    parts = [Paragraph(words, styles["h3"]), _picture(flat(layer), 0.62 * width, 95.0)]
    if layer.scale is not None:
        parts.append(_legend(layer.scale, 0.62 * width))
    yield KeepTogether(parts)


def _legend(scale: Scale, width: float) -> Any:
    from reportlab.graphics.shapes import Drawing, Rect
    from reportlab.lib.colors import HexColor

    bar = Drawing(width, 9)
    step = width / len(scale.colours)
    for n, colour in enumerate(scale.colours):
        block = Rect(n * step, 2, step + 0.5, 6)
        block.fillColor, block.strokeColor = HexColor(colour), None
        bar.add(block)
    return bar


def flat(layer: PictureLayer, most_px: int = 1400) -> bytes:
    """A layer as one JPEG on white, from the level that is about as large."""
    import cv2
    import numpy as np

    level = layer.levels - 1
    while (
        level > 0 and max(layer.width_px, layer.height_px) >> (layer.levels - 1 - level) > most_px
    ):
        level -= 1
    halvings = layer.levels - 1 - level
    width, height = layer.width_px, layer.height_px
    for _ in range(halvings):
        width, height = (width + 1) // 2, (height + 1) // 2
    sheet = np.full((height, width, 3), 255, np.uint8)
    for name, data in layer.tiles.items():
        k, x, y = (int(part) for part in name.split("/"))
        if k != level:
            continue
        tile = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        left, top = x * layer.tile_px, y * layer.tile_px
        if tile.shape[2] == 4:
            clear = tile[..., 3] < 128
            tile = tile[..., :3].copy()
            tile[clear] = 255
        sheet[top : top + tile.shape[0], left : left + tile.shape[1]] = tile
    encoded: bytes = cv2.imencode(".jpg", sheet, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()
    return encoded


def _picture(png: bytes, width: float, most_height_mm: float = _MOST_HEIGHT_MM) -> Any:
    from reportlab.lib.units import mm
    from reportlab.lib.utils import ImageReader
    from reportlab.platypus import Image

    across, down = ImageReader(io.BytesIO(png)).getSize()
    shrink = min(width / across, most_height_mm * mm / down)
    return Image(io.BytesIO(png), across * shrink, down * shrink, hAlign="LEFT")


def _figure(figure: Figure, styles: dict[str, Any], width: float) -> Iterator[Any]:
    from reportlab.platypus import KeepTogether, Paragraph

    words = [("Shows.", figure.shows), ("Good.", figure.good), ("If not.", figure.otherwise)]
    told = " ".join(f"<b>{label}</b> {escape(text)}" for label, text in words if text)
    yield KeepTogether(
        [
            Paragraph(escape(figure.title), styles["h3"]),
            Paragraph(told, styles["body"]),
            _picture(figure.png, width),
        ]
    )


def _table(table: Table, styles: dict[str, Any], width: float) -> Iterator[Any]:
    from reportlab.platypus import Paragraph

    if table.title:
        yield Paragraph(escape(table.title), styles["h3"])
    head = [Paragraph(escape(cell), styles["head"]) for cell in table.header]
    rows = [
        [
            Paragraph(escape(cell), styles["cell" if n == 0 else "number"])
            for n, cell in enumerate(row)
        ]
        for row in table.rows
    ]
    letters = [
        min(_WIDE_CELL, max(len(row[n]) for row in (table.header, *table.rows)))
        for n in range(len(table.header))
    ]
    wanted = [5.0 * count + 14.0 for count in letters]
    shrink = min(1.0, width / sum(wanted))
    yield _grid([head, *rows], [shrink * part for part in wanted], header=True)


def _grid(rows: Sequence[list[Any]], widths: Sequence[float], *, header: bool = False) -> Any:
    from reportlab.platypus import Table as Grid
    from reportlab.platypus import TableStyle

    look: list[Any] = [
        ("LINEBELOW", (0, 0), (-1, -1), 0.4, _LINE),
        ("TOPPADDING", (0, 0), (-1, -1), 1.5),
        ("BOTTOMPADDING", (0, 0), (-1, -1), 2.5),
        ("LEFTPADDING", (0, 0), (0, -1), 0),
        ("VALIGN", (0, 0), (-1, -1), "TOP"),
    ]
    return Grid(rows, widths, repeatRows=1 if header else 0, style=TableStyle(look), hAlign="LEFT")
