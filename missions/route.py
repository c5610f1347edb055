"""The way through a plan: straight along its lines, and the shortest turns of bounded curvature.

Between lines the vehicle takes the shortest path of straights and arcs of one radius (L. E. Dubins,
1957; closed forms after A. M. Shkel and V. Lumelsky, 2001). Each line has a straight run-in and
run-out, so that the vehicle is steady when pictures begin.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from alice_survey.errors import PlanError
from alice_survey.frames import Array
from missions.lines import Line

_SAME_M = 1e-6
_TINY_M = 1e-9
_SAME_RAD = 1e-9
_FULL = 2 * math.pi


@dataclass(frozen=True, kw_only=True)
class Leg:
    """A straight or an arc."""

    start_ne_m: tuple[float, float]
    heading_rad: float
    """At its start."""
    length_m: float
    curvature_per_m: float
    """Positive to starboard."""
    line: int
    """Index of the plan's line, or -1 between lines."""

    def places(self, along_m: Array) -> Array:
        """Where the path is, (N, 2) north and east, after distances (N,) from the leg's start."""
        k = self.curvature_per_m
        turned = self.heading_rad + k * along_m / 2
        # The chord of an arc points along its mean heading and is sinc(half the angle) as long.
        chord = along_m * np.sinc(k * along_m / 2 / math.pi)
        ne: Array = np.array(self.start_ne_m) + chord[:, None] * np.stack(
            [np.cos(turned), np.sin(turned)], axis=1
        )
        return ne

    @property
    def end_ne_m(self) -> tuple[float, float]:
        """Where it ends."""
        north, east = self.places(np.array([self.length_m]))[0]
        return float(north), float(east)

    @property
    def end_heading_rad(self) -> float:
        """Heading at its end."""
        return self.heading_rad + self.curvature_per_m * self.length_m


@dataclass(frozen=True, kw_only=True)
class Route:
    """Legs that follow one another without a gap or a kink. Places are of the left port's glass."""

    legs: tuple[Leg, ...]

    @cached_property
    def starts_m(self) -> Array:
        """(L + 1,) distance along the route at which each leg starts, and the whole length."""
        return np.concatenate([[0.0], np.cumsum([leg.length_m for leg in self.legs])])

    @property
    def length_m(self) -> float:
        """Of all legs."""
        return float(self.starts_m[-1])

    def places(self, along_m: Array) -> Array:
        """Where the route is, (N, 2), at distances (N,); it goes on straight beyond its ends."""
        result = np.empty((len(along_m), 2))
        for leg, rows, within_m in self._by_leg(along_m):
            result[rows] = leg.places(within_m)
        return result

    def headings_rad(self, along_m: Array) -> Array:
        """Heading of the route, (N,), at distances (N,); not wrapped within a leg."""
        result = np.empty(len(along_m))
        for leg, rows, within_m in self._by_leg(along_m):
            result[rows] = leg.heading_rad + leg.curvature_per_m * within_m
        return result

    def _by_leg(self, along_m: Array) -> Iterator[tuple[Leg, NDArray[np.intp], Array]]:
        """Each leg that is met, the indices of its distances, and these from its start."""
        starts = self.starts_m
        index = np.clip(np.searchsorted(starts, along_m, side="right") - 1, 0, len(self.legs) - 1)
        order = np.argsort(index, kind="stable")
        cuts = np.searchsorted(index[order], np.arange(len(self.legs) + 1))
        for i, leg in enumerate(self.legs):
            rows = order[cuts[i] : cuts[i + 1]]
            if len(rows):
                yield leg, rows, along_m[rows] - starts[i]

    def line_starts_m(self) -> dict[int, float]:
        """Distance along the route at which each line of the plan starts."""
        starts = zip(self.legs, self.starts_m, strict=False)
        return {leg.line: float(start) for leg, start in starts if leg.line >= 0}


def route_through(lines: Sequence[Line], turn_radius_m: float, run_in_m: float) -> Route:
    """The route along all lines in order.

    Args:
        lines: in the order of flight.
        turn_radius_m: of every arc.
        run_in_m: straight before and after each line.

    Raises:
        PlanError: there is no line.
    """
    if not lines:
        raise PlanError("there is no line to fly")
    start = _moved(lines[0].start_ne_m, lines[0], -run_in_m)
    legs = [_straight(start, lines[0], run_in_m)]
    for index, line in enumerate(lines):
        legs.append(
            Leg(
                start_ne_m=line.start_ne_m,
                heading_rad=line.heading_rad,
                length_m=line.length_m,
                curvature_per_m=0.0,
                line=index,
            )
        )
        following = lines[index + 1] if index + 1 < len(lines) else None
        if following is not None and _goes_on(line, following):
            gap_m = math.dist(line.end_ne_m, following.start_ne_m)
            legs.append(_straight(line.end_ne_m, line, gap_m))
            continue
        legs.append(_straight(line.end_ne_m, line, run_in_m))
        if following is not None:
            goal = _moved(following.start_ne_m, following, -run_in_m)
            legs += turn(
                legs[-1].end_ne_m, line.heading_rad, goal, following.heading_rad, turn_radius_m
            )
            legs.append(_straight(goal, following, run_in_m))
    return Route(legs=tuple(leg for leg in legs if leg.length_m > _TINY_M))


def turn(
    start_ne_m: tuple[float, float],
    start_heading_rad: float,
    goal_ne_m: tuple[float, float],
    goal_heading_rad: float,
    radius_m: float,
) -> list[Leg]:
    """The shortest path between two places with headings, of straights and arcs of one radius."""
    north, east = np.subtract(goal_ne_m, start_ne_m) / radius_m
    distance, bearing = math.hypot(north, east), math.atan2(east, north)
    alpha = (start_heading_rad - bearing) % _FULL
    beta = (goal_heading_rad - bearing) % _FULL
    best: list[Leg] | None = None
    for turns, lengths in _words(alpha, beta, distance):
        legs: list[Leg] = []
        place, heading = start_ne_m, start_heading_rad
        for sense, length in zip(turns, lengths, strict=True):
            leg = Leg(
                start_ne_m=place,
                heading_rad=heading,
                length_m=length * radius_m,
                curvature_per_m=sense / radius_m,
                line=-1,
            )
            legs.append(leg)
            place, heading = leg.end_ne_m, leg.end_heading_rad
        total = sum(leg.length_m for leg in legs)
        if math.dist(place, goal_ne_m) > _SAME_M * (1 + total):
            continue  # a closed form outside of its domain
        if best is None or total < sum(leg.length_m for leg in best) - _TINY_M:
            best = legs
    if best is None:
        raise PlanError(f"no turn of radius {radius_m:g} m from {start_ne_m} to {goal_ne_m}")
    return best


def _words(
    alpha: float, beta: float, distance: float
) -> Iterator[tuple[tuple[int, int, int], tuple[float, float, float]]]:
    """Lengths of the six kinds of shortest path, in radii; senses are +1 starboard, -1 port."""
    for side in (1, -1):  # port is the mirror image of starboard
        a, b = side * alpha, side * beta
        sa, ca, sb, cb = math.sin(a), math.cos(a), math.sin(b), math.cos(b)
        cab = math.cos(a - b)
        across = math.atan2(cb - ca, distance + sa - sb)
        square = 2 + distance**2 - 2 * cab + 2 * distance * (sa - sb)
        if square >= -_TINY_M:
            straight = math.sqrt(max(square, 0.0))
            yield (side, 0, side), (_wrap(across - a), straight, _wrap(b - across))
        cosine = (6 - distance**2 + 2 * cab - 2 * distance * (sa - sb)) / 8
        if abs(cosine) <= 1:
            middle = _FULL - math.acos(cosine)
            first = _wrap(across - a + middle / 2)
            yield (side, -side, side), (first, middle, _wrap(b - a - first + middle))
        square = -2 + distance**2 + 2 * cab + 2 * distance * (sa + sb)
        if square >= -_TINY_M:
            straight = math.sqrt(max(square, 0.0))
            across = math.atan2(-ca - cb, distance + sa + sb) - math.atan2(-2.0, straight)
            yield (side, 0, -side), (_wrap(across - a), straight, _wrap(across - b))


def _wrap(angle_rad: float) -> float:
    """The angle in [0, 2 pi), with 0 for what is a full turn but for rounding."""
    wrapped = angle_rad % _FULL
    return 0.0 if _FULL - wrapped < _SAME_RAD else wrapped


def _goes_on(line: Line, following: Line) -> bool:
    """Whether a line lies straight ahead of another."""
    ahead = np.array([math.cos(line.heading_rad), math.sin(line.heading_rad)])
    gap = np.subtract(following.start_ne_m, line.end_ne_m)
    same_way = math.cos(line.heading_rad - following.heading_rad) > 1 - 1e-12
    return bool(same_way and ahead @ gap >= 0 and abs(ahead[0] * gap[1] - ahead[1] * gap[0]) < 1e-6)


def _moved(place: tuple[float, float], line: Line, along_m: float) -> tuple[float, float]:
    heading = line.heading_rad
    return place[0] + along_m * math.cos(heading), place[1] + along_m * math.sin(heading)


def _straight(place: tuple[float, float], line: Line, length_m: float) -> Leg:
    return Leg(
        start_ne_m=place,
        heading_rad=line.heading_rad,
        length_m=length_m,
        curvature_per_m=0.0,
        line=-1,
    )
