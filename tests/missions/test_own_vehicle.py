"""Vehicles that a file describes, planned and flown."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alice_survey.app.pipeline import plan_report
from alice_survey.core.artefacts import read_json
from alice_survey.core.config import SurveyConfig, load_config
from alice_survey.core.errors import AliceError, PlanError, VehicleError
from alice_survey.sim.vehicle.pilot.gains import LAG, MASS, PLACE, RATE, gains_for
from alice_survey.sim.vehicle.vehicle import vehicle_from
from missions.plan.strength import survey_costs
from missions.route.energy import battery_wh, hotel_w, planned_vehicle
from missions.values.flight import Flight, rms
from tests.missions import flown_plans
from tests.missions.flown_plans import flown, planned
from tests.small_survey import with_settings

HEAVY = Path(__file__).parents[2] / "alice_survey/sim/vehicle/fleet_files/bluerov2_heavy.toml"
PLACES = {"position_body_m": [0.2, -0.05, 0.1], "dvl_position_body_m": [-0.1, 0.0, 0.12]}


def survey(vehicle: dict[str, object], **changes: Any) -> SurveyConfig:
    area = {"length_m": 5.0} | changes.pop("area", {})
    return flown_plans.survey(area=area, camera=PLACES, vehicle=vehicle, **changes)


def changed_heavy(folder: Path, **lines: str) -> str:
    """The file of the heavy vehicle with some lines replaced, or left out if empty."""
    text = HEAVY.read_text()
    for name, line in lines.items():
        text, count = re.subn(rf"^{name} = .*$", line, text, flags=re.MULTILINE)
        assert count == 1
    path = folder / "own.toml"
    path.write_text(text)
    return str(path)


def flown_by(name: str) -> Flight:
    config = survey({"name": name})
    return flown(planned(config), config, None, 1)


def tilt_deg(flight: Flight) -> np.ndarray:
    """(T, 2) roll and pitch while lines are flown."""
    return np.rad2deg(flight.attitude_rad[flight.line >= 0, :2])


def test_eight_thrusters_fly_level_lines() -> None:
    flight = flown_by("bluerov2_heavy")
    cross, heading = flight.line_errors
    assert flight.ending == "complete"
    assert flight.vehicle.name == "bluerov2_heavy"
    assert 0.002 < rms(cross) < 0.12
    assert 0.1 < np.rad2deg(rms(heading)) < 3.0
    assert 0.05 < np.sqrt((tilt_deg(flight) ** 2).mean()) < 3.0


def test_thrusters_hold_level_what_gravity_does_not(tmp_path: Path) -> None:
    """With the centres of gravity and buoyancy in one place nothing rights the hull."""
    flight = flown_by(changed_heavy(tmp_path, cg_body_m="cg_body_m = [0.0, 0.0, 0.0]"))
    assert flight.ending == "complete"
    assert np.sqrt((tilt_deg(flight) ** 2).mean()) < 5.0


def test_gains_of_roll_and_pitch_are_damped_with_their_lag() -> None:
    craft = vehicle_from("bluerov2_heavy")
    gains = gains_for(craft, 0.2)
    assert gains.holds_level
    for row, degree in ((4, 3), (5, 4)):
        axis = gains.axes[row]
        assert axis[MASS] == pytest.approx(craft.mass[degree, degree])
        decay = -craft.coefficients.linear[degree, degree] / axis[MASS]
        poles = np.roots([axis[LAG], 1 + axis[LAG] * decay, decay + axis[RATE], axis[PLACE]])
        assert np.all(poles.real < -0.5)
        assert np.min(-poles.real / np.abs(poles)) > 0.99


def test_battery_and_hotel_load_are_the_vehicles_own_or_as_set(tmp_path: Path) -> None:
    heavy = survey({"name": "bluerov2_heavy"}).vehicle
    assert (battery_wh(heavy), hotel_w(heavy)) == (266.0, 35.0)
    other = survey({"name": "bluerov2_heavy", "battery_wh": 100.0, "hotel_w": 0.0}).vehicle
    assert (battery_wh(other), hotel_w(other)) == (100.0, 0.0)
    bare = survey({"name": changed_heavy(tmp_path, battery_wh="", hotel_w="hotel_w = 1.0")})
    with pytest.raises(VehicleError, match=r"own\.toml: states no battery_wh: .*vehicle\.battery"):
        planned(bare)


def test_no_vehicle_dives_deeper_than_it_is_built_for() -> None:
    for name, rated_m in (("alice", 200), ("bluerov2_heavy", 100)):
        deep = survey({"name": name}, area={"seafloor_depth_m": rated_m + 2.5})
        with pytest.raises(PlanError, match=f"{name} is built for {rated_m} m"):
            planned(deep)


@pytest.mark.parametrize(
    ("vehicle", "named"),
    [
        ({"name": "nautilus"}, "alice, bluerov2_heavy, remus100, sparus2, or a TOML file"),
        ({"name": "none.toml"}, "none.toml: cannot be read"),
        ({"name": "bluerov2_heavy", "coefficients": "cfd"}, "has its own coefficients, not 'cfd'"),
        ({"failures": ["warp=0.5"]}, "no thruster 'warp'; it has starboard"),
        ({"name": "sparus2", "failures": ["bow"]}, "sparus2 has no thruster 'bow'"),
    ],
)
def test_what_is_not_known_is_named(vehicle: dict[str, object], named: str) -> None:
    with pytest.raises(AliceError, match=re.escape(named)):
        planned_vehicle(survey(vehicle).vehicle)


def test_a_vehicle_is_named_for_one_plan(tmp_path: Path) -> None:
    """`plan --vehicle`: its energy is that of the survey with that vehicle in its settings."""
    area = (
        "[area]\nlength_m = 3.0\nwidth_m = 1.0\nseafloor_depth_m = 6.0\n[plan]\ncross_lines = 0\n"
    )
    (tmp_path / "survey.toml").write_text(area)
    plan_report(tmp_path, None, vehicle="bluerov2_heavy")
    given = read_json(tmp_path / "plan" / "plan.json")
    config = load_config(tmp_path / "survey.toml")
    heavy, own = (
        planned(with_settings(config, {"vehicle.name": name})).energy_wh
        for name in ("bluerov2_heavy", "alice")
    )
    assert given["energy_wh"] == pytest.approx(heavy, rel=1e-6)
    assert abs(heavy - own) > 0.02 * own
    with pytest.raises(VehicleError, match="'nautilus' is not known"):
        plan_report(tmp_path, None, vehicle="nautilus")


def test_energy_is_that_of_the_vehicle() -> None:
    """Drag of the ROV at 0.2 m/s: 13.7 x 0.2 + 141 x 0.04 N, by four thrusters at 45 deg."""
    costs = survey_costs(survey({"name": "bluerov2_heavy", "hotel_w": 0.0}, sea={"current_mps": 0}))
    drag_w = (13.7 * 0.2 + 141.0 * 0.04) * 0.2
    assert 1.5 * drag_w < float(np.min(costs.way_w)) < 30.0 * drag_w
    ours = survey_costs(survey({"hotel_w": 0.0}, sea={"current_mps": 0}))
    assert float(np.min(costs.way_w)) > 1.5 * float(np.min(ours.way_w))
