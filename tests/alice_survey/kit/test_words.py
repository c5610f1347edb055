import math

import pytest

from alice_survey.kit.words import (
    length,
    length_with_sigma,
    parts_with_sigma,
    share,
    with_sigma,
)


@pytest.mark.parametrize(
    ("metres", "expected"),
    [(0.000364, "0.364 mm"), (0.0058, "5.80 mm"), (0.0244, "2.44 cm"), (0.244, "24.4 cm"),
     (5.56, "5.56 m"), (412.3, "412 m"), (12345.0, "12.3 km"), (-0.0002, "-0.200 mm"),
     (0.0, "0 mm"), (None, "unknown"), (math.nan, "unknown")],
)  # fmt: skip
def test_lengths_take_the_unit_that_fits(metres: float | None, expected: str) -> None:
    assert length(metres) == expected


def test_a_share_that_is_not_whole_never_says_100() -> None:
    assert share(1.0) == "100 %"
    assert share(0.9999) == "99.9 %"
    assert share(0.99999, 2) == "99.99 %"
    assert share(0.99984, 2) == "99.98 %"
    assert share(1.0, 2) == "100 %"
    assert share(0.9984) == "99.8 %"
    assert share(0.5) == "50.0 %"


@pytest.mark.parametrize(
    ("value_m", "sigma_m", "expected"),
    [(0.00459, 0.0492, "0.5 ± 4.9 cm"), (0.0049, 0.0012, "4.9 ± 1.2 mm"),
     (-3.2, 0.05, "-3.200 ± 0.050 m")],
)  # fmt: skip
def test_a_length_and_its_sigma_have_one_unit(
    value_m: float, sigma_m: float, expected: str
) -> None:
    assert length_with_sigma(value_m, sigma_m) == expected


def test_a_scale_and_its_sigma_have_one_unit() -> None:
    assert parts_with_sigma(672e-6, 0.0056) == "+0.07 ± 0.56 %"
    assert parts_with_sigma(-8e-6, 29e-6) == "-8 ± 29 ppm"


@pytest.mark.parametrize(
    ("value", "sigma", "expected"),
    [(849.3123, 0.4567, "849.31 ± 0.46"), (53.2, 12.3, "53 ± 12"), (5.0, 0.0, "5 ± 0")],
)
def test_a_sigma_has_two_digits(value: float, sigma: float, expected: str) -> None:
    assert with_sigma(value, sigma) == expected
