"""How well each picture's pose is known: the model's own covariance and that of its place.

A covariance of a pose here is (6, 6) of its position (north, east, down of the world frame, in the
frame's unit) and of its rotation about the same three axes, radians: the true pose is
`exp(rotation) * attitude` at `position + shift`.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.artefacts import atomic_path
from alice_survey.base.frames import Array
from alice_survey.base.run import progress
from reconstruct.mapping.uncertainty import Uncertainty
from reconstruct.placing.alignment import Similarity
from reconstruct.placing.navigation_equations import attitude_axes, cross_matrices

POSE_ORDER = (
    "north_m", "east_m", "down_m", "rotation_north_rad", "rotation_east_rad", "rotation_down_rad",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class PlaceCovariance:
    """How well a model's place is known: see `georeference.Fit`."""

    middle: Array
    """(3,) middle of the track in the world."""
    covariance: Array
    """(7, 7) covariance of rotation, shift of the middle, and logarithm of the scale."""


def placed_covariances(poses: RigidTransform, place: PlaceCovariance) -> Array:
    """Covariance of poses from the place alone, (N, 6, 6): the same errors for all of them."""
    away = poses.translation - place.middle
    jacobian = np.zeros((len(away), 6, 7))
    jacobian[:, :3, :3] = -cross_matrices(away)
    jacobian[:, :3, 3:6] = np.eye(3)
    jacobian[:, :3, 6] = away
    jacobian[:, 3:, :3] = np.eye(3)
    found: Array = jacobian @ place.covariance @ np.swapaxes(jacobian, 1, 2)
    return found


@progress.step("covariance of the track")
def shape_covariances(
    poses: RigidTransform,
    stations: NDArray[np.int64],
    reference: NDArray[np.bool_],
    found: Uncertainty,
    world_from_model: Similarity,
) -> Array:
    """Covariance of poses from the model's own shape, (N, 6, 6); NaN where it is unknown.

    Args:
        poses: (N,) of the pictures in the world.
        stations: (N,) theirs.
        reference: (N,) whether a picture is that whose pose `found` has.
        found: covariances of the stations, in the model's axes and unit.
        world_from_model: the model's place.
    """
    turn = world_from_model.rotation.as_matrix()
    # There: turn, then position; here: position, then turn.
    move = np.zeros((6, 6))
    move[:3, 3:] = world_from_model.scale * turn
    move[3:, :3] = turn
    of_station = dict(zip(found.stations.tolist(), found.frame_cov, strict=True))
    origins = {
        int(s): p
        for s, p, first in zip(stations, poses.translation, reference, strict=True)
        if first
    }
    result = np.full((len(stations), 6, 6), np.nan)
    for i, (station, place) in enumerate(zip(stations.tolist(), poses.translation, strict=True)):
        if station not in of_station or station not in origins:
            continue
        arm = np.eye(6)
        arm[:3, 3:] = -cross_matrices((place - origins[station])[None])[0]
        jacobian = arm @ move
        result[i] = jacobian @ of_station[station] @ jacobian.T
    return result


def attitude_sigmas_deg(ned_from_body: Rotation, covariances: Array) -> Array:
    """Sigmas of roll, pitch and heading, (N, 3) degrees, of poses with such covariances."""
    angles = np.linalg.inv(attitude_axes(ned_from_body))
    moved = angles @ covariances[:, 3:, 3:] @ np.swapaxes(angles, 1, 2)
    found: Array = np.rad2deg(np.sqrt(np.diagonal(moved, axis1=1, axis2=2)))
    return found


def write_covariances(path: Path, images: list[str], covariances: Array, parts: str) -> None:
    """Write `track_covariance.npz`: `image` (N,), `covariance` (N, 6, 6), `order`, `parts`."""
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez(
            file,
            image=np.array(images),
            covariance=covariances,
            order=np.array(POSE_ORDER),
            parts=np.array(parts),
        )
