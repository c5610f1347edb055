"""COLMAP models and PLY files, whole, cut short or damaged."""

import struct
from pathlib import Path

import numpy as np
import pytest

from alice_survey.core.errors import ReconstructionError, WorkspaceError
from alice_survey.core.frames import Datum
from reconstruct.ply import read_ply_points
from reconstruct.views.model import WorldFrame, read_frame, write_frame
from reconstruct.views.model_files import read_reconstruction
from tests.reconstruct.scenes import make_scene
from tests.reconstruct.true_models import near_truth, warped_scene

NAMES = ("cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    scene = make_scene(lines=1, stations=2, points=60)
    mapped = near_truth(scene, *warped_scene(scene), np.random.default_rng(1))
    mapped.model.write(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", NAMES)
def test_a_file_that_is_missing_cut_or_longer_is_refused(folder: Path, name: str) -> None:
    model = read_reconstruction(folder)
    assert len(model.images) == 4 and len(model.points3D) > 10
    whole = (folder / name).read_bytes()
    spoilt = [b"", whole[:7], whole[: len(whole) // 2], whole[:-1], whole + b"\0"]
    counts = (1 << 40, (1 << 64) - 1, 3_000_000_000)  # beyond the file
    spoilt += [struct.pack("<Q", count) + whole[8:] for count in counts]
    for data in spoilt:
        (folder / name).write_bytes(data)
        with pytest.raises(ReconstructionError, match=name):
            read_reconstruction(folder)
    (folder / name).unlink()
    with pytest.raises(ReconstructionError, match=name):
        read_reconstruction(folder)


@pytest.mark.parametrize(
    ("old", "new"), [('"ned"', '"enu"'), ("46.5", "91"), ('"latitude_deg"', '"latitude"')]
)
def test_a_frame_that_was_changed_names_its_file(tmp_path: Path, old: str, new: str) -> None:
    path = tmp_path / "frame.json"
    datum = Datum(46.5, -91.5)
    frame = WorldFrame(name="ned", datum=datum, scaled=True, vertical_datum="sea", notes=("a",))
    write_frame(path, frame)
    assert read_frame(path) == frame
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(WorkspaceError, match=r"frame\.json"):
        read_frame(path)


XYZ = np.random.default_rng(2).normal(0, 100, (50, 3))
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def ply(path: Path, kind: str, comment: str = "", faces: bool = True) -> Path:
    """Points with a colour between their coordinates, and a face after them."""
    head = ["ply", f"format {kind} 1.0", *([f"comment {comment}"] if comment else [])]
    head += ["element vertex 50", "property double x", "property uchar red", "property double y"]
    head += ["property double z"]
    head += ["element face 1", "property list uchar int vertex_indices"] if faces else []
    start = "\n".join([*head, "end_header", ""]).encode()
    order = FORMATS[kind]
    if not order:
        rows = [f"{x!r} 7 {y!r} {z!r}" for x, y, z in XYZ.tolist()]
        path.write_bytes(start + "\n".join([*rows, "3 0 1 2", ""]).encode())
        return path
    record = np.dtype(
        [("x", f"{order}f8"), ("red", "u1"), ("y", f"{order}f8"), ("z", f"{order}f8")]
    )
    rows_of = np.zeros(50, record)
    for i, axis in enumerate("xyz"):
        rows_of[axis] = XYZ[:, i]
    path.write_bytes(start + rows_of.tobytes() + b"\3" + bytes(12))
    return path


@pytest.mark.parametrize("kind", FORMATS)
def test_points_of_every_format(tmp_path: Path, kind: str) -> None:
    path = ply(tmp_path / "a.ply", kind)
    np.testing.assert_allclose(read_ply_points(path, 1000), XYZ, rtol=1e-15)
    np.testing.assert_allclose(read_ply_points(path, 20), XYZ[::3], rtol=1e-15)
    ply(path, kind, "offset_east_north_up 10 20 -5")
    np.testing.assert_allclose(
        read_ply_points(path, 1000), XYZ + np.array([10, 20, -5]), rtol=1e-12
    )


@pytest.mark.parametrize("kind", FORMATS)
def test_a_file_that_is_cut_short_makes_no_points(tmp_path: Path, kind: str) -> None:
    whole = ply(tmp_path / "a.ply", kind, faces=False).read_bytes()
    start = whole.index(b"end_header") + 11
    for end in (3, start - 1, start, start + 100):
        (tmp_path / "a.ply").write_bytes(whole[:end])
        with pytest.raises(WorkspaceError):
            read_ply_points(tmp_path / "a.ply", 1000)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"vertex 50", b"vertex -5"), (b"vertex 50", b"vertex x"),
        (b"element vertex", b"element edge"),
        (b"property double x", b"property list uchar int x"),
        (b"property double x", b"property double y"), (b"property double x", b"property double q"),
        (b"ascii 1.0", b"morse 1.0"),
    ],
)  # fmt: skip
def test_headers_that_do_not_hold(tmp_path: Path, old: bytes, new: bytes) -> None:
    path = ply(tmp_path / "a.ply", "ascii")
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(WorkspaceError):
        read_ply_points(path, 1000)
