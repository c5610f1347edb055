"""What is black around a target's points, and corners that are fitted with it."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from camera_calib.camera import Camera
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.targets.corners import FITTED, fit_corners
from camera_calib.targets.detect import detect
from camera_calib.targets.grow import board_map
from camera_calib.targets.pattern import CROSSING, black_rectangles, surroundings
from camera_calib.targets.target import parse_target
from tests.oracles_targets import light_through, to_srgb

GRID = parse_target("apriltag 6x6 88mm 0.3")
FISHEYE = Camera(
    width_px=512,
    height_px=512,
    lens=FisheyeLens(fx_px=191, fy_px=191, cx_px=255, cy_px=257, k1=0.0035, k3=-0.002),
)


@pytest.mark.parametrize("text", ["apriltag 3x2 88mm 0.3", "charuco 5x4 40mm 30mm legacy"])
def test_surroundings_are_the_pattern_near_each_point(text: str) -> None:
    target = parse_target(text)
    rectangles, around = black_rectangles(target) / target.size_m, surroundings(target)
    off = np.random.default_rng(1).uniform(-0.55, 0.55, (400, 2))
    for n, point in enumerate(target.points[:, :2] / target.size_m):
        x, y = (point + off).T[..., None]
        black = ((rectangles[:, 0] < x) & (x < rectangles[:, 2])
                 & (rectangles[:, 1] < y) & (y < rectangles[:, 3])).any(axis=1)  # fmt: skip
        column, row = (np.searchsorted(around.lines[n, k], off[:, k]) for k in range(2))
        shade = around.shades[n, row, column]
        np.testing.assert_array_equal(shade < 0, black == target.top_left_black[n])
        assert 0.1 < black.mean() < 0.9


def test_a_chessboard_has_nothing_but_its_edges() -> None:
    assert surroundings(parse_target("chessboard 9x6 25mm")) is CROSSING


@cache
def fisheye_view() -> tuple[np.ndarray, np.ndarray]:
    """Light of a grid near the edge of a fisheye's frame, and its points; tags are 25 px wide."""
    turn = Rotation.from_euler("xyz", [15.0, 30.0, 20.0], degrees=True)
    middle = GRID.points.mean(axis=0)
    pose = RigidTransform.from_components([0.28, 0.12, 0.45] - turn.apply(middle), turn)
    return light_through(GRID, FISHEYE, pose.inv(), 10), FISHEYE.project(pose.apply(GRID.points))


@pytest.mark.slow
def test_neither_bits_nor_the_lens_pull_a_corner() -> None:
    light, true = fisheye_view()
    board = GRID.points[:, :2] / GRID.size_m
    steps, bends = board_map(board, true)
    plain = fit_corners(light, true, steps, 0.3, 0.2)
    known = fit_corners(light, true, steps, 0.3, 0.2, bends=bends, around=surroundings(GRID))

    both = (plain.states == FITTED) & (known.states == FITTED)
    plain_px, known_px = (
        float(np.sqrt(np.mean((c.pixels[both] - true[both]) ** 2))) for c in (plain, known)
    )

    assert both.mean() > 0.9
    assert 1e-3 < known_px < 0.5 * plain_px
    assert known_px < 0.015


def test_a_grid_of_small_tags_is_found_through_a_fisheye() -> None:
    light, true = fisheye_view()
    rng = np.random.default_rng(5)

    found = detect(GRID, to_srgb(light + rng.normal(0.0, 0.01, light.shape)))

    assert found.pixels is not None
    off = found.pixels - true
    seen = np.isfinite(off).all(axis=1)
    assert seen.mean() > 0.9
    assert 0.003 < np.sqrt(np.mean(off[seen] ** 2)) < 0.04
    assert np.abs(off[seen]).max() < 0.3
