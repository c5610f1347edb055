"""The block that a plan is expected to give."""

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.base.config import SurveyConfig
from alice_survey.base.frames import Array, rotation_from_attitude
from camera_calib.rig import Rig
from missions.coverage.stations import stations_of_plan
from missions.plan.planner import area_bathymetry
from missions.plan.run import station_times_s
from missions.plan.strength import survey_costs
from missions.values.plan_file import Plan
from reconstruct.precision.tracks import ExpectedBlock, TrackModel, expected_block, waves

_BETWEEN_DIVES_S = 3600.0
"""By then slow errors of navigation are new ones."""


def planned_block(
    plan: Plan,
    rig: Rig,
    config: SurveyConfig,
    *,
    tracks: TrackModel | None = None,
    drawn: float | None = None,
    seed: int = 0,
) -> ExpectedBlock:
    """The pictures of a plan flown exactly by a level vehicle.

    Args:
        plan: it.
        rig: its cameras.
        config: of the survey.
        tracks: of points; None as rendered surveys have them.
        drawn: see `expected_block`.
        seed: of the draw.

    Raises:
        PlanError: pictures do not show the sea floor, or share none of it.
    """
    bathymetry = area_bathymetry(config.area, plan.area, plan.altitude_m)
    ripple = waves(config.plan.relief_m, 2.0 * plan.altitude_m)

    def depth_at(places: Array) -> Array:
        mean: Array | float = plan.seafloor_depth_m
        if bathymetry is not None:
            found = bathymetry.depth_at(places)
            mean = np.where(np.isfinite(found), found, plan.seafloor_depth_m)
        return mean + ripple(places)

    return expected_block(
        rig, *stations_and_times(plan, rig, config), depth_at, tracks or TrackModel.of(config),
        drawn=drawn, seed=seed,
    )  # fmt: skip


def stations_and_times(plan: Plan, rig: Rig, config: SurveyConfig) -> tuple[RigidTransform, Array]:
    """Poses `ned_from_body` (S,) of a plan's stations in the order of flight, and their times."""
    stations = stations_of_plan(plan)
    costs, start_s = survey_costs(config, imaging_w=0.0), 0.0
    times: list[float] = []
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
