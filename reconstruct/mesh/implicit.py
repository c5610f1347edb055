"""A surface through oriented points: an implicit function on a lattice, and its zero as a mesh.

The function is the weighted mean height over the tangent planes of the points around (implicit
moving least squares, Kolluri 2008, "Provably good moving least squares"). It depends on points
within a few lattice steps only, so that tiles that share a rim of points agree exactly where they
meet, and where there are no points there is no surface: holes stay holes. A global Poisson surface
would close them, and differs from tile to tile.

The zero set is meshed by dual cells (surface nets, Gibson 1998, "Constrained elastic surface
nets"): one vertex in every lattice cell that it crosses, one quadrilateral around every lattice
edge that it crosses.
"""

import math

import numpy as np
from numpy.typing import NDArray

from alice_survey.base.compiled import compiled
from alice_survey.base.frames import Array

KERNEL_STEPS = 0.8
"""Standard deviation of the points' Gaussian weight, lattice steps."""
REACH_STEPS = 2.5
"""Distance from a node at which points stop to count, lattice steps."""
_NEWTON_STEPS = 3


@compiled
def splat(
    points: Array,
    normals: Array,
    weights: Array,
    first: tuple[int, int, int],
    shape: tuple[int, int, int],
) -> NDArray[np.float64]:
    """The implicit function at the nodes of a block of the lattice.

    Args:
        points: (N, 3) in lattice steps from the lattice's origin.
        normals: (N, 3) unit vectors, out of the ground.
        weights: (N,) of the points.
        first: number of the block's first node along x, y, z.
        shape: nodes of the block.

    Returns:
        (X, Y, Z) in lattice steps, positive outside of the ground; NaN without a point in reach.
        A node's value does not depend on the block, if all points in its reach are there.
    """
    moment = np.zeros(shape)
    total = np.zeros(shape)
    for i in range(points.shape[0]):
        x0 = max(math.ceil(points[i, 0] - REACH_STEPS), first[0])
        x1 = min(math.floor(points[i, 0] + REACH_STEPS), first[0] + shape[0] - 1)
        y0 = max(math.ceil(points[i, 1] - REACH_STEPS), first[1])
        y1 = min(math.floor(points[i, 1] + REACH_STEPS), first[1] + shape[1] - 1)
        z0 = max(math.ceil(points[i, 2] - REACH_STEPS), first[2])
        z1 = min(math.floor(points[i, 2] + REACH_STEPS), first[2] + shape[2] - 1)
        for x in range(x0, x1 + 1):
            a = x - points[i, 0]
            for y in range(y0, y1 + 1):
                b = y - points[i, 1]
                for z in range(z0, z1 + 1):
                    c = z - points[i, 2]
                    square = a * a + b * b + c * c
                    if square > REACH_STEPS * REACH_STEPS:
                        continue
                    w = weights[i] * math.exp(-0.5 * square / (KERNEL_STEPS * KERNEL_STEPS))
                    over = a * normals[i, 0] + b * normals[i, 1] + c * normals[i, 2]
                    moment[x - first[0], y - first[1], z - first[2]] += w * over
                    total[x - first[0], y - first[1], z - first[2]] += w
    for x in range(shape[0]):
        for y in range(shape[1]):
            for z in range(shape[2]):
                if total[x, y, z] > 0.0:
                    moment[x, y, z] /= total[x, y, z]
                else:
                    moment[x, y, z] = np.nan
    return moment


@compiled
def zero_mesh(values: Array) -> tuple[Array, NDArray[np.int32], NDArray[np.int32]]:
    """Mesh the zero of a function on a lattice.

    Quadrilaterals around edges that start in the first cells along any axis are left to the block
    before, of which those cells are the last.

    Args:
        values: (X, Y, Z) at the nodes; NaN where unknown (such a cell holds no surface).

    Returns:
        Vertices, (V, 3) in steps from the block's first node; their cells, (V, 3); and
        quadrilaterals, (Q, 4), counter-clockwise seen from where the function is positive.
    """
    nx, ny, nz = values.shape
    number = np.full((max(nx - 1, 0), max(ny - 1, 0), max(nz - 1, 0)), -1, np.int32)
    count = 0
    for x in range(nx - 1):
        for y in range(ny - 1):
            for z in range(nz - 1):
                below = 0
                known = True
                for corner in range(8):
                    v = values[x + (corner & 1), y + ((corner >> 1) & 1), z + (corner >> 2)]
                    if math.isnan(v):
                        known = False
                        break
                    if v < 0.0:
                        below += 1
                if known and 0 < below < 8:
                    number[x, y, z] = count
                    count += 1
    vertices = np.empty((count, 3))
    cells = np.empty((count, 3), np.int32)
    for x in range(nx - 1):
        for y in range(ny - 1):
            for z in range(nz - 1):
                if number[x, y, z] >= 0:
                    n = number[x, y, z]
                    cells[n, 0], cells[n, 1], cells[n, 2] = x, y, z
                    _place(values[x : x + 2, y : y + 2, z : z + 2], vertices[n])
                    vertices[n, 0] += x
                    vertices[n, 1] += y
                    vertices[n, 2] += z
    quads = np.empty((3 * count, 4), np.int32)
    made = 0
    around = np.empty(4, np.int32)
    step = np.zeros(3, np.int64)
    for n in range(count):
        x, y, z = cells[n, 0], cells[n, 1], cells[n, 2]
        if x == 0 or y == 0 or z == 0:
            continue
        for axis in range(3):
            # the lattice edge from this cell's first node along the axis
            step[:] = 0
            step[axis] = 1
            b, c = (axis + 1) % 3, (axis + 2) % 3
            start, end = values[x, y, z], values[x + step[0], y + step[1], z + step[2]]
            if (start < 0.0) == (end < 0.0):
                continue
            for k in range(4):
                i = cells[n].copy()
                if k == 1 or k == 2:
                    i[b] -= 1
                if k >= 2:
                    i[c] -= 1
                around[k] = number[i[0], i[1], i[2]]
            if around.min() < 0:
                continue
            for k in range(4):
                quads[made, k] = around[k] if start < 0.0 else around[3 - k]
            made += 1
    return vertices, cells, quads[:made].copy()


@compiled
def _place(corner: Array, out: Array) -> None:
    """The vertex of one cell: the mean crossing of its edges, moved onto the zero within the cell.

    Args:
        corner: (2, 2, 2) values.
        out: (3,) filled, 0 to 1 in the cell.
    """
    out[:] = 0.0
    crossings = 0
    for axis in range(3):
        for k in range(4):
            i, j = k & 1, k >> 1
            if axis == 0:
                a, b = corner[0, i, j], corner[1, i, j]
            elif axis == 1:
                a, b = corner[j, 0, i], corner[j, 1, i]
            else:
                a, b = corner[i, j, 0], corner[i, j, 1]
            if (a < 0.0) == (b < 0.0):
                continue
            t = a / (a - b)
            crossings += 1
            out[axis] += t
            if axis == 0:
                out[1] += i
                out[2] += j
            elif axis == 1:
                out[2] += i
                out[0] += j
            else:
                out[0] += i
                out[1] += j
    for axis in range(3):
        out[axis] /= crossings
    for _ in range(_NEWTON_STEPS):
        u, v, w = out[0], out[1], out[2]
        f, gx, gy, gz = 0.0, 0.0, 0.0, 0.0
        for i in range(2):
            p, dp = (u, 1.0) if i else (1.0 - u, -1.0)
            for j in range(2):
                q, dq = (v, 1.0) if j else (1.0 - v, -1.0)
                for k in range(2):
                    r, dr = (w, 1.0) if k else (1.0 - w, -1.0)
                    f += corner[i, j, k] * p * q * r
                    gx += corner[i, j, k] * dp * q * r
                    gy += corner[i, j, k] * p * dq * r
                    gz += corner[i, j, k] * p * q * dr
        square = gx * gx + gy * gy + gz * gz
        if square < 1e-6:
            return
        out[0] = min(max(u - f * gx / square, 0.0), 1.0)
        out[1] = min(max(v - f * gy / square, 0.0), 1.0)
        out[2] = min(max(w - f * gz / square, 0.0), 1.0)
