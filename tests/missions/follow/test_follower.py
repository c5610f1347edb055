"""A dive of the simulator, followed while its log grows."""

import io
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from alice_survey.core.config import SurveyConfig
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.sea import level_floor
from camera_calib.rig import design_rig
from missions.coverage.certificate import Certificate, certificate
from missions.coverage.dive_record import read_dive_record
from missions.coverage.holes import find_holes
from missions.coverage.stations import plan_pattern
from missions.follow.follower import DiveFollower
from missions.follow.proposal import Budget
from missions.follow.rows import TIME, Piece
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
    follower = DiveFollower(plan(), RIG, CONFIG)
    return certificate(
        plan().area, RIG, record.stations, plan_pattern(plan(), RIG),
        cell_m=follower.coverage.grid.cell_m,
    )  # fmt: skip


def fed(follower: DiveFollower, rows: Array, every: int = 50) -> list[dict]:
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
    follower = DiveFollower(plan(), RIG, CONFIG)
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
    known = fed(DiveFollower(plan(), RIG, CONFIG), rows)
    # What is left when it comes up to half a metre under the surface.
    end_s = rows[-1, TIME]
    off = np.array([(k["s"] + k["finish_s"] - end_s, k["sigma_s"]) for k in known if k["left"]])
    assert np.all(np.abs(off[:, 0]) < 3.0 * off[:, 1] + 3.0)
    assert np.abs(off[:, 0]).max() > 0.5
    assert off[-1, 1] < off[0, 1]
    left = [k["left"] for k in known]
    assert left[0] == len(plan().lines)
    assert left[-1] == 0
    assert np.all(np.diff(left) <= 0)
    assert {k["line"] for k in known} >= set(range(len(plan().lines)))
    assert known[-1]["phase"] == "back at the surface"
    assert known[0]["energy_wh"] == pytest.approx(plan().energy_wh, rel=0.25)
    assert known[-1]["energy_wh"] == 0.0


def with_gap(rows: Array) -> Array:
    """The log without the middle of the second line and some of the third."""
    line = fed_lines(rows)
    inside = np.flatnonzero(line == 1)
    return np.delete(rows, slice(inside[len(inside) // 3], inside[2 * len(inside) // 3]), axis=0)


@cache
def _fed_lines(data: bytes) -> Array:
    rows = np.frombuffer(data).reshape(-1, 8)
    follower = DiveFollower(plan(), RIG, CONFIG)
    line = np.full(len(rows), -1)
    for first in range(0, len(rows), 5):
        follower.add([Piece(rows=rows[first : first + 5])])
        line[first : first + 5] = follower.progress.line
    return line


def fed_lines(rows: Array) -> Array:
    """The line that the vehicle is on, (N,)."""
    return _fed_lines(np.ascontiguousarray(rows).tobytes())


def test_a_gap_is_found_while_the_dive_goes_on_and_the_lines_proposed_close_it(
    rows: Array, tmp_path: Path
) -> None:
    lost = with_gap(rows)
    line = fed_lines(rows)
    # Half way along the third line: the dive goes on.
    until_s = rows[np.flatnonzero(line == 2)[len(np.flatnonzero(line == 2)) // 2], TIME]
    follower = DiveFollower(plan(), RIG, CONFIG)
    before = lost[lost[:, TIME] <= until_s]
    fed(follower, before)
    assert follower.gap_count == 1
    expected, holes = follower.expected()
    assert len(follower.progress.left) == len(plan().lines) - 2
    assert 1 <= len(holes) <= 3
    second = plan().lines[1]
    middle = (np.array(second.start_ne_m) + np.array(second.end_ne_m)) / 2
    assert np.linalg.norm(np.array(holes[0].place_ne) - middle) < 1.0
    hole_m2 = sum(hole.area_m2 for hole in holes)
    assert 0.3 < hole_m2 < 6.0

    proposal = follower.propose()
    assert proposal is not None
    spare = follower.to_spare()
    assert 0 < proposal.extra_wh <= spare.energy_wh
    assert proposal.gain_m2 > 0.9 * hole_m2
    assert proposal.expected.share_at_overlap > 0.995
    assert expected.share_at_overlap < 0.97
    ways = follower._flying().ways
    places = proposal.plan.dives[0].route.places(
        np.arange(0.0, proposal.plan.dives[0].route.length_m, 0.05)
    )
    assert ways.free_many(places[:-1], places[1:]).all()

    # The rest as planned, and then the proposal.
    finish_before = follower.to_finish()
    follower.accept(proposal)
    assert follower.to_finish().time_s - finish_before.time_s == pytest.approx(
        proposal.extra_s, rel=0.02
    )
    assert follower.expected()[1] == ()
    rest = lost[(lost[:, TIME] > until_s) & (lost[:, TIME] < rows[line >= 0][-1, TIME] + 3.0)]
    flown_again = rows_of(proposal.plan, tmp_path, rest[-1, TIME] + 1.0)
    fed(follower, rest)
    assert len(follower.progress.left) == len(proposal.plan.lines)
    fed(follower, flown_again)
    assert follower.progress.left == []
    done = follower.certificate()
    assert done.to_json() == whole(np.concatenate([before, rest, flown_again]),
                                   tmp_path / "all.csv").to_json()  # fmt: skip
    assert sum(hole.area_m2 for hole in find_holes(done)) < 0.1 * hole_m2


def test_a_proposal_keeps_to_its_budget(rows: Array) -> None:
    line = fed_lines(rows)
    kept = ~np.isin(line, [0, 2])  # two gaps
    follower = DiveFollower(plan(), RIG, CONFIG)
    fed(follower, rows[kept])
    _, holes = follower.expected()
    assert sum(hole.area_m2 for hole in holes) > 4.0
    gains = []
    for time_s in (np.inf, 150.0, 90.0, 60.0, 45.0, 5.0):
        proposal = follower.propose(Budget(time_s=time_s, energy_wh=np.inf))
        if proposal is None:
            gains.append(0.0)
            continue
        assert 0 < proposal.extra_s <= time_s
        gains.append(proposal.gain_m2)
    assert gains[0] > 0.8 * sum(hole.area_m2 for hole in holes)
    assert gains[-1] == 0.0
    assert np.all(np.diff(gains) <= 1e-9)
    assert len(set(gains)) >= 4
    maximum = follower.propose(Budget(time_s=np.inf, energy_wh=np.inf))
    assert maximum is not None
    less = follower.propose(Budget(time_s=np.inf, energy_wh=0.6 * maximum.extra_wh))
    assert less is not None
    assert less.extra_wh <= 0.6 * maximum.extra_wh
    assert 0 < less.gain_m2 < maximum.gain_m2
    assert follower.propose(Budget(time_s=0.0, energy_wh=1.0)) is None
