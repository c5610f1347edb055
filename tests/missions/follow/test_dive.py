"""A dive that is followed: progress, holes, and a plan that closes them."""

import json
from pathlib import Path

import numpy as np
import pytest
import shapely
from typer.testing import CliRunner

from alice_survey.app.cli.main import app
from alice_survey.app.pipeline import settings
from alice_survey.core.errors import NavigationError, PlanError, WorkspaceError
from alice_survey.core.frames import Array
from missions.coverage.stations import stations_of_plan
from missions.fly.check import check_log
from missions.follow.dive import OUTSIDE, FollowedDive, follow_report
from missions.values.costs import leg_costs
from missions.values.plan_file import read_plan
from tests.missions.follow.dives import route_rows, rows_along, text_of, workspace_of
from tests.oracles_coverage import area_of, lawnmower, plan_of

PLAN = plan_of(area_of(shapely.box(0, 0, 6, 4)), lawnmower(6.0, 4.0, 1.0, 0.46, over_m=0.5))
ROWS = route_rows(PLAN, np.random.default_rng(1))
LINE_S = PLAN.lines[0].length_m / PLAN.speed_mps
UNTIL_S = 100.0 + 3.5 * (LINE_S + 5.0)
GAP = (ROWS[:, 0] > 100.0 + 2.4 * (LINE_S + 5.0)) & (ROWS[:, 0] < 100.0 + 2.7 * (LINE_S + 5.0))
BROKEN = ROWS[~GAP]


@pytest.fixture
def reef(tmp_path: Path) -> Path:
    return workspace_of(tmp_path / "reef", PLAN)


def followed(reef: Path, rows: Array, **options: float) -> FollowedDive:
    (reef / "nav.csv").write_bytes(text_of(rows))
    dive = FollowedDive(reef, settings(reef, None, needed=False), reef / "nav.csv", **options)  # type: ignore[arg-type]
    assert dive.update(0.0)
    assert dive.fault is None
    return dive


def test_at_its_end_a_dive_is_certified_as_plan_check_does(reef: Path) -> None:
    dive = followed(reef, BROKEN)
    (reef / "whole.csv").write_bytes(text_of(BROKEN[:-1]))  # the last row may not be whole
    check = check_log(reef, dive.rig, reef / "whole.csv")
    assert dive.view is not None
    np.testing.assert_array_equal(dive.view.flown.pictures, check.flown.pictures)
    np.testing.assert_array_equal(dive.view.flown.least_lines, check.flown.least_lines)
    assert dive.view.flown.to_json() == check.flown.to_json()
    assert dive.snapshot()["holes"]["area_m2"] == pytest.approx(
        sum(hole.area_m2 for hole in check.holes), rel=0.1, abs=0.05
    )


@pytest.mark.parametrize("pace", [1.0, 1.25])
def test_progress_and_time_left_are_those_of_the_flight(reef: Path, pace: float) -> None:
    dive = followed(reef, ROWS[:1].repeat(3, axis=0) + np.arange(3)[:, None] * np.eye(8)[0])
    surface_s = dive.costs.dive_s(PLAN.seafloor_depth_m - PLAN.altitude_m) / 2
    planned_s = float(leg_costs(PLAN.dives[0].route, dive.costs)[1].sum())
    rows = ROWS.copy()
    rows[:, 0] = 100.0 + pace * (rows[:, 0] - 100.0)
    left = []
    for share in (0.3, 0.5, 0.7, 0.9):
        (reef / "nav.csv").write_bytes(text_of(rows[: int(share * len(rows))]))
        assert dive.update(1e6 * share)
        state = dive.snapshot()
        left.append(state["lines"]["left"])
        # Rows fly without the stops at turns that the plan counts.
        assert 0.6 * pace < state["pace"] < 1.05 * pace
        remaining_s = (1.0 - share) * planned_s * state["pace"] + surface_s * state["pace"]
        assert state["finish"]["time_s"] == pytest.approx(remaining_s, rel=0.15, abs=20.0)
        assert state["holes"]["area_m2"] < 0.3
        assert state["coverage"]["expected_at_overlap"] > 0.98
    assert left == sorted(left, reverse=True)
    assert left[0] > left[-1]


def test_a_gap_is_found_while_the_dive_goes_on_and_the_plan_proposed_closes_it(reef: Path) -> None:
    before = BROKEN[BROKEN[:, 0] < UNTIL_S]
    dive = followed(reef, before)
    state = dive.snapshot()
    assert (state["phase"], state["gaps"]) == ("on line 4", 1)
    assert state["lines"]["done"] == 3
    assert [line["state"] for line in dive.lines()][:4] == ["done", "done", "done", "now"]
    assert 0.3 < state["coverage"]["at_overlap"] < state["coverage"]["expected_at_overlap"] < 0.97
    hole_m2 = state["holes"]["area_m2"]
    assert 1.0 < hole_m2 < 4.0
    ring = np.array(dive.holes()[0]["rings_ne"][0])
    assert abs(float(np.mean(ring[:, 1])) - PLAN.lines[2].start_ne_m[1]) < 1.0
    classes = dive.coverage_classes()
    assert np.mean(classes[classes != OUTSIDE] > 0) == pytest.approx(
        state["coverage"]["seen"], rel=0.01
    )

    proposal = dive.propose()
    assert proposal is not None
    assert proposal.coverage > 0.95
    offered = dive.snapshot()["proposal"]
    assert offered["time_s"] == proposal.duration_s
    # The rest as planned, and then the lines proposed.
    rest = BROKEN[BROKEN[:, 0] >= UNTIL_S]
    again = rows_along(offered["route_ne"], PLAN, rest[-1, 0] + 1.0)
    (reef / "nav.csv").write_bytes(text_of(np.concatenate([before, rest, again])))
    assert dive.update(1e6)
    assert dive.snapshot()["lines"]["left"] == 0
    assert dive.snapshot()["holes"]["area_m2"] < 0.1 * hole_m2


def test_the_command_line_says_once_what_there_is_and_writes_the_plan(reef: Path) -> None:
    (reef / "nav.csv").write_bytes(text_of(BROKEN[BROKEN[:, 0] < UNTIL_S]))
    out = reef / "holes"
    done = CliRunner().invoke(
        app, ["plan", "follow", str(reef / "nav.csv"), "-w", str(reef), "--json", "-o", str(out)]
    )
    assert done.exit_code == 0, done.output
    data = json.loads(done.stdout[done.stdout.index("{") :])
    assert data["holes"]["count"] == len(data["hole_list"]) > 0
    again = read_plan(out / "plan" / "plan.json")
    assert len(again.lines) == len(data["proposal"]["lines"])
    assert (out / "plan" / "exports" / "about.txt").is_file()
    assert len(stations_of_plan(again)) == again.stations
    text, _ = next(iter(follow_report(reef, settings(reef, None, needed=False),
                                      str(reef / "nav.csv"))))  # fmt: skip
    assert "on line 4" in text
    assert "3 done" in text


def test_a_log_is_read_again_where_it_grew_and_not_too_often(reef: Path) -> None:
    dive = followed(reef, ROWS[:100])
    log, version = reef / "nav.csv", dive.version
    assert not dive.update(1e6)  # nothing new
    with log.open("ab") as file:
        file.write(text_of(ROWS[100:140]).split(b"\n", 1)[1][:-7])  # half a line at its end
    assert not dive.update(0.5)  # too soon
    assert dive.update(1e6)
    assert dive.version == version + 1
    assert dive.view is not None
    assert dive.view.fixes[-1, 0] == pytest.approx(ROWS[138, 0] - 100.0, abs=0.6)
    assert dive.track(dive.view.fixes[-3, 0])[0][0] == pytest.approx(dive.view.fixes[-2, 0])
    log.write_bytes(text_of(ROWS[:120]))  # cut, or another log
    assert dive.update(2e6)
    state = dive.snapshot(2e6 + 60.0)
    assert state["is_silent"]
    assert state["silent_s"] == pytest.approx(60.0)


def test_what_cannot_be_followed_is_said_in_a_line(reef: Path, tmp_path: Path) -> None:
    config = settings(reef, None, needed=False)
    for name, error, words in (
        ("udp:14600", NavigationError, "CSV that grows"),
        ("ros", NavigationError, "CSV that grows"),
        (str(reef), NavigationError, "folder"),
    ):
        with pytest.raises(error, match=words):
            FollowedDive(reef, config, name)
    with pytest.raises(PlanError, match="dive 7"):
        FollowedDive(reef, config, "nav.csv", dive=7)
    with pytest.raises(WorkspaceError, match="plan"):
        FollowedDive(tmp_path, config, "nav.csv")
    (reef / "bad.csv").write_text("a,b\n1,2\n")
    with pytest.raises(NavigationError, match="time_s"):
        next(iter(follow_report(reef, config, str(reef / "bad.csv"))))
    waiting = FollowedDive(reef, config, reef / "later.csv")
    waiting.update(0.0)
    assert waiting.snapshot()["fix"] is None
    (reef / "later.csv").write_bytes(text_of(ROWS[:50]))
    assert waiting.update(1e6)
    assert waiting.snapshot()["fix"] is not None
