"""How calibration and navigation of a planned survey are expected to err.

The calibration is that of the workspace, or a usual one; navigation has the survey's instruments.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.block_solver import inverse_of
from alice_survey.core.config import (
    CameraConfig,
    ImagingConfig,
    NavigationConfig,
    ReconstructConfig,
    WaterConfig,
)
from alice_survey.sim.seafloor.board import PoolBoard, pool_poses
from alice_survey.sim.vehicle.navigation.sensors import CompassSpec, PressureSpec
from camera_calib.freedom import USUAL_LENS, knowing_water, of_lenses, of_ports, pose_names
from camera_calib.rig import Covariance, Rig, design_rig
from missions.fly.check import rig_of
from reconstruct.adjustment.exact_observations import Pixels, RigState, exact_observations
from reconstruct.mapping.arrays import cross_matrices
from reconstruct.placing.correlated_fit import MIN_WHITE, Correlation
from reconstruct.placing.navigation import USUAL_INSTALLATION, Installation

CORNER_PX = 0.01
"""Sigma of a corner's coordinate in a calibration that is yet to be made; rendered pools of the
demo and of Caesarea show 0.008 and 0.012 px."""
# Of ten simulated flights of Caesarea, log minus truth at the stations: rms of the mean and of the
# differences over 4 s to 1500 s.
_DEPTH_SLOW_M, _DEPTH_SLOW_S, _DEPTH_WHITE_M = 0.011, 190.0, 0.0015
_LEVEL_SLOW_M, _LEVEL_SLOW_S, _LEVEL_WHITE_M = 0.05, 60.0, 0.002
_TILT_DEG, _TILT_WHITE_DEG = 0.008, 0.0135
_HEADING_WHITE_DEG = 0.025
_TURN_SHARE = 1.0
"""Positions between fixes turn with the heading."""
_STRETCH = 0.002


def expected_rig(
    workspace: Path, camera: CameraConfig, water: WaterConfig, imaging: ImagingConfig
) -> Rig:
    """The rig of the workspace's calibration, else the designed one with a usual covariance.

    Its water's index is known as well as that of a reconstruction.
    """
    rig = rig_of(workspace, camera, water)
    if rig.covariance is None:
        rig = usual_rig(camera, water, imaging)
    return knowing_water(rig, water.index_sigma)


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


@dataclass(frozen=True, kw_only=True)
class ChannelErrors:
    """Sigmas of three independent errors of a channel, metres or radians."""

    constant: float
    slow: float
    slow_s: float
    """Correlation time of the slow one."""
    white: float
    by_dive: bool = False
    """Whether every dive has errors of its own, as after a fix at the surface."""

    @property
    def sigma(self) -> float:
        """Of their sum."""
        return math.hypot(self.constant, self.slow, self.white)

    @property
    def correlation(self) -> Correlation:
        """The same as the placing has it."""
        varying = math.hypot(self.slow, self.white)
        return Correlation(
            tau=self.slow_s,
            white=max((self.white / varying) ** 2, MIN_WHITE),
            constant=(self.constant / self.sigma) ** 2,
            restart=float(self.by_dive),
        )

    def times(self, factor: float) -> "ChannelErrors":
        """All of it so many times as large."""
        return replace(
            self,
            constant=factor * self.constant,
            slow=factor * self.slow,
            white=factor * self.white,
        )


@dataclass(frozen=True, kw_only=True)
class NavigationErrors:
    """Errors by group of channels (see `navigation_equations.GROUPS`)."""

    channels: Mapping[str, ChannelErrors]
    turn_rad: float
    """Of the frame of horizontal positions."""
    stretch: float
    installed: Installation = USUAL_INSTALLATION

    @classmethod
    def of(cls, settings: NavigationConfig, placing: ReconstructConfig) -> "NavigationErrors":
        """Of the survey's instruments, as the filter of the simulated vehicle leaves them."""
        pressure, compass = PressureSpec(), CompassSpec()
        bias_rad = math.radians(settings.compass_bias_deg)
        return cls(
            channels={
                "horizontal": ChannelErrors(
                    constant=max(settings.gps_bias_m, 1e-3), slow=_LEVEL_SLOW_M,
                    slow_s=_LEVEL_SLOW_S, white=_LEVEL_WHITE_M, by_dive=True,
                ),
                "depth": ChannelErrors(
                    constant=pressure.bias_sigma_m, slow=_DEPTH_SLOW_M, slow_s=_DEPTH_SLOW_S,
                    white=_DEPTH_WHITE_M,
                ),
                "tilt": ChannelErrors(
                    constant=math.radians(_TILT_DEG), slow=0.0, slow_s=1.0,
                    white=math.radians(_TILT_WHITE_DEG),
                ),
                "heading": ChannelErrors(
                    constant=0.0, slow=max(bias_rad, 1e-6), slow_s=compass.bias_correlation_s,
                    white=math.radians(_HEADING_WHITE_DEG),
                ),
            },
            turn_rad=_TURN_SHARE * max(bias_rad, 1e-6),
            stretch=_STRETCH,
            installed=Installation.of(placing),
        )  # fmt: skip

    def times(self, factor: float) -> "NavigationErrors":
        """All of it so many times as large."""
        return replace(
            self,
            channels={name: errors.times(factor) for name, errors in self.channels.items()},
            turn_rad=factor * self.turn_rad,
            stretch=factor * self.stretch,
        )
