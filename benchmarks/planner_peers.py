"""The planner and its peers on the same areas, and one meter for all of them.

coverage-path-planner 1.4.0 (its package names no licence) is run as it comes and nothing of it is
shipped. It plans at a fixed angle with a fixed spacing.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import coverage_path_planner
import numpy as np
import shapely
from shapely.geometry import LineString, Polygon

from alice_survey.core.frames import Array
from missions.lines.lay import LineTask, lay_lines
from missions.route.turns import Manoeuvre, legs_through, line_table, route_of
from missions.route.ways import Ways
from missions.values.area import Area
from missions.values.line import Line
from missions.values.pattern import Pattern
from tests.oracles_route import time_costs

PATTERN = Pattern(spacing_m=1.0, step_m=0.47, half_across_m=0.6, half_along_m=0.57)
"""Lines 1 m apart, near the paper's stereo pair at 2 m."""
HEADING_RAD = math.pi / 2
MARGIN_M = 3.0
_SPEED_MPS = 0.2
_TURN_RADIUS_M = 0.5
_RUN_IN_M = 0.5
_POINTS = 20_000
SAME_SHARE = 1e-4
"""Shares this close are one: two of the meter's points."""
CLOSER = tuple(np.arange(1.0, 0.49, -0.05).round(2).tolist())
"""Spacings, m, at which a peer may come to see as much."""
_ALL = 10**12


@dataclass(frozen=True, kw_only=True)
class Way:
    """A plan as the meter takes it."""

    seconds: float
    """Of one core to plan it, once warm: lines, their order, and how they are joined. All planners
    work on one core; its time leaves out what else the machine does."""
    seen: Array
    """(S, 4) lines, x and y of both ends: straights along the heading that was requested. What is
    seen in turns and on the way between lines does not count for any planner."""
    path: Array
    """(K, 2) the whole way, from the first line's start to the last one's end."""


@dataclass(frozen=True, kw_only=True)
class Measured:
    """What the meter says of a plan."""

    planner: str
    seconds: float
    path_m: float
    turns: int
    """Corners of the way by more than a degree."""
    covered: float
    """Share of the area."""
    outside_m: float
    """Of the way, outside of the allowed area and not in holes."""
    holes_m: float
    """Of the way, in holes."""


def own_plan(area: Area, repeats: int) -> Way:
    """This planner: lines, order, and the route with its turns. The area's ways are sorted too."""
    best = math.inf
    for _ in range(repeats + 1):
        began = time.process_time()
        ways = Ways(area.allowed)
        lines = own_lines(area, ways)
        route_of(
            legs_through(
                line_table(lines),
                Manoeuvre(time_costs(_SPEED_MPS), _TURN_RADIUS_M, _RUN_IN_M, ways=ways),
            )
        )
        best = min(best, time.process_time() - began)
    places = [lines[0].start_ne_m, lines[0].end_ne_m]
    for before, after in pairwise(lines):
        places += ways.path_ne(before.end_ne_m, after.start_ne_m)[1:].tolist()
        places.append(after.end_ne_m)
    return Way(
        seconds=best,
        seen=np.array([(*line.start_ne_m, *line.end_ne_m) for line in lines]),
        path=np.array(places),
    )


def own_lines(area: Area, ways: Ways) -> list[Line]:
    """Survey lines alone, from the area's first corner, as the peers lay them."""
    home = area.survey.geoms[0].exterior.coords[0]
    task = LineTask(
        area=area,
        pattern=PATTERN,
        ways=ways,
        costs=time_costs(_SPEED_MPS),
        home_ne=(home[0], home[1]),
        cross_lines=0,
        closing_line=False,
        max_stations=_ALL,
    )
    return lay_lines(task, HEADING_RAD)


def coverage_path_plan(area: Area, repeats: int, spacing_m: float = PATTERN.spacing_m) -> Way:
    """coverage-path-planner: lines only, the first one half a spacing from the border."""
    polygon = area.survey.geoms[0]

    def work() -> Array:
        # Planning changes what it is given: a second run with the same settings lays no lines.
        settings = coverage_path_planner.PathSettings()
        settings.pattern, settings.offset, settings.angle = "lines", spacing_m, HEADING_RAD
        settings.distanceToBorder = 0.0  # its first line is half a spacing further in
        settings.borderLaps = settings.exclusionsBorderLaps = 0
        settings.mowArea = True
        settings.mowBorder = settings.mowExclusionsBorder = False
        environment = coverage_path_planner.Environment(_peer_polygon(polygon.exterior))
        for ring in polygon.interiors:
            environment.addObstacle(_peer_polygon(ring))
        start = coverage_path_planner.Point(*polygon.exterior.coords[0])
        result = coverage_path_planner.PathService().computeFullTask(environment, settings, start)
        return np.array([(point.x, point.y) for point in result.path.getPoints()])[1:]

    path, best = work(), math.inf
    for _ in range(repeats):
        began = time.process_time()
        path = work()
        best = min(best, time.process_time() - began)
    return Way(seconds=best, seen=_lines_of(path), path=path)


def equal_coverage_plan(area: Area, repeats: int) -> Way:
    """coverage-path-planner with its lines as much closer as it takes to see what ours see.

    The widest of `CLOSER` that does, or else the closest.
    """
    target = covered_share(area, own_plan(area, 0).seen) - SAME_SHARE
    for spacing_m in CLOSER:
        way = coverage_path_plan(area, 0, spacing_m)
        if covered_share(area, way.seen) >= target:
            break
    return coverage_path_plan(area, repeats, spacing_m)


PLANNERS: dict[str, Callable[[Area, int], Way]] = {
    "alice-survey": own_plan,
    "coverage-path-planner": coverage_path_plan,
    "coverage-path-planner, as covered": equal_coverage_plan,
}


def measured(planner: str, way: Way, area: Area) -> Measured:
    """Measure a plan of any planner: by points in boxes, and by clipping its way."""
    path = LineString(way.path)
    beyond = path.difference(area.allowed.buffer(1e-6))
    in_holes = beyond.intersection(area.no_go).length
    sides = np.diff(way.path, axis=0)
    sides = sides[np.hypot(*sides.T) > 1e-9]
    courses = np.arctan2(sides[:, 1], sides[:, 0])
    turned = np.abs((np.diff(courses) + math.pi) % (2 * math.pi) - math.pi)
    return Measured(
        planner=planner,
        seconds=way.seconds,
        path_m=path.length,
        turns=int((turned > math.radians(1.0)).sum()),
        covered=covered_share(area, way.seen),
        outside_m=beyond.length - in_holes,
        holes_m=in_holes,
    )


def covered_share(area: Area, seen: Array) -> float:
    """Share of some thousand random points of the area that a straight sees, with its swath."""
    rng = np.random.default_rng(1)
    x_0, y_0, x_1, y_1 = area.survey.bounds
    points = rng.uniform((x_0, y_0), (x_1, y_1), (4 * _POINTS, 2))
    points = points[shapely.contains_xy(area.survey, points[:, 0], points[:, 1])][:_POINTS]
    ahead = seen[:, 2:] - seen[:, :2]
    length = np.hypot(*ahead.T)
    seen, ahead, length = seen[length > 1e-6], ahead[length > 1e-6], length[length > 1e-6]
    ahead = ahead / length[:, None]
    along, aside = PATTERN.half_along_m * ahead, PATTERN.half_across_m * ahead[:, ::-1]
    aside = aside * np.array([-1.0, 1.0])
    begin, end = seen[:, :2] - along, seen[:, 2:] + along
    corners = np.stack([begin - aside, end - aside, end + aside, begin + aside], axis=1)
    boxes = np.asarray(shapely.polygons(corners))
    hit = shapely.STRtree(boxes).query(shapely.points(points), predicate="intersects")[0]
    return len(np.unique(hit)) / len(points)


def _lines_of(path: Array) -> Array:
    """Lines, (S, 4), of a way: its straights within a degree of the heading."""
    straights: Array = np.concatenate([path[:-1], path[1:]], axis=1)
    north, east = (path[1:] - path[:-1]).T
    off = (np.arctan2(east, north) - HEADING_RAD + math.pi / 2) % math.pi - math.pi / 2
    return np.asarray(straights[np.abs(off) < math.radians(1.0)])


def _peer_polygon(ring: shapely.LinearRing) -> "coverage_path_planner.Polygon":
    corners = Polygon(ring).exterior.coords[:-1]
    return coverage_path_planner.Polygon([coverage_path_planner.Point(*c) for c in corners])
