"""Positions from velocities over ground and attitudes, tied to what fixes there are.

Velocity v of the body, turned to north and east by the attitude, adds up to a track. Its errors are
a scale e_s of the speeds and a turn e_h of the headings, constant over the dive, and noise of the
velocity that adds up as a random walk:

    d(north) = ((1 + e_s) v_n - e_h v_e) dt + w_n,  d(east) = ((1 + e_s) v_e + e_h v_n) dt + w_e

A Kalman filter and the smoother of Rauch, Tung and Striebel (1965, "Maximum likelihood estimates of
linear dynamic systems") over (north, east, e_s, e_h) give every place with its standard deviation:
it grows away from fixes, and shrinks again towards the next one.
"""

import math
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.errors import NavigationError
from alice_survey.core.frames import Array, Datum
from missions.logs.dive import LoggedDive, Signal, of_known, rotation_of
from missions.logs.navigation_csv import max_gap_s

_FAR_M = 1e4
"""Standard deviation of a place before any fix, about the first one."""
_GATE = 5.0
"""A fix this many standard deviations off the track is left out."""
_FIXES_S = 60.0
"""Fixes this close share their errors (GPS: the ionosphere's, and what the sky hides)."""
_FIX_SIGMA_M = 3.0
"""Of a fix whose log states none."""


@dataclass(frozen=True, kw_only=True)
class TrackErrors:
    """How velocities and headings err."""

    scale: float = 0.005
    """Standard deviation of the relative error of speeds (beam angles, sound speed)."""
    heading_deg: float = 1.0
    """Standard deviation of the constant error of headings, degrees."""
    noise_mps: float = 0.02
    """Noise of the velocity over one second, m/s per root Hz."""

    def __post_init__(self) -> None:
        if not all(0 < v < math.inf for v in (self.scale, self.heading_deg, self.noise_mps)):
            raise NavigationError("errors of dead reckoning must be more than 0 and finite")


@dataclass(frozen=True, kw_only=True, eq=False)
class ReckonedTrack:
    """Places of a dive about a datum."""

    time_s: Array
    """(N,)."""
    ne: Array
    """(N, 2) north and east, metres."""
    sigma_m: Array
    """(N,) standard deviation of each of north and east, root mean square of both."""
    refused: int
    """Fixes that are far off the track."""


def with_dead_reckoning(
    dive: LoggedDive,
    errors: TrackErrors,
    start: tuple[float, float, float] | None,
    declination_deg: float = 0.0,
) -> LoggedDive:
    """A dive whose positions are those of its velocities and attitudes between its fixes.

    Args:
        dive: with `velocity_body` and `attitude`, or `velocity_ned`.
        errors: of both.
        start: latitude, longitude (degrees) and standard deviation (metres) of the first velocity,
            for a dive without a fix there.
        declination_deg: of the log's north, east positive.

    Raises:
        NavigationError: it has no velocity or no attitude, or no fix and no start.
    """
    velocity, broken = _velocity_ne(dive, np.deg2rad(declination_deg))
    fixes_s, fixes, sigmas = _fixes(dive)
    if start is not None:
        fixes_s = np.append(velocity.time_s[0], fixes_s)
        fixes = np.vstack([start[:2], fixes])
        sigmas = np.append(start[2], sigmas)
    if not len(fixes_s):
        raise NavigationError(
            "dead reckoning needs a place to start from, and the log has no fix: give --start-at "
            "LATITUDE LONGITUDE SIGMA of the first velocity"
        )
    datum = Datum(float(fixes[0, 0]), float(fixes[0, 1]))
    places = datum.ned_from_geodetic(np.column_stack([fixes, np.zeros(len(fixes))]))[:, :2]
    track = dead_reckoned(velocity, (fixes_s, places, sigmas), errors)
    known = np.isfinite(track.sigma_m)
    if not known.any():
        raise NavigationError("no velocity is within a stretch that has a fix")
    ned = np.column_stack([track.ne[known], np.zeros(int(known.sum()))])
    lost = Counter(dict(dive.lost))
    if track.refused:
        lost[f"fixes over {_GATE:g} sigmas off the track of velocities"] += track.refused
    if not known.all():
        lost["velocities in stretches without a fix"] += int((~known).sum())
    source = f"{velocity.source}, dead reckoning"
    sigma = Signal(source=source, time_s=track.time_s[known], values=track.sigma_m[known, None])
    note = (
        f"positions by dead reckoning from {velocity.source}, tied to {len(fixes_s)} fixes; "
        f"sigma {track.sigma_m[known].min():.2g} to {track.sigma_m[known].max():.2g} m"
    )
    if broken:
        note += f"; {broken} gaps in the velocity break the track"
    return replace(
        dive,
        position=Signal(
            source=source, time_s=track.time_s[known], values=datum.geodetic_from_ned(ned)[:, :2]
        ),
        sigmas={**dive.sigmas, "sigma_horizontal_m": sigma},
        lost=dict(lost),
        notes=(*dive.notes, note),
    )


def dead_reckoned(
    velocity: Signal, fixes: tuple[Array, Array, Array], errors: TrackErrors
) -> ReckonedTrack:
    """Smooth a track of velocities over fixes.

    Args:
        velocity: (N, 2) north and east, m/s; a gap longer than its signal's limit breaks the track.
        fixes: (F,) times, (F, 2) north and east in metres, (F,) standard deviations of each.
        errors: of the velocity.

    Returns:
        Places at the times of the velocity; NaN in stretches without a fix.
    """
    time_s = velocity.time_s
    steps = np.diff(time_s, prepend=time_s[:1])
    moves = np.zeros((len(time_s), 2))
    moves[1:] = 0.5 * (velocity.values[1:] + velocity.values[:-1]) * steps[1:, None]
    breaks = steps > max_gap_s(time_s)
    stretch = np.cumsum(breaks)
    fixes_s, places, sigmas = (np.asarray(part, dtype=np.float64) for part in fixes)
    order = np.argsort(fixes_s, kind="stable")
    fixes_s, places = fixes_s[order], places[order]
    sigmas = sigmas[order] * np.sqrt(_company(fixes_s))
    # A fix counts at the nearest velocity, moved by the velocity in between.
    at = np.rint(np.interp(fixes_s, time_s, np.arange(len(time_s)))).astype(np.intp)
    late = (fixes_s - time_s[at])[:, None]
    near = np.abs(late[:, 0]) <= 0.5 * max_gap_s(time_s)
    at, places, sigmas = at[near], (places - late * velocity.values[at])[near], sigmas[near]
    starts = np.searchsorted(at, np.arange(len(time_s) + 1))
    state, spread, refused = _smooth((steps, moves, breaks), (starts, places, sigmas), errors)
    tied = np.isin(stretch, stretch[at])
    state[~tied], spread[~tied] = np.nan, np.nan
    return ReckonedTrack(
        time_s=time_s, ne=state, sigma_m=np.sqrt(0.5 * spread.sum(axis=1)), refused=refused
    )


def _velocity_ne(dive: LoggedDive, declination_rad: float) -> tuple[Signal, int]:
    """Velocity to true north and east, (N, 2), where known, and how many gaps break it."""
    if dive.velocity_ned is not None:
        source, times = dive.velocity_ned.source, dive.velocity_ned.time_s
        ne = dive.velocity_ned.values[:, :2]
    else:
        if dive.velocity_body is None or dive.attitude is None:
            lacks = "velocity over ground" if dive.velocity_body is None else "attitude"
            raise NavigationError(f"dead reckoning needs a {lacks}, and the log has none")
        source, times = dive.velocity_body.source, dive.velocity_body.time_s
        turning = np.hstack([dive.attitude.at(times, turning=True), dive.velocity_body.values])
        ne = of_known(turning, 2, lambda row: rotation_of(row[:, :3]).apply(row[:, 3:])[:, :2])
    good = np.isfinite(ne).all(axis=1)
    if good.sum() < 2:
        raise NavigationError(f"{source}: no two velocities have an attitude")
    cos, sin = math.cos(declination_rad), math.sin(declination_rad)
    times, ne = times[good], ne[good] @ np.array([[cos, sin], [-sin, cos]])
    broken = int((np.diff(times) > max_gap_s(times)).sum())
    return Signal(source=source, time_s=times, values=ne), broken


def _fixes(dive: LoggedDive) -> tuple[Array, Array, Array]:
    """Times, latitude and longitude, and sigmas of a dive's own positions."""
    if dive.position is None:
        return np.empty(0), np.empty((0, 2)), np.empty(0)
    times = dive.position.time_s
    sigmas = np.full(len(times), np.nan)
    if "sigma_horizontal_m" in dive.sigmas:
        sigmas = dive.sigmas["sigma_horizontal_m"].at(times)[:, 0]
    return times, dive.position.values[:, :2], np.where(sigmas > 0, sigmas, _FIX_SIGMA_M)


def _company(times_s: Array) -> Array:
    """How many fixes, (F,) sorted, are within the time over which fixes share errors."""
    half = 0.5 * _FIXES_S
    last = np.searchsorted(times_s, times_s + half, side="right")
    return (last - np.searchsorted(times_s, times_s - half)).astype(np.float64)


def _smooth(
    velocities: tuple[Array, Array, NDArray[np.bool_]],
    fixes: tuple[NDArray[np.int64], Array, Array],
    errors: TrackErrors,
) -> tuple[Array, Array, int]:
    """Filter forwards and smooth backwards.

    Args:
        velocities: (N,) seconds since the velocity before; (N, 2) metres since then; (N,) whether
            the track begins again there: the place is unknown, the errors stay.
        fixes: (N + 1,) where the fixes of each velocity start, (F, 2) their places, (F,) sigmas;
            the first after a break is always taken.
        errors: of the velocities.

    Returns:
        (N, 2) places, (N, 2) variances, and how many fixes were refused.
    """
    (steps, moves, breaks), (starts, places, sigmas) = velocities, fixes
    count = len(steps)
    x, p = np.zeros((count, 4)), np.zeros((count, 4, 4))
    ahead_x, ahead_p, step_f = np.zeros_like(x), np.zeros_like(p), np.zeros_like(p)
    prior = np.array([_FAR_M, _FAR_M, errors.scale, np.deg2rad(errors.heading_deg)])
    now, spread, unit = np.zeros(4), np.diag(prior**2), np.eye(4)
    place = np.diag([1.0, 1.0, 0.0, 0.0])
    refused, tied = 0, False
    for k in range(count):
        north, east = moves[k]
        if breaks[k]:
            f, grown, tied = unit - place, _FAR_M**2, False
        else:
            f, grown = unit.copy(), errors.noise_mps**2 * steps[k]
            f[:2, 2:] = [[north, -east], [east, north]]
        now, spread = f @ now, f @ spread @ f.T + grown * place
        if not breaks[k]:
            now[:2] += moves[k]
        step_f[k], ahead_x[k], ahead_p[k] = f, now, spread
        for i in range(starts[k], starts[k + 1]):
            off = places[i] - now[:2]
            inverse = np.linalg.inv(spread[:2, :2] + sigmas[i] ** 2 * unit[:2, :2])
            if tied and off @ inverse @ off > _GATE**2:
                refused += 1
                continue
            tied, gain = True, spread[:, :2] @ inverse
            keep = unit - gain @ unit[:2]
            now = now + gain @ off
            spread = keep @ spread @ keep.T + sigmas[i] ** 2 * (gain @ gain.T)
        x[k], p[k] = now, spread
    for k in range(count - 2, -1, -1):
        back = np.linalg.solve(ahead_p[k + 1], step_f[k + 1] @ p[k]).T
        x[k] += back @ (x[k + 1] - ahead_x[k + 1])
        p[k] += back @ (p[k + 1] - ahead_p[k + 1]) @ back.T
    return x[:, :2], np.diagonal(p, axis1=1, axis2=2)[:, :2].copy(), refused
