"""A survey against an earlier one of the same site: where and by how much the sea floor changed."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.artefacts import refuse_links
from alice_survey.core.errors import ReconstructionError, WorkspaceError, warn
from alice_survey.core.records import ChangeRecord
from alice_survey.core.run import progress
from reconstruct.evaluate.change import SIGNIFICANT, Change, find_change
from reconstruct.evaluate.elevation import Elevation, enu_from_enu, read_elevation
from reconstruct.evaluate.height_registration import HeightFit, refine_heights, register_heights
from reconstruct.evaluate.plots import plot_change
from reconstruct.raster import DemGrid, tiled_raster

_MUCH = 0.5
"""Share of the ground that is rarely found changed between two surveys."""


@progress.step("find what has changed")
def compare_elevations(
    now: Elevation, before: Elevation, now_from_before: Any
) -> tuple[Change, HeightFit]:
    """Register two surveys, find what changed, and register again without that.

    Args:
        now: later survey; its grid is that of the result.
        before: earlier survey.
        now_from_before: rigid transform that the georeferences give, east, north, up.
    """
    fit = register_heights(now, before, now_from_before)
    change = find_change(now, before, fit)
    if change.changed.any():
        stable = replace(now, height=np.where(change.changed, np.nan, now.height))
        try:
            fit = refine_heights(stable, before, fit.fixed_from_moving)
        except ReconstructionError:
            warn("too little is unchanged to register on it alone: change may be underestimated")
            return change, fit
        change = find_change(now, before, fit)
    return change, fit


def evaluate_against(
    workspace: Path, earlier: Path, out: Path | None = None
) -> tuple[str, dict[str, Any]]:
    """Compare the surface of a workspace with that of an earlier survey and write the change.

    Writes `difference.tif` (height now minus before, m), `significance.tif` (in standard
    deviations), `change.png` and `change.json` into `against/NAME` of the workspace, or `out`.

    Args:
        workspace: of the later survey.
        earlier: workspace of the earlier one, or of another model of the same pictures.
        out: folder to write to.

    Returns:
        A few lines of text, and figures as JSON values.

    Raises:
        WorkspaceError: a surface is missing or has no georeference or no scale.
        ReconstructionError: the two do not overlap.
    """
    now, frame = read_elevation(workspace)
    before, frame_before = read_elevation(earlier)
    for folder, one in ((workspace, frame), (earlier, frame_before)):
        if one.datum is None or not one.scaled:
            raise WorkspaceError(
                f"{folder} is not georeferenced: surveys are compared where the georeference puts "
                "them; give positions in the manifest or control points"
            )
    assert frame.datum is not None  # noqa: S101 - for the type checker, said above
    assert frame_before.datum is not None  # noqa: S101
    georeferenced = enu_from_enu(frame.datum, frame_before.datum)
    change, fit = compare_elevations(now, before, georeferenced)
    share = change.changed.sum() / max(int(np.isfinite(change.difference).sum()), 1)
    if share > _MUCH:
        warn(
            f"{share:.0%} of the common ground differs: if that is not so, one of the models is "
            f"bent or wrongly scaled, or they are laid on each other wrongly; look at the maps"
        )
    folder = out or workspace / "against" / earlier.resolve().name
    refuse_links(workspace, folder)
    folder.mkdir(parents=True, exist_ok=True)
    figures = {
        "format": "alice-survey change",
        "version": 1,
        "earlier": str(earlier),
        "registration": _registration(fit, georeferenced),
        **change.to_json(),
    }
    grid = DemGrid(
        west=now.west, north=now.north, cell=now.cell,
        rows=now.height.shape[0], columns=now.height.shape[1],
    )  # fmt: skip
    for name, values, text in (
        ("difference", change.difference, "height now minus before (m)"),
        ("significance", change.significance, "change over its sigma"),
    ):
        path = folder / f"{name}.tif"
        with tiled_raster(path, grid, frame, "float32", np.nan, text) as raster:
            raster.write(values.astype(np.float32), 1)
    plot_change(folder / "change.png", now, change)
    ChangeRecord.save(folder / "change.json", figures)
    return _text(figures, folder), figures


def _registration(fit: HeightFit, georeferenced: Any) -> dict[str, Any]:
    """How far the surfaces were from where the georeferences put them, at their middle."""
    moved = fit.fixed_from_moving * georeferenced.inv()
    shift = moved.apply(fit.centre) - fit.centre
    sigma = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    return {
        "shift_east_north_up_m": [round(float(v), 5) for v in shift],
        "shift_sigma_mm": [round(1e3 * float(v), 4) for v in sigma[3:]],
        "turn_deg": [round(float(v), 5) for v in np.rad2deg(moved.rotation.as_rotvec())],
        "turn_sigma_deg": [round(float(v), 6) for v in np.rad2deg(sigma[:3])],
        "spread_mm": round(1e3 * fit.spread, 4),
        "cells": fit.used,
    }


def _text(figures: dict[str, Any], folder: Path) -> str:
    still, shift = figures["unchanged"], figures["registration"]["shift_east_north_up_m"]
    return "\n".join([
        f"gained {figures['gained']['volume_l']:.2f} +/- {figures['gained']['sigma_l']:.2f} l in "
        f"{figures['gained']['regions']} places, lost {-figures['lost']['volume_l']:.2f} +/- "
        f"{figures['lost']['sigma_l']:.2f} l in {figures['lost']['regions']}, on "
        f"{figures['changed_m2']:.2f} of {figures['area_m2']:.2f} m2",
        f"registered by {shift[0]:+.3f} east, {shift[1]:+.3f} north, {shift[2]:+.3f} m up of the "
        f"georeferences; unchanged ground differs by {still['robust_sigma_mm']:.2f} mm "
        f"({still['difference_over_sigma_rms']:.2f} of its sigma; "
        f"{still['share_significant']:.1%} of it beyond {SIGNIFICANT} sigma)",
        f"maps in {folder}",
    ])  # fmt: skip
