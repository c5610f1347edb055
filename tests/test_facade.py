"""The facade's truth and judge, each by a second route."""

from typing import Any

import numpy as np
import open3d as o3d
import pytest

from benchmarks import facade_scene as scene
from benchmarks.facade import looks, projected

CAMERAS = scene.cameras()


def test_rays_meet_the_mesh_where_the_distance_is_zero() -> None:
    corners, triangles, _ = scene.mesh()
    solid = o3d.t.geometry.RaycastingScene()
    solid.add_triangles(corners.astype(np.float32), triangles.astype(np.uint32))
    rng = np.random.default_rng(2)
    met = 0
    for camera in CAMERAS[::5]:
        turn, eye = looks(camera)
        for slope in rng.uniform(-0.5, 0.5, (12, 2)):
            way = turn.T @ np.array([*slope, 1.0])
            way /= np.linalg.norm(way)
            ray = np.array([[*eye, *way]], np.float32)
            length = float(solid.cast_rays(ray)["t_hit"].numpy()[0])
            if length == np.inf:
                continue
            met += 1
            end = (eye + length * way)[None]
            assert abs(scene.distance(end)[0]) < 1e-4  # a column's chord is 0.04 mm off
            near = eye + 0.98 * length * way
            assert scene.reached(eye[None], near[None]).all()
            assert not scene.reached(eye[None], eye[None] + 1.2 * length * way).any()
    assert met > 30


def test_a_camera_sees_its_target_in_the_middle_with_what_is_above_on_top() -> None:
    steps = np.array([[0, 0, 0], [0, 0, 0.2], [0.2, 0, 0]])
    for camera in CAMERAS:
        target = np.array(camera["target"])
        middle, above, right = projected(target + steps, camera)
        np.testing.assert_allclose(middle, np.array(scene.SIZE_PX) / 2, atol=1e-9)
        assert above[1] < middle[1] - 10
        assert right[0] > middle[0] + 10
    # half the width of the picture at a distance of one is the tangent of half the angle
    eye, target = np.array([0.0, -5.0, 1.0]), np.array([0.0, 0.0, 1.0])
    level: dict[str, Any] = {"eye": eye, "target": target, "up": [0.0, 0.0, 1.0]}
    half = 5.0 * np.tan(np.deg2rad(scene.FOV_DEG / 2))
    edge = projected(np.array([[half, 0.0, 1.0]]), level)[0]
    np.testing.assert_allclose(edge, [scene.SIZE_PX[0], scene.SIZE_PX[1] / 2], atol=1e-9)


@pytest.mark.slow
def test_texture_coordinates_of_the_wall_are_places_on_it() -> None:
    corners, triangles, places = scene.mesh()
    flat = triangles[np.ptp(corners[triangles][..., 1], axis=1) == 0].ravel()
    np.testing.assert_allclose(places[flat] * scene.TEXTURE_M, corners[flat][:, [0, 2]])
    assert scene.texture().shape == (scene.TEXTURE_PX, scene.TEXTURE_PX, 3)
    assert 30 < scene.texture().std() < 90
    assert pytest.approx(1.0) == np.linalg.norm(scene.normals(corners[:40] + 0.01), axis=1)
