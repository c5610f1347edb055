"""Slow, obvious twins of ways, turns and costs of routes: shapely, all pairs, dense sampling."""

import math
from collections.abc import Sequence
from itertools import groupby
from typing import Any

import numpy as np
import shapely
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from shapely.geometry import LineString, MultiPolygon

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.pilot.settings import STEP_MPS, TURN_IN_PLACE_RAD_S
from missions.route.turns import Manoeuvre, Turns, legs_through, line_table, route_of
from missions.route.ways import OPEN_WATER, Ways
from missions.values.costs import SETTLE_S, Costs, leg_costs, power_at
from missions.values.legs import Leg, Route
from missions.values.line import Line


def time_costs(speed_mps: float) -> Costs:
    """Costs of 1 W whatever the vehicle does: joules are seconds."""
    turns = (TURN_IN_PLACE_RAD_S, SETTLE_S, STEP_MPS)
    return Costs(speed_mps, np.ones(4), np.ones(4), 1.0, 0.0, *turns, np.ones(4), 0.15, 1.0)


PAPER_COSTS = time_costs(0.2)  # Gutnik et al. 2021, section VII.A


def min_way_m(allowed: MultiPolygon, a: tuple[float, float], b: tuple[float, float]) -> float:
    """Dijkstra over the straights between all corners and both places that shapely finds inside."""
    wider = allowed.buffer(1e-6)
    places = np.concatenate([[a, b], np.unique(shapely.get_coordinates(allowed), axis=0)])
    one, two = np.triu_indices(len(places), 1)
    straights = shapely.linestrings(np.stack([places[one], places[two]], axis=1))
    shapely.prepare(wider)
    free = shapely.covers(wider, straights)
    lengths = np.linalg.norm(places[one] - places[two], axis=1)
    # Places that coincide are joined too: a length of 0 would be no edge.
    edges = (np.maximum(lengths[free], 1e-12), (one[free], two[free]))
    graph = csr_array(edges, shape=(len(places), len(places)))
    return float(dijkstra(graph, directed=False, indices=0)[1])  # type: ignore[call-overload]


def sampled_leg(leg: Leg, samples: int) -> tuple[Array, float]:
    """Places along a leg, and how far it may be from the straights between them."""
    if leg.curvature_per_m == 0.0:
        ahead = np.array([math.cos(leg.heading_rad), math.sin(leg.heading_rad)])
        return np.array([leg.start_ne_m, leg.start_ne_m + leg.length_m * ahead]), 0.0
    radius = 1 / abs(leg.curvature_per_m)
    side = math.copysign(1.0, leg.curvature_per_m)
    right = np.array([-math.sin(leg.heading_rad), math.cos(leg.heading_rad)])
    centre = np.array(leg.start_ne_m) + side * radius * right
    swept = leg.length_m / radius * np.linspace(0.0, 1.0, samples)
    angles = math.atan2(*(-side * right)[::-1]) + side * swept
    places = centre + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return places, radius * (1 - math.cos(swept[-1] / (samples - 1) / 2))


def farthest_outside_m(allowed: MultiPolygon, route: Route, samples: int = 400) -> float:
    """How far a route leaves the allowed area at most, by shapely; 0 if it does not."""
    worst = 0.0
    for leg in route.legs:
        if leg.length_m == 0.0:
            places, bend = np.array([leg.start_ne_m]), 0.0
            outside = shapely.points(places[0])
        else:
            places, bend = sampled_leg(leg, samples)
            outside = LineString(places).difference(allowed)
        if outside.is_empty:
            continue
        corners = shapely.points(shapely.get_coordinates(outside))
        # The straights between samples cut an arc's inside by up to `bend`.
        worst = max(worst, float(shapely.distance(allowed, corners).max()) - bend)
    return worst


def route_cost(route: Route, costs: Costs) -> tuple[float, float]:
    """Energy, J, and time, s, of a route; descent and ascent are not in it."""
    legs_j, legs_s = leg_costs(route, costs)
    return float(legs_j.sum()), float(legs_s.sum())


def turn_counts(route: Route) -> tuple[int, int, int]:
    """How many times a route turns in arcs (in a row once), on the spot, and steps sideways."""
    kinds = [leg.kind for leg in route.legs]
    arcs = sum(kind == "arc" for kind, _ in groupby(kinds))
    return arcs, kinds.count("spot"), kinds.count("sway")


def line_starts_m(route: Route) -> dict[int, float]:
    """Distance along a route at which each line of the plan starts."""
    starts = zip(route.legs, route.starts_m, strict=False)
    return {leg.line: float(start) for leg, start in starts if leg.line >= 0}


def route_cost_by_steps(route: Route, costs: Costs, step_m: float) -> tuple[float, float]:
    """Energy and time, leg after leg, arcs in short steps of one course each."""
    joules = seconds = 0.0
    for leg in route.legs:
        if leg.turn_rad or leg.side_rad:
            turning_s = abs(leg.turn_rad) / costs.turn_rate_rad_s
            moving_s = leg.length_m / costs.sway_mps
            joules += costs.stop_w * (turning_s + costs.settle_s)
            joules += moving_s * float(power_at(costs.sway_w, leg.heading_rad))
            seconds += turning_s + moving_s + costs.settle_s
            continue
        power_w = costs.line_w if leg.line >= 0 else costs.way_w
        steps = max(1, math.ceil(leg.length_m / step_m)) if leg.curvature_per_m else 1
        along_m = leg.length_m * (np.arange(steps) + 0.5) / steps
        step_w = power_at(power_w, leg.heading_rad + leg.curvature_per_m * along_m)
        extra_w = costs.arc_extra_w if leg.curvature_per_m and leg.line < 0 else 0.0
        joules += leg.length_m / costs.speed_mps * (float(step_w.mean()) + extra_w)
        seconds += leg.length_m / costs.speed_mps
    return joules, seconds


def lawn(count: int, length_m: float, spacing_m: float) -> list[Line]:
    """Lines north and south, side by side."""
    lines = []
    for east in (np.arange(count) * spacing_m).tolist():
        line = Line(kind="survey", start_ne_m=(0.0, east), end_ne_m=(length_m, east), stations=20)
        lines.append(line.reverse() if len(lines) % 2 else line)
    return lines


def way_m(ways: Ways, a: tuple[float, float], b: tuple[float, float]) -> float:
    """Length of the shortest way between two places."""
    return float(ways.lengths_m(np.array([a]), np.array([b]))[0])


def inside(ways: Ways, places_ne: Array) -> list[bool]:
    """Which places, (N, 2), are inside the allowed area."""
    return ways.inside(places_ne).tolist()


def route_through(
    lines: Sequence[Line],
    turn_radius_m: float = 0.5,
    run_in_m: float = 0.5,
    *,
    ways: Ways = OPEN_WATER,
    costs: Costs = PAPER_COSTS,
    turns: Turns = "auto",
    **ends: Any,
) -> Route:
    """The route along all lines in order; other arguments as of `legs_through`."""
    how = Manoeuvre(costs, turn_radius_m, run_in_m, turns, ways)
    return route_of(legs_through(line_table(lines), how, **ends))
