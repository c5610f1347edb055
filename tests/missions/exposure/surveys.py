"""Surveys that the tests of imaging plan."""

from collections.abc import Callable
from typing import Any

import pytest

from alice_survey.core.config import parse_config
from camera_calib.rig import Rig
from missions.exposure.conflict import ConflictError
from missions.exposure.settings import ImagingSetup


def survey(ideal_port: bool = False, **sections: Any) -> tuple[Rig, ImagingSetup]:
    """Rig and setup of a survey with the default settings but for those given, by section."""
    if ideal_port:
        port = {"port_distance_m": 0.0, "glass_thickness_m": 0.0}
        sections["camera"] = {**port, **sections.get("camera", {})}
    config = parse_config(sections, "test")
    setup = ImagingSetup(
        plan=config.plan, camera=config.camera, water=config.water, imaging=config.imaging
    )
    return setup.rig, setup


def conflict_of(call: Callable[..., object], *args: Any, **named: Any) -> Any:
    """The conflict that a call is refused with."""
    with pytest.raises(ConflictError) as fault:
        call(*args, **named)
    return fault.value
