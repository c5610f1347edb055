"""Areas and sea floors: every format that `area.file` and `area.bathymetry_file` may have."""

import json
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pyogrio.raw
import rasterio
import shapely
from rasterio.transform import from_origin
from shapely.geometry import Polygon

from alice_survey.core.config import AreaConfig
from alice_survey.core.frames import Datum
from missions.areas.bathymetry import read_bathymetry
from missions.areas.survey import survey_area
from tests.fuzz.target import Target

_DEGREES = Polygon(
    [(35.0, 32.8), (35.0003, 32.8), (35.0003, 32.8002), (35.00015, 32.8001), (35.0, 32.8002)],
    [[(35.00004, 32.80003), (35.00009, 32.80003), (35.00006, 32.80008)]],
)
_METRES = shapely.transform(_DEGREES, lambda xy: (xy - [35.0, 32.8]) * 1e5 + [7e5, 36.4e5])


def read_area(path: Path, ending: str = "") -> object:
    """An area for planning, of a file, or of the file whose side file is damaged."""
    file = path.with_suffix(ending) if ending else path
    return survey_area(AreaConfig(file=file), turn_margin_m=3.0)


def read_zones(path: Path) -> object:
    """Zones to keep out of, where points and lines count."""
    settings = AreaConfig(
        latitude_deg=32.8, longitude_deg=35.0, no_go_file=path, no_go_clearance_m=1.0
    )
    return survey_area(settings, turn_margin_m=3.0)


def read_depths(path: Path, crs: str | None = None) -> object:
    bounds_ne = (0.0, 0.0, 15.0, 15.0)
    return read_bathymetry(path, Datum(32.8, 35.0), bounds_ne=bounds_ne, sense="depths", crs=crs)


def geojson() -> str:
    ring = np.array(_DEGREES.exterior.coords).tolist()
    hole = np.array(_DEGREES.interiors[0].coords).tolist()
    place = {"type": "Polygon", "coordinates": [ring, hole]}
    line = {"type": "LineString", "coordinates": ring[:3]}
    features = [
        {"type": "Feature", "properties": {"name": "site", "n": i}, "geometry": shape}
        for i, shape in enumerate((place, line))
    ]
    return json.dumps({"type": "FeatureCollection", "name": "site", "features": features})


def kml(extra: str = "", head: str = "") -> str:
    corners = " ".join(f"{x},{y},0" for x, y in _DEGREES.exterior.coords)
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n{head}'
        '<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Folder><name>a</name>\n'
        f"<Placemark><name>site{extra}</name>\n<Polygon><outerBoundaryIs><LinearRing>\n"
        f"<coordinates>{corners}</coordinates>\n</LinearRing></outerBoundaryIs></Polygon>\n"
        "</Placemark></Folder></Document></kml>\n"
    )


def _by_gdal(path: Path, driver: str) -> None:
    pyogrio.raw.write(
        path, shapely.to_wkb(np.array([_METRES], dtype=object)), [np.arange(1)], ["number"],
        geometry_type="Polygon", crs="EPSG:32636", driver=driver,
    )  # fmt: skip


def _kmz(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("doc.kml", kml())
        archive.writestr("files/readme.txt", "x" * 50)


def build_shapefile(path: Path) -> None:
    """All its side files, one of which is that path."""
    _by_gdal(path.with_suffix(".shp"), "ESRI Shapefile")


def _zip(path: Path) -> None:
    build_shapefile(path)
    with zipfile.ZipFile(path, "w") as archive:
        for side in (".shp", ".shx", ".dbf", ".prj"):
            archive.write(path.with_suffix(side), f"site/a{side}")
            path.with_suffix(side).unlink()
    path.with_suffix(".cpg").unlink(missing_ok=True)


def _geotiff(path: Path) -> None:
    north, east = np.mgrid[0:24, 0:24]
    depths = (15.0 + 0.1 * north + 0.05 * east).astype(np.float32)
    with rasterio.open(
        path, "w", driver="GTiff", width=24, height=24, count=1, dtype="float32",
        crs="EPSG:4326", transform=from_origin(34.9999, 32.8004, 2.5e-5, 2.5e-5), nodata=-9999.0,
        compress="deflate",
    ) as file:  # fmt: skip
        file.write(depths, 1)


def _xyz(mark: str) -> str:
    return "".join(
        f"{35.0 + 2e-5 * i:.6f}{mark}{32.8003 - 2e-5 * j:.6f}{mark}{15 + (i + 5) % 7}\n"
        for j in range(20)
        for i in range(-5, 15)
    )


def _ascii_grid() -> str:
    rows = "\n".join(" ".join(f"{15 + (i + j) % 5}.5" for i in range(20)) for j in range(20))
    head = "ncols 20\nnrows 20\nxllcorner 34.9999\nyllcorner 32.7999\ncellsize 0.00002\n"
    return f"{head}NODATA_value -9999\n{rows}\n"


_GPKG, _SIDES = partial(_by_gdal, driver="GPKG"), (".shx", ".dbf", ".prj")
_BY_SHP, _PREFIXED = partial(read_area, ending=".shp"), partial(read_depths, crs="EPSG:4326")
_PLACES = list(_DEGREES.exterior.coords)[:-1]
_CORNERS = "name,lat,lon\n" + "".join(f"c{i},{y},{x}\n" for i, (x, y) in enumerate(_PLACES))
_POLY = "#saved by Mission Planner\n" + "".join(f"{y} {x}\n" for x, y in _PLACES)
_GPX = (
    '<?xml version="1.0"?><gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><rte>'
    + "".join(f'<rtept lat="{y}" lon="{x}"/>' for x, y in _PLACES)
    + "</rte></gpx>"
)
TARGETS = (
    Target("GeoJSON", "json", "a.geojson", geojson(), read_area),
    Target("GeoJSON zones", "json", "z.json", geojson(), read_zones),
    Target("KML", "text", "a.kml", kml(), read_area),
    Target("corners CSV", "csv", "corners.csv", _CORNERS, read_area),
    Target("GPX", "text", "a.gpx", _GPX, read_area),
    Target("corners of Mission Planner", "text", "a.poly", _POLY, read_area),
    Target("KMZ", "binary", "a.kmz", _kmz, read_area),
    Target("WKT", "text", "a.wkt", f"SRID=4326;{_DEGREES.wkt}", read_area),
    Target("GeoPackage", "binary", "a.gpkg", _GPKG, read_area),
    Target("shapefile", "binary", "a.shp", build_shapefile, read_area),
    *(Target(f"shapefile's {s}", "binary", f"a{s}", build_shapefile, _BY_SHP) for s in _SIDES),
    Target("zipped shapefile", "binary", "a.zip", _zip, read_area),
    Target("bathymetry GeoTIFF", "binary", "a.tif", _geotiff, read_depths),
    Target("bathymetry XYZ", "text", "a.xyz", _xyz(" "), _PREFIXED),
    Target("bathymetry CSV", "csv", "a.csv", f"x,y,z\n{_xyz(',')}", _PREFIXED),
    Target("bathymetry ASCII grid", "text", "a.asc", _ascii_grid(), _PREFIXED),
)
