"""A plan as one HTML page: an interactive map and all figures, without any network.

The page loads nothing: its policy lets in its own script and style by their hashes, and pictures
that it carries itself. Every text passes through `html.escape` or is JSON without a `<`.
"""

import base64
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from urllib.parse import quote

from alice_survey.base.artefacts import atomic_path
from alice_survey.base.config import SeaConfig
from camera_calib.rig import Rig
from missions.areas.bathymetry import Bathymetry
from missions.coverage.certificate import Certificate
from missions.exposure.settings_table import Setting
from missions.plan.page_data import page_data
from missions.values.plan_file import Plan

_HERE = Path(__file__).parent
_SCRIPTS = ("page_plan.js", "page_draw.js", "page_layers.js", "page.js")


@dataclass(frozen=True, kw_only=True)
class Link:
    """A file that the page points to."""

    href: str
    """Relative to the page, with forward slashes."""
    about: str


def write_page(
    path: Path,
    plan: Plan,
    rig: Rig,
    certificate: Certificate | None = None,
    settings_rows: Sequence[Setting] = (),
    *,
    bathymetry: Bathymetry | None = None,
    sea: SeaConfig | None = None,
    warnings: Sequence[str] = (),
    links: Sequence[Link] = (),
) -> None:
    """Write a plan as a page with an interactive map.

    Args:
        path: of the HTML file.
        plan: the plan.
        rig: its cameras; footprints are of the first.
        certificate: how many pictures see each place; None leaves that layer out.
        settings_rows: of the table of imaging settings.
        bathymetry: contours to draw.
        sea: its mean current near the sea floor is shown.
        warnings: what is not as asked for.
        links: files to point to.
    """
    data = page_data(plan, rig, certificate, bathymetry, sea)
    # Within a script only "</" and "<!--" could end or change it.
    held = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    style = (_HERE / "page.css").read_text(encoding="utf-8")
    script = page_script()
    policy = (
        f"default-src 'none'; img-src data:; style-src '{_hash(style)}'; "
        f"script-src '{_hash(script)}'; base-uri 'none'; form-action 'none'"
    )
    title = escape(plan.name)
    parts = [
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
        '<meta name="viewport" content="width=device-width,initial-scale=1">',
        '<meta name="referrer" content="no-referrer">',
        f"<title>{title}: survey plan</title><style>{style}</style></head>\n<body><main>",
        f'<h1>{title}</h1><p class="sub">{escape(_subtitle(plan))}</p>',
        _facts(plan, rig),
        _warnings(warnings),
        _map(plan),
        f'<div class="tables">{_coverage(certificate)}{_dives(plan)}</div>',
        _settings(settings_rows),
        _links(links),
        "<footer>Places are of the left port's outer glass, metres north and east of the datum "
        f"{escape(_place(plan))}; latitude and longitude are WGS 84.</footer>",
        f'</main>\n<script type="application/json" id="data">{held}</script>',
        f"<script>{script}</script></body></html>\n",
    ]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(part for part in parts if part), encoding="utf-8")


def page_script() -> str:
    """The page's script: its parts in the order in which they build on one another."""
    return "\n".join((_HERE / name).read_text(encoding="utf-8") for name in _SCRIPTS)


def _hash(text: str) -> str:
    """As a content security policy names inline text (W3C, CSP level 3)."""
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return f"sha256-{base64.b64encode(digest).decode('ascii')}"


def _place(plan: Plan) -> str:
    datum = plan.datum
    return (
        f"{abs(datum.latitude_deg):.6f}° {'NS'[datum.latitude_deg < 0]}, "
        f"{abs(datum.longitude_deg):.6f}° {'EW'[datum.longitude_deg < 0]}"
    )


def _subtitle(plan: Plan) -> str:
    return (
        f"Survey plan at {_place(plan)}: {plan.area.survey.area:.0f} m² of sea floor at "
        f"{plan.seafloor_depth_m:g} m, seen from {plan.altitude_m:g} m at {plan.speed_mps:g} m/s, "
        f"lines {plan.line_spacing_m:.2f} m apart"
    )


def _facts(plan: Plan, rig: Rig) -> str:
    minutes = plan.duration_s / 60
    along, across = 100 * plan.reached_forward_overlap, 100 * plan.reached_side_overlap
    facts = (
        ("lines", f"{len(plan.lines)}"),
        ("stations", f"{plan.stations}"),
        ("pictures", f"{plan.stations * len(rig.cameras)}"),
        ("every", f"{plan.interval_s:.2f} s"),
        ("exposure", f"{plan.exposure_s * 1000:.2f} ms"),
        ("overlap", f"{along:.0f} / {across:.0f} %"),
        ("covered", f"{plan.coverage:.2%}"),
        ("way", f"{plan.length_m:.0f} m"),
        ("time", f"{minutes:.0f} min" if minutes < 180 else f"{minutes / 60:.1f} h"),
        ("dives", f"{len(plan.dives)}"),
        ("energy", f"{plan.energy_wh:.0f} Wh"),
    )
    cells = "".join(
        f'<div class="fact"><span>{escape(label)}</span><b>{escape(value)}</b></div>'
        for label, value in facts
    )
    return f'<div class="facts">{cells}</div>'


def _warnings(warnings: Sequence[str]) -> str:
    if not warnings:
        return ""
    items = "".join(f"<li>{escape(text)}</li>" for text in warnings)
    return f'<section class="card warnings"><h2>Take note</h2><ul>{items}</ul></section>'


def _map(plan: Plan) -> str:
    ruler = (
        '<svg width="18" height="18" viewBox="0 0 18 18" fill="none" stroke="currentColor" '
        'stroke-width="1.6"><path d="M1.5 12.5 12.5 1.5 16.5 5.5 5.5 16.5Z"/>'
        '<path d="M4.5 9.5l2 2M7.5 6.5l2 2M10.5 3.5l2 2"/></svg>'
    )
    whole = (
        '<svg width="18" height="18" viewBox="0 0 18 18" fill="none" stroke="currentColor" '
        'stroke-width="1.8"><path d="M2 6V2h4M12 2h4v4M16 12v4h-4M6 16H2v-4"/></svg>'
    )
    buttons = "".join(
        f'<button id="{name}" type="button" title="{title}" aria-label="{title}"{extra}>'
        f"{face}</button>"
        for name, title, face, extra in (
            ("in", "Zoom in (+)", "+", ""),
            ("out", "Zoom out (-)", "−", ""),
            ("fit", "Show all (0)", whole, ""),
            ("measure", "Measure distances (m, Esc)", ruler, ' aria-pressed="false"'),
        )
    )
    return (
        '<section class="card map"><div class="view">'
        f'<canvas id="map" tabindex="0" role="img" aria-label="Map of {escape(plan.name)}: area, '
        'lines and stations; arrow keys move it"></canvas>'
        f'<div class="tools">{buttons}</div><div id="tip" hidden></div>'
        '<div id="read" aria-live="off"></div></div>'
        '<div class="side"><div id="layers"></div><p class="hint">Drag to move, turn the wheel or '
        "pinch to zoom, point at a line for its stations.</p>"
        "<noscript>The map needs JavaScript; map.png beside this page shows the same.</noscript>"
        "</div></section>"
    )


def _coverage(seen: Certificate | None) -> str:
    if seen is None:
        return ""
    asked = seen.pattern.passes * seen.pattern.pictures
    rows = (
        ("In at least one picture", f"{seen.covered_share:.3%}"),
        ("Seen by every camera", f"{seen.every_camera_share:.3%}"),
        ("Seen by all cameras at once (stereo)", f"{seen.stereo_share:.3%}"),
        (
            f"As asked: on {seen.pattern.passes} line(s) and in {asked} picture(s) of every camera",
            f"{seen.share_at_overlap:.3%}",
        ),
        ("Fewest pictures of a camera anywhere", f"{seen.fewest_pictures}"),
        ("Pictures of all cameras, mean", f"{seen.mean_pictures:.1f}"),
        ("Cell of this count", f"{100 * seen.grid.cell_m:.1f} cm"),
    )
    return _table("Coverage", ("share of the area", ""), rows, numbers=(1,))


def _dives(plan: Plan) -> str:
    rows = [
        (
            f"Dive {number}",
            f"{dive.first_line} to {dive.last_line}",
            f"{sum(plan.lines[i].stations for i in range(dive.first_line, dive.last_line + 1))}",
            f"{dive.route.length_m:.0f} m",
            f"{dive.duration_s / 60:.0f} min",
            f"{dive.energy_wh:.0f} Wh",
        )
        for number, dive in enumerate(plan.dives, start=1)
    ]
    header = ("", "lines", "stations", "way", "time", "energy")
    return _table("Dives", header, rows, numbers=(2, 3, 4, 5))


def _table(
    title: str, header: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int]
) -> str:
    kinds = [' class="num"' if index in numbers else "" for index in range(len(header))]
    head = "".join(
        f'<th scope="col"{kind}>{escape(cell)}</th>'
        for kind, cell in zip(kinds, header, strict=True)
    )
    body = "".join(
        "<tr>"
        + "".join(f"<td{k}>{escape(cell)}</td>" for k, cell in zip(kinds, row, strict=True))
        + "</tr>"
        for row in rows
    )
    return (
        f'<section class="card"><h2>{escape(title)}</h2><div class="scroll"><table><thead><tr>'
        f"{head}</tr></thead><tbody>{body}</tbody></table></div></section>"
    )


def _settings(rows: Sequence[Setting]) -> str:
    """The table of settings, each with its equation, its source and what bound it."""
    if not rows:
        return ""
    sources = list(dict.fromkeys(row.source for row in rows if row.source))
    body: list[str] = []
    group = None
    for row in rows:
        if row.group != group:
            group = row.group
            body.append(f'<tr class="group"><td colspan="4">{escape(group)}</td></tr>')
        note = f'<span class="note">{escape(row.note)}</span>' if row.note else ""
        source = f" [{sources.index(row.source) + 1}]" if row.source else ""
        body.append(
            f"<tr><td>{escape(row.name)}</td><td>{escape(row.text)}</td>"
            f"<td>{escape(row.equation)}{source}{note}</td><td>{escape(row.bound_by)}</td></tr>"
        )
    listed = "".join(f"<li>{escape(source)}</li>" for source in sources)
    return (
        '<section class="card"><h2>Settings and why</h2><div class="scroll">'
        '<table class="settings"><thead><tr>'
        '<th scope="col">setting</th><th scope="col">value</th>'
        '<th scope="col">equation [source]</th><th scope="col">bound by</th></tr></thead>'
        f'<tbody>{"".join(body)}</tbody></table></div><ol class="sources">{listed}</ol></section>'
    )


def _links(links: Sequence[Link]) -> str:
    if not links:
        return ""
    items = "".join(
        f'<li><a href="{escape(quote(link.href))}">{escape(link.href)}</a> '
        f"{escape(link.about)}</li>"
        for link in links
    )
    return f'<section class="card"><h2>Files</h2><ul class="files">{items}</ul></section>'
