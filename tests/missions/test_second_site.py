"""The paper's second site: its settings plan and fly the whole of it."""

from importlib import resources

import numpy as np
import pytest

from alice_survey.core.config import load_config
from missions.fly.simulation import floor_grid
from tests.missions.flown_plans import flown, planned, terrain_of


@pytest.mark.slow
def test_the_site_of_the_paper_is_flown_over_its_rocks() -> None:
    """10 x 30 m at 8 m depth, flown at 3 m altitude (Gutnik et al. 2021, section VII)."""
    with resources.as_file(resources.files("alice_survey") / "caesarea.toml") as path:
        config = load_config(path)
    plan = planned(config)
    assert plan.area.survey.area == pytest.approx(300.0, rel=1e-6)
    edges = np.linalg.norm(np.diff(plan.area.rings_ne[0], axis=0), axis=1)
    np.testing.assert_allclose(sorted(edges), [10.0, 10.0, 30.0, 30.0], rtol=1e-6)
    assert (plan.seafloor_depth_m, plan.altitude_m, plan.speed_mps) == (8.0, 3.0, 0.2)
    assert plan.coverage >= 0.999
    assert len(plan.dives) == 1

    coarse = config.seafloor.model_copy(update={"grid_m": 0.05})
    rough = config.model_copy(update={"seafloor": coarse})
    terrain = terrain_of(rough, plan)
    # Large rocks: they stick out of the sand by decimetres.
    assert 0.3 < -terrain.depths.min() < 1.0
    assert 0.05 < (terrain.material > 0.5).mean() < 0.3
    flight = flown(plan, config, floor_grid(terrain))
    assert flight.ending == "complete"
    assert len(flight.trigger_s) == plan.stations
    assert flight.stations_off_line == 0
    cross = flight.line_errors[0]
    assert 0.005 < np.sqrt(np.nanmean(cross**2)) < 0.12
    on_line = flight.line >= 0
    assert 2.0 < flight.altitude_m[on_line].min() < flight.altitude_m[on_line].max() < 3.8
