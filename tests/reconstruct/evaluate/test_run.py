"""The score measures the error that was put in, and nothing else."""

import math

import numpy as np
import pytest
import shapely
from scipy.spatial.transform import RigidTransform, Rotation
from shapely.geometry import MultiPolygon, Polygon

from alice_survey.core.config import SeafloorConfig
from alice_survey.core.frames import Datum
from alice_survey.sim.seafloor.terrain import Terrain, build_terrain
from missions.values.area import Area
from missions.values.legs import Leg, Route
from missions.values.line import Line, LineKind
from missions.values.plan_file import Dive, Plan
from reconstruct.evaluate.elevation import Elevation
from reconstruct.evaluate.mosaic import area_in_world
from reconstruct.evaluate.run import score_cameras
from reconstruct.evaluate.surface import CountStations, SurfaceScore, score_surface
from reconstruct.evaluate.truth import neighbours, surface_depth

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


def everywhere(points_ned: np.ndarray) -> np.ndarray:
    """Three stations see every point."""
    return np.full(len(points_ned), 3)


def scored(
    terrain: Terrain,
    error_m: float,
    *,
    holes: float = 0.0,
    elsewhere_m: float | None = None,
    stations: CountStations = everywhere,
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
    return score_surface(model, AREA, terrain, SHIFT, 0.0015, stations)


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


def test_sigmas_stations_and_ground_pixels_are_compared_with_the_error(terrain: Terrain) -> None:
    def western_half(points_ned: np.ndarray) -> np.ndarray:
        return np.where(points_ned[:, 1] < 1.25, 3, 2)

    score = scored(terrain, 0.004, stations=western_half)
    figures = score.to_json()
    assert figures["error_over_sigma"]["rms"] == pytest.approx(2.0, abs=0.01)
    assert figures["error_over_sigma"]["within_1_sigma"] == 0
    assert figures["volume"]["mean_height_error_mm"] == pytest.approx(4.0, abs=0.01)
    assert abs(figures["doming"]["dome_mm"]) < 0.01
    well = figures["seen_from_3_stations"]
    west = shapely.intersection(AREA, shapely.box(0, 0, 4, 1.25)).area
    assert well["share"] == pytest.approx(west / AREA.area, abs=0.04)
    assert well["completeness"] > 0.98
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


def plan_with(lines: list[Line]) -> Plan:
    area = Area(
        datum=Datum(latitude_deg=32.8, longitude_deg=34.9), survey=AREA, allowed=AREA,
        no_go=MultiPolygon(),
    )  # fmt: skip
    leg = Leg(
        start_ne_m=(0.0, 0.0), heading_rad=0.0, length_m=1.0, curvature_per_m=0.0, line=0
    )  # fmt: skip
    dive = Dive(
        first_line=0, last_line=len(lines) - 1, route=Route(legs=(leg,)), duration_s=5.0,
        energy_wh=1.0,
    )  # fmt: skip
    return Plan(
        name="lines", area=area, home_ne_m=(0.0, 0.0), seafloor_depth_m=10.0, altitude_m=2.0,
        speed_mps=0.2, interval_s=1.0, exposure_s=0.003, strobe_pulse_s=0.003, strobe_lead_s=0.0,
        footprint_m=(1.4, 1.15), line_spacing_m=1.0, station_spacing_m=0.4,
        reached_forward_overlap=0.6, reached_side_overlap=0.3, lines=tuple(lines), dives=(dive,),
        turn_radius_m=0.5, run_in_m=0.5, length_m=1.0, duration_s=5.0,
        energy_wh=1.0, coverage=1.0, details={},
    )  # fmt: skip


def line_at(
    along: tuple[float, float], across_m: float, heading_rad: float, kind: LineKind = "survey"
) -> Line:
    ahead = np.array([math.cos(heading_rad), math.sin(heading_rad)])
    start, end = (a * ahead + across_m * np.array([-ahead[1], ahead[0]]) for a in along)
    return Line(
        kind=kind, start_ne_m=(start[0], start[1]), end_ne_m=(end[0], end[1]), stations=20
    )  # fmt: skip


@pytest.mark.parametrize("heading_rad", [0.0, 1.1, 4.0])
def test_neighbours_are_the_adjacent_lines_not_the_next_ones(heading_rad: float) -> None:
    lines = [
        line_at((0.0, 10.0), 0.0, heading_rad),
        line_at((12.0, 20.0), 1.0, heading_rad),  # of another cell, ahead
        line_at((0.0, 10.0), 2.0, heading_rad),
        line_at((9.0, 2.0), 1.0, heading_rad),  # between, the other way
        line_at((0.0, 10.0), 1.0, heading_rad, "fill"),
        line_at((0.0, 10.0), -1.0, heading_rad + math.pi / 2, "cross"),
    ]
    found = {(i, j): strip for i, j, strip in neighbours(plan_with(lines))}
    assert set(found) == {(0, 3), (2, 3)}
    ahead = np.array([math.cos(heading_rad), math.sin(heading_rad)])
    for strip in found.values():
        along = np.array(strip.exterior.coords) @ ahead
        np.testing.assert_allclose([along.min(), along.max()], [2.0, 9.0], atol=1e-9)


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
