"""The parameters that a fit may free: their names, places, values and bounds.

Stretches of logs that a simulation is compared with.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.errors import VehicleError, warn
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.coefficients import FORCES, MOTIONS, Coefficients, both_ways, kind_of
from alice_survey.sim.vehicle.identification import sensitivity as term
from alice_survey.sim.vehicle.identification.sensitivity import (
    CHANNELS,
    STATES,
    Physics,
    Record,
    Terms,
)
from alice_survey.sim.vehicle.log import VehicleLog, max_step_s, segments
from alice_survey.sim.vehicle.vehicle import Vehicle

CURRENTS = ("current_north_mps", "current_east_mps")
NET_BUOYANCY = "net_buoyancy_n"
TRIMS = ("trim_x_m", "trim_y_m", "trim_z_m")
BIASES = tuple(f"bias_{m}_{'mps' if i < 3 else 'rad_s'}" for i, m in enumerate(MOTIONS))
GAINS = tuple(f"gain_{force}" for force in FORCES)
OTHERS = (*CURRENTS, NET_BUOYANCY, *TRIMS, *BIASES, *GAINS)
"""Parameters that are not coefficients: a constant current; buoyancy minus weight; where the weight
acts from the centre of buoyancy (its righting moment only, not the inertia); constant errors of the
velocity and rate sensors; and factors on the forces and moments that a log gives, where its thrusts
are no calibrated ones (speeds of thrusters are not scaled: a bollard pull calibrates those)."""
GROUPS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"current": CURRENTS, "trim": TRIMS, "bias": BIASES, "buoyancy": (NET_BUOYANCY,), "gain": GAINS}
)
"""Short names of several parameters."""
_GROUP_KINDS: Mapping[int, tuple[str, ...]] = {
    term.CURRENT: CURRENTS, term.TRIM: TRIMS, term.BIAS: BIASES, term.GAIN: GAINS,
    term.BUOYANCY: (NET_BUOYANCY,),
}  # fmt: skip
_KINDS = {
    "dot": term.ADDED_MASS, "linear": term.LINEAR, "lift": term.LIFT, "quadratic": term.QUADRATIC,
    "quadratic_pos": term.QUADRATIC_POS, "quadratic_neg": term.QUADRATIC_NEG,
}  # fmt: skip
QUADRATICS = (term.QUADRATIC, term.QUADRATIC_POS, term.QUADRATIC_NEG)
_GREATEST: Mapping[int, float] = MappingProxyType({term.CURRENT: 5.0, term.TRIM: 1.0})


@dataclass(frozen=True, kw_only=True, eq=False)
class Parameters:
    """Free parameters of a vehicle; everything else is as in the vehicle."""

    vehicle: Vehicle
    names: tuple[str, ...]
    fixed: Mapping[str, float]
    """Values of `OTHERS` that are not free; zero, or as in the vehicle, if not named."""

    @cached_property
    def terms(self) -> Terms:
        """For compiled code."""
        places = [place_of(name) for name in self.names]
        columns = np.array(places, dtype=np.int64).reshape(-1, 3).T
        return Terms(*(np.ascontiguousarray(column) for column in columns))

    @cached_property
    def start(self) -> Array:
        """(P,) values that the vehicle has."""
        return np.array([self._given_value(name) for name in self.names])

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """(P,) lower and upper limits.

        Damping of a motion by itself takes energy out and a diagonal added mass is not negative:
        those coefficients are not positive. A current is at most 5 m/s, a lever at most 1 m.
        """
        lower, upper = np.full(len(self.names), -np.inf), np.full(len(self.names), np.inf)
        for k, name in enumerate(self.names):
            kind, i, j = place_of(name)
            if kind in (term.LINEAR, *QUADRATICS, term.ADDED_MASS) and i == j:
                upper[k] = 0.0
            elif kind == term.GAIN:
                lower[k] = 0.0
            elif kind in _GREATEST:
                lower[k], upper[k] = -_GREATEST[kind], _GREATEST[kind]
        return lower, upper

    def coefficients(self, values: Array, name: str) -> Coefficients:
        """The vehicle's set with the free coefficients replaced."""
        free = {
            key: float(value)
            for key, value in zip(self.names, values, strict=True)
            if key not in OTHERS
        }
        return self.vehicle.coefficients.with_values(name, free)

    def others(self, values: Array) -> dict[str, float]:
        """All parameters that are not coefficients."""
        free = dict(zip(self.names, (float(v) for v in values), strict=True))
        return {name: free.get(name, self._given_value(name)) for name in OTHERS}

    def physics(self, values: Array) -> Physics:
        """The vehicle with values (P,) of the parameters, for compiled code.

        Raises:
            VehicleError: the inertia is not positive definite.
        """
        vehicle = self.vehicle.with_coefficients(self.coefficients(values, "trial"))
        others = self.others(values)
        body = vehicle.plant.body
        body = body._replace(
            buoyancy_n=body.weight_n + others[NET_BUOYANCY],
            cg=np.array([others[name] for name in TRIMS]),
        )
        return Physics(
            body,
            vehicle.plant.propulsion,
            np.array([thruster.time_constant_s for thruster in vehicle.thrusters]),
            np.array([others[name] for name in CURRENTS]),
            np.array([others[name] for name in BIASES]),
            np.array([others[name] for name in GAINS]),
            np.zeros(6),
        )

    def _given_value(self, name: str) -> float:
        if name not in OTHERS:
            return self.vehicle.coefficients.value(name)
        if name in self.fixed:
            return self.fixed[name]
        rigid, body = self.vehicle.rigid_body, self.vehicle.plant.body
        if name == NET_BUOYANCY:
            return float(body.buoyancy_n - body.weight_n)
        if name in GAINS:
            return 1.0
        return float(rigid.cg_body_m[TRIMS.index(name)]) if name in TRIMS else 0.0


def free_parameters(
    vehicle: Vehicle, names: Sequence[str], fixed: Mapping[str, float] | None = None
) -> Parameters:
    """Parameters by their names, or by the names of groups: current, trim, bias, buoyancy, gain.

    Raises:
        VehicleError: a name is not known, comes twice, or is fixed as well; two names stand for one
            added mass; a fixed one is a coefficient.
    """
    flat = [one for name in names for one in GROUPS.get(name, (name,))]
    places: dict[tuple[int, int, int], str] = {}
    for name in flat:
        kind, i, j = place_of(name)
        place = (kind, min(i, j), max(i, j)) if kind == term.ADDED_MASS else (kind, i, j)
        if place in places:
            raise VehicleError(f"{places[place]} and {name} are one parameter: free it once")
        places[place] = name
    for name in flat:
        if both_ways(name) != name and both_ways(name) in flat:
            raise VehicleError(
                f"{both_ways(name)} stands for both ways: free it, or {both_ways(name)}_pos and "
                f"{both_ways(name)}_neg"
            )
    for name in fixed or {}:
        if name not in OTHERS:
            raise VehicleError(f"{name} cannot be held by hand; these can: {', '.join(OTHERS)}")
        if name in flat:
            raise VehicleError(f"{name} is free and held at once")
    return Parameters(vehicle=vehicle, names=tuple(flat), fixed=dict(fixed or {}))


def unit_of(name: str) -> str:
    """The unit of a parameter, SI and radians.

    Raises:
        VehicleError: the name is not known.
    """
    kind, i, j = place_of(name)
    if kind == term.GAIN:
        return "1"
    if kind in (term.CURRENT, term.TRIM, term.BUOYANCY, term.BIAS):
        suffix = name.split("_", 2)[2]
        return {"mps": "m/s", "rad_s": "rad/s", "m": "m", "n": "N"}[suffix]
    force, turning = ("N m" if i >= 3 else "N"), j >= 3
    if kind == term.ADDED_MASS:
        return ("kg", "kg m", "kg m2")[int(i >= 3) + int(turning)]
    if kind == term.LIFT:
        return f"{force} s2/m2"
    power = "2" if kind in QUADRATICS else ""
    return f"{force} s{power}" + ("" if turning else f"/m{power}")


def place_of(name: str) -> tuple[int, int, int]:
    """Kind, row and column of a parameter.

    Raises:
        VehicleError: the name is not known.
    """
    for kind, group in _GROUP_KINDS.items():
        if name in group:
            return kind, group.index(name), 0
    if (found := kind_of(name)) is not None:
        motion = name[3] if found == "lift" else name[2]
        return _KINDS[found], FORCES.index(name[0]), MOTIONS.index(motion)
    known = ", ".join((*GROUPS, *OTHERS))
    raise VehicleError(
        f"parameter {name!r} is not known; known: X_udot, X_u, X_uu, Z_ww_neg, ..., {known}"
    )


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
    log: VehicleLog, vehicle: Vehicle, *, window_s: float | None = None, given: Sequence[str] = ()
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
