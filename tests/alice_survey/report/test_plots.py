import numpy as np
import pytest

from alice_survey.report.plots import ratio_words


@pytest.mark.parametrize(
    ("shift", "spread", "words"),
    [
        (0.0, 1.0, "as stated"),
        (0.5, 0.5, "shifted by +0.50 sigma and narrower than stated"),
        (0.0, 2.0, "wider than stated"),
    ],
)
def test_the_caption_says_what_the_bars_show(shift: float, spread: float, words: str) -> None:
    ratio = shift + spread * np.random.default_rng(2).standard_normal(200_000)
    text = ratio_words(ratio)
    assert words in text
    assert f"{np.hypot(shift, spread):.1f}" in text
    if words == "as stated":
        assert "68.2 %" in text or "68.3 %" in text
