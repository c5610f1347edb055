"""A survey's observations through its exact flat-port cameras, linearised.

What the adjustment of ideal pinholes holds fixed, the rig and its ports, is free to move here: the
pixels as taken depend on stations, on points and on every parameter of the rig.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.base.compiled import compiled
from alice_survey.base.frames import Array
from camera_calib.camera import Camera, pose_jacobian
from camera_calib.freedom import POSE as TURN_AND_SHIFT
from camera_calib.rig import Rig
from reconstruct.mapping.arrays import Indices, observed
from reconstruct.mapping.database import Observations
from reconstruct.mapping.mapper import Mapped
from reconstruct.mapping.normal_equations import LinearObservations
from reconstruct.views.model_files import as_transform

_BLOCK = 4096
"""Observations at a time: their intermediate values stay in the cache."""
_MOST_OBSERVATIONS = 500_000
"""Linearised they take 1.2 kB each; of more, whole points are left out evenly."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pixels:
    """Observations, sorted by point."""

    starts: Indices
    """(P + 1,) start of each point's observations."""
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
class RigState:
    """One guess of all unknowns."""

    cameras: tuple[Camera, ...]
    cam_from_rig: tuple[RigidTransform, ...]
    turns: Array
    """(F, 3, 3) `world_from_rig`, and (F, 3) where the rig's origins are."""
    centres: Array
    points: Array
    lever: Array


def calibrated_parameters(rig: Rig, names: Sequence[str]) -> tuple[str, ...]:
    """The parameters of these cameras whose covariance a rig states."""
    known = () if rig.covariance is None else rig.covariance.parameters
    return tuple(name for name in known if name.split(".")[0] in names)


def choose_pixels(
    mapped: Mapped, seen: Observations, names: Sequence[str], frames: Indices
) -> tuple[Pixels, Indices]:
    """The observations that take part, and the ids of their points.

    Args:
        mapped: exact model; picture i of `seen` has the id i + 1.
        seen: keypoints.
        names: of the cameras.
        frames: ids of the stations, ascending.
    """
    model, found = mapped.model, observed(mapped.model)
    camera, station = np.empty(len(found.point), np.int64), np.empty(len(found.point), np.int64)
    taken = np.empty((len(found.point), 2))
    for n, number in enumerate(found.pictures.tolist()):
        rows, record = found.of(n), seen.images[number - 1]
        taken[rows] = seen.taken[number - 1][found.keypoint[rows]]
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
) -> RigState:
    """A model's poses and points as flat-port cameras on one rig have them.

    Args:
        mapped: exact model on the rig.
        rig: cameras.
        names: of the cameras that took pictures, the reference first.
        frames: ids of the stations, ascending.
        ids: of the points.
    """
    model, pinhole_from_cam = mapped.model, mapped.warps[names[0]].pinhole_from_cam
    reference = rig.cam_from_rig[names[0]]
    poses = [
        as_transform(model.frames[int(f)].rig_from_world).inv() * pinhole_from_cam for f in frames
    ]
    return RigState(
        cameras=tuple(rig.cameras[name] for name in names),
        cam_from_rig=tuple(rig.cam_from_rig[name] * reference.inv() for name in names),
        turns=np.array([p.rotation.as_matrix() for p in poses]),
        centres=np.array([p.translation for p in poses]),
        points=np.array([model.points3D[i].xyz for i in ids.tolist()]).reshape(-1, 3),
        lever=np.asarray((reference * rig.body_from_rig.inv()).translation),
    )


def exact_observations(
    state: RigState, pixels: Pixels, fields: Sequence[str], names: Sequence[str], *, lever: bool
) -> LinearObservations:
    """The observations linearised; those that no ray explains do not count."""
    count = len(fields) + 3 * lever
    arm = state.points[pixels.point] - state.centres[pixels.station]
    by_point = np.zeros((len(arm), 2, 3))
    by_shared, miss = np.zeros((len(arm), 2, count)), np.zeros((len(arm), 2))
    for c, name in enumerate(names):
        pose, turn = state.cam_from_rig[c], state.cam_from_rig[c].rotation.as_matrix()
        mine = [(g, f.split(".")[1]) for g, f in enumerate(fields) if f.split(".")[0] == name]
        # A camera's pixels depend on itself, and on its place on the rig.
        every = (*state.cameras[c].parameters, *TURN_AND_SHIFT)
        source = np.array([every.index(parameter) for _, parameter in mine], dtype=np.int64)
        target = np.array([g for g, _ in mine], dtype=np.int64)
        seen = np.flatnonzero(pixels.camera == c)
        for first in range(0, len(seen), _BLOCK):
            rows = seen[first : first + _BLOCK]
            turned = _in_rig(arm, rows, pixels.station, state.turns) @ turn.T
            at, by_cam, by_camera = state.cameras[c].project_jacobian(turned + pose.translation)
            _put(
                rows, at, by_cam, turn, state.turns, pixels.station, pixels.taken,
                np.concatenate([by_camera, pose_jacobian(by_cam, turned)], axis=2),
                source, target, by_point, by_shared, miss,
            )  # fmt: skip
    return LinearObservations(
        starts=pixels.starts, station=pixels.station, by_point=by_point, arm=arm,
        by_shared=by_shared, miss=miss,
    )  # fmt: skip


@compiled
def _in_rig(arm: Array, rows: Indices, station: Indices, turns: Array) -> Array:
    """Some observations' arms (N, 3) along the axes of their rigs."""
    found = np.empty((rows.shape[0], 3))
    for i in range(rows.shape[0]):
        turn, o = turns[station[rows[i]]], rows[i]
        for j in range(3):
            found[i, j] = turn[0, j] * arm[o, 0] + turn[1, j] * arm[o, 1] + turn[2, j] * arm[o, 2]
    return found


@compiled
def _put(
    rows: Indices, at: Array, by_cam: Array, turn: Array, turns: Array, station: Indices,
    taken: Array, slopes: Array, source: Indices, target: Indices,
    by_point: Array, by_shared: Array, miss: Array,
) -> None:  # fmt: skip
    """Put what one camera sees in its rows, in place; what it does not see stays as it is.

    Args:
        rows: (N,) observations of the camera.
        at: (N, 2) where it sees them; NaN where it does not.
        by_cam: (N, 2, 3) slopes by the point in the camera's frame.
        turn: (3, 3) rotation of `cam_from_rig`.
        turns: (F, 3, 3) of `world_from_rig`.
        station: (O,).
        taken: (O, 2).
        slopes: (N, 2, K) by all that the camera may depend on.
        source: (G',) which of the K are wanted.
        target: (G',) and where among what is shared they go.
        by_point: (O, 2, 3) to fill.
        by_shared: (O, 2, G) the same way.
        miss: (O, 2) the same way.
    """
    cam_from_world = np.empty((3, 3))
    for i in range(rows.shape[0]):
        o = rows[i]
        if not (np.isfinite(at[i, 0]) and np.isfinite(at[i, 1])):
            continue
        for k in range(3):
            for j in range(3):
                value = 0.0
                for m in range(3):
                    value += turn[k, m] * turns[station[o], j, m]
                cam_from_world[k, j] = value
        for row in range(2):
            miss[o, row] = at[i, row] - taken[o, row]
            u, v, w = by_cam[i, row, 0], by_cam[i, row, 1], by_cam[i, row, 2]
            for j in range(3):
                by_point[o, row, j] = (
                    u * cam_from_world[0, j] + v * cam_from_world[1, j] + w * cam_from_world[2, j]
                )
            for g in range(source.shape[0]):
                by_shared[o, row, target[g]] = slopes[i, row, source[g]]
