"""A certificate in files that other tools read: GeoTIFF in UTM, holes as GeoJSON."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.frames import Array, Datum
from missions.coverage.certificate import Certificate

NO_DATA = 65535
"""Outside of the area."""
_BANDS = (
    ("pictures", "pictures of all cameras"),
    ("least_pictures", "pictures of the camera that sees it least often"),
    ("least_lines", "lines of the camera that sees it on the fewest"),
    ("pairs", "stations that see it with all cameras at once"),
)
_BLOCK = 256


def write_coverage_tif(path: Path, certificate: Certificate) -> None:
    """Write how often each place of the area is seen, in UTM; 65535 outside of the area.

    A pixel takes the value of the certificate's cell that holds its middle.
    """
    import rasterio
    from pyproj import Transformer
    from rasterio.transform import from_origin

    datum, cell_m = certificate.area.datum, certificate.grid.cell_m
    crs = f"EPSG:{datum.utm_epsg}"
    geodetic = datum.geodetic_from_ned(_at_surface(certificate.area.corners_ne))
    to_utm = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    east, north = to_utm.transform(geodetic[:, 1], geodetic[:, 0])
    west_m, north_m = float(np.min(east)), float(np.max(north))
    columns = max(1, int(np.ceil((np.max(east) - west_m) / cell_m)))
    rows = max(1, int(np.ceil((north_m - np.min(north)) / cell_m)))

    def places_ne(row: Array, column: Array) -> Array:
        """Local places, (..., 2), of rows and columns (corners of pixels)."""
        lon, lat = to_utm.transform(
            west_m + cell_m * column.ravel(), north_m - cell_m * row.ravel(), direction="INVERSE"
        )
        ned = datum.ned_from_geodetic(np.column_stack([lat, lon, np.zeros(lon.size)]))
        return ned[:, :2].reshape(*row.shape, 2)

    profile = {
        "driver": "GTiff", "width": columns, "height": rows, "count": len(_BANDS),
        "dtype": "uint16", "nodata": NO_DATA, "crs": crs, "compress": "deflate",
        "transform": from_origin(west_m, north_m, cell_m, cell_m),
        "tiled": True, "blockxsize": _BLOCK, "blockysize": _BLOCK,
    }  # fmt: skip
    with atomic_path(path) as temporary, rasterio.open(temporary, "w", **profile) as raster:
        for row in range(0, rows, _BLOCK):
            for column in range(0, columns, _BLOCK):
                height, width = min(_BLOCK, rows - row), min(_BLOCK, columns - column)
                # Between the corners of a block the projection is even to a few micrometres.
                ends = np.meshgrid([row, row + height], [column, column + width], indexing="ij")
                corners = places_ne(ends[0].astype(np.float64), ends[1].astype(np.float64))
                places = _between(corners, height, width)
                for band, (name, _) in enumerate(_BANDS, 1):
                    values = sample_counts(certificate, getattr(certificate, name), places)
                    window = rasterio.windows.Window(column, row, width, height)
                    raster.write(values, band, window=window)
        for band, (_, text) in enumerate(_BANDS, 1):
            raster.set_band_description(band, text)


class Outlined(Protocol):
    """What has an outline to be drawn on a map."""

    def feature(self, datum: Datum) -> dict[str, Any]:
        """It as a GeoJSON feature, WGS 84."""
        ...


def write_outlines(path: Path, datum: Datum, places: Sequence[Outlined]) -> None:
    """Write holes or weak places, RFC 7946 (WGS 84)."""
    features = [place.feature(datum) for place in places]
    with atomic_path(path) as temporary:
        text = json.dumps(
            {"type": "FeatureCollection", "features": features}, indent=1, allow_nan=False
        )
        temporary.write_text(text + "\n", encoding="utf-8")


def sample_counts(
    certificate: Certificate, values: NDArray[np.uint16], places_ne: Array
) -> NDArray[np.uint16]:
    """Values of the cells that hold places (..., 2); `NO_DATA` outside of the area."""
    inside = certificate.grid.sample(certificate.inside, places_ne, False)
    found = certificate.grid.sample(values, places_ne, NO_DATA)
    return np.where(inside, np.minimum(found, NO_DATA - 1), np.uint16(NO_DATA))


def _between(corners: Array, rows: int, columns: int) -> Array:
    """Places, (rows, columns, 2), of the middles of pixels between the corners (2, 2, 2)."""
    down = ((np.arange(rows) + 0.5) / rows)[:, None, None]
    right = ((np.arange(columns) + 0.5) / columns)[None, :, None]
    top = corners[0, 0] * (1 - right) + corners[0, 1] * right
    bottom = corners[1, 0] * (1 - right) + corners[1, 1] * right
    places: Array = top * (1 - down) + bottom * down
    return places


def _at_surface(points_ne: Array) -> Array:
    return np.column_stack([points_ne, np.zeros(len(points_ne))])
