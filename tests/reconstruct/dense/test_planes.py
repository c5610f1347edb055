"""Surface and mosaic over planes: a level one that is turned, and a wall of known relief."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.app.stages import spec
from alice_survey.core.artefacts import read_json
from alice_survey.core.config import ReconstructConfig, SurveyConfig
from alice_survey.core.errors import keep_warnings
from alice_survey.core.executor import SERIAL
from tests.oracles_dense import (
    block_scene,
    read_raster,
    sloped_with_step,
    two_lines,
    write_workspace,
)

pytestmark = pytest.mark.slow
SCENE = block_scene()
WORLD_FROM_SCENE = RigidTransform.from_components(
    [30.0, -4.0, 6.0], Rotation.from_matrix([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
)
"""The scene stands upright: its north is up, its down is the world's north; it faces south."""
BANDS = ("dem", "sigma", "slope", "count", "stations", "surfaces", "lower")


def config(*planes: str) -> SurveyConfig:
    return SurveyConfig(reconstruct=ReconstructConfig(dem_cell_m=0.01, planes=planes))


@pytest.fixture(scope="module")
def level(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene on the level plane, and on that turned by 90 degrees about the vertical."""
    folder = tmp_path_factory.mktemp("level")
    write_workspace(folder, two_lines(-0.05, 0.3, 0.65), SCENE)
    planes = config("level", "turned=facing 90 tilt 90")
    assert spec("dense").make(folder, planes, SERIAL)
    assert spec("mosaic").make(folder, planes, SERIAL)
    return folder


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """The scene as a wall that faces south, and what was warned of."""
    folder = tmp_path_factory.mktemp("wall")
    write_workspace(folder, two_lines(-0.05, 0.3, 0.65), SCENE, WORLD_FROM_SCENE)
    planes = config("back=facing 0", "wall=facing 180")
    with keep_warnings() as warnings:
        assert spec("dense").make(folder, planes, SERIAL)
        assert spec("mosaic").make(folder, planes, SERIAL)
    return folder, [str(warning) for warning in warnings]


def points_enu(folder: Path) -> np.ndarray:
    """The cells of a DEM as points (N, 3) by its `plane.json`: east, north, up."""
    height, up, right = read_raster(folder / "dem.tif")
    about = read_json(folder / "plane.json")
    known = np.isfinite(height)
    axes = np.array([about["right_enu"], about["up_enu"], about["out_enu"]])
    local = np.stack([right[known], up[known], height[known]], axis=1)
    return np.array(about["origin_enu"]) + local @ axes


def test_a_turned_plane_has_the_heights_of_the_level_one(level: Path):
    height, north, east = read_raster(level / "dense" / "dem.tif")
    turned, west, up_north = read_raster(level / "dense" / "planes" / "turned" / "dem.tif")
    # its up is west and its right is north
    column, row = (-west - east[0, 0]) / 0.01, (north[0, 0] - up_north) / 0.01
    there = map_coordinates(height, [row, column], order=1, cval=np.nan)
    known = np.isfinite(there) & np.isfinite(turned)
    assert known.mean() > 0.75
    difference = np.abs(there - turned)[known]
    assert np.median(difference) < 2e-6  # the same cells, of the same points
    assert np.mean(difference > 1e-3) < 0.005  # ends of views and bridged gaps
    for name in ("surfaces", "count"):
        one = read_raster(level / "dense" / f"{name}.tif")[0]
        other = read_raster(level / "dense" / "planes" / "turned" / f"{name}.tif")[0]
        assert other.sum() == pytest.approx(one.sum(), rel=1e-3)


def test_the_wall_has_its_relief(wall: tuple[Path, list[str]]):
    folder, _ = wall
    enu = points_enu(folder / "dense")
    scene = WORLD_FROM_SCENE.inv().apply(enu[:, [1, 0, 2]] * [1, 1, -1])
    inside = (np.abs(scene[:, 0] - 0.3) < 0.5) & (np.abs(scene[:, 1] - 0.35) < 0.5)
    assert inside.sum() > 0.95 * 100 * 100
    error = (sloped_with_step(scene[:, 0], scene[:, 1]) - scene[:, 2])[inside]
    assert 3e-5 < np.median(np.abs(error)) < 4e-4
    assert np.mean(np.abs(error) > 0.01) < 0.04  # the block's sides
    assert np.ptp(scene[inside, 2]) > 0.1


def test_a_plane_without_surface_has_a_warning_and_no_product(wall: tuple[Path, list[str]]):
    folder, warnings = wall
    (warning,) = [w for w in warnings if "plane" in w]
    assert "'back'" in warning
    assert not (folder / "dense" / "planes").exists()
    assert not (folder / "mosaic" / "planes").exists()
    assert read_json(folder / "dense" / "surface.json")["planes"] == ["wall"]
    names = {path.stem for path in (folder / "dense").glob("*.tif")}
    assert names == set(BANDS)
    assert (folder / "mosaic" / "mosaic.tif").is_file()


def test_the_mosaic_of_the_wall_is_that_of_the_scene(wall: tuple[Path, list[str]], level: Path):
    """Painted from the same pictures: up the wall is the scene's north."""
    pixels = []
    for path in (wall[0] / "mosaic" / "mosaic.tif", level / "mosaic" / "mosaic.tif"):
        with rasterio.open(path) as raster:
            t = raster.transform
            pixels.append((raster.read(), t.c, t.f, t.a))
    (upright, left, top, side), (flat, west, north, cell) = pixels
    assert side == cell
    _, east, down = WORLD_FROM_SCENE.translation
    column, row = round((left - east - west) / cell), round((north - (top + down)) / cell)
    high = min(upright.shape[1], flat.shape[1]) - 20 - abs(row)
    wide = min(upright.shape[2], flat.shape[2]) - 20 - abs(column)
    one = upright[:, 10 + max(-row, 0) :, 10 + max(-column, 0) :][:, :high, :wide]
    two = flat[:, 10 + max(row, 0) :, 10 + max(column, 0) :][:, :high, :wide]
    both = (one[3] > 0) & (two[3] > 0)
    assert both.sum() > 0.93 * min((one[3] > 0).sum(), (two[3] > 0).sum())
    difference = np.abs(one[0].astype(float) - two[0])[both]
    # corners of pixels are up to half a pixel apart
    assert np.corrcoef(one[0][both], two[0][both])[0, 1] > 0.95
    assert np.median(difference) < 6
