"""The man-made object of the simulated sea floor: a wine amphora, lying half buried.

Its body is a surface of revolution about x from the foot (x = 0) to the rim, closed by the inside
of the neck; two handles in the plane of x and y join neck and shoulder.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

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
