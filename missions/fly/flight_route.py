"""The part of a plan that is flown: all its dives in one go, or one of them."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import shapely
from shapely.geometry import LineString, Point

from alice_survey.core.errors import PlanError
from alice_survey.sim.vehicle.pilot.path import Path, path_from_legs
from missions.values.legs import Leg, Route
from missions.values.plan_file import Plan

_SAME_RAD = 1e-6
_TOUCH_M = 1e-6
_SAME_HOME_M = 0.01


def one_dive(plan: Plan, dive: int | None) -> Plan:
    """The plan with one of its dives alone; all lines keep their index.

    Args:
        plan: a survey.
        dive: which, from 1 on; None leaves all of them.

    Raises:
        PlanError: the plan lacks that dive.
    """
    if dive is None:
        return plan
    count = len(plan.dives)
    if not 1 <= dive <= count:
        held = "1 dive" if count == 1 else f"dives 1 to {count}"
        raise PlanError(f"dive {dive} was requested; the plan has {held}: choose one of these")
    chosen = plan.dives[dive - 1]
    return replace(
        plan,
        dives=(chosen,),
        length_m=chosen.route.length_m,
        duration_s=chosen.duration_s,
        energy_wh=chosen.energy_wh,
    )


def stations_of_dives(plan: Plan) -> int:
    """How many times all cameras take a picture on the plan's dives."""
    return sum(
        line.stations
        for dive in plan.dives
        for line in plan.lines[dive.first_line : dive.last_line + 1]
    )


def whole_route(plan: Plan) -> Route:
    """The routes of all dives, one after the other: at home the vehicle turns for the next.

    Raises:
        PlanError: a dive begins elsewhere than the one before has ended.
    """
    return Route(legs=tuple(_join_dives(plan)))


def _join_dives(plan: Plan) -> Iterator[Leg]:
    last: Leg | None = None
    for dive in plan.dives:
        first = dive.route.legs[0]
        if last is not None:
            away_m = math.dist(last.end_ne_m, first.start_ne_m)
            if away_m > _SAME_HOME_M:
                raise PlanError(
                    f"a dive begins {away_m:.1f} m from where the one before ends, in another part "
                    f"of the area: fly them one by one: vehicle.dive = 1 to {len(plan.dives)}"
                )
            heading = last.end_heading_rad + last.side_rad
            turn = math.remainder(first.heading_rad + first.side_rad - heading, 2 * math.pi)
            if abs(turn) > _SAME_RAD:
                yield Leg(
                    start_ne_m=last.end_ne_m,
                    heading_rad=heading,
                    length_m=0.0,
                    curvature_per_m=0.0,
                    line=-1,
                    turn_rad=turn,
                )
        yield from dive.route.legs
        last = dive.route.legs[-1]


def path_of(plan: Plan) -> Path:
    """The route of a plan for the pilot."""
    legs = whole_route(plan).legs
    return path_from_legs(
        [leg.start_ne_m for leg in legs],
        [leg.heading_rad for leg in legs],
        [leg.length_m for leg in legs],
        [leg.curvature_per_m for leg in legs],
        [leg.line for leg in legs],
        plan.altitude_m,
        plan.speed_mps,
        turn_rad=[leg.turn_rad for leg in legs],
        side_rad=[leg.side_rad for leg in legs],
    )


def turns_in_place(path: Path) -> int:
    """How many there are."""
    return int(np.count_nonzero(path.turn_rad))


def room_behind_m(plan: Plan, path: Path, max_m: float) -> float:
    """How far the vehicle may go back from the path's start, to come in straight.

    Args:
        plan: whose allowed area counts.
        path: its first leg's course.
        max_m: the most that is of use.
    """
    start = np.array([path.start_n[0], path.start_e[0]])
    course = float(path.heading_rad[0])
    end = start - max_m * np.array([math.cos(course), math.sin(course)])
    inside = LineString([start, end]).intersection(plan.area.allowed.buffer(_TOUCH_M))
    parts = [part for part in shapely.get_parts(inside) if part.distance(Point(start)) <= _TOUCH_M]
    return min(max_m, max((float(part.length) for part in parts), default=0.0))


def roomier_side(plan: Plan, path: Path, way_in_m: float, radius_m: float) -> tuple[float, float]:
    """On which side of the way in a circle lies more inside the allowed area, +1 to starboard.

    Args:
        plan: whose allowed area counts.
        path: its first leg's course.
        way_in_m: length of the way in, at whose start the circle touches it.
        radius_m: of the circle.

    Returns:
        The side, and the share of the circle that lies outside.
    """
    course = float(path.heading_rad[0])
    ahead = np.array([math.cos(course), math.sin(course)])
    touches = np.array([path.start_n[0], path.start_e[0]]) - way_in_m * ahead
    starboard = np.array([-ahead[1], ahead[0]])
    outside = []
    for side in (1.0, -1.0):
        circle = Point(touches + side * radius_m * starboard).buffer(radius_m)
        outside.append(float(circle.difference(plan.area.allowed).area / circle.area))
    return (1.0 if outside[0] <= outside[1] else -1.0), min(outside)
