"""What changed between two surveys: a map of differences, its significance, and volumes.

The sigma of a difference is that of both heights and of the registration. Single cells exceed 1.96
sigma by chance in 5 % of all cases; a place counts as changed only where most cells around agree.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from rasterio.features import shapes
from rasterio.transform import Affine
from scipy.ndimage import find_objects

from alice_survey.core.frames import Array
from alice_survey.core.robust import MAD_TO_SIGMA
from reconstruct.evaluate.elevation import Elevation
from reconstruct.evaluate.figures import rms, rounded
from reconstruct.evaluate.height_registration import HeightFit

SIGNIFICANT = 1.96
"""Standard deviations: 95 % of errors of a normal distribution stay below."""

_WINDOW = 7
"""Cells a side of the square in which most must have changed significantly, the same way."""
_RING = 3
"""Cells a changed place grows by at a time, while the ring around it has changed on average."""
_FARTHEST = 120
"""Cells it may grow by."""
_RING_SIGMAS = 2.0
_REGION_SIGMAS = 3.0
_MIN_BLOCKS = 20
_SIDES = (1, 2, 4, 8, 16, 32)


@dataclass(frozen=True, kw_only=True)
class Region:
    """One place that changed."""

    east_m: float
    north_m: float
    area_m2: float
    volume_m3: float
    """Positive where there is more now."""
    sigma_m3: float
    max_m: float
    """Largest change of height (95 % of the cells are below)."""
    outlines: tuple[tuple[tuple[float, float], ...], ...]
    """Rings of east and north around its cells, the outer one of each part and its holes."""


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
    noise_area: float
    """Area over which errors are correlated: the variance of a mean over a larger area A is the
    variance of a cell times this over A."""
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
        ratio = self.significance[stable]
        gained = [r for r in self.regions if r.volume_m3 > 0]
        lost = [r for r in self.regions if r.volume_m3 < 0]
        level = 1e3 * self.difference[stable]
        return {
            "cells": int(known.sum()),
            "area_m2": round(float(known.sum()) * self.cell**2, 4),
            "changed_m2": round(float(self.changed.sum()) * self.cell**2, 4),
            "gained": _total(gained),
            "lost": _total(lost),
            "regions": [_region(region) for region in self.regions],
            "unchanged": {
                "share_significant": rounded(float(np.mean(np.abs(ratio) > SIGNIFICANT)), 4),
                "difference_over_sigma_rms": rounded(rms(ratio), 3),
                "median_mm": rounded(float(np.median(level)), 4),
                "robust_sigma_mm": rounded(MAD_TO_SIGMA * float(np.median(np.abs(level))), 4),
                "registration_sigma_mm": rounded(1e3 * self.registration_sigma, 4),
                "errors_go_together_over_mm": rounded(1e3 * float(np.sqrt(self.noise_area)), 2),
            },
        }


@dataclass(frozen=True, eq=False)
class _Maps:
    """Difference, its sigma, and the share of the registration in it."""

    difference: Array
    sigma: Array
    registration: Array

    def part(self, window: tuple[slice, slice]) -> "_Maps":
        return _Maps(self.difference[window], self.sigma[window], self.registration[window])


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
    labels = _changed(difference / sigma)
    noise_area = _noise_area(difference, sigma, labels == 0, now.cell)
    regions, changed = [], np.zeros(shape, dtype=np.bool_)
    maps = _Maps(difference, sigma, registration)
    for label, box in enumerate(find_objects(labels), 1):
        window = _padded(box, shape)
        free = (labels[window] == 0) & ~changed[window]
        inside = _followed(labels[window] == label, free, maps.part(window), now.cell, noise_area)
        region = _measure(inside, maps.part(window), window, now, noise_area)
        if abs(region.volume_m3) > _REGION_SIGMAS * region.sigma_m3:
            regions.append(region)
            changed[window] |= inside
    return Change(
        difference=difference,
        sigma=sigma,
        changed=changed,
        regions=tuple(sorted(regions, key=lambda r: -abs(r.volume_m3))),
        cell=now.cell,
        noise_area=noise_area,
        registration_sigma=float(np.nanmedian(registration)),
    )


def _changed(significance: Array) -> NDArray[np.int32]:
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


def _padded(box: tuple[slice, ...], shape: tuple[int, ...]) -> tuple[slice, slice]:
    """The window of a place with room to grow."""
    rows, columns = (
        slice(max(part.start - _FARTHEST, 0), min(part.stop + _FARTHEST, size))
        for part, size in zip(box, shape, strict=True)
    )
    return rows, columns


def _followed(
    inside: NDArray[np.bool_], free: NDArray[np.bool_], maps: _Maps, cell: float, noise_area: float
) -> NDArray[np.bool_]:
    """A place and the rings around it, as far as they have changed on average."""
    away = cv2.distanceTransform((~inside).astype(np.uint8), cv2.DIST_L2, 5)
    known = np.isfinite(maps.difference)
    sign = np.sign(maps.difference[inside & known].sum())
    reach, looked = 0.0, 0.0
    while looked < min(reach + 3 * _RING, _FARTHEST):  # past rings that look still by chance
        ring = known & free & (away > looked) & (away <= looked + _RING)
        looked += _RING
        count = int(ring.sum())
        if not count:
            continue
        mean = float(maps.difference[ring].mean())
        alike = np.mean(maps.sigma[ring] ** 2) * noise_area / (count * cell**2)
        if sign * mean > _RING_SIGMAS * np.sqrt(alike + np.mean(maps.registration[ring]) ** 2):
            reach = looked
    grown: NDArray[np.bool_] = (inside | (free & (away <= reach))) & known
    return grown


def _measure(
    inside: NDArray[np.bool_],
    maps: _Maps,
    window: tuple[slice, slice],
    now: Elevation,
    noise_area: float,
) -> Region:
    values = maps.difference[inside]
    area = len(values) * now.cell**2
    random = np.sqrt(float(np.mean(maps.sigma[inside] ** 2)) * area * noise_area)
    shared = area * float(np.mean(maps.registration[inside]))
    rows, columns = np.nonzero(inside)
    share = np.abs(values) / np.abs(values).sum()
    row, column = rows @ share + window[0].start, columns @ share + window[1].start
    sign = np.sign(values.sum())
    return Region(
        east_m=now.west + (float(column) + 0.5) * now.cell,
        north_m=now.north - (float(row) + 0.5) * now.cell,
        area_m2=area,
        volume_m3=float(values.sum()) * now.cell**2,
        sigma_m3=float(np.hypot(random, shared)),
        max_m=float(sign * np.percentile(sign * values, 95)),
        outlines=_outlines(inside, window, now),
    )


def _outlines(
    inside: NDArray[np.bool_], window: tuple[slice, slice], now: Elevation
) -> tuple[tuple[tuple[float, float], ...], ...]:
    """Rings around cells, corners of single cells cut off."""
    west = now.west + window[1].start * now.cell
    north = now.north - window[0].start * now.cell
    to_plane = Affine(now.cell, 0.0, west, 0.0, -now.cell, north)
    found = []
    for part, value in shapes(inside.astype(np.uint8), transform=to_plane):
        if value == 1:
            outer, *holes = part["coordinates"]
            outline = shapely.simplify(shapely.Polygon(outer, holes), now.cell)
            rings = (outline.exterior, *outline.interiors)
            found += [tuple((x, y) for x, y in ring.coords[:-1]) for ring in rings]
    return tuple(found)


def _total(regions: list[Region]) -> dict[str, float]:
    """Volumes of places add up; so do errors of the registration, and the rest is smaller."""
    return {
        "regions": len(regions),
        "volume_l": round(1e3 * sum(r.volume_m3 for r in regions), 4),
        "sigma_l": round(1e3 * float(np.sqrt(sum(r.sigma_m3**2 for r in regions))), 4),
    }


def _region(region: Region) -> dict[str, Any]:
    return {
        "east_m": round(region.east_m, 3),
        "north_m": round(region.north_m, 3),
        "area_m2": round(region.area_m2, 4),
        "volume_l": round(1e3 * region.volume_m3, 4),
        "sigma_l": round(1e3 * region.sigma_m3, 4),
        "most_mm": round(1e3 * region.max_m, 2),
        "outlines": [[[round(e, 4), round(n, 4)] for e, n in ring] for ring in region.outlines],
    }
