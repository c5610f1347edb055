"""The map: the sheet fits the area, lines stay thin."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from matplotlib.collections import LineCollection
from shapely.geometry import MultiPolygon

from alice_survey.app.stages import spec
from alice_survey.core.config import SeaConfig, parse_config
from alice_survey.core.errors import ConfigError
from alice_survey.core.executor import SERIAL
from alice_survey.kit.figure import Sheet
from missions.coverage.certificate import certificate
from missions.coverage.stations import plan_pattern, stations_of_plan
from missions.plan.map import map_report, plan_figure
from missions.values.plan_file import Plan
from tests.missions.exports.plans import RIG, line, plan_of


def rows(count: int, length_m: float) -> Plan:
    """Lines to the east, 1 m apart, there and back."""
    lines = [
        line((float(i), 0.0), (float(i), length_m))
        if i % 2 == 0
        else line((float(i), length_m), (float(i), 0.0))
        for i in range(count)
    ]
    return plan_of(lines, [(0, count - 1)])


def figure_of(plan: Plan) -> Sheet:
    """The map of a plan, its coverage counted on a coarse grid."""
    pattern = plan_pattern(plan, RIG)
    seen = certificate(plan.area, RIG, stations_of_plan(plan), pattern, cell_m=0.25)
    return plan_figure(plan, RIG, seen, None, SeaConfig())


@pytest.mark.parametrize("count", [5, 120])
def test_lines_leave_room_between_them(count: int) -> None:
    figure = figure_of(rows(count, float(count)))
    figure.draw_without_rendering()
    axes = figure.axes[0]
    (drawn_lines,) = (c for c in axes.collections if isinstance(c, LineCollection))
    width_px = float(drawn_lines.get_linewidths()[0]) * figure.dpi / 72
    apart_px = abs(np.diff(axes.transData.transform([[0, 0], [0, 1]])[:, 1])[0])
    assert width_px < 0.5 * apart_px
    assert width_px > 0.2 * apart_px or width_px == pytest.approx(1.6 * figure.dpi / 72)


def test_the_allowed_area_is_whole_on_the_map_unless_it_is_much_larger() -> None:
    plan = rows(16, 15.0)
    axes = figure_of(plan).axes[0]
    south, west, north, east = plan.area.allowed.bounds
    assert axes.get_xlim()[0] < west < east < axes.get_xlim()[1]
    assert axes.get_ylim()[0] < south < north < axes.get_ylim()[1]
    sea = MultiPolygon([shapely.box(-500, -500, 500, 500)])
    wide = replace(plan, area=replace(plan.area, allowed=sea))
    axes = figure_of(wide).axes[0]
    assert np.ptp(axes.get_xlim()) < 2 * 15


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
