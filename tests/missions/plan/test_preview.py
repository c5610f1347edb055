"""Previews: the plan's own totals, and a suggestion that works."""

import json
import math

import numpy as np
import pytest

from alice_survey.core.config import change_section, parse_config
from camera_calib.rig import design_rig
from missions.coverage.certificate import certificate
from missions.coverage.stations import plan_pattern, stations_of_plan
from missions.plan.preview import counts_picture, preview
from tests.missions.exports.plans import RIG, small_plan
from tests.missions.flown_plans import planned_survey
from tests.small_survey import with_settings

SMALL = parse_config({"area": {"length_m": 8.0, "width_m": 6.0}}, "test")


def test_totals_and_warnings_are_those_of_the_plan() -> None:
    config = with_settings(SMALL, {"plan.line_spacing_m": 1.45, "vehicle.battery_wh": 13.0})
    found, made = preview(config), planned_survey(config)
    plan, totals = made.plan, found["totals"]
    assert found["ok"] and len(plan.dives) == totals["dives"] == 2
    for name in ("duration_s", "energy_wh", "stations", "altitude_m"):
        assert totals[name] == getattr(plan, name)
    assert totals["at_overlap"] == plan.coverage
    assert found["warnings"] == list(made.warnings) and found["warnings"]
    dives = [line["dive"] for line in found["lines"]]
    assert dives == sorted(dives)
    for way, dive in zip(found["routes"], plan.dives, strict=True):
        length = float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
        assert 0.98 * dive.route.length_m < length < dive.route.length_m + 0.01
    assert found["profile"]["s_m"][-1] == pytest.approx(plan.length_m, abs=0.01)
    json.dumps(found["lines"])


def test_holes_are_where_the_area_is_not_covered() -> None:
    room = [[-1, -1], [9, -1], [9, 4], [-1, 4]]
    config = change_section(SMALL, "area", allowed_ne_m=room)
    found = preview(config)
    hole = max(found["holes"], key=lambda one: float(one["area_m2"]))
    assert found["totals"]["at_overlap"] < 0.9
    missing_m2 = sum(one["area_m2"] for one in found["holes"])
    share = missing_m2 / found["totals"]["area_m2"]
    assert share == pytest.approx(1.0 - found["totals"]["at_overlap"], abs=0.01)
    assert min(east for _, east in hole["outer"]) > 3.5


def test_the_suggestion_of_a_conflict_works() -> None:
    config = change_section(SMALL, "plan", forward_overlap=0.95, speed_mps=1.2)
    found = preview(config)
    assert not found["ok"] and len(found["error"].splitlines()) == 1
    ((section, values),) = found["suggestion"].items()
    assert preview(change_section(config, section, **values))["ok"]
    found = preview(change_section(SMALL, "area", seafloor_depth_m=1.5))
    assert not found["ok"] and found["suggestion"] is None and "altitude_m" in found["error"]


@pytest.mark.parametrize("cells", [2_000, 20_000])
def test_a_quick_look_estimates_the_certificate(cells: int) -> None:
    config = change_section(SMALL, "plan", line_spacing_m=1.45)
    made, rig = planned_survey(config), design_rig(config.camera, config.water)
    stations, pattern = stations_of_plan(made.plan), plan_pattern(made.plan, rig)
    quick = certificate(made.plan.area, rig, stations, pattern, max_cells=cells)
    whole = made.certificate
    assert quick.estimated and not whole.estimated
    assert 0.4 * cells < quick.grid.rows * quick.grid.columns < 1.3 * cells
    for share in ("share_at_overlap", "covered_share", "stereo_share"):
        error = 1.5 / math.sqrt(cells)
        assert getattr(quick, share) == pytest.approx(getattr(whole, share), abs=error)
    assert whole.share_at_overlap < 0.99


def test_counts_in_the_picture_are_those_of_their_cells() -> None:
    plan = small_plan()
    stations, pattern = stations_of_plan(plan), plan_pattern(plan, RIG)
    seen = certificate(plan.area, RIG, stations, pattern)
    rgb, (north, west), pixel_m = counts_picture(seen)
    rows, columns = rgb.shape[:2]
    row, column = np.mgrid[:rows, :columns]
    places = np.stack([north - pixel_m * (row + 0.5), west + pixel_m * (column + 0.5)], axis=-1)
    cells = np.floor(seen.grid.cells_of(places)).astype(int)
    on = np.all((cells >= 0) & (cells < seen.grid.shape), axis=-1)
    at = (cells[on][:, 0], cells[on][:, 1])
    inside = seen.inside[at]
    assert (rgb[~on][:, 0] == 255).all()
    assert (rgb[on][~inside][:, 0] == 255).all()
    for channel, counts in enumerate((seen.pictures, seen.least_lines, seen.at_overlap)):
        assert (rgb[on][inside][:, channel] == counts[at][inside]).all()
    assert (rgb[..., 0] < 255).mean() > 0.9 * plan.area.survey.area / (rows * columns * pixel_m**2)
