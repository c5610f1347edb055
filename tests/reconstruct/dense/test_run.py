from pathlib import Path

import laspy
import numpy as np
import pytest
from scipy import ndimage

from alice_survey.app.stages import spec
from alice_survey.core.artefacts import read_json
from alice_survey.core.config import ReconstructConfig, SurveyConfig
from alice_survey.core.errors import ReconstructionError
from alice_survey.core.executor import SERIAL, local_executor
from alice_survey.core.products import rasters_in
from reconstruct.dense import run
from reconstruct.dense.stereo_pairs import in_frame
from tests import oracles_dense

pytestmark = pytest.mark.slow
SCENE = oracles_dense.block_scene()
CONFIG = SurveyConfig(reconstruct=ReconstructConfig())


VIEWS = oracles_dense.two_lines(-0.05, 0.3, 0.65)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("survey")
    oracles_dense.write_workspace(folder, VIEWS, SCENE)
    assert spec("dense").make(folder, CONFIG, SERIAL)
    return folder


def bands(workspace: Path, *names: str) -> list[np.ndarray]:
    return [oracles_dense.read_raster(workspace / "dense" / f"{name}.tif")[0] for name in names]


def middle(north: np.ndarray, east: np.ndarray) -> np.ndarray:
    """Where several stations look, the rim of the block left out by no one."""
    return (north > -0.2) & (north < 0.8) & (east > -0.2) & (east < 0.9)


def test_surface_agrees_with_the_truth_edges_included(workspace: Path):
    height, north, east = oracles_dense.read_raster(workspace / "dense" / "dem.tif")
    here = middle(north, east)
    assert np.isfinite(height[here]).mean() > 0.97
    error = (height + oracles_dense.sloped_with_step(north, east))[here]
    error = error[np.isfinite(error)]
    assert 3e-5 < np.median(np.abs(error)) < 3e-4  # matching alone gives 4e-4; a pixel is 4.7 mm
    assert abs(np.median(error)) < 8e-4
    # the block's sides, 0.1 m high, fill a cell's width around 1.6 m of rim
    assert np.mean(np.abs(error) > 0.01) < 0.03
    assert np.sqrt(np.mean(error**2)) < 0.012


def test_sigma_is_an_honest_bound(workspace: Path):
    height, north, east = oracles_dense.read_raster(workspace / "dense" / "dem.tif")
    sigma, count = bands(workspace, "sigma", "count")
    flat_part = middle(north, east) & (np.abs(north - 0.3) > 0.25) & (count > 0)
    error = (height + oracles_dense.sloped_with_step(north, east))[flat_part]
    ratio = np.sqrt(np.mean(np.clip(error / sigma[flat_part], -5, 5) ** 2))
    assert 0.15 < ratio < 1.2
    np.testing.assert_array_equal(np.isfinite(height), np.isfinite(sigma))
    assert (count[~np.isfinite(height)] == 0).all()
    assert np.median(count[flat_part]) > 4


def test_cloud_lies_on_the_surface_with_normals_up(workspace: Path):
    about = read_json(workspace / "dense" / "cloud.json")
    cloud = laspy.read(workspace / "dense" / "cloud.copc.laz")
    enu = cloud.xyz
    assert len(enu) == about["points"] > 20_000
    error = enu[:, 2] + oracles_dense.sloped_with_step(enu[:, 1], enu[:, 0])
    assert np.median(np.abs(error)) < 0.003
    normals = np.column_stack([cloud[f"n{axis}"] for axis in "xyz"])
    level = np.abs(enu[:, 1] - 0.3) > 0.3
    expected = np.array([-0.05, 0.08, 1.0]) / np.linalg.norm([0.05, 0.08, 1.0])
    np.testing.assert_allclose(np.median(normals[level], axis=0), expected, atol=0.02)
    assert cloud.sigma.min() > 0


def test_stations_and_slope(workspace: Path):
    _, north, east = oracles_dense.read_raster(workspace / "dense" / "dem.tif")
    count, stations, slope = bands(workspace, "count", "stations", "slope")
    assert (stations <= count).all()
    assert (2 * stations >= count).all()  # a station has two cameras
    assert np.median(stations[middle(north, east)]) >= 3
    flat_part = middle(north, east) & (np.abs(north - 0.3) > 0.25)
    assert np.nanmedian(slope[flat_part]) == pytest.approx(
        np.rad2deg(np.arctan(np.hypot(0.08, 0.05))), abs=0.5
    )
    assert np.nanmax(slope) > 60


def test_scratch_is_gone_and_files_are_there(workspace: Path):
    names = {path.name for path in (workspace / "dense").iterdir()}
    rasters = {one.path.name for one in rasters_in("dense")}
    styles = {f"{one.name}.qml" for one in rasters_in("dense") if one.palette}
    clouds = {"cloud.copc.laz", "cloud.json"}
    others = {"dem.png", "light.json", "moving.csv", "surface.json", "plane.json", "stage.json"}
    assert names == rasters | styles | clouds | others


def test_bytes_depend_on_no_number_of_processes_and_no_interruption(
    workspace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Two processes are interrupted while a plane is written, and two go on."""
    for name in ("images", "sparse"):
        (tmp_path / name).symlink_to(workspace / name)
    with monkeypatch.context() as interrupted:

        def stop(dem: Path, picture: Path) -> None:
            assert dem.exists()
            raise KeyboardInterrupt

        interrupted.setattr(run, "preview_dem", stop)
        with pytest.raises(KeyboardInterrupt):
            spec("dense").make(tmp_path, CONFIG, local_executor(2))
    assert (tmp_path / "dense.partial" / "dem.tif").exists()
    assert spec("dense").make(tmp_path, CONFIG, local_executor(2))
    assert not (tmp_path / "dense" / "planes").exists()
    for path in sorted((workspace / "dense").iterdir()):
        if path.name != "stage.json":
            assert (tmp_path / "dense" / path.name).read_bytes() == path.read_bytes(), path.name


def test_pictures_without_texture_are_refused(tmp_path: Path):
    grey = oracles_dense.Scene(
        depth_of=oracles_dense.flat, paint=lambda n, e: np.full((*n.shape, 3), 90.0)
    )
    views = oracles_dense.stereo_views(np.array([0.0, 0.3]), np.array([0.0, 0.0]))
    oracles_dense.write_workspace(tmp_path, views, grey)
    with pytest.raises(ReconstructionError):
        spec("dense").make(tmp_path, CONFIG, SERIAL)
    assert not (tmp_path / "dense").exists()


def test_what_one_stereo_pair_alone_sees_is_kept_with_an_honest_sigma(workspace: Path):
    height, north, east = oracles_dense.read_raster(workspace / "dense" / "dem.tif")
    (sigma,) = bands(workspace, "sigma")
    true = oracles_dense.sloped_with_step(north, east)
    ground = np.stack([north.ravel(), east.ravel(), true.ravel()], axis=1)
    left, right = np.split(np.array([in_frame(view, ground) for view in VIEWS]), 2)
    alone = ((left & right).sum(axis=0) == 1) & (left.sum(axis=0) + right.sum(axis=0) == 2)
    alone = alone.reshape(height.shape) & (np.hypot(north - 0.3, east - 0.35) > 0.4)
    alone = ndimage.binary_erosion(alone, iterations=2)  # of windows at a picture's border
    assert alone.sum() > 300

    known = np.isfinite(height) & alone
    ratio = (height + true)[known] / sigma[known]
    assert known.sum() > 0.9 * alone.sum()
    assert 0.5 < np.sqrt(np.mean(ratio**2)) < 1.3
