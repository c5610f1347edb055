"""Clocks of cameras that have no common trigger: offsets from the target's motion, and views.

Seen from either camera of a rig the target moves in the same way, at the camera's own time: with
the right offset of the clocks the pose between the cameras is the same at all moments. The offset
that makes it so is refined on pixels. Then the pixels of every camera are interpolated at the
moments at which the first one took its pictures.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation, RotationSpline

from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from camera_calib.calibrate.start import poses_alone, poses_apart
from camera_calib.calibration import TargetView
from camera_calib.camera import Camera

_MAX_GAP = 2.5
"""Between pictures of one motion, over the usual interval of the camera."""
_SHORTEST = 4
"""Pictures of one motion: cubics are laid through so many."""
_FEWEST = 8
_MIN_SHARED = 0.25
"""Share of a camera's pictures that must fall into the motion that the other saw."""
_CLEARER = 0.25
"""The spread of the pose between the cameras at the right offset, over that at other offsets."""
_TRIED = 48
"""Pictures that the search over all offsets looks at."""
_MAX_OFFSETS = 4000
_ODD = 3.0
"""Residuals of a picture over the middle ones, beyond which it is left out."""


@dataclass(frozen=True, kw_only=True)
class ClockOffset:
    """What to add to the times of one camera to get those of the first."""

    seconds: float
    sigma_s: float
    """Standard deviation; points of one picture err together."""
    pictures: int
    """Number of pictures that it is from."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraTrack:
    """Pictures of one camera, in the order of their times."""

    time_s: Array
    """(T,) on the camera's own clock, increasing."""
    pixels: Array
    """(T, N, 2) of the target's points; NaN where not seen."""
    cam_from_target: RigidTransform
    """(T,) poses from this camera alone."""

    def motions(self) -> list[slice]:
        """Runs of pictures without a long gap, long enough for cubics."""
        gaps = np.diff(self.time_s)
        ends = np.flatnonzero(gaps > _MAX_GAP * np.median(gaps)) + 1
        bounds = [0, *ends.tolist(), len(self.time_s)]
        runs = [slice(a, b) for a, b in pairwise(bounds)]
        return [run for run in runs if run.stop - run.start >= _SHORTEST]


class _PoseCurve:
    """Poses of a track at any time; not known outside of its motions."""

    def __init__(self, track: CameraTrack) -> None:
        self._runs = []
        for run in track.motions():
            time_s, poses = track.time_s[run], track.cam_from_target[run]
            place, turn = (
                CubicSpline(time_s, poses.translation),
                RotationSpline(time_s, poses.rotation),
            )
            self._runs.append((time_s[0], time_s[-1], place, turn))

    def at(self, time_s: Array) -> tuple[RigidTransform, NDArray[np.bool_]]:
        """(T,) poses, and whether they are known; unknown ones are the identity."""
        known = np.zeros(len(time_s), dtype=np.bool_)
        places, turns = np.zeros((len(time_s), 3)), np.tile([0.0, 0.0, 0.0, 1.0], (len(time_s), 1))
        for first, last, place, turn in self._runs:
            within = (time_s >= first) & (time_s <= last)
            if within.any():
                places[within] = place(time_s[within])
                turns[within] = turn(time_s[within]).as_quat()
                known |= within
        return RigidTransform.from_components(places, Rotation.from_quat(turns)), known


def track_of(
    name: str,
    camera: Camera,
    views: Sequence[TargetView],
    times_s: Mapping[str, float],
    points: Array,
) -> CameraTrack:
    """The track of one camera.

    Args:
        name: of the camera.
        camera: near the truth.
        views: what all cameras saw, each view of one picture.
        times_s: of views by name, on the camera's clock.
        points: (N, 3) of the target, metres.

    Raises:
        CalibrationError: the camera saw the target too seldom.
    """
    found = poses_alone(name, camera, views, points)
    order = sorted(found, key=lambda v: times_s[views[v].name])
    time_s = np.array([times_s[views[v].name] for v in order])
    if len(order) < _FEWEST or np.any(np.diff(time_s) <= 0.0):
        raise CalibrationError(
            f"{name}: {len(order)} pictures of the target with {len(set(time_s.tolist()))} times; "
            f"clocks need {_FEWEST} or more of different times, such as frames of a video"
        )
    return CameraTrack(
        time_s=time_s,
        pixels=np.stack([views[v].pixels[name] for v in order]),
        cam_from_target=RigidTransform.concatenate([found[v] for v in order]),
    )


def clock_offset(
    names: tuple[str, str],
    first: CameraTrack,
    other: CameraTrack,
    camera: Camera,
    points: Array,
) -> ClockOffset:
    """The offset of a camera's clock from the first one's.

    Args:
        names: of the first camera and of the other.
        first: what the first camera saw.
        other: what the other saw.
        camera: the other camera, near the truth.
        points: (N, 3) of the target, metres.

    Raises:
        CalibrationError: their pictures have too little motion in common.
    """
    motion = _PoseCurve(first)
    coarse_s, step_s = _search(names, motion, first, other)
    _, known = motion.at(other.time_s + coarse_s)
    for margin_s in (-step_s, step_s):
        known &= motion.at(other.time_s + coarse_s + margin_s)[1]
    between = other.cam_from_target[known] * motion.at(other.time_s[known] + coarse_s)[0].inv()
    middle = between[int(np.argmin(poses_apart(between, _range_m(other)).sum(axis=1)))]

    def misses(unknowns: Array, time_s: Array, pixels: Array) -> Array:
        """Of all points, by a change of the pose between the cameras and of the offset."""
        change = RigidTransform.from_components(unknowns[3:6], Rotation.from_rotvec(unknowns[:3]))
        poses = motion.at(time_s + coarse_s + np.clip(unknowns[6], -step_s, step_s))[0]
        moved = change * middle * poses
        seen = np.stack([camera.project(moved[i].apply(points)) for i in range(len(time_s))])
        return np.nan_to_num(seen - pixels).ravel()

    time_s, pixels, fit = other.time_s[known], other.pixels[known], np.zeros(7)
    for _ in range(2):
        fit = least_squares(misses, fit, args=(time_s, pixels), loss="soft_l1", x_scale="jac").x
        squares = misses(fit, time_s, pixels).reshape(len(time_s), -1) ** 2
        lengths = np.sqrt(squares.mean(axis=1))
        usual = lengths <= _ODD * np.median(lengths)
        time_s, pixels = time_s[usual], pixels[usual]
    last = least_squares(misses, fit, args=(time_s, pixels), x_scale="jac")
    # Points of a picture err together, with the pose that they are compared with: each picture is
    # one draw.
    slopes = np.asarray(last.jac, dtype=np.float64)
    residuals = misses(last.x, time_s, pixels).reshape(len(time_s), -1)
    pulls = np.einsum("tni,tn->ti", slopes.reshape(*residuals.shape, 7), residuals)
    inverse = np.linalg.pinv(slopes.T @ slopes)
    spread = inverse @ (pulls.T @ pulls) @ inverse * len(time_s) / max(len(time_s) - 7, 1)
    return ClockOffset(
        seconds=coarse_s + float(last.x[6]),
        sigma_s=float(np.sqrt(spread[6, 6])),
        pictures=len(time_s),
    )


def _range_m(track: CameraTrack) -> float:
    return float(np.median(np.linalg.norm(track.cam_from_target.translation, axis=1)))


def _search(
    names: tuple[str, str], motion: _PoseCurve, first: CameraTrack, other: CameraTrack
) -> tuple[float, float]:
    """The best of all offsets at which the pictures share enough, and the step between offsets."""
    chosen = np.unique(np.linspace(0, len(other.time_s) - 1, _TRIED).astype(int))
    time_s, poses, range_m = other.time_s[chosen], other.cam_from_target[chosen], _range_m(other)
    min_s, max_s = first.time_s[0] - other.time_s[-1], first.time_s[-1] - other.time_s[0]
    usual_s = min(float(np.median(np.diff(track.time_s))) for track in (first, other))
    step_s = max(0.5 * usual_s, (max_s - min_s) / _MAX_OFFSETS)
    offsets_s = np.arange(min_s, max_s, step_s)
    spreads = np.full(len(offsets_s), np.nan)
    for i, offset_s in enumerate(offsets_s.tolist()):
        at_moments, known = motion.at(time_s + offset_s)
        if known.sum() >= max(_FEWEST, _MIN_SHARED * len(time_s)):
            apart = poses_apart(poses[known] * at_moments[known].inv(), range_m)
            spreads[i] = np.median(apart, axis=1).min()
    if not np.isfinite(spreads).any():
        raise CalibrationError(
            f"{names[0]} and {names[1]} have too few pictures of the same motion for their clocks: "
            f"{_SHORTEST} or more without a gap, {_FEWEST} in common, such as frames of a video"
        )
    best = int(np.nanargmin(spreads))
    if spreads[best] > _CLEARER * np.nanmedian(spreads):
        raise CalibrationError(
            f"the clocks of {names[0]} and {names[1]} cannot be compared: the target moves too "
            "little before both at once, or too fast for the time between pictures"
        )
    return float(offsets_s[best]), step_s


def views_at_moments(
    tracks: Mapping[str, CameraTrack], offsets: Mapping[str, ClockOffset]
) -> tuple[TargetView, ...]:
    """Views of one moment each: when the first camera took its pictures.

    Args:
        tracks: of the cameras, the first one being the reference.
        offsets: of the clocks of the others.
    """
    reference, *others = tracks
    moments_s = tracks[reference].time_s
    pixels = {reference: tracks[reference].pixels}
    for name in others:
        pixels[name] = _interpolated(tracks[name], moments_s - offsets[name].seconds)
    width = len(str(len(moments_s) - 1))
    return tuple(
        TargetView(
            name=f"{v:0{width}d}",
            pixels={name: seen[v] for name, seen in pixels.items() if np.isfinite(seen[v]).any()},
        )
        for v in range(len(moments_s))
    )


def _interpolated(track: CameraTrack, time_s: Array) -> Array:
    """(T, N, 2) pixels at other times, by cubics through four pictures; NaN where one lacks."""
    found = np.full((len(time_s), *track.pixels.shape[1:]), np.nan)
    for run in track.motions():
        own_s, seen = track.time_s[run], track.pixels[run]
        for v in np.flatnonzero((time_s >= own_s[0]) & (time_s <= own_s[-1])).tolist():
            low = int(np.clip(np.searchsorted(own_s, time_s[v]) - 2, 0, len(own_s) - 4))
            at = own_s[low : low + 4]
            weights = [
                np.prod([(time_s[v] - at[k]) / (at[j] - at[k]) for k in range(4) if k != j])
                for j in range(4)
            ]
            used = [j for j, weight in enumerate(weights) if weight != 0.0]
            found[v] = sum(weights[j] * seen[low + j] for j in used)
    return found
