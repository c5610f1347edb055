"""A mosaic that is painted elsewhere than the truth is found to be off by just that."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
from scipy.spatial.transform import RigidTransform
from shapely.geometry import MultiPolygon, box

from alice_survey.core.config import SeafloorConfig
from alice_survey.sim.seafloor.terrain import Terrain, build_terrain
from alice_survey.sim.seafloor.texture import Texture, survey_texture
from reconstruct.elevation import Elevation
from reconstruct.evaluate.figures import compare_lengths
from reconstruct.evaluate.scores import score_mosaic
from reconstruct.evaluate.truth import surface_material
from tests.alice_survey.app.report.tiny import write_raster

PIXEL, SIDE = 0.002, 700
AREA = MultiPolygon([box(0.05, 0.05, 1.35, 1.35)])
STILL = RigidTransform.identity()


@pytest.fixture(scope="module")
def floor() -> tuple[Terrain, Texture]:
    config = SeafloorConfig(relief_m=0.1, grid_m=0.02, rocks_per_m2=0.0, amphora=False)
    terrain = build_terrain(config, (-1.0, 3.0, -1.0, 3.0), 10.0, np.random.default_rng(1))
    return terrain, survey_texture(1)


def write(
    folder: Path, floor: tuple[Terrain, Texture], off_m: tuple[float, float], scale: float = 1.0
) -> tuple[Path, Elevation]:
    """Mosaic and elevation model whose content lies `off_m` (east, north) of where it should."""
    terrain, texture = floor
    rows, columns = np.mgrid[:SIDE, :SIDE] + 0.5
    east, north = columns * PIXEL, 1.4 - rows * PIXEL
    shown = np.stack([north - off_m[1], east - off_m[0]], axis=-1).reshape(-1, 2) / scale
    points, material = surface_material(terrain, shown)
    colour = texture.albedo(points, material, np.full(len(points), PIXEL, np.float32))
    picture = np.clip(255 * colour.T.reshape(3, SIDE, SIDE), 0, 255).astype(np.uint8)
    rgba = np.concatenate([picture, np.full((1, SIDE, SIDE), 255, np.uint8)])
    write_raster(folder / "mosaic.tif", rgba, PIXEL, (0, 1.4))
    height = -scale * points[:, 2].reshape(SIDE, SIDE)
    surface = Elevation(height=height, sigma=0 * height, west=0.0, north=1.4, cell=PIXEL)
    return folder / "mosaic.tif", surface


def test_a_shift_is_measured_in_length_and_pixels(
    floor: tuple[Terrain, Texture], tmp_path: Path
) -> None:
    true = score_mosaic(*write(tmp_path / "a", floor, (0.0, 0.0)), AREA, *floor, STILL).to_json()
    assert true["clear_share"] > 0.95
    assert true["position_rms_px"] < 0.05
    off = score_mosaic(*write(tmp_path / "b", floor, (0.006, -0.004)), AREA, *floor, STILL)
    np.testing.assert_allclose(np.median(off.shifts_m, axis=0), [0.006, -0.004], atol=2e-4)
    figures = off.to_json()
    assert figures["position_rms_px"] == pytest.approx(np.hypot(3, 2), rel=0.05)
    assert figures["position_rms_mm"] == pytest.approx(1e3 * np.hypot(0.006, 0.004), rel=0.05)

    # lengths between patches give the scale
    grown = score_mosaic(*write(tmp_path / "c", floor, (0.0, 0.0), 1.004), AREA, *floor, STILL)
    found = compare_lengths(grown.points_world, grown.points_true, np.random.default_rng(2))
    assert found["scale_error_ppm"] == pytest.approx(4000, rel=0.05)


def test_a_mosaic_of_something_else_matches_nowhere(
    floor: tuple[Terrain, Texture], tmp_path: Path
) -> None:
    mosaic, dem = write(tmp_path, floor, (0.0, 0.0))
    with rasterio.open(mosaic, "r+") as target:
        noise = np.random.default_rng(3).integers(0, 255, (3, SIDE, SIDE), dtype=np.uint8)
        target.write(noise, indexes=[1, 2, 3])
    figures = score_mosaic(mosaic, dem, AREA, *floor, STILL).to_json()
    assert figures["clear_share"] < 0.1
    assert figures["coverage"] > 0.98
