"""Grids and GeoTIFFs over the local east-north plane, and pictures of a surface.

Rasters of the `ned` frame carry an azimuthal equidistant projection centred on the datum. In it
north and east of the NED frame are the map's axes, true to scale: within 1 km of the datum the
tangent plane and the map differ by under 0.01 mm. UTM would turn the grid by the convergence of
its meridian and stretch it by up to 0.04 % (0.4 mm a metre), so that either every height is
resampled or lengths are wrong; any GIS reprojects on the fly.

QGIS takes layer styles (.qml) next to rasters when it opens them.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from pyproj.crs import ProjectedCRS
from pyproj.crs.coordinate_operation import AzimuthalEquidistantConversion
from rasterio.crs import CRS
from rasterio.transform import Affine
from rasterio.windows import Window

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.contents import one_line
from alice_survey.core.errors import WorkspaceError
from alice_survey.core.frames import Array, Datum
from alice_survey.core.run import progress
from reconstruct.views.model import WorldFrame

BLOCK = 256
"""Pixels a side of the blocks of a tiled TIFF."""
_CACHE_MIB = 16
_SHARES = (1.0, 99.0)
"""Percentiles at the ends of a ramp of colours."""


@dataclass(frozen=True, kw_only=True)
class DemGrid:
    """Square cells in rows from north to south, columns from west to east.

    In the `model` frame "north" and "east" are the first and second axis of the model.
    """

    west: float
    """East coordinate of the outer edge of the first column."""
    north: float
    """North coordinate of the outer edge of the first row."""
    cell: float
    rows: int
    columns: int

    def east_of(self, column: NDArray[Any] | float) -> Array:
        """East coordinate of a position in columns; cell centres are at n + 0.5."""
        return np.asarray(self.west + np.asarray(column) * self.cell)

    def north_of(self, row: NDArray[Any] | float) -> Array:
        """North coordinate of a position in rows; cell centres are at n + 0.5."""
        return np.asarray(self.north - np.asarray(row) * self.cell)

    def window(self, row: int, column: int, rows: int, columns: int) -> "DemGrid":
        """A part of the grid, clipped to it only where the caller does."""
        moved = self.translate(column * self.cell, -row * self.cell)
        return replace(moved, rows=rows, columns=columns)

    def translate(self, east: float, north: float) -> "DemGrid":
        """The same cells, in coordinates in which they lie elsewhere."""
        return replace(self, west=self.west + east, north=self.north + north)


def grid_over(bounds: Sequence[tuple[float, float, float, float]], cell: float) -> DemGrid:
    """The grid, aligned to whole cells, that covers boxes of (south, west, north, east)."""
    boxes = np.array(bounds)
    south, west = np.floor(boxes[:, :2].min(axis=0) / cell)
    north, east = np.ceil(boxes[:, 2:].max(axis=0) / cell)
    return DemGrid(
        west=float(west * cell),
        north=float(north * cell),
        cell=cell,
        rows=int(north - south),
        columns=int(east - west),
    )


def round_cell(length: float) -> float:
    """Round a length to two significant digits, for cells that people can name."""
    digits = 1 - math.floor(math.log10(length))
    return round(length, digits)


def local_crs(datum: Datum) -> CRS:
    """The projection whose east and north are those of the NED frame of a datum."""
    method = AzimuthalEquidistantConversion(
        latitude_natural_origin=datum.latitude_deg, longitude_natural_origin=datum.longitude_deg
    )
    crs = ProjectedCRS(method, name="Local east and north of the survey's datum", geodetic_crs=4326)
    return CRS.from_wkt(crs.to_wkt())


def crs_of(frame: WorldFrame) -> CRS | None:
    """The projection of rasters of a frame; None in those of a model and of a plane."""
    return None if frame.name != "ned" or frame.datum is None else local_crs(frame.datum)


def transform_of(grid: DemGrid) -> Affine:
    """Map coordinates (east, north) from (column, row)."""
    return Affine(grid.cell, 0.0, grid.west, 0.0, -grid.cell, grid.north)


def frame_tags(frame: WorldFrame) -> dict[str, str]:
    """What a raster says about its frame."""
    tags = {
        "FRAME": frame.name,
        "UNIT": frame.unit,
        "VERTICAL_DATUM": frame.vertical_datum,
        "AREA_OR_POINT": "Area",
    }
    if frame.notes:
        tags["NOTES"] = "; ".join(frame.notes)
    return tags | dict(frame.tags)


def geotiff_profile(grid: DemGrid, frame: WorldFrame, threads: int) -> dict[str, Any]:
    """What all tiled GeoTIFFs of a grid share; parts that nobody writes take no room."""
    return {
        "driver": "GTiff",
        "width": grid.columns,
        "height": grid.rows,
        "crs": crs_of(frame),
        "transform": transform_of(grid),
        "tiled": True,
        "blockxsize": BLOCK,
        "blockysize": BLOCK,
        "compress": "deflate",
        "bigtiff": "if_safer",
        "sparse_ok": True,
        "num_threads": threads,
    }


@contextmanager
def tiled_raster(
    path: Path,
    grid: DemGrid,
    frame: WorldFrame,
    dtype: str,
    nodata: float | None,
    text: str,
    unit: str = "",
    threads: int = 1,
) -> Iterator[Any]:
    """A one-band tiled GeoTIFF to write to, window by window; others are unknown and take no room.

    Args:
        path: of the file.
        grid: cells.
        frame: that the grid lies in.
        dtype: of the band.
        nodata: value of unknown cells.
        text: what the band holds.
        unit: of its values; none of numbers.
        threads: that compress; the file is the same for any number.
    """
    profile = geotiff_profile(grid, frame, threads)
    profile |= {"count": 1, "dtype": dtype, "nodata": nodata}
    profile |= {"predictor": 3 if dtype.startswith("float") else 2}
    with rasterio.open(path, "w", **profile) as raster:
        raster.update_tags(**frame_tags(frame))
        raster.set_band_description(1, text)
        raster.set_band_unit(1, unit)
        yield raster


@contextmanager
def small_cache(mib: int = _CACHE_MIB) -> Iterator[None]:
    """Within this block, or a task that it decorates, GDAL keeps little of the files it opens.

    Its own choice is 5 % of the machine's memory in each process.
    """
    with rasterio.Env(GDAL_CACHEMAX=mib << 20):
        yield


@contextmanager
def opened_raster(path: Path) -> Iterator[Any]:
    """A GeoTIFF of a workspace, to read from.

    Raises:
        WorkspaceError: it is missing or damaged.
    """
    if not path.is_file():
        raise WorkspaceError(f"{path}: no such file")
    try:
        with rasterio.open(path, driver="GTiff") as raster:
            yield raster
    except (rasterio.errors.RasterioError, MemoryError) as error:
        raise WorkspaceError(
            f"{path}: is damaged ({one_line(error)}): delete it and run its stage again"
        ) from None


def grid_of(path: Path) -> DemGrid:
    """The cells of a raster."""
    with opened_raster(path) as raster:
        return DemGrid(
            west=float(raster.transform.c), north=float(raster.transform.f),
            cell=float(raster.transform.a), rows=raster.height, columns=raster.width,
        )  # fmt: skip


@small_cache()
def read_cells(path: Path, row: int, column: int, rows: int, columns: int, every: int = 1) -> Array:
    """Cells of a window of a raster's first band, (rows // every, columns // every).

    Those beyond the raster are NaN.

    Args:
        path: of the raster.
        row: first row, which may lie beyond the raster.
        column: first column.
        rows: of the window.
        columns: of the window.
        every: reads every so many-th cell only, the nearest to the middle of each square.
    """
    found = np.full((rows // every, columns // every), np.nan)
    with opened_raster(path) as raster:
        # squares of which all cells are within the raster
        top, left = (-(-max(0, -first) // every) for first in (row, column))
        bottom = min(rows, raster.height - row) // every
        right = min(columns, raster.width - column) // every
        if bottom > top and right > left:
            shape = (bottom - top, right - left)
            part = Window(
                column + left * every, row + top * every, shape[1] * every, shape[0] * every
            )
            found[top:bottom, left:right] = raster.read(1, window=part, out_shape=shape)
    return found


def tiles_of(grid: DemGrid, size: int) -> list[Window]:
    """Windows of a grid, row by row; a multiple of `BLOCK` as size fits the blocks of files."""
    return tiles_of_shape(grid.rows, grid.columns, size)


def tiles_of_shape(rows: int, columns: int, size: int) -> list[Window]:
    """The same of a raster of so many rows and columns."""
    return [
        Window(column, row, min(size, columns - column), min(size, rows - row))
        for row in range(0, rows, size)
        for column in range(0, columns, size)
    ]


def tiles_reached(
    grid: DemGrid, size: int, boxes: Array, margin: float
) -> list[tuple[Window, list[int]]]:
    """Windows of `tiles_of` that boxes reach, row by row, each with the numbers of its boxes.

    Args:
        grid: of the tiles.
        size: of a tile, in cells.
        boxes: (B, 4) west, south, east, north; a row of NaN reaches nothing.
        margin: around the boxes.
    """
    side = size * grid.cell
    edges = np.stack([boxes[:, 0], -boxes[:, 3], boxes[:, 2], -boxes[:, 1]], axis=1)
    edges += np.array([-1.0, -1.0, 1.0, 1.0]) * margin - np.array([grid.west, -grid.north] * 2)
    maximum = np.array([-(-grid.columns // size), -(-grid.rows // size)] * 2) - 1
    spans = np.floor(edges / side)
    known = np.isfinite(spans).all(axis=1) & (spans[:, 2:] >= 0).all(axis=1)
    known &= (spans[:, :2] <= maximum[:2]).all(axis=1)
    reached: dict[tuple[int, int], list[int]] = {}
    for number in np.flatnonzero(known).tolist():
        left, top, right, bottom = np.clip(spans[number], 0, maximum).astype(int).tolist()
        for tile in product(range(top, bottom + 1), range(left, right + 1)):
            reached.setdefault(tile, []).append(number)
    tiles = tiles_of(grid, size)
    return [
        (tiles[row * (int(maximum[0]) + 1) + column], numbers)
        for (row, column), numbers in sorted(reached.items())
    ]


def hillshade(height: Array, cell: float) -> Array:
    """Shade (0 to 1) of a surface lit from the north-west, 45 degrees up; NaN stays NaN."""
    down, right = np.gradient(height, cell)
    normal = np.stack([-right, down, np.ones_like(height)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    light = np.array([-0.5, 0.5, np.sqrt(0.5)])
    return np.asarray(np.clip(normal @ light, 0.0, 1.0))


@progress.step("draw the surface")
def preview_dem(dem: Path, picture: Path, max_px: int = 1600) -> None:
    """Write a shaded, coloured picture of a DEM; what is unknown is white."""
    with opened_raster(dem) as raster:
        shrink = max(1.0, max(raster.width, raster.height) / max_px)
        shape = (max(2, int(raster.height / shrink)), max(2, int(raster.width / shrink)))
        resampling = rasterio.enums.Resampling.average
        height = raster.read(1, out_shape=shape, resampling=resampling).astype(np.float64)
        cell = raster.transform.a * raster.width / shape[1]
    known = np.isfinite(height)
    low, high = np.percentile(height[known], _SHARES) if known.any() else (0.0, 1.0)
    level = np.nan_to_num(np.clip((height - low) / max(high - low, 1e-9), 0, 1))
    tint = cv2.applyColorMap((level * 255).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    shade = np.nan_to_num(hillshade(height, cell), nan=np.sqrt(0.5))
    lit = np.clip(tint * (0.25 + 1.05 * shade[..., None]), 0, 255)
    write_png(picture, np.where(known[..., None], lit, 255).astype(np.uint8))


def write_png(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write a BGR or BGRA picture; the same pixels give the same bytes."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(cv2.imencode(".png", picture)[1].tobytes())


_COLOURS = 5
_SAMPLE = 1024


def write_style(raster: Path, palette: str, unit: str) -> None:
    """Write the style of a raster's first band: a colour ramp over its own range of values.

    Args:
        raster: a GeoTIFF.
        palette: of matplotlib.
        unit: for the labels.
    """
    from alice_survey.kit.figure import palette_steps  # here, for matplotlib

    with opened_raster(raster) as file:
        shape = tuple(min(side, _SAMPLE) for side in file.shape)
        values = file.read(1, out_shape=shape, resampling=rasterio.enums.Resampling.nearest)
    values = values[np.isfinite(values)]
    low, high = np.percentile(values, _SHARES) if values.size else (0.0, 1.0)
    high = max(float(high), float(low) + 1e-6)
    stops = np.linspace(low, high, _COLOURS).tolist()
    items = "\n".join(
        f'<item value="{value:.6g}" color="{colour}" alpha="255" '
        f'label="{value:.3g} {escape(unit)}"/>'
        for value, colour in zip(stops, palette_steps(palette, _COLOURS), strict=True)
    )
    with atomic_path(raster.with_suffix(".qml")) as path:
        path.write_text(
            '<qgis version="3.28" styleCategories="Symbology"><pipe>\n'
            '<rasterrenderer type="singlebandpseudocolor" band="1" opacity="1" alphaBand="-1" '
            f'classificationMin="{low:.6g}" classificationMax="{high:.6g}">\n'
            '<rastershader><colorrampshader colorRampType="INTERPOLATED" classificationMode="1" '
            f'clip="0" minimumValue="{low:.6g}" maximumValue="{high:.6g}">\n'
            f"{items}\n"
            "</colorrampshader></rastershader></rasterrenderer></pipe></qgis>\n"
        )
