"""Occluders off the heights of a plane, and what they hide from a view, in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.executor import local_executor
from reconstruct.dense.cloud import VERTEX
from reconstruct.mosaic.visibility import Occluders, find_occluders, hidden_by, read_occluders
from reconstruct.planes import LEVEL_PLANE
from reconstruct.ply import write_ply
from reconstruct.raster import DemGrid, tiled_raster
from reconstruct.views.model import View
from tests.oracles_dense import FRAME, PINHOLE, view_at

CELL_M = 0.01
POLE_M = 0.1
"""Radius of an upright pole, 1 m high, around the origin, on a floor 10 m deep."""
FLOOR_M = -10.0
SIZE_PX = (600, 480)
"""Of a picture with a focal length of 500 px."""


def floor_and_pole() -> tuple[np.ndarray, np.ndarray]:
    """Places (N, 3), east, north, up, on the floor and on the pole."""
    line = np.arange(-2.0, 2.0, CELL_M) + 0.5 * CELL_M
    east, north = (part.ravel() for part in np.meshgrid(line, line))
    outside = np.hypot(east, north) > POLE_M + 2 * CELL_M
    floor = np.column_stack([east, north, np.full(len(east), FLOOR_M)])[outside]
    turn, up = np.meshgrid(np.arange(0, 2 * np.pi, 0.1), np.arange(CELL_M, 1.0, CELL_M))
    pole = [POLE_M * np.cos(turn).ravel(), POLE_M * np.sin(turn).ravel(), FLOOR_M + up.ravel()]
    return floor, np.column_stack(pole)


@pytest.fixture(scope="module")
def occluders(tmp_path_factory: pytest.TempPathFactory) -> Occluders:
    folder = tmp_path_factory.mktemp("occluders")
    floor, pole = floor_and_pole()
    points = np.concatenate([floor, pole])
    offset = np.array([3.0, -2.0, -9.0])
    records = np.zeros(len(points), VERTEX)
    for axis, values in zip("xyz", (points - offset).T, strict=True):
        records[axis] = values
    write_ply(folder / "cloud.ply", [records], ["offset_east_north_up 3.0 -2.0 -9.0"])
    heights = np.full((400, 400), np.nan, np.float32)
    row, column = (200 - floor[:, 1] / CELL_M).astype(int), (floor[:, 0] / CELL_M + 200).astype(int)
    heights[row, column] = FLOOR_M
    grid = DemGrid(west=-2.0, north=2.0, cell=CELL_M, rows=400, columns=400)
    with tiled_raster(folder / "dem.tif", grid, FRAME, "float32", np.nan, "height") as raster:
        raster.write(heights, 1)
    with local_executor().start() as executor:
        find_occluders(
            folder / "cloud.ply",
            CELL_M,
            LEVEL_PLANE,
            folder / "dem.tif",
            folder / "found",
            executor,
            "find occluders",
        )
    return read_occluders(folder / "found")


def view_from(place_enu: np.ndarray, at_enu: np.ndarray) -> View:
    """A view whose axis meets a place."""
    ned = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    start, end = ned @ place_enu, ned @ at_enu
    ahead = (end - start) / np.linalg.norm(end - start)
    right = np.cross([0.0, 0.0, 1.0], ahead)
    right /= np.linalg.norm(right)
    rotation = Rotation.from_matrix(np.stack([right, np.cross(ahead, right), ahead], axis=1))
    pinhole = replace(
        PINHOLE,
        width_px=SIZE_PX[0],
        height_px=SIZE_PX[1],
        fx_px=500.0,
        fy_px=500.0,
        cx_px=300.0,
        cy_px=240.0,
    )
    return view_at(RigidTransform.from_components(start, rotation), pinhole)


def test_the_pole_is_off_the_heights_and_the_floor_is_not(occluders: Occluders) -> None:
    _, pole = floor_and_pole()
    view = view_from(np.array([0.0, -3.0, FLOOR_M + 1.0]), np.array([0.0, 0.0, FLOOR_M + 0.5]))
    found = occluders.seen_by(view)
    assert np.count_nonzero(pole[:, 2] > FLOOR_M + 3.1 * CELL_M) <= len(found) <= len(pole)
    np.testing.assert_allclose(np.hypot(found[:, 0], found[:, 1]), POLE_M, atol=1e-5)
    away = view_from(np.array([0.0, -3.0, FLOOR_M + 1.0]), np.array([0.0, -9.0, FLOOR_M]))
    assert len(occluders.seen_by(away)) == 0


@pytest.mark.parametrize("azimuth_deg", [0.0, 50.0, 200.0])
def test_the_floor_behind_the_pole_is_hidden_and_all_else_is_seen(
    occluders: Occluders, azimuth_deg: float
) -> None:
    azimuth = np.radians(azimuth_deg)
    away = np.array([np.sin(azimuth), np.cos(azimuth), 0.0])
    camera = np.array([0.0, 0.0, FLOOR_M + 1.5]) - 2.0 * away
    view = view_from(camera, np.array([0.0, 0.0, FLOOR_M]))
    floor, _ = floor_and_pole()
    world = np.column_stack([floor[:, 1], floor[:, 0], -floor[:, 2]])
    hidden = hidden_by(occluders, view, world)
    # a line of sight goes down: it meets the pole if it would leave it below its top
    sight = floor - camera
    length = np.hypot(sight[:, 0], sight[:, 1])
    beside = np.abs(sight[:, 0] * camera[1] - sight[:, 1] * camera[0]) / length
    along = -(camera[:2] @ sight[:, :2].T) / length
    half = np.sqrt(np.maximum(POLE_M**2 - beside**2, 0.0))
    height = camera[2] + sight[:, 2] * (along + half) / length - FLOOR_M
    behind = (beside < POLE_M) & (length > along) & (height < 1.0)
    pixels = view.project(world)
    inside = ((pixels > 4) & (pixels < np.array(SIZE_PX) - 4)).all(axis=1)
    # the pole's rim is drawn with squares of a spacing and a half, its foot is no occluder
    clear = (np.abs(beside - POLE_M) > 2 * CELL_M) & (np.abs(height - 1.0) > 0.03)
    clear &= inside & ((length - along > POLE_M + 6 * CELL_M) | (length < along))
    assert np.count_nonzero(clear & behind) > 500
    np.testing.assert_array_equal(hidden[clear], behind[clear])
