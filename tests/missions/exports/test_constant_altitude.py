"""Missions that keep one altitude are refused where the plan over a bathymetry does not."""

import re
from pathlib import Path

import numpy as np
import pytest

from alice_survey.core.errors import PlanError
from missions.exports.write import write_exports
from missions.route.terrain import Reach, TerrainLimits, line_profiles, terrain_figures
from missions.values.plan_file import Plan
from tests.missions.areas.sites import floor_of
from tests.missions.exports.plans import RIG, small_plan

VEHICLES = ("cola2", "qgc", "wpl")
CELL_M = 0.25
REACH = Reach(ahead_m=1.0, astern_m=1.0, aside_m=1.0)


def plan_over(wall_m: float, slope: float = 0.0) -> Plan:
    """The small plan over a floor 16 m deep that a wall raises east of 2 m."""
    east = (np.arange(160) + 0.5) * CELL_M - 20.0
    depth = np.broadcast_to(16.0 - slope * east - wall_m * (east > 2.0), (160, 160))
    lines = small_plan().lines
    limits = TerrainLimits(altitude_m=2.0, least_clearance_m=1.0, steepest_rad=np.deg2rad(30.0))
    profiles = line_profiles(lines, floor_of(depth, CELL_M), REACH, limits)
    figures = terrain_figures(profiles, limits, relief_m=10.0)
    depths = tuple(tuple(map(float, profile.depth_m)) for profile in profiles)
    return small_plan(line_depths_m=depths, seafloor_depth_m=16.0, details={"terrain": figures})


@pytest.mark.parametrize("format_", VEHICLES)
def test_a_wall_is_refused_with_the_least_clearance(tmp_path: Path, format_: str) -> None:
    plan = plan_over(6.0)
    with pytest.raises(PlanError, match="least clearance") as refused:
        write_exports(tmp_path / "out", plan, RIG, formats=["csv", format_])
    assert not (tmp_path / "out").exists()
    # 2 m above the foot of a wall of 6 m is 4 m below its top.
    clearance = re.search(r"least clearance of such a mission is (-?[\d.]+) m", str(refused.value))
    assert clearance is not None
    assert float(clearance[1]) == pytest.approx(-4.0, abs=0.05)


def test_all_formats_leave_missions_of_a_wall_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_exports(tmp_path / "out", small_plan(), RIG)
    assert list((tmp_path / "out").glob("mission_*"))
    files = write_exports(tmp_path / "out", plan_over(6.0), RIG)
    assert "missions are left out" in capsys.readouterr().err
    assert not list((tmp_path / "out").glob("mission_*"))
    assert {path.name for path in files} >= {"plan.kml", "waypoints.csv"}
    assert "Missions are left out" in (tmp_path / "out" / "about.txt").read_text()


@pytest.mark.parametrize(
    ("wall_m", "slope", "refused"),
    [(0.0, 0.0, False), (0.25, 0.0, False), (0.4, 0.0, True), (0.0, 0.2, False), (0.0, 0.4, True)],
)
def test_floors_within_thirty_centimetres_are_exported(
    tmp_path: Path, wall_m: float, slope: float, refused: bool
) -> None:
    plan = plan_over(wall_m, slope)
    # The highest floor within reach of 1 m ahead and aside is as much higher as the slope says.
    stated = plan.details["terrain"]["at_constant_altitude"]
    assert stated["max_difference_m"] == pytest.approx(max(wall_m, slope), abs=0.06)
    assert stated["min_clearance_m"] == pytest.approx(2.0 - max(wall_m, slope), abs=0.06)
    if refused:
        with pytest.raises(PlanError, match="least clearance"):
            write_exports(tmp_path / "out", plan, RIG, formats=["wpl"])
        return
    files = write_exports(tmp_path / "out", plan, RIG, formats=list(VEHICLES))
    assert len(files) == 7
