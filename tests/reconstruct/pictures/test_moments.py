"""Pictures of several cameras are of one moment by their times, whatever was dropped."""

import numpy as np
import pytest

from alice_survey.core.errors import ImageError
from reconstruct.pictures.incoming import moments_of

RNG = np.random.default_rng(4)


def test_a_dropped_picture_does_not_shift_the_others() -> None:
    true = 100.0 + 0.1 * np.arange(50) + RNG.normal(0, 0.002, 50)
    left, right = np.delete(true, [3, 20, 21]), np.delete(true + 0.004, [0, 20, 40])
    found = moments_of({"left": left, "right": right})
    expected = []
    lefts, rights = iter(range(47)), iter(range(47))
    for k in range(50):
        moment = {}
        if k not in (3, 20, 21):
            moment["left"] = next(lefts)
        if k not in (0, 20, 40):
            moment["right"] = next(rights)
        if moment:
            expected.append(moment)
    assert found == expected


def test_three_cameras_of_unlike_rates_meet_where_they_do() -> None:
    fast, slow, odd = np.arange(0, 10, 0.1), np.arange(0, 10, 0.5), np.array([2.5, 4.03])
    found = moments_of({"fast": fast, "slow": slow, "odd": odd})
    assert len(found) == 101  # 4.03 is a moment of its own, 0.03 s from any other
    together = [m for m in found if len(m) > 1]
    assert len(together) == 20
    assert [m for m in found if "odd" in m] == [{"fast": 25, "slow": 5, "odd": 0}, {"odd": 1}]


@pytest.mark.parametrize(
    ("right", "named"),
    [
        (np.arange(0, 5, 0.1) + 0.05, "no pictures of left and right"),
        (np.array([2.0, 1.0]), "right"),
    ],
)
def test_times_that_do_not_pair_are_refused(right: np.ndarray, named: str) -> None:
    with pytest.raises(ImageError, match=named):
        moments_of({"left": np.arange(0, 5, 0.1), "right": right})
