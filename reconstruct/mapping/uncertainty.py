"""How well a model's stations and points are known: `mapping/covariance.npz`.

The covariance is that of the last adjustment: the inverse of its weighted normal equations, scaled
by the variance of the keypoints that its residuals show (see `reconstruct.mapping.robust`), and
what errors of the calibration add to it. A model of pictures has no place of its own, so that what
is stated is its shape: the covariance of what is left when all stations together are laid onto the
truth by a rigid motion (and by a scale, where nothing fixes that) with the least squares error (the
inner constraints of a free network; Baarda's S-transformation, 1973). Where the whole lies in the
world is for the georeference to say.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, diags_array
from scipy.spatial.transform import Rotation

from alice_survey.base.contents import read_arrays, taken_from
from alice_survey.base.errors import ReconstructionError, warn
from alice_survey.base.frames import Array
from alice_survey.base.manifest import ImageRecord
from alice_survey.base.run import progress
from camera_calib.rig import Rig
from reconstruct.mapping.arrays import Indices, Observed, frames_of, observed
from reconstruct.mapping.calibration_part import CalibrationPart, calibration_part
from reconstruct.mapping.database import Observations
from reconstruct.mapping.mapper import Mapped
from reconstruct.mapping.normal_equations import (
    LEAST_POINTS,
    POSE,
    Gauge,
    ReducedSystem,
    Sights,
    point_covariances,
    reduce_points,
    solver_of,
)
from reconstruct.mapping.robust import cauchy_weights, sigma_of, variance_of

_CHUNK = 32
"""Stations whose columns of the inverse are in memory at a time."""
_TURN_INFORMATION = 1.0
"""1/rad^2 of a station whose position is given: a line does not determine its own roll."""


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


def estimate(
    mapped: Mapped,
    records: Sequence[ImageRecord],
    position_sigmas: Array | None,
    calibration: CalibrationPart | None = None,
) -> Uncertainty:
    """Covariances of an adjusted model of ideal pinholes with held rig and lenses.

    Args:
        mapped: adjusted; picture i of `records` has the id i + 1.
        records: pictures.
        position_sigmas: (N, 3) of the pictures' given positions along the model's axes, NaN where
            none took part in the adjustment; None for an adjustment without.
        calibration: what errors of the rig do; None where they are unknown.

    Raises:
        ReconstructionError: the model is too small to determine its covariance.
    """
    model = mapped.model
    seen = observed(model)
    frames = frames_of(model)
    sights, order = sights_of(model, seen, frames)
    scale_free = not np.isfinite(mapped.baseline)
    spare = 2 * len(order) - 3 * len(seen.point_ids) - POSE * len(frames) + 6 + int(scale_free)
    if spare < 1 or len(frames) < 2:
        raise ReconstructionError(
            f"{len(order)} observations of {len(seen.point_ids)} points from {len(frames)} "
            "stations do not determine how well they are known"
        )
    left = spare / (2 * len(order))
    sigma = sigma_of(sights.miss, sights.seen_by, len(frames))
    weights = cauchy_weights(sights.miss, sigma)
    variance = variance_of(sights.miss, weights, left)
    sights = sights.weighted(weights)
    reduced = reduce_points(sights, len(frames))
    centres = _centres(model, frames)
    given = navigation_information(model, position_sigmas)
    counts = np.bincount(sights.station, minlength=len(frames))
    loose = counts < LEAST_POINTS
    gauge = Gauge(centres, float(np.median(np.linalg.norm(sights.arm, axis=1))), scale_free)
    blocks = _inverse_blocks(reduced, variance, given, gauge, loose)
    rows = np.repeat(np.arange(len(frames)), np.diff(reduced.pointers))
    own = np.flatnonzero(rows == reduced.columns)
    points = point_covariances(
        sights.starts, sights.station, sights.by_point, sights.arm,
        reduced.point_inverse, reduced.pointers, reduced.columns, blocks,
    )  # fmt: skip
    noise = variance * reduced.point_inverse
    points += noise - reduced.point_inverse
    frame_cov = blocks[own]
    if calibration is not None:
        shape = calibration.without(gauge)
        frame_cov = frame_cov + shape.of_stations()
        points += shape.of_points(seen.points)
    first = _first_pictures(model, seen, frames)
    return Uncertainty(
        frames=frames,
        stations=np.array([records[n - 1].station for n in first], dtype=np.int64),
        images=tuple(records[n - 1].image for n in first),
        frame_cov=frame_cov,
        point_ids=seen.point_ids,
        point_cov=points,
        point_noise=noise,
        sigma_px=float(np.sqrt(variance / weights.mean())),
    )


@progress.step("covariance of the model")
def save_uncertainty(
    folder: Path,
    mapped: Mapped,
    seen: Observations,
    rig: Rig | None,
    position_sigmas: Array | None = None,
) -> None:
    """Write `covariance.npz` of a model (see `estimate`), with a warning where it cannot be."""
    try:
        calibration = None
        if rig is not None:
            given = navigation_information(mapped.model, position_sigmas)
            calibration = calibration_part(mapped, seen, rig, given)
        found = estimate(mapped, seen.images, position_sigmas, calibration)
    except ReconstructionError as error:
        warn(f"no covariance: {error}")
        return
    write_uncertainty(folder / "covariance.npz", found)


def write_uncertainty(path: Path, found: Uncertainty) -> None:
    """Write `covariance.npz`: fields of `Uncertainty`; points as float32."""
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
    """Read `covariance.npz`.

    Raises:
        WorkspaceError: it is missing, or not as it was written.
    """
    data = read_arrays(
        path, "frames", "stations", "images", "cov", "point_ids", "point_cov", "point_noise",
        "sigma_px",
    )  # fmt: skip
    with taken_from(path):
        frames, points = len(data["frames"]), len(data["point_ids"])
        shapes = [data[name].shape for name in ("stations", "cov", "point_cov", "point_noise")]
        if shapes != [(frames,), (frames, 6, 6), (points, 3, 3), (points, 3, 3)]:
            raise ValueError(f"{frames} frames and {points} points with the shapes {shapes}")
        return Uncertainty(
            frames=data["frames"].astype(np.int64),
            stations=data["stations"].astype(np.int64),
            images=tuple(str(name) for name in data["images"]),
            frame_cov=data["cov"].astype(np.float64),
            point_ids=data["point_ids"].astype(np.int64),
            point_cov=data["point_cov"].astype(np.float64),
            point_noise=data["point_noise"].astype(np.float64),
            sigma_px=float(data["sigma_px"]),
        )


def sights_of(
    model: pycolmap.Reconstruction, seen: Observed, frames: Indices
) -> tuple[Sights, Indices]:
    """The observations of a model of pinholes, linearised.

    Returns:
        Observations sorted by point, and which of `seen` they are.
    """
    points, local, pixels = seen.points, seen.in_cameras, seen.pixels
    order = np.argsort(seen.point, kind="stable")
    station, by_point = np.empty(len(order), np.int64), np.empty((len(order), 2, 3))
    miss = np.empty((len(order), 2))
    centres = _centres(model, frames)
    for n, number in enumerate(seen.pictures.tolist()):
        image, rows = model.images[number], seen.of(n)
        fx, fy, cx, cy = image.camera.params
        x, y, z = local[rows].T
        zero = np.zeros_like(z)
        slopes = np.stack([fx / z, zero, -fx * x / z**2, zero, fy / z, -fy * y / z**2], axis=-1)
        turn = image.cam_from_world().matrix()[:, :3]
        by_point[rows] = slopes.reshape(-1, 2, 3) @ turn
        miss[rows] = np.column_stack([fx * x / z + cx, fy * y / z + cy]) - pixels[rows]
        station[rows] = np.searchsorted(frames, image.frame_id)
    counts = np.bincount(seen.point, minlength=len(points))
    sights = Sights(
        starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        station=station[order],
        by_point=by_point[order],
        arm=(points[seen.point] - centres[station])[order],
        by_shared=np.zeros((len(order), 2, 0)),
        miss=miss[order],
    )
    return sights, order.astype(np.int64)


def _inverse_blocks(
    reduced: ReducedSystem,
    variance: float,
    given: Array | None,
    gauge: Gauge,
    loose: NDArray[np.bool_],
) -> Array:
    """Covariances (B, 6, 6) between stations that see a point in common, without the gauge."""
    matrix = csc_matrix(reduced.matrix / variance)
    size = matrix.shape[0]
    free = np.repeat(~loose, POSE)
    if given is None:
        free[gauge.held] = False
    else:
        matrix = csc_matrix(matrix + diags_array(given.ravel()))
    solve = solver_of(matrix, free)
    flat, spread = gauge.flat, gauge.spread
    weighed = gauge.weights[:, None] * flat
    along = solve(weighed)
    middle = spread @ (weighed.T @ along) @ spread
    count = size // POSE
    blocks = np.empty_like(reduced.blocks)
    motions, along = gauge.motions, along.reshape(count, POSE, -1)
    for first in range(0, count, _CHUNK):
        last = min(first + _CHUNK, count)
        right = np.zeros((size, POSE * (last - first)))
        right[POSE * first + np.arange(right.shape[1]), np.arange(right.shape[1])] = 1.0
        columns = solve(right).reshape(count, POSE, last - first, POSE)
        for s in range(first, last):
            rows = slice(int(reduced.pointers[s]), int(reduced.pointers[s + 1]))
            others = reduced.columns[rows]
            plain = columns[others, :, s - first, :].swapaxes(1, 2)
            blocks[rows] = (
                plain
                - motions[s] @ spread @ along[others].swapaxes(1, 2)
                - along[s] @ spread @ motions[others].swapaxes(1, 2)
                + motions[s] @ middle @ motions[others].swapaxes(1, 2)
            )
            blocks[rows][loose[others] | loose[s]] = np.nan
    return blocks


def navigation_information(model: pycolmap.Reconstruction, sigmas: Array | None) -> Array | None:
    """(F, 6) information of stations whose positions are given; None where there are none.

    Args:
        model: picture i of `sigmas` has the id i + 1.
        sigmas: (N, 3) of the pictures' given positions; NaN where none is given.
    """
    if sigmas is None:
        return None
    frames = frames_of(model)
    given = np.zeros((len(frames), POSE))
    for number, image in sorted(model.images.items()):
        if not image.has_pose:
            continue
        row = int(np.searchsorted(frames, image.frame_id))
        if np.isfinite(sigmas[number - 1]).all() and not given[row].any():
            given[row] = [*[_TURN_INFORMATION] * 3, *(1.0 / sigmas[number - 1] ** 2)]
    return given if given.any() else None


def _centres(model: pycolmap.Reconstruction, frames: Indices) -> Array:
    """Origins of the rigs in the world, (F, 3)."""
    poses: list[Any] = [model.frames[int(f)].rig_from_world for f in frames]
    turns = Rotation.from_quat(np.array([p.rotation.quat for p in poses]))
    return -turns.inv().apply(np.array([p.translation for p in poses]))


def _first_pictures(model: pycolmap.Reconstruction, seen: Observed, frames: Indices) -> list[int]:
    """The picture of the reference camera of every frame, else its first."""
    chosen: dict[int, tuple[bool, int]] = {}
    for number in seen.pictures.tolist():
        image = model.images[number]
        rank = (not image.is_ref_in_frame(), number)
        chosen[image.frame_id] = min(rank, chosen.get(image.frame_id, rank))
    return [chosen[int(f)][1] for f in frames]
