"""The command `vehicle identify`: from logs to coefficients, a table and a picture.

Without logs to fit, `--validate` alone runs a log through the vehicle as it is known, open loop.

Prediction errors of a model on a log it was not fitted to.

The fit of a velocity is 100 (1 - |y - y_model| / |y - mean(y)|) per cent over the rows where it was
measured (normalised root mean square, as in the System Identification Toolbox's `compare`): 100 is
perfect, 0 no better than the mean. Simulations start from what is measured in their first row and
see only the inputs from there on; next to them the velocity of that row is kept.
"""

import itertools
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
from alice_survey.sim.vehicle.identification.output_error import (
    MAX_STEP_S,
    OutputErrorFit,
    PriorSigmas,
    fit_output_error,
)
from alice_survey.sim.vehicle.identification.problem import (
    CHANNEL_NAMES,
    CURRENTS,
    OTHERS,
    Parameters,
    Window,
    free_parameters,
    make_windows,
    of_windows,
    unit_of,
)
from alice_survey.sim.vehicle.identification.sensitivity import Physics, simulate, with_given
from alice_survey.sim.vehicle.identification.two_step import (
    ThrustCoefficient,
    TwoStep,
    calibrate,
    fit_pulls,
    read_pulls,
    with_thrust,
)
from alice_survey.sim.vehicle.log import read_column_map, read_foreign_log, read_vehicle_log
from alice_survey.sim.vehicle.vehicle import (
    Vehicle,
    coefficients_from_file,
    parse_table,
    read_table,
    speeds_missing,
    vehicle_from,
    write_coefficients,
)

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
    max_step_s: float = MAX_STEP_S,
) -> MotionValidation:
    """Compare simulations with windows of a log.

    Args:
        windows: windows of the log.
        parameters: parameters of the model.
        values: (P,) theirs.
        max_step_s: longest step of the simulation.

    Raises:
        VehicleError: a simulation does not stay finite.
    """
    physics = with_given(parameters.physics(values), windows[0].given)
    measured = np.concatenate([window.measured for window in windows])
    # A motion that follows the log is not predicted.
    measured[:, list(windows[0].given)] = np.nan
    simulated, constant, longest = [], [], 0.0
    for window in windows:
        simulated.append(_run(window, physics, max_step_s))
        constant.append(np.tile(window.start[4:], (len(window.measured), 1)))
        time_s = window.record.time_s
        longest = max(longest, float(time_s[-1] - time_s[0]))
    return MotionValidation(
        source=Path(windows[0].source).name,
        time_s=np.concatenate([w.record.time_s for w in windows]),
        measured=measured, simulated=np.concatenate(simulated), constant=np.concatenate(constant),
        window_s=longest,
    )  # fmt: skip


def _run(window: Window, physics: Physics, max_step_s: float) -> Array:
    """Velocity over ground and rates, (T, 6), of a window simulated from its start.

    Raises:
        VehicleError: the simulation does not stay finite.
    """
    start = window.start.copy()
    start[4:] -= physics.bias
    start[4:7] -= Rotation.from_quat(start[:4]).inv().apply([*physics.current_ne, 0.0])
    _, observed, _ = simulate(physics, None, window.record, start, max_step_s)
    if not np.all(np.isfinite(observed[:, :_MOTIONS])):
        raise VehicleError(
            f"{window.source}: the simulation does not stay finite: simulate shorter stretches"
        )
    return observed[:, :_MOTIONS]


JOINT_FREE = ("X_uu", "Y_vv", "Z_ww", "N_rr", "current")
TWO_STEP_FREE = ("X_udot", "X_uu", "Z_wdot", "Z_ww", "N_rdot", "N_rr")
"""Parameters free by default; the second as in the paper's three manoeuvres."""
_VALIDATION_WINDOW_S = 10.0
_HIGH_CORRELATION = 0.9
_POOR = 0.25
"""Relative sigma of a coefficient that the logs hardly determine."""
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


def identify_report(
    logs: Sequence[Path], out: Path, options: IdentifyOptions
) -> tuple[str, dict[str, Any]]:
    """Identify a vehicle from logs; write coefficients.json and fit.png into a folder.

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
    found = _identify(windows, used, options)
    parameters, values, shown = found.parameters, found.values, None
    data: dict[str, Any] = {
        "vehicle": vehicle.name,
        "logs": [path.name for path in logs],
        "method": options.method,
        "identified": {name: _row(found, k) for k, name in enumerate(parameters.names)},
        "others": parameters.others(values),
        "thrust": [
            {**asdict(one), "sigma": _or_none(one.sigma), "factor": one.factor} for one in thrust
        ],
        **({} if isinstance(found, TwoStep) else _fit_data(found)),
    }
    if windows:
        shown = validate(windows, parameters, values)
        data["same_logs"] = _fits_of(shown)
    if shorter:
        shown, data["validation"] = _validation(shorter, parameters, values)
    text = _text(data)
    try:
        out.mkdir(parents=True, exist_ok=True)
        if logs:
            identified = parameters.coefficients(values, "identified")
            write_coefficients(out / "coefficients.json", identified, data)
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
    windows: Sequence[Window], vehicle: Vehicle, options: IdentifyOptions
) -> OutputErrorFit | TwoStep:
    held = _held_values(options.held)
    if not windows:
        known = free_parameters(vehicle, (), _others_of(options.coefficients) | held)
        return TwoStep(parameters=known, values=np.zeros(0), sigma=np.zeros(0), step=())
    free = options.free or (JOINT_FREE if options.method == "joint" else TWO_STEP_FREE)
    parameters = free_parameters(vehicle, free, held)
    if options.method == "two-step":
        return calibrate(windows, parameters)
    return fit_output_error(windows, parameters, prior=options.prior)


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


def _validation(
    windows: Sequence[Window], parameters: Parameters, values: Array
) -> tuple[MotionValidation, dict[str, Any]]:
    """A log predicted by the identified vehicle, next to the one that the fit began with."""
    found, current_ne = _with_its_current(windows, parameters, values)
    shown, started = validate(windows, parameters, found), None
    if len(values):
        try:
            start, _ = _with_its_current(windows, parameters, parameters.start)
            started = _motions(validate(windows, parameters, start).fit_percent)
        except VehicleError:  # the motions of the start may not last
            started = None
    return shown, {
        **_fits_of(shown),
        "start_fit_percent": started,
        "current_ne_mps": None if current_ne is None else current_ne.tolist(),
    }


def _with_its_current(
    windows: Sequence[Window], parameters: Parameters, found: Array
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
    drift = fit_output_error(windows, free_parameters(identified, CURRENTS, others)).values
    values = found.copy()
    values[[parameters.names.index(name) for name in CURRENTS]] = drift
    return values, drift


def _row(found: OutputErrorFit | TwoStep, k: int) -> dict[str, Any]:
    """A parameter as JSON values, with what limits it; unknown ones are null."""
    name, start = found.parameters.names[k], float(found.parameters.start[k])
    value, sigma = float(found.values[k]), float(found.sigma[k])
    remarks = [] if isinstance(found, OutputErrorFit) else [found.step[k]]
    if name not in OTHERS and math.isfinite(sigma) and sigma > _POOR * abs(value):
        remarks.append(f"sigma over {_POOR:.0%}")
    if isinstance(found, OutputErrorFit):
        prior = found.prior_covariance[k, k]
        remarks += ["at a bound"] if found.at_bound[k] else []
        remarks += ["left at its start"] if found.at_start[k] else []
        remarks += ["held by the prior"] if 2.0 * prior > found.covariance[k, k] else []
    return {
        "start": start,
        "identified": value,
        "sigma": _or_none(sigma),
        "factor": None if name in OTHERS or start == 0.0 else value / start,
        "unit": unit_of(name),
        "remark": ", ".join(remarks),
    }


def _fit_data(fit: OutputErrorFit) -> dict[str, Any]:
    """What the joint fit knows besides: pairs that the logs hardly separate, noise, prior."""
    names, matrix = fit.parameters.names, fit.correlation
    pairs = [
        {"of": [names[i], names[j]], "correlation": float(matrix[i, j])}
        for i, j in itertools.combinations(range(len(names)), 2)
        if math.isfinite(matrix[i, j]) and abs(matrix[i, j]) > _HIGH_CORRELATION
    ]
    shares = 100.0 * fit.closer[:, :_MOTIONS]
    return {
        "high_correlations": sorted(pairs, key=lambda pair: -abs(pair["correlation"])),
        "closer_percent": _motions(shares[0]),
        "closer_percent_sigma": _motions(shares[1]),
        "prior": None if fit.prior is None else asdict(fit.prior),
        "covariance": fit.covariance.tolist(),
    }


def _or_none(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _motions(values: Array) -> dict[str, float | None]:
    return dict(zip(CHANNEL_NAMES[:6], map(_or_none, values), strict=True))


def _fits_of(found: MotionValidation) -> dict[str, Any]:
    return {
        "source": found.source,
        "window_s": found.window_s,
        "fit_percent": _motions(found.fit_percent),
        "constant_fit_percent": _motions(found.constant_fit_percent),
    }


def _cell(value: float | None, style: str) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:{style}}"


def _text(data: Mapping[str, Any]) -> str:
    """The report: one table, and a line for each log's fit."""
    thrust = {
        f"k_t {'+'.join(one['thrusters'])} {one['way']}": {
            **one, "start": one["model"], "unit": "", "remark": f"{one['readings']} readings"
        }
        for one in data["thrust"]
    }  # fmt: skip
    styles = {"start": ".5g", "identified": ".5g", "sigma": ".2g", "factor": ".3g"}
    rows = [
        (name, *(_cell(one[key], styles[key]) for key in styles), one["unit"], one["remark"])
        for name, one in (thrust | data["identified"]).items()
    ]
    logs = ", ".join(data["logs"]) or "no log"
    lines = [f"{data['vehicle']}, {data['method']}, fitted to {logs}"]
    if rows:
        lines.append(text_table(("coefficient", *styles, "unit", ""), rows))
    lines += [
        f"correlated {one['correlation']:+.3f}: {' and '.join(one['of'])}"
        for one in data.get("high_correlations", ())
    ]
    lines += [_fit_line(data[key]) for key in ("same_logs", "validation") if key in data]
    current_ne = data.get("validation", {}).get("current_ne_mps")
    if current_ne is not None:
        north, east = current_ne
        lines.append(f"current of that log: {north:.3f} m/s north, {east:.3f} m/s east")
    return "\n".join(lines)


def _fit_line(found: Mapping[str, Any]) -> str:
    """Fit of each motion, next to that of the start and of a velocity that is kept."""
    keys = ("fit_percent", "start_fit_percent", "constant_fit_percent")
    fits = "; ".join(
        f"{of} {' / '.join(_cell(value, '.1f') for value in found[key].values())}"
        for of, key in zip(("model", "start", "constant velocity"), keys, strict=True)
        if found.get(key) is not None
    )
    return f"fit of {found['source']} by {found['window_s']:.4g} s, % of u/v/w/p/q/r: {fits}"


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
