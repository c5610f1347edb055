"""Plans, what they are expected to give, and which change buys how much for how many minutes."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.config import PlanConfig, SurveyConfig
from alice_survey.core.errors import PlanError, collected_by
from alice_survey.core.frames import Array, rotation_from_attitude
from camera_calib.rig import Rig, design_rig
from missions.coverage.stations import Stations, stations_of_plan
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
    """A survey as set, or with changes, its plan, and what that is predicted to give."""

    changes: tuple[str, ...] = ()
    """In words; empty of the plan as set."""
    config: SurveyConfig
    rig: Rig
    made: Plan | None = None
    """The plan where there is one already."""
    with_control: bool = False
    """Whether four points at the corners of the area are surveyed."""

    @property
    def name(self) -> str:
        """In words."""
        return " and ".join(self.changes) or "as planned"

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
        flown = stations_and_times(self.plan, self.rig, survey_costs(self.config))
        return self.block_at(*flown, tracks, drawn=drawn, seed=seed)

    def block_at(
        self,
        ned_from_body: RigidTransform,
        time_s: Array,
        tracks: TrackModel | None = None,
        *,
        drawn: float | None = None,
        seed: int = 0,
    ) -> ExpectedBlock:
        """The pictures of other stations over the same sea floor, as `block`.

        Args:
            ned_from_body: (S,) stations.
            time_s: (S,) their times.
            tracks: as of `block`.
            drawn: as of `block`.
            seed: as of `block`.
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
            self.rig, ned_from_body, time_s, depth_at, tracks or TrackModel.of(config.reconstruct),
            drawn=drawn, seed=seed,
        )  # fmt: skip


def _corners(points: Array) -> list[int]:
    """The points farthest towards the corners."""
    level = points[:, :2] - points[:, :2].mean(axis=0)
    u, v = (level @ np.linalg.svd(level, full_matrices=False)[2].T).T
    return [int(np.argmax(a * u / np.ptp(u) + b * v / np.ptp(v))) for a in (-1, 1) for b in (-1, 1)]


def stations_and_times(
    plan: Plan, rig: Rig, costs: Costs, start_s: float = 0.0
) -> tuple[RigidTransform, Array]:
    """Poses `ned_from_body` (S,) of a plan's stations in the order of flight, and their times."""
    times = list[float]()
    for dive in plan.dives:
        mine = [start_s + time_s for time_s in station_times_s(plan, dive, costs)]
        times += mine
        start_s = mine[-1] + BETWEEN_DIVES_S
    stations = stations_of_plan(plan, np.full(len(times), plan.seafloor_depth_m))
    return ned_from_stations(stations, plan, rig), np.array(times)


def ned_from_stations(stations: Stations, plan: Plan, rig: Rig) -> RigidTransform:
    """Poses of the vehicle (S,) at stations over a plan's mean sea floor."""
    rotation = rotation_from_attitude(*stations.attitude_rad.T)
    front = rig.body_from_cam(rig.reference).apply(rig.cameras[rig.reference].front_cam)
    depth_m = plan.seafloor_depth_m - stations.altitude_m
    glass = np.column_stack([stations.glass_ne, depth_m])
    return RigidTransform.from_components(glass - rotation.apply(front), rotation)


def single_measures(base: Candidate) -> list[Candidate]:
    """Every measure by itself that can be planned, what brings most a minute first.

    Args:
        base: the survey as set.
    """
    requested = [level for levels in _levels(base.config.plan) for level in levels]
    found = [one for level in requested if (one := _change(base, [level])) is not None]
    return sorted(found, key=lambda one: -gain_per_minute(base, one))


def with_control(base: Candidate) -> Candidate:
    """The same with control points, which cost no time of dive that a plan knows of."""
    change = f"4 control points of {1e3 * CONTROL_SIGMA_M:g} mm at the corners"
    return replace(base, changes=(*base.changes, change), made=base.plan, with_control=True)


def gain_per_minute(base: Candidate, one: Candidate) -> float:
    """Metres of the bend that a measure takes away for a minute of dive; 0 of what takes none."""
    minutes = one.minutes - base.minutes
    gain = worst_bend(base.precision) - worst_bend(one.precision)
    return gain / minutes if minutes > 0 else 0.0


def worst_bend(found: Precision) -> float:
    """The larger sigma of the sag, metres."""
    return float(np.nanmax(found.bend_m))


def sets_of_measures(base: Candidate) -> Iterator[Candidate]:
    """None, then all sets of measures that can be planned, the shortest dives first."""
    yield base
    kinds = [[None, *levels] for levels in _levels(base.config.plan)]
    made = [
        one
        for chosen in itertools.product(*kinds)
        if (levels := [level for level in chosen if level is not None])
        and (one := _change(base, levels)) is not None
    ]
    yield from sorted(made, key=lambda one: one.minutes)


def cheapest(base: Candidate, bend_m: float) -> Candidate:
    """The shortest dive that is predicted to reach a sigma of the bend.

    Raises:
        PlanError: none does; the message says how near they come.
    """
    nearest = base
    for one in sets_of_measures(base):
        if worst_bend(one.precision) <= bend_m:
            return one
        nearest = min(nearest, one, key=lambda each: worst_bend(each.precision))
    held = with_control(nearest)
    raise PlanError(
        f"no lines reach a bend of {1e3 * bend_m:g} mm: {nearest.name} comes to "
        f"{1e3 * worst_bend(nearest.precision):.2g} mm in {nearest.minutes:.0f} min, "
        f"with {held.changes[-1]} {1e3 * worst_bend(held.precision):.2g} mm; ask for that, or "
        "improve the depth, attitude or calibration that 'plan precision' says dominates"
    )


@dataclass(frozen=True)
class _PlanChange:
    change: str
    setting: str
    value: float | bool


def _levels(plan: PlanConfig) -> Iterator[Sequence[_PlanChange]]:
    """Kinds of measures, of each of which a set has at most one."""
    lines = plan.cross_lines
    yield [
        _PlanChange(f"{more} more cross line{'s' * (more > 1)}", "cross_lines", lines + more)
        for more in _MORE_CROSS_LINES
    ]
    if not plan.closing_line:
        yield [_PlanChange("a closing line", "closing_line", True)]
    overlaps = {"forward_overlap": "forward"}
    if plan.line_spacing_m is None:
        overlaps["side_overlap"] = "side"
    yield [
        _PlanChange(f"{word} overlap {own + more:.0%}", setting, round(own + more, 3))
        for setting, word in overlaps.items()
        for more in _MORE_OVERLAP
        if (own := getattr(plan, setting)) + more <= _MAX_OVERLAP
    ]


def _change(base: Candidate, levels: Sequence[_PlanChange]) -> Candidate | None:
    """The survey planned with some measures; None where no plan meets them."""
    update = {level.setting: level.value for level in levels}
    plan = base.config.plan.model_copy(update=update)
    config = base.config.model_copy(update={"plan": plan})
    one = Candidate(changes=tuple(each.change for each in levels), config=config, rig=base.rig)
    try:
        return replace(one, made=one.plan)
    except PlanError:
        return None
