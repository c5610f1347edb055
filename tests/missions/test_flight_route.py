"""What of a plan is flown: dives, one or all, with stops between straight ways."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shapely.geometry import MultiPolygon, Polygon, box

from alice_survey.app.stages import spec
from alice_survey.core.artefacts import write_json
from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.errors import PlanError, VehicleError
from alice_survey.core.executor import SERIAL
from alice_survey.sim.vehicle.pilot.memory import FOLLOW, LEG, PHASE
from camera_calib.rig import design_rig
from missions.fly import simulation
from missions.fly.run import flight_summary
from missions.values.flight import Flight
from tests.missions.flown_plans import flown, off_stations_m, plan_of, survey, walk

FIRST = walk(
    (0.0, 0.0), 0.0,
    [("go", 1.0), ("line", 4.0, 0), ("go", 0.5), ("step", 1.0), ("spot", 180.0), ("go", 0.5),
     ("line", 4.0, 1), ("go", 1.0), ("spot", 90.0), ("go", 1.0)],
)  # fmt: skip
"""Up, a step to starboard, about, and back; home from the east."""
SECOND = walk(
    (0.0, 0.0), 90.0,
    [("go", 2.0), ("spot", -90.0), ("go", 1.0), ("line", 4.0, 2), ("spot", 90.0), ("spot", 90.0),
     ("go", 5.0), ("spot", 90.0), ("go", 2.0)],
)  # fmt: skip
"""The third line ends in a turn on the spot."""
PLAN = plan_of([FIRST, SECOND])


def summary(flight: Flight) -> dict[str, Any]:
    return flight_summary(flight, survey().vehicle, design_rig(CameraConfig(), WaterConfig()))


@pytest.fixture(scope="module")
def flight() -> Flight:
    return flown(PLAN, survey())


def test_dives_join_at_home_by_a_turn_on_the_spot() -> None:
    legs = simulation.whole_route(PLAN).legs
    count = len(FIRST.legs)
    assert legs[:count] == FIRST.legs
    assert legs[count + 1 :] == SECOND.legs
    between = legs[count]
    np.testing.assert_allclose(between.start_ne_m, (0.0, 0.0), atol=1e-12)
    # Home from the east is a course of 270 degrees; the second dive begins at 90.
    assert (between.length_m, between.line) == (0.0, -1)
    assert abs(between.turn_rad) == pytest.approx(math.pi)
    path = simulation.path_of(PLAN)
    assert path.line[path.line >= 0].tolist() == [0.0, 1.0, 2.0]


def test_one_dive_is_the_plan_with_that_dive_alone() -> None:
    second = simulation.one_dive(PLAN, 2)
    assert simulation.whole_route(second).legs == SECOND.legs
    assert second.lines == PLAN.lines
    assert (simulation.stations_of_dives(second), simulation.stations_of_dives(PLAN)) == (6, 18)
    assert second.duration_s == PLAN.dives[1].duration_s
    assert simulation.max_mission_s(second) < simulation.max_mission_s(PLAN)
    assert simulation.one_dive(PLAN, None) is PLAN


def test_all_dives_are_flown_in_one_mission_from_home_to_home(flight: Flight) -> None:
    assert flight.ending == "complete"
    assert len(flight.trigger_s) == PLAN.stations == 18
    assert flight.trigger_line == (*[0] * 6, *[1] * 6, *[2] * 6)
    assert np.all(np.diff(flight.trigger_s) > 0)
    np.testing.assert_allclose(flight.glass_ned[0, :2], PLAN.home_ne_m, atol=1e-9)
    following = flight.flown.report[:, PHASE] == FOLLOW
    assert np.linalg.norm(flight.glass_ned[following][-1, :2] - PLAN.home_ne_m) < 0.3
    found = summary(flight)
    assert (found["dives"], found["stations_planned"]) == (2, 18)
    # Pictures are in their places, at a line that ends in a stop too.
    assert 0.001 < off_stations_m(flight, flight.believed_glass_ned).max() < 0.15


def test_stops_are_made_where_they_are_planned(flight: Flight) -> None:
    """By the navigation: where the vehicle turns on the spot, and how it steps aside."""
    path, leg = simulation.path_of(PLAN), flight.flown.report[:, LEG]
    following = flight.flown.report[:, PHASE] == FOLLOW
    for i in np.flatnonzero(path.turn_rad):
        rows = following & (leg == i)
        away = flight.believed_glass_ned[rows, :2] - [path.start_n[i], path.start_e[i]]
        assert 0.001 < np.linalg.norm(away, axis=1).max() < 0.25
    (step,) = np.flatnonzero(path.side_rad)
    rows = following & (leg == step)
    heading = np.rad2deg(flight.attitude_rad[rows, 2] - path.heading_rad[step])
    np.testing.assert_allclose(heading, np.rad2deg(path.side_rad[step]), atol=4.0)


def test_one_dive_is_flown_alone() -> None:
    alone = flown(simulation.one_dive(PLAN, 2), survey())
    assert alone.ending == "complete"
    assert set(alone.trigger_line) == {2}
    assert np.flatnonzero(~np.isnan(alone.line_errors[0])).size > 100
    found = summary(alone)
    assert (found["dives"], found["stations_planned"], found["stations"]) == (1, 6, 6)


@pytest.mark.parametrize(
    ("allowed", "room"),
    [
        (box(-3.0, -3.0, 8.0, 5.0), 1.6),
        (box(-0.5, -3.0, 8.0, 5.0), 0.5),
        (box(0.0, -3.0, 8.0, 5.0), 0.0),
        # Beyond a no-go zone there is no room.
        (box(-3.0, -3.0, 8.0, 5.0).difference(box(-1.2, -1.0, -0.7, 1.0)), 0.7),
    ],
)
def test_the_way_in_stays_where_the_vehicle_may_be(allowed: Polygon, room: float) -> None:
    fenced = replace(PLAN, area=replace(PLAN.area, allowed=MultiPolygon([allowed])))
    assert simulation.room_behind_m(fenced, simulation.path_of(fenced), 1.6) == pytest.approx(
        room, abs=1e-5
    )


def test_a_vehicle_without_sway_turns_on_the_spot_with_a_warning_but_cannot_step(
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = survey(vehicle={"name": "sparus2", "controller": "los"})
    with pytest.raises(VehicleError, match="1 sway step"):
        flown(PLAN, config)
    capsys.readouterr()
    flight = flown(simulation.one_dive(PLAN, 2), config)
    assert capsys.readouterr().err
    assert flight.ending == "complete"
    assert len(flight.trigger_s) == 6


def test_the_settings_choose_the_dive(tmp_path: Path) -> None:
    folder = tmp_path / "plan"
    write_json(folder / "plan.json", PLAN.to_json())
    write_json(folder / "stage.json", {})
    config = survey(vehicle={"dive": 2}, seafloor={"grid_m": 0.05})
    assert spec("fly").make(tmp_path, config, SERIAL)
    found = json.loads((tmp_path / "flight" / "flight.json").read_text())
    assert (found["stations"], found["stations_planned"]) == (6, 6)
    with pytest.raises(PlanError, match="dive 3"):
        spec("fly").make(tmp_path, survey(vehicle={"dive": 3}, seafloor={"grid_m": 0.05}), SERIAL)
