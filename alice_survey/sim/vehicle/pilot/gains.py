"""Gains of the inner loops, derived from a vehicle by pole placement; nothing is tuned.

Each controlled axis is a mass m with damping d, pushed by thrusters that lag: m a = F - d v,
T F' = F_wanted - F. With F_wanted / m = -(rate v + place x) its characteristic polynomial is
T s^3 + (1 + T d/m) s^2 + (d/m + rate) s + place. T. I. Fossen (Handbook of Marine Craft
Hydrodynamics and Motion Control, 2011, section 12.2, PID by pole placement) has the same without
the lag: rate = 2 zeta omega - d/m, place = omega^2. Here all three poles are placed: a pair of
damping ratio zeta and natural frequency omega, and a real one at -a, with a + 2 zeta omega =
1/T + d/m, the sum that the lag dictates.

The rule for omega: as fast as the lag allows without the real pole becoming the slowest (a = omega,
hence omega = (1/T + d/m) / (1 + 2 zeta)), but not above a twentieth of the rate of the navigation's
velocities (K. J. Astrom, B. Wittenmark, Computer-Controlled Systems, 1997, section 2.9, samples 10
to 30 times within a period of the closed loop). Integral action is a tenth as fast, integral =
place omega / 10 (Fossen 2011, section 12.2), or slower where the water damps much: integral =
place^2 / (rate + d/m at the greatest speed of the axis) if that is less, since the loop with lag
and integral lets less through where damping takes the rate's part.

Yaw is not a bare axis: under way a slender hull slips through its turns, and the sway that this
gives turns it further (Munk moment) or back. Where the gains above leave a mode of heading, sway,
yaw rate, lag and integral together damped by less than HEADING_DAMPING at the survey's speed, the
gains are the nearest to them (by their logarithms, on a grid) that damp enough; if none do, those
that damp best, unless that is less than MIN_HEADING_DAMPING. At rest and at half the speed, which
are passed through, PASSING_DAMPING less is enough.

The sway axis is a PID that asks a speed of an inner loop (paper, section VII): the inner gain is
the critically damped one, 1 / (4 T), or rate if that is less; what rate has beyond it is k_D. The
other axes need no k_D: their inner gain is rate.

The same numbers serve a speed loop: its proportional gain is rate, its integral gain place. A PI
has a zero at -place / rate, nearer than its poles, by which it overshoots a target speed. The
proportional part therefore sees only a share of the target speed (set-point weighting: K. J.
Astrom, T. Hagglund, Advanced PID Control, 2006, section 3.4), weight = (place / omega - d/m) /
rate, which with the feed-forward of drag moves the zero onto a pole at -omega.

A vehicle that fins steer has surge, yaw and pitch (roll where its fins give all three moments), by
the same rules, its fins' damping counted with the hull's. Pitch is not bare either: heave, the Munk
moment and the low centre of gravity are in its loop as sway is in that of yaw. Fins are weaker than
their drives are fast: omega is so low that an error of KEPT_RAD takes no more than their moment.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import columns
from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.allocation import AXIS_WEIGHTS, LEVEL_WEIGHTS, new_allocation
from alice_survey.sim.vehicle.dynamics import Body, coriolis_matrix
from alice_survey.sim.vehicle.fins import Fins, fin_slope, pack_fins, write_fin_matrix
from alice_survey.sim.vehicle.propulsion import thrust_limits
from alice_survey.sim.vehicle.steady import balance_fins, bisect, min_radius_m
from alice_survey.sim.vehicle.vehicle import Vehicle

LATERAL, VERTICAL = (1, 5), (2, 4)
"""Degrees of freedom that a turn couples: sway and yaw, heave and pitch."""
NO_FINS = pack_fins((), 0.0)
_AT_REST_PER_S = 1e-9
"""Poles nearer to 0 do not move."""


def coupled_pair(
    body: Body, speed_mps: float, fins: Fins = NO_FINS, plane: tuple[int, int] = LATERAL
) -> tuple[Array, Array]:
    """Sway and yaw rate under way: (v, r)' = A (v, r) + b moment; or heave and pitch rate.

    Args:
        body: body of the vehicle.
        speed_mps: surge; without drift or turning.
        fins: of the vehicle, not turned.
        plane: `LATERAL` or `VERTICAL`.

    Returns:
        (2, 2) and (2,)
    """
    nu = np.array([speed_mps, 0.0, 0.0, 0.0, 0.0, 0.0])
    both = np.ix_(plane, plane)
    inverse = np.linalg.inv(body.mass[both])
    slope = linear_damping(body, nu) + linear_coriolis(body, nu)
    if len(fins.surfaces):
        slope = slope + fin_slope(fins, nu)
    pair: Array = -inverse @ slope[both]
    return pair, np.array(inverse[:, 1], np.float64)


def damping_ratio(loop: Array) -> float:
    """Least damping ratio of a state matrix's modes; negative if one grows."""
    return float(mode_damping(np.linalg.eigvals(loop)).min())


def mode_damping(poles: NDArray[Any]) -> Array:
    """Damping ratio of each pole; 1 of one at rest: a sway that no water damps is its own loop's.

    Args:
        poles: complex.
    """
    size = np.abs(poles)
    return np.where(size > _AT_REST_PER_S, -poles.real / np.maximum(size, _AT_REST_PER_S), 1.0)


def linear_damping(body: Body, nu: Array) -> Array:
    """(6, 6) slope of damping and body lift by velocity at a velocity (6,)."""
    quadratic = np.where(np.asarray(nu) > 0.0, body.quadratic, body.quadratic_back)
    slope = -(body.linear + 2.0 * quadratic * np.abs(nu))
    u, v, w = nu[0], nu[1], nu[2]
    y_uv, z_uw, m_uw, n_uv = body.lift
    slope[1, [0, 1]] -= y_uv * np.sign(u) * v, y_uv * abs(u)
    slope[2, [0, 2]] -= z_uw * np.sign(u) * w, z_uw * abs(u)
    slope[4, [0, 2]] -= m_uw * w, m_uw * u
    slope[5, [0, 1]] -= n_uv * v, n_uv * u
    return slope


def linear_coriolis(body: Body, nu: Array) -> Array:
    """(6, 6) slope of C(nu) nu by velocity at a velocity (6,).

    C(a) b is bilinear, so that the slope's column j is C(e_j) nu + C(nu) e_j.
    """
    slope = coriolis_matrix(body.mass, nu)
    columns = [coriolis_matrix(body.mass, unit) @ nu for unit in np.eye(6)]
    return slope + np.array(columns).T


SURGE, SWAY, HEAVE, YAW, ROLL, PITCH = columns(6)
"""Rows of `Gains.axes`."""
DEGREES = (0, 1, 2, 5)
"""Which of the 6 degrees of freedom each of the first rows is: those that a mission steers."""
STEERED = len(DEGREES)
LEVEL = (3, 4)
"""The same of the rows after them, which are held level: by thrusters that can, else by gravity."""
_DEGREE = (*DEGREES, *LEVEL)
_BY_FINS = (SURGE, YAW, PITCH, ROLL)
_AXES = ("surge", "sway", "heave", "yaw", "roll", "pitch")

MASS, RATE, PLACE, INTEGRAL, INNER, MIN_FORCE, MAX_FORCE, FASTEST, LAG, BANDWIDTH, WEIGHT = range(
    11
)
"""Columns of `Gains.axes`: inertia (kg, kg m^2); rate (1/s), place (1/s^2), integral (1/s^3); inner
(1/s), the part of rate that the inner speed loop has; least and greatest force or moment; greatest
commanded speed (m/s, rad/s); lag (s); bandwidth (rad/s); share of a target speed that the
proportional part of a speed loop sees."""

DAMPING_RATIO = 1.0
"""Damping ratio of the placed pair: no overshoot, so that a neighbouring line is not reached."""
INTEGRAL_SHARE = 0.1
"""Bandwidth of integral action over that of the loop (Fossen 2011, section 12.2)."""
SAMPLES_PER_PERIOD = 20.0
MIN_SAMPLES_PER_PERIOD = 10.0
"""Samples per period of an oscillation that couples heading and sway."""
HEADING_DAMPING = 0.7
"""Target damping of every mode of the heading loop (inferred: an overshoot of a twentieth)."""
MIN_HEADING_DAMPING = 0.5
"""Below it a vehicle is not flown (inferred: an overshoot of a sixth)."""
PASSING_DAMPING = 0.2
"""Reduction of the heading loop's damping below the survey's speed (inferred)."""
KEPT_RAD = math.radians(10.0)
"""Tolerance within which a heading counts as kept."""
_TICK_S = 0.05
"""Of the control; half of it is added to the lag (a held value is half a tick old)."""
_MAX_TURN_RAD_S = math.radians(30.0)
"""Greatest commanded yaw rate, if the thrusters allow it."""
_NO_FORCE = 1e-6
"""A force or moment of less is none, N or N m."""
_RATE_FACTORS = np.geomspace(0.5, 8.0, 49)
_PLACE_FACTORS = np.geomspace(0.5, 16.0, 61)
_SLOWER, _SLOWER_BY_FINS = (0.0, 0.5), (0.5,)
"""Shares of the survey's speed."""
STEADY_SHARE = 0.75
"""Share of the greatest force for steady motion; a quarter stays for feedback (inferred)."""


class Gains(NamedTuple):
    """Model of the vehicle in the inner loops."""

    body: Body
    """Inertia and damping, for feed-forward."""
    fins: Fins
    """Those that are there: for feed-forward, not turned."""
    straight: Array
    """(m,) angles of fins that are not turned."""
    level_rad: float
    """Pitch of level flight; 0 but for a vehicle that fins steer."""
    axes: Array
    """(6, 11) rows SURGE, SWAY, HEAVE, YAW, ROLL, PITCH; an axis that nothing moves has zero gains,
    and so have roll and pitch where the thrusters cannot hold both and steer as well."""

    @property
    def holds_level(self) -> bool:
        """Whether thrusters hold roll and pitch, or fins."""
        return bool(np.all(self.axes[[ROLL, PITCH], MASS] > 0.0))

    @property
    def axis_weights(self) -> Array:
        """(6,) priorities of the axes in the allocation; 0 of those that nothing pushes along."""
        weights = LEVEL_WEIGHTS if self.holds_level or self.dives_by_pitch else AXIS_WEIGHTS
        weights = weights.copy()
        if self.dives_by_pitch:
            rows = [SURGE, SWAY, HEAVE, ROLL, PITCH, YAW]
            weights[self.axes[rows, MASS] == 0.0] = 0.0
        return weights

    @property
    def dives_by_pitch(self) -> bool:
        """Whether nothing pushes the vehicle up or down: it goes where its fins point it."""
        return bool(self.axes[HEAVE, MASS] == 0.0)


def gains_for(vehicle: Vehicle, speed_mps: float, navigation_hz: float = 5.0) -> Gains:
    """Gains for a vehicle.

    Args:
        vehicle: inertia, damping, thrusters.
        speed_mps: survey speed, at which damping is linearised, without drift or turning.
        navigation_hz: rate of the navigation's velocities (DVL).

    Raises:
        VehicleError: surge, heave or yaw cannot be controlled, or yaw not damped at that speed; or
            a vehicle with fins has vertical thrusters too, or does not fly level at that speed.
    """
    plant, count, fins = vehicle.plant, len(vehicle.thrusters), bool(vehicle.fins)
    if fins and np.any(np.abs(vehicle.configuration_matrix[[2, 4]]) > _NO_FORCE):
        raise VehicleError(
            f"{vehicle.name} has fins and thrusters that push it up or down, which are not "
            "controlled together: leave out the one or the other"
        )
    cruise = np.array([speed_mps, 0.0, 0.0, 0.0, 0.0, 0.0])
    radius_m = min_radius_m(vehicle, speed_mps, STEADY_SHARE) if fins else 0.0
    room = new_allocation(vehicle, np.ones(count), exact=True, axes=np.ones(6))
    matrix, lower, upper = room.matrix, room.lower, room.upper
    thrust_limits(plant.propulsion, room.health, cruise, lower, upper)
    if fins:
        write_fin_matrix(plant.fins, cruise, matrix, count)
    rows = matrix[list(_DEGREE)]
    if fins:
        rolls = np.linalg.matrix_rank(matrix[3:, count:]) == 3
        used: tuple[int, ...] = _BY_FINS if rolls else _BY_FINS[:-1]
    else:
        used = tuple(range(6 if _holds(rows, lower, upper) else STEERED))
        rows = rows[list(used)]
    steers = matrix[[_DEGREE[axis] for axis in used]]
    slowness_s = np.array([
        *(thruster.time_constant_s for thruster in vehicle.thrusters),
        *(fin.time_constant_s for fin in vehicle.fins),
    ])  # fmt: skip
    slope = linear_damping(plant.body, cruise)
    if fins:
        slope += fin_slope(plant.fins, cruise)
    gyradius_m = math.sqrt(vehicle.mass[5, 5] / vehicle.mass[1, 1])
    axes = np.zeros((6, 11))
    for row, axis in enumerate(used):
        degree, levels = _DEGREE[axis], axis in (ROLL, PITCH)
        inertia = float(vehicle.mass[degree, degree])
        minimum, maximum = authority(steers, lower, upper, row)
        axes[axis, [MASS, MIN_FORCE, MAX_FORCE]] = inertia, minimum, maximum
        weakest = min(-minimum, maximum)
        if weakest < _NO_FORCE:
            if axis == SWAY:
                continue
            raise VehicleError(
                f"{vehicle.name} cannot control {_AXES[axis]} both ways at {speed_mps:g} m/s "
                f"({minimum:.2g} to {maximum:.2g}): it cannot fly a survey"
            )
        lag_s = effective_lag_s(rows, lower, upper, slowness_s, axis, gyradius_m) + _TICK_S / 2
        decay = float(slope[degree, degree]) / inertia
        # Attitude and its rates are known at every tick.
        known_hz = 1.0 / _TICK_S if levels else navigation_hz
        fastest_rad_s = 2 * math.pi * known_hz / SAMPLES_PER_PERIOD
        if fins and axis != SURGE:
            fastest_rad_s = min(fastest_rad_s, math.sqrt(weakest / inertia / KEPT_RAD))
        omega, rate, place = place_poles(lag_s, decay, fastest_rad_s)
        max_decay = max(decay, 0.0) if fins else decay
        fastest = _steady_speed(plant.body, degree, STEADY_SHARE * weakest)
        if fins and axis == PITCH:
            fastest = min(fastest, STEADY_SHARE * weakest / slope[degree, degree])
        elif not fins and not levels:
            moving = np.zeros(6)
            moving[degree] = fastest
            max_decay = float(linear_damping(plant.body, moving)[degree, degree]) / inertia
        if axis == YAW or (fins and axis == PITCH):
            rate, place, damped = _damped_together(
                plant.body, speed_mps, np.array([rate, place]), lag_s, omega, max_decay,
                2 * math.pi * known_hz / MIN_SAMPLES_PER_PERIOD, fins=plant.fins,
                plane=LATERAL if axis == YAW else VERTICAL,
                slower=_SLOWER_BY_FINS if fins else _SLOWER,
            )  # fmt: skip
            if damped < MIN_HEADING_DAMPING:
                raise VehicleError(
                    f"the {_AXES[axis]} loop of {vehicle.name} with {vehicle.coefficients.name!r} "
                    f"coefficients cannot be damped at {speed_mps:g} m/s (damping ratio "
                    f"{damped:.2f} at best, {MIN_HEADING_DAMPING:g} is needed): lower the speed"
                )
        axes[axis, [RATE, PLACE, LAG, BANDWIDTH]] = rate, place, lag_s, omega
        axes[axis, INTEGRAL] = _integral(rate, place, omega, max_decay)
        if fins or not levels:
            axes[axis, INNER] = min(rate, 1.0 / (4.0 * lag_s)) if axis == SWAY else rate
            axes[axis, FASTEST] = fastest
        if rate > 0.0 and (axis == SURGE or not (fins or levels)):
            axes[axis, WEIGHT] = min(max((place / omega - decay) / rate, 0.0), 1.0)
    if fins:
        axes[YAW, FASTEST], axes[ROLL, FASTEST] = speed_mps / radius_m, 0.0
    axes[YAW, FASTEST] = min(axes[YAW, FASTEST], _MAX_TURN_RAD_S)
    level = balance_fins(vehicle, speed_mps) if fins else None
    level_rad = 0.0 if level is None else level.pitch_rad
    return Gains(plant.body, plant.fins, np.zeros(len(vehicle.fins)), level_rad, axes)


def _holds(configuration: Array, lower: Array, upper: Array) -> bool:
    """Whether thrusters can turn the vehicle both ways in roll and pitch, and do nothing else.

    Args:
        configuration: (6, n) rows as of `Gains.axes`.
        lower: (n,) least thrust.
        upper: (n,) greatest thrust.
    """
    if np.linalg.matrix_rank(configuration[[0, 2, 3, 4, 5]]) < 5:
        return False
    ends = [authority(configuration, lower, upper, axis) for axis in (ROLL, PITCH)]
    return all(min(-minimum, maximum) > _NO_FORCE for minimum, maximum in ends)


def place_poles(
    lag_s: float, decay_per_s: float, fastest_rad_s: float
) -> tuple[float, float, float]:
    """Natural frequency, rate gain and place gain of the rule above.

    Args:
        lag_s: T.
        decay_per_s: d / m.
        fastest_rad_s: bound on the natural frequency.
    """
    total = 1.0 / lag_s + decay_per_s
    omega = min(total / (1.0 + 2.0 * DAMPING_RATIO), fastest_rad_s)
    pair = 2.0 * DAMPING_RATIO * omega
    real = total - pair
    rate = lag_s * (pair * real + omega**2) - decay_per_s
    # Damping beyond what is target is left to the water: a negative gain would undo it.
    return omega, max(rate, 0.0), lag_s * real * omega**2


def _integral(rate: float, place: float, omega: float, max_decay: float) -> float:
    return place * min(INTEGRAL_SHARE * omega, place / (rate + max_decay))


def heading_loop(
    body: Body, speed_mps: float, row: Array, fins: Fins = NO_FINS, plane: tuple[int, int] = LATERAL
) -> Array:
    """State matrix of the heading loop with the sway that it brings about; or of pitch and heave.

    States: integral of heading; heading; sway, m/s; yaw rate; yaw acceleration that the lagging
    thrusters or fins give.

    Args:
        body: body of the vehicle.
        speed_mps: surge.
        row: row of yaw, or of pitch, in `Gains.axes`.
        fins: of the vehicle.
        plane: `LATERAL` or `VERTICAL`.

    Returns:
        (5, 5)
    """
    pair, by_moment = coupled_pair(body, speed_mps, fins, plane)
    loop = np.zeros((5, 5))
    loop[0, 1] = loop[1, 3] = 1.0
    loop[2:4, 2:4] = pair
    if plane == VERTICAL:  # the low centre of gravity
        loop[2:4, 1] = -by_moment * body.weight_n * body.cg[2]
    loop[2:4, 4] = by_moment * row[MASS]
    loop[4, [0, 1, 3]] = -row[[INTEGRAL, PLACE, RATE]] / row[LAG]
    loop[4, 4] = -1.0 / row[LAG]
    return loop


def _damped_together(
    body: Body,
    speed_mps: float,
    bare: Array,
    lag_s: float,
    omega: float,
    max_decay: float,
    sampled_rad_s: float,
    *,
    fins: Fins = NO_FINS,
    plane: tuple[int, int] = LATERAL,
    slower: tuple[float, ...] = _SLOWER,
) -> tuple[float, float, float]:
    """Rate and place gains of yaw, or pitch, by the rule above, and the least damping they give.

    Args:
        body: body of the vehicle.
        speed_mps: speed of the survey.
        bare: (2,) gains of the axis by itself.
        lag_s: lag of the thrusters.
        omega: natural frequency placed for the axis by itself.
        max_decay: greatest d / m.
        sampled_rad_s: bound on the frequency of a pair of poles.
        fins: of the vehicle.
        plane: `LATERAL` or `VERTICAL`.
        slower: shares of the speed that are passed through.
    """
    row = np.zeros(11)
    row[[MASS, LAG]] = body.mass[plane[1], plane[1]], lag_s
    factors = np.vstack([
        [1.0, 1.0],
        np.stack(np.meshgrid(_RATE_FACTORS, _PLACE_FACTORS), axis=-1).reshape(-1, 2),
    ])  # fmt: skip
    # From the nearest on.
    factors = factors[np.argsort(np.hypot(*np.log(factors).T), kind="stable")]
    damped = np.full(len(factors), math.inf)
    gains = bare * factors
    for share in (1.0, *slower):
        loop = heading_loop(body, share * speed_mps, row, fins, plane)
        loops = np.repeat(loop[None], len(gains), axis=0)
        integral = [_integral(rate, place, omega, max_decay) for rate, place in gains]
        loops[:, 4, 0] = -np.array(integral) / lag_s
        loops[:, 4, [1, 3]] = -gains[:, ::-1] / lag_s
        # Without speed sway decays by itself, or not at all; it is not of the loop then.
        if share == 0.0:
            loops = loops[:, [[0], [1], [3], [4]], [0, 1, 3, 4]]
        poles = np.linalg.eigvals(loops)
        size = np.abs(poles)
        ratio = mode_damping(poles).min(axis=1)
        fast = np.any((np.abs(poles.imag) > 0.0) & (size > sampled_rad_s), axis=1)
        if share < 1.0:
            ratio += PASSING_DAMPING
        damped = np.minimum(damped, np.where(fast, -1.0, ratio))
    enough = np.flatnonzero(damped >= HEADING_DAMPING)
    best = int(enough[0]) if len(enough) else int(np.argmax(damped))
    return float(gains[best, 0]), float(gains[best, 1]), float(damped[best])


def authority(configuration: Array, lower: Array, upper: Array, axis: int) -> tuple[float, float]:
    """Least and greatest force on one axis while the other axes get none: a linear programme.

    Args:
        configuration: (A, n) force on each axis by thrust.
        lower: (n,) least thrust.
        upper: (n,) greatest thrust.
        axis: row.
    """
    from scipy.optimize import linprog

    row = configuration[axis]
    others = np.delete(configuration, axis, axis=0)
    ends = []
    for sense in (1.0, -1.0):
        found = linprog(
            sense * row,
            A_eq=others,
            b_eq=np.zeros(len(others)),
            bounds=list(zip(lower.tolist(), upper.tolist(), strict=True)),
        )
        ends.append(float(row @ found.x))
    return ends[0], ends[1]


def effective_lag_s(
    configuration: Array,
    lower: Array,
    upper: Array,
    time_constant_s: Array,
    axis: int,
    gyradius_m: float,
) -> float:
    """Lag of the force on one axis: the thrusters' time constants, by the part that each plays.

    The thrusts are those of least effort (weighted by their bounds) that push this axis alone; a
    thruster plays a part by all that it does, as when one cancels the yaw of another.

    Args:
        configuration: (A, n) force on each axis by thrust, A 4 or 6.
        lower: (n,) least thrust.
        upper: (n,) greatest thrust.
        time_constant_s: (n,) of the thrusters.
        axis: row.
        gyradius_m: by which moments are divided to be compared with forces.
    """
    arms = np.array([1.0, 1.0, 1.0, gyradius_m, gyradius_m, gyradius_m])
    scaled = configuration / arms[: len(configuration), None]
    strength = np.minimum(-lower, upper)
    thrust = strength * np.linalg.pinv(scaled * strength)[:, axis]
    part = np.abs(thrust) * np.linalg.norm(scaled, axis=0)
    return float(part @ time_constant_s / part.sum())


def _steady_speed(body: Body, degree: int, force: float) -> float:
    """Speed at which linear and quadratic drag of one degree of freedom take a force, both ways."""
    linear = -body.linear[degree, degree]
    quadratic = -min(body.quadratic[degree, degree], body.quadratic_back[degree, degree])
    if quadratic <= 0.0:
        return force / linear if linear > 0.0 else math.inf
    return float((math.sqrt(linear**2 + 4.0 * quadratic * force) - linear) / (2.0 * quadratic))


_MAX_MPS = 5.0
_STEP_MPS = 0.02
_GROWS_PER_S = 1e-6
"""Growth beyond rounding errors."""


def pitch_matrix(vehicle: Vehicle, speed_mps: float) -> Array:
    """State matrix of heave w, pitch rate q and pitch about level flight at a held surge.

    The Munk moment of the added masses grows with the square of the speed and turns a hull that
    pitches further; the low centre of gravity turns it back (Fossen 2011, sections 6.3 and 7.5).

    Args:
        vehicle: level when at rest, with all thrusters steady.
        speed_mps: surge.

    Returns:
        (3, 3)
    """
    body, matrix = vehicle.plant.body, np.zeros((3, 3))
    matrix[:2, :2], by_moment = coupled_pair(body, speed_mps, plane=VERTICAL)
    matrix[:2, 2] = -by_moment * body.weight_n * body.cg[2]
    matrix[2, 1] = 1.0
    return matrix


def pitch_divergence_speed_mps(vehicle: Vehicle) -> float:
    """The lowest speed above which a pitch grows, by bisection; infinite if none up to 5 m/s.

    Args:
        vehicle: as in `pitch_matrix`.
    """

    def grows(speed_mps: float) -> bool:
        growth = np.linalg.eigvals(pitch_matrix(vehicle, speed_mps)).real.max()
        return bool(growth > _GROWS_PER_S)

    high = _STEP_MPS
    while not grows(high):
        high += _STEP_MPS
        if high > _MAX_MPS:
            return math.inf
    return bisect(grows, high, high - _STEP_MPS, 1e-6)
