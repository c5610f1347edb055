"""Groups of stations that no point links, put where navigation has them.

Pictures say nothing of how such groups lie to each other. Each is placed by its own navigation
first, which brings it near enough for the adjustment's linear motions of groups (see
`reconstruct.adjustment.uncertainty.SoftModes`); the model's place then finds these motions, with
navigation's errors correlated between groups as along the track.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform

from alice_survey.base.errors import collected_by, warn
from alice_survey.base.frames import Datum
from alice_survey.base.manifest import ImageRecord
from reconstruct.mapping.arrays import frames_of, model_groups
from reconstruct.mapping.mapper import Mapped
from reconstruct.pictures.files import named
from reconstruct.placing.georeference import fit_navigation, level
from reconstruct.placing.placement_fit import PlacementFit
from reconstruct.views.model_files import as_transform, rigid3d

_MOST_TURN_RAD = 0.1
"""Sigma of a group's turn about any axis up to which turns are linear."""


def join_groups(
    mapped: Mapped,
    records: Sequence[ImageRecord],
    body_from_pinhole: Mapping[str, RigidTransform] | None,
    datum: Datum | None,
) -> Mapped:
    """Move groups of linked stations to where navigation has them, seen from the largest.

    Args:
        mapped: on a rig that gives the scale; its groups may lie anywhere.
        records: pictures.
        body_from_pinhole: mount of every camera; None where it is unknown.
        datum: origin of the local frame; None where no latitude and longitude are known.

    Returns:
        The model without those groups that navigation does not place, which are reported.
    """
    frames, groups = frames_of(mapped.model), model_groups(mapped.model)
    if not groups.any():
        return mapped
    model, notes = pycolmap.Reconstruction(mapped.model), []
    of_name = {record.image: record for record in records}
    members = [frames[groups == group].tolist() for group in range(int(groups.max()) + 1)]
    fits = [_placed(model, of_frames, of_name, body_from_pinhole, datum) for of_frames in members]
    for of_frames, fit in list(zip(members, fits, strict=True))[1:]:
        if fit is None or fits[0] is None:
            notes.append(_leave_out(model, of_frames))
        else:
            _move(model, of_frames, _rigid(fits[0]).inv() * _rigid(fit))
    model.update_point_3d_errors()
    return replace(mapped, model=model, notes=(*mapped.notes, *notes))


def _placed(
    model: pycolmap.Reconstruction,
    frames: Sequence[int],
    records: Mapping[str, ImageRecord],
    body_from_pinhole: Mapping[str, RigidTransform] | None,
    datum: Datum | None,
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
            [records[model.images[n].name] for n in numbers], poses, body_from_pinhole, datum,
            level(points, centres), known_scale=1.0,
        )  # fmt: skip
    if fit is None:
        return None
    sigmas = np.sqrt(np.diag(fit.covariance)[:6])
    return fit if np.all(sigmas > 0) and sigmas[:3].max() <= _MOST_TURN_RAD else None


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
