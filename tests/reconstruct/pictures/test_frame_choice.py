"""Frames of films whose motion is known: a window that moves over a textured floor."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from reconstruct.pictures.videos import Frame, FrameCounts, choose_frames

WIDTH, HEIGHT = 320, 240
RATE_HZ = 20.0
Picture = NDArray[np.uint8]


def floor(seed: int, width: int, height: int) -> Picture:
    """Sand and stones: noise of several grain sizes."""
    rng = np.random.default_rng(seed)
    grey = np.zeros((height, width))
    for grain in (2, 5, 13, 34):
        small = rng.normal(size=(height // grain + 2, width // grain + 2))
        grey += cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
    grey = 120.0 + 28.0 * grey
    return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def view(ground: Picture, x_px: float, y_px: float = 0.0, turn_deg: float = 0.0) -> Picture:
    """The frame of a camera over a place of the floor."""
    middle = (WIDTH / 2, HEIGHT / 2)
    turn = cv2.getRotationMatrix2D(middle, turn_deg, 1.0)
    turn[:, 2] += turn[:, :2] @ -np.array([x_px, y_px])
    return np.asarray(cv2.warpAffine(ground, turn, (WIDTH, HEIGHT)), np.uint8)


def film(frames: Sequence[Picture]) -> list[Frame]:
    return [Frame(time_s=i / RATE_HZ, pixels=pixels) for i, pixels in enumerate(frames)]


def chosen(frames: Sequence[Frame], overlap: float) -> tuple[list[int], FrameCounts]:
    """Numbers of the frames that are taken."""
    counts = FrameCounts()
    taken = [round(one.time_s * RATE_HZ) for one in choose_frames(frames, overlap, counts)]
    return taken, counts


def overlaps(x_px: NDArray[Any], taken: Sequence[int]) -> NDArray[Any]:
    """Closed form: two frames a distance apart along x share the rest of the width."""
    return 1.0 - np.abs(np.diff(x_px[list(taken)])) / WIDTH


@pytest.mark.parametrize(
    "overlap", [0.7, *(pytest.param(o, marks=pytest.mark.slow) for o in (0.6, 0.85))]
)
def test_neighbours_overlap_as_wanted_at_any_speed(overlap: float) -> None:
    """A diver who hurries, dawdles, stops for 3 s and goes back over new ground."""
    speeds = np.repeat([4.0, 11.0, 1.5, 0.0, 7.0], [40, 40, 50, 60, 40])  # px a frame
    x = np.concatenate([[0.0], np.cumsum(speeds)])
    ground = floor(1, int(x.max()) + WIDTH + 8, HEIGHT)
    taken, counts = chosen(film([view(ground, at) for at in x]), overlap)
    found = overlaps(x, taken)
    advance = 1.0 - overlap
    step = 11.0 / WIDTH
    assert np.all(found[:-1] >= 1.0 - 1.25 * advance - step)  # the last one closes the film
    assert np.all(found[:-1] <= 1.0 - 0.75 * advance + step)
    assert x[taken[0]] < 0.25 * advance * WIDTH + step * WIDTH
    assert x[-1] - x[taken[-1]] < advance * WIDTH
    assert len(taken) == pytest.approx(x[-1] / (advance * WIDTH), rel=0.3)
    assert counts.breaks_s == [] and counts.unfollowed == 0


def test_who_stands_still_gets_one_frame() -> None:
    ground = floor(2, WIDTH + 80, HEIGHT + 80)
    rng = np.random.default_rng(3)
    sway = 5.0 * np.cumsum(rng.normal(size=(150, 2)), axis=0) / np.sqrt(150)
    frames = [view(ground, 40 + dx, 40 + dy) for dx, dy in sway]
    assert np.abs(sway).max() < 0.25 * 0.3 * HEIGHT
    assert len(chosen(film(frames), 0.7)[0]) == 1


def test_blurred_frames_are_not_taken_where_sharp_ones_are_near() -> None:
    x = 5.0 * np.arange(120)
    ground = floor(4, int(x[-1]) + WIDTH + 8, HEIGHT)
    blurred = set(range(120)) - set(range(3, 120, 7))
    frames = [view(ground, at) for at in x]
    for i in blurred:
        frames[i] = np.asarray(cv2.GaussianBlur(frames[i], (0, 0), 1.5), np.uint8)
    taken, _ = chosen(film(frames), 0.7)
    assert len(taken) > 4
    assert not blurred & set(taken[:-1])  # every window holds a sharp one


@pytest.mark.slow
def test_a_cut_and_black_frames_are_reported() -> None:
    """The first scene, half a second of black in it, then another scene."""
    x = 6.0 * np.arange(80)
    first, second = (floor(seed, int(x[-1]) + WIDTH + 8, HEIGHT) for seed in (9, 10))
    frames = [view(first, at) for at in x]
    for i in range(30, 36):
        frames[i] = np.zeros_like(frames[i])
    frames += [view(second, at) for at in x]
    taken, counts = chosen(film(frames), 0.7)
    assert counts.dark == 6 and not set(range(30, 36)) & set(taken)
    assert len(counts.breaks_s) == 1
    assert 80 / RATE_HZ <= counts.breaks_s[0] <= 80 / RATE_HZ + 0.6
    before = [i for i in taken if i < 80]
    after = [i - 80 for i in taken if i >= 80]
    for part in (before, after):
        assert len(part) >= 4
        assert np.all(overlaps(x, part) > 1.0 - 1.25 * 0.3 - 6.0 / WIDTH)


def test_open_water_gives_no_frames() -> None:
    rng = np.random.default_rng(11)
    blue = [rng.normal(60, 3, (HEIGHT, WIDTH, 3)).astype(np.uint8) for _ in range(40)]
    taken, counts = chosen(film(blue), 0.7)
    assert taken == []
    assert counts.unfollowed == 40
