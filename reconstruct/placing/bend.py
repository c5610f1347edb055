"""How bent a block is against navigation.

Near-parallel views bend a model like a dome while every reprojection error stays small (James &
Robson 2014, "Mitigating systematic error in topographic models derived from UAV and ground-based
image networks"). Neither a pressure sensor nor an attitude reference bends with it.
"""

from dataclasses import dataclass

import numpy as np

from alice_survey.core.frames import Array
from reconstruct.placing.alignment import Similarity

_THIN = 0.1
"""Width over length of a block below which it has no curvature across."""
_SIGMAS = 3.0
MIN_STATIONS = 8
"""A paraboloid has six coefficients."""


@dataclass(frozen=True, kw_only=True)
class Bend:
    """Curvature of a block along one of its axes."""

    curvature_per_m: float
    """Second derivative of the model's height error: positive where ends are too high."""
    sigma_per_m: float
    length_m: float
    """Length of the block along the axis."""
    straightened_per_m: float = 0.0
    """Curvature that was taken out of the model before."""

    @property
    def sag_m(self) -> float:
        """How far the middle is off against the ends: `curvature * length^2 / 8`."""
        return self.curvature_per_m * self.length_m**2 / 8.0

    @property
    def sag_sigma_m(self) -> float:
        """Standard deviation of the sag."""
        return self.sigma_per_m * self.length_m**2 / 8.0

    def significant(self, pixel_m: float) -> bool:
        """Whether it is beyond its noise and larger than a ground pixel."""
        return abs(self.sag_m) > max(_SIGMAS * self.sag_sigma_m, pixel_m)


def quadratic(places: Array) -> tuple[Array, Array, Array]:
    """Columns 1, u, u^2 / 2 and, of a wide block, v, v^2 / 2, u v of places (N, 2).

    Here u and v are places about their middle in principal axes.

    Returns:
        The columns, (N, 3 or 6); the extents along u and v, (2,); the axes, (2, 2) by rows.
    """
    flat = places - places.mean(axis=0)
    axes = np.linalg.svd(flat, full_matrices=False)[2]
    u, v = axes @ flat.T
    sizes = np.array([np.ptp(u), np.ptp(v)])
    columns = [np.ones(len(u)), u, u**2 / 2]
    if sizes[1] > _THIN * sizes[0]:
        columns += [v, v**2 / 2, u * v]
    return np.column_stack(columns), sizes, axes


def sag_weights(places: Array) -> Array:
    """(1 or 2, N) that take heights at places (N, 2) to the sags along and, if wide, across."""
    columns, sizes, _ = quadratic(places)
    curvatures = np.linalg.pinv(columns)[2::2]
    return np.asarray(curvatures * sizes[: len(curvatures), None] ** 2 / 8.0)


def bend_modes(places_ned: Array, place: Similarity) -> Array:
    """Deformations that bend a model by a unit of curvature downwards, like its soft modes.

    Args:
        places_ned: (N, 3) of cameras.
        place: of the model.

    Returns:
        (N, 6, 1 or 3) motions and turns in the model's axes: along u, along v, and twisted.
    """
    columns, _, axes = quadratic(places_ned[:, :2])
    wide = columns.shape[1] > 3
    u, v = columns[:, 1], columns[:, 3] if wide else np.zeros(len(columns))
    zero = np.zeros_like(u)
    # Depth, then its slopes along u and v.
    shapes = [(u**2 / 2, u, zero), (v**2 / 2, zero, v), (u * v, v, u)][: 3 if wide else 1]
    found = np.zeros((len(u), 6, len(shapes)))
    back = place.rotation.inv().as_matrix()
    for k, (depth, by_u, by_v) in enumerate(shapes):
        found[:, :3, k] = np.column_stack([zero, zero, depth]) @ back.T / place.scale
        north, east = axes.T @ np.stack([by_u, by_v])
        found[:, 3:, k] = np.column_stack([east, -north, zero]) @ back.T
    return found
