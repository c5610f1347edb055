"""A flown plan: where the left port was on each line, and when its pictures are taken."""

import itertools
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

from alice_survey.core.frames import Array, attitude_from_rotation
from alice_survey.core.trajectory import Trajectory
from alice_survey.sim.vehicle.pilot.memory import CROSS, PATH_HEADING
from alice_survey.sim.vehicle.pilot.steering import STOP_M
from alice_survey.sim.vehicle.simulator import Flown
from alice_survey.sim.vehicle.vehicle import Vehicle
from missions.values.navigation import BelievedNavigation
from missions.values.plan_file import Plan


@dataclass(frozen=True, kw_only=True, eq=False)
class Flight:
    """A flown plan."""

    plan: Plan
    vehicle: Vehicle
    """What flew, with all its thrust."""
    truth: Trajectory
    """True motion of the body origin."""
    glass_ned: Array
    """(T, 3) the left port's outer glass."""
    altitude_m: Array
    """(T,) true, of the left port's glass above the sea floor below it."""
    clearance_m: float
    """Least height of hull, port and DVL above the sea floor, of every second and at the end."""
    believed_glass_ned: Array
    """(T, 3) where navigation placed it."""
    line: Array
    """(T,) line of the plan that is being flown, -1 between lines; as the pilot estimates."""
    trigger_s: Array
    """(S,) when each station's pictures are taken."""
    trigger_line: tuple[int, ...]
    """(S,) line of the plan of each station."""
    log: BelievedNavigation
    flown: Flown
    ending: str
    """Why the flight ended, in words."""
    expected_m: tuple[Array | float, float] = (0.0, 0.0)
    """How far off lines, (L,), and out of the area the law of an autopilot should bring it."""

    @cached_property
    def attitude_rad(self) -> Array:
        """(T, 3) true roll, pitch, heading."""
        return attitude_from_rotation(self.truth.ned_from_body.rotation)

    @cached_property
    def line_errors(self) -> tuple[Array, Array]:
        """How far the left port's glass and the heading truly are off the line, at each time.

        Returns:
            Cross-track error, (T,) metres to starboard, and heading error, (T,) radians; NaN
            between lines.
        """
        heading = np.full(len(self.line), np.nan)
        for index, line in enumerate(self.plan.lines):
            rows = self.line == index
            turned = self.attitude_rad[rows, 2] - line.heading_rad
            heading[rows] = np.angle(np.exp(1j * turned))
        return self._cross_track(self.glass_ned), heading

    @cached_property
    def believed_cross_track(self) -> Array:
        """(T,) metres: how far off the line the vehicle estimated the glass; NaN between."""
        return self._cross_track(self.believed_glass_ned)

    @cached_property
    def believed_route_error(self) -> Array:
        """(T,) metres: how far the pilot saw the glass to starboard of the route, turns too."""
        return self.flown.report[:, CROSS]

    @cached_property
    def route_error(self) -> Array:
        """(T,) metres: how far the glass truly was to starboard of the route's tangent.

        The pilot's own figure minus the navigation's error across the path.
        """
        heading = self.flown.report[:, PATH_HEADING]
        off = self.glass_ned - self.believed_glass_ned
        across = off[:, 1] * np.cos(heading) - off[:, 0] * np.sin(heading)
        return self.believed_route_error + across

    @property
    def allowed_off_m(self) -> Array:
        """(L,) how far off each of the plan's lines its pictures may be."""
        allowed_m: Array = np.maximum(self.expected_m[0], [self.plan.allowed_offset_m])
        return np.broadcast_to(allowed_m, len(self.plan.lines))

    @property
    def allowed_outside_m(self) -> float:
        """How far it may leave the allowed area: as a picture its line, and what is expected."""
        return self.plan.allowed_offset_m + self.expected_m[1]

    @cached_property
    def stations_off_line(self) -> int:
        """How many pictures were truly taken farther off their line than is allowed."""
        places = np.column_stack(
            [np.interp(self.trigger_s, self.truth.time_s, axis) for axis in self.glass_ned.T[:2]]
        )
        off = [
            self.plan.lines[index].offsets_m(place)[1]
            for place, index in zip(places, self.trigger_line, strict=True)
        ]
        return int(np.sum(np.abs(off) > self.allowed_off_m[list(self.trigger_line)]))

    @cached_property
    def outside_m(self) -> Array:
        """(T,) metres: how far the left port truly was out of the allowed area, or in a zone."""
        places = np.asarray(shapely.points(self.glass_ned[:, :2]))
        allowed = self.plan.area.allowed
        shapely.prepare(allowed)
        return shapely.distance(allowed, places)

    def _cross_track(self, glass_ned: Array) -> Array:
        cross = np.full(len(self.line), np.nan)
        for index, line in enumerate(self.plan.lines):
            rows = self.line == index
            cross[rows] = line.offsets_m(glass_ned[rows, :2])[:, 1]
        return cross


def trigger_times(
    plan: Plan, time_s: Array, line: Array, glass_ne: Array
) -> tuple[Array, tuple[int, ...]]:
    """When each station of each line is passed, by the vehicle's own estimate.

    Args:
        plan: its lines and stations.
        time_s: (T,)
        line: (T,) line being flown, -1 between lines.
        glass_ne: (T, 2) the vehicle's estimate of where the left port's glass is.

    Returns:
        (S,) seconds, interpolated between ticks, and the line of each; stations that were never
        reached are left out. One at a line's end where the vehicle stops is taken when it leaves
        the line, since it may come to rest a little before it.
    """
    times: list[Array] = []
    lines: list[int] = []
    stopping = _stops_at_end(plan)
    for index, planned in enumerate(plan.lines):
        rows = np.flatnonzero(line == index)
        if not len(rows):
            continue
        # The tick before the line is entered brackets its first station, the one after its last.
        rows = np.arange(max(rows[0] - 1, 0), min(rows[-1] + 2, len(line)))
        along = np.maximum.accumulate(planned.offsets_m(glass_ne[rows])[:, 0])
        stations = np.linspace(0.0, planned.length_m, planned.stations)
        stations = stations[stations <= along[-1] + (STOP_M if index in stopping else 0.0)]
        # Of equal distances, while the vehicle falls back, the first counts.
        first = np.concatenate([[True], np.diff(along) > 0])
        times.append(np.interp(stations, along[first], time_s[rows][first]))
        lines += [index] * len(stations)
    return np.concatenate([np.empty(0), *times]), tuple(lines)


def _stops_at_end(plan: Plan) -> set[int]:
    """Lines at whose end the vehicle stops: a turn on the spot or a sway step follows at once."""
    return {
        leg.line
        for dive in plan.dives
        for leg, following in itertools.pairwise(dive.route.legs)
        if leg.line >= 0 and (following.turn_rad != 0.0 or following.side_rad != 0.0)
    }


def rms(values: Array) -> float:
    """Root mean square of what is known; NaN of nothing."""
    known = values[~np.isnan(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else math.nan
