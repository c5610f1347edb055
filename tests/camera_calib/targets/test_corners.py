"""Corners of a chessboard are found far below a pixel, half pixel included."""

import cv2
import numpy as np
import pytest

from camera_calib.targets.corners import (
    AT_BORDER,
    FITTED,
    NOT_SETTLED,
    UNLIKE_A_CORNER,
    UNSEEN,
    fit_corners,
    linear_light,
)
from camera_calib.targets.target import parse_target
from tests.oracles_targets import picture_light, seen_from, slow_corner, to_srgb, true_pixels

TARGET = parse_target("chessboard 9x6 25mm")
COLUMNS, ROWS = 9, 6
SIZE, FINE = (320, 240), 8


def drawn_board(noise: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A tilted board seen by a pinhole, area-sampled in linear light, and its true corners."""
    rng = np.random.default_rng(seed)
    x_deg, y_deg, z_deg = rng.uniform(-25, 25, 3).tolist()
    off_x, off_y = rng.uniform(-12, 12, 2).tolist()
    seen = seen_from(TARGET, SIZE, (x_deg, y_deg, z_deg), 0.75, (off_x, off_y))
    light = picture_light(TARGET, seen, SIZE, FINE, blur_px=0.0)
    return to_srgb(light + rng.normal(0, noise, light.shape)), true_pixels(TARGET, seen)


def steps_of(corners: np.ndarray) -> np.ndarray:
    """(N, 2, 2) steps to the next corners along the rows and the columns."""
    grid = corners.reshape(ROWS, COLUMNS, 2)
    return np.stack(np.gradient(grid, axis=(1, 0)), axis=-1).reshape(-1, 2, 2)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("noise", "bound_px"), [(0.0, 0.02), (0.01, 0.06)])
def test_corners_are_where_they_were_drawn(seed: int, noise: float, bound_px: float) -> None:
    picture, true = drawn_board(noise, seed)
    start = true + np.random.default_rng(seed).uniform(-0.7, 0.7, true.shape)

    found = fit_corners(picture, start, steps_of(true))

    assert np.all(found.states == FITTED)
    assert 1e-4 < np.abs(found.pixels - true).max() < bound_px


def test_the_fit_beats_opencvs_refinement() -> None:
    picture, true = drawn_board(0.01, 11)
    found = fit_corners(picture, true, steps_of(true)).pixels
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
    near = (true - 0.5).astype(np.float32).reshape(-1, 1, 2)
    theirs = cv2.cornerSubPix(picture, near, (5, 5), (-1, -1), criteria).reshape(-1, 2) + 0.5

    ours_px, theirs_px = (np.sqrt(np.mean((c - true) ** 2)) for c in (found, theirs))

    assert ours_px < 0.7 * theirs_px


def test_a_corner_at_the_border_or_on_nothing_is_nan_and_says_why() -> None:
    picture, true = drawn_board(0.0, 0)
    near = np.array([[3.0, 100.0], true[0], [200.0, 9.0], [np.nan, 1.0], [-4.0, 50.0]])

    found = fit_corners(picture, near, np.tile(20.0 * np.eye(2), (5, 1, 1)))

    assert found.states.tolist() == [AT_BORDER, FITTED, NOT_SETTLED, UNSEEN, UNSEEN]
    assert np.isnan(found.pixels[found.states != FITTED]).all()
    assert np.abs(found.pixels[1] - true[0]).max() < 0.05


def test_a_corner_behind_an_edge_is_refused() -> None:
    picture, true = drawn_board(0.01, 0)
    x, y = true[20].astype(int)
    hidden = picture.copy()
    hidden[y - 20 : y + 20, x - 20 : x + 1] = 90
    states = [
        fit_corners(shown, true[20:21], 20.0 * np.eye(2)[None]).states[0]
        for shown in (picture, hidden)
    ]

    assert states[0] == FITTED
    assert states[1] in (UNLIKE_A_CORNER, NOT_SETTLED)


def test_the_fit_is_its_slow_twin() -> None:
    picture, true = drawn_board(0.01, 5)
    light = cv2.GaussianBlur(linear_light(picture), (0, 0), 0.8)
    steps = steps_of(true)

    found = fit_corners(picture, true, steps)

    y, x = np.mgrid[: picture.shape[0], : picture.shape[1]]
    for i in (0, 17, 31, 53):
        off = np.stack([x + 0.5 - true[i, 0], y + 0.5 - true[i, 1]], axis=-1)
        along = np.abs(off @ np.linalg.inv(steps[i]).T)
        used = (along <= 0.45).all(axis=-1) & (np.abs(off).max(axis=-1) < 12)
        slow = slow_corner(light, used, true[i])
        np.testing.assert_allclose(found.pixels[i], slow, atol=2e-3)


def test_sigmas_are_true() -> None:
    errors, sigmas = [], []
    for seed in range(8):
        picture, true = drawn_board(0.02, seed)
        found = fit_corners(picture, true, steps_of(true))
        errors.append(found.pixels - true)
        sigmas.append(found.sigma_px)

    normalised = np.concatenate(errors) / np.concatenate(sigmas)[:, None]

    assert 0.6 < np.sqrt(np.nanmean(normalised**2)) < 1.2


@pytest.mark.parametrize("turn", [0, 1])
def test_contrast_shows_the_colours(turn: int) -> None:
    picture, true = drawn_board(0.01, 3)
    steps = steps_of(true)
    row, column = np.mgrid[:ROWS, :COLUMNS]
    black = ((row + column) % 2 == 0).ravel()  # the square (0, 0), left and above, is black
    shown = 255 - picture if turn else picture

    contrast = fit_corners(shown, true, steps).contrast

    assert np.all((contrast > 0) == (black if turn == 0 else ~black))


def test_linear_light_inverts_the_srgb_curve() -> None:
    values = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(to_srgb(linear_light(values)), values)
