"""Which change of a plan buys how much precision for how many minutes of dive."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from alice_survey.base.config import PlanConfig, SurveyConfig
from alice_survey.base.errors import PlanError, collected_by
from camera_calib.rig import Rig, design_rig
from missions.plan.planner import plan_survey
from reconstruct.precision.planned import CONTROL_SIGMA_M, Candidate
from reconstruct.precision.predict import Precision

_MORE_CROSS_LINES = (1, 2, 4)
_MORE_OVERLAP = (0.1, 0.2)
_MOST_OVERLAP = 0.9


def as_planned(config: SurveyConfig, rig: Rig, changes: tuple[str, ...] = ()) -> Candidate:
    """The survey as set, or as changes in words have set it.

    Raises:
        PlanError: no plan meets the settings.
    """
    with collected_by(lambda *_: None):
        plan = plan_survey(config, design_rig(config.camera, config.water)).plan
    return Candidate(changes=changes, config=config, plan=plan, rig=rig)


def single_measures(base: Candidate) -> list[Candidate]:
    """Every measure by itself that can be planned, what brings most a minute first.

    Args:
        base: the survey as set.
    """
    wanted = [level for levels in _levels(base.config.plan) for level in levels]
    found = [one for level in wanted if (one := _changed(base, [level])) is not None]
    return sorted(found, key=lambda one: -gain_per_minute(base, one))


def with_control(base: Candidate) -> Candidate:
    """The same with control points, which cost no time of dive that a plan knows of."""
    change = f"4 control points of {1e3 * CONTROL_SIGMA_M:g} mm at the corners"
    return Candidate(
        changes=(*base.changes, change),
        config=base.config,
        plan=base.plan,
        rig=base.rig,
        with_control=True,
    )


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
        and (one := _changed(base, levels)) is not None
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
        if (own := getattr(plan, setting)) + more <= _MOST_OVERLAP
    ]


def _changed(base: Candidate, levels: Sequence[_PlanChange]) -> Candidate | None:
    """The survey planned with some measures; None where no plan meets them."""
    update = {level.setting: level.value for level in levels}
    plan = base.config.plan.model_copy(update=update)
    config = base.config.model_copy(update={"plan": plan})
    try:
        return as_planned(config, base.rig, tuple(level.change for level in levels))
    except PlanError:
        return None
