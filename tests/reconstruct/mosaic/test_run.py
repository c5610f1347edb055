from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio

from alice_survey.app.stages import spec
from alice_survey.core.artefacts import read_json, write_json
from alice_survey.core.config import CameraConfig, ReconstructConfig, SurveyConfig, WaterConfig
from alice_survey.core.executor import SERIAL
from camera_calib.approximation.pinhole_warp import best_warp
from camera_calib.rig import design_rig
from reconstruct.dense.cloud import VERTEX, write_cloud, write_cloud_json
from reconstruct.mosaic import run
from reconstruct.mosaic.picture_measures import encode_srgb, linear_table
from reconstruct.mosaic.run import _dispersion
from reconstruct.raster import DemGrid, tiled_raster
from reconstruct.views.model import View
from tests.cameras import changed
from tests.engines import PicklingThreads
from tests.oracles_dense import (
    DEPTH_M,
    FRAME,
    PERIOD_M,
    Scene,
    position_code,
    read_raster,
    stereo_views,
    write_workspace,
)

CELL_M, PIXEL_M = 0.012, 0.005
CONFIG = SurveyConfig(reconstruct=ReconstructConfig(mosaic_pixel_m=PIXEL_M, colour="raw"))
EVEN = SurveyConfig(reconstruct=ReconstructConfig(mosaic_pixel_m=PIXEL_M, colour="even"))


GAP = np.s_[60:80, 40:60]
"""Cells within the survey of which no depth is known."""


def terraced(north: np.ndarray, east: np.ndarray) -> np.ndarray:
    """A slope: warps that forget the height are off by up to 60 mm."""
    return DEPTH_M + 0.15 * north - 0.1 * east


SCENE = Scene(depth_of=terraced, paint=position_code)


def write_surface(folder: Path) -> None:
    """The true DEM over the middle of the survey."""
    dense = folder / "dense"
    dense.mkdir()
    grid = DemGrid(west=-0.6, north=0.9, cell=CELL_M, rows=125, columns=110)
    columns, rows = np.meshgrid(np.arange(grid.columns) + 0.5, np.arange(grid.rows) + 0.5)
    height = -terraced(grid.north_of(rows), grid.east_of(columns))
    height[100:, 90:] = np.nan
    height[GAP] = np.nan
    known = np.where(np.isfinite(height), 1.0, np.nan)
    for name, band in (("dem", height), ("sigma", 1e-3 * known), ("count", known)):
        path = dense / f"{name}.tif"
        with tiled_raster(path, grid, FRAME, "float32", np.nan, name) as raster:
            raster.write(band.astype(np.float32), 1)
    write_surface_cloud(dense, grid, height)
    write_json(dense / "stage.json", {})


def write_surface_cloud(dense: Path, grid: DemGrid, height: np.ndarray) -> None:
    """The cloud of a DEM alone: a point at every cell."""
    rows, columns = np.nonzero(np.isfinite(height))
    points = np.zeros(len(rows), VERTEX)
    points["x"], points["y"] = grid.east_of(columns + 0.5), grid.north_of(rows + 0.5)
    points["z"] = height[rows, columns]
    write_cloud(dense / "cloud.ply", [points], (0.0, 0.0, 0.0), FRAME)
    write_cloud_json(dense / "cloud.json", len(points), (0.0, 0.0, 0.0), grid.cell, FRAME)


def make_workspace(folder: Path, views: list[View], scene: Scene) -> Path:
    """All that the mosaic is made of."""
    write_workspace(folder, views, scene)
    write_surface(folder)
    return folder


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mosaic")
    views = stereo_views(np.array([-0.2, 0.2, 0.6]), np.array([0.0, 0.05, 0.0]), heading_deg=30.0)
    make_workspace(folder, views, SCENE)
    assert spec("mosaic").make(folder, CONFIG, SERIAL)
    return folder


def read(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """RGBA (4, H, W), and north and east of the pixels' centres."""
    return read_raster(folder / "mosaic" / "mosaic.tif", None)


def test_every_pixel_shows_its_own_coordinates(workspace: Path):
    rgba, north, east = read(workspace)
    known = rgba[3] > 0
    assert known.mean() > 0.6
    about = read_json(workspace / "mosaic" / "mosaic.json")
    assert (about["height_px"], about["width_px"]) == known.shape
    assert 0.6 < about["covered"] < 1.0
    thumbnail = cv2.imread(str(workspace / "mosaic" / "mosaic.png"), cv2.IMREAD_UNCHANGED)
    assert thumbnail.shape == (*known.shape, 4)
    expected = position_code(north, east)
    levels_per_m = 100 * 2 * np.pi / PERIOD_M
    for band, channel in ((2, 0), (1, 1)):
        error = (rgba[band] - expected[..., channel])[known]
        # rms of the slope of a sine is its largest over the root of two
        error_m = np.sqrt(np.mean(error**2)) / (levels_per_m / np.sqrt(2))
        assert 1e-5 < error_m < 0.1 * PIXEL_M
        assert np.abs(error).max() < 40
    assert np.abs(rgba[0] - 128)[known].max() <= 2


def test_nothing_is_painted_where_the_surface_is_unknown(workspace: Path):
    rgba, north, east = read(workspace)
    hole = (north < 0.9 - 100 * CELL_M - CELL_M) & (east > -0.6 + 90 * CELL_M + CELL_M)
    assert hole.sum() > 100
    assert (rgba[3][hole] == 0).all()
    assert (rgba[:3][:, rgba[3] == 0] == 0).all()


def test_a_gap_is_painted_and_marked_with_the_sigma_of_its_places(workspace: Path):
    rgba, north, east = read(workspace)
    rows, columns = (np.array([part.start, part.stop]) for part in GAP)
    (high, low), (left, right) = 0.9 - rows * CELL_M, columns * CELL_M - 0.6
    assert (rgba[3][(north < high) & (north > low) & (east > left) & (east < right)] > 0).all()
    (_, _, places), north, east = read_raster(workspace / "mosaic" / "coverage.tif", None)
    far = 0.05
    inside = (north < high) & (north > low) & (east > left) & (east < right)
    near = (north < high + far) & (north > low - far) & (east > left - far) & (east < right + far)
    assert (places[inside] == 1).all()  # 1 mm of height, looked at from 2 m above: less, rounded up
    assert (places[~near] == 0).all()


def test_source_names_the_picture_nearest_to_straight_above(workspace: Path):
    with rasterio.open(workspace / "mosaic" / "mosaic_source.tif") as raster:
        source = raster.read(1)
    rgba, north, east = read(workspace)
    np.testing.assert_array_equal(source > 0, rgba[3] > 0)
    names = read_json(workspace / "mosaic" / "mosaic.json")["pictures"]
    at = np.unravel_index(np.argmin((north - 0.6) ** 2 + east**2), north.shape)
    assert names[source[at] - 1].endswith("002.png")
    assert len(np.unique(source[source > 0])) >= 4


def grey_survey(folder: Path, north: list[float], east: list[float]) -> list[View]:
    """Stations at places over an evenly grey sea floor."""
    plain = Scene(depth_of=terraced, paint=lambda n, e: np.full((*n.shape, 3), 100.0))
    views = stereo_views(np.array(north), np.array(east), heading_deg=30.0)
    make_workspace(folder, views, plain)
    return views


def test_gains_of_pictures_leave_no_seam(tmp_path: Path):
    views = grey_survey(tmp_path, [-0.2, 0.2, 0.6], [0.0, 0.05, 0.0])
    gains = np.log(np.linspace(0.7, 1.3, len(views)))
    for view, gain in zip(views, gains, strict=True):
        path = tmp_path / "images" / view.image
        picture = cv2.imread(str(path)).astype(np.float64) * np.exp(gain)
        cv2.imwrite(str(path), np.rint(picture).astype(np.uint8))
    assert spec("mosaic").make(tmp_path, EVEN, SERIAL)
    rgba, _, _ = read(tmp_path)
    painted = rgba[:3][:, rgba[3] > 0]
    assert np.ptp(np.percentile(painted, [0.5, 99.5])) < 8  # 60 without any correction
    assert 100 < np.median(painted) < 140


def patches(north: np.ndarray, east: np.ndarray) -> np.ndarray:
    """Bright and dark spots without edges, of slowly changing colour."""
    level = 90.0 + 35.0 * np.sin(17.0 * north) * np.cos(13.0 * east)
    return level[..., None] * np.stack([0.8 + 0.1 * np.sin(3.0 * east), 1.0 + 0.0 * east,
                                        1.1 - 0.1 * np.cos(4.0 * north)], axis=-1)  # fmt: skip


@pytest.mark.slow
def test_borders_of_blocks_and_tiles_show_no_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One model of colours serves all blocks: many small ones paint what a single one does."""
    scene = Scene(depth_of=terraced, paint=patches)
    north, east = (c.ravel() for c in np.meshgrid([-0.1, 0.2, 0.5], [-0.1, 0.1]))
    views = stereo_views(north, east, heading_deg=30.0)
    reconstruct = CONFIG.reconstruct.model_copy(update={"colour": "water"})
    config = CONFIG.model_copy(update={"reconstruct": reconstruct})
    painted = {}
    for name, block_px in (("one", 2048), ("many", 128)):
        folder = tmp_path / name
        make_workspace(folder, views, scene)
        for view in views:  # a lamp ahead and a veil
            path = folder / "images" / view.image
            picture = linear_table()[cv2.imread(str(path))]
            x = np.linspace(-1.0, 1.0, picture.shape[1])[:, None]
            lit = picture * np.exp(-0.5 * x**2) * [0.6, 1.0, 0.9] + np.array([0.02, 0.015, 0.01])
            cv2.imwrite(str(path), np.rint(encode_srgb(lit.astype(np.float32))).astype(np.uint8))
        monkeypatch.setattr(run, "_LABEL_PX", block_px)
        monkeypatch.setattr(run, "_TILE_PX", block_px)
        monkeypatch.setattr(run, "_LABEL_MARGIN_PX", 64)
        assert spec("mosaic").make(folder, config, SERIAL)
        painted[name], _, _ = read(folder)
    known = (painted["one"][3] > 0) & (painted["many"][3] > 0)
    assert known.mean() > 0.5
    apart = np.where(known, painted["many"][:3] - painted["one"][:3], np.nan)
    assert np.nanpercentile(np.abs(apart), 99) < 10
    for axis in (1, 2):  # blocks of their own give slightly other samples, but no step
        steps = np.abs(np.diff(apart, axis=axis))
        at = np.arange(steps.shape[axis]) % 128 == 127
        border = np.nanmean(np.compress(at, steps, axis=axis))
        inside = np.nanmean(np.compress(~at, steps, axis=axis))
        assert border < inside + 0.3
        assert inside < 1.0


def test_a_single_grey_station_gives_a_grey_mosaic(tmp_path: Path):
    grey_survey(tmp_path, [0.2], [0.0])
    assert spec("mosaic").make(tmp_path, EVEN, SERIAL)
    rgba, _, _ = read(tmp_path)
    painted = rgba[:3][:, rgba[3] > 0]
    assert painted.shape[1] > 20_000
    assert np.ptp(painted, axis=0).max() <= 1
    assert 60 < np.median(painted) < 200


@pytest.mark.parametrize(("n_water", "corrected"), [(1.0, False), (1.34, True)])
def test_only_refraction_parts_the_colours(tmp_path: Path, n_water: float, corrected: bool):
    """A camera calibrated in water as a plain pinhole has no dispersion to correct."""
    camera = design_rig(CameraConfig(), WaterConfig()).cameras["left"]
    bare = {"port_distance_m": 0.0, "glass_thickness_m": 0.0, "n_water": n_water}
    warp = best_warp(changed(camera, **bare), 1.5, 2.5)
    write_json(
        tmp_path / "sparse" / "cameras.json", {"cameras": {"left": warp.to_json()}, "images": {}}
    )
    write_json(tmp_path / "images" / "survey.json", {"source": "imported"})
    water, stated = _dispersion(tmp_path, CONFIG.water, 2.0, grey=False)
    assert stated["corrected"] is corrected and (water is not None) is corrected


def test_what_a_mask_hides_is_not_painted_and_others_fill_it(tmp_path: Path):
    views = grey_survey(tmp_path, [0.2], [0.0])
    about = read_json(tmp_path / "sparse" / "cameras.json")
    left = next(view for view in views if view.camera == "left")
    picture = cv2.imread(str(tmp_path / "images" / left.image))
    mask = np.full(picture.shape[:2], 255, np.uint8)
    picture[90:170, 100:220], mask[90:170, 100:220] = (0, 0, 255), 0
    cv2.imwrite(str(tmp_path / "images" / left.image), picture)
    cv2.imwrite(str(tmp_path / "images" / "fish.png"), mask)
    about["images"][left.image]["mask"] = "fish.png"
    write_json(tmp_path / "sparse" / "cameras.json", about)
    assert spec("mosaic").make(tmp_path, CONFIG, SERIAL)
    rgba, north, east = read(tmp_path)
    known = rgba[3] > 0
    assert np.abs(rgba[:3][:, known] - 100).max() <= 3
    middle = (np.hypot(north - 0.2, east) < 0.1) & known
    assert middle.sum() > 500  # the other camera shows what the fish hides


def test_bytes_do_not_change_on_another_engine(workspace: Path, tmp_path: Path):
    for name in ("images", "sparse", "dense"):
        (tmp_path / name).symlink_to(workspace / name)
    with PicklingThreads(1) as engine:
        assert spec("mosaic").make(tmp_path, CONFIG, engine.executor)
        assert engine.tasks > len(list((tmp_path / "images").rglob("*.png")))
    names = ("mosaic.tif", "mosaic_source.tif", "coverage.tif", "mosaic.png", "mosaic.json")
    for name in (*names, "footprints.csv", "footprints.geojson"):
        same = (tmp_path / "mosaic" / name).read_bytes()
        assert same == (workspace / "mosaic" / name).read_bytes()
    assert not spec("mosaic").make(tmp_path, CONFIG, SERIAL)
