"""Rasters of depth: signs, coordinate systems, windows, and what lies between cells."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import shapely
from pyproj import Transformer
from rasterio.transform import from_origin

from alice_survey.core.errors import PlanError
from alice_survey.core.frames import Array
from missions.areas import bathymetry as module
from missions.areas.bathymetry import mean_depth_m, read_bathymetry
from tests.missions.areas.sites import TO_UTM, UTM, real_floor
from tests.oracles_energy import bilinear
from tests.oracles_lines import DATUM


def _written(
    path: Path, values: Array, description: str = "", tags: Mapping[str, str] = {}, **profile: Any
) -> Path:
    """A GeoTIFF whose first cell's outer corner is 20 m north-west of the datum."""
    x, y = TO_UTM.transform(DATUM.longitude_deg, DATUM.latitude_deg)
    given = {"crs": UTM, "transform": from_origin(x - 20.0, y + 20.0, 2.0, 2.0), **profile}
    shape = {"height": values.shape[0], "width": values.shape[1], "count": 1, "dtype": "float64"}
    with rasterio.open(path, "w", driver="GTiff", **shape, **given) as file:
        file.write(values, 1)
        file.set_band_description(1, description)
        file.update_tags(1, **tags)
    return path


def _plane(rows: int = 20, columns: int = 24) -> Array:
    row, column = np.mgrid[0:rows, 0:columns]
    return 15.0 + 0.05 * column + 0.03 * row


def test_heights_and_depths_read_alike(tmp_path: Path) -> None:
    depths = _plane()
    by_depth = read_bathymetry(_written(tmp_path / "d.tif", depths), DATUM)
    by_height = read_bathymetry(_written(tmp_path / "h.tif", -depths), DATUM)
    points = np.random.default_rng(1).uniform(-15, 15, (50, 2))

    np.testing.assert_array_equal(by_depth.depth_at(points), by_height.depth_at(points))
    assert np.all(by_depth.depth_at(points) > 14)


@pytest.mark.parametrize(
    ("options", "sign"),
    [
        ({"description": "Elevation"}, -1.0),
        ({"description": "depth below MSL"}, 1.0),
        ({"tags": {"positive": "up"}}, -1.0),
        ({"tags": {"z#positive": "down"}}, 1.0),
    ],
)
def test_metadata_goes_before_the_sign(
    tmp_path: Path, options: dict[str, Any], sign: float
) -> None:
    mixed = _plane() - 15.5  # some negative, some positive: a shore

    found = read_bathymetry(_written(tmp_path / "m.tif", mixed, **options), DATUM)

    np.testing.assert_allclose(found.depth_m, sign * mixed)


def test_a_shore_without_a_word_on_its_sign_is_refused(tmp_path: Path) -> None:
    path = _written(tmp_path / "m.tif", _plane() - 15.5)
    with pytest.raises(PlanError, match=r"area\.bathymetry_values"):
        read_bathymetry(path, DATUM)
    depths = read_bathymetry(path, DATUM, sense="depths").depth_m
    np.testing.assert_array_equal(read_bathymetry(path, DATUM, sense="heights").depth_m, -depths)


def test_depth_is_bilinear_between_centres_of_cells(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    values = rng.uniform(10, 20, (12, 17))
    values[5, 6] = -9999.0
    found = read_bathymetry(_written(tmp_path / "r.tif", values, nodata=-9999.0), DATUM)
    values[5, 6] = np.nan
    points = rng.uniform(-30, 30, (400, 2))
    lon_lat = DATUM.geodetic_from_ned(np.column_stack([points, np.full(400, 15.0)]))
    x, y = TO_UTM.transform(lon_lat[:, 1], lon_lat[:, 0])
    a, _, c, _, e, f = found.from_pixel

    depth = found.depth_at(points)

    expected = [
        bilinear(values, (px - c) / a - 0.5, (py - f) / e - 0.5)
        for px, py in zip(x, y, strict=True)
    ]
    np.testing.assert_allclose(depth, expected, atol=1e-5)
    assert 0.1 < np.isnan(depth).mean() < 0.9


def test_next_to_a_gap_nothing_is_known_and_on_the_next_centre_all(tmp_path: Path) -> None:
    values = _plane()
    values[7, 8] = np.nan
    found = read_bathymetry(_written(tmp_path / "g.tif", values), DATUM)

    def at(column: float, row: float) -> float:
        ne = found._ne_from_pixel(np.array([[column + 0.5, row + 0.5]]))
        return float(found.depth_at(ne)[0])

    assert math.isnan(at(7.5, 7.0))
    assert math.isnan(at(8.0, 7.9))
    assert at(7.0, 7.0) == pytest.approx(values[7, 7], abs=1e-5)
    assert math.isnan(at(-0.1, 3.0))
    assert at(0.0, 3.0) == pytest.approx(values[3, 0], abs=1e-5)
    assert at(23.0, 19.0) == pytest.approx(values[19, 23], abs=1e-5)


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:3857", "EPSG:32635", "EPSG:2039"])
def test_any_coordinate_system_gives_the_same_floor(tmp_path: Path, crs: str) -> None:
    """A plane of latitude and longitude, written in other systems on their own grids."""
    to_crs = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    x0, y0 = to_crs.transform(34.9553, 32.8236)
    x1, y1 = to_crs.transform(34.9554, 32.8237)
    cell = max(abs(x1 - x0), abs(y1 - y0)) / 8
    transform = from_origin(x0 - 25 * cell, y0 + 25 * cell, cell, cell)
    cells = (np.arange(50) + 0.5 - 25) * cell
    x, y = np.meshgrid(x0 + cells, y0 - cells)
    lon, lat = to_crs.transform(x, y, direction="INVERSE")
    values = 20 + 3e3 * (np.asarray(lon) - 34.9553) - 2e3 * (np.asarray(lat) - 32.8236)
    path = _written(tmp_path / "p.tif", values, crs=crs, transform=transform)
    found = read_bathymetry(path, DATUM)
    points = np.random.default_rng(3).uniform(-15, 15, (100, 2))
    geodetic = DATUM.geodetic_from_ned(np.column_stack([points, np.full(100, 20.0)]))

    depth = found.depth_at(points)

    expected = 20 + 3e3 * (geodetic[:, 1] - 34.9553) - 2e3 * (geodetic[:, 0] - 32.8236)
    np.testing.assert_allclose(depth, expected, atol=1e-5)
    assert 0.5 < found.cell_m < 3.0


def test_only_the_window_is_read_and_says_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = np.random.default_rng(5).uniform(10, 20, (400, 500))
    path = _written(tmp_path / "w.tif", values)
    bounds = (-60.0, 30.0, -40.0, 70.0)
    points = np.random.default_rng(6).uniform([-60, 30], [-40, 70], (200, 2))

    window = read_bathymetry(path, DATUM, bounds_ne=bounds)

    whole = read_bathymetry(path, DATUM)
    np.testing.assert_allclose(window.depth_at(points), whole.depth_at(points), atol=1e-5)
    assert np.all(np.isfinite(window.depth_at(points)))
    assert 20 * 10 < window.depth_m.size < 40 * 30
    monkeypatch.setattr(module, "_MAX_CELLS", 10_000)
    assert read_bathymetry(path, DATUM, bounds_ne=bounds).depth_m.shape == window.depth_m.shape
    with pytest.raises(PlanError, match="500 x 400"):
        read_bathymetry(path, DATUM)


def test_faults_say_what_to_change(tmp_path: Path) -> None:
    path = _written(tmp_path / "f.tif", _plane())
    with pytest.raises(PlanError, match=r"f\.tif"):
        read_bathymetry(path, DATUM, bounds_ne=(500.0, 500.0, 600.0, 600.0))
    with pytest.raises(PlanError, match=r"missing\.tif"):
        read_bathymetry(tmp_path / "missing.tif", DATUM)
    with pytest.raises(PlanError, match=r"area\.bathymetry_file"):
        read_bathymetry(_written(tmp_path / "e.tif", np.full((5, 5), np.nan)), DATUM)
    nameless = _written(tmp_path / "n.tif", _plane(), crs=None)
    with pytest.raises(PlanError, match=r"area\.crs"):
        read_bathymetry(nameless, DATUM)
    with pytest.raises(PlanError, match="EPSG:999999"):
        read_bathymetry(nameless, DATUM, crs="EPSG:999999")
    named = read_bathymetry(nameless, DATUM, crs=UTM)
    np.testing.assert_array_equal(named.depth_m, _plane())


def test_depth_over_an_area_is_the_mean_of_what_is_known(tmp_path: Path) -> None:
    found = read_bathymetry(_written(tmp_path / "a.tif", _plane()), DATUM)
    square = shapely.MultiPolygon([shapely.box(-10, -10, 10, 10)])
    wide = shapely.MultiPolygon([shapely.box(-10, -10, 10, 60)])

    middle = float(found.depth_at(np.array([[0.0, 0.0]]))[0])
    assert mean_depth_m(found, square) == pytest.approx(middle, abs=0.01)
    # The raster reaches 27 m east of the datum; columns of 2 m are 0.05 m deeper each.
    known_ne = np.array([[0.0, (-10.0 + 27.0) / 2]])
    assert mean_depth_m(found, wide) == pytest.approx(found.depth_at(known_ne)[0], abs=0.05)
    with pytest.raises(PlanError, match=r"area\.bathymetry_file"):
        mean_depth_m(found, shapely.MultiPolygon([shapely.box(100, 100, 110, 110)]))


def test_a_window_of_a_real_grid_equals_gdals_own_samples(shared_data: Path) -> None:
    path, datum = real_floor(shared_data)
    window = read_bathymetry(path, datum, bounds_ne=(-150.0, -150.0, 150.0, 150.0))
    centres = window._ne_from_pixel(np.array([[20.5, 30.5], [70.5, 11.5], [50.5, 50.5]]))
    geodetic = datum.geodetic_from_ned(np.column_stack([centres, np.full(3, 51.7)]))
    x, y = Transformer.from_crs("EPSG:4326", "EPSG:32602", always_xy=True).transform(
        geodetic[:, 1], geodetic[:, 0]
    )
    with rasterio.open(path) as file:
        heights = [float(value[0]) for value in file.sample(zip(x, y, strict=True))]
    np.testing.assert_allclose(window.depth_at(centres), -np.array(heights), atol=1e-5)
    assert window.depth_m.size < 180 * 180


def test_a_description_of_other_files_is_not_followed(tmp_path: Path) -> None:
    real = _written(tmp_path / "real.tif", np.full((20, 20), 15.0))
    other = tmp_path / "a.tif"
    other.write_text(
        '<VRTDataset rasterXSize="20" rasterYSize="20"><VRTRasterBand band="1"><SimpleSource>'
        f"<SourceFilename>{real}</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"
    )
    with pytest.raises(PlanError, match=r"a\.tif"):
        read_bathymetry(other, DATUM)


def test_points_that_span_far_more_than_they_fill(tmp_path: Path) -> None:
    rows = [f"{x} {y} 15" for y in range(20) for x in range(20)]
    path = tmp_path / "a.xyz"
    path.write_text("\n".join(rows) + "\n")
    assert read_bathymetry(path, DATUM, crs=UTM, sense="depths").depth_m.shape == (20, 20)
    path.write_text("\n".join([*rows, "900000 20 15"]) + "\n")
    with pytest.raises(PlanError, match=r"a\.xyz"):
        read_bathymetry(path, DATUM, crs=UTM, sense="depths")


@pytest.mark.parametrize("unknown", [-9999.0, 0.0, -32768.0, 1e6, -3.4e38])
def test_undeclared_cells_without_a_value_are_unknown(tmp_path: Path, unknown: float) -> None:
    heights = np.full((20, 30), -12.0)
    heights[4:9, 6:11] = unknown
    found = read_bathymetry(_written(tmp_path / "b.tif", heights), DATUM)
    assert (np.isnan(found.depth_m) == (heights == unknown)).all()
    assert np.nanmax(found.depth_m) == np.nanmin(found.depth_m) == 12.0
