"""Several models: those that share stations become one, and the others are reported by name."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.errors import warn
from alice_survey.base.run import progress
from reconstruct.mapping.database import as_transform
from reconstruct.mapping.global_mapper import triangulate_and_adjust

_NAMED = 8
_LARGEST_SPREAD = 0.1
"""Radians, and lengths over the models' usual distance to the floor, by which shared stations may
disagree about where the second model lies in the first."""


@progress.step("merge models")
def merge_models(
    models: Sequence[pycolmap.Reconstruction],
    database: Path,
    options: pycolmap.IncrementalPipelineOptions,
) -> list[pycolmap.Reconstruction]:
    """Join models on one known rig that share stations.

    A rig gives every model its scale, so that one shared station suffices to place it. Joined
    models are triangulated and adjusted again, so that points of both sides link them.

    Args:
        models: largest first, on the rig of the database, which is held constant.
        database: what they were made from.
        options: of triangulation and adjustment.

    Returns:
        What is left, largest first; a joined model that lost pictures is not used.
    """
    left = list(models)
    merged = True
    while merged and len(left) > 1:
        merged = False
        for k in range(1, len(left)):
            step = second_from_first(left[0], left[k])
            if step is None:
                continue
            poses = _poses(left[0])
            for frame, pose in _poses(left[k]).items():
                poses.setdefault(frame, pose * step)
            joined = triangulate_and_adjust(database, poses, options)
            if joined.num_reg_frames() == len(poses):
                left = [joined, *left[1:k], *left[k + 1 :]]
                merged = True
                break
    return left


def second_from_first(
    first: pycolmap.Reconstruction, second: pycolmap.Reconstruction
) -> RigidTransform | None:
    """Where the world of one model lies in that of another, by the stations that both have.

    Returns:
        None where they share none or these disagree.
    """
    ours, theirs = _poses(first), _poses(second)
    shared = sorted(ours.keys() & theirs.keys())
    if not shared:
        return None
    steps = [theirs[frame].inv() * ours[frame] for frame in shared]
    middle = np.median([ours[frame].inv().translation for frame in shared], axis=0)
    turn = Rotation.concatenate([step.rotation for step in steps]).mean()
    places = np.array([step.apply(middle) for step in steps])
    place = np.median(places, axis=0)
    away = np.median([(step.rotation * turn.inv()).magnitude() for step in steps])
    spread = np.median(np.linalg.norm(places - place, axis=1))
    if away > _LARGEST_SPREAD or spread > _LARGEST_SPREAD * _reach(first):
        return None
    return RigidTransform.from_components(place - turn.apply(middle), turn)


def report_left_out(models: Sequence[pycolmap.Reconstruction]) -> list[str]:
    """A line for every model but the first, with its pictures; each is warned of, too."""
    notes = []
    have = {i.name for i in models[0].images.values() if i.has_pose} if models else set()
    for model in models[1:]:
        names = sorted({i.name for i in model.images.values() if i.has_pose} - have)
        have |= set(names)
        if names:
            rest = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
            notes.append(
                f"{len(names)} pictures make a model of their own that could not be joined to the "
                f"largest: {', '.join(names[:_NAMED])}{rest}"
            )
            warn(notes[-1])
    return notes


def _poses(model: pycolmap.Reconstruction) -> dict[int, RigidTransform]:
    """`rig_from_world` by frame."""
    return {f: as_transform(model.frames[f].rig_from_world) for f in sorted(model.reg_frame_ids())}


def _reach(model: pycolmap.Reconstruction) -> float:
    """Median distance from the stations to the points."""
    points = np.array([p.xyz for _, p in sorted(model.points3D.items())])
    centres = np.array([pose.inv().translation for pose in _poses(model).values()])
    return float(np.linalg.norm(np.median(points, axis=0) - np.median(centres, axis=0)))
