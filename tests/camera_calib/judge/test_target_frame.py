"""What returns in the target's frame is the target's; what does not is not blamed on it."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.target_calibration import SOUND, TARGETS, run_trial
from camera_calib.calibration import Calibration
from camera_calib.judge.target_frame import TargetFrame, target_frame
from camera_calib.target_shape import AS_DRAWN


def frame_of(calibration: Calibration) -> TargetFrame:
    found = target_frame(calibration)
    assert found is not None
    return found


def test_noise_does_not_return() -> None:
    """The probability is that of chance: it is small as often as it says."""
    far = replace(SOUND, together_px=0.15)
    values = [frame_of(run_trial(seed, t)).p_value for seed in range(12) for t in (SOUND, far)]
    assert min(values) > 1e-3
    assert 0.3 < np.mean(values) < 0.8


@pytest.mark.parametrize("bow_m", [2.5e-4, 5e-4])
def test_a_bend_that_was_not_adjusted_returns_and_is_named(bow_m: float) -> None:
    for seed in range(3):
        target = replace(SOUND, bow_m=bow_m)
        held, free = frame_of(run_trial(seed, target, AS_DRAWN)), frame_of(run_trial(seed, target))
        assert held.returns
        assert held.cause == "shape"
        assert not free.returns


def test_an_uneven_print_returns_with_its_size() -> None:
    for seed in range(3):
        found = frame_of(run_trial(seed, replace(TARGETS["correlated"], place_m=6e-5)))
        assert found.returns
        assert found.cause == "uneven"
        # Two axes; poses take up a part of so few places.
        assert found.in_plane_m == pytest.approx(6e-5 * 2**0.5, rel=0.25)
        assert found.returning_px > 0.08


def test_a_few_bad_corners_are_named() -> None:
    sound = run_trial(1, SOUND)
    assert sound.spread is not None
    # Three of 63 corners lie 0.3 mm to the right of where the calibration has them.
    by_corner = np.zeros_like(sound.residuals_px)
    bad = [10, 31, 50]
    for v, pose in enumerate(sound.rig_from_target):
        moved = sound.target_points + np.array([3e-4, 0.0, 0.0])
        camera = sound.rig.cameras["camera"]
        both = [camera.project(pose.apply(p)) for p in (sound.target_points, moved)]
        by_corner[v, 0, bad] = (both[0] - both[1])[bad]
    found = frame_of(replace(sound, residuals_px=sound.residuals_px + by_corner))
    assert found.returns
    assert found.cause == "corners"
    np.testing.assert_allclose(found.offsets_m[bad, 0], 3e-4, atol=1e-4)
