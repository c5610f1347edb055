"""The points of the dense cloud as the studio gives them."""

import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from alice_survey.app.studio.server import Server
from alice_survey.core.artefacts import write_json
from reconstruct.copc_nodes import read_node, read_nodes
from tests.alice_survey.app.report.tiny import CELL_M, plane_of, tiny_workspace
from tests.alice_survey.app.studio.client import ask, serving
from tests.reconstruct.tiny_cloud import STEP_M, deep_cloud, rippled

CLOUD = "dense/cloud.copc.laz"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    workspace = tiny_workspace(tmp_path_factory.mktemp("reef"))
    deep_cloud(workspace / CLOUD, rippled(3.0, 2.0))
    return workspace


@pytest.fixture(scope="module")
def server(folder: Path) -> Iterator[Server]:
    with serving(folder) as started:
        yield started


def points_of(data: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places (N, 3) from the node's centre, sigmas (N,) and colours (N, 3)."""
    count = len(data) // 19
    assert len(data) == 19 * count > 0
    places = np.frombuffer(data, "<f4", 3 * count).reshape(-1, 3)
    sigmas = np.frombuffer(data, "<f4", count, 12 * count)
    return places, sigmas, np.frombuffer(data, np.uint8, 3 * count, 16 * count).reshape(-1, 3)


def test_all_nodes_together_are_the_cloud(server: Server, folder: Path) -> None:
    about = ask(server, "/api/model/points").json
    assert about["cell"] == CELL_M and about["unit"] == "m" and about["plane"] is None
    counts = [node[-1] for node in about["nodes"]]
    assert sum(counts) == about["points"] == len(rippled(3.0, 2.0))
    assert about["nodes"][0][:4] == [0, 0, 0, 0]
    assert len(counts) > 50
    nodes = read_nodes(folder / CLOUD)
    total = 0
    for number in (0, 1, 20, len(counts) - 1):
        reply = ask(server, f"/api/model/points/{number}?v={about['version']}")
        assert reply.headers["content-type"] == "application/octet-stream"
        places, sigmas, colours = points_of(reply.body)
        level, *key, count = about["nodes"][number]
        half = about["half"] / 2**level
        centre = np.array(about["centre"]) - about["half"] + half * (2 * np.array(key) + 1)
        true = read_node(nodes, number)
        np.testing.assert_allclose(places + centre, true.enu, atol=0.01 * STEP_M)
        np.testing.assert_array_equal(sigmas, true.sigmas)
        np.testing.assert_array_equal(colours, true.colours)
        assert np.abs(places).max() < half
        assert len(places) == count
        total += count
    assert total > 100
    low, high = np.array(about["low"]), np.array(about["high"])
    np.testing.assert_allclose((high - low)[:2], [3.0, 2.0], atol=0.03)
    np.testing.assert_allclose(low[:2], [-1.5, -1.0], atol=0.01)


def test_a_node_is_kept_by_its_version(server: Server) -> None:
    version = ask(server, "/api/model/points").json["version"]
    reply = ask(server, f"/api/model/points/0?v={version}")
    assert "immutable" in reply.headers["cache-control"]
    tag = reply.headers["etag"]
    assert tag == f'"{version}-0"'
    again = ask(server, f"/api/model/points/0?v={version}", {"If-None-Match": tag})
    assert (again.status, again.body) == (304, b"")


@pytest.mark.parametrize(("number", "status"), [
    ("0?v=another", 409), ("0", 409), ("999999?v={}", 404), ("x?v={}", 404), ("-1?v={}", 404),
])  # fmt: skip
def test_what_is_not_there(server: Server, number: str, status: int) -> None:
    version = ask(server, "/api/model/points").json["version"]
    assert ask(server, "/api/model/points/" + number.format(version)).status == status


def test_a_cloud_that_is_replaced_is_to_be_loaded_again(tmp_path: Path) -> None:
    workspace = tiny_workspace(tmp_path)
    deep_cloud(workspace / CLOUD, rippled(1.0, 1.0))
    with serving(workspace) as server:
        old = ask(server, "/api/model/points").json
        deep_cloud(workspace / CLOUD, rippled(2.0, 1.0))
        reply = ask(server, f"/api/model/points/0?v={old['version']}")
        assert reply.status == 409
        assert "load the page again" in reply.json["error"]
        new = ask(server, "/api/model/points").json
        assert new["points"] > old["points"]
        assert ask(server, f"/api/model/points/0?v={new['version']}").status == 200


def test_a_cloud_replaced_while_it_is_read_is_a_conflict(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    workspace = tiny_workspace(tmp_path)
    deep_cloud(workspace / CLOUD, rippled(1.0, 1.0))
    from alice_survey.app.studio.endpoints import points

    replaced = threading.Event()

    def slow(nodes, number):
        found = read_node(nodes, number)
        deep_cloud(workspace / CLOUD, rippled(2.0, 1.0))
        replaced.set()
        return found

    monkeypatch.setattr(points, "read_node", slow)
    with serving(workspace) as server:
        version = ask(server, "/api/model/points").json["version"]
        assert ask(server, f"/api/model/points/0?v={version}").status == 409
    assert replaced.is_set()


def test_a_damaged_cloud_is_one_line(tmp_path: Path) -> None:
    workspace = tiny_workspace(tmp_path)
    path = deep_cloud(workspace / CLOUD, rippled(2.0, 2.0))
    nodes = read_nodes(path)
    bad, other = (int(n) for n in np.argsort(nodes.entries["count"])[-2:])
    data, at = bytearray(path.read_bytes()), int(nodes.entries[bad]["offset"])
    data[at + 60 : at + 300] = b"\x5a" * 240
    path.write_bytes(data)
    with serving(workspace) as server:
        version = ask(server, "/api/model/points").json["version"]
        reply = ask(server, f"/api/model/points/{bad}?v={version}")
        assert reply.status == 500
        assert f"cloud.copc.laz: is damaged (node {bad}" in reply.json["error"]
        assert ask(server, f"/api/model/points/{other}?v={version}").status == 200
        path.write_bytes(data[:300])
        reply = ask(server, "/api/model/points")
        assert reply.status == 500 and "\n" not in reply.json["error"]


def test_links_are_not_followed_and_nothing_is_nothing(tmp_path: Path) -> None:
    workspace = tiny_workspace(tmp_path / "reef")
    with serving(workspace) as server:
        assert ask(server, "/api/model/points").status == 404
        deep_cloud(tmp_path / "elsewhere.copc.laz", rippled(1.0, 1.0))
        (workspace / CLOUD).symlink_to(tmp_path / "elsewhere.copc.laz")
        assert ask(server, "/api/model/points").status == 404
        assert ask(server, "/api/model/points/0?v=").status == 404


def test_a_wall_has_its_plane(tmp_path: Path) -> None:
    workspace = tiny_workspace(tmp_path)
    deep_cloud(workspace / CLOUD, rippled(1.0, 1.0)[:, [0, 2, 1]])
    write_json(workspace / "dense" / "plane.json", plane_of("wall"))
    with serving(workspace) as server:
        about = ask(server, "/api/model/points").json
        assert about["plane"]["out"] == [0.0, -1.0, 0.0]
        spans = np.array(about["high"]) - about["low"]
        assert spans[1] < 0.2 < 0.9 < spans[2]
