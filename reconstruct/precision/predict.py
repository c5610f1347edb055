"""The covariance that a survey will have, from the normal equations of its reconstruction.

Stations, points and the rig within its calibration give the shape and its soft modes as they do
after a dive; navigation of known errors then places it and knows the modes better.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from alice_survey.core.block_solver import inverse_of, product_of
from alice_survey.core.frames import Array
from reconstruct.adjustment.exact_observations import calibrated_parameters, exact_observations
from reconstruct.adjustment.normal_equations import LinearObservations, one_part, reduce_points
from reconstruct.adjustment.survey_fit import calibrated_information, motions_of
from reconstruct.adjustment.uncertainty import BlockShape, Motions, shape_of_block
from reconstruct.mapping.arrays import first_of, linked_groups
from reconstruct.placing.alignment import Similarity, sag_weights
from reconstruct.placing.correlated_fit import Extra, estimate
from reconstruct.placing.navigation import (
    GROUP_OF,
    PARAMETERS,
    PLACE,
    SCALE,
    STRETCH,
    TURN,
    Epochs,
    equations,
    slopes_by_place,
)
from reconstruct.precision.instruments import NavigationErrors
from reconstruct.precision.tracks import ExpectedBlock

_CELL_POINTS = 12
_EXACT = 1e-3
"""Factor on errors that are left out."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Precision:
    """Expected sigmas of a survey, metres."""

    bend_m: Array
    """(2,) of the sag along and across the block; NaN across one that is narrow."""
    scale: float
    """Relative."""
    shape_m: Array
    """(S, 3) of stations after a rigid alignment: north, east, down."""
    place_m: Array
    """(S, 3) of stations in the world."""
    cells_ne: Array
    """(C, 2) middles of cells of the sea floor, whose sides are `cell_m`."""
    cell_m: float
    heights_m: Array
    """(C,) of the surface after a rigid alignment, by poses and rig: matching adds its own."""

    @property
    def heights_rms_m(self) -> float:
        """Over the surface."""
        return float(np.sqrt(np.mean(self.heights_m**2)))


def predict(
    block: ExpectedBlock,
    navigation: NavigationErrors,
    *,
    pixels: bool = True,
    calibration: bool = True,
    control: Array | None = None,
    control_sigma_m: float = 0.01,
) -> Precision:
    """Predict the sigmas of a survey.

    Args:
        block: what pictures are expected to share.
        navigation: errors of the log.
        pixels: whether pixels err.
        calibration: whether the calibration does.
        control: (N, 3) places in NED of points that are surveyed; None without.
        control_sigma_m: of each coordinate of these.
    """
    state, noise_px = block.state, block.noise_px * (1.0 if pixels else _EXACT)
    rig = state.rig
    fields = calibrated_parameters(rig, list(rig.cameras)) if calibration else ()
    block = replace(block, state=state.with_shifts()) if fields else block
    linear = exact_observations(block.state, block.pixels, fields)
    linear.rest[..., -1] = 0.0
    linear = linear.weigh(np.full(len(block.pixels.station), block.times / noise_px**2))
    motions = _calibration(linear, block, fields) if fields else None
    bare = LinearObservations(
        starts=linear.starts, station=linear.station, by_point=linear.by_point, arm=linear.arm,
        rest=np.ascontiguousarray(linear.rest[..., -1:]),
    )  # fmt: skip
    shape = shape_of_block(
        one_part(bare, len(state.centres)), block.pixels, state.centres,
        state.points, motions, scale_free=len(rig.cameras) < 2,
    )  # fmt: skip
    joint, middle = _place(block, shape, navigation, control, control_sigma_m)
    return _precision(block, shape, joint, middle)


def _calibration(
    linear: LinearObservations, block: ExpectedBlock, fields: tuple[str, ...]
) -> Motions:
    """What is left of the errors of the calibration after the survey, and what they do."""
    found = reduce_points(linear, len(block.state.centres))
    station, point = block.pixels.station, block.pixels.point
    found.free[first_of(linked_groups(station, point, len(found.free)))] = False
    found.shared[:-1, :-1] += calibrated_information(block.state, fields)
    return motions_of(found, block.state.points, inverse_of(found.information))


def _place(
    block: ExpectedBlock,
    shape: BlockShape,
    navigation: NavigationErrors,
    control: Array | None,
    control_sigma_m: float,
) -> tuple[Array, Array]:
    """Covariance of the placement and of the modes, and the middle about which it acts."""
    state, bodies = block.state, block.ned_from_body
    count, modes = len(state.centres), shape.modes.stations
    sigma = np.array([navigation.channels[group].sigma for group in GROUP_OF])
    epochs = Epochs(
        time=block.time_s,
        timed=True,
        moment=np.arange(count),
        centres=state.centres,
        model_from_body=bodies.rotation,
        levers=bodies.rotation.inv().apply(bodies.translation - state.centres),
        measured_ned=bodies.translation,
        ned_from_body=bodies.rotation,
        sigma=np.tile(sigma, (count, 1)),
        known=np.ones((count, 6), dtype=bool),
        modes=np.concatenate([modes[:, 3:], modes[:, :3]], axis=1),
    )
    place = Similarity(scale=1.0, rotation=Rotation.identity(), translation=np.zeros(3))
    middle = state.centres.mean(axis=0)
    columns = PARAMETERS + modes.shape[2]
    known = navigation.installed.weights(columns)
    known[PARAMETERS:] = shape.modes.known
    known[TURN], known[STRETCH] = 1.0 / navigation.turn_rad, 1.0 / navigation.stretch
    rows = np.diag(known)[np.flatnonzero(known)]
    if control is not None:
        near = KDTree(state.points).query(control)[1]
        at, motions = state.points[near], shape.modes.points[near].astype(np.float64)
        known_at = np.zeros((len(at), 3, columns))
        known_at[:, :, :PLACE], known_at[:, :, PARAMETERS:] = slopes_by_place(at - middle), motions
        rows = np.concatenate([rows, known_at.reshape(-1, columns) / control_sigma_m])
    free = [*range(6), TURN, STRETCH, *np.flatnonzero(navigation.installed.weights(columns))]
    if not np.isfinite(state.rig.baseline_m):
        free.append(SCALE)
    found = estimate(
        epochs.time,
        equations(epochs, place, middle),
        epochs.known,
        [*free, *range(PARAMETERS, columns)],
        Extra(misfit=np.zeros(len(rows)), jacobian=rows),
        frame_bounds={},
        correlation={name: errors.correlation for name, errors in navigation.channels.items()},
    )
    joint = [*range(PLACE), *range(PARAMETERS, columns)]
    return found.covariance[np.ix_(joint, joint)], middle


def _precision(block: ExpectedBlock, shape: BlockShape, joint: Array, middle: Array) -> Precision:
    state, modes = block.state, shape.modes
    left = joint[PLACE:, PLACE:]
    shifts, points = modes.stations[:, 3:], modes.points.astype(np.float64)
    rest = np.diagonal(shape.stations[:, 3:, 3:], axis1=1, axis2=2) - shifts**2 @ modes.known
    own = np.einsum("fik,kl,fil->fi", shifts, left, shifts)
    slopes = np.concatenate([slopes_by_place(state.centres - middle), shifts], axis=2)
    placed = np.einsum("fik,kl,fil->fi", slopes, joint, slopes)
    heights = (shape.points - shape.noise)[:, 2, 2] - points[:, 2] ** 2 @ modes.known
    heights += np.einsum("pk,kl,pl->p", points[:, 2], left, points[:, 2])
    cell_m = cell_of(block)
    cells_ne, variances = by_cell(state.points[:, :2], heights, cell_m)
    bend = np.full(2, np.nan)
    for k, weights in enumerate(sag_weights(state.centres[:, :2])):
        bend[k] = _sigma(shape, weights[:, None] * [0.0, 0.0, 1.0], joint)
    arms = state.centres - state.centres.mean(axis=0)
    return Precision(
        bend_m=bend,
        scale=_sigma(shape, arms / (arms**2).sum(), joint, whole=1.0),
        shape_m=np.sqrt(np.maximum(rest + own, 0.0)),
        place_m=np.sqrt(np.maximum(rest + placed, 0.0)),
        cells_ne=cells_ne,
        cell_m=cell_m,
        heights_m=np.sqrt(np.maximum(variances, 0.0)),
    )


def _sigma(shape: BlockShape, weights: Array, joint: Array, *, whole: float = 0.0) -> float:
    """Sigma of a sum over the stations' shifts.

    Args:
        shape: of the block.
        weights: (S, 3) of the shifts; the sum is the same wherever the block lies.
        joint: covariance of placement and modes.
        whole: weight of the placement's scale.
    """
    both = np.concatenate([np.zeros_like(weights), weights], axis=1)
    along = np.zeros(len(joint))
    along[SCALE] = whole
    along[PLACE:] = product_of(both[..., None], shape.modes.stations)[0]
    stiff = shape.variance(both) - float(along[PLACE:] ** 2 @ shape.modes.known)
    return math.sqrt(max(stiff, 0.0) + float(along @ joint @ along))


def cell_of(block: ExpectedBlock) -> float:
    """Side of cells with some points each."""
    shown = block.state.points[:, :2]
    return math.sqrt(_CELL_POINTS * float(np.prod(np.ptp(shown, axis=0))) / len(shown))


def by_cell(places: Array, values: Array, cell_m: float) -> tuple[Array, Array]:
    """Middles of cells (C, 2) and medians (C,) of their values, a quarter of the usual or more."""
    cells, which = np.unique(np.floor(places / cell_m), axis=0, return_inverse=True)
    order = np.argsort(which, kind="stable")
    counts = np.bincount(which)
    parts, full = np.split(values[order], np.cumsum(counts)[:-1]), counts >= np.median(counts) / 4
    medians = np.array([np.median(part) for part in parts])
    middles: Array = (cells[full] + 0.5) * cell_m
    return middles, medians[full]
