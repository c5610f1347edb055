"""How well a model's stations and points are known: `sparse/covariance.npz`.

The covariance is that of the last adjustment: the inverse of its weighted normal equations, scaled
by the variance of the keypoints that its residuals show (see `reconstruct.mapping.robust`), and
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
from scipy.sparse.linalg import LinearOperator, eigsh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from alice_survey.base.block_solver import product_of
from alice_survey.base.contents import read_arrays, taken_from
from alice_survey.base.errors import ReconstructionError
from alice_survey.base.frames import Array
from alice_survey.base.manifest import ImageRecord
from reconstruct.adjustment.normal_equations import (
    POSE,
    Gauge,
    LinearObservations,
    PointEquations,
    reduce_points,
)
from reconstruct.mapping.arrays import (
    LEAST_POINTS,
    Indices,
    Observed,
    frames_of,
    linked_groups,
    observed,
    rig_poses,
)
from reconstruct.mapping.mapper import Mapped
from reconstruct.mapping.robust import cauchy_weights, sigma_of, variance_of

_MODES = 32
"""Soft modes at most: of a block of lines the tenth is known a hundred times as well as the first.
"""
_MODES_TOLERANCE = 1e-4
_LEAST_MODE = 1e-13
"""Variance of a mode over that of the softest, above rounding: where two parts of a model hardly
hang together, one mode is kilometres large and others are millimetres."""


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
    modes: "SoftModes"
    """What of these errors is soft."""

    def knowing(self, left: Array) -> Self:
        """The same where measurements leave the modes the covariance (K, K)."""
        modes = self.modes
        gain = np.diag(modes.known) - left
        return replace(
            self,
            frame_cov=self.frame_cov - _spread(modes.stations, gain),
            point_cov=self.point_cov - _spread(modes.points, gain),
        )

    def moved(self, scale: float, rotation: Rotation) -> Self:
        """The same in the world, `scale` and `rotation` being those of `world_from_model`.

        Its modes are no longer to be found: they are by groups in the model.
        """
        turn = rotation.as_matrix()
        both = np.kron(np.eye(2), turn)
        both[3:] *= scale
        places, noise = (
            scale**2 * turn @ part @ turn.T for part in (self.point_cov, self.point_noise)
        )
        return replace(
            self, frame_cov=both @ self.frame_cov @ both.T, point_cov=places, point_noise=noise,
            modes=replace(
                self.modes, stations=both @ self.modes.stations,
                points=scale * turn @ self.modes.points, groups=None,
            ),
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Groups:
    """Groups of stations that no point links; the first is the largest."""

    station: Indices
    """(F,) the group of each station."""
    point: Indices
    """(P,) that of each point."""
    middles: Array
    """(N, 3) about which groups turn and grow."""

    def carried(self, motions: Array, places: Array, group: Indices) -> Array:
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

    def moved(
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
        points = points + self.points[rows] @ soft
        if self.groups is None:
            return turns, centres, points
        motions = sizes[-self.joints :].reshape(len(self.groups.middles) - 1, -1)
        every = np.concatenate([np.zeros((1, 3)), motions[:, :3]])[self.groups.station]
        return (
            Rotation.from_rotvec(every) * turns,
            self.groups.carried(motions, centres, self.groups.station),
            self.groups.carried(motions, points, self.groups.point[rows]),
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
        return _spread(self.stations, self.covariance)

    def of_points(self, points: Array, group: Indices | None = None) -> Array:
        """Covariances (N, 3, 3) of (N, 3) points: those of the nearest where it is known."""
        given, which = np.unique(self.nearest(points, group), return_inverse=True)
        found: Array = _spread(self.points[given], self.covariance)[which]
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


def estimate(
    mapped: Mapped,
    records: Sequence[ImageRecord],
    calibration: Motions | None = None,
    *,
    held: bool = False,
) -> Uncertainty:
    """Covariances of an adjusted model of ideal pinholes.

    Args:
        mapped: adjusted; picture i of `records` has the id i + 1.
        records: pictures.
        calibration: what errors of the rig do; None where they are unknown.
        held: whether the rig stays as it is, so that no mode may move it.

    Raises:
        ReconstructionError: the model is too small to determine its covariance.
    """
    model = mapped.model
    seen = observed(model)
    frames = frames_of(model)
    linear, order = pinhole_observations(model, seen, frames)
    scale_free = not np.isfinite(mapped.baseline)
    spare = 2 * len(order) - 3 * len(seen.point_ids) - POSE * len(frames) + 6 + int(scale_free)
    if spare < 1 or len(frames) < 2:
        raise ReconstructionError(
            f"{len(order)} observations of {len(seen.point_ids)} points from {len(frames)} "
            "stations do not determine how well they are known"
        )
    left = spare / (2 * len(order))
    sigma = sigma_of(linear.miss, linear.seen_by, len(frames))
    weights = cauchy_weights(linear.miss, sigma)
    variance = variance_of(linear.miss, weights, left)
    centres = rig_poses(model, frames).inv().translation
    shape = shape_of_block(
        linear.weighted(weights / variance), centres, seen.points, calibration,
        scale_free=scale_free, held=held,
    )  # fmt: skip
    first = _first_pictures(model, seen, frames)
    return Uncertainty(
        frames=frames,
        stations=np.array([records[n - 1].station for n in first], dtype=np.int64),
        images=tuple(records[n - 1].image for n in first),
        frame_cov=shape.stations,
        point_ids=seen.point_ids,
        point_cov=shape.points,
        point_noise=shape.noise,
        sigma_px=float(np.sqrt(variance / weights.mean())),
        modes=shape.modes,
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
    linear: LinearObservations,
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
        centres: (F, 3) of the stations.
        points: (P, 3).
        calibration: what errors of the rig do; None where they are unknown.
        scale_free: whether nothing fixes the scale.
        held: whether the rig stays as it is, so that no mode may move it.
    """
    count = len(centres)
    group = linked_groups(linear.station, linear.point, count)
    group_of_point = np.maximum.reduceat(group[linear.station], linear.starts[:-1])
    gauge = Gauge(centres, float(np.median(np.linalg.norm(linear.arm, axis=1))), scale_free, group)
    loose = np.bincount(linear.station, minlength=count) < LEAST_POINTS
    equations = replace(reduce_points(linear, count), free=~(gauge.held | loose[:, None]))
    blocks = gauge.shape_blocks(equations)
    blocks[loose[equations.rows] | loose[equations.columns]] = np.nan
    of_points = equations.point_covariances(blocks)
    of_stations = blocks[equations.own]
    moving = None
    if calibration is not None:
        of_place = group_of_point[KDTree(points).query(calibration.places)[1]]
        calibration = replace(calibration, group=of_place)
        shape = calibration.without(gauge)
        of_stations = of_stations + shape.of_stations()
        of_points += shape.of_points(points, group_of_point)
        moving = None if held else calibration
    return BlockShape(
        stations=of_stations,
        points=of_points,
        noise=equations.point_inverse,
        gauge=gauge,
        modes=soft_modes(equations, gauge, moving, points, group_of_point),
        equations=equations,
        calibration=calibration,
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

    def moved(weighed: Array) -> tuple[Array, Array, Array]:
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
        step = moved(flat.reshape(stations, width))[1]
        shape: Array = weigh * (step - gauge.motions @ gauge.motion_in(step))
        return shape.ravel()

    size = stations * width
    count = min(_MODES, size - gauge.motions.shape[2] - 1)
    operator: Any = LinearOperator((size, size), matvec=product, dtype=np.float64)
    start = np.random.default_rng(0).normal(size=size)  # any will do; the same modes each time
    values, vectors = eigsh(operator, k=count, which="LA", v0=start, tol=_MODES_TOLERANCE)
    kept = np.flatnonzero(values > _LEAST_MODE * values.max())[::-1]
    shape, rigs, rigid = [], [], gauge.of_points(points, group)
    places = np.empty((*points.shape, len(kept)), np.float32)
    nearest = None if calibration is None else calibration.nearest(points, group)
    for n, k in enumerate(kept.tolist()):
        own, step, rig = moved(vectors[:, k].reshape(stations, width))
        place = equations.follow(own, np.zeros(1))
        if calibration is not None:
            place = place + calibration.points[nearest] @ rig
        whole = gauge.motion_in(step)
        size_of = np.sqrt(values[k])
        shape.append((step - gauge.motions @ whole) / size_of)
        places[..., n] = (place - rigid @ whole) / size_of
        rigs.append(rig / size_of)
    soft = SoftModes(
        stations=np.stack(shape, axis=-1),
        points=places,
        calibration=np.stack(rigs, axis=-1),
    )
    joints = gauge.motions.shape[2] - gauge.each
    if not joints:
        return soft
    return SoftModes(
        stations=np.concatenate([soft.stations, gauge.motions[..., -joints:]], axis=2),
        points=np.concatenate([places, rigid[..., -joints:].astype(np.float32)], axis=2),
        calibration=np.pad(soft.calibration, ((0, 0), (0, joints))),
        joints=joints,
        groups=Groups(station=gauge.group, point=group, middles=gauge.middles),
    )


def write_uncertainty(path: Path, found: Uncertainty) -> None:
    """Write `covariance.npz`: fields of `Uncertainty` but the modes; points as float32."""
    np.savez(
        path,
        frames=found.frames,
        stations=found.stations,
        images=np.array(found.images),
        cov=found.frame_cov,
        point_ids=found.point_ids,
        point_cov=found.point_cov.astype(np.float32),
        point_noise=found.point_noise.astype(np.float32),
        sigma_px=np.array(found.sigma_px),
    )


def read_uncertainty(path: Path) -> Uncertainty:
    """Read `covariance.npz`; its modes have been found and are no longer there.

    Raises:
        WorkspaceError: it is missing, or not as it was written.
    """
    data = read_arrays(
        path, "frames", "stations", "images", "cov", "point_ids", "point_cov", "point_noise",
        "sigma_px",
    )  # fmt: skip
    with taken_from(path):
        return Uncertainty(
            frames=data["frames"].astype(np.int64),
            stations=data["stations"].astype(np.int64),
            images=tuple(str(name) for name in data["images"]),
            frame_cov=data["cov"].astype(np.float64),
            point_ids=data["point_ids"].astype(np.int64),
            point_cov=data["point_cov"].astype(np.float64),
            point_noise=data["point_noise"].astype(np.float64),
            sigma_px=float(data["sigma_px"]),
            modes=no_modes(len(data["frames"]), len(data["point_ids"])),
        )


def pinhole_observations(
    model: pycolmap.Reconstruction, seen: Observed, frames: Indices
) -> tuple[LinearObservations, Indices]:
    """The observations of a model of pinholes, linearised.

    Returns:
        Observations sorted by point, and which of `seen` they are.
    """
    points, local, pixels = seen.points, seen.in_cameras, seen.pixels
    order = np.argsort(seen.point, kind="stable")
    station, by_point = np.empty(len(order), np.int64), np.empty((len(order), 2, 3))
    rest = np.empty((len(order), 2, 1))
    centres = rig_poses(model, frames).inv().translation
    for n, number in enumerate(seen.pictures.tolist()):
        image, rows = model.images[number], seen.of(n)
        fx, fy, cx, cy = image.camera.params
        x, y, z = local[rows].T
        zero = np.zeros_like(z)
        slopes = np.stack([fx / z, zero, -fx * x / z**2, zero, fy / z, -fy * y / z**2], axis=-1)
        turn = image.cam_from_world().matrix()[:, :3]
        by_point[rows] = slopes.reshape(-1, 2, 3) @ turn
        rest[rows, :, 0] = np.column_stack([fx * x / z + cx, fy * y / z + cy]) - pixels[rows]
        station[rows] = np.searchsorted(frames, image.frame_id)
    counts = np.bincount(seen.point, minlength=len(points))
    linear = LinearObservations(
        starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        station=station[order],
        by_point=by_point[order],
        arm=(points[seen.point] - centres[station])[order],
        rest=rest[order],
    )
    return linear, order.astype(np.int64)


def _first_pictures(model: pycolmap.Reconstruction, seen: Observed, frames: Indices) -> list[int]:
    """The picture of the reference camera of every frame, else its first."""
    chosen: dict[int, tuple[bool, int]] = {}
    for number in seen.pictures.tolist():
        image = model.images[number]
        rank = (not image.is_ref_in_frame(), number)
        chosen[image.frame_id] = min(rank, chosen.get(image.frame_id, rank))
    return [chosen[int(f)][1] for f in frames]


def _spread(motions: Array | NDArray[np.float32], covariance: Array) -> Array:
    """Covariances (N, k, k) of what moves by (N, k, G)."""
    spread: Array = motions @ covariance @ motions.swapaxes(1, 2)
    return spread
