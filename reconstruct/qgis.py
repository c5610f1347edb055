"""QGIS layer styles (.qml) beside rasters, which QGIS takes when it opens them."""

from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import rasterio

from alice_survey.core.artefacts import atomic_path
from alice_survey.kit.figure import palette_steps
from reconstruct.raster import opened_raster

_COLOURS = 5
_SHARES = (1.0, 99.0)
"""Percentiles at the ends of a ramp."""
_SAMPLE = 1024


def write_style(raster: Path, palette: str, unit: str) -> None:
    """Write the style of a raster's first band: a colour ramp over its own range of values.

    Args:
        raster: a GeoTIFF.
        palette: of matplotlib.
        unit: for the labels.
    """
    with opened_raster(raster) as file:
        shape = tuple(min(side, _SAMPLE) for side in file.shape)
        values = file.read(1, out_shape=shape, resampling=rasterio.enums.Resampling.nearest)
    values = values[np.isfinite(values)]
    low, high = np.percentile(values, _SHARES) if values.size else (0.0, 1.0)
    high = max(float(high), float(low) + 1e-6)
    stops = zip(
        np.linspace(low, high, _COLOURS).tolist(), palette_steps(palette, _COLOURS), strict=True
    )
    root = ET.Element("qgis", version="3.28", styleCategories="Symbology")
    renderer = ET.SubElement(
        ET.SubElement(root, "pipe"), "rasterrenderer", type="singlebandpseudocolor", band="1",
        opacity="1", alphaBand="-1",
        classificationMin=f"{low:.6g}", classificationMax=f"{high:.6g}",
    )  # fmt: skip
    shader = ET.SubElement(
        ET.SubElement(renderer, "rastershader"), "colorrampshader",
        colorRampType="INTERPOLATED", classificationMode="1", clip="0",
        minimumValue=f"{low:.6g}", maximumValue=f"{high:.6g}",
    )  # fmt: skip
    for value, colour in stops:
        ET.SubElement(
            shader, "item", value=f"{value:.6g}", color=colour, alpha="255",
            label=f"{value:.3g} {unit}",
        )  # fmt: skip
    ET.indent(root)
    with atomic_path(raster.with_suffix(".qml")) as path:
        path.write_text(ET.tostring(root, encoding="unicode") + "\n")
