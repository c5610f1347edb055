"""Polygons of GIS files on a surface of known slope, in several formats and coordinate systems."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyogrio.raw
import pytest
import shapely
from pyproj import Transformer

from alice_survey.core.errors import AliceError, ConfigError, WorkspaceError
from alice_survey.core.frames import Datum
from reconstruct.measure.figures import figure
from reconstruct.measure.shapes import measure_polygon_file, plan_slopes_of, read_polygons
from reconstruct.measure.surface import MeasuredSurface
from reconstruct.raster import local_crs
from reconstruct.views.model import WorldFrame
from tests.reconstruct.measure.synthetic import grid, without_errors
from tests.reconstruct.measure.test_figures import ramp

DATUM = Datum(32.8, 34.9, 0.0)
SLANT = np.sqrt(1.25)
WHOLE = shapely.box(-0.4, -0.4, -0.1, 0.0)
HOLED = shapely.Polygon(
    [(0.0, 0.0), (0.4, 0.0), (0.4, 0.4), (0.0, 0.4)],
    [[(0.1, 0.1), (0.1, 0.2), (0.2, 0.2), (0.2, 0.1)]],
)
SHAPES = {"coral": [WHOLE, HOLED], "sponge": [shapely.box(-0.3, 0.1, -0.1, 0.2)]}


@pytest.fixture
def surface(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> MeasuredSurface:
    made = without_errors(tmp_path, grid(1.0, 0.01), ramp)
    frame = WorldFrame(name="ned", datum=DATUM, scaled=True, vertical_datum="a test's")
    placed = replace(made, frame=frame)
    monkeypatch.setattr(MeasuredSurface, "of", lambda _: placed)
    return placed


def write(path: Path, crs: str | None, driver: str) -> Path:
    """The shapes in a coordinate system, with their labels in an attribute."""
    own = local_crs(DATUM).to_wkt()
    to = Transformer.from_crs(own, crs or own, always_xy=True)
    shapes = np.array([shape for some in SHAPES.values() for shape in some], dtype=object)
    labels = np.array([name for name, some in SHAPES.items() for _ in some], dtype=object)
    shapes = shapely.transform(shapes, lambda xy: np.column_stack(to.transform(*xy.T)))
    pyogrio.raw.write(
        path, np.array(shapely.to_wkb(shapes), dtype=object), [labels], ["Species"],
        geometry_type="Polygon", crs=crs or own, driver=driver, layer="seen",
    )  # fmt: skip
    return path


@pytest.mark.parametrize(
    ("name", "crs", "driver"),
    [
        ("seen.geojson", "EPSG:4326", "GeoJSON"), ("seen.gpkg", "EPSG:32636", "GPKG"),
        ("seen.gpkg", None, "GPKG"), ("seen.shp", "EPSG:3857", "ESRI Shapefile"),
    ],
)  # fmt: skip
def test_areas_cover_and_rugosity_are_those_of_a_slope(
    surface: MeasuredSurface, tmp_path: Path, name: str, crs: str | None, driver: str
) -> None:
    file = write(tmp_path / name, crs, driver)
    text, data = measure_polygon_file(tmp_path, file, pick_sigma_px=0.5)
    plans = [0.12, 0.15, 0.02]
    for one, plan in zip(data["polygons"], plans, strict=True):
        found = {f["name"]: f for f in one["figures"]}
        assert found["plan_area"]["value"] == pytest.approx(plan, rel=1e-3)
        assert found["surface_area"]["value"] == pytest.approx(SLANT * plan, rel=1e-3)
        assert found["rugosity"]["value"] == pytest.approx(SLANT, rel=1e-4)
        assert found["plan_area"]["sigma"] > 0 and found["surface_area"]["sigma"] > 0
    for one, label, count, cover in zip(
        data["labels"], ("coral", "sponge"), (2, 1), (0.27, 0.02), strict=True
    ):
        found = {f["name"]: f["value"] for f in one["figures"]}
        assert (one["label"], one["count"]) == (label, count)
        assert found["cover"] == pytest.approx(cover, rel=1e-3)
    assert "all of 'coral', 2" in text


def test_results_are_written_for_spreadsheets_and_maps(
    surface: MeasuredSurface, tmp_path: Path
) -> None:
    file = write(tmp_path / "seen.gpkg", None, "GPKG")
    _, data = measure_polygon_file(tmp_path, file, output=tmp_path / "out.geojson")
    features = json.loads((tmp_path / "out.geojson").read_text())["features"]
    assert [len(f["geometry"]["coordinates"]) for f in features] == [1, 2, 1]
    assert features[1]["properties"]["plan_area"] == data["polygons"][1]["figures"][0]["value"]
    back = read_polygons(tmp_path / "out.geojson", surface)
    assert [one.geometry.area for one in back] == pytest.approx([0.12, 0.15, 0.02], rel=1e-5)
    measure_polygon_file(tmp_path, file, output=tmp_path / "out.csv")
    rows = list(csv.DictReader((tmp_path / "out.csv").open()))
    assert len(rows) == sum(len(one["figures"]) for one in data["polygons"])
    with pytest.raises(ConfigError):
        measure_polygon_file(tmp_path, file, output=tmp_path / "out.xlsx")


def test_the_sigma_of_an_area_is_that_of_drawn_corners(surface: MeasuredSurface) -> None:
    sigma, rng = 0.002, np.random.default_rng(1)
    stated = figure(surface, "", "", 1.0, plan_slopes_of(surface.picked_to(sigma), HOLED), 0).sigma
    rings = [shapely.get_coordinates(ring)[:-1] for ring in shapely.get_rings(HOLED)]
    draws = []
    for _ in range(2000):
        outer, hole = (ring + rng.normal(0, sigma, ring.shape) for ring in rings)
        draws.append(shapely.Polygon(outer, [hole]).area)
    assert np.std(draws) == pytest.approx(stated, rel=0.06)


def test_files_that_are_no_polygons_are_refused(surface: MeasuredSurface, tmp_path: Path) -> None:
    file = write(tmp_path / "seen.gpkg", None, "GPKG")
    with pytest.raises(WorkspaceError, match="genus"):
        measure_polygon_file(tmp_path, file, label="genus")
    points = tmp_path / "points.geojson"
    points.write_text('{"type": "Point", "coordinates": [34.9, 32.8]}')
    with pytest.raises(WorkspaceError, match="no polygon"):
        measure_polygon_file(tmp_path, points)
    vrt = tmp_path / "seen.vrt"
    vrt.write_text(f"<OGRVRTDataSource><SrcDataSource>{file}</SrcDataSource></OGRVRTDataSource>")
    for path in (vrt, vrt.rename(tmp_path / "seen.kml"), tmp_path / "missing.gpkg"):
        with pytest.raises(AliceError):
            measure_polygon_file(tmp_path, path)
