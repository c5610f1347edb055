"""How an autopilot will follow a plan: its parameters, its tolerances, and how far it will be off.

COLA2 steers by line of sight without an integral and without sway (alice_survey.sim.vehicle.pilot.
cola2): a current across a section holds it off by `delta` times the sine of the drift angle, in
closed form, and the shortest `delta` is bounded by how quickly the vehicle turns. ArduSub holds on
to its track by sway with an integral: no steady current holds it off that the vehicle can stem.
"""

import math
from dataclasses import dataclass

import numpy as np
import shapely

from alice_survey.core.config import SeaConfig, VehicleConfig
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.pilot.gains import FASTEST, SWAY, Gains, gains_for
from alice_survey.sim.vehicle.pilot.mission import (
    Cola2Settings,
    circling_m,
    steady_drift,
    turn_in_m,
    yaw_rad_s,
)
from alice_survey.sim.vehicle.pilot.settings import min_look_ahead_m
from missions.route.energy import planned_vehicle
from missions.values.mission import Mission
from missions.values.plan_file import Plan

COLA2_TOLERANCE_Z_M = 0.3
"""A step down is done this near to its depth; COLA2's own 1 m begins a line a metre too high."""


@dataclass(frozen=True, kw_only=True)
class Follower:
    """A vehicle as an autopilot flies it, and the current that is expected."""

    name: str
    sways: bool
    """Whether it has thrusters that push it sideways."""
    delta_m: float
    """COLA2's look-ahead: the shortest that is damped well at the plan's speed."""
    circle_m: float
    """Radius at which COLA2 would circle an end with a smaller tolerance."""
    turn_in_m: float
    """How far it goes on while COLA2 turns it onto a line that it comes to at a right angle."""
    turn_rad_s: float
    """Yaw rate at a heading error of one radian."""
    current_ne_mps: tuple[float, float]
    """The expected current, towards north and east."""
    gust_mps: float = 0.0
    """What its slow changes add: two sigmas."""

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
    flown_by = planned_vehicle(vehicle)
    gains = gains_for(flown_by, speed_mps)
    towards = math.radians(sea.current_towards_deg)
    return Follower(
        name=flown_by.name,
        sways=sways(gains),
        delta_m=cola2_delta_m(gains, speed_mps),
        circle_m=circling_m(gains, speed_mps),
        turn_in_m=turn_in_m(gains, speed_mps),
        turn_rad_s=yaw_rad_s(gains, 1.0),
        current_ne_mps=(sea.current_mps * math.cos(towards), sea.current_mps * math.sin(towards)),
        gust_mps=2.0 * sea.current_sigma_mps,
    )


def sways(gains: Gains) -> bool:
    """Whether a vehicle can be pushed sideways."""
    return bool(gains.axes[SWAY, FASTEST] > 0.0)


def cola2_delta_m(gains: Gains, speed_mps: float) -> float:
    """COLA2's look-ahead for a vehicle: the shortest that is damped well, to 0.1 m upwards.

    COLA2 steers the vehicle's reference point, so that its loop has no lever.
    """
    return math.ceil(10.0 * min_look_ahead_m(gains, speed_mps, 0.0) - 1e-6) / 10.0


def off_lines_m(follower: Follower, plan: Plan, lever_m: float) -> Array:
    """How far off each of a plan's lines, (L,), COLA2 holds the glass in current and gusts.

    The reference point is down the current; the glass, ahead of it, is nearer to the line, since
    the vehicle heads into the current.

    Args:
        follower: vehicle and current.
        plan: its lines.
        lever_m: how far the glass is ahead of the reference point.
    """
    across = (abs(follower.across_mps(line.heading_rad)) for line in plan.lines)
    drift = [steady_drift(mps + follower.gust_mps, plan.speed_mps) for mps in across]
    return (follower.delta_m - lever_m) * np.array(drift)


def end_tolerance_m(follower: Follower) -> float:
    """Least tolerance at which COLA2 does not circle the end of a step in the expected current.

    In a current the bearing of an end at a distance x turns at current / x besides, which the
    vehicle follows at a heading error of a radian at most.
    """
    return follower.circle_m + follower.current_mps / follower.turn_rad_s


def swing_ne_m(follower: Follower, way_ne: Array, lever_m: float) -> Array:
    """How far beyond the ends of steps COLA2 brings the glass while it turns, (2,) or (N, 2).

    A step is done the circle's radius before its end; the glass is ahead of the reference point,
    goes on as the vehicle turns, and the current carries it: across the hull, on average of half a
    turn for half its time.

    Args:
        follower: vehicle and current.
        way_ne: (2,) or (N, 2) directions in which it comes to the ends.
        lever_m: how far the glass is ahead of the reference point.
    """
    ahead_m = max(lever_m + follower.turn_in_m - follower.circle_m, 0.0)
    carried_s = 0.5 * math.pi / follower.turn_rad_s
    return ahead_m * way_ne + carried_s * np.array(follower.current_ne_mps)


def expected_m(
    follower: Follower, plan: Plan, lever_m: float, mission: Mission
) -> tuple[Array, float]:
    """How far off each of a plan's lines, (L,), and out of its area COLA2 brings the glass.

    Off lines by the tolerance at their starts and what the current adds, out of the area where
    steps end.
    """
    tolerance_m = max(step.tolerance_m for step in mission.steps if step.camera == "off")
    ends = mission.ends_ne(plan.datum)
    ways = np.diff(ends, axis=0, prepend=ends[:1])
    ways /= np.maximum(np.hypot(*ways.T), 1e-9)[:, None]
    outside = shapely.points(ends + swing_ne_m(follower, ways, lever_m))
    return (
        tolerance_m + off_lines_m(follower, plan, lever_m),
        float(np.max(shapely.distance(plan.area.allowed, outside))),
    )


def cola2_settings(delta_m: float, speed_mps: float) -> Cola2Settings:
    """The pilot's parameters that exported missions count on.

    Speed is the same all along a line: pictures are taken at a constant interval.
    """
    return Cola2Settings(
        delta_m=delta_m,
        tolerance_z_m=COLA2_TOLERANCE_Z_M,
        max_surge_mps=max(Cola2Settings().max_surge_mps, speed_mps),
        min_surge_mps=max(Cola2Settings().min_surge_mps, speed_mps),
    )
