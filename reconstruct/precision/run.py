"""`plan precision`: what a plan is predicted to give, and what helps."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.artefacts import atomic_path, need_stage, write_json
from alice_survey.core.config import SurveyConfig
from alice_survey.core.frames import Array
from alice_survey.kit.words import text_table
from missions.values.plan_file import read_plan
from reconstruct.precision.candidates import (
    Candidate,
    gain_per_minute,
    single_measures,
    with_control,
    worst_bend,
)
from reconstruct.precision.instruments import NavigationErrors, expected_rig
from reconstruct.precision.predict import Precision, predict
from reconstruct.raster import DemGrid, tiled_raster
from reconstruct.views.model import WorldFrame

_EXACT = 1e-3
_LEVEL = "sea surface at the datum"
_MM, _PPM = 1e3, 1e6
_HEADER = ("bend along, mm", "across, mm", "scale, ppm", "heights, mm", "stations, mm")


def precision_report(
    workspace: Path, config: SurveyConfig, *, measures: bool = True
) -> tuple[str, dict[str, Any]]:
    """What a workspace's plan is predicted to give, as text and as JSON values.

    Writes `precision.json` and `precision.tif`, the sigmas of heights, next to the plan.

    Args:
        workspace: with the plan, and the calibration where there is one.
        config: the survey.
        measures: also say what cross lines and other measures buy.

    Raises:
        WorkspaceError: there is no plan.
        PlanError: the plan does not tie its pictures together.
    """
    folder = need_stage(workspace, "plan", "plan")
    plan = read_plan(folder / "plan.json")
    rig = expected_rig(workspace, config.camera, config.water, config.imaging)
    base = Candidate(config=config, made=plan, rig=rig)
    block, found = base.block(), base.precision
    errors = NavigationErrors.of(config.navigation, config.reconstruct)
    without = {
        "calibration": predict(block, errors, calibration=False),
        "navigation": predict(block, errors.times(_EXACT)),
        "pixels": predict(block, errors, pixels=False),
    }
    rows = {"all": found, **{f"without errors of {name}": p for name, p in without.items()}}
    in_world = ", ".join(f"{_MM * s:.0f}" for s in np.sqrt((found.place_m**2).mean(axis=0)))
    text = [
        f"Expected sigmas of {plan.stations} stations in {plan.duration_s / 60.0:.0f} min; rig: "
        f"{rig.source}",
        text_table(("", *_HEADER), [[name, *_cells(p)] for name, p in rows.items()]),
        f"worst station {_MM * np.linalg.norm(found.shape_m, axis=1).max():.2g} mm of shape; the "
        f"track lies within north, east, depth {in_world} mm",
    ]
    data: dict[str, Any] = {
        "stations": plan.stations, "minutes": plan.duration_s / 60.0, "rig": rig.source,
        **to_json(found), "without": {name: to_json(p) for name, p in without.items()},
    }  # fmt: skip
    if measures:
        options = [*single_measures(base), with_control(base)]
        data["measures"] = [_measure_json(base, one) for one in options]
        gains = [row["bend_gain_m_per_minute"] for row in data["measures"]]
        table = [
            [one.name, f"{one.minutes - base.minutes:+.1f}", *_cells(one.precision),
             "-" if gain is None else f"{_MM * gain:.2g}"]
            for one, gain in zip(options, gains, strict=True)
        ]  # fmt: skip
        text.append(text_table(("measure", "min", *_HEADER, "off the bend, mm a min"), table))
    _write(folder, base, data)
    text.append(f"{folder}: precision.json, precision.tif with the sigmas of heights")
    return "\n\n".join(text), data


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


def _measure_json(base: Candidate, one: Candidate) -> dict[str, Any]:
    return {
        "measure": one.name,
        "minutes": one.minutes - base.minutes,
        "bend_gain_m": worst_bend(base.precision) - worst_bend(one.precision),
        "bend_gain_m_per_minute": None if one.with_control else gain_per_minute(base, one),
        **to_json(one.precision),
    }


def summary(found: Precision) -> str:
    """The figures of a prediction in words."""
    along, across, scale, heights, stations = _cells(found)
    return (
        f"bend {along} mm along, {across} mm across, scale {scale} ppm, heights {heights} mm, "
        f"stations {stations} mm"
    )


def _cells(found: Precision) -> list[str]:
    """Its figures under `_HEADER`."""
    along, across = (f"{_MM * b:.2g}" if np.isfinite(b) else "-" for b in found.bend_m)
    return [
        along, across, f"{_PPM * found.scale:.0f}", f"{_MM * found.heights_rms_m:.2g}",
        f"{_MM * _rms(found.shape_m):.2g}",
    ]  # fmt: skip


def _rms(sigmas: Array) -> float:
    return float(np.sqrt((sigmas**2).sum(axis=1).mean()))


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
