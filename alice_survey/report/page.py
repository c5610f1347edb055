"""A report as one HTML page that loads nothing: text, plots, a map that zooms, a mesh that turns.

The page's policy lets in its own scripts and styles by their hashes, and pictures that it carries
itself. Every text passes through `html.escape` or is JSON without a `<`. Leaflet draws the map and
three the mesh; `web/` holds them as the page carries them. To write them again, the same bytes:

    cd alice_survey/report/web && npm ci && npm run build
"""

import base64
import hashlib
import re
import struct
from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path

from alice_survey.base.run import progress
from alice_survey.report.document import Figure, Level, Link, Mesh, Report, Section, Table
from alice_survey.report.page_map import map_data, map_view

_HERE = Path(__file__).parent
_MAP_SCRIPTS = ("web/vendor_map.js", "report_tiles.js", "report_map.js")
_MESH_SCRIPTS = ("web/vendor_mesh.js", "report_mesh.js")
_VERDICTS: dict[Level, tuple[str, str]] = {
    "good": ("Good", "M3.5 8.5l3 3 6-7"),
    "look": ("Look", "M8 3v6.5M8 12v.8"),
    "bad": ("Bad", "M4 4l8 8M12 4l-8 8"),
}
"""The word and the path of the sign, on a square of 16."""
_NUMBER = re.compile(
    r"[~<>≤≥±+\-−]?\s*\d[\d.,'\u2009\u202f ]*(e[+\-−]?\d+)?"  # with groups of thousands
    r"(\s*(±|to|of|/|x|×)\s*[+\-−]?\d[\d.,]*(e[+\-−]?\d+)?)*"
    r"\s*([%‰°]|[a-zA-Zµ²³/·%]{1,8}( [a-z]{1,4})?)?",
    re.IGNORECASE,
)
"""With its unit, its sigma or a share: "12.3 mm", "0.4 ± 0.1 %", "3 of 58"."""
_SHORT_WORD = 8
_NO_VALUE = {"", "-", "–", "—", "n/a"}


@progress.step("write the page")
def render_html(report: Report) -> str:
    """Write a report as one page; the same report gives the same text.

    Args:
        report: what it says.

    Returns:
        The page, to be written as UTF-8.

    Raises:
        ValueError: two sections or layers share a name, a section shows a map or a mesh that the
            report lacks, a map or a mesh has no section, or a picture is of no kind known here.
    """
    _check(report)
    styles, scripts, data = *_carried(report), list[str]()
    if report.map is not None:
        data.append(map_data(report.map))
    if report.mesh is not None:
        data.append(_mesh_data(report.mesh))
    title = escape(report.title)
    parts = [
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{page_policy(report)}">',
        '<meta name="viewport" content="width=device-width,initial-scale=1">',
        '<meta name="referrer" content="no-referrer"><link rel="icon" href="data:,">',
        f"<title>{title}</title>",
        *(f"<style>{text}</style>" for text in styles),
        '</head>\n<body><a class="skip" href="#contents">Skip to the contents</a>',
        f'<header><h1>{title}</h1><p class="sub">{escape(report.subtitle)}</p></header>',
        "<main>",
        _summary(report),
        _verdicts(report.verdicts),
        _facts(report.facts),
        f'<div class="body">{_contents(report.sections)}<div class="sections">',
        *(_section(section, report) for section in report.sections),
        "</div></div></main>",
        *data,
        *(f"<script>{text}</script>" for text in scripts),
        "</body></html>\n",
    ]
    return "\n".join(part for part in parts if part)


def _check(report: Report) -> None:
    names = [section.name for section in report.sections]
    if len(set(names)) < len(names):
        raise ValueError(f"sections share a name: {', '.join(sorted(names))}")
    for scene, held in (("map", report.map), ("mesh", report.mesh)):
        shown = sum(section.scene == scene for section in report.sections)
        if shown != (held is not None):
            raise ValueError(f"{shown} sections show the {scene}, {int(held is not None)} expected")


def _read(name: str) -> str:
    return (_HERE / name).read_text(encoding="utf-8")


def _carried(report: Report) -> tuple[list[str], list[str]]:
    """The styles and the scripts that its page carries."""
    styles, scripts = [_read("page.css")], list[str]()
    if report.map is not None:
        styles.insert(0, _read("web/vendor_map.css"))
        scripts += [_read(name) for name in _MAP_SCRIPTS]
    if report.mesh is not None:
        scripts += [_read(name) for name in _MESH_SCRIPTS]
    return styles, scripts


def _mesh_data(mesh: Mesh) -> str:
    if mesh.address is not None:
        return (
            f'<script type="text/plain" id="mesh-glb" data-from="{escape(mesh.address)}"></script>'
        )
    glb = base64.b64encode(mesh.glb.read_bytes()).decode("ascii")
    return f'<script type="text/plain" id="mesh-glb">{glb}</script>'


def page_policy(report: Report) -> str:
    """What its page may load, as a content security policy.

    A texture of the mesh is a `blob:` of the page itself. A page that a server gives may load
    from that server too.
    """
    styles, scripts = _carried(report)
    layers = report.map.layers if report.map is not None else ()
    tiled = any(getattr(layer, "address", None) is not None for layer in layers)
    fetched = report.mesh is not None and report.mesh.address is not None
    allowed_styles = " ".join(_hash(text) for text in styles)
    allowed_scripts = " ".join(_hash(text) for text in scripts) or "'none'"
    pictures = "'self' data: blob:" if tiled else "data: blob:"
    fetches = "connect-src 'self'; " if fetched else ""
    return (
        f"default-src 'none'; img-src {pictures}; style-src {allowed_styles}; "
        f"script-src {allowed_scripts}; {fetches}base-uri 'none'; form-action 'none'"
    )


def _hash(text: str) -> str:
    """As a content security policy names inline text (W3C, CSP level 3)."""
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def _summary(report: Report) -> str:
    if not report.summary:
        return ""
    items = "".join(
        f"<div><dt>{escape(label)}</dt><dd>{escape(text)}</dd></div>"
        for label, text in report.summary.items()
    )
    return f'<section class="summary" aria-label="Summary"><dl>{items}</dl></section>'


def _verdicts(verdicts: Sequence[tuple[Level, str]]) -> str:
    if not verdicts:
        return ""
    items = []
    for level, text in verdicts:
        word, path = _VERDICTS[level]
        sign = (
            '<svg viewBox="0 0 16 16" width="14" height="14" aria-hidden="true" fill="none" '
            f'stroke="currentColor" stroke-width="2.2" stroke-linecap="round"><path d="{path}"/>'
            "</svg>"
        )
        items.append(
            f'<li class="{level}"><b class="badge">{sign}{word}</b><span>{escape(text)}</span></li>'
        )
    return f'<section class="verdicts" aria-label="Verdicts"><ul>{"".join(items)}</ul></section>'


def _facts(facts: Sequence[tuple[str, str]]) -> str:
    if not facts:
        return ""
    cells = "".join(
        f"<div><dt>{escape(label)}</dt><dd>{escape(value)}</dd></div>" for label, value in facts
    )
    return f'<section aria-label="In numbers"><dl class="facts">{cells}</dl></section>'


def _contents(sections: Sequence[Section]) -> str:
    items = "".join(
        f'<li><a href="#{_anchor(section)}">{escape(section.title)}</a></li>'
        for section in sections
    )
    return (
        '<nav id="contents" aria-label="Contents" tabindex="-1"><h2>Contents</h2>'
        f"<ol>{items}</ol></nav>"
    )


def _anchor(section: Section) -> str:
    return "part-" + re.sub(r"[^a-z0-9]+", "-", section.name.lower()).strip("-")


def _section(section: Section, report: Report) -> str:
    anchor = _anchor(section)
    parts = [
        f'<section class="part" id="{anchor}" aria-labelledby="{anchor}-title">',
        f'<h2 id="{anchor}-title">{escape(section.title)}</h2>',
        *(f"<p>{escape(text)}</p>" for text in section.text),
    ]
    if section.scene == "map" and report.map is not None:
        parts.append(map_view(report.map))
    if section.scene == "mesh" and report.mesh is not None:
        parts.append(_mesh_view(report.mesh))
    parts += [_figure(figure) for figure in section.figures]
    parts += [_table(table) for table in section.tables]
    if section.links:
        parts.append(f'<ul class="links">{"".join(map(_link, section.links))}</ul>')
    return "\n".join([*parts, "</section>"])


def _figure(figure: Figure) -> str:
    width, height = _png_size(figure.png)
    words = (("Shows", figure.shows), ("Good", figure.good), ("If not", figure.otherwise))
    reading = "".join(
        f"<div><dt>{label}</dt><dd>{escape(text)}</dd></div>" for label, text in words if text
    )
    return (
        f'<figure><h3>{escape(figure.title)}</h3><img src="{_png_uri(figure.png)}" '
        f'width="{width}" height="{height}" alt="{escape(figure.alt)}">'
        f'<figcaption><dl class="reading">{reading}</dl></figcaption></figure>'
    )


def _png_size(png: bytes) -> tuple[int, int]:
    if png[:8] != b"\x89PNG\r\n\x1a\n":
        raise ValueError("a figure is not a PNG")
    width, height = struct.unpack(">II", png[16:24])
    return width, height


def _png_uri(png: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}"


def _table(table: Table) -> str:
    numeric = list(_numeric_columns(table))
    head = "".join(
        f'<th scope="col"{_kind(number)}>{escape(cell)}</th>' if cell else "<td></td>"
        for cell, number in zip(table.header, numeric, strict=True)
    )
    rows = []
    for row in table.rows:
        cells = []
        for index, (cell, number) in enumerate(zip(row, numeric, strict=True)):
            names_row = index == 0 and cell and not number and len(row) > 1
            opening = '<th scope="row">' if names_row else f"<td{_kind(number)}>"
            cells.append(f"{opening}{escape(cell)}</{'th' if names_row else 'td'}>")
        rows.append(f"<tr>{''.join(cells)}</tr>")
    title = escape(table.title)
    return (
        f'<div class="table"><h3>{title}</h3>'
        f'<div class="scroll" role="region" tabindex="0" aria-label="{title}">'
        f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div></div>"
    )


def _link(link: Link) -> str:
    return f'<li><a href="{escape(link.address)}">{escape(link.text)}</a> {escape(link.about)}</li>'


def _numeric_columns(table: Table) -> Iterator[bool]:
    """Whether most cells with a value are numbers, and the rest short words such as "held"."""
    for index in range(len(table.header)):
        cells = [row[index].strip() for row in table.rows]
        values = [cell for cell in cells if cell.lower() not in _NO_VALUE]
        words = [value for value in values if not _NUMBER.fullmatch(value)]
        short = all(len(word) <= _SHORT_WORD for word in words)
        yield short and len(values) > 2 * len(words)


def _kind(number: bool) -> str:
    return ' class="num"' if number else ""


def _mesh_view(mesh: Mesh) -> str:
    width, height = _png_size(mesh.still)
    turns = "".join(
        f'<button type="button" data-act="{act}" title="{label}" aria-label="{label}">{face}'
        "</button>"
        for act, label, face in (
            ("left", "Turn left", "←"),
            ("right", "Turn right", "→"),
            ("up", "Look from higher", "↑"),
            ("down", "Look from lower", "↓"),
            ("nearer", "Nearer", "+"),
            ("farther", "Farther", "−"),
            ("reset", "Reset the view", "⟲"),
        )
    )
    return (
        '<div class="scene mesh"><div class="live" id="mesh" hidden><div class="view">'
        '<canvas id="mesh-canvas" tabindex="0" role="application" '
        'aria-label="Mesh of the sea floor: arrow keys turn it, + and - move nearer and farther, '
        '0 resets the view"></canvas>'
        f'<div class="tools" role="group" aria-label="Turn the mesh">{turns}'
        '<button type="button" class="word" data-act="relief" aria-pressed="false" '
        'title="Grey under a lamp from the side: shape without colours">Relief</button></div>'
        '<p class="readout" id="mesh-readout"></p></div>'
        '<p class="hint">Drag to turn it, or use the arrow keys; two fingers or the right button '
        "move it. Click it, then turn the wheel to come nearer.</p></div>"
        f'<div class="still"><img src="{_png_uri(mesh.still)}" width="{width}" height="{height}" '
        f'alt="{escape(mesh.alt)}"><p class="hint" id="mesh-note">'
        "A still picture: the mesh turns in a browser that runs scripts and has WebGL.</p></div>"
        f"<p>{escape(mesh.about)}</p></div>"
    )
