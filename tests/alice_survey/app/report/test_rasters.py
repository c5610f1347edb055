import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from affine import Affine

from alice_survey.app.report.held import Held
from alice_survey.app.report.rasters import page_layer, picture_layers, read_shrunk
from alice_survey.app.studio.files import Workspace
from alice_survey.app.studio.layers import Layers
from alice_survey.core.products import MOSAIC
from alice_survey.kit.document import PictureLayer
from reconstruct.measure.surface import values_at
from tests.alice_survey.app.report.tiny import CELL_M, COLUMNS, ROWS, tiny_workspace, write_raster


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_workspace(tmp_path_factory.mktemp("tiny"))


def mosaic_layer(workspace: Path, max_px: float | None = None) -> PictureLayer:
    path = workspace / MOSAIC.path
    return page_layer(path, MOSAIC, "m", shown=True, max_px=max_px)


def put_together(layer: PictureLayer, level: int) -> np.ndarray:
    halvings = layer.levels - 1 - level
    width, height = layer.width_px, layer.height_px
    for _ in range(halvings):
        width, height = (width + 1) // 2, (height + 1) // 2
    sheet = np.zeros((height, width, 4), np.uint8)
    for name, data in layer.tiles.items():
        k, x, y = (int(part) for part in name.split("/"))
        if k == level:
            tile = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
            if tile.shape[2] == 3:
                tile = np.dstack([tile, np.full(tile.shape[:2], 255, np.uint8)])
            top, left = y * layer.tile_px, x * layer.tile_px
            sheet[top : top + tile.shape[0], left : left + tile.shape[1]] = tile
    return sheet


def test_the_mosaics_tiles_make_the_mosaic(workspace: Path) -> None:
    layer = mosaic_layer(workspace)
    assert (layer.width_px, layer.height_px, layer.levels) == (400, 600, 2)
    assert (layer.west_m, layer.north_m, layer.pixel_m) == (0.0, pytest.approx(1.2), 0.002)
    sheet = put_together(layer, 1)
    rows, columns = np.mgrid[:600, :400]
    clear = (rows >= 500) & (columns < 100)
    assert np.array_equal(sheet[..., 3] < 128, clear)
    smooth = ~clear & (rows % 256 > 8) & (rows % 256 < 248) & (columns % 256 > 8)
    smooth &= (columns % 256 < 248) & ((rows < 492) | (columns > 108))
    assert np.abs(sheet[..., 2].astype(int) - rows % 256)[smooth].max() < 12  # red, BGRA
    assert np.abs(sheet[..., 1].astype(int) - columns % 256)[smooth].max() < 12


def test_a_coarser_level_is_the_mean_of_the_finer(workspace: Path) -> None:
    layer = mosaic_layer(workspace)
    fine, coarse = put_together(layer, 1).astype(float), put_together(layer, 0).astype(float)
    mean = fine.reshape(300, 2, 200, 2, 4).mean(axis=(1, 3))
    inner = mean[..., 3] == 255
    assert np.abs(mean - coarse)[inner][:, :3].mean() < 3.0
    assert coarse.shape[:2] == (300, 200)


def test_a_mosaic_too_large_is_shrunk(workspace: Path) -> None:
    layer = mosaic_layer(workspace, max_px=60_000)
    assert layer.width_px * layer.height_px <= 61_000
    assert layer.pixel_m * layer.width_px == pytest.approx(0.8)


@pytest.mark.parametrize("width", [3, 1000, 2719])
def test_a_raster_that_fits_keeps_its_own_grid(width: int, tmp_path: Path) -> None:
    path = write_raster(tmp_path / "a.tif", np.ones((1, 2, width), np.uint8), 0.0018, (-2.3, 4.1))
    assert read_shrunk(path, [1], 1e6)[1] == Affine(0.0018, 0, -2.3, 0, -0.0018, 4.1)


@pytest.mark.parametrize("columns", [COLUMNS, COLUMNS + 3])
def test_errors_of_an_earlier_surface_are_no_layer(columns: int, tmp_path: Path) -> None:
    """Nor a value under the cursor: they may have been evaluated over another plane."""
    workspace = tiny_workspace(tmp_path)
    shutil.copytree(workspace / "dense", workspace / "evaluation")
    errors = np.full((1, ROWS, columns), 0.001, np.float32)
    path = workspace / "evaluation" / "error.tif"
    write_raster(path, errors, CELL_M, (0.0, ROWS * CELL_M), nodata=np.nan, crs="EPSG:32636")
    is_current = columns == COLUMNS
    for layers in (
        picture_layers(Held.of(workspace)),
        Layers(Workspace(workspace)).picture_layers(),
    ):
        assert ("error" in {layer.name for layer in layers}) == is_current
    found = values_at(workspace, (0.4, 1.0))
    assert ("evaluation/error.tif" in found) == is_current and "dense/dem.tif" in found


def test_numbers_are_coloured_between_limits_of_the_legend(workspace: Path) -> None:
    layers = {layer.name: layer for layer in picture_layers(Held.of(workspace))}
    assert list(layers) == ["mosaic", "dem", "sigma", "slope", "stations"]
    assert [name for name, layer in layers.items() if layer.shown] == ["mosaic"]
    scale = layers["sigma"].scale
    assert scale is not None
    assert scale.label == "sigma of height, mm"
    assert (scale.low, scale.high) == (0.0, pytest.approx(0.5))
    assert all(len(colour) == 7 for colour in scale.colours)
    height = layers["dem"].scale
    assert height is not None
    assert -10.0 <= height.low < height.high <= -10.0 + 0.25 * 0.8
    hole = put_together(layers["dem"], 0)[105:, :15]
    assert (hole[..., 3] == 0).all()
