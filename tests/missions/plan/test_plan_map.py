"""The map of a finished plan."""

from pathlib import Path

import pytest

from alice_survey.app.stages import spec
from alice_survey.core.config import parse_config
from alice_survey.core.errors import ConfigError
from alice_survey.core.executor import SERIAL
from missions.plan.map import map_report


@pytest.mark.slow
def test_a_finished_plan_is_drawn_again_for_print(tmp_path: Path) -> None:
    config = parse_config({"area": {"length_m": 4.0, "width_m": 3.0}}, "test")
    spec("plan").make(tmp_path, config, SERIAL)
    plan = tmp_path / "plan" / "plan.json"
    sections = config.camera, config.water, config.area, config.sea
    for suffix, start in ((".pdf", b"%PDF"), (".svg", b"<?xml"), (".png", b"\x89PNG")):
        drawn = [tmp_path / name / f"map{suffix}" for name in "ab"]
        for out in drawn:
            map_report(plan, out, *sections)
        assert drawn[0].read_bytes().startswith(start)
        assert drawn[0].read_bytes() == drawn[1].read_bytes()
    with pytest.raises(ConfigError):
        map_report(plan, tmp_path / "map.bmp", *sections)
