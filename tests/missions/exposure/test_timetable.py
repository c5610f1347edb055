import csv
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from alice_survey.base.errors import PlanError
from missions.exposure.settings import imaging_settings
from missions.exposure.timetable import HEADER, trigger_edges, trigger_table, write_timetable
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
    for row, time_s in zip(rows, times, strict=True):
        edges = (row.strobe_on_us, row.camera_open_us, row.camera_close_us, row.strobe_off_us)
        assert all(isinstance(edge, int) for edge in edges)
        assert row.camera_close_us - row.camera_open_us == exposure_us
        middle = (row.camera_open_us + row.camera_close_us) / 2
        assert abs(middle - time_s * 1e6) <= 1.0
        lead_us = row.camera_open_us - row.strobe_on_us
        assert lead_us == row.strobe_off_us - row.camera_close_us
        assert lead_s * 1e6 - 2e-6 <= lead_us <= lead_s * 1e6 + 1
    for before, row in pairwise(rows):
        assert row.strobe_on_us > before.strobe_off_us
        assert row.trigger_us - before.trigger_us >= 100_000 - 1


def test_a_lead_of_200_us_is_200_us() -> None:
    edges = trigger_edges(2.24e-3, 0.0002)
    assert (edges.strobe_on_us, edges.camera_open_us) == (-1320, -1120)
    assert (edges.camera_close_us, edges.strobe_off_us) == (1120, 1320)


@pytest.mark.parametrize(
    ("times", "lead_s", "words"),
    [
        ([1.0, 1.05], 0.0, r"trigger 1 at 1\.050000 s follows the one before by 0\.050000 s"),
        ([1.0, 0.5], 0.0, "trigger 1"),
        ([1.0, 1.1], 0.06, "trigger 1: its strobe would be lit at"),
        ([0.0005, 1.0], 0.0, "500 us before the start"),
    ],
)
def test_what_a_controller_cannot_do_is_refused(
    times: list[float], lead_s: float, words: str
) -> None:
    with pytest.raises(PlanError, match=words):
        trigger_table(times, 2e-3, lead_s, 0.1)


def test_an_exposure_of_nothing_is_refused() -> None:
    with pytest.raises(PlanError, match="edges"):
        trigger_edges(1e-7, 0.0)
    with pytest.raises(PlanError, match="edges"):
        trigger_edges(1e-3, -1e-4)


def test_the_file_holds_absolute_and_relative_edges(tmp_path: Path) -> None:
    settings = imaging_settings(*survey())
    rows = trigger_table(
        [3600.0, 3602.35],
        settings.exposure_s,
        settings.strobe_lead_s,
        settings.shortest_interval_s,
    )
    write_timetable(tmp_path / "triggers.csv", rows)
    with (tmp_path / "triggers.csv").open() as file:
        read = list(csv.DictReader(file))
    assert tuple(read[0]) == HEADER
    assert read[1]["trigger_us"] == "3602350000"
    for line in read:
        open_us = int(line["camera_close_us"]) - int(line["camera_open_us"])
        assert open_us == round(settings.exposure_s * 1e6)
        for edge in ("strobe_on", "camera_open", "camera_close", "strobe_off"):
            relative = int(line[f"{edge}_rel_us"])
            assert int(line[f"{edge}_us"]) == int(line["trigger_us"]) + relative
