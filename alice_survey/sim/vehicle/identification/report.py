"""The command `vehicle identify`: from logs to coefficients, a report and a picture.

Without logs to fit, `--validate` alone runs a log through the vehicle as it is known, open loop.

Prediction errors of a model on a log it was not fitted to.

The fit of a velocity is 100 (1 - |y - y_model| / |y - mean(y)|) per cent over the rows where it was
measured (normalised root mean square, as in the System Identification Toolbox's `compare`): 100 is
perfect, 0 no better than the mean. Simulations start from what is measured in their first row and
see only the inputs from there on; next to them the velocity of that row is kept.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from alice_survey.core.config import DEFAULT_VEHICLE
from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.kit.figure import INKS, SOFT, figure_style, new_figure, save_figure
from alice_survey.kit.words import text_table
from alice_survey.sim.vehicle.files import (
    coefficients_from_file,
    parse_table,
    read_table,
    speeds_missing,
    vehicle_from,
    write_coefficients,
)
from alice_survey.sim.vehicle.identification.output_error import (
    OutputErrorFit,
    PriorSigmas,
    Simulation,
    fit_output_error,
)
from alice_survey.sim.vehicle.identification.parameters import (
    CURRENTS,
    OTHERS,
    Parameters,
    free_parameters,
    unit_of,
)
from alice_survey.sim.vehicle.identification.sensitivity import (
    CHANNELS,
    STATES,
    Physics,
    Terms,
    scratch_for,
    simulate,
    with_given,
)
from alice_survey.sim.vehicle.identification.two_step import (
    ThrustCoefficient,
    calibrate,
    fit_pulls,
    read_pulls,
    with_thrust,
)
from alice_survey.sim.vehicle.identification.windows import (
    CHANNEL_NAMES,
    Window,
    make_windows,
    of_windows,
)
from alice_survey.sim.vehicle.log import read_column_map, read_foreign_log, read_vehicle_log
from alice_survey.sim.vehicle.vehicle import Vehicle

_MOTIONS = 6


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
) -> MotionValidation:
    """Compare simulations with windows of a log.

    Args:
        windows: windows of the log.
        parameters: parameters of the model.
        values: (P,) theirs.
        simulation: steps and inputs.

    Raises:
        VehicleError: a simulation does not stay finite.
    """
    how = simulation or Simulation()
    physics = with_given(parameters.physics(values), windows[0].given)
    measured = np.concatenate([window.measured for window in windows])
    # A motion that follows the log is not predicted.
    measured[:, list(windows[0].given)] = np.nan
    simulated, constant, longest = [], [], 0.0
    for window in windows:
        filled = _hold_last(window.measured)
        simulated.append(_run(window, filled[0], physics, how))
        constant.append(np.tile(filled[0], (len(filled), 1)))
        time_s = window.record.time_s
        longest = max(longest, float(time_s[-1] - time_s[0]))
    return MotionValidation(
        source=Path(windows[0].source).name,
        time_s=np.concatenate([w.record.time_s for w in windows]),
        measured=measured, simulated=np.concatenate(simulated), constant=np.concatenate(constant),
        window_s=longest,
    )  # fmt: skip


def _run(window: Window, motion: Array, physics: Physics, how: Simulation) -> Array:
    """Velocity over ground and rates, (T, 6), of a window simulated from those of its first row.

    Raises:
        VehicleError: the simulation does not stay finite.
    """
    start = window.start.copy()
    start[4:] = motion - physics.bias
    start[4:7] -= Rotation.from_quat(start[:4]).inv().apply([*physics.current_ne, 0.0])
    rows = len(window.record.time_s)
    states, observed = np.empty((rows, STATES)), np.empty((rows, CHANNELS))
    nothing = np.zeros(0, np.int64)
    simulate(
        physics, Terms(nothing, nothing, nothing), window.record, start, how.max_step_s,
        scratch_for(0, window.record.rps.shape[1]), np.zeros((STATES, 0)), states,
        observed, np.empty((rows, CHANNELS, 0)),
    )  # fmt: skip
    if not np.all(np.isfinite(observed[:, :_MOTIONS])):
        raise VehicleError(
            f"{window.source}: the simulation does not stay finite: simulate shorter stretches"
        )
    return observed[:, :_MOTIONS]


def _hold_last(measured: Array) -> Array:
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


JOINT_FREE = ("X_uu", "Y_vv", "Z_ww", "N_rr", "current")
TWO_STEP_FREE = ("X_udot", "X_uu", "Z_wdot", "Z_ww", "N_rdot", "N_rr")
"""Parameters free by default; the second as in the paper's three manoeuvres."""
_VALIDATION_WINDOW_S = 10.0
_HIGH_CORRELATION = 0.9
_POOR = 0.25
"""Relative sigma of a coefficient that the logs hardly determine."""
_AS_GOOD = 1.0
"""Points of fit by which two predictions may differ and be equally good."""
_MAX_POINTS = 8000


@dataclass(frozen=True, kw_only=True)
class IdentifyOptions:
    """Options of `vehicle identify`."""

    vehicle: str = DEFAULT_VEHICLE
    """A name, or a TOML or JSON file."""
    coefficients: str | None = None
    """A named set or a file to start from; the vehicle's own if not given."""
    validate: Path | None = None
    bollard: Path | None = None
    free: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    """`NAME=VALUE` of parameters that are not coefficients."""
    method: str = "joint"
    """`joint` or `two-step`."""
    columns: Path | None = None
    """Column map of the logs, if they do not have the documented columns."""
    given: tuple[str, ...] = ()
    """Rates that follow the log."""
    window_s: float | None = None
    """Longest stretch simulated in one go; as long as there are no gaps if not given."""
    prior: PriorSigmas | None = field(default_factory=PriorSigmas)
    """How far the vehicle may be from where the joint fit starts; anywhere if None."""


@dataclass(frozen=True, kw_only=True)
class _Identified:
    """Parameters by either method."""

    parameters: Parameters
    values: Array
    sigma: Array
    fit: OutputErrorFit | None
    """None of the two-step calibration."""
    steps: tuple[str, ...]
    """Step in which each was calibrated; none of the joint fit."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Validation:
    """A log predicted by the identified vehicle, and by the one that the fit began with."""

    found: MotionValidation
    started: MotionValidation | None = None
    current_ne: Array | None = None
    """(2,) current of that log, where it was fitted to it."""

    @property
    def worse(self) -> list[str]:
        """Motions that the start predicts better."""
        if self.started is None:
            return []
        gain = self.found.fit_percent - self.started.fit_percent
        return [name for name, g in zip(CHANNEL_NAMES[:6], gain, strict=True) if g < -_AS_GOOD]


def identify_report(
    logs: Sequence[Path], out: Path, options: IdentifyOptions
) -> tuple[str, dict[str, Any]]:
    """Identify a vehicle from logs; write coefficients.json, report.txt and fit.png into a folder.

    Without logs the vehicle is as it is known, and a log to validate is predicted by it.

    Raises:
        VehicleError: a file or an option is wrong, or the logs do not determine what is free.
    """
    if options.method not in ("joint", "two-step"):
        raise VehicleError(f"method {options.method!r} is not known: joint or two-step")
    vehicle = _vehicle_of(options)
    if not logs and options.validate is None:
        raise VehicleError("there is no log: name logs to fit, or one to predict by --validate LOG")
    thrust: list[ThrustCoefficient] = []
    if options.bollard is not None:
        thrust = fit_pulls(read_pulls(options.bollard), vehicle)
        vehicle = with_thrust(vehicle, thrust)
    windows = [window for path in logs for window in _windows(path, vehicle, options)]
    shorter: list[Window] = []
    if options.validate is not None:
        length_s = options.window_s if not logs else _VALIDATION_WINDOW_S
        shorter = _windows(options.validate, vehicle, options, length_s)
    used = of_windows([*windows, *shorter], vehicle)
    missing = speeds_missing(Path(options.vehicle)) if Path(options.vehicle).suffix else []
    if used.thrusters and missing:
        raise VehicleError(
            f"the logs give speeds, but {options.vehicle} does not say what they mean of "
            f"{'; '.join(missing)}"
        )
    how = Simulation()
    result = _identify(windows, used, how, options)
    validation = _validation(shorter, result, how) if shorter else None
    own = validate(windows, result.parameters, result.values, simulation=how) if windows else None
    data = _data(vehicle, logs, result, thrust, own, validation)
    text = _text(data, result, validation)
    try:
        out.mkdir(parents=True, exist_ok=True)
        if logs:
            identified = result.parameters.coefficients(result.values, "identified")
            write_coefficients(out / "coefficients.json", identified, data)
        (out / "report.txt").write_text(text + "\n", encoding="utf-8")
        shown = validation.found if validation is not None else own
        if shown is not None:
            draw_motion(out / "fit.png", f"{vehicle.name}: {shown.source}", shown)
    except OSError as error:
        raise VehicleError(f"{out}: cannot be written: {error.strerror}") from None
    return f"{text}\nwritten to {out}", data


def _vehicle_of(options: IdentifyOptions) -> Vehicle:
    """The vehicle by its name or file, with a set of coefficients by its name or file."""
    name, coefficients = options.vehicle, options.coefficients
    if coefficients is not None and Path(coefficients).suffix:
        vehicle = vehicle_from(name).with_coefficients(coefficients_from_file(Path(coefficients)))
    else:
        vehicle = vehicle_from(name) if coefficients is None else vehicle_from(name, coefficients)
    if vehicle.fins:
        raise VehicleError(
            f"{vehicle.name} is steered by fins, whose angles are not used: give the file of a "
            "vehicle without [[fins]], and logs of the whole wrench (X_n to N_nm)"
        )
    return vehicle


def _windows(
    path: Path, vehicle: Vehicle, options: IdentifyOptions, window_s: float | None = None
) -> list[Window]:
    if options.columns is None:
        log = read_vehicle_log(path)
    else:
        log = read_foreign_log(path, read_column_map(options.columns))
    return make_windows(log, vehicle, window_s=window_s or options.window_s, given=options.given)


def _identify(
    windows: Sequence[Window], vehicle: Vehicle, how: Simulation, options: IdentifyOptions
) -> _Identified:
    held, nothing = _held_values(options.held), np.zeros(0)
    if not windows:
        known = free_parameters(vehicle, (), _others_of(options.coefficients) | held)
        return _Identified(parameters=known, values=nothing, sigma=nothing, fit=None, steps=())
    free = options.free or (JOINT_FREE if options.method == "joint" else TWO_STEP_FREE)
    parameters = free_parameters(vehicle, free, held)
    if options.method == "two-step":
        found = calibrate(windows, parameters)
        return _Identified(
            parameters=parameters, values=found.values, sigma=found.sigma, fit=None,
            steps=found.step,
        )  # fmt: skip
    fit = fit_output_error(windows, parameters, simulation=how, prior=options.prior)
    return _Identified(parameters=parameters, values=fit.values, sigma=fit.sigma, fit=fit, steps=())


def _held_values(pairs: Sequence[str]) -> dict[str, float]:
    """Numbers by name, of `NAME=VALUE`."""
    values = {}
    for pair in pairs:
        name, _, value = pair.partition("=")
        try:
            values[name.strip()] = float(value)
        except ValueError:
            raise VehicleError(f"{pair!r} is not NAME=VALUE") from None
    return values


def _others_of(coefficients: str | None) -> dict[str, float]:
    """Buoyancy, trim, biases and gains of a file of `vehicle identify`; a current is of its day."""
    if coefficients is None or not Path(coefficients).suffix:
        return {}
    table = read_table(Path(coefficients)).get("others", {})
    found = parse_table(Path(coefficients), dict[str, float], table)
    return {name: value for name, value in found.items() if name not in CURRENTS}


def _validation(windows: Sequence[Window], result: _Identified, how: Simulation) -> _Validation:
    values, current_ne = _with_its_current(windows, result.parameters, result.values, how)
    found = validate(windows, result.parameters, values, simulation=how)
    if not len(values):
        return _Validation(found=found)
    try:
        start, _ = _with_its_current(windows, result.parameters, result.parameters.start, how)
        started = validate(windows, result.parameters, start, simulation=how)
    except VehicleError:  # the motions of the start may not last
        started = None
    return _Validation(found=found, started=started, current_ne=current_ne)


def _with_its_current(
    windows: Sequence[Window], parameters: Parameters, found: Array, how: Simulation
) -> tuple[Array, Array | None]:
    """Values for another log: coefficients are the vehicle's, a current is the day's.

    Where the current is free it is fitted to the other log, with everything else held.

    Returns:
        (P,) values, and the current (2,) towards north and east, if it was fitted.
    """
    if not set(CURRENTS) <= set(parameters.names):
        return found, None
    others = {
        name: value for name, value in parameters.others(found).items() if name not in CURRENTS
    }
    identified = parameters.vehicle.with_coefficients(parameters.coefficients(found, "identified"))
    drift = fit_output_error(
        windows, free_parameters(identified, CURRENTS, others), simulation=how
    ).values
    values = found.copy()
    for name, value in zip(CURRENTS, drift, strict=True):
        values[parameters.names.index(name)] = value
    return values, drift


def _cell(value: float | None, style: str) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:{style}}"


def _text(data: Mapping[str, Any], result: _Identified, validation: _Validation | None) -> str:
    """The report: one table, and a line for each fit."""
    found = {
        f"k_t {'+'.join(one['thrusters'])} {one['way']}": {
            **one, "start": one["model"], "unit": "", "remark": f"{one['readings']} readings"
        }
        for one in data["thrust"]
    }  # fmt: skip
    for k, (name, one) in enumerate(data["identified"].items()):
        found[name] = {**one, "remark": _remark(result, k)}
    styles = {"start": ".5g", "identified": ".5g", "sigma": ".2g", "factor": ".3g"}
    rows = [
        (
            name,
            *(_cell(one[key], style) for key, style in styles.items()),
            one["unit"],
            one["remark"],
        )
        for name, one in found.items()
    ]
    lines = [
        f"{data['vehicle']}, {data['method']}, fitted to {', '.join(data['logs']) or 'no log'}"
    ]
    if rows:
        lines.append(text_table(("coefficient", *styles, "unit", ""), rows))
    lines += [
        f"correlated {one['correlation']:+.3f}: {' and '.join(one['of'])}"
        for one in data.get("high_correlations", ())
    ]
    if result.fit is not None and result.fit.prior is not None:
        lines.append(f"prior about the start, relative sigmas: {result.fit.prior}")
    lines += [_fit_line(data[key]) for key in ("same_logs", "validation") if key in data]
    if validation is not None and validation.worse:
        lines.append(
            f"Worse than the values that the fit began with in {', '.join(validation.worse)}: "
            "free fewer coefficients, or log manoeuvres that excite these motions"
        )
    if validation is not None and validation.current_ne is not None:
        north, east = validation.current_ne
        lines.append(f"current of that log: {north:.3f} m/s north, {east:.3f} m/s east")
    return "\n".join(lines)


def _remark(result: _Identified, k: int) -> str:
    """What limits a parameter; of the two-step calibration the step as well."""
    name, fit = result.parameters.names[k], result.fit
    remarks = [result.steps[k]] if result.steps else []
    if name in poorly_determined(result.parameters.names, result.values, result.sigma):
        remarks.append(f"sigma over {_POOR:.0%}")
    if fit is not None and fit.at_bound[k]:
        remarks.append("at a bound")
    if fit is not None and name in held_by_prior(fit):
        remarks.append("held by the prior")
    return ", ".join(remarks)


def _fit_line(found: Mapping[str, Any]) -> str:
    """Fit of each motion, next to that of the start and of a velocity that is kept."""
    keys = ("fit_percent", "start_fit_percent", "constant_fit_percent")
    fits = "; ".join(
        f"{of} {' / '.join(_cell(value, '.1f') for value in found[key].values())}"
        for of, key in zip(("model", "start", "constant velocity"), keys, strict=True)
        if found.get(key) is not None
    )
    return f"fit of {found['source']} by {found['window_s']:.4g} s, % of u/v/w/p/q/r: {fits}"


def held_by_prior(fit: OutputErrorFit) -> list[str]:
    """Parameters whose variance comes of the start's error for more than a half."""
    logs, prior = np.diag(fit.covariance - fit.prior_covariance), np.diag(fit.prior_covariance)
    return [name for name, more in zip(fit.parameters.names, prior > logs, strict=True) if more]


def poorly_determined(names: Sequence[str], values: Array, sigma: Array) -> list[str]:
    """Coefficients whose sigma is a large part of their value."""
    return [
        name
        for name, value, s in zip(names, values, sigma, strict=True)
        if name not in OTHERS and math.isfinite(s) and s > _POOR * abs(value)
    ]


def high_correlations(fit: OutputErrorFit) -> list[tuple[str, str, float]]:
    """Pairs of parameters that the logs hardly separate, the closest first."""
    names, matrix = fit.parameters.names, fit.correlation
    pairs = [
        (names[i], names[j], float(matrix[i, j]))
        for i in range(len(names))
        for j in range(i)
        if math.isfinite(matrix[i, j]) and abs(matrix[i, j]) > _HIGH_CORRELATION
    ]
    return sorted(pairs, key=lambda pair: -abs(pair[2]))


def _data(
    vehicle: Vehicle,
    logs: Sequence[Path],
    result: _Identified,
    thrust: Sequence[ThrustCoefficient],
    own: MotionValidation | None,
    validation: _Validation | None,
) -> dict[str, Any]:
    """The same as JSON values; unknown ones are null."""
    names, fit, start = result.parameters.names, result.fit, result.parameters.start
    data: dict[str, Any] = {
        "vehicle": vehicle.name,
        "logs": [path.name for path in logs],
        "method": "joint" if fit is not None or not names else "two-step",
        "identified": {
            name: {
                "start": float(start[k]),
                "identified": float(result.values[k]),
                "sigma": _or_none(result.sigma[k]),
                "factor": None
                if name in OTHERS or start[k] == 0.0
                else float(result.values[k] / start[k]),
                "unit": unit_of(name),
            }
            for k, name in enumerate(names)
        },
        "others": result.parameters.others(result.values),
        "poorly_determined": poorly_determined(names, result.values, result.sigma),
        "thrust": [
            {**asdict(one), "sigma": _or_none(one.sigma), "factor": one.factor} for one in thrust
        ],
    }
    if own is not None:
        data["same_logs"] = _fit_data(own)
    if fit is not None:
        data["high_correlations"] = [
            {"of": [a, b], "correlation": value} for a, b, value in high_correlations(fit)
        ]
        data["residual_sigma"] = {
            name: _or_none(value)
            for name, value in zip(CHANNEL_NAMES, fit.channel_sigma, strict=True)
        }
        data["prior"] = None if fit.prior is None else asdict(fit.prior)
        data["held_by_prior"] = held_by_prior(fit)
        data["covariance"] = fit.covariance.tolist()
    if validation is not None:
        started = validation.started
        data["validation"] = {
            **_fit_data(validation.found),
            "start_fit_percent": None if started is None else _motions(started.fit_percent),
            "worse_than_start": validation.worse,
        }
    return data


def _or_none(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _motions(values: Array) -> dict[str, float | None]:
    return {name: _or_none(value) for name, value in zip(CHANNEL_NAMES[:6], values, strict=True)}


def _fit_data(found: MotionValidation) -> dict[str, Any]:
    return {
        "source": found.source,
        "window_s": found.window_s,
        "fit_percent": _motions(found.fit_percent),
        "constant_fit_percent": _motions(found.constant_fit_percent),
    }


@figure_style()
def draw_motion(path: Path, title: str, found: MotionValidation) -> None:
    """Draw measured and simulated velocities and rates, row by row of all windows."""
    figure = new_figure(8.5, 13)
    rows = np.arange(len(found.time_s))[:: max(len(found.time_s) // _MAX_POINTS, 1)]
    for k, axes in enumerate(figure.subplots(3, 2, sharex=True).T.flat):
        scale = 1.0 if k < 3 else math.degrees(1.0)
        axes.plot(rows, scale * found.measured[rows, k], ".", color=SOFT, ms=2.5, label="measured")
        axes.plot(rows, scale * found.simulated[rows, k], color=INKS[0], lw=1.1, label="model")
        axes.set_ylabel(f"{CHANNEL_NAMES[k]}, {'m/s' if k < 3 else 'deg/s'}")
        axes.set_title(f"fit {_cell(found.fit_percent[k], '.0f')} %")
    figure.axes[0].legend(loc="upper right", ncol=2)
    figure.supxlabel("row of the logs")
    figure.suptitle(title)
    save_figure(figure, path, dpi=110)
