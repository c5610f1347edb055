"""How an autopilot will follow a plan: its parameters, its tolerances, and how far it will be off.

COLA2 steers by line of sight without an integral and without sway (alice_survey.vehicle.pilot.
cola2): a current across a section holds it off by `delta` times the sine of the drift angle, in
closed form, and the shortest `delta` is bounded by how quickly the vehicle turns. ArduSub holds on
to its track by sway with an integral: no steady current holds it off that the vehicle can stem.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from alice_survey.base.config import SeaConfig, VehicleConfig
from alice_survey.base.frames import Array
from alice_survey.vehicle.pilot.cola2 import steady_drift
from alice_survey.vehicle.pilot.gains import FASTEST, SWAY, YAW, Gains, gains_for
from alice_survey.vehicle.pilot.settings import shortest_look_ahead_m
from missions.coverage.stations import Stations, stations_of_plan
from missions.route.energy import craft_of
from missions.values.line import Line
from missions.values.plan_file import Plan

_TURN_SHARE = 0.5
"""Share of the greatest yaw rate that following a point needs to keep the vehicle on it: the rest
is for the lag of the loop (inferred)."""


@dataclass(frozen=True, kw_only=True)
class Follower:
    """A vehicle as an autopilot flies it, and the current that is expected."""

    name: str
    sways: bool
    """Whether it has thrusters that push it sideways."""
    delta_m: float
    """COLA2's look-ahead: the shortest that is damped well at the plan's speed."""
    turn_rad_s: float
    """Greatest yaw rate."""
    current_ne_mps: tuple[float, float]
    """The expected current, towards north and east."""

    def across_mps(self, heading_rad: float) -> float:
        """Current across a course, positive to starboard."""
        north, east = self.current_ne_mps
        return east * math.cos(heading_rad) - north * math.sin(heading_rad)

    @property
    def current_mps(self) -> float:
        """Speed of the current."""
        return math.hypot(*self.current_ne_mps)


def follower_of(vehicle: VehicleConfig, sea: SeaConfig, speed_mps: float) -> Follower:
    """The follower of a survey's settings.

    Args:
        vehicle: that is to fly the plan.
        sea: its current near the sea floor is the expected one.
        speed_mps: of the plan.

    Raises:
        VehicleError: no vehicle that is controllable is described.
    """
    craft = craft_of(vehicle)
    gains = gains_for(craft, speed_mps)
    towards = math.radians(sea.current_towards_deg)
    return Follower(
        name=craft.name,
        sways=sways(gains),
        delta_m=cola2_delta_m(gains, speed_mps),
        turn_rad_s=float(gains.axes[YAW, FASTEST]),
        current_ne_mps=(
            sea.current_mps * math.cos(towards),
            sea.current_mps * math.sin(towards),
        ),
    )


def sways(gains: Gains) -> bool:
    """Whether a vehicle can be pushed sideways."""
    return bool(gains.axes[SWAY, FASTEST] > 0.0)


def cola2_delta_m(gains: Gains, speed_mps: float) -> float:
    """COLA2's look-ahead for a vehicle: the shortest that is damped well, to 0.1 m upwards.

    COLA2 steers the vehicle's reference point, so that its loop has no lever.
    """
    return math.ceil(10.0 * shortest_look_ahead_m(gains, speed_mps, 0.0) - 1e-6) / 10.0


def line_offset_m(
    follower: Follower, heading_rad: float, speed_mps: float, lever_m: float
) -> float:
    """How far to starboard of a line COLA2 holds the glass in the expected current, in the end.

    The reference point is down the current; the glass, ahead of it, is nearer to the line, since
    the vehicle heads into the current.

    Args:
        follower: vehicle and current.
        heading_rad: course of the line.
        speed_mps: of the plan.
        lever_m: how far the glass is ahead of the reference point.
    """
    across = follower.across_mps(heading_rad)
    return math.copysign(steady_drift(across, speed_mps) * (follower.delta_m - lever_m), across)


def circle_m(follower: Follower, speed_mps: float) -> float:
    """Radius of the tightest circle at a speed: ends that are nearer abeam are not reached."""
    return speed_mps / follower.turn_rad_s


def end_tolerance_m(follower: Follower, speed_mps: float) -> float:
    """Least tolerance at which COLA2 does not circle the end of a step in the expected current.

    It heads for an end however near that is, and slows down only by the share of a heading error
    beyond 0.3 rad: it circles an end within its turning circle for ever. In a current the bearing
    of an end at a distance x turns at current / x besides.
    """
    drift_m = follower.current_mps / (_TURN_SHARE * follower.turn_rad_s)
    return circle_m(follower, speed_mps) + drift_m


def predicted_stations(plan: Plan, follower: Follower, lever_m: float) -> Stations:
    """Where COLA2 will take the pictures of a plan in the expected current.

    It comes onto a line's run-in without an offset and is pushed towards the steady one over a
    length of `delta`.

    Args:
        plan: what is exported.
        follower: vehicle and current.
        lever_m: how far the glass is ahead of the reference point.
    """
    stations = stations_of_plan(plan)
    glass, attitude = stations.glass_ne.copy(), stations.attitude_rad.copy()
    for index, line in enumerate(plan.lines):
        rows = stations.line == index
        glass[rows] += _pushed_ne(plan, line, follower, lever_m)
        across = follower.across_mps(line.heading_rad)
        drift = math.asin(steady_drift(across, plan.speed_mps))
        attitude[rows, 2] -= math.copysign(drift, across)
    return replace(stations, glass_ne=glass, attitude_rad=attitude)


def _pushed_ne(plan: Plan, line: Line, follower: Follower, lever_m: float) -> Array:
    heading = line.heading_rad
    along_m = plan.run_in_m + np.linspace(0.0, line.length_m, line.stations)
    off_m = line_offset_m(follower, heading, plan.speed_mps, lever_m)
    off_m = off_m * -np.expm1(-along_m / follower.delta_m)
    pushed: Array = off_m[:, None] * np.array([-math.sin(heading), math.cos(heading)])
    return pushed
