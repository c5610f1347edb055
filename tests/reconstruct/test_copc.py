"""COPC files of `reconstruct.copc`, read by laspy as COPC and as plain LAZ."""

import tracemalloc
from collections.abc import Iterable
from datetime import date
from pathlib import Path

import laspy
import numpy as np
import pytest
from laspy.copc import Bounds

from alice_survey.core.executor import SERIAL, Executor, local_executor
from reconstruct import copc
from reconstruct.copc import PointSpool, write_copc

STEP_M = 1e-4
SPACING_M = 0.02
OFFSET_M = np.array([-300.0, 20.0, -40.0])


def new_header() -> laspy.LasHeader:
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.offsets, header.scales = OFFSET_M, np.full(3, STEP_M)
    header.creation_date = date(2000, 1, 1)
    header.add_extra_dims([laspy.ExtraBytesParams(name="sigma", type="f4")])
    return header


def points_at(xyz: np.ndarray, header: laspy.LasHeader) -> laspy.ScaleAwarePointRecord:
    """Points with random attributes."""
    rng = np.random.default_rng(len(xyz))
    points = laspy.ScaleAwarePointRecord.zeros(len(xyz), header=header)
    points.x, points.y, points.z = xyz.T
    points["return_number"] = np.ones(len(xyz), np.uint8)
    points["red"] = rng.integers(0, 65536, len(xyz)).astype(np.uint16)
    points["sigma"] = rng.random(len(xyz), np.float32)
    return points


def write(
    folder: Path,
    parts: Iterable[np.ndarray],
    spacing: float = SPACING_M,
    executor: Executor = SERIAL,
) -> tuple[Path, np.ndarray]:
    """A file of points at places (N, 3), and its records sorted."""
    path, header = folder / "cloud.copc.laz", new_header()
    spool = PointSpool.of(folder / "scratch", header, spacing)
    written = [points_at(xyz, header).array for xyz in parts]
    spooled = [spool.add(f"{n}", points) for n, points in enumerate(written)]
    write_copc(path, header, spool, spooled, executor)
    assert list(folder.iterdir()) == [path]
    return path, np.sort(np.concatenate(written))


def floor(length_m: float, width_m: float) -> np.ndarray:
    """A rippled floor at `SPACING_M` around zero."""
    x, y = np.meshgrid(
        np.arange(-length_m / 2, length_m / 2, SPACING_M),
        np.arange(-width_m / 2, width_m / 2, SPACING_M),
    )
    z = 0.05 * np.sin(9 * x) * np.cos(7 * y)
    return np.stack([x, y, z], axis=-1).reshape(-1, 3) + 0.5 * STEP_M


@pytest.fixture(scope="module")
def strip(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    return write(tmp_path_factory.mktemp("strip"), np.array_split(floor(200.0, 2.0), 40))


CLOUDS = {
    "one point": np.array([[-3.0, 2.0, -1.0]]),
    "one place": np.full((110_000, 3), [7.0, -8.0, 9.0]),
    "floor across zero": floor(9.0, 7.0),
    "wall": floor(9.0, 7.0)[:, [2, 0, 1]],
    "apart": np.array([[-9e4, 0.0, 0.0], [9e4, 1.0, 0.0], [0.0, 1e5, 3e4]]),
}


@pytest.mark.parametrize("name", CLOUDS)
def test_every_point_is_there_once(name: str, tmp_path: Path):
    path, written = write(tmp_path, np.array_split(CLOUDS[name], 3))
    np.testing.assert_array_equal(np.sort(laspy.read(path).points.array), written)
    with laspy.CopcReader.open(path) as reader:
        np.testing.assert_array_equal(np.sort(reader.query().array), written)
        assert reader.header.point_count == reader.header.number_of_points_by_return[0]
        (sigma,) = reader.header.vlrs.get("ExtraBytesVlr")[0].extra_bytes_structs
        assert not (sigma.min_is_relevant() or sigma.max_is_relevant())
        for minimum, maximum, axis in zip(
            reader.header.mins, reader.header.maxs, "XYZ", strict=True
        ):
            at = written[axis] * STEP_M + OFFSET_M["XYZ".index(axis)]
            assert (minimum, maximum) == pytest.approx((at.min(), at.max()), abs=1e-9)


@pytest.mark.slow
def test_a_long_strip_is_found_by_bounds(strip: tuple[Path, np.ndarray]):
    path, written = strip
    rng = np.random.default_rng(3)
    with laspy.CopcReader.open(path) as reader:
        xyz = np.stack([written[axis] for axis in "XYZ"], axis=1) * STEP_M + OFFSET_M
        for _ in range(6):
            low = rng.uniform([-100.0, -1.0], [90.0, 0.5])
            high = low + rng.uniform(0.2, 10.0, 2)
            found = np.sort(reader.query(bounds=Bounds(low, high)).array)
            inside = ((xyz[:, :2] > low) & (xyz[:, :2] < high)).all(axis=1)
            np.testing.assert_array_equal(found, written[inside])
            assert inside.sum() > 100


@pytest.mark.slow
def test_every_level_is_an_even_thinning_of_the_cloud(strip: tuple[Path, np.ndarray]):
    path, written = strip
    with laspy.CopcReader.open(path) as reader:
        info = reader.copc_info
        sizes = []
        for level in range(20):
            edge = info.spacing / 2**level
            shown = reader.query(level=range(level + 1)).array
            cells, counts = _cells(shown, edge, info)
            all_cells, all_counts = _cells(written, edge, info)
            # no cell is bare; one point each, but in leaves, which hold all that there is
            np.testing.assert_array_equal(cells, all_cells)
            assert ((counts == 1) | (counts == all_counts)).all()
            same = reader.query(resolution=edge).array
            np.testing.assert_array_equal(np.sort(same), np.sort(shown))
            sizes.append(len(shown))
            if len(shown) == len(written):
                break
        reader.query()  # reads all pages
        nodes = np.array([entry.point_count for entry in reader.root_page.entries.values()])
    assert nodes.sum() == len(written)
    assert nodes.max() <= 100_000
    assert np.median(nodes[nodes > 0]) > 5_000
    assert len(sizes) > 4
    assert 100 < sizes[0] < 2000  # along 200 m, 256 cells of the root at most
    assert (np.diff(sizes) > 0).all()


def _cells(points: np.ndarray, edge: float, info: object) -> tuple[np.ndarray, np.ndarray]:
    """Cells that hold points, counted from the root's corner, and how many each holds."""
    corner = info.center - info.halfsize  # type: ignore[attr-defined]
    at = np.stack([points[axis] for axis in "XYZ"], axis=1) * STEP_M + OFFSET_M - corner
    number = np.floor(at / edge).astype(np.int64) @ np.array([1, 1 << 20, 1 << 40])
    cells, counts = np.unique(number, return_counts=True)
    return cells, counts


@pytest.mark.slow
def test_workers_make_the_same_bytes(tmp_path: Path):
    parts = np.array_split(floor(22.5, 12.0), 7)  # six cubes of half their usual edge
    files = []
    for name, executor in (("a", SERIAL), ("b", local_executor(2))):
        (tmp_path / name).mkdir()
        files.append(write(tmp_path / name, parts, SPACING_M / 2, executor)[0].read_bytes())
    assert files[0] == files[1]


@pytest.mark.slow
def test_memory_does_not_hold_the_cloud(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(copc, "_GRID_BITS", 5)
    monkeypatch.setattr(copc, "_LEAF_POINTS", 1500)
    header, count = new_header(), 0
    tracemalloc.start()
    try:
        spool, spooled = PointSpool.of(tmp_path / "scratch", header, SPACING_M / 8), []
        for n in range(50):
            places = floor(2.0, 2.0) + np.array([2.0 * (n % 10), 2.0 * (n // 10), 0.0])
            spooled.append(spool.add(f"{n}", points_at(places, header).array))
            count += len(places)
        write_copc(tmp_path / "c.laz", header, spool, spooled)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert header.point_count == count == 500_000
    size = count * header.point_format.size
    assert 0.01 * size < peak < 0.2 * size
