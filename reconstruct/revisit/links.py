"""How firmly the stations of a survey hang together, counted in tracks.

A track that `k` stations see is cut where some of them are taken from the others. It stands here
as links between all pairs of them, of 1 / (k - 1) each, so that to take one station off it costs
one track, and to halve it more. What links a group of stations to the others is a cut of that
graph; stations are in one piece where no cut between them is below a given number of tracks.
"""

from typing import Any

import numpy as np
import scipy.sparse as sp
import shapely
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components, maximum_flow

from camera_calib.rig import Rig
from missions.coverage.raster import border_rays_body, footprints_ne
from missions.coverage.stations import Stations

Indices = NDArray[np.int64]
_CAPACITY = 64
"""Units of flow in a track: scipy's capacities are whole numbers."""


def footprints(rig: Rig, stations: Stations) -> NDArray[Any]:
    """What any camera shows at each station, (S,) shapes; x = north, y = east, metres."""
    borders = footprints_ne(
        *border_rays_body(rig), stations.glass_ne, stations.altitude_m, stations.attitude_rad
    )
    blind = np.asarray(~np.isfinite(borders).all(axis=(2, 3)))
    shapes = np.asarray(shapely.polygons(np.where(blind[..., None, None], 0.0, borders)))
    shapes[blind] = shapely.Polygon()
    return np.asarray(shapely.union_all(np.asarray(shapely.make_valid(shapes)), axis=1))


def views_of_floor(shapes: NDArray[Any], step_m: float) -> sp.csr_array:
    """Which stations, (S, P), show each point of a lattice over the sea floor.

    Args:
        shapes: (S,) from `footprints`.
        step_m: of the lattice.
    """
    low, high = np.array(shapely.total_bounds(shapes)).reshape(2, 2)
    north, east = (np.arange(a, b + step_m, step_m) for a, b in zip(low, high, strict=True))
    places = np.stack(np.meshgrid(north, east), axis=-1).reshape(-1, 2)
    tree = shapely.STRtree(np.asarray(shapely.points(places)))
    station, point = tree.query(shapes, predicate="intersects")
    return sp.csr_array((np.ones(len(station)), (station, point)), shape=(len(shapes), len(places)))


def links(views: sp.csr_array) -> sp.csr_array:
    """Tracks that link stations to each other, (S, S), symmetric.

    Args:
        views: (S, P) which stations see each track: nothing but zero and one.
    """
    lengths = views.sum(axis=0)
    shared = views[:, lengths > 1]
    found = (shared / (lengths[lengths > 1] - 1.0)[None, :]).tocsr() @ shared.T
    found.setdiag(0.0)
    found.eliminate_zeros()
    return sp.csr_array(found)


def pieces(linked: sp.csr_array, minimum: float) -> Indices:
    """The piece of each station, (S,), counted from the largest.

    Stations are in one piece where every cut between them takes `minimum` tracks or more.
    A link of that many decides by itself; of what these leave, greatest flows decide, and each
    pair that is found to be in one piece becomes one node, which changes no lesser cut.
    """
    piece, nodes, first = np.arange(linked.shape[0]), linked, 0
    while first < nodes.shape[0]:
        heavy = nodes.multiply(nodes >= minimum)
        label = _by_first(connected_components(heavy, directed=False)[1])
        piece, nodes = label[piece], _merge(nodes, label)
        other = _firmly_linked(nodes, first, minimum)
        if other is None:  # nodes before `first` stand apart from all others, and keep their place
            first += 1
        else:
            label = np.arange(nodes.shape[0])
            label[other] = first
            label = _by_first(label)
            piece, nodes = label[piece], _merge(nodes, label)
    sizes = np.bincount(piece)
    rank = np.empty(len(sizes), np.int64)
    rank[np.argsort(-sizes, kind="stable")] = np.arange(len(sizes))
    return rank[piece]


def cut_around(linked: sp.csr_array, group: NDArray[np.bool_]) -> float:
    """Tracks that link a group of stations to all others."""
    return float(linked[group][:, ~group].sum())


def _firmly_linked(nodes: sp.csr_array, first: int, minimum: float) -> int | None:
    """A node after the first between which and it no cut is below `minimum`."""
    whole = sp.csr_array((nodes * _CAPACITY).astype(np.int32))
    degree = nodes.sum(axis=0)
    for other in range(first + 1, nodes.shape[0]):
        if (
            min(degree[first], degree[other]) >= minimum
            and maximum_flow(whole, first, other).flow_value >= minimum * _CAPACITY
        ):
            return other
    return None


def _by_first(label: NDArray[Any]) -> Indices:
    """The same groups, numbered in the order of their first members."""
    _, first, of = np.unique(label, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.asarray(rank[of])


def _merge(nodes: sp.csr_array, label: Indices) -> sp.csr_array:
    count = int(label.max(initial=-1)) + 1
    gather = sp.csr_array((np.ones(len(label)), (label, np.arange(len(label)))),
                          shape=(count, len(label)))  # fmt: skip
    found = (gather @ nodes @ gather.T).tolil()
    found.setdiag(0.0)
    return sp.csr_array(found)
