"""The end of the pipeline, from a model near the truth to a placed one: what `bend` scores."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.base.config import ReconstructConfig
from alice_survey.base.errors import ReconstructionError
from alice_survey.base.frames import Array, Datum
from camera_calib.rig import Rig
from reconstruct.mapping.acceptance import judge_model
from reconstruct.mapping.arrays import frames_of
from reconstruct.mapping.database import Observations
from reconstruct.mapping.mapper import Mapped
from reconstruct.mapping.priors import NavigationAdjuster
from reconstruct.mapping.refraction import refract
from reconstruct.mapping.rig_refinement import RefinedSurvey, frees_rig, refine_rig
from reconstruct.mapping.uncertainty import read_uncertainty, save_uncertainty
from reconstruct.mapping.working_range import WorkingDistances
from reconstruct.placing.georeference import fit_navigation, level
from reconstruct.placing.run import body_from_pinhole
from reconstruct.placing.track import placed_covariances, shape_covariances
from reconstruct.views.model_files import as_transform


@dataclass(frozen=True, kw_only=True, eq=False)
class Adjusted:
    """A placed model, as far as it is scored, and what it states of itself."""

    ned_from_cam: RigidTransform
    """(S,) entrance pupils of the reference camera by station."""
    covariances: Array
    """(S, 6, 6) of position and rotation in NED; NaN where unknown."""
    shape: Array
    """(S, 6, 6) the same of the shape alone."""
    bend_sigmas_m: Array
    """(2,) of the sag along and across the block; NaN where unknown."""
    scale_sigma: float
    """Relative; NaN where unknown."""
    correlation: str
    """How navigation's errors of depth are correlated, in words."""


Adjust = Callable[[Mapped, Observations, Rig, WorkingDistances, Datum, Path], Adjusted]
"""Takes a model near the truth on a calibrated rig, and a folder for its files."""


def adjusted(
    mapped: Mapped,
    seen: Observations,
    rig: Rig,
    distances: WorkingDistances,
    datum: Datum,
    folder: Path,
) -> Adjusted:
    """Adjust and place a model as `mapping` and `placing` do.

    Raises:
        ReconstructionError: a station is lost, or navigation does not place the model.
    """
    settings = ReconstructConfig()
    adjust = NavigationAdjuster(seen.images, rig, mapped.warps, datum)
    poses = {name: rig.cam_from_rig[name] for name in seen.cameras}
    free = frees_rig(settings, rig, list(seen.cameras))
    mapped, _ = refract(mapped, seen, folder, adjust, poses, settle=not free)
    if free:
        found = refine_rig(mapped, seen, rig, distances, adjust, datum, folder, settings)
        if isinstance(found, RefinedSurvey):
            mapped, seen, rig, adjust = found.mapped, found.seen, found.rig, found.adjust
        else:
            mapped, _ = refract(mapped, seen, folder, adjust, poses)
    save_uncertainty(folder, mapped, seen, rig, adjust.sigmas)
    return placed(mapped, seen, rig, datum, folder)


def placed(mapped: Mapped, seen: Observations, rig: Rig, datum: Datum, folder: Path) -> Adjusted:
    """Place a finished model whose `covariance.npz` is in the folder.

    Raises:
        ReconstructionError: a station is lost, or navigation does not place the model.
    """
    doming, _ = judge_model(mapped, seen.images, rig, datum)
    model = mapped.model
    numbers = sorted(n for n, image in model.images.items() if image.has_pose)
    records = [seen.images[n - 1] for n in numbers]
    pinholes = [as_transform(model.images[n].cam_from_world()).inv() for n in numbers]
    points = np.array([point.xyz for _, point in sorted(model.points3D.items())])
    fit = fit_navigation(
        records,
        pinholes,
        body_from_pinhole(rig, mapped.warps),
        datum,
        level(points, np.array([pinhole.translation for pinhole in pinholes])),
        known_scale=1.0,
    )
    if fit is None:
        raise ReconstructionError("navigation does not place the model")
    place, own = fit.ned_from_model, mapped.warps[rig.reference].pinhole_from_cam
    kept = [k for k, record in enumerate(records) if record.camera == rig.reference]
    in_model = RigidTransform.concatenate([pinholes[k] * own for k in kept])
    poses = RigidTransform.from_components(
        place.apply(in_model.translation), place.rotation * in_model.rotation
    )
    stations = np.array([records[k].station for k in kept], dtype=np.int64)
    if len(stations) < len({record.station for record in seen.images}):
        raise ReconstructionError(f"only {len(frames_of(model))} stations are left")
    path = folder / "covariance.npz"
    shape = np.full((len(stations), 6, 6), np.nan)
    if path.is_file():
        every = np.ones(len(stations), dtype=np.bool_)
        shape = shape_covariances(poses, stations, every, read_uncertainty(path), place)
    bends = [doming.along, doming.across]
    depth = fit.correlation["depth"]
    return Adjusted(
        ned_from_cam=poses,
        covariances=shape + placed_covariances(poses, fit.middle_ned, fit.covariance),
        shape=shape,
        bend_sigmas_m=np.array([np.nan if b is None else b.sag_sigma_m for b in bends]),
        scale_sigma=fit.sigma_scale or np.nan,
        correlation=(
            f"{depth.factor:.2g} of stated, {depth.tau:.3g} {fit.time_unit}, white "
            f"{depth.white:.2g}, constant {depth.constant:.2g}"
        ),
    )
