"""When the trigger controller opens cameras and lights strobes: edges in whole microseconds.

A trigger's time is the middle of its exposure, as everywhere in a survey. The strobe is lit before
the cameras open and goes out after they close, by its lead.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from alice_survey.base.artefacts import write_csv
from alice_survey.base.errors import PlanError

_US = 1_000_000
HEADER = (
    "trigger", "trigger_us", "strobe_on_us", "camera_open_us", "camera_close_us", "strobe_off_us",
    "strobe_on_rel_us", "camera_open_rel_us", "camera_close_rel_us", "strobe_off_rel_us",
)  # fmt: skip
"""Columns of the time table: times since the start, then the same relative to the trigger."""


@dataclass(frozen=True, kw_only=True)
class Edges:
    """Edges relative to a trigger, us."""

    strobe_on_us: int
    camera_open_us: int
    camera_close_us: int
    strobe_off_us: int

    def __post_init__(self) -> None:
        order = (
            self.strobe_on_us, self.camera_open_us, self.camera_close_us, self.strobe_off_us
        )  # fmt: skip
        if list(order) != sorted(order) or self.camera_open_us == self.camera_close_us:
            raise PlanError(
                f"edges {order} us: the strobe must be lit before the camera opens and after it "
                "closes; raise the exposure above 1 us and strobe_lead_s to 0 or more"
            )


@dataclass(frozen=True, kw_only=True)
class TriggerRow:
    """Edges of one trigger, us since the start."""

    trigger: int
    """Number of the trigger, from 0."""
    trigger_us: int
    """The middle of the exposure."""
    edges: Edges

    @property
    def strobe_on_us(self) -> int:
        """Rising edge of the strobes."""
        return self.trigger_us + self.edges.strobe_on_us

    @property
    def camera_open_us(self) -> int:
        """Rising edge of the cameras."""
        return self.trigger_us + self.edges.camera_open_us

    @property
    def camera_close_us(self) -> int:
        """Falling edge of the cameras."""
        return self.trigger_us + self.edges.camera_close_us

    @property
    def strobe_off_us(self) -> int:
        """Falling edge of the strobes."""
        return self.trigger_us + self.edges.strobe_off_us


def trigger_edges(exposure_s: float, lead_s: float) -> Edges:
    """Edges of one trigger; the exposure is a whole number of us, the lead rounded up to one.

    Raises:
        PlanError: the exposure is shorter than 1 us or the lead negative.
    """
    exposure_us, lead_us = round(exposure_s * _US), math.ceil(lead_s * _US - 1e-6)
    before = exposure_us // 2
    after = exposure_us - before
    return Edges(
        strobe_on_us=-before - lead_us,
        camera_open_us=-before,
        camera_close_us=after,
        strobe_off_us=after + lead_us,
    )


def trigger_table(
    times_s: Sequence[float], exposure_s: float, lead_s: float, shortest_interval_s: float
) -> list[TriggerRow]:
    """The time table of some triggers.

    Args:
        times_s: middles of the exposures since the start, rising.
        exposure_s: of the cameras.
        lead_s: of the strobes before the exposure and after it.
        shortest_interval_s: of the cameras and the controller.

    Raises:
        PlanError: a trigger follows another too soon, overlaps it, or its strobe would have to be
            lit before the start; the message names it.
    """
    edges = trigger_edges(exposure_s, lead_s)
    rows = [
        TriggerRow(trigger=i, trigger_us=round(t * _US), edges=edges) for i, t in enumerate(times_s)
    ]
    # Rounding moves each trigger by half a microsecond at most.
    least_us = round(shortest_interval_s * _US) - 1
    for before, row in pairwise(rows):
        apart_us = row.trigger_us - before.trigger_us
        if apart_us < least_us:
            raise PlanError(
                f"trigger {row.trigger} at {row.trigger_us / _US:.6f} s follows the one before by "
                f"{apart_us / _US:.6f} s; the shortest interval is {shortest_interval_s:g} s: "
                "lower speed_mps or forward_overlap"
            )
        if row.strobe_on_us <= before.strobe_off_us:
            raise PlanError(
                f"trigger {row.trigger}: its strobe would be lit at {row.strobe_on_us} us, before "
                f"it goes out at {before.strobe_off_us} us: lower strobe_lead_s or allowed_blur_px"
            )
    if rows and rows[0].strobe_on_us < 0:
        raise PlanError(
            f"the first trigger, at {times_s[0]:.6f} s, needs its strobe "
            f"{-rows[0].strobe_on_us} us before the start: begin later"
        )
    return rows


def write_timetable(path: Path, rows: Sequence[TriggerRow]) -> None:
    """Write a time table as CSV with the columns `HEADER`."""
    write_csv(
        path,
        HEADER,
        [
            [
                row.trigger, row.trigger_us, row.strobe_on_us, row.camera_open_us,
                row.camera_close_us, row.strobe_off_us, row.edges.strobe_on_us,
                row.edges.camera_open_us, row.edges.camera_close_us, row.edges.strobe_off_us,
            ]
            for row in rows
        ],
    )  # fmt: skip
