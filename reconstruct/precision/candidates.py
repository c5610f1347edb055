"""Plans, what they are expected to give, and which change buys how much for how many minutes."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.config import PlanConfig, SurveyConfig
from alice_survey.core.errors import PlanError, collected_by
from alice_survey.core.frames import Array, rotation_from_attitude
from camera_calib.rig import Rig, design_rig
from missions.coverage.stations import stations_of_plan
from missions.plan.planner import area_bathymetry, plan_survey
from missions.plan.run import station_times_s
from missions.plan.strength import survey_costs
from missions.values.costs import Costs
from missions.values.plan_file import Plan
from reconstruct.precision.instruments import NavigationErrors
from reconstruct.precision.predict import Precision, predict
from reconstruct.precision.tracks import ExpectedBlock, TrackModel, expected_block, waves

CONTROL_SIGMA_M = 0.01
"""Of each coordinate of a control point."""
BETWEEN_DIVES_S = 3600.0
"""By then slow errors of navigation are new ones."""
_MORE_CROSS_LINES = (1, 2, 4)
_MORE_OVERLAP = (0.1, 0.2)
_MAX_OVERLAP = 0.9


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """A survey as set, or with a change, its plan, and what that is predicted to give."""

    name: str = "as planned"
    """The change in words."""
    config: SurveyConfig
    rig: Rig
    made: Plan | None = None
    """The plan where there is one already."""
    with_control: bool = False
    """Whether four points at the corners of the area are surveyed."""

    @cached_property
    def plan(self) -> Plan:
        """The plan; PlanError where none meets the settings."""
        if self.made is not None:
            return self.made
        with collected_by(lambda *_: None):
            return plan_survey(self.config, design_rig(self.config.camera, self.config.water)).plan

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
            NavigationErrors.of(self.config.navigation, self.config.reconstruct),
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

        return expected_block(
            self.rig, *stations_and_times(plan, self.rig, survey_costs(config)), depth_at,
            tracks or TrackModel.of(config.reconstruct), drawn=drawn, seed=seed,
        )  # fmt: skip


def _corners(points: Array) -> list[int]:
    """The points farthest towards the corners."""
    level = points[:, :2] - points[:, :2].mean(axis=0)
    u, v = (level @ np.linalg.svd(level, full_matrices=False)[2].T).T
    return [int(np.argmax(a * u / np.ptp(u) + b * v / np.ptp(v))) for a in (-1, 1) for b in (-1, 1)]


def stations_and_times(plan: Plan, rig: Rig, costs: Costs) -> tuple[RigidTransform, Array]:
    """Poses `ned_from_body` (S,) of a plan's stations in the order of flight, and their times."""
    times, start_s = list[float](), 0.0
    for dive in plan.dives:
        times += [start_s + time_s for time_s in station_times_s(plan, dive, costs)]
        start_s = times[-1] + BETWEEN_DIVES_S
    stations = stations_of_plan(plan, np.full(len(times), plan.seafloor_depth_m))
    rotation = rotation_from_attitude(*stations.attitude_rad.T)
    front = rig.body_from_cam(rig.reference).apply(rig.cameras[rig.reference].front_cam)
    depth_m = plan.seafloor_depth_m - stations.altitude_m
    glass = np.column_stack([stations.glass_ne, depth_m])
    poses = RigidTransform.from_components(glass - rotation.apply(front), rotation)
    return poses, np.array(times)


def single_measures(base: Candidate) -> list[Candidate]:
    """Every measure that can be planned, what brings most a minute first.

    Args:
        base: the survey as set.
    """
    found = []
    for name, update in _measures(base.config.plan):
        plan = base.config.plan.model_copy(update=update)
        one = Candidate(
            name=name, config=base.config.model_copy(update={"plan": plan}), rig=base.rig
        )
        with suppress(PlanError):
            found.append(replace(one, made=one.plan))
    return sorted(found, key=lambda one: -gain_per_minute(base, one))


def _measures(plan: PlanConfig) -> Iterator[tuple[str, dict[str, Any]]]:
    """Changes of a plan, in words and as settings."""
    for count in _MORE_CROSS_LINES:
        added = {"cross_lines": plan.cross_lines + count}
        yield f"{count} more cross line{'s' * (count > 1)}", added
    if not plan.closing_line:
        yield "a closing line", {"closing_line": True}
    for word in ("forward", "side") if plan.line_spacing_m is None else ("forward",):
        for more in _MORE_OVERLAP:
            share = round(getattr(plan, f"{word}_overlap") + more, 3)
            if share <= _MAX_OVERLAP:
                yield f"{word} overlap {share:.0%}", {f"{word}_overlap": share}


def with_control(base: Candidate) -> Candidate:
    """The same with control points, which cost no time of dive that a plan knows of."""
    name = f"4 control points of {1e3 * CONTROL_SIGMA_M:g} mm at the corners"
    return replace(base, name=name, made=base.plan, with_control=True)


def gain_per_minute(base: Candidate, one: Candidate) -> float:
    """Metres of the bend that a measure takes away for a minute of dive; 0 of what takes none."""
    minutes = one.minutes - base.minutes
    gain = worst_bend(base.precision) - worst_bend(one.precision)
    return gain / minutes if minutes > 0 else 0.0


def worst_bend(found: Precision) -> float:
    """The larger sigma of the sag, metres."""
    return float(np.nanmax(found.bend_m))
