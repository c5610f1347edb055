"""The map of a report's page: its data, its controls and a still of it for print."""

import base64
import json
import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from alice_survey.report.document import PictureLayer, Scale, ShapeLayer, SurveyMap

_STILL_PX = 1000
"""Wanted of the longer side of the still."""
_MARGIN = 0.04
"""Around all that is drawn, as a share of the longer side."""
_RIMMED = 20
"""Outlines up to which each has a light rim, as in `report_map.js`."""


def map_data(survey_map: SurveyMap) -> str:
    """What the page's script draws the map from: blocks that a browser does not run.

    The tiles of a layer are one text, so that each is decoded only when it is looked at.

    Raises:
        ValueError: two layers share a name, two base layers are shown, or a tile is no JPEG, PNG
            or WebP.
    """
    layers = survey_map.layers
    names = [layer.name for layer in layers]
    if len(set(names)) < len(names):
        raise ValueError(f"layers share a name: {', '.join(sorted(names))}")
    pictures = [layer for layer in layers if isinstance(layer, PictureLayer)]
    if sum(layer.base and layer.shown for layer in pictures) > 1:
        raise ValueError("more than one base layer is shown")
    described: list[dict[str, Any]] = []
    blocks: list[str] = []
    for index, layer in enumerate(layers):
        if isinstance(layer, PictureLayer):
            if layer.address is not None:
                described.append(_picture(layer) | {"address": layer.address})
                continue
            found, text = _packed(layer.tiles)
            described.append(_picture(layer) | {"block": f"tiles-{index}", "tiles": found})
            blocks.append(f'<script type="text/plain" id="tiles-{index}">{text}</script>')
        else:
            described.append(_shapes(layer))
    west, south, east, north = map_extent(survey_map)
    data = {
        "unit": survey_map.unit,
        "extent": [_short(value) for value in (west, south, east, north)],
        "layers": described,
    }
    # Within a script only "</" and "<!--" could end or change it.
    held = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return "\n".join([f'<script type="application/json" id="map-data">{held}</script>', *blocks])


def map_extent(survey_map: SurveyMap) -> tuple[float, float, float, float]:
    """West, south, east and north of all that the map holds, on its own axes.

    Raises:
        ValueError: nothing is on the map.
    """
    east: list[float] = []
    north: list[float] = []
    for layer in survey_map.layers:
        if isinstance(layer, PictureLayer):
            east += [layer.west_m, layer.west_m + layer.width_px * layer.pixel_m]
            north += [layer.north_m, layer.north_m - layer.height_px * layer.pixel_m]
        else:
            east += [place[0] for shape in layer.shapes for place in shape]
            north += [place[1] for shape in layer.shapes for place in shape]
    if not east:
        raise ValueError("a map without a picture or a shape")
    return min(east), min(north), max(east), max(north)


def map_view(survey_map: SurveyMap) -> str:
    """The map's place on the page: what moves, its controls, and the still for print."""
    layers = survey_map.layers
    bases = [layer for layer in layers if isinstance(layer, PictureLayer) and layer.base]
    overlays = [layer for layer in layers if layer not in bases]
    whole = (
        '<svg width="18" height="18" viewBox="0 0 18 18" fill="none" stroke="currentColor" '
        'stroke-width="1.8" aria-hidden="true"><path d="M2 6V2h4M12 2h4v4M16 12v4h-4M6 16H2v-4"/>'
        "</svg>"
    )
    tools = "".join(
        f'<button type="button" data-act="{act}" title="{label}" aria-label="{label}">{face}'
        "</button>"
        for act, label, face in (
            ("in", "Zoom in", "+"),
            ("out", "Zoom out", "−"),
            ("all", "Show all", whole),
        )
    )
    groups = [
        _group("Picture", [_choice("radio", layer) for layer in bases]),
        _group("Over it", [_choice("checkbox", layer) for layer in overlays]),
    ]
    legends = "".join(
        _legend(layer.scale, f'id="legend-{escape(layer.name)}" hidden', layer.title)
        for layer in layers
        if isinstance(layer, PictureLayer) and layer.scale is not None
    )
    return (
        '<div class="scene map"><div class="live" id="map" hidden><div class="view">'
        '<div id="map-canvas" role="application" aria-label="Map of the survey: arrow keys move '
        'it, + and - zoom, 0 shows all, Enter tells what is in the middle"></div>'
        f'<div class="tools" role="group" aria-label="Zoom the map">{tools}</div>'
        '<div class="bar" aria-hidden="true"><span></span></div>'
        '<p class="readout" id="map-readout"></p></div>'
        f'<div class="side">{"".join(groups)}<div id="map-legends">{legends}</div>'
        f'<p class="hint">{escape(survey_map.origin)}</p><p class="hint">Drag to move. Click the '
        "map, then turn the wheel or use + and - to zoom. Click a line or a point to learn more."
        "</p></div></div>"
        f'<div class="still">{_still(survey_map)}</div></div>'
    )


def _packed(tiles: Mapping[str, bytes]) -> tuple[dict[str, list[Any]], str]:
    """Where each tile lies in the text of all, and that text."""
    found: dict[str, list[Any]] = {}
    texts: list[str] = []
    at = 0
    for name in sorted(tiles):
        text = base64.b64encode(tiles[name]).decode("ascii")
        found[name] = [at, len(text), picture_kind(tiles[name])]
        texts.append(text)
        at += len(text)
    return found, "".join(texts)


def picture_kind(content: bytes) -> str:
    """The subtype of a picture, by its first bytes.

    Raises:
        ValueError: it is no JPEG, PNG or WebP.
    """
    if content.startswith(b"\xff\xd8\xff"):
        return "jpeg"
    if content.startswith(b"\x89PNG\r\n\x1a\n"):
        return "png"
    if content[:4] == b"RIFF" and content[8:12] == b"WEBP":
        return "webp"
    raise ValueError("a tile of the map is no JPEG, PNG or WebP")


def _picture(layer: PictureLayer) -> dict[str, Any]:
    return {
        "kind": "picture",
        "name": layer.name,
        "west": layer.west_m,
        "north": layer.north_m,
        "pixel": layer.pixel_m,
        "width": layer.width_px,
        "height": layer.height_px,
        "tile": layer.tile_px,
        "levels": layer.levels,
        "base": layer.base,
        **({} if layer.sizes is None else {"sizes": [list(size) for size in layer.sizes]}),
    }


def _shapes(layer: ShapeLayer) -> dict[str, Any]:
    if layer.texts and len(layer.texts) != len(layer.shapes):
        raise ValueError(f"{layer.name}: {len(layer.texts)} texts for {len(layer.shapes)} shapes")
    return {
        "kind": layer.kind,
        "name": layer.name,
        "title": layer.title,
        "colour": layer.colour,
        "dashed": layer.dashed,
        "shapes": [
            [[_short(east), _short(north)] for east, north in shape] for shape in layer.shapes
        ],
        "texts": list(layer.texts),
    }


def _short(value: float) -> float:
    """Seven digits: a tenth of a millimetre on a kilometre."""
    return float(f"{value:.7g}")


def _group(title: str, choices: Sequence[str]) -> str:
    if not choices:
        return ""
    return f"<fieldset><legend>{title}</legend>{''.join(choices)}</fieldset>"


def _choice(kind: str, layer: PictureLayer | ShapeLayer) -> str:
    name = escape(layer.name)
    group = ' name="map-base"' if kind == "radio" else ""
    checked = " checked" if layer.shown else ""
    return (
        f'<div class="choice"><label><input type="{kind}"{group} value="{name}"{checked} '
        f'aria-describedby="about-{name}">{_key(layer)}{escape(layer.title)}</label>'
        f'<small id="about-{name}">{escape(layer.about)}</small></div>'
    )


def _key(layer: PictureLayer | ShapeLayer) -> str:
    """A small drawing of how the layer looks."""
    if isinstance(layer, PictureLayer):
        return ""
    colour = escape(layer.colour)
    dashes = ' stroke-dasharray="5 3"' if layer.dashed else ""
    if layer.kind == "point":
        drawn = f'<circle cx="11" cy="7" r="4.5" fill="{colour}" stroke="#fff"/>'
    elif layer.kind == "polygon":
        drawn = (
            f'<rect x="2" y="2" width="18" height="10" fill="{colour}" fill-opacity=".12" '
            f'stroke="{colour}" stroke-width="1.8"{dashes}/>'
        )
    else:
        drawn = f'<path d="M1 7h20" stroke="{colour}" stroke-width="2.6"{dashes}/>'
    return (
        '<svg class="key" width="22" height="14" viewBox="0 0 22 14" aria-hidden="true">'
        f"{drawn}</svg>"
    )


def _legend(scale: Scale | None, attributes: str, title: str) -> str:
    """Colours with three of their values."""
    if scale is None:
        return ""
    slices = "".join(
        f'<rect x="{index}" width="1.02" height="1" fill="{escape(colour)}"/>'
        for index, colour in enumerate(scale.colours)
    )
    values = "".join(
        f"<span>{value:.4g}</span>".replace("-", "−")
        for value in (scale.low, (scale.low + scale.high) / 2, scale.high)
    )
    return (
        f'<div class="legend" {attributes}><p>{escape(scale.label)}</p>'
        f'<svg viewBox="0 0 {len(scale.colours)} 1" preserveAspectRatio="none" role="img" '
        f'aria-label="Colours of {escape(title)}, {scale.low:.4g} to {scale.high:.4g}">'
        f'{slices}</svg><div class="values">{values}</div></div>'
    )


def _still(survey_map: SurveyMap) -> str:
    """All layers that are shown from the start, as one drawing with its key."""
    west, south, east, north = map_extent(survey_map)
    margin = _MARGIN * max(east - west, north - south)
    west, south, east, north = west - margin, south - margin, east + margin, north + margin
    px_per_m = _STILL_PX / max(east - west, north - south)
    width, height = (east - west) * px_per_m, (north - south) * px_per_m

    def place(east_m: float, north_m: float) -> tuple[float, float]:
        return (east_m - west) * px_per_m, (north - north_m) * px_per_m

    shown = [layer for layer in survey_map.layers if layer.shown]
    drawn = [
        _still_picture(layer, place, px_per_m)
        for layer in sorted(
            (layer for layer in shown if isinstance(layer, PictureLayer)),
            key=lambda layer: not layer.base,
        )
    ]
    order = ("polygon", "line", "point")
    shapes = [layer for layer in shown if isinstance(layer, ShapeLayer)]
    drawn += [
        _still_shapes(layer, place) for layer in sorted(shapes, key=lambda a: order.index(a.kind))
    ]
    keys = "".join(f"<li>{_key(layer)}{escape(layer.title)}</li>" for layer in shapes)
    legends = "".join(
        _legend(layer.scale, "", layer.title) for layer in shown if isinstance(layer, PictureLayer)
    )
    length = round_length(0.25 * (east - west))
    bar = length * px_per_m
    titles = ", ".join(layer.title for layer in shown)
    return (
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="Map, north up: '
        f'{escape(titles)}">{"".join(drawn)}'
        f'<g transform="translate(24 {height - 30:.0f})"><rect x="-10" y="-30" '
        f'width="{max(bar + 20, 110):.0f}" height="48" fill="#fff" fill-opacity=".85"/>'
        f'<path d="M0 0v8h{bar:.1f}v-8" fill="none" stroke="#1f2d36" stroke-width="2.5"/>'
        f'<text y="-8" font-size="20" fill="#1f2d36">{length:g} {escape(survey_map.unit)}</text>'
        f'</g></svg><ul class="keys">{keys}</ul>{legends}<p class="hint">North is up. '
        f"{escape(survey_map.origin)}</p>"
    )


def _still_picture(layer: PictureLayer, place: Any, px_per_m: float) -> str:
    """The level that comes closest to the still's own resolution, from above."""
    wanted = math.ceil(math.log2(max(1.0, layer.pixel_m * px_per_m * 2 ** (layer.levels - 1))))
    level = min(layer.levels - 1, wanted)
    columns, rows, east_m, north_m = layer.size(level)
    images = []
    for row in range(-(-rows // layer.tile_px)):
        for column in range(-(-columns // layer.tile_px)):
            address = _tile_address(layer, f"{level}/{column}/{row}")
            if address is None:
                continue
            left, top = column * layer.tile_px, row * layer.tile_px
            x, y = place(layer.west_m + left * east_m, layer.north_m - top * north_m)
            width = min(layer.tile_px, columns - left) * east_m * px_per_m
            height = min(layer.tile_px, rows - top) * north_m * px_per_m
            # A little over its border, so that no seam shows.
            images.append(
                f'<image x="{x:.2f}" y="{y:.2f}" width="{width + 0.4:.2f}" '
                f'height="{height + 0.4:.2f}" preserveAspectRatio="none" href="{address}"/>'
            )
    return "".join(images)


def _tile_address(layer: PictureLayer, name: str) -> str | None:
    """Where a page finds a tile, or in what it carries it; None where nothing is."""
    if layer.address is not None:
        return escape(layer.address.replace("{}", name))
    content = layer.tiles.get(name)
    if content is None:
        return None
    return f"data:image/{picture_kind(content)};base64,{base64.b64encode(content).decode('ascii')}"


def _still_shapes(layer: ShapeLayer, place: Any) -> str:
    colour = escape(layer.colour)
    if layer.kind == "point":
        circles = "".join(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5"/>'
            for x, y in (place(*shape[0]) for shape in layer.shapes)
        )
        return f'<g fill="{colour}" stroke="#fff" stroke-width="1.5">{circles}</g>'
    closing = "Z" if layer.kind == "polygon" else ""
    path = "".join(
        "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in (place(*spot) for spot in shape)) + closing
        for shape in layer.shapes
    )
    dashes = ' stroke-dasharray="10 6"' if layer.dashed else ""
    width = 2 if layer.kind == "polygon" else 3
    casing = (
        f'<path d="{path}" stroke="#fff" stroke-opacity=".8" stroke-width="{width + 3}"/>'
        if layer.kind == "line" or len(layer.shapes) <= _RIMMED
        else ""
    )
    return (
        f'<g fill="none" stroke-linejoin="round">{casing}<path d="{path}" stroke="{colour}" '
        f'stroke-width="{width}"{dashes}/></g>'
    )


def round_length(length: float) -> float:
    """The greatest of 1, 2 and 5 times a power of ten that is not above a length."""
    power = 10.0 ** math.floor(math.log10(length))
    return next(step * power for step in (5, 2, 1) if step * power <= length * (1 + 1e-9))
