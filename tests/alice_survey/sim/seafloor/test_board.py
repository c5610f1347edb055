"""An independent check of the renderer: OpenCV finds corners where Fermat's principle puts them."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.config import SurveyConfig
from alice_survey.sim.seafloor.as_built import true_rig
from alice_survey.sim.seafloor.board import PoolBoard, render_board
from camera_calib.rig import Rig, design_rig
from tests.oracles_seafloor import fermat_pixels, fit_saddle

CONFIG = SurveyConfig.model_validate({"imaging": {"scale": 4}})


def built_rig(seed: int = CONFIG.seed) -> Rig:
    return true_rig(CONFIG.camera, CONFIG.water, scale=4, seed=seed)


EIGHTH = true_rig(CONFIG.camera, CONFIG.water, scale=8, seed=CONFIG.seed)


def find(picture: np.ndarray, board: PoolBoard) -> tuple[np.ndarray, np.ndarray]:
    """Corners in our pixels, by OpenCV and by a better fit.

    A blur, the same in all directions, gives edges a width to measure.
    """
    grey = cv2.GaussianBlur(picture[..., 1] / picture[..., 1].max(), (0, 0), 0.8).astype(np.float64)
    grey8 = (255 * grey).astype(np.uint8)
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(grey8, (board.columns, board.rows), flags=flags)
    assert found
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 200, 1e-5)
    corners = cv2.cornerSubPix(grey8, corners, (8, 8), (-1, -1), criteria)
    by_opencv = corners.reshape(-1, 2).astype(np.float64) + 0.5
    return by_opencv, np.array([fit_saddle(grey, corner, 7) for corner in by_opencv])


@pytest.mark.parametrize(
    ("name", "aim", "distance_m", "turn_deg"),
    [
        ("left", (0.5, 0.5), 0.8, (3.0, -4.0, 2.0)),
        pytest.param("right", (0.42, 0.55), 0.9, (25.0, 5.0, -8.0), marks=pytest.mark.slow),
        pytest.param("left", (0.35, 0.4), 1.1, (-10.0, 28.0, 12.0), marks=pytest.mark.slow),
        pytest.param("right", (0.7, 0.65), 1.3, (12.0, -15.0, 30.0), marks=pytest.mark.slow),
    ],
)
def test_corners_are_where_fermat_puts_them(
    name: str, aim: tuple[float, float], distance_m: float, turn_deg: tuple[float, ...]
) -> None:
    board, camera = PoolBoard(columns=7, rows=5, square_m=0.06), EIGHTH.cameras[name]
    turn = Rotation.from_rotvec(np.deg2rad(turn_deg))
    aim_px = np.array(aim) * [camera.width_px, camera.height_px]
    # Where the board is does not matter to the test; about there is enough.
    slope = (aim_px - [camera.cx_px, camera.cy_px]) / (1.34 * camera.fx_px)
    centre = turn.apply(board.outline.mean(axis=0))
    pose = RigidTransform.from_components(np.append(slope, 1.0) * distance_m - centre, turn)
    truth = fermat_pixels(camera.to_json(), pose.apply(board.corners))

    by_opencv, by_fit = find(render_board(board, camera, pose, 12), board)

    if np.abs(by_fit - truth).max() > 10.0:
        by_opencv, by_fit = by_opencv[::-1], by_fit[::-1]
    assert np.linalg.norm(by_fit - truth, axis=1).max() < 0.03
    assert _rms(by_fit - truth) < 0.014
    assert _rms(by_opencv - truth) < 0.05
    assert np.linalg.norm(by_opencv - truth, axis=1).max() < 0.12
    assert np.all(np.abs((by_fit - truth).mean(axis=0)) < 0.006)  # half a pixel would be 0.5


def _rms(misses: np.ndarray) -> float:
    return float(np.sqrt((misses**2).sum(axis=1).mean()))


def test_fermats_twin_magnifies_by_the_index_of_water() -> None:
    """Small angles, no port: focal length n f (Snell), to third order."""
    camera = design_rig(CONFIG.camera, CONFIG.water, 4).cameras["left"].to_json()
    camera |= {"port_distance_m": 1e-6, "glass_thickness_m": 1e-9}
    point = np.array([[0.002, -0.001, 2.0]])
    pixel = fermat_pixels(camera, point)[0] - [camera["cx_px"], camera["cy_px"]]
    np.testing.assert_allclose(pixel, 1.34 * camera["fx_px"] * point[0, :2] / 2.0, rtol=2e-5)


def test_the_rig_as_built_is_near_its_drawing_but_not_on_it() -> None:
    drawn, built = design_rig(CONFIG.camera, CONFIG.water, 4), built_rig()
    again, other = built_rig(), built_rig(9)
    assert again.cameras == built.cameras
    assert other.cameras != built.cameras
    for name, camera in built.cameras.items():
        design = drawn.cameras[name]
        assert 0.0 < abs(camera.fx_px / design.fx_px - 1.0) < 0.0031
        assert 0.0 < abs(camera.cx_px - design.cx_px) <= 2.6  # 10 px at full resolution
        built_m, drawn_m = (one.parameter("port_distance_m") for one in (camera, design))
        assert 0.0 < abs(built_m - drawn_m) < 0.00101
        tilt = np.arccos(camera.port.axis_cam[2])
        assert 0.0 < np.rad2deg(tilt) < 0.43  # 0.3 degrees about each axis
        assert -0.06 < camera.parameter("k1") < -0.04
    turn = built.cam_from_rig["right"].rotation.magnitude()
    assert 0.0 < np.rad2deg(turn) < 0.53  # 0.3 degrees about each axis
    assert 0.0 < abs(built.baseline_m - drawn.baseline_m) < 0.0003
