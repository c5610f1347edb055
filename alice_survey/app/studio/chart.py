"""A chart of the user's own under a survey: how its values are coloured, and where it lies."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rasterio
from rasterio.crs import CRS
from rasterio.errors import RasterioError

from alice_survey.app.report.colours import Numbers
from alice_survey.core.contents import one_line
from alice_survey.core.errors import WorkspaceError
from alice_survey.core.frames import Array
from alice_survey.core.records import PlaceRecord
from alice_survey.kit.document import ShapeLayer
from missions.areas.bathymetry import check_raster, read_bathymetry
from missions.plan.page_map import contour_layer
from reconstruct.raster import local_crs
from reconstruct.views.model import datum_of

CHART = "chart"
"""Name of its layer."""
CHART_TITLE = "Chart"
_CONTOUR_DETAIL = 1000
"""Parts of the width of a survey below which a bend of a contour is left out."""


def check_chart(path: Path) -> Path:
    """A chart that can be shown.

    Args:
        path: a GeoTIFF, BAG or other raster with a coordinate system.

    Raises:
        WorkspaceError: it cannot be read, names no coordinate system, or is a description of
            other files.
    """
    try:
        check_raster(path)
        with rasterio.open(path) as raster:
            if raster.crs is None:
                raise WorkspaceError(
                    f"{path}: names no coordinate system: give it one (gdal_edit.py -a_srs)"
                )
            rows, columns = raster.block_shapes[0]
            if raster.count == 1 and _has_palette(raster):
                raise WorkspaceError(
                    f"{path}: its colours are a palette: make it a picture "
                    "(gdal_translate -expand rgba)"
                )
    except RasterioError as error:
        raise WorkspaceError(f"{path}: cannot be read as a raster: {one_line(error)}") from None
    if rows * columns > 1 << 24:
        raise WorkspaceError(
            f"{path}: is stored in blocks of {columns} x {rows} cells, too large to read: store it "
            "in tiles (gdal_translate -co TILED=YES)"
        )
    return path.resolve()


def _has_palette(raster: rasterio.DatasetReader) -> bool:
    return bool(raster.colorinterp[0].name == "palette")


def chart_numbers(path: Path) -> Numbers | None:
    """How its values are coloured; None for a picture in its own colours."""
    with rasterio.open(path) as raster:
        if raster.count >= 3:
            return None
        unit = raster.units[0] or "m"
    return Numbers(
        file=path.name, name=CHART, title=CHART_TITLE, about=f"{path.name}, shaded.",
        palette="viridis", limits=_middle, label=f"{path.name}, {unit}", shaded=True,
    )  # fmt: skip


def _middle(values: Array) -> tuple[float, float]:
    low, high = np.percentile(values, [2, 98])
    return float(low), float(max(high, low + 1e-9))


def contours_of(
    path: Path, place: PlaceRecord, extent: tuple[float, float, float, float]
) -> Iterator[ShapeLayer]:
    """Lines of equal depth of a chart around a survey; none of a picture.

    Args:
        path: of the chart.
        place: datum of the survey.
        extent: west, south, east and north of the survey, m.

    Raises:
        PlanError: its values cannot be taken for depths; the line says why.
    """
    if chart_numbers(path) is None:
        return
    west, south, east, north = extent
    around = max(east - west, north - south)
    box = south - around, west - around, north + around, east + around
    bathymetry = read_bathymetry(path, datum_of(place), bounds_ne=box)
    yield from contour_layer(bathymetry, box, around / _CONTOUR_DETAIL)


def chart_crs(place: PlaceRecord) -> CRS:
    """The system of a survey's map, that its chart is warped to."""
    return local_crs(datum_of(place))


_TILES = re.compile(r"(https?://[a-z0-9.-]+(?::[0-9]{1,5})?)/[A-Za-z0-9/._~{}?=&%+-]*")
"""Address of tiles; no character that could end a content security policy's source."""


def server_of(background: str) -> str:
    """Scheme, host and port of a web map's tiles.

    Args:
        background: their address, with {z}, {x} and {y}.

    Raises:
        WorkspaceError: it is none.
    """
    found = _TILES.fullmatch(background)
    parts = re.findall(r"\{.*?\}", background)
    if found is None or sorted(parts) != ["{x}", "{y}", "{z}"]:
        raise WorkspaceError(
            f"--background {background}: give the address of tiles, such as "
            "https://tiles.example.org/{z}/{x}/{y}.png"
        )
    return found.group(1)
