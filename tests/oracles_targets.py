"""Slow, obvious twins of corner fitting and target layout, and pictures of targets with truth."""

from collections.abc import Callable
from itertools import product

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.special import erf

from camera_calib.camera import Camera
from camera_calib.targets.pattern import black_rectangles
from camera_calib.targets.target import Target

WHITE, BLACK, WALL = 0.7, 0.05, 0.3


def to_srgb(light: np.ndarray) -> np.ndarray:
    """Linear light to 8-bit grey values (IEC 61966-2-1)."""
    light = np.clip(light, 0, 1)
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.clip(np.rint(255 * encoded), 0, 255).astype(np.uint8)


def seen_from(
    target: Target,
    size: tuple[int, int],
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
    fill: float = 0.7,
    centre: tuple[float, float] = (0.0, 0.0),
) -> np.ndarray:
    """(3, 3) `pixels_from_board`: a pinhole of 55 degrees sees the target turned about its middle.

    Args:
        target: what is seen.
        size: width and height of the picture.
        turn_deg: about x (nods), y (swings) and z (spins), applied z first.
        fill: size of the board over that of the picture when it is seen square on.
        centre: where its middle is seen, in pixels from the picture's middle.
    """
    width, height = size
    focal = 0.96 * max(size)
    left, top, right, bottom = target.outline
    middle = np.array([(left + right) / 2, (top + bottom) / 2, 0.0])
    distance = focal * max((right - left) / width, (bottom - top) / height) / fill
    turn = Rotation.from_euler("zxy", [turn_deg[2], turn_deg[0], turn_deg[1]], degrees=True)
    place = np.array([centre[0], centre[1], focal]) * distance / focal
    matrix = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    rotation = turn.as_matrix()
    return matrix @ np.column_stack([rotation[:, :2], place - rotation @ middle])


def true_pixels(target: Target, pixels_from_board: np.ndarray) -> np.ndarray:
    """(N, 2) where the points of the target are."""
    rays = np.column_stack([target.points[:, :2], np.ones(len(target.points))])
    seen = rays @ pixels_from_board.T
    return seen[:, :2] / seen[:, 2:]


def picture_light(
    target: Target,
    pixels_from_board: np.ndarray,
    size: tuple[int, int],
    fine: int = 6,
    blur_px: float = 0.7,
    warp: Callable[[np.ndarray], np.ndarray] | None = None,
) -> np.ndarray:
    """(H, W) light of a target with a white margin before a grey wall: every pixel an area.

    Args:
        target: what is shown.
        pixels_from_board: (3, 3) homography from its x, y, 1.
        size: width and height.
        fine: samples along a side of a pixel.
        blur_px: of the lens, Gaussian.
        warp: takes (M, 2) pixels of the picture to those of the homography (lens distortion).
    """
    rectangles = black_rectangles(target)
    margin = 0.5 * target.size_m
    outer = np.array(target.outline) + np.array([-margin, -margin, margin, margin])
    # Lines of a grid that no edge crosses: what lies between two neighbours has one shade.
    grid_x = _merged(np.concatenate([rectangles[:, [0, 2]].ravel(), outer[[0, 2]]]))
    grid_y = _merged(np.concatenate([rectangles[:, [1, 3]].ravel(), outer[[1, 3]]]))
    shade = np.full((len(grid_y) + 1, len(grid_x) + 1), WALL)
    shade[1:-1, 1:-1] = WHITE
    for x0, y0, x1, y1 in rectangles:
        a, b = np.searchsorted(grid_x, [x0 + 1e-7, x1 + 1e-7])
        c, d = np.searchsorted(grid_y, [y0 + 1e-7, y1 + 1e-7])
        shade[c:d, a:b] = BLACK
    back = np.linalg.inv(pixels_from_board)
    width, height = size

    def cells(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Column and row of the grid that pixels (..., 2) see."""
        flat = pixels.reshape(-1, 2) if warp is None else warp(pixels.reshape(-1, 2))
        ray = np.column_stack([flat, np.ones(len(flat))]) @ back.T
        ahead = ray[:, 2] * back[2, 2] > 0
        u = np.where(ahead, ray[:, 0] / ray[:, 2], np.inf)
        v = np.where(ahead, ray[:, 1] / ray[:, 2], np.inf)
        column, row = np.searchsorted(grid_x, u), np.searchsorted(grid_y, v)
        return column.reshape(pixels.shape[:-1]), row.reshape(pixels.shape[:-1])

    y, x = np.mgrid[: height + 1, : width + 1].astype(float)
    column, row = cells(np.stack([x, y], axis=-1))
    light = shade[row, column][:-1, :-1]
    cell = row * shade.shape[1] + column
    mixed = np.ptp(np.lib.stride_tricks.sliding_window_view(cell, (2, 2)), axis=(2, 3)) > 0
    # Samples are strewn, or an edge along the pixels would be rounded to a sample's width.
    rng = np.random.default_rng(0)
    first = np.argwhere(mixed)[:, ::-1]
    strata = np.stack(np.meshgrid(np.arange(fine), np.arange(fine)), axis=-1).reshape(-1, 2)
    for start in range(0, len(first), 20_000):
        part = first[start : start + 20_000]
        strewn = rng.uniform(0, 1, (len(part), fine * fine, 2))
        column, row = cells(part[:, None] + (strata + strewn) / fine)
        light[part[:, 1], part[:, 0]] = shade[row, column].mean(axis=1)
    return cv2.GaussianBlur(light, (0, 0), blur_px) if blur_px > 0 else light


def light_through(
    target: Target,
    camera: Camera,
    board_from_cam: RigidTransform,
    fine: int = 4,
    depth_m: Callable[[np.ndarray], np.ndarray] = np.zeros_like,
) -> np.ndarray:
    """(H, W) light of a target as the rays of pixels meet it, through a port too.

    A board that is bent a little has a depth, which depends on x.
    """

    def hits(pixels: np.ndarray) -> np.ndarray:
        """(M, 2) x and y where the rays of pixels meet the board; NaN behind the camera."""
        points, directions = camera.unproject(pixels)
        start, ways = board_from_cam.apply(points), board_from_cam.rotation.apply(directions)
        z_m = np.zeros(len(pixels))
        for _ in range(4):  # bends are small: each round takes off all but a hundredth
            reach = ((z_m - start[:, 2]) / ways[:, 2])[:, None]
            places = start[:, :2] + reach * ways[:, :2]
            z_m = depth_m(places[:, 0])
            if not z_m.any():
                break
        return np.where(reach > 0.0, places, np.nan)

    return picture_light(target, np.eye(3), (camera.width_px, camera.height_px), fine, warp=hits)


def _merged(edges: np.ndarray) -> np.ndarray:
    """Sorted places, of which those equal but for rounding are one."""
    places = np.unique(edges)
    return places[np.concatenate([[True], np.diff(places) > 1e-9])]


def slow_corner(picture: np.ndarray, used: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Fit the product of two soft edges to the used pixels of a light picture, by SciPy.

    Args:
        picture: (H, W) linear light, already blurred.
        used: (H, W) which pixels count.
        near: (2,) start, from the outer corner of the first pixel.

    Returns:
        (2,) the corner.
    """
    y, x = np.nonzero(used)
    light = picture[used]

    def misses(q: np.ndarray) -> np.ndarray:
        across, down = x + 0.5 - q[0], y + 0.5 - q[1]
        one = erf((across * np.cos(q[2]) + down * np.sin(q[2])) / q[4])
        two = erf((across * np.cos(q[3]) + down * np.sin(q[3])) / q[4])
        return q[6] + q[7] * across + q[8] * down + q[5] * one * two - light

    fits = []
    for swing, angle in product((-0.5 * np.ptp(light), 0.5 * np.ptp(light)), (0.0, np.pi / 4)):
        start = [*near, angle, angle + np.pi / 2, 1.5, swing, light.mean(), 0, 0]
        fits.append(least_squares(misses, start, xtol=1e-12, ftol=1e-12, gtol=1e-12))
    return min(fits, key=lambda fit: fit.cost).x[:2]
