"""The way through a plan: straight along its lines, and the shortest turns of bounded curvature.

Between lines the vehicle takes the shortest path of straights and arcs of one radius (L. E. Dubins,
1957; closed forms after A. M. Shkel and V. Lumelsky, 2001). Each line has a straight run-in and
run-out, so that the vehicle is steady when pictures begin.
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from alice_survey.errors import PlanError
from missions.lines.line import Line
from missions.route.legs import Leg, Route

_SAME_M = 1e-6
_TINY_M = 1e-9
_SAME_RAD = 1e-9
_FULL = 2 * math.pi


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
