"""Requests that make no sense: every endpoint says so in one line, and none breaks."""

from collections.abc import Iterator
from typing import Any
from urllib.parse import quote

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alice_survey.app.studio.endpoints.base import Endpoint
from alice_survey.app.studio.server import Server, all_endpoints
from tests.alice_survey.app.report.tiny import tiny_workspace
from tests.alice_survey.app.studio.client import Reply, ask, call, serving

STARTS = {"/api/run/start"}
"""Endpoints that start a program."""
LONGEST = 200
NAMES = (
    "east", "north", "n", "e", "x", "y", "image", "name", "path", "format", "places", "kind",
    "changes", "shapes", "plan", "area", "altitude_m", "token", "survey", "outer", "holes", "first",
    "second", "points", "picks", "rows", "label", "labels", "annotations", "folder", "log", "speed",
    "budget_s", "minutes", "tool", "base", "height", "measures", "page", "level", "job", "after",
)  # fmt: skip


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with serving(tiny_workspace(tmp_path_factory.mktemp("studio"))) as started:
        yield started


@pytest.fixture(scope="module")
def endpoints(server: Server) -> list[Endpoint]:
    found = list(all_endpoints(server.studio))
    assert len(found) > 30 and {one.path for one in found} >= STARTS
    return [one for one in found if one.path not in STARTS]


def values() -> st.SearchStrategy[Any]:
    scalars = st.one_of(
        st.none(), st.booleans(), st.integers(-(10**20), 10**20), st.floats(-1e9, 1e9),
        st.sampled_from([0, -1, 1e308, 0.5, "", "a", "../..", "é", "\x00", "left/1.png", "mosaic"]),
    )  # fmt: skip
    return st.recursive(
        scalars,
        lambda inner: st.one_of(
            st.lists(inner, max_size=4), st.dictionaries(st.sampled_from(NAMES), inner, max_size=6)
        ),
        max_leaves=12,
    )


def is_understood(endpoint: Endpoint, reply: Reply) -> None:
    assert reply.status in (200, 400, 404, 409, 411, 413, 500), endpoint.path
    if reply.status not in (200, 411):
        fault = reply.json["error"]  # a bug has none
        assert "\n" not in fault and 0 < len(fault) < 1000, endpoint.path


@given(data=st.data())
@settings(max_examples=80, deadline=None)
def test_wrong_questions_get_one_line(
    server: Server, endpoints: list[Endpoint], data: st.DataObject
) -> None:
    endpoint = data.draw(st.sampled_from([one for one in endpoints if one.method == "GET"]))
    words = st.sampled_from(["", "0", "-1", "1e400", "nan", "inf", "a", "../x", "é", "0,0", "%"])
    query = data.draw(st.dictionaries(st.sampled_from(NAMES), words, max_size=5))
    text = "&".join(f"{quote(name)}={quote(value)}" for name, value in query.items())
    path = endpoint.path.replace("{name:path}", data.draw(st.sampled_from(["a", "a/b.png", "%2e"])))
    for part in ("{name}", "{level}", "{x}", "{y}"):
        path = path.replace(part, data.draw(st.sampled_from(["a", "0", "-1", "999999999"])))
    is_understood(endpoint, ask(server, f"{path}?{text}"))


@given(data=st.data())
@settings(max_examples=150, deadline=None)
def test_wrong_orders_get_one_line(
    server: Server, endpoints: list[Endpoint], data: st.DataObject
) -> None:
    endpoint = data.draw(st.sampled_from([one for one in endpoints if one.method == "POST"]))
    body = data.draw(st.one_of(values(), st.binary(max_size=LONGEST)))
    is_understood(endpoint, call(server, endpoint.path, body))
