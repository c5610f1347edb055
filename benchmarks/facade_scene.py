"""A facade of boxes and columns: its surface in closed form, its mesh, and where cameras stand.

Coordinates: x along the facade, y into it, z up, metres; a visitor stands at negative y.
"""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.frames import Array

SIZE_PX = (1200, 800)
FOV_DEG = 62.0
TEXTURE_M, TEXTURE_PX = 8.192, 4096
"""Side of the texture, which repeats."""
_WIDTH_M, _HEIGHT_M, _DEEP_M = 8.0, 5.0, 0.3
_WINDOWS = [(x, z, 1.1, 1.3) for z in (0.8, 2.8) for x in (-3.2, 2.1)] + [(-0.6, 2.8, 1.2, 1.4)]
_DOOR = (-0.7, 0.0, 1.4, 2.1)
_SEED = 4


@dataclass(frozen=True, kw_only=True)
class Box:
    """A box along the axes."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def distance(self, points: Array) -> Array:
        """(N,) from points (N, 3), negative inside."""
        low, high = np.array(self.low), np.array(self.high)
        beyond = np.abs(points - 0.5 * (low + high)) - 0.5 * (high - low)
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
        return np.asarray(outside + np.minimum(beyond.max(axis=1), 0.0))


@dataclass(frozen=True, kw_only=True)
class Column:
    """An upright cylinder."""

    x: float
    y: float
    radius: float
    low: float
    high: float

    def distance(self, points: Array) -> Array:
        """(N,) from points (N, 3), negative inside."""
        across = np.hypot(points[:, 0] - self.x, points[:, 1] - self.y) - self.radius
        along = np.abs(points[:, 2] - 0.5 * (self.low + self.high)) - 0.5 * (self.high - self.low)
        beyond = np.stack([across, along], axis=1)
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
        return np.asarray(outside + np.minimum(beyond.max(axis=1), 0.0))


def boxes() -> list[Box]:
    """Wall around its openings, what stands out of it, and the ground."""
    half = 0.5 * _WIDTH_M
    openings = [*_WINDOWS, _DOOR]
    xs = sorted({-half, half, *(x for x, *_ in openings), *(x + w for x, _, w, _ in openings)})
    found = [Box(low=(-half, _DEEP_M, 0.0), high=(half, _DEEP_M + 0.5, _HEIGHT_M))]
    for left, right in pairwise(xs):
        middle = 0.5 * (left + right)
        holes = sorted((z, z + h) for x, z, w, h in openings if x < middle < x + w)
        edges = [0.0, *(edge for hole in holes for edge in hole), _HEIGHT_M]
        found += [
            Box(low=(left, 0.0, low), high=(right, _DEEP_M, high))
            for low, high in zip(edges[::2], edges[1::2], strict=True)
            if high > low
        ]
    found += [Box(low=(x - 0.1, -0.16, z - 0.12), high=(x + w + 0.1, 0.0, z))
              for x, z, w, _ in _WINDOWS]  # fmt: skip
    found += [
        Box(low=(-half, -0.4, 4.5), high=(half, 0.0, 4.75)),  # cornice
        Box(low=(-1.1, -0.9, 2.38), high=(1.1, 0.0, 2.55)),  # balcony
        Box(low=(-1.1, -0.7, 0.0), high=(1.1, 0.0, 0.17)),  # step
        Box(low=(-9.0, -9.0, -0.5), high=(9.0, 0.8, 0.0)),  # ground
    ]
    return found


COLUMNS = [Column(x=x, y=-0.1, radius=0.28, low=0.0, high=4.5) for x in (-1.5, 1.5)]


def distance(points: Array) -> Array:
    """(N,) of points (N, 3) from the surface, negative inside."""
    solids: list[Box | Column] = [*boxes(), *COLUMNS]
    return np.asarray(np.min([solid.distance(points) for solid in solids], axis=0))


def normals(points: Array) -> Array:
    """(N, 3) gradient of the distance, by central differences."""
    step = 1e-5 * np.eye(3)
    slope = np.stack([distance(points + s) - distance(points - s) for s in step], axis=1)
    unit: Array = slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)
    return unit


def reached(starts: Array, ends: Array) -> NDArray[np.bool_]:
    """Whether nothing stands between points (N, 3) and (N, 3), by sphere tracing (Hart 1996)."""
    way = ends - starts
    length = np.linalg.norm(way, axis=1)
    unit = way / length[:, None]
    gone = np.full(len(starts), 2e-3)
    for _ in range(200):
        open_still = gone < length
        if not open_still.any():
            break
        free = distance(starts[open_still] + gone[open_still, None] * unit[open_still])
        gone[open_still] += np.where(free < 5e-4, np.nan, np.maximum(free, 5e-4))
    return np.asarray(gone >= length)


def mesh() -> tuple[Array, NDArray[np.int64], Array]:
    """Corners (V, 3), triangles (T, 3) and texture coordinates (V, 2), faces apart."""
    corners: list[Array] = []
    triangles: list[NDArray[np.int64]] = []
    places: list[Array] = []
    for box in boxes():
        low, high = np.array(box.low), np.array(box.high)
        for axis in range(3):
            across = [k for k in range(3) if k != axis]
            for end in (low, high):
                square = np.tile(end, (4, 1))
                square[:, across[0]] = [low[across[0]], high[across[0]]] * 2
                square[:, across[1]] = [low[across[1]]] * 2 + [high[across[1]]] * 2
                triangles += [np.array([[0, 1, 3], [0, 3, 2]]) + 4 * len(corners)]
                corners.append(square)
                places.append(square[:, across] + 2.7 * axis * (axis != 1))
    flat = np.concatenate(corners)
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    for column in COLUMNS:
        ring = np.column_stack(
            [column.x + column.radius * np.sin(turn), column.y - column.radius * np.cos(turn)]
        )
        rows = [np.column_stack([ring, np.full(len(ring), z)]) for z in (column.low, column.high)]
        first, count = len(flat), len(turn)
        k = np.arange(count - 1) + first
        triangles += [np.column_stack([k, k + 1, k + 1 + count])]
        triangles += [np.column_stack([k, k + 1 + count, k + count])]
        flat = np.concatenate([flat, *rows])
        arc = column.radius * turn + column.x
        places += [np.column_stack([arc, np.full(count, z)]) for z in (column.low, column.high)]
    return flat, np.concatenate(triangles), np.concatenate(places) / TEXTURE_M


def texture() -> NDArray[np.uint8]:
    """Courses of stones with joints, each of its own shade, and grain of all sizes; (H, W, 3).

    Row 0 is the top, where the second texture coordinate is 1.
    """
    rng = np.random.default_rng(_SEED)
    n = TEXTURE_PX
    grain = np.zeros((n, n), np.float32)
    for cells in (16, 64, 256, 1024, 2048):
        layer = rng.standard_normal((cells, cells)).astype(np.float32)
        grain += 0.16 * cv2.resize(layer, (n, n), interpolation=cv2.INTER_CUBIC) * cells**-0.12
    shade = np.empty((n, n, 3), np.float32)
    top = 0
    while top < n:
        tall = int(rng.integers(90, 170))
        left = -int(rng.integers(0, 200))
        while left < n:
            wide = int(rng.integers(140, 340))
            colour = np.array([0.36, 0.45, 0.52]) * (1.0 + 0.22 * rng.standard_normal())
            shade[top : top + tall, max(left, 0) : left + wide] = np.clip(colour, 0.08, 0.8)
            shade[top : top + tall, max(left, 0) : max(left, 0) + 6] = 0.12
            left += wide
        shade[top : top + 6] = 0.12
        top += tall
    shown = np.clip(shade * np.exp(grain)[..., None], 0.02, 0.9)
    srgb = np.where(shown > 0.0031308, 1.055 * shown ** (1 / 2.4) - 0.055, 12.92 * shown)
    found: NDArray[np.uint8] = np.rint(255.0 * srgb).astype(np.uint8)
    return found


def cameras() -> list[dict[str, list[float]]]:
    """Eye, target and up of every picture: a walk along, from below and from above, and aslant."""
    rng = np.random.default_rng(_SEED + 1)
    found = []
    for eye_z, aim_z, out in ((1.6, 2.0, 5.0), (3.6, 2.6, 5.4)):
        row = np.linspace(-3.6, 3.6, 9).tolist()
        found += [((x, -out, eye_z), (0.75 * x, 0.0, aim_z)) for x in row]
    found += [((x, -3.9, 1.6), (0.35 * x, 0.0, 2.3)) for x in (-5.2, -4.4, 4.4, 5.2)]
    rows = []
    for eye, target in found:
        lean = rng.normal(0.0, 0.03, 3)
        rows.append({
            "eye": (np.array(eye) + rng.normal(0.0, 0.08, 3)).tolist(),
            "target": (np.array(target) + rng.normal(0.0, 0.08, 3)).tolist(),
            "up": [float(lean[0]), float(lean[1]), 1.0],
        })  # fmt: skip
    return rows
