"""Distances from the true harbour, in float64 from closed forms: no triangle and no renderer.

Positive in the water, negative in what is solid. Distances of boxes, cylinders and the ends of the
wall are exact (Quilez, "Distance functions", iquilezles.org); an ellipsoid's is the root of its
secular equation (Eberly, "Distance from a point to an ellipse, an ellipsoid, or a hyperellipsoid",
2013); stones and floor are searched for their nearest point.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from alice_survey.core.frames import Array
from benchmarks.harbour_scene import (
    FISH,
    FLOOR_M,
    LADDER,
    PARTS,
    SOLIDS,
    STEEPEST,
    WALL_EAST_M,
    WEEDS,
    Ellipsoid,
    RoundedBox,
    Solid,
    Upright,
    floor_depth,
    wall_north,
)

_PROUD_M, _HIGH_M = 0.035, 0.065
"""No stone comes farther out of the wall, no ripple higher above the floor's mean."""
_FAR_M = 0.15
"""Beyond, the nearest point of a height field is only found to the size of its relief."""
_ELLIPSOID_STEPS = 40
Heights = Callable[[Array, Array], Array]


def distances(points: Array) -> tuple[Array, NDArray[np.int64]]:
    """Signed distance from the nearest surface that does not move, and its place in `PARTS`.

    Args:
        points: (N, 3) NED, metres.
    """
    best = _field_distance(points, 2, floor_depth)
    part = np.zeros(len(points), np.int64)
    others = [(one.name, solid_distance(one, points)) for one in SOLIDS]
    others.append(("wall", _wall_distance(points)))
    for name, distance in others:
        nearer = distance < best
        best = np.where(nearer, distance, best)
        part[nearer] = PARTS.index(name)
    return best, part


def normals(points: Array) -> Array:
    """(N, 3) unit vectors into the water, of points on a surface or close to it."""
    step = 1e-5
    slope = np.stack(
        [clearance(points + step * axis) - clearance(points - step * axis) for axis in np.eye(3)],
        axis=-1,
    )
    unit: Array = slope / np.linalg.norm(slope, axis=1, keepdims=True)
    return unit


def clearance(points: Array) -> Array:
    """A distance that no surface is nearer than, (N,), quickly; its sign is that of `distances`."""
    north, east, depth = points.T
    found = (FLOOR_M - _HIGH_M) - depth
    near = found < 0.02
    found[near] = (floor_depth(north[near], east[near]) - depth[near]) / np.hypot(
        1.0, STEEPEST["floor"]
    )
    wall = np.maximum(-_PROUD_M - north, east - WALL_EAST_M[1])
    near = wall < 0.02
    face = (wall_north(east[near], depth[near]) - north[near]) / np.hypot(1.0, STEEPEST["wall"])
    wall[near] = np.maximum(face, east[near] - WALL_EAST_M[1])
    np.minimum(found, wall, out=found)
    low, high = _LADDER_BOX
    outside = np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0.0), axis=1)
    near = outside < 0.02
    ladder = np.where(near, np.inf, outside)
    for solid in SOLIDS:
        if solid in LADDER:
            if near.any():
                ladder[near] = np.minimum(ladder[near], solid_distance(solid, points[near]))
            continue
        middle, reach = _ball(solid)
        apart = np.linalg.norm(points - middle, axis=1) - reach
        close = apart < 0.05
        apart[close] = solid_distance(solid, points[close])
        np.minimum(found, apart, out=found)
    minimum: Array = np.minimum(found, ladder)
    return minimum


def solid_distance(solid: Solid, points: Array) -> Array:
    """Signed distance from a solid, (N,)."""
    match solid:
        case RoundedBox():
            inner = np.asarray(solid.half) - solid.radius_m
            q = np.abs(points - np.asarray(solid.centre)) - inner
            outside = np.linalg.norm(np.maximum(q, 0.0), axis=1)
            box: Array = outside + np.minimum(q.max(axis=1), 0.0) - solid.radius_m
            return box
        case Upright():
            upper, lower = solid.depths
            around = np.linalg.norm(points[:, :2] - solid.place_ne, axis=1) - solid.radius_m
            along = np.abs(points[:, 2] - (upper + lower) / 2) - (lower - upper) / 2
            outside = np.hypot(np.maximum(around, 0.0), np.maximum(along, 0.0))
            rod: Array = outside + np.minimum(np.maximum(around, along), 0.0)
            return rod
        case Ellipsoid():
            turn = Rotation.from_euler("Z", solid.heading_deg, degrees=True)
            local = turn.inv().apply(points - np.asarray(solid.centre))
            return _ellipsoid_distance(local, np.asarray(solid.semi_axes))


def _ellipsoid_distance(points: Array, semi_axes: Array) -> Array:
    """The nearest point is a_i^2 p_i / (t + a_i^2); its t by Newton's method from below the root.

    The function is convex and falls, so that steps from the left never go beyond.
    """
    squares = semi_axes**2
    scaled = semi_axes * np.abs(points)
    t = (scaled - squares).max(axis=1)
    for _ in range(_ELLIPSOID_STEPS):
        shares = scaled / np.maximum(t[:, None] + squares, 1e-12)
        value = (shares**2).sum(axis=1) - 1.0
        slope = -2.0 * (shares**2 / np.maximum(t[:, None] + squares, 1e-12)).sum(axis=1)
        step = value / np.minimum(slope, -1e-12)
        t -= step
        if np.all(np.abs(step) < 1e-15):
            break
    nearest = squares * points / np.maximum(t[:, None] + squares, 1e-12)
    distance: Array = np.sign(t) * np.linalg.norm(points - nearest, axis=1)
    return distance


def _wall_distance(points: Array) -> Array:
    """The wall ends in a plane in the east, and in a corner."""
    beyond = points[:, 1] - WALL_EAST_M[1]
    face = _field_distance(np.column_stack([
        points[:, 0], np.minimum(points[:, 1], WALL_EAST_M[1]), points[:, 2],
    ]), 0, wall_north)  # fmt: skip
    outside = np.hypot(np.maximum(face, 0.0), beyond)
    distance: Array = np.where(beyond > 0.0, outside, np.maximum(face, beyond))
    return distance


def _field_distance(points: Array, axis: int, heights: Heights) -> Array:
    """Signed distance from a surface whose coordinate `axis` is a function of the other two.

    The nearest point is within the distance along the axis: a grid over that disc, and finer grids
    about the best of it.
    """
    u, v = points[:, [a for a in range(3) if a != axis]].T
    along = heights(u, v) - points[:, axis]
    best_u, best_v, best = u.copy(), v.copy(), along**2
    away = np.abs(along)
    search = away > 1e-7
    reach = np.minimum(away, _FAR_M)
    for half, spread in ((4, 1.0), (2, 0.3), (2, 0.12), (2, 0.05), (2, 0.02), (2, 0.008)):
        from_u, from_v = best_u[search], best_v[search]
        steps = np.linspace(-1.0, 1.0, 2 * half + 1) * spread
        for du in steps:
            for dv in steps:
                at_u, at_v = from_u + du * reach[search], from_v + dv * reach[search]
                w = heights(at_u, at_v) - points[search, axis]
                trial = (at_u - u[search]) ** 2 + (at_v - v[search]) ** 2 + w**2
                better = trial < best[search]
                index = np.nonzero(search)[0][better]
                best[index], best_u[index], best_v[index] = (
                    trial[better],
                    at_u[better],
                    at_v[better],
                )
    distance: Array = np.sign(along) * np.sqrt(best)
    return distance


def moving_distance(points: Array, time_s: float) -> tuple[Array, Array]:
    """Distances from the nearest fish and from the nearest blade of weed at a time, each (N,).

    A blade counts as a rod of its half width.
    """
    fish = np.full(len(points), np.inf)
    for one in FISH:
        apart = points - one.place(time_s)
        near = np.linalg.norm(apart, axis=1) < 0.5
        local = one.turn(time_s).inv().apply(apart[near])
        fish[near] = np.minimum(fish[near], _ellipsoid_distance(local, np.array(one.semi_axes)))
    weed = np.full(len(points), np.inf)
    for blade in WEEDS:
        line = blade.line(np.linspace(0.0, 1.0, 33), time_s)
        near = np.linalg.norm(points - line[0], axis=1) < 1.0
        gap = np.linalg.norm(points[near, None] - line[None], axis=2).min(axis=1)
        weed[near] = np.minimum(weed[near], gap - blade.half_width_m)
    return fish, weed


def _ball(solid: Solid) -> tuple[Array, float]:
    """A ball around a solid."""
    match solid:
        case RoundedBox():
            return np.asarray(solid.centre), float(np.linalg.norm(solid.half))
        case Upright():
            half = (solid.depths[1] - solid.depths[0]) / 2
            middle = np.array([*solid.place_ne, sum(solid.depths) / 2])
            return middle, float(np.hypot(half, solid.radius_m))
        case Ellipsoid():
            return np.asarray(solid.centre), max(solid.semi_axes)


_LADDER_BOX = (np.array([-0.19, 0.57, 1.5]), np.array([-0.13, 1.03, 5.7]))
