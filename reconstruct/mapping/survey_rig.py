"""The rig refined from the survey, the model rebuilt on it: settings `refine_port`, `refine_rig`.

It writes `port.json` (values, sigmas, correlation) and `rig.json` (the refined rig) next to the
model.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform

from alice_survey.base.config import ReconstructConfig
from alice_survey.base.errors import ReconstructionError
from alice_survey.base.frames import Datum
from alice_survey.base.records import PortRecord
from camera_calib.freedom import pose_names
from camera_calib.rig import Rig, write_rig
from reconstruct.mapping.arrays import first_pictures, frames_of
from reconstruct.mapping.bundle import move_points
from reconstruct.mapping.database import Observations, rigid3d
from reconstruct.mapping.mapper import Mapped, model_baseline
from reconstruct.mapping.priors import NavigationAdjuster
from reconstruct.mapping.refraction import Convergence, refract
from reconstruct.mapping.rig_refinement import NavigationFixes, RigFit, fit_rig
from reconstruct.mapping.working_range import WorkingDistances
from reconstruct.matching.matches import as_seen
from reconstruct.matching.pairs import positions_ned
from reconstruct.views.lens import Lens, flat_port_lens


@dataclass(frozen=True, kw_only=True, eq=False)
class RefinedSurvey:
    """A survey mapped on its own refined rig."""

    mapped: Mapped
    seen: Observations
    """Keypoints as warped by the refined rig's lenses."""
    rig: Rig
    convergence: Convergence
    """How the keypoints converged."""
    adjust: NavigationAdjuster
    """What adjusted the model."""


def poses_are_calibrated(rig: Rig, names: Sequence[str]) -> bool:
    """Whether a rig states how well the poses of these cameras on it are known."""
    moving = [n for n in pose_names(rig) if n.split(".")[0] in names]
    return bool(moving) and set(moving) <= set(rig.sigmas)


def frees_rig(settings: ReconstructConfig, rig: Rig, names: Sequence[str]) -> bool:
    """Whether the settings, or the calibration, call for a refinement of the rig.

    A calibration that states its covariance leaves the poses on the rig to the survey as well,
    unless that is turned off: the two together know more than either.
    """
    return settings.refine_port or _frees_poses(settings, rig, names)


def _frees_poses(settings: ReconstructConfig, rig: Rig, names: Sequence[str]) -> bool:
    if settings.refine_rig == "auto":
        return poses_are_calibrated(rig, names)
    return settings.refine_rig == "on"


def refine_rig(
    mapped: Mapped,
    seen: Observations,
    rig: Rig,
    distances: WorkingDistances | None,
    adjust: NavigationAdjuster,
    datum: Datum | None,
    folder: Path,
    settings: ReconstructConfig,
) -> RefinedSurvey | str:
    """Refine a rig from a model, as far as `frees_rig` calls for it, and map again on it.

    Args:
        mapped: model on the rig, near its end; picture i of `seen` has the id i + 1.
        seen: keypoints as warped by the model's lenses.
        rig: as calibrated or designed.
        distances: for which the new lenses are the best.
        adjust: that adjusted the model.
        datum: of the positions of navigation.
        folder: where `port.json` and `rig.json` go.
        settings: `refine_port` and `refine_rig`.

    Returns:
        The survey on its refined rig; or what prevented it, where the settings do not insist.

    Raises:
        ReconstructionError: the settings insist, and the model has no scale, or the survey does not
            determine what is to be refined.
    """
    names = list(seen.cameras)
    fixes = None
    if datum is not None and adjust.sigmas is not None:
        fixes = navigation_fixes(mapped.model, seen, datum)
    try:
        if not mapped.scaled or distances is None:
            raise ReconstructionError(
                "refine_port and refine_rig need two cameras, whose known baseline gives the "
                'scale: set refine_port = false and refine_rig = "off" in survey.toml'
            )
        pose = _frees_poses(settings, rig, names)
        fit = fit_rig(mapped, seen, rig, port=settings.refine_port, pose=pose, fixes=fixes)
    except ReconstructionError as error:
        if settings.refine_port or settings.refine_rig == "on":
            raise
        return f"rig as calibrated: {error}"
    lenses: dict[str, Lens] = {
        name: flat_port_lens(fit.rig.cameras[name], distances.near_m, distances.far_m)
        for name in names
    }
    mapped, seen = on_rig(mapped, seen, fit, lenses)
    adjust = NavigationAdjuster(seen.images, fit.rig, lenses, datum)
    poses = {name: fit.rig.cam_from_rig[name] for name in names}
    mapped, convergence = refract(mapped, seen, folder, adjust, poses, near=True)
    PortRecord.save(folder / "port.json", fit.to_json())
    write_rig(folder / "rig.json", fit.rig)
    return RefinedSurvey(
        mapped=mapped, seen=seen, rig=fit.rig, convergence=convergence, adjust=adjust
    )


def on_rig(
    mapped: Mapped, seen: Observations, fit: RigFit, lenses: dict[str, Lens]
) -> tuple[Mapped, Observations]:
    """A model and its keypoints for refined lenses, as warped."""
    model = pycolmap.Reconstruction(mapped.model)
    names = list(seen.cameras)
    pixels = [
        as_seen(mapped.lenses[record.camera].from_pinhole(rows), lenses[record.camera])
        for record, rows in zip(seen.images, seen.pixels, strict=True)
    ]
    pinhole_from_rig: dict[str, RigidTransform] = {
        name: lenses[name].pinhole_from_cam * fit.rig.cam_from_rig[name] for name in names
    }
    rig_from_reference = pinhole_from_rig[names[0]].inv()
    for number, name in enumerate(names, 1):
        camera = model.cameras[number]
        camera.params = lenses[name].pinhole.colmap.params
        if number > 1:
            for rig in model.rigs.values():
                rig.set_sensor_from_rig(
                    camera.sensor_id, rigid3d(pinhole_from_rig[name] * rig_from_reference)
                )
    frames = frames_of(model).tolist()
    for frame, station in zip(frames, fit.stations, strict=True):
        pose = lenses[names[0]].pinhole_from_cam * station.inv()
        model.frames[frame].rig_from_world = rigid3d(pose)
    for point, xyz in zip(fit.point_ids.tolist(), fit.points, strict=True):
        model.points3D[point].xyz = xyz
    for number, image in model.images.items():
        for point, xy in zip(image.points2D, pixels[number - 1], strict=True):
            point.xy = xy
    if len(fit.points) < len(model.points3D):  # the others lie where the old rig had them
        move_points(model, fit.sigma_px)
    notes = (*mapped.notes, "rig and port refined from the survey's own pictures")
    return (
        replace(mapped, model=model, lenses=lenses, baseline=model_baseline(model), notes=notes),
        replace(
            seen,
            pixels=pixels,
            cameras={name: lenses[name].pinhole.colmap for name in names},
        ),
    )


def navigation_fixes(
    model: pycolmap.Reconstruction, seen: Observations, datum: Datum
) -> NavigationFixes:
    """Where navigation says that the body's origin was, by ascending frame."""
    bodies = positions_ned(seen.images, datum)
    frames = frames_of(model).tolist()
    positions, sigmas = np.full((len(frames), 3), np.nan), np.full((len(frames), 3), np.nan)
    for frame, number in first_pictures(model).items():
        record, row = seen.images[number - 1], frames.index(frame)
        positions[row] = bodies[number - 1]
        level = record.sigma_horizontal_m
        sigmas[row] = [level, level, record.sigma_depth_m]
    sigmas[~(sigmas > 0).all(axis=1)] = np.nan
    return NavigationFixes(positions=positions, sigmas=sigmas)
