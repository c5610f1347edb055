"""How much of a block's shape the calibration leaves uncertain.

An adjustment that holds rig and ports assumes that they are exact. They are not: a lens that is off
by its sigma bends the whole block a little, and every picture more does the same again. To first
order stations and points move with the rig's parameters as the adjustment's normal equations say
(implicit function theorem), and the covariance of the calibration moves with them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csc_matrix, diags_array
from scipy.spatial import KDTree

from alice_survey.base.frames import Array
from camera_calib.rig import Rig
from reconstruct.mapping.arrays import Indices, frames_of
from reconstruct.mapping.database import Observations
from reconstruct.mapping.exact_sights import choose_pixels, exact_sights, start_state
from reconstruct.mapping.mapper import Mapped
from reconstruct.mapping.normal_equations import (
    LEAST_POINTS,
    POSE,
    Gauge,
    Sights,
    moved_points,
    reduce_points,
    solver_of,
)
from reconstruct.mapping.robust import cauchy_weights, sigma_of


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
        flat = self.stations.reshape(-1, self.stations.shape[2])
        whole = gauge.spread @ gauge.flat.T @ (gauge.weights[:, None] * flat)
        return replace(
            self,
            stations=self.stations - gauge.motions @ whole,
            points=self.points - gauge.of_points(self.places) @ whole,
        )


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
    fields = _known(rig, names)
    if not fields or rig.covariance is None:
        return None
    frames = frames_of(mapped.model)
    pixels, ids = choose_pixels(mapped, seen, names, frames)
    state = start_state(mapped, rig, names, frames, ids)
    sights = exact_sights(state, pixels, fields, names, lever=False)
    sigma = sigma_of(sights.miss, sights.seen_by, len(frames))
    sights = sights.weighted(cauchy_weights(sights.miss, sigma))
    stations, points = _response(sights, len(frames), sigma**2, given)
    at = [rig.covariance.parameters.index(name) for name in fields]
    return CalibrationPart(
        frames=frames,
        stations=stations,
        places=state.points,
        points=points,
        covariance=rig.covariance.matrix[np.ix_(at, at)],
    )


def _known(rig: Rig, names: Sequence[str]) -> tuple[str, ...]:
    if rig.covariance is None:
        return ()
    return tuple(n for n in rig.covariance.parameters if n.split(".")[0] in names)


def _response(
    sights: Sights, count: int, variance: float, given: Array | None
) -> tuple[Array, Array]:
    """Slopes of stations (F, 6, G) and points (P, 3, G) by what is shared, in some gauge."""
    reduced = reduce_points(sights, count)
    matrix = csc_matrix(reduced.matrix / variance)
    seeing = np.bincount(sights.station, minlength=count) >= LEAST_POINTS
    free = np.repeat(seeing, POSE)
    if given is None:
        free[:POSE] = False
    else:
        matrix = csc_matrix(matrix + diags_array(given.ravel()))
    solve = solver_of(matrix, free)
    shared = reduced.border.shape[1]
    stations = -solve(reduced.border / variance).reshape(count, POSE, shared)
    still = np.zeros_like(sights.miss)
    points = [
        moved_points(
            sights.starts, sights.station, sights.by_point, sights.arm, sights.by_shared, still,
            reduced.point_inverse, np.ascontiguousarray(stations[:, :, g]), np.eye(shared)[g],
        )
        for g in range(shared)
    ]  # fmt: skip
    return stations, np.stack(points, axis=-1)
