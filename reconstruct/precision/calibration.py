"""The calibration that a survey is expected to have: that of its workspace, or a usual one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.base.block_solver import inverse_of
from alice_survey.base.config import CameraConfig, ImagingConfig, WaterConfig
from alice_survey.seafloor.board import PoolBoard, pool_poses
from camera_calib.freedom import USUAL_LENS, of_lenses, of_ports, pose_names
from camera_calib.rig import Covariance, Rig, design_rig
from missions.fly.check import rig_of
from reconstruct.adjustment.exact_observations import Pixels, RigState, exact_observations
from reconstruct.mapping.arrays import cross_matrices

CORNER_PX = 0.01
"""Sigma of a corner's coordinate in a calibration that is yet to be made; rendered pools of the
demo and of Caesarea show 0.008 and 0.012 px."""


def expected_rig(
    workspace: Path, camera: CameraConfig, water: WaterConfig, imaging: ImagingConfig
) -> Rig:
    """The rig of the workspace's calibration, else the designed one with a usual covariance."""
    rig = rig_of(workspace, camera, water)
    return usual_rig(camera, water, imaging) if rig.covariance is None else rig


def usual_rig(camera: CameraConfig, water: WaterConfig, imaging: ImagingConfig) -> Rig:
    """The designed rig with the covariance that views of a board in a pool would leave.

    As many views as `imaging.pool_views` of the simulated pool's board, through the ports, the
    lens free (Cramer-Rao bound).
    """
    rig = design_rig(camera, water, imaging.scale)
    board, rng = PoolBoard(), np.random.default_rng(0)
    views = pool_poses(board, rig, imaging.pool_views, rng)
    names = (*of_lenses(rig, USUAL_LENS[camera.lens]), *of_ports(rig), *pose_names(rig))
    names = tuple(name for name in names if not name.endswith(".n_water"))
    linear = exact_observations(*_board_seen(rig, board, views), names)
    size = len(board.corners) * len(rig.cameras)
    shared = linear.rest[..., :-1].reshape(len(views), 2 * size, -1) / CORNER_PX
    by_pose = np.concatenate([linear.by_point @ cross_matrices(linear.arm), -linear.by_point], 2)
    by_pose = by_pose.reshape(len(views), 2 * size, 6) / CORNER_PX
    information = np.zeros((len(names), len(names)))
    for own, pose in zip(shared, by_pose, strict=True):
        across = own.T @ pose
        information += own.T @ own - across @ np.linalg.solve(pose.T @ pose, across.T)
    matrix = inverse_of(information)
    return replace(
        rig,
        covariance=Covariance(parameters=names, matrix=matrix),
        source=f"design; covariance of {len(views)} views of a board, corners at {CORNER_PX:g} px",
    )


def _board_seen(rig: Rig, board: PoolBoard, views: list[RigidTransform]) -> tuple[RigState, Pixels]:
    """Views of the board as stations about it, every corner in every picture."""
    cameras, corners = len(rig.cameras), board.corners
    board_from_rig = RigidTransform.concatenate(views).inv()
    each = np.tile(np.arange(len(corners)), cameras * len(views))
    camera = np.tile(np.repeat(np.arange(cameras), len(corners)), len(views))
    pixels = Pixels(
        starts=np.zeros(1, np.int64),
        station=np.repeat(np.arange(len(views)), cameras * len(corners)),
        camera=camera,
        taken=np.zeros((len(each), 2)),
        point=each,
    )
    state = RigState(
        rig=rig, turns=board_from_rig.rotation.as_matrix(), centres=board_from_rig.translation,
        points=corners,
    )  # fmt: skip
    return state, pixels
