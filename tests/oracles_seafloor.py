"""Slow, obvious twins of what the simulated sea floor computes, written apart from it."""

import math
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.optimize.elementwise import find_root
from scipy.special import erf

U32 = 0xFFFFFFFF


def fermat_pixels(camera: dict[str, Any], points_cam: np.ndarray) -> np.ndarray:
    """Pixels of points seen through a flat port, by Fermat's principle of the quickest path.

    The light's way from a point to the pupil crosses the outer glass at radius r2 and the inner at
    r1; both minimise the optical path. It is convex, so that its slopes have one root each: the
    inner search has the best r1 for each r2. The lens is OpenCV's.

    Args:
        camera: fx_px, fy_px, cx_px, cy_px, k1, k2, p1, p2, k3, port_distance_m, glass_thickness_m,
            n_glass, n_water and the port's normal.
        points_cam: (N, 3).

    Returns:
        (N, 2) pixels that count from the outer corner of the first pixel.
    """
    # In axes of the port: its normal is the third.
    normal = np.asarray(camera["normal"])
    side = np.cross(normal, [0.6, -0.8, 0.0])
    side /= np.linalg.norm(side)
    cam_from_port = np.column_stack([side, np.cross(normal, side), normal])
    points_cam = points_cam @ cam_from_port
    d, g = camera["port_distance_m"], camera["glass_thickness_m"]
    radius = np.hypot(points_cam[:, 0], points_cam[:, 1])
    water = points_cam[:, 2] - d - g

    def slope_inner(r1: np.ndarray, r2: np.ndarray) -> np.ndarray:
        """Derivative of the path through air and glass by r1."""
        return r1 / np.hypot(d, r1) - camera["n_glass"] * (r2 - r1) / np.hypot(g, r2 - r1)

    def best_inner(r2: np.ndarray) -> np.ndarray:
        return find_root(slope_inner, (np.zeros_like(r2), r2), args=(r2,)).x

    def slope_outer(r2: np.ndarray, radius: np.ndarray, water: np.ndarray) -> np.ndarray:
        """Derivative of the whole path by r2 (that by r1 is zero)."""
        in_glass, in_water = r2 - best_inner(r2), radius - r2
        slope = camera["n_glass"] * in_glass / np.hypot(g, in_glass)
        return slope - camera["n_water"] * in_water / np.hypot(water, in_water)

    outer = find_root(slope_outer, (np.zeros_like(radius), radius), args=(radius, water))
    tangent = best_inner(outer.x) / d
    away = np.where(radius > 0.0, radius, 1.0)
    sideways = points_cam[:, :2] * (tangent / away)[:, None]
    ray = np.column_stack([sideways, np.ones(len(sideways))]) @ cam_from_port.T
    lens = np.diag([camera["fx_px"], camera["fy_px"], 1.0])
    lens[:2, 2] = camera["cx_px"], camera["cy_px"]
    distortion = np.array([camera[name] for name in ("k1", "k2", "p1", "p2", "k3")])
    return cv2.projectPoints(ray, np.zeros(3), np.zeros(3), lens, distortion)[0][:, 0]


def mix_bits(h: int) -> int:
    """The integer hash, in Python's unbounded integers."""
    h ^= h >> 15
    h = (h * 0x2C1B3C6D) & U32
    h ^= h >> 12
    h = (h * 0x297A2D39) & U32
    return h ^ (h >> 15)


def gradient_noise(x: float, y: float, z: float, lattice: float, seed: int) -> float:
    """Gradient noise at one place: the ramps of the eight corners of its cell, faded together."""
    place = [x / lattice, y / lattice, z / lattice]
    cell = [math.floor(p) for p in place]
    inside = [p - c for p, c in zip(place, cell, strict=True)]
    fade = [t**3 * (t * (6.0 * t - 15.0) + 10.0) for t in inside]
    total = 0.0
    for corner in np.ndindex(2, 2, 2):
        at = [c + k for c, k in zip(cell, corner, strict=True)]
        h = (at[0] * 0x8DA6B343) & U32 ^ (at[1] * 0xD8163841) & U32 ^ (at[2] * 0xCB1AB31F) & U32
        h = mix_bits(h ^ seed)
        gradient = [((h >> shift) & 1023) - 511.5 for shift in (0, 10, 20)]
        ramp = sum(s * (t - k) for s, t, k in zip(gradient, inside, corner, strict=True))
        weight = math.prod(f if k else 1.0 - f for f, k in zip(fade, corner, strict=True))
        total += weight * ramp
    return 2.5 / 511.5 * total


def direct_light(
    point: np.ndarray,
    normal: np.ndarray,
    path_m: float,
    strobes: np.ndarray,
    axis: np.ndarray,
    profile: np.ndarray,
    peak: float,
    attenuation: np.ndarray,
) -> np.ndarray:
    """What strobes send that shine on the point with the share `profile` of their peak, (3,)."""
    rays = strobes - point
    distance = np.linalg.norm(rays, axis=1)
    cosine = np.maximum(rays @ normal / distance, 0.0)
    lost = np.exp(-attenuation * (distance + path_m)[:, None])
    return (profile * peak * cosine / distance**2) @ lost


def fit_saddle(picture: np.ndarray, near: np.ndarray, half: int) -> np.ndarray:
    """The crossing of two soft edges, fitted to a window of a chessboard's picture.

    OpenCV's `cornerSubPix` is good to 0.03 to 0.1 px on edges as sharp as these; this fit is a
    better ruler.

    Args:
        picture: (H, W) grey values of a blurred board.
        near: (2,) a place within a pixel of the corner, in pixels from the outer corner of the
            first pixel.
        half: half the size of the window.

    Returns:
        (2,) in the same pixels.
    """
    column, row = (int(p) for p in near)
    window = (slice(row - half, row + half + 1), slice(column - half, column + half + 1))
    y, x = (axis[window] + 0.5 for axis in np.mgrid[: picture.shape[0], : picture.shape[1]])
    grey = picture[window]
    dy, dx = np.gradient(grey)
    # Edges run where gradients are: their mean direction, four times turned.
    first = (
        np.angle((np.hypot(dx, dy) * (dx + 1j * dy) ** 4 / (dx**2 + dy**2 + 1e-9) ** 2).sum()) / 4
    )

    def misses(q: np.ndarray) -> np.ndarray:
        along = [(x - q[0]) * np.cos(a) + (y - q[1]) * np.sin(a) for a in (q[2], q[3])]
        step = q[5] * erf(along[0] / q[4]) * erf(along[1] / q[4])
        return (q[6] + q[7] * (x - near[0]) + q[8] * (y - near[1]) + step - grey).ravel()

    height = 0.5 * np.ptp(grey)
    starts = [
        [*near, first, first + np.pi / 2, 1.5, sign * height, grey.mean(), 0, 0] for sign in (1, -1)
    ]
    fits = [least_squares(misses, start) for start in starts]
    return min(fits, key=lambda fit: fit.cost).x[:2]
