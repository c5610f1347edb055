"""The shape of the simulated sea floor: sand waves, mounds, ripples and half-buried rocks.

All shapes are sums of few separable terms, so that each is band-limited and a large grid is cheap.

The man-made object of the simulated sea floor: a wine amphora, lying half buried.

Its body is a surface of revolution about x from the foot (x = 0) to the rim, closed by the inside
of the neck; two handles in the plane of x and y join neck and shoulder.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter

from alice_survey.core.frames import Array

LENGTH_M = 0.6
BELLY_X_M = 0.34
"""Position along the axis of the greatest width."""

_PROFILE_M = np.array([
    [0.000, 0.000], [0.000, 0.017], [0.012, 0.025], [0.035, 0.028], [0.060, 0.026], [0.085, 0.034],
    [0.130, 0.064], [0.200, 0.101], [0.280, 0.125], [0.340, 0.130], [0.395, 0.124], [0.430, 0.108],
    [0.455, 0.084], [0.474, 0.060], [0.495, 0.047], [0.530, 0.043], [0.565, 0.043], [0.574, 0.052],
    [0.583, 0.057], [0.594, 0.057], [0.600, 0.052], [0.598, 0.043], [0.580, 0.036], [0.530, 0.034],
    [0.480, 0.034], [0.455, 0.022], [0.450, 0.000],
])  # fmt: skip
"""Outline as (distance along the axis, radius), from the foot over the rim into the neck."""

_HANDLE_M = np.array([
    [0.553, 0.036], [0.566, 0.062], [0.566, 0.086], [0.548, 0.106], [0.515, 0.113], [0.478, 0.110],
    [0.445, 0.100], [0.425, 0.088],
])  # fmt: skip
"""Centre line of a handle as (distance along the axis, distance from the axis)."""
_AROUND, _RINGS = 128, 160
"""Corners of a ring of the body, and rings."""
_HANDLE_HALF_WIDTH_M = 0.016
_HANDLE_HALF_DEPTH_M = 0.010


def amphora_mesh() -> tuple[Array, NDArray[np.int32]]:
    """The amphora in its own frame, metres.

    Returns:
        (V, 3) vertices and (T, 3) triangles, counter-clockwise seen from outside.
    """
    parts = [_revolve(_resample(_PROFILE_M, _RINGS), _AROUND)]
    line = _resample(_HANDLE_M, 48)
    parts += [_tube(np.column_stack([line[:, 0], side * line[:, 1]]), 24) for side in (1.0, -1.0)]
    first = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    triangles = np.concatenate([t + f for (_, t), f in zip(parts, first, strict=False)])
    return vertices, triangles.astype(np.int32)


def _resample(points: Array, count: int) -> Array:
    """Smooth (N, 2) points along their length into `count` points of even spacing."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    smooth: Array = PchipInterpolator(length, points)(np.linspace(0.0, length[-1], count))
    return smooth


def _revolve(profile: Array, around: int) -> tuple[Array, NDArray[np.int64]]:
    angle = 2.0 * np.pi * np.arange(around) / around
    x, radius = profile[:, :1], profile[:, 1:]
    rings = np.stack(
        [np.broadcast_to(x, (len(x), around)), radius * np.cos(angle), radius * np.sin(angle)], -1
    )
    return rings.reshape(-1, 3), _ring_triangles(len(profile), around)


def _tube(line: Array, around: int) -> tuple[Array, NDArray[np.int64]]:
    """An elliptic tube about a line in the plane of x and y; its ends lie inside the body."""
    forward = np.gradient(line, axis=0)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    zero = np.zeros(len(line))
    across = np.stack([-forward[:, 1], forward[:, 0], zero], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    angle = 2.0 * np.pi * np.arange(around) / around
    centre = np.stack([line[:, 0], line[:, 1], zero], axis=1)
    rings = (
        _HANDLE_HALF_DEPTH_M * np.cos(angle)[:, None] * across[:, None]
        + _HANDLE_HALF_WIDTH_M * np.sin(angle)[:, None] * up
    )
    rings[[0, -1]] = 0.0  # closed ends
    rings += centre[:, None]
    return rings.reshape(-1, 3), _ring_triangles(len(line), around)


def _ring_triangles(rings: int, around: int) -> NDArray[np.int64]:
    """Triangles between neighbouring rings of vertices that turn the same way about the line."""
    ring, corner = np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij")
    after = (corner + 1) % around
    a, b = ring * around + corner, ring * around + after
    c, d = a + around, b + around
    return np.stack([a, d, c, a, b, d], axis=-1).reshape(-1, 3)


_RIPPLE_LENGTH_M = 0.16
_RIPPLE_HEIGHT_M = 0.012
_MIN_ROCK_M = 0.07
_FILLET_M = 0.006
"""Approximate radius with which sand rounds the foot of a rock."""
_EDGE = 0.05
"""Radius, about, of a stone's edges in shares of its height."""


@dataclass(frozen=True, kw_only=True)
class Rock:
    """A rounded boulder that sticks out of the sand."""

    north_m: float
    east_m: float
    radius_m: float
    """Half its longest horizontal axis."""
    flattening: float
    """Second horizontal axis over the first."""
    height_m: float
    """Height from its widest level to its top."""
    buried: float
    """Share of the height that is under the sand."""
    heading_rad: float
    lumps: Array
    """(K, 4): wave numbers along both axes (rad per radius), phase, share of the radius."""
    faces: Array
    """(F, 3): planes that cut the stone: slopes along both axes, level in shares of the height."""


def ground_relief(
    north_m: Array, east_m: Array, relief_m: float, rng: np.random.Generator
) -> Array:
    """Heights of the sand, positive up, that span `relief_m` from lowest to highest.

    Args:
        north_m: (R,) grid lines.
        east_m: (C,) grid lines.
        relief_m: from the lowest to the highest point of the grid.
        rng: source of the shapes.

    Returns:
        (R, C) metres about a mean of zero.
    """
    wind_rad = rng.uniform(0.0, 2.0 * np.pi)
    waves = _cosines(north_m, east_m, 7, (3.0, 8.0), wind_rad, 0.45, rng)
    hummocks = _cosines(north_m, east_m, 24, (0.9, 2.5), wind_rad, math.pi, rng)
    mounds = _mounds(north_m, east_m, rng)
    shape = waves / waves.std() + 0.35 * hummocks / hummocks.std() + 1.1 * mounds
    ripples = _ripples(north_m, east_m, wind_rad, rng)
    ripple_height_m = min(_RIPPLE_HEIGHT_M, 0.1 * relief_m)
    grid_m = float(north_m[1] - north_m[0])
    if grid_m * 8.0 > _RIPPLE_LENGTH_M:  # a coarse grid cannot carry them
        ripple_height_m = 0.0
    heights = shape / np.ptp(shape) * relief_m + ripple_height_m * ripples
    heights *= relief_m / max(float(np.ptp(heights)), 1e-12)
    result: Array = heights - heights.mean()
    return result


def trough_share(sand: Array, grid_m: float) -> Array:
    """How much of a trough each point of the sand is, 0 to 1: where light, dark matter gathers.

    Args:
        sand: (R, C) heights, positive up.
        grid_m: spacing of the grid.
    """
    wide = _RIPPLE_LENGTH_M / 2.0 / grid_m
    hollow = gaussian_filter(sand, wide) - gaussian_filter(sand, wide / 4.0)
    share: Array = np.clip(hollow / (0.3 * _RIPPLE_HEIGHT_M), 0.0, 1.0)
    return share


def scatter_rocks(
    bounds_ne_m: tuple[float, float, float, float],
    rocks_per_m2: float,
    largest_m: float,
    keep_clear: Array,
    rng: np.random.Generator,
) -> list[Rock]:
    """Rocks at random places, many small ones for each large one.

    Args:
        bounds_ne_m: least and greatest north, least and greatest east.
        rocks_per_m2: mean number.
        largest_m: longest horizontal axis of the largest.
        keep_clear: (K, 3) north, east and radius of circles without rocks.
        rng: source of places and shapes.
    """
    south, north, west, east = bounds_ne_m
    count = rng.poisson(rocks_per_m2 * (north - south) * (east - west))
    smallest_m = min(_MIN_ROCK_M, 0.5 * largest_m)
    rocks = []
    for _ in range(count):
        place = rng.uniform((south, west), (north, east))
        # Inverse transform of a density that falls with the size to the power of -1.5.
        power = -0.5
        u = rng.uniform()
        size_m = (smallest_m**power + u * (largest_m**power - smallest_m**power)) ** (1 / power)
        wave_numbers = rng.normal(0.0, [[2.4, 2.4]] * 4 + [[6.0, 6.0]] * 6)
        phases = rng.uniform(0.0, 2.0 * np.pi, 10)
        sizes = np.r_[rng.uniform(0.03, 0.10, 4), rng.uniform(0.008, 0.03, 6)]
        faces = np.column_stack([rng.normal(0.0, 0.55, (7, 2)), rng.uniform(0.55, 1.05, 7)])
        rock = Rock(
            north_m=float(place[0]),
            east_m=float(place[1]),
            radius_m=size_m / 2,
            flattening=rng.uniform(0.6, 0.95),
            height_m=size_m / 2 * rng.uniform(0.45, 0.85),
            buried=rng.uniform(0.2, 0.55),
            heading_rad=rng.uniform(0.0, 2.0 * np.pi),
            lumps=np.column_stack([wave_numbers, phases, sizes]),
            faces=faces,
        )
        away = np.hypot(keep_clear[:, 0] - place[0], keep_clear[:, 1] - place[1])
        if np.all(away > keep_clear[:, 2] + rock.radius_m):
            rocks.append(rock)
    return rocks


def add_rocks(
    north_m: Array, east_m: Array, heights: Array, rocks: list[Rock]
) -> tuple[Array, Array]:
    """Add rocks to the sand.

    Args:
        north_m: (R,) grid lines.
        east_m: (C,) grid lines.
        heights: (R, C) heights of the sand, positive up.
        rocks: the rocks to add.

    Returns:
        New (R, C) heights, and the share of rock at each point, (R, C) from 0 to 1.
    """
    heights, share = heights.copy(), np.zeros_like(heights)
    for rock in rocks:
        reach = 1.5 * rock.radius_m
        rows = slice(*np.searchsorted(north_m, [rock.north_m - reach, rock.north_m + reach]))
        columns = slice(*np.searchsorted(east_m, [rock.east_m - reach, rock.east_m + reach]))
        if rows.start >= rows.stop or columns.start >= columns.stop:
            continue
        sand = heights[rows, columns]
        dome = sand.mean() + _dome(rock, north_m[rows, None], east_m[None, columns])
        # A smooth maximum: sand and stone meet in a fillet, not in a crease.
        above = (dome - sand) / _FILLET_M
        heights[rows, columns] = sand + _FILLET_M * np.logaddexp(0.0, above)
        stone = 1.0 / (1.0 + np.exp(-np.clip(above - 1.0, -30.0, 30.0)))
        share[rows, columns] = np.maximum(share[rows, columns], stone)
    return heights, share


def _dome(rock: Rock, north_m: Array, east_m: Array) -> Array:
    """Height of a rock's surface over the mean sand level around it, metres."""
    dn, de = (north_m - rock.north_m) / rock.radius_m, (east_m - rock.east_m) / rock.radius_m
    c, s = math.cos(rock.heading_rad), math.sin(rock.heading_rad)
    u, v = c * dn + s * de, (c * de - s * dn) / rock.flattening
    bumps = sum(a * np.cos(ku * u + kv * v + phase) for ku, kv, phase, a in rock.lumps)
    # Lumps move the outline too, so that no rock is an ellipse.
    r2 = (u * u + v * v) * (1.0 + 1.5 * bumps)
    inside = np.sqrt(np.maximum(1.0 - r2, 0.0))
    # Past the widest level the surface falls away, out of sight below the sand.
    profile = np.where(r2 < 1.0, inside, -np.minimum(3.0 * (r2 - 1.0), 3.0))
    cuts = [level + slope_u * u + slope_v * v for slope_u, slope_v, level in rock.faces]
    # A smooth minimum of dome and planes: faces with worn edges.
    stone = -_EDGE * np.logaddexp.reduce([-surface / _EDGE for surface in (profile, *cuts)])
    dome: Array = rock.height_m * (stone - rock.buried) + rock.radius_m * bumps * (r2 < 1.0)
    return dome


def _cosines(
    north_m: Array,
    east_m: Array,
    count: int,
    length_m: tuple[float, float],
    heading_rad: float,
    spread_rad: float,
    rng: np.random.Generator,
) -> Array:
    """A sum of plane waves of random length, heading and phase, on a grid; rms about 0.7 each."""
    length = np.exp(rng.uniform(math.log(length_m[0]), math.log(length_m[1]), count))
    heading = heading_rad + rng.uniform(-spread_rad, spread_rad, count)
    phase = rng.uniform(0.0, 2.0 * np.pi, count)
    along_north = np.outer(north_m, 2.0 * np.pi / length * np.cos(heading))
    along_east = np.outer(2.0 * np.pi / length * np.sin(heading), east_m) + phase[:, None]
    weight = (length / length.max())[:, None]
    total: Array = np.cos(along_north) @ (weight * np.cos(along_east))
    total -= np.sin(along_north) @ (weight * np.sin(along_east))
    return total


def _mounds(north_m: Array, east_m: Array, rng: np.random.Generator) -> Array:
    """Heaps and hollows of 0.4 to 0.9 m radius, heights of about one, one in 6 square metres."""
    extent = (float(np.ptp(north_m)), float(np.ptp(east_m)))
    count = 1 + rng.poisson(extent[0] * extent[1] / 6.0)
    centre = rng.uniform((north_m[0], east_m[0]), (north_m[-1], east_m[-1]), (count, 2))
    radius, height = rng.uniform(0.4, 0.9, count), rng.normal(0.35, 0.8, count)
    over_north = np.exp(-0.5 * ((north_m[:, None] - centre[:, 0]) / radius) ** 2)
    over_east = np.exp(-0.5 * ((east_m[:, None] - centre[:, 1]) / radius) ** 2)
    mounds: Array = (over_north * height) @ over_east.T
    return mounds


def _ripples(north_m: Array, east_m: Array, wind_rad: float, rng: np.random.Generator) -> Array:
    """Wave ripples with sharp crests that wander, fork and fade, from 0 to about 1."""
    trains = []
    for length_m, turn_rad in ((_RIPPLE_LENGTH_M, 0.22), (1.3 * _RIPPLE_LENGTH_M, -0.22)):
        heading = wind_rad + turn_rad + rng.uniform(-0.1, 0.1)
        along = np.add.outer(north_m * math.cos(heading), east_m * math.sin(heading))
        wander = _cosines(north_m, east_m, 24, (0.45, 2.0), 0.0, math.pi, rng)
        phase = 2.0 * np.pi * along / length_m + 1.2 * wander / wander.std()
        trains.append((0.5 + 0.5 * np.sin(phase + 0.35 * np.sin(phase))) ** 1.4)
    patches = _cosines(north_m, east_m, 12, (1.2, 4.0), 0.0, math.pi, rng)
    strength = 0.2 + 0.8 / (1.0 + np.exp(-2.5 * patches / patches.std()))
    which = _cosines(north_m, east_m, 16, (0.8, 3.0), 0.0, math.pi, rng)
    first = 1.0 / (1.0 + np.exp(-4.0 * which / which.std()))
    # Crests fork where one train of waves gives way to the other.
    ripples: Array = strength * (first * trains[0] + (1.0 - first) * trains[1])
    return ripples
