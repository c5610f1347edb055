"""Areas and sea floors: every format that `area.file` and `area.bathymetry_file` may have."""

import json
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import shapely
from shapely.geometry import Polygon

from alice_survey.core.config import AreaConfig
from alice_survey.core.frames import Datum
from tests.fuzz.target import Target

_DEGREES = Polygon(
    [(35.0, 32.8), (35.0003, 32.8), (35.0003, 32.8002), (35.00015, 32.8001), (35.0, 32.8002)],
    [[(35.00004, 32.80003), (35.00009, 32.80003), (35.00006, 32.80008)]],
)
_METRES = shapely.transform(_DEGREES, lambda xy: (xy - [35.0, 32.8]) * 1e5 + [7e5, 36.4e5])
_DATUM = Datum(32.8, 35.0)


def read_area(path: Path, ending: str = "") -> object:
    """An area for planning, of a file, or of the file whose side file is damaged."""
    from missions.areas.survey import survey_area

    file = path.with_suffix(ending) if ending else path
    return survey_area(AreaConfig(file=file), turn_margin_m=3.0)


def read_zones(path: Path) -> object:
    """Zones to keep out of, where points and lines count."""
    from missions.areas.survey import survey_area

    settings = AreaConfig(
        latitude_deg=32.8, longitude_deg=35.0, no_go_file=path, no_go_clearance_m=1.0
    )
    return survey_area(settings, turn_margin_m=3.0)


def read_depths(path: Path) -> object:
    from missions.areas.bathymetry import read_bathymetry

    return read_bathymetry(path, _DATUM, bounds_ne=(0.0, 0.0, 15.0, 15.0), sense="depths")


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


def _by_gdal(folder: Path, name: str, driver: str, geometry_type: str = "Polygon") -> Path:
    import pyogrio.raw

    pyogrio.raw.write(
        folder / name, shapely.to_wkb(np.array([_METRES], dtype=object)), [np.arange(1)],
        ["number"], geometry_type=geometry_type, crs="EPSG:32636", driver=driver,
    )  # fmt: skip
    return folder / name


def _text(folder: Path, name: str, text: str) -> None:
    (folder / name).write_text(text, encoding="utf-8")


def _kmz(folder: Path) -> None:
    with zipfile.ZipFile(folder / "a.kmz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("doc.kml", kml())
        archive.writestr("files/readme.txt", "x" * 50)


def build_shapefile(folder: Path) -> None:
    _by_gdal(folder, "a.shp", "ESRI Shapefile")


def _zip(folder: Path) -> None:
    build_shapefile(folder)
    with zipfile.ZipFile(folder / "a.zip", "w") as archive:
        for side in (".shp", ".shx", ".dbf", ".prj"):
            archive.write(folder / f"a{side}", f"site/a{side}")
            (folder / f"a{side}").unlink()
    (folder / "a.cpg").unlink(missing_ok=True)


def _geopackage(folder: Path) -> None:
    _by_gdal(folder, "a.gpkg", "GPKG")


def _geotiff(folder: Path) -> None:
    import rasterio
    from rasterio.transform import from_origin

    north, east = np.mgrid[0:24, 0:24]
    depths = (15.0 + 0.1 * north + 0.05 * east).astype(np.float32)
    with rasterio.open(
        folder / "a.tif", "w", driver="GTiff", width=24, height=24, count=1, dtype="float32",
        crs="EPSG:4326", transform=from_origin(34.9999, 32.8004, 2.5e-5, 2.5e-5), nodata=-9999.0,
        compress="deflate",
    ) as file:  # fmt: skip
        file.write(depths, 1)


def _cells() -> tuple[list[float], list[float]]:
    return [35.0 + 2e-5 * i for i in range(-5, 15)], [32.8003 - 2e-5 * i for i in range(20)]


def _xyz(folder: Path, name: str, mark: str) -> None:
    xs, ys = _cells()
    rows = [f"{x:.6f}{mark}{y:.6f}{mark}{15 + i % 7}" for y in ys for i, x in enumerate(xs)]
    head = [mark.join("xyz")] if mark == "," else []
    _text(folder, name, "\n".join([*head, *rows]) + "\n")


def _ascii_grid(folder: Path) -> None:
    rows = "\n".join(" ".join(f"{15 + (i + j) % 5}.5" for i in range(20)) for j in range(20))
    head = "ncols 20\nnrows 20\nxllcorner 34.9999\nyllcorner 32.7999\ncellsize 0.00002\n"
    _text(folder, "a.asc", f"{head}NODATA_value -9999\n{rows}\n")


def _of_text(name: str, text: Callable[[], str]) -> Callable[[Path], None]:
    return lambda folder: _text(folder, name, text())


def _target(name: str, file: str, build: Callable[[Path], None], **more: object) -> Target:
    settings = {"syntax": "binary", "read": read_area} | more
    return Target(name=name, file=file, build=build, **settings)  # type: ignore[arg-type]


def _wkt() -> str:
    return f"SRID=4326;{_DEGREES.wkt}"


def _prefixed(path: Path) -> object:
    from missions.areas.bathymetry import read_bathymetry

    return read_bathymetry(
        path, _DATUM, bounds_ne=(0.0, 0.0, 15.0, 15.0), sense="depths", crs="EPSG:4326"
    )


TARGETS = (
    _target("GeoJSON", "a.geojson", _of_text("a.geojson", geojson), syntax="json"),
    _target("GeoJSON zones", "z.json", _of_text("z.json", geojson), syntax="json", read=read_zones),
    _target("KML", "a.kml", _of_text("a.kml", kml), syntax="text"),
    _target("KMZ", "a.kmz", _kmz),
    _target("WKT", "a.wkt", _of_text("a.wkt", _wkt), syntax="text"),
    _target("GeoPackage", "a.gpkg", _geopackage),
    _target("shapefile", "a.shp", build_shapefile),
    *(
        _target(
            f"shapefile's {side}", f"a{side}", build_shapefile,
            read=partial(read_area, ending=".shp"),
        )
        for side in (".shx", ".dbf", ".prj")
    ),
    _target("zipped shapefile", "a.zip", _zip),
    _target("bathymetry GeoTIFF", "a.tif", _geotiff, read=read_depths),
    _target(
        "bathymetry XYZ", "a.xyz", partial(_xyz, name="a.xyz", mark=" "), read=_prefixed,
        syntax="text",
    ),
    _target(
        "bathymetry CSV", "a.csv", partial(_xyz, name="a.csv", mark=","), read=_prefixed,
        syntax="csv",
    ),
    _target("bathymetry ASCII grid", "a.asc", _ascii_grid, read=_prefixed, syntax="text"),
)  # fmt: skip
