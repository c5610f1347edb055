"""A symmetric board gets one numbering in all cameras."""

import numpy as np
import pytest

from camera_calib.calibrate.start import same_numbering
from camera_calib.calibration import TargetView
from camera_calib.targets.target import parse_target
from tests.camera_calib.calibration_scenes import DESIGN, board_poses, built_rig, views_of

TRUTH = built_rig()


@pytest.mark.parametrize("text", ["chessboard 9x7 30mm", "chessboard 8x8 30mm"])
def test_cameras_that_number_a_board_unlike_are_brought_together(text: str) -> None:
    target = parse_target(text)
    rng = np.random.default_rng(1)
    poses = board_poses(TRUTH, 14, rng, points=target.points)
    views = views_of(TRUTH, poses, 0.1, rng, target.points)
    entries = [np.arange(len(target.points)), *target.symmetries]
    mixed, unlike = [], []
    for v, view in enumerate(views):
        # As a detector would see it: any numbering that looks the same, in either camera.
        chosen = rng.integers(len(entries), size=2)
        pixels = {
            camera: view.pixels[camera][entries[which]]
            for camera, which in zip(("left", "right"), chosen, strict=True)
        }
        mixed.append(TargetView(name=f"{v}", pixels=pixels))
        if chosen[0] != chosen[1]:
            unlike.append(v)

    found = same_numbering(DESIGN.cameras, mixed, target.points, target.symmetries)

    for view, seen in zip(found, views, strict=True):
        # Both cameras see the same point at the same place, whatever its number.
        left = np.lexsort(view.pixels["left"].T)
        true = np.lexsort(seen.pixels["left"].T)
        np.testing.assert_array_equal(view.pixels["left"][left], seen.pixels["left"][true])
        np.testing.assert_array_equal(view.pixels["right"][left], seen.pixels["right"][true])
    changed = [
        v for v, (a, b) in enumerate(zip(found, mixed, strict=True))
        if not np.array_equal(a.pixels["right"], b.pixels["right"])
    ]  # fmt: skip
    assert changed == unlike
    for new, old in zip(found, mixed, strict=True):
        np.testing.assert_array_equal(new.pixels["left"], old.pixels["left"])
