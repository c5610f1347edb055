"""A dive that is followed by its growing navigation log, certified again every few seconds.

The log is read and certified as `plan check` does, as a whole, so that at the end of a dive both
say the same. Lines that are left count as flown exactly: what they will cover is not a hole.
"""

import json
import math
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import need_stage
from alice_survey.core.config import SurveyConfig
from alice_survey.core.errors import NavigationError, PlanError, collected_by
from alice_survey.core.frames import Array
from alice_survey.kit.words import count, share
from missions.coverage.certificate import Certificate, certificate
from missions.coverage.dive_record import (
    MIN_RUN,
    DiveRecord,
    glass_places,
    read_growing_log,
    record_of_log,
)
from missions.coverage.holes import Hole, find_holes
from missions.coverage.raster import north_up
from missions.coverage.stations import (
    Stations,
    at_once,
    plan_pattern,
    stations_of_lines,
    stations_of_plan,
)
from missions.fly.check import rig_of
from missions.fly.refly import dive_means, holes_plan, write_refly
from missions.logs.navigation_csv import READINGS, NavigationLog
from missions.plan.strength import survey_costs
from missions.route.energy import usable_wh
from missions.values.costs import Costs, leg_costs
from missions.values.plan_file import Plan, read_plan

SEEN, STEREO, AT_OVERLAP, OUTSIDE = 1, 2, 4, 255
"""Bits of what a pixel of the coverage is: in some picture, in all cameras' at once, at the overlap
requested; and a pixel outside of the survey area."""
_MIN_UPDATE_S, _BUSY = 2.0, 4.0
"""The log is read again after this time at the earliest, and no more often than after so many times
the time that it took."""
_MIN_FIX_S, _MAX_FIXES = 0.5, 4000
_MAX_LISTED = 200
_MAX_SIDE_PX = 1024
_SURFACE_M = 0.5
"""A vehicle deeper than this is on its dive (inferred: below what waves do at the surface)."""
_MIN_PACE_S = 60.0
"""Planned time after which the pace is measured."""
_SILENT_S = 1.0


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How far along the plan a dive is."""

    dive: int
    """Index of the dive."""
    line: int
    """The plan's line that was begun last, -1 before the first."""
    is_on_line: bool
    flown_share: float
    """Share of that line that is behind the vehicle."""
    left: tuple[int, ...]
    """Lines of the dive after that one, in the order of flight."""
    spent_j: float
    """Planned energy to there."""
    left_s: float
    """Planned seconds from there to the end of the route."""
    left_j: float
    pace: float
    """True time over planned time so far."""


def dive_progress(
    plan: Plan, costs: Costs, stations: Stations, end_s: float, dive: int | None = None
) -> Progress:
    """How far along a plan the pictures of a dive go.

    A line counts as begun with half of its pictures, or with a few as the line of the last ones.

    Args:
        plan: with the dives.
        costs: of its legs.
        stations: of the dive so far, with times.
        end_s: time of the last row of the log.
        dive: its index; None: that of the line begun last.
    """
    times_s: Array = np.asarray(stations.time_s, dtype=np.float64)
    planned = (stations.line >= 0) & (stations.line < len(plan.lines))
    numbers, counts = np.unique(stations.line[planned], return_counts=True)
    latest = int(stations.line[planned][-1]) if planned.any() else -1
    begun = {
        int(number)
        for number, count in zip(numbers, counts, strict=True)
        if count >= plan.lines[number].stations / 2 or (number == latest and count >= MIN_RUN)
    }
    if dive is None:
        flown = [i for i, one in enumerate(plan.dives) if begun & set(_lines_of(one.route.legs))]
        dive = flown[-1] if flown else 0
    legs = plan.dives[dive].route.legs
    order = _lines_of(legs)
    energy_j, time_s = leg_costs(plan.dives[dive].route, costs)
    last = max((i for i, number in enumerate(order) if number in begun), default=-1)
    line, here, flown_share, is_on_line, pace = -1, 0, 0.0, False, 1.0
    if last >= 0:
        line = order[last]
        here = next(i for i, leg in enumerate(legs) if leg.line == line)
        on_line = stations.line == line
        along = np.array([math.cos(legs[here].heading_rad), math.sin(legs[here].heading_rad)])
        reached_m = float(((stations.glass_ne[on_line] - legs[here].start_ne_m) @ along).max())
        flown_share = min(max(reached_m / legs[here].length_m, 0.0), 1.0)
        since_s = end_s - float(times_s[on_line][-1])
        is_on_line = latest == line and flown_share < 1.0 and since_s <= 2 * plan.interval_s
        first = next(i for i, leg in enumerate(legs) if leg.line in begun)
        planned_s = float(time_s[first:here].sum() + flown_share * time_s[here])
        true_s = float(times_s[on_line][-1] - times_s[stations.line == legs[first].line][0])
        if planned_s >= _MIN_PACE_S:
            pace = min(max(true_s / planned_s, 0.5), 3.0)
    spent_s, spent_j = (
        float(cost[:here].sum() + flown_share * cost[here]) for cost in (time_s, energy_j)
    )
    return Progress(
        dive=dive,
        line=line,
        is_on_line=is_on_line,
        flown_share=flown_share,
        left=tuple(order[last + 1 :]),
        spent_j=spent_j,
        left_s=float(time_s.sum()) - spent_s,
        left_j=float(energy_j.sum()) - spent_j,
        pace=pace,
    )


def _lines_of(legs: Any) -> list[int]:
    return [leg.line for leg in legs if leg.line >= 0]


def stations_to_come(plan: Plan, progress: Progress) -> Stations:
    """The pictures that are still to be taken, flown exactly: those of other dives too."""
    numbers = [
        number
        for index, dive in enumerate(plan.dives)
        for number in (
            progress.left if index == progress.dive else range(dive.first_line, dive.last_line + 1)
        )
    ]
    skipped = [0] * len(numbers)
    if progress.line >= 0:
        count = plan.lines[progress.line].stations
        numbers.append(progress.line)
        skipped.append(math.floor(progress.flown_share * (count - 1) + 0.5) + 1)
    lines = [plan.lines[number] for number in numbers]
    stations = stations_of_lines(lines, plan.altitude_m)
    place = np.concatenate([np.arange(0), *(np.arange(line.stations) for line in lines)])
    which = stations.line
    stations = replace(stations, line=np.array(numbers, dtype=np.intp)[which])
    return stations.some(place >= np.array(skipped, dtype=np.intp)[which])


@dataclass(frozen=True, kw_only=True, eq=False)
class DiveView:
    """What a log says at one moment."""

    record: DiveRecord
    progress: Progress
    flown: Certificate
    expected: Certificate
    """With all that is left flown exactly."""
    holes: tuple[Hole, ...]
    """That this leaves, worst first."""
    fixes: Array
    """(F, 6) seconds since the first row, north and east of the glass, altitude, heading, depth."""
    elapsed_s: float
    """Under water."""
    is_up: bool
    """Whether the vehicle is back at the surface."""
    warnings: tuple[str, ...]


class FollowedDive:
    """A dive and its growing log; for any number of threads."""

    def __init__(
        self, workspace: Path, config: SurveyConfig, log: str | Path, *, dive: int | None = None
    ) -> None:
        """Read the plan; of the log nothing is read yet.

        Args:
            workspace: with the plan.
            config: the survey.
            log: navigation CSV that is appended to; it need not be there yet.
            dive: which dive of the plan, from 1 on; None: found by its lines.

        Raises:
            AliceError: there is no plan, or the log cannot be one.
        """
        self.log = Path(log)
        if str(log).partition(":")[0] in ("udp", "mavlink", "ros"):
            raise NavigationError(
                f"{log}: links are no longer read: have the navigation written to a CSV that grows"
            )
        if self.log.is_dir():
            raise NavigationError(f"{log}: is a folder: give the navigation CSV that grows")
        self.config = config
        self.plan = read_plan(need_stage(workspace, "plan", "plan") / "plan.json")
        if dive is not None and not 1 <= dive <= len(self.plan.dives):
            raise PlanError(f"dive {dive} was requested; the plan has {len(self.plan.dives)}")
        self._dive = None if dive is None else dive - 1
        self.rig = rig_of(workspace, config.camera, config.water)
        self.costs = survey_costs(config)
        self._pattern = plan_pattern(self.plan, self.rig)
        self._planned = certificate(
            self.plan.area, self.rig, stations_of_plan(self.plan), self._pattern
        )
        self.lock = threading.RLock()
        self.view: DiveView | None = None
        self.proposal: Plan | None = None
        self.version = 0
        """Counts views."""
        self.fault: str | None = None
        """Why the log cannot be used as it is."""
        self._file_key: tuple[int, int, int] | None = None
        self._grew_s: float | None = None
        self._due_s = -math.inf
        self._patience_s = math.inf

    def update(self, wall_s: float | None = None) -> bool:
        """Read and certify the log again where it has grown and it is time.

        Args:
            wall_s: time of this machine's steady clock.

        Returns:
            Whether there is a new view or fault.
        """
        wall_s = time.monotonic() if wall_s is None else wall_s
        with self.lock:
            key = self._key()
            if key == self._file_key:
                return False
            self._grew_s = wall_s
            if wall_s < self._due_s:
                return False
            began = time.perf_counter()
            warnings: list[str] = []
            before = self.fault
            try:
                with collected_by(lambda _, text: warnings.append(text)):
                    self.view = self._look(wall_s, warnings)
                self.fault, self.version = None, self.version + 1
            except NavigationError as error:
                self.fault = str(error)
            self._file_key = key
            self._due_s = wall_s + max(_MIN_UPDATE_S, _BUSY * (time.perf_counter() - began))
            return self.fault is None or self.fault != before

    def _key(self) -> tuple[int, int, int] | None:
        try:
            found = self.log.stat()
        except OSError:
            return None
        return found.st_ino, found.st_size, found.st_mtime_ns

    def _look(self, wall_s: float, warnings: list[str]) -> DiveView:
        nav = read_growing_log(self.log)
        self._patience_s = nav.max_gap_s + _MIN_UPDATE_S + _SILENT_S
        plan = self.plan
        record = record_of_log(self.log, nav, plan, self.rig)
        progress = dive_progress(
            plan, self.costs, record.stations, float(nav.time_s[-1]), self._dive
        )
        both = at_once([record.stations, stations_to_come(plan, progress)])
        flown, expected = (
            certificate(plan.area, self.rig, stations, self._pattern,
                        cell_m=self._planned.grid.cell_m)
            for stations in (record.stations, both)
        )  # fmt: skip
        depth_m = nav.columns.get("depth_m", np.full(len(nav.time_s), np.nan))
        under = np.flatnonzero(~(depth_m <= _SURFACE_M))
        elapsed_s = float(nav.time_s[under[-1]] - nav.time_s[under[0]]) if len(under) else 0.0
        return DiveView(
            record=record,
            progress=progress,
            flown=flown,
            expected=expected,
            holes=find_holes(expected),
            fixes=self._fixes(nav),
            elapsed_s=elapsed_s,
            is_up=progress.line >= 0 and bool(depth_m[-1] <= _SURFACE_M),
            warnings=tuple(warnings),
        )

    def _fixes(self, nav: NavigationLog) -> Array:
        chosen = np.flatnonzero(np.diff(np.floor(nav.time_s / _MIN_FIX_S), append=np.inf) > 0)
        chosen = chosen[:: -(-len(chosen) // _MAX_FIXES)]
        nothing = np.full(len(nav.time_s), np.nan)
        at = {name: nav.columns.get(name, nothing)[chosen] for name in READINGS}
        angles = np.deg2rad(np.nan_to_num(np.column_stack([at[name] for name in READINGS[3:6]])))
        glass = glass_places(at, angles, self.plan, self.rig)
        return np.column_stack(
            [nav.time_s[chosen] - nav.time_s[0], glass[:, :2], at["altitude_m"],
             at["heading_deg"], at["depth_m"]]
        )  # fmt: skip

    def propose(self) -> Plan | None:
        """Plan the holes again, as `plan check` does; None where there are none or none can be."""
        with self.lock:
            view = self.view
            self.proposal = None
            if view is not None and view.holes:
                try:
                    with collected_by(lambda *_: None):
                        config = self.config
                        means = dive_means(config.plan, config.vehicle, self.costs)
                        self.proposal = holes_plan(
                            self.plan, self.rig, view.expected, view.holes, means
                        )
                except PlanError:
                    return None
            return self.proposal

    @cached_property
    def _frame(self) -> tuple[Array, tuple[float, float, float, float]]:
        """Places, (H, W, 2), of pixels of the coverage, and south, west, north, east, metres."""
        return north_up(self.plan.area, self._planned.grid.cell_m, _MAX_SIDE_PX)

    def coverage_classes(self) -> NDArray[np.uint8]:
        """What is seen so far, north up: (H, W) bits."""
        grid = self._planned.grid
        with self.lock:
            seen = None if self.view is None else self.view.flown
        classes = np.full(grid.shape, OUTSIDE, np.uint8)
        if seen is not None:
            bits = SEEN * (seen.pictures > 0) + STEREO * (seen.pairs > 0)
            bits = bits + AT_OVERLAP * seen.at_overlap
            classes = np.where(seen.inside, bits.astype(np.uint8), np.uint8(OUTSIDE))
        return grid.sample(classes, self._frame[0], OUTSIDE)

    def snapshot(self, wall_s: float | None = None) -> dict[str, Any]:
        """All figures as JSON values; numbers that are not finite are None."""
        wall_s = time.monotonic() if wall_s is None else wall_s
        with self.lock:
            age_s = None if self._grew_s is None else wall_s - self._grew_s
            state: dict[str, Any] = {
                "source": str(self.log), "fault": self.fault, "version": self.version, "fix": None,
                "silent_s": age_s, "patience_s": self._patience_s,
                "is_silent": age_s is not None and age_s > self._patience_s,
                "bounds": self._frame[1],
                "proposal": self._proposal_json(),
            }  # fmt: skip
            if self.view is not None:
                state |= self._figures(self.view)
        found: dict[str, Any] = json.loads(json.dumps(state), parse_constant=lambda _: None)
        return found

    def _figures(self, view: DiveView) -> dict[str, Any]:
        plan, progress = self.plan, view.progress
        down_s, down_j = (
            cost(plan.seafloor_depth_m - plan.altitude_m) / 2
            for cost in (self.costs.dive_s, self.costs.dive_j)
        )
        ways = 0.0 if view.is_up else 2.0 if progress.line < 0 else 1.0
        finish_s = 0.0 if view.is_up else progress.pace * (progress.left_s + ways * down_s)
        finish_wh = 0.0 if view.is_up else progress.pace * (progress.left_j + ways * down_j) / 3600
        spent_wh = progress.pace * (progress.spent_j + (2.0 - ways) * down_j) / 3600.0
        dive_s = math.inf if self.config.plan.dive_s is None else self.config.plan.dive_s
        keys = ("dive_s", "north_m", "east_m", "altitude_m", "heading_deg", "depth_m")
        lines = self.lines()
        return {
            "phase": self._phase(view),
            "fix": dict(zip(keys, view.fixes[-1].tolist(), strict=True)),
            "dive": {"number": progress.dive + 1, "of": len(plan.dives)},
            "lines": {
                "done": sum(line["state"] == "done" for line in lines),
                "left": sum(line["state"] != "done" for line in lines),
            },
            "elapsed_s": view.elapsed_s,
            "pace": progress.pace,
            "finish": {"time_s": finish_s, "energy_wh": finish_wh},
            "spare": {
                "time_s": dive_s - view.elapsed_s - finish_s,
                "energy_wh": usable_wh(self.config.vehicle) - spent_wh - finish_wh,
            },
            "coverage": {
                "seen": view.flown.covered_share,
                "stereo": view.flown.stereo_share,
                "at_overlap": view.flown.share_at_overlap,
                "expected_at_overlap": view.expected.share_at_overlap,
            },
            "holes": {
                "count": len(view.holes),
                "area_m2": sum(hole.area_m2 for hole in view.holes),
                "unseen_m2": sum(hole.unseen_m2 for hole in view.holes),
            },
            "pictures": view.flown.stations,
            "left_out": view.record.left_out,
            "gaps": len(view.record.gaps),
            "warnings": list(view.warnings),
        }

    def _phase(self, view: DiveView) -> str:
        progress = view.progress
        if view.is_up:
            return "back at the surface"
        if progress.line < 0:
            return "at the surface" if view.elapsed_s == 0.0 else "on the way down"
        if progress.is_on_line:
            return f"on line {progress.line + 1}"
        return "between lines" if progress.left else "on the way home"

    def _proposal_json(self) -> dict[str, Any] | None:
        plan = self.proposal
        if plan is None:
            return None
        route = plan.dives[0].route
        along = np.linspace(0.0, route.length_m, max(2, round(route.length_m / 0.25)))
        return {
            "lines": [
                {"start_ne": list(line.start_ne_m), "end_ne": list(line.end_ne_m)}
                for line in plan.lines
            ],
            "route_ne": np.round(route.places(along), 3).tolist(),
            "time_s": plan.duration_s,
            "energy_wh": plan.energy_wh,
            "holes_share": plan.coverage,
        }

    def track(self, after_s: float = -math.inf) -> list[list[float | None]]:
        """Fixes since one, as of `DiveView.fixes`; None is not known."""
        with self.lock:
            fixes = np.empty((0, 6)) if self.view is None else self.view.fixes
        later = np.round(fixes[fixes[:, 0] > after_s + 1e-9], 3).tolist()
        return [[v if math.isfinite(v) else None for v in row] for row in later]

    def lines(self) -> list[dict[str, Any]]:
        """The lines of the dive, and what became of them."""
        with self.lock:
            progress = None if self.view is None else self.view.progress
        if progress is None:
            return []
        return [
            {
                "number": number + 1,
                "kind": self.plan.lines[number].kind,
                "start_ne": list(self.plan.lines[number].start_ne_m),
                "end_ne": list(self.plan.lines[number].end_ne_m),
                "state": "now" if progress.is_on_line and number == progress.line
                else "left" if number in progress.left else "done",
            }
            for number in _lines_of(self.plan.dives[progress.dive].route.legs)
        ]  # fmt: skip

    def holes(self) -> list[dict[str, Any]]:
        """The holes with their outlines, worst first."""
        with self.lock:
            holes = () if self.view is None else self.view.holes[:_MAX_LISTED]
        return [
            hole.to_json()
            | {
                "rings_ne": [
                    np.round(np.asarray(part.exterior.coords), 3).tolist()
                    for part in hole.outline.geoms
                ]
            }
            for hole in holes
        ]


def follow_report(
    workspace: Path,
    config: SurveyConfig,
    log: str,
    *,
    every_s: float | None = None,
    dive: int | None = None,
    out: Path | None = None,
) -> Iterator[tuple[str, dict[str, Any]]]:
    """`alice-survey plan follow`: the state of a dive, once or again and again.

    Args:
        workspace: with the plan.
        config: the survey.
        log: navigation CSV that is appended to.
        every_s: seconds between states; None: once, of what the file holds now.
        dive: which dive of the plan, from 1 on.
        out: folder for a plan over the holes with its exports, written where there are some.

    Yields:
        Text, and the same as JSON values.

    Raises:
        AliceError: there is no plan, or the log cannot be used.
    """
    followed = FollowedDive(workspace, config, log, dive=dive)
    while True:
        if followed.update() and followed.fault is None:
            followed.propose()
        if every_s is None and followed.fault is not None:
            raise NavigationError(followed.fault)
        state = followed.snapshot() | {"hole_list": followed.holes()}
        text = state_text(state)
        if out is not None and followed.proposal is not None:
            words, _ = write_refly(
                out, followed.proposal, followed.rig, config.camera, config.water, config.plan
            )
            text += f"\n{out}: {words}"
            state["written"] = str(out)
        yield text, state
        if every_s is None:
            return
        time.sleep(every_s)


def state_text(state: dict[str, Any]) -> str:
    """The state in a few lines."""
    if state["fix"] is None:
        return f"{state['source']}: {state['fault'] or 'no position yet'}"
    finish, spare, coverage = state["finish"], state["spare"], state["coverage"]
    lines, holes, proposal = state["lines"], state["holes"], state["proposal"]
    spared = [
        _minutes(spare["time_s"]) if spare["time_s"] is not None else "",
        f"{spare['energy_wh']:.0f} Wh" if spare["energy_wh"] is not None else "",
    ]
    rows = [
        f"{state['source']}: {state['phase']}, {_minutes(state['elapsed_s'])} under water"
        + (f"; no news for {state['silent_s']:.0f} s" if state["is_silent"] else ""),
        f"  lines: {lines['done']} done, {lines['left']} left; {_minutes(finish['time_s'])} to the "
        f"surface, {finish['energy_wh']:.0f} Wh; to spare: {' and '.join(filter(None, spared))}",
        f"  seen {share(coverage['seen'], 1)}, in stereo {share(coverage['stereo'], 1)}, at the "
        f"requested overlap {share(coverage['at_overlap'], 1)}; "
        f"{share(coverage['expected_at_overlap'], 1)} when the lines left are flown",
        f"  holes behind it: {holes['count']}, {holes['area_m2']:.2f} m2, of which "
        f"{holes['unseen_m2']:.2f} m2 in no picture",
        *(f"  left out: {count} {reason}" for reason, count in state["left_out"].items()),
        *(f"  {warning}" for warning in state["warnings"]),
    ]
    if state["fault"]:
        rows.append(f"  {state['fault']}")
    if proposal is not None:
        rows.append(
            f"  to fly the holes again: {count(len(proposal['lines']), 'line')}, "
            f"{_minutes(proposal['time_s'])} and {proposal['energy_wh']:.1f} Wh from home to home; "
            f"then {share(proposal['holes_share'], 1)} of them are at that overlap"
        )
    return "\n".join(rows)


def _minutes(seconds: float) -> str:
    minutes, rest = divmod(round(abs(seconds)), 60)
    return f"{'-' if seconds < 0 else ''}{minutes}:{rest:02d} min"
