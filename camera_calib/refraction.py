"""Kernels of the flat port: pixel to ray, point to pixel, and the slopes of point to pixel.

A camera comes as three values: `lens`, (16,) fx fy cx cy and the distortion coefficients; `port`,
(7,) air gap, glass thickness, n_glass, n_water and the unit normal; and the fold of its distortion.
Rows without a solution are NaN. Frames and units are those of `flat_port`.
"""

import math

import numpy as np
from numba import njit

from alice_survey.frames import Array
from camera_calib.lens import distort, distort_slopes, radial, undistort

_NEWTON_STEPS = 60
LENS_COUNT, PORT_COUNT = 16, 7
PARAMETER_COUNT = LENS_COUNT + 6


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def air_tangent(radius: float, water: float, port: Array) -> float:
    """Tangent in air, against the port's normal, of the light from a point in the water.

    It solves t (air + glass / G + water / W) = radius with G = sqrt(n_g^2 + (n_g^2 - 1) t^2) and W
    likewise (Snell's law twice, in tangents). The left side is concave in t: from its slope at 0
    Newton's method climbs to the root and never passes it.

    Args:
        radius: distance of the point from the normal through the pupil, > 0.
        water: its distance from the outer glass, > 0.
        port: (7,).

    Returns:
        NaN where no light reaches the pupil.
    """
    air, glass, n_glass, n_water = port[0], port[1], port[2], port[3]
    a_glass, b_glass = n_glass * n_glass, n_glass * n_glass - 1.0
    a_water, b_water = n_water * n_water, n_water * n_water - 1.0
    if air == 0.0:
        reach = glass / math.sqrt(b_glass) if b_glass > 0.0 else math.inf
        if glass == 0.0:
            reach = 0.0
        reach += water / math.sqrt(b_water) if b_water > 0.0 else math.inf
        if not radius < reach:
            return math.nan
    tangent: float = radius / (air + glass / n_glass + water / n_water)
    step = math.inf
    for _ in range(_NEWTON_STEPS):
        t2 = tangent * tangent
        root_glass = math.sqrt(a_glass + b_glass * t2)
        root_water = math.sqrt(a_water + b_water * t2)
        miss = tangent * (air + glass / root_glass + water / root_water) - radius
        slope = air + glass * a_glass / root_glass**3 + water * a_water / root_water**3
        step = miss / slope
        tangent -= step
        if abs(step) <= 1e-15 * tangent:
            return tangent
    if not abs(step) <= 1e-12 * tangent:
        tangent = math.nan
    return tangent


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def project(points: Array, lens: Array, port: Array, fold: float) -> Array:
    """(N, 2) pixels of (N, 3) points."""
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    k = lens[4:]
    before, nx, ny, nz = port[0] + port[1], port[4], port[5], port[6]
    pixels = np.full((points.shape[0], 2), np.nan)
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        along = nx * x + ny * y + nz * z
        water = along - before
        if not water > 0.0:
            continue
        rx, ry, rz = x - along * nx, y - along * ny, z - along * nz
        radius = math.sqrt(rx * rx + ry * ry + rz * rz)
        turn = 0.0
        if radius > 0.0:
            turn = air_tangent(radius, water, port) / radius
        dz = rz * turn + nz
        if not dz > 0.0:
            continue
        u, v = (rx * turn + nx) / dz, (ry * turn + ny) / dz
        if not u * u + v * v < fold:
            continue
        x, y = distort(u, v, k)
        pixels[i, 0] = fx * x + cx
        pixels[i, 1] = fy * y + cy
    return pixels


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def unproject(pixels: Array, lens: Array, port: Array, fold: float) -> tuple[Array, Array]:
    """Points on the outer glass and unit directions in water, (N, 3) each, of (N, 2) pixels."""
    air, glass, n_glass, n_water, nx, ny, nz = port
    k = lens[4:]
    points = np.full((pixels.shape[0], 3), np.nan)
    directions = np.full((pixels.shape[0], 3), np.nan)
    for i in range(pixels.shape[0]):
        u, v = undistort(
            (pixels[i, 0] - lens[2]) / lens[0], (pixels[i, 1] - lens[3]) / lens[1], k, fold
        )
        if not math.isfinite(u):
            continue
        length = math.sqrt(u * u + v * v + 1.0)
        dx, dy, dz = u / length, v / length, 1.0 / length
        cos_air = dx * nx + dy * ny + dz * nz
        if not cos_air > 0.0:
            continue
        x, y, z = dx * air / cos_air, dy * air / cos_air, dz * air / cos_air
        sin2 = 1.0 - cos_air * cos_air
        cos_glass = math.sqrt(1.0 - sin2 / (n_glass * n_glass))
        bend = cos_glass - cos_air / n_glass
        gx, gy, gz = dx / n_glass + bend * nx, dy / n_glass + bend * ny, dz / n_glass + bend * nz
        x += gx * glass / cos_glass
        y += gy * glass / cos_glass
        z += gz * glass / cos_glass
        cos_water = math.sqrt(1.0 - sin2 / (n_water * n_water))
        bend = cos_water - cos_air / n_water
        points[i] = x, y, z
        directions[i] = dx / n_water + bend * nx, dy / n_water + bend * ny, dz / n_water + bend * nz
    return points, directions


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def project_jacobian(
    points: Array, lens: Array, port: Array, fold: float
) -> tuple[Array, Array, Array]:
    """Pixels (N, 2) with their slopes by point (N, 2, 3) and by parameter (N, 2, 22).

    With n the normal, h = n . p, w = p - h n = r e and t(r, h) the tangent in air, the light's
    direction in air is D = (t / r) w + n. Slopes of t follow from the implicit equation that
    `air_tangent` solves; those of D by the chain rule, written so that r may be 0 (t is odd in r).
    """
    count = points.shape[0]
    pixels = np.full((count, 2), np.nan)
    by_point = np.full((count, 2, 3), np.nan)
    by_parameter = np.full((count, 2, PARAMETER_COUNT), np.nan)
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    k = lens[4:]
    air, glass, n_glass, n_water = port[0], port[1], port[2], port[3]
    n, p, e = port[4:7], np.empty(3), np.empty(3)
    ray, slope = np.empty(3), np.empty((9, 3))
    for i in range(count):
        p[:] = points[i]
        along = n[0] * p[0] + n[1] * p[1] + n[2] * p[2]
        water = along - air - glass
        if not water > 0.0:
            continue
        for a in range(3):
            e[a] = p[a] - along * n[a]
        radius = math.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
        tangent = 0.0
        if radius > 0.0:
            tangent = air_tangent(radius, water, port)
        t2 = tangent * tangent
        root_glass = math.sqrt(n_glass * n_glass + (n_glass * n_glass - 1.0) * t2)
        root_water = math.sqrt(n_water * n_water + (n_water * n_water - 1.0) * t2)
        glass3, water3 = root_glass**3, root_water**3
        steep = air + glass * n_glass * n_glass / glass3 + water * n_water * n_water / water3
        turn = 1.0 / (air + glass / n_glass + water / n_water)
        if radius > 0.0:
            turn = tangent / radius
            for a in range(3):
                e[a] /= radius
        for a in range(3):
            ray[a] = turn * radius * e[a] + n[a]
        if not ray[2] > 0.0:
            continue
        u, v = ray[0] / ray[2], ray[1] / ray[2]
        r2 = u * u + v * v
        if not r2 < fold:
            continue
        x, y, x_u, x_v, y_u, y_v = distort_slopes(u, v, k)
        pixels[i, 0], pixels[i, 1] = fx * x + cx, fy * y + cy

        # Slopes of the ray by the point (rows 0 to 2) and by the port (3 to 8).
        by_r, by_h = 1.0 / steep, -tangent / (root_water * steep)
        bend = by_r - turn
        for j in range(3):
            for a in range(3):
                slope[j, a] = bend * e[a] * e[j] + by_h * e[a] * n[j] - turn * n[a] * n[j]
            slope[j, j] += turn
        by_air = (tangent / root_water - tangent) / steep
        by_glass = (tangent / root_water - tangent / root_glass) / steep
        by_n_glass = tangent * glass * n_glass * (1.0 + t2) / (glass3 * steep)
        by_n_water = tangent * water * n_water * (1.0 + t2) / (water3 * steep)
        for a in range(3):
            slope[3, a] = by_air * e[a]
            slope[4, a] = by_glass * e[a]
            slope[5, a] = by_n_glass * e[a]
            slope[6, a] = by_n_water * e[a]
        for j in range(2):  # n moves by dn = (1, 0, -nx / nz) or (0, 1, -ny / nz)
            down = -n[j] / n[2]
            p_dn, e_dn = p[j] + p[2] * down, e[j] + e[2] * down
            outward = by_h * p_dn - bend * along * e_dn
            for a in range(3):
                slope[7 + j, a] = outward * e[a] - turn * p_dn * n[a]
            slope[7 + j, j] += 1.0 - turn * along
            slope[7 + j, 2] += (1.0 - turn * along) * down
        for j in range(9):
            u_j = (slope[j, 0] - u * slope[j, 2]) / ray[2]
            v_j = (slope[j, 1] - v * slope[j, 2]) / ray[2]
            x_j, y_j = fx * (x_u * u_j + x_v * v_j), fy * (y_u * u_j + y_v * v_j)
            if j < 3:
                by_point[i, 0, j], by_point[i, 1, j] = x_j, y_j
            else:
                by_parameter[i, 0, LENS_COUNT + j - 3] = x_j
                by_parameter[i, 1, LENS_COUNT + j - 3] = y_j
        _by_lens(u, v, x, y, fx, fy, k, by_parameter[i])
    return pixels, by_point, by_parameter


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _by_lens(
    u: float, v: float, x: float, y: float, fx: float, fy: float, k: Array, out: Array
) -> None:
    """Fill in the slopes of one pixel by focal lengths, centre and distortion."""
    r2 = u * u + v * v
    ratio, _, bottom = radial(r2, k)
    out[:, :LENS_COUNT] = 0.0
    out[0, 0], out[1, 1], out[0, 2], out[1, 3] = x, y, 1.0, 1.0
    xu, yv = fx * u, fy * v
    one, two, three = r2 / bottom, r2 * r2 / bottom, r2 * r2 * r2 / bottom
    out[0, 4], out[1, 4] = xu * one, yv * one
    out[0, 5], out[1, 5] = xu * two, yv * two
    out[0, 6], out[1, 6] = fx * 2.0 * u * v, fy * (r2 + 2.0 * v * v)
    out[0, 7], out[1, 7] = fx * (r2 + 2.0 * u * u), fy * 2.0 * u * v
    out[0, 8], out[1, 8] = xu * three, yv * three
    out[0, 9], out[1, 9] = -xu * ratio * one, -yv * ratio * one
    out[0, 10], out[1, 10] = -xu * ratio * two, -yv * ratio * two
    out[0, 11], out[1, 11] = -xu * ratio * three, -yv * ratio * three
    out[0, 12], out[0, 13] = fx * r2, fx * r2 * r2
    out[1, 14], out[1, 15] = fy * r2, fy * r2 * r2
