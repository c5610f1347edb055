"""The score measures the error that was put in, and nothing else."""

import numpy as np
import pytest
import shapely
from scipy.spatial.transform import RigidTransform, Rotation
from shapely.geometry import MultiPolygon, Polygon

from alice_survey.core.config import SeafloorConfig
from alice_survey.sim.seafloor.terrain import Terrain, build_terrain
from reconstruct.elevation import Elevation
from reconstruct.evaluate.run import score_cameras
from reconstruct.evaluate.scores import SurfaceScore, area_in_world, score_surface
from reconstruct.evaluate.truth import surface_depth

HOLE = [(1.0, 0.8), (1.6, 0.8), (1.6, 1.4), (1.0, 1.4)]
AREA = MultiPolygon([
    Polygon([(0.5, 0.5), (2.0, 0.5), (2.0, 2.0), (0.5, 2.0)], [HOLE]),
    Polygon([(2.3, 0.5), (2.9, 0.5), (2.9, 2.0)]),
])  # fmt: skip
"""Two parts, one with a hole."""
CELL = 0.02
SHIFT = RigidTransform.from_components([0.3, -0.2, 0.05], Rotation.from_rotvec([0, 0, 0.02]))


@pytest.fixture(scope="module")
def terrain() -> Terrain:
    config = SeafloorConfig(relief_m=0.2, grid_m=0.02, rocks_per_m2=0.3, amphora=False)
    return build_terrain(config, (-1.0, 4.0, -1.0, 4.0), 10.0, np.random.default_rng(1))


def scored(
    terrain: Terrain,
    error_m: float,
    *,
    holes: float = 0.0,
    elsewhere_m: float | None = None,
) -> SurfaceScore:
    """The true surface as a model sees it whose world is shifted by SHIFT, with an error.

    Outside of the area the error is `elsewhere_m`, if that is given.
    """
    north, east = np.arange(3.4, -0.6, -CELL) - CELL / 2, np.arange(-0.6, 3.4, CELL) + CELL / 2
    norths, easts = np.meshgrid(north, east, indexing="ij")
    world = np.stack([norths, easts, np.zeros_like(norths)], axis=-1).reshape(-1, 3)
    true = SHIFT.apply(world)
    depth = surface_depth(terrain, true[:, :2]) - SHIFT.translation[2]
    outside = ~shapely.contains_xy(AREA, true[:, 0], true[:, 1])
    errors = np.where(outside, error_m if elsewhere_m is None else elsewhere_m, error_m)
    heights = (-depth + errors).reshape(norths.shape)
    heights[np.random.default_rng(2).random(heights.shape) < holes] = np.nan
    model = Elevation(
        height=heights, sigma=np.full(heights.shape, 0.002), west=-0.6, north=3.4, cell=CELL
    )
    return score_surface(model, AREA, terrain, SHIFT, 0.0015)


def test_a_true_surface_scores_zero(terrain: Terrain) -> None:
    score = scored(terrain, 0.0)
    assert score.completeness > 0.99
    assert np.abs(score.height_m).max() < 1e-5
    assert score.distance_m.max() < 1e-5


def test_an_error_and_holes_are_measured(terrain: Terrain) -> None:
    score = scored(terrain, 0.012, holes=0.25)
    figures = score.to_json()
    assert figures["height_rms_mm"] == pytest.approx(12.0, abs=0.01)
    assert 8.0 < figures["distance_rms_mm"] < 12.0
    assert score.completeness == pytest.approx(0.75, abs=0.02)
    assert np.all(score.distance_m <= np.abs(score.height_m) + 1e-5)  # depths are of 32 bits


def test_sigmas_and_ground_pixels_are_compared_with_the_error(terrain: Terrain) -> None:
    figures = scored(terrain, 0.004).to_json()
    assert figures["error_over_sigma"]["rms"] == pytest.approx(2.0, abs=0.01)
    assert figures["error_over_sigma"]["within_1_sigma"] == 0
    assert figures["height_median_mm"] == pytest.approx(4.0, abs=0.01)
    assert abs(figures["doming"]["dome_mm"]) < 0.01

    # 4 mm in height are less in distance where the surface is steep, and 2.67 ground pixels.
    assert figures["completeness_within_px"]["3"] > 0.98
    assert figures["completeness_within_px"]["1"] < 0.1


def test_the_area_moves_with_the_model(terrain: Terrain) -> None:
    moved = area_in_world(AREA, terrain, SHIFT)
    assert moved.area == pytest.approx(AREA.area, rel=1e-9)
    assert [len(part.interiors) for part in moved.geoms] == [1, 0]
    for there, here in zip(shapely.get_coordinates(moved), shapely.get_coordinates(AREA),
                           strict=True):  # fmt: skip
        back = SHIFT.apply([there[0], there[1], terrain.offset_ned[2]])[:2]
        np.testing.assert_allclose(back, here, atol=1e-9)


def test_cameras_are_aligned_without_scale() -> None:
    rng = np.random.default_rng(3)
    truth = {
        f"left/{i:03d}.png": RigidTransform.from_components(
            rng.uniform(-2, 2, 3), Rotation.random(rng=rng)
        )
        for i in range(30)
    }
    world = {name: SHIFT.inv() * pose for name, pose in truth.items()}

    exact = score_cameras(world, truth, 31)
    grown = {
        name: RigidTransform.from_components(1.002 * p.translation, p.rotation)
        for name, p in world.items()
    }
    large = score_cameras(grown, truth, 31)

    assert exact.rms_m < 1e-9
    assert exact.turns_deg.max() < 1e-5
    assert abs(exact.scale_error) < 1e-9
    assert (exact.registered, exact.total) == (30, 31)
    assert large.scale_error == pytest.approx(0.002, rel=1e-6)
    places = np.stack([p.translation for p in truth.values()])
    spread = np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=1).mean())
    assert large.rms_m == pytest.approx(0.002 * spread, rel=1e-2)
