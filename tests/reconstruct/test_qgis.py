from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import rasterio

from reconstruct.raster import DemGrid, tiled_raster, write_style
from tests.oracles_dense import FRAME

GRID = DemGrid(west=0.0, north=3.0, cell=0.1, rows=30, columns=40)


def write(path: Path, values: np.ndarray) -> Path:
    with tiled_raster(path, GRID, FRAME, "float32", np.nan, "height", "m") as raster:
        raster.write(values.astype(np.float32), 1)
    return path


def test_the_ramp_spans_the_values_without_their_tails(tmp_path: Path):
    values = np.random.default_rng(1).normal(-12.0, 0.2, (30, 40))
    values[:5] = np.nan
    values[9, 9] = 500.0
    path = write(tmp_path / "dem.tif", values)
    write_style(path, "viridis", "m")
    root = ET.parse(tmp_path / "dem.qml").getroot()  # noqa: S314 - our own file
    assert root.tag == "qgis"
    shader = root.find("pipe/rasterrenderer/rastershader/colorrampshader")
    assert shader is not None
    stops = [float(item.get("value", "nan")) for item in shader]
    assert stops == sorted(stops)
    known = values[np.isfinite(values)]
    assert stops[0] == pytest.approx(np.percentile(known, 1), abs=0.01)
    assert stops[-1] == pytest.approx(np.percentile(known, 99), abs=0.01)
    assert all(item.get("label", "").endswith(" m") for item in shader)
    with rasterio.open(path) as raster:
        assert raster.units == ("m",)
