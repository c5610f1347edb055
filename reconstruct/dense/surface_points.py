"""Points of many views fused into points of one oriented surface in space.

A surface is a function of two coordinates along whichever of the six directions of the axes its
normal is nearest to: floors over east and north, walls over the other pairs, ceilings from below.
In each direction points are put into cells of the two other axes, moved along the surface to the
middle of their cell, told apart where several surfaces lie behind each other, and fused robustly.
What becomes of a cell depends on points in it alone, so that tiles agree where they meet.

What a single cell cannot show, its neighbours do. A wrong match makes a small patch apart from any
surface; where a surface turns or ends within a cell, its neighbours contradict it beyond noise.

A cell may hold several surfaces: an overhang above the floor, a ladder before a wall. The height of
each is a robust mean of what several views of several stations claim.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from alice_survey.core.block_solver import MAD_TO_SIGMA
from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from reconstruct.dense.points import Points

Float32 = NDArray[np.float32]

_APART_SIGMAS = 5.0
"""Noise in a gap between heights, in standard deviations of the points on its two sides."""
_DIAGONAL = math.sqrt(2.0)
_MIN_POINTS = 3


@compiled
def sorted_ranks(values: NDArray[Any]) -> NDArray[np.int64]:
    """Indices that sort values upwards (Shell's sort, which numba compiles in no time).

    The order of equal values depends on the values alone, not on the machine.
    """
    count = values.size
    ranks = np.arange(count)
    gap = 1
    while gap < count:
        gap = 3 * gap + 1
    while gap > 1:
        gap //= 3
        for i in range(gap, count):
            moved = ranks[i]
            j = i
            while j >= gap and values[ranks[j - gap]] > values[moved]:
                ranks[j] = ranks[j - gap]
                j -= gap
            ranks[j] = moved
    return ranks


@compiled
def surfaces_of(
    heights: Float32, sigmas: Float32, places: NDArray[np.int64], steepness: Float32, cell: float
) -> tuple[int, NDArray[np.int64]]:
    """Which surface each point of a cell lies on.

    Sorted heights fall apart where a gap is wider than noise and a continuous surface explain: five
    standard deviations, and a cell's side, or the height that the surface's own slope gains over a
    cell's diagonal. A surface is what three points from two stations or more show. Where fewer than
    two are shown, all points are of one.

    Args:
        heights: (N,).
        sigmas: (N,) of the heights.
        places: (N,) stations.
        steepness: (N,) tangent of the angle between normal and vertical; NaN where unknown.
        cell: side of the cell.

    Returns:
        How many surfaces there are, and (N,) the surface of each point, 0 the uppermost; -1 of
        points between several surfaces and on none of them.
    """
    count = heights.size
    surface = np.zeros(count, np.int64)
    low, high = heights[0], heights[0]
    for height in heights:
        low, high = min(low, height), max(high, height)
    if high - low <= cell:
        return 1, surface
    ranks = sorted_ranks(heights)
    starts = np.empty(count + 1, np.int64)  # of parts, in the order of heights
    starts[0], parts = 0, 1
    for i in range(1, count):
        below, above = ranks[i - 1], ranks[i]
        noise = _APART_SIGMAS * math.hypot(sigmas[below], sigmas[above])
        if heights[above] - heights[below] > cell + noise:
            starts[parts] = i
            parts += 1
    starts[parts] = count
    if parts == 1:
        return 1, surface
    slopes = np.full(parts, np.nan)  # the median of those known, the upper one of two
    for part in range(parts):
        known = steepness[ranks[starts[part] : starts[part + 1]]]
        known = known[~np.isnan(known)]
        if known.size > 0:
            slopes[part] = known[sorted_ranks(known)[known.size // 2]]
    kept = 1  # parts after those that a slope joins, whose starts move to the front
    for part in range(1, parts):
        below, above = ranks[starts[part] - 1], ranks[starts[part]]
        noise = _APART_SIGMAS * math.hypot(sigmas[below], sigmas[above])
        steep = np.nan
        for side in (slopes[part - 1], slopes[part]):
            if math.isnan(steep) or side > steep:
                steep = side
        # where no normal is known nothing tells a step from a steep slope
        if heights[above] - heights[below] > noise + _DIAGONAL * cell * steep:
            starts[kept] = starts[part]
            kept += 1
    starts[kept] = count
    found = 0
    surface[:] = -1
    for part in range(kept - 1, -1, -1):
        members = ranks[starts[part] : starts[part + 1]]
        alone = places[members] == places[members[0]]  # what one station sees may be a wrong match
        if members.size < _MIN_POINTS or alone.all():
            continue
        for member in members:
            surface[member] = found
        found += 1
    if found < 2:
        surface[:] = 0
        return 1, surface
    return found, surface


@compiled
def robust_height(
    heights: Float32, sigmas: Float32, views: NDArray[np.int32], stations: NDArray[np.int64],
    gate: float, shared: float,
) -> tuple[float, float, int, int]:  # fmt: skip
    """Robust height of some points: the weighted mean of what lies near the median.

    The gate around the median is `gate` times the larger of the scatter (from the MAD) and the
    median's own sigma. The standard deviation adds the formal one to the scatter over the square
    root of the number of views: pixels of one view share their errors, and so do views of which
    one was refined by the other. Views of a single station count as one.

    Args:
        heights: (N,) sorted by view, one or more.
        sigmas: (N,) of the heights.
        views: (N,) of the heights.
        stations: (V,) of every view, by its number.
        gate: in standard deviations.
        shared: views whose depths rest on the same pair of pictures, in the mean, 1 to 2.

    Returns:
        Height and sigma, and number of views and of stations used (255 stands for more).
    """
    order = sorted_ranks(heights)
    half = 0.0
    for i in range(heights.size):
        half += 0.5 / sigmas[i] ** 2
    rank, below = 0, 1.0 / sigmas[order[0]] ** 2
    while below < half and rank < heights.size - 1:
        rank += 1
        below += 1.0 / sigmas[order[rank]] ** 2
    median_at = order[rank]
    median = heights[median_at]
    low, high, middle, before = rank, rank + 1, 0.0, 0.0  # residuals rise both ways from it
    for _ in range(heights.size // 2 + 1):
        before = middle
        upper = np.inf if high == heights.size else heights[order[high]] - median
        if low >= 0 and median - heights[order[low]] <= upper:
            middle = median - heights[order[low]]
            low -= 1
        else:
            middle = upper
            high += 1
    scatter = MAD_TO_SIGMA * middle
    if heights.size % 2 == 0:
        scatter = 0.5 * (scatter + MAD_TO_SIGMA * before)
    reach = gate * max(scatter, sigmas[median_at])
    total, weights, squares = 0.0, 0.0, 0.0
    formal, in_view, view_weight, seen, last_view = 0.0, 0, 0.0, 0, -1
    places, companions = np.empty(heights.size, np.int64), 0
    for i in range(heights.size):
        if abs(heights[i] - median) > reach:
            continue
        w = 1.0 / sigmas[i] ** 2
        total += w * (heights[i] - median)
        squares += w * (heights[i] - median) ** 2
        weights += w
        if views[i] != last_view:
            if in_view > 0:
                formal += view_weight / in_view
            last_view, in_view, view_weight = views[i], 0, 0.0
            seen += 1
            place, known = stations[last_view], False
            for k in range(companions):
                known = known or places[k] == place
            if not known:
                places[companions] = place
                companions += 1
        in_view += 1
        view_weight += w
    formal += view_weight / in_view
    if companions == 1:
        formal /= seen  # one pair of pictures, however often looked at
    elif seen > 1:
        formal /= shared
    mean = total / weights
    variance = max(squares / weights - mean * mean, 0.0)
    return median + mean, math.sqrt(1.0 / formal + variance / seen), seen, min(companions, 255)


SURFACE_POINT = np.dtype(
    [
        ("enu", "<f4", 3),
        ("normal", "<f4", 3),
        ("colour", "u1", 3),
        ("sigma", "<f4"),
        ("shared", "<f4"),
        ("views", "<u2"),
        ("stations", "u1"),
    ]
)
"""One point: east, north, up; unit normal into the water; RGB; standard deviations along it, the
point's own and what all points around share; views and stations that it rests on (255: or more)."""
_FUSED = ("enu", "normal", "colour", "sigma", "views", "stations")
_MIN_ALONG = 0.4
"""Least part of a point's normal along a direction for it to be fused there."""
_GATE = 3.0
PART_REACH_CELLS = 16.0
"""Around a tile, points must be known so far to tell what is part of a surface."""
_NEIGHBOUR_CELLS = 2.0
_MIN_PART = 300
"""Points of a part of the surface; smaller ones are mostly wrong."""
_RIM_REACH_CELLS = 3.0
"""Within this many cells of a rim a point may be of no surface: what a window of matching spans."""
_MIN_ASIDE = 0.25
"""Cells by which the neighbours of a point within a surface lie to one side by chance."""
_STEP_CELLS = 1.0
"""Points farther than this from each other's tangent planes do not hang together."""
_MIN_TURN = 0.3
"""Nor do those whose normals have a smaller cosine between them."""
_SAME_SIDE = -0.2
"""Cosine between the normals of neighbours from which they are no two sides of one thing."""


def fuse_surface(
    points: Points, stations: NDArray[np.int64], cell: float, origin: Array, shared: float
) -> NDArray[Any]:
    """Fuse points into one for each cell of a surface.

    Args:
        points: of all views that see some part of space; those without a normal are left out.
        stations: (V,) of every view, by its number.
        cell: side of a cell.
        origin: (3,) from which cells start at whole multiples of their side.
        shared: views whose depths rest on the same pair of pictures, in the mean, 1 to 2.

    Returns:
        (M,) records of `SURFACE_POINT`.
    """
    return np.concatenate(
        [
            _fuse_along(points, stations, cell, origin, shared, axis, sign)
            for axis in (2, 0, 1)
            for sign in (1.0, -1.0)
        ]
    )


def _fuse_along(
    points: Points, stations: NDArray[np.int64], cell: float, origin: Array, shared: float,
    axis: int, sign: float,
) -> NDArray[Any]:  # fmt: skip
    across = [k for k in range(3) if k != axis]
    order = np.flatnonzero(sign * points.normals[:, axis] >= _MIN_ALONG)
    if not len(order):
        return np.empty(0, SURFACE_POINT)
    at = [np.floor((points.enu[order, k] - origin[k]) / cell).astype(np.int64) for k in across]
    low, high = np.min(at, axis=1), np.max(at, axis=1)
    rows, columns = (high - low + 1).tolist()
    entries = (at[0] - low[0]) * columns + at[1] - low[1], np.arange(len(order))
    by_cell = csr_array((np.ones(len(order), np.int8), entries), (rows * columns, len(order)))
    filled = np.flatnonzero(np.diff(by_cell.indptr))
    starts, order = np.append(by_cell.indptr[filled], len(order)), order[by_cell.indices]
    cells = np.stack([filled // columns, filled % columns], axis=1) + low
    found = fuse_cells(
        starts, origin[across] + (cells + 0.5) * cell, points, order, stations, cell,
        (across[0], across[1], axis), sign, _GATE, shared,
    )  # fmt: skip
    records = np.zeros(len(found[0]), SURFACE_POINT)
    for name, values in zip(_FUSED, found, strict=True):
        records[name] = values
    return records


@compiled
def fuse_cells(
    starts: NDArray[np.int64],
    middles: Array,
    points: Points,
    order: NDArray[np.int64],
    stations: NDArray[np.int64],
    cell: float,
    axes: tuple[int, int, int],
    sign: float,
    gate: float,
    shared: float,
) -> tuple[Float32, Float32, NDArray[np.uint8], Float32, NDArray[np.uint16], NDArray[np.uint8]]:
    """Fuse the points of cells that lie across one direction.

    A surface whose normal is nearer to another direction is left to that.

    Args:
        starts: (C + 1,) where the points of each cell start.
        middles: (C, 2) of the cells.
        points: in ascending order of their views.
        order: numbers of points by cell, then by view.
        stations: (V,) of every view, by its number.
        cell: side of a cell.
        axes: the two axes of the cells, and that of the direction.
        sign: 1 or -1, of the direction along its axis.
        gate: in standard deviations.
        shared: views whose depths rest on the same pair of pictures, in the mean, 1 to 2.

    Returns:
        Columns of `SURFACE_POINT` without what points share.
    """
    enu, normals, colours, sigmas, views = points
    maximum, count = order.size, 0
    place, normal = np.empty((maximum, 3), np.float32), np.empty((maximum, 3), np.float32)
    colour = np.empty((maximum, 3), np.uint8)
    sigma = np.empty(maximum, np.float32)
    seen, met = np.empty(maximum, np.uint16), np.empty(maximum, np.uint8)
    a, b, along = axes
    middle, mean, tint = np.empty(3), np.empty(3), np.empty(3)
    for n in range(starts.size - 1):
        own = order[starts[n] : starts[n + 1]]
        size = own.size
        middle[a], middle[b] = middles[n, 0], middles[n, 1]
        heights = np.empty(size, np.float32)
        spreads = np.empty(size, np.float32)
        steep = np.empty(size, np.float32)
        for i in range(size):
            j = own[i]
            up = sign * normals[j, along]
            lift = (enu[j, a] - middle[a]) * normals[j, a]
            lift += (enu[j, b] - middle[b]) * normals[j, b]
            heights[i] = sign * enu[j, along] + lift / up
            spreads[i] = sigmas[j] / up
            steep[i] = math.sqrt(max(1.0 - up * up, 0.0)) / up
        numbers = views[own]
        layers, layer = surfaces_of(heights, spreads, stations[numbers], steep, cell)
        for one in range(layers):
            mean[:] = 0.0
            tint[:] = 0.0
            weights = 0.0
            for i in range(size):
                if layer[i] == one:
                    j = own[i]
                    w = 1.0 / sigmas[j] ** 2
                    weights += w
                    for k in range(3):
                        mean[k] += w * normals[j, k]
                        tint[k] += w * colours[j, k]
            length = math.sqrt(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2)
            mean /= max(length, 1e-30)
            up = sign * mean[along]
            if up < abs(mean[a]) or up < abs(mean[b]):
                continue
            for i in range(size):
                j = own[i]
                lift = (enu[j, a] - middle[a]) * mean[a]
                lift += (enu[j, b] - middle[b]) * mean[b]
                heights[i] = sign * enu[j, along] + lift / up
            members = layer == one
            height, deviation, in_views, at_stations = robust_height(
                heights[members], spreads[members], numbers[members], stations, gate, shared
            )
            middle[along] = sign * height
            for k in range(3):
                place[count, k] = middle[k]
                normal[count, k] = mean[k]
                colour[count, k] = int(tint[k] / weights + 0.5)
            sigma[count] = deviation * up
            seen[count], met[count] = in_views, at_stations
            count += 1
    return (
        place[:count], normal[:count], colour[:count], sigma[:count], seen[:count], met[:count]
    )  # fmt: skip


def settle(surface: NDArray[Any], cell: float, low: Array, high: Array) -> NDArray[Any]:
    """Leave out small parts of a surface, and raise sigmas at rims and where neighbours contradict.

    The squared distance of neighbours from a point's tangent plane, beyond the variance of both,
    is taken for the sum of two equal variances, the point's own and theirs. At a rim matching may
    have carried the surface on by a window: a point is as unsure as its neighbours lie to one side.

    Args:
        surface: records of `SURFACE_POINT` of one tile and `PART_REACH_CELLS` around it.
        cell: side of a cell.
        low: (2,) west and south of all that is known; a part that comes near is taken to go on.
        high: (2,) east and north of it.
    """
    if not len(surface):
        return surface
    place = surface["enu"].astype(np.float64) / cell
    normal = surface["normal"].astype(np.float64)
    variance = np.square(surface["sigma"].astype(np.float64) / cell)
    count = len(surface)
    tree = cKDTree(place)
    aside = _aside(tree, place, normal)
    i, j = tree.query_pairs(_NEIGHBOUR_CELLS, output_type="ndarray").T
    apart = place[j] - place[i]
    from_i, from_j = (np.einsum("nk,nk->n", apart, normal[k]) for k in (i, j))
    turn = np.einsum("nk,nk->n", normal[i], normal[j])

    joined = (np.abs(from_i) < _STEP_CELLS) & (np.abs(from_j) < _STEP_CELLS)
    joined &= turn > _MIN_TURN
    links = coo_matrix((np.ones(joined.sum(), np.int8), (i[joined], j[joined])), (count, count))
    part = connected_components(links, directed=False)[1]
    near = (place[:, :2] < low / cell + _NEIGHBOUR_CELLS).any(axis=1)
    near |= (place[:, :2] > high / cell - _NEIGHBOUR_CELLS).any(axis=1)
    large = np.bincount(part) >= _MIN_PART
    large[part[near]] = True

    mean = normal / variance[:, None]
    for one, other in ((i[joined], j[joined]), (j[joined], i[joined])):
        for k in range(3):
            mean[:, k] += np.bincount(one, normal[other, k] / variance[other], count)
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    same = turn > _SAME_SIDE
    i, j = i[same], j[same]
    both = variance[i] + variance[j]
    beyond = np.bincount(i, from_i[same] ** 2 - both, count)
    beyond += np.bincount(j, from_j[same] ** 2 - both, count)
    neighbours = np.bincount(i, minlength=count) + np.bincount(j, minlength=count)
    excess = 0.5 * np.maximum(beyond / np.maximum(neighbours, 1), 0.0)
    found = surface.copy()
    found["sigma"] = cell * np.sqrt(variance + excess + np.square(aside))
    found["normal"] = mean
    return found[large[part]]


def _aside(tree: cKDTree, place: Array, normal: Array) -> Array:
    """(N,) how far the middle of each point's neighbours lies to one side of it, in cells.

    Args:
        tree: of the places.
        place: (N, 3) in cells.
        normal: (N, 3) unit vectors.
    """
    i, j = tree.query_pairs(_RIM_REACH_CELLS, output_type="ndarray").T
    same = np.einsum("nk,nk->n", normal[i], normal[j]) > _MIN_TURN
    i, j = i[same], j[same]
    apart = place[j] - place[i]
    count = len(place)
    near = np.bincount(i, minlength=count) + np.bincount(j, minlength=count) + 1
    middle = np.array([np.bincount(i, a, count) - np.bincount(j, a, count) for a in apart.T]).T
    away = np.linalg.norm(middle, axis=1) / near
    return np.asarray(np.maximum(away - _MIN_ASIDE, 0.0))
