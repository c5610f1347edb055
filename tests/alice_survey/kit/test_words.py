import math
from typing import Any

import pytest

from alice_survey.kit import words


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        ("length", [0.000364], "0.364 mm"), ("length", [0.0058], "5.80 mm"),
        ("length", [0.244], "24.4 cm"), ("length", [412.3], "412 m"),
        ("length", [12345.0], "12.3 km"), ("length", [-0.0002], "-0.200 mm"),
        ("length", [0.0], "0 mm"), ("length", [None], "unknown"), ("length", [math.nan], "unknown"),
        ("share", [1.0], "100 %"), ("share", [0.9999], "99.9 %"), ("share", [0.5], "50.0 %"),
        ("share", [0.99999, 2], "99.99 %"), ("share", [0.99984, 2], "99.98 %"),
        ("length_with_sigma", [0.00459, 0.0492], "0.5 ± 4.9 cm"),
        ("length_with_sigma", [0.0049, 0.0012], "4.9 ± 1.2 mm"),
        ("length_with_sigma", [-3.2, 0.05], "-3.200 ± 0.050 m"),
        ("parts_with_sigma", [672e-6, 0.0056], "+0.07 ± 0.56 %"),
        ("parts_with_sigma", [-8e-6, 29e-6], "-8 ± 29 ppm"),
        ("with_sigma", [849.3123, 0.4567], "849.31 ± 0.46"),
        ("with_sigma", [53.2, 12.3], "53 ± 12"), ("with_sigma", [5.0, 0.0], "5 ± 0"),
    ],
)  # fmt: skip
def test_numbers_have_units_that_fit_and_the_digits_of_their_sigma(
    name: str, values: list[Any], expected: str
) -> None:
    assert getattr(words, name)(*values) == expected


def test_figures_of_nested_values_have_names_and_units() -> None:
    values = {
        "cameras": {"registered": 1200, "rms_mm": 0.7823, "turn_mm": [0.265, 0.201]},
        "surface": {"within_px": {"1": 0.977}, "dome_mm": None}, "mesh": None,
    }  # fmt: skip
    assert dict(words.figure_rows(values)) == {
        "cameras registered": "1,200", "cameras rms": "0.7823 mm",
        "cameras turn": "0.2650, 0.2010 mm",
        "surface within px 1": "0.9770", "surface dome": "unknown", "mesh": "unknown",
    }  # fmt: skip
