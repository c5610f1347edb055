import math

import pytest

from alice_survey.kit.words import count, digits, duration, length, parts, share


@pytest.mark.parametrize(
    ("metres", "told"),
    [(0.000364, "0.364 mm"), (0.0058, "5.80 mm"), (0.0244, "2.44 cm"), (0.244, "24.4 cm"),
     (5.56, "5.56 m"), (412.3, "412 m"), (12345.0, "12.3 km"), (-0.0002, "-0.200 mm"),
     (0.0, "0 mm"), (None, "unknown"), (math.nan, "unknown")],
)  # fmt: skip
def test_lengths_take_the_unit_that_fits(metres: float | None, told: str) -> None:
    assert length(metres) == told


def test_lengths_of_a_model_without_scale_are_in_its_units() -> None:
    assert length(0.0052689, "unit") == "0.00527 unit"


@pytest.mark.parametrize(("value", "told"), [(0.0, "0"), (99.96, "100"), (1234.0, "1234")])
def test_numbers_have_no_exponent(value: float, told: str) -> None:
    assert digits(value) == told


def test_a_share_that_is_not_whole_never_says_100() -> None:
    assert share(1.0) == "100 %"
    assert share(0.9999) == "more than 99.9 %"
    assert share(0.9984) == "99.8 %"
    assert share(0.5) == "50.0 %"


def test_scales_are_told_in_parts() -> None:
    assert parts(98e-6) == "+98 ppm"
    assert parts(-0.0051) == "-0.51 %"


def test_durations_and_counts() -> None:
    assert [duration(s) for s in (3.04, 51, 840, 9000)] == ["3.0 s", "51 s", "14 min", "2.5 h"]
    assert (count(1, "picture"), count(1200, "picture")) == ("1 picture", "1,200 pictures")
