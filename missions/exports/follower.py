"""How an autopilot will follow a plan: its parameters, its tolerances, and how far it will be off.

COLA2 steers by line of sight without an integral and without sway (alice_survey.sim.vehicle.pilot.
cola2): a current across a section holds it off by `delta` times the sine of the drift angle, in
closed form, and the shortest `delta` is bounded by how quickly the vehicle turns. ArduSub holds on
to its track by sway with an integral: no steady current holds it off that the vehicle can stem.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from alice_survey.core.config import SeaConfig, VehicleConfig
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.pilot.gains import FASTEST, SWAY, Gains, gains_for
from alice_survey.sim.vehicle.pilot.mission import circling_m, steady_drift, turn_in_m, yaw_rad_s
from alice_survey.sim.vehicle.pilot.settings import los_loop, min_look_ahead_m
from missions.coverage.stations import Stations, stations_of_plan
from missions.route.energy import planned_vehicle
from missions.values.line import Line
from missions.values.plan_file import Plan

_ROUNDS = 40
"""Of an iteration that halves its error in each."""
_MIN_SLIP = 0.05
"""Share of the speed that a hull slips and yaws at in calm water, at the least (inferred)."""


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
    wander_m: float
    """How far gusts push COLA2 off a line without a current, rms."""
    mode_per_s: complex
    """The slowest mode in which it comes onto a line."""
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
    flown_by = planned_vehicle(vehicle)
    gains = gains_for(flown_by, speed_mps)
    towards = math.radians(sea.current_towards_deg)
    delta_m = cola2_delta_m(gains, speed_mps)
    gust_n, correlation_s = sea.gust_n[1], sea.gust_correlation_s
    wander_m, mode_per_s = path_loop(gains, speed_mps, delta_m, gust_n, correlation_s)
    return Follower(
        name=flown_by.name,
        sways=sways(gains),
        delta_m=delta_m,
        wander_m=wander_m,
        mode_per_s=mode_per_s,
        circle_m=circling_m(gains, speed_mps),
        turn_in_m=turn_in_m(gains, speed_mps),
        turn_rad_s=yaw_rad_s(gains, 1.0),
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
    return math.ceil(10.0 * min_look_ahead_m(gains, speed_mps, 0.0) - 1e-6) / 10.0


def path_loop(
    gains: Gains, speed_mps: float, delta_m: float, gust_n: float, correlation_s: float
) -> tuple[float, complex]:
    """How COLA2's loop about a straight answers to gusts, and how it comes onto it.

    The variance of the loop, driven by a Gauss-Markov force from the side, by Lyapunov's equation.
    Quadratic damping counts as the linear one with the least mean square difference for normal
    velocities, of slope sqrt(8 / pi) sigma (T. K. Caughey, Equivalent linearization techniques, J.
    Acoust. Soc. Am. 35, 1963), found by iteration.

    Args:
        gains: of the vehicle.
        speed_mps: along the straight.
        delta_m: COLA2's look-ahead.
        gust_n: sigma of the force.
        correlation_s: of the force.

    Returns:
        How far off gusts push it, rms, m, and the slowest mode, 1/s; NaN where it weaves.
    """
    from scipy.linalg import solve_continuous_lyapunov

    if not math.isfinite(delta_m):
        return math.nan, complex(math.nan, math.nan)
    body, sigma = gains.body, np.full(2, _MIN_SLIP * speed_mps)
    noise = np.zeros((6, 6))
    noise[5, 5] = 2.0 * gust_n**2 / correlation_s
    loop = np.zeros((6, 6))
    variance: Array = noise
    loop[2:4, 5] = np.linalg.inv(body.mass[np.ix_([1, 5], [1, 5])])[:, 0]
    loop[5, 5] = -1.0 / correlation_s
    for _ in range(_ROUNDS):
        linear = body.linear.copy()
        linear[[1, 5], [1, 5]] += math.sqrt(8.0 / math.pi) * body.quadratic[[1, 5], [1, 5]] * sigma
        damped = gains._replace(body=body._replace(linear=linear))
        loop[:5, :5] = los_loop(damped, speed_mps, 0.0, delta_m)
        variance = np.asarray(solve_continuous_lyapunov(loop, -noise), np.float64)
        now = np.sqrt(np.maximum(np.diag(variance)[2:4], 0.0))
        sigma = np.maximum(0.5 * (sigma + now), _MIN_SLIP * speed_mps)
    modes = np.linalg.eigvals(loop[:5, :5])
    slowest = complex(modes[np.argmax(modes.real)])
    if slowest.real >= 0.0:
        return math.nan, slowest
    return float(math.sqrt(max(variance[0, 0], 0.0))), slowest


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


def end_tolerance_m(follower: Follower) -> float:
    """Least tolerance at which COLA2 does not circle the end of a step in the expected current.

    In a current the bearing of an end at a distance x turns at current / x besides, which the
    vehicle follows at a heading error of a radian at most.
    """
    return follower.circle_m + follower.current_mps / follower.turn_rad_s


def predicted_stations(plan: Plan, follower: Follower, lever_m: float) -> Stations:
    """Where COLA2 will take the pictures of a plan in the expected current.

    A vehicle that needs more room to turn than there is between lines comes onto them too far, on
    alternate sides, and swings in by its slowest mode. A current pushes it towards the steady
    offset over a length of `delta`. Gusts come on top, in one draw, correlated over that length.

    Args:
        plan: what is exported.
        follower: vehicle and current.
        lever_m: how far the glass is ahead of the reference point.
    """
    stations, rng = stations_of_plan(plan), np.random.default_rng(0)
    glass, attitude = stations.glass_ne.copy(), stations.attitude_rad.copy()
    for index, line in enumerate(plan.lines):
        rows = stations.line == index
        off_m = _pushed_m(plan, line, follower, lever_m) + _gusts_m(line, follower, rng)
        off_m += (-1) ** index * _swing_m(plan, line, follower)
        starboard = [-math.sin(line.heading_rad), math.cos(line.heading_rad)]
        glass[rows] += off_m[:, None] * np.array(starboard)
        across = follower.across_mps(line.heading_rad)
        drift = math.asin(steady_drift(across, plan.speed_mps))
        attitude[rows, 2] -= math.copysign(drift, across)
    return replace(stations, glass_ne=glass, attitude_rad=attitude)


def _pushed_m(plan: Plan, line: Line, follower: Follower, lever_m: float) -> Array:
    along_m = plan.run_in_m + np.linspace(0.0, line.length_m, line.stations)
    off_m = line_offset_m(follower, line.heading_rad, plan.speed_mps, lever_m)
    pushed: Array = off_m * -np.expm1(-along_m / follower.delta_m)
    return pushed


def _swing_m(plan: Plan, line: Line, follower: Follower) -> Array:
    too_far_m = max(0.0, follower.circle_m + follower.turn_in_m - plan.line_spacing_m)
    took_s = (plan.run_in_m + np.linspace(0.0, line.length_m, line.stations)) / plan.speed_mps
    return np.asarray(too_far_m * np.exp(follower.mode_per_s * took_s).real)


def _gusts_m(line: Line, follower: Follower, rng: np.random.Generator) -> Array:
    step_m = line.length_m / max(line.stations - 1, 1)
    kept = math.exp(-step_m / follower.delta_m)
    drawn = rng.standard_normal(line.stations)
    off = np.empty(line.stations)
    off[0] = drawn[0]
    for i in range(1, line.stations):
        off[i] = kept * off[i - 1] + math.sqrt(1.0 - kept * kept) * drawn[i]
    return np.asarray(follower.wander_m * off)
