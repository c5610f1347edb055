from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from alice_survey.base.errors import CalibrationError
from camera_calib.tank.interface import (
    FixedCamera,
    Reference,
    check_sides,
    place_camera,
    plane_through,
)
from tests.oracles_interface import LENS, looking, points_in_tank, true_tank

Array = NDArray[np.float64]
TRUE = true_tank()


def placed(camera: FixedCamera, reference: Reference | None = None) -> FixedCamera:
    return place_camera(
        LENS,
        reference or camera.reference,
        n_water=camera.n_water,
        glass_thickness_m=camera.glass_thickness_m,
    )


@pytest.mark.parametrize("lean_m", [0.0, 0.02])
@pytest.mark.parametrize("i", [0, 1])
def test_pose_and_port_are_exact_without_noise(i: int, lean_m: float) -> None:
    truth = true_tank(lean_m=lean_m).cameras[i]

    found = placed(truth)

    miss = found.cam_from_world * truth.cam_from_world.inv()
    assert miss.rotation.magnitude() < 1e-10
    np.testing.assert_allclose(found.position_world, truth.position_world, atol=1e-10)
    assert found.camera.port_distance_m == pytest.approx(truth.camera.port_distance_m, abs=1e-10)
    np.testing.assert_allclose(found.camera.normal, truth.camera.normal, atol=1e-10)
    assert found.camera.glass_thickness_m == truth.glass_thickness_m
    assert found.reference_rms_px < 1e-8


def test_the_port_is_where_the_interface_is() -> None:
    camera = TRUE.cameras[1]
    middle = camera.plane.point_world

    in_camera = camera.cam_from_world.apply(middle)

    along = float(in_camera @ np.asarray(camera.camera.normal))
    assert along == pytest.approx(camera.camera.port_distance_m, abs=1e-12)
    assert camera.camera.port_distance_m == pytest.approx(0.186, abs=0.01)


def test_more_points_than_corners_serve() -> None:
    truth = TRUE.cameras[0]
    grid = np.array([[x, y, 0.0] for x in (0.0, 0.1, 0.4) for y in (0.0, 0.1, 0.21)])
    noise = np.random.default_rng(1).normal(0.0, 0.5, (9, 2))
    pixels = LENS.project(truth.cam_from_world.apply(grid)) + noise

    found = placed(truth, replace(truth.reference, pixels=pixels, points_world=grid))

    assert 0.2 < found.reference_rms_px < 1.0
    assert np.linalg.norm(found.position_world - truth.position_world) < 1e-3


def test_slopes_agree_with_differences() -> None:
    for camera in TRUE.cameras:
        points = points_in_tank(np.random.default_rng(2), 6)
        by_point, by_motion, by_parameter = camera.slopes(points)

        def seen(moved: FixedCamera, points: Array) -> Array:
            return moved.camera.project(moved.cam_from_world.apply(points))

        for axis in range(6):
            step = np.zeros(6)
            step[axis] = 1e-6
            change = seen(camera.moved(step), points) - seen(camera.moved(-step), points)
            np.testing.assert_allclose(by_motion[..., axis], change / 2e-6, atol=2e-4, rtol=1e-6)
        for axis in range(3):
            shift = np.zeros(3)
            shift[axis] = 1e-6
            change = seen(camera, points + shift) - seen(camera, points - shift)
            np.testing.assert_allclose(by_point[..., axis], change / 2e-6, atol=2e-4, rtol=1e-6)
        assert by_parameter.shape == (6, 2, 22)


def test_reference_slopes_agree_with_differences() -> None:
    camera = TRUE.cameras[1]
    by_motion, _ = camera.reference_slopes()
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 1e-6
        ahead, behind = camera.moved(step), camera.moved(-step)
        change = (ahead.reference_residuals_px - behind.reference_residuals_px).ravel() / 2e-6
        np.testing.assert_allclose(by_motion[:, axis], change, atol=2e-4, rtol=1e-6)


def test_interfaces_of_one_tank_fit() -> None:
    check_sides(TRUE.cameras)


def test_a_mirrored_world_is_refused() -> None:
    first, second = TRUE.cameras
    mirrored = first.reference.points_world * np.array([1.0, -1.0, 1.0]) + [0.0, 0.21, 0.0]
    flipped = placed(first, replace(first.reference, points_world=mirrored))
    assert flipped.position_world[2] > 0  # the pose of a mirrored plane is below the water

    with pytest.raises(CalibrationError, match="mirrored or corners are swapped"):
        check_sides([flipped, second])


def _with_points(change: Array) -> Reference:
    reference = TRUE.cameras[0].reference
    return replace(reference, points_world=reference.points_world + change, source="cam1.json")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (np.array([[0, 0, 0.03], [0, 0, 0], [0, 0, 0], [0, 0, 0.0]]), "7.5 mm off one plane"),
        (
            -TRUE.cameras[0].reference.points_world * np.array([0.0, 0.999, 0.0]),
            "lie on one line",
        ),
    ],
)
def test_points_that_span_no_plane_are_refused(change: Array, says: str) -> None:
    with pytest.raises(CalibrationError, match=says) as error:
        plane_through(_with_points(change))
    assert str(error.value).startswith("cam1.json: ")


def test_corners_in_the_wrong_order_are_refused() -> None:
    reference = TRUE.cameras[0].reference
    swapped = replace(reference, pixels=reference.pixels[[1, 0, 2, 3]])

    with pytest.raises(CalibrationError, match="check their order"):
        placed(TRUE.cameras[0], swapped)


def test_pixels_beyond_the_lens_are_refused() -> None:
    reference = TRUE.cameras[0].reference
    folding = replace(LENS, k1=-0.5, k2=0.0)

    with pytest.raises(CalibrationError, match=r"no ray for [1-4] of the reference pixels"):
        place_camera(folding, reference, n_water=1.333)


@pytest.mark.parametrize(
    ("pixels", "points", "says"),
    [
        (np.zeros((3, 2)), np.zeros((3, 3)), "3 reference points; at least 4"),
        (np.full((4, 2), np.nan), np.zeros((4, 3)), "not a number"),
        (np.zeros((4, 2)), np.zeros((5, 3)), r"\(5, 3\)"),
    ],
)
def test_bad_references_are_refused(pixels: Array, points: Array, says: str) -> None:
    with pytest.raises(CalibrationError, match=says):
        Reference(camera="cam1", pixels=pixels, points_world=points)


def test_a_camera_that_looks_away_is_refused() -> None:
    camera = TRUE.cameras[0]
    turned = replace(
        camera,
        cam_from_world=looking(
            camera.position_world, camera.position_world - [0.0, 0.0, 1.0], np.array([1.0, 0, 0])
        ),
    )
    with pytest.raises(CalibrationError, match="180 deg off the interface's normal"):
        _ = turned.camera


def test_two_poses_that_explain_a_far_plane_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    camera = TRUE.cameras[0]
    far = looking(np.array([0.2, 0.1, -8.0]), np.array([0.2, 0.1, 0.0]), np.array([1.0, 0.1, 0.0]))
    tilt = Rotation.from_rotvec([0.3, 0.0, 0.0])
    middle = np.array([0.2, 0.1, 0.0])
    points = tilt.apply(camera.reference.points_world - middle) + middle
    noise = np.random.default_rng(3).normal(0.0, 1.0, (4, 2))
    reference = replace(
        camera.reference, pixels=LENS.project(far.apply(points)) + noise, points_world=points
    )

    place_camera(LENS, reference, n_water=1.333)

    told = capsys.readouterr().err
    assert "two poses" in told and told.count("\n") == 1
    placed(camera)
    assert capsys.readouterr().err == ""
