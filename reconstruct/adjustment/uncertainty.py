"""How well a model's stations and points are known: `sparse/covariance.npz`.

The covariance is that of the last adjustment: the inverse of its weighted normal equations, scaled
by the variance of the keypoints that its residuals show (see `reconstruct.mapping.bundle`), and
what errors of the calibration add to it. A model of pictures has no place of its own, so that what
is stated is its shape: the covariance of what is left when all stations together are moved onto the
truth by a rigid motion (and by a scale, where nothing fixes that) with the least squares error (the
inner constraints of a free network; Baarda's S-transformation, 1973). Where the whole lies in the
world is for the georeference to say. Stations that no point links make groups, and the shape is
that of each; where a group is relative to the largest is a mode of which pictures know nothing.

Rig and ports are not exact: a lens that is off by its sigma bends the whole block a little, and
every picture more does the same again. To first order stations and points move with the rig's
parameters as the adjustment's normal equations say (implicit function theorem), and the covariance
of the calibration moves with them.

Pictures leave few deformations of a block soft: its bends, its twist, its scale. These soft modes,
the leading eigenvectors of the covariance, are what measurements from outside can improve; all
others are known better from the pictures. Updating them alone is the best approximation of its rank
to the joint estimate (Spantini et al. 2015, "Optimal low-rank approximations of Bayesian linear
inverse problems").
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.sparse.linalg import LinearOperator, eigsh
from scipy.spatial import KDTree
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.block_solver import product_of
from alice_survey.core.contents import read_arrays, taken_from
from alice_survey.core.errors import ReconstructionError
from alice_survey.core.frames import Array
from alice_survey.core.manifest import ImageRecord
from camera_calib.camera import Camera
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.rig import Rig
from reconstruct.adjustment.exact_observations import (
    ALONE,
    PixelParts,
    Pixels,
    RigState,
    Workers,
    linearise_parts,
)
from reconstruct.adjustment.normal_equations import (
    POSE,
    Gauge,
    LinearParts,
    PointEquations,
    reduce_parts,
)
from reconstruct.mapping.arrays import (
    MIN_POINTS,
    Indices,
    frames_of,
    linked_groups,
    observations,
    rig_poses,
)
from reconstruct.mapping.bundle import robust_weights, sigma_of, variance_of
from reconstruct.mapping.mapper import Mapped
from reconstruct.views.model_files import as_transform

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
        return np.asarray(self.middles[group] + every[:, 3:6] + grown)


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
        return np.asarray(spread(self.points[given], self.covariance)[which])

    def nearest(self, points: Array, group: Indices | None = None) -> Indices:
        """(N,) which of `places` are nearest to (N, 3) points, of groups (N,) where there are some.

        A group without a place takes those of the others.
        """
        if group is None or self.group is None:
            return np.asarray(np.asarray(KDTree(self.places).query(points)[1]))
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
        sigma = np.sqrt(values[k])
        own, step, rig = (part / sigma for part in respond(vectors[:, k].reshape(stations, width)))
        owns.append(own)
        wholes.append(gauge.motion_in(step))
        shape.append(step - gauge.motions @ wholes[-1])
        rigs.append(rig)
    by_rig, whole = np.stack(rigs, axis=-1), np.stack(wholes, axis=-1)
    moved = np.empty((*points.shape, len(kept)), np.float32)
    nearest = None if calibration is None else calibration.nearest(points, group)
    end = 0
    for place in equations.follow_poses(np.stack(owns, axis=-1)):
        rows = slice(end, end + len(place))
        end = rows.stop
        if calibration is not None and nearest is not None:
            place = place + calibration.points[nearest[rows]] @ by_rig
        moved[rows] = place - gauge.of_points(points[rows], group[rows]) @ whole
    soft = SoftModes(stations=np.stack(shape, axis=-1), points=moved, calibration=by_rig)
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


def spread(motions: Array | NDArray[np.float32], covariance: Array) -> Array:
    """Covariances (N, k, k) of what moves by (N, k, G)."""
    found = np.empty((len(motions), motions.shape[1], motions.shape[1]))
    for first in range(0, len(motions), _ROWS):
        some = motions[first : first + _ROWS]
        found[first : first + _ROWS] = some @ covariance @ some.swapaxes(1, 2)
    return found


_MAX_PLACES = 2000
"""Places at most at which the motions that points share are kept: they are smooth."""


_SHARED = (
    "shared_places", "shared_motions", "shared_cov", "shared_rest", "shared_calibration",
)  # fmt: skip
_STORED = {
    "frames": "frames", "stations": "stations", "images": "images", "cov": "frame_cov",
    "point_ids": "point_ids", "point_cov": "point_cov", "point_noise": "point_noise",
    "sigma_px": "sigma_px",
}  # fmt: skip
"""Arrays of the file, and the fields that they hold."""


@dataclass(frozen=True, eq=False)
class SharedMotions:
    """How points move together: the soft modes of a block, then what else of its rig is unknown.

    The covariance of the poses' part of two points is the product of their motions with the
    covariance between; what it leaves of a point's own is not shared.
    """

    places: Array
    """(M, 3) points, spread over the model."""
    motions: Array | NDArray[np.float32]
    """(M, 3, K) of them, each by one sigma."""
    covariance: Array
    """(K, K) of these, in their sigmas."""
    rest: Array
    """(M, 3, 3) covariances of what poses do to the points besides."""
    calibration: Array | None = None
    """(G, G) covariance of the rig's parameters, then of shifts of keypoints; None: unknown."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Uncertainty:
    """Covariances in units of the model, in its own axes."""

    frames: Indices
    """(F,) ids of COLMAP's frames, ascending."""
    stations: Indices
    """(F,) their stations."""
    images: tuple[str, ...]
    """(F,) the picture of each frame's reference camera (of its first, where that took none)."""
    frame_cov: Array
    """(F, 6, 6): turn, radians about the model's axes (`R' = exp(turn) R` for `world_from_rig`),
    then position of the rig's origin, the centre of the reference pinhole."""
    point_ids: Indices
    """(P,) ids of COLMAP's points, ascending."""
    point_cov: Array
    """(P, 3, 3) covariances of the points."""
    point_noise: Array
    """(P, 3, 3): of it, what the noise of the point's own keypoints does; the rest are poses."""
    sigma_px: float
    """Sigma of one coordinate of a keypoint, from the residuals."""
    modes: SoftModes
    """What of these errors is soft."""
    shared: SharedMotions | None = None
    """What points share; None where a file of an earlier version does not say."""

    def knowing(self, left: Array) -> Self:
        """The same where measurements leave the modes the covariance (K, K)."""
        modes, shared = self.modes, self.shared
        gain = np.diag(modes.known) - left
        if shared is not None:
            covariance = shared.covariance.copy()
            covariance[: len(left), : len(left)] = left
            shared = replace(shared, covariance=covariance)
            if shared.calibration is not None and len(modes.calibration):
                change = modes.calibration @ gain @ modes.calibration.T
                shared = replace(shared, calibration=shared.calibration - change)
        return replace(
            self,
            frame_cov=self.frame_cov - spread(modes.stations, gain),
            point_cov=self.point_cov - spread(modes.points, gain),
            shared=shared,
        )

    def move(self, scale: float, rotation: Rotation, translation: Array) -> Self:
        """The same in the world; the arguments are those of `world_from_model`.

        Its modes are no longer to be found: they are by groups in the model.
        """
        turn = rotation.as_matrix()
        both = np.kron(np.eye(2), turn)
        both[3:] *= scale
        places, noise = (
            scale**2 * turn @ part @ turn.T for part in (self.point_cov, self.point_noise)
        )
        shared = self.shared and replace(
            self.shared,
            places=scale * rotation.apply(self.shared.places) + translation,
            motions=scale * turn @ self.shared.motions,
            rest=scale**2 * turn @ self.shared.rest @ turn.T,
        )
        return replace(
            self, frame_cov=both @ self.frame_cov @ both.T, point_cov=places, point_noise=noise,
            shared=shared,
            modes=replace(
                self.modes, stations=both @ self.modes.stations,
                points=(scale * turn).astype(np.float32) @ self.modes.points, groups=None,
            ),
        )  # fmt: skip


def estimate(
    mapped: Mapped,
    records: Sequence[ImageRecord],
    calibration: Motions | None = None,
    *,
    held: bool = False,
    workers: Workers = ALONE,
) -> Uncertainty:
    """Covariances of an adjusted model of ideal pinholes.

    Args:
        mapped: adjusted; picture i of `records` has the id i + 1.
        records: pictures.
        calibration: what errors of the rig do; None where they are unknown.
        held: whether the rig stays as it is, so that no mode may move it.
        workers: where parts of a large survey are worked on.

    Raises:
        ReconstructionError: the model is too small to determine its covariance.
    """
    frames = frames_of(mapped.model)
    pixels, state, point_ids, first = pinhole_survey(mapped.model, frames)
    scale_free = not np.isfinite(mapped.baseline)
    count = len(pixels.station)
    spare = 2 * count - 3 * pixels.points - POSE * len(frames) + 6 + int(scale_free)
    if spare < 1 or len(frames) < 2:
        raise ReconstructionError(
            f"{count} observations of {pixels.points} points from {len(frames)} "
            "stations do not determine how well they are known"
        )
    pixels, order = pixels.by_place(state.centres)
    state = replace(state, points=state.points[order])
    parts = PixelParts(pixels, len(frames), workers)
    miss = np.nan_to_num(parts.residuals(state), nan=0.0)
    sigma = sigma_of(miss, pixels.seen_by, len(frames))
    weights = robust_weights(miss, sigma)
    variance = variance_of(miss, weights, spare / (2 * count))
    linear = linearise_parts(parts, state, (), (sigma, variance))
    shape = shape_of_block(
        linear, pixels, state.centres, state.points, calibration,
        scale_free=scale_free, held=held,
    )  # fmt: skip
    back = np.argsort(order)
    return Uncertainty(
        frames=frames,
        stations=np.array([records[n - 1].station for n in first], dtype=np.int64),
        images=tuple(records[n - 1].image for n in first),
        frame_cov=shape.stations,
        point_ids=point_ids,
        point_cov=shape.points[back],
        point_noise=shape.noise[back],
        sigma_px=float(np.sqrt(variance / weights.mean())),
        modes=shape.modes.of_points(back),
        shared=shape.shared,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class BlockShape:
    """Covariances of a block's shape (see `Uncertainty`)."""

    stations: Array
    """(F, 6, 6); NaN of one that sees too little."""
    points: Array
    """(P, 3, 3)."""
    noise: Array
    """(P, 3, 3) what the noise of a point's own keypoints does."""
    modes: SoftModes
    shared: SharedMotions
    gauge: Gauge
    equations: PointEquations
    """Of the stations, with nothing shared."""
    calibration: Motions | None
    """What errors of the rig do; None where they are unknown."""

    def variance(self, weights: Array) -> float:
        """Variance of a sum over stations, (F, 6), apart from motions of whole groups."""
        weights = self.gauge.shape_weights(weights)
        found = float((weights * self.equations.covariance_times(weights[..., None])[..., 0]).sum())
        if self.calibration is not None:
            along = product_of(weights[..., None], self.calibration.stations)[0]
            found += float(along @ self.calibration.covariance @ along)
        return found


def shape_of_block(
    linear: LinearParts,
    pixels: Pixels,
    centres: Array,
    points: Array,
    calibration: Motions | None,
    *,
    scale_free: bool,
    held: bool = False,
) -> BlockShape:
    """Covariances of the shape that weighted observations and a calibration determine.

    Args:
        linear: observations in their sigmas; nothing is shared.
        pixels: the same.
        centres: (F, 3) of the stations.
        points: (P, 3).
        calibration: what errors of the rig do; None where they are unknown.
        scale_free: whether nothing fixes the scale.
        held: whether the rig stays as it is, so that no mode may move it.
    """
    count = len(centres)
    group = linked_groups(pixels.station, pixels.point, count)
    group_of_point = np.maximum.reduceat(group[pixels.station], pixels.starts[:-1])
    reach = [
        np.linalg.norm(points[part.point] - centres[part.station], axis=1)
        for part in (pixels.run(*run) for run in pixels.parts())
    ]
    gauge = Gauge(centres, float(np.median(np.concatenate(reach))), scale_free, group)
    loose = np.bincount(pixels.station, minlength=count) < MIN_POINTS
    equations = replace(reduce_parts(linear), free=~(gauge.held | loose[:, None]))
    blocks = gauge.shape_blocks(equations)
    blocks[loose[equations.rows] | loose[equations.columns]] = np.nan
    of_points = equations.point_covariances(blocks)
    of_stations = blocks[equations.own]
    moving = shape = None
    if calibration is not None:
        of_place = group_of_point[KDTree(points).query(calibration.places)[1]]
        calibration = replace(calibration, group=of_place)
        shape = calibration.without(gauge)
        of_stations = of_stations + shape.of_stations()
        of_points += shape.of_points(points, group_of_point)
        moving = None if held else calibration
    modes = soft_modes(equations, gauge, moving, points, group_of_point)
    return BlockShape(
        stations=of_stations,
        points=of_points,
        noise=equations.point_inverse,
        gauge=gauge,
        modes=modes,
        shared=_shared_motions(
            modes, shape, points, group_of_point, of_points, equations.point_inverse
        ),
        equations=equations,
        calibration=calibration,
    )


def _shared_motions(
    modes: SoftModes,
    shape: Motions | None,
    points: Array,
    group: Indices,
    covariances: Array,
    noise: Array,
) -> SharedMotions:
    """What points share: modes, and what of the rig these leave.

    Given the modes, the rig's parameters have the covariance that is left after theirs; that what
    poses do apart from modes goes along with it is left out.

    Args:
        modes: of the block.
        shape: what errors of the rig do to its shape; None where they are unknown.
        points: (P, 3).
        group: (P,) of them.
        covariances: (P, 3, 3) of them.
        noise: (P, 3, 3) of it, what their own keypoints do.
    """
    known = np.flatnonzero(np.isfinite(modes.points[..., 0]).all(axis=1))
    rows = known[_spread_rows(points[known])]
    motions, covariance = modes.points[rows], np.diag(modes.known)
    if shape is not None:
        rig = shape.covariance.copy()
        if len(modes.calibration):
            soft = modes.calibration[:, : len(modes.known) - modes.joints]
            rig -= soft @ soft.T
        variances, axes = np.linalg.eigh(rig)
        by_axis = shape.points @ (axes * np.sqrt(np.maximum(variances, 0.0)))
        rest = by_axis[shape.nearest(points[rows], group[rows])].astype(np.float32)
        motions = np.concatenate([motions, rest], axis=2)
        covariance = block_diag(covariance, np.eye(rest.shape[2]))
    return SharedMotions(
        points[rows], motions, covariance,
        covariances[rows] - noise[rows] - spread(motions, covariance),
        None if shape is None else shape.covariance,
    )  # fmt: skip


def _spread_rows(points: Array) -> Indices:
    """Rows of some of the points (P, 3), one in each cube of space."""
    if len(points) <= _MAX_PLACES:
        return np.arange(len(points))
    low, high = np.percentile(points, [2, 98], axis=0)
    side = float(np.linalg.norm(high - low)) / np.sqrt(_MAX_PLACES)
    while True:
        cubes = np.floor((points - low) / side)
        rows = np.sort(np.unique(cubes, axis=0, return_index=True)[1])
        if len(rows) <= _MAX_PLACES:
            return rows
        side *= 1.25


def write_uncertainty(path: Path, found: Uncertainty) -> None:
    """Write `covariance.npz`: fields of `Uncertainty` but the modes; much of it as float32."""
    arrays: dict[str, Any] = {
        key: np.asarray(getattr(found, name)) for key, name in _STORED.items()
    }
    if found.shared is not None:
        shared = zip(_SHARED, vars(found.shared).values(), strict=True)
        arrays |= {key: value for key, value in shared if value is not None}
    for key in arrays.keys() & {"point_cov", "point_noise", "shared_motions"}:
        arrays[key] = arrays[key].astype(np.float32)
    np.savez(path, **arrays)


def read_uncertainty(path: Path) -> Uncertainty:
    """Read `covariance.npz`; its modes have been found and are no longer there.

    Raises:
        WorkspaceError: it is missing, or not as it was written.
    """
    data = read_arrays(path, *_STORED, optional=_SHARED)
    with taken_from(path):
        for name in data.keys() - {"images"}:
            whole = name in ("frames", "stations", "point_ids")
            data[name] = data[name].astype(np.int64 if whole else np.float64)
        found: dict[str, Any] = {name: data[key] for key, name in _STORED.items()}
        found |= {"images": tuple(map(str, data["images"])), "sigma_px": float(data["sigma_px"])}
        shared = [data[name] for name in _SHARED if name in data]
        return Uncertainty(
            **found, modes=no_modes(len(data["frames"]), len(data["point_ids"])),
            shared=SharedMotions(*shared) if shared else None,  # type: ignore[arg-type]
        )  # fmt: skip


def pinhole_survey(
    model: pycolmap.Reconstruction, frames: Indices
) -> tuple[Pixels, RigState, Indices, list[int]]:
    """A model of pinholes as a survey.

    Returns:
        Its observations, its state, the ids (P,) of its points, and for every frame the picture of
        the reference camera, or else its first.
    """
    seen = observations(model)
    images = [model.images[number] for number in seen.pictures.tolist()]
    counts, order = np.diff(seen.starts), np.argsort(seen.point, kind="stable")
    numbers = sorted({image.camera_id for image in images})
    station = np.searchsorted(frames, [image.frame_id for image in images])
    camera = np.searchsorted(numbers, [image.camera_id for image in images])
    by_point = np.bincount(seen.point, minlength=len(seen.point_ids))
    pixels = Pixels(
        starts=np.concatenate([[0], np.cumsum(by_point)]).astype(np.int64),
        station=np.repeat(station, counts)[order],
        camera=np.repeat(camera, counts)[order],
        taken=seen.pixels[order],
        point=seen.point[order],
    )
    where = {
        sensor.id: as_transform(pose)
        for one in model.rigs.values()
        for sensor, pose in one.non_ref_sensors.items()
    }
    cameras = {}
    for number in numbers:
        given = model.cameras[number]
        lens = OpenCVLens(
            **dict(zip(("fx_px", "fy_px", "cx_px", "cy_px"), given.params, strict=True))
        )
        cameras[str(number)] = Camera(width_px=given.width, height_px=given.height, lens=lens)
    rig = Rig(
        cameras=cameras,
        cam_from_rig={str(n): where.get(n, RigidTransform.identity()) for n in numbers},
        body_from_rig=None,
        source="pinholes of a model",
    )
    poses = rig_poses(model, frames).inv()
    state = RigState(
        rig=rig, turns=poses.rotation.as_matrix(), centres=poses.translation, points=seen.points
    )
    first: dict[int, tuple[bool, int]] = {}
    for image in images:
        rank = (not image.is_ref_in_frame(), int(image.image_id))
        first[image.frame_id] = min(rank, first.get(image.frame_id, rank))
    return pixels, state, seen.point_ids, [first[int(f)][1] for f in frames]
