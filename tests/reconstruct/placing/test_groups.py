"""Patches of a survey that no picture links, joined by navigation, against the truth."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.config import ReconstructConfig
from alice_survey.core.frames import Array
from alice_survey.core.records import RangeRecord
from reconstruct.adjustment.normal_equations import Gauge
from reconstruct.adjustment.survey_fit import adjust_survey
from reconstruct.adjustment.uncertainty import Uncertainty
from reconstruct.mapping.arrays import Indices, frames_of, model_groups
from reconstruct.mapping.mapper import Mapped
from reconstruct.mapping.refraction import refract
from reconstruct.placing.alignment import align_rigid, level
from reconstruct.placing.fit import PlacementFit, fit_navigation
from reconstruct.placing.navigation import PLACE, body_from_pinhole
from reconstruct.placing.run import _move, join_groups
from reconstruct.placing.track import picture_modes, pose_covariances, track_rows
from reconstruct.views.model import WorldFrame
from reconstruct.views.model_files import as_transform
from tests.reconstruct.placing.test_sigmas import SIGMA, gauss_markov, records_of
from tests.reconstruct.scenes import ALTITUDE_M, DATUM, Scene, make_scene
from tests.reconstruct.true_models import near_truth, warped_scene

DISTANCES = RangeRecord(near_m=1.75, far_m=2.35, source="test")
TWO = (range(5), range(9, 14))
TAU_S = 60.0


def patches(
    steps: tuple[range, ...], seed: int, lines: int = 3, stations: int | None = None
) -> Scene:
    """Lines over a floor of which pictures are left of these steps alone, and a log that drifts."""
    stations = stations or max(step.stop for step in steps)
    scene = make_scene(
        lines=lines, stations=stations, points=150 * stations, noise_px=0.3, scale=1, seed=seed
    )
    bodies = scene.left.bodies
    errors = SIGMA * gauss_markov(np.random.default_rng([8, seed]), len(bodies), TAU_S)
    log = records_of(RigidTransform.concatenate(bodies), errors, SIGMA)
    kept = [k for k, record in enumerate(scene.records) if _patch(record.station, stations, steps)]
    row = {k: new for new, k in enumerate(kept)}
    return replace(
        scene,
        records=[
            replace(
                log[scene.records[k].station],
                image=scene.records[k].image, camera=scene.records[k].camera,
            )
            for k in kept
        ],
        ned_from_cam=[scene.ned_from_cam[k] for k in kept],
        pixels=[scene.pixels[k] for k in kept],
        ids=[scene.ids[k] for k in kept],
        pairs=[(row[i], row[j], pair) for i, j, pair in scene.pairs if i in row and j in row],
    )  # fmt: skip


def _patch(station: int, stations: int, steps: tuple[range, ...]) -> int:
    """Which patch, from 1, a station of the whole survey is in; 0 where it is left out."""
    line, step = divmod(station, stations)
    at = step if line % 2 == 0 else stations - 1 - step
    return next((k for k, patch in enumerate(steps, 1) if at in patch), 0)


def mapped_apart(scene: Scene, folder: Path, seed: int) -> Mapped:
    """The model with every patch in a frame of its own, as a mapper leaves it."""
    seen, warps = warped_scene(scene)
    rng = np.random.default_rng([seed, 1])
    mapped, _ = refract(near_truth(scene, seen, warps, rng), seen, folder, settle=False)
    frames, groups = frames_of(mapped.model), model_groups(mapped.model)
    for group in range(int(groups.max()) + 1):
        motion = RigidTransform.from_components(rng.normal(0, 10, 3), Rotation.random(rng=rng))
        _move(mapped.model, frames[groups == group].tolist(), motion)
    return mapped


@dataclass(frozen=True, kw_only=True, eq=False)
class Found:
    """A placed model and its truth, station by station."""

    fit: PlacementFit
    group: Indices
    poses: RigidTransform
    """(S,) entrance pupils of the left camera in NED."""
    true: RigidTransform
    covariances: Array
    """(S, 6, 6) of the poses."""
    before: Uncertainty
    """Of the shape, before navigation."""
    after: Uncertainty

    def shape_rms_m(self, group: int) -> float:
        """What is left of a group's errors when it is laid onto the truth."""
        places, true = (p.translation[self.group == group] for p in (self.poses, self.true))
        off = align_rigid(places, true).apply(places) - true
        return float(np.sqrt((off**2).sum(axis=1).mean()))

    def joint(self, group: int) -> tuple[Array, Array]:
        """Error of a group relative to the first, (6,) turn and shift in NED, and covariance."""
        off = np.column_stack([
            (self.true.rotation * self.poses.rotation.inv()).as_rotvec(),
            self.true.translation - self.poses.translation,
        ])  # fmt: skip
        gauge = Gauge(self.poses.translation, ALTITUDE_M, False, self.group)
        motions = gauge.motion_in(off[..., None]).reshape(-1, 6)
        wrong = motions[group] - motions[0]
        wrong[3:] -= np.cross(motions[0, :3], gauge.middles[group] - gauge.middles[0])
        turn = np.kron(np.eye(2), self.fit.ned_from_model.rotation.as_matrix())
        first = len(self.fit.joint) - 6 * (len(motions) - group)
        rows = slice(first, first + 6)
        return wrong, turn @ self.fit.joint[rows, rows] @ turn.T


def placed(scene: Scene, mapped: Mapped) -> Found:
    """The end of the pipeline, as `run_sparse` has it."""
    mounts = body_from_pinhole(scene.rig, mapped.warps)
    joined = join_groups(mapped, scene.records, scene.rig, DATUM)
    found = adjust_survey(joined, scene.records, scene.rig, DISTANCES, ReconstructConfig())
    assert found.shape is not None
    model = found.mapped.model
    numbers = sorted(n for n, image in model.images.items() if image.has_pose)
    records = [scene.records[n - 1] for n in numbers]
    pinholes = [as_transform(model.images[n].cam_from_world()).inv() for n in numbers]
    points = np.array([point.xyz for _, point in sorted(model.points3D.items())])
    fit = fit_navigation(
        records, pinholes, mounts, DATUM,
        level(points, np.stack([pose.translation for pose in pinholes])),
        known_scale=1.0, modes=picture_modes(found.shape, records, pinholes),
        joints=found.shape.modes.joints,
    )  # fmt: skip
    assert fit is not None
    after = found.deform(fit.modes, fit.joint[PLACE:, PLACE:])
    frame = WorldFrame(name="ned", datum=DATUM, scaled=True, vertical_datum="", notes=())
    of_name = {record.image: record for record in scene.records}
    rows = track_rows(after.mapped.model, of_name, after.mapped.warps, frame)
    rows = [replace(r, world_from_cam=_as_rigid(fit) * r.world_from_cam) for r in rows]
    rows = [row for row in rows if row.camera == "left"]
    left = scene.left
    true = {r.station: pose for r, pose in zip(left.records, left.ned_from_cam, strict=True)}
    groups = dict(zip(found.shape.stations.tolist(), model_groups(model).tolist(), strict=True))
    assert after.shape is not None
    return Found(
        fit=fit,
        group=np.array([groups[row.station] for row in rows]),
        poses=RigidTransform.concatenate([row.world_from_cam for row in rows]),
        true=RigidTransform.concatenate([true[row.station] for row in rows]),
        covariances=pose_covariances(rows, fit, found.shape, fit.ned_from_model),
        before=found.shape,
        after=after.shape,
    )


def _as_rigid(fit: PlacementFit) -> RigidTransform:
    place = fit.ned_from_model
    return RigidTransform.from_components(place.translation, place.rotation)


def rms(values: Sequence[float] | Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.slow
def test_patches_lie_to_each_other_as_well_as_is_stated(tmp_path: Path) -> None:
    """Of 20 surveys the errors are 1.13 times their sigmas; shapes are as of a patch alone."""
    ratios, whole, shapes, alone = [], [], [], []
    for seed in range(4):
        scene = patches(TWO, seed)
        found = placed(scene, mapped_apart(scene, tmp_path, seed))
        wrong, covariance = found.joint(1)
        ratios.append(np.linalg.solve(np.linalg.cholesky(covariance), wrong))
        sigmas = np.sqrt(np.einsum("nii->ni", found.covariances[:, :3, :3]))
        whole.append((found.poses.translation - found.true.translation) / sigmas)
        assert np.all(np.sqrt(np.diag(covariance))[3:] > 5e-3)
        assert np.all(np.sqrt(np.diag(covariance))[3:] < 2.0 * SIGMA[:3])
        shapes += [found.shape_rms_m(group) for group in (0, 1)]
        one = patches(TWO[:1], seed, stations=TWO[-1].stop)
        alone.append(placed(one, mapped_apart(one, tmp_path, seed)).shape_rms_m(0))
    assert 0.7 < rms(np.array(ratios)) < 1.4
    assert 0.5 < rms(np.concatenate(whole)) < 1.5
    assert rms(shapes) < 1.3 * rms(alone)
    assert 0.2e-3 < rms(shapes) < 2e-3


def test_a_patch_that_navigation_does_not_place_is_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = patches(TWO, 3, lines=2)
    mapped = mapped_apart(scene, tmp_path, 3)
    of_frame = dict(zip(frames_of(mapped.model), model_groups(mapped.model), strict=True))
    blind = {station - 1 for station, group in of_frame.items() if group == 1}
    silent: dict[str, Any] = {"latitude_deg": np.nan, "longitude_deg": np.nan}
    records = [replace(r, **silent) if r.station in blind else r for r in scene.records]
    found = join_groups(mapped, records, scene.rig, DATUM)
    left = {scene.records[n - 1].station for n, i in found.model.images.items() if i.has_pose}
    assert left == {record.station for record in scene.records} - blind
    assert "20 pictures make a separate model" in capsys.readouterr().err
    assert "left/" in found.notes[-1]
    assert not model_groups(found.model).any()
    assert len(join_groups(mapped, records, scene.rig, None).notes) == 1
    both = join_groups(mapped, scene.records, scene.rig, DATUM)
    assert len(frames_of(both.model)) == 20
