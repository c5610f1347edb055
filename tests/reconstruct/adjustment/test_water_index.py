"""What not knowing the index of the water does to ranges and scale."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from alice_survey.core.config import ReconstructConfig
from alice_survey.core.frames import Array
from alice_survey.core.records import RangeRecord
from camera_calib.freedom import knowing_water
from camera_calib.rig import Covariance, Rig
from reconstruct.adjustment.survey_fit import AdjustedSurvey, adjust_survey, fit_survey
from reconstruct.mapping.refraction import refract
from reconstruct.placing.alignment import align_similarity
from tests.reconstruct.scenes import Scene, make_scene
from tests.reconstruct.true_models import near_truth, pupils_and_points, warped_scene

DISTANCES = RangeRecord(near_m=1.75, far_m=2.35, source="test")
POSES = {"right.rx_rad": 2e-5, "right.ry_rad": 2e-5, "right.rz_rad": 2e-5,
         "right.x_m": 2e-6, "right.y_m": 2e-6, "right.z_m": 2e-6}  # fmt: skip
SIGMA = 1e-3


def adjusted(scene: Scene, believed: Rig, folder: Path) -> AdjustedSurvey:
    """The survey as adjusted by who believes in a rig."""
    seen, warps = warped_scene(replace(scene, rig=believed))
    start = near_truth(replace(scene, rig=believed), seen, warps, np.random.default_rng(1))
    mapped, _ = refract(start, seen, folder)
    return adjust_survey(mapped, scene.records, believed, DISTANCES, ReconstructConfig())


def with_poses(rig: Rig) -> Rig:
    matrix = np.diag(np.array(list(POSES.values())) ** 2)
    return replace(rig, covariance=Covariance(parameters=tuple(POSES), matrix=matrix))


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
    seen, warps = warped_scene(scene)
    start = near_truth(scene, seen, warps, np.random.default_rng(1))
    mapped, _ = refract(start, seen, tmp_path)
    moved = fit_survey(mapped, seen, rig, port=False, pose=False).calibration
    assert moved is not None
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
    assert found.shape is not None
    pupils, true, _, _ = pupils_and_points(found.mapped, scene)
    error = 1.0 / align_similarity(pupils, true).scale - 1.0
    stations = centres_of(found)
    arms = stations - stations.mean(axis=0)
    weights = arms / (arms**2).sum()
    by_mode = np.einsum("fi,fik->k", weights, found.shape.modes.stations[:, 3:])
    return error, float(np.linalg.norm(by_mode))


def centres_of(found: AdjustedSurvey) -> Array:
    assert found.exact is not None
    return found.exact.fit.state.centres


def test_scales_lie_within_their_sigmas_where_the_index_is_drawn(tmp_path: Path) -> None:
    drawn, counted, ignored = np.random.default_rng(4).normal(0, SIGMA, 12), [], []
    for seed, off in enumerate(drawn):
        truth = make_scene(lines=2, stations=5, points=600, noise_px=0.05, scale=2, seed=seed)
        believed = with_poses(truth.rig)
        scene = make_scene(
            lines=2, stations=5, points=600, noise_px=0.05, scale=2, seed=seed,
            rig=truth.rig.in_water(truth.rig.cameras["left"].n_water + off),
        )  # fmt: skip
        for rig, ratios in ((knowing_water(believed, SIGMA), counted), (believed, ignored)):
            error, sigma = scale_error_and_sigma(adjusted(scene, rig, tmp_path), scene)
            ratios.append(error / sigma)
    assert 0.7 < np.sqrt(np.mean(np.square(counted))) < 1.4
    assert np.sqrt(np.mean(np.square(ignored))) > 1.5
