"""Position of a board's point in a picture, predicted from known points around it."""

import cv2
import numpy as np
from scipy.spatial import cKDTree

from alice_survey.base.frames import Array

_MOST = 24
_WIDTH = 1.5
"""Standard deviation of a neighbour's weight, in squares."""
_STIFFNESS = 0.1
"""Weight of 'no change of slope' against that of a neighbour one square away."""


def from_neighbours(
    board: Array, pixels: Array, asked: Array, others: bool = False
) -> tuple[Array, Array]:
    """Predict positions of the board's points in the picture, and the size of a square there.

    A homography through all known points, plus an affine change of its misses near each point: so
    a lens may bend the board.

    Args:
        board: (M, 2) known points, in squares.
        pixels: (M, 2) their pixels.
        asked: (K, 2) requested points, in squares.
        others: ignore a known point at exactly the requested place.

    Returns:
        (K, 2) pixels, and (K, 2, 2) pixels per square along x (first column) and y (second); NaN
        where fewer than 4 points are known, or all on a line.
    """
    homography = None
    if len(board) >= 4 and np.linalg.matrix_rank(board - board.mean(axis=0), tol=0.1) == 2:
        homography, _ = cv2.findHomography(board, pixels, 0)
    if homography is None:
        return np.full((len(asked), 2), np.nan), np.full((len(asked), 2, 2), np.nan)
    predicted, slopes = through(homography, asked)
    misses = pixels - through(homography, board)[0]
    distance, index = cKDTree(board).query(asked, k=min(_MOST, len(board)))
    weight = np.exp(-0.5 * (distance / _WIDTH) ** 2)
    if others:
        weight = np.where(distance < 1e-6, 0.0, weight)
    terms = np.concatenate([np.ones((*index.shape, 1)), board[index] - asked[:, None]], axis=2)
    weighted = (terms * weight[..., None]).transpose(0, 2, 1)
    normal = weighted @ terms + np.diag([1e-3, _STIFFNESS, _STIFFNESS])
    change = np.linalg.solve(normal, weighted @ misses[index])
    return predicted + change[:, 0], slopes + change[:, 1:].transpose(0, 2, 1)


def through(homography: Array, points: Array) -> tuple[Array, Array]:
    """(K, 2) points mapped by a homography, and (K, 2, 2) the slopes of the map."""
    mapped = np.column_stack([points, np.ones(len(points))]) @ homography.T
    scale = mapped[:, 2:]
    pixels = mapped[:, :2] / scale
    slopes = homography[None, :2, :2] - pixels[:, :, None] * homography[None, 2:, :2]
    return pixels, slopes / scale[:, :, None]
