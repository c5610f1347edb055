"""Which pictures to match with which for depth.

A good partner sees most of what the reference sees (overlap) from a place far enough to the side
that depth shows (base-to-height ratio), yet near enough that the picture looks alike. Depth from a
match that is good to s pixels is good to s (Z / f) (Z / B): the rig partner (B / Z of 0.05 at 2 m)
covers everything but is coarse, neighbours along and across the track carry the precision.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.spatial import cKDTree

from alice_survey.core.errors import ReconstructionError
from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from reconstruct.views.model import SparseModel, View, points_of_views

MIN_POINTS = 8
"""Sparse points that a view must see for its range of depths to be known."""
_SAMPLE = 400
"""Points of a view at which overlap is measured."""
_MIN_OVERLAP = 0.15
_WIDEST_ANGLE_DEG = 40.0
_MAX_TILT = 0.6
"""Largest sine of the angle between a line of sight and the plane square to the baseline."""
_GOOD_RATIO = (0.15, 0.45)
_USABLE_RATIO = (0.02, 0.8)
_MAX_BOUNDING = 4000
"""Points that bound the depth of a view."""
_BEYOND = 1.2
"""Times the farthest point that a view observed: points of others may lie so far away."""
_MIN_GAIN = 0.03
"""Share of a view's points that another partner must newly serve to be worth its time."""


def in_frame(view: View, points_world: Array) -> NDArray[np.bool_]:
    """Whether points (N, 3) lie before the camera and inside of its picture, occluded or not."""
    pixels = view.project(points_world)
    inside = (pixels >= 0) & (pixels < view.pinhole.size_px)  # NaN compares as False
    return np.asarray(inside.all(axis=1))


class PointsInSight:
    """The points in the frame of each view, its own and others', that bound its depth.

    They are found when they are wanted: those of all views take a hundred kilobytes a view. The
    work grows with the views, not with views times points.
    """

    def __init__(self, model: SparseModel) -> None:
        """Take views and points."""
        self._model, self._own = model, points_of_views(model)
        self._tree = cKDTree(model.points_world) if len(model.points_world) else None

    def of(self, number: int) -> Array:
        """(N, 3) of a view; of many every n-th."""
        own, view = self._own[number], self._model.views[number]
        if self._tree is None or len(own) == 0:
            return own
        centre = view.world_from_cam.translation
        reach = _BEYOND * np.linalg.norm(own - centre, axis=1).max()
        near = np.sort(self._tree.query_ball_point(centre, reach))
        inside = near[in_frame(view, self._model.points_world[near])]
        chosen: Array = self._model.points_world[inside[:: -(-len(inside) // _MAX_BOUNDING) or 1]]
        return chosen


def neighbours(model: SparseModel, maximum: int) -> list[list[int]]:
    """The other views that share most sparse points with each view, best first."""
    views = len(model.views)
    points, numbers = model.observations.T
    seen = coo_matrix(
        (np.ones(len(points), np.float32), (numbers, points)),
        shape=(views, len(model.points_world)),
    ).tocsr()
    shared = (seen @ seen.T).tocsr()
    found = []
    for view in range(views):
        part = slice(shared.indptr[view], shared.indptr[view + 1])
        others, counts = shared.indices[part], shared.data[part]
        others, counts = others[others != view], counts[others != view]
        found.append([int(n) for n in others[np.lexsort((others, -counts))][:maximum]])
    return found


@progress.step("choose partners")
def choose_partners(model: SparseModel, per_view: int) -> list[list[int]]:
    """Choose partners for every view.

    The rig partner comes first: it was exposed at the same moment, under the same light. Others
    are taken one by one; each time the one that most raises the expected number of points that at
    least one partner matches well, so that partners complement each other: one ahead, one astern,
    one abeam.

    Args:
        model: views and sparse points.
        per_view: largest number of partners of a view.

    Returns:
        For every view its partners, best first; none for a view with too few sparse points.

    Raises:
        ReconstructionError: no view has a partner.
    """
    axes = [view.world_from_cam.rotation.apply([0.0, 0.0, 1.0]) for view in model.views]
    centres = np.array([view.world_from_cam.translation for view in model.views]).reshape(-1, 3)
    tree = cKDTree(centres)
    observed = points_of_views(model)
    stations = [view.station for view in model.views]
    chosen: list[list[int]] = []
    for index in range(len(model.views)):
        points = observed[index]
        if len(points) < MIN_POINTS:
            chosen.append([])
            continue
        points = points[:: max(1, len(points) // _SAMPLE)]
        distance = float(np.median(np.linalg.norm(points - centres[index], axis=1)))
        candidates: dict[int, Array] = {}
        for other in sorted(tree.query_ball_point(centres[index], _USABLE_RATIO[1] * distance)):
            base = centres[other] - centres[index]
            if other == index:
                continue
            if axes[index] @ axes[other] < np.cos(np.deg2rad(_WIDEST_ANGLE_DEG)):
                continue
            across = np.linalg.norm(base - (base @ axes[index]) * axes[index])
            ratio = float(across / distance)
            if not _USABLE_RATIO[0] <= ratio <= _USABLE_RATIO[1]:
                continue
            tilt = max(abs(base @ axes[i]) for i in (index, other)) / np.linalg.norm(base)
            if tilt > _MAX_TILT:
                continue
            served = in_frame(model.views[other], points).astype(np.float64)
            if served.mean() < _MIN_OVERLAP:
                continue
            candidates[int(other)] = served * _quality(ratio) * (1.0 - tilt * tilt)
        rig = [n for n in candidates if stations[n] == stations[index]]
        chosen.append(_complementary(rig[:per_view], candidates, per_view))
    if not any(chosen):
        raise ReconstructionError(
            f"none of {len(model.views)} registered pictures has a partner with "
            f"{_MIN_OVERLAP:.0%} overlap to find depth with; add pictures that overlap"
        )
    return chosen


def depths_per_pair(looked_at: Sequence[Sequence[int]]) -> float:
    """Into how many depths a pair of pictures enters, in the mean.

    Args:
        looked_at: for every view the others that its depth was found with.

    Returns:
        From 1, where no two views look at each other, to 2, where all do.
    """
    looks = [(view, other) for view, others in enumerate(looked_at) for other in others]
    return len(looks) / len({frozenset(pair) for pair in looks}) if looks else 1.0


def _quality(ratio: float) -> float:
    """Chance that a match at this base-to-height ratio is found and determines depth well."""
    low, high = _GOOD_RATIO
    if ratio < low:
        return 0.8 * float(np.sqrt(ratio / low))
    if ratio > high:
        return 0.8 * (high / ratio) ** 2
    return 0.8


def _complementary(first: list[int], candidates: dict[int, Array], per_view: int) -> list[int]:
    """The first, and candidates that match well what those before them miss."""
    chosen, missed = list(first), np.array(1.0)
    for n in first:
        missed = missed * (1.0 - candidates[n])
    left = [n for n in candidates if n not in chosen]
    while left and len(chosen) < per_view:
        gains = [float((missed * candidates[n]).mean()) for n in left]
        best = int(np.argmax(gains))
        if gains[best] < _MIN_GAIN and chosen:
            break
        chosen.append(left.pop(best))
        missed = missed * (1.0 - candidates[chosen[-1]])
    return chosen
