"""Plans to fly: small ones by hand, legs one after the other, and those of surveys."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from shapely.geometry import MultiPolygon, box

from alice_survey.core.config import SurveyConfig, parse_config
from alice_survey.core.frames import Array, Datum
from alice_survey.sim.seafloor.terrain import Terrain
from alice_survey.sim.vehicle.sea import FloorGrid, level_floor
from camera_calib.rig import design_rig
from missions.fly.simulation import flight_settings, simulate_plan, true_terrain
from missions.plan.planner import Planned, plan_survey
from missions.values.area import Area
from missions.values.flight import Flight
from missions.values.legs import Leg, Route
from missions.values.line import Line
from missions.values.plan_file import Plan
from tests.missions.exports.plans import plan_of as exported_plan

Move = tuple[str, float] | tuple[str, float, int]
"""("go", metres), ("line", metres, index), ("spot", degrees), ("step", metres to starboard)."""


def walk(start_ne_m: tuple[float, float], heading_deg: float, moves: Sequence[Move]) -> Route:
    """The route of a vehicle that makes one move after the other."""
    place, heading = start_ne_m, math.radians(heading_deg)
    legs = []
    for kind, amount, *line in moves:
        turn = math.radians(amount) if kind == "spot" else 0.0
        side = -math.copysign(math.pi / 2, amount) if kind == "step" else 0.0
        leg = Leg(
            start_ne_m=place,
            heading_rad=heading - side,
            length_m=0.0 if kind == "spot" else abs(amount),
            curvature_per_m=0.0,
            line=line[0] if line else -1,
            turn_rad=turn,
            side_rad=side,
        )
        legs.append(leg)
        place, heading = leg.end_ne_m, heading + turn
    return Route(legs=tuple(legs))


def plan_of(routes: Sequence[Route], stations: int = 6, turn_radius_m: float = 0.5) -> Plan:
    """A plan whose dives fly these routes; lines are the legs that bear an index."""
    legs = sorted(
        (leg for route in routes for leg in route.legs if leg.line >= 0), key=lambda leg: leg.line
    )
    lines = [
        Line(kind="survey", start_ne_m=leg.start_ne_m, end_ne_m=leg.end_ne_m, stations=stations)
        for leg in legs
    ]
    indices = [[leg.line for leg in route.legs if leg.line >= 0] for route in routes]
    plan = exported_plan(
        lines,
        [(min(own), max(own)) for own in indices],
        datum=Datum(latitude_deg=32.8, longitude_deg=34.9),
        routes=list(routes),
        home=routes[0].legs[0].start_ne_m,
        seafloor_depth_m=6.0,
        interval_s=2.0,
        footprint_m=(1.4, 1.15),
        station_spacing_m=0.8,
        turn_radius_m=turn_radius_m,
    )
    turned = [sum(abs(leg.turn_rad) for leg in route.legs) for route in routes]
    dives = tuple(
        replace(dive, duration_s=dive.duration_s + turn_rad / math.radians(15.0))
        for dive, turn_rad in zip(plan.dives, turned, strict=True)
    )
    area, allowed = (MultiPolygon([box(-m, -m, 7.0 + m, 4.0 + m)]) for m in (1.0, 5.0))
    return replace(
        plan,
        area=Area(datum=plan.datum, survey=area, allowed=allowed, no_go=MultiPolygon()),
        dives=dives,
        duration_s=sum(dive.duration_s for dive in dives),
    )


def survey(**sections: Any) -> SurveyConfig:
    """A survey of a small area in water of 6 m, in a current."""
    area = {"length_m": 3.0, "width_m": 2.5, "seafloor_depth_m": 6.0}
    sea = {"current_mps": 0.1, "current_towards_deg": 110.0}
    area |= sections.pop("area", {})
    return parse_config({"area": area, "sea": sea} | sections, "test")


def planned_survey(config: SurveyConfig) -> Planned:
    """The plan of a survey, with its certificate and warnings."""
    return plan_survey(config, design_rig(config.camera, config.water))


def planned(config: SurveyConfig) -> Plan:
    """The plan of a survey."""
    return planned_survey(config).plan


def flown(
    plan: Plan, config: SurveyConfig, floor: FloorGrid | None = None, seed: int = 1
) -> Flight:
    """A plan flown over a floor, level at 6 m if there is none."""
    rng = np.random.default_rng(seed)
    return simulate_plan(plan, flight_settings(config), floor or level_floor(6.0), rng)


def off_stations_m(flight: Flight, glass_ned: Array) -> Array:
    """How far the glass is from each station of the plan when its picture is taken, (S,)."""
    taken = [np.interp(flight.trigger_s, flight.truth.time_s, axis) for axis in glass_ned[:, :2].T]
    planned_ne = np.vstack([line.stations_ne for line in flight.plan.lines])
    return np.asarray(np.linalg.norm(np.transpose(taken) - planned_ne, axis=1))


def terrain_of(config: SurveyConfig, plan: Plan) -> Terrain:
    """The sea floor of a survey under a plan."""
    return true_terrain(plan, config.area, config.seafloor, config.plan.altitude_m, config.seed)
