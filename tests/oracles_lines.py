"""Slow, obvious twins of the kernels that lay lines, and the areas these are tested on."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import shapely
import shapely.affinity
from hypothesis import strategies as st
from numpy.typing import NDArray
from shapely.geometry import LineString, MultiPolygon, Point, Polygon, box
from shapely.geometry.base import BaseGeometry

from alice_survey.core.frames import Array, Datum
from missions.lines.lay import LineTask, lay_lines
from missions.route.ways import Ways
from missions.values.area import Area, multipolygon
from missions.values.costs import Costs, power_at
from missions.values.line import Line
from missions.values.pattern import Pattern
from tests.oracles_route import time_costs

DATUM = Datum(latitude_deg=32.8236, longitude_deg=34.9553)
STEREO = Pattern(spacing_m=1.0, step_m=0.47, half_across_m=0.6, half_along_m=0.57)
TWICE = Pattern(spacing_m=0.5, step_m=0.3, half_across_m=0.6, half_along_m=0.57)
SPARSE = Pattern(spacing_m=1.2, step_m=1.0, half_across_m=0.61, half_along_m=0.57)
PATTERNS = (STEREO, TWICE, SPARSE)

ELL = Polygon([(0, 0), (30, 0), (30, 14), (15, 14), (15, 30), (0, 30)])
ELL_WITH_HOLES = ELL.difference(box(5, 4, 9.3, 10)).difference(Point(8, 21).buffer(2.3, 4))


def area_of(survey: BaseGeometry, margin_m: float = 3.0) -> Area:
    """An area whose holes are no-go zones, and that may be left by a margin."""
    parts = multipolygon(survey)
    holes = MultiPolygon([Polygon(ring) for part in parts.geoms for ring in part.interiors])
    around = parts.buffer(margin_m, join_style="mitre").difference(holes)
    return Area(datum=DATUM, survey=parts, allowed=multipolygon(around), no_go=multipolygon(holes))


def lay(
    survey: BaseGeometry, heading: float = 0.0, pattern: Pattern = STEREO, *,
    margin_m: float = 3.0, **kinds: Any,
) -> list[Line]:  # fmt: skip
    """The lines of an area with a margin, from somewhere inside it and home again."""
    area = area_of(survey, margin_m)
    home = area.allowed.representative_point()
    return lay_lines(line_task(area, pattern, home_ne=(home.x, home.y), **kinds), heading)


def line_task(area: Area, pattern: Pattern = STEREO, **others: Any) -> LineTask:
    """What lines are laid for; 1 W at 0.2 m/s, with a cross and a closing line, if not given."""
    usual: dict[str, Any] = {
        "costs": time_costs(0.2),
        "home_ne": (0, 0),
        "cross_lines": 1,
        "closing_line": True,
    }
    return LineTask(area=area, pattern=pattern, ways=Ways(area.allowed), **(usual | others))


def random_area(rng: np.random.Generator) -> MultiPolygon:
    """A star, a comb, a sliver, a coast or two parts, turned, often with holes."""
    kind = int(rng.integers(5))
    if kind == 0:
        count = int(rng.integers(3, 12))
        angles = np.sort(rng.uniform(0, 2 * np.pi, count))
        radii = rng.uniform(0.2, 1, count) * rng.uniform(2, 12)
        shape: BaseGeometry = Polygon(np.c_[radii * np.cos(angles), radii * np.sin(angles)])
    elif kind == 1:
        corners, x = [(0.0, 0.0)], 0.0
        for _ in range(int(rng.integers(2, 5))):
            tooth, width, gap = rng.uniform(3, 9), rng.uniform(0.3, 3), rng.uniform(0.3, 3)
            corners += [(x, tooth), (x + width, tooth), (x + width, 1.0), (x + width + gap, 1.0)]
            x += width + gap
        shape = Polygon([*corners, (x, 0.0)])
    elif kind == 2:
        shape = box(0, 0, rng.uniform(2, 20), rng.uniform(0.05, 0.6))
    elif kind == 3:
        angles = np.linspace(0, 2 * np.pi, 200, endpoint=False)
        radii = 7 * (1 + 0.2 * np.cumsum(rng.normal(size=200)) / 200**0.5)
        shape = Polygon(np.c_[radii * np.cos(angles), radii * np.sin(angles)])
    else:
        one = box(0, 0, rng.uniform(2, 7), rng.uniform(2, 7))
        shape = MultiPolygon([one, box(8, 3, 8 + rng.uniform(1, 6), rng.uniform(4, 9))])
    shape = shapely.make_valid(shape).buffer(0)
    for _ in range(int(rng.integers(0, 4))):
        place = np.array(shape.representative_point().coords[0]) + rng.normal(size=2) * 3
        shape = shape.difference(Point(place).buffer(rng.uniform(0.1, 1.5), quad_segs=2))
    return multipolygon(shapely.affinity.rotate(shape, rng.uniform(0, 360)))


areas = st.integers(0, 2**32 - 1).map(lambda seed: random_area(np.random.default_rng(seed)))


def reaches_by_shapely(
    survey: BaseGeometry, heading_rad: float, offset: float, half_m: float
) -> Array:
    """Projections on u, (N, 2), of the parts that lie in a strip, by clipping."""
    turned = shapely.affinity.rotate(survey, -heading_rad, origin=(0, 0), use_radians=True)
    u_0, _, u_1, _ = turned.bounds
    inside = turned.intersection(box(u_0 - 1, offset - half_m, u_1 + 1, offset + half_m))
    parts = shapely.get_parts(inside)
    bounds: Array = shapely.bounds(parts[shapely.area(parts) > 1e-9])
    return bounds[:, [0, 2]]


def sees(lines: Sequence[Line], points: Array, pattern: Pattern) -> tuple[Array, Array]:
    """By how many lines, and in how many pictures of them, each point (N, 2) is seen."""
    passes, pictures = np.zeros(len(points), int), np.zeros(len(points), int)
    for line in lines:
        c, s = math.cos(line.heading_rad), math.sin(line.heading_rad)
        place = points - np.array(line.start_ne_m)
        u, v = place @ np.array([c, s]), place @ np.array([-s, c])
        stations = np.linspace(0.0, line.length_m, line.stations)
        near = np.abs(u[:, None] - stations) <= pattern.half_along_m + 1e-6
        near &= np.abs(v[:, None]) <= pattern.half_across_m + 1e-6
        pictures += near.sum(axis=1)
        passes += near.any(axis=1)
    return passes, pictures


def seen_enough(lines: Sequence[Line], points: Array, pattern: Pattern) -> NDArray[np.bool_]:
    """Whether each point is seen at the requested overlap."""
    passes, pictures = sees(lines, points, pattern)
    return (passes >= pattern.passes) & (pictures >= pattern.passes * pattern.pictures)


def points_in(area: BaseGeometry, count: int) -> Array:
    """About a given number of places, (N, 2), evenly over an area."""
    x_0, y_0, x_1, y_1 = area.bounds
    pitch = math.sqrt(area.area / count)
    x, y = np.arange(x_0 + pitch / 2, x_1, pitch), np.arange(y_0 + pitch / 2, y_1, pitch)
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    return grid[shapely.contains_xy(area, grid[:, 0], grid[:, 1])]


def as_string(line: Line) -> LineString:
    return LineString([line.start_ne_m, line.end_ne_m])


def best_tour_by_trial(
    exits: NDArray[np.int64], inner: Array, hops: Array, start: Array, finish: Array
) -> float:
    """The least cost of all orders and corners of entry; arguments as of `tour.exact_tour`."""
    best = math.inf
    for order in itertools.permutations(range(len(inner) // 4)):
        for flown in itertools.product(*(range(4 * c, 4 * c + 4) for c in order)):
            cost = start[flown[0]] + finish[flown[0], exits[flown[-1]]] + inner[[*flown]].sum()
            cost += sum(hops[exits[a], b] for a, b in itertools.pairwise(flown))
            best = min(best, float(cost))
    return best


def spot_by_hand(costs: Costs, turn_rad: float) -> float:
    """A turn by NaN, to or from no heading, is none."""
    turn = abs(math.remainder(turn_rad, 2 * math.pi))
    return costs.stop_w * (turn / costs.turn_rate_rad_s + costs.settle_s) if turn >= 1e-6 else 0.0


def flight_by_hand(
    lines: Sequence[Line],
    way_m: Callable[[tuple[float, float], tuple[float, float]], float],
    costs: Costs,
    home: tuple[float, float],
) -> float:
    """What flying lines in order costs, J: turns on the spot and straights, or sway steps."""
    total = 0.0
    base = home, home, math.nan
    stops = [base, *((x.start_ne_m, x.end_ne_m, x.heading_rad) for x in lines), base]
    for (_, here, before), (there, _, after) in itertools.pairwise(stops):
        length, straight = way_m(here, there), math.dist(here, there)
        if straight < 1e-6:
            total += spot_by_hand(costs, after - before)
            continue
        bearing = math.atan2(there[1] - here[1], there[0] - here[0])
        hop = length / costs.speed_mps * float(power_at(costs.way_w, bearing))
        hop += spot_by_hand(costs, bearing - before) + spot_by_hand(costs, after - bearing)
        if math.isfinite(before + after) and straight <= 5.0 and length < straight + 1e-6:
            aside = straight / costs.sway_mps * float(power_at(costs.sway_w, bearing))
            aside += costs.stop_w * costs.settle_s + spot_by_hand(costs, after - before)
            hop = min(hop, aside)
        total += hop
    for line in lines:
        total += line.length_m / costs.speed_mps * float(power_at(costs.line_w, line.heading_rad))
    return total
