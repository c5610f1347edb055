"""A plan played back: where the vehicle would be, and when, if it were flown exactly."""

import math
from dataclasses import dataclass

import numpy as np

from alice_survey.core.frames import Array
from missions.areas.bathymetry import Bathymetry
from missions.plan.run import station_times_s
from missions.values.costs import Costs, leg_costs
from missions.values.plan_file import Dive, Plan

_TURN_RAD = 0.2
"""Angle of an arc from place to place."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Playback:
    """Moments of all dives, one after the other."""

    time_s: Array
    """(T,) seconds from the start of the first dive; a dive begins when the one before is up."""
    glass_ne: Array
    """(T, 2) the left port's glass."""
    depth_m: Array
    """(T,) of the glass."""
    altitude_m: Array
    """(T,) of the glass above the floor."""
    heading_rad: Array
    """(T,) of the vehicle, without jumps within a dive."""
    pictures_s: Array
    """(S,) when pictures are taken."""


def play(plan: Plan, costs: Costs, bathymetry: Bathymetry | None) -> Playback:
    """Play a plan back.

    Args:
        plan: it.
        costs: of the vehicle, by which legs take their time.
        bathymetry: of the sea floor; None: it is level.
    """
    times, places, headings, depths, floors, pictures = [], [], [], [], [], []
    begin_s = 0.0
    for dive in plan.dives:
        time_s, along_m, heading_rad = _dive(dive, costs)
        glass_m, floor_m = depths_along(plan, dive, along_m, bathymetry)
        times.append(begin_s + time_s)
        places.append(dive.route.places(along_m))
        headings.append(heading_rad)
        depths.append(glass_m)
        floors.append(floor_m)
        pictures.append(begin_s + np.array(station_times_s(plan, dive, costs)))
        begin_s += dive.duration_s
    return Playback(
        time_s=np.concatenate(times),
        glass_ne=np.vstack(places),
        depth_m=np.concatenate(depths),
        altitude_m=np.concatenate(floors) - np.concatenate(depths),
        heading_rad=np.concatenate(headings),
        pictures_s=np.concatenate(pictures),
    )


def depths_along(
    plan: Plan, dive: Dive, along_m: Array, bathymetry: Bathymetry | None
) -> tuple[Array, Array]:
    """Depths of the glass and of the floor, (N,) both, at distances (N,) along a dive's way.

    Between lines the vehicle goes evenly from the depth of one to that of the next.
    """
    floor = np.full(len(along_m), plan.seafloor_depth_m)
    if bathymetry is not None:
        floor = bathymetry.depth_at(dive.route.places(along_m))
    if not plan.line_depths_m:
        return np.full(len(along_m), plan.seafloor_depth_m - plan.altitude_m), floor
    at, depths = [], []
    for start_m, leg in zip(dive.route.starts_m, dive.route.legs, strict=False):
        if leg.line >= 0:
            row = plan.line_depths_m[leg.line]
            at.append(start_m + np.linspace(0.0, leg.length_m, len(row)))
            depths.append(np.array(row))
    return np.interp(along_m, np.concatenate(at), np.concatenate(depths)), floor


def _dive(dive: Dive, costs: Costs) -> tuple[Array, Array, Array]:
    """Times from the dive's start, distances along its way, headings."""
    _, took_s = leg_costs(dive.route, costs)
    starts_s = costs.settle_s + np.concatenate([[0.0], np.cumsum(took_s)])
    times, along, headings = [], [], []
    for i, leg in enumerate(dive.route.legs):
        turned = leg.curvature_per_m * leg.length_m
        share = np.linspace(0.0, 1.0, max(1, math.ceil(abs(turned) / _TURN_RAD)) + 1)
        times.append(starts_s[i] + share * took_s[i])
        along.append(dive.route.starts_m[i] + share * leg.length_m)
        headings.append(leg.heading_rad + leg.side_rad + share * (turned + leg.turn_rad))
    return np.concatenate(times), np.concatenate(along), np.unwrap(np.concatenate(headings))
