"""Stretches of logs that a simulation is compared with."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.errors import VehicleError, warn
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.identification.sensitivity import CHANNELS, STATES, Record
from alice_survey.sim.vehicle.log import VehicleLog, max_step_s, segments
from alice_survey.sim.vehicle.vehicle import Vehicle

RATE_NAMES = ("p", "q", "r")
Mask = NDArray[np.bool_]

CHANNEL_NAMES = ("u", "v", "w", "p", "q", "r", "roll", "pitch", "heading")
"""Velocity over ground, m/s; rates, rad/s; attitude about the body's axes, rad."""
_MIN_ROWS = 5
"""Fewest rows: a shorter stretch gives less information than its free start needs."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Window:
    """A stretch of a log, ready to simulate."""

    source: str
    record: Record
    measured: Array
    """(T, 6) velocity over ground and rates, NaN where not measured."""
    given: tuple[int, ...]
    """Motions of nu, by their places, that follow the log instead of the forces."""
    start: Array
    """(10,) state to begin with: the first attitude, and the first velocity over ground and rates
    that were measured, zero where none was."""


def make_windows(
    log: VehicleLog,
    vehicle: Vehicle,
    *,
    window_s: float | None = None,
    given: Sequence[str] = (),
) -> list[Window]:
    """Cut a log into windows; warns of rows that are left out.

    Args:
        log: with attitude, velocities or rates, and the speeds of all thrusters, their thrusts, or
            the wrench; the first of these that the log holds is taken. An input that is missing in
            a row stays what it was.
        vehicle: whose thrusters they are.
        window_s: longest duration of a window; whole stretches without gaps if not given.
        given: rates, of p, q and r, that follow the log instead of the forces, such as those of
            rolling and pitching that nothing in the log explains; they are not compared then.

    Raises:
        VehicleError: the log lacks attitude, motion or input, or no stretch is long enough.
    """
    _check(log)
    rps, wrench = inputs(log, vehicle)
    motion = np.concatenate([log.velocity_body, log.rates_body], axis=1)
    places = _given_places(log, motion, given)
    acceleration = _accelerations(log.time_s, motion, places)
    windows, lost = [], 0
    for part in segments(log):
        known = _hold_inputs(log.time_s[part], rps[part], wrench[part])
        for piece in _pieces(log.time_s[part], known, window_s):
            rows = slice(part.start + piece.start, part.start + piece.stop)
            record = Record(
                *(
                    np.ascontiguousarray(table[rows])
                    for table in (log.time_s, rps, wrench, log.quaternion_xyzw, acceleration)
                )
            )
            window = _window(log.source, record, motion[rows], places)
            if window is None:
                lost += rows.stop - rows.start
            else:
                windows.append(window)
        lost += int(np.sum(~known))
    if not windows:
        raise VehicleError(
            f"{log.source}: no stretch of {_MIN_ROWS} rows has motion, attitude and input"
        )
    if lost:
        warn(
            f"{log.source}: {lost} of {len(log.time_s)} rows are not used: no input, or a stretch "
            f"of less than {_MIN_ROWS} rows or without motion"
        )
    return windows


def inputs(log: VehicleLog, vehicle: Vehicle) -> tuple[Array, Array]:
    """Speeds of the vehicle's thrusters, (T, n) rev/s, and a given wrench, (T, 6).

    Of the two the one that the log does not hold has no columns, or is zero. Thrusts act at the
    thrusters' places along their directions, and are net forces on the vehicle.

    Raises:
        VehicleError: the log has no such input, or lacks a thruster of the vehicle.
    """
    count, series = len(log.time_s), log.rpm or log.thrust_n
    if not series:
        if not np.any(np.isfinite(log.wrench)):
            raise VehicleError(
                f"{log.source}: has no input: give rpm_NAME, thrust_NAME_n or "
                "X_n,Y_n,Z_n,K_nm,M_nm,N_nm"
            )
        return np.zeros((count, 0)), log.wrench.copy()
    names = [thruster.name for thruster in vehicle.thrusters]
    if set(names) != set(series):
        raise VehicleError(
            f"{log.source}: thrusters {', '.join(series)} are not those of {vehicle.name}: "
            f"{', '.join(names) or 'none'}"
        )
    table = np.stack([series[name] for name in names], axis=1)
    if log.rpm:
        return table / 60.0, np.zeros((count, 6))
    columns = []
    for thruster in vehicle.thrusters:
        direction = np.array(thruster.direction_body)
        columns.append([*direction, *np.cross(thruster.position_body_m, direction)])
    return np.zeros((count, 0)), table @ np.array(columns)


def cut(window: Window, max_s: float) -> list[Window]:
    """A window in equal shorter ones; those without information are left out."""
    record = window.record
    known = np.ones(len(record.time_s), bool)
    parts = []
    for piece in _pieces(record.time_s, known, max_s):
        short = Record(*(np.ascontiguousarray(table[piece]) for table in record))
        made = _window(window.source, short, window.measured[piece], window.given)
        if made is not None:
            parts.append(made)
    return parts


def of_windows(windows: Sequence[Window], vehicle: Vehicle) -> Vehicle:
    """The vehicle with the thrusters that the windows give speeds of: all, or none."""
    thrusters = {window.record.rps.shape[1] for window in windows}
    if len(thrusters) > 1:
        raise VehicleError("some logs give thruster speeds and others forces: use one kind")
    if thrusters == {len(vehicle.thrusters)}:
        return vehicle
    return vehicle.without([thruster.name for thruster in vehicle.thrusters])


def residual_channels(window: Window, observed: Array) -> Array:
    """Simulated minus measured, (T, 9), NaN where nothing was measured."""
    difference = np.empty((len(observed), CHANNELS))
    difference[:, :6] = observed[:, :6] - window.measured
    difference[:, list(window.given)] = np.nan
    difference[:, 6:] = observed[:, 6:]
    return difference


def _check(log: VehicleLog) -> None:
    if not np.any(np.isfinite(log.quaternion_xyzw)):
        raise VehicleError(
            f"{log.source}: has no attitude: give roll_deg, pitch_deg and heading_deg, or quat_x "
            "to quat_w"
        )
    if not np.any(np.isfinite(log.velocity_body)) and not np.any(np.isfinite(log.rates_body)):
        raise VehicleError(
            f"{log.source}: has neither velocities u_mps, v_mps, w_mps nor rates p_rad_s, q_rad_s, "
            "r_rad_s"
        )


def _given_places(log: VehicleLog, motion: Array, names: Sequence[str]) -> tuple[int, ...]:
    """Places in nu of motions that follow the log; their gaps in `motion` are filled in place."""
    places = []
    for name in names:
        if name not in RATE_NAMES:
            raise VehicleError(f"motion {name!r} cannot be given; of p, q and r each can")
        place = 3 + RATE_NAMES.index(name)
        known = np.isfinite(motion[:, place])
        if not known.any():
            raise VehicleError(f"{log.source}: has no {name}_rad_s to follow")
        motion[:, place] = np.interp(log.time_s, log.time_s[known], motion[known, place])
        places.append(place)
    return tuple(sorted(set(places)))


def _accelerations(time_s: Array, motion: Array, places: tuple[int, ...]) -> Array:
    """Accelerations of given motions, (T, 6), row to row; zero of others and in the last row."""
    result = np.zeros(motion.shape)
    for place in places:
        result[:-1, place] = np.diff(motion[:, place]) / np.diff(time_s)
    return result


def _hold_inputs(time_s: Array, rps: Array, wrench: Array) -> Mask:
    """Fill gaps of the input in place from the row before; (T,) where there is one.

    An input is not carried on for longer than a gap of the log.
    """
    longest = max_step_s(time_s)
    known = np.all(np.isfinite(rps), axis=1) & np.all(np.isfinite(wrench), axis=1)
    last = np.maximum.accumulate(np.where(known, np.arange(len(time_s)), -1))
    fresh: Mask = (last >= 0) & (time_s - time_s[np.maximum(last, 0)] <= longest)
    for table in (rps, wrench):
        table[fresh] = table[last[fresh]]
    return fresh


def _pieces(time_s: Array, known: Mask, window_s: float | None) -> list[slice]:
    """Runs of rows with an input, cut into equal windows no longer than requested."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], known.astype(np.int8), [0]])))
    pieces = []
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        span = time_s[end - 1] - time_s[begin]
        count = 1 if window_s is None else max(int(np.ceil(span / window_s - 1e-9)), 1)
        marks = time_s[begin] + span * np.arange(1, count) / count
        cuts = [begin, *(begin + np.searchsorted(time_s[begin:end], marks)).tolist(), end]
        pieces += [slice(a, b) for a, b in itertools.pairwise(cuts)]
    return pieces


def _window(source: str, record: Record, measured: Array, given: tuple[int, ...]) -> Window | None:
    """A stretch; None where it is too short or has nothing of motion or attitude."""
    attitudes = np.flatnonzero(np.all(np.isfinite(record.attitude), axis=1))
    if len(measured) < _MIN_ROWS or not len(attitudes) or not np.any(np.isfinite(measured)):
        return None
    start = np.zeros(STATES)
    start[:4] = record.attitude[attitudes[0]]
    for i, column in enumerate(measured.T):
        there = np.flatnonzero(np.isfinite(column))
        if len(there):
            start[4 + i] = column[there[0]]
    return Window(source=source, record=record, measured=measured, given=given, start=start)
