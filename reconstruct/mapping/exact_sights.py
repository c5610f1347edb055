"""A survey's observations through its exact flat-port cameras, linearised.

What the adjustment of ideal pinholes holds fixed, the rig and its ports, is free to move here: the
pixels as taken depend on stations, on points and on every parameter of the rig.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.frames import Array
from camera_calib.calibration.freedom import POSE as TURN_AND_SHIFT
from camera_calib.flat_port import PARAMETERS, FlatPortCamera, pose_jacobian
from camera_calib.rig import Rig
from reconstruct.lenses.lens import Lens
from reconstruct.mapping.arrays import Indices, observed
from reconstruct.mapping.database import Observations, as_transform
from reconstruct.mapping.mapper import Mapped
from reconstruct.mapping.normal_equations import Sights

_MOST_OBSERVATIONS = 200_000
"""More tell little more of so few parameters; whole points are left out evenly."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pixels:
    """Observations, sorted by point."""

    starts: Indices
    """(P + 1,) where the observations of every point begin."""
    station: Indices
    """(O,) index of the station."""
    camera: Indices
    """(O,) index of the camera."""
    taken: Array
    """(O, 2) pixels of the pictures as taken."""
    point: Indices
    """(O,) index of the point."""

    @property
    def points(self) -> int:
        """How many there are."""
        return len(self.starts) - 1


@dataclass(frozen=True, kw_only=True, eq=False)
class State:
    """One guess of all unknowns."""

    cameras: tuple[FlatPortCamera, ...]
    cam_from_rig: tuple[RigidTransform, ...]
    turns: Array
    """(F, 3, 3) `world_from_rig`, and (F, 3) where the rig's origins are."""
    centres: Array
    points: Array
    lever: Array


def choose_pixels(
    mapped: Mapped, seen: Observations, names: Sequence[str], frames: Indices
) -> tuple[Pixels, Indices]:
    """The observations that take part, and the ids of their points.

    Args:
        mapped: exact model; picture i of `seen` has the id i + 1.
        seen: keypoints as warped by the model's lenses.
        names: of the cameras.
        frames: ids of the stations, ascending.
    """
    model, found = mapped.model, observed(mapped.model)
    camera, station = np.empty(len(found.point), np.int64), np.empty(len(found.point), np.int64)
    taken = np.empty((len(found.point), 2))
    for n, number in enumerate(found.pictures.tolist()):
        rows, record = found.of(n), seen.images[number - 1]
        lens: Lens = mapped.lenses[record.camera]
        taken[rows] = lens.from_pinhole(seen.pixels[number - 1][found.keypoint[rows]])
        camera[rows] = names.index(record.camera)
        station[rows] = np.searchsorted(frames, model.images[number].frame_id)
    every = -(-len(found.point) // _MOST_OBSERVATIONS)
    lost = np.unique(found.point[~np.isfinite(taken).all(axis=1)])
    kept = (found.point % every == 0) & ~np.isin(found.point, lost)
    order = np.flatnonzero(kept)
    order = order[np.argsort(found.point[order], kind="stable")]
    points, inverse = np.unique(found.point[order], return_inverse=True)
    starts = np.concatenate([[0], np.cumsum(np.bincount(inverse, minlength=len(points)))])
    pixels = Pixels(
        starts=starts.astype(np.int64),
        station=station[order],
        camera=camera[order],
        taken=taken[order],
        point=inverse.astype(np.int64),
    )
    return pixels, found.point_ids[points]


def start_state(
    mapped: Mapped, rig: Rig, names: Sequence[str], frames: Indices, ids: Indices
) -> State:
    """A model's poses and points as flat-port cameras on one rig have them.

    Args:
        mapped: exact model on the rig.
        rig: cameras.
        names: of the cameras that took pictures, the reference first.
        frames: ids of the stations, ascending.
        ids: of the points.
    """
    model, pinhole_from_cam = mapped.model, mapped.lenses[names[0]].pinhole_from_cam
    reference = rig.cam_from_rig[names[0]]
    poses = [
        as_transform(model.frames[int(f)].rig_from_world).inv() * pinhole_from_cam for f in frames
    ]
    return State(
        cameras=tuple(rig.cameras[name] for name in names),
        cam_from_rig=tuple(rig.cam_from_rig[name] * reference.inv() for name in names),
        turns=np.array([p.rotation.as_matrix() for p in poses]),
        centres=np.array([p.translation for p in poses]),
        points=np.array([model.points3D[i].xyz for i in ids.tolist()]).reshape(-1, 3),
        lever=np.asarray((reference * rig.body_from_rig.inv()).translation),
    )


def exact_sights(
    state: State, pixels: Pixels, fields: Sequence[str], names: Sequence[str], *, lever: bool
) -> Sights:
    """The observations linearised; those that no light explains count nothing."""
    count = len(fields) + 3 * lever
    arm = state.points[pixels.point] - state.centres[pixels.station]
    by_point = np.zeros((len(arm), 2, 3))
    by_shared, miss = np.zeros((len(arm), 2, count)), np.zeros((len(arm), 2))
    for c, name in enumerate(names):
        rows = np.flatnonzero(pixels.camera == c)
        turns = state.turns[pixels.station[rows]]
        pose = state.cam_from_rig[c]
        turned = np.einsum("nij,ni->nj", turns, arm[rows]) @ pose.rotation.as_matrix().T
        found, by_cam, by_parameter = state.cameras[c].project_jacobian(turned + pose.translation)
        sees = np.isfinite(found).all(axis=1)
        rows, by_cam, by_parameter = rows[sees], by_cam[sees], by_parameter[sees]
        by_rig = by_cam @ pose.rotation.as_matrix()
        by_point[rows] = by_rig @ turns[sees].transpose(0, 2, 1)
        miss[rows] = found[sees] - pixels.taken[rows]
        by_pose = pose_jacobian(by_cam, turned[sees])
        for g, field in enumerate(fields):
            camera, parameter = field.split(".")
            if camera != name:
                continue
            if parameter in PARAMETERS:
                by_shared[rows, :, g] = by_parameter[:, :, PARAMETERS.index(parameter)]
            else:
                by_shared[rows, :, g] = by_pose[:, :, TURN_AND_SHIFT.index(parameter)]
    return Sights(
        starts=pixels.starts, station=pixels.station, by_point=by_point, arm=arm,
        by_shared=by_shared, miss=miss,
    )  # fmt: skip
