"""The pictures of a flight show what the flight holds."""

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from alice_survey.core.config import parse_config
from alice_survey.sim.vehicle.navigation import tick as navigation
from missions.fly.flight_plots import draw_flight, draw_vehicle, line_spans, thin, true_current
from missions.fly.flight_records import rpm_of
from missions.values.flight import Flight, rms
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


@pytest.fixture(scope="module")
def lost(flight: Flight) -> Flight:
    """The same, had it never reached a line."""
    return replace(
        flight, line=np.full(len(flight.line), -1.0), trigger_s=np.empty(0), trigger_line=()
    )


def drawn(
    draw: Callable[[Path, Flight], None], flight: Flight, monkeypatch: pytest.MonkeyPatch
) -> Any:
    """The figure that would be saved."""
    kept: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: kept.append(figure))
    with tempfile.TemporaryDirectory() as folder:
        draw(Path(folder) / "drawn.png", flight)
    return kept[0]


def curve(figure: Any, strip: str, label: str) -> np.ndarray:
    """Heights of the curve so named in the strip so named."""
    for axes in figure.axes:
        if axes.get_ylabel() == strip:
            for line in axes.lines:
                if line.get_label() == label:
                    return np.asarray(line.get_ydata(), np.float64)
    raise AssertionError(f"no curve {label!r} in {strip!r}")


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


def test_the_current_is_that_of_the_sea(flight: Flight) -> None:
    expected = np.broadcast_to([0.0, 0.1], (len(flight.line), 2))
    np.testing.assert_allclose(true_current(flight.flown), expected, atol=1e-12)


def test_a_curve_has_a_limited_number_of_points() -> None:
    for count in (1, 20_000, 20_001, 123_456):
        kept = len(range(*thin(count).indices(count)))
        assert min(count, 10_000) <= kept <= 20_000


def test_rms_is_of_what_is_known() -> None:
    assert rms(np.array([3.0, np.nan, -4.0])) == pytest.approx(np.sqrt(12.5))
    assert np.isnan(rms(np.array([np.nan])))


def test_strips_of_the_flight_show_its_errors(
    flight: Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    figure = drawn(draw_flight, flight, monkeypatch)
    some = thin(len(flight.line))
    cross, _ = flight.line_errors
    np.testing.assert_array_equal(curve(figure, "cross-track, m", "true"), cross[some])
    np.testing.assert_array_equal(
        curve(figure, "cross-track, m", "believed"), flight.believed_cross_track[some]
    )
    off = flight.log.position_ned - flight.truth.ned_from_body.translation
    column = navigation.LOG_COLUMNS.index("sigma_east_m")
    np.testing.assert_array_equal(
        curve(figure, "east error, m", "believed minus true"), off[some, 1]
    )
    (strip,) = [axes for axes in figure.axes if axes.get_ylabel() == "east error, m"]
    (band,) = [c for c in strip.collections if "sigmas" in str(c.get_label())]
    reach = np.abs(band.get_paths()[0].vertices[:, 1]).max()
    assert reach == pytest.approx(2.0 * flight.flown.navigation[some, column].max())


def test_strips_of_the_vehicle_show_its_thrusters_and_energy(
    flight: Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    figure = drawn(draw_vehicle, flight, monkeypatch)
    some = thin(len(flight.line))
    for name, rpm in rpm_of(flight.flown).items():
        np.testing.assert_array_equal(curve(figure, "rpm", name), rpm[some])
    (energy,) = [axes for axes in figure.axes if axes.get_ylabel() == "energy, Wh"]
    spent = np.asarray(energy.lines[0].get_ydata())
    assert np.all(np.diff(spent) >= 0)
    assert spent[-1] == pytest.approx(flight.flown.energy_j.sum() / 3600.0, rel=1e-3)
    limits = [axes.get_ylim()[1] for axes in figure.axes if axes.get_ylabel() == "rpm"]
    assert all(0.0 < limit < 1.1 * 3390.0 for limit in limits)


@pytest.mark.parametrize("draw", [draw_flight, draw_vehicle])
def test_a_flight_without_lines_is_drawn_too(
    draw: Callable[[Path, Flight], None], lost: Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    figure = drawn(draw, lost, monkeypatch)
    assert len(figure.axes) > 5
    assert line_spans(lost) == []
