"""Clean triangle meshes: every edge has one or two faces, every vertex one fan of them."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from alice_survey.core.frames import Array

Triangles = NDArray[np.int32]


def edges_of(triangles: Triangles) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Edges of a mesh.

    Returns:
        (E, 2) vertex numbers, the smaller first, in ascending order; and for each of the 3 T sides
        (side s of triangle t, from corner s to the next, is 3 t + s) the number of its edge.
    """
    key = _side_keys(triangles)
    order = np.argsort(key, kind="stable")
    starts = np.diff(key[order], prepend=-1) > 0
    edge = np.empty(len(key), np.int64)
    edge[order] = np.cumsum(starts) - 1
    return _ends(key[order][starts]), edge


def count_edges(triangles: Triangles) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Edges of a mesh as `edges_of` has them, and how many triangles are at each."""
    key = np.sort(_side_keys(triangles), kind="stable")
    first = np.flatnonzero(np.diff(key, prepend=-1))
    return _ends(key[first]), np.diff(first, append=len(key))


def _side_keys(triangles: Triangles) -> NDArray[np.int64]:
    """(3 T,) both ends of every side in one number; in nearly the order of the triangles'."""
    start = triangles.astype(np.int64)
    end = np.roll(start, -1, axis=1)
    return np.asarray(np.minimum(start, end) << 32 | np.maximum(start, end)).reshape(-1)


def _ends(key: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.stack([key >> 32, key & 0xFFFFFFFF], axis=1)


def twin_sides(edge: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Both sides of each edge that has exactly two, by the edge of every side."""
    order = np.argsort(edge, kind="stable")
    count = np.bincount(edge)
    first = (np.cumsum(count) - count)[count == 2]
    return order[first], order[first + 1]


def triangulate(vertices: Array, quads: NDArray[np.int32]) -> Triangles:
    """Quadrilaterals cut along their shorter diagonal."""
    corners = vertices[quads]
    first = np.linalg.norm(corners[:, 0] - corners[:, 2], axis=1)
    second = np.linalg.norm(corners[:, 1] - corners[:, 3], axis=1)
    turned = np.where((second < first)[:, None], np.roll(quads, -1, axis=1), quads)
    return np.ascontiguousarray(turned[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3))


def find_unfolded(vertices: Array, triangles: Triangles) -> NDArray[np.bool_]:
    """Triangles (T,) that have an area and are at no edge that more than two share."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    longest = np.maximum(np.maximum(_square(b - a), _square(c - b)), _square(a - c))
    sound = _square(normal) > (1e-6 * longest) ** 2
    sound &= np.ptp(np.sort(triangles, 1), axis=1) > 0
    edges, edge = edges_of(triangles[sound])
    crowded = np.bincount(edge, minlength=len(edges)) > 2
    sound[sound] = ~crowded[edge].reshape(-1, 3).any(axis=1)
    return np.asarray(sound)


def split_fans(vertices: Array, triangles: Triangles) -> tuple[Array, Triangles, NDArray[np.int64]]:
    """Give each fan of triangles around a vertex its own vertex; drop unused vertices.

    Returns:
        Vertices, triangles, and of which vertex each is a copy.
    """
    one, other = twin_sides(edges_of(triangles)[1])
    corner = np.arange(triangles.size)
    end = corner // 3 * 3 + (corner + 1) % 3
    flat = triangles.reshape(-1)
    # the two triangles of an edge join their corners at either end of it
    same = flat[one] == flat[other]
    rows = np.concatenate([one, end[one]])
    columns = np.concatenate([np.where(same, other, end[other]), np.where(same, end[other], other)])
    graph = coo_array((np.ones(len(rows), np.int8), (rows, columns)), (flat.size, flat.size))
    total, fan = connected_components(graph, directed=False)
    source = np.empty(total, np.int64)
    source[fan] = flat
    order = np.argsort(source, kind="stable")  # keep the order of the vertices
    place = np.empty(total, np.int32)
    place[order] = np.arange(total, dtype=np.int32)
    split: Triangles = np.asarray(place[fan], np.int32).reshape(-1, 3)
    return vertices[source[order]], split, source[order]


def component_areas(vertices: Array, triangles: Triangles) -> tuple[NDArray[np.int32], Array]:
    """Number of the connected part of every triangle (through edges), and the parts' areas."""
    edges, edge = edges_of(triangles)
    count = len(triangles)
    face = np.arange(3 * count) // 3
    graph = coo_array(
        (np.ones(3 * count, np.int8), (face, count + edge)),
        (count + len(edges), count + len(edges)),
    )
    total, part = connected_components(graph, directed=False)
    own = part[:count].astype(np.int32)
    area = np.bincount(own, weights=face_areas(vertices, triangles), minlength=total)
    areas: Array = np.asarray(area, dtype=np.float64)
    return own, areas


def face_areas(vertices: Array, triangles: Triangles) -> Array:
    """(T,) areas in squared units of length."""
    return np.asarray(0.5 * np.linalg.norm(_crosses(vertices, triangles), axis=1))


def face_normals(vertices: Array, triangles: Triangles) -> Array:
    """(T, 3) unit normals; 0 of a triangle without area."""
    return _unit(_crosses(vertices, triangles))


def vertex_normals(vertices: Array, triangles: Triangles) -> Array:
    """(V, 3) unit normals weighted by the area of the faces around."""
    normal = np.repeat(_crosses(vertices, triangles), 3, axis=0)
    around = [np.bincount(triangles.ravel(), normal[:, k], len(vertices)) for k in range(3)]
    return _unit(np.stack(around, axis=1))


def _crosses(vertices: Array, triangles: Triangles) -> Array:
    """(T, 3) cross products of two sides: along the normals, twice the areas long."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30))


def _square(vectors: Array) -> Array:
    return np.asarray((vectors * vectors).sum(axis=1))
