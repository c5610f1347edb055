"""A survey against an earlier one: a map of differences, its significance, and volumes.

The sigma of a difference is that of both heights and of the registration. Single cells exceed 1.96
sigma by chance in 5 % of all cases; a place counts as changed only where most cells around agree.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes, distance_transform_edt, find_objects
from scipy.spatial.transform import RigidTransform

from alice_survey.core.artefacts import need_stage, refuse_links
from alice_survey.core.block_solver import MAD_TO_SIGMA
from alice_survey.core.errors import ReconstructionError, WorkspaceError, warn
from alice_survey.core.frames import Array, Datum
from alice_survey.core.records import ChangeRecord
from alice_survey.core.run import progress
from alice_survey.kit.figure import figure_style, new_figure, save_figure
from alice_survey.kit.words import count, length
from reconstruct.elevation import Elevation, elevation_in
from reconstruct.evaluate.figures import json_number, map_errors, rms
from reconstruct.evaluate.registration import HeightFit, adjust_heights, register_heights
from reconstruct.placing.alignment import align_rigid
from reconstruct.raster import DemGrid, hillshade, tiled_raster
from reconstruct.views.model import WorldFrame, read_frame

SIGNIFICANT = 1.96
"""Standard deviations: 95 % of errors of a normal distribution stay below."""

_WINDOW = 7
"""Cells a side of the square in which most must have changed significantly, the same way."""
_RING = 3
"""Cells a changed place grows by at a time, while the ring around it has changed on average."""
_MAX_GROWTH = 120
"""Cells it may grow by."""
_RING_SIGMAS = 2.0
_REGION_SIGMAS = 3.0
_MIN_BLOCKS = 20
_SIDES = (1, 2, 4, 8, 16, 32)
_MAX_DRAWN = 1200


class Region(NamedTuple):
    """One place that changed."""

    east_m: float
    north_m: float
    area_m2: float
    volume_m3: float
    """Positive where there is more now."""
    sigma_m3: float
    max_m: float
    """Largest change of height (95 % of the cells are below)."""

    def to_json(self) -> dict[str, Any]:
        """Figures in millimetres and litres."""
        return {
            "east_m": round(self.east_m, 3),
            "north_m": round(self.north_m, 3),
            "area_m2": round(self.area_m2, 4),
            "volume_l": round(1e3 * self.volume_m3, 4),
            "sigma_l": round(1e3 * self.sigma_m3, 4),
            "most_mm": round(1e3 * self.max_m, 2),
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class Change:
    """Heights now minus heights before, on the grid of now."""

    difference: Array
    """(rows, columns) metres; NaN where one survey has no height."""
    sigma: Array
    """(rows, columns) standard deviation of it."""
    changed: NDArray[np.bool_]
    """(rows, columns) within a region."""
    regions: tuple[Region, ...]
    """Largest volume first."""
    cell: float
    registration_sigma: float
    """Median over the cells."""

    @property
    def significance(self) -> Array:
        """(rows, columns) difference in standard deviations."""
        return self.difference / self.sigma

    def to_json(self) -> dict[str, Any]:
        """Figures in millimetres and litres."""
        known = np.isfinite(self.difference)
        stable = known & ~self.changed
        ratio, level = self.significance[stable], 1e3 * self.difference[stable]
        figures: dict[str, Any] = {
            "cells": int(known.sum()),
            "area_m2": round(float(known.sum()) * self.cell**2, 4),
            "changed_m2": round(float(self.changed.sum()) * self.cell**2, 4),
        }
        for name, sign in (("gained", 1), ("lost", -1)):
            # volumes of places add up; so do errors of the registration, and the rest is smaller
            mine = np.array([r[3:5] for r in self.regions if sign * r.volume_m3 > 0]).reshape(-1, 2)
            figures[name] = {
                "regions": len(mine),
                "volume_l": round(1e3 * float(mine[:, 0].sum()), 4),
                "sigma_l": round(1e3 * float(np.linalg.norm(mine[:, 1])), 4),
            }
        unchanged = {
            "share_significant": np.mean(np.abs(ratio) > SIGNIFICANT),
            "difference_over_sigma_rms": rms(ratio),
            "robust_sigma_mm": MAD_TO_SIGMA * np.median(np.abs(level)),
            "registration_sigma_mm": 1e3 * self.registration_sigma,
        }
        return figures | {
            "regions": [region.to_json() for region in self.regions],
            "unchanged": {name: json_number(value, 4) for name, value in unchanged.items()},
        }


def find_change(now: Elevation, before: Elevation, fit: HeightFit) -> Change:
    """Differences of two registered surveys.

    A place is found where most cells exceed their sigma, and followed outwards while the mean of
    the ring around it has changed: where a change fades, no cell by itself does.

    Args:
        now: its grid is that of the result.
        before: the earlier survey, in its own frame.
        fit: `fixed_from_moving` takes `before` to `now`.
    """
    shape = now.height.shape
    difference, sigma = np.full(shape, np.nan), np.full(shape, np.nan)
    registration = np.full(shape, np.nan)
    down, right = list(np.gradient(now.height, now.cell))
    for row in range(shape[0]):  # row by row: memory stays that of the maps
        columns = np.flatnonzero(now.known[row])
        if not columns.size:
            continue
        east = now.west + (columns + 0.5) * now.cell
        north = np.full(len(columns), now.north - (row + 0.5) * now.cell)
        points = np.column_stack([east, north, now.height[row, columns]])
        there = fit.fixed_from_moving.inv().apply(points)
        difference[row, columns] = there[:, 2] - before.at(before.height, there[:, :2])
        normals = np.column_stack([right[row, columns], -down[row, columns], -np.ones(len(east))])
        normals = np.nan_to_num(normals)
        registration[row, columns] = fit.sigma_at(points, normals)
        own, other = now.sigma[row, columns], before.at(before.sigma, there[:, :2])
        sigma[row, columns] = np.sqrt(own**2 + other**2 + registration[row, columns] ** 2)
    difference = np.where(np.isfinite(sigma), difference, np.nan)
    labels = _label_changes(difference / sigma)
    noise_area = _noise_area(difference, sigma, labels == 0, now.cell)
    regions, changed = [], np.zeros(shape, dtype=np.bool_)
    maps = np.stack([difference, sigma, registration])
    for label, box in enumerate(find_objects(labels), 1):
        window = _pad(box, shape)
        free = (labels[window] == 0) & ~changed[window]
        part = maps[:, *window]
        inside = _follow(labels[window] == label, free, part, now.cell, noise_area)
        region = _measure(inside, part, window, now, noise_area)
        if abs(region.volume_m3) > _REGION_SIGMAS * region.sigma_m3:
            regions.append(region)
            changed[window] |= inside
    return Change(
        difference=difference,
        sigma=sigma,
        changed=changed,
        regions=tuple(sorted(regions, key=lambda r: -abs(r.volume_m3))),
        cell=now.cell,
        registration_sigma=float(np.nanmedian(registration)),
    )


def _label_changes(significance: Array) -> NDArray[np.int32]:
    """Labels of places, 0 where nothing changed: most cells of a window exceed their sigma."""
    known = np.isfinite(significance).astype(np.float32)
    ratio = np.nan_to_num(significance)
    around = cv2.boxFilter(known, -1, (_WINDOW, _WINDOW), normalize=False)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_WINDOW, _WINDOW))
    labels = np.zeros(significance.shape, dtype=np.int32)
    for sign in (1, -1):
        beyond = (sign * ratio > SIGNIFICANT).astype(np.float32)
        share = cv2.boxFilter(beyond, -1, (_WINDOW, _WINDOW), normalize=False)
        core = (share > 0.5 * np.maximum(around, 0.5 * _WINDOW**2)).astype(np.uint8)
        grown = cv2.dilate(core, disc) * (known > 0) * (labels == 0)
        _, part = cv2.connectedComponents(grown.astype(np.uint8), connectivity=8)
        labels[part > 0] = part[part > 0] + labels.max()
    return labels


def _noise_area(difference: Array, sigma: Array, stable: NDArray[np.bool_], cell: float) -> float:
    """Area over which errors of unchanged cells are correlated, from the scatter of block means.

    For blocks much larger than the reach of the correlation the variance of the mean of `n` cells
    is the cell's times (correlated cells) / n (Rolstad et al. 2009, equation 8): the largest such
    product over block sizes is taken. Errors that exceed their stated sigmas raise it too.
    """
    ratio = np.where(stable & np.isfinite(difference), difference / sigma, np.nan)
    ratio = ratio - np.nanmedian(ratio)
    maximum = 1.0
    for side in _SIDES:
        rows, columns = ratio.shape[0] // side, ratio.shape[1] // side
        blocks = ratio[: rows * side, : columns * side].reshape(rows, side, columns, side)
        means = blocks.mean(axis=(1, 3))
        means = means[np.isfinite(means)]
        if len(means) >= _MIN_BLOCKS:
            maximum = max(maximum, float(np.mean(means**2)) * side**2)
    return maximum * cell**2


def _pad(box: tuple[slice, ...], shape: tuple[int, ...]) -> tuple[slice, slice]:
    """The window of a place with room to grow."""
    rows, columns = (
        slice(max(part.start - _MAX_GROWTH, 0), min(part.stop + _MAX_GROWTH, size))
        for part, size in zip(box, shape, strict=True)
    )
    return rows, columns


def _follow(
    inside: NDArray[np.bool_], free: NDArray[np.bool_], maps: Array, cell: float, noise_area: float
) -> NDArray[np.bool_]:
    """A place and the rings around it, as far as they have changed on average.

    Args:
        inside: (h, w) the place.
        free: (h, w) where no other place is.
        maps: (3, h, w) difference, its sigma, and the share of the registration in it.
        cell: side of a cell.
        noise_area: over which errors are correlated: the variance of a mean over a larger area A is
            the variance of a cell times this over A.
    """
    difference, sigma, registration = maps
    away = cv2.distanceTransform((~inside).astype(np.uint8), cv2.DIST_L2, 5)
    known = np.isfinite(difference)
    sign = np.sign(difference[inside & known].sum())
    reach, looked = 0.0, 0.0
    while looked < min(reach + 3 * _RING, _MAX_GROWTH):  # past rings that look still by chance
        ring = known & free & (away > looked) & (away <= looked + _RING)
        looked += _RING
        count = int(ring.sum())
        if not count:
            continue
        mean = float(difference[ring].mean())
        alike = np.mean(sigma[ring] ** 2) * noise_area / (count * cell**2)
        if sign * mean > _RING_SIGMAS * np.sqrt(alike + np.mean(registration[ring]) ** 2):
            reach = looked
    return np.asarray((inside | (free & (away <= reach))) & known)


def _measure(
    inside: NDArray[np.bool_],
    maps: Array,
    window: tuple[slice, slice],
    now: Elevation,
    noise_area: float,
) -> Region:
    hidden = binary_fill_holes(inside) & np.isnan(maps[0])  # as the cells next to them
    nearest = distance_transform_edt(~inside, return_distances=False, return_indices=True)
    maps, inside = np.where(hidden, maps[:, *nearest], maps), inside | hidden
    values, sigma, registration = maps[:, inside]
    area = len(values) * now.cell**2
    random = np.sqrt(float(np.mean(sigma**2)) * area * noise_area)
    shared = area * float(np.mean(registration))
    guessed = hidden.sum() * now.cell**2 * float(np.std(values))
    rows, columns = np.nonzero(inside)
    share = np.abs(values) / np.abs(values).sum()
    row, column = rows @ share + window[0].start, columns @ share + window[1].start
    sign = np.sign(values.sum())
    return Region(
        east_m=now.west + (float(column) + 0.5) * now.cell,
        north_m=now.north - (float(row) + 0.5) * now.cell,
        area_m2=area,
        volume_m3=float(values.sum()) * now.cell**2,
        sigma_m3=float(np.linalg.norm([random, shared, guessed])),
        max_m=float(sign * np.percentile(sign * values, 95)),
    )


@figure_style()
def plot_change(path: Path, now: Elevation, change: Change) -> None:
    """Difference over the relief, its significance, and places that changed."""
    step = max(1, max(now.height.shape) // _MAX_DRAWN)
    difference = 1e3 * change.difference[::step, ::step]
    shade = hillshade(now.height[::step, ::step], now.cell * step)
    rows, columns = now.height.shape
    extent = (now.west, now.west + columns * now.cell, now.north - rows * now.cell, now.north)
    known = difference[np.isfinite(difference)]
    limit = max(float(np.percentile(np.abs(known), 99.5)), 1e-6) if known.size else 1.0
    figure = new_figure(5.2, 11)
    maps = (
        (difference, limit, "Height now minus before", "mm"),
        (change.significance[::step, ::step], 4.0, "Significance", "standard deviations"),
    )
    for axis, (values, span, title, label) in zip(figure.subplots(1, 2), maps, strict=True):
        axis.imshow(shade, extent=extent, cmap="gray", vmin=0, vmax=1.2)
        opacity = np.where(np.isfinite(values), 0.75, 0.0)
        map_errors(axis, values, span, title, label, extent=extent, alpha=opacity)
        if change.changed.any():
            outline = change.changed[::step, ::step]
            axis.contour(outline, levels=[0.5], colors="k", extent=extent, origin="upper")
    save_figure(figure, path)


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
        again = adjust_heights(stable, before, fit.fixed_from_moving)
        if again is None:
            warn("too little is unchanged to register on it alone: change may be underestimated")
            return change, fit
        change, fit = find_change(now, before, again), again
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
    now, frame, datum = _read_survey(workspace)
    before, _, datum_before = _read_survey(earlier)
    georeferenced = enu_from_enu(datum, datum_before)
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
        "registration": _change_registration(fit, georeferenced),
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
    return _change_text(figures, folder), figures


def _read_survey(workspace: Path) -> tuple[Elevation, WorldFrame, Datum]:
    """The DEM of a workspace, and the frame and datum that it lies in; raises as said above."""
    dense = need_stage(workspace, "dense", "reconstruct")
    frame = read_frame(need_stage(workspace, "sparse", "reconstruct") / "frame.json")
    elevation = elevation_in(dense)
    if not elevation.known.any():
        raise ReconstructionError(f"{dense / 'dem.tif'}: holds no height")
    if frame.datum is None or not frame.scaled:
        raise WorkspaceError(
            f"{workspace} is not georeferenced: surveys are compared where the georeference puts "
            "them; give positions in the manifest or control points"
        )
    return elevation, frame, frame.datum


def enu_from_enu(target: Datum, source: Datum) -> RigidTransform:
    """Local east, north, up of one datum from that of another: rigid, both are tangent planes."""
    corners = 100.0 * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    ned = corners[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    moved = target.ned_from_geodetic(source.geodetic_from_ned(ned))
    return align_rigid(corners, moved[:, [1, 0, 2]] * [1.0, 1.0, -1.0])


def _change_registration(fit: HeightFit, georeferenced: Any) -> dict[str, Any]:
    """How far the surfaces were from where the georeferences put them, at their middle."""
    moved = fit.fixed_from_moving * georeferenced.inv()
    shift = moved.apply(fit.centre) - fit.centre
    sigma = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    return {
        "shift_east_north_up_m": [round(float(v), 5) for v in shift],
        "turn_deg": [round(float(v), 5) for v in np.rad2deg(moved.rotation.as_rotvec())],
        "turn_sigma_deg": [round(float(v), 6) for v in np.rad2deg(sigma[:3])],
        "cells": fit.used,
    }


def _change_text(figures: dict[str, Any], folder: Path) -> str:
    still, shift = figures["unchanged"], figures["registration"]["shift_east_north_up_m"]
    changes = [
        f"{word} {abs(one['volume_l']):.2f} +/- {one['sigma_l']:.2f} l in "
        f"{count(one['regions'], 'place')}"
        for word in ("gained", "lost") if (one := figures[word])["regions"]
    ] or ["nothing changed surely"]  # fmt: skip
    return "\n".join([
        f"{', '.join(changes)}: {figures['changed_m2']:.2f} of {figures['area_m2']:.2f} m2",
        f"the two models lay {length(float(np.linalg.norm(shift)))} apart and were laid on each "
        f"other; unchanged ground differs by {still['robust_sigma_mm']:.2f} mm "
        f"({still['difference_over_sigma_rms']:.2f} of its sigma; "
        f"{still['share_significant']:.1%} of it beyond {SIGNIFICANT} sigma)",
        f"maps in {folder}",
    ])  # fmt: skip
