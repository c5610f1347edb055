"""What a vehicle's own log records of a dive, in any format: series of numbers against time."""

import bisect
import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from alice_survey.core.contents import where_unknown
from alice_survey.core.frames import Array, attitude_from_rotation, rotation_from_attitude
from missions.logs.navigation_csv import interpolate

ROLES = ("navigation", "depth", "attitude", "altitude", "velocity")
"""What of a log may be chosen by name."""
_LATEST_S = 7258118400.0
"""1 January 2200."""
_UNIT = 0.05
"""How far from 1 the length of a quaternion may be."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Signal:
    """One or more numbers against time."""

    source: str
    """Topic or message that it comes from."""
    time_s: Array
    """(N,) strictly increasing."""
    values: Array
    """(N, k); NaN is not known."""

    def at(self, time_s: Array, *, turning: bool = False) -> Array:
        """Values, (M, k), at other times, interpolated; NaN in gaps and beyond the ends.

        Args:
            time_s: (M,).
            turning: whether values are angles in degrees, which turn the short way round.
        """
        columns = (
            interpolate(self.time_s, column, time_s, turning=turning) for column in self.values.T
        )
        return np.stack(list(columns), axis=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class LoggedDive:
    """A dive as logged; angles in degrees, nothing corrected."""

    kind: str
    """Format of the log, in words."""
    clock: str
    """Whose clock the times are, in words."""
    dated: bool
    """Whether times are seconds since 1970, UTC, and not of a separate clock."""
    position: Signal | None = None
    """(N, 2) latitude and longitude."""
    depth: Signal | None = None
    """(N, 1) depth below the surface, metres."""
    attitude: Signal | None = None
    """(N, 3) roll, pitch, heading."""
    altitude: Signal | None = None
    """(N, 1) altitudes, metres."""
    altitude_slant: bool = False
    """Whether `altitude` is a range along the body's down axis, not yet a height."""
    sigmas: Mapping[str, Signal] = field(default_factory=dict)
    """(N, 1) sigmas by their column in the navigation CSV."""
    velocity_ned: Signal | None = None
    """(N, 3) over ground, m/s."""
    velocity_body: Signal | None = None
    """(N, 3) u, v, w over ground, m/s."""
    rates: Signal | None = None
    """(N, 3) p, q, r, rad/s."""
    rpm: Signal | None = None
    """(N, n) speeds of the thrusters `thrusters`."""
    thrusters: tuple[str, ...] = ()
    pwm: Signal | None = None
    """(N, n) microseconds of servo outputs 1 to n."""
    declination_in_log: str = ""
    """What the vehicle itself added to its compass, in words, where the log says that it did."""
    lost: Mapping[str, int] = field(default_factory=dict)
    """How many rows or bytes were left out, by reason."""
    notes: tuple[str, ...] = ()

    @property
    def row_times(self) -> Array:
        """(M,) times of positions, and of depths where there are no positions.

        Without both they are those of attitudes, else of altitudes.
        """
        if self.position is None and self.depth is None:
            one = self.attitude or self.altitude
            return np.empty(0) if one is None else one.time_s
        times = np.empty(0)
        for signal in (self.position, self.depth):
            if signal is not None:
                lacking = np.isnan(
                    interpolate(times, np.zeros(len(times)), signal.time_s, turning=False)
                )
                times = np.union1d(times, signal.time_s[lacking])
        return times


def finite_number(value: Any) -> float:
    """A number of a log that may hold anything; NaN for what is none."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan
    return number if math.isfinite(number) and not isinstance(value, bool) else math.nan


def of_known(values: Array, width: int, function: Callable[[Array], Array]) -> Array:
    """What a function makes of rows, (N, k) to (N, width); NaN where a row is not all known."""
    known = np.isfinite(values).all(axis=1)
    found = np.full((len(values), width), np.nan)
    if known.any():
        found[known] = function(values[known])
    return found


def angles_of(xyzw: Array) -> Array:
    """Roll, pitch, heading, (N, 3) degrees, of quaternions, (N, 4); NaN where not of length 1."""
    unit = np.abs(np.linalg.norm(xyzw, axis=1, keepdims=True) - 1.0) < _UNIT
    return of_known(
        np.where(unit, xyzw, np.nan),
        3,
        lambda q: np.rad2deg(attitude_from_rotation(Rotation.from_quat(q))),
    )


def rotation_of(angles_deg: Array) -> Rotation:
    """Rotations of roll, pitch and heading, (N, 3) degrees."""
    return rotation_from_attitude(*np.deg2rad(angles_deg).T)


def clean_signal(source: str, time_s: Array, values: Array, lost: Counter[str]) -> Signal | None:
    """A signal of the rows whose times increase, the most that can be kept; None without rows.

    Args:
        source: topic or message.
        time_s: (N,) as logged.
        values: (N, k).
        lost: counts what is left out, once for a source that serves several roles; is added to.
    """
    time_s = np.asarray(time_s, dtype=np.float64)
    values = np.asarray(values, dtype=np.float64)
    values = values[:, None] if values.ndim == 1 else values
    good = np.abs(time_s) < _LATEST_S
    if not good.all():
        lost |= Counter({f"{source}: the time is not a number, or after 2200": int((~good).sum())})
    time_s, values = time_s[good], values[good]
    unknown = where_unknown(values) | where_unknown(-values)  # of a height, as a depth
    if stated := int((unknown & np.isfinite(values)).sum()):
        lost |= Counter({f"{source}: numbers that stand for unknown": stated})
    values = np.where(unknown, np.nan, values)
    keep = _increasing(time_s)
    if len(keep) < len(time_s):
        lost |= Counter({f"{source}: the time repeats or goes back": len(time_s) - len(keep)})
        time_s, values = time_s[keep], values[keep]
    known = np.isfinite(values).any(axis=1)
    if not known.any():
        return None
    return Signal(source=source, time_s=time_s, values=values)


def _increasing(time_s: Array) -> NDArray[np.intp]:
    """Rows of the longest strictly increasing subsequence (patience sorting).

    One wild time then costs one row, and not all that follow it.
    """
    count = len(time_s)
    if count < 2 or bool(np.all(np.diff(time_s) > 0)):
        return np.arange(count)
    tails: list[float] = []
    last: list[int] = []
    before = [-1] * count
    for i, time in enumerate(time_s.tolist()):
        place = bisect.bisect_left(tails, time)
        before[i] = last[place - 1] if place else -1
        if place == len(tails):
            tails.append(time)
            last.append(i)
        else:
            tails[place] = time
            last[place] = i
    rows, i = [], last[-1]
    while i >= 0:
        rows.append(i)
        i = before[i]
    return np.array(rows[::-1])


def usable_positions(position: Signal | None, lost: Counter[str]) -> Signal | None:
    """The rows of a position signal that can be a place; what is left out is counted."""
    if position is None:
        return None
    known = np.isfinite(position.values).all(axis=1)
    inside = (np.abs(position.values) <= [90.0, 180.0]).all(axis=1)
    nowhere = (position.values == 0).all(axis=1)  # as `is_nowhere` says of one
    for reason, rows in (
        ("the position is not a number", ~known),
        ("the position is beyond the range of latitude and longitude", known & ~inside),
        ("the position is 0, 0: no fix", nowhere),
    ):
        if rows.any():
            lost[f"{position.source}: {reason}"] += int(rows.sum())
    good = known & inside & ~nowhere
    if not good.any():
        return None
    return replace(position, time_s=position.time_s[good], values=position.values[good])
