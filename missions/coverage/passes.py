"""Which pass over the area each picture belongs to, where the log does not say."""

import math

import numpy as np
from numpy.typing import NDArray

from alice_survey.base.frames import Array
from missions.coverage.stations import Stations
from missions.values.plan_file import Plan

_ALIKE_RAD = math.radians(45.0)
"""A vehicle that crabs or yaws by less than this still flies its line (inferred: half way to a line
across)."""
_LEAST_RUN = 3
"""Pictures that make a straight run of their own."""


def assign_lines(stations: Stations, plan: Plan) -> NDArray[np.intp]:
    """The line of each station, (S,).

    A station belongs to the plan's line that it is nearest to, if it is within half a spacing of
    it, beyond its ends by no more than a step, and along it either way. Of what is left, runs of
    three pictures or more on one course without a pause count as lines of their own, numbered on
    from the plan's; the rest is -1: seen, but on no line.
    """
    line = np.full(len(stations), -1, dtype=np.intp)
    nearest_m = np.full(len(stations), plan.line_spacing_m / 2 + 1e-9)
    heading = stations.attitude_rad[:, 2]
    step_m = plan.station_spacing_m
    for index, planned in enumerate(plan.lines):
        ahead = np.array([math.cos(planned.heading_rad), math.sin(planned.heading_rad)])
        off = stations.glass_ne - planned.start_ne_m
        along, across = off @ ahead, np.abs(off @ np.array([-ahead[1], ahead[0]]))
        here = (along >= -step_m) & (along <= planned.length_m + step_m)
        here &= np.abs(np.cos(heading - planned.heading_rad)) >= math.cos(_ALIKE_RAD)
        here &= across < nearest_m
        line[here] = index
        nearest_m[here] = across[here]
    return _with_runs(line, stations, plan)


def _with_runs(line: NDArray[np.intp], stations: Stations, plan: Plan) -> NDArray[np.intp]:
    """Number straight runs of stations that belong to no line."""
    result = line.copy()
    following = len(plan.lines)
    for run in _runs(line, stations, 3.0 * plan.station_spacing_m):
        if len(run) >= _LEAST_RUN:
            result[run] = following
            following += 1
    return result


def _runs(line: NDArray[np.intp], stations: Stations, longest_m: float) -> list[list[int]]:
    """Consecutive stations of no line, near one another and on one heading."""
    places: Array = stations.glass_ne
    heading = stations.attitude_rad[:, 2]
    runs: list[list[int]] = []
    for i in np.flatnonzero(line < 0).tolist():
        last = runs[-1] if runs else None
        if (
            last is not None
            and last[-1] == i - 1
            and math.dist(places[i], places[i - 1]) <= longest_m
            and math.cos(heading[i] - heading[last[0]]) >= math.cos(_ALIKE_RAD)
        ):
            last.append(i)
        else:
            runs.append([i])
    return runs
