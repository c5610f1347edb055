"""Coded markers that lie on the sea floor are found in pictures seen through flat ports."""

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from alice_survey.core.artefacts import write_json
from alice_survey.core.frames import Array
from alice_survey.core.manifest import write_manifest
from camera_calib.approximation.pinhole_warp import best_warp
from camera_calib.camera import Camera
from reconstruct.placing.control_command import survey_control
from reconstruct.placing.control_points import RegisteredPicture, read_picks, triangulate_picks
from tests.reconstruct.scenes import ALTITUDE_M, Scene, make_scene

SIDE_M, DEPTH_M = 0.15, 15.0


@cache
def site() -> Scene:
    return make_scene(lines=1, stations=3, points=50, port_distance_m=0.1)


def middle_ne() -> Array:
    """Where marker 7 lies flat, its upper edge to the north."""
    return np.mean([pose.translation[:2] for pose in site().ned_from_cam[:4]], axis=0)


def corners_ned() -> Array:
    """(4, 3) clockwise as a camera above sees them, from the marker's own upper left."""
    half = SIDE_M / 2
    plan = np.array([[half, -half], [half, half], [-half, half], [-half, -half]]) + middle_ne()
    return np.column_stack([plan, np.full(4, DEPTH_M)])


def picture(camera: Camera, ned_from_cam: RigidTransform, dictionary: int) -> np.ndarray:
    """A grey sea floor with the marker, every pixel's ray traced through the port."""
    paper = np.full((800, 800), 120.0, np.float32)  # twice the marker's side, 400 texels
    paper[120:680, 120:680] = 220.0
    known = cv2.aruco.getPredefinedDictionary(dictionary)
    paper[200:600, 200:600] = 20.0 + 0.78 * cv2.aruco.generateImageMarker(known, 7, 400)
    paper = cv2.GaussianBlur(paper, (0, 0), 1.5)  # about half a pixel: no stairs
    start, way = camera.unproject(camera.pixel_centres().reshape(-1, 2))
    start, way = ned_from_cam.apply(start), ned_from_cam.rotation.apply(way)
    spot = start + (DEPTH_M - start[:, 2:]) / way[:, 2:] * way
    upper_left = corners_ned()[0, :2]
    row = (upper_left[0] - spot[:, 0]) / SIDE_M * 400 + 200 - 0.5
    column = (spot[:, 1] - upper_left[1]) / SIDE_M * 400 + 200 - 0.5
    shape = (camera.height_px, camera.width_px)
    x, y = (v.reshape(shape).astype(np.float32) for v in (column, row))
    seen = cv2.remap(paper, x, y, cv2.INTER_LINEAR, borderValue=120.0)
    return cv2.GaussianBlur(seen, (0, 0), 0.7).astype(np.uint8)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("markers")
    images = folder / "images"
    for record, pose in zip(site().records, site().ned_from_cam, strict=True):
        path = images / record.image
        path.parent.mkdir(parents=True, exist_ok=True)
        taken = picture(site().rig.cameras[record.camera], pose, cv2.aruco.DICT_5X5_100)
        cv2.imwrite(str(path), taken)
    write_manifest(images / "manifest.csv", site().records)
    write_json(images / "stage.json", {"stage": "images", "digest": ""})
    return folder


def test_markers_are_found_to_a_part_of_a_pixel_and_their_side_measured(workspace: Path) -> None:
    _, found = survey_control(workspace)
    assert found["dictionary"] == "DICT_5X5_100"
    assert list(found["markers"]) == ["7"]
    assert found["markers"]["7"] >= 4
    assert found["detections"] == found["markers"]["7"]
    picks = read_picks(workspace / "markers.csv")
    of_name = {r.image: (r, p) for r, p in zip(site().records, site().ned_from_cam, strict=True)}
    misses = []
    for pick in picks:
        record, pose = of_name[pick.image]
        corner = corners_ned()[int(pick.point.split(".")[1])]
        seen = site().rig.cameras[record.camera].project(pose.inv().apply(corner[None]))[0]
        misses.append(np.linalg.norm(seen - [pick.x_px, pick.y_px]))
    assert 0.0 < np.sqrt(np.mean(np.square(misses))) < 0.35

    warps = {
        n: best_warp(c, 0.8 * ALTITUDE_M, 1.2 * ALTITUDE_M) for n, c in site().rig.cameras.items()
    }
    cameras = {
        r.image: RegisteredPicture(
            warp=warps[r.camera],
            model_from_pinhole=p * warps[r.camera].pinhole_from_cam.inv(),
        )
        for r, p in of_name.values()
    }
    spots, lost = triangulate_picks(picks, cameras)
    assert not lost
    place = np.stack([spots[f"7.{k}"].model for k in range(4)])
    np.testing.assert_allclose(place, corners_ned(), atol=0.012)
    np.testing.assert_allclose(spots["7"].model[:2], middle_ne(), atol=0.003)
    sides = np.linalg.norm(place - np.roll(place, -1, axis=0), axis=1)
    assert sides.mean() == pytest.approx(SIDE_M, rel=0.01)


def test_markers_of_another_dictionary_are_not_seen(workspace: Path) -> None:
    _, found = survey_control(workspace, dictionary="DICT_7X7_100")
    assert found["detections"] == 0
    assert read_picks(workspace / "markers.csv") == []
