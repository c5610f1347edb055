"""A survey's observations through its exact flat-port cameras, linearised.

What the adjustment of ideal pinholes holds fixed, the rig and its ports, is free to move here: the
pixels as taken depend on stations, on points and on every parameter of the rig.

Many observations are in parts, each of neighbouring stations, on as many workers as there are. A
part holds whole points and knows its own stations alone, so that what it says of the survey is a
small sum. Sums are added in the order of the parts: the result does not depend on the workers. What
does not change lies in files, of which a task has the paths.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.spatial import KDTree

from alice_survey.core.compiled import compiled
from alice_survey.core.executor import SERIAL, Executor
from alice_survey.core.frames import Array
from camera_calib.camera import Camera
from camera_calib.freedom import select_slopes, slope_columns
from camera_calib.rig import Rig
from reconstruct.adjustment.normal_equations import (
    BlockPattern,
    LinearObservations,
    LinearParts,
    joined_pattern,
    one_part,
    pattern_of,
)
from reconstruct.mapping.arrays import Indices, frames_of, observations, rig_poses
from reconstruct.mapping.bundle import robust_weights
from reconstruct.mapping.database import Observations
from reconstruct.mapping.mapper import Mapped

Value = TypeVar("Value")
Result = TypeVar("Result")
_BLOCK = 4096
"""Observations at a time: their intermediate values stay in the cache."""
PART = 80_000
"""Observations that are linearised at a time, some: they take 4 kB each."""
_ORDER = 5
"""Of the polynomials of keypoints' shifts: a lens's own radial terms but the last."""


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

    @property
    def seen_by(self) -> Indices:
        """(O,) how many observations each one's point has."""
        counts: Indices = np.diff(self.starts)
        return np.repeat(counts, counts)

    def parts(self) -> list[tuple[int, int]]:
        """Runs of points, first and end, of about `PART` observations each."""
        ends = np.searchsorted(self.starts, np.arange(PART, len(self.station), PART))
        bounds = np.unique([0, *ends, self.points])
        return list(pairwise(bounds.tolist()))

    def by_place(self, centres: Array) -> "tuple[Pixels, Indices]":
        """The same with points next to each other that neighbouring stations see.

        Parts of many observations then have few stations. Where all are one part, points stay.

        Args:
            centres: (F, 3) of the stations.

        Returns:
            The observations, and (P,) which point each is.
        """
        if len(self.parts()) <= 1:
            return self, np.arange(self.points)
        leaf = np.argsort(KDTree(centres).indices)
        order = np.argsort(np.minimum.reduceat(leaf[self.station], self.starts[:-1]), kind="stable")
        counts = np.diff(self.starts)[order]
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        rows = np.repeat(self.starts[order] - starts[:-1], counts) + np.arange(starts[-1])
        return Pixels(
            starts=starts, station=self.station[rows], camera=self.camera[rows],
            taken=self.taken[rows], point=np.repeat(np.arange(self.points), counts),
        ), order  # fmt: skip

    def run(self, first: int, end: int) -> "Pixels":
        """The observations of points from the first up to the end."""
        rows = slice(self.starts[first], self.starts[end])
        return Pixels(
            starts=self.starts[first : end + 1] - self.starts[first], station=self.station[rows],
            camera=self.camera[rows], taken=self.taken[rows], point=self.point[rows],
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class RigState:
    """One guess of all unknowns."""

    rig: Rig
    """The cameras that took pictures, the reference first."""
    turns: Array
    """(F, 3, 3) `world_from_rig`, and (F, 3) where the rig's origins are."""
    centres: Array
    points: Array
    shifts: Array = field(default_factory=lambda: np.zeros((0, 2, 0)))
    """(C, 2, K) of the keypoints of each camera, in all its pictures alike: sums of `frame_terms`,
    pixels; empty where there are none."""

    def with_shifts(self) -> "RigState":
        """The same with shifts, of no size yet."""
        terms = (_ORDER + 1) * (_ORDER + 2) // 2
        return replace(self, shifts=np.zeros((len(self.rig.cameras), 2, terms)))


def frame_terms(camera: Camera, pixels: Array) -> Array:
    """Polynomials over the frame at (N, 2) pixels: (N, K), each of mean square 1, orthogonal."""
    size, orders = np.array([camera.width_px, camera.height_px]), np.arange(_ORDER + 1)
    u, v = legvander((2.0 * pixels / size - 1.0).T, _ORDER) * np.sqrt(2 * orders + 1)
    row, column = np.nonzero(np.add.outer(orders, orders) <= _ORDER)
    return np.asarray(u[:, row] * v[:, column])


def calibrated_parameters(rig: Rig, names: Sequence[str]) -> tuple[str, ...]:
    """The parameters of these cameras whose covariance a rig states."""
    known = () if rig.covariance is None else rig.covariance.parameters
    return tuple(name for name in known if name.split(".")[0] in names)


def exact_survey(mapped: Mapped, seen: Observations, rig: Rig) -> tuple[Pixels, RigState, Indices]:
    """A model as flat-port cameras on one rig have it.

    Args:
        mapped: exact model on the rig; picture i of `seen` has the id i + 1.
        seen: keypoints.
        rig: cameras.

    Returns:
        The observations that take part; where stations, by ascending frame, and the points of these
        are; and the ids of the points.
    """
    model, found, names = mapped.model, observations(mapped.model), list(seen.cameras)
    frames = frames_of(model)
    camera, station = np.empty(len(found.point), np.int64), np.empty(len(found.point), np.int64)
    taken = np.empty((len(found.point), 2))
    for n, number in enumerate(found.pictures.tolist()):
        rows, record = found.of(n), seen.images[number - 1]
        taken[rows] = seen.taken[number - 1][found.keypoint[rows]]
        camera[rows] = names.index(record.camera)
        station[rows] = np.searchsorted(frames, model.images[number].frame_id)
    lost = np.unique(found.point[~np.isfinite(taken).all(axis=1)])
    order = np.flatnonzero(~np.isin(found.point, lost))
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
    reference = rig.cam_from_rig[names[0]]
    poses = rig_poses(model, frames).inv() * mapped.warps[names[0]].pinhole_from_cam
    state = RigState(
        rig=replace(
            rig,
            cameras={name: rig.cameras[name] for name in names},
            cam_from_rig={name: rig.cam_from_rig[name] * reference.inv() for name in names},
        ),
        turns=poses.rotation.as_matrix(),
        centres=poses.translation,
        points=found.points[points],
    )
    return pixels, state, found.point_ids[points]


def exact_residuals(pixels: Pixels, state: RigState, _: None = None) -> Array:
    """(O, 2) computed pixels minus observed ones; NaN where no ray explains one."""
    arm = state.points[pixels.point] - state.centres[pixels.station]
    residuals = np.empty((len(arm), 2))
    for c, (name, pose) in enumerate(state.rig.cam_from_rig.items()):
        rows = np.flatnonzero(pixels.camera == c)
        in_rig = np.einsum("nij,ni->nj", state.turns[pixels.station[rows]], arm[rows])
        residuals[rows] = state.rig.cameras[name].project(pose.apply(in_rig)) - pixels.taken[rows]
        if state.shifts.size:
            terms = frame_terms(state.rig.cameras[name], pixels.taken[rows])
            residuals[rows] += terms @ state.shifts[c].T
    return residuals


def exact_observations(
    state: RigState, pixels: Pixels, fields: Sequence[str]
) -> LinearObservations:
    """The observations linearised; those that no ray explains do not count.

    After the fields come the shifts of the state, where it has some.
    """
    arm = state.points[pixels.point] - state.centres[pixels.station]
    by_point = np.zeros((len(arm), 2, 3))
    rest = np.zeros((len(arm), 2, len(fields) + state.shifts.size + 1))
    for c, (name, pose) in enumerate(state.rig.cam_from_rig.items()):
        camera, turn = state.rig.cameras[name], pose.rotation.as_matrix()
        source, target = slope_columns(state.rig, fields, name)
        own = len(fields) + np.arange(state.shifts.size).reshape(state.shifts.shape)
        target = np.concatenate([target, own[c : c + 1].ravel(), [-1]])
        every = np.flatnonzero(pixels.camera == c)
        for first in range(0, len(every), _BLOCK):
            rows = every[first : first + _BLOCK]
            world_from_rig = state.turns[pixels.station[rows]]
            turned = np.einsum("nij,ni->nj", world_from_rig, arm[rows]) @ turn.T
            at, by_cam, by_camera = camera.project_jacobian(turned + pose.translation)
            slopes = select_slopes(source, by_camera, by_cam, turned)
            terms = np.zeros((len(rows), 0))
            miss = at - pixels.taken[rows]
            if state.shifts.size:
                terms = frame_terms(camera, pixels.taken[rows])
                miss += terms @ state.shifts[c].T
            by_shift = np.kron(np.eye(2), terms[:, None])
            slopes = np.concatenate([slopes, by_shift, miss[:, :, None]], axis=2)
            slopes = np.ascontiguousarray(slopes)
            _put(rows, by_cam @ turn, world_from_rig, slopes, target, by_point, rest)
    return LinearObservations(
        starts=pixels.starts, station=pixels.station, by_point=by_point, arm=arm, rest=rest
    )


@compiled
def _put(
    rows: Indices, by_rig: Array, turns: Array, slopes: Array, target: Indices, by_point: Array,
    rest: Array,
) -> None:  # fmt: skip
    """Put what one camera sees in its rows, in place; what it does not see stays as it is.

    Args:
        rows: (N,) observations of the camera.
        by_rig: (N, 2, 3) slopes by the point along the axes of the rig.
        turns: (N, 3, 3) of `world_from_rig`.
        slopes: (N, 2, K) by what is wanted of the camera, last the miss; NaN if not seen.
        target: (K,) where in `rest` they go.
        by_point: (O, 2, 3) to fill.
        rest: (O, 2, G + 1) the same way.
    """
    for i in range(rows.shape[0]):
        o = rows[i]
        if not np.isfinite(slopes[i, 0, -1] + slopes[i, 1, -1]):
            continue
        turn = turns[i]
        for row in range(2):
            u, v, w = by_rig[i, row, 0], by_rig[i, row, 1], by_rig[i, row, 2]
            for j in range(3):
                by_point[o, row, j] = u * turn[j, 0] + v * turn[j, 1] + w * turn[j, 2]
            for k in range(target.shape[0]):
                rest[o, row, target[k]] = slopes[i, row, k]


@dataclass(frozen=True, kw_only=True)
class Workers:
    """Where parts are worked on."""

    executor: Executor = SERIAL
    folder: Path | None = None
    """For what all workers read; None where they are this process."""

    def __post_init__(self) -> None:
        if self.folder is None and (self.executor.workers > 1 or self.executor.pool is not None):
            raise ValueError("workers of other processes need a folder")

    def apart(self, name: str) -> "Workers":
        """The same, with a folder of its own in that of these."""
        return replace(self, folder=None if self.folder is None else self.folder / name)


ALONE = Workers()
"""This process."""


def _run(
    function: Callable[[Pixels, Any, Any], Result], part: tuple[Pixels | Path, Any, Any]
) -> Result:
    """What a function makes of a part, whose pixels may lie in a file."""
    pixels, state, value = part
    if isinstance(pixels, Path):
        with np.load(pixels) as arrays:
            pixels = Pixels(**arrays)
    return function(pixels, state, value)


class PixelParts:
    """Observations in parts of about `PART`; one alone is the survey as it is."""

    def __init__(self, pixels: Pixels, stations: int, workers: Workers = ALONE) -> None:
        self.pixels, self.count, self.workers = pixels, stations, workers
        self.runs = pixels.parts()
        self.points = [end - first for first, end in self.runs]
        self.kept: dict[int, Pixels | Path] = {}
        self.stations: Sequence[Indices] = [np.arange(stations)]
        if not self.is_one:
            self.stations = [np.unique(pixels.run(*run).station) for run in self.runs]

    @property
    def is_one(self) -> bool:
        """Whether they are one part."""
        return len(self.runs) == 1

    @cached_property
    def pattern(self) -> BlockPattern:
        """Which stations see points in common."""
        if self.is_one:
            return pattern_of(self.pixels.starts, self.pixels.station, self.count)
        found = self._map(_pattern_of_part, [None] * len(self.runs), self.stations)
        return joined_pattern(zip(self.stations, found, strict=True), self.count)

    def map(
        self,
        function: Callable[[Pixels, RigState, Value], Result],
        state: RigState,
        values: Iterable[Value],
    ) -> Iterator[Result]:
        """Yield `function(pixels, state, value)` of every part, in order.

        Args:
            function: a task of the part's pixels, of the state of its stations and points, and of a
                value.
            state: of the survey.
            values: one for each part.
        """
        states = iter([state])
        if not self.is_one:
            states = (
                replace(
                    state, turns=state.turns[own], centres=state.centres[own],
                    points=state.points[slice(*run)],
                )
                for run, own in zip(self.runs, self.stations, strict=True)
            )  # fmt: skip
        return self._map(function, states, values)

    def _map(
        self, function: Callable[..., Result], states: Iterable[Any], values: Iterable[Any]
    ) -> Iterator[Result]:
        parts = map(self._of, range(len(self.runs)))
        tasks = zip(parts, states, values, strict=True)
        run, executor = partial(_run, function), self.workers.executor
        if self.is_one or self.workers.folder is None:
            return map(run, tasks)
        return executor.map(run, tasks, label="parts of the survey", total=len(self.runs))

    def _of(self, number: int) -> Pixels | Path:
        """Pixels of a part, counting in its stations and points, or the file of these."""
        if self.is_one:
            return self.pixels
        if number not in self.kept:
            run = self.pixels.run(*self.runs[number])
            own: Pixels | Path = replace(
                run, station=np.searchsorted(self.stations[number], run.station),
                point=run.point - self.runs[number][0],
            )  # fmt: skip
            if self.workers.folder is None:
                return own
            self.workers.folder.mkdir(parents=True, exist_ok=True)
            path = self.workers.folder / f"part-{number:05d}.npz"
            np.savez(path, **vars(own))
            self.kept[number] = path
        return self.kept[number]

    def residuals(self, state: RigState) -> Array:
        """(O, 2) computed pixels minus observed ones; NaN where no ray explains one."""
        return np.concatenate(list(self.map(exact_residuals, state, [None] * len(self.runs))))


def _pattern_of_part(pixels: Pixels, _: None, own: Indices) -> BlockPattern:
    return pattern_of(pixels.starts, pixels.station, len(own))


def linearise_parts(
    pixels: PixelParts, state: RigState, fields: Sequence[str], noise: tuple[float, float]
) -> LinearParts:
    """Weighted observations from one guess, part by part; a single part is computed once only.

    Args:
        pixels: what is seen.
        state: the guess.
        fields: parameters of the rig that are not held.
        noise: sigma of a keypoint's coordinate for the weights, and variance that scales them.
    """
    weigh = partial(_weigh, tuple(fields), noise)
    if pixels.is_one:
        return one_part(weigh(pixels.pixels, state), pixels.count, pixels.pattern)
    return LinearParts(
        stations=pixels.stations, points=pixels.points, pattern=pixels.pattern,
        map=lambda function, values: pixels.map(
            partial(_with_weights, function, weigh), state, values
        ),
    )  # fmt: skip


def _weigh(
    fields: tuple[str, ...], noise: tuple[float, float], pixels: Pixels, state: RigState
) -> LinearObservations:
    sigma, variance = noise
    found = exact_observations(state, pixels, fields)
    root = np.sqrt(robust_weights(found.miss, sigma) / variance)[:, None, None]
    for slopes in (found.by_point, found.rest):  # in place: a copy takes longer than all else
        slopes *= root
    return found


def _with_weights(
    function: Callable[[LinearObservations, Any], Result],
    weigh: Callable[[Pixels, RigState], LinearObservations],
    pixels: Pixels,
    state: RigState,
    value: Any,
) -> Result:
    return function(weigh(pixels, state), value)
