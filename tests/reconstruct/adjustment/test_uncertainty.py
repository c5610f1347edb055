"""Stated covariances against what many draws of noise show, and against dense algebra."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from scipy.linalg import block_diag
from scipy.spatial import KDTree
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.block_solver import BlockStep
from alice_survey.core.config import ReconstructConfig
from alice_survey.core.errors import WorkspaceError
from alice_survey.core.frames import Array
from benchmarks.bend_pipeline import Adjusted, adjusted
from camera_calib.freedom import POSE
from camera_calib.rig import Rig
from reconstruct.adjustment import exact_observations, uncertainty
from reconstruct.adjustment.exact_observations import Workers, exact_survey
from reconstruct.adjustment.exact_observations import exact_observations as linearised
from reconstruct.adjustment.normal_equations import Gauge, LinearObservations, reduce_points
from reconstruct.adjustment.survey_fit import (
    AdjustedSurvey,
    adjust_survey,
    fit_survey,
    shift_information,
)
from reconstruct.mapping.arrays import cross_matrices, frames_of, observations
from reconstruct.mapping.bundle import robust_weights
from reconstruct.mapping.mapper import Mapped
from reconstruct.mapping.refraction import adjust_freely
from reconstruct.placing.alignment import align_rigid, align_similarity, level
from reconstruct.placing.fit import fit_navigation
from reconstruct.placing.navigation import PLACE, body_from_pinhole
from reconstruct.placing.track import picture_modes
from reconstruct.views.model_files import as_transform
from tests.engines import PicklingThreads
from tests.oracles_refraction import dense_normal_equations, dense_of, laid_onto
from tests.reconstruct import true_models
from tests.reconstruct.adjustment.test_survey_fit import with_sigmas
from tests.reconstruct.scenes import DATUM, Scene, make_scene, stating

NOISE_PX = 0.3


@cache
def clean() -> Scene:
    return make_scene(lines=2, stations=5, points=700, scale=1, port_distance_m=0.05, relief_m=0.3)


def drawn(seed: int, folder: Path) -> tuple[Scene, Mapped]:
    """The same block with other noise, adjusted."""
    rng = np.random.default_rng(seed)
    pixels = [p + rng.normal(0, NOISE_PX, p.shape) for p in clean().pixels]
    scene = replace(clean(), pixels=pixels)
    return scene, true_models.refracted(scene, folder, rng)[0]


def test_errors_are_as_large_as_stated(tmp_path: Path) -> None:
    frames, points = [], []
    for seed in range(12):
        scene, mapped = drawn(seed, tmp_path)
        found = uncertainty.estimate(mapped, scene.records)
        misses, point_misses = _away(mapped, found, scene)
        frames.append(misses / _sigmas(found.frame_cov))
        points.append(point_misses / _sigmas(found.point_cov))
        assert found.sigma_px == pytest.approx(NOISE_PX, rel=0.12)
    ratios = np.sqrt((np.concatenate(frames) ** 2).mean(axis=0))
    assert np.all((ratios > 0.75) & (ratios < 1.3)), ratios
    assert 0.85 < np.sqrt((ratios**2).mean()) < 1.15
    point_ratios = np.sqrt((np.concatenate(points) ** 2).mean(axis=0))
    assert np.all((point_ratios > 0.8) & (point_ratios < 1.25)), point_ratios


def test_points_are_eliminated_as_dense_algebra_does(tmp_path: Path) -> None:
    _, mapped = drawn(0, tmp_path)
    few = _few(_observations(mapped), 40, np.random.default_rng(3))
    stations = int(few.station.max()) + 1
    reduced = reduce_points(few, stations)
    hessian, slope = dense_normal_equations(few, stations)
    size, count = 6 * stations, few.rest.shape[2] - 1
    own = np.r_[0:size, len(slope) - count : len(slope)]
    rest = np.r_[size : len(slope) - count]
    back = np.linalg.inv(hessian[np.ix_(rest, rest)])
    expected = (
        hessian[np.ix_(own, own)] - hessian[np.ix_(own, rest)] @ back @ hessian[np.ix_(rest, own)]
    )
    pull = slope[own] - hessian[np.ix_(own, rest)] @ back @ slope[rest]
    scale = np.abs(expected).max()
    np.testing.assert_allclose(dense_of(reduced), expected, atol=1e-9 * scale)
    together = np.concatenate([reduced.border[..., -1].ravel(), reduced.shared[:-1, -1]])
    np.testing.assert_allclose(together, pull, atol=1e-9 * np.abs(slope).max())

    rng = np.random.default_rng(1)
    steps, shared_step = rng.normal(0, 1e-3, (stations, 6)), rng.normal(0, 1e-3, count)
    moved = reduced.point_steps(BlockStep(poses=steps, shared=shared_step, gain=0.0, length=0.0))
    step = np.concatenate([steps.ravel(), shared_step])
    wanted = -back @ (slope[rest] + hessian[np.ix_(rest, own)] @ step)
    np.testing.assert_allclose(moved.ravel(), wanted, atol=1e-9)


def test_the_file_gives_back_what_was_written(tmp_path: Path) -> None:
    scene, mapped = drawn(2, tmp_path)
    found = uncertainty.estimate(mapped, scene.records)
    for name in ("a.npz", "b.npz"):
        uncertainty.write_uncertainty(tmp_path / name, found)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    back = uncertainty.read_uncertainty(tmp_path / "a.npz")
    np.testing.assert_array_equal(back.frame_cov, found.frame_cov)
    np.testing.assert_array_equal(back.stations, found.stations)
    np.testing.assert_allclose(back.point_cov, found.point_cov, rtol=1e-6)
    np.testing.assert_allclose(back.point_noise, found.point_noise, rtol=1e-6)
    assert back.images == tuple(f"left/{s:06d}.png" for s in range(10))
    assert back.sigma_px == found.sigma_px
    for cov in (*found.frame_cov, *found.point_cov):
        np.testing.assert_allclose(cov, cov.T, atol=1e-9 * np.abs(cov).max())
        assert np.linalg.eigvalsh(cov)[0] > -1e-12
    with np.load(tmp_path / "a.npz") as data:
        np.savez(tmp_path / "c.npz", **{**data, "stations": np.array(["first"])})
    with pytest.raises(WorkspaceError, match="not as it was written"):
        uncertainty.read_uncertainty(tmp_path / "c.npz")


def _observations(mapped: Mapped) -> LinearObservations:
    pixels, state, *_ = uncertainty.pinhole_survey(mapped.model, frames_of(mapped.model))
    return linearised(state, pixels, ())


def _away(mapped: Mapped, found: uncertainty.Uncertainty, scene: Scene) -> tuple[Array, Array]:
    """Errors of stations and points; the usual depth weighs turns against positions."""
    depth_m = float(np.median(np.linalg.norm(_observations(mapped).arm, axis=1)))
    true = true_models.true_stations(scene, mapped)
    return laid_onto(mapped.model, found, true, scene.points_ned, depth_m)


def _few(linear: LinearObservations, points: int, rng: np.random.Generator) -> LinearObservations:
    """The first points only, with two parameters that all share."""
    end = int(linear.starts[points])
    return LinearObservations(
        starts=linear.starts[: points + 1],
        station=linear.station[:end],
        by_point=linear.by_point[:end],
        arm=linear.arm[:end],
        rest=np.concatenate([rng.normal(0, 100, (end, 2, 2)), linear.rest[:end]], axis=2),
    )


def _sigmas(covariances: Array) -> Array:
    return np.sqrt(np.einsum("nii->ni", covariances))


CALIBRATED_NOISE_PX = 0.1
SIGMAS = {
    "left.fx_px": 0.3,
    "left.k1": 2e-4,
    "left.normal_x": 5e-4,
    "right.port_distance_m": 5e-4,
    "right.ry_rad": 5e-5,
    "right.z_m": 1e-4,
}


@cache
def calibrated() -> Scene:
    found = make_scene(lines=2, stations=5, points=900, scale=1, relief_m=0.3)
    return replace(found, rig=with_sigmas(found.rig, SIGMAS))


def noisy(seed: int = 0) -> Scene:
    """The same block with other noise."""
    rng = np.random.default_rng(seed)
    pixels = [p + rng.normal(0, CALIBRATED_NOISE_PX, p.shape) for p in calibrated().pixels]
    return replace(calibrated(), pixels=pixels)


def off(rig: Rig, steps: dict[str, float]) -> Rig:
    """A rig whose parameters are off by so much."""
    cameras, poses = dict(rig.cameras), dict(rig.cam_from_rig)
    for name, step in steps.items():
        camera, field = name.split(".")
        if field in POSE:
            turn, shift = step * np.eye(6)[POSE.index(field)].reshape(2, 3)
            pose, turned = poses[camera], Rotation.from_rotvec(turn)
            poses[camera] = RigidTransform.from_components(
                pose.translation + shift, turned * pose.rotation
            )
        else:
            now = cameras[camera]
            cameras[camera] = now.with_parameters({field: now.parameter(field) + step})
    return replace(rig, cameras=cameras, cam_from_rig=poses)


def points_with(rig: Rig, folder: Path, seed: int = 0) -> tuple[Mapped, Array]:
    """The model of the same pictures by who believes in a rig, and its points."""
    mapped, _ = true_models.refracted(replace(noisy(seed), rig=rig), folder)
    return mapped, observations(mapped.model).points


def part_of(mapped: Mapped, scene: Scene) -> Any:
    """What errors of a rig that is held do."""
    seen, _ = true_models.warped_scene(scene)
    return fit_survey(mapped, seen, scene.rig, port=False, pose=False).calibration


def shape_of(points: Array, true: Array) -> Array:
    return align_rigid(points, true).apply(points) - true


@pytest.mark.parametrize("name", SIGMAS)
def test_a_wrong_parameter_moves_the_points_as_predicted(name: str, tmp_path: Path) -> None:
    mapped, true = points_with(noisy().rig, tmp_path)
    part = part_of(mapped, noisy())
    step = SIGMAS[name]
    _, found = points_with(off(noisy().rig, {name: step}), tmp_path)
    expected = part.points[:, :, list(SIGMAS).index(name)] * step
    found, expected = shape_of(found, true), shape_of(true + expected, true)
    assert np.linalg.norm(found) > 1e-5 * np.sqrt(len(found))
    assert np.linalg.norm(found - expected) < 0.1 * np.linalg.norm(expected)


@pytest.mark.slow
def test_with_random_errors_of_calibration_the_block_is_as_good_as_stated(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    stations, points, too_sure, apart = [], [], [], []
    for seed in range(12):
        steps = {name: float(s * rng.normal()) for name, s in SIGMAS.items()}
        scene = replace(noisy(seed), rig=off(noisy().rig, steps))
        mapped, _ = points_with(scene.rig, tmp_path, seed)
        found = uncertainty.estimate(mapped, scene.records, part_of(mapped, scene))
        away = _away(mapped, found, noisy())
        stations.append(away[0] / _sigmas(found.frame_cov))
        points.append(away[1] / _sigmas(found.point_cov))
        apart.append(_relative_misses(found, away[1], mapped, rng))
        without = uncertainty.estimate(mapped, scene.records)
        too_sure.append(away[1] / _sigmas(without.point_cov))
    for ratios in (stations, points, apart):
        assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.4
    assert np.sqrt(np.mean(np.square(too_sure))) > 1.8, "then the calibration would not matter"


def test_points_move_like_those_of_their_own_group() -> None:
    """Where groups lie over each other, the nearest place may be of the other one."""
    rng = np.random.default_rng(7)
    places, of_place = rng.uniform(0, 1, (40, 3)), rng.integers(0, 2, 40)
    part = uncertainty.Motions(
        stations=np.zeros((2, 6, 1)),
        places=places,
        points=np.where(of_place, 3.0, 1.0)[:, None, None] * np.ones((40, 3, 1)),
        covariance=np.eye(1),
        group=of_place,
    )
    points, group = rng.uniform(0, 1, (200, 3)), rng.integers(0, 3, 200)
    variances = part.of_points(points, group)[:, 0, 0]
    np.testing.assert_allclose(variances[group == 0], 1.0)
    np.testing.assert_allclose(variances[group == 1], 9.0)
    assert set(np.unique(variances[group == 2])) == {1.0, 9.0}


def test_a_station_that_sees_next_to_nothing_stays(tmp_path: Path) -> None:
    mapped, _ = points_with(noisy().rig, tmp_path)
    lonely = [9, 10]
    for point in {
        p.point3D_id for n in lonely for p in mapped.model.images[n].get_observation_points2D()
    }:
        mapped.model.delete_point3D(point)
    part = part_of(mapped, noisy())
    assert np.isfinite(part.stations).all()
    assert np.all(part.stations[4] == 0)
    assert np.all(np.abs(np.delete(part.stations, [0, 4], axis=0)).max(axis=(1, 2)) > 0)


def _relative_misses(
    found: uncertainty.Uncertainty, misses: Array, mapped: Mapped, rng: np.random.Generator
) -> Array:
    """Errors of one point relative to another over what shared motions and own noise say."""
    shared, places = found.shared, observations(mapped.model).points
    rows = np.asarray(KDTree(places).query(shared.places)[1])
    i, j = rng.permutation(len(rows))[:200].reshape(2, 100)
    motion = shared.motions[i] - shared.motions[j]
    noise = found.point_noise[rows[i]] + found.point_noise[rows[j]]
    variance = np.diagonal(uncertainty.spread(motion, shared.covariance) + noise, axis1=1, axis2=2)
    return (misses[rows[i]] - misses[rows[j]]) / np.sqrt(variance)


def test_what_points_share_is_nearly_all_that_poses_do(tmp_path: Path) -> None:
    mapped, places = points_with(noisy().rig, tmp_path)
    part = part_of(mapped, noisy())
    shares = []
    for calibration in (None, part):
        found = uncertainty.estimate(mapped, noisy().records, calibration)
        uncertainty.write_uncertainty(tmp_path / "a.npz", found)
        shared: Any = uncertainty.read_uncertainty(tmp_path / "a.npz").shared
        away, rows = KDTree(places).query(shared.places)
        assert np.max(away) == 0.0
        pose = np.trace((found.point_cov - found.point_noise)[rows], axis1=1, axis2=2)
        share = (
            np.trace(uncertainty.spread(shared.motions, shared.covariance), axis1=1, axis2=2) / pose
        )
        assert share.max() < 1.1
        shares.append(float(np.median(share)))
    assert 0.6 < shares[0] < 1.001, shares
    assert 0.8 < shares[1] < 1.05, shares


def test_parts_of_a_large_survey_know_what_the_whole_knows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapped, _ = points_with(noisy().rig, tmp_path)
    records, part = noisy().records, part_of(mapped, noisy())
    count = mapped.model.compute_num_observations()
    whole = uncertainty.estimate(mapped, records, part)
    monkeypatch.setattr(exact_observations, "PART", -(-count // 6))
    parts = uncertainty.estimate(mapped, records, part)
    for found, wanted in (
        (parts.frame_cov, whole.frame_cov),
        (parts.point_cov, whole.point_cov),
        (parts.point_noise, whole.point_noise),
        (np.array(parts.sigma_px), np.array(whole.sigma_px)),
    ):
        size = np.abs(wanted).max(axis=0)
        np.testing.assert_allclose(found / size, wanted / size, rtol=1e-9, atol=1e-9)
    for found, wanted in (
        (parts.modes.stations, whole.modes.stations),
        (parts.modes.points, whole.modes.points),
        (parts.modes.calibration, whole.modes.calibration),
    ):
        np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-5 * np.abs(wanted).max())
    for workers in (1, 3):
        with PicklingThreads(workers) as engine:
            given = Workers(executor=engine.executor, folder=tmp_path / f"{workers}")
            again = uncertainty.estimate(mapped, records, part, workers=given)
        assert engine.tasks >= 5 * 6
        np.testing.assert_array_equal(again.frame_cov, parts.frame_cov)
        np.testing.assert_array_equal(again.point_cov, parts.point_cov)
        np.testing.assert_array_equal(again.modes.points, parts.modes.points)


RIG_SIGMAS = {"right.ry_rad": 1e-4, "right.rx_rad": 1e-4, "left.k1": 2e-4, "right.z_m": 1e-4,
          "right.rz_rad": 1e-4, "right.x_m": 1e-5, "right.y_m": 1e-5}  # fmt: skip


@cache
def on_known_rig() -> Scene:
    """Two short lines on a rig whose covariance is known."""
    scene = make_scene(lines=2, stations=5, points=500, noise_px=0.3, scale=1, relief_m=0.3)
    return replace(scene, rig=with_sigmas(scene.rig, RIG_SIGMAS))


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> AdjustedSurvey:
    scene = on_known_rig()
    mapped, _ = true_models.refracted(scene, tmp_path_factory.mktemp("refract"))
    return adjust_survey(
        mapped, scene.records, scene.rig, true_models.DISTANCES, ReconstructConfig()
    )


def hessian_of(survey: AdjustedSurvey) -> Array:
    """Of stations, points and rig, in that order, priors included: no elimination, no modes."""
    fit = survey.exact.fit
    pixels = exact_survey(survey.exact.mapped, survey.exact.seen, fit.calibrated)[0]
    linear = linearised(fit.state, pixels, fit.parameters)
    weights = robust_weights(linear.miss, fit.sigma_px)
    count = len(fit.state.centres)
    hessian, _ = dense_normal_equations(
        linear.weigh(weights / weights.mean() / fit.sigma_px**2), count
    )
    own = np.array([RIG_SIGMAS[name] for name in fit.parameters])
    known = block_diag(np.diag(own**-2), shift_information(fit.state))
    hessian[-len(known) :, -len(known) :] += known
    return hessian


def test_modes_and_navigation_end_where_all_unknowns_at_once_do(survey: AdjustedSurvey) -> None:
    """Readings of the stations' places, bent by 4 mm: solved for some 1,500 unknowns, densely."""
    state, modes = survey.exact.fit.state, survey.shape.modes
    count, rng = len(state.centres), np.random.default_rng(3)
    away = state.centres - state.centres.mean(axis=0)
    sigma = 5e-4
    read = rng.normal(0, sigma, (count, 3))
    read[:, 2] += 4e-3 * (away[:, 0] / np.abs(away[:, 0]).max()) ** 2
    place = np.zeros((count, 3, 6))
    place[:, :, :3], place[:, :, 3:] = -cross_matrices(away), np.eye(3)

    hessian = hessian_of(survey)
    size = len(hessian)
    rows = np.zeros((3 * count, size + 6))
    for k in range(count):
        rows[3 * k : 3 * k + 3, 6 * k + 3 : 6 * k + 6] = np.eye(3)
        rows[3 * k : 3 * k + 3, size:] = place[k]
    whole = np.zeros((size + 6,) * 2)
    whole[:size, :size] = hessian
    whole += rows.T @ rows / sigma**2
    solved = np.zeros(size + 6)  # the first station stays
    solved[6:] = np.linalg.solve(whole[6:, 6:], rows[:, 6:].T @ read.ravel() / sigma**2)
    dense = solved[: 6 * count].reshape(count, 6)

    columns = np.concatenate([place, modes.stations[:, 3:]], axis=2).reshape(3 * count, -1)
    known = np.diag(np.r_[np.zeros(6), np.ones(modes.stations.shape[2])])
    sizes = np.linalg.solve(
        columns.T @ columns / sigma**2 + known, columns.T @ read.ravel() / sigma**2
    )[6:]
    by_modes = modes.stations @ sizes

    gauge = Gauge(state.centres, 2.0, scale_free=False)
    wanted = dense - gauge.motions @ gauge.motion_in(dense)
    found = by_modes - gauge.motions @ gauge.motion_in(by_modes)
    assert np.ptp(wanted[:, 5]) > 1e-3
    assert np.linalg.norm((found - wanted)[:, 3:]) < 0.05 * np.linalg.norm(wanted[:, 3:])
    fit = survey.exact.fit
    moved = fit.deform(modes, survey.shape.point_ids, sizes, np.eye(len(sizes)))
    first = size - fit.state.shifts.size - len(RIG_SIGMAS)
    off = moved.after - fit.after - solved[first : first + len(RIG_SIGMAS)]
    assert np.all(np.abs(off) < 0.1 * np.sqrt(np.diag(fit.covariance)))


def strip(jump_m: float, seed: int) -> Scene:
    """A line of 16 m; a log with a lasting bias, 2 % too long, perhaps with one wrong station."""
    scene = make_scene(lines=1, stations=30, points=2500, noise_px=0.3, seed=seed)
    station = np.array([record.station for record in scene.records])
    places = np.array([body.translation for body in scene.bodies]) * [1.02, 1.02, 1.0]
    places += np.random.default_rng(seed).normal(0, 0.004, (30, 3))[station] + [0.4, -0.3, 0.05]
    places[station == 6, 0] += jump_m
    return replace(scene, records=stating(scene.records, places))


def mute(scene: Scene) -> Scene:
    """The same with a log that says nothing of the shape."""
    vague: dict[str, Any] = {
        "sigma_depth_m": 50.0, "sigma_horizontal_m": 50.0, "sigma_attitude_deg": 60.0,
        "sigma_heading_deg": 60.0,
    }  # fmt: skip
    return replace(scene, records=[replace(record, **vague) for record in scene.records])


def flown(scene: Scene, folder: Path) -> Adjusted:
    start, seen = true_models.started(scene)
    return adjusted(start, seen, scene.rig, true_models.DISTANCES, DATUM, folder)


def rms_and_scale(found: Adjusted, scene: Scene) -> tuple[float, float]:
    true = RigidTransform.concatenate(scene.left.ned_from_cam).translation
    at = found.ned_from_cam.translation
    return true_models.rigid_rms(at, true), align_similarity(at, true).scale - 1.0


@pytest.mark.slow
@pytest.mark.parametrize("jump_m", [0.0, 8.0])
def test_navigation_straightens_a_long_line_but_leaves_its_scale(
    jump_m: float, tmp_path: Path
) -> None:
    """Pictures alone bow such a line; depths to 4 mm do not."""
    before, after = [], []
    for seed in range(3):
        scene = strip(jump_m, seed)
        before.append(rms_and_scale(flown(mute(scene), tmp_path), scene))
        after.append(rms_and_scale(flown(scene, tmp_path), scene))
    rms, scale = np.abs(np.array(after)).T
    assert np.sqrt(np.mean(rms**2)) < 0.7 * np.sqrt(np.mean(np.array(before)[:, 0] ** 2))
    assert scale.max() < 1e-3, "2 % of the log must not reach the model"


@pytest.mark.slow
def test_one_camera_takes_scale_and_shape_from_navigation() -> None:
    """Pictures of the left camera alone, in a unit of 0.37 m: errors are as large as stated."""
    ratios, bends = [], []
    for seed in range(6):
        scene = make_scene(lines=3, stations=9, points=9000, noise_px=0.3, seed=seed).left
        rng = np.random.default_rng([9, seed])
        places = np.array([body.translation for body in scene.bodies])
        places += rng.normal(0, [0.03, 0.03, 0.005], places.shape)
        records = stating(scene.records, places, sigma_horizontal_m=0.03, sigma_depth_m=0.005)
        scale, sigma, before, after = placed_alone(replace(scene, records=records), rng)
        ratios.append(scale / sigma)
        bends.append((before, after))
        assert 1e-4 < sigma < 0.02
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 1.6
    before, after = np.sqrt(np.mean(np.square(bends), axis=0))
    assert after < 0.9 * before


def placed_alone(scene: Scene, rng: np.random.Generator) -> tuple[float, float, float, float]:
    """Error and sigma of the scale; median of cameras after a similarity, before and with modes."""
    start, _ = true_models.started(scene, rng)
    mapped = adjust_freely(replace(start, scaled=False, baseline=np.nan))
    model = pycolmap.Reconstruction(mapped.model)
    model.transform(pycolmap.Sim3d(1.0 / 0.37, pycolmap.Rotation3d(), np.zeros(3)))
    found = adjust_survey(
        replace(mapped, model=model), scene.records, scene.rig, None, ReconstructConfig()
    )
    assert found.exact is None
    pinholes = [
        as_transform(found.mapped.model.images[n].cam_from_world()).inv()
        for n in sorted(found.mapped.model.images)
    ]
    assert found.shape is not None
    points = np.array([p.xyz for p in found.mapped.model.points3D.values()])
    fit: Any = fit_navigation(
        scene.records, pinholes, body_from_pinhole(scene.rig, start.warps), DATUM,
        level(points, np.array([p.translation for p in pinholes])), known_scale=None,
        modes=picture_modes(found.shape, scene.records, pinholes),
    )  # fmt: skip
    after = found.deform(fit.modes, fit.joint[PLACE:, PLACE:]).mapped.model
    true = np.array([pose.translation for pose in true_models.true_stations(scene, start)])
    rms, aligned = [], []
    for one in (found.mapped.model, after):
        at = np.array([one.images[n].projection_center() for n in sorted(one.images)])
        aligned.append(align_similarity(at, true))
        off = aligned[-1].apply(at) - true
        rms.append(float(np.median(np.linalg.norm(off, axis=1))))
    error = np.log(fit.ned_from_model.scale / aligned[1].scale)
    return float(error), fit.sigma_scale, rms[0], rms[1]
