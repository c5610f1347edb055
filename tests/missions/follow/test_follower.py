"""A dive of the simulator, followed while its log grows."""

import io
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from alice_survey.base.config import SurveyConfig
from alice_survey.base.frames import Array
from alice_survey.vehicle.floor import level_floor
from camera_calib.rig import design_rig
from missions.coverage.certificate import Certificate, certificate
from missions.coverage.dive_record import read_dive_record
from missions.coverage.holes import find_holes
from missions.coverage.stations import plan_pattern
from missions.follow.follower import Follower
from missions.follow.proposal import Budget
from missions.follow.rows import LATITUDE, LONGITUDE, TIME, Piece
from missions.values.navigation import write_navigation
from missions.values.plan_file import Plan
from tests.missions.flown_plans import flown, planned
from tests.missions.follow.dives import text_of

CONFIG = SurveyConfig.model_validate(
    {"area": {"length_m": 5.0, "width_m": 4.0, "seafloor_depth_m": 6.0},
     "plan": {"cross_lines": 0, "closing_line": False}}
)  # fmt: skip
RIG = design_rig(CONFIG.camera, CONFIG.water)


@cache
def plan() -> Plan:
    return planned(CONFIG)


def rows_of(of: Plan, folder: Path, start_s: float = 0.0) -> Array:
    """Rows of a simulated flight, five a second."""
    flight = flown(of, CONFIG, level_floor(6.0))
    assert flight.ending == "complete"
    write_navigation(folder / "flown.csv", flight.log, of.datum)
    table = np.genfromtxt(folder / "flown.csv", delimiter=",", skip_header=1)[::4, :8]
    table[:, TIME] += start_s
    return np.genfromtxt(io.BytesIO(text_of(table)), delimiter=",", skip_header=1)  # as rounded


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> Array:
    return rows_of(plan(), tmp_path_factory.mktemp("flown"))


def whole(rows: Array, path: Path) -> Certificate:
    """The certificate that `plan check` has of a log."""
    path.write_bytes(text_of(rows))
    record = read_dive_record(path, plan(), RIG)
    follower = Follower(plan(), RIG, CONFIG)
    return certificate(
        plan().area, RIG, record.stations, plan_pattern(plan(), RIG),
        cell_m=follower.coverage.grid.cell_m,
    )  # fmt: skip


def fed(follower: Follower, rows: Array, every: int = 50) -> list[dict]:
    """Feed rows part by part; what is known after each."""
    known = []
    for first in range(0, len(rows), every):
        follower.add([Piece(rows=rows[first : first + every])])
        finish = follower.to_finish()
        known.append(
            {
                "s": rows[min(first + every, len(rows)) - 1, TIME], "phase": follower.phase,
                "finish_s": finish.time_s, "sigma_s": finish.sigma_s,
                "left": len(follower.progress.left), "share": follower.coverage.share_at_overlap,
                "line": follower.progress.line, "energy_wh": finish.energy_wh,
            }
        )  # fmt: skip
    return known


def test_a_dive_as_planned_leaves_no_holes_on_its_way(rows: Array, tmp_path: Path) -> None:
    follower = Follower(plan(), RIG, CONFIG)
    found = []
    for first in range(0, len(rows), 100):
        follower.add([Piece(rows=rows[first : first + 100])])
        expected, holes = follower.expected()
        found.append((sum(hole.area_m2 for hole in holes), expected.share_at_overlap))
    # At no moment is what the lines left will cover a hole; some centimetres off a line are.
    assert max(area for area, _ in found) < 0.02 * follower.coverage.area.survey.area
    assert min(share for _, share in found) > 0.98
    done = follower.certificate()
    exact = whole(rows, tmp_path / "nav.csv")
    np.testing.assert_array_equal(done.pictures, exact.pictures)
    np.testing.assert_array_equal(done.least_lines, exact.least_lines)
    assert done.to_json() == exact.to_json()


def test_progress_and_what_is_left_are_those_of_the_flight(rows: Array) -> None:
    known = fed(Follower(plan(), RIG, CONFIG), rows)
    # What is left when it comes up to half a metre under the surface.
    end_s = rows[-1, TIME]
    off = np.array([(k["s"] + k["finish_s"] - end_s, k["sigma_s"]) for k in known if k["left"]])
    print(off, [k["phase"] for k in known])
    assert np.all(np.abs(off[:, 0]) < 3.5 * off[:, 1] + 10.0)
    assert off[-1, 1] < off[0, 1]
    left = [k["left"] for k in known]
    assert left[0] == len(plan().lines)
    assert left[-1] == 0
    assert np.all(np.diff(left) <= 0)
    assert {k["line"] for k in known} >= set(range(len(plan().lines)))
    assert known[-1]["phase"] == "back at the surface"
    assert known[0]["energy_wh"] == pytest.approx(plan().energy_wh, rel=0.25)
    assert known[-1]["energy_wh"] == 0.0
