"""The endpoints of a dive that is followed, by its growing log."""

import io
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from alice_survey.app.studio.endpoints.follow import _COLOURS
from alice_survey.app.studio.server import Server
from tests.alice_survey.app.studio.client import ask, call, serving
from tests.engines import until
from tests.missions.follow.dives import text_of, workspace_of
from tests.missions.follow.test_dive import BROKEN, PLAN, ROWS, UNTIL_S


def state(server: Server) -> Any:
    reply = ask(server, "/api/follow/state")
    assert reply.status == 200, reply.text
    return reply.json


def wait_for(server: Server, true: Callable[[Any], bool]) -> Any:
    """The first state of which something is true."""

    def seen() -> Any:
        found = state(server)
        return found if found.get("fix") and true(found) else None

    return until(seen)


@pytest.fixture
def dive(tmp_path: Path) -> Iterator[tuple[Server, Path]]:
    """A studio that follows a log with three lines and a gap in it."""
    folder = workspace_of(tmp_path / "reef", PLAN)
    log = folder / "nav.csv"
    log.write_bytes(text_of(BROKEN[BROKEN[:, 0] < UNTIL_S]))
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
    heard = ask(server, "/api/follow/dive").json
    assert [line["state"] for line in heard["lines"][:4]] == ["done", "done", "done", "now"]
    assert len(heard["holes"]) == now["holes"]["count"]
    assert len(heard["fixes"]) > 50
    since = ask(server, f"/api/follow/dive?after={heard['fixes'][-3][0]}").json
    assert since["fixes"] == heard["fixes"][-2:]

    # The coverage: as many opaque pixels as are seen.
    reply = ask(server, "/api/follow/coverage")
    assert reply.headers["content-type"] == "image/png"
    pixels = cv2.imdecode(np.frombuffer(reply.body, np.uint8), cv2.IMREAD_UNCHANGED)
    south, west, north, east = now["bounds"]
    seen_m2 = float(np.mean(pixels[..., 3] == _COLOURS[1, 3])) * (north - south) * (east - west)
    assert seen_m2 == pytest.approx(24.0 * now["coverage"]["seen"], rel=0.01)

    # A plan over the holes is made by itself, and exported.
    wait_for(server, lambda found: found["proposal"] is not None)
    archive = zipfile.ZipFile(io.BytesIO(ask(server, "/api/follow/export?format=cola2").body))
    assert any(name.endswith(".xml") for name in archive.namelist())
    assert ask(server, "/api/follow/export?format=nonsense").status == 400

    # The log grows.
    before = now["coverage"]["seen"]
    with log.open("ab") as file:
        later = ROWS[ROWS[:, 0] >= UNTIL_S]
        file.write(text_of(later).split(b"\n", 1)[1])
    wait_for(server, lambda found: found["coverage"]["seen"] > before + 0.05)


def test_only_the_page_itself_changes_what_is_followed(dive: tuple[Server, Path]) -> None:
    server, log = dive
    assert call(server, "/api/follow/end", {}, token=None).status == 403
    (log.parent / "link.csv").symlink_to("/etc/passwd")
    for name in ("../nav.csv", "/etc/passwd", "none.csv", "link.csv"):
        assert call(server, "/api/follow/open", {"log": name}).status in (400, 404), name
    assert not call(server, "/api/follow/end", {}).json["following"]
    assert ask(server, "/api/follow/dive").status == 400
    opened = call(server, "/api/follow/open", {"log": "nav.csv"})
    assert opened.status == 200, opened.text
    wait_for(server, lambda found: found["coverage"]["seen"] > 0)


def test_a_log_that_cannot_be_used_is_said_in_a_line(tmp_path: Path) -> None:
    folder = workspace_of(tmp_path / "reef", PLAN)
    (folder / "nav.csv").write_text("a,b\n1,2\n")
    with serving(folder, log=str(folder / "nav.csv")) as server:
        assert "time_s" in until(lambda: state(server)["fault"])
    with serving(tmp_path / "empty", log="nav.csv") as server:
        found = state(server)
        assert not found["following"]
        assert "plan" in found["fault"]
