"""Points of PLY files in each of its three formats, and of files that are cut short."""

from pathlib import Path

import numpy as np
import pytest

from alice_survey.core.errors import WorkspaceError
from reconstruct.ply import read_ply_points

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
