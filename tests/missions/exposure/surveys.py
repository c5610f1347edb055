"""Surveys that the tests of imaging plan."""

from typing import Any

from alice_survey.base.config import SurveyConfig, parse_config
from camera_calib.rig import Rig, design_rig


def survey(ideal_port: bool = False, **sections: Any) -> tuple[Rig, SurveyConfig]:
    """A survey with the default settings but for those given, by section, and its rig."""
    if ideal_port:
        port = {"port_distance_m": 0.0, "glass_thickness_m": 0.0}
        sections["camera"] = {**port, **sections.get("camera", {})}
    config = parse_config(sections, "test")
    return design_rig(config.camera, config.water), config
