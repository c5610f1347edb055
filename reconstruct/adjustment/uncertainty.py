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
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
import pycolmap
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
from reconstruct.adjustment.soft_modes import Motions, SoftModes, no_modes, soft_modes, spread
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
            frame_cov=self.frame_cov - spread(modes.stations, gain),
            point_cov=self.point_cov - spread(modes.points, gain),
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
    linear = linear.weighted(weights / variance)
    shape = shape_of_block(
        linear, centres, seen.points, calibration,
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
    place = np.argsort(order)
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
        to = place[rows]
        by_point[to] = slopes.reshape(-1, 2, 3) @ turn
        rest[to, :, 0] = np.column_stack([fx * x / z + cx, fy * y / z + cy]) - pixels[rows]
        station[to] = np.searchsorted(frames, image.frame_id)
    counts = np.bincount(seen.point, minlength=len(points))
    linear = LinearObservations(
        starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        station=station,
        by_point=by_point,
        arm=points[seen.point[order]] - centres[station],
        rest=rest,
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
