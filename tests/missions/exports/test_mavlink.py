"""WPL 110 read back by pymavlink, QGroundControl plans by MAVSDK's importer."""

import itertools
import json
import math
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from mavsdk.component_type import ComponentType
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.mission_raw.mission_raw import MissionRaw
from pymavlink import mavwp
from pymavlink.dialects.v20 import ardupilotmega as dialect
from shapely.geometry import Point, Polygon, box

from camera_calib.rig import Rig
from missions.exports.format import line_tolerance_m
from missions.exports.write import write_exports
from missions.values.plan_file import Plan
from tests.missions.exports.plans import RIG, line, plan_of, small_plan
from tests.missions.exports.readers import WIDE, local_ne, plans, rigs, turned

MM = 1e-3
Importer = Callable[[str], Any]


@pytest.fixture(scope="module")
def import_plan() -> Iterator[Importer]:
    """MAVSDK's importer; it needs a vehicle, so it receives one heartbeat."""
    mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    mavsdk.add_any_connection("raw://")
    link = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    heart = link.heartbeat_encode(
        dialect.MAV_TYPE_SUBMARINE, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, 0, 0, 4
    )
    mavsdk.pass_received_raw_bytes(heart.pack(link))
    system = mavsdk.first_autopilot(10.0)
    assert system is not None
    yield MissionRaw(system).import_qgroundcontrol_mission
    mavsdk.destroy()


def read_wpl(path: Path) -> list[Any]:
    loader = mavwp.MAVWPLoader()
    loader.load(str(path))
    return [loader.wp(index) for index in range(loader.count())]


def written(plan: Plan, rig: Rig, formats: list[str], folder: Path) -> None:
    write_exports(folder, plan, rig, formats=formats)


def check_lines(
    plan: Plan, rig: Rig, dive: int, items: list[Any], unit_deg: float, atol: float
) -> None:
    """The camera is on exactly along each line of the glass, and takes all its pictures."""
    glass = rig.body_from_cam("left").apply([0.0, 0.0, 0.03])
    first, last = plan.dives[dive].first_line, plan.dives[dive].last_line
    number, on, place = first, 0.0, np.zeros(2)
    for item in items:
        if item.command == dialect.MAV_CMD_NAV_WAYPOINT:
            at = local_ne(plan.datum, item.x * unit_deg, item.y * unit_deg)
            before, place = place, np.array(at)
            if on:
                wanted = plan.lines[number]
                arm = turned((glass[0], glass[1]), wanted.heading_rad)
                np.testing.assert_allclose(before + arm, wanted.start_ne_m, atol=atol)
                # It goes on by its radius and a step: the allowed area is 3 m wider.
                past_m = line_tolerance_m(plan, rig) + plan.station_spacing_m
                past = past_m * turned((1.0, 0.0), wanted.heading_rad)
                np.testing.assert_allclose(place + arm, wanted.end_ne_m + past, atol=atol)
                assert item.frame == 10
                altitude = plan.altitude_m + glass[2] - 0.11
                assert item.z == pytest.approx(altitude, abs=MM)
                assert math.floor(wanted.length_m / on) + 1 == wanted.stations
                number += 1
        elif item.command == dialect.MAV_CMD_DO_SET_CAM_TRIGG_DIST:
            assert bool(item.param1) != bool(on)
            on = item.param1
    assert number == last + 1
    assert not on


@settings(WIDE, max_examples=20)
@given(plan=plans(), rig=rigs())
def test_wpl_in_pymavlink(plan: Plan, rig: Rig) -> None:
    with tempfile.TemporaryDirectory() as folder:
        written(plan, rig, ["wpl"], Path(folder))
        for dive in range(len(plan.dives)):
            rows = read_wpl(Path(folder) / f"mission_dive{dive + 1}.waypoints")
            check_lines(plan, rig, dive, rows, 1.0, MM)
            assert [w.seq for w in rows] == list(range(len(rows)))
            assert [w.current for w in rows] == [1] + [0] * (len(rows) - 1)


@WIDE
@given(plan=plans(), rig=rigs())
def test_plans_in_mavsdk(import_plan: Importer, plan: Plan, rig: Rig) -> None:
    with tempfile.TemporaryDirectory() as folder:
        written(plan, rig, ["qgc"], Path(folder))
        for dive in range(len(plan.dives)):
            data = import_plan(str(Path(folder) / f"mission_dive{dive + 1}.plan"))
            # MAVLink carries 1e-7 degrees, 11 mm: half of it in each of north and east.
            check_lines(plan, rig, dive, data.mission_items, 1e-7, 0.0058)


def test_the_way_down_is_by_depth_and_stops_short_of_the_charted_floor(tmp_path: Path) -> None:
    written(small_plan(), RIG, ["wpl"], tmp_path)
    rows = read_wpl(tmp_path / "mission_dive1.waypoints")[1:]
    ways = [row for row in rows if row.command == dialect.MAV_CMD_NAV_WAYPOINT]
    # A floor at 15 m, twice 2 m above it, and the reference point 0.08 m above the glass.
    assert (ways[0].frame, ways[0].z) == (3, pytest.approx(-(15 - 4 - 0.08)))
    assert (ways[-1].frame, ways[-1].z) == (3, 0.0)
    assert {row.frame for row in ways[1:-1]} == {10}


def test_a_turn_on_the_spot_has_its_heading_and_sense(tmp_path: Path) -> None:
    plan = small_plan()
    written(plan, RIG, ["wpl"], tmp_path)
    rows = read_wpl(tmp_path / "mission_dive1.waypoints")
    turns = [leg for leg in plan.dives[0].route.legs if leg.turn_rad]
    yaws = [row for row in rows if row.command == dialect.MAV_CMD_CONDITION_YAW]
    assert len(yaws) == len(turns) > 3
    for row, leg in zip(yaws, turns, strict=True):
        off_rad = math.remainder(math.radians(row.param1) - leg.end_heading_rad, math.tau)
        assert off_rad == pytest.approx(0.0, abs=1e-6)
        assert row.param3 == math.copysign(1, math.remainder(leg.turn_rad, math.tau))
        assert row.param4 == 0
    # ArduPilot does the first command after a way-point before the next way begins, and beginning
    # turns the vehicle along it: a heading must be the second.
    for before, row in itertools.pairwise(rows):
        if row.command == dialect.MAV_CMD_CONDITION_YAW:
            assert before.command != dialect.MAV_CMD_NAV_WAYPOINT


def test_the_fence_holds_the_vehicle_and_keeps_it_out(
    tmp_path: Path, import_plan: Importer
) -> None:
    survey = Polygon(
        [(-0.1, -0.5), (5.1, -0.5), (5.1, 6.0), (-0.1, 6.0)],
        [[(1.5, 2.0), (1.5, 4.0), (3.5, 4.0), (3.5, 2.0)]],
    )
    lines = [line((0.2, 0.0), (4.8, 0.0)), line((4.8, 1.2), (0.2, 1.2))]
    plan = plan_of(lines, [(0, 1)], survey=survey)
    written(plan, RIG, ["qgc"], tmp_path)
    data = import_plan(str(tmp_path / "mission_dive1.plan"))

    corners: dict[int, list[tuple[float, float]]] = {}
    for vertex in data.geofence_items:
        place = local_ne(plan.datum, vertex.x * 1e-7, vertex.y * 1e-7)
        corners.setdefault(vertex.command, []).append(place)
    inside = Polygon(corners[dialect.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION])
    outside = Polygon(corners[dialect.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION])
    assert outside.symmetric_difference(Polygon(survey.interiors[0])).area < 0.1
    # The lever arm of 0.552 m about the area where the glass may be.
    assert inside.symmetric_difference(survey.buffer(3.552, join_style="mitre")).area < 4.5
    for item in data.mission_items:
        if item.command == dialect.MAV_CMD_NAV_WAYPOINT:
            flown = Point(local_ne(plan.datum, item.x * 1e-7, item.y * 1e-7))
            assert inside.contains(flown)
            assert not outside.contains(flown)


def test_a_zone_that_the_reference_point_must_cut_is_cut_or_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = box(2.0, -0.2, 2.4, 0.1)
    zones = [small, box(0.8, 3.0, 4.2, 3.3), box(4.0, 5.2, 4.5, 5.7)]
    rings = [list(zone.exterior.coords) for zone in zones]
    survey = Polygon([(-0.1, -0.5), (5.1, -0.5), (5.1, 6.0), (-0.1, 6.0)], rings)
    lines = [line((0.2, 0.0), (4.8, 0.0)), line((2.2, 2.0), (2.2, 4.6))]
    plan = plan_of(lines, [(0, 0), (1, 1)], survey=survey)
    written(plan, RIG, ["qgc"], tmp_path)
    for dive in (1, 2):
        data = json.loads((tmp_path / f"mission_dive{dive}.plan").read_text())
        rings = [p["polygon"] for p in data["geoFence"]["polygons"] if not p["inclusion"]]
        corners = [plan.datum.ned_from_geodetic(np.pad(r, [(0, 0), (0, 1)])) for r in rings]
        fenced = shapely.union_all([Polygon(ring[:, :2]) for ring in corners])
        assert fenced.intersection(small).area < 1e-6
        parts = fenced.intersection(zones[1])
        assert len(shapely.get_parts(parts)) > 1  # to both sides of the way of the second dive
        assert 0.2 < parts.area / zones[1].area < 0.8
        assert fenced.intersection(zones[2]).area == pytest.approx(zones[2].area, rel=1e-5)
    said = [text for text in capsys.readouterr().err.splitlines() if "fence" in text]
    assert len(said) == 1 and "2 of 3" in said[0] and "1 of them" in said[0]


def test_a_plan_and_the_wpl_say_the_same(tmp_path: Path, import_plan: Importer) -> None:
    plan = small_plan()
    written(plan, RIG, ["qgc", "wpl"], tmp_path)
    for dive in (1, 2):
        simple = import_plan(str(tmp_path / f"mission_dive{dive}.plan")).mission_items
        rows = read_wpl(tmp_path / f"mission_dive{dive}.waypoints")
        # The first item is home in all; MAVSDK says it in integers.
        assert [item.command for item in simple] == [row.command for row in rows]
        names = ("frame", "param1", "param2", "param3", "param4", "z")
        for item, row in list(zip(simple, rows, strict=True))[1:]:
            read, given = ([getattr(one, name) for name in names] for one in (item, row))
            assert read == pytest.approx(given, abs=2e-5)
            assert (item.x, item.y) == pytest.approx((row.x * 1e7, row.y * 1e7), abs=1.01)
