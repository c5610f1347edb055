"""The vehicle of the how-to, one that hovers and one that fins steer, over the tutorial's area."""

from pathlib import Path

import numpy as np
import pytest

from alice_survey.core.config import parse_config
from alice_survey.sim.vehicle.sea import level_floor
from camera_calib.rig import design_rig
from missions.coverage.certificate import certificate
from missions.coverage.stations import plan_pattern, stations_of_flight
from missions.fly.simulation import flight_settings, simulate_plan
from missions.plan.planner import plan_survey
from tests.docs.pages import DOCS, written

_DEPTH_M = 6.0


@pytest.mark.parametrize(
    ("vehicle", "controller", "camera", "plan"),
    [
        ("own.toml", "los", [0.10, -0.05, 0.15], {}),
        ("bluerov2_heavy", "sway", [0.20, -0.05, 0.10], {}),
        ("remus100", "los", [0.30, -0.05, 0.10], {"speed_mps": 1.0}),
    ],
)
def test_any_vehicle_covers_the_area_of_the_tutorial(
    vehicle: str, controller: str, camera: list[float], plan: dict[str, float], tmp_path: Path
) -> None:
    """Planned, flown in the default current and certified: what the plan sees, the flight sees."""
    (tmp_path / "area.geojson").write_text(written(DOCS / "tutorial.md", "area.geojson"))
    own = tmp_path / "own.toml"
    own.write_text(written(DOCS / "how-to/own-vehicle.md", "own.toml"))
    config = parse_config(
        {
            "area": {"file": str(tmp_path / "area.geojson"), "seafloor_depth_m": _DEPTH_M},
            "camera": {"position_body_m": camera, "dvl_position_body_m": [-0.20, 0.0, 0.12]},
            "plan": plan,
            "vehicle": {
                "name": str(own) if vehicle == own.name else vehicle,
                "controller": controller,
            },
        },
        "test",
    )
    rig = design_rig(config.camera, config.water)
    planned = plan_survey(config, rig)
    assert planned.plan.coverage > 0.99
    flight = simulate_plan(
        planned.plan,
        flight_settings(config),
        level_floor(_DEPTH_M),
        np.random.default_rng(config.seed),
    )
    assert flight.ending == "complete"
    flown = certificate(
        planned.plan.area,
        rig,
        stations_of_flight(flight),
        plan_pattern(planned.plan, rig),
        cell_m=planned.certificate.grid.cell_m,
    )
    assert 0.97 < flown.stereo_share <= 1.0
    assert 0.8 < flown.share_at_overlap <= 1.0
    assert flown.fewest_pictures >= 1
