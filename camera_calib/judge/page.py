"""HTML of a calibration report: one page, nothing loaded from elsewhere, fit for printing.

Every text passes through `html.escape`; names of files and cameras are never markup.
"""

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape

_STYLE = """
:root{--ink:#22313a;--soft:#5d6d77;--line:#dde5e9;--paper:#ffffff;--wash:#f4f7f8;--blue:#1b6ca8;
--good:#2e7d4f;--look:#b26a00;--bad:#b3261e}
*{box-sizing:border-box}
body{margin:0;background:var(--wash);color:var(--ink);
font:15px/1.5 -apple-system,"Segoe UI",Roboto,"Helvetica Neue",Arial,sans-serif}
main{max-width:1180px;margin:0 auto;padding:28px 22px 60px}
h1{font-size:28px;margin:0}h2{font-size:20px;margin:0 0 10px;color:var(--blue)}
h3{font-size:15.5px;margin:0 0 4px}p{margin:0 0 10px}
.sub{color:var(--soft);margin-bottom:18px;overflow-wrap:anywhere}
.card{background:var(--paper);border:1px solid var(--line);border-radius:10px;padding:20px 22px;
margin:0 0 18px}
.facts{display:grid;grid-template-columns:repeat(auto-fit,minmax(165px,1fr));gap:12px;
margin:0 0 18px}
.fact{background:var(--paper);border:1px solid var(--line);border-radius:10px;padding:11px 14px}
.fact b{display:block;font-size:17px;font-weight:600}.fact span{color:var(--soft);font-size:13px}
ul.verdicts{list-style:none;margin:0;padding:0}
ul.verdicts li{padding:6px 0 6px 74px;position:relative;border-top:1px solid var(--line);
overflow-wrap:anywhere}
ul.verdicts li:first-child{border-top:0}
.tag{position:absolute;left:0;top:8px;width:60px;text-align:center;border-radius:9px;color:#fff;
font-size:12px;font-weight:600;line-height:18px}
.tag.good{background:var(--good)}.tag.look{background:var(--look)}.tag.bad{background:var(--bad)}
nav{margin:0 0 18px;font-size:14px}nav a{color:var(--blue);text-decoration:none;margin-right:14px}
figure{margin:18px 0 0;padding-top:16px;border-top:1px solid var(--line)}
figure img{display:block;width:100%;height:auto;margin-top:10px}
figcaption{display:grid;grid-template-columns:1.35fr 1fr 1fr;gap:4px 22px;font-size:13.5px}
figcaption h3{grid-column:1/-1}figcaption p{margin:0}
figcaption b{color:var(--soft);font-weight:600}
.tables{display:grid;grid-template-columns:repeat(auto-fit,minmax(480px,1fr));gap:18px;
margin-top:16px}
.tables .wide{grid-column:1/-1}
.scroll{overflow-x:auto}
table{border-collapse:collapse;width:100%;font-size:13px;font-variant-numeric:tabular-nums}
caption{text-align:left;font-weight:600;padding-bottom:5px;overflow-wrap:anywhere}
th{text-align:left;color:var(--soft);font-weight:600;border-bottom:1.5px solid var(--line);
padding:4px 10px 4px 0;vertical-align:bottom}
td{border-bottom:1px solid var(--line);padding:3px 10px 3px 0;vertical-align:top;
overflow-wrap:break-word}
td:first-child{font-weight:600}
@media(max-width:760px){figcaption{grid-template-columns:1fr}.tables{grid-template-columns:1fr}}
@media print{@page{size:A4;margin:14mm}body{background:#fff;font-size:10.5pt}
figcaption{display:block}figcaption p{margin:0 0 3px}.facts{display:block}
.fact{display:inline-block;width:31%;margin:0 1% 2mm 0}
main{max-width:none;padding:0}nav{display:none}.card{border:0;padding:0;margin:0 0 8mm}
figure,tr,.fact{break-inside:avoid}h2,h3,caption{break-after:avoid}
.tables{display:block}.scroll{margin:0 0 5mm}table{font-size:8.5pt;width:auto}
*{-webkit-print-color-adjust:exact;print-color-adjust:exact}}
"""
_TAGS = {"good": "good", "look": "look", "bad": "bad"}


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A picture with the plain words that go over it."""

    png: bytes
    title: str
    alt: str
    shows: str
    good: str
    otherwise: str


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows of text under a header."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    wide: bool = False
    """Takes the page's whole width; else two stand side by side."""


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of the page."""

    title: str
    text: Sequence[str] = ()
    figures: Sequence[Figure] = field(default_factory=list)
    tables: Sequence[Table] = field(default_factory=list)


def page(
    *,
    title: str,
    subtitle: str,
    facts: Sequence[tuple[str, str]],
    verdicts: Sequence[tuple[str, str]],
    sections: Sequence[Section],
) -> str:
    """The whole page as HTML.

    Args:
        title: of the page.
        subtitle: one line below it.
        facts: labels and values of the first row.
        verdicts: levels (good, look, bad) and texts, in the order in which they are shown.
        sections: the rest.
    """
    anchors = "".join(
        f'<a href="#s{i}">{escape(section.title)}</a>' for i, section in enumerate(sections)
    )
    cells = "".join(
        f'<div class="fact"><span>{escape(label)}</span><b>{escape(value)}</b></div>'
        for label, value in facts
    )
    lines = "".join(
        f'<li><span class="tag {_TAGS[level]}">{_TAGS[level]}</span>{escape(text)}</li>'
        for level, text in verdicts
    )
    parts = "\n".join(_section(i, section) for i, section in enumerate(sections))
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head>\n<body><main>"
        f'<h1>{escape(title)}</h1><p class="sub">{escape(subtitle)}</p>\n'
        f'<div class="facts">{cells}</div>\n'
        f'<section class="card"><h2>Verdict</h2><ul class="verdicts">{lines}</ul></section>\n'
        f"<nav>{anchors}</nav>\n{parts}\n</main></body></html>\n"
    )


def _section(number: int, section: Section) -> str:
    text = "".join(f"<p>{escape(paragraph)}</p>" for paragraph in section.text)
    figures = "\n".join(_figure(figure) for figure in section.figures)
    tables = "\n".join(_table(table) for table in section.tables)
    return (
        f'<section class="card" id="s{number}"><h2>{escape(section.title)}</h2>{text}{figures}'
        + (f'<div class="tables">{tables}</div>' if tables else "")
        + "</section>"
    )


def _figure(figure: Figure) -> str:
    data = base64.b64encode(figure.png).decode("ascii")
    words = "".join(
        f"<p><b>{label}</b> {escape(text)}</p>"
        for label, text in (
            ("Shows.", figure.shows),
            ("Good.", figure.good),
            ("If not.", figure.otherwise),
        )
    )
    return (
        f"<figure><figcaption><h3>{escape(figure.title)}</h3>{words}</figcaption>"
        f'<img src="data:image/png;base64,{data}" alt="{escape(figure.alt)}"></figure>'
    )


def _table(table: Table) -> str:
    header = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in table.header)
    rows = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in table.rows
    )
    caption = f"<caption>{escape(table.title)}</caption>" if table.title else ""
    kind = "scroll wide" if table.wide else "scroll"
    return (
        f'<div class="{kind}"><table>{caption}<thead><tr>{header}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div>"
    )


def with_sigma(value: float, sigma: float) -> str:
    """`849.31 ± 0.46`: two digits of the sigma, and the value to the same place."""
    if not (math.isfinite(sigma) and sigma > 0):
        return f"{value:.6g} ± {sigma:.2g}"
    digits = max(0, 1 - math.floor(math.log10(sigma)))
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def short_label(field: str) -> str:
    """A parameter's name without its unit: `fx_px` as `fx`."""
    for ending in ("_px", "_rad", "_m"):
        field = field.removesuffix(ending)
    return field.replace("_", " ")
