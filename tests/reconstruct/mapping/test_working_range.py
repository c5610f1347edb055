from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from alice_survey.core.errors import ReconstructionError
from alice_survey.core.executor import SERIAL
from camera_calib.rig import Rig
from reconstruct.mapping.working_range import (
    find_distances,
    first_stations,
    ray_passes,
    refuse_exchanged,
)
from reconstruct.matching.features import Features, save_features
from tests.reconstruct.rig_survey import four_cameras
from tests.reconstruct.scenes import ALTITUDE_M, Scene, make_scene
from tests.refusals import refused


def features_of(scene: Scene, folder: Path) -> list[Path]:
    """Features whose descriptors determine which point they show."""
    codes = np.random.default_rng(0).integers(0, 90, (len(scene.points_ned), 128))
    paths = []
    for i, (pixels, ids) in enumerate(zip(scene.pixels, scene.ids, strict=True)):
        features = Features(
            pixels=pixels,
            scale_px=np.ones(len(ids), np.float32),
            descriptors=codes[ids].astype(np.uint8),
        )
        paths.append(folder / f"{i}.npz")
        save_features(paths[-1], features)
    return paths


@pytest.mark.parametrize("rig", [None, four_cameras()], ids=["stereo", "four cameras"])
def test_stereo_matches_give_the_distance(tmp_path: Path, rig: Rig | None) -> None:
    """Also of cameras that look obliquely, and see farther along their axes."""
    scene = make_scene(lines=1, stations=4, points=2500, noise_px=0.2, rig=rig)
    paths = features_of(scene, tmp_path)
    found = find_distances(scene.records, paths, scene.rig, executor=SERIAL)
    depths = []
    for (i, one), (j, other) in permutations(enumerate(scene.records), 2):
        if one.station == other.station:
            shared = np.intersect1d(scene.ids[i], scene.ids[j])
            pose = scene.ned_from_cam[i].inv()
            depths.append(pose.apply(scene.points_ned[shared]).reshape(-1, 3)[:, 2])
    near, far = np.percentile(np.concatenate(depths), [2, 98])
    assert found.source == "stereo"
    assert found.near_m == pytest.approx(near, abs=0.02)
    assert found.far_m == pytest.approx(far, abs=0.02)


@pytest.mark.parametrize("rig", [None, four_cameras()], ids=["stereo", "four cameras"])
def test_cameras_that_are_exchanged_are_refused(tmp_path: Path, rig: Rig | None) -> None:
    """By a few stations, before others have features."""
    scene = make_scene(lines=1, stations=8, points=2500, noise_px=0.2, rig=rig)
    paths = features_of(scene, tmp_path)
    first = first_stations(scene.records)
    assert len({scene.records[i].station for i in first}) >= 6
    files = [paths[i] for i in first]
    records = [scene.records[i] for i in first]
    refuse_exchanged(records, files, scene.rig, executor=SERIAL)
    if rig is None:
        other = {"left": "right", "right": "left"}
        records = [replace(record, camera=other[record.camera]) for record in records]
        with refused(ReconstructionError, "left", "right"):
            refuse_exchanged(records, files, scene.rig, executor=SERIAL)


def test_the_altitude_stands_in(tmp_path: Path) -> None:
    scene = make_scene(lines=1, stations=2, points=10)
    paths = features_of(scene, tmp_path)
    arguments = (scene.records, paths, scene.rig)
    measured = find_distances(*arguments, executor=SERIAL)
    assert measured.source == "altitude"
    assert 2 / (1 / measured.near_m + 1 / measured.far_m) == pytest.approx(ALTITUDE_M + 0.03)
    blind = [replace(r, altitude_m=np.nan) for r in scene.records]
    with pytest.raises(ReconstructionError, match="altitude"):
        find_distances(blind, paths, scene.rig, executor=SERIAL)


def test_cameras_without_refraction_need_no_distance(tmp_path: Path) -> None:
    scene = make_scene(lines=1, stations=2, points=10)
    paths = features_of(scene, tmp_path)
    blind = [replace(r, altitude_m=np.nan) for r in scene.records]
    cameras = {name: camera.in_air() for name, camera in scene.rig.cameras.items()}
    rig = replace(scene.rig, cameras=cameras)
    found = find_distances(blind, paths, rig, executor=SERIAL)
    assert 0 < found.near_m < found.far_m and found.source == "no refraction"


def test_rays_pass_where_they_were_built_to() -> None:
    rng = np.random.default_rng(1)
    target = rng.normal(0, 1, (30, 3)) + np.array([0, 0, 5])
    start_a = rng.normal(0, 0.1, (30, 3))
    start_b = rng.normal(0, 0.1, (30, 3)) + np.array([0.5, 0, 0])
    ray_a, ray_b = target - start_a, target - start_b
    reach = np.linalg.norm(ray_a, axis=1)
    ray_a, ray_b = (r / np.linalg.norm(r, axis=1, keepdims=True) for r in (ray_a, ray_b))
    lift = np.cross(ray_a, ray_b)
    lift *= 0.01 / np.linalg.norm(lift, axis=1, keepdims=True)
    along, gap = ray_passes(start_a, ray_a, start_b + lift, ray_b)
    np.testing.assert_allclose(along, reach, rtol=1e-9)
    np.testing.assert_allclose(gap, 0.01, rtol=1e-6)
    parallel = ray_passes(start_a[:1], ray_a[:1], start_b[:1], ray_a[:1])
    assert np.isnan(parallel[0]).all()
