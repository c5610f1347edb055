"""Points of a board are predicted from those around them: exactly if flat, nearly if bent."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera_calib.targets.grow import board_map, from_neighbours, through

GRID = np.stack(np.meshgrid(np.arange(8.0), np.arange(6.0)), axis=-1).reshape(-1, 2)
VIEW = np.array([[40.0, 6, 100], [-5, 38, 80], [0.01, -0.012, 1]])


def bent(pixels: np.ndarray) -> np.ndarray:
    off = (pixels - 250.0) / 500.0
    return 250.0 + 500.0 * off * (1.0 - 0.2 * (off**2).sum(axis=1, keepdims=True))


@given(x=st.floats(-1, 8), y=st.floats(-1, 6))
def test_a_plane_is_continued_exactly(x: float, y: float) -> None:
    asked = np.array([[x, y]])
    known = through(VIEW, GRID)[0]

    pixels, steps = from_neighbours(GRID, known, asked)

    expected, slopes, curved = through(VIEW, asked)
    np.testing.assert_allclose(pixels, expected, atol=1e-6)
    np.testing.assert_allclose(steps, slopes, atol=1e-6)
    ahead = through(VIEW, asked + np.array([1e-5, 0]))[0] - expected
    np.testing.assert_allclose(slopes[0, :, 0], ahead[0] / 1e-5, rtol=1e-3, atol=1e-3)
    for way, of_bends in (([1, 0], [1, 0, 0]), ([0, 1], [0, 0, 1]), ([1, 1], [1, 1, 1])):
        both = [through(VIEW, asked + 1e-3 * sign * np.array(way))[0] for sign in (-1, 1)]
        second = (both[0] + both[1] - 2.0 * expected)[0] / 2e-6
        np.testing.assert_allclose(curved[0] @ of_bends, second, rtol=1e-2, atol=1e-3)


def test_what_a_lens_bends_is_followed() -> None:
    known = bent(through(VIEW, GRID)[0])

    pixels, steps = from_neighbours(GRID, known, GRID, others=True)

    plane = np.abs(through(VIEW, GRID)[0] - known).max()
    inner = (GRID > 0).all(axis=1) & (GRID < [7, 5]).all(axis=1)
    off = np.linalg.norm(pixels - known, axis=1)
    square = np.sqrt(np.abs(np.linalg.det(steps)))
    assert plane > 8.0
    assert np.all(off[inner] < 0.005 * square[inner])
    assert np.all(off < 0.1 * square)
    ahead = bent(through(VIEW, GRID + np.array([0, 1e-4]))[0]) - known
    np.testing.assert_allclose(steps[inner][:, :, 1], ahead[inner] / 1e-4, rtol=0.05, atol=1.0)


@pytest.mark.parametrize("board", [GRID, GRID[:21], GRID[GRID.sum(axis=1) < 4]])
def test_steps_and_bends_are_those_of_the_lens(board: np.ndarray) -> None:
    """Less so from few points, of which only polynomials of low degree are taken."""

    def seen(x: float, y: float) -> np.ndarray:
        return bent(through(VIEW, board + 1e-2 * np.array([x, y]))[0])

    steps, bends = board_map(board, seen(0, 0))

    slopes = np.stack([seen(1, 0) - seen(-1, 0), seen(0, 1) - seen(0, -1)], axis=-1) / 2e-2
    square = [seen(*way) + seen(*(-np.array(way))) - 2 * seen(0, 0) for way in [(1, 0), (0, 1)]]
    mixed = seen(1, 1) + seen(-1, -1) - seen(1, -1) - seen(-1, 1)
    second = np.stack([square[0] / 2, mixed / 4, square[1] / 2], axis=-1) / 1e-4
    lens = np.sqrt(np.mean((second - through(VIEW, board)[2]) ** 2))
    assert lens > 0.2
    whole = len(board) == len(GRID)
    assert np.sqrt(np.mean((bends - second) ** 2)) < (0.1 if whole else 0.6) * lens
    np.testing.assert_allclose(steps, slopes, atol=0.2 if whole else 1.0)


@pytest.mark.parametrize("known", [GRID[:0], GRID[:3], GRID[:8]])
def test_a_line_or_less_shows_nothing(known: np.ndarray) -> None:
    pixels, steps = from_neighbours(known, known * 30.0, GRID)
    assert np.isnan(pixels).all() and np.isnan(steps).all()
    assert pixels.shape == (48, 2) and steps.shape == (48, 2, 2)
