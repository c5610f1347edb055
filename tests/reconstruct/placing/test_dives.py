"""Navigation of several dives: errors restart with each, if the readings show it."""

from dataclasses import replace

import numpy as np
import pytest

from alice_survey.core.frames import Array
from alice_survey.core.manifest import ImageRecord
from reconstruct.placing.correlated_fit import dives_of
from tests.reconstruct.placing.test_sigmas import SIGMA, flight, place, records_of

BODY = flight(8, 15)
SECOND = len(BODY) // 2
GAP_S = 1800.0


def two_dives(seed: int, jump_m: float, *, restart: bool = True) -> list[ImageRecord]:
    """Constant errors, a fifth of their variance white; positions of the second dive jump."""
    rng = np.random.default_rng([seed, int(10 * jump_m), restart])
    constants = rng.normal(size=(2, 6))
    if not restart:
        constants[1] = constants[0]
    dive = (np.arange(len(BODY)) >= SECOND).astype(int)
    errors: Array = np.sqrt(0.8) * constants[dive] + np.sqrt(0.2) * rng.normal(size=(len(BODY), 6))
    errors *= SIGMA
    errors[:, :2] += dive[:, None] * jump_m * np.array([np.cos(seed), np.sin(seed)])
    return [
        replace(record, time_s=record.time_s + GAP_S * d)
        for record, d in zip(records_of(BODY, errors, SIGMA), dive, strict=True)
    ]


def test_long_gaps_lie_between_dives() -> None:
    time = np.array([0.0, 2.5, 5.0, 65.0, 67.5, 1000.0, 1002.0])
    assert dives_of(time).tolist() == [0, 0, 0, 0, 0, 1, 1]
    assert dives_of(100.0 * np.arange(5.0)).tolist() == [0] * 5
    assert dives_of(400.0 * np.arange(5.0)).tolist() == [0] * 5


@pytest.mark.parametrize("restart", [True, False])
def test_two_dives_are_as_sure_as_their_errors_are_independent(restart: bool) -> None:
    found, stated, restarts = [], [], []
    for seed in range(8):
        fit, errors, sigma = place(BODY, two_dives(seed, 0.0, restart=restart), seed)
        found.append(errors[:3] / SIGMA[:3])
        stated.append(sigma[:3] / SIGMA[:3])
        restarts.append(fit.correlation["horizontal"].restart)
    ratio = np.sqrt(np.mean((np.array(found) / np.array(stated)) ** 2))
    assert 0.7 < ratio < 1.4
    share = np.mean(stated)
    if restart:  # the mean of two constants
        assert 0.6 < share < 0.85
        assert np.mean(restarts) > 0.5
    else:
        assert 0.75 < share < 1.05


@pytest.mark.parametrize("jump_m", [0.5, 5.0])
def test_dives_that_contradict_each_other_leave_the_place_that_unsure(jump_m: float) -> None:
    ratios = []
    for seed in range(8):
        fit, errors, sigma = place(BODY, two_dives(seed, jump_m), seed)
        assert not any(fit.record.left_out.values())
        assert fit.correlation["horizontal"].restart * SIGMA[0] > 0.1 * jump_m
        assert fit.correlation["horizontal"].factor < 1.5
        assert sigma[2] < SIGMA[2]  # depths do not suffer
        assert np.rad2deg(sigma[5]) < 0.35
        assert abs(errors[5]) < 4.0 * sigma[5]  # nor the heading
        ratios.append(errors[:2] / sigma[:2])
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 1.6
