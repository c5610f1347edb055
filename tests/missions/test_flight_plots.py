"""The pictures of a flight show what the flight holds."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from alice_survey.core.config import parse_config
from missions.fly.run import draw_flight, line_spans, rpm_of
from missions.values.flight import Flight
from tests.missions.flown_plans import flown, planned

CONFIG = parse_config(
    {
        "area": {"length_m": 3.0, "width_m": 2.0, "seafloor_depth_m": 6.0},
        "plan": {"line_spacing_m": 1.0},
        "sea": {"current_mps": 0.1, "current_towards_deg": 90.0, "current_sigma_mps": 0.0},
    },
    "test",
)


@pytest.fixture(scope="module")
def flight() -> Flight:
    return flown(planned(CONFIG), CONFIG)


def curve(figure: Any, strip: str, label: str) -> np.ndarray:
    """Heights of a curve by the labels of its strip and its own."""
    (axes,) = [axes for axes in figure.axes if axes.get_ylabel() == strip]
    (line,) = [line for line in axes.lines if line.get_label() == label]
    return np.asarray(line.get_ydata(), np.float64)


def test_spans_are_the_times_on_lines(flight: Flight) -> None:
    spans = line_spans(flight)
    time_s = flight.truth.time_s
    inside = np.zeros(len(time_s), bool)
    for begin, end in spans:
        assert begin < end
        assert not inside[(time_s >= begin) & (time_s <= end)].any()
        inside |= (time_s >= begin) & (time_s <= end)
    assert len(spans) == len(flight.plan.lines)
    np.testing.assert_array_equal(inside, flight.line >= 0)


def test_strips_show_errors_thrusters_and_power(
    flight: Flight, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    kept: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: kept.append(figure))
    draw_flight(tmp_path / "drawn.png", flight)
    (figure,) = kept
    np.testing.assert_array_equal(curve(figure, "cross-track, m", "true"), flight.line_errors[0])
    off = flight.log.position_ned - flight.truth.ned_from_body.translation
    np.testing.assert_array_equal(curve(figure, "east error, m", "believed minus true"), off[:, 1])
    for name, rpm in rpm_of(flight.flown).items():
        np.testing.assert_array_equal(curve(figure, "rpm", name), rpm)
    power_w = curve(figure, "power, W", "all thrusters")
    assert 0.05 * power_w.sum() == pytest.approx(flight.flown.energy_j.sum(), rel=1e-3)
