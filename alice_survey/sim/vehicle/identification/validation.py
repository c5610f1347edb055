"""Prediction errors of a model on a log it was not fitted to.

The fit of a velocity is 100 (1 - |y - y_model| / |y - mean(y)|) per cent over the rows where it was
measured (normalised root mean square, as in the System Identification Toolbox's `compare`): 100 is
perfect, 0 no better than the mean. Simulations start from what is measured in their first row and
see only the inputs from there on; next to them the velocity of that row is kept.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.identification.output_error import Simulation
from alice_survey.sim.vehicle.identification.parameters import Parameters
from alice_survey.sim.vehicle.identification.sensitivity import (
    CHANNELS,
    STATES,
    Physics,
    Record,
    Terms,
    scratch_for,
    simulate,
    with_given,
)
from alice_survey.sim.vehicle.identification.windows import Window

HORIZONS_S = (0.5, 1.0, 2.0, 5.0, 10.0)
_MOTIONS = 6
_START_ROWS_S = 0.5
"""A forecast starts this long after the one before."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Forecast:
    """Errors after a time from a start, root mean square over many starts."""

    horizon_s: float
    starts: int
    model: Array
    """(6,) m/s and rad/s."""
    constant: Array
    """(6,) of the velocity that is kept."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionValidation:
    """Prediction errors of a model on a log."""

    source: str
    time_s: Array
    """(T,) times of all windows."""
    measured: Array
    """(T, 6) velocity over ground and rates."""
    simulated: Array
    """(T, 6) simulated from the start of each window without correction."""
    constant: Array
    """(T, 6) the velocity at the start of each window."""
    window_s: float
    """Longest of the windows."""
    forecasts: tuple[Forecast, ...]

    @property
    def fit_percent(self) -> Array:
        """(6,) fit of the model; NaN where nothing was measured or nothing moves."""
        return fit_percent(self.measured, self.simulated)

    @property
    def constant_fit_percent(self) -> Array:
        """(6,) of the velocity that is kept."""
        return fit_percent(self.measured, self.constant)


def fit_percent(measured: Array, predicted: Array) -> Array:
    """Normalised fit of each column, (K,), of (T, K) series; rows with NaN are skipped."""
    result = np.full(measured.shape[1], np.nan)
    for k in range(measured.shape[1]):
        known = np.isfinite(measured[:, k]) & np.isfinite(predicted[:, k])
        y, y_model = measured[known, k], predicted[known, k]
        spread = np.linalg.norm(y - y.mean()) if len(y) else 0.0
        if spread > 0:
            result[k] = 100.0 * (1.0 - np.linalg.norm(y - y_model) / spread)
    return result


def validate(
    windows: Sequence[Window],
    parameters: Parameters,
    values: Array,
    *,
    simulation: Simulation | None = None,
    horizons_s: Sequence[float] = HORIZONS_S,
) -> MotionValidation:
    """Compare simulations with windows of a log.

    Args:
        windows: windows of the log.
        parameters: parameters of the model.
        values: (P,) theirs.
        simulation: steps and inputs.
        horizons_s: times after which forecasts are judged; those longer than a window are left out.

    Raises:
        VehicleError: a simulation does not stay finite.
    """
    how = simulation or Simulation()
    physics = with_given(parameters.physics(values), windows[0].given)
    measured = np.concatenate([window.measured for window in windows])
    # A motion that follows the log is not predicted.
    measured[:, list(windows[0].given)] = np.nan
    simulated, constant, longest = [], [], 0.0
    errors: dict[float, list[tuple[Array, Array]]] = {h: [] for h in horizons_s}
    for window in windows:
        filled = _held(window.measured)
        start = _state(window, filled, 0, physics.current_ne, physics.bias)
        simulated.append(run(window, start, physics, how))
        constant.append(np.tile(filled[0], (len(filled), 1)))
        time_s = window.record.time_s
        longest = max(longest, float(time_s[-1] - time_s[0]))
        _forecast(window, filled, physics, how, errors)
    forecasts = []
    for horizon, rows in errors.items():
        if rows:
            model, kept = (np.array([row[i] for row in rows]) for i in range(2))
            forecasts.append(
                Forecast(
                    horizon_s=horizon, starts=len(rows), model=_rms(model), constant=_rms(kept)
                )
            )
    return MotionValidation(
        source=Path(windows[0].source).name,
        time_s=np.concatenate([w.record.time_s for w in windows]),
        measured=measured, simulated=np.concatenate(simulated), constant=np.concatenate(constant),
        window_s=longest, forecasts=tuple(forecasts),
    )  # fmt: skip


def _forecast(
    window: Window,
    filled: Array,
    physics: Physics,
    how: Simulation,
    errors: dict[float, list[tuple[Array, Array]]],
) -> None:
    """Add the errors of forecasts from many rows of a window."""
    time_s = window.record.time_s
    next_s = time_s[0]
    for row in range(len(time_s) - 1):
        if time_s[row] < next_s or not np.all(np.isfinite(window.record.attitude[row])):
            continue
        next_s = time_s[row] + _START_ROWS_S
        ends = {h: int(np.searchsorted(time_s, time_s[row] + h - 1e-6)) for h in errors}
        ends = {h: end for h, end in ends.items() if end < len(time_s)}
        if not ends:
            break
        last = max(ends.values())
        part = Window(
            source=window.source,
            record=Record(*(np.ascontiguousarray(a[row : last + 1]) for a in window.record)),
            measured=window.measured[row : last + 1],
            given=window.given,
            start=window.start,
        )
        start = _state(window, filled, row, physics.current_ne, physics.bias)
        found = run(part, start, physics, how)
        for horizon, end in ends.items():
            truth = window.measured[end].copy()
            truth[list(window.given)] = np.nan
            errors[horizon].append((found[end - row] - truth, filled[row] - truth))


def run(window: Window, start: Array, physics: Physics, how: Simulation) -> Array:
    """Velocity over ground and rates, (T, 6), of a window simulated from a start (10,).

    Raises:
        VehicleError: the simulation does not stay finite.
    """
    rows = len(window.record.time_s)
    states, observed = np.empty((rows, STATES)), np.empty((rows, CHANNELS))
    nothing = np.zeros(0, np.int64)
    simulate(
        physics, Terms(nothing, nothing, nothing), window.record, start, how.max_step_s,
        how.hold, scratch_for(0, window.record.rps.shape[1]), np.zeros((STATES, 0)), states,
        observed, np.empty((rows, CHANNELS, 0)),
    )  # fmt: skip
    if not np.all(np.isfinite(observed[:, :_MOTIONS])):
        raise VehicleError(
            f"{window.source}: the simulation does not stay finite: simulate shorter stretches"
        )
    return observed[:, :_MOTIONS]


def _state(window: Window, filled: Array, row: int, current_ne: Array, bias: Array) -> Array:
    """The state (10,) that a row measured; its attitude, where unknown, is the window's first."""
    attitude = window.record.attitude[row]
    state = window.start.copy()
    if np.all(np.isfinite(attitude)):
        state[:4] = attitude
    state[4:] = filled[row] - bias
    drift = Rotation.from_quat(state[:4]).inv().apply([current_ne[0], current_ne[1], 0.0])
    state[4:7] -= drift
    return state


def _held(measured: Array) -> Array:
    """Measurements with the last known one in rows without; the first known one before it."""
    filled = measured.copy()
    for column in filled.T:
        known = np.flatnonzero(np.isfinite(column))
        if not len(known):
            column[:] = 0.0
            continue
        last = np.maximum.accumulate(np.where(np.isfinite(column), np.arange(len(column)), -1))
        column[:] = column[np.where(last < 0, known[0], last)]
    return filled


def _rms(errors: Array) -> Array:
    """(6,) over the rows where something was measured; NaN where nothing was."""
    known = np.isfinite(errors)
    count = known.sum(axis=0)
    total = np.where(known, errors, 0.0) ** 2
    result: Array = np.sqrt(
        np.divide(total.sum(axis=0), count, out=np.full(errors.shape[1], np.nan), where=count > 0)
    )
    return result
