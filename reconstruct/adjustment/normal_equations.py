"""Normal equations of a block of pictures: what pixels say of stations, points and a shared rig.

Every pixel depends on the pose of one station, on one point, and perhaps on a few parameters that
all share. With R, c the pose `world_from_rig` and X the point, the pixel depends on
R^T (X - c) only, so that with P its slopes by X those by a small rotation about the axes of the
world (R' = exp(turn) R) and by a motion of c are P [X - c]x and -P. Points are eliminated one by
one, which leaves a block-sparse system of the stations with a border of what is shared
(`alice_survey.core.block_solver`).
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix, identity

from alice_survey.core.block_solver import BlockStep, Equations, Flags, Indices, product_of
from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from reconstruct.mapping.arrays import first_of

POSE = 6
"""Parameters of a station: turn about the axes of the world, then motion of its origin."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LinearObservations:
    """Linearised observations, sorted by point."""

    starts: Indices
    """(P + 1,) start of each point's observations."""
    station: Indices
    """(O,) index of the station."""
    by_point: Array
    """(O, 2, 3) slopes of the pixel by the point in the world."""
    arm: Array
    """(O, 3) vector from the station's origin to the point, in the world."""
    rest: Array
    """(O, 2, G + 1) slopes by what all share, then computed pixel minus the observed one."""

    @property
    def arrays(self) -> tuple[Indices, Indices, Array, Array, Array]:
        """All of it, as kernels take it."""
        return self.starts, self.station, self.by_point, self.arm, self.rest

    @property
    def miss(self) -> Array:
        """(O, 2) computed pixel minus the observed one."""
        return self.rest[..., -1]

    @property
    def point_inverse(self) -> Array:
        """(P, 3, 3) covariances of points where all else is known."""
        return _point_inverse(self.starts, self.by_point)

    def weigh(self, weights: Array) -> "LinearObservations":
        """The same observations with the squares of each weighted, (O,)."""
        root = np.sqrt(weights)[:, None, None]
        return replace(self, by_point=root * self.by_point, rest=root * self.rest)


@dataclass(frozen=True, kw_only=True, eq=False)
class LinearParts:
    """Observations by whole points, in parts that are linearised where they are needed."""

    stations: Sequence[Indices]
    """Of each part, the stations (f,) that it sees, ascending; observations count in these."""
    points: Sequence[int]
    """How many points each part has."""
    pattern: "BlockPattern"
    """Which of all stations see points in common."""
    map: Callable[[Callable[[LinearObservations, Any], Any], Iterable[Any]], Iterator[Any]]
    """Yields `function(part, value)` of every part with its value, in order."""


def one_part(
    linear: LinearObservations, stations: int, pattern: "BlockPattern | None" = None
) -> LinearParts:
    """All observations of so many stations as one part, in this process."""
    return LinearParts(
        stations=[np.arange(stations)],
        points=[len(linear.starts) - 1],
        pattern=pattern or pattern_of(linear.starts, linear.station, stations),
        map=lambda function, values: (function(linear, value) for value in values),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class BlockPattern:
    """Which stations meet, as rows of a matrix of blocks."""

    pointers: Indices
    """(F + 1,) and (B,): the blocks of every station's row, and their columns, sorted."""
    columns: Indices

    @cached_property
    def keys(self) -> Indices:
        """(B,) row and column of each block as one number, ascending."""
        stations = len(self.pointers) - 1
        rows = np.repeat(np.arange(stations), np.diff(self.pointers))
        return np.asarray(rows * stations + self.columns)

    def at(self, stations: Indices, part: "BlockPattern") -> Indices:
        """Where the blocks of a part of the stations, (f,), are among these."""
        rows, columns = np.divmod(part.keys, len(stations))
        requested = stations[rows] * (len(self.pointers) - 1) + stations[columns]
        return np.searchsorted(self.keys, requested)


def pattern_of(starts: Indices, station: Indices, stations: int) -> BlockPattern:
    """The pattern of stations that see points in common.

    Args:
        starts: (P + 1,) start of each point's observations.
        station: (O,) of all observations.
        stations: F, how many there are.
    """
    seen = csr_matrix(
        (np.ones(len(station), np.int32), station, starts), shape=(len(starts) - 1, stations)
    )
    return _pattern(csr_matrix(seen.T @ seen + identity(stations, np.int32, format="csr")))


def joined_pattern(parts: Iterable[tuple[Indices, BlockPattern]], stations: int) -> BlockPattern:
    """The pattern of all stations, from those of parts of them, (f,) each."""
    keys = np.arange(stations) * (stations + 1)
    for own, part in parts:
        rows, columns = np.divmod(part.keys, len(own))
        keys = np.union1d(keys, own[rows] * stations + own[columns])
    rows, columns = np.divmod(keys, stations)
    pointers = np.searchsorted(rows, np.arange(stations + 1))
    return BlockPattern(pointers=pointers.astype(np.int64), columns=columns)


def _pattern(meets: csr_matrix) -> BlockPattern:
    meets.sort_indices()
    return BlockPattern(
        pointers=meets.indptr.astype(np.int64), columns=meets.indices.astype(np.int64)
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class PointEquations(Equations):
    """Normal equations of stations and of what is shared, the points eliminated."""

    parts: LinearParts
    """All that is taken from the observations is a sum over points, or stays with one."""

    @cached_property
    def point_inverse(self) -> Array:
        """(P, 3, 3) covariance of the points where all else is known."""
        return self._by_point(_inverse_of_part, [None for _ in self.parts.stations])

    def point_steps(self, step: BlockStep) -> Array:
        """How far every point moves, (P, 3), where all else takes a step."""
        return self.follow(step.poses, np.append(step.shared, 1.0))

    def follow(self, poses: Array, rest: Array) -> Array:
        """Motions (P, 3) of points by steps (F, 6) of stations and (G + 1,) of the `rest`."""
        steps = ((poses[own, :, None], rest[None]) for own in self.parts.stations)
        return self._by_point(_follow_steps_in_part, ((step, slice(None)) for step in steps))[
            ..., 0
        ]

    def follow_poses(self, poses: Array) -> Iterator[Array]:
        """Yield the motions (p, 3, K) of the points of each part by K steps (F, 6, K) of stations.

        Nothing is shared.
        """
        steps = ((poses[own], np.zeros((poses.shape[2], 1))) for own in self.parts.stations)
        return self.parts.map(_follow_steps_in_part, ((step, slice(None)) for step in steps))

    def follow_shared(self, response: Array, every: int) -> Array:
        """Motions (P', 3, G) of every n-th point by what is shared.

        Args:
            response: (F, 6, G) how stations move by it.
            every: n.
        """
        firsts = np.cumsum([0, *self.parts.points])[:-1].tolist()
        units = np.eye(response.shape[2], response.shape[2] + 1)
        steps = (
            ((response[own], units), slice(-first % every, None, every))
            for own, first in zip(self.parts.stations, firsts, strict=True)
        )
        return self._by_point(_follow_steps_in_part, steps)

    def point_covariances(self, blocks: Array) -> Array:
        """Covariance of every point, (P, 3, 3), from those of its stations.

        With G = -V^-1 W^T what a point does when its stations move: V^-1 + G C G^T.

        Args:
            blocks: (B, 6, 6) covariances between the stations that see a point in common.
        """
        whole = BlockPattern(pointers=self.pointers, columns=self.columns)
        near = ((own, *_between(whole, own)) for own in self.parts.stations)
        values = ((pattern, blocks[at]) for _, pattern, at in near)
        return self._by_point(_covariances_of_part, values)

    def _by_point(
        self, function: Callable[[LinearObservations, Any], Array], values: Iterable[Any]
    ) -> Array:
        return np.concatenate(list(self.parts.map(function, values)))


def _between(whole: BlockPattern, own: Indices) -> tuple[BlockPattern, Indices]:
    """The pattern of some of the stations (f,), and where its blocks are in the whole."""
    count = len(whole.columns)
    matrix = csr_matrix(
        (np.arange(1, count + 1), whole.columns, whole.pointers),
        shape=(len(whole.pointers) - 1,) * 2,
    )
    part = matrix[own][:, own]
    part.sort_indices()
    return _pattern(part), part.data - 1


def _inverse_of_part(linear: LinearObservations, _: None) -> Array:
    return linear.point_inverse


def _follow_steps_in_part(
    linear: LinearObservations, by: tuple[tuple[Array, Array], slice]
) -> Array:
    """Motions (p, 3, K) of chosen points by steps (f, 6, K) of stations, (K, G + 1) of the rest."""
    (poses, rest), chosen = by
    inverse = linear.point_inverse
    steps = zip(np.ascontiguousarray(poses.transpose(2, 0, 1)), rest, strict=True)
    moved = [_follow(*linear.arrays, inverse, *step)[chosen] for step in steps]
    return np.stack(moved, axis=-1)


def _covariances_of_part(linear: LinearObservations, known: tuple[BlockPattern, Array]) -> Array:
    pattern, blocks = known
    return _point_covariances(
        *linear.arrays, linear.point_inverse, pattern.pointers, pattern.columns, blocks
    )


def reduce_points(linear: LinearObservations, stations: int) -> PointEquations:
    """Eliminate the points.

    Args:
        linear: observations; every point needs two that see it from apart.
        stations: F, how many there are.
    """
    return reduce_parts(one_part(linear, stations))


def reduce_parts(parts: LinearParts) -> PointEquations:
    """Eliminate the points, part by part; the sums are added in the order of the parts."""
    pattern = parts.pattern
    stations = len(pattern.pointers) - 1
    found: PointEquations | None = None
    every = parts.map(_reduce_part, map(len, parts.stations))
    for own, (part, blocks, border, shared) in zip(parts.stations, every, strict=True):
        if found is None:
            count = len(shared)
            found = PointEquations(
                pointers=pattern.pointers, columns=pattern.columns, parts=parts,
                blocks=np.zeros((len(pattern.columns), POSE, POSE)),
                border=np.zeros((stations, POSE, count)), shared=np.zeros((count, count)),
                free=np.ones((stations, POSE), dtype=np.bool_),
            )  # fmt: skip
        found.blocks[pattern.at(own, part)] += blocks
        found.border[own] += border
        found.shared[:] += shared
    if found is None:
        raise ValueError("no observations")
    found.shared[:] += np.tril(found.shared, -1).T
    return found


def _reduce_part(
    linear: LinearObservations, stations: int
) -> tuple[BlockPattern, Array, Array, Array]:
    """What a part of the points says of its own stations and of what is shared.

    Blocks, border and, below its diagonal, what is shared are as in `Equations`.
    """
    pattern = pattern_of(linear.starts, linear.station, stations)
    count = linear.rest.shape[2]
    blocks = np.zeros((len(pattern.columns), POSE, POSE))
    border, shared = np.zeros((stations, POSE, count)), np.zeros((count, count))
    _reduce(
        *linear.arrays, linear.point_inverse, pattern.pointers, pattern.columns, blocks, border,
        shared,
    )  # fmt: skip
    return pattern, blocks, border, shared


@compiled
def find_block(pointers: Indices, columns: Indices, row: int, column: int) -> int:
    """Where a block stands among those of its row; it must be there."""
    low, high = pointers[row], pointers[row + 1]
    while low < high:
        middle = (low + high) // 2
        if columns[middle] < column:
            low = middle + 1
        else:
            high = middle
    return int(low)


@compiled
def by_pose(by_point: Array, arm: Array, out: Array) -> None:
    """Slopes (2, 6) of one pixel by its station's pose, from those by the point."""
    x, y, z = arm[0], arm[1], arm[2]
    for row in range(2):
        u, v, w = by_point[row, 0], by_point[row, 1], by_point[row, 2]
        out[row, 0] = v * z - w * y
        out[row, 1] = w * x - u * z
        out[row, 2] = u * y - v * x
        out[row, 3], out[row, 4], out[row, 5] = -u, -v, -w


@compiled
def _invert(m: Array, out: Array) -> None:
    """The inverse of a symmetric 3 x 3 matrix; NaN where it has none."""
    a, b, c, d, e, f = m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2]
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * aa + b * bb + c * cc
    scale = 1.0 / determinant if determinant > 0.0 else np.nan
    out[0, 0], out[0, 1], out[0, 2] = aa * scale, bb * scale, cc * scale
    out[1, 0], out[1, 1], out[1, 2] = out[0, 1], (a * f - c * c) * scale, (b * c - a * e) * scale
    out[2, 0], out[2, 1], out[2, 2] = out[0, 2], out[1, 2], (a * d - b * b) * scale


@compiled
def _point_inverse(starts: Indices, by_point: Array) -> Array:
    """Covariances (P, 3, 3) of points where all else is known."""
    points = starts.shape[0] - 1
    inverse, own = np.empty((points, 3, 3)), np.empty((3, 3))
    for p in range(points):
        own[:] = 0.0
        for o in range(starts[p], starts[p + 1]):
            for row in range(2):
                for i in range(3):
                    s = by_point[o, row, i]
                    for j in range(3):
                        own[i, j] += s * by_point[o, row, j]
        _invert(own, inverse[p])
    return inverse


@compiled
def _reduce(
    starts: Indices, station: Indices, by_point: Array, arm: Array, rest: Array, inverse: Array,
    pointers: Indices, columns: Indices, blocks: Array, border: Array, shared: Array,
) -> None:  # fmt: skip
    """Add what some points say, in place, of `shared` below its diagonal."""
    points, count = starts.shape[0] - 1, rest.shape[2]
    longest = np.int64(0)
    for p in range(points):
        longest = max(longest, starts[p + 1] - starts[p])
    pose = np.empty((longest, 2, 6))
    cross, gain = np.empty((longest, 6, 3)), np.empty((longest, 6, 3))
    together, solved = np.empty((3, count)), np.empty((3, count))
    for p in range(points):
        first, end = starts[p], starts[p + 1]
        together[:] = 0.0
        for o in range(first, end):
            for row in range(2):
                for i in range(3):
                    s = by_point[o, row, i]
                    for g in range(count):
                        together[i, g] += s * rest[o, row, g]
        back = inverse[p]
        for i in range(3):
            for g in range(count):
                solved[i, g] = 0.0
                for j in range(3):
                    solved[i, g] += back[i, j] * together[j, g]
        for o in range(first, end):
            k = o - first
            by_pose(by_point[o], arm[o], pose[k])
            for i in range(6):
                for j in range(3):
                    cross[k, i, j] = (
                        pose[k, 0, i] * by_point[o, 0, j] + pose[k, 1, i] * by_point[o, 1, j]
                    )
            for i in range(6):
                for j in range(3):
                    gain[k, i, j] = (
                        cross[k, i, 0] * back[0, j]
                        + cross[k, i, 1] * back[1, j]
                        + cross[k, i, 2] * back[2, j]
                    )
        for o in range(first, end):
            k, s = o - first, station[o]
            at = find_block(pointers, columns, s, s)
            for i in range(6):
                u, v = pose[k, 0, i], pose[k, 1, i]
                for j in range(6):
                    blocks[at, i, j] += u * pose[k, 0, j] + v * pose[k, 1, j]
                x, y, z = gain[k, i, 0], gain[k, i, 1], gain[k, i, 2]
                for g in range(count):
                    border[s, i, g] += (
                        u * rest[o, 0, g] + v * rest[o, 1, g]
                        - x * together[0, g] - y * together[1, g] - z * together[2, g]
                    )  # fmt: skip
            for other in range(first, end):
                m, block = other - first, blocks[find_block(pointers, columns, s, station[other])]
                for i in range(6):
                    x, y, z = gain[k, i, 0], gain[k, i, 1], gain[k, i, 2]
                    for j in range(6):
                        block[i, j] -= x * cross[m, j, 0] + y * cross[m, j, 1] + z * cross[m, j, 2]
            for g in range(count):
                u, v = rest[o, 0, g], rest[o, 1, g]
                if u == 0.0 and v == 0.0:  # of another camera
                    continue
                for h in range(min(g + 1, count - 1)):
                    shared[g, h] += u * rest[o, 0, h] + v * rest[o, 1, h]
        for g in range(count):
            for j in range(3):
                for h in range(g + 1):
                    shared[g, h] -= together[j, g] * solved[j, h]


@compiled
def _follow(
    starts: Indices, station: Indices, by_point: Array, arm: Array, rest: Array,
    inverse: Array, steps: Array, rest_steps: Array,
) -> Array:  # fmt: skip
    points = starts.shape[0] - 1
    moved = np.empty((points, 3))
    pose, pull = np.empty((2, 6)), np.empty(3)
    for p in range(points):
        pull[:] = 0.0
        for o in range(starts[p], starts[p + 1]):
            by_pose(by_point[o], arm[o], pose)
            for row in range(2):
                value = 0.0
                for i in range(6):
                    value += pose[row, i] * steps[station[o], i]
                for g in range(rest_steps.shape[0]):
                    value += rest[o, row, g] * rest_steps[g]
                for i in range(3):
                    pull[i] -= by_point[o, row, i] * value
        for i in range(3):
            moved[p, i] = (
                inverse[p, i, 0] * pull[0] + inverse[p, i, 1] * pull[1] + inverse[p, i, 2] * pull[2]
            )
    return moved


@compiled
def _point_covariances(
    starts: Indices, station: Indices, by_point: Array, arm: Array, rest: Array, inverse: Array,
    pointers: Indices, columns: Indices, blocks: Array,
) -> Array:  # fmt: skip
    points = starts.shape[0] - 1
    found = inverse.copy()
    longest = np.int64(0)
    for p in range(points):
        longest = max(longest, starts[p + 1] - starts[p])
    follow, pose = np.empty((longest, 3, 6)), np.empty((2, 6))
    for p in range(points):
        first, end = starts[p], starts[p + 1]
        for o in range(first, end):
            by_pose(by_point[o], arm[o], pose)
            for i in range(3):
                for j in range(6):
                    value = 0.0
                    for k in range(3):
                        value += inverse[p, i, k] * (
                            by_point[o, 0, k] * pose[0, j] + by_point[o, 1, k] * pose[1, j]
                        )
                    follow[o - first, i, j] = value
        for a in range(first, end):
            for b in range(first, end):
                at = find_block(pointers, columns, station[a], station[b])
                for i in range(3):
                    for j in range(6):
                        value = 0.0
                        for k in range(6):
                            value += follow[a - first, i, k] * blocks[at, k, j]
                        for k in range(3):
                            found[p, i, k] += value * follow[b - first, k, j]
    return found


class Gauge:
    """Motions that pictures do not see: of each group of linked stations by itself."""

    def __init__(
        self, centres: Array, depth: float, scale_free: bool, group: Indices | None = None
    ) -> None:
        """Take stations at (F, 3) of groups (F,); `depth`, a usual one, weighs turns."""
        self.group = np.zeros(len(centres), np.int64) if group is None else group
        first = first_of(self.group)
        self.each = 7 if scale_free else POSE
        self.middles = np.stack([centres[self.group == g].mean(axis=0) for g in range(len(first))])
        shifts = self.of_points(centres, self.group)
        self.motions = np.concatenate([np.zeros_like(shifts), shifts], axis=1)
        for axis in range(3):
            self.motions[np.arange(len(centres)), axis, self.each * self.group + axis] = 1.0
        self.weights = np.array([depth**2] * 3 + [1.0] * 3)
        self.weighed = self.motions * self.weights[:, None]
        self.spread = np.linalg.inv(product_of(self.motions, self.weighed))
        self.held: Flags = np.zeros((len(centres), POSE), dtype=np.bool_)
        self.held[first] = True
        for g, start in enumerate(first if scale_free else ()):
            arms = np.where((self.group == g)[:, None], centres - centres[start], 0.0)
            far = int(np.argmax(np.linalg.norm(arms, axis=1)))
            self.held[far, 3 + int(np.argmax(np.abs(arms[far])))] = True

    def of_points(self, points: Array, group: Indices | None = None) -> Array:
        """What the same motions do to (N, 3) points of groups (N,), (N, 3, 6 or 7 a group)."""
        group = np.zeros(len(points), np.int64) if group is None else group
        arms, rows = points - self.middles[group], np.arange(len(points))
        found = np.zeros((len(arms), 3, self.each * len(self.middles)))
        for axis in range(3):
            found[rows, :, self.each * group + axis] = np.cross(np.eye(3)[axis], arms)
            found[rows, axis, self.each * group + 3 + axis] = 1.0
        if self.each > POSE:
            found[rows, :, self.each * group + POSE] = arms
        return found

    def motion_in(self, steps: Array) -> Array:
        """How much of each motion (6 or 7 a group, G) steps (F, 6, G) of the stations are."""
        return np.asarray(self.spread @ product_of(self.weighed, steps))

    def shape_weights(self, weights: Array) -> Array:
        """Weights (F, 6) of stations' steps in a sum, those minus the motions being summed."""
        along = np.tensordot(self.motions, weights, axes=([0, 1], [0, 1]))
        return np.asarray(weights - self.weighed @ (self.spread @ along))

    def shape_blocks(self, equations: Equations) -> Array:
        """Covariances (B, 6, 6) of stations without these motions, where the equations have blocks.

        Args:
            equations: of the stations, whatever holds their place.
        """
        along = equations.covariance_times(self.weighed) @ self.spread
        across = along - 0.5 * self.motions @ self.motion_in(along)
        rows, columns = equations.rows, equations.columns
        blocks = self.motions[rows] @ across[columns].swapaxes(1, 2)
        blocks += across[rows] @ self.motions[columns].swapaxes(1, 2)
        return equations.covariance_blocks() - blocks
