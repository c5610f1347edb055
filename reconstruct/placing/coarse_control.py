"""Control that is coarser than stated or wrong in part: what to leave out, and its real sigma.

A wrong point is found by least median of squares (Rousseeuw & Leroy 1987, "Robust regression and
outlier detection", chapter 5): of the placements that three points give, the one that most others
agree with. What the rest misses by then says what it is worth.
"""

import itertools
from dataclasses import replace

import numpy as np
from scipy.optimize import brentq

from alice_survey.core.errors import warn
from alice_survey.core.frames import Array
from alice_survey.core.robust import MAD_TO_SIGMA
from reconstruct.placing.alignment import Similarity
from reconstruct.placing.control import ControlFit, aligned

_TRIPLE = 3
_MAX_TRIPLES = 500
_INSIDE_SIGMAS, _WRONG_SIGMAS = 2.5, 4.0
"""What takes part in a first spread of the misfits, and what is wrong by the spread of these."""
_CHI_SIGMAS = 3.0
"""A misfit larger than stated sigmas allow, at this significance, makes them larger."""


def without_wrong_points(control: ControlFit, known_scale: float | None) -> ControlFit:
    """Control whose points agree: what most others contradict is left out, after a warning.

    With four points or fewer none can be told to be the wrong one.
    """
    ties = control.used_points
    count = len(ties)
    agreeing = (count + _TRIPLE + 1) // 2
    if count <= agreeing:
        return control
    model, ned = np.stack([t.spot.model for t in ties]), np.stack([t.ned for t in ties])
    best = np.full(count, np.inf)
    for triple in _triples(count):
        place = aligned(model[triple], ned[triple], known_scale)
        if place is None:
            continue
        off = _misfits(control, place)
        if (
            np.partition(off, agreeing - 1)[agreeing - 1]
            < np.partition(best, agreeing - 1)[agreeing - 1]
        ):
            best = off
    if not np.isfinite(best).all():
        return control
    spread = MAD_TO_SIGMA * (1.0 + 5.0 / (count - _TRIPLE)) * float(np.median(best))
    inside = best <= max(_INSIDE_SIGMAS * max(1.0, spread), np.sort(best)[agreeing - 1])
    place = aligned(model[inside], ned[inside], known_scale)
    if place is None:
        return control
    off = _misfits(control, place)
    freedom = 3 * int(inside.sum()) - (7 if known_scale is None else 6)
    spread = np.sqrt(3.0 * float(np.square(off[inside]).sum()) / freedom)
    misses = np.linalg.norm(place.apply(model) - ned, axis=1)
    wrong = {
        tie.name: float(miss)
        for tie, sigmas, miss in zip(ties, off, misses, strict=True)
        if sigmas > _WRONG_SIGMAS * max(1.0, spread)
    }
    for name, miss in wrong.items():
        warn(
            f"control point {name} is {miss:.2g} m off where the others place it and is left out: "
            "check its coordinates and picks"
        )
    kept = tuple(
        replace(tie, use="left out") if tie.use == "control" and tie.name in wrong else tie
        for tie in control.ties
    )
    return replace(control, ties=kept)


def _triples(count: int) -> list[list[int]]:
    every = [list(triple) for triple in itertools.combinations(range(count), _TRIPLE)]
    if len(every) <= _MAX_TRIPLES:
        return every
    rng = np.random.default_rng(0)  # any choice will do; the same each time
    return [every[k] for k in rng.choice(len(every), _MAX_TRIPLES, replace=False)]


def _misfits(control: ControlFit, place: Similarity) -> Array:
    """(N,) misfits of the used points, in sigmas: root mean square of the three axes."""
    return np.array(
        [
            np.linalg.norm(np.linalg.solve(np.linalg.cholesky(spread), miss)) / np.sqrt(3.0)
            for miss, spread in control.misfits(place)
        ]
    )


def real_sigma_factor(control: ControlFit, place: Similarity, parameters: int) -> float:
    """Factor that sigmas of points need for what they miss by, 1 or more.

    What picks are worth shows in the pictures; the rest is the coordinates'.

    Args:
        control: on the model as placed.
        place: that fits it.
        parameters: of the placement that the points themselves may have absorbed.
    """
    freedom = 3 * len(control.used_points) - parameters
    if freedom < 1:
        return 1.0

    def excess(log_factor: float) -> float:
        coarser = widened(control, float(np.exp(log_factor)))
        return 3.0 * float(np.square(_misfits(coarser, place)).sum()) / freedom - 1.0

    ratio = 1.0 + excess(0.0)
    if ratio <= 1.0 + _CHI_SIGMAS * np.sqrt(2.0 / freedom):
        return 1.0
    maximum = np.log(ratio)
    while excess(maximum) > 0:
        maximum *= 2.0
    return float(np.exp(brentq(excess, 0.0, maximum)))


def widened(control: ControlFit, factor: float) -> ControlFit:
    """The same with sigmas of its points that are larger by a factor."""
    ties = tuple(
        replace(tie, sigma=factor * tie.sigma) if tie.use == "control" else tie
        for tie in control.ties
    )
    return replace(control, ties=ties, sigma_factor=factor * control.sigma_factor)


def warn_of_coarse(control: ControlFit) -> None:
    """Say what sigma points count with, where that is not the stated one."""
    if control.sigma_factor > 1.0:
        used = control.used_points
        real = float(np.median([tie.sigma for tie in used]))
        warn(
            f"{len(used)} control points miss by more than their sigmas and picks allow: they "
            f"count with a sigma of {real:.2g} m, not {real / control.sigma_factor:.2g} m"
        )
