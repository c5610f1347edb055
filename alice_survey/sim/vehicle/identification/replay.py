"""The command `vehicle replay`: a whole log through the model, open loop, next to the measured.

The model starts from what the first row measured and from there on sees the inputs alone: speeds
of the thrusters, thrusts or the wrench. Velocities, rates, attitude and place are its own, so that
errors add up as in a dive without any sensor (the paper's section VI). It starts from what is
measured again after each gap of the log, and every `reset_s` if so wanted; every start is listed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from alice_survey.core.config import DEFAULT_VEHICLE
from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.files import read_table, validated
from alice_survey.sim.vehicle.identification.drawing import draw_replay
from alice_survey.sim.vehicle.identification.given import given_log, given_values, given_vehicle
from alice_survey.sim.vehicle.identification.output_error import Simulation
from alice_survey.sim.vehicle.identification.parameters import CURRENTS, GAINS, OTHERS, Parameters
from alice_survey.sim.vehicle.identification.sensitivity import with_given
from alice_survey.sim.vehicle.identification.validation import (
    fit_percent,
    measured_start,
    simulated,
)
from alice_survey.sim.vehicle.identification.windows import make_windows, of_windows
from alice_survey.sim.vehicle.log import VehicleLog, attitude_of, vehicle_log, write_vehicle_log
from alice_survey.sim.vehicle.propulsion import turned_speeds
from alice_survey.sim.vehicle.vehicle import Vehicle

AXES = ("u", "v", "w", "p", "q", "r", "roll", "pitch", "heading", "north", "east", "depth")
_UNITS = ("m/s",) * 3 + ("deg/s",) * 3 + ("deg",) * 3 + ("m",) * 3
_DRIFTS = range(6, 12)
"""Axes whose errors add up."""


@dataclass(frozen=True, kw_only=True)
class ReplayOptions:
    """Options of `vehicle replay`."""

    vehicle: str = DEFAULT_VEHICLE
    coefficients: str | None = None
    """A named set or a file; the vehicle's own if not given. What a file of `vehicle identify` says
    of buoyancy, trim, biases and gains is taken, too; its current is of another day."""
    held: tuple[str, ...] = ()
    """`NAME=VALUE` of parameters that are not coefficients."""
    columns: Path | None = None
    given: tuple[str, ...] = ()
    hold_input: bool = False
    commanded: bool = False
    """Speeds of the log were commanded: they go through each thruster's lag and limits."""
    reset_s: float | None = None
    """Longest stretch without a start from what is measured; the whole log if not given."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Replay:
    """A log and the model's motion by its inputs; degrees."""

    source: str
    time_s: Array
    """(T,) of the rows that are simulated."""
    measured: Array
    """(T, 12) in the order of `AXES`; NaN where not measured."""
    simulated: Array
    """(T, 12); the place is NaN where the start has none."""
    quaternion_xyzw: Array
    """(T, 4) simulated attitude."""
    starts: tuple[int, ...]
    """Rows at which the model starts from what is measured."""

    @property
    def errors(self) -> Array:
        """(T, 12) simulated minus measured; angles the short way round."""
        errors = self.simulated - self.measured
        errors[:, 6:9] = (errors[:, 6:9] + 180.0) % 360.0 - 180.0
        return errors

    @property
    def drift_per_min(self) -> Array:
        """(12,) root mean square over stretches of the last error by the stretch's minutes."""
        drifts = []
        for a, b in self._stretches():
            rows = self.errors[a:b]
            rows[:, 6:9] = _unwrapped(rows[:, 6:9])
            for column, series in enumerate(rows.T):
                known = np.flatnonzero(np.isfinite(series))
                last = known[-1] if len(known) else 0
                minutes = (self.time_s[a + last] - self.time_s[a]) / 60.0
                drifts.append((column, series[last] / minutes if minutes > 0 else np.nan))
        return np.array(
            [_rms(np.array([value for k, value in drifts if k == axis])) for axis in range(12)]
        )

    @property
    def max_s(self) -> float:
        """Duration of the longest stretch."""
        return max(float(self.time_s[b - 1] - self.time_s[a]) for a, b in self._stretches())

    def _stretches(self) -> list[tuple[int, int]]:
        return list(zip(self.starts, (*self.starts[1:], len(self.time_s)), strict=True))


def replay(
    log: VehicleLog,
    vehicle: Vehicle,
    *,
    others: dict[str, float] | None = None,
    given: Sequence[str] = (),
    reset_s: float | None = None,
    simulation: Simulation | None = None,
) -> Replay:
    """Simulate a whole log by its inputs.

    Args:
        log: with attitude, motion and inputs, as for identification.
        vehicle: the model.
        others: values of parameters that are not coefficients; as in the vehicle if not named.
        given: rates, of p, q and r, that follow the log instead of the forces.
        reset_s: longest stretch without a start from what is measured; gaps start one anyway.
        simulation: steps and inputs.

    Raises:
        VehicleError: the log lacks something, or the simulation does not stay finite.
    """
    how = simulation or Simulation()
    windows = make_windows(log, vehicle, window_s=reset_s, given=given)
    used = of_windows(windows, vehicle)
    physics = Parameters(vehicle=used, names=(), fixed=others or {}).physics(np.zeros(0))
    physics = with_given(physics, windows[0].given)
    times, motions, attitudes, places, rows, starts = [], [], [], [], [], [0]
    for window in windows:
        time_s = window.record.time_s
        quaternion, motion = simulated(window, measured_start(window, physics), physics, how)
        begin = int(np.searchsorted(log.time_s, time_s[0]))
        rows.append(np.arange(begin, begin + len(time_s)))
        ned = Rotation.from_quat(quaternion).apply(motion[:, :3] - physics.bias[:3])
        steps = 0.5 * (ned[1:] + ned[:-1]) * np.diff(time_s)[:, None]
        moved = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
        places.append(_first_places(time_s, log.position_ned[rows[-1]], moved) + moved)
        times.append(time_s)
        motions.append(motion)
        attitudes.append(quaternion)
        starts.append(starts[-1] + len(time_s))
    taken, quaternions = np.concatenate(rows), np.concatenate(attitudes)
    turn = np.rad2deg(1.0)
    measured = np.column_stack(
        [
            log.velocity_body[taken], turn * log.rates_body[taken],
            turn * log.attitude_rad[taken], log.position_ned[taken],
        ]
    )  # fmt: skip
    motion = np.concatenate(motions)
    simulated_all = np.column_stack(
        [motion[:, :3], turn * motion[:, 3:], turn * attitude_of(quaternions), *[np.vstack(places)]]
    )
    for place in windows[0].given:
        measured[:, place] = np.nan
    return Replay(
        source=Path(log.source).name, time_s=np.concatenate(times), measured=measured,
        simulated=simulated_all, quaternion_xyzw=quaternions, starts=tuple(starts[:-1]),
    )  # fmt: skip


def replay_report(log: Path, out: Path, options: ReplayOptions) -> tuple[str, dict[str, Any]]:
    """Replay a log; write report.txt, replay.png and the simulated motion, replay.csv.

    Raises:
        VehicleError: a file or an option is wrong, or the simulation does not stay finite.
    """
    vehicle = given_vehicle(options.vehicle, options.coefficients)
    others = _others_of(options.coefficients) | given_values(options.held)
    unknown = [name for name in others if name not in OTHERS]
    if unknown:
        raise VehicleError(f"{unknown[0]} cannot be held; these can: {', '.join(OTHERS)}")
    read = given_log(log, options.columns)
    if options.commanded:
        read = _turned(read, vehicle)
    how = Simulation(hold=options.hold_input)
    found = replay(
        read, vehicle, others=others, given=options.given, reset_s=options.reset_s, simulation=how
    )
    data = _data(found, vehicle, others)
    text = _text(found, vehicle, data, options)
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "report.txt").write_text(text + "\n", encoding="utf-8")
        draw_replay(
            out / "replay.png", f"{vehicle.name}: {found.source}, open loop", found.time_s,
            found.measured, found.simulated, found.starts,
            [f"{name}, {unit}" for name, unit in zip(AXES, _UNITS, strict=True)],
        )  # fmt: skip
        write_vehicle_log(out / "replay.csv", _log_of(found))
    except OSError as error:
        raise VehicleError(f"{out}: cannot be written: {error.strerror}") from None
    return f"{text}\n\nwritten to {out}", data


def _first_places(time_s: Array, position: Array, moved: Array) -> Array:
    """Place, (3,), at the start of a stretch: of the first row that measured it, less the way."""
    first = np.full(3, np.nan)
    for axis in range(3):
        known = np.flatnonzero(np.isfinite(position[:, axis]))
        if len(known):
            first[axis] = position[known[0], axis] - moved[known[0], axis]
    return first


def _turned(log: VehicleLog, vehicle: Vehicle) -> VehicleLog:
    """The log with the speeds that thrusters turn by those that it commands."""
    by_name = {thruster.name: thruster for thruster in vehicle.thrusters}
    if not log.rpm:
        raise VehicleError(f"{log.source}: --commanded is of rpm_NAME columns, and there are none")
    rpm = {}
    for name, commanded in log.rpm.items():
        if name not in by_name:
            raise VehicleError(f"{log.source}: {vehicle.name} has no thruster {name!r}")
        known = np.flatnonzero(np.isfinite(commanded))
        rpm[name] = np.full(len(commanded), np.nan)
        asked = commanded[known] / 60.0
        rpm[name][known] = 60.0 * turned_speeds(log.time_s[known], asked, by_name[name])
    return replace(log, rpm=rpm)


def _others_of(coefficients: str | None) -> dict[str, float]:
    """Buoyancy, trim, biases and gains of a file that `vehicle identify` wrote."""
    if coefficients is None or not Path(coefficients).suffix:
        return {}
    table = read_table(Path(coefficients)).get("others", {})
    found = validated(Path(coefficients), dict[str, float], table)
    return {name: value for name, value in found.items() if name not in CURRENTS}


def _log_of(found: Replay) -> VehicleLog:
    """The simulated motion as a vehicle log."""
    return vehicle_log(
        found.time_s, source=found.source, position_ned=found.simulated[:, 9:],
        quaternion_xyzw=found.quaternion_xyzw, velocity_body=found.simulated[:, :3],
        rates_body=np.deg2rad(found.simulated[:, 3:6]),
    )  # fmt: skip


def _unwrapped(degrees: Array) -> Array:
    """Angles, (T, K), without the jumps of the circle; NaN stays."""
    result = degrees.copy()
    for column in result.T:
        known = np.isfinite(column)
        column[known] = np.unwrap(column[known], period=360.0)
    return result


def _rms(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else math.nan


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _data(found: Replay, vehicle: Vehicle, others: dict[str, float]) -> dict[str, Any]:
    errors, drift = found.errors, found.drift_per_min
    fits = fit_percent(found.measured[:, :6], found.simulated[:, :6])
    axes = {}
    for k, name in enumerate(AXES):
        known = errors[np.isfinite(errors[:, k]), k]
        axes[name] = {
            "unit": _UNITS[k],
            "rms": _known(_rms(known)),
            "mean": _known(float(known.mean())) if len(known) else None,
            "worst": _known(float(np.abs(known).max())) if len(known) else None,
            "fit_percent": _known(float(fits[k])) if k < 6 else None,
            "drift_per_min": _known(float(drift[k])) if k in _DRIFTS else None,
        }
    return {
        "log": found.source,
        "vehicle": vehicle.name,
        "coefficients": vehicle.coefficients.name,
        "others": others,
        "rows": len(found.time_s),
        "duration_s": float(found.time_s[-1] - found.time_s[0]),
        "longest_stretch_s": found.max_s,
        "starts_s": [float(found.time_s[row] - found.time_s[0]) for row in found.starts],
        "axes": axes,
    }


_NAMED = 8


def _text(found: Replay, vehicle: Vehicle, data: dict[str, Any], options: ReplayOptions) -> str:
    starts = data["starts_s"]
    listed = ", ".join(f"{s:.4g}" for s in starts[:_NAMED])
    more = f" and {len(starts) - _NAMED} more" if len(starts) > _NAMED else ""
    resets = "" if options.reset_s is None else f", every {options.reset_s:g} s at most"
    lines = [
        f"{vehicle.name} with {vehicle.coefficients.name!r} coefficients over {found.source}: "
        f"{data['rows']} rows, {data['duration_s']:.4g} s, open loop",
        f"started from what was measured {len(starts)} times, at {listed}{more} s (the log's "
        f"start, gaps{resets}); the longest stretch is {data['longest_stretch_s']:.4g} s",
    ]
    set_ = {name: value for name, value in data["others"].items() if value != float(name in GAINS)}
    if set_:
        lines.append("with " + ", ".join(f"{name} {value:.4g}" for name, value in set_.items()))
    if options.given:
        lines.append(f"{', '.join(options.given)} follow the log")
    lines += [
        "",
        f"{'axis':10}{'rms':>9}{'mean':>9}{'worst':>9}{'fit, %':>8}{'drift/min':>11}  unit",
    ]
    for name, one in data["axes"].items():
        cells = [
            "-" if one[key] is None else f"{one[key]:{style}}"
            for key, style in (
                ("rms", ".3g"), ("mean", "+.3g"), ("worst", ".3g"), ("fit_percent", ".1f"),
                ("drift_per_min", ".3g"),
            )
        ]  # fmt: skip
        widths = (9, 9, 9, 8, 11)
        row = "".join(f"{cell:>{width}}" for cell, width in zip(cells, widths, strict=True))
        lines.append(f"{name:10}{row}  {one['unit']}")
    lines.append(
        "errors are simulated minus measured; fit = 100 (1 - |y - model| / |y - mean y|); drift: "
        "the last error of each stretch by its minutes, rms"
    )
    return "\n".join(lines)
