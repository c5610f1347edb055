"""The command `vehicle identify`: from files to coefficients, a report and pictures."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.config import DEFAULT_VEHICLE
from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.files import speeds_missing, write_coefficients
from alice_survey.sim.vehicle.identification.bollard import (
    ThrustCoefficient,
    fit_pulls,
    read_pulls,
    with_thrust,
)
from alice_survey.sim.vehicle.identification.drawing import draw_motion
from alice_survey.sim.vehicle.identification.given import given_log, given_values, given_vehicle
from alice_survey.sim.vehicle.identification.output_error import (
    OutputErrorFit,
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
from alice_survey.sim.vehicle.identification.prior import PriorSigmas
from alice_survey.sim.vehicle.identification.two_step import calibrate
from alice_survey.sim.vehicle.identification.validation import MotionValidation, validate
from alice_survey.sim.vehicle.identification.windows import (
    CHANNEL_NAMES,
    Window,
    make_windows,
    of_windows,
)
from alice_survey.sim.vehicle.vehicle import Vehicle

JOINT_FREE = ("X_uu", "Y_vv", "Z_ww", "N_rr", "current")
TWO_STEP_FREE = ("X_udot", "X_uu", "Z_wdot", "Z_ww", "N_rdot", "N_rr")
"""Parameters free by default; the second as in the paper's three manoeuvres."""
_VALIDATION_WINDOW_S = 10.0
_HIGH_CORRELATION = 0.9
_POOR = 0.25
"""Relative sigma of a coefficient that the logs hardly determine."""


_AS_GOOD = 1.0
"""Points of fit by which two predictions may differ and be equally good."""


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
    hold_input: bool = False
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


def identify_report(
    logs: Sequence[Path], out: Path, options: IdentifyOptions
) -> tuple[str, dict[str, Any]]:
    """Identify a vehicle from logs; write coefficients.json, report.txt and figures into a folder.

    Raises:
        VehicleError: a file or an option is wrong, or the logs do not determine what is free.
    """
    if options.method not in ("joint", "two-step"):
        raise VehicleError(f"method {options.method!r} is not known: joint or two-step")
    vehicle = given_vehicle(options.vehicle, options.coefficients)
    if vehicle.fins:
        raise VehicleError(
            f"{vehicle.name} is steered by fins, whose angles are not used: give the file of a "
            "vehicle without [[fins]], and logs of the whole wrench (X_n to N_nm)"
        )
    thrust: list[ThrustCoefficient] = []
    if options.bollard is not None:
        thrust = fit_pulls(read_pulls(options.bollard), vehicle)
        vehicle = with_thrust(vehicle, thrust)
    windows = [window for path in logs for window in _windows(path, vehicle, options)]
    used = of_windows(windows, vehicle)
    if used.thrusters and Path(options.vehicle).suffix:
        missing = speeds_missing(Path(options.vehicle))
        if missing:
            raise VehicleError(
                f"the logs give speeds, but {options.vehicle} does not say what they mean of "
                f"{'; '.join(missing)}"
            )
    free = options.free or (JOINT_FREE if options.method == "joint" else TWO_STEP_FREE)
    parameters = free_parameters(used, free, given_values(options.held))
    how = Simulation(hold=options.hold_input)
    result = _identify(windows, parameters, how, options)
    validation, started, drift = None, None, None
    if options.validate is not None:
        shorter = _windows(options.validate, vehicle, options, _VALIDATION_WINDOW_S)
        of_windows([*windows, *shorter], vehicle)
        values, drift = _with_its_current(shorter, parameters, result.values, how)
        validation = validate(shorter, parameters, values, simulation=how)
        started = _from_start(shorter, parameters, how)
    own = validate(windows, parameters, result.values, simulation=how, horizons_s=())
    text = _text(vehicle, logs, result, thrust, own, validation, started, drift, options)
    data = _data(vehicle, logs, result, thrust, own, validation, started)
    try:
        out.mkdir(parents=True, exist_ok=True)
        identified = parameters.coefficients(result.values, "identified")
        write_coefficients(out / "coefficients.json", identified, data)
        (out / "report.txt").write_text(text + "\n", encoding="utf-8")
        draw_motion(out / "fit.png", f"{vehicle.name}: the logs it was identified from", own)
        if validation is not None:
            title = f"{vehicle.name}: predicted, {Path(validation.source).name}"
            draw_motion(out / "validation.png", title, validation)
    except OSError as error:
        raise VehicleError(f"{out}: cannot be written: {error.strerror}") from None
    return f"{text}\n\nwritten to {out}", data


def _windows(
    path: Path, vehicle: Vehicle, options: IdentifyOptions, window_s: float | None = None
) -> list[Window]:
    log = given_log(path, options.columns)
    return make_windows(log, vehicle, window_s=window_s or options.window_s, given=options.given)


def _identify(
    windows: Sequence[Window], parameters: Parameters, how: Simulation, options: IdentifyOptions
) -> _Identified:
    if options.method == "two-step":
        found = calibrate(windows, parameters)
        return _Identified(
            parameters=parameters, values=found.values, sigma=found.sigma, fit=None,
            steps=found.step,
        )  # fmt: skip
    fit = fit_output_error(windows, parameters, simulation=how, prior=options.prior)
    return _Identified(parameters=parameters, values=fit.values, sigma=fit.sigma, fit=fit, steps=())


def _from_start(
    windows: Sequence[Window], parameters: Parameters, how: Simulation
) -> MotionValidation | None:
    """Motions of another log by the values that the fit began with; None if they do not last."""
    try:
        values, _ = _with_its_current(windows, parameters, parameters.start, how)
        return validate(windows, parameters, values, simulation=how, horizons_s=())
    except VehicleError:
        return None


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


def _factor(start: float, value: float) -> float:
    return value / start if start else math.nan


def _cell(value: float, style: str) -> str:
    return f"{value:{style}}" if math.isfinite(value) else "-"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table, the first column to the left."""
    widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
    return [
        "  ".join(
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in (head, *rows)
    ]


def _text(
    vehicle: Vehicle,
    logs: Sequence[Path],
    result: _Identified,
    thrust: Sequence[ThrustCoefficient],
    own: MotionValidation,
    validation: MotionValidation | None,
    started: MotionValidation | None,
    drift: Array | None,
    options: IdentifyOptions,
) -> str:
    lines = [
        f"{vehicle.name} by the {options.method} "
        f"{'fit' if options.method == 'joint' else 'calibration'} to "
        f"{', '.join(path.name for path in logs)}; from {vehicle.coefficients.name!r} coefficients",
        "",
    ]
    if thrust:
        rows = [
            (
                f"{'+'.join(one.thrusters)} {one.way}", f"{one.model:.4g}", f"{one.identified:.4g}",
                _cell(one.sigma, ".2g"), f"{one.factor:.3g}", str(one.readings),
            )
            for one in thrust
        ]  # fmt: skip
        head = ("k_t by bollard pull", "model", "identified", "sigma", "factor", "readings")
        lines += [*_table(head, rows), ""]
    rows_ = []
    for k, name in enumerate(result.parameters.names):
        start, value = float(result.parameters.start[k]), float(result.values[k])
        factor = math.nan if name in OTHERS else _factor(start, value)
        row = [
            name, f"{start:.5g}", f"{value:.5g}", _cell(float(result.sigma[k]), ".2g"),
            _cell(factor, ".3g"), unit_of(name),
        ]  # fmt: skip
        rows_.append([*row, result.steps[k]] if result.steps else row)
    head_ = ["coefficient", "start", "identified", "sigma", "factor", "unit"]
    lines += _table([*head_, "step"] if result.steps else head_, rows_)
    lines += _remarks(result)
    lines += ["", *_fit_lines("Simulated over the same logs", own)]
    if validation is not None:
        lines += ["", *_fit_lines(f"Validated on {validation.source}", validation, started)]
        worse = _worse(validation, started)
        if worse:
            lines.append(
                f"Worse than the values that the fit began with in {', '.join(worse)}: there the "
                "logs say less than is known of the vehicle; free fewer coefficients, or log "
                "manoeuvres that excite these motions"
            )
    if drift is not None:
        lines.append(
            f"The current of that log, fitted to it with all else held: {drift[0]:.3f} m/s to the "
            f"north, {drift[1]:.3f} m/s to the east"
        )
    return "\n".join(lines)


def _remarks(result: _Identified) -> list[str]:
    """Caveats on the numbers."""
    lines = [""]
    names, fit = result.parameters.names, result.fit
    poor = poorly_determined(names, result.values, result.sigma)
    if poor:
        lines.append(f"hardly determined (sigma over {_POOR:.0%}): {', '.join(poor)}")
    if fit is None:
        lines.append("Sigmas are those of the regressions; noise pulls coefficients towards zero.")
        return lines
    bound = [name for name, held in zip(names, fit.at_bound, strict=True) if held]
    if bound:
        lines.append(f"at a bound, so without sigma: {', '.join(bound)}")
    lines += [f"correlated {value:+.3f}: {a} and {b}" for a, b, value in high_correlations(fit)]
    lines += _prior_lines(fit)
    sigma = ", ".join(
        f"{name} {value * scale:.3g} {unit}"
        for name, value, scale, unit in zip(
            CHANNEL_NAMES, fit.channel_sigma, [1.0] * 3 + [180 / math.pi] * 6,
            ["m/s"] * 3 + ["deg/s"] * 3 + ["deg"] * 3, strict=True,
        )
        if math.isfinite(value)
    )  # fmt: skip
    lines.append(f"residuals: {sigma}")
    white = np.sqrt(np.diag(fit.white_covariance))
    ratio = np.max(np.where(fit.at_bound, 1.0, fit.sigma / np.where(white > 0, white, 1.0)))
    longest = float(np.nanmax(fit.correlation_s))
    if ratio > 1.2:
        lines.append(
            f"Residuals are correlated (over {longest:.2g} s): the model misses something or the "
            f"vehicle was pushed unseen. Sigmas allow for it (up to {ratio:.2g} times those of "
            "white noise), but not for what a wrong model shifts."
        )
    return lines


def _prior_lines(fit: OutputErrorFit) -> list[str]:
    """What the prior was, and where it says more than the logs."""
    if fit.prior is None:
        return []
    lines = [f"prior about the start, relative sigmas: {fit.prior}"]
    held = held_by_prior(fit)
    if held:
        lines.append(f"held by the prior more than by the logs: {', '.join(held)}")
    return lines


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


def _worse(found: MotionValidation, started: MotionValidation | None) -> list[str]:
    """Motions that the start predicts better than the fit."""
    if started is None:
        return []
    gain = found.fit_percent - started.fit_percent
    return [name for name, g in zip(CHANNEL_NAMES[:6], gain, strict=True) if g < -_AS_GOOD]


def _fit_lines(
    title: str, found: MotionValidation, started: MotionValidation | None = None
) -> list[str]:
    """Fit of each motion, and the errors of forecasts."""
    names = CHANNEL_NAMES[:6]
    lines = [
        f"{title}, in stretches of at most {found.window_s:.4g} s, each from its first row",
        "fit = 100 (1 - |y - model| / |y - mean y|) %; constant: that row's velocity is kept"
        + ("; start: the values that the fit began with" if started is not None else ""),
    ]
    fits, constant = found.fit_percent, found.constant_fit_percent
    rows = [
        ("model", *(_cell(value, ".1f") for value in fits)),
        ("constant", *(_cell(value, ".1f") for value in constant)),
    ]
    if started is not None:
        rows.insert(1, ("start", *(_cell(value, ".1f") for value in started.fit_percent)))
    lines += _table(("fit, %", *names), rows)
    if found.forecasts:
        rows = [
            (
                f"after {one.horizon_s:g} s",
                *(
                    f"{_cell(a, '.3g')} / {_cell(b, '.3g')}"
                    for a, b in zip(one.model, one.constant, strict=True)
                ),
            )
            for one in found.forecasts
        ]
        head = ("rms error, model / constant (m/s, rad/s)", *names)
        lines += ["", *_table(head, rows)]
    return lines


def _data(
    vehicle: Vehicle,
    logs: Sequence[Path],
    result: _Identified,
    thrust: Sequence[ThrustCoefficient],
    own: MotionValidation,
    validation: MotionValidation | None,
    started: MotionValidation | None,
) -> dict[str, Any]:
    """The same as JSON values; unknown ones are null."""

    def known(value: float) -> float | None:
        return float(value) if math.isfinite(value) else None

    def motions(values: Array) -> dict[str, float | None]:
        return {name: known(v) for name, v in zip(CHANNEL_NAMES[:6], values, strict=True)}

    def fits(found: MotionValidation) -> dict[str, Any]:
        return {
            "source": found.source,
            "window_s": found.window_s,
            "fit_percent": motions(found.fit_percent),
            "constant_fit_percent": motions(found.constant_fit_percent),
            "forecasts": [
                {
                    "horizon_s": one.horizon_s,
                    "starts": one.starts,
                    "model_rms": motions(one.model),
                    "constant_rms": motions(one.constant),
                }
                for one in found.forecasts
            ],
        }

    fit, start = result.fit, result.parameters.start
    identified = {
        name: {
            "start": float(start[k]),
            "identified": float(result.values[k]),
            "sigma": known(float(result.sigma[k])),
            "factor": None
            if name in OTHERS
            else known(_factor(float(start[k]), float(result.values[k]))),
            "unit": unit_of(name),
        }
        for k, name in enumerate(result.parameters.names)
    }
    data: dict[str, Any] = {
        "vehicle": vehicle.name,
        "logs": [path.name for path in logs],
        "method": "joint" if fit is not None else "two-step",
        "identified": identified,
        "others": result.parameters.others(result.values),
        "poorly_determined": poorly_determined(
            result.parameters.names, result.values, result.sigma
        ),
        "thrust": [
            {**asdict(one), "sigma": known(one.sigma), "factor": one.factor} for one in thrust
        ],
        "same_logs": fits(own),
    }
    if fit is not None:
        data["high_correlations"] = [
            {"of": [a, b], "correlation": value} for a, b, value in high_correlations(fit)
        ]
        data["residual_sigma"] = {
            name: known(float(value))
            for name, value in zip(CHANNEL_NAMES, fit.channel_sigma, strict=True)
        }
        data["prior"] = None if fit.prior is None else asdict(fit.prior)
        data["held_by_prior"] = held_by_prior(fit)
        data["covariance"] = [[float(value) for value in row] for row in fit.covariance]
    if validation is not None:
        data["validation"] = {
            **fits(validation),
            "start_fit_percent": None if started is None else motions(started.fit_percent),
            "worse_than_start": _worse(validation, started),
        }
    return data
