"""Nodes of COPC files, read one by one, next to laspy's reading of the whole file."""

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest
from laspy.copc import Bounds, CopcReader

from alice_survey.core.errors import AliceError, ReconstructionError, WorkspaceError
from reconstruct import copc, copc_nodes
from reconstruct.copc_nodes import read_node, read_nodes
from tests.reconstruct.test_copc import CLOUDS, OFFSET_M, STEP_M, new_header, write
from tests.reconstruct.tiny_cloud import deep_cloud, rippled

ENTRY = struct.Struct("<4iQ2i")


@pytest.fixture(scope="module")
def deep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return deep_cloud(tmp_path_factory.mktemp("deep") / "cloud.copc.laz", rippled(3.0, 2.0))


def rows(points: laspy.ScaleAwarePointRecord) -> np.ndarray:
    """(N, 7) steps, colours as bytes, sigmas; sorted."""
    steps = np.stack([points[axis] for axis in "XYZ"], axis=1)
    colours = np.stack([points[name] >> 8 for name in ("red", "green", "blue")], axis=1)
    found = np.column_stack([steps, colours, points["sigma"]])
    return found[np.lexsort(found.T)]


@pytest.mark.parametrize("name", ["one point", "floor across zero", "wall", "apart"])
def test_nodes_hold_every_point_once(name: str, tmp_path: Path) -> None:
    path, _ = write(tmp_path, np.array_split(CLOUDS[name], 3))
    assert_all_there(path)


def test_nodes_of_many_levels_hold_every_point_once(deep: Path) -> None:
    nodes = assert_all_there(deep)
    assert len(nodes.entries) > 100
    assert nodes.entries["level"].max() >= 4


def assert_all_there(path: Path) -> copc_nodes.CopcNodes:
    nodes = read_nodes(path)
    found = []
    for number in np.flatnonzero(nodes.entries["count"]):
        points = read_node(nodes, int(number))
        assert len(points.enu) == nodes.entries[number]["count"]
        steps = np.rint((points.enu - nodes.header.offsets) / STEP_M)
        np.testing.assert_allclose(steps * STEP_M + nodes.header.offsets, points.enu, atol=1e-9)
        found.append(np.column_stack([steps, points.colours, points.sigmas]))
        centre, half = nodes.cube(int(number))
        assert np.abs(points.enu - centre).max() < half
    everything = np.concatenate(found)
    np.testing.assert_array_equal(everything[np.lexsort(everything.T)], rows(laspy.read(path)))
    return nodes


def test_a_node_is_what_laspy_finds_in_its_cube(deep: Path) -> None:
    nodes = read_nodes(deep)
    with CopcReader.open(deep) as reader:
        assert nodes.spacing == reader.copc_info.spacing
        for number in (0, 3, 40, len(nodes.entries) - 1):
            centre, half = nodes.cube(number)
            within = Bounds(centre - half + 0.1 * STEP_M, centre + half - 0.1 * STEP_M)
            level = int(nodes.entries[number]["level"])
            theirs = reader.query(bounds=within, level=level)
            ours = read_node(nodes, number)
            assert len(ours.sigmas) == len(theirs) > 0
            assert np.isin(ours.sigmas, np.asarray(theirs["sigma"])).all()


def in_pages(path: Path, maximum: int) -> Path:
    """A copy whose hierarchy is in pages of a few entries, each named by the one before."""
    nodes = read_nodes(path)
    rows = [
        (int(e["level"]), *map(int, e["key"]), int(e["offset"]), int(e["size"]), int(e["count"]))
        for e in nodes.entries
    ]
    data, page = path.read_bytes(), b""
    for start in range((len(rows) - 1) // maximum * maximum, -1, -maximum):
        further = [(*rows[start + maximum][:4], len(data), len(page), -1)] if page else []
        data += page
        page = b"".join(ENTRY.pack(*row) for row in [*rows[start : start + maximum], *further])
    at = data.index(struct.pack("<d", nodes.spacing), 375) + 8
    copy = path.with_name("pages.copc.laz")
    copy.write_bytes(data[:at] + struct.pack("<2Q", len(data), len(page)) + data[at + 16 :] + page)
    return copy


def test_a_hierarchy_of_many_pages_is_read_whole(deep: Path) -> None:
    nodes = read_nodes(in_pages(deep, 50))
    np.testing.assert_array_equal(nodes.entries, read_nodes(deep).entries)


def test_what_is_too_large_is_refused(deep: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = read_nodes(deep)
    monkeypatch.setattr(copc_nodes, "_MAX_POINTS", int(nodes.entries["count"].max()) - 1)
    with pytest.raises(ReconstructionError, match="at most"):
        read_node(nodes, int(nodes.entries["count"].argmax()))
    monkeypatch.setattr(copc_nodes, "_MAX_NODES", len(nodes.entries) - 1)
    with pytest.raises(ReconstructionError, match="too many to show"):
        read_nodes(deep)


def test_what_is_damaged_is_one_line(deep: Path, tmp_path: Path) -> None:
    data, nodes = deep.read_bytes(), read_nodes(deep)
    path = tmp_path / "cloud.copc.laz"
    hierarchy = data.rindex(ENTRY.pack(*root_of(nodes)))
    for wrong in (
        data[:200],
        data[: hierarchy + 40],
        data[:hierarchy] + bytes(len(data) - hierarchy),
        data[:hierarchy] + b"\xff" * (len(data) - hierarchy),
        b"no cloud at all" * 100,
    ):
        path.write_bytes(wrong)
        with pytest.raises(WorkspaceError, match=r"cloud\.copc\.laz: is damaged .*delete it"):
            read_nodes(path)
    rng = np.random.default_rng(5)
    refused = 0
    for number in range(1, 60):
        entry = nodes.entries[number]
        at = int(entry["offset"]) + 60
        noise = rng.integers(0, 256, 400, dtype=np.uint8).tobytes()
        path.write_bytes(data[:at] + noise + data[at + 400 :])
        try:
            read_node(read_nodes(path), number)
        except AliceError as error:
            refused += 1
            assert "\n" not in str(error) and f"node {number}" in str(error)
    assert refused > 40  # noise in colours and sigmas is not to be known
    path.write_bytes(data[: int(nodes.entries["offset"].max())])
    cut = int(nodes.entries["offset"].argmax())
    with pytest.raises(WorkspaceError, match="cut off"):
        read_node(copc_nodes.CopcNodes(**vars(nodes) | {"path": path}), cut)


def root_of(nodes: copc_nodes.CopcNodes) -> tuple[int, ...]:
    root = nodes.entries[0]
    return (0, 0, 0, 0, int(root["offset"]), int(root["size"]), int(root["count"]))


def test_points_without_sigmas_are_refused(deep: Path, tmp_path: Path) -> None:
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.offsets, header.scales = OFFSET_M, np.full(3, STEP_M)
    points = laspy.ScaleAwarePointRecord.zeros(5, header=header)
    spool = copc.PointSpool.of(tmp_path / "scratch", header, 0.02)
    path = tmp_path / "plain.copc.laz"
    copc.write_copc(path, header, spool, [spool.add("0", points.array)])
    with pytest.raises(ReconstructionError, match="without sigmas"):
        read_nodes(path)
    with pytest.raises(FileNotFoundError):
        read_nodes(tmp_path / "none.copc.laz")
    header = new_header()
    with laspy.open(tmp_path / "no_copc.laz", "w", header=header) as file:
        file.write_points(laspy.ScaleAwarePointRecord.zeros(5, header=header))
    with pytest.raises(WorkspaceError, match="no COPC info"):
        read_nodes(tmp_path / "no_copc.laz")
