from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import rasterio
from pyproj import Transformer

from alice_survey.core.errors import WorkspaceError, keep_warnings
from reconstruct import elevation
from reconstruct.elevation import StoredElevation
from reconstruct.export import destination
from reconstruct.raster import (
    DemGrid,
    hillshade,
    local_crs,
    opened_raster,
    read_cells,
    tiled_raster,
    tiles_of,
    tiles_reached,
    write_style,
)
from tests.alice_survey.app.report.tiny import write_raster
from tests.oracles_dense import DATUM, FRAME

GRID = DemGrid(west=-12.5, north=40.0, cell=0.25, rows=300, columns=420)


def heights() -> np.ndarray:
    rows, columns = np.mgrid[: GRID.rows, : GRID.columns]
    return (-12.0 + 0.01 * columns - 0.02 * rows).astype(np.float32)


def write(path, values=None) -> None:
    values = heights() if values is None else values
    with tiled_raster(path, GRID, FRAME, "float32", np.nan, "height", "m") as raster:
        for window in tiles_of(GRID, 256):
            part = values[
                window.row_off : window.row_off + window.height,
                window.col_off : window.col_off + window.width,
            ]
            raster.write(part, 1, window=window)


def test_a_known_point_lands_on_its_latitude_longitude_and_utm(tmp_path):
    write(tmp_path / "dem.tif")
    north_m, east_m = 17.875, 51.125  # centre of a cell
    with rasterio.open(tmp_path / "dem.tif") as raster:
        row, column = raster.index(east_m, north_m)
        assert raster.xy(row, column) == pytest.approx((east_m, north_m), abs=1e-9)
        assert raster.read(1)[row, column] == heights()[row, column]
        crs = raster.crs.to_wkt()
    lat, lon, _ = DATUM.geodetic_from_ned(np.array([[north_m, east_m, 0.0]]))[0]
    to_geodetic = Transformer.from_crs(crs, 4326, always_xy=True)
    assert to_geodetic.transform(east_m, north_m) == pytest.approx((lon, lat), abs=1e-11)
    to_utm = Transformer.from_crs(crs, DATUM.utm_epsg, always_xy=True)
    from_geodetic = Transformer.from_crs(4326, DATUM.utm_epsg, always_xy=True)
    utm = to_utm.transform(east_m, north_m)
    assert utm == pytest.approx(from_geodetic.transform(lon, lat), abs=1e-5)
    # and why the file is not in UTM: there the same offset is turned and stretched
    base = from_geodetic.transform(DATUM.longitude_deg, DATUM.latitude_deg)
    assert abs(utm[1] - base[1] - north_m) > 0.1


@pytest.mark.parametrize("distance_m", [10.0, 1000.0])
def test_map_axes_are_north_and_east_of_the_tangent_plane(distance_m: float):
    points = distance_m * np.array([[0.6, 0.8, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    lat_lon = DATUM.geodetic_from_ned(points)
    to_map = Transformer.from_crs(4326, local_crs(DATUM).to_wkt(), always_xy=True)
    east, north = to_map.transform(lat_lon[:, 1], lat_lon[:, 0])
    np.testing.assert_allclose(np.column_stack([north, east]), points[:, :2], atol=2e-5)


def test_hillshade_of_planes():
    rows, columns = np.mgrid[:20, :30].astype(float)
    level = hillshade(np.zeros((20, 30)), 1.0)
    np.testing.assert_allclose(level, np.sqrt(0.5))
    # rises to the south-east, so it faces the light in the north-west squarely
    facing = hillshade((rows + columns) * np.sqrt(0.5), 1.0)
    np.testing.assert_allclose(facing, 1.0, atol=1e-12)
    away = hillshade(-(rows + columns) * np.sqrt(0.5), 1.0)
    np.testing.assert_allclose(away, 0.0, atol=1e-12)


def test_tiles_are_reached_by_boxes_that_overlap_them() -> None:
    rng = np.random.default_rng(4)
    low = rng.uniform([-40.0, -60.0], [110.0, 60.0], (60, 2))
    boxes = np.concatenate([low, low + rng.uniform(0.0, 30.0, (60, 2))], axis=1)
    boxes[7], margin = np.nan, 2.0
    found = {
        (window.col_off, window.row_off, window.width, window.height): numbers
        for window, numbers in tiles_reached(GRID, 64, boxes, margin)
    }
    expected = {}
    for window in tiles_of(GRID, 64):
        tile = GRID.window(window.row_off, window.col_off, 64, 64)
        over = (boxes[:, 0] - margin < tile.east_of(64)) & (boxes[:, 2] + margin >= tile.west)
        over &= (boxes[:, 3] + margin > tile.north_of(64)) & (boxes[:, 1] - margin <= tile.north)
        if over.any():
            key = (window.col_off, window.row_off, window.width, window.height)
            expected[key] = np.flatnonzero(over).tolist()
    assert list(found.items()) == list(expected.items())
    assert 10 < len(expected) <= 35


def test_a_damaged_raster_is_reported_with_its_name(tmp_path: Path) -> None:
    path = tmp_path / "dem.tif"
    with pytest.raises(WorkspaceError, match=r"\.tif"), opened_raster(path):
        pass
    write(path)
    with opened_raster(path) as raster:
        np.testing.assert_array_equal(raster.read(1), heights())
    whole = path.read_bytes()
    for end in (0, 100, len(whole) // 2):
        path.write_bytes(whole[:end])
        with pytest.raises(WorkspaceError, match=r"dem\.tif"), opened_raster(path) as raster:
            raster.read(1)


def test_the_ramp_spans_the_values_without_their_tails(tmp_path: Path):
    values = np.random.default_rng(1).normal(-12.0, 0.2, (GRID.rows, GRID.columns))
    values[:5] = np.nan
    values[9, 9] = 500.0
    path = tmp_path / "dem.tif"
    write(path, values.astype(np.float32))
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


CELL, ROWS, COLUMNS = 0.02, 500, 400


def stored(folder: Path, height: np.ndarray) -> StoredElevation:
    for name, cells in (("dem.tif", height), ("sigma.tif", np.full_like(height, 0.003))):
        write_raster(folder / name, cells.astype(np.float32)[None], CELL, (-4, 5), nodata=np.nan)
    return StoredElevation.of(folder)


def middles() -> tuple[np.ndarray, np.ndarray]:
    rows, columns = np.mgrid[:ROWS, :COLUMNS]
    return -4 + (columns + 0.5) * CELL, 5 - (rows + 0.5) * CELL


def rays(count: int, spread: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    starts = np.column_stack([rng.uniform(-2, 2, (count, 2)), rng.uniform(6.5, 7.5, count)])
    ways = np.column_stack([rng.normal(0, spread, (count, 2)), np.ones(count)])
    return starts, ways / np.linalg.norm(ways, axis=1, keepdims=True)


def test_rays_meet_a_plane_where_they_must(tmp_path: Path) -> None:
    east, north = middles()
    dem = stored(tmp_path, -9.0 + 0.2 * north - 0.1 * east)
    starts, ways = rays(200, 0.3)
    part, met = dem.met_by(starts, ways)
    normal = np.array([0.2, -0.1, 1.0])  # depth + height is 0
    reach = (9.0 - starts @ normal) / (ways @ normal)
    np.testing.assert_allclose(met, starts + reach[:, None] * ways, atol=1e-5)
    np.testing.assert_allclose(part.at(part.sigma, met[:, [1, 0]]), 0.003, rtol=1e-6)
    up = dem.met_by(starts[:1], ways[:1] * [1.0, 1.0, -1.0])[1]
    beyond = dem.met_by(starts[:1] + np.array([50.0, 0.0, 0.0]), ways[:1])[1]
    assert np.isnan(up).all() and np.isnan(beyond).all()


def test_parts_say_what_the_whole_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    east, north = middles()
    height = -9.0 + 0.3 * np.sin(3 * east) * np.cos(2 * north)
    height[:, :20] = np.nan
    height[-1, -1] = -30.0  # a fault far away widens what rays may reach
    dem = stored(tmp_path, height)
    starts, ways = rays(300, 0.2)
    expected = dem.whole.met_by(starts, ways)
    assert np.isfinite(expected).all(axis=1).sum() > 290
    one_by_one = [dem.met_by(s[None], w[None]) for s, w in zip(starts, ways, strict=True)]
    np.testing.assert_allclose([met[0] for _, met in one_by_one], expected, atol=2e-3)
    monkeypatch.setattr(elevation, "_MAX_CELLS", 90_000)
    bounded = [dem.met_by(s[None], w[None]) for s, w in zip(starts, ways, strict=True)]
    assert max(part.height.size for part, _ in bounded) <= 100_000
    np.testing.assert_allclose([met[0] for _, met in bounded], expected, atol=2e-2)


def test_a_wall_hides_what_is_behind_it(tmp_path: Path) -> None:
    _, north = middles()
    dem = stored(tmp_path, np.where(np.abs(north - 1.0) < 0.1, -8.0, -9.0))
    points = np.array([[0.0, 0.0, 9.0]] * 4)
    eyes = np.array([[0, 0, 7.0], [2, 0, 7.5], [2, 0, 6.5], [-2, 0, 7.5]])
    hidden = dem.whole.hides(points, np.full(4, 0.05), eyes)
    assert hidden.tolist() == [False, True, False, False]


@pytest.mark.parametrize("window", [(0, 0, 10, 12), (-3, -4, 9, 11), (495, 390, 12, 20)])
def test_cells_beyond_a_raster_are_unknown(
    tmp_path: Path, window: tuple[int, int, int, int]
) -> None:
    values = np.arange(ROWS * COLUMNS, dtype=np.float64).reshape(ROWS, COLUMNS)
    stored(tmp_path, values)
    row, column, rows, columns = window
    wide = np.pad(values, 30, constant_values=np.nan)
    expected = wide[row + 30 : row + 30 + rows, column + 30 : column + 30 + columns]
    np.testing.assert_array_equal(read_cells(tmp_path / "dem.tif", *window), expected)
    coarse = read_cells(tmp_path / "dem.tif", *window, every=3)
    assert coarse.shape == (rows // 3, columns // 3)
    blocks = expected[: rows // 3 * 3, : columns // 3 * 3].reshape(rows // 3, 3, columns // 3, 3)
    np.testing.assert_array_equal(coarse, np.where(np.isnan(blocks).any((1, 3)), np.nan,
                                                   blocks[:, 1, :, 1]))  # fmt: skip


@pytest.mark.parametrize(("crs", "warned"), [("EPSG:32636", 0), ("EPSG:32632", 1)])
def test_a_system_of_another_zone_is_warned_of_with_the_right_one(crs: str, warned: int) -> None:
    with keep_warnings() as said:
        destination(crs, FRAME)
    assert len(said) == warned and all("EPSG:32636" in text for text in said)
