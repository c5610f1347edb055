"""Rims and overhangs in heights and mosaic, against a mesh whose rays another program traces."""

from pathlib import Path

import numpy as np
import pytest

from alice_survey.app.stages import spec
from alice_survey.core.config import ReconstructConfig, SurveyConfig
from alice_survey.core.executor import SERIAL
from tests.oracles_dense import boulder_scene, read_raster, two_lines, write_workspace

SCENE = boulder_scene(4)
VIEWS = two_lines(0.0, 0.45, 0.9)
CONFIG = SurveyConfig(reconstruct=ReconstructConfig(mask_moving=False))
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("boulders")
    write_workspace(folder, VIEWS, SCENE)
    assert spec("dense").make(folder, CONFIG, SERIAL)
    return folder


def test_heights_are_those_seen_from_above_within_their_sigmas(workspace: Path) -> None:
    height, north, east = read_raster(workspace / "dense" / "dem.tif")
    inside = (np.abs(north - 0.4) < 0.75) & (np.abs(east - 0.35) < 0.65)
    sigma, surfaces = (
        read_raster(workspace / "dense" / f"{n}.tif")[0] for n in ("sigma", "surfaces")
    )
    error = height + SCENE.depth_of(north, east)
    assert np.isfinite(height[inside]).mean() > 0.98
    known = inside & np.isfinite(height)
    ratio = np.abs(error / sigma)[known]
    assert 0.6 < np.sqrt(np.mean(ratio**2)) < 1.1  # 4 to 12 before rims had their sigma
    assert np.mean(ratio > 5.0) < 0.001
    wrong = np.abs(error[known]) > 0.1  # the ledge is 0.2 m over the floor
    assert 0.0002 < wrong.mean() < 0.006
    assert np.mean((surfaces[known] != 1)[wrong]) > 0.6


def test_all_that_any_picture_shows_is_painted(workspace: Path) -> None:
    assert spec("mosaic").make(workspace, CONFIG, SERIAL)
    rgba, north, east = read_raster(workspace / "mosaic" / "mosaic.tif", None)
    assert SCENE.cast is not None
    floor = np.stack([north, east, SCENE.depth_of(north, east)], axis=-1)
    shown = np.zeros(north.shape, bool)
    for view in VIEWS:
        pixels = view.project(floor.reshape(-1, 3)).reshape(*north.shape, 2)
        inside = ((pixels > 4) & (pixels < np.array(view.pinhole.size_px) - 4)).all(axis=-1)
        centre = np.broadcast_to(view.world_from_cam.translation, floor.shape)
        shown |= inside & (SCENE.cast(centre, floor - centre) > 0.998)
    shown &= (np.abs(north - 0.4) < 0.75) & (np.abs(east - 0.35) < 0.65)
    assert (rgba[3][shown] > 0).mean() > 0.996  # 0.98 without what is interpolated
    places = read_raster(workspace / "mosaic" / "coverage.tif", 3)[0]
    assert 0.001 < (places > 0).mean() < 0.03
