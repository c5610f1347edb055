import numpy as np
import pytest
from numpy.typing import NDArray

from camera_calib.calibrate.clock import Lag, estimate_lags, pixel_speeds
from tests.oracles_interface import SIZE_M, true_tank

Array = NDArray[np.float64]
TANK = true_tank()


def moving(lag_frames: float, rng: np.random.Generator, frames: int = 600) -> Array:
    """Pixels of a thing that swims in loops; the second camera is late by some frames."""
    time = np.arange(frames, dtype=np.float64)

    def place(t: Array) -> Array:
        phases = np.array([0.031, 0.047, 0.023])
        return SIZE_M * (0.45 + 0.3 * np.sin(t[:, None] * phases + [0.0, 1.0, 2.0]))

    pixels = np.stack([TANK.seen(place(time))[0], TANK.seen(place(time + lag_frames))[1]])
    return pixels + 0.3 * rng.normal(size=pixels.shape)


def lags_of(pixels: Array) -> tuple[Lag, ...]:
    frames = np.arange(pixels.shape[1])
    speeds = pixel_speeds(frames, np.zeros_like(frames), pixels)
    return estimate_lags(TANK.cameras, TANK.poses, speeds, TANK.triangulate(pixels))


@pytest.mark.parametrize("lag_frames", [0.0, 1.6, -0.7])
def test_lag_of_a_clock_shows_in_what_moves(lag_frames: float) -> None:
    (lag,) = lags_of(moving(lag_frames, np.random.default_rng(12)))

    assert lag.points == 598
    assert lag.frames == pytest.approx(lag_frames, abs=0.02)
    assert 0.0005 < lag.sigma < 0.01


def test_few_moving_things_give_no_lag() -> None:
    assert lags_of(moving(1.0, np.random.default_rng(13), frames=50)) == ()


def test_speed_is_unknown_next_to_gaps_and_doubles() -> None:
    pixels = moving(0.0, np.random.default_rng(14), frames=10)
    frames = np.array([0, 1, 2, 3, 20, 21, 22, 22, 23, 24])

    speeds = pixel_speeds(frames, np.zeros_like(frames), pixels)

    known = np.isfinite(speeds).all(axis=(0, 2))
    assert known.tolist() == [
        False, True, True, False, False, True, False, False, True, False
    ]  # fmt: skip
    np.testing.assert_allclose(speeds[:, 1], (pixels[:, 2] - pixels[:, 0]) / 2)
    np.testing.assert_allclose(speeds[:, 5], (pixels[:, 8] - pixels[:, 4]) / 3)
