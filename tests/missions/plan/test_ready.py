"""Ways out that a plan offers, each planned."""

from typing import Any

import pytest

from alice_survey.core.config import SurveyConfig, parse_config, with_settings
from camera_calib.rig import design_rig
from missions.exposure.ways_out import ConflictError
from missions.plan.planner import Planned, plan_survey

SMALL = {"length_m": 8.0, "width_m": 5.0}
FIVE_THRUSTERS = dict.fromkeys(("starboard", "port", "vertical", "bow", "stern"), 1.0)


def survey(**sections: dict[str, Any]) -> SurveyConfig:
    return parse_config({"area": SMALL, **sections}, "survey")


def planned(config: SurveyConfig) -> Planned:
    return plan_survey(config, design_rig(config.camera, config.water))


@pytest.mark.parametrize(
    ("config", "minimum"),
    [
        (survey(sea={"current_mps": 0.5}), 3),
        (survey(sea={"current_mps": 0.5}, plan={"turns": "arcs"}), 3),
        (survey(plan={"altitude_m": 0.4, "relief_m": 0.35, "line_spacing_m": 1.0}), 1),
        (survey(plan={"speed_mps": 2.0, "forward_overlap": 0.95}), 1),
        (survey(vehicle={"failures": ["vertical"]}), 1),
        (survey(camera={"baseline_m": 2.0}, area={**SMALL, "seafloor_depth_m": 20.0}), 1),
        (survey(plan={"relief_m": 1.2, "sharp_px": 0.5}), 2),
    ],
    ids=["current", "current, arcs", "relief", "rate", "thruster", "baseline", "focus"],
)
def test_every_way_out_that_is_offered_plans(config: SurveyConfig, minimum: int) -> None:
    with pytest.raises(ConflictError) as caught:
        planned(config)
    assert minimum <= len(caught.value.ways) <= 3
    for way in caught.value.ways:
        assert f"  - {way.change}: {way.price}" in str(caught.value).splitlines()
        seen = planned(with_settings(config, way.settings)).certificate
        assert seen.stereo_share > 0.999, way.change


def test_a_conflict_that_nothing_tried_resolves_says_so() -> None:
    """A current on top: at no speed or overlap that the camera can do."""
    with pytest.raises(ConflictError) as caught:
        planned(
            survey(
                plan={"speed_mps": 2.0, "forward_overlap": 0.95, "turns": "arcs"},
                sea={"current_mps": 3.0},
            )
        )
    text = str(caught.value)
    assert len(text.splitlines()) == 1
    assert "no value of one of plan.forward_overlap, plan.speed_mps, plan.altitude_m" in text


def test_what_a_plan_warns_of_is_in_its_file_too() -> None:
    ring = "LINESTRING (0 0, 8 0, 8 5, 0 5, 0 0)"
    found = planned(survey(area={"wkt": ring, "corridor_width_m": 2.0}, plan={"speed_mps": 0.3}))
    assert found.plan.details["warnings"] == list(found.warnings)
    for said in ("closed_lines = 'inside'", "arcs are planned with 0.58 m"):
        assert [said in warning for warning in found.warnings].count(True) == 1
    assert found.plan.turn_radius_m == 0.58
    assert found.certificate.stereo_share > 0.999
