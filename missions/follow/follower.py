"""A dive that is followed: what its navigation says of coverage, progress, holes and time left."""

import math
from collections import Counter, deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.config import PlanConfig, SurveyConfig
from alice_survey.core.errors import PlanError
from alice_survey.core.frames import Array
from camera_calib.rig import Rig
from missions.coverage.certificate import Certificate, certificate
from missions.coverage.dive_record import glass_places, planned_lines
from missions.coverage.growing import GrowingCoverage
from missions.coverage.holes import Hole, find_holes
from missions.coverage.stations import Stations, at_once, plan_pattern, stations_of_plan
from missions.follow.pictures import PictureTrack
from missions.follow.progress import Progress, TimeLeft
from missions.follow.proposal import Budget, Flying, Proposal, propose
from missions.follow.rows import (
    ALTITUDE,
    DEPTH,
    HEADING,
    LATITUDE,
    LONGITUDE,
    PITCH,
    ROLL,
    TIME,
    Piece,
    SteadyTimes,
)
from missions.logs.navigation_csv import READINGS
from missions.plan.strength import survey_costs
from missions.route.energy import craft_of, usable_wh
from missions.route.flyable import without_stops
from missions.values.costs import Costs
from missions.values.legs import Route
from missions.values.plan_file import Plan

SURE_SIGMAS = 2.0
"""The rest of the plan counts with so many of its sigmas before holes are flown."""
_EVERY_S = 0.5
"""Fixes that are shown, and by which progress is judged, are no closer."""
_UNDER_M = 0.5
"""A vehicle deeper than this is on its dive (inferred: below what waves do at the surface)."""
_SHOWN = 4000
"""Fixes of the track that are kept: when there are more every other one goes."""
_OTHER_LINE = 1_000_000
"""Lines from here on are of a proposal, and none of the plan's."""


@dataclass(frozen=True, kw_only=True)
class Fix:
    """Where the vehicle was, and when; NaN is not known."""

    time_s: float
    """On the clock of the log."""
    dive_s: float
    """Since the first fix."""
    north_m: float
    """North of the left port's glass."""
    east_m: float
    depth_m: float
    """Depth of the body's origin."""
    altitude_m: float
    heading_deg: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Limits:
    """What a dive may take."""

    dive_s: float
    """May be infinite."""
    usable_wh: float


@dataclass
class _Clock:
    """Seconds since the first fix, over logs that begin again."""

    passed_s: float = 0.0
    first_s: float | None = None
    latest_s: float = 0.0
    went_under_s: float | None = None
    came_up_s: float | None = None

    def begin_again(self) -> None:
        if self.first_s is not None:
            self.passed_s += self.latest_s - self.first_s
            self.first_s = None

    def dive_s(self, time_s: float) -> float:
        if self.first_s is None:
            self.first_s = time_s
        self.latest_s = time_s
        return self.passed_s + time_s - self.first_s


class DiveFollower:
    """A dive as far as it is known.

    Its methods are for one thread at a time.
    """

    def __init__(self, plan: Plan, rig: Rig, config: SurveyConfig, dive: int | None = None) -> None:
        """Nothing is known yet.

        Args:
            plan: what is flown.
            rig: the cameras in the survey's water.
            config: the survey.
            dive: which dive, from 1 on; None: found by its lines.

        Raises:
            PlanError: the plan lacks that dive.
            AliceError: what flying takes cannot be computed.
        """
        if dive is not None and not 1 <= dive <= len(plan.dives):
            raise PlanError(f"dive {dive} was requested; the plan has {len(plan.dives)}")
        self.plan, self.rig = plan, rig
        self.settings: PlanConfig = without_stops(config.plan, craft_of(config.vehicle))
        self.costs: Costs = survey_costs(config)
        self.limits = Limits(
            dive_s=math.inf if config.plan.dive_s is None else config.plan.dive_s,
            usable_wh=usable_wh(config.vehicle),
        )
        self._asked_dive = None if dive is None else dive - 1
        self.pattern = plan_pattern(plan, rig)
        planned = certificate(plan.area, rig, stations_of_plan(plan), self.pattern)
        self.planned_share = planned.share_at_overlap
        self.coverage = GrowingCoverage(plan.area, rig, self.pattern, planned.grid.cell_m)
        self.restart()

    def restart(self) -> None:
        """Forget the dive."""
        self.left_out: Counter[str] = Counter()
        self._times = SteadyTimes(self.left_out)
        self.pictures = PictureTrack(self.plan, self.rig)
        self.coverage.restart()
        self.progress = Progress(self.plan, self.costs, self._asked_dive)
        self.accepted: Proposal | None = None
        self.fix: Fix | None = None
        self.track: list[Fix] = []
        self.tail: deque[Fix] = deque(maxlen=600)
        """The latest fixes."""
        self._thinned_s = _EVERY_S
        self.gaps: deque[tuple[float, float]] = deque(maxlen=100)
        """Start and length of the latest gaps, seconds of the dive."""
        self.gap_count = 0
        self._clock = _Clock()
        self.version = 0
        """Counts changes of the coverage."""
        self._looked: tuple[tuple[Any, ...], Certificate, tuple[Hole, ...]] | None = None

    def add(self, pieces: list[Piece]) -> list[NDArray[np.intp]]:
        """Take what a source has sent.

        Returns:
            Windows of cells of the coverage that may have changed, (4,) first and last row and
            column each.
        """
        windows = []
        for sent in pieces:
            for piece in self._times.passed(sent):
                if piece.starts:
                    windows.append(self.coverage.add(self.pictures.begin_again()))
                    self._clock.begin_again()
                if len(piece.rows):
                    windows += self._take(piece.rows)
        windows = [window for window in windows if window[1] > window[0]]
        self.version += len(windows)
        return windows

    def _take(self, rows: Array) -> list[NDArray[np.intp]]:
        stations, again = self.pictures.add(rows)
        windows = []
        if again:
            self.coverage.restart()
            windows.append(np.array([0, self.coverage.grid.rows, 0, self.coverage.grid.columns]))
        windows.append(self.coverage.add(stations))
        located = rows[np.isfinite(rows[:, LATITUDE] + rows[:, LONGITUDE])]
        if len(located):
            self._move(located)
        return windows

    def _move(self, rows: Array) -> None:
        """Follow the vehicle along rows with positions."""
        times = rows[:, TIME]
        goes_on = self._clock.first_s is not None
        steps = np.diff(times, prepend=self._clock.latest_s if goes_on else times[0])
        self._clock.dive_s(float(times[0]))
        for i in np.flatnonzero(steps > self.pictures.longest_gap_s).tolist():
            start_s = self._clock.dive_s(float(times[i] - steps[i]))
            self.gaps.append((start_s, float(steps[i])))
            self.gap_count += 1
        # Rows of a fast log are looked at every half a second, and the last one.
        chosen = np.flatnonzero(np.diff(np.floor(times / _EVERY_S), append=np.inf) > 0)
        angles = np.deg2rad(np.nan_to_num(rows[chosen][:, [ROLL, PITCH, HEADING]]))
        at = {name: rows[chosen, 1 + i] for i, name in enumerate(READINGS)}
        glass = glass_places(at, angles, self.plan, self.rig)
        for row, place in zip(rows[chosen], glass, strict=True):
            dive_s = self._clock.dive_s(float(row[TIME]))
            self.fix = Fix(
                time_s=float(row[TIME]), dive_s=dive_s, north_m=float(place[0]),
                east_m=float(place[1]), depth_m=float(row[DEPTH]),
                altitude_m=float(row[ALTITUDE]), heading_deg=float(row[HEADING]),
            )  # fmt: skip
            self._keep(self.fix)
            self._see_surface(self.fix)
            if self._is_low(self.fix):
                self.progress.add(dive_s, place[:2], math.radians(self.fix.heading_deg))

    def _is_low(self, fix: Fix) -> bool:
        """Whether the vehicle is near the depth of lines: going down and up it is over them too."""
        if math.isfinite(fix.altitude_m):
            return fix.altitude_m <= 2.0 * self.plan.altitude_m
        depth_m = self.plan.seafloor_depth_m - 2.0 * self.plan.altitude_m
        return not math.isfinite(fix.depth_m) or fix.depth_m >= depth_m

    def _see_surface(self, fix: Fix) -> None:
        clock = self._clock
        if clock.went_under_s is None:
            if not fix.depth_m <= _UNDER_M:
                clock.went_under_s = fix.dive_s
        elif fix.depth_m <= _UNDER_M:
            clock.came_up_s = fix.dive_s if clock.came_up_s is None else clock.came_up_s
        else:
            clock.came_up_s = None

    def _keep(self, fix: Fix) -> None:
        self.tail.append(fix)
        if not self.track or fix.dive_s - self.track[-1].dive_s >= self._thinned_s:
            self.track.append(fix)
            if len(self.track) > _SHOWN:
                self.track = self.track[::2]
                self._thinned_s *= 2.0

    @property
    def elapsed_s(self) -> float:
        """Time under water so far."""
        if self.fix is None or self._clock.went_under_s is None:
            return 0.0
        until_s = self._clock.came_up_s
        return (self.fix.dive_s if until_s is None else until_s) - self._clock.went_under_s

    @property
    def phase(self) -> str:
        """What the vehicle does, in words."""
        if self.fix is None:
            return "no fix yet"
        if self._clock.went_under_s is None:
            return "at the surface"
        if self._clock.came_up_s is not None and self.progress.has_begun:
            return "back at the surface"
        if not self.progress.has_begun:
            return "on the way down"
        if not self.progress.left:
            return "on the way home" if self._is_low(self.fix) else "on the way up"
        if not self.progress.is_on_route:
            return "off the route"
        line = self.progress.line
        if line >= 0:
            kind = self.progress.plan.lines[line].kind
            return f"on line {line + 1}" + ("" if kind == "survey" else f" ({kind})")
        return "between lines"

    def to_finish(self) -> TimeLeft:
        """What is left of the plan, and of a proposal that was accepted, to the surface."""
        if self._clock.came_up_s is not None and self.progress.has_begun:
            return TimeLeft(time_s=0.0, sigma_s=0.0, energy_wh=0.0)
        return self.progress.to_finish(self._surface_ways())

    def _surface_ways(self) -> float:
        """Ways down or up that are left: 2 at the surface before the dive, 0 after it."""
        depth_m = 0.0 if self.fix is None else self.fix.depth_m
        share = depth_m / (self.plan.seafloor_depth_m - self.plan.altitude_m)
        share = min(max(share, 0.0), 1.0) if math.isfinite(share) else 1.0
        if not self.progress.has_begun:
            return 2.0 - share
        return share if not self.progress.left else 1.0

    def to_spare(self) -> Budget:
        """What the dive has left beyond that."""
        finish = self.to_finish()
        left_s = self.limits.dive_s - self.elapsed_s
        left_wh = self.limits.usable_wh - self.progress.spent_wh()
        share = 1.0 if finish.time_s <= 0 else 1.0 + SURE_SIGMAS * finish.sigma_s / finish.time_s
        return Budget(
            time_s=left_s - finish.time_s - SURE_SIGMAS * finish.sigma_s,
            energy_wh=left_wh - finish.energy_wh * share,
        )

    def certificate(self) -> Certificate:
        """What has been seen, with all pictures up to the last row: as `plan check` finds it."""
        return self.coverage.certificate(self.pictures.rest())

    def expected(self) -> tuple[Certificate, tuple[Hole, ...]]:
        """What will be seen when all that is left was flown, and the holes that this leaves."""
        key = (self.version, self.progress.at_s // 2.0, self.progress.dive, id(self.accepted))
        if self._looked is None or self._looked[0] != key:
            found = self._with_more(None)
            self._looked = (key, found, find_holes(found))
        return self._looked[1], self._looked[2]

    def _with_more(self, more: Stations | None) -> Certificate:
        """What is seen when all that is left was flown, and more."""
        left = self.progress.to_come()
        of_others = left.line >= len(self.plan.lines)
        parts = [self.pictures.rest(), left.some(~of_others)]
        parts.append(self._renumbered(left.some(of_others), 0))
        if more is not None:
            parts.append(self._renumbered(more, _OTHER_LINE))
        return self.coverage.certificate(at_once(parts))

    def _renumbered(self, stations: Stations, add: int) -> Stations:
        """Stations of other lines, with the plan's lines where these go along one."""
        own = planned_lines(stations, self.plan)
        return replace(stations, line=np.where(own >= 0, own, stations.line + _OTHER_LINE + add))

    def propose(self, budget: Budget | None = None) -> Proposal | None:
        """Lines that close the holes; None where nothing fits, or there is nothing to close.

        Args:
            budget: what they may take; None: what the dive has to spare.
        """
        expected, holes = self.expected()
        budget = self.to_spare() if budget is None else budget
        if not holes or budget.time_s <= 0.0 or budget.energy_wh <= 0.0:
            return None
        return propose(self._flying(), expected, holes, self._with_more, budget)

    def _flying(self) -> Flying:
        progress, route = self.progress, self.progress.route
        left = progress.left
        begins_s = route.ends[left[-1]][1] if left else progress.at_s
        if left:
            start_ne = progress.plan.lines[left[-1]].end_ne_m
        elif self.fix is not None and progress.has_begun:
            start_ne = (self.fix.north_m, self.fix.east_m)
        else:
            start_ne = self.plan.home_ne_m
        spent_j = float(np.interp(begins_s, route.seconds, route.joules))
        return Flying(
            plan=self.plan,
            costs=self.costs,
            settings=self.settings,
            start_ne=start_ne,
            home_s=route.whole_s - begins_s,
            home_j=float(route.joules[-1]) - spent_j,
            pace=progress.pace.fitted()[0],
        )

    def accept(self, proposal: Proposal) -> None:
        """Follow a proposal: its lines come after those that are left, and then the way home."""
        progress = self.progress
        dive = progress.plan.dives[progress.dive]
        count = len(progress.plan.lines)
        last = max(i for i, leg in enumerate(dive.route.legs) if leg.line >= 0)
        new = [
            replace(leg, line=leg.line + count) if leg.line >= 0 else leg
            for leg in proposal.plan.dives[0].route.legs
        ]
        longer = replace(dive, route=Route(legs=(*dive.route.legs[: last + 1], *new)))
        dives = list(progress.plan.dives)
        dives[progress.dive] = longer
        lines = (*progress.plan.lines, *proposal.plan.lines)
        progress.change(replace(progress.plan, lines=lines, dives=tuple(dives)), longer)
        self.accepted = proposal

    def lines_json(self) -> list[dict[str, Any]]:
        """The lines of the dive with what became of them."""
        progress = self.progress
        left, now = set(progress.left), progress.line
        return [
            {
                "number": number + 1,
                "kind": progress.plan.lines[number].kind,
                "start_ne": list(progress.plan.lines[number].start_ne_m),
                "end_ne": list(progress.plan.lines[number].end_ne_m),
                "state": "now" if number == now else "left" if number in left else "done",
            }
            for number in progress.route.ends
        ]
