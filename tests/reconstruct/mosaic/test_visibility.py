"""Look-ups in pictures as taken against the exact camera behind its port."""

from functools import cache

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.frames import BODY_FROM_NADIR_CAM
from camera_calib.approximation.pinhole_warp import PinholeWarp, best_warp
from camera_calib.camera import Camera
from camera_calib.water import channel_cameras
from reconstruct.mosaic import visibility
from reconstruct.raster import DemGrid
from reconstruct.views.model import View
from reconstruct.views.range_shift import range_shift
from tests.cameras import flat_port_camera
from tests.oracles_dense import view_at

TILT = np.deg2rad(2.0)
CAMERA = flat_port_camera(
    width_px=846, height_px=676, fx_px=848.0, fy_px=848.5, cx_px=424.0, cy_px=340.0,
    k1=-0.045, k2=0.02, p1=2e-4, p2=-1e-4, port_distance_m=0.1, glass_thickness_m=0.02,
    normal=(np.sin(TILT), 0.0, np.cos(TILT)),
)  # fmt: skip


@cache
def warp() -> PinholeWarp:
    return best_warp(CAMERA, 1.6, 2.5)


SEA = visibility.Water(temperature_c=24.0, salinity_psu=39.0, depth_m=10.0)


def view_of(warp: PinholeWarp) -> View:
    turned = Rotation.from_euler("ZYX", [20.0, 4.0, -6.0], degrees=True) * BODY_FROM_NADIR_CAM
    pose = RigidTransform.from_components([0.0, 0.0, 8.0], turned)
    return view_at(pose, warp.pinhole, range_shift(warp))


GRID = DemGrid(west=-0.9, north=0.9, cell=0.012, rows=150, columns=150)
NORTH, EAST = np.meshgrid(GRID.north_of(np.arange(150) + 0.5), GRID.east_of(np.arange(150) + 0.5),
                          indexing="ij")  # fmt: skip
HEIGHT = (-10.0 + 0.3 * NORTH - 0.25 * EAST).astype(np.float32)
"""A surface whose height spans a metre."""
RELIEF = visibility.Ground(HEIGHT, GRID).surface(GRID)


def misses_px(sight: visibility.SeenCells, camera: Camera) -> np.ndarray:
    """How far from the exact pixel of a camera each cell of the relief is looked up."""
    world = np.stack([NORTH, EAST, -HEIGHT.astype(float)], axis=-1)
    points = view_of(warp()).world_from_cam.inv().apply(world.reshape(-1, 3))
    taken = camera.project(warp().pinhole_from_cam.inv().apply(points)).reshape(150, 150, 2)
    return np.hypot(sight.x + 0.5 - taken[..., 0], sight.y + 0.5 - taken[..., 1])


def test_points_are_looked_up_where_the_camera_behind_a_tilted_port_shows_them() -> None:
    sight = visibility.see(view_of(warp()), visibility.camera_optics(warp(), True), RELIEF)
    inside = sight.quality > 0
    assert inside.mean() > 0.3
    error = misses_px(sight, CAMERA)
    assert 1e-5 < error[inside].max() < 0.02
    assert np.sqrt((error[inside] ** 2).mean()) < 0.008


def test_each_channel_is_looked_up_where_its_own_light_falls() -> None:
    view = view_of(warp())
    cameras = channel_cameras(CAMERA, temperature_c=24.0, salinity_psu=39.0, depth_m=10.0)
    green = visibility.see(view, visibility.camera_optics(warp(), True), RELIEF)
    moved = []
    for name, optics in zip(
        ("blue", "green", "red"), visibility.channel_optics(warp(), SEA, True), strict=True
    ):
        sight = visibility.see(view, optics, RELIEF)
        inside = (sight.quality > 0) & (green.quality > 0)
        assert misses_px(sight, cameras[name])[inside].max() < 0.05
        moved.append(np.hypot(sight.x - green.x, sight.y - green.y)[inside].max())
    assert moved[0] > 0.5
    assert moved[1] == 0
    assert moved[2] > 0.5


def test_forgetting_the_range_would_show() -> None:
    sight = visibility.see(view_of(warp()), visibility.camera_optics(warp(), False), RELIEF)
    assert misses_px(sight, CAMERA)[sight.quality > 0].max() > 0.1
