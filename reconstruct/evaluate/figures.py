"""Figures that every score needs: spreads, the bend of a block, lengths and volumes."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from alice_survey.core.block_solver import MAD_TO_SIGMA
from alice_survey.core.frames import Array
from alice_survey.kit.figure import Axes, colour_bar, map_axes

_BLOCKS = 10
"""Blocks along the longer side over which errors are averaged before a bend is fitted."""
_MIN_SHARE = 0.25
"""Share of the fullest block's count that a block must hold to count."""
_MIN_BLOCKS = 12
_PAIRS = 4000
_TUKEY = 4.685
"""Tukey's constant: 95 % efficient for normal errors."""
WITHIN_PX = (1, 2, 3, 5)
"""Ground pixels within which completeness is reported."""


def rms(values: Array) -> float:
    """Root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else math.nan


def median(values: Array) -> float:
    """Median; NaN of nothing."""
    return float(np.median(values)) if len(values) else math.nan


def percentile(values: Array, percent: float) -> float:
    """What this share of the values is below; NaN of nothing."""
    return float(np.percentile(values, percent)) if len(values) else math.nan


def spread(name: str, values_mm: Array) -> dict[str, float | None]:
    """Root mean square, median and 95th percentile of errors, by name."""
    return {
        f"{name}_rms_mm": json_number(rms(values_mm), 3),
        f"{name}_median_mm": json_number(median(values_mm), 3),
        f"{name}_95_mm": json_number(percentile(values_mm, 95), 3),
    }


def shares_within(distances_m: Array, pixel_m: float, total: float) -> dict[str, float]:
    """Shares of a total that lie within some ground pixels, by their number."""
    return {
        str(px): round(float((distances_m < px * pixel_m).sum() / total), 4) for px in WITHIN_PX
    }


def tukey_weights(residuals: Array) -> tuple[Array, float]:
    """(N,) weights that are 0 for what lies beyond Tukey's limit, and the robust scatter."""
    scatter = max(MAD_TO_SIGMA * float(np.median(np.abs(residuals))), 1e-12)
    weights: Array = np.clip(1 - (residuals / (_TUKEY * scatter)) ** 2, 0, None) ** 2
    return weights, scatter


def mean_grid(places_en: Array, values: Array, side: float) -> tuple[Array, float, float]:
    """Means of values at (N, 2) places on a grid of cells, rows from north; its west and north."""
    west, north = places_en[:, 0].min(), places_en[:, 1].max()
    column = ((places_en[:, 0] - west) / side).astype(np.int64)
    row = ((north - places_en[:, 1]) / side).astype(np.int64)
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    place = row * shape[1] + column
    count = np.bincount(place, minlength=shape[0] * shape[1])
    total = np.bincount(place, values, minlength=shape[0] * shape[1])
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return mean.reshape(shape), float(west), float(north)


def map_errors(
    axis: Axes, values: Array, limit: float, title: str, label: str, **drawn: Any
) -> None:
    """Draw a map of errors (rows, columns), blue and red up to a limit; more as `imshow` takes."""
    axis.set_facecolor("0.85")
    colours = {"vmin": -limit, "vmax": limit, "cmap": "RdBu_r", "interpolation": "nearest"}
    colour_bar(axis.imshow(values, **(colours | drawn)), axis, label)
    axis.grid(visible=False)
    axis.set_title(title)
    map_axes(axis)


def json_number(value: float, digits: int) -> float | None:
    """A number for JSON, which has no NaN: None instead."""
    return round(float(value), digits) if math.isfinite(value) else None


@dataclass(frozen=True, kw_only=True)
class ModelBend:
    """The bend of a model: a paraboloid fitted to its height errors."""

    dome_m: float
    """Middle of the block over its rim, after tilt and shift are taken off; NaN when too few."""
    sigma_m: float
    bend_m: float
    """The same along the direction of the strongest bend: a trough as well as a dome."""
    radius_m: float
    """Radius of the rim."""

    def to_json(self) -> dict[str, Any]:
        """Figures in millimetres."""
        return {
            "dome_mm": json_number(1e3 * self.dome_m, 3),
            "sigma_mm": json_number(1e3 * self.sigma_m, 3),
            "strongest_bend_mm": json_number(1e3 * self.bend_m, 3),
            "radius_m": json_number(self.radius_m, 3),
        }


def fit_doming(places_m: Array, errors_m: Array) -> ModelBend:
    """Fit `error = a + b x + c y + d x^2 + e x y + f y^2` over medians of square blocks.

    Medians keep outliers out. Errors of neighbouring cells are correlated: cells would promise
    too small a sigma; it comes from how the blocks scatter about the paraboloid. The curvature of a
    fitted paraboloid is the measure of doming of James & Robson (2014) and Refrax (2026).

    Args:
        places_m: (N, 2) where the errors are.
        errors_m: (N,) height errors, positive where the model is too high.
    """
    unknown = ModelBend(dome_m=math.nan, sigma_m=math.nan, bend_m=math.nan, radius_m=math.nan)
    if len(places_m) < _MIN_BLOCKS:
        return unknown
    corner, far = places_m.min(axis=0), places_m.max(axis=0)
    side = max(float((far - corner).max()) / _BLOCKS, 1e-12)
    block = np.minimum(((places_m - corner) / side).astype(np.int64), _BLOCKS - 1)
    number = block[:, 0] * _BLOCKS + block[:, 1]
    order = np.argsort(number, kind="stable")
    starts = np.flatnonzero(np.diff(number[order], prepend=-1))
    parts = np.split(order, starts[1:])
    fullest = max(len(part) for part in parts)
    parts = [part for part in parts if len(part) >= _MIN_SHARE * fullest]
    if len(parts) < _MIN_BLOCKS:
        return unknown
    middles = np.array([places_m[part].mean(axis=0) for part in parts])
    centre = middles.mean(axis=0)
    radius = float(np.linalg.norm(middles - centre, axis=1).max())
    x, y = ((middles - centre) / radius).T
    design = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    level, values = errors_m, np.zeros(6)
    for _ in range(2):  # of a tilted block the median is not at the mean place: level it first
        level = level - values[0] - (places_m - centre) @ (values[1:3] / radius)
        medians = np.array([np.median(level[part]) for part in parts])
        values, _, rank, _ = np.linalg.lstsq(design, medians, rcond=None)
        if rank < design.shape[1]:  # all blocks on one line or circle
            return unknown
    residual = medians - design @ values
    variance = float(residual @ residual) / (len(parts) - design.shape[1])
    covariance = variance * np.linalg.inv(design.T @ design)
    mean = np.array([0, 0, 0, 0.5, 0, 0.5])
    bends = np.linalg.eigvalsh([[values[3], values[4] / 2], [values[4] / 2, values[5]]])
    return ModelBend(
        dome_m=-float(mean @ values),
        sigma_m=math.sqrt(float(mean @ covariance @ mean)),
        bend_m=-float(bends[np.abs(bends).argmax()]),
        radius_m=radius,
    )


def compare_lengths(found: Array, true: Array, rng: np.random.Generator) -> dict[str, Any]:
    """Lengths between random pairs of points, which no alignment can hide.

    Args:
        found: (N, 3) points of the model, metres.
        true: (N, 3) the same points in truth.
        rng: draws the pairs.

    Returns:
        Error of the scale (least squares over all lengths, ppm) and of the lengths; empty of fewer
        than 3 points.
    """
    if len(found) < 3:
        return {}
    pairs = rng.integers(0, len(found), (_PAIRS, 2))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    lengths = np.linalg.norm(found[pairs[:, 0]] - found[pairs[:, 1]], axis=1)
    truth = np.linalg.norm(true[pairs[:, 0]] - true[pairs[:, 1]], axis=1)
    error = lengths - truth
    return {
        "points": len(found),
        "scale_error_ppm": round(1e6 * float(lengths @ truth / (truth @ truth) - 1), 1),
        "rms_mm": round(1e3 * rms(error), 3),
        "mean_length_m": round(float(truth.mean()), 3),
    }
