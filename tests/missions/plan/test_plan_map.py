"""The map of a finished plan."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from shapely.geometry import MultiPolygon, box

from alice_survey.app.stages import spec
from alice_survey.core.config import SeaConfig, parse_config
from alice_survey.core.errors import ConfigError
from alice_survey.core.executor import SERIAL
from missions.coverage.certificate import certificate
from missions.coverage.stations import plan_pattern, stations_of_plan
from missions.plan.map import map_report, plan_figure
from tests.missions.exports.plans import RIG, line, plan_of


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


@pytest.mark.parametrize("count", [16, 200])
def test_lines_leave_room_and_the_allowed_area_is_whole_unless_much_larger(count: int) -> None:
    plan = plan_of([line((i, 0.0), (i, float(count))) for i in range(count)], [(0, count - 1)])
    sea = MultiPolygon([box(-5e3, -5e3, 5e3, 5e3)])
    wide = replace(plan, area=replace(plan.area, allowed=sea))
    seen = certificate(plan.area, RIG, stations_of_plan(plan), plan_pattern(plan, RIG), cell_m=0.25)
    figure, far = (plan_figure(one, RIG, seen, None, SeaConfig()) for one in (plan, wide))
    figure.draw_without_rendering()
    axes, scale = figure.axes[0], figure.dpi / 72
    (lines,) = (one for one in axes.collections if isinstance(one, LineCollection))
    width_px = float(lines.get_linewidths()[0]) * scale
    apart_px = abs(np.diff(axes.transData.transform([[0, 0], [0, 1]])[:, 1])[0])
    assert width_px < 0.5 * apart_px
    assert width_px > 0.2 * apart_px or width_px == pytest.approx(1.6 * scale)
    south, west, north, east = plan.area.allowed.bounds
    assert axes.get_xlim()[0] < west < east < axes.get_xlim()[1]
    assert axes.get_ylim()[0] < south < north < axes.get_ylim()[1]
    assert np.ptp(far.axes[0].get_xlim()) < 2 * count
