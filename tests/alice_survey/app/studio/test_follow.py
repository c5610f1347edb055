"""The endpoints of a dive that is followed, by its growing log."""

import io
import json
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import shapely

from alice_survey.app.studio.endpoints.follow import _COLOURS
from alice_survey.app.studio.server import Server
from alice_survey.core.artefacts import Stage, run_stage, write_json
from tests.alice_survey.app.studio.client import ask, call, serving, until
from tests.missions.follow.dives import route_rows, text_of
from tests.oracles_coverage import area_of, lawnmower, plan_of

PLAN = plan_of(area_of(shapely.box(0, 0, 6, 4)), lawnmower(6.0, 4.0, 1.0, 0.46, over_m=0.5))
ROWS = route_rows(PLAN, 0.5, np.random.default_rng(1))
LINE_S = PLAN.lines[0].length_m / PLAN.speed_mps
GAP = (ROWS[:, 0] > 100.0 + 2.4 * (LINE_S + 5.0)) & (ROWS[:, 0] < 100.0 + 2.7 * (LINE_S + 5.0))


def workspace_of(folder: Path) -> Path:
    """A workspace with a plan, and a dive's log beside it."""
    stage = Stage(name="plan", version=1, settings={})
    run_stage(folder, stage, lambda part: write_json(part / "plan.json", PLAN.to_json()))
    (folder / "survey.toml").write_text(
        "[area]\nlength_m = 6.0\nwidth_m = 4.0\nseafloor_depth_m = 15.0\n"
    )
    return folder


def state(server: Server) -> dict[str, Any]:
    reply = ask(server, "/api/follow/state")
    assert reply.status == 200, reply.text
    found: dict[str, Any] = json.loads(reply.text)
    return found


def wait_for(server: Server, true: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """The first state of which something is true."""

    def seen() -> dict[str, Any] | None:
        found = state(server)
        return found if found.get("fix") and true(found) else None

    return until(seen)


@pytest.fixture
def dive(tmp_path: Path) -> Iterator[tuple[Server, Path]]:
    """A studio that follows a log with three lines and a gap in it."""
    folder = workspace_of(tmp_path / "reef")
    log = folder / "nav.csv"
    kept = ROWS[~GAP]
    log.write_bytes(text_of(kept[kept[:, 0] < 100.0 + 3.5 * (LINE_S + 5.0)]))
    with serving(folder, log=str(log)) as server:
        yield server, log


def test_a_dive_is_followed_from_its_log_to_its_missions(dive: tuple[Server, Path]) -> None:
    server, log = dive
    now = wait_for(server, lambda found: found["holes"]["count"] > 0)
    assert now["following"]
    assert now["gaps"] == 1
    assert now["lines"]["done"] == 3
    assert 0.3 < now["coverage"]["at_overlap"] < 0.8
    assert now["coverage"]["expected_at_overlap"] > now["coverage"]["at_overlap"]
    assert now["logs"] == ["nav.csv"]
    assert not now["is_silent"]
    lines = json.loads(ask(server, "/api/follow/lines").text)["lines"]
    assert [line["state"] for line in lines[:4]] == ["done", "done", "done", "now"]
    holes = json.loads(ask(server, "/api/follow/holes").text)["holes"]
    assert len(holes) == now["holes"]["count"]
    ring = np.array(holes[0]["rings_ne"][0])
    assert abs(float(np.mean(ring[:, 1])) - PLAN.lines[2].start_ne_m[1]) < 1.0

    # Blocks of the coverage: as many opaque cells as are seen.
    assert now["blocks"]
    seen = 0
    for row, column, _, *_bounds in now["blocks"]:
        reply = ask(server, f"/api/follow/block/{row}/{column}")
        assert reply.headers["content-type"] == "image/png"
        pixels = cv2.imdecode(np.frombuffer(reply.body, np.uint8), cv2.IMREAD_UNCHANGED)
        assert pixels.shape == (256, 256, 4)
        seen += int((pixels[..., 3] == _COLOURS[1, 3]).sum())
    cell_m = (now["blocks"][0][5] - now["blocks"][0][3]) / 256
    assert seen * cell_m**2 == pytest.approx(24.0 * now["coverage"]["seen"], rel=0.01)
    assert ask(server, "/api/follow/block/99/0").status == 404
    assert ask(server, "/api/follow/block/x/0").status == 404

    track = json.loads(ask(server, "/api/follow/track").text)["fixes"]
    assert len(track) > 50
    assert (
        len(json.loads(ask(server, f"/api/follow/track?after={track[-3][0]}").text)["fixes"]) == 2
    )

    # Lines are proposed by themselves, accepted by number, and exported.
    now = wait_for(server, lambda found: found["proposal"] is not None)
    offered = json.loads(ask(server, "/api/follow/proposal").text)
    assert offered["proposal"]["gain_m2"] > 0.5 * now["holes"]["area_m2"]
    archive = zipfile.ZipFile(io.BytesIO(ask(server, "/api/follow/export?format=cola2").body))
    assert any(name.endswith(".xml") for name in archive.namelist())
    assert ask(server, "/api/follow/export?format=nonsense").status == 400
    assert call(server, "/api/follow/accept", {"number": offered["number"] + 1}).status == 409
    accepted = call(server, "/api/follow/accept", {"number": offered["number"]})
    assert accepted.status == 200, accepted.text
    assert json.loads(accepted.text)["accepted"]["lines"] == len(offered["proposal"]["lines"])
    assert json.loads(accepted.text)["holes"]["area_m2"] < 0.5 * now["holes"]["area_m2"]

    # The log grows.
    before = now["coverage"]["seen"]
    with log.open("ab") as file:
        later = ROWS[ROWS[:, 0] >= 100.0 + 3.5 * (LINE_S + 5.0)]
        file.write(text_of(later).split(b"\n", 1)[1])
    wait_for(server, lambda found: found["coverage"]["seen"] > before + 0.05)


def test_a_smaller_budget_gives_less(dive: tuple[Server, Path]) -> None:
    server, _ = dive
    wait_for(server, lambda found: found["proposal"] is not None)
    much = json.loads(call(server, "/api/follow/propose", {}).text)["proposal"]
    little = json.loads(call(server, "/api/follow/propose", {"minutes": 0.01}).text)["proposal"]
    assert much["gain_m2"] > 0.1
    assert little is None
    now = json.loads(call(server, "/api/follow/allow", {"minutes": 1.0}).text)
    assert now["spare"]["time_s"] < 0
    assert json.loads(call(server, "/api/follow/propose", {}).text)["proposal"] is None


def test_only_the_page_itself_changes_what_is_followed(dive: tuple[Server, Path]) -> None:
    server, log = dive
    assert call(server, "/api/follow/end", {}, token=None).status == 403
    (log.parent / "link.csv").symlink_to("/etc/passwd")
    for name in ("../nav.csv", "/etc/passwd", "none.csv", "link.csv"):
        assert call(server, "/api/follow/open", {"log": name}).status in (400, 404), name
    assert call(server, "/api/follow/open", {"log": "nav.csv", "replay": -1}).status == 400
    assert not json.loads(call(server, "/api/follow/end", {}).text)["following"]
    assert ask(server, "/api/follow/holes").status == 400
    opened = call(server, "/api/follow/open", {"log": "nav.csv", "replay": 200})
    assert opened.status == 200, opened.text
    half = wait_for(server, lambda found: found["coverage"]["seen"] > 0)
    assert "200 times" in half["source"]


def test_a_log_that_cannot_be_used_is_said_in_a_line(tmp_path: Path) -> None:
    folder = workspace_of(tmp_path / "reef")
    (folder / "nav.csv").write_text("a,b\n1,2\n")
    with serving(folder, log=str(folder / "nav.csv")) as server:
        assert "time_s" in until(lambda: state(server)["fault"])
    with serving(tmp_path / "empty", log="nav.csv") as server:
        found = state(server)
        assert not found["following"]
        assert "plan" in found["fault"]


def test_pages_hear_of_it_twice_a_second_at_most(dive: tuple[Server, Path]) -> None:
    server, _ = dive
    wait_for(server, lambda found: found["coverage"]["seen"] > 0)
    heard: list[float] = []
    publish = server.studio.events.publish
    server.studio.events.publish = lambda event, data: (  # type: ignore[method-assign]
        heard.append(time.monotonic()), publish(event, data))[1]  # fmt: skip
    assert call(server, "/api/follow/open", {"log": "nav.csv", "replay": 50}).status == 200
    wait_for(server, lambda found: found["lines"]["done"] >= 2)
    assert len(heard) >= 2
    assert len(heard) <= 2.0 * (heard[-1] - heard[0]) + 2
