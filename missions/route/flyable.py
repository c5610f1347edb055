"""A plan as its vehicle can fly it: turns of one that fins steer, which cannot stop."""

import math

from alice_survey.core.config import PlanConfig, SurveyConfig
from alice_survey.core.errors import PlanError
from alice_survey.sim.vehicle.pilot.gains import STEADY_SHARE
from alice_survey.sim.vehicle.steady import fin_flight, min_radius_m
from alice_survey.sim.vehicle.vehicle import Vehicle
from missions.route.energy import planned_vehicle

_ROOM = 1.25
"""Radius of turns over the tightest that fins hold (inferred): room to come back to the path."""


def as_flown(config: SurveyConfig) -> SurveyConfig:
    """A survey whose turns its vehicle can fly; itself for a vehicle that can stop.

    Raises:
        PlanError: turns are set that it cannot fly.
    """
    plan = plan_as_flown(config.plan, planned_vehicle(config.vehicle))
    return config if plan is config.plan else config.model_copy(update={"plan": plan})


def without_stops(plan: PlanConfig, vehicle: Vehicle) -> PlanConfig:
    """Settings for laying routes: of a vehicle that fins steer, by arcs alone."""
    return plan.model_copy(update={"turns": "arcs"}) if vehicle.fins else plan


def plan_as_flown(plan: PlanConfig, vehicle: Vehicle) -> PlanConfig:
    """Settings with arcs that fins hold and run-ins as long as their radius.

    They are widened where `turns = "auto"`. At a speed at which it does not fly at all they are
    left: the speed is refused elsewhere.

    Raises:
        PlanError: turns are set that it cannot fly.
    """
    if not vehicle.fins:
        return plan
    if plan.turns not in ("auto", "arcs"):
        raise PlanError(
            f"{vehicle.name} is steered by fins and cannot stop: plan.turns = {plan.turns!r} "
            "cannot be flown; set 'arcs', or leave it out"
        )
    if fin_flight(vehicle, plan.speed_mps, 0.0, STEADY_SHARE) is None:
        return plan
    min_m = min_radius_m(vehicle, plan.speed_mps, STEADY_SHARE)
    if plan.turns == "auto":
        radius_m = max(plan.arc_radius_m, math.ceil(10.0 * _ROOM * min_m) / 10.0)
        run_in_m = max(plan.run_in_m, radius_m)
        return plan.model_copy(update={"turn_radius_m": radius_m, "run_in_m": run_in_m})
    if plan.turn_radius_m < min_m:
        raise PlanError(
            f"turn_radius_m {plan.turn_radius_m:g} is tighter than the {min_m:.2f} m that the "
            f"fins of {vehicle.name} hold at {plan.speed_mps:g} m/s: raise it, or "
            "set turns = 'auto'"
        )
    return plan
