"""A mapped survey after its last adjustment, with what is known of its shape."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform

from alice_survey.core.config import ReconstructConfig
from alice_survey.core.errors import ReconstructionError, warn
from alice_survey.core.frames import Array
from alice_survey.core.manifest import ImageRecord
from alice_survey.core.records import RangeRecord
from alice_survey.core.run import progress
from camera_calib.approximation.pinhole_warp import PinholeWarp, best_warp
from camera_calib.freedom import part_of_rig
from camera_calib.rig import Rig
from reconstruct.adjustment.pixel_parts import ALONE, Workers
from reconstruct.adjustment.soft_modes import SoftModes
from reconstruct.adjustment.survey_fit import SurveyFit, fit_survey, frees_poses, on_pinholes
from reconstruct.adjustment.uncertainty import Uncertainty, estimate
from reconstruct.mapping.arrays import frames_of, observations, rig_poses
from reconstruct.mapping.database import Observations
from reconstruct.mapping.mapper import Mapped
from reconstruct.views.model_files import colmap_pinhole, rigid3d, stored_of


@dataclass(frozen=True, kw_only=True, eq=False)
class ExactSurvey:
    """A survey adjusted on exact rays."""

    mapped: Mapped
    """As it was mapped."""
    seen: Observations
    distances: RangeRecord
    """For which the pinholes are the best."""
    fit: SurveyFit

    def on_pinholes(self) -> Mapped:
        """As a model of the pinholes of its rig."""
        warps = self.mapped.warps
        if self.fit.parameters:
            near, far = self.distances.near_m, self.distances.far_m
            warps = {name: best_warp(self.fit.rig.cameras[name], near, far) for name in warps}
        return on_pinholes(self.mapped, self.seen, self.fit, warps)


@dataclass(frozen=True, kw_only=True, eq=False)
class AdjustedSurvey:
    """A model of pinholes after the last adjustment."""

    mapped: Mapped
    rig: Rig | None
    exact: ExactSurvey | None
    """What the model stands for; None where lenses or scale are not known beforehand."""
    shape: Uncertainty | None
    """How well its shape is known; None where it is not."""

    def deform(self, sizes: Array, left: Array) -> Self:
        """The same after measurements from outside have said how large its soft modes are.

        Args:
            sizes: (K,) of every mode of the `shape`, in its sigmas.
            left: (K, K) covariance of these.
        """
        if self.shape is None:
            raise ValueError("a model of unknown shape has no modes")
        shape, modes = self.shape.knowing(left), self.shape.modes
        if self.exact is None:
            return replace(self, mapped=_move_model(self.mapped, modes, sizes), shape=shape)
        fit = self.exact.fit.deform(modes, self.shape.point_ids, sizes, left)
        exact = replace(self.exact, fit=fit)
        return replace(self, mapped=exact.on_pinholes(), rig=fit.rig, exact=exact, shape=shape)


def adjust_survey(
    mapped: Mapped,
    records: Sequence[ImageRecord],
    rig: Rig | None,
    distances: RangeRecord | None,
    settings: ReconstructConfig,
    workers: Workers = ALONE,
) -> AdjustedSurvey:
    """Adjust a mapped survey a last time by its pictures and its calibration.

    Args:
        mapped: exact model; picture i of `records` has the id i + 1.
        records: pictures.
        rig: as calibrated; None where the cameras calibrated themselves.
        distances: for which the model's pinholes are the best.
        settings: `refine_port` and `refine_rig`.
        workers: where parts of a large survey are worked on.

    Raises:
        ReconstructionError: the settings insist on a refinement of the rig, and the model has no
            scale or does not determine it.
    """
    exact, notes = None, mapped.notes
    if rig is not None and list(rig.cameras) != list(mapped.warps):
        rig = part_of_rig(rig, list(mapped.warps))
    try:
        if rig is not None and distances is not None and mapped.scaled:
            exact = _exact(mapped, records, rig, distances, settings, workers)
        elif settings.refine_port or settings.refine_rig == "on":
            raise ReconstructionError(
                "refine_port and refine_rig need two cameras, whose known baseline gives the "
                'scale: set refine_port = false and refine_rig = "off" in survey.toml'
            )
    except ReconstructionError as error:
        if settings.refine_port or settings.refine_rig == "on":
            raise
        notes = (*notes, f"rig as calibrated: {error}")
    found = replace(mapped, notes=notes) if exact is None else exact.on_pinholes()
    shape = None
    try:
        shape = _shape(found, records, exact, workers)
    except ReconstructionError as error:
        warn(f"no covariance: {error}")
    if exact is not None:
        rig = exact.fit.rig
    return AdjustedSurvey(mapped=found, rig=rig, exact=exact, shape=shape)


def _exact(
    mapped: Mapped,
    records: Sequence[ImageRecord],
    rig: Rig,
    distances: RangeRecord,
    settings: ReconstructConfig,
    workers: Workers,
) -> ExactSurvey:
    names = list(mapped.warps)
    seen = Observations(
        images=records,
        cameras={name: colmap_pinhole(warp.pinhole) for name, warp in mapped.warps.items()},
        taken=taken_pixels(mapped.model, records, mapped.warps),
        pairs=(),
        warps=mapped.warps,
    )
    pose = frees_poses(settings, rig, names)
    fit = fit_survey(mapped, seen, rig, port=settings.refine_port, pose=pose, workers=workers)
    return ExactSurvey(mapped=mapped, seen=seen, distances=distances, fit=fit)


@progress.step("covariance of the model")
def _shape(
    mapped: Mapped, records: Sequence[ImageRecord], exact: ExactSurvey | None, workers: Workers
) -> Uncertainty:
    workers = workers.apart("covariance")
    if exact is None:
        return estimate(mapped, records, workers=workers)
    return estimate(
        mapped, records, exact.fit.calibration, held=not exact.fit.parameters, workers=workers
    )


def taken_pixels(
    model: pycolmap.Reconstruction,
    records: Sequence[ImageRecord],
    warps: Mapping[str, PinholeWarp],
) -> list[Array]:
    """The keypoints of all pictures as taken, (N, 2) each.

    A keypoint that has a point is where its pinhole sees that spot, at the point's depth; others
    are as at the working range.

    Args:
        model: exact, in metres; picture i of `records` has the id i + 1.
        records: pictures.
        warps: by camera.
    """
    seen, stored = observations(model), stored_of(model).keypoints
    found = [np.zeros((0, 2))] * len(records)
    for number, rows in sorted(stored.items()):
        warp = warps[records[number - 1].camera]
        depths = np.full(len(rows), warp.working_depth_m)
        if number in seen.pictures:
            mine = seen.of(seen.row(number))
            depths[seen.keypoint[mine]] = seen.in_cameras[mine, 2]
        points = np.column_stack([warp.pinhole.slopes(rows["xy"]), np.ones(len(rows))])
        in_cam = points * depths[:, None] + np.array(warp.centre_m)
        found[number - 1] = warp.camera.project(in_cam)
    return found


def _move_model(mapped: Mapped, modes: SoftModes, sizes: Array) -> Mapped:
    """A model of pinholes with its soft modes (K,) of these sizes."""
    model = pycolmap.Reconstruction(mapped.model)
    frames, seen = frames_of(model), observations(model)
    poses = rig_poses(model, frames).inv()
    turns, centres, points = modes.move(sizes, poses.translation, seen.points, slice(None))
    stations = RigidTransform.from_components(centres, turns * poses.rotation)
    for frame, station in zip(frames.tolist(), stations, strict=True):
        model.frames[frame].rig_from_world = rigid3d(station.inv())
    for point, xyz in zip(seen.point_ids.tolist(), points, strict=True):
        model.points3D[point].xyz = xyz
    model.update_point_3d_errors()
    return replace(mapped, model=model)
