"""Dead reckoning against dense least squares over all unknowns, and against its own sigmas."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid

from alice_survey.core.errors import NavigationError
from alice_survey.core.frames import Array, Datum
from missions.logs.dead_reckoning import (
    ReckonedTrack,
    TrackErrors,
    dead_reckoned,
    with_dead_reckoning,
)
from missions.logs.dive import LoggedDive, Signal

ERRORS = TrackErrors(scale=0.01, heading_deg=2.0, noise_mps=0.05)
DATUM = Datum(43.0, 5.0)


TIME_S = np.arange(400, dtype=float) * 0.5
VELOCITY = np.column_stack(
    [np.where(TIME_S // 40 % 2 == 0, 0.4, -0.4), 0.05 + 0.02 * np.sin(TIME_S / 17)]
) + np.random.default_rng(0).normal(0, 0.01, (400, 2))
"""North and east, of lines there and back with a drift across."""
TRUE = cumulative_trapezoid(VELOCITY, TIME_S, axis=0, initial=0)


def reckoned(
    at: Any, places: Array, sigmas: Any = 1.0, *, time_s: Array = TIME_S, velocity: Array = VELOCITY
) -> ReckonedTrack:
    """The track of velocities with fixes at some of their times."""
    signal = Signal(source="dvl", time_s=time_s, values=velocity)
    fixes = time_s[at], places, np.broadcast_to(sigmas, len(places))
    return dead_reckoned(signal, fixes, ERRORS)


def dense(at: list[int], places: Array, sigmas: Array) -> tuple[Array, Array]:
    """All places and both errors at once, by the normal equations of their residuals."""
    count, moves = len(TIME_S), np.diff(TRUE, axis=0)
    longer = [-moves.ravel(), -(moves[:, ::-1] * [-1.0, 1.0]).ravel()]  # by both errors
    steps = np.column_stack([np.kron(np.diff(np.eye(count), axis=0), np.eye(2)), *longer])
    known = np.eye(2 * count + 2)
    fixed = known[np.add.outer(2 * np.array(at), [0, 1]).ravel()]
    weights = 1.0 / np.concatenate(
        [
            np.repeat(ERRORS.noise_mps * np.sqrt(np.diff(TIME_S)), 2),
            np.repeat(sigmas, 2),
            [ERRORS.scale, np.deg2rad(ERRORS.heading_deg)],
        ]
    )
    a = np.vstack([steps, fixed, known[-2:]]) * weights[:, None]
    b = np.concatenate([moves.ravel(), places.ravel(), [0.0, 0.0]]) * weights
    normal = a.T @ a
    found = np.asarray(np.linalg.solve(normal, a.T @ b), np.float64)
    variances = np.diag(np.linalg.inv(normal))[:-2].reshape(-1, 2)
    return found[:-2].reshape(-1, 2), np.sqrt(0.5 * variances.sum(axis=1))


@pytest.mark.parametrize("at", [[0], [250], [3, 399], [0, 130, 260, 390]])
def test_the_smoother_is_least_squares_over_all_places(at: list[int]) -> None:
    places = TRUE[at] * 1.02
    sigmas = np.linspace(0.5, 2.0, len(at))
    track = reckoned(at, places, sigmas)
    expected, sigma = dense(at, places, sigmas)
    np.testing.assert_allclose(track.ne, expected, atol=2e-5)
    np.testing.assert_allclose(track.sigma_m, sigma, rtol=1e-4)
    assert track.refused == 0


@pytest.mark.parametrize("at", [[0], pytest.param([0, 399], marks=pytest.mark.slow)])
def test_sigmas_are_those_of_the_errors(at: list[int]) -> None:
    ratios = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        scale, turn = rng.normal(0, [ERRORS.scale, np.deg2rad(ERRORS.heading_deg)])
        # Truth = (1 + scale) turned measured: the measured track is the inverse of that.
        cos, sin = np.cos(turn), np.sin(turn)
        measured = VELOCITY @ np.array([[cos, -sin], [sin, cos]]) / (1 + scale)
        # White noise of velocity over a step dt has a variance of noise^2 / dt.
        measured = measured + rng.normal(0, ERRORS.noise_mps / np.sqrt(0.5), measured.shape)
        fixes = TRUE[at] + rng.normal(0, 0.3, (len(at), 2))
        track = reckoned(at, fixes, 0.3, velocity=measured)
        ratios.append((track.ne - TRUE) / track.sigma_m[:, None])
    rms = np.sqrt(np.mean(np.square(ratios), axis=(0, 2)))
    assert rms.min() > 0.85
    assert rms.max() < 1.15


def test_a_wild_fix_is_refused_and_many_at_once_count_as_one() -> None:
    places = TRUE[[0, 200, 399]] + [[0, 0], [80, 0], [0, 0]]
    track = reckoned([0, 200, 399], places)
    assert track.refused == 1
    assert np.abs(track.ne - TRUE).max() < 0.5
    often = np.arange(0, 40)  # 20 s
    many = reckoned(often, TRUE[often])
    assert 0.9 < many.sigma_m[20] < 1.1


def test_a_gap_breaks_the_track() -> None:
    time_s = np.where(TIME_S > 100, TIME_S + 60, TIME_S)
    track = reckoned([0], np.zeros((1, 2)), time_s=time_s)
    after = time_s > 150
    assert np.isnan(track.sigma_m[after]).all()
    assert np.isfinite(track.sigma_m[~after]).all()
    both = reckoned([0, -1], np.array([[0, 0], [30.0, 9.0]]), time_s=time_s)
    assert np.isfinite(both.sigma_m).all()
    np.testing.assert_allclose(both.ne[-1], [30, 9], atol=0.01)


def dive_along(heading_deg: float, *, position: Signal | None = None) -> LoggedDive:
    """Ahead at 0.5 m/s and rolled by 30 degrees, ten minutes; attitudes at another rate."""
    time_s, slow_s = np.arange(0, 600, 0.25), np.arange(-1, 602, 0.4)
    speed = np.tile([0.5, 0.0, 0.0], (len(time_s), 1))
    angles = np.tile([30.0, 0.0, heading_deg], (len(slow_s), 1))
    return LoggedDive(
        kind="test", clock="test", dated=False, position=position,
        velocity_body=Signal(source="/dvl", time_s=time_s, values=speed),
        attitude=Signal(source="/imu", time_s=slow_s, values=angles),
    )  # fmt: skip


def test_a_dive_from_one_place_ends_where_its_speed_takes_it() -> None:
    dive = with_dead_reckoning(dive_along(60.0), TrackErrors(), (43.0, 5.0, 2.0))
    assert dive.position is not None
    ends = np.column_stack([dive.position.values[[0, -1]], np.zeros(2)])
    moved = np.diff(DATUM.ned_from_geodetic(ends), axis=0)[0, :2]
    far = 0.5 * 599.75
    np.testing.assert_allclose(moved, [0.5 * far, np.sqrt(0.75) * far], atol=2e-3)
    sigma = dive.sigmas["sigma_horizontal_m"].values[:, 0]
    grown = np.sqrt(sigma[-1] ** 2 - sigma[0] ** 2)
    # scale 0.5 % along, heading 1 degree across, noise 0.02 sqrt(600 s): rms of both axes
    along, across, noise = 0.005 * far, np.deg2rad(1.0) * far, 0.02 * np.sqrt(599.75)
    assert grown == pytest.approx(np.sqrt(0.5 * (along**2 + across**2) + noise**2), rel=0.01)
    assert any("dead reckoning" in note for note in dive.notes)


@pytest.mark.parametrize("lacks", ["velocity_body", "attitude", "start"])
def test_what_is_missing_is_named(lacks: str) -> None:
    dive = dive_along(0.0)
    if lacks != "start":
        missing: dict[str, Any] = {lacks: None}
        dive = replace(dive, **missing)
    words = {"velocity_body": "velocity", "attitude": "attitude", "start": "--start-at"}[lacks]
    with pytest.raises(NavigationError, match=words):
        with_dead_reckoning(dive, TrackErrors(), None)


def test_sigma_grows_away_from_a_fix_and_shrinks_towards_the_next() -> None:
    one, two = (reckoned(at, TRUE[at], 0.1) for at in ([0], [0, -1]))
    assert one.sigma_m[0] == pytest.approx(0.1, rel=1e-3)
    assert one.sigma_m[-1] > 0.6
    assert two.sigma_m[-1] < 0.11
    assert 0.2 < two.sigma_m.max() < 0.7 * one.sigma_m.max()
