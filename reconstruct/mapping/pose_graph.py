"""All stations in one frame, from the relative poses of pairs of them.

First rotations, then positions, each a sparse linear problem that is solved a few times with
weights that fade out links which contradict the others (iteratively reweighted least squares, as
Chatterjee & Govindu 2013, "Efficient and Robust Large-Scale Rotation Averaging"). Since a rig
gives every link its length, positions are as linear as rotations.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.sparse.linalg import splu
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.frames import Array
from alice_survey.base.run import progress
from reconstruct.mapping.stations import StationLink

Indices = NDArray[np.int64]
_ROUNDS = 8
_LEAST_ANGLE_RAD = 1e-3
_LEAST_LENGTH = 1e-3
"""Share of the links' usual length; with the angle, floors of what counts as a contradiction."""
_MEDIANS = 2.0
"""Residuals of this many medians keep half their weight."""


def station_groups(links: Sequence[StationLink]) -> list[list[int]]:
    """Stations that links join, the largest group first (of equals that with the first station)."""
    names, ends = _numbered(links)
    graph = coo_array((np.ones(len(links)), ends), shape=(len(names),) * 2)
    count, label = connected_components(graph, directed=False)
    groups = [[names[k] for k in np.flatnonzero(label == g)] for g in range(count)]
    return sorted(groups, key=lambda group: (-len(group), group[0]))


@progress.step("average poses")
def average_poses(links: Sequence[StationLink]) -> Mapping[int, RigidTransform]:
    """Poses that agree best with all links.

    Args:
        links: of one group (see `station_groups`).

    Returns:
        `rig_from_world` by station; the world is the frame of the best linked station.

    Raises:
        ValueError: the links join more than one group.
    """
    if len(station_groups(links)) != 1:
        raise ValueError("links of more than one group have no common frame")
    names, (first, second) = _numbered(links)
    turn = 1.0 / np.array([link.turn_variance for link in links])
    shift = 1.0 / np.array([link.shift_variance for link in links])
    relative = RigidTransform.concatenate([link.second_from_first for link in links])
    root, start = _along_tree(len(names), first, second, relative, turn)
    turned = _average_rotations(start.rotation, first, second, relative.rotation, turn, root)
    # Where the second station's origin lies as the first sees it, turned into the world's axes.
    steps = turned[first].inv().apply(relative.inv().translation)
    centres = _average_centres(start.inv().translation, first, second, steps, shift, root)
    poses = RigidTransform.from_components(-turned.apply(centres), turned)
    return {name: poses[k] for k, name in enumerate(names)}


def _numbered(links: Sequence[StationLink]) -> tuple[list[int], tuple[Indices, Indices]]:
    names = sorted({s for link in links for s in (link.first, link.second)})
    number = {name: k for k, name in enumerate(names)}
    first = np.array([number[link.first] for link in links], dtype=np.int64)
    second = np.array([number[link.second] for link in links], dtype=np.int64)
    return names, (first, second)


def _along_tree(
    count: int, first: Indices, second: Indices, relative: RigidTransform, weight: Array
) -> tuple[int, RigidTransform]:
    """Chain the most precise links from the best linked station: (root, rig_from_world)."""
    strength = np.bincount(first, weight, count) + np.bincount(second, weight, count)
    root = int(np.argmax(strength))
    graph = csr_array(coo_array((1.0 / weight, (first, second)), shape=(count, count)))
    tree = minimum_spanning_tree(graph)
    order, parent = breadth_first_order(tree, root, directed=False)
    of_pair = {(int(a), int(b)): k for k, (a, b) in enumerate(zip(first, second, strict=True))}
    poses = [RigidTransform.identity() for _ in range(count)]
    for node in order[1:]:
        above = int(parent[node])
        k = of_pair.get((above, int(node)))
        step = relative[k] if k is not None else relative[of_pair[int(node), above]].inv()
        poses[node] = step * poses[above]
    return root, RigidTransform.concatenate(poses)


def _average_rotations(
    start: Rotation, first: Indices, second: Indices, relative: Rotation, weight: Array, root: int
) -> Rotation:
    turned = start
    for _ in range(_ROUNDS):
        # (relative * first).inv() * second is what is left over, about the world's axes.
        left = ((relative * turned[first]).inv() * turned[second]).as_rotvec()
        trust = weight * _trust(np.linalg.norm(left, axis=1), _LEAST_ANGLE_RAD)
        step = _solve(len(turned), first, second, -left, trust, root)
        turned = turned * Rotation.from_rotvec(step)
        if np.abs(step).max() < 1e-8:
            break
    return turned


def _average_centres(
    centres: Array, first: Indices, second: Indices, steps: Array, weight: Array, root: int
) -> Array:
    floor = _LEAST_LENGTH * float(np.median(np.linalg.norm(steps, axis=1)))
    for _ in range(_ROUNDS):
        left = centres[second] - centres[first] - steps
        trust = weight * _trust(np.linalg.norm(left, axis=1), floor)
        step = _solve(len(centres), first, second, -left, trust, root)
        centres = centres + step
        if np.abs(step).max() < 1e-6 * floor:
            break
    return centres


def _trust(residuals: Array, floor: float) -> Array:
    scale = max(_MEDIANS * float(np.median(residuals)), floor)
    trust: Array = 1.0 / (1.0 + (residuals / scale) ** 2)
    return trust


def _solve(
    count: int, first: Indices, second: Indices, wanted: Array, weight: Array, root: int
) -> Array:
    """Least squares of `x[second] - x[first] = wanted` with `x[root] = 0`; (count, 3)."""
    rows = np.arange(len(first))
    sign = np.concatenate([-np.ones(len(first)), np.ones(len(first))])
    incidence = csr_array(
        coo_array(
            (sign, (np.concatenate([rows, rows]), np.concatenate([first, second]))),
            shape=(len(first), count),
        )
    )
    free = np.flatnonzero(np.arange(count) != root)
    reduced = incidence[:, free]
    normal = csr_array(reduced.T @ _scaled(reduced, weight)).tocsc()
    solved = np.zeros((count, 3))
    solved[free] = splu(normal).solve(reduced.T @ (weight[:, None] * wanted))
    return solved


def _scaled(matrix: csr_array, weight: Array) -> csr_array:
    scaled = matrix.copy()
    scaled.data = scaled.data * np.repeat(weight, np.diff(scaled.indptr))
    return scaled
