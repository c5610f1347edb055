"""How well a model's stations and points are known: `mapping/covariance.npz`.

The covariance is that of the last adjustment: the inverse of its weighted normal equations, scaled
by the variance of the keypoints that its residuals show (see `reconstruct.mapping.robust`), and
what errors of the calibration add to it. A model of pictures has no place of its own, so that what
is stated is its shape: the covariance of what is left when all stations together are laid onto the
truth by a rigid motion (and by a scale, where nothing fixes that) with the least squares error (the
inner constraints of a free network; Baarda's S-transformation, 1973). Where the whole lies in the
world is for the georeference to say.

An adjustment that holds rig and ports assumes that they are exact. They are not: a lens that is off
by its sigma bends the whole block a little, and every picture more does the same again. To first
order stations and points move with the rig's parameters as the adjustment's normal equations say
(implicit function theorem), and the covariance of the calibration moves with them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial import KDTree

from alice_survey.base.contents import read_arrays, taken_from
from alice_survey.base.errors import ReconstructionError, warn
from alice_survey.base.frames import Array
from alice_survey.base.manifest import ImageRecord
from alice_survey.base.run import progress
from camera_calib.rig import Rig
from reconstruct.adjustment.exact_observations import (
    calibrated_parameters,
    choose_pixels,
    exact_observations,
    start_state,
)
from reconstruct.adjustment.normal_equations import (
    LEAST_POINTS,
    POSE,
    TURN_INFORMATION,
    Gauge,
    LinearObservations,
    reduce_points,
)
from reconstruct.mapping.arrays import (
    Indices,
    Observed,
    first_pictures,
    frames_of,
    observed,
    rig_poses,
)
from reconstruct.mapping.database import Observations
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


@dataclass(frozen=True, kw_only=True, eq=False)
class CalibrationPart:
    """How a block moves with the parameters of its rig, and how uncertain those are."""

    frames: Indices
    """(F,) ids of COLMAP's frames, ascending."""
    stations: Array
    """(F, 6, G) turns and motions of the stations by the parameters, in the model's axes."""
    places: Array
    """(P, 3) points at which the motion is known: enough of them, not all."""
    points: Array
    """(P, 3, G) motions of those points by the parameters."""
    covariance: Array
    """(G, G) covariance of the parameters."""

    def of_stations(self) -> Array:
        """Covariances (F, 6, 6) of the stations."""
        return _spread(self.stations, self.covariance)

    def of_points(self, points: Array) -> Array:
        """Covariances (N, 3, 3) of (N, 3) points: those of the nearest where it is known."""
        nearest = np.asarray(KDTree(self.places).query(points)[1])
        given, which = np.unique(nearest, return_inverse=True)
        found: Array = _spread(self.points[given], self.covariance)[which]
        return found

    def without(self, gauge: Gauge) -> "CalibrationPart":
        """The same minus what a motion of the whole block does, which does not change its shape."""
        whole = gauge.motion_in(self.stations)
        return replace(
            self,
            stations=self.stations - gauge.motions @ whole,
            points=self.points - gauge.of_points(self.places) @ whole,
        )


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
    linear = linear.weighted(weights / variance)
    centres = rig_poses(model, frames).inv().translation
    gauge = Gauge(centres, float(np.median(np.linalg.norm(linear.arm, axis=1))), scale_free)
    given = navigation_information(model, position_sigmas)
    loose = np.bincount(linear.station, minlength=len(frames)) < LEAST_POINTS
    equations = replace(reduce_points(linear, len(frames)), free=~(gauge.held | loose[:, None]))
    if given is not None:
        equations = gauge.placed(equations, given * ~loose[:, None])
    blocks = gauge.shape_blocks(equations)
    blocks[loose[equations.rows] | loose[equations.columns]] = np.nan
    points = equations.point_covariances(blocks)
    frame_cov = blocks[equations.own]
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
        point_noise=equations.point_inverse,
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
    for frame, number in first_pictures(model, sigmas).items():
        row = int(np.searchsorted(frames, frame))
        given[row] = [*[TURN_INFORMATION] * 3, *(1.0 / sigmas[number - 1] ** 2)]
    return given if given.any() else None


def _first_pictures(model: pycolmap.Reconstruction, seen: Observed, frames: Indices) -> list[int]:
    """The picture of the reference camera of every frame, else its first."""
    chosen: dict[int, tuple[bool, int]] = {}
    for number in seen.pictures.tolist():
        image = model.images[number]
        rank = (not image.is_ref_in_frame(), number)
        chosen[image.frame_id] = min(rank, chosen.get(image.frame_id, rank))
    return [chosen[int(f)][1] for f in frames]


def _spread(motions: Array, covariance: Array) -> Array:
    """Covariances (N, k, k) of what moves by (N, k, G)."""
    spread: Array = motions @ covariance @ motions.swapaxes(1, 2)
    return spread


def calibration_part(
    mapped: Mapped, seen: Observations, rig: Rig, given: Array | None = None
) -> CalibrationPart | None:
    """How a finished model depends on its calibration.

    Args:
        mapped: exact model on the rig; picture i of `seen` has the id i + 1.
        seen: keypoints as warped by the model's lenses.
        rig: with the covariance of its calibration.
        given: (F, 6) information of the stations' given poses, as in the adjustment; None without.

    Returns:
        None where the rig states no covariance: then it is unknown.
    """
    names = list(seen.cameras)
    fields = calibrated_parameters(rig, names)
    if not fields or rig.covariance is None:
        return None
    frames = frames_of(mapped.model)
    pixels, ids = choose_pixels(mapped, seen, names, frames)
    state = start_state(mapped, rig, names, frames, ids)
    linear = exact_observations(state, pixels, fields, lever=False)
    sigma = sigma_of(linear.miss, linear.seen_by, len(frames))
    linear = linear.weighted(cauchy_weights(linear.miss, sigma) / sigma**2)
    equations = reduce_points(linear, len(frames))
    equations.free[np.bincount(linear.station, minlength=len(frames)) < LEAST_POINTS] = False
    if given is None:
        equations.free[0] = False
    else:
        equations = equations.knowing(given[:, :, None] * np.eye(POSE))
    stations = equations.response
    points = [
        equations.follow(np.ascontiguousarray(stations[:, :, g]), unit)
        for g, unit in enumerate(np.eye(len(fields), len(fields) + 1))
    ]
    return CalibrationPart(
        frames=frames,
        stations=stations,
        places=state.points,
        points=np.stack(points, axis=-1),
        covariance=rig.covariance.marginal(fields).matrix,
    )
