import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from alice_survey.core.errors import PlanError
from missions.exposure.settings import imaging_settings
from missions.plan.run import HEADER, trigger_table
from tests.missions.exposure.surveys import survey


@given(
    exposure_us=st.integers(1, 20_000),
    lead_s=st.floats(0, 0.01),
    gaps=st.lists(st.floats(0.1, 5.0), min_size=1, max_size=30),
)
def test_strobes_cover_exposures_and_nothing_overlaps(
    exposure_us: int, lead_s: float, gaps: list[float]
) -> None:
    times = (1.0 + np.cumsum(gaps)).tolist()
    rows = trigger_table(times, exposure_us * 1e-6, lead_s, 0.1)
    table = dict(zip(HEADER, rows.T, strict=True))
    open_us, close_us = table["camera_open_us"], table["camera_close_us"]
    assert np.issubdtype(rows.dtype, np.integer)
    assert (close_us - open_us == exposure_us).all()
    assert np.abs((open_us + close_us) / 2 - np.array(times) * 1e6).max() <= 1.0
    lead_us = open_us - table["strobe_on_us"]
    assert (lead_us == table["strobe_off_us"] - close_us).all()
    assert lead_s * 1e6 - 2e-6 <= lead_us.min() <= lead_us.max() <= lead_s * 1e6 + 1
    assert (table["strobe_on_us"][1:] > table["strobe_off_us"][:-1]).all()
    assert (np.diff(table["trigger_us"]) >= 100_000 - 1).all()


def test_what_a_controller_cannot_do_is_refused() -> None:
    for second_s, lead_s, named in (
        (1.05, 0.0, r"trigger 1 .* 0\.050000 s"),
        (0.5, 0.0, "trigger 1"),
        (1.1, 0.06, r"take 0\.122001 s"),
    ):
        with pytest.raises(PlanError, match=named):
            trigger_table([1.0, second_s], 2e-3, lead_s, 0.1)


def test_the_table_holds_absolute_and_relative_edges() -> None:
    settings = imaging_settings(*survey())
    strobe_s = settings.strobe_lead_s, settings.shortest_interval_s
    rows = trigger_table([3600.0, 3602.35], settings.exposure_s, *strobe_s)
    table = dict(zip(HEADER, rows.T, strict=True))
    assert table["trigger_us"].tolist() == [3_600_000_000, 3_602_350_000]
    opened_us = table["camera_close_us"] - table["camera_open_us"]
    assert (opened_us == round(settings.exposure_s * 1e6)).all()
    for edge in ("strobe_on", "camera_open", "camera_close", "strobe_off"):
        np.testing.assert_array_equal(
            table[f"{edge}_us"], table["trigger_us"] + table[f"{edge}_rel_us"]
        )
