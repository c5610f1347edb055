"""The hull keeps out of no-go zones in turns and on ways between lines, planned and flown."""

import json
import math
import re
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import shapely
from shapely.geometry import MultiPolygon, Point, Polygon, box
from shapely.geometry.base import BaseGeometry

from alice_survey.core.config import SurveyConfig
from alice_survey.core.frames import Array, Datum
from alice_survey.sim.vehicle.vehicle import vehicle_from
from missions.exports.format import options_of
from missions.exports.write import write_exports
from missions.fly.simulation import flight_settings, simulate_mission
from missions.plan.planner import Planned, _home
from missions.values.area import Area, multipolygon
from missions.values.legs import Leg
from missions.values.plan_file import Plan
from tests.missions.exports.plans import RIG
from tests.missions.flown_plans import flown, level_floor, planned_survey, survey

BLOCKS = (box(4, 3, 5, 4), box(4, 8, 5, 9))
PILES = tuple(Point(north, east).buffer(0.6, 6) for north in (2.3, 6.8) for east in (3.0, 7.5))
NARROW = (box(4, 4, 5, 5), box(4, 7, 5, 8))
"""Less between them than the hull needs to turn."""
HULL, GLASS = vehicle_from("alice").hull, (0.55, -0.05)


def config_of(zones: tuple[Polygon, ...], **area: float) -> SurveyConfig:
    rings = [np.array(zone.exterior.coords)[:-1].tolist() for zone in zones]
    size = {"length_m": 9.0, "width_m": 12.0, "heading_deg": 0.0} | area
    return survey(area={**size, "no_go_ne_m": rings}, sea={"current_mps": 0.0})


@lru_cache
def plan_around(zones: tuple[Polygon, ...]) -> Planned:
    return planned_survey(config_of(zones))


def hulls_at(glass_ne: Array, heading_rad: Array) -> Array:
    """Outlines of the hull seen from above, a rectangle, by where glass and bow are."""
    side = HULL.half_breadth_m
    x = np.array([HULL.nose_m, HULL.nose_m, -HULL.tail_m, -HULL.tail_m]) - GLASS[0]
    y = np.array([side, -side, -side, side]) - GLASS[1]
    c, s = np.cos(heading_rad)[:, None], np.sin(heading_rad)[:, None]
    return np.asarray(
        shapely.polygons(glass_ne[:, None] + np.stack([c * x - s * y, s * x + c * y], axis=2))
    )


def hulls_of(leg: Leg) -> Array:
    share = np.linspace(0.0, 1.0, 90)
    turned = leg.curvature_per_m * leg.length_m + leg.turn_rad
    return hulls_at(
        leg.places(share * leg.length_m), leg.heading_rad + leg.side_rad + share * turned
    )


def lines_own(plan: Plan) -> BaseGeometry:
    """What is under the hull on lines."""
    swept = [
        hulls_at(line.stations_ne, np.full(line.stations, line.heading_rad)) for line in plan.lines
    ]
    return shapely.union_all(np.concatenate(swept))


def hull_over_zones_m2(plan: Plan) -> tuple[float, float]:
    """The most, of turns and ways; and of what continues a line, less what it passes itself."""
    own = lines_own(plan)
    most = [0.0, 0.0]
    for dive in plan.dives:
        legs = dive.route.legs
        for i, leg in enumerate(legs):
            if leg.line >= 0:
                continue
            near = [other for other in legs[max(i - 1, 0) : i + 2] if other.line >= 0]
            continues = not (leg.turn_rad or leg.curvature_per_m) and any(
                abs(math.sin(leg.heading_rad - other.heading_rad)) < 1e-9 for other in near
            )
            zones = plan.area.no_go.difference(own.buffer(0.01)) if continues else plan.area.no_go
            area = shapely.area(shapely.intersection(hulls_of(leg), zones)).max()
            most[continues] = max(most[continues], float(area))
    return most[0], most[1]


def ways_over(found: Planned) -> list[int]:
    """Of each warning of the hull, on how many ways it touches a zone."""
    counts = [re.search(r"(\d+) of \d+ ways", text) for text in found.warnings]
    return [int(count[1]) for count in counts if count]


@pytest.mark.parametrize("zones", [BLOCKS, PILES], ids=["blocks", "piles"])
def test_turns_and_ways_keep_the_hull_out_of_zones(zones: tuple[Polygon, ...]) -> None:
    found = plan_around(zones)
    turning_m2, along_m2 = hull_over_zones_m2(found.plan)
    assert turning_m2 < 1e-4
    assert along_m2 < 1e-3
    assert found.plan.coverage > 0.999
    assert any(abs(leg.side_rad) == math.pi for leg in found.plan.dives[0].route.legs)
    assert ways_over(found) == [] and any("hull" in text for text in found.warnings)


def test_home_is_no_corner_of_a_zone_while_there_are_others() -> None:
    """The datum is in the middle of an area, next to a wreck; another zone cuts its edge."""
    outer, zones = box(-9, -9, 9, 9), MultiPolygon([box(1, 1, 2, 2), box(-9, -1, -5, 1)])
    allowed = multipolygon(outer.difference(zones))
    for shape, home in ((allowed, (-9, -9)), (box(2, 1, 4, 2), (4, 1)), (box(1, 1, 2, 2), (1, 1))):
        survey = multipolygon(shape)
        area = Area(datum=Datum(32.8, 35.0), survey=survey, allowed=allowed, no_go=zones)
        assert _home(None, area) == home


def test_where_there_is_no_room_to_turn_one_line_counts_the_ways() -> None:
    found = plan_around(NARROW)
    assert hull_over_zones_m2(found.plan)[0] > 0.1
    assert ways_over(found) == [2]


def test_the_pilot_goes_astern_and_keeps_out_as_planned() -> None:
    plan, config = plan_around(BLOCKS).plan, config_of(BLOCKS)
    flight = flown(plan, config)
    assert flight.ending == "complete" and flight.stations_off_line == 0
    between = (flight.line < 0) & (flight.glass_ned[:, 2] > 3.0)
    zones = plan.area.no_go.difference(lines_own(plan).buffer(0.3))
    hulls = hulls_at(flight.glass_ned[between, :2], flight.attitude_rad[between, 2])
    assert shapely.area(shapely.intersection(hulls[::10], zones)).max() < 0.02


def test_ardusub_stays_out_of_the_zones_of_its_own_fence(tmp_path: Path) -> None:
    plan, config = plan_around(BLOCKS).plan, config_of(BLOCKS)
    options = options_of(config.camera, config.plan, config.vehicle, config.sea)
    write_exports(tmp_path, plan, RIG, formats=["qgc"], options=options)
    path = tmp_path / "mission_dive1.plan"
    fence = json.loads(path.read_text())["geoFence"]["polygons"]
    vehicle = config.vehicle.model_copy(update={"mission_file": path})
    settings = flight_settings(config.model_copy(update={"vehicle": vehicle}))
    flight = simulate_mission(plan, settings, level_floor(6.0), np.random.default_rng(1))
    assert flight.ending == "complete"
    corners = [np.pad(p["polygon"], [(0, 0), (0, 1)]) for p in fence if not p["inclusion"]]
    zones = [Polygon(plan.datum.ned_from_geodetic(ring)[:, :2]) for ring in corners]
    for block in BLOCKS:
        assert shapely.intersection_all([block, shapely.union_all(zones)]).area > 0.05
    places = flight.truth.ned_from_body.translation[:, :2]
    assert not shapely.intersects_xy(shapely.union_all(zones), *places.T).any()
