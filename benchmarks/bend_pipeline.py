"""The end of the pipeline, from a model near the truth to a placed one: what `bend` scores."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform

from alice_survey.core.config import ReconstructConfig
from alice_survey.core.errors import ReconstructionError
from alice_survey.core.frames import Array, Datum
from alice_survey.core.records import RangeRecord
from camera_calib.rig import Rig
from reconstruct.adjustment.survey_fit import adjust_survey
from reconstruct.mapping.database import Observations
from reconstruct.mapping.mapper import Mapped
from reconstruct.mapping.refraction import refract
from reconstruct.placing.alignment import Similarity, level, sag_weights
from reconstruct.placing.fit import fit_navigation
from reconstruct.placing.navigation import PLACE, body_from_pinhole
from reconstruct.placing.track import picture_modes, pose_covariances, track_rows
from reconstruct.views.model import WorldFrame
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
    points_ned: Mapping[int, Array]
    """Points by their ids."""
    correlation: str
    """How navigation's errors of depth are correlated, in words."""


Adjust = Callable[[Mapped, Observations, Rig, RangeRecord, Datum, Path], Adjusted]
"""Takes a model near the truth on a calibrated rig, and a folder for its files."""


def adjusted(
    mapped: Mapped, seen: Observations, rig: Rig, distances: RangeRecord, datum: Datum, folder: Path
) -> Adjusted:
    """Adjust and place a model as `mapping` and `placing` do.

    Raises:
        ReconstructionError: a station is lost, or navigation does not place the model.
    """
    mapped, _ = refract(
        mapped, seen, folder, {name: rig.cam_from_rig[name] for name in seen.cameras}
    )
    found = adjust_survey(mapped, seen.images, rig, distances, ReconstructConfig())
    if found.rig is None or found.shape is None:
        raise ReconstructionError("the shape of the model is not known")
    model = found.mapped.model
    numbers = sorted(n for n, image in model.images.items() if image.has_pose)
    records = [seen.images[n - 1] for n in numbers]
    pinholes = [as_transform(model.images[n].cam_from_world()).inv() for n in numbers]
    points = np.array([point.xyz for _, point in sorted(model.points3D.items())])
    fit = fit_navigation(
        records,
        pinholes,
        body_from_pinhole(found.rig, found.mapped.warps),
        datum,
        level(points, np.array([pinhole.translation for pinhole in pinholes])),
        known_scale=1.0,
        modes=picture_modes(found.shape, records, pinholes),
    )
    if fit is None:
        raise ReconstructionError("navigation does not place the model")
    place, left = fit.ned_from_model, fit.joint[PLACE:, PLACE:]
    after = found.deform(fit.modes, left)
    model = after.mapped.model
    model.transform(_as_sim3(place))
    frame = WorldFrame(name="ned", datum=datum, scaled=True, vertical_datum="", notes=())
    of_name = {record.image: record for record in seen.images}
    rows = [
        row
        for row in track_rows(model, of_name, after.mapped.warps, frame)
        if row.camera == rig.reference
    ]
    if len(rows) < len({record.station for record in seen.images}):
        raise ReconstructionError(f"only {len(rows)} stations are left")
    poses = RigidTransform.concatenate([row.world_from_cam for row in rows])
    stations = [int(np.flatnonzero(found.shape.stations == row.station)[0]) for row in rows]
    moved = found.shape.move(place.scale, place.rotation, place.translation)
    down = moved.modes.stations[stations, 5]
    spreads = sag_weights(poses.translation[:, :2]) @ down
    scaling = _scale_weights(poses.translation) @ moved.modes.stations[stations, 3:].reshape(
        -1, len(left)
    )
    depth = fit.correlation["depth"]
    return Adjusted(
        ned_from_cam=poses,
        covariances=pose_covariances(rows, fit, found.shape, place),
        shape=_positions_first(
            found.shape.knowing(left)
            .move(place.scale, place.rotation, place.translation)
            .frame_cov[stations]
        ),
        bend_sigmas_m=np.sqrt(np.einsum("ik,kl,il->i", spreads, left, spreads)),
        scale_sigma=float(np.sqrt(scaling @ left @ scaling)),
        points_ned={int(i): point.xyz for i, point in model.points3D.items()},
        correlation=(
            f"{depth.factor:.2g} of stated, {depth.tau:.3g} s, white "
            f"{depth.white:.2g}, constant {depth.constant:.2g}"
        ),
    )


def _positions_first(covariances: Array) -> Array:
    order = [3, 4, 5, 0, 1, 2]
    found: Array = covariances[:, order][:, :, order]
    return found


def _scale_weights(places: Array) -> Array:
    """(3 S,) that take errors of places to that of the scale."""
    arms = places - places.mean(axis=0)
    weights: Array = (arms / (arms**2).sum()).ravel()
    return weights


def _as_sim3(place: Similarity) -> pycolmap.Sim3d:
    rotation = pycolmap.Rotation3d(place.rotation.as_quat())
    return pycolmap.Sim3d(place.scale, rotation, place.translation)
