"""Cameras in housings as drawn, and what they see of a board: nothing here is the program's own.

Corners are traced through glass by Snell's law along rays from the pupil, whose ways are changed
until they end at the corner, and projected by OpenCV. The board is bent and misprinted, and errors
of corners go together, as in `benchmarks.target_calibration`.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from alice_survey.core.frames import Array
from benchmarks.target_calibration import SIZE, Board, Projection, views_of
from camera_calib.calibration import TargetView

KINDS = ("none", "flat", "dome, centred", "dome, off", "fisheye in a dome")
GLASS_M, INDICES = 0.006, (1.0, 1.49, 1.334)
"""Thickness, and indices of air, glass and water."""
_BOARD = Board(bow_m=2.5e-4, alone_px=0.05, together_px=0.05, place_m=2e-5)
_STEPS = 60


def bend(ways: Array, normals: Array, ratio: float) -> Array:
    """Unit ways (N, 3) after a surface, by normals that the light goes along."""
    across = ratio * (ways - (ways * normals).sum(axis=1, keepdims=True) * normals)
    return across + np.sqrt(1.0 - (across**2).sum(axis=1, keepdims=True)) * normals


def leave_sphere(starts: Array, ways: Array, centre: Array, radius_m: float) -> Array:
    """Where rays from within a sphere leave it."""
    off = starts - centre
    half = (off * ways).sum(axis=1, keepdims=True)
    root = np.sqrt(half**2 - (off**2).sum(axis=1, keepdims=True) + radius_m**2)
    return starts + (root - half) * ways


@dataclass(frozen=True, kw_only=True, eq=False)
class Housing:
    """Glass before a pupil: a dome about a centre, or a plane where it has a normal."""

    inner_m: float
    """Radius, or distance from the pupil."""
    centre: Array
    normal: Array | None = None

    def rays_to(self, points: Array) -> Array:
        """Rays in air (N, 3) whose light reaches points."""
        ways = points / points[:, 2:]
        for _ in range(_STEPS):
            now, place = ways / np.linalg.norm(ways, axis=1, keepdims=True), np.zeros_like(points)
            for surface, reach_m in enumerate((self.inner_m, self.inner_m + GLASS_M)):
                if self.normal is None:
                    place = leave_sphere(place, now, self.centre, reach_m)
                    normals = (place - self.centre) / reach_m
                else:
                    left = (reach_m - place @ self.normal) / (now @ self.normal)
                    place = place + left[:, None] * now
                    normals = np.broadcast_to(self.normal, now.shape)
                now = bend(now, normals, INDICES[surface] / INDICES[surface + 1])
            end = place + (points[:, 2:] - place[:, 2:]) / now[:, 2:] * now
            ways = ways + (points - end) / points[:, 2:]
        return ways


@dataclass(frozen=True, kw_only=True, eq=False)
class HousedCamera:
    """A camera, its views in air and in water, and what its owner knows."""

    dry: list[TargetView]
    wet: list[TargetView]
    known: dict[str, Any]
    """Options of `calibrate --water`."""
    lens: str
    ports: tuple[str, ...]
    """Those that are right: a dome whose centre is at the pupil bends nothing."""


def drawn_camera(kind: str, seed: int, views: int = 24) -> HousedCamera:
    """A camera of a kind; a fisheye's dome is centred for even seeds."""
    rng = np.random.default_rng([seed, KINDS.index(kind), 46])
    fisheye, is_dome = kind == "fisheye in a dome", "dome" in kind
    focal = rng.uniform(0.9, 1.1) * (560.0 if fisheye else 1250.0)
    terms = rng.normal(0.0, [0.01] * 4 if fisheye else [0.1, 0.05, 3e-4, 3e-4, 0.01])
    middle = np.array(SIZE) / 2.0 + rng.normal(0.0, 8.0, 2) - 0.5
    matrix = np.array([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]])
    centre, is_off = np.zeros(3), kind == "dome, off" or (fisheye and seed % 2 == 1)
    if is_off:
        way = rng.normal(0.0, 1.0, 3) * [0.4, 0.4, 1.0]
        centre = rng.uniform(0.003, 0.008) * way / np.linalg.norm(way)
    inner_m, normal = rng.uniform(0.035, 0.1), None
    if not is_dome:
        normal = np.append(rng.normal(0.0, 0.01, 2), 1.0)
        inner_m, normal = 10.0 ** rng.uniform(-3.0, -1.0), normal / np.linalg.norm(normal)
    housing = Housing(inner_m=inner_m, centre=centre, normal=normal)

    def air(points: Array) -> Array:
        project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
        shape = points.reshape(-1, 1, 3)
        return np.asarray(project(shape, np.zeros(3), np.zeros(3), matrix, terms)[0][:, 0] + 0.5)

    def water(points: Array) -> Array:
        return air(points if kind == "none" else housing.rays_to(points))

    def seen(projection: Projection) -> list[TargetView]:
        return views_of(_BOARD, rng, views, projection, 1.6 if fisheye else 0.3)

    known = {"glass_mm": f"{1e3 * GLASS_M}", "n_glass": f"{INDICES[1]}", "n_water": f"{INDICES[2]}"}
    if is_dome:
        known["dome_radius_mm"] = f"{1e3 * (inner_m + GLASS_M):.6f}"
    ports = ("dome",) if is_off else ("none", "dome") if is_dome else (kind,)
    return HousedCamera(
        dry=seen(air), wet=seen(water), known=known, ports=ports,
        lens="fisheye" if fisheye else "opencv",
    )  # fmt: skip
