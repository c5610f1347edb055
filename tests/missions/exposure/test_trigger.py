import pytest

from missions.exposure.conflict import ConflictError
from missions.exposure.settings import imaging_settings, paper_rule
from missions.values.footprint import footprint_size_m
from tests.missions.exposure.surveys import survey


def test_the_papers_rule_gives_28_percent_not_60() -> None:
    rig, config = survey(ideal_port=True, water={"n_water": 1.33})
    along_m = footprint_size_m(rig.cameras["left"], 2.0)[1]
    rule = paper_rule(config.plan, along_m)

    assert rule.rate_hz == pytest.approx(0.25)
    assert rule.forward_overlap == pytest.approx(0.28, abs=0.005)


def test_a_camera_that_is_too_slow_suggests_the_speed_that_just_fits() -> None:
    rig, config = survey(plan={"forward_overlap": 0.92, "speed_mps": 1.32})
    with pytest.raises(ConflictError) as fault:
        imaging_settings(rig, config)
    along_m = footprint_size_m(rig.cameras["left"], 2.0)[1]
    assert f"{1.32 / (0.08 * along_m):.3g} " in str(fault.value)  # 14 fps
    assert fault.value.suggestion is not None
    name, speed_mps = fault.value.suggestion
    assert name == "plan.speed_mps"
    slower = survey(plan={"forward_overlap": 0.92, "speed_mps": speed_mps})
    # The tenth of a second is used up.
    assert 0.1 <= imaging_settings(*slower).interval_s <= 0.1015
