"""`plan precision` and `plan solve --bend`: what a plan is predicted to give, and what helps."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.base.artefacts import need_stage
from alice_survey.base.config import SurveyConfig
from alice_survey.base.errors import ConfigError
from alice_survey.base.frames import Array
from alice_survey.base.text_table import text_table
from missions.values.plan_file import read_plan
from reconstruct.precision.calibration import expected_rig
from reconstruct.precision.measures import (
    as_planned,
    cheapest,
    gain_per_minute,
    single_measures,
    with_control,
    worst_bend,
)
from reconstruct.precision.navigation import NavigationErrors
from reconstruct.precision.planned import Candidate
from reconstruct.precision.predict import Precision, predict

_UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
_EXACT = 1e-3
_MM, _PPM = 1e3, 1e6


def length_m(text: str) -> float:
    """A length such as 5mm, 0.5cm or 5 (mm), in metres.

    Raises:
        ConfigError: it is none, or not positive.
    """
    number, unit = text.strip().lower(), "mm"
    for name in _UNITS_MM:
        if number.endswith(name):
            number, unit = number.removesuffix(name).strip(), name
            break
    try:
        value = float(number) * _UNITS_MM[unit] / _MM
    except ValueError:
        value = float("nan")
    if not 0.0 < value < 1e3:
        raise ConfigError(f"{text!r} is no length: write 5mm, 0.5cm, or millimetres as a number")
    return value


def precision_report(
    workspace: Path, config: SurveyConfig, *, measures: bool = True, plot: Path | None = None
) -> tuple[str, dict[str, Any]]:
    """What a workspace's plan is predicted to give, as text and as JSON values.

    Args:
        workspace: with the plan, and the calibration where there is one.
        config: the survey.
        measures: also say what cross lines and other measures buy.
        plot: figure to draw; None without.

    Raises:
        WorkspaceError: there is no plan.
        PlanError: the plan does not tie its pictures together.
    """
    plan = read_plan(need_stage(workspace, "plan", "plan") / "plan.json")
    rig = expected_rig(workspace, config.camera, config.water, config.imaging)
    base = Candidate(config=config, plan=plan, rig=rig)
    block, errors, found = base.block(), NavigationErrors.of(config.navigation), base.precision
    without = {
        "calibration": predict(block, errors, calibration=False),
        "navigation": predict(block, errors.times(_EXACT)),
        "pixels": predict(block, errors, pixels=False),
    }
    rows = {"all": found, **{f"without errors of {name}": p for name, p in without.items()}}
    text = [
        f"Expected sigmas of {plan.stations} stations in {plan.duration_s / 60.0:.0f} min; rig: "
        f"{rig.source}",
        _table(rows),
        f"worst station {_MM * np.linalg.norm(found.shape_m, axis=1).max():.2g} mm of shape; the "
        f"track lies within north, east, depth {_in_world(found)} mm",
    ]
    data: dict[str, Any] = {
        "stations": plan.stations, "minutes": plan.duration_s / 60.0, "rig": rig.source,
        **to_json(found), "without": {name: to_json(p) for name, p in without.items()},
    }  # fmt: skip
    if measures:
        options = [*single_measures(base), with_control(base)]
        text.append(_measures_text(base, options))
        data["measures"] = [_measure_json(base, one) for one in options]
    if plot is not None:
        from reconstruct.precision.figure import draw_precision  # matplotlib is slow to import

        draw_precision(plot, plan, found, without)
    return "\n\n".join(text), data


def bend_report(workspace: Path, config: SurveyConfig, bend_m: float) -> tuple[str, dict[str, Any]]:
    """The shortest plan that is predicted to bend by no more than a sigma, as text and JSON.

    Raises:
        PlanError: no set of measures does.
    """
    base = as_planned(config, expected_rig(workspace, config.camera, config.water, config.imaging))
    found = cheapest(base, bend_m)
    plan = found.config.plan
    changed = {
        name: value
        for name, value in plan.model_dump().items()
        if value != getattr(config.plan, name)
    }
    reached = f"{_MM * worst_bend(found.precision):.2g} mm, {found.minutes:.0f} min"
    if not changed:
        text = f"the plan as set reaches a bend of {_MM * bend_m:g} mm: {reached}"
    else:
        settings = "\n".join(f"  {name} = {str(v).lower()}" for name, v in changed.items())
        text = (
            f"{found.name}: a bend of {reached}, where the plan as set has "
            f"{_MM * worst_bend(base.precision):.2g} mm, {base.minutes:.0f} min\n[plan]\n{settings}"
        )
    data = {"bend_m": bend_m, "changes": list(found.changes), "settings": changed}
    return text, {**data, "minutes": found.minutes, **to_json(found.precision)}


def to_json(found: Precision) -> dict[str, Any]:
    """The figures of a prediction."""
    along, across = (float(b) if np.isfinite(b) else None for b in found.bend_m)
    return {
        "bend_along_m": along,
        "bend_across_m": across,
        "scale": found.scale,
        "heights_rms_m": found.heights_rms_m,
        "stations_shape_rms_m": _rms(found.shape_m),
        "stations_shape_worst_m": float(np.linalg.norm(found.shape_m, axis=1).max()),
        "stations_place_rms_m": np.sqrt((found.place_m**2).mean(axis=0)).tolist(),
    }


def _rms(sigmas: Array) -> float:
    return float(np.sqrt((sigmas**2).sum(axis=1).mean()))


def _in_world(found: Precision) -> str:
    return ", ".join(f"{_MM * s:.0f}" for s in np.sqrt((found.place_m**2).mean(axis=0)))


def _table(rows: dict[str, Precision]) -> str:
    header = ["", "bend along, mm", "across, mm", "scale, ppm", "heights, mm", "stations, mm"]
    return text_table(header, [[name, *_cells(p)] for name, p in rows.items()])


def _cells(found: Precision) -> list[str]:
    along, across = (f"{_MM * b:.2g}" if np.isfinite(b) else "-" for b in found.bend_m)
    return [
        along, across, f"{_PPM * found.scale:.0f}", f"{_MM * found.heights_rms_m:.2g}",
        f"{_MM * _rms(found.shape_m):.2g}",
    ]  # fmt: skip


def _measures_text(base: Candidate, options: Sequence[Candidate]) -> str:
    header = [
        "measure", "min", "bend along, mm", "across, mm", "scale, ppm", "heights, mm",
        "stations, mm", "off the bend, mm a min",
    ]  # fmt: skip
    rows = []
    for one in options:
        rate = "-" if one.with_control else f"{_MM * gain_per_minute(base, one):.2g}"
        minutes = f"{one.minutes - base.minutes:+.1f}"
        rows.append([one.name, minutes, *_cells(one.precision), rate])
    return text_table(header, rows)


def _measure_json(base: Candidate, one: Candidate) -> dict[str, Any]:
    return {
        "measure": one.name,
        "minutes": one.minutes - base.minutes,
        "bend_gain_m": worst_bend(base.precision) - worst_bend(one.precision),
        "bend_gain_m_per_minute": None if one.with_control else gain_per_minute(base, one),
        **to_json(one.precision),
    }
