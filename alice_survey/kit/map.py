"""The data of a page's interactive map."""

import base64
import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from alice_survey.core.frames import Array
from alice_survey.kit.document import PictureLayer, ShapeLayer, SurveyMap


def even_limit(values: Array) -> float:
    """Limit of a colour scale about zero that includes 97 % of the values; NaNs do not count."""
    known = np.abs(values[np.isfinite(values)])
    return max(float(np.percentile(known, 97.0)), 1e-9) if len(known) else 1.0


def map_data(survey_map: SurveyMap) -> tuple[str, list[tuple[str, str]]]:
    """Data from which the page's script draws the map.

    The tiles of a layer are one text, so that each is decoded only when it is looked at.

    Returns:
        JSON without a `<`, since within a script only "</" and "<!--" could end or change it, and
        the tiles of each layer as (id, base64 text).
    """
    described: list[dict[str, Any]] = []
    tiles: list[tuple[str, str]] = []
    for index, layer in enumerate(survey_map.layers):
        if isinstance(layer, ShapeLayer):
            described.append(_shapes(layer))
        elif layer.address is not None:
            described.append(picture_json(layer) | {"address": layer.address})
        else:
            found, text = _pack_tiles(layer.tiles)
            described.append(picture_json(layer) | {"block": f"tiles-{index}", "tiles": found})
            tiles.append((f"tiles-{index}", text))
    data = {
        "unit": survey_map.unit,
        "axes": list(survey_map.axes),
        "extent": [_short(value) for value in map_extent(survey_map)],
        "layers": described,
    }
    held = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return held, tiles


def map_extent(survey_map: SurveyMap) -> tuple[float, float, float, float]:
    """West, south, east and north limits of what is shown at first, on the map's own axes.

    Raises:
        ValueError: nothing is on the map.
    """
    east: list[float] = []
    north: list[float] = []
    for layer in [one for one in survey_map.layers if one.shown] or survey_map.layers:
        if isinstance(layer, PictureLayer):
            east += [layer.west_m, layer.west_m + layer.width_px * layer.pixel_m]
            north += [layer.north_m, layer.north_m - layer.height_px * layer.pixel_m]
        else:
            east += [place[0] for shape in layer.shapes for place in shape]
            north += [place[1] for shape in layer.shapes for place in shape]
    if not east:
        raise ValueError("a map without a picture or a shape")
    return min(east), min(north), max(east), max(north)


def _pack_tiles(tiles: Mapping[str, bytes]) -> tuple[dict[str, list[int]], str]:
    """Where each tile lies in the text of all, and that text."""
    found: dict[str, list[int]] = {}
    texts: list[str] = []
    at = 0
    for name in sorted(tiles):
        text = base64.b64encode(tiles[name]).decode("ascii")
        found[name] = [at, len(text)]
        texts.append(text)
        at += len(text)
    return found, "".join(texts)


def picture_json(layer: PictureLayer) -> dict[str, Any]:
    """A raster as the map's script takes it."""
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
        "sizes": layer.sizes,
    }


def _shapes(layer: ShapeLayer) -> dict[str, Any]:
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


def round_length(length: float) -> float:
    """The greatest of 1, 2 and 5 times a power of ten that is not above a length."""
    power = 10.0 ** math.floor(math.log10(length))
    return next(step * power for step in (5, 2, 1) if step * power <= length * (1 + 1e-9))
