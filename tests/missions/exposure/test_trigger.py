import re

import pytest

from alice_survey.core.errors import PlanError
from missions.exposure.settings import imaging_settings
from missions.exposure.trigger import paper_rule, trigger_rows
from missions.values.footprint import footprint_size_m
from tests.missions.exposure.surveys import survey


def test_the_papers_rule_gives_28_percent_not_60() -> None:
    rig, config = survey(ideal_port=True, water={"n_water": 1.33})
    along_m = footprint_size_m(rig.cameras["left"], 2.0)[1]
    rule = paper_rule(config.plan, along_m)

    assert rule.rate_hz == pytest.approx(0.25)
    assert rule.wanted_forward_overlap == 0.6
    assert rule.forward_overlap == pytest.approx(0.28, abs=0.005)
    row = trigger_rows(config.plan, config.camera, along_m, along_m, 2.3)[-1]
    assert row.value == rule.rate_hz
    assert "28%" in row.note


def test_a_camera_that_is_too_slow_gets_ways_out_that_work() -> None:
    rig, config = survey(plan={"forward_overlap": 0.92, "speed_mps": 1.32})
    with pytest.raises(PlanError) as fault:
        imaging_settings(rig, config)
    text = str(fault.value)
    along_m = footprint_size_m(rig.cameras["left"], 2.0)[1]
    assert f"{1.32 / (0.08 * along_m):.3g} " in text  # 14 fps
    assert len(text.splitlines()) == 4

    ways = dict(re.findall(r"- (\w+) ([\d.]+) instead of", text))
    assert set(ways) == {"speed_mps", "forward_overlap", "altitude_m"}
    for name, value in ways.items():
        plan = {"forward_overlap": 0.92, "speed_mps": 1.32, name: float(value)}
        settings = imaging_settings(*survey(plan=plan))
        # Each just fits: the tenth of a second is used up.
        assert 0.1 <= settings.interval_s <= 0.1015
