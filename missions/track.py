"""The true track of a simulated flight: the plan's route, flown with believable errors.

The vehicle keeps its speed along the route; arcs are rounded off so that velocity and acceleration
are continuous. Cross-track, altitude and attitude errors are second-order Gauss-Markov processes,
whose rates are continuous too.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.config import FlightConfig
from alice_survey.frames import Array, rotation_from_attitude
from alice_survey.trajectory import Trajectory
from missions.plan_file import Plan
from missions.route import Route, route_through

_KERNEL_POINTS = 41
_ONE_OVER_E = 2.1461932206205825
"""Root of (1 + x) exp(-x) = 1 / e."""


class SeaFloor(Protocol):
    """What a flight needs to know of a sea floor."""

    @property
    def bounds_ne_m(self) -> tuple[float, float, float, float]:
        """Least and greatest north, least and greatest east."""

    def depth_at(self, points_ne: Array) -> Array:
        """Depth, (...), at places (..., 2) within the bounds."""


@dataclass(frozen=True, kw_only=True)
class LevelFloor:
    """A level sea floor without end."""

    depth_m: float

    @property
    def bounds_ne_m(self) -> tuple[float, float, float, float]:
        """Everywhere."""
        return (-math.inf, math.inf, -math.inf, math.inf)

    def depth_at(self, points_ne: Array) -> Array:
        """The same depth everywhere."""
        return np.full(np.shape(points_ne)[:-1], self.depth_m)


@dataclass(frozen=True, kw_only=True, eq=False)
class Flight:
    """A flown plan."""

    truth: Trajectory
    """Of the body origin."""
    glass_ned: Array
    """(T, 3) the left port's outer glass."""
    trigger_s: Array
    """(S,) when each station's pictures are taken."""
    trigger_line: tuple[int, ...]
    """(S,) line of the plan of each station."""


def fly_plan(
    plan: Plan,
    errors: FlightConfig,
    floor: SeaFloor,
    glass_body_m: tuple[float, float, float],
    rng: np.random.Generator,
) -> Flight:
    """Fly a plan.

    Args:
        plan: what to fly.
        errors: rate and how well the vehicle keeps to its lines.
        floor: the true sea floor; beyond its bounds it goes on level with its edge.
        glass_body_m: the left port's outer glass in the body frame.
        rng: where the errors come from.
    """
    route = route_through(plan.lines, plan.turn_radius_m, plan.run_in_m)
    count = math.ceil(plan.duration_s * errors.rate_hz) + 1
    time_s = np.arange(count) / errors.rate_hz
    places, headings = smooth_way(plan, route, plan.speed_mps * time_s)
    cross, altitude, heading, roll, pitch = (
        gauss_markov(rng, sigma, errors.correlation_s, 1.0 / errors.rate_hz, count)
        for sigma in (
            errors.track_sigma_m,
            errors.altitude_sigma_m,
            math.radians(errors.heading_sigma_deg),
            math.radians(errors.roll_sigma_deg),
            math.radians(errors.pitch_sigma_deg),
        )
    )
    right = np.stack([-np.sin(headings), np.cos(headings)], axis=1)
    glass_ne = places + cross[:, None] * right
    floor_m = low_pass(
        depth_clamped(floor, glass_ne),
        half_width=errors.terrain_smoothing_m / plan.speed_mps * errors.rate_hz,
    )
    glass_ned = np.column_stack([glass_ne, floor_m - plan.altitude_m + altitude])
    rotation = rotation_from_attitude(roll, pitch, headings + heading)
    body_ned = glass_ned - rotation.apply(np.asarray(glass_body_m))
    trigger_s, trigger_line = triggers(plan, route)
    return Flight(
        truth=Trajectory(
            time_s=time_s, ned_from_body=RigidTransform.from_components(body_ned, rotation)
        ),
        glass_ned=glass_ned,
        trigger_s=trigger_s,
        trigger_line=trigger_line,
    )


def triggers(plan: Plan, route: Route) -> tuple[Array, tuple[int, ...]]:
    """When the pictures are taken, (S,) seconds, and on which line."""
    starts = route.line_starts_m()
    times: list[Array] = []
    lines: list[int] = []
    for index, line in enumerate(plan.lines):
        along = np.linspace(0.0, line.length_m, line.stations)
        times.append((starts[index] + along) / plan.speed_mps)
        lines += [index] * line.stations
    return np.concatenate(times), tuple(lines)


def smooth_way(plan: Plan, route: Route, along_m: Array) -> tuple[Array, Array]:
    """The route with its curvature steps rounded off by a Hann window.

    Straights stay as they are but for half a run-in at their ends, which the window leaves clear of
    the lines; arcs move inwards by some millimetres.

    Args:
        plan: its run-in and turn radius set the window's width.
        route: the route.
        along_m: (N,) distances along it.

    Returns:
        Places, (N, 2) north and east, and headings, (N,) radians without jumps of 2 pi.
    """
    reach = min(plan.run_in_m, plan.turn_radius_m) / 2
    offsets = np.linspace(-reach, reach, _KERNEL_POINTS)[1:-1]
    weights = 1 + np.cos(math.pi * offsets / reach)
    weights /= weights.sum()
    places, ahead = np.zeros((len(along_m), 2)), np.zeros((len(along_m), 2))
    for offset, weight in zip(offsets, weights, strict=True):
        places += weight * route.places(along_m + offset)
        turned = route.headings_rad(along_m + offset)
        ahead += weight * np.stack([np.cos(turned), np.sin(turned)], axis=1)
    return places, np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))


def gauss_markov(
    rng: np.random.Generator, sigma: float, correlation_s: float, step_s: float, count: int
) -> Array:
    """A stationary second-order Gauss-Markov process, exactly sampled, (count,).

    It is critically damped white noise, x'' + 2 w x' + w^2 x = noise, with the autocorrelation
    sigma^2 (1 + w |t|) exp(-w |t|) (A. Gelb, Applied Optimal Estimation, 1974, table 2.2-1).

    Args:
        rng: source of the noise.
        sigma: standard deviation.
        correlation_s: lag at which the correlation has fallen to 1 / e.
        step_s: between samples.
        count: how many.
    """
    omega = _ONE_OVER_E / correlation_s
    decay = math.exp(-omega * step_s)
    step = decay * np.array(
        [[1 + omega * step_s, step_s], [-(omega**2) * step_s, 1 - omega * step_s]]
    )
    stationary = np.diag([1.0, omega**2])
    noise = stationary - step @ stationary @ step.T
    # Of a 2 x 2 covariance of nearly rank 1: Cholesky by hand, safe from rounding below zero.
    first = math.sqrt(max(noise[0, 0], 0.0))
    mixed = noise[0, 1] / first if first > 0 else 0.0
    second = math.sqrt(max(noise[1, 1] - mixed**2, 0.0))
    draws = rng.standard_normal((count, 2))
    place, rate = float(draws[0, 0]), omega * float(draws[0, 1])
    values = np.empty(count)
    values[0] = place
    (a, b), (c, d) = step.tolist()
    for i, (one, two) in enumerate(draws[1:].tolist(), 1):
        place, rate = (
            a * place + b * rate + first * one,
            c * place + d * rate + mixed * one + second * two,
        )
        values[i] = place
    return sigma * values


def low_pass(values: Array, half_width: float) -> Array:
    """Smooth a series (N,) by a Hann window; beyond its ends it keeps its last value.

    Args:
        values: the series.
        half_width: of the window, in samples.
    """
    reach = max(1, math.ceil(half_width))
    window = 1 + np.cos(math.pi * np.arange(-reach + 1, reach) / reach)
    padded = np.pad(values, reach - 1, mode="edge")
    smooth: Array = np.convolve(padded, window / window.sum(), mode="valid")
    return smooth


def depth_clamped(floor: SeaFloor, points_ne: Array) -> Array:
    """Depth, (...), of the sea floor, which goes on level with its edge beyond its bounds."""
    south, north, west, east = floor.bounds_ne_m
    inset = 1e-6
    clamped = np.stack(
        [
            np.clip(points_ne[..., 0], south + inset, north - inset),
            np.clip(points_ne[..., 1], west + inset, east - inset),
        ],
        axis=-1,
    )
    return floor.depth_at(clamped)
