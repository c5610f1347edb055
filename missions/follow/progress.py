"""How far along its route a vehicle is, at what pace, and what is left.

Places along the route are counted in the seconds that the plan gives them. A fix belongs to the
nearest place ahead of the last one, as far ahead as the time since may have taken the vehicle;
farther off the route than half a line spacing for some pictures, it is looked for along all lines
that it may be on by its heading.

The pace is the true time over the plan's, from the middle of one line to that of the next. It is
taken as a random walk: what is off adds up as the root of the time, so that of `T` planned seconds
that are left the true ones have the mean `r T` and the variance `q T + (s T)^2`, with the pace `r`,
its own sigma `s`, and `q` the variance per planned second that the lines so far have shown.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.frames import Array
from missions.coverage.dive_record import ALIKE_RAD
from missions.coverage.stations import Stations, stations_of_lines
from missions.values.costs import Costs, leg_costs
from missions.values.legs import Route
from missions.values.plan_file import Dive, Plan

_STEP_M, _STEP_S = 0.1, 0.5
"""Places of a route are looked at no farther apart, in metres and in planned seconds."""
_BACK_S, _AHEAD_S, _FASTER = 5.0, 10.0, 1.5
"""A vehicle is looked for so many planned seconds behind the last place, and ahead: some seconds,
and so many times the time that has passed (inferred)."""
_DOUBT = 0.25
"""Of two places as near the one is taken that is nearer to where the plan expects the vehicle by
now: the whole window counts as this share of half a line spacing."""
_OFF_PICTURES = 3.0
"""So many intervals off the route the vehicle is looked for elsewhere."""
_ALONG = 0.5
"""A vehicle begins a line where it goes along it for a picture's interval at this share of the
plan's pace or more (inferred): one that turns over a line on its way down does not."""
PRIOR_SIGMA = 0.1
"""Sigma of the pace before any line was flown (twelve simulated flights of ALICE, in currents up to
0.3 m/s, took 1.02 to 1.14 of the time of their plans)."""
_PRIOR_LINES = 2.0
"""Before lines have shown how the pace varies, its variance counts as seen on so many lines."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RouteTimes:
    """A dive's route, sampled: where the vehicle should be after planned seconds."""

    places_ne: Array
    """(N, 2)"""
    course_rad: Array
    """(N,)"""
    seconds: Array
    """(N,) planned since the route's start, not decreasing."""
    joules: Array
    """(N,) planned energy to there."""
    line: NDArray[np.intp]
    """(N,) index of the line, -1 between lines."""
    ends: dict[int, tuple[float, float]]
    """Planned seconds at the start and the end of each line."""
    surface_s: float
    """Planned time of going down or of coming up, which the route leaves out."""
    surface_j: float

    @property
    def whole_s(self) -> float:
        """Planned time from the route's start to its end."""
        return float(self.seconds[-1])


def route_times(route: Route, costs: Costs, depth_m: float) -> RouteTimes:
    """Sample a route by what it takes.

    Args:
        route: of a dive.
        costs: of its legs.
        depth_m: of lines.
    """
    energy, time = leg_costs(route, costs)
    places, course, seconds, joules, line = [], [], [], [], []
    ends: dict[int, tuple[float, float]] = {}
    passed_s, passed_j = 0.0, 0.0
    for leg, leg_j, leg_s in zip(route.legs, energy.tolist(), time.tolist(), strict=True):
        steps = max(leg.length_m / _STEP_M, leg_s / _STEP_S)
        share = np.linspace(0.0, 1.0, math.ceil(steps) + 2)
        places.append(leg.places(share * leg.length_m))
        course.append(leg.heading_rad + leg.curvature_per_m * share * leg.length_m)
        seconds.append(passed_s + share * leg_s)
        joules.append(passed_j + share * leg_j)
        line.append(np.full(len(share), leg.line, dtype=np.intp))
        if leg.line >= 0:
            ends[leg.line] = (passed_s, passed_s + leg_s)
        passed_s, passed_j = passed_s + leg_s, passed_j + leg_j
    return RouteTimes(
        places_ne=np.concatenate(places),
        course_rad=np.concatenate(course),
        seconds=np.concatenate(seconds),
        joules=np.concatenate(joules),
        line=np.concatenate(line),
        ends=ends,
        surface_s=costs.dive_s(depth_m) / 2,
        surface_j=costs.dive_j(depth_m) / 2,
    )


@dataclass(frozen=True, kw_only=True)
class TimeLeft:
    """A time with its sigma, and an energy."""

    time_s: float
    sigma_s: float
    energy_wh: float


class FlightPace:
    """True time over planned time, and how both differ from line to line."""

    def __init__(self) -> None:
        """No lines yet."""
        self._planned: list[float] = []
        self._true: list[float] = []

    def add(self, planned_s: float, true_s: float) -> None:
        """Take a part of the route that was flown."""
        if planned_s > 0.0 and true_s > 0.0:
            self._planned.append(planned_s)
            self._true.append(true_s)

    @property
    def parts(self) -> int:
        """Parts so far."""
        return len(self._planned)

    def fitted(self) -> tuple[float, float, float]:
        """The pace, its sigma, and the variance per planned second, s."""
        planned, true = np.array(self._planned), np.array(self._true)
        total = float(planned.sum())
        part_s = total / len(planned) if len(planned) else 60.0
        prior_q = PRIOR_SIGMA**2 * part_s
        if not len(planned):
            return 1.0, PRIOR_SIGMA, prior_q
        plain = float(true.sum()) / total
        off = float(((true - plain * planned) ** 2 / planned).sum())
        q = (off + _PRIOR_LINES * prior_q) / (len(planned) - 1 + _PRIOR_LINES)
        seen, prior = total / q, 1.0 / PRIOR_SIGMA**2
        return (plain * seen + prior) / (seen + prior), (seen + prior) ** -0.5, q

    def left(self, planned_s: float, energy_j: float) -> TimeLeft:
        """What a planned time will take."""
        pace, sigma, q = self.fitted()
        return TimeLeft(
            time_s=pace * planned_s,
            sigma_s=math.sqrt(max(q * planned_s, 0.0) + (sigma * planned_s) ** 2),
            energy_wh=pace * energy_j / 3600.0,
        )


class Progress:
    """Where a vehicle is on the route of its dive."""

    def __init__(self, plan: Plan, costs: Costs, dive: int | None = None) -> None:
        """At home.

        Args:
            plan: with the dives.
            costs: of its legs.
            dive: which is flown, from 0 on; None: found by the lines that the vehicle is on.
        """
        self._costs, self._depth_m = costs, plan.seafloor_depth_m - plan.altitude_m
        self._near_m = plan.line_spacing_m / 2
        self._interval_s = plan.interval_s
        self._asked = dive
        self.pace = FlightPace()
        self.plan, self.dive = plan, 0 if dive is None else dive
        self.at_s = 0.0
        """Planned seconds of the vehicle's place on the route."""
        self.is_on_route = False
        self.has_begun = False
        """Whether it was on the route at all."""
        self._time_s: float | None = None
        self._off_since_s: float | None = None
        self._reference: tuple[float, float] | None = None
        self._seen: tuple[int, float, float] | None = None
        """Dive, planned seconds and time of where it may have begun."""
        self._times = [self._timed(one) for one in plan.dives]

    def _timed(self, dive: Dive) -> RouteTimes:
        return route_times(dive.route, self._costs, self._depth_m)

    @property
    def route(self) -> RouteTimes:
        """Route of the dive that is flown."""
        return self._times[self.dive]

    @property
    def line(self) -> int:
        """The line that the vehicle is on, -1 between lines."""
        if not self.is_on_route:
            return -1
        for line, (start_s, end_s) in self.route.ends.items():
            if start_s <= self.at_s < end_s:
                return line
        return -1

    @property
    def left(self) -> list[int]:
        """Lines of the dive that are not passed, in the order of flight."""
        return [line for line, (_, end_s) in self.route.ends.items() if end_s > self.at_s + 1e-9]

    def change(self, plan: Plan, dive: Dive) -> None:
        """Go on along another route of the dive that is flown.

        Args:
            plan: with all lines that the route counts.
            dive: whose route is the old one up to the end of its last line, or beyond.
        """
        flown_s = max(end_s for _, end_s in self.route.ends.values())
        self.plan = plan
        self._times[self.dive] = self._timed(dive)
        self.at_s = min(self.at_s, flown_s)  # from the way home to where the new way begins

    def add(self, time_s: float, place_ne: Array, heading_rad: float) -> None:
        """Take a fix of the left port's glass; NaN is a heading that is not known."""
        passed_s = 0.0 if self._time_s is None else max(0.0, time_s - self._time_s)
        self._time_s = time_s
        found = self._ahead(place_ne, passed_s) if self.has_begun else None
        if found is None:
            self.is_on_route = self.is_on_route and self._off_since_s is None
            if self._off_since_s is None:
                self._off_since_s = time_s
            if time_s - self._off_since_s < _OFF_PICTURES * self._interval_s and self.has_begun:
                return
            self.is_on_route = False
            elsewhere = self._anywhere(place_ne, heading_rad)
            if elsewhere is None or not (self.has_begun or self._begins(time_s, *elsewhere)):
                return
            self.dive, found = elsewhere
            self._reference = None
            self.has_begun = True
        self._off_since_s, self.is_on_route = None, True
        before_s, self.at_s = self.at_s, found
        self._measure_pace(before_s, time_s)

    def _ahead(self, place_ne: Array, passed_s: float) -> float | None:
        """Planned seconds of the nearest place of the route round the last one; None: it is off."""
        route = self.route
        # A line that is passed stays so: that it is flown again is for `_anywhere` to find.
        passed = [end_s for _, end_s in route.ends.values() if end_s <= self.at_s]
        first, last = np.searchsorted(
            route.seconds,
            [
                max(self.at_s - _BACK_S, *passed, 0.0),
                self.at_s + _AHEAD_S + _FASTER * passed_s,
            ],
        )
        last = min(max(last + 1, first + 1), len(route.seconds))
        first = min(first, last - 1)
        away_m = np.hypot(*(route.places_ne[first:last] - place_ne).T)
        early_s = np.abs(route.seconds[first:last] - self.at_s - passed_s)
        doubt_m = _DOUBT * self._near_m * early_s / max(float(early_s.max()), 1.0)
        nearest = int(np.argmin(away_m + doubt_m))
        if away_m[nearest] > self._near_m:
            return None
        return float(route.seconds[first + nearest])

    def _anywhere(self, place_ne: Array, heading_rad: float) -> tuple[int, float] | None:
        """Dive and planned seconds of where the vehicle may be; the nearest in time.

        On any line, or on a way between lines that is still ahead.
        """
        best: tuple[float, int, float] | None = None
        for index, route in enumerate(self._times):
            if self._asked is not None and index != self._asked:
                continue
            away_m = np.hypot(*(route.places_ne - place_ne).T)
            ahead = self.has_begun and index == self.dive
            ways = route.line >= 0
            ways |= (route.seconds > self.at_s) if ahead else False
            near = (away_m <= self._near_m) & ways
            if math.isfinite(heading_rad):
                near &= np.cos(route.course_rad - heading_rad) >= math.cos(ALIKE_RAD)
            if not near.any():
                continue
            which = np.flatnonzero(near)
            # Of one pass along a line the nearest place; of several passes that nearest in time.
            for run in np.split(which, np.flatnonzero(np.diff(which) > 1) + 1):
                place = int(run[np.argmin(away_m[run])])
                at_s = float(route.seconds[place])
                apart_s = abs(at_s - self.at_s) if index == self.dive else math.inf
                score = (apart_s, index, at_s)
                best = score if best is None else min(best, score)
        return None if best is None else (best[1], best[2])

    def _begins(self, time_s: float, dive: int, at_s: float) -> bool:
        """Whether a vehicle goes along the line that it is over, for the first time of a dive."""
        if self._seen is not None and self._seen[0] == dive and self._seen[1] <= at_s:
            passed_s = time_s - self._seen[2]
            if passed_s < self._interval_s:
                return False
            if at_s - self._seen[1] >= _ALONG * passed_s:
                return True
        self._seen = (dive, at_s, time_s)
        return False

    def _measure_pace(self, before_s: float, time_s: float) -> None:
        """Note the time that was taken where the middle of a line is passed.

        There the vehicle goes at its speed: at the ends it brakes, and is for a while in one place.
        """
        middles = [sum(ends) / 2 for ends in self.route.ends.values()]
        if not any(before_s < middle_s <= self.at_s for middle_s in middles):
            return
        if self._reference is not None:
            self.pace.add(self.at_s - self._reference[0], time_s - self._reference[1])
        self._reference = (self.at_s, time_s)

    def to_finish(self, surface_ways: float = 1.0) -> TimeLeft:
        """What is left of the dive, to the surface.

        Args:
            surface_ways: ways down or up that are left: 2 at the surface, 1 at depth, less on the
                way up.
        """
        route = self.route
        spent_j = float(np.interp(self.at_s, route.seconds, route.joules))
        return self.pace.left(
            route.whole_s - self.at_s + surface_ways * route.surface_s,
            float(route.joules[-1]) - spent_j + surface_ways * route.surface_j,
        )

    def spent_wh(self) -> float:
        """Energy by the plan's costs and the true pace, since the start."""
        route = self.route
        spent_j = float(np.interp(self.at_s, route.seconds, route.joules)) + route.surface_j
        return self.pace.fitted()[0] * spent_j / 3600.0

    def to_come(self) -> Stations:
        """The pictures that are still to be taken, flown exactly.

        Of the line that the vehicle is on, those ahead of it; of the lines that are left, all; and
        all of other dives, which are flown before or after.
        """
        numbers: list[int] = []
        skipped: list[int] = []
        for index, dive in enumerate(self.plan.dives):
            flown = index == self.dive
            wanted = self.left if flown else range(dive.first_line, dive.last_line + 1)
            numbers += wanted
            skipped += [self._taken(number) if flown else 0 for number in wanted]
        lines = [self.plan.lines[number] for number in numbers]
        stations = stations_of_lines(lines, self.plan.altitude_m)
        place = np.concatenate([np.arange(0), *(np.arange(line.stations) for line in lines)])
        which = stations.line
        stations = replace(stations, line=np.array(numbers, dtype=np.intp)[which])
        return stations.some(place >= np.array(skipped, dtype=np.intp)[which])

    def _taken(self, number: int) -> int:
        """How many pictures of a line have surely been taken: not the one that was due last."""
        start_s, end_s = self.route.ends[number]
        if self.at_s <= start_s:
            return 0
        flown = (self.at_s - start_s) / (end_s - start_s)
        return math.floor(flown * (self.plan.lines[number].stations - 1) + 1e-9)
