"""Where a model lies in the world: fitted to navigation, or levelled where there is none."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.errors import ReconstructionError, warn
from alice_survey.core.frames import Array, Datum
from alice_survey.core.manifest import ImageRecord
from reconstruct.placing.alignment import Similarity
from reconstruct.placing.first_placement import first_placement, observable
from reconstruct.placing.navigation_equations import (
    SCALE,
    USUAL_INSTALLATION,
    Installation,
    read_epochs,
    without_navigation,
)
from reconstruct.placing.navigation_task import SHRUNK, ExtraOf, NavigationTask
from reconstruct.placing.placement_fit import PlacementFit

_ROUGH_SCALE, _VAGUE_SCALE = 0.03, 0.15
"""Relative sigmas of a scale by positions: from the first it is worth a warning; beyond the second
it is none: of vaguer ones those that are too large would pass."""
_TRIMS = 5
"""Rounds of leaving out what is off the mean plane."""


def level(points: Array, centres: Array) -> Similarity:
    """Put a model's mean plane level, its third axis down, away from the cameras.

    The origin is the middle of the plane's points; the first axis points from the first camera to
    the last.

    Args:
        points: (N, 3) points of the model, 3 or more.
        centres: (M, 3) camera centres in order.

    Returns:
        `world_from_model`, of scale one.
    """
    kept = points
    for _ in range(_TRIMS):
        middle = kept.mean(axis=0)
        normal = np.linalg.svd(kept - middle, full_matrices=False)[2][2]
        away = np.abs((points - middle) @ normal)
        kept = points[away <= 3.0 * np.median(away) + 1e-12]
    middle = kept.mean(axis=0)
    normal = np.linalg.svd(kept - middle, full_matrices=False)[2][2]
    if (centres.mean(axis=0) - middle) @ normal > 0:
        normal = -normal
    ahead = centres[-1] - centres[0]
    ahead = ahead - (ahead @ normal) * normal
    if np.linalg.norm(ahead) < 1e-9 * (1.0 + np.abs(centres).max()):
        ahead = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    ahead = ahead / np.linalg.norm(ahead)
    rotation = Rotation.from_matrix(np.stack([ahead, np.cross(normal, ahead), normal]))
    return Similarity(scale=1.0, rotation=rotation, translation=-rotation.apply(middle))


def fit_navigation(
    records: Sequence[ImageRecord],
    model_from_cam: Sequence[RigidTransform],
    body_from_cam: Mapping[str, RigidTransform] | None,
    datum: Datum | None,
    levelled: Similarity,
    *,
    known_scale: float | None,
    installed: Installation = USUAL_INSTALLATION,
    scale_sigma: float = 0.0,
    control: ExtraOf | None = None,
    modes: Array | None = None,
    joints: int = 0,
) -> PlacementFit | None:
    """Fit a model to the positions and attitudes of navigation.

    Args:
        records: registered pictures.
        model_from_cam: pose of each picture's camera in the model.
        body_from_cam: mount of every camera, metres; None where it is unknown: positions are those
            of the cameras, and attitudes, which are the vehicle's, are not used.
        datum: origin of the local frame; None where no latitude and longitude are known: the model
            keeps the origin of `levelled`, its heading too where none is known.
        levelled: `level` of the model; where no attitude is known it keeps the model from turning
            about a straight track, with a sigma of 10 degrees.
        known_scale: metres in a unit of the model, or None: then the scale is fitted too.
        installed: how well it is known where the cameras are on the vehicle, and their clock.
        scale_sigma: relative, of a known scale; above 0 the scale is fitted about it.
        control: equations of control points and bars.
        modes: (N, 6, K) of the pictures by the model's soft modes; None where it is stiff.
        joints: how many of them, the last, are motions of groups of which pictures know nothing.

    Returns:
        The fit; None, after a warning, where positions are too few or too close together, or have
        no scale in common with the model.
    """
    epochs = read_epochs(records, model_from_cam, body_from_cam, datum, modes)
    if epochs is None or (datum is not None and not epochs.has_horizontal):
        return None
    start = first_placement(epochs, levelled, known_scale)
    if start is None:
        return None
    free = observable(epochs)
    if known_scale is None or scale_sigma > 0:
        free.append(SCALE)
    task = NavigationTask(
        epochs=epochs,
        levelled=levelled,
        known_scale=known_scale,
        scale_sigma=scale_sigma,
        installed=installed,
        control=control,
        joints=joints,
    )
    near, fit = task.robust(start, free), None
    if near.scale >= SHRUNK * start.scale:
        with suppress(ReconstructionError):
            fit = task.fit(near, free)
    if fit is None:
        warn(
            "positions of navigation and model have no scale in common: it stays without CRS; are "
            "they of these pictures?"
        )
        return None
    return fit if known_scale is not None or control is not None else _with_rough_scale(fit)


def _with_rough_scale(fit: PlacementFit) -> PlacementFit | None:
    """The fit with a sigma of its scale that holds where positions hardly show the scale.

    Errors of the scale itself are normal, those of its logarithm not: three sigmas s below a scale
    are -ln(1 - 3 s) away. None, after a warning, where the scale might as well be zero.
    """
    sigma = fit.sigma_scale
    if sigma < _ROUGH_SCALE:
        return fit
    if sigma > _VAGUE_SCALE:
        warn(
            f"positions of navigation show the scale to {sigma:.0%} only: the model stays without "
            "CRS; measure a known length with 'alice-survey scale'"
        )
        return None
    honest = -float(np.log1p(-3.0 * sigma)) / 3.0
    warn(
        f"positions spread little for their errors: the scale is rough, sigma {honest:.0%}; "
        "measure a known length with 'alice-survey scale'"
    )
    grown = np.ones(len(fit.joint))
    grown[SCALE] = honest / sigma
    return replace(fit, joint=fit.joint * np.outer(grown, grown))


def fit_control(
    records: Sequence[ImageRecord],
    model_from_cam: Sequence[RigidTransform],
    start: Similarity,
    control: ExtraOf,
    *,
    known_scale: float | None,
    scale_sigma: float,
    modes: Array | None = None,
    joints: int = 0,
) -> PlacementFit:
    """Place a model by control points alone.

    Args:
        records: registered pictures.
        model_from_cam: pose of each picture's camera in the model.
        start: a placement near the right one.
        control: equations of three or more points that are not on one line.
        known_scale: metres in a unit of the model, or None: then the scale is fitted too.
        scale_sigma: relative, of a known scale.
        modes: as in `fit_navigation`.
        joints: as there.
    """
    free = [0, 1, 2, 3, 4, 5]
    if known_scale is None or scale_sigma > 0:
        free.append(SCALE)
    task = NavigationTask(
        epochs=without_navigation(records, model_from_cam, modes),
        levelled=None,
        known_scale=known_scale,
        scale_sigma=scale_sigma,
        installed=USUAL_INSTALLATION,
        control=control,
        joints=joints,
    )
    return task.fit(task.robust(start, free), free)
