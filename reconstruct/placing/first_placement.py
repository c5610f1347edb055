"""Where the fit of a model to navigation starts, and what of its place navigation can tell."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from alice_survey.core.errors import warn
from reconstruct.placing.alignment import Similarity
from reconstruct.placing.navigation_equations import Epochs

_MIN_SPREAD = 0.1
"""Positions that spread less than this share of their sigma do not place a model."""
_RELIEF_SIGMAS = 3.0
"""Relief of a track over the sigma of its depths from which depths alone give the scale."""


def observable(epochs: Epochs) -> list[int]:
    """Parameters of rotation and shift that some reading depends on.

    Without positions north and east are the model's own, without headings too its heading; without
    depths its depth is the sea floor's, and where headings are all that is known, its level too: by
    choice, and so without a sigma.
    """
    free = [0, 1] if epochs.known[:, :5].any() else []
    if epochs.has_horizontal or epochs.known[:, 5].any():
        free.append(2)
    if epochs.has_horizontal:
        free += [3, 4]
    if epochs.known[:, 2].any():
        free.append(5)
    return free


def first_placement(
    epochs: Epochs, levelled: Similarity, known_scale: float | None
) -> Similarity | None:
    """A first placement: from attitudes, else from the levelled model and what is known.

    Args:
        epochs: navigation and model.
        levelled: the model on its mean plane.
        known_scale: metres in a unit of the model, or None.

    Returns:
        The placement; None, after a warning, where navigation gives no scale or place.
    """
    if not epochs.has_horizontal:
        return _without_positions(epochs, levelled, known_scale)
    at = epochs.known[epochs.moment, 0]
    count = int(epochs.known[:, 0].sum())
    measured = epochs.measured_ned[at]
    spread = float(np.sqrt(measured[:, :2].var(axis=0).sum()))
    need = float(np.median(epochs.sigma[epochs.known[:, 0], 0]))
    flat = levelled.apply(epochs.centres)[at]
    has = _has_angles(epochs)
    if not has.any() or known_scale is None:
        minimum = 2 if has.any() else 3
        if count < minimum or spread <= _MIN_SPREAD * need:
            warn(
                f"{count} positions spread over {spread:.2f} m at a sigma of {need:.2f} m do not "
                "place the model: it stays without CRS"
            )
            return None
    a = (flat[:, :2] - flat[:, :2].mean(axis=0)) @ [1.0, 1j]
    b = (measured[:, :2] - measured[:, :2].mean(axis=0)) @ [1.0, 1j]
    turn = complex(np.vdot(a, b) / max(float(np.vdot(a, a).real), 1e-300))
    if has.any():
        rotation = _by_attitudes(epochs, has)
    else:
        rotation = Rotation.from_rotvec([0.0, 0.0, np.angle(turn)]) * levelled.rotation
    scale = abs(turn) if known_scale is None else known_scale
    return _shifted(epochs, levelled, scale, rotation)


def _without_positions(
    epochs: Epochs, levelled: Similarity, known_scale: float | None
) -> Similarity | None:
    scale, rotation = known_scale, levelled.rotation
    if scale is None:
        scale = _scale_by_relief(epochs, levelled)
        if scale is None:
            return None
    headed, has = epochs.known[epochs.moment, 5], _has_angles(epochs)
    if has.any():
        rotation = _by_attitudes(epochs, has)
    elif headed.any():
        stated = epochs.ned_from_body[headed].as_euler("ZYX")[:, 0]
        found = (rotation * epochs.model_from_body[headed]).as_euler("ZYX")[:, 0]
        turn = np.angle(np.exp(1j * (stated - found)).mean())
        rotation = Rotation.from_rotvec([0.0, 0.0, turn]) * rotation
    return _shifted(epochs, levelled, scale, rotation)


def _has_angles(epochs: Epochs) -> NDArray[np.bool_]:
    """(N,) whether roll, pitch and heading of a picture are known."""
    return np.asarray(np.isfinite(np.where(epochs.known, 0.0, np.nan)[epochs.moment, 3:].sum(1)))


def _by_attitudes(epochs: Epochs, has: NDArray[np.bool_]) -> Rotation:
    some = np.flatnonzero(has)
    return (epochs.ned_from_body[some] * epochs.model_from_body[some].inv()).mean()


def _scale_by_relief(epochs: Epochs, levelled: Similarity) -> float | None:
    """The scale by which the relief of the track fits its depths, where they hold it.

    Depth is linear in the model's coordinates, and a slope of the track against the level is one of
    the model's tilt: what is left after slopes is the scale's.
    """
    at = epochs.known[epochs.moment, 2]
    if not at.any():
        warn("navigation gives no scale to a model without one: it stays unscaled, without CRS")
        return None
    flat, depths = levelled.apply(epochs.centres)[at], epochs.measured_ned[at, 2]
    sigma = float(np.median(epochs.sigma[epochs.known[:, 2], 2]))
    slopes = np.column_stack([np.ones(len(flat)), flat[:, :2]])
    relief, rest = (v - slopes @ np.linalg.lstsq(slopes, v)[0] for v in (flat[:, 2], depths))
    along = float(relief @ rest) / max(float(relief @ relief), 1e-300)
    size = along * float(np.sqrt(np.mean(relief**2)))
    if len(np.unique(epochs.moment[at])) <= slopes.shape[1] or size < _RELIEF_SIGMAS * sigma:
        warn(
            f"depths along the track show {max(size, 0.0):.2f} m of the model's relief at a sigma "
            f"of {sigma:.2f} m, too little for its scale: it stays unscaled, without CRS; measure "
            "a known length with 'alice-survey scale'"
        )
        return None
    # The depth's gradient in the model has the length of the scale; the slopes are its other part.
    tilt = np.linalg.lstsq(slopes, depths - along * flat[:, 2])[0][1:]
    return float(np.sqrt(along**2 + tilt @ tilt))


def _shifted(epochs: Epochs, levelled: Similarity, scale: float, rotation: Rotation) -> Similarity:
    """A placement shifted onto the readings, else with the origin of the levelled model."""
    start = Similarity(scale=scale, rotation=rotation, translation=np.zeros(3))
    origin = -levelled.rotation.inv().apply(levelled.translation) / levelled.scale
    shift = -scale * rotation.apply(origin)
    off = epochs.measured_ned - epochs.positions(start)
    for axis in range(3):
        known = epochs.known[epochs.moment, axis]
        if known.any():
            shift[axis] = np.median(off[known, axis])
    return Similarity(scale=scale, rotation=rotation, translation=shift)
