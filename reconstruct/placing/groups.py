"""Groups of stations that no point links, put where navigation has them.

Pictures do not show where such groups are relative to each other. Each is placed by its own
navigation first, which brings it near enough for the adjustment's linear motions of groups (see
`reconstruct.adjustment.soft_modes.SoftModes`); the model's place then finds these motions, with
navigation's errors correlated between groups as along the track.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import collected_by, warn
from alice_survey.core.frames import Datum
from alice_survey.core.manifest import ImageRecord
from alice_survey.core.records import JointRecord
from camera_calib.rig import Rig, mounted
from reconstruct.adjustment.normal_equations import POSE
from reconstruct.adjustment.soft_modes import SoftModes
from reconstruct.mapping.arrays import cross_matrices, frames_of, model_groups
from reconstruct.mapping.mapper import Mapped
from reconstruct.pictures.files import named
from reconstruct.placing.georeference import fit_navigation, level
from reconstruct.placing.navigation_equations import (
    SCALE,
    USUAL_INSTALLATION,
    Installation,
    body_from_pinhole,
)
from reconstruct.placing.placement_fit import PlacementFit
from reconstruct.views.model_files import as_transform, rigid3d

_MAX_TURN_RAD = 0.1
"""Sigma of a group's turn about any axis up to which turns are linear."""


def join_groups(
    mapped: Mapped,
    records: Sequence[ImageRecord],
    rig: Rig | None,
    datum: Datum | None,
    installed: Installation = USUAL_INSTALLATION,
) -> Mapped:
    """Move groups of linked stations to where navigation has them, seen from the largest.

    Args:
        mapped: its groups may be anywhere.
        records: pictures.
        rig: as calibrated; None where it is unknown.
        datum: origin of the local frame; None where no latitude and longitude are known.
        installed: how well it is known where the cameras are on the vehicle, and their clock.

    Returns:
        The model without those groups that navigation does not place or whose scale nothing gives,
        which are reported.
    """
    frames, groups = frames_of(mapped.model), model_groups(mapped.model)
    if not groups.any():
        return mapped
    model, notes = pycolmap.Reconstruction(mapped.model), []
    of_name = {record.image: record for record in records}
    members = [frames[groups == group].tolist() for group in range(int(groups.max()) + 1)]
    rig = mounted(rig)
    mounts = None if rig is None else body_from_pinhole(rig, mapped.warps)
    fits = [
        _placed(model, of_frames, of_name, mounts, datum if mapped.scaled else None, installed)
        for of_frames in members
    ]
    for of_frames, fit in list(zip(members, fits, strict=True))[1:]:
        if fit is None or fits[0] is None:
            notes.append(_leave_out(model, of_frames))
        else:
            _move(model, of_frames, _rigid(fits[0]).inv() * _rigid(fit))
            notes.append(f"{len(of_frames)} stations joined to the others by navigation alone")
    model.tear_down()  # what is left out is no longer in it at all
    model.update_point_3d_errors()
    return replace(mapped, model=model, notes=(*mapped.notes, *notes))


def joints_of(fit: PlacementFit, modes: SoftModes) -> tuple[JointRecord, ...]:
    """How well the place of each group after the first is known relative to the first.

    Args:
        fit: of the place and the modes.
        modes: of the model before they were found.
    """
    if modes.groups is None:
        return ()
    place, found = fit.ned_from_model, []
    turn, middles = place.rotation.as_matrix(), place.apply(modes.groups.middles)
    each = modes.joints // (len(middles) - 1)
    for group in range(1, len(middles)):
        away = middles[group] - middles[0]
        first = len(fit.joint) - each * (len(middles) - group)
        slopes = np.zeros((POSE, len(fit.joint)))
        slopes[:3, :3], slopes[:3, SCALE] = -cross_matrices(away[None])[0], away
        slopes[:3, first + 3 : first + 6] = place.scale * turn
        slopes[3:, first : first + 3] = turn
        sigmas = np.sqrt(np.einsum("ij,jk,ik->i", slopes, fit.joint, slopes))
        north, east, down = sigmas[:3].tolist()
        found.append(
            JointRecord(
                stations=int((modes.groups.station == group).sum()),
                sigma_north_m=north,
                sigma_east_m=east,
                sigma_depth_m=down,
                sigma_tilt_deg=float(np.rad2deg(np.sqrt((sigmas[3:5] ** 2).mean()))),
                sigma_heading_deg=float(np.rad2deg(sigmas[5])),
            )
        )
    return tuple(found)


def _placed(
    model: pycolmap.Reconstruction,
    frames: Sequence[int],
    records: Mapping[str, ImageRecord],
    mounts: Mapping[str, RigidTransform] | None,
    datum: Datum | None,
    installed: Installation,
) -> PlacementFit | None:
    """The place of a group by its own navigation; None where that leaves it loose."""
    numbers = _pictures(model, frames)
    poses = [as_transform(model.images[n].cam_from_world()).inv() for n in numbers]
    points = np.array([model.points3D[p].xyz for p in _points(model, numbers)]).reshape(-1, 3)
    if datum is None or len(points) < 3:
        return None
    centres = np.stack([pose.translation for pose in poses])
    with collected_by(lambda *_: None):  # of the whole model it is reported later
        fit = fit_navigation(
            [records[model.images[n].name] for n in numbers], poses, mounts, datum,
            level(points, centres), known_scale=1.0, installed=installed,
        )  # fmt: skip
    if fit is None:
        return None
    sigmas = np.sqrt(np.diag(fit.covariance)[:6])
    return fit if np.all(sigmas > 0) and sigmas[:3].max() <= _MAX_TURN_RAD else None


def _pictures(model: pycolmap.Reconstruction, frames: Sequence[int]) -> list[int]:
    inside = set(frames)
    posed = [n for n, image in model.images.items() if image.has_pose]
    return sorted(n for n in posed if model.images[n].frame_id in inside)


def _points(model: pycolmap.Reconstruction, pictures: Sequence[int]) -> list[int]:
    inside = set(pictures)
    return [
        number
        for number, point in sorted(model.points3D.items())
        if point.track.elements[0].image_id in inside
    ]


def _leave_out(model: pycolmap.Reconstruction, frames: Sequence[int]) -> str:
    """Take a group out of a model, in place; a line that says so."""
    names = sorted(model.images[n].name for n in _pictures(model, frames))
    for frame in frames:
        model.deregister_frame(frame)
    text = (
        f"{len(names)} pictures make a separate model that neither points nor navigation join to "
        f"the largest: {named(names)}"
    )
    warn(text)
    return text


def _move(model: pycolmap.Reconstruction, frames: Sequence[int], motion: RigidTransform) -> None:
    """Move a group, in place."""
    points = _points(model, _pictures(model, frames))
    for frame in frames:
        pose = as_transform(model.frames[frame].rig_from_world)
        model.frames[frame].rig_from_world = rigid3d(pose * motion.inv())
    for number in points:
        model.points3D[number].xyz = motion.apply(model.points3D[number].xyz)


def _rigid(fit: PlacementFit) -> RigidTransform:
    place = fit.ned_from_model
    return RigidTransform.from_components(place.translation, place.rotation)
