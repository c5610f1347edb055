"""`plan precision` and `plan solve --bend`: what a plan is predicted to give, and what helps."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.artefacts import atomic_path, need_stage, write_json
from alice_survey.core.config import SurveyConfig
from alice_survey.core.errors import ConfigError
from alice_survey.core.frames import Array
from alice_survey.kit.figure import (
    check_figure_path,
    colour_bar,
    figure_style,
    map_axes,
    new_figure,
    save_figure,
)
from alice_survey.kit.words import text_table
from missions.values.plan_file import Plan, read_plan
from reconstruct.precision.candidates import (
    Candidate,
    cheapest,
    gain_per_minute,
    single_measures,
    with_control,
    worst_bend,
)
from reconstruct.precision.instruments import NavigationErrors, expected_rig
from reconstruct.precision.predict import Precision, predict
from reconstruct.raster import DemGrid, tiled_raster
from reconstruct.views.model import WorldFrame

_UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
_EXACT = 1e-3
_LEVEL = "sea surface at the datum"
_PALETTE, _COLOURS, _OPACITY = "viridis", 9, 215
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

    Writes `precision.json` and `precision.tif`, the sigmas of heights, next to the plan, and draws
    them in its page.

    Args:
        workspace: with the plan, and the calibration where there is one.
        config: the survey.
        measures: also say what cross lines and other measures buy.
        plot: figure to draw; None without.

    Raises:
        WorkspaceError: there is no plan.
        PlanError: the plan does not tie its pictures together.
    """
    folder = need_stage(workspace, "plan", "plan")
    plan = read_plan(folder / "plan.json")
    rig = expected_rig(workspace, config.camera, config.water, config.imaging)
    base = Candidate(config=config, made=plan, rig=rig)
    block = base.block()
    errors = NavigationErrors.of(config.navigation, config.reconstruct)
    found = base.precision
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
    _write(folder, base, data)
    text.append(f"{folder}: precision.json, precision.tif with the sigmas of heights")
    if plot is not None:
        _draw(plot, plan, found, without)
    return "\n\n".join(text), data


def bend_report(workspace: Path, config: SurveyConfig, bend_m: float) -> tuple[str, dict[str, Any]]:
    """The shortest plan that is predicted to bend by no more than a sigma, as text and JSON.

    Raises:
        PlanError: no set of measures does.
    """
    rig = expected_rig(workspace, config.camera, config.water, config.imaging)
    base = Candidate(config=config, rig=rig)
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


def summary(found: Precision) -> str:
    """The figures of a prediction in words."""
    along, across, scale, heights, stations = _cells(found)
    return (
        f"bend {along} mm along, {across} mm across, scale {scale} ppm, heights {heights} mm, "
        f"stations {stations} mm"
    )


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


def heights_raster(found: Precision) -> tuple[Array, DemGrid]:
    """Sigmas of heights with north up, (rows, columns), metres, NaN outside; and their grid."""
    cell, low, high = found.cell_m, found.cells_ne.min(axis=0), found.cells_ne.max(axis=0)
    rows, columns = (np.rint((high - low) / cell).astype(int) + 1).tolist()
    north, west = float(high[0] + cell / 2), float(low[1] - cell / 2)
    heights = np.full((rows, columns), np.nan)
    row, column = np.rint((found.cells_ne - low) / cell).astype(int).T
    heights[rows - 1 - row, column] = found.heights_m
    return heights, DemGrid(west=west, north=north, cell=cell, rows=rows, columns=columns)


def _write(folder: Path, base: Candidate, data: Mapping[str, Any]) -> None:
    """Write a prediction into the folder of its plan: values, raster of heights."""
    plan = base.plan
    write_json(folder / "precision.json", data)
    heights, grid = heights_raster(base.precision)
    frame = WorldFrame(name="ned", datum=plan.datum, scaled=True, vertical_datum=_LEVEL)
    text = "expected standard deviation of the height (m)"
    with (
        atomic_path(folder / "precision.tif") as path,
        tiled_raster(path, grid, frame, "float32", float("nan"), text) as raster,
    ):
        raster.write(heights.astype(np.float32), 1)


def _draw(path: Path, plan: Plan, found: Precision, without: Mapping[str, Precision]) -> None:
    """Draw the sigma of heights under the lines, and sigmas with one kind of error left out.

    Raises:
        ConfigError: the figure cannot be written.
    """
    check_figure_path(path)
    sheet = new_figure(4.6)
    with figure_style():
        left, right = sheet.subplots(1, 2, width_ratios=[3, 2])
        heights, grid = heights_raster(found)
        south, east = grid.north_of(grid.rows), grid.east_of(grid.columns)
        extent = (grid.west, float(east), float(south), grid.north)
        image = left.imshow(_MM * heights, extent=extent, cmap=_PALETTE)
        for line in plan.lines:
            left.plot(*line.stations_ne.T[::-1], color="white", lw=0.6, alpha=0.7)
        colour_bar(image, left, "sigma of heights, mm")
        left.grid(False)
        map_axes(left)
        shown = {"all errors": found, **{f"without {name}": p for name, p in without.items()}}
        worst = [_MM * float(np.nanmax(p.bend_m)) for p in shown.values()]
        rms = [_MM * p.heights_rms_m for p in shown.values()]
        at = np.arange(len(shown))
        right.barh(at - 0.2, worst, 0.38, label="bend")
        right.barh(at + 0.2, rms, 0.38, label="heights")
        right.set_yticks(at, list(shown))
        right.invert_yaxis()
        right.set_xlabel("sigma, mm")
        right.legend()
    save_figure(sheet, path)
