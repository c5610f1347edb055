"""The harbour's truth, its judge, and its pictures, each by a second route."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.frames import Array
from alice_survey.sim.seafloor.renderer import Scene
from alice_survey.sim.seafloor.texture import Texture
from benchmarks.harbour_judge import (
    Truth,
    align_cameras,
    completeness,
    overhangs,
    points_near,
    score_points,
    slope_class,
    true_harbour,
)
from benchmarks.harbour_masks import MaskTask, count_pixels, fish_in, shadow_in, shares
from benchmarks.harbour_meshes import moving_at, still_harbour
from benchmarks.harbour_scene import FISH, PARTS, Ellipsoid
from benchmarks.harbour_sight import instants_that_see, surface_samples, trace
from benchmarks.harbour_survey import body_poses, harbour_rig, quick_stations, stations, time_of
from benchmarks.harbour_truth import clearance, distances, moving_distance, normals, solid_distance
from camera_calib.camera import Camera
from tests.cameras import range_map

QUICK = tuple(quick_stations())


@pytest.fixture(scope="module")
def truth() -> Truth:
    return true_harbour(QUICK, 12, spacing_m=0.1)


@pytest.mark.slow
def test_meshes_lie_on_the_true_surface_and_face_the_water() -> None:
    for item in still_harbour().objects:
        vertices = item.vertices.astype(np.float64) + still_harbour().offset_ned
        chosen = np.nonzero((vertices[:, 2] > 1.81) & (vertices[:, 1] > -3.0))[0]
        chosen = chosen[:: max(len(chosen) // 300, 1)]
        gap = distances(vertices[chosen])[0]
        assert gap.max() < 2e-6, item.name
        chosen = chosen[gap > -1e-5]  # not what is within another body
        assert len(chosen) > 30, item.name
        outside = distances(vertices[chosen] + 1e-3 * item.normals[chosen].astype(np.float64))[0]
        assert np.median(outside) > 0.5e-3, item.name


def on_sphere(rng: np.random.Generator, count: int) -> Array:
    points = rng.normal(size=(count, 3))
    return np.asarray(points / np.linalg.norm(points, axis=1, keepdims=True))


def test_the_distance_from_an_ellipsoid_is_that_to_the_nearest_of_many_points() -> None:
    solid = Ellipsoid(name="boulder", centre=(1, 2, 3), semi_axes=(0.3, 0.2, 0.1), heading_deg=25)
    rng = np.random.default_rng(0)
    ball = on_sphere(rng, 200_000)
    turn = Rotation.from_euler("Z", 25, degrees=True)
    surface = turn.apply(ball * solid.semi_axes) + np.asarray(solid.centre)
    points = rng.uniform(-0.5, 0.5, (60, 3)) + np.asarray(solid.centre)
    nearest = np.linalg.norm(points[:, None] - surface[None], axis=2).min(axis=1)
    inside = (((turn.inv().apply(points - np.asarray(solid.centre))) / solid.semi_axes) ** 2).sum(1)
    expected = np.where(inside < 1, -nearest, nearest)
    np.testing.assert_allclose(solid_distance(solid, points), expected, atol=2e-3)


def test_distances_follow_a_shift_along_the_normal(truth: Truth) -> None:
    away = normals(truth.samples)
    for shift in (0.002, -0.002):
        found = distances(truth.samples + shift * away)[0]
        assert np.median(np.abs(found - shift)) < 2e-6
        # In the joints of the wall and where two bodies meet the nearest point is another one.
        assert (np.abs(found - shift) < 1e-4).mean() > 0.93
        assert np.abs(found).max() < 0.002 + 1e-4


def test_nothing_is_nearer_than_the_clearance() -> None:
    points = np.random.default_rng(4).uniform([-3, -2.5, 2.5], [0.3, 6, 6.1], (6000, 3))
    exact, quick = distances(points)[0], clearance(points)
    outside = exact > 0
    assert np.all(quick[outside] <= exact[outside] + 1e-9)
    assert np.all((quick > 0) == outside)


def test_no_station_is_in_the_way_and_each_sees_something() -> None:
    planned = stations(0.3)
    assert 150 <= len(planned) <= 250
    rig, bodies = harbour_rig(8), body_poses(planned)
    left = bodies * rig.body_from_cam("left")
    assert distances(left.translation)[0].min() > 0.4
    ahead = left.rotation.apply([0.0, 0.0, 1.0])
    path = trace(left.translation, ahead, np.full(len(planned), 6.0))
    assert (np.abs(path - 2.0) < 1.2).mean() > 0.93
    down = np.rad2deg(np.arcsin(ahead[:, 2]))
    np.testing.assert_allclose(down, [one.down_deg for one in planned], atol=6.0)


def test_a_rung_hides_the_wall_behind_it() -> None:
    camera = harbour_rig(8).cameras["left"]
    rung = 3.68
    behind, clear = np.array([0.0, 0.8, rung]), np.array([0.0, 0.8, rung + 0.14])
    points = np.stack([behind, clear])
    points[:, 0] -= distances(points)[0]
    for _ in range(20):
        points[:, 0] += distances(points)[0]
    facing = np.tile([-1.0, 0.0, 0.0], (2, 1))
    level = Rotation.from_matrix([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    places = np.array([[-2.0, 0.8, rung], [-2.0, 0.8, rung], [-2.0, 0.8, rung + 0.14]])
    poses = RigidTransform.from_components(places, level)
    np.testing.assert_array_equal(instants_that_see(points, facing, [(camera, poses)]), [0, 3])


def test_a_perfect_cloud_is_complete_and_what_is_missing_counts(truth: Truth) -> None:
    sigma = np.full(len(truth.samples), 1e-3)
    score = score_points(truth.samples, sigma, truth)
    assert score["all"]["rms_mm"] < 0.02
    assert score["on_fish"] == 0.0
    found = completeness(points_near(truth.samples, truth), truth)
    assert found["two or more instants"]["complete"] == 1.0
    assert found["wall"]["area_m2"] > 2.0
    part = distances(truth.samples)[1]
    near = points_near(truth.samples[part != PARTS.index("ladder")], truth)
    found = completeness(near, truth)
    assert found["ladder"]["complete"] < 0.05
    assert found["wall"]["complete"] == 1.0
    assert completeness(points_near(truth.samples[:0], truth), truth)["wall"]["complete"] == 0.0


def test_a_shifted_cloud_errs_by_the_shift(truth: Truth) -> None:
    away = normals(truth.samples)
    wall = distances(truth.samples)[1] == PARTS.index("wall")
    moved = truth.samples + np.where(wall, 0.004, 0.001)[:, None] * away
    score = score_points(moved, np.full(len(moved), 2e-3), truth)["by"]
    assert score["wall"]["robust_mm"] == pytest.approx(4.0 * 1.4826, rel=0.02)
    assert score["wall"]["median_signed_mm"] == pytest.approx(4.0, rel=0.02)
    assert score["floor"]["rms_mm"] == pytest.approx(1.0, rel=0.05)
    assert score["floor"]["over_sigma_rms"] == pytest.approx(0.5, rel=0.05)
    assert score["wall"]["over_sigma_robust"] == pytest.approx(2.0 * 1.4826, rel=0.02)
    assert score["wall"]["beyond_5_sigma"] == 0.0
    assert score["60 to 100 deg"]["rms_mm"] > 3.0 > score["0 to 27 deg"]["rms_mm"]


def test_an_overhang_needs_both_of_its_surfaces() -> None:
    samples = surface_samples(
        np.array([-1.2, 3.6, 4.3]), np.array([0.0, 4.6, 6.1]), 0.06, np.random.default_rng(2)
    )
    planned = tuple(s for s in stations(0.6) if s.row in ("under hull", "hull", "floor", "tie"))
    rig, bodies = harbour_rig(8), body_poses(planned)
    away = normals(samples)
    cameras = [(camera, bodies * rig.body_from_cam(name)) for name, camera in rig.cameras.items()]
    truth = Truth(
        planned=planned, scale=8, samples=samples, part=distances(samples)[1], away=away,
        instants=instants_that_see(samples, away, cameras), spacing_m=0.06,
    )  # fmt: skip
    assert (slope_class(away) == 3).sum() > 30
    everything = np.ones(len(samples), bool)
    whole = overhangs(everything, truth)
    assert whole["columns"] > 5
    assert whole["both"] == 1.0
    halved = overhangs(truth.part != PARTS.index("hull"), truth)
    assert (halved["upper"], halved["both"]) == (0.0, 0.0)
    assert halved["lower"] == 1.0


def test_points_on_a_fish_are_found_and_kept_apart(truth: Truth) -> None:
    rng = np.random.default_rng(3)
    at = time_of(5)
    fish = FISH[1]
    ball = on_sphere(rng, 1000)
    points = fish.turn(at).apply(ball * fish.semi_axes) + fish.place(at)
    assert np.abs(moving_distance(points, at)[0]).max() < 1e-9
    cloud = np.concatenate([truth.samples, points])
    score = score_points(cloud, None, truth)
    assert score["on_fish"] == pytest.approx(1000 / len(cloud), rel=0.02)
    assert score["by"]["still"]["rms_mm"] < 0.1 < score["all"]["rms_mm"]


def test_moving_meshes_are_where_the_judge_takes_them_to_be() -> None:
    below = still_harbour().offset_ned
    for at in (0.0, 17.0):
        for item in moving_at(at):
            vertices = item.vertices[::7].astype(np.float64) + below
            fish, weed = moving_distance(vertices, at)
            if item.name == "fish":
                assert np.abs(fish).max() < 1e-5
            else:
                assert np.abs(weed).max() < 0.02


def test_cameras_are_aligned_and_their_scale_is_found() -> None:
    poses = body_poses(QUICK)
    truth = {str(k): poses[k] for k in range(len(poses))}
    turn = Rotation.from_euler("ZYX", [20.0, 3.0, -5.0], degrees=True)
    moved = {
        name: RigidTransform.from_components(
            1.001 * turn.apply(pose.translation) + [4.0, 5.0, 6.0], turn * pose.rotation
        )
        for name, pose in truth.items()
    }
    found = align_cameras(moved, truth).figures
    assert found["scale_error_ppm"] == pytest.approx(1000.0, abs=2.0)
    assert found["attitude_rms_deg"] < 1e-5
    centred = poses.translation - poses.translation.mean(axis=0)
    expected = 1e-3 * np.sqrt((centred**2).sum(axis=1).mean())
    assert found["rms_mm"] == pytest.approx(1e3 * expected, rel=1e-3)


def snell_rays(camera: Camera, pixels: Array) -> tuple[Array, Array]:
    """Where rays leave the port, and their directions in water, by Snell's law written out."""
    values = camera.to_json()
    normal = np.array(values["normal"])
    ray = camera.in_air().unproject(pixels)[1].reshape(-1, 3)
    place = ray * (values["port_distance_m"] / (ray @ normal))[:, None]
    for before, after, thickness in (
        (1.0, values["n_glass"], values["glass_thickness_m"]),
        (values["n_glass"], values["n_water"], 0.0),
    ):
        across = (before / after) * (ray - (ray @ normal)[:, None] * normal)
        ray = across + np.sqrt(1.0 - (across**2).sum(axis=1, keepdims=True)) * normal
        place = place + ray * (thickness / (ray @ normal))[:, None]
    return place, ray


@pytest.mark.parametrize("row", ["wall", "oblique", "under hull", "pile", "floor"])
def test_the_renderer_sees_what_snell_and_the_closed_form_say(row: str) -> None:
    camera = harbour_rig(16).cameras["left"]
    planned = stations(0.6)
    station = [k for k, one in enumerate(planned) if one.row == row][2]
    pose = body_poses(planned)[station] * harbour_rig(16).body_from_cam("left")
    scene = Scene(terrain=still_harbour(), texture=Texture(seed=1))
    rendered = range_map(scene, camera, pose, reach_m=4.0)
    origins, directions = snell_rays(camera, camera.pixel_centres())
    path = trace(pose.apply(origins), pose.rotation.apply(directions), np.full(len(origins), 6.0))
    expected = (origins[:, 2] + path * directions[:, 2]).reshape(rendered.shape)
    near = expected < 4.0
    # A traced ray ends up to 0.4 mm before the surface, more where it grazes.
    close = np.abs(rendered - expected) < 4e-3
    edges = np.abs(np.diff(expected, axis=1)) > 0.05
    assert near.sum() > 0.4 * near.size
    assert np.median(np.abs(rendered - expected)[near]) < 8e-4
    # Where an edge is off by a share of a pixel, that share of the pixels along it disagrees.
    wrong = (near & ~close).sum()
    assert wrong < 0.25 * max(edges.sum(), 40)


def fishy_station() -> int:
    """The one that sees most of a fish."""
    seen = [
        fish_in("left", 12, body_poses(QUICK)[k] * harbour_rig(12).body_from_cam("left"),
                time_of(k)).sum()
        for k in range(len(QUICK))
    ]  # fmt: skip
    assert max(seen) > 1000
    return int(np.argmax(seen))


@pytest.mark.slow
def test_fish_of_the_judge_are_those_of_the_renderer() -> None:
    station = fishy_station()
    camera = harbour_rig(12).cameras["left"]
    pose = body_poses(QUICK)[station] * harbour_rig(12).body_from_cam("left")
    fish = tuple(one for one in moving_at(time_of(station)) if one.name == "fish")
    assert len(fish) == len(FISH)
    still = still_harbour()
    without, with_fish = (
        range_map(Scene(terrain=terrain, texture=Texture(seed=1)), camera, pose, reach_m=4.0)
        for terrain in (still, replace(still, objects=still.objects + fish))
    )
    shown = np.nan_to_num(with_fish, nan=9.0) < np.nan_to_num(without, nan=9.0) - 0.01
    found = fish_in("left", 12, pose, time_of(station))
    assert (shown & found).sum() / (shown | found).sum() > 0.97
    assert abs(int(shown.sum()) - int(found.sum())) < 0.02 * shown.sum()


@pytest.mark.slow
def test_masks_are_judged_by_what_moves_and_by_shadows(tmp_path: Path) -> None:
    station = fishy_station()
    task = MaskTask(masks=tmp_path, planned=QUICK, scale=24, name="left", station=station)
    pose = body_poses(QUICK)[station] * harbour_rig(24).body_from_cam("left")
    fish = fish_in("left", 24, pose, time_of(station))
    nothing = shares(count_pixels(task))
    assert (nothing["recall"], nothing["still_masked"]) == (0.0, 0.0)
    (tmp_path / "left").mkdir()
    path = tmp_path / "left" / f"{station:04d}.png"
    cv2.imwrite(str(path), np.where(fish, 0, 255).astype(np.uint8))
    right = shares(count_pixels(task))
    assert (right["recall"], right["precision"], right["shadow_share"]) == (1.0, 1.0, 0.0)
    cv2.imwrite(str(path), np.zeros(fish.shape, np.uint8))
    all_masked = count_pixels(task)
    assert all_masked["hit"] == fish.sum()
    assert shares(all_masked)["still_masked"] == 1.0
    # A fish that is seen before a wall casts a shadow on it, about as large as itself.
    shadow = shadow_in(task, pose, ~fish)
    assert 0.3 * fish.sum() < shadow.sum() < 0.7 * fish.size
    assert all_masked["masked"] == fish.size
