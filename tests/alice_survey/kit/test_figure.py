from pathlib import Path

import numpy as np
import pytest

from alice_survey.kit import figure
from alice_survey.kit.paper import flat_picture
from tests.alice_survey.kit.sketch import picture_layer, seafloor


@figure.figure_style()
def sine() -> object:
    sheet = figure.new_figure(2.0, 4.0)
    axes = sheet.subplots()
    axes.plot(np.sin(np.linspace(0, 6, 50)))
    axes.set(xlabel="x, m")
    return sheet


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_the_same_numbers_give_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    paths = [tmp_path / f"{name}.{suffix}" for name in "ab"]
    for path in paths:
        figure.save_figure(sine(), path)
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_a_scale_bar_is_as_long_as_it_says() -> None:
    sheet = figure.new_figure(3.0)
    axes = sheet.subplots()
    axes.set(xlim=(100.0, 137.0), ylim=(0.0, 20.0))
    figure.scale_bar(axes)
    (bar,) = axes.lines
    length = float(np.ptp(bar.get_xdata()))
    assert axes.texts[0].get_text() == f"{length:g} m" == "5 m"
    assert 100 < bar.get_xdata()[0] < 110
    figure.map_axes(axes)
    assert axes.get_xlim() == (100.0, 137.0)
    assert "N" in [text.get_text() for text in axes.texts]


def test_a_scale_about_zero_shows_small_errors_next_to_few_large_ones() -> None:
    errors_mm = np.concatenate([np.linspace(-0.4, 0.4, 980), [20.0] * 20, [np.nan]])
    assert 0.35 < figure.even_limit(errors_mm) <= 0.4
    assert figure.even_limit(np.array([np.nan])) == 1.0


def test_a_flat_picture_shows_every_tile_on_white() -> None:
    floor = seafloor(700, 500)
    layer = picture_layer("mosaic", "Mosaic", floor)
    found = flat_picture(layer)
    assert found.shape == (500, 700, 3)
    difference = found.astype(int) - np.asarray(floor).astype(int)
    assert abs(difference.mean()) < 0.5
    assert np.abs(difference).mean() < 6  # of WebP
    assert flat_picture(layer, max_px=400).shape == (250, 350, 3)
    clear = floor.convert("RGBA")
    clear.putalpha(0)
    assert (flat_picture(picture_layer("c", "C", clear)) == 255).all()
