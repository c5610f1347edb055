"""The surface between the cells of a grid: its area, its volume, and how heights move them.

Between the middles of four cells the surface is the mean of the two ways to cut that square into
triangles. Arrays of heights are (rows, columns) of cells, rows from north to south; those of
squares have one row and one column less.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve, uniform_filter
from scipy.special import ndtr

from alice_survey.core.frames import Array
from reconstruct.measure.errors import REACH_CELLS, own_correlation

_CORNERS = ((np.s_[:-1, :-1], -1, 1), (np.s_[:-1, 1:], 1, 1), (np.s_[1:, :-1], -1, -1),
            (np.s_[1:, 1:], 1, -1))  # fmt: skip
"""Corners of squares in an array of cells: north-west, north-east, south-west, south-east, and on
which side of the square each is, to the right and up."""
_TOO_SMOOTH = 0.5
"""Share of the stated noise that less scatter of slopes contradicts."""
_AROUND, _ALONG = 9, 41
"""Squares along a side, and steps of a line, over which the scatter of slopes is taken."""
_FAR = 9.0
"""Sigmas from which on noise lifts nothing."""
_NEXT, _ACROSS = (float(own_correlation(np.array(cells))) for cells in (1.0, np.sqrt(2.0)))


def corners_of(cells: Array) -> tuple[Array, ...]:
    """Values at the corners of squares."""
    return tuple(cells[corner] for corner, _, _ in _CORNERS)


def mean_of_corners(cells: Array) -> Array:
    """Mean value of each square's corners."""
    return np.asarray(sum(corners_of(cells)) / 4.0)


def spread_to_cells(squares: Array) -> Array:
    """Sum at each cell of a quarter of the values of the squares around it."""
    found = np.zeros((squares.shape[0] + 1, squares.shape[1] + 1))
    for corner, _, _ in _CORNERS:
        found[corner] += squares / 4.0
    return found


def own_variance(slopes: Array, sigma: Array, core: tuple[slice, slice]) -> float:
    """Variance by own errors of a figure with derivatives by heights, of the cells of a core.

    NaN where it hangs on a cell whose sigma is not stated.
    """
    if np.isnan(sigma[core][slopes[core] != 0.0]).any():
        return np.nan
    steps = np.arange(-REACH_CELLS, REACH_CELLS + 1)
    kernel = own_correlation(np.hypot(*np.meshgrid(steps, steps)))
    kicks = np.nan_to_num(slopes * sigma)
    return float((kicks * convolve(kicks, kernel, mode="constant"))[core].sum())


def _scatter() -> float:
    """Variance of what noise adds to a level floor, by the square of its mean in each square.

    A square adds half the sum of the squares of its sides' rises; the variance of a sum of squares
    of Gaussian numbers is twice the sum of their squared covariances.
    """
    steps = np.arange(-4, 5)
    x, y = np.meshgrid(steps, steps)

    def fading(right: int, up: int) -> Array:
        return own_correlation(np.hypot(x + right, y + up))

    alike = 2 * fading(0, 0) - fading(1, 0) - fading(-1, 0)
    other = fading(0, 1) + fading(-1, 0) - fading(0, 0) - fading(-1, 1)
    return float((alike**2 + other**2).sum() / (2 * (1 - _NEXT)) ** 2)


_SCATTER = _scatter()


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceArea:
    """Area of the surface over squares."""

    area: Array
    """(rows - 1, columns - 1) without what noise adds."""
    added: Array
    """Of it, what noise added in the mean and was taken away."""
    slopes: Array
    """(rows, columns, 3) derivatives of the weighted sum by the motions of the cells."""

    def scatter(self, weight: Array) -> float:
        """Variance of the weighted sum by how much noise adds, which differs from draw to draw."""
        return _SCATTER * float(np.nansum((weight * self.added) ** 2))


def surface_area(height: Array, own: Array, weight: Array, cell: float) -> SurfaceArea:
    """Area of the surface over squares, and what moves their weighted sum.

    A triangle with slopes p and q has the area of its plan times J = √(1 + p² + q²). Noise in the
    slopes of covariance V adds ½ tr(H V) in the mean, with the Hessian of J, H = (I - g gᵀ/J²)/J of
    g = (p, q), to second order: of a level surface whose slopes have a noise of 0.3, a tenth of it
    is left.

    Args:
        height: (rows, columns); NaN where unknown.
        own: (rows, columns) sigmas of own errors.
        weight: (rows - 1, columns - 1) of the squares.
        cell: side of a square.
    """
    nw, ne, sw, se = corners_of(height)
    own = np.nan_to_num(own)
    variances = corners_of(own**2)
    right = {1: (ne - nw) / cell, -1: (se - sw) / cell}
    up = {-1: (nw - sw) / cell, 1: (ne - se) / cell}
    sigma = {(-1, 1): 0, (1, 1): 1, (-1, -1): 2, (1, -1): 3}
    roots = corners_of(own)
    area, added, share_of_noise = np.zeros_like(nw), np.zeros_like(nw), np.ones_like(nw)
    slopes = np.zeros((*height.shape, 3))
    known = np.isfinite(nw + ne + sw + se)
    weight = np.where(known, weight, 0.0)
    for corner, to_right, to_up in _CORNERS:
        p, q = right[to_up], up[to_right]
        root = np.sqrt(1.0 + p**2 + q**2)
        # this corner, and the ends of the square's sides that meet in it
        here = sigma[to_right, to_up]
        aside, below = sigma[-to_right, to_up], sigma[to_right, -to_up]
        var_p = variances[here] + variances[aside] - 2 * _NEXT * roots[here] * roots[aside]
        var_q = variances[here] + variances[below] - 2 * _NEXT * roots[here] * roots[below]
        cov = (
            variances[here]
            - _NEXT * roots[here] * (roots[aside] + roots[below])
            + _ACROSS * roots[aside] * roots[below]
        )
        # p and q have the sign of the corner that is to the right, or up
        cov = cov * (to_right * to_up)
        bend = ((1 + q**2) * var_p + (1 + p**2) * var_q - 2 * p * q * cov) / root**3
        if (to_right, to_up) == (-1, 1):  # one corner of each square stands for all
            share_of_noise = not_more((p, q), (var_p + var_q) / cell**2)
        area += cell**2 * root / 4.0
        added += bend / 8.0
        # A triangle's area ½ |E₁ × E₂| moves with its sides E₁ = c (1, 0, p), E₂ = c (0, 1, q).
        share = weight * cell / 4.0 / root
        by_first = np.stack([share * (1 + q**2), share * -p * q, share * p], axis=-1)
        by_second = np.stack([share * -p * q, share * (1 + p**2), share * q], axis=-1)
        by_first, by_second = (np.nan_to_num(side) for side in (by_first, by_second))
        others = {(x, y): place for place, x, y in _CORNERS}
        slopes[corner] += to_right * by_first + to_up * by_second
        slopes[others[-to_right, to_up]] -= to_right * by_first
        slopes[others[to_right, -to_up]] -= to_up * by_second
    added *= share_of_noise
    return SurfaceArea(area=area - added, added=added, slopes=slopes)


def not_more(slopes: Sequence[Array], noise: Array) -> Array:
    """Share of the stated noise that there can be, where the surface is smoother than that.

    Sigmas of cells at ledges and of bridged ones are of what is there, not of differences between
    neighbours: noise is not larger than the scatter of slopes that is measured around.

    Args:
        slopes: (H, W) or (N,) of each direction; NaN where unknown.
        noise: sum of the variances of the slopes, as stated.
    """
    known = np.isfinite(sum(slopes) + noise)
    size = _AROUND if noise.ndim > 1 else _ALONG

    def around(part: Array) -> Array:
        return np.asarray(uniform_filter(np.where(known, part, 0.0), size, mode="constant"))

    here = np.maximum(around(np.ones_like(noise)), 1e-12)
    scatter = sum(around(one**2) / here - (around(one) / here) ** 2 for one in slopes)
    stated = around(noise) / here
    share = np.where(stated > 0, scatter / np.where(stated > 0, stated, 1.0), 1.0)
    # Half of it or more is what a small sample may show of noise as stated.
    return np.asarray(np.where(share < _TOO_SMOOTH, np.maximum(share, 0.0), 1.0))


def plan_slopes(weight: Array, cell: float) -> Array:
    """Derivatives (rows, columns, 3) of the weighted sum of the squares' plan areas."""
    slopes = np.zeros((weight.shape[0] + 1, weight.shape[1] + 1, 3))
    for corner, to_right, to_up in _CORNERS:
        slopes[corner][..., 0] += to_right * weight * cell / 2.0
        slopes[corner][..., 1] += to_up * weight * cell / 2.0
    return slopes


def lifted(distance: Array, sigma: Array) -> Array:
    """How much noise lifts the mean of max(distance, 0), at a true distance."""
    t = np.abs(distance) / np.maximum(sigma, 1e-300)
    t = np.minimum(t, _FAR)
    return np.asarray(sigma * (np.exp(-(t**2) / 2) / np.sqrt(2 * np.pi) - t * ndtr(-t)))


def sigma_of_means(own: Array) -> Array:
    """Sigma of the mean of each square's corners."""
    mean = mean_of_corners(own)
    return np.asarray(mean * np.sqrt((4 + 8 * _NEXT + 4 * _ACROSS) / 16.0))


def known_squares(cells: Array) -> NDArray[np.bool_]:
    """Squares of which all corners are known."""
    return np.asarray(np.isfinite(sum(corners_of(cells))))
