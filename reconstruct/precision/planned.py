"""A plan and what it is expected to give."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.base.config import SurveyConfig
from alice_survey.base.frames import Array, rotation_from_attitude
from camera_calib.rig import Rig
from missions.coverage.stations import stations_of_plan
from missions.plan.planner import area_bathymetry
from missions.plan.run import station_times_s
from missions.plan.strength import survey_costs
from missions.values.costs import Costs
from missions.values.plan_file import Plan
from reconstruct.precision.navigation import NavigationErrors
from reconstruct.precision.predict import Precision, predict
from reconstruct.precision.tracks import ExpectedBlock, TrackModel, expected_block, waves

CONTROL_SIGMA_M = 0.01
"""Of each coordinate of a control point."""
_BETWEEN_DIVES_S = 3600.0
"""By then slow errors of navigation are new ones."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """A plan that was made, perhaps with changes, and what it is predicted to give."""

    changes: tuple[str, ...] = ()
    """In words; empty of the plan as set."""
    config: SurveyConfig
    plan: Plan
    rig: Rig
    with_control: bool = False
    """Whether four points at the corners of the area are surveyed."""

    @property
    def name(self) -> str:
        """In words."""
        return " and ".join(self.changes) or "as planned"

    @property
    def minutes(self) -> float:
        """Of all dives."""
        return self.plan.duration_s / 60.0

    @cached_property
    def precision(self) -> Precision:
        """Predicted."""
        block = self.block()
        points = block.state.points
        return predict(
            block,
            NavigationErrors.of(self.config.navigation),
            control=points[_corners(points)] if self.with_control else None,
            control_sigma_m=CONTROL_SIGMA_M,
        )

    def block(
        self, tracks: TrackModel | None = None, *, drawn: float | None = None, seed: int = 0
    ) -> ExpectedBlock:
        """The pictures of the plan flown exactly by a level vehicle.

        Args:
            tracks: of points; None as rendered surveys have them.
            drawn: see `expected_block`.
            seed: of the draw.

        Raises:
            PlanError: pictures do not show the sea floor, or share none of it.
        """
        config, plan = self.config, self.plan
        bathymetry = area_bathymetry(config.area, plan.area, plan.altitude_m)
        ripple = waves(config.plan.relief_m, 2.0 * plan.altitude_m)

        def depth_at(places: Array) -> Array:
            mean: Array | float = plan.seafloor_depth_m
            if bathymetry is not None:
                found = bathymetry.depth_at(places)
                mean = np.where(np.isfinite(found), found, plan.seafloor_depth_m)
            return mean + ripple(places)

        poses, time_s = stations_and_times(plan, self.rig, survey_costs(config))
        return expected_block(
            self.rig, poses, time_s, depth_at, tracks or TrackModel.of(config.reconstruct),
            drawn=drawn, seed=seed,
        )  # fmt: skip


def _corners(points: Array) -> list[int]:
    """The points farthest towards the corners."""
    level = points[:, :2] - points[:, :2].mean(axis=0)
    u, v = (level @ np.linalg.svd(level, full_matrices=False)[2].T).T
    return [int(np.argmax(a * u / np.ptp(u) + b * v / np.ptp(v))) for a in (-1, 1) for b in (-1, 1)]


def stations_and_times(plan: Plan, rig: Rig, costs: Costs) -> tuple[RigidTransform, Array]:
    """Poses `ned_from_body` (S,) of a plan's stations in the order of flight, and their times."""
    stations = stations_of_plan(plan)
    start_s, times = 0.0, list[float]()
    for dive in plan.dives:
        mine = [start_s + time_s for time_s in station_times_s(plan, dive, costs)]
        times += mine
        start_s = mine[-1] + _BETWEEN_DIVES_S
    rotation = rotation_from_attitude(*stations.attitude_rad.T)
    front = rig.body_from_cam(rig.reference).apply(rig.cameras[rig.reference].front_cam)
    depth_m = plan.seafloor_depth_m - stations.altitude_m
    if plan.line_depths_m:
        depth_m = np.concatenate([np.asarray(row) for row in plan.line_depths_m])
    glass = np.column_stack([stations.glass_ne, depth_m])
    return RigidTransform.from_components(glass - rotation.apply(front), rotation), np.array(times)
