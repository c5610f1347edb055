"""The setting that a refused plan suggests, planned."""

from typing import Any

import pytest

from alice_survey.core.config import SurveyConfig, parse_config
from tests.missions.exposure.surveys import conflict_of
from tests.missions.flown_plans import planned_survey
from tests.small_survey import with_settings

SMALL = {"length_m": 8.0, "width_m": 5.0}


def survey(**sections: dict[str, Any]) -> SurveyConfig:
    return parse_config({"area": SMALL, **sections}, "survey")


@pytest.mark.parametrize(
    ("config", "setting"),
    [
        (survey(sea={"current_mps": 0.5}), "sea.current_mps"),
        (survey(sea={"current_mps": 0.5}, plan={"turns": "arcs"}), "sea.current_mps"),
        (survey(plan={"altitude_m": 0.4, "relief_m": 0.35}), "plan.altitude_m"),
        (survey(plan={"altitude_m": 0.6, "relief_m": 0.35}), "plan.altitude_m"),
        (survey(plan={"speed_mps": 2.0, "forward_overlap": 0.95}), "plan.speed_mps"),
        (survey(camera={"baseline_m": 2.0}, area={**SMALL, "seafloor_depth_m": 20.0}),
         "plan.altitude_m"),
        (survey(plan={"relief_m": 1.2, "sharp_px": 0.5}), "plan.sharp_px"),
        (survey(plan={"track_error_m": 0.6}), "plan.track_error_m"),
        (survey(plan={"speed_mps": 3.0}), "plan.speed_mps"),
    ],
)  # fmt: skip
def test_the_setting_that_is_suggested_plans(config: SurveyConfig, setting: str) -> None:
    error = conflict_of(planned_survey, config)
    name, value = error.suggestion
    assert name == setting
    assert f"; {name} = {value:g} fits" in str(error)
    assert len(str(error).splitlines()) == 1
    assert planned_survey(with_settings(config, {name: value})).certificate.stereo_share > 0.999


def test_what_a_plan_warns_of_is_in_its_file_too() -> None:
    ring = {"wkt": "LINESTRING (0 0, 8 0, 8 5, 0 5, 0 0)", "corridor_width_m": 2.0}
    found = planned_survey(survey(area=ring, plan={"speed_mps": 0.3}))
    assert found.plan.details["warnings"] == list(found.warnings)
    for said in ("closed_lines = 'inside'", "arcs are planned with 0.58 m"):
        assert [said in warning for warning in found.warnings].count(True) == 1
    assert found.plan.turn_radius_m == 0.58
    assert found.certificate.stereo_share > 0.999
