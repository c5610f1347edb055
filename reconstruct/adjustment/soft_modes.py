"""How a block moves where its pictures hold it least: soft modes, motions of groups and of the rig.

Pictures leave few deformations of a block soft: its bends, its twist, its scale. These soft modes,
the leading eigenvectors of the covariance, are what measurements from outside can improve; all
others are known better from the pictures. Updating them alone is the best approximation of its rank
to the joint estimate (Spantini et al. 2015, "Optimal low-rank approximations of Bayesian linear
inverse problems").
"""

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, eigsh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from alice_survey.core.frames import Array
from reconstruct.adjustment.normal_equations import POSE, Gauge, PointEquations
from reconstruct.mapping.arrays import Indices

_MODES = 32
"""Soft modes at most: of a block of lines the tenth is known a hundred times as well as the first.
"""
_MODES_TOLERANCE = 1e-4
_ROWS = 10_000
"""Points whose motions are worked on at a time: in double precision they take much memory."""
_MIN_MODE = 1e-13
"""Variance of a mode over that of the softest, above rounding: where two parts of a model hardly
hang together, one mode is kilometres large and others are millimetres."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Groups:
    """Groups of stations that no point links; the first is the largest."""

    station: Indices
    """(F,) the group of each station."""
    point: Indices
    """(P,) that of each point."""
    middles: Array
    """(N, 3) about which groups turn and grow."""

    def carry(self, motions: Array, places: Array, group: Indices) -> Array:
        """Places (M, 3) of groups (M,) that are moved relative to the first.

        Args:
            motions: (N - 1, 6 or 7) of the other groups: turn, shift, logarithm of the scale.
            places: to carry, in the model.
            group: of each.
        """
        every = np.concatenate([np.zeros((1, motions.shape[1])), motions])[group]
        arms = Rotation.from_rotvec(every[:, :3]).apply(places - self.middles[group])
        grown = arms * np.exp(every[:, 6:].sum(axis=1, keepdims=True))
        carried: Array = self.middles[group] + every[:, 3:6] + grown
        return carried


@dataclass(frozen=True, kw_only=True, eq=False)
class SoftModes:
    """Deformations of a block that pictures determine least, the softest first, each by a sigma.

    They are independent of each other and of what else the covariance holds. After them come
    motions of the groups of stations that nothing links to the first: turns about the axes of the
    model (radians), shifts and, where it is free, the logarithm of the scale. Pictures know nothing
    of these.
    """

    stations: Array
    """(F, 6, K) turns and motions of the stations, in the model's axes."""
    points: Array | NDArray[np.float32]
    """(P, 3, K) motions of the points; in single precision, as there are many."""
    calibration: Array
    """(G, K) changes of the parameters of the rig; G is 0 where it is held."""
    joints: int = 0
    """How many of the K are motions of groups."""
    groups: Groups | None = None
    """The groups, where there are several."""

    @property
    def known(self) -> Array:
        """(K,) 1 of modes with a variance by pictures, 0 of motions of groups, which have none."""
        count = self.stations.shape[2]
        return np.repeat([1.0, 0.0], [count - self.joints, self.joints])

    def of_points(self, rows: Indices) -> Self:
        """The same of some of the points, (P',), in that order."""
        groups = self.groups and replace(self.groups, point=self.groups.point[rows])
        return replace(self, points=self.points[rows], groups=groups)

    def move(
        self, sizes: Array, centres: Array, points: Array, rows: Indices | slice
    ) -> tuple[Rotation, Array, Array]:
        """Turns (F,) of the stations, and where these and the points are, with modes of a size.

        Groups stay as they are in themselves, however far they turn.

        Args:
            sizes: (K,).
            centres: (F, 3) of the stations before.
            points: (N, 3) of some points before.
            rows: which these are.
        """
        soft = sizes * self.known
        step = self.stations @ soft
        turns, centres = Rotation.from_rotvec(step[:, :3]), centres + step[:, 3:]
        points = points + np.einsum("nik,k->ni", self.points[rows], soft)
        if self.groups is None:
            return turns, centres, points
        motions = sizes[-self.joints :].reshape(len(self.groups.middles) - 1, -1)
        every = np.concatenate([np.zeros((1, 3)), motions[:, :3]])[self.groups.station]
        return (
            Rotation.from_rotvec(every) * turns,
            self.groups.carry(motions, centres, self.groups.station),
            self.groups.carry(motions, points, self.groups.point[rows]),
        )


def no_modes(stations: int, points: int) -> SoftModes:
    """Those of a stiff model."""
    return SoftModes(
        stations=np.zeros((stations, POSE, 0)),
        points=np.zeros((points, 3, 0), np.float32),
        calibration=np.zeros((0, 0)),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Motions:
    """How a block moves with the parameters of its rig, and how uncertain those are."""

    stations: Array
    """(F, 6, G) turns and motions of the stations by the parameters, in the model's axes."""
    places: Array
    """(P, 3) points at which the motion is known: enough of them, not all."""
    points: Array
    """(P, 3, G) motions of those points by the parameters."""
    covariance: Array
    """(G, G) covariance of the parameters."""
    group: Indices | None = None
    """(P,) of the `places`; None where all are of one."""

    def of_stations(self) -> Array:
        """Covariances (F, 6, 6) of the stations."""
        return spread(self.stations, self.covariance)

    def of_points(self, points: Array, group: Indices | None = None) -> Array:
        """Covariances (N, 3, 3) of (N, 3) points: those of the nearest where it is known."""
        given, which = np.unique(self.nearest(points, group), return_inverse=True)
        found: Array = spread(self.points[given], self.covariance)[which]
        return found

    def nearest(self, points: Array, group: Indices | None = None) -> Indices:
        """(N,) which of `places` are nearest to (N, 3) points, of groups (N,) where there are some.

        A group without a place takes those of the others.
        """
        if group is None or self.group is None:
            found: Indices = np.asarray(KDTree(self.places).query(points)[1])
            return found
        found = np.empty(len(points), np.int64)
        for number in np.unique(group):
            own = np.flatnonzero(self.group == number)
            own = own if len(own) else np.arange(len(self.places))
            mine = group == number
            found[mine] = own[KDTree(self.places[own]).query(points[mine])[1]]
        return found

    def without(self, gauge: Gauge) -> "Motions":
        """The same minus what motions of whole groups do, which do not change their shape."""
        whole = gauge.motion_in(self.stations)
        return replace(
            self,
            stations=self.stations - gauge.motions @ whole,
            points=self.points - gauge.of_points(self.places, self.group) @ whole,
        )


def soft_modes(
    equations: PointEquations,
    gauge: Gauge,
    calibration: Motions | None,
    points: Array,
    group: Indices,
) -> SoftModes:
    """The leading eigenvectors of the covariance of the shape, then motions of groups.

    Turns count as what they move at the usual distance, like the gauge's. A mode of the stations
    takes with it what it makes likely of the points and of the rig.

    Args:
        equations: of the stations, with nothing shared.
        gauge: motions of whole groups, which are no change of their shape.
        calibration: what errors of the rig do; None without.
        points: (P, 3) in the model.
        group: (P,) of them.
    """
    weigh = np.sqrt(gauge.weights)
    stations, width = equations.free.shape

    def respond(weighed: Array) -> tuple[Array, Array, Array]:
        """Covariance times (F, 6): of stations in a fixed rig, in all, and of the rig."""
        kick = gauge.shape_weights(weigh * weighed)
        own = equations.covariance_times(kick[..., None])[..., 0]
        if calibration is None:
            return own, own, np.zeros(0)
        rig = calibration.covariance @ np.tensordot(
            calibration.stations, kick, axes=([0, 1], [0, 1])
        )
        return own, own + calibration.stations @ rig, rig

    def product(flat: Array) -> Array:
        step = respond(flat.reshape(stations, width))[1]
        shape: Array = weigh * (step - gauge.motions @ gauge.motion_in(step))
        return shape.ravel()

    size = stations * width
    count = min(_MODES, size - gauge.motions.shape[2] - 1)
    operator: Any = LinearOperator((size, size), matvec=product, dtype=np.float64)
    start = np.random.default_rng(0).normal(size=size)  # any will do; the same modes each time
    values, vectors = eigsh(operator, k=count, which="LA", v0=start, tol=_MODES_TOLERANCE)
    kept = np.flatnonzero(values > _MIN_MODE * values.max())[::-1]
    owns, shape, rigs, wholes = [], [], [], []
    for k in kept.tolist():
        own, step, rig = respond(vectors[:, k].reshape(stations, width))
        whole, sigma = gauge.motion_in(step), np.sqrt(values[k])
        owns.append(own / sigma)
        wholes.append(whole / sigma)
        shape.append((step - gauge.motions @ whole) / sigma)
        rigs.append(rig / sigma)
    soft = SoftModes(
        stations=np.stack(shape, axis=-1),
        points=_of_points(
            equations, gauge, calibration, points, group,
            (np.stack(owns, axis=-1), np.stack(rigs, axis=-1), np.stack(wholes, axis=-1)),
        ),
        calibration=np.stack(rigs, axis=-1),
    )  # fmt: skip
    joints = gauge.motions.shape[2] - gauge.each
    if not joints:
        return soft
    return SoftModes(
        stations=np.concatenate([soft.stations, gauge.motions[..., -joints:]], axis=2),
        points=np.concatenate(
            [soft.points, gauge.of_points(points, group)[..., -joints:].astype(np.float32)], axis=2
        ),
        calibration=np.pad(soft.calibration, ((0, 0), (0, joints))),
        joints=joints,
        groups=Groups(station=gauge.group, point=group, middles=gauge.middles),
    )


def _of_points(
    equations: PointEquations,
    gauge: Gauge,
    calibration: Motions | None,
    points: Array,
    group: Indices,
    by: tuple[Array, Array, Array],
) -> NDArray[np.float32]:
    """Motions (P, 3, K) of points by modes.

    Args:
        equations: as of `soft_modes`, and so are the gauge, the calibration, points and groups.
        gauge: motions of whole groups.
        calibration: what errors of the rig do.
        points: (P, 3).
        group: (P,).
        by: of each mode what stations do in a fixed rig (F, 6, K), what the rig does (G, K), and
            the motions of whole groups (N, K) in both, which do not count.
    """
    stations, rig, whole = by
    found = np.empty((*points.shape, whole.shape[1]), np.float32)
    nearest = None if calibration is None else calibration.nearest(points, group)
    end = 0
    for place in equations.follow_poses(stations):
        rows = slice(end, end + len(place))
        end = rows.stop
        if calibration is not None and nearest is not None:
            place = place + calibration.points[nearest[rows]] @ rig
        found[rows] = place - gauge.of_points(points[rows], group[rows]) @ whole
    return found


def spread(motions: Array | NDArray[np.float32], covariance: Array) -> Array:
    """Covariances (N, k, k) of what moves by (N, k, G)."""
    found = np.empty((len(motions), motions.shape[1], motions.shape[1]))
    for first in range(0, len(motions), _ROWS):
        some = motions[first : first + _ROWS]
        found[first : first + _ROWS] = some @ covariance @ some.swapaxes(1, 2)
    return found
