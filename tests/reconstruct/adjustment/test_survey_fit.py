"""What a survey says of its own rig, against the truth."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.config import ReconstructConfig
from alice_survey.core.errors import ReconstructionError
from alice_survey.core.records import RangeRecord
from camera_calib.freedom import POSE, value
from camera_calib.rig import Covariance, Rig
from reconstruct.adjustment import exact_observations, survey_fit
from reconstruct.adjustment.exact_observations import (
    Linearised,
    PixelParts,
    Pixels,
    RigState,
    Workers,
    choose_pixels,
    start_state,
)
from reconstruct.adjustment.normal_equations import PointEquations, reduce_parts
from reconstruct.adjustment.survey_fit import (
    AdjustedSurvey,
    SurveyFit,
    adjust_survey,
    fit_survey,
    frees_poses,
)
from reconstruct.mapping.arrays import frames_of
from reconstruct.mapping.database import Observations
from reconstruct.mapping.mapper import Mapped, model_baseline
from reconstruct.mapping.refraction import refract
from reconstruct.placing.alignment import align_rigid
from tests.cameras import changed
from tests.engines import PicklingThreads
from tests.reconstruct.scenes import Scene, make_scene
from tests.reconstruct.true_models import near_truth, pupils_and_points, warped_scene

NOISE_PX = 0.3
TURN_SIGMA = 3e-4
PORT = ReconstructConfig(refine_port=True, refine_rig="off")
DISTANCES = RangeRecord(near_m=1.75, far_m=2.35, source="test")


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
        name: changed(c, port_distance_m=c.parameter("port_distance_m") - by_m)
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


def errors_in_sigmas(fit: SurveyFit, true: Rig) -> np.ndarray:
    misses = fit.after - [value(true, name) for name in fit.parameters]
    return misses / np.sqrt(np.diag(fit.covariance))


def test_a_wrong_port_comes_back_within_its_sigmas(tmp_path: Path) -> None:
    draws = []
    for seed in range(8):
        scene = noisy(seed)
        wrong = nearer(scene.rig, 0.003)
        mapped, seen = modelled(scene, wrong, tmp_path)
        fit = fit_survey(mapped, seen, wrong, port=True, pose=False)
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
    fit = fit_survey(mapped, seen, wrong, port=True, pose=False)
    for name in fit.parameters:
        # The wide prior still pulls a little; it is worth a tiny part of the sigma.
        sigma = fit.rig.sigmas[name]
        assert value(fit.rig, name) == pytest.approx(
            value(clean().rig, name), abs=0.2 * sigma + 1e-9
        )
    assert fit.sigma_px < 0.02


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
    fit = fit_survey(mapped, seen, wrong, port=False, pose=True)
    assert set(names) <= set(fit.parameters)
    np.testing.assert_allclose(
        [fit.prior_sigmas[fit.parameters.index(n)] for n in names], np.sqrt(np.diag(covariance))
    )
    assert np.all(
        [fit.rig.sigmas[n] <= 1.0001 * np.sqrt(covariance[i, i]) for i, n in enumerate(names)]
    )
    shared = [fit.parameters.index(n) for n in names]
    assert np.abs(errors_in_sigmas(fit, scene.rig)[shared]).max() < 4.0


def points_rms(mapped: Mapped, scene: Scene) -> float:
    """Of the points, wherever the model lies."""
    _, _, points, true = pupils_and_points(mapped, scene)
    away = align_rigid(points, true).apply(points) - true
    return float(np.sqrt((away**2).sum(axis=1).mean()))


def test_the_model_is_built_again_on_the_refined_rig(tmp_path: Path) -> None:
    scene = noisy(6)
    wrong = nearer(scene.rig, 0.01)
    mapped, _ = modelled(scene, wrong, tmp_path)
    found = adjust_survey(mapped, scene.records, wrong, DISTANCES, PORT)
    assert found.exact is not None and found.rig is not None and found.shape is not None
    fit, refined = found.exact.fit, found.mapped
    assert found.rig.covariance is not None
    assert refined.baseline == pytest.approx(model_baseline(refined.model), rel=1e-9)
    said = fit.record.to_json()
    assert said["parameters"][0] == "left.port_distance_m"
    assert found.rig.cameras["left"].parameter("port_distance_m") == pytest.approx(said["after"][0])
    assert refined.warps["left"].camera == found.rig.cameras["left"]
    assert np.diag(said["correlation"]) == pytest.approx(1.0)
    assert points_rms(refined, scene) < 3e-3
    assert refined.model.compute_mean_reprojection_error() < 0.45


def test_parts_say_of_stations_and_points_what_all_observations_say(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = noisy(4)
    mapped, seen = modelled(scene, scene.rig, tmp_path)
    names, frames = list(seen.cameras), frames_of(mapped.model)
    pixels, ids = choose_pixels(mapped, seen, names, frames)
    state = start_state(mapped, scene.rig, names, frames, ids)
    fields = ("right.rx_rad", "right.x_m", "left.fx_px")
    monkeypatch.setattr(exact_observations, "PART", -(-len(pixels.station) // 5))
    near, order = pixels.by_place(state.centres)
    moved = replace(state, points=state.points[order])

    def equations(pixels: Pixels, state: RigState) -> PointEquations:
        parts = PixelParts(pixels, len(state.centres))
        linear = Linearised(pixels=parts, state=state, fields=fields, noise=(0.3, 0.09))
        return reduce_parts(linear)

    parts = equations(near, moved)
    assert len(parts.parts.stations) == 5
    assert min(len(own) for own in parts.parts.stations) < len(state.centres)
    monkeypatch.setattr(exact_observations, "PART", 10**9)
    whole = equations(pixels, state)

    np.testing.assert_array_equal(parts.pointers, whole.pointers)
    np.testing.assert_array_equal(parts.columns, whole.columns)
    rng = np.random.default_rng(0)
    poses, rest = rng.normal(0, 1e-3, (len(state.centres), 6)), rng.normal(0, 1e-4, 4)
    covariances = np.tile(1e-6 * np.eye(6), (len(whole.columns), 1, 1))
    for found, wanted in (
        (parts.blocks, whole.blocks),
        (parts.border, whole.border),
        (parts.shared, whole.shared),
        (parts.point_inverse, whole.point_inverse[order]),
        (parts.follow(poses, rest), whole.follow(poses, rest)[order]),
        (parts.point_covariances(covariances), whole.point_covariances(covariances)[order]),
    ):
        size = np.abs(wanted).max(axis=0)
        np.testing.assert_allclose(found / size, wanted / size, rtol=1e-9, atol=1e-9)


def test_a_calibration_with_sigmas_lets_the_survey_refine_the_rig(tmp_path: Path) -> None:
    scene = noisy(6)
    sigmas = [*[TURN_SIGMA] * 3, 1e-5, 1e-4, 1e-4]
    wrong = right_turned(scene.rig, 1.5 * TURN_SIGMA, sigmas)
    mapped, _ = modelled(scene, wrong, tmp_path)

    def refined(rig: Rig, model: Mapped = mapped, **settings: Any) -> AdjustedSurvey:
        return adjust_survey(model, scene.records, rig, DISTANCES, ReconstructConfig(**settings))

    assert points_rms(refined(wrong).mapped, scene) < 0.5 * points_rms(mapped, scene)
    held = refined(wrong, refine_rig="off")
    assert held.rig == wrong and held.shape is not None
    assert held.shape.modes.calibration.shape[0] == 0, "then no mode moves the rig"
    both, unknown = ["left", "right"], replace(wrong, covariance=None)
    assert frees_poses(ReconstructConfig(), wrong, both)
    assert not frees_poses(ReconstructConfig(refine_rig="off"), wrong, both)
    assert not frees_poses(ReconstructConfig(), unknown, both)
    assert not frees_poses(ReconstructConfig(), wrong, ["left"])
    assert frees_poses(ReconstructConfig(refine_rig="on"), unknown, both)
    few = replace(mapped, model=pycolmap.Reconstruction(mapped.model))
    for point in sorted(few.model.points3D)[12:]:
        few.model.delete_point3D(point)
    assert any("12 points" in note for note in refined(wrong, few).mapped.notes)
    with pytest.raises(ReconstructionError, match="12 points"):
        refined(wrong, few, refine_rig="on")


def test_a_large_survey_is_adjusted_in_parts_as_a_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(8)
    pixels = [p + rng.normal(0, 0.05, p.shape) for p in clean().pixels]
    scene = replace(clean(), pixels=pixels)
    wrong = right_turned(scene.rig, 6e-4, [4e-4, 8e-4, 4e-4, 1e-5, 1e-4, 1e-4])
    mapped, seen = modelled(scene, wrong, tmp_path)
    whole = fit_survey(mapped, seen, wrong, port=False, pose=True)
    monkeypatch.setattr(exact_observations, "PART", -(-whole.observations // 7))
    parts = fit_survey(mapped, seen, wrong, port=False, pose=True)
    assert whole.calibration is not None and parts.calibration is not None
    assert whole.observations == parts.observations
    away, same = KDTree(whole.calibration.places).query(parts.calibration.places)
    assert np.max(away) < 1e-6
    for found, wanted in (
        (parts.after, whole.after),
        (parts.covariance, whole.covariance),
        (parts.state.points, whole.state.points),
        (parts.calibration.points, whole.calibration.points[same]),
    ):
        np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-9 * np.abs(wanted).max())
    for workers in (1, 2, 3):
        with PicklingThreads(workers) as engine:
            folder = tmp_path / f"{workers}"
            again = fit_survey(
                mapped, seen, wrong, port=False, pose=True,
                workers=Workers(executor=engine.executor, folder=folder),
            )  # fmt: skip
        assert engine.tasks > 3 * 7
        assert len(list(folder.iterdir())) == 7
        assert again.calibration is not None
        np.testing.assert_array_equal(again.after, parts.after)
        np.testing.assert_array_equal(again.state.points, parts.state.points)
        np.testing.assert_array_equal(again.calibration.points, parts.calibration.points)
    monkeypatch.setattr(survey_fit, "_MAX_PLACES", len(whole.point_ids) // 3)
    some = fit_survey(mapped, seen, wrong, port=False, pose=True).calibration
    assert some is not None
    assert 0.2 < len(some.places) / len(whole.point_ids) < 0.35
    every = round(len(whole.point_ids) / len(some.places))
    np.testing.assert_array_equal(some.points, parts.calibration.points[::every])
    np.testing.assert_array_equal(some.places, parts.calibration.places[::every])
