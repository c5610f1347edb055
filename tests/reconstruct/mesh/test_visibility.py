"""Views and faces: the work for a view does not grow with the mesh beyond what it sees."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from reconstruct.mesh.visibility import see_faces
from reconstruct.views.model import View
from tests.oracles_dense import CODED, DEPTH_M, stereo_views, write_workspace

STEP_M = 0.02
VIEWS = stereo_views(np.array([0.0]), np.array([0.0]))


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("visibility")
    write_workspace(folder, VIEWS, CODED)
    return folder


def floor(path: Path, rows: int) -> np.ndarray:
    """Write a level mesh of so many rows around the origin; return the middles of its faces.

    Vertices are numbered square by square, as those of cells are.
    """
    at = STEP_M * (np.arange(rows) - rows / 2 + 0.3)
    east, north = (axis.ravel() for axis in np.meshgrid(at, at))
    corner = (np.arange(rows - 1)[:, None] * rows + np.arange(rows - 1)).ravel()
    square = corner[:, None] + [0, 1, rows + 1, rows]
    row, column = np.divmod(np.arange(rows * rows), rows)
    order = np.lexsort((column // 20, row // 20))
    triangles = np.concatenate([square[:, [0, 1, 2]], square[:, [0, 2, 3]]])
    triangles = np.argsort(order)[triangles].astype(np.int32)
    vertices = np.column_stack([east, north, np.full(len(east), -DEPTH_M)])[order]
    np.savez(path, vertices=vertices, triangles=triangles, offset=np.zeros(3))
    return vertices[triangles].mean(axis=1)


def seen(path: Path, workspace: Path, view: View) -> tuple[np.ndarray, int]:
    """Faces that a view sees, and the most memory that was taken while it looked."""
    see_faces(path, workspace, 0.01, view)  # what all views share is made
    tracemalloc.start()
    try:
        faces, quality = see_faces(path, workspace, 0.01, view)
        assert (quality > 0).all()
        return faces, tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_a_view_sees_the_faces_in_its_frame_whatever_lies_around(
    workspace: Path, tmp_path: Path
) -> None:
    places, taken = [], []
    for rows in (150, 600):
        middles = floor(tmp_path / "floor.npz", rows)
        faces, memory = seen(tmp_path / "floor.npz", workspace, VIEWS[0])
        assert (np.diff(faces) > 0).all()
        points_ned = middles[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
        pixels = VIEWS[0].project(points_ned)
        size = np.array(VIEWS[0].pinhole.size_px)
        side_px = VIEWS[0].pinhole.focal_px * STEP_M / 1.5
        inner = ((pixels > 3 + side_px) & (pixels < size - 3 - side_px)).all(axis=1)
        outer = ((pixels > 0) & (pixels < size)).all(axis=1)
        assert set(np.flatnonzero(inner)) <= set(faces.tolist()) <= set(np.flatnonzero(outer))
        places.append(middles[faces])
        taken.append(memory)
    assert len(places[0]) == len(places[1]) > 1000
    assert taken[1] < 3.0 * taken[0]
