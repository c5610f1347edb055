"""Which view textures which face: good views, and patches as large as they can be.

The energy is that of Lempitsky & Ivanov 2007 ("Seamless mosaicing of image-based texture maps"): a
cost of every face's view and a Potts cost of every edge between faces of different views. It is
lowered face by face (iterated conditional modes, Besag 1986) from the best views; patches that
stay small are then given to a neighbour that sees all of them.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from reconstruct.mesh.topology import Triangles, edges_of, face_normals, twin_sides
from reconstruct.mesh.visibility import Candidates

_SEAM_COST = 0.35
"""Cost of an edge of mean length between two views, over the logarithm of a ratio of quality."""
_SWEEPS = 30
_SMALL_FACES = 60
"""Patches of fewer faces are given away if they can be."""
_MERGES = 6
_MIN_AXIS_COSINE = 0.3
"""Least cosine between the normal of a face and the axis along which its texture lies."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Charts:
    """Connected patches of faces that one view textures."""

    label: NDArray[np.int32]
    """(T,) view of every face; -1 to -6 where no view sees it, by the axis it faces."""
    chart: NDArray[np.int32]
    """(T,) number of every face's patch."""
    views: NDArray[np.int32]
    """(C,) label of every patch."""


@progress.step("choose a picture for each face")
def choose_views(
    vertices: Array, triangles: Triangles, candidates: Candidates
) -> NDArray[np.int32]:
    """A view for every face, (T,); -1 to -6 where no view sees it (see `Charts.label`)."""
    neighbours, lengths = face_neighbours(vertices, triangles)
    known = candidates.quality > 0
    best = np.maximum(candidates.quality[:, :1], 1e-30)
    cost = np.where(known, -np.log(np.where(known, candidates.quality, 1.0) / best), np.inf)
    label = candidates.views[:, 0].copy()
    seam = _SEAM_COST * lengths / max(float(lengths.mean()), 1e-30)
    smooth(label, candidates.views, cost, neighbours, seam, _SWEEPS)
    for _ in range(_MERGES):
        chart = connected_charts(neighbours, label)
        size = np.bincount(chart)
        if not give_away(label, chart, size, candidates.views, neighbours, lengths, _SMALL_FACES):
            break
    unseen = label < 0
    normal = face_normals(vertices, triangles[unseen])
    axis = np.argmax(np.abs(normal), axis=1)
    ahead = np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] >= 0
    label[unseen] = -1 - (2 * axis + ahead)
    return label


def choose_axes(vertices: Array, triangles: Triangles) -> NDArray[np.int32]:
    """The axis along which to see every face, (T,): -1 to -6, in patches as large as they can be.

    Axes are chosen as views are, with the cosine to the face's normal for quality.
    """
    normal = face_normals(vertices, triangles)
    cosine = np.stack([-normal, normal], axis=2).reshape(-1, 6)
    best = np.argsort(-cosine, axis=1, kind="stable")[:, :3]
    quality = np.take_along_axis(cosine, best, axis=1)
    seen = quality > _MIN_AXIS_COSINE
    axes = Candidates(
        views=np.where(seen, best, -1).astype(np.int32),
        quality=np.where(seen, quality, 0.0).astype(np.float32),
    )
    chosen = choose_views(vertices, triangles, axes)
    return np.where(chosen < 0, chosen, -1 - chosen)


@progress.step("cut patches")
def make_charts(
    vertices: Array,
    triangles: Triangles,
    label: NDArray[np.int32],
    tile: NDArray[np.int32] | None = None,
) -> Charts:
    """The connected patches of faces of one label, and of one tile (T,) where these are given."""
    group = label
    if tile is not None:
        both = np.stack([label, tile])
        group = np.unique(both, axis=1, return_inverse=True)[1].reshape(-1).astype(np.int32)
    chart = connected_charts(face_neighbours(vertices, triangles)[0], group)
    views = np.empty(int(chart.max(initial=-1)) + 1, np.int32)
    views[chart] = label
    return Charts(label=label, chart=chart, views=views)


def face_neighbours(vertices: Array, triangles: Triangles) -> tuple[NDArray[np.int32], Array]:
    """The face over each side of every face, (T, 3), -1 at the outline; and the sides' lengths."""
    edges, edge = edges_of(triangles)
    one, other = twin_sides(edge)
    neighbours = np.full(triangles.size, -1, np.int32)
    neighbours[one], neighbours[other] = other // 3, one // 3
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    return neighbours.reshape(-1, 3), length[edge].reshape(-1, 3)


def connected_charts(neighbours: NDArray[np.int32], label: NDArray[np.int32]) -> NDArray[np.int32]:
    """(T,) number of the connected patch of equal label, in the order of their first faces."""
    face = np.repeat(np.arange(len(label)), 3)
    other = neighbours.reshape(-1)
    same = (other >= 0) & (label[face] == label[other])
    graph = coo_array(
        (np.ones(int(same.sum()), np.int8), (face[same], other[same])), (len(label), len(label))
    )
    chart: NDArray[np.int32] = connected_components(graph, directed=False)[1].astype(np.int32)
    return chart


@compiled
def smooth(
    label: NDArray[np.int32],
    views: NDArray[np.int32],
    cost: Array,
    neighbours: NDArray[np.int32],
    seam: Array,
    sweeps: int,
) -> None:
    """Give every face in turn the view of least cost, until nothing changes, in place.

    Args:
        label: (T,) changed.
        views: (T, K) candidates, -1 beyond the last.
        cost: (T, K) of them.
        neighbours: (T, 3) faces, -1 at the outline.
        seam: (T, 3) cost of a different view across a side.
        sweeps: at most.
    """
    for _ in range(sweeps):
        changed = 0
        for face in range(label.size):
            best, minimum = label[face], np.inf
            for k in range(views.shape[1]):
                if views[face, k] < 0:
                    break
                total = cost[face, k]
                for side in range(3):
                    other = neighbours[face, side]
                    if other >= 0 and label[other] != views[face, k]:
                        total += seam[face, side]
                if total < minimum:
                    best, minimum = views[face, k], total
            if best != label[face]:
                label[face] = best
                changed += 1
        if changed == 0:
            return


@compiled
def give_away(
    label: NDArray[np.int32],
    chart: NDArray[np.int32],
    size: NDArray[np.int64],
    views: NDArray[np.int32],
    neighbours: NDArray[np.int32],
    lengths: Array,
    small: int,
) -> int:
    """Give small patches the view with which they share most of their outline, in place.

    A view is taken only if it is a candidate of every face of the patch. Patches next to one that
    changed wait for the next call. Returns how many faces changed.
    """
    count = size.size
    start = np.zeros(count + 1, np.int64)
    for c in range(count):
        start[c + 1] = start[c] + size[c]
    fill = start[:count].copy()
    members = np.empty(label.size, np.int64)
    for face in range(label.size):
        members[fill[chart[face]]] = face
        fill[chart[face]] += 1
    frozen = np.zeros(count, np.bool_)
    changed = 0
    for c in range(count):
        if size[c] >= small or frozen[c] or label[members[start[c]]] < 0:
            continue
        mine = members[start[c] : start[c + 1]]
        best, longest = -1, 0.0
        tried = np.empty(0, np.int32)
        for i in range(mine.size):
            for side in range(3):
                other = neighbours[mine[i], side]
                if other < 0 or chart[other] == c or label[other] < 0:
                    continue
                if size[chart[other]] < size[c] or (tried == label[other]).any():
                    continue
                wanted = label[other]
                tried = np.append(tried, wanted)
                length = 0.0
                able = True
                for j in range(mine.size):
                    if not (views[mine[j]] == wanted).any():
                        able = False
                        break
                    for s in range(3):
                        near = neighbours[mine[j], s]
                        if near >= 0 and chart[near] != c and label[near] == wanted:
                            length += lengths[mine[j], s]
                if able and length > longest:
                    best, longest = wanted, length
        if best < 0:
            continue
        for i in range(mine.size):
            label[mine[i]] = best
            for side in range(3):
                other = neighbours[mine[i], side]
                if other >= 0:
                    frozen[chart[other]] = True
        changed += mine.size
    return changed
