"""Chessboards are found in whatever part of them shows, and not where there are none."""

import cv2
import numpy as np
import pytest

from camera_calib.targets.detect import chessboard_size
from camera_calib.targets.grow import from_neighbours, grown_chessboard, spans_board
from camera_calib.targets.target import parse_target
from tests.oracles_targets import picture_light, seen_from, to_srgb, true_pixels

SIZE = (640, 480)
BOARD = parse_target("chessboard 9x6 25mm")
GRID = BOARD.points[:, :2] / BOARD.size_m


def view(turn: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    seen = seen_from(BOARD, SIZE, turn, 0.7)
    light = picture_light(BOARD, seen, SIZE, fine=4)
    noisy = light + np.random.default_rng(2).normal(0, 0.01, light.shape)
    return to_srgb(noisy), true_pixels(BOARD, seen)


def matched(found: np.ndarray, true: np.ndarray, off_px: float) -> set[int]:
    """Which true corners were found, in any numbering: none is far from one, and none is twice."""
    seen = found[np.isfinite(found).all(axis=1)]
    near = np.linalg.norm(seen[:, None] - true[None], axis=2)
    assert near.min(axis=1).max() < off_px
    numbers = set(near.argmin(axis=1).tolist())
    assert len(numbers) == len(seen)
    return numbers


@pytest.mark.parametrize(
    "turn",
    [(30, 25, 20), *(pytest.param(t, marks=pytest.mark.slow) for t in ((0, 0, 0), (-50, 10, 100)))],
)
def test_whole_boards_are_found(turn: tuple[float, float, float]) -> None:
    picture, true = view(turn)
    found = grown_chessboard(picture, (6, 9))
    assert found is not None
    assert len(matched(found, true, 0.1)) == 54
    assert chessboard_size(picture) == (9, 6)
    assert grown_chessboard(picture, (6, 8)) is None
    assert grown_chessboard(picture, (7, 9)) is None


@pytest.mark.parametrize("shift", [-1, 1])
def test_a_detector_that_goes_beyond_a_board_is_corrected(shift: int) -> None:
    """A column beyond its end, in place of the one at its other end."""
    picture, true = view((30, 25, 20))
    near = from_neighbours(GRID, true, GRID + np.array([shift, 0.0]))[0].reshape(6, 9, 2)
    found = grown_chessboard(picture, (6, 9), near)
    assert found is not None
    assert len(matched(found, true, 0.1)) == 54
    assert grown_chessboard(picture, (6, 8), near[:, :8]) is None
    sparse = true.reshape(6, 9, 2)[::2, ::2]
    assert grown_chessboard(picture, (3, 5), sparse) is None


def found_in(light: np.ndarray, true: np.ndarray, off_px: float) -> int:
    """How many corners of the board are found in a picture."""
    found = grown_chessboard(to_srgb(light), (6, 9))
    assert found is not None
    return len(matched(found, true, off_px))


@pytest.mark.parametrize("shade", [0.2, 0.4])
@pytest.mark.parametrize("turn", [(15, 10, 14), (0, 56, 20)])
def test_a_board_with_a_shadow_along_a_row_is_found(
    turn: tuple[float, float, float], shade: float
) -> None:
    """The row is lost, but not what lies in the shadow behind it."""
    seen = seen_from(BOARD, SIZE, turn, 0.6)
    true = true_pixels(BOARD, seen)
    light = picture_light(BOARD, seen, SIZE, fine=4, blur_px=0.0)
    start, end = true[18], true[26]
    y, x = np.mgrid[: SIZE[1], : SIZE[0]] + 0.5
    off = (x - start[0]) * (end - start)[1] - (y - start[1]) * (end - start)[0]
    light = np.where(off < -2.0 * np.linalg.norm(end - start), shade * light, light)
    light = 0.3 * cv2.GaussianBlur(light, (0, 0), 0.7)
    light += np.random.default_rng(3).normal(0, 0.002, light.shape)
    assert 45 <= found_in(light, true, 1.0) <= 54


@pytest.mark.parametrize("steps", [((14.5, 0.2), (16.4, 26.8)), ((20.0, 2.0), (-24.0, 21.0))])
def test_a_board_at_a_slant_is_found(steps: tuple[tuple[float, float], ...]) -> None:
    """The nearest saddles of a slanted board make parallelograms that are no squares."""
    across, down = np.array(steps) / BOARD.size_m
    middle = BOARD.points[:, :2].mean(axis=0)
    at = np.array(SIZE) / 2 - np.column_stack([across, down]) @ middle
    seen = np.array([[across[0], down[0], at[0]], [across[1], down[1], at[1]], [0.0, 0.0, 1.0]])
    light = picture_light(BOARD, seen, SIZE, fine=4, blur_px=1.2)
    light = 0.3 + 0.4 * (light - 0.3)
    light += np.random.default_rng(2).normal(0, 0.003, light.shape)
    assert found_in(light, true_pixels(BOARD, seen), 0.5) == 54


def test_a_faint_board_in_noise_is_found() -> None:
    """What a fit leaves is noise; nothing beyond the board is taken for a corner."""
    seen = seen_from(BOARD, SIZE, (20, 10, 5), 0.7)
    light = picture_light(BOARD, seen, SIZE, fine=4, blur_px=1.0)
    light = 0.3 + 0.06 * (light - 0.3) + np.random.default_rng(2).normal(0, 0.01, light.shape)
    assert found_in(light, true_pixels(BOARD, seen), 1.5) >= 50


def test_a_board_ends_where_its_outer_rows_are_seen() -> None:
    seen = np.ones((6, 9), dtype=bool)
    assert spans_board(seen)
    seen[2:4, 2:7] = False
    assert spans_board(seen)
    seen[:, 8] = False
    assert not spans_board(seen)
    seen[2:5, 8] = True
    assert spans_board(seen)
    seen[1:5, :7] = False
    assert not spans_board(seen)
