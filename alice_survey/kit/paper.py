"""A report as a PDF that can be cited: numbered figures and tables, vector plots, maps.

Typst sets the pages: it is one wheel without libraries of the system, and it tags the PDF for
screen readers (PDF/UA-1). Text reaches it as data and is never read as markup.
"""

import base64
import itertools
import json
import re
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.kit.document import Figure, PictureLayer, Report, Section, ShapeLayer, SurveyMap
from alice_survey.kit.figure import (
    WIDTH_IN,
    LinearSegmentedColormap,
    LineCollection,
    PolyCollection,
    colour_bar,
    figure_style,
    map_axes,
    new_figure,
    png_of,
    svg_of,
    withStroke,
)
from alice_survey.kit.map import map_extent
from alice_survey.kit.page import numeric_columns, png_size

_TEMPLATE = Path(__file__).with_name("paper.typ")
_STANDARD: Final = "ua-1"
_LONG_WORD = re.compile(r"\S{28,}")
_SVG_WIDTH = re.compile(rb'<svg[^>]* width="([0-9.]+)pt"')
_PIXELS_HIGH = 0.85
"""Greatest height of a bitmap, over the width of the text."""
_BREAKS = re.compile(r"([/_.,;:=-])(?=\w)")
_MAX_PX = 1400
"""Pixels along the longer side of a picture in print."""
_MAX_HEIGHT_IN = 4.1
"""Height of the map itself, so that two fit on a page."""
_MARGIN = 0.04
"""Margin around all that is drawn, as a share of the longer side."""
_RIMMED = 20
"""Outlines up to which each has a light rim, as in `map.js`."""
_JPEG_QUALITY = 88
_TIGHT: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": 0.04}
"""A map seldom has the shape of its sheet."""
_KINDS = ("polygon", "line", "point")


def render_pdf(report: Report, date: datetime) -> bytes:
    """Set a report on A4 pages; the same report and date give the same bytes.

    Args:
        report: its content; links to files and interactive parts are left out.
        date: date of the document.

    Returns:
        The PDF, tagged for screen readers.
    """
    import typst
    from matplotlib import get_data_path

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
        # matplotlib brings the fonts of the figures, with the letters of most scripts.
        content: bytes = typst.compile(
            main, root=folder, font_paths=[Path(get_data_path()) / "fonts" / "ttf"],
            ignore_system_fonts=True, pdf_standards=[_STANDARD],
        )  # fmt: skip
    return content


def _data(report: Report, folder: Path) -> dict[str, Any]:
    numbers = itertools.count(1)
    return {
        "title": report.title,
        "subtitle": report.subtitle,
        "author": "alice-survey",
        "version": f"alice-survey {version('alice-survey')}",
        "summary": dict(report.summary),
        "facts": [list(fact) for fact in report.facts],
        "verdicts": [[verdict.level, verdict.text] for verdict in report.verdicts],
        "citation": [list(row) for row in report.citation],
        "sections": [
            {
                "title": section.title,
                "text": list(section.text),
                "figures": [
                    _write_figure(figure, folder / f"figure-{next(numbers)}")
                    for figure in _figures(report, section)
                ],
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


def _write_figure(figure: Figure, path: Path) -> dict[str, Any]:
    """Write a figure next to the template, and describe it."""
    file = path.with_suffix(".svg" if figure.svg else ".png")
    file.write_bytes(figure.svg or figure.png)
    words = ("title", "alt", "shows", "good", "otherwise")
    texts = {word: getattr(figure, word) for word in words}
    return {"file": file.name, "share": _width_share(figure)} | texts


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


def with_stills(survey_map: SurveyMap) -> SurveyMap:
    """The same map with figures for print: as it first shows, then further pictures alone."""
    shown = [layer for layer in survey_map.layers if layer.shown]
    outline = [a for a in survey_map.layers if isinstance(a, ShapeLayer) and a.name == "area"]
    further = [
        layer
        for layer in survey_map.layers
        if isinstance(layer, PictureLayer) and layer.base and not layer.shown
    ]
    stills = [map_figure(survey_map, shown)]
    stills += [map_figure(survey_map, [layer, *outline], on_page=False) for layer in further]
    return replace(survey_map, stills=stills)


@figure_style()
def map_figure(
    survey_map: SurveyMap, layers: Sequence[PictureLayer | ShapeLayer], *, on_page: bool = True
) -> Figure:
    """Layers of a map over one another, with its scale, north, key and colour bar.

    Args:
        survey_map: what the layers are of; gives the frame.
        layers: the lowest first; those of shapes lie over those of pictures.
        on_page: whether it needs pixels too.
    """
    west, south, east, north = map_extent(survey_map)
    margin = _MARGIN * max(east - west, north - south)
    wide, high = east - west + 2 * margin, north - south + 2 * margin
    sheet = new_figure(0.8 + min(_MAX_HEIGHT_IN, (WIDTH_IN - 1.6) * high / wide))
    axes = sheet.subplots()
    axes.grid(visible=False)
    pictures = [layer for layer in layers if isinstance(layer, PictureLayer)]
    for layer in sorted(pictures, key=lambda layer: not layer.base):
        _paint_picture(axes, layer)
    shapes = [layer for layer in layers if isinstance(layer, ShapeLayer)]
    for shape in sorted(shapes, key=lambda layer: _KINDS.index(layer.kind)):
        _paint_shapes(axes, shape)
    axes.set(xlim=(west - margin, east + margin), ylim=(south - margin, north + margin))
    map_axes(axes, survey_map.unit, names=survey_map.axes)
    if shapes:
        sheet.legend(loc="outside lower center", ncols=min(4, len(shapes)), fontsize=8)
    titles = ", ".join(layer.title.lower() for layer in layers)
    first = pictures[0] if pictures else layers[0]
    words = [f"{layer.title}: {layer.about[0].lower()}{layer.about[1:]}" for layer in shapes
             if layer.about]  # fmt: skip
    about = pictures[0].about if pictures else ""
    return Figure(
        png=png_of(sheet, **_TIGHT) if on_page else b"",
        svg=_with_jpegs(svg_of(sheet, **_TIGHT)),
        title=first.title,
        alt=f"Map, north up: {titles}",
        shows=" ".join([about, *words]).strip(),
    )


def _paint_picture(axes: Any, layer: PictureLayer) -> None:
    picture = flat_picture(layer)
    extent = (
        layer.west_m,
        layer.west_m + layer.width_px * layer.pixel_m,
        layer.north_m - layer.height_px * layer.pixel_m,
        layer.north_m,
    )
    axes.imshow(picture, extent=extent, interpolation="none", zorder=1 if layer.base else 2)
    scale = layer.scale
    if scale is not None:
        colours = LinearSegmentedColormap.from_list(layer.name, list(scale.colours))
        ramp = axes.imshow(
            np.array([[scale.low, scale.high]]), cmap=colours, visible=False, aspect="auto"
        )
        colour_bar(ramp, axes, scale.label)


def flat_picture(layer: PictureLayer, max_px: int = _MAX_PX) -> NDArray[np.uint8]:
    """A layer as one picture on white, from the finest level that is small enough.

    Returns:
        (H, W, 3) red, green, blue.
    """
    level = layer.levels - 1
    while level > 0 and max(layer.size(level)[:2]) > max_px:
        level -= 1
    width, height = layer.size(level)[:2]
    sheet = np.full((height, width, 3), 255, np.uint8)
    for name, data in layer.tiles.items():
        k, x, y = (int(part) for part in name.split("/"))
        if k != level:
            continue
        tile = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        left, top = x * layer.tile_px, y * layer.tile_px
        below = sheet[top : top + tile.shape[0], left : left + tile.shape[1]]
        opacity = tile[..., 3:] / 255.0 if tile.shape[2] == 4 else 1.0
        below[:] = (opacity * tile[..., 2::-1] + (1.0 - opacity) * below).astype(np.uint8)
    return sheet


def _paint_shapes(axes: Any, layer: ShapeLayer) -> None:
    if layer.kind == "point":
        places = np.array([shape[0] for shape in layer.shapes])
        axes.plot(
            *places.T, "o", ms=3.6, mew=0.7, color=layer.colour, mec="white", label=layer.title,
            zorder=6,
        )  # fmt: skip
        return
    kind = LineCollection if layer.kind == "line" else PolyCollection
    many = len(layer.shapes) > _RIMMED and layer.kind == "polygon"
    width = 0.5 if many else 1.4
    drawn = kind(
        [np.array(shape) for shape in layer.shapes], edgecolors=layer.colour, facecolors="none",
        linewidths=width, linestyles="dashed" if layer.dashed else "solid", label=layer.title,
        zorder=4 + _KINDS.index(layer.kind) / 2,
    )  # fmt: skip
    if not many and not layer.dashed:
        drawn.set_path_effects([withStroke(linewidth=width + 1.6, foreground="white", alpha=0.8)])
    axes.add_collection(drawn, autolim=False)


def _with_jpegs(svg: bytes) -> bytes:
    """An SVG whose pictures are JPEG in place of PNG, a tenth of the size."""

    def shrunk(found: re.Match[bytes]) -> bytes:
        png = base64.b64decode(found[1])
        pixels = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
        coded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
        if len(coded) >= len(png):
            return found[0]
        return b"data:image/jpeg;base64," + base64.b64encode(coded)

    return re.sub(rb"data:image/png;base64,([A-Za-z0-9+/=\s]+)", shrunk, svg)
