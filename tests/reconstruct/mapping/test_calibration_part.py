"""What a wrong calibration does to a block, against what is stated of it."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from alice_survey.base.frames import Array
from camera_calib.rig import Covariance, Rig
from reconstruct.mapping.arrays import observed
from reconstruct.mapping.mapper import Mapped
from reconstruct.mapping.normal_equations import Gauge
from reconstruct.mapping.refraction import refract
from reconstruct.mapping.uncertainty import (
    CalibrationPart,
    calibration_part,
    estimate,
    pinhole_observations,
)
from reconstruct.placing.alignment import align_rigid
from tests.oracles_refraction import laid_onto
from tests.reconstruct.scenes import Scene, make_scene
from tests.reconstruct.true_models import near_truth, true_stations, warped_scene

NOISE_PX = 0.1
SIGMAS = {
    "left.fx_px": 0.3,
    "left.k1": 2e-4,
    "left.normal_x": 5e-4,
    "right.port_distance_m": 5e-4,
    "right.ry_rad": 5e-5,
    "right.z_m": 1e-4,
}


@cache
def clean() -> Scene:
    found = make_scene(lines=2, stations=5, points=900, scale=1, relief_m=0.3)
    known = Covariance(parameters=tuple(SIGMAS), matrix=np.diag([s**2 for s in SIGMAS.values()]))
    return replace(found, rig=replace(found.rig, covariance=known))


def scene(seed: int = 0) -> Scene:
    """The same block with other noise."""
    rng = np.random.default_rng(seed)
    pixels = [p + rng.normal(0, NOISE_PX, p.shape) for p in clean().pixels]
    return replace(clean(), pixels=pixels)


def off(rig: Rig, steps: dict[str, float]) -> Rig:
    """A rig whose parameters are off by so much."""
    cameras, poses = dict(rig.cameras), dict(rig.cam_from_rig)
    for name, step in steps.items():
        camera, field = name.split(".")
        if field.endswith("_rad"):
            turn = Rotation.from_rotvec(step * np.eye(3)["xyz".index(field[1])])
            pose = poses[camera]
            poses[camera] = type(pose).from_components(pose.translation, turn * pose.rotation)
        elif field in ("x_m", "y_m", "z_m"):
            pose = poses[camera]
            moved = pose.translation + step * np.eye(3)["xyz".index(field[0])]
            poses[camera] = type(pose).from_components(moved, pose.rotation)
        else:
            now = cameras[camera]
            cameras[camera] = now.with_parameters({field: now.parameter(field) + step})
    return replace(rig, cameras=cameras, cam_from_rig=poses)


def points_with(rig: Rig, folder: Path, seed: int = 0) -> tuple[Mapped, Array]:
    """The model of the same pictures by who believes in a rig, and its points."""
    believed = replace(scene(seed), rig=rig)
    seen, lenses = warped_scene(believed)
    mapped, _ = refract(near_truth(believed, seen, lenses, np.random.default_rng(1)), seen, folder)
    return mapped, observed(mapped.model).points


def shape_of(points: Array, true: Array) -> Array:
    return align_rigid(points, true).apply(points) - true


@pytest.mark.parametrize("name", SIGMAS)
def test_a_wrong_parameter_moves_the_points_as_predicted(name: str, tmp_path: Path) -> None:
    mapped, true = points_with(scene().rig, tmp_path)
    part = calibration_part(mapped, warped_scene(scene())[0], scene().rig)
    assert part is not None
    step = SIGMAS[name]
    _, found = points_with(off(scene().rig, {name: step}), tmp_path)
    expected = part.points[:, :, list(SIGMAS).index(name)] * step
    found, expected = shape_of(found, true), shape_of(true + expected, true)
    assert np.linalg.norm(found) > 1e-5 * np.sqrt(len(found))
    assert np.linalg.norm(found - expected) < 0.1 * np.linalg.norm(expected)


def test_with_random_errors_of_calibration_the_block_is_as_good_as_stated(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    stations, points, too_sure = [], [], []
    for seed in range(12):
        steps = {name: float(s * rng.normal()) for name, s in SIGMAS.items()}
        rig = off(scene().rig, steps)
        mapped, _ = points_with(rig, tmp_path, seed)
        seen = warped_scene(replace(scene(seed), rig=rig))[0]
        part = calibration_part(mapped, seen, rig)
        found = estimate(mapped, seen.images, None, part)
        away = laid_onto(
            mapped.model,
            found,
            true_stations(scene(), mapped),
            scene().points_ned,
            depth_of(mapped),
        )
        stations.append(away[0] / sigmas_of(found.frame_cov))
        points.append(away[1] / sigmas_of(found.point_cov))
        without = estimate(mapped, seen.images, None)
        too_sure.append(away[1] / sigmas_of(without.point_cov))
    for ratios in (stations, points):
        assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.4
    assert np.sqrt(np.mean(np.square(too_sure))) > 1.8, "then the calibration would not matter"


def depth_of(mapped: Mapped) -> float:
    frames = np.array(sorted(mapped.model.frames), dtype=np.int64)
    arm = pinhole_observations(mapped.model, observed(mapped.model), frames)[0].arm
    return float(np.median(np.linalg.norm(arm, axis=1)))


def sigmas_of(covariances: Array) -> Array:
    found: Array = np.sqrt(np.einsum("nii->ni", covariances))
    return found


def test_a_motion_of_the_whole_block_is_no_change_of_shape() -> None:
    rng = np.random.default_rng(6)
    centres, points = rng.normal(0, 2, (7, 3)), rng.normal(0, 2, (30, 3))
    gauge = Gauge(centres, 2.0, scale_free=False)
    motion = rng.normal(0, 1, (6, 2))
    part = CalibrationPart(
        frames=np.arange(7),
        stations=gauge.motions @ motion,
        places=points,
        points=gauge.of_points(points) @ motion,
        covariance=np.eye(2),
    ).without(gauge)
    assert np.abs(part.of_stations()).max() < 1e-20
    assert np.abs(part.of_points(points)).max() < 1e-20


def test_a_rig_without_covariance_adds_nothing(tmp_path: Path) -> None:
    mapped, _ = points_with(scene().rig, tmp_path)
    unknown = replace(scene().rig, covariance=None)
    assert calibration_part(mapped, warped_scene(scene())[0], unknown) is None


def test_a_station_that_sees_next_to_nothing_stays(tmp_path: Path) -> None:
    mapped, _ = points_with(scene().rig, tmp_path)
    lonely = [9, 10]
    for point in {
        p.point3D_id for n in lonely for p in mapped.model.images[n].get_observation_points2D()
    }:
        mapped.model.delete_point3D(point)
    part = calibration_part(mapped, warped_scene(scene())[0], scene().rig)
    assert part is not None
    assert np.isfinite(part.stations).all()
    assert np.all(part.stations[4] == 0)
    assert np.all(np.abs(np.delete(part.stations, [0, 4], axis=0)).max(axis=(1, 2)) > 0)
