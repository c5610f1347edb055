"""What navigation does to a model along its soft modes, against dense algebra and the truth."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import RigidTransform

from alice_survey.core.config import ReconstructConfig
from alice_survey.core.frames import Array
from alice_survey.core.records import RangeRecord
from benchmarks.bend_pipeline import Adjusted, adjusted
from camera_calib.rig import Covariance
from reconstruct.adjustment.exact_observations import choose_pixels, exact_observations
from reconstruct.adjustment.normal_equations import Gauge
from reconstruct.adjustment.survey_fit import AdjustedSurvey, adjust_survey
from reconstruct.mapping.arrays import cross_matrices, frames_of
from reconstruct.mapping.bundle import cauchy_weights
from reconstruct.mapping.refraction import adjust_freely, refract
from reconstruct.placing.alignment import align_rigid, align_similarity, level
from reconstruct.placing.fit import fit_navigation
from reconstruct.placing.navigation import PLACE, body_from_pinhole
from reconstruct.placing.track import picture_modes
from reconstruct.views.model_files import as_transform
from tests.oracles_refraction import dense_normal_equations
from tests.reconstruct.scenes import DATUM, Scene, make_scene
from tests.reconstruct.true_models import near_truth, warped_scene

SIGMAS = {"right.ry_rad": 1e-4, "right.rx_rad": 1e-4, "left.k1": 2e-4, "right.z_m": 1e-4,
          "right.rz_rad": 1e-4, "right.x_m": 1e-5, "right.y_m": 1e-5}  # fmt: skip
DISTANCES = RangeRecord(near_m=1.75, far_m=2.35, source="test")


@cache
def calibrated() -> Scene:
    """Two short lines on a rig whose covariance is known."""
    scene = make_scene(lines=2, stations=5, points=500, noise_px=0.3, scale=1, relief_m=0.3)
    matrix = np.diag(np.array(list(SIGMAS.values())) ** 2)
    known = Covariance(parameters=tuple(SIGMAS), matrix=matrix)
    return replace(scene, rig=replace(scene.rig, covariance=known))


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> AdjustedSurvey:
    scene = calibrated()
    seen, warps = warped_scene(scene)
    start = near_truth(scene, seen, warps, np.random.default_rng(1))
    mapped, _ = refract(start, seen, tmp_path_factory.mktemp("refract"))
    return adjust_survey(mapped, scene.records, scene.rig, DISTANCES, ReconstructConfig())


def hessian_of(survey: AdjustedSurvey) -> Array:
    """Of stations, points and rig, in that order, priors included: no elimination, no modes."""
    assert survey.exact is not None
    fit, seen = survey.exact.fit, survey.exact.seen
    names = list(seen.cameras)
    pixels, _ = choose_pixels(survey.exact.mapped, seen, names, frames_of(survey.mapped.model))
    linear = exact_observations(fit.state, pixels, fit.parameters)
    weights = cauchy_weights(linear.miss, fit.sigma_px)
    count = len(fit.state.centres)
    hessian, _ = dense_normal_equations(
        linear.weigh(weights / weights.mean() / fit.sigma_px**2), count
    )
    own = np.array([SIGMAS[name] for name in fit.parameters])
    hessian[-len(own) :, -len(own) :] += np.diag(own**-2)
    return hessian


def test_modes_and_navigation_end_where_all_unknowns_at_once_do(survey: AdjustedSurvey) -> None:
    """Readings of the stations' places, bent by 4 mm: solved for some 1,500 unknowns, densely."""
    assert survey.exact is not None and survey.shape is not None
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
    off = moved.after - fit.after - solved[size - len(SIGMAS) : size]
    assert np.all(np.abs(off) < 0.1 * np.sqrt(np.diag(fit.covariance)))


def strip(jump_m: float, seed: int, noise_m: float = 0.004) -> Scene:
    """A line of 16 m; a log with a lasting bias, 2 % too long, perhaps with one wrong station."""
    scene = make_scene(lines=1, stations=30, points=2500, noise_px=0.3, seed=seed)
    rng, records = np.random.default_rng(seed), []
    bodies = [p * scene.rig.body_from_cam(r.camera).inv()
              for p, r in zip(scene.ned_from_cam, scene.records, strict=True)]  # fmt: skip
    noise = rng.normal(0, noise_m, (30, 3))
    for body, record in zip(bodies, scene.records, strict=True):
        stated = 1.02 * body.translation * [1, 1, 0] + body.translation * [0, 0, 1]
        stated = stated + noise[record.station] + [0.4, -0.3, 0.05]
        if record.station == 6:
            stated = stated + np.array([jump_m, 0.0, 0.0])
        place = DATUM.geodetic_from_ned(stated[None])[0]
        records.append(
            replace(record, latitude_deg=place[0], longitude_deg=place[1], depth_m=place[2])
        )
    return replace(scene, records=records)


def mute(scene: Scene) -> Scene:
    """The same with a log that says nothing of the shape."""
    vague: dict[str, Any] = {
        "sigma_depth_m": 50.0, "sigma_horizontal_m": 50.0, "sigma_attitude_deg": 60.0,
        "sigma_heading_deg": 60.0,
    }  # fmt: skip
    return replace(scene, records=[replace(record, **vague) for record in scene.records])


def flown(scene: Scene, folder: Path) -> Adjusted:
    seen, warps = warped_scene(scene)
    start = near_truth(scene, seen, warps, np.random.default_rng(1))
    return adjusted(start, seen, scene.rig, DISTANCES, DATUM, folder)


def rms_and_scale(found: Adjusted, scene: Scene) -> tuple[float, float]:
    true = RigidTransform.concatenate(
        [p for p, r in zip(scene.ned_from_cam, scene.records, strict=True) if r.camera == "left"]
    ).translation
    at = found.ned_from_cam.translation
    off = align_rigid(at, true).apply(at) - true
    return float(np.sqrt((off**2).sum(axis=1).mean())), align_similarity(at, true).scale - 1.0


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


def test_one_camera_takes_scale_and_shape_from_navigation(tmp_path: Path) -> None:
    """Pictures of the left camera alone, in a unit of 0.37 m: errors are as large as stated."""
    ratios, bends = [], []
    for seed in range(6):
        scene = make_scene(lines=3, stations=9, points=9000, noise_px=0.3, seed=seed)
        rng = np.random.default_rng([9, seed])
        rows = [k for k, r in enumerate(scene.records) if r.camera == "left"]
        records = []
        for k in rows:
            body = scene.ned_from_cam[k] * scene.rig.body_from_cam("left").inv()
            stated = DATUM.geodetic_from_ned(
                (body.translation + rng.normal(0, [0.03, 0.03, 0.005]))[None]
            )[0]
            records.append(
                replace(scene.records[k], latitude_deg=stated[0], longitude_deg=stated[1],
                        depth_m=stated[2], sigma_horizontal_m=0.03, sigma_depth_m=0.005)
            )  # fmt: skip
        alone = replace(
            scene, records=records,
            rig=replace(scene.rig, cameras={"left": scene.rig.cameras["left"]},
                        cam_from_rig={"left": scene.rig.cam_from_rig["left"]}),
            ned_from_cam=[scene.ned_from_cam[k] for k in rows],
            pixels=[scene.pixels[k] for k in rows], ids=[scene.ids[k] for k in rows], pairs=[],
        )  # fmt: skip
        scale, sigma, before, after = placed_alone(alone, rng, tmp_path)
        ratios.append(scale / sigma)
        bends.append((before, after))
        assert 1e-4 < sigma < 0.02
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 1.6
    before, after = np.sqrt(np.mean(np.square(bends), axis=0))
    assert after < 0.9 * before


def placed_alone(
    scene: Scene, rng: np.random.Generator, folder: Path
) -> tuple[float, float, float, float]:
    """Error and sigma of the scale; median of cameras after a similarity, before and with modes."""
    seen, warps = warped_scene(scene)
    start = near_truth(scene, seen, warps, rng)
    mapped = adjust_freely(replace(start, scaled=False, baseline=np.nan))
    model = pycolmap.Reconstruction(mapped.model)
    model.transform(pycolmap.Sim3d(1.0 / 0.37, pycolmap.Rotation3d(), np.zeros(3)))
    found = adjust_survey(
        replace(mapped, model=model), scene.records, scene.rig, None, ReconstructConfig()
    )
    assert found.exact is None and found.shape is not None
    pinholes = [
        as_transform(found.mapped.model.images[n].cam_from_world()).inv()
        for n in sorted(found.mapped.model.images)
    ]
    points = np.array([p.xyz for p in found.mapped.model.points3D.values()])
    fit = fit_navigation(
        scene.records, pinholes, body_from_pinhole(scene.rig, warps), DATUM,
        level(points, np.array([p.translation for p in pinholes])), known_scale=None,
        modes=picture_modes(found.shape, scene.records, pinholes),
    )  # fmt: skip
    assert fit is not None
    after = found.deform(fit.modes, fit.joint[PLACE:, PLACE:]).mapped.model
    true = np.array([
        (pose * warps["left"].pinhole_from_cam.inv()).translation for pose in scene.ned_from_cam
    ])  # fmt: skip
    rms, aligned = [], []
    for one in (found.mapped.model, after):
        at = np.array([one.images[n].projection_center() for n in sorted(one.images)])
        aligned.append(align_similarity(at, true))
        off = aligned[-1].apply(at) - true
        rms.append(float(np.median(np.linalg.norm(off, axis=1))))
    error = np.log(fit.ned_from_model.scale / aligned[1].scale)
    return float(error), fit.sigma_scale, rms[0], rms[1]
