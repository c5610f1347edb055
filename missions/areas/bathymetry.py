"""Depth of the sea floor from a raster.

A bathymetric attributed grid (BAG), a GeoTIFF, or any other that GDAL reads, in any coordinate
system; only the part that is needed is read.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import shapely
from shapely.geometry import MultiPolygon

from alice_survey.core.contents import UNKNOWN, one_line, where_unknown
from alice_survey.core.errors import PlanError, file_faults, warn
from alice_survey.core.frames import Array, Datum

Sense = Literal["auto", "heights", "depths"]
"""What a raster's values are: heights positive up, or depths positive down."""
_MAX_CELLS = 16_000_000
"""Read at once: 128 MB."""
_LOOKED_AT = 4096
_EMPTIEST = 5
"""Cells a byte of a table of points: with some 10 bytes a row, one cell in 50 has a value."""
_PAD_CELLS = 2
_SAME_CELL = 1e-6
"""A place so near a centre, in cells, is on it."""
_EDGE_POINTS = 128
"""Points round the bounds, whose straight sides are curves in the raster."""
_ONE_SIGN = 0.99
"""Share of cells of one sign from which a raster without a word on it is taken to be of that sign.
"""
_MAX_SAMPLES = 1_000_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Bathymetry:
    """Depths at the centres of a raster's cells, in its own coordinate system."""

    name: str
    """Name of the file."""
    datum: Datum
    """Origin of the local frame."""
    crs: str
    """WKT of the raster's horizontal coordinate system."""
    from_pixel: tuple[float, float, float, float, float, float]
    """(a, b, c, d, e, f): x = a col + b row + c and y = d col + e row + f, where (0.5, 0.5) is the
    centre of the first cell."""
    depth_m: Array
    """(rows, columns) below the vertical datum, positive down; NaN where it is not known."""

    @cached_property
    def cell_m(self) -> float:
        """Longer side of a cell in the middle of the raster."""
        rows, columns = self.depth_m.shape
        middle = np.array([columns / 2, rows / 2])
        corners = middle + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        ne = self._ne_from_pixel(corners)
        return float(max(math.dist(ne[0], ne[1]), math.dist(ne[0], ne[2])))

    @cached_property
    def known_m(self) -> Array:
        """(K,) all depths that are known."""
        depths: Array = self.depth_m.ravel()
        return np.extract(np.isfinite(depths), depths)

    def depth_at(self, points_ne: Array) -> Array:
        """Depth, (...), at places (..., 2), bilinear between the centres of cells.

        NaN beyond the outermost centres, and where a cell that counts is not known.
        """
        points = np.asarray(points_ne, dtype=np.float64)
        pixel = self._pixel_from_ne(points.reshape(-1, 2))
        return self._depth_of_pixel(pixel).reshape(points.shape[:-1])

    def depth_about(self, points_ne: Array, offsets_ne: Array) -> Array:
        """Depth, (N, M), at short offsets (N, M, 2) from places (N, 2), both metres.

        As `depth_at`, but the raster's frame is taken to be straight over the offsets: its scale
        and direction are those in the middle of the places, true to 1e-4 of an offset over some
        kilometres.
        """
        _, per_metre = self._pixels_about((points_ne.min(axis=0) + points_ne.max(axis=0)) / 2)
        pixel = self._pixel_from_ne(points_ne)[:, None] + offsets_ne @ per_metre
        return self._depth_of_pixel(pixel.reshape(-1, 2)).reshape(offsets_ne.shape[:-1])

    def depth_everywhere(self, points_ne: Array) -> Array:
        """Depth, (N,), at places (N, 2) within some kilometres, as true as `depth_about`.

        Where it is not known, that of the nearest cell that is.
        """
        middle = points_ne.mean(axis=0)
        at, per_metre = self._pixels_about(middle)
        rows, columns = self.depth_m.shape
        pixel = at + (points_ne - middle) @ per_metre
        return self._without_gaps._depth_of_pixel(np.clip(pixel, 0.5, [columns - 0.5, rows - 0.5]))

    @cached_property
    def _without_gaps(self) -> "Bathymetry":
        from scipy.ndimage import distance_transform_edt

        nearest = distance_transform_edt(
            np.isnan(self.depth_m), return_distances=False, return_indices=True
        )
        return replace(self, depth_m=self.depth_m[tuple(nearest)])

    def _pixels_about(self, place_ne: Array) -> tuple[Array, Array]:
        """Column and row of a place, (2,), and what a metre north and east adds to them, (2, 2)."""
        steps = self._pixel_from_ne(place_ne + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
        return steps[0], steps[1:] - steps[0]

    def _depth_of_pixel(self, pixel: Array) -> Array:
        pixel = pixel - 0.5
        rows, columns = self.depth_m.shape
        # A place on the outermost centres must not fall off them by rounding.
        last = np.array([columns - 1.0, rows - 1.0])
        inside = np.all((pixel > -_SAME_CELL) & (pixel < last + _SAME_CELL), axis=1)
        pixel = np.clip(np.where(inside[:, None], pixel, 0.0), 0.0, last)
        col = np.minimum(pixel[:, 0].astype(np.intp), max(columns - 2, 0))
        row = np.minimum(pixel[:, 1].astype(np.intp), max(rows - 2, 0))
        along, down = _snap(pixel[:, 0] - col), _snap(pixel[:, 1] - row)
        total = np.zeros(len(pixel))
        for d_row, d_col, weight in (
            (0, 0, (1 - along) * (1 - down)),
            (0, 1, along * (1 - down)),
            (1, 0, (1 - along) * down),
            (1, 1, along * down),
        ):
            cell = self.depth_m[
                np.minimum(row + d_row, rows - 1), np.minimum(col + d_col, columns - 1)
            ]
            total += np.where(weight > 0.0, weight * cell, 0.0)
        return np.where(inside, total, np.nan)

    def _pixel_from_ne(self, points_ne: Array) -> Array:
        """(N, 2) column and row of places (N, 2) on the sea floor, in the file's own corners."""
        down = np.full((len(points_ne), 1), self._middle_depth_m)
        geodetic = self.datum.geodetic_from_ned(np.hstack([points_ne, down]))
        x, y = self._transformer.transform(geodetic[:, 1], geodetic[:, 0])
        return _pixels(self.from_pixel, np.asarray(x), np.asarray(y))

    def _ne_from_pixel(self, pixel: Array) -> Array:
        places = np.column_stack([pixel, np.ones(len(pixel))])
        x, y = np.reshape(self.from_pixel, (2, 3)) @ places.T
        lon, lat = self._transformer.transform(x, y, direction="INVERSE")
        depth = np.full(len(pixel), self._middle_depth_m)
        return self.datum.ned_from_geodetic(np.column_stack([lat, lon, depth]))[:, :2]

    @cached_property
    def _middle_depth_m(self) -> float:
        """Of the known part: degrees grow shorter by one part in 10,000 in 600 m of depth."""
        return float(self.known_m.mean()) if len(self.known_m) else 0.0

    @cached_property
    def _transformer(self) -> Any:
        return _transformer(self.crs)


def mean_depth_m(bathymetry: Bathymetry, survey: MultiPolygon) -> float:
    """Mean depth over what is known of an area, on a grid as fine as the raster's.

    Raises:
        PlanError: the raster has no values there.
    """
    north_0, east_0, north_1, east_1 = survey.bounds
    count = (north_1 - north_0) * (east_1 - east_0) / bathymetry.cell_m**2
    step = bathymetry.cell_m * max(1.0, math.sqrt(count / _MAX_SAMPLES))
    step = min(step, max(north_1 - north_0, east_1 - east_0) / 16)
    north = np.arange(north_0 + step / 2, north_1, step)
    east = np.arange(east_0 + step / 2, east_1, step)
    points = np.stack(np.meshgrid(north, east, indexing="ij"), axis=-1).reshape(-1, 2)
    points = points[shapely.contains_xy(survey, points[:, 0], points[:, 1])]
    if not len(points):
        points = np.array(
            [[p.x, p.y] for p in (part.representative_point() for part in survey.geoms)]
        )
    depth = bathymetry.depth_at(points)
    known = depth[np.isfinite(depth)]
    if not len(known):
        raise PlanError(
            f"{bathymetry.name}: knows no depth within the survey area; check area.bathymetry_file "
            "and the area's place"
        )
    return float(known.mean())


def read_bathymetry(
    path: Path,
    datum: Datum,
    *,
    bounds_ne: tuple[float, float, float, float] | None = None,
    sense: Sense = "auto",
    crs: str | None = None,
) -> Bathymetry:
    """Read the depths of a raster's first band.

    Args:
        path: a BAG, GeoTIFF or other raster.
        datum: of the local frame.
        bounds_ne: least north and east, greatest north and east, of what is needed, metres; the
            whole raster if not given.
        sense: whether values are heights or depths; `auto` goes by the format, the band's name, the
            tag `positive` of the CF conventions, and else by their sign.
        crs: of a raster that does not say its own.

    Raises:
        PlanError: it is not a raster, has no coordinate system, does not reach the bounds, has
            too many cells within them, or it is not clear whether it holds heights or depths.
    """
    import rasterio
    from rasterio.errors import RasterioError
    from rasterio.windows import Window

    check_raster(path)
    try:
        with rasterio.open(path) as file:
            _check_filled(path, file)
            if crs is None and file.crs is None:
                raise PlanError(f"{path}: names no coordinate system; give area.crs, as EPSG:32636")
            flat = _flat_wkt(file.crs.to_wkt() if file.crs else str(crs), path)
            window = _window(path, file, flat, datum, bounds_ne)
            band = _without_unknown(path, file.read(1, window=Window(*window), masked=True))
            heights = sense == "heights" if sense != "auto" else _are_heights(path, file, band)
            scale, offset = file.scales[0], file.offsets[0]
            a, b, c, d, e, f = tuple(file.transform)[:6]
    except (RasterioError, OSError, ValueError, MemoryError) as error:
        raise PlanError(f"{path}: cannot be read as a raster: {one_line(error)}") from None
    values = np.ma.filled(band.astype(np.float64), np.nan) * scale + offset
    values[~np.isfinite(values)] = np.nan
    column, row, _, _ = window
    known = np.isfinite(values).mean() if values.size else 0.0
    if known == 0.0:
        raise PlanError(f"{path}: no cell there has a value; check area.bathymetry_file")
    return Bathymetry(
        name=path.name,
        datum=datum,
        crs=flat,
        from_pixel=(a, b, c + a * column + b * row, d, e, f + d * column + e * row),
        depth_m=-values if heights else values,
    )


def check_raster(path: Path) -> None:
    """Refuse descriptions of rasters, such as VRT and WMS: GDAL would fetch what they name.

    Raises:
        PlanError: it is one, or cannot be read.
    """
    if path.exists() and not path.is_file():
        raise PlanError(f"{path}: is not a file")
    with file_faults(path, PlanError), path.open("rb") as file:
        start = file.read(_LOOKED_AT).lstrip(b"\xef\xbb\xbf \t\r\n\0")
    if start[:1] in (b"<", b"{"):
        raise PlanError(
            f"{path}: is not a raster but a description of other files: give those, or make one "
            "file of them (gdal_translate)"
        )


_SHALLOW_M = 0.5
"""Zero stands for unknown where no other value is nearer to it."""


def _without_unknown(path: Path, band: Any) -> Any:
    """Values of a raster without those that stand for "not known", which it need not declare.

    Zero is one where all others are far from it.
    """
    zero = band == 0
    far = np.ma.abs(band[~zero]) > _SHALLOW_M
    is_zero_unknown = bool(zero.any() and far.size and far.all())
    unknown = [value for value in UNKNOWN if (band == value).any()] + [0.0] * is_zero_unknown
    if unknown:
        names = " and ".join(f"{value:g}" for value in unknown)
        warn(f"{path}: holds {names}, taken for no data, which it does not declare")
    filled = np.ma.filled(band, 1)
    return np.ma.masked_where(where_unknown(filled) | (is_zero_unknown & (filled == 0)), band)


def _check_filled(path: Path, file: Any) -> None:
    """Refuse a raster that cannot be read in parts, or whose grid its points cannot fill.

    Raises:
        PlanError: with the size of a part, or of the grid.
    """
    rows, columns = file.block_shapes[0]
    if rows * columns > 4 * _MAX_CELLS:
        raise PlanError(
            f"{path}: is stored in blocks of {columns} x {rows} cells, too large to read: store it "
            "in tiles (gdal_translate -co TILED=YES)"
        )
    size = path.stat().st_size
    if file.driver == "XYZ" and file.width * file.height > _EMPTIEST * size:
        raise PlanError(
            f"{path}: its points span {file.width} x {file.height} cells, far more than {size} "
            "bytes can fill: a coordinate is wrong"
        )


def _snap(share: Array) -> Array:
    """Places between two centres, with those on a centre by rounding put on it."""
    ends = np.where(share > 1.0 - _SAME_CELL, 1.0, share)
    return np.where(share < _SAME_CELL, 0.0, ends)


def _pixels(from_pixel: tuple[float, ...], x: Array, y: Array) -> Array:
    """(N, 2) column and row of places in the raster's own coordinates."""
    a, b, c, d, e, f = from_pixel
    return np.linalg.solve(np.array([[a, b], [d, e]]), np.stack([x - c, y - f])).T


def _transformer(crs: str) -> Any:
    from pyproj import Transformer

    return Transformer.from_crs("EPSG:4326", crs, always_xy=True)


def _flat_wkt(crs: str, path: Path) -> str:
    """WKT of the horizontal coordinate system."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        system = CRS.from_user_input(crs)
    except CRSError:
        raise PlanError(f"coordinate system {crs!r} is not known; give one as EPSG:32636") from None
    if system.is_compound:
        system = system.sub_crs_list[0]
    if not (system.is_projected or system.is_geographic):
        raise PlanError(f"{path}: {system.name!r} is neither a map nor a geographic system")
    return str(system.to_wkt())


def _window(
    path: Path,
    file: Any,
    crs: str,
    datum: Datum,
    bounds_ne: tuple[float, float, float, float] | None,
) -> tuple[int, int, int, int]:
    """First column and row, and how many of each, that bounds need."""
    if bounds_ne is None:
        window = (0, 0, int(file.width), int(file.height))
    else:
        box = shapely.box(*bounds_ne)
        edge = shapely.get_coordinates(
            shapely.segmentize(box.exterior, max(box.length / _EDGE_POINTS, 1e-9))
        )
        geodetic = datum.geodetic_from_ned(np.hstack([edge, np.zeros((len(edge), 1))]))
        x, y = _transformer(crs).transform(geodetic[:, 1], geodetic[:, 0])
        pixels = _pixels(tuple(file.transform)[:6], np.asarray(x), np.asarray(y))
        if not np.isfinite(pixels).all():
            raise PlanError(f"{path}: its coordinate system does not reach the survey area")
        low, high, size = pixels.min(axis=0), pixels.max(axis=0), (file.width, file.height)
        first = np.maximum(np.floor(low) - _PAD_CELLS, 0).astype(int)
        count = np.minimum(np.ceil(high) + _PAD_CELLS, size).astype(int) - first
        if (count <= 0).any():
            raise PlanError(
                f"{path}: does not reach the survey area, which is at columns {low[0]:.0f} to "
                f"{high[0]:.0f} and rows {low[1]:.0f} to {high[1]:.0f} of its {size[0]} x "
                f"{size[1]}: check the area's datum, whether its latitude and longitude are "
                "swapped, and area.bathymetry_file"
            )
        window = (int(first[0]), int(first[1]), int(count[0]), int(count[1]))
    cells = window[2] * window[3]
    if cells > _MAX_CELLS:
        raise PlanError(
            f"{path}: {window[2]} x {window[3]} cells are needed, more than {_MAX_CELLS:,}; "
            "survey less at once, or coarsen the raster (gdalwarp -tr)"
        )
    return window


def _are_heights(path: Path, file: Any, band: Any) -> bool:
    """Whether values are heights, as the file states it or as their signs show."""
    values = band.compressed()
    values = values[np.isfinite(values)]
    below = float(np.mean(values < 0)) if len(values) else 0.0
    stated = _stated_sense(file)
    if stated is None:
        if _ONE_SIGN > below > 1 - _ONE_SIGN:
            raise PlanError(
                f"{path}: {below:.0%} of its values are negative, so that it is not clear "
                "whether they are heights or depths; set area.bathymetry_values to one of them"
            )
        return below >= _ONE_SIGN
    heights, why = stated
    dry = 1 - below if heights else below
    if len(values) and dry > _ONE_SIGN:
        other = "depths" if heights else "heights"
        warn(
            f"{path}: by its {why} nearly all of it ({dry:.0%}) is above water; if its values are "
            f"{other}, set area.bathymetry_values = '{other}'"
        )
    return heights


def _stated_sense(file: Any) -> tuple[bool, str] | None:
    """Whether values are heights, and what says so."""
    if file.driver == "BAG":
        return True, "format (BAG: elevations)"
    for tags in (file.tags(1), file.tags()):
        for key, value in tags.items():
            if key.lower().split("#")[-1] == "positive" and str(value).lower() in ("up", "down"):
                return str(value).lower() == "up", f"tag {key} = {value}"
    name = str(file.descriptions[0] or "").lower()
    for word, heights in (("elevation", True), ("height", True), ("depth", False)):
        if word in name:
            return heights, f"band's name {file.descriptions[0]!r}"
    return None
