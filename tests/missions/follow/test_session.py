"""What the command line says of a dive, and what a session does with a source."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from alice_survey.app.cli.main import app
from alice_survey.app.pipeline import settings
from alice_survey.core.errors import NavigationError, WorkspaceError
from missions.follow.session import DiveSession, follow_report, open_source
from missions.follow.tail import ReplayedLog
from missions.values.plan_file import read_plan
from tests.alice_survey.app.studio.test_follow import GAP, LINE_S, PLAN, ROWS, workspace_of
from tests.missions.follow.dives import RIG, text_of

UNTIL_S = 100.0 + 3.5 * (LINE_S + 5.0)


@pytest.fixture
def reef(tmp_path: Path) -> Path:
    return workspace_of(tmp_path / "reef")


def test_the_command_line_says_once_what_there_is_and_writes_the_lines(reef: Path) -> None:
    kept = ROWS[~GAP]
    (reef / "nav.csv").write_bytes(text_of(kept[kept[:, 0] < UNTIL_S]))
    out = reef / "holes"
    done = CliRunner().invoke(
        app, ["plan", "follow", str(reef / "nav.csv"), "-w", str(reef), "--json", "-o", str(out)]
    )
    assert done.exit_code == 0, done.output
    data = json.loads(done.stdout[done.stdout.index("{") :])
    assert data["lines"]["done"] == 3
    assert data["holes"]["count"] == len(data["hole_list"]) > 0
    assert data["proposal"]["gain_m2"] > 0.5 * data["holes"]["area_m2"]
    again = read_plan(out / "plan" / "plan.json")
    assert len(again.lines) == data["proposal"]["lines"]
    assert (out / "plan" / "exports" / "about.txt").is_file()
    # It begins where the last planned line ends.
    assert again.dives[0].route.legs[0].start_ne_m == pytest.approx(PLAN.lines[-1].end_ne_m)
    text, _ = next(iter(follow_report(reef, settings(reef, None, needed=False),
                                      str(reef / "nav.csv"))))  # fmt: skip
    assert "on line 4" in text
    assert "3 done" in text


def test_holes_of_the_last_rows_are_found_when_nothing_comes_any_more(reef: Path) -> None:
    kept = ROWS[~GAP]
    log = reef / "nav.csv"
    log.write_bytes(text_of(kept[:50]))
    session = DiveSession(reef, settings(reef, None, needed=False), str(log))
    assert session.step(0.0) > 0
    with log.open("ab") as file:
        file.write(text_of(kept[50:][kept[50:, 0] < UNTIL_S]).split(b"\n", 1)[1])
    assert session.step(0.01) > 0  # too soon after the first look for another
    assert session.holes == ()
    assert session.step(1000.0) == 0
    assert 1.0 < sum(hole.area_m2 for hole in session.holes) < 4.0
    found = session.holes
    assert session.step(2000.0) == 0
    assert session.holes is found  # nothing new, nothing looked for
    session.close()


def test_what_cannot_be_followed_is_said_in_a_line(reef: Path, tmp_path: Path) -> None:
    config = settings(reef, None, needed=False)
    with pytest.raises(NavigationError, match="port"):
        open_source("udp:99999", PLAN, RIG, config)
    with pytest.raises(NavigationError, match="folder"):
        open_source(str(reef), PLAN, RIG, config)
    with pytest.raises(NavigationError, match="--every"):
        next(iter(follow_report(reef, config, "udp:0")))
    with pytest.raises(WorkspaceError, match="plan"):
        DiveSession(tmp_path, config, "nav.csv")
    (reef / "bad.csv").write_text("a,b\n1,2\n")
    with pytest.raises(NavigationError, match="time_s"):
        next(iter(follow_report(reef, config, str(reef / "bad.csv"))))


def test_a_log_is_replayed_at_its_pace_and_the_age_of_its_last_fix_is_known(reef: Path) -> None:
    (reef / "nav.csv").write_bytes(text_of(ROWS))
    session = DiveSession(reef, settings(reef, None, needed=False), str(reef / "nav.csv"),
                          replay=10.0)  # fmt: skip
    assert isinstance(session.source, ReplayedLog)
    times = []
    for wall_s in np.arange(0.0, 6.0, 0.5):
        session.step(float(wall_s))
        state = session.state(float(wall_s))
        times.append(state["fix"]["time_s"] - ROWS[0, 0])
        assert not state["is_silent"]
    np.testing.assert_allclose(times, 10.0 * np.arange(0.0, 6.0, 0.5), atol=0.6)
    late = session.state(5.5 + 12.0)
    assert late["is_silent"]
    assert late["silent_s"] == pytest.approx(12.0, abs=0.6)
    session.close()


def test_the_time_until_it_has_to_be_up_limits_what_is_proposed(reef: Path) -> None:
    kept = ROWS[~GAP]
    (reef / "nav.csv").write_bytes(text_of(kept[kept[:, 0] < UNTIL_S]))
    session = DiveSession(reef, settings(reef, None, needed=False), str(reef / "nav.csv"))
    session.read_all()
    assert session.propose() is not None
    finish = session.state()["finish"]
    sure_s = finish["time_s"] + 2.0 * finish["sigma_s"]
    for spare_s, some in ((-5.0, False), (3.0, False), (300.0, True)):
        session.allow(sure_s + spare_s)
        assert session.state()["spare"]["time_s"] == pytest.approx(spare_s, abs=1e-6)
        found = session.propose()
        assert (found is not None) == some
        if found is not None:
            assert 3.0 < found.extra_s <= spare_s
    session.close()
