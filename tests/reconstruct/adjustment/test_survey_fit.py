"""What a survey says of its own rig, against the truth."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from reconstruct.adjustment.rig_refinement import (
    NavigationFixes,
    RefinedSurvey,
    RigFit,
    fit_rig,
    frees_rig,
    on_rig,
    refine_rig,
)
from reconstruct.mapping.priors import NavigationAdjuster
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.config import ReconstructConfig
from alice_survey.base.errors import ReconstructionError
from camera_calib.approximation.pinhole_warp import PinholeWarp, best_warp
from camera_calib.freedom import POSE, value
from camera_calib.rig import Covariance, Rig, read_rig
from reconstruct.mapping.arrays import observed
from reconstruct.mapping.database import Observations
from reconstruct.mapping.mapper import Mapped, model_baseline
from reconstruct.mapping.refraction import refract
from reconstruct.mapping.working_range import WorkingDistances
from reconstruct.placing.alignment import align_rigid
from reconstruct.views.model_files import as_transform
from tests.cameras import changed
from tests.reconstruct.scenes import DATUM, Scene, make_scene
from tests.reconstruct.true_models import near_truth, pupils_and_points, warped_scene

NOISE_PX = 0.3
TURN_SIGMA = 3e-4
PORT = ReconstructConfig(refine_port=True, refine_rig="off")
RIG = ReconstructConfig(refine_rig="on")


@cache
def clean() -> Scene:
    return make_scene(lines=2, stations=5, points=1500, scale=1, port_distance_m=0.05, relief_m=0.3)


def noisy(seed: int) -> Scene:
    rng = np.random.default_rng(seed)
    return replace(clean(), pixels=[p + rng.normal(0, NOISE_PX, p.shape) for p in clean().pixels])


def modelled(scene: Scene, rig: Rig, folder: Path) -> tuple[Mapped, Observations]:
    """The model that pictures of a scene give to who believes in another rig."""
    believed = replace(scene, rig=rig)
    seen, warps = warped_scene(believed)
    start = near_truth(believed, seen, warps, np.random.default_rng(1))
    return refract(start, seen, folder)[0], seen


def nearer(rig: Rig, by_m: float) -> Rig:
    """The same with shorter ports."""
    cameras = {
        name: changed(c, port_distance_m=c.port.port_distance_m - by_m)
        for name, c in rig.cameras.items()
    }
    return replace(rig, cameras=cameras)


def right_turned(rig: Rig, turn_rad: float, sigmas: list[float]) -> Rig:
    """A rig whose right camera is turned about y, and whose pose a calibration knows this well."""
    pose = rig.cam_from_rig["right"]
    turned = Rotation.from_rotvec([0.0, turn_rad, 0.0]) * pose.rotation
    right = RigidTransform.from_components(pose.translation, turned)
    names = tuple(f"right.{name}" for name in POSE)
    return replace(
        rig,
        covariance=Covariance(parameters=names, matrix=np.diag(sigmas) ** 2),
        cam_from_rig={**rig.cam_from_rig, "right": right},
    )


def errors_in_sigmas(fit: RigFit, true: Rig) -> np.ndarray:
    misses = fit.after - [value(true, name) for name in fit.parameters]
    return misses / np.sqrt(np.diag(fit.covariance))


def test_a_wrong_port_comes_back_within_its_sigmas(tmp_path: Path) -> None:
    draws = []
    for seed in range(8):
        scene = noisy(seed)
        wrong = nearer(scene.rig, 0.003)
        mapped, seen = modelled(scene, wrong, tmp_path)
        fit = fit_rig(mapped, seen, wrong, port=True, pose=False)
        assert fit.sigma_px == pytest.approx(NOISE_PX, rel=0.08)
        draws.append(errors_in_sigmas(fit, scene.rig))
    assert np.abs(draws).max() < 4.0
    assert 0.7 < np.sqrt((np.array(draws) ** 2).mean()) < 1.4
    assert fit.parameters[:4] == (
        "left.port_distance_m", "left.normal_x", "left.normal_y", "left.n_water"
    )  # fmt: skip
    left, right = (c.n_water for c in fit.rig.cameras.values())
    assert left == pytest.approx(right, abs=1e-5), "both look into the same water"


def test_without_noise_port_water_and_rig_are_found_exactly(tmp_path: Path) -> None:
    wrong = nearer(clean().rig, 0.003)
    wrong = replace(
        wrong,
        cameras={
            name: c.with_parameters({"n_water": 1.342, "normal_x": 0.004})
            for name, c in wrong.cameras.items()
        },
    )
    mapped, seen = modelled(clean(), wrong, tmp_path)
    fit = fit_rig(mapped, seen, wrong, port=True, pose=False)
    for name in fit.parameters:
        # The wide prior still pulls a little; it is worth a tiny part of the sigma.
        sigma = fit.rig.sigmas[name]
        assert value(fit.rig, name) == pytest.approx(
            value(clean().rig, name), abs=0.2 * sigma + 1e-9
        )
    assert fit.sigma_px < 0.02


def test_a_turned_camera_is_turned_back_and_the_baseline_stays(tmp_path: Path) -> None:
    scene = noisy(3)
    pose = scene.rig.cam_from_rig["right"]
    turned = RigidTransform.from_components(
        pose.translation, Rotation.from_rotvec([1e-3, -8e-4, 5e-4]) * pose.rotation
    )
    wrong = replace(scene.rig, cam_from_rig={**scene.rig.cam_from_rig, "right": turned})
    mapped, seen = modelled(scene, wrong, tmp_path)
    fit = fit_rig(mapped, seen, wrong, port=False, pose=True)
    assert np.abs(errors_in_sigmas(fit, scene.rig)[[0, 1, 2, 4, 5]]).max() < 4.0
    found = fit.rig.cam_from_rig["right"].rotation * pose.rotation.inv()
    assert found.magnitude() < 0.3 * turned.rotation.magnitude()
    assert fit.rig.baseline_m == pytest.approx(scene.rig.baseline_m, rel=1e-3)


def test_calibrated_parameters_move_within_their_covariance(tmp_path: Path) -> None:
    """A principal point that calibration had wrong by one sigma is not blamed on the rig."""
    scene = noisy(4)
    names = ("right.cx_px", "right.rx_rad", "right.ry_rad", "right.rz_rad")
    covariance = np.diag(np.array([1.0, TURN_SIGMA, TURN_SIGMA, TURN_SIGMA]) ** 2)
    right = scene.rig.cameras["right"]
    wrong = replace(
        scene.rig,
        cameras={**scene.rig.cameras, "right": changed(right, cx_px=right.cx_px + 1.0)},
        covariance=Covariance(parameters=names, matrix=covariance),
    )
    mapped, seen = modelled(scene, wrong, tmp_path)
    fit = fit_rig(mapped, seen, wrong, port=False, pose=True)
    assert set(names) <= set(fit.parameters)
    np.testing.assert_allclose(
        [fit.prior_sigmas[fit.parameters.index(n)] for n in names], np.sqrt(np.diag(covariance))
    )
    assert np.all(
        [fit.rig.sigmas[n] <= 1.0001 * np.sqrt(covariance[i, i]) for i, n in enumerate(names)]
    )
    shared = [fit.parameters.index(n) for n in names]
    assert np.abs(errors_in_sigmas(fit, scene.rig)[shared]).max() < 4.0


def test_the_lever_arm_follows_from_turning_about(tmp_path: Path) -> None:
    """Lines flown both ways show where navigation's origin sits, but not how deep."""
    scene = noisy(5)
    mapped, seen = modelled(scene, scene.rig, tmp_path)
    rng = np.random.default_rng(2)
    ned_from_body = [
        pose * scene.rig.body_from_cam("left").inv() for pose in scene.ned_from_cam[::2]
    ]
    fixes = NavigationFixes(
        positions=np.array([p.translation for p in ned_from_body]) + rng.normal(0, 0.01, (10, 3)),
        sigmas=np.full((10, 3), 0.01),
    )
    true = scene.rig.body_from_rig
    moved = RigidTransform.from_components(
        true.translation + np.array([0.03, -0.02, 0]), true.rotation
    )
    fit = fit_rig(
        mapped, seen, replace(scene.rig, body_from_rig=moved), port=False, pose=True, fixes=fixes
    )
    sigmas = np.sqrt(np.diag(fit.covariance))[-3:]
    truth = true.inv().translation
    assert np.all(np.abs(fit.after[-3:] - truth) < 4 * sigmas)
    assert np.all(sigmas[:2] < 0.015)
    assert sigmas[2] > 0.02
    np.testing.assert_allclose(fit.rig.body_from_rig.inv().translation, fit.after[-3:], atol=1e-12)


def test_the_model_is_built_again_on_the_refined_rig(tmp_path: Path) -> None:
    scene = noisy(6)
    wrong = nearer(scene.rig, 0.01)
    mapped, seen = modelled(scene, wrong, tmp_path)
    adjust = NavigationAdjuster(scene.records, wrong, mapped.warps, DATUM)
    mapped = adjust(mapped)
    distances = WorkingDistances(near_m=1.75, far_m=2.35, source="test")
    found = refine_rig(mapped, seen, wrong, distances, adjust, DATUM, tmp_path, PORT)
    assert isinstance(found, RefinedSurvey)
    refined = found.mapped
    assert found.convergence.settled
    assert found.adjust.sigmas is not None
    assert found.rig.covariance is not None
    for keypoints, before in zip(found.seen.pixels, seen.pixels, strict=True):
        assert 0.01 < np.abs(keypoints - before).max() < 3.0
    assert refined.baseline == pytest.approx(model_baseline(refined.model), rel=1e-9)
    written = read_rig(tmp_path / "rig.json")
    said = json.loads((tmp_path / "port.json").read_text())
    assert said["parameters"][0] == "left.port_distance_m"
    assert written.cameras["left"].port.port_distance_m == pytest.approx(said["after"][0])
    left = refined.warps["left"]
    assert left.camera == written.cameras["left"]
    assert np.diag(said["correlation"]) == pytest.approx(1.0)
    _, _, points, true_points = pupils_and_points(refined, scene)
    away = align_rigid(points, true_points).apply(points) - true_points
    assert np.sqrt((away**2).sum(axis=1).mean()) < 3e-3
    assert refined.model.compute_mean_reprojection_error() < 0.45


def test_points_that_took_no_part_move_along(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A refinement takes some of a large survey's points, and no observation is lost by that."""
    rng = np.random.default_rng(8)
    pixels = [p + rng.normal(0, 0.05, p.shape) for p in clean().pixels]
    scene = replace(clean(), pixels=pixels)
    wrong = right_turned(scene.rig, 6e-4, [4e-4, 8e-4, 4e-4, 1e-5, 1e-4, 1e-4])
    mapped, seen = modelled(scene, wrong, tmp_path)
    adjust = NavigationAdjuster(scene.records, wrong, mapped.warps, None)
    distances = WorkingDistances(near_m=1.75, far_m=2.35, source="test")
    models = []
    for most in (200_000, mapped.model.compute_num_observations() // 4):
        monkeypatch.setattr("reconstruct.adjustment.exact_observations._MOST_OBSERVATIONS", most)
        found = refine_rig(mapped, seen, wrong, distances, adjust, None, tmp_path, RIG)
        assert isinstance(found, RefinedSurvey)
        before = mapped.model.compute_num_observations()
        assert found.convergence.removed < 0.01 * before
        models.append(found.mapped.model)
    all_points, some = (observed(model) for model in models)
    assert len(some.point) == pytest.approx(len(all_points.point), rel=0.002)


def test_a_calibration_with_sigmas_lets_the_survey_refine_the_rig(tmp_path: Path) -> None:
    scene = noisy(6)
    sigmas = [*[TURN_SIGMA] * 3, 1e-5, 1e-4, 1e-4]
    wrong = right_turned(scene.rig, 1.5 * TURN_SIGMA, sigmas)
    mapped, seen = modelled(scene, wrong, tmp_path)
    adjust = NavigationAdjuster(scene.records, wrong, mapped.warps, None)
    distances = WorkingDistances(near_m=1.75, far_m=2.35, source="test")

    def refined(rig: Rig, model: Mapped = mapped, **settings: Any) -> RefinedSurvey | str:
        return refine_rig(
            model, seen, rig, distances, adjust, None, tmp_path, ReconstructConfig(**settings)
        )

    found = refined(wrong)
    assert isinstance(found, RefinedSurvey)
    before, after = (
        np.sqrt((align_rigid(p, t).apply(p) - t) ** 2).mean()
        for p, t in (pupils_and_points(m, scene)[2:] for m in (mapped, found.mapped))
    )
    assert after < 0.5 * before
    both, unknown = ["left", "right"], replace(wrong, covariance=None)
    assert frees_rig(ReconstructConfig(), wrong, both)
    assert not frees_rig(ReconstructConfig(refine_rig="off"), wrong, both)
    assert not frees_rig(ReconstructConfig(), unknown, both)
    assert not frees_rig(ReconstructConfig(), wrong, ["left"])
    assert frees_rig(ReconstructConfig(refine_rig="on"), unknown, both)
    few = replace(mapped, model=pycolmap.Reconstruction(mapped.model))
    for point in sorted(few.model.points3D)[12:]:
        few.model.delete_point3D(point)
    said = refined(wrong, few)
    assert isinstance(said, str)
    assert "12 points" in said
    with pytest.raises(ReconstructionError, match="12 points"):
        refined(wrong, few, refine_rig="on")


def test_the_same_rig_gives_the_same_model(tmp_path: Path) -> None:
    """New warps of an unchanged rig: nothing moves."""
    scene = noisy(7)
    mapped, seen = modelled(scene, scene.rig, tmp_path)
    frames = sorted(mapped.model.frames)
    ids = observed(mapped.model).point_ids
    fit = RigFit(
        rig=scene.rig,
        parameters=(),
        before=np.zeros(0),
        after=np.zeros(0),
        prior_sigmas=np.zeros(0),
        covariance=np.zeros((0, 0)),
        sigma_px=NOISE_PX,
        observations=0,
        stations=tuple(
            as_transform(mapped.model.frames[f].rig_from_world).inv()
            * mapped.warps["left"].pinhole_from_cam
            for f in frames
        ),
        points=np.array([mapped.model.points3D[int(i)].xyz for i in ids]),
        point_ids=ids,
    )
    warps: dict[str, PinholeWarp] = {
        name: best_warp(c, 1.75, 2.35) for name, c in scene.rig.cameras.items()
    }
    same, warped = on_rig(mapped, seen, fit, warps)
    for before, after in zip(seen.pixels, warped.pixels, strict=True):
        np.testing.assert_allclose(after, before, atol=1e-6)
    for number, image in mapped.model.images.items():
        np.testing.assert_allclose(
            same.model.images[number].cam_from_world().matrix(),
            image.cam_from_world().matrix(),
            atol=1e-12,
        )


def test_one_camera_is_refused(tmp_path: Path) -> None:
    scene = noisy(0)
    mapped, seen = modelled(scene, scene.rig, tmp_path)
    adjust = NavigationAdjuster(scene.records, scene.rig, mapped.warps, None)
    alone = replace(mapped, scaled=False)
    with pytest.raises(ReconstructionError):
        refine_rig(alone, seen, scene.rig, None, adjust, None, tmp_path, PORT)
