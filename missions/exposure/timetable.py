"""When the trigger controller opens cameras and lights strobes: edges in whole microseconds.

A trigger's time is the middle of its exposure, as everywhere in a survey. The strobe is lit before
the cameras open and goes out after they close, by its lead.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import write_csv
from alice_survey.core.errors import PlanError

_US = 1_000_000
HEADER = (
    "trigger", "trigger_us", "strobe_on_us", "camera_open_us", "camera_close_us", "strobe_off_us",
    "strobe_on_rel_us", "camera_open_rel_us", "camera_close_rel_us", "strobe_off_rel_us",
)  # fmt: skip
"""Columns of the time table: times since the start, then the same relative to the trigger."""


def trigger_edges(exposure_s: float, lead_s: float) -> NDArray[np.int64]:
    """Edges of one trigger: strobe on, camera open, camera close, strobe off; us from its time.

    The exposure is a whole number of microseconds, the lead rounded up to one.

    Raises:
        PlanError: the exposure is shorter than 1 us or the lead negative.
    """
    exposure_us, lead_us = round(exposure_s * _US), math.ceil(lead_s * _US - 1e-6)
    if exposure_us < 1 or lead_us < 0:
        raise PlanError(
            f"an exposure of {exposure_s:g} s with the strobe lit {lead_s:g} s before it: raise "
            "the exposure above 1 us and strobe_lead_s to 0 or more"
        )
    before = exposure_us // 2
    after = exposure_us - before
    return np.array([-before - lead_us, -before, after, after + lead_us])


def trigger_table(
    times_s: Sequence[float], exposure_s: float, lead_s: float, shortest_interval_s: float
) -> NDArray[np.int64]:
    """The time table of some triggers, (T, 10) with the columns `HEADER`.

    Args:
        times_s: middles of the exposures since the start, rising.
        exposure_s: of the cameras.
        lead_s: of the strobes before the exposure and after it.
        shortest_interval_s: of the cameras and the controller.

    Raises:
        PlanError: a trigger follows another too soon, overlaps it, or its strobe would have to be
            lit before the start; the message names it.
    """
    relative = trigger_edges(exposure_s, lead_s)
    trigger_us = np.round(np.asarray(times_s, dtype=np.float64) * _US).astype(np.int64)
    edges = trigger_us[:, None] + relative
    # Rounding moves each trigger by half a microsecond at most.
    soon = np.flatnonzero(np.diff(trigger_us) < round(shortest_interval_s * _US) - 1)
    if len(soon):
        i = int(soon[0]) + 1
        raise PlanError(
            f"trigger {i} at {trigger_us[i] / _US:.6f} s follows the one before by "
            f"{(trigger_us[i] - trigger_us[i - 1]) / _US:.6f} s; the shortest interval is "
            f"{shortest_interval_s:g} s: lower speed_mps or forward_overlap"
        )
    lit = np.flatnonzero(edges[1:, 0] <= edges[:-1, 3])
    if len(lit):
        i = int(lit[0]) + 1
        raise PlanError(
            f"trigger {i}: its strobe would be lit at {edges[i, 0]} us, before it goes out at "
            f"{edges[i - 1, 3]} us: lower strobe_lead_s or allowed_blur_px"
        )
    if len(edges) and edges[0, 0] < 0:
        raise PlanError(
            f"the first trigger, at {times_s[0]:.6f} s, needs its strobe {-edges[0, 0]} us before "
            "the start: begin later"
        )
    count = len(edges)
    return np.column_stack([np.arange(count), trigger_us, edges, np.tile(relative, (count, 1))])


def write_timetable(path: Path, table: NDArray[np.int64]) -> None:
    """Write a time table as CSV with the columns `HEADER`."""
    write_csv(path, HEADER, table.tolist())
