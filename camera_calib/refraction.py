"""Kernels of the flat port: pixel to ray, point to pixel, and its derivatives.

A camera comes as three values: `lens`, (16,) fx fy cx cy and the distortion coefficients; `port`,
(7,) air gap, glass thickness, n_glass, n_water and the unit normal; and the fold of its distortion.
Rows without a solution are NaN. Frames and units are those of `flat_port`.
"""

import math

import numpy as np

from alice_survey.base.compiled import compiled, compiled_ieee
from alice_survey.base.frames import Array
from camera_calib.lens import distort, distort_slopes, radial, undistort_block

_NEWTON_STEPS = 60
_SETTLED = 1e-8
"""A step this short, against the tangent, leaves an error below 1.5 times its square, as t f'' / f'
of what Newton's method solves is 3 at most."""
_LEAST_ROOT = 0.01
_BLOCK = 128
"""Points at a time: loops over a block that do not branch become vector instructions."""
LENS_COUNT = 16
PARAMETER_COUNT = LENS_COUNT + 6


@compiled_ieee
def air_tangent(radius: float, water: float, port: Array) -> float:
    """Tangent in air, against the port's normal, of the light from a point in the water.

    It solves t (air + glass / G + water / W) = radius with G = sqrt(n_g^2 + (n_g^2 - 1) t^2) and W
    in the same way (Snell's law twice, in tangents). The left side is concave in t: from below,
    Newton's method climbs to the root and never passes it; its slope at 0 gives such a lower
    bound. The start t / sqrt(1 - c t^2) from that bound t is exact to third order, and for one
    layer exact.

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
    flat = air + glass / n_glass + water / n_water
    low = radius / flat
    bend = (glass * b_glass / n_glass**3 + water * b_water / n_water**3) / flat
    tangent: float = low / math.sqrt(max(1.0 - bend * low * low, _LEAST_ROOT))
    for _ in range(_NEWTON_STEPS):
        t2 = tangent * tangent
        by_glass = 1.0 / math.sqrt(a_glass + b_glass * t2)
        by_water = 1.0 / math.sqrt(a_water + b_water * t2)
        to_glass, to_water = glass * by_glass, water * by_water
        slope = air + to_glass * a_glass * by_glass**2 + to_water * a_water * by_water**2
        step = (tangent * (air + to_glass + to_water) - radius) / slope
        tangent = max(tangent - step, low)
        if abs(step) <= _SETTLED * tangent:
            return tangent
    return math.nan


@compiled_ieee
def _air_tangents(radius: Array, water: Array, port: Array, tangent: Array, step: Array) -> None:
    """Three steps of `air_tangent` for a block of points, without branches.

    Args:
        radius: (B,) as there, or 0.
        water: (B,) as there; where it is not positive the results mean nothing.
        port: (7,).
        tangent: (B,) to be filled in.
        step: (B,) to be filled in: the last step.
    """
    air, glass, n_glass, n_water = port[0], port[1], port[2], port[3]
    a_glass, b_glass = n_glass * n_glass, n_glass * n_glass - 1.0
    a_water, b_water = n_water * n_water, n_water * n_water - 1.0
    flat_glass, flat_water = glass / n_glass, 1.0 / n_water
    bend_glass, bend_water = flat_glass * b_glass / a_glass, flat_water * b_water / a_water
    for j in range(len(radius)):
        flat = air + flat_glass + flat_water * water[j]
        low = radius[j] / flat
        bend = (bend_glass + bend_water * water[j]) / flat
        t = low / math.sqrt(max(1.0 - bend * low * low, _LEAST_ROOT))
        last = 0.0
        for _ in range(3):
            t2 = t * t
            by_glass = 1.0 / math.sqrt(a_glass + b_glass * t2)
            by_water = 1.0 / math.sqrt(a_water + b_water * t2)
            to_glass, to_water = glass * by_glass, water[j] * by_water
            slope = air + to_glass * a_glass * by_glass**2 + to_water * a_water * by_water**2
            last = (t * (air + to_glass + to_water) - radius[j]) / slope
            t = max(t - last, low)
        tangent[j] = t
        step[j] = last


@compiled(nogil=True, error_model="numpy")
def project(points: Array, lens: Array, port: Array, fold: float) -> Array:
    """(N, 2) pixels of (N, 3) points."""
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    k = lens[4:]
    before, nx, ny, nz = port[0] + port[1], port[4], port[5], port[6]
    pixels = np.full((points.shape[0], 2), np.nan)
    radius, water = np.empty(_BLOCK), np.empty(_BLOCK)
    tangent, step = np.empty(_BLOCK), np.empty(_BLOCK)
    for first in range(0, points.shape[0], _BLOCK):
        count = min(_BLOCK, points.shape[0] - first)
        for j in range(count):
            x, y, z = points[first + j, 0], points[first + j, 1], points[first + j, 2]
            along = nx * x + ny * y + nz * z
            rx, ry, rz = x - along * nx, y - along * ny, z - along * nz
            radius[j], water[j] = math.sqrt(rx * rx + ry * ry + rz * rz), along - before
        _air_tangents(radius[:count], water[:count], port, tangent, step)
        for j in range(count):
            if not water[j] > 0.0:
                continue
            if not abs(step[j]) <= _SETTLED * tangent[j]:
                tangent[j] = air_tangent(radius[j], water[j], port)
            turn = 0.0
            if radius[j] > 0.0:
                turn = tangent[j] / radius[j]
            x, y, z = points[first + j, 0], points[first + j, 1], points[first + j, 2]
            along = nx * x + ny * y + nz * z
            dz = (z - along * nz) * turn + nz
            if not dz > 0.0:
                continue
            u, v = ((x - along * nx) * turn + nx) / dz, ((y - along * ny) * turn + ny) / dz
            if not u * u + v * v < fold:
                continue
            x, y = distort(u, v, k)
            pixels[first + j, 0] = fx * x + cx
            pixels[first + j, 1] = fy * y + cy
    return pixels


@compiled(nogil=True, error_model="numpy")
def unproject(pixels: Array, lens: Array, port: Array, fold: float) -> tuple[Array, Array]:
    """Points on the outer glass and unit directions in water, (N, 3) each, of (N, 2) pixels."""
    air, glass, n_glass, n_water, nx, ny, nz = port
    k = lens[4:]
    points = np.full((pixels.shape[0], 3), np.nan)
    directions = np.full((pixels.shape[0], 3), np.nan)
    x, y, u, v = np.empty(_BLOCK), np.empty(_BLOCK), np.empty(_BLOCK), np.empty(_BLOCK)
    for first in range(0, pixels.shape[0], _BLOCK):
        count = min(_BLOCK, pixels.shape[0] - first)
        for j in range(count):
            x[j] = (pixels[first + j, 0] - lens[2]) / lens[0]
            y[j] = (pixels[first + j, 1] - lens[3]) / lens[1]
        undistort_block(x[:count], y[:count], k, fold, u, v)
        for j in range(count):
            if not math.isfinite(u[j]):
                continue
            length = math.sqrt(u[j] * u[j] + v[j] * v[j] + 1.0)
            dx, dy, dz = u[j] / length, v[j] / length, 1.0 / length
            cos_air = dx * nx + dy * ny + dz * nz
            if not cos_air > 0.0:
                continue
            sin2 = 1.0 - cos_air * cos_air
            cos_glass = math.sqrt(1.0 - sin2 / (n_glass * n_glass))
            cos_water = math.sqrt(1.0 - sin2 / (n_water * n_water))
            # Both spans lie in the plane of the air's ray and the normal.
            in_glass = glass / cos_glass
            by_ray = air / cos_air + in_glass / n_glass
            by_normal = in_glass * (cos_glass - cos_air / n_glass)
            points[first + j] = (
                by_ray * dx + by_normal * nx,
                by_ray * dy + by_normal * ny,
                by_ray * dz + by_normal * nz,
            )
            bend = cos_water - cos_air / n_water
            directions[first + j] = (
                dx / n_water + bend * nx,
                dy / n_water + bend * ny,
                dz / n_water + bend * nz,
            )
    return points, directions


@compiled(nogil=True, error_model="numpy")
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
    by_point = np.empty((count, 2, 3))
    by_parameter = np.empty((count, 2, PARAMETER_COUNT))
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    k = lens[4:]
    air, glass, n_glass, n_water = port[0], port[1], port[2], port[3]
    nx, ny, nz = port[4], port[5], port[6]
    for i in range(count):
        by_point[i, :, :] = math.nan
        by_parameter[i, :, LENS_COUNT:] = math.nan
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        along = nx * px + ny * py + nz * pz
        water = along - air - glass
        ex, ey, ez = px - along * nx, py - along * ny, pz - along * nz
        radius = math.sqrt(ex * ex + ey * ey + ez * ez)
        tangent = 0.0
        if water > 0.0 and radius > 0.0:
            tangent = air_tangent(radius, water, port)
            ex, ey, ez = ex / radius, ey / radius, ez / radius
        dx, dy, dz = tangent * ex + nx, tangent * ey + ny, tangent * ez + nz
        u, v = dx / dz, dy / dz
        if not (water > 0.0 and dz > 0.0 and u * u + v * v < fold):
            by_parameter[i, :, :LENS_COUNT] = math.nan
            continue
        x, y, x_u, x_v, y_u, y_v = distort_slopes(u, v, k)
        pixels[i, 0], pixels[i, 1] = fx * x + cx, fy * y + cy
        _by_lens(u, v, x, y, fx, fy, k, by_parameter[i])

        t2 = tangent * tangent
        root_glass = math.sqrt(n_glass * n_glass + (n_glass * n_glass - 1.0) * t2)
        root_water = math.sqrt(n_water * n_water + (n_water * n_water - 1.0) * t2)
        glass3, water3 = root_glass**3, root_water**3
        steep = air + glass * n_glass * n_glass / glass3 + water * n_water * n_water / water3
        turn = 1.0 / (air + glass / n_glass + water / n_water)
        if radius > 0.0:
            turn = tangent / radius
        # Slopes of the tangent, which move D along e.
        by_r, by_h = 1.0 / steep, -tangent / (root_water * steep)
        bend = by_r - turn
        by_air = (tangent / root_water - tangent) / steep
        by_glass = (tangent / root_water - tangent / root_glass) / steep
        by_n_glass = tangent * glass * n_glass * (1.0 + t2) / (glass3 * steep)
        by_n_water = tangent * water * n_water * (1.0 + t2) / (water3 * steep)
        for row in range(2):
            # Slopes of this coordinate of the pixel by D.
            if row == 0:
                gx, gy = fx * x_u / dz, fx * x_v / dz
            else:
                gx, gy = fy * y_u / dz, fy * y_v / dz
            gz = -(u * gx + v * gy)
            g_e, g_n = gx * ex + gy * ey + gz * ez, gx * nx + gy * ny + gz * nz
            by_e, by_n = g_e * bend, g_e * by_h - turn * g_n
            by_point[i, row, 0] = by_e * ex + by_n * nx + turn * gx
            by_point[i, row, 1] = by_e * ey + by_n * ny + turn * gy
            by_point[i, row, 2] = by_e * ez + by_n * nz + turn * gz
            by_parameter[i, row, LENS_COUNT] = g_e * by_air
            by_parameter[i, row, LENS_COUNT + 1] = g_e * by_glass
            by_parameter[i, row, LENS_COUNT + 2] = g_e * by_n_glass
            by_parameter[i, row, LENS_COUNT + 3] = g_e * by_n_water
            for j in range(2):  # n moves by dn = (1, 0, -nx / nz) or (0, 1, -ny / nz)
                down = -(nx if j == 0 else ny) / nz
                p_dn = (px if j == 0 else py) + pz * down
                e_dn = (ex if j == 0 else ey) + ez * down
                g_dn = (gx if j == 0 else gy) + gz * down
                outward = by_h * p_dn - bend * along * e_dn
                by_parameter[i, row, LENS_COUNT + 4 + j] = (
                    outward * g_e - turn * p_dn * g_n + (1.0 - turn * along) * g_dn
                )
    return pixels, by_point, by_parameter


@compiled_ieee
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
