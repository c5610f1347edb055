from pathlib import Path

import cv2
import numpy as np
import pytest

from alice_survey.core.artefacts import read_json, write_json
from reconstruct.mosaic.exports import hits_of, mosaic_tiles, picture_footprint, write_footprints
from reconstruct.raster import DemGrid, crs_of
from tests.alice_survey.app.report.tiny import write_raster
from tests.oracles_dense import ALTITUDE_M, FOCAL, FRAME, HEIGHT, WIDTH, stereo_views

GRID = DemGrid(west=-2.0, north=2.0, cell=0.02, rows=200, columns=200)


def slope() -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(200) + 0.5, np.arange(200) + 0.5)
    height = -12.0 + 0.2 * GRID.north_of(rows) - 0.1 * GRID.east_of(columns)
    return height.astype(np.float32)


def test_rays_end_on_the_surface_where_the_view_projects_it() -> None:
    view = stereo_views(np.array([0.1]), np.array([-0.1]))[0]
    x, y = np.meshgrid(np.linspace(5, WIDTH - 5, 6), np.linspace(5, HEIGHT - 5, 5))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    met, ranges = hits_of(view, pixels, slope(), GRID)
    depth = 12.0 - 0.2 * met[:, 1] + 0.1 * met[:, 0]
    world = np.column_stack([met[:, 1], met[:, 0], depth])
    np.testing.assert_allclose(view.project(world), pixels, atol=0.02)
    away = np.linalg.norm(world - view.world_from_cam.translation, axis=1)
    np.testing.assert_allclose(ranges, away, atol=1e-4)


def test_area_and_ground_pixel_over_a_flat_floor_are_those_of_a_pinhole(tmp_path: Path) -> None:
    views = tuple(stereo_views(np.array([0.0]), np.array([0.0])))
    flat = np.full((200, 200), -12.0, np.float32)
    found = [picture_footprint(view, flat, GRID) for view in views]
    ground = ALTITUDE_M / FOCAL
    for one in found:
        assert one.seen == 1.0
        assert one.area == pytest.approx(WIDTH * HEIGHT * ground**2, rel=0.01)
        assert one.ground_pixel == pytest.approx(ground, rel=0.01)
        assert ALTITUDE_M < one.mean_range < 1.1 * ALTITUDE_M
        assert len(one.outline) == 64
    write_footprints(tmp_path, views, found, FRAME)
    features = read_json(tmp_path / "footprints.geojson")["features"]
    lon, lat = np.array(features[0]["geometry"]["coordinates"][0]).T
    north_m, east_m = np.ptp(lat) * 110_900, np.ptp(lon) * 93_700
    assert north_m * east_m > found[0].area
    assert north_m * east_m < 2.2 * found[0].area
    lines = (tmp_path / "footprints.csv").read_text().splitlines()
    assert lines[0].startswith("image,camera,station,area_m2")
    assert len(lines) == 3


def test_a_picture_off_the_surface_has_no_area() -> None:
    view = stereo_views(np.array([30.0]), np.array([0.0]))[0]
    found = picture_footprint(view, slope(), GRID)
    assert found.area == 0
    assert np.isnan(found.mean_range)
    assert len(found.outline) == 0


def workspace_with_mosaic(folder: Path) -> np.ndarray:
    rng = np.random.default_rng(3)
    rgba = rng.integers(0, 256, (4, 150, 230)).astype(np.uint8)
    rgba[3] = 255
    rgba[:, :70, :70] = 0
    path = folder / "mosaic" / "mosaic.tif"
    write_raster(path, rgba, 0.01, (5.0, 9.0), crs=crs_of(FRAME))
    write_json(
        folder / "mosaic" / "mosaic.json",
        {"width_px": 230, "height_px": 150, "pixel": 0.01, "unit": "m"},
    )
    write_json(folder / "mosaic" / "stage.json", {})
    return rgba


@pytest.mark.parametrize("kind", ["png", "tif"])
def test_tiles_hold_the_mosaic_and_say_where_they_lie(tmp_path: Path, kind: str) -> None:
    rgba = workspace_with_mosaic(tmp_path)
    out = tmp_path / "out"
    _, data = mosaic_tiles(tmp_path, out, side_px=64, kind=kind)  # type: ignore[arg-type]
    assert data["tiles"] == 11  # 3 x 4 without the empty one
    lines = [line.split(",") for line in (out / "tiles.csv").read_text().splitlines()]
    assert len(lines) == 12
    row = dict(zip(lines[0], lines[4], strict=True))
    picture = cv2.imread(str(out / row["tile"]), cv2.IMREAD_UNCHANGED)
    left, top = int(row["column_px"]), int(row["row_px"])
    part = rgba[:, top : top + picture.shape[0], left : left + picture.shape[1]]
    known = part[3] > 0
    expected = part[[2, 1, 0]].transpose(1, 2, 0)
    np.testing.assert_array_equal(picture[..., :3][known], expected[known])
    assert float(row["west"]) == pytest.approx(5.0 + 0.01 * left)
    world = (out / row["tile"]).with_suffix({"png": ".pgw", "tif": ".tfw"}[kind])
    values = [float(v) for v in world.read_text().split()]
    np.testing.assert_allclose(values[:4], [0.01, 0, 0, -0.01], atol=1e-12)
    np.testing.assert_allclose(values[4:], [5 + 0.01 * (left + 0.5), 9 - 0.01 * (top + 0.5)])
    assert not list(out.glob("*.rough*"))
