"""A report as one HTML page that loads nothing: text, plots, a map that zooms, a mesh that turns.

The templates escape every text. The page's policy lets in its own scripts and styles by their
hashes, and pictures that it carries itself. Leaflet draws the map and three the mesh; `web/` holds
them as the page carries them. To write them again, with the same bytes:

    cd alice_survey/kit/web && npm ci && npm run build
"""

import base64
import hashlib
import io
import re
from functools import cache
from pathlib import Path
from typing import Any

from PIL import Image

from alice_survey.kit.document import Report, Section, Table
from alice_survey.kit.map import map_data

_HERE = Path(__file__).parent
_MAP_SCRIPTS = ("web/vendor_map.js", "map_tiles.js", "map.js")
_MESH_SCRIPTS = ("web/vendor_mesh.js", "mesh.js")
_NUMBER = re.compile(r"[~<>≤≥±+\-−]?\s*\d.{0,23}")
"""A number with its unit, its sigma or a share: "12.3 mm", "0.4 ± 0.1 %", "3 of 58"."""
_SHORT_WORD = 8
_NO_VALUE = {"", "-", "–", "—", "n/a"}


def render_html(report: Report) -> str:
    """Write a report as one page; the same report gives the same text.

    Args:
        report: its content.

    Returns:
        The page, to be written as UTF-8.

    Raises:
        ValueError: a picture is of an unknown kind.
    """
    styles, scripts = _embedded_files(report)
    map_json, map_tiles = ("", []) if report.map is None else map_data(report.map)
    page: str = _templates().get_template("page.html").render(
        report=report, policy=_policy(styles, scripts), styles=styles, scripts=scripts,
        map_json=map_json, map_tiles=map_tiles,
        mesh_glb="" if report.mesh is None else _base64(report.mesh.glb.read_bytes()),
    )  # fmt: skip
    return page


@cache
def _templates() -> Any:
    from jinja2 import Environment, FileSystemLoader

    found = Environment(
        loader=FileSystemLoader(_HERE / "templates"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    found.filters |= {
        "anchor": _anchor,
        "numeric_columns": numeric_columns,
        "png_address": lambda png: f"data:image/png;base64,{_base64(png)}",
        "png_size": png_size,
        "short": lambda value: f"{value:.4g}".replace("-", "−"),
    }
    return found


def _embedded_files(report: Report) -> tuple[list[str], list[str]]:
    """Styles and scripts that the page embeds."""
    styles, scripts = [_read("page.css")], list[str]()
    if report.map is not None:
        styles.insert(0, _read("web/vendor_map.css"))
        scripts += map(_read, _MAP_SCRIPTS)
    if report.mesh is not None:
        scripts += map(_read, _MESH_SCRIPTS)
    return styles, scripts


def _read(name: str) -> str:
    return (_HERE / name).read_text(encoding="utf-8")


def _policy(styles: list[str], scripts: list[str]) -> str:
    """The page's content security policy; a texture of the mesh is a `blob:` of the page itself."""
    allowed_styles = " ".join(_hash(text) for text in styles)
    allowed_scripts = " ".join(_hash(text) for text in scripts) or "'none'"
    return (
        f"default-src 'none'; img-src data: blob:; style-src {allowed_styles}; "
        f"script-src {allowed_scripts}; base-uri 'none'; form-action 'none'"
    )


def _hash(text: str) -> str:
    """Hash by which a content security policy names inline text (W3C, CSP level 3)."""
    return f"'sha256-{_base64(hashlib.sha256(text.encode('utf-8')).digest())}'"


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _anchor(section: Section) -> str:
    name = (section.name or section.title).lower()
    return "part-" + re.sub(r"[^a-z0-9]+", "-", name).strip("-")


def png_size(png: bytes) -> tuple[int, int]:
    """Width and height in pixels."""
    with Image.open(io.BytesIO(png)) as picture:
        return picture.size


def numeric_columns(table: Table) -> list[bool]:
    """Whether most cells with a value are numbers, and the rest short words such as "held"."""
    found = []
    for index in range(len(table.header)):
        cells = [row[index].strip() for row in table.rows]
        values = [cell for cell in cells if cell.lower() not in _NO_VALUE]
        words = [value for value in values if not _NUMBER.fullmatch(value)]
        short = all(len(word) <= _SHORT_WORD for word in words)
        found.append(short and len(values) > 2 * len(words))
    return found
