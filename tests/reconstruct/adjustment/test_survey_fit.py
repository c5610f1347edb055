"""What a survey says of its own rig, against the truth."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.config import ReconstructConfig
from alice_survey.core.errors import ReconstructionError
from camera_calib.freedom import POSE, knowing_water, value
from camera_calib.rig import Covariance, Rig
from reconstruct.adjustment import exact_observations, survey_fit
from reconstruct.adjustment.exact_observations import (
    PixelParts,
    Pixels,
    RigState,
    Workers,
    exact_survey,
    linearise_parts,
)
from reconstruct.adjustment.normal_equations import PointEquations, reduce_parts
from reconstruct.adjustment.survey_fit import (
    AdjustedSurvey,
    SurveyFit,
    adjust_survey,
    contradiction,
    fit_survey,
    frees_poses,
)
from reconstruct.mapping.database import Observations
from reconstruct.mapping.mapper import Mapped, model_baseline
from reconstruct.placing.alignment import align_similarity
from tests.engines import PicklingThreads
from tests.oracles_place import is_unit
from tests.reconstruct.scenes import Scene, make_scene
from tests.reconstruct.true_models import DISTANCES, points_of, pupils, refracted, rigid_rms

NOISE_PX = 0.3
TURN_SIGMA = 3e-4
PORT = ReconstructConfig(refine_port=True, refine_rig="off")


@cache
def clean() -> Scene:
    return make_scene(lines=2, stations=5, points=1500, scale=1, port_distance_m=0.05, relief_m=0.3)


def noisy(seed: int) -> Scene:
    rng = np.random.default_rng(seed)
    return replace(clean(), pixels=[p + rng.normal(0, NOISE_PX, p.shape) for p in clean().pixels])


def modelled(scene: Scene, rig: Rig, folder: Path) -> tuple[Mapped, Observations]:
    """The model that pictures of a scene give to who believes in another rig."""
    return refracted(replace(scene, rig=rig), folder)


def with_sigmas(rig: Rig, sigmas: Mapping[str, float]) -> Rig:
    matrix = np.diag(np.array([*sigmas.values()]) ** 2)
    return replace(rig, covariance=Covariance(parameters=tuple(sigmas), matrix=matrix))


def with_camera(rig: Rig, name: str, **changes: float) -> Rig:
    camera = rig.cameras[name].with_parameters(changes)
    return replace(rig, cameras={**rig.cameras, name: camera})


def nearer(rig: Rig, by_m: float, **changes: float) -> Rig:
    """The same with shorter ports."""
    for name, camera in rig.cameras.items():
        port_m = camera.parameter("port_distance_m") - by_m
        rig = with_camera(rig, name, port_distance_m=port_m, **changes)
    return rig


def right_turned(rig: Rig, turn_rad: float, sigmas: list[float]) -> Rig:
    """A rig whose right camera is turned about y, and whose pose a calibration knows this well."""
    pose = rig.cam_from_rig["right"]
    turned = Rotation.from_rotvec([0.0, turn_rad, 0.0]) * pose.rotation
    right = RigidTransform.from_components(pose.translation, turned)
    known = {f"right.{name}": sigma for name, sigma in zip(POSE, sigmas, strict=True)}
    return replace(with_sigmas(rig, known), cam_from_rig={**rig.cam_from_rig, "right": right})


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
    wrong = nearer(clean().rig, 0.003, n_water=1.342, normal_x=0.004)
    mapped, seen = modelled(clean(), wrong, tmp_path)
    fit = fit_survey(mapped, seen, wrong, port=True, pose=False)
    for name in fit.parameters:
        # The wide prior still pulls a little; it is worth a tiny part of the sigma.
        off = abs(value(fit.rig, name) - value(clean().rig, name))
        assert off < 0.2 * fit.rig.sigmas[name] + 1e-9
    assert fit.sigma_px < 0.02


def test_calibrated_parameters_move_within_their_covariance(tmp_path: Path) -> None:
    """A principal point that calibration had wrong by one sigma is not blamed on the rig."""
    scene = noisy(4)
    known = {"right.cx_px": 1.0} | {f"right.r{axis}_rad": TURN_SIGMA for axis in "xyz"}
    wrong = with_camera(scene.rig, "right", cx_px=scene.rig.cameras["right"].cx_px + 1.0)
    wrong = with_sigmas(wrong, known)
    mapped, seen = modelled(scene, wrong, tmp_path)
    fit = fit_survey(mapped, seen, wrong, port=False, pose=True)
    assert known.keys() <= set(fit.parameters)
    shared = [fit.parameters.index(n) for n in known]
    sigmas = np.sqrt(np.diag(fit.prior_covariance))
    np.testing.assert_allclose(sigmas[shared], [*known.values()])
    assert all(fit.rig.sigmas[n] <= 1.0001 * sigma for n, sigma in known.items())
    assert np.abs(errors_in_sigmas(fit, scene.rig)[shared]).max() < 4.0


def points_rms(mapped: Mapped, scene: Scene) -> float:
    return rigid_rms(*points_of(mapped, scene))


def test_the_model_is_built_again_on_the_refined_rig(tmp_path: Path) -> None:
    scene = noisy(6)
    wrong = nearer(scene.rig, 0.01)
    mapped, _ = modelled(scene, wrong, tmp_path)
    found = adjust_survey(mapped, scene.records, wrong, DISTANCES, PORT)
    fit, refined = found.exact.fit, found.mapped
    assert found.rig.covariance is not None and found.shape is not None
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
    pixels, state, _ = exact_survey(mapped, seen, scene.rig)
    fields = ("right.rx_rad", "right.x_m", "left.fx_px")
    monkeypatch.setattr(exact_observations, "PART", -(-len(pixels.station) // 5))
    near, order = pixels.by_place(state.centres)
    moved = replace(state, points=state.points[order])

    def equations(pixels: Pixels, state: RigState) -> PointEquations:
        parts = PixelParts(pixels, len(state.centres))
        return reduce_parts(linearise_parts(parts, state, fields, (0.3, 0.09)))

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
    assert held.rig == wrong
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


@pytest.mark.slow
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
        np.testing.assert_array_equal(again.after, parts.after)
        np.testing.assert_array_equal(again.state.points, parts.state.points)
        np.testing.assert_array_equal(again.calibration.points, parts.calibration.points)
    monkeypatch.setattr(survey_fit, "_MAX_PLACES", len(whole.point_ids) // 3)
    some: Any = fit_survey(mapped, seen, wrong, port=False, pose=True).calibration
    assert 0.2 < len(some.places) / len(whole.point_ids) < 0.35
    every = round(len(whole.point_ids) / len(some.places))
    np.testing.assert_array_equal(some.points, parts.calibration.points[::every])
    np.testing.assert_array_equal(some.places, parts.calibration.places[::every])


POSES = {"right.rx_rad": 2e-5, "right.ry_rad": 2e-5, "right.rz_rad": 2e-5,
         "right.x_m": 2e-6, "right.y_m": 2e-6, "right.z_m": 2e-6}  # fmt: skip
SIGMA = 1e-3


def believing(scene: Scene, believed: Rig, folder: Path) -> AdjustedSurvey:
    """The survey as believing by who believes in a rig."""
    mapped, _ = modelled(scene, believed, folder)
    return adjust_survey(mapped, scene.records, believed, DISTANCES, ReconstructConfig())


def test_ranges_of_one_pair_follow_the_index_as_snells_law_says(tmp_path: Path) -> None:
    """With h the sideways way in water, `z - d - g = h / tan(c)` and `sin(a) = n sin(c)`.

    Pixels hold a, so that `dz/dn = (z - d - g) / (n cos^2 c)`: what lies amid two parallel cameras
    moves along their axes alone.
    """
    scene = make_scene(lines=1, stations=1, points=60_000, relief_m=0.3)
    scene = replace(
        scene, pixels=[p + np.random.default_rng(i).normal(0, 0.05, p.shape)
                       for i, p in enumerate(scene.pixels)]
    )  # fmt: skip
    rig = knowing_water(scene.rig, SIGMA)
    mapped, seen = refracted(scene, tmp_path)
    moved: Any = fit_survey(mapped, seen, rig, port=False, pose=False).calibration
    moved = replace(moved, points=moved.points[..., :2], covariance=moved.covariance[:2, :2])
    ned_from_cam = scene.ned_from_cam[0]
    places = ned_from_cam.inv().apply(moved.places)
    ways = ned_from_cam.rotation.inv().apply(moved.points.sum(axis=2))
    half_m = 0.5 * scene.rig.baseline_m
    amid = np.abs(places[:, 0] - half_m) < 0.005
    assert amid.sum() > 50
    port = scene.rig.cameras["left"].port
    d, g, n = map(port.parameter, ("port_distance_m", "glass_thickness_m", "n_water"))
    _, y, z = places[amid].T
    in_water = z - d - g
    # The ways in air and glass are 3 % of all: c as if all were water is right to a thousandth.
    cos_sq = z**2 / (half_m**2 + y**2 + z**2)
    np.testing.assert_allclose(ways[amid, 2], in_water / (n * cos_sq), rtol=0.005)
    spread = np.sqrt(np.diag(moved.of_points(moved.places[amid][:1])[0]))
    along = np.abs(ned_from_cam.rotation.inv().apply(spread))[2]
    assert along == pytest.approx(SIGMA * in_water[0] / (n * cos_sq[0]), rel=0.02)


def scale_error_and_sigma(found: AdjustedSurvey, scene: Scene) -> tuple[float, float]:
    """Of the stations' scale, relative."""
    error = 1.0 / align_similarity(*pupils(found.mapped, scene)).scale - 1.0
    stations = found.exact.fit.state.centres
    arms = stations - stations.mean(axis=0)
    weights = arms / (arms**2).sum()
    by_mode = np.einsum("fi,fik->k", weights, found.shape.modes.stations[:, 3:])
    return error, float(np.linalg.norm(by_mode))


@pytest.mark.slow
def test_scales_lie_within_their_sigmas_where_the_index_is_drawn(tmp_path: Path) -> None:
    drawn, counted, ignored = np.random.default_rng(4).normal(0, SIGMA, 12), [], []
    for seed, off in enumerate(drawn):
        survey = partial(make_scene, lines=2, stations=5, points=600, noise_px=0.05, seed=seed)
        truth = survey(scale=2).rig
        scene = survey(rig=truth.in_water(truth.cameras["left"].n_water + off))
        believed = with_sigmas(truth, POSES)
        for rig, ratios in ((knowing_water(believed, SIGMA), counted), (believed, ignored)):
            error, sigma = scale_error_and_sigma(believing(scene, rig, tmp_path), scene)
            ratios.append(error / sigma)
    assert is_unit(counted, 12)
    assert np.sqrt(np.mean(np.square(ignored))) > 1.5


LENS = {"fx_px": 0.03, "fy_px": 0.03, "cx_px": 0.05, "cy_px": 0.05, "k1": 1e-4, "k2": 3e-4,
        "p1": 3e-5, "p2": 3e-5, "port_distance_m": 3e-4, "normal_x": 1e-4,
        "normal_y": 1e-4}  # fmt: skip


def smooth_shift(rng: np.random.Generator, pixels: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Where a detector puts keypoints at (N, 2) pixels off, alike in all pictures: soft humps."""
    places, heights = rng.uniform(0, 1, (8, 2)), rng.normal(size=(8, 2))
    away = ((pixels / size)[:, None] - places) / 0.4
    return np.exp(-0.5 * (away**2).sum(axis=2)) @ heights


@pytest.mark.slow
@pytest.mark.parametrize("shift_px", [0.0, 0.005])
def test_shifts_that_pictures_share_move_no_exact_rig_beyond_its_sigmas(
    tmp_path: Path, shift_px: float
) -> None:
    pulls = []
    for seed in range(3):
        scene = make_scene(lines=3, stations=5, points=2500, relief_m=0.2, noise_px=0.03, seed=seed)
        size = np.array([scene.rig.cameras["left"].width_px, scene.rig.cameras["left"].height_px])
        pixels = list(scene.pixels)
        for camera in scene.rig.cameras:
            rows = [k for k, record in enumerate(scene.records) if record.camera == camera]
            rng = np.random.default_rng([seed, rows[0]])
            off = smooth_shift(rng, np.concatenate([pixels[k] for k in rows]), size)
            off *= shift_px / np.sqrt((off**2).sum(axis=1).mean())
            for k in rows:
                pixels[k], off = pixels[k] + off[: len(pixels[k])], off[len(pixels[k]) :]
        scene = replace(scene, pixels=pixels)
        sigmas = {f"{name}.{f}": s for name in scene.rig.cameras for f, s in LENS.items()}
        rig = knowing_water(with_sigmas(scene.rig, {**sigmas, **POSES}), 2e-4)
        mapped, seen = refracted(replace(scene, rig=rig), tmp_path)
        pulls.append(errors_in_sigmas(fit_survey(mapped, seen, rig, port=False, pose=True), rig))
    assert np.abs(pulls).max() < 2.5
    assert np.sqrt(np.mean(np.square(pulls))) < 0.6, "prior errors are none"


NAMES = tuple(f"left.p{n}" for n in range(6))


def linear_fit(
    rng: np.random.Generator, wrong: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Change, prior and what is left of 6 parameters, of which readings measure 4 combinations.

    The truth is drawn from the prior, plus `wrong` of its sigmas.
    """
    root = rng.normal(size=(6, 6)) * np.logspace(-4, 2, 6)[:, None]
    prior = root @ root.T
    truth = root @ rng.normal(size=6) + wrong * np.sqrt(np.diag(prior))
    seen = rng.normal(size=(4, 6)) / np.sqrt(np.diag(prior))
    readings = seen @ truth + 0.3 * rng.normal(size=4)
    gain = prior @ seen.T @ np.linalg.inv(seen @ prior @ seen.T + 0.09 * np.eye(4))
    return gain @ readings, prior, prior - gain @ seen @ prior


def test_a_right_calibration_is_contradicted_as_seldom_as_stated():
    rng = np.random.default_rng(1)
    found = [contradiction(NAMES, *linear_fit(rng, np.zeros(6))) for _ in range(4000)]
    assert sum(one is not None for one in found) <= 4  # of 4000 at 1e-4


def test_a_wrong_parameter_is_found_and_named():
    rng = np.random.default_rng(2)
    wrong = np.zeros(6)
    wrong[3] = 12.0
    found = [contradiction(NAMES, *linear_fit(rng, wrong)) for _ in range(200)]
    known = [one for one in found if one is not None]
    assert len(known) > 180
    named = sum("left.p3" in one.pulls for one in known)
    assert named > 0.6 * len(known)
    assert all(3 <= one.directions <= 4 for one in known)


@pytest.mark.parametrize(("most", "is_named"), [(2.5, False), (4.5, True)])
def test_what_one_of_many_parameters_moves_by_chance_is_not_named(most: float, is_named: bool):
    """Of 60 parameters one moves by 2.5 sigmas every other time; their mean is known too well."""
    prior = np.eye(60) - (1.0 - 1e-6) / 60
    change = np.eye(60)[7] * most + 0.05 / np.sqrt(60)
    found = contradiction([f"p{n}" for n in range(60)], change, prior, 1e-9 * np.eye(60))
    assert (found is not None and next(iter(found.pulls)) == "p7") == is_named


def test_nothing_free_contradicts_nothing():
    assert contradiction((), np.empty(0), np.empty((0, 0)), np.empty((0, 0))) is None
    assert contradiction(NAMES, np.zeros(6), np.eye(6), np.eye(6)) is None


STATED = {"port_distance_m": 5e-5, "normal_x": 2e-4, "normal_y": 2e-4, "n_water": 2e-4}


@pytest.mark.parametrize(
    ("wrong", "about"),
    [({}, None), ({"normal_x": 0.004}, "normal_x"), ({"port_distance_m": 0.008}, "")],
)
def test_a_port_stated_too_well_is_named_and_a_right_one_is_not(
    tmp_path: Path, wrong: dict[str, float], about: str | None
):
    scene = noisy(5)
    left = scene.rig.cameras["left"]
    off = {name: left.parameter(name) + by for name, by in wrong.items()}
    stated = {f"{name}.{field}": s for name in scene.rig.cameras for field, s in STATED.items()}
    rig = with_sigmas(with_camera(scene.rig, "left", **off), stated)
    mapped, seen = modelled(scene, rig, tmp_path)
    fit = fit_survey(mapped, seen, rig, port=True, pose=False)
    found = fit.contradiction
    off = np.sqrt(np.mean(np.square(errors_in_sigmas(fit, scene.rig))))
    assert off < (20.0 if about == "" else 2.0), "of 160 and of 20 stated sigmas"
    assert (found is None) == (about is None)
    if found is not None and about is not None:
        assert about in found.words
        assert found.words.count("sigmas") >= 2
        assert "\n" not in found.words
