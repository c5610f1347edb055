"""Plans for tests of exports, made by hand so that they need no planner."""

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from shapely.geometry import Polygon

from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.frames import Datum
from camera_calib.rig import Rig, design_rig
from missions.values.legs import Leg, Route
from missions.values.line import Line
from missions.values.plan_file import Dive, Plan
from tests.oracles_lines import DATUM, area_of

RIG: Rig = design_rig(CameraConfig(), WaterConfig())


def straight(
    start: tuple[float, float], end: tuple[float, float], line: int = -1, side_rad: float = 0.0
) -> Leg:
    course, length_m = math.atan2(end[1] - start[1], end[0] - start[0]), math.dist(start, end)
    given: dict[str, Any] = {"length_m": length_m, "line": line, "side_rad": side_rad}
    return Leg(start_ne_m=start, heading_rad=course, **given)


def spot(place: tuple[float, float], heading_rad: float, turn_rad: float) -> Leg:
    return Leg(start_ne_m=place, heading_rad=heading_rad, length_m=0.0, turn_rad=turn_rad)


def arc(place: tuple[float, float], heading_rad: float, radius_m: float, turn_rad: float) -> Leg:
    curvature = math.copysign(1 / radius_m, turn_rad)
    bend: dict[str, Any] = {"length_m": radius_m * abs(turn_rad), "curvature_per_m": curvature}
    return Leg(start_ne_m=place, heading_rad=heading_rad, **bend)


def lawnmower_route(lines: list[Line], first: int, home: tuple[float, float]) -> Route:
    """From home along lines, with run-ins, and home again: a turn on the spot at each kink."""
    stops = [(home, -1)]
    for index, line in enumerate(lines, start=first):
        ahead = math.cos(line.heading_rad), math.sin(line.heading_rad)
        run_in = line.start_ne_m[0] - 0.5 * ahead[0], line.start_ne_m[1] - 0.5 * ahead[1]
        stops += [(run_in, -1), (line.start_ne_m, -1), (line.end_ne_m, index)]
    legs: list[Leg] = []
    for (start, _), (end, line_number) in pairwise([*stops, (home, -1)]):
        if math.dist(start, end) < 1e-9:
            continue
        leg = straight(start, end, line_number)
        heading = legs[-1].end_heading_rad if legs else leg.heading_rad
        turn = math.remainder(leg.heading_rad - heading, 2 * math.pi)
        legs += [spot(start, heading, turn)] if abs(turn) > 1e-12 else []
        legs.append(leg)
    return Route(legs=tuple(legs))


def plan_of(
    lines: list[Line],
    dives: list[tuple[int, int]],
    *,
    datum: Datum = DATUM,
    home: tuple[float, float] = (-2.0, -2.0),
    routes: list[Route] | None = None,
    survey: Polygon | None = None,
    **changes: Any,
) -> Plan:
    """A plan that flies given lines; `dives` holds first and last line of each."""
    ends = np.array([end for line in lines for end in (line.start_ne_m, line.end_ne_m)])
    low, high = ends.min(axis=0) - 0.2, ends.max(axis=0) + 0.2
    box = Polygon([low, (high[0], low[1]), high, (low[0], high[1])])
    area = box if survey is None else survey
    flown = routes or [lawnmower_route(lines[a : b + 1], a, home) for a, b in dives]
    values: dict[str, Any] = {
        "name": "harbour",
        "area": replace(area_of(area), datum=datum),
        "home_ne_m": home,
        "seafloor_depth_m": 15.0,
        "altitude_m": 2.0,
        "speed_mps": 0.2,
        "interval_s": 2.3,
        "exposure_s": 0.003,
        "strobe_pulse_s": 0.0034,
        "strobe_lead_s": 0.0002,
        "footprint_m": (1.441, 1.1749),
        "line_spacing_m": 1.0,
        "station_spacing_m": 0.46,
        "reached_forward_overlap": 0.6,
        "reached_side_overlap": 0.3,
        "lines": tuple(lines),
        "dives": tuple(
            Dive(first_line=a, last_line=b, route=r, duration_s=r.length_m / 0.2, energy_wh=12.5)
            for (a, b), r in zip(dives, flown, strict=True)
        ),
        "turn_radius_m": 0.5,
        "run_in_m": 0.5,
        "length_m": sum(route.length_m for route in flown),
        "duration_s": sum(route.length_m for route in flown) / 0.2,
        "energy_wh": 12.5,
        "coverage": 1.0,
        "details": {},
    }
    return Plan(**(values | changes))


def line(
    start: tuple[float, float], end: tuple[float, float], kind: Any = "survey", step: float = 0.46
) -> Line:
    stations = max(2, math.ceil(math.dist(start, end) / step) + 1)
    return Line(kind=kind, start_ne_m=start, end_ne_m=end, stations=stations)


def small_plan(**changes: Any) -> Plan:
    """Four lines of 4.6 m, a cross line and a closing line in two dives, about a hole."""
    lines = []
    for i in range(4):
        ends = (0.2, float(i)), (4.8, float(i))
        lines.append(line(*(ends if i % 2 == 0 else ends[::-1])))
    lines.append(line((2.5, 3.2), (2.5, -0.2), "cross"))
    lines.append(line((0.2, 0.0), (4.8, 0.0), "closing"))
    survey = Polygon(
        [(-0.1, -0.5), (5.1, -0.5), (5.1, 3.5), (-0.1, 3.5)],
        [[(2.0, 1.4), (2.0, 1.6), (2.3, 1.6), (2.3, 1.4)]],
    )
    return plan_of(lines, [(0, 2), (3, 5)], survey=survey, **changes)


def golden_plan() -> Plan:
    """Two lines and all ways to turn: an arc, a turn on the spot, a step sideways."""
    north = [line((0.0, 0.0), (4.6, 0.0)), line((4.6, 1.0), (0.0, 1.0))]
    lines = [*north, line((0.0, 1.8), (0.0, 2.6), "fill")]
    legs = (
        straight((-0.5, 0.0), (0.0, 0.0)),
        straight((0.0, 0.0), (4.6, 0.0), 0),
        straight((4.6, 0.0), (5.1, 0.0)),
        arc((5.1, 0.0), 0.0, 0.5, math.pi),
        straight((5.1, 1.0), (4.6, 1.0)),
        straight((4.6, 1.0), (0.0, 1.0), 1),
        straight((0.0, 1.0), (0.0, 1.8), side_rad=math.pi / 2),
        spot((0.0, 1.8), math.pi, -math.pi / 2),
        straight((0.0, 1.8), (0.0, 2.6), 2),
    )
    return plan_of(lines, [(0, 2)], routes=[Route(legs=legs)], home=(-0.5, 0.0))
