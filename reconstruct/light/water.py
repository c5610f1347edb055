"""What the water adds to light and takes from it, from spots that two views see.

With the direct light's pattern m, a picture's gain g and the fall-off b with range z, a view shows

    I = J exp(m(place) + g - b (z - z0)) (z0 / z)^s + A(place, z)
    A(place, z) = A0(place) (1 - exp(-B z)) / (1 - exp(-B z0))

per channel (Akkaynak & Treibitz 2018, equation 20: backscatter saturates with range and has a
coefficient B of its own), where s, the same for all channels, is 2 for the light of a small lamp
that travels along and 0 for daylight. A0 is a share u of the darkest light that a place of the
picture ever shows, where u varies smoothly over the picture: the darkest spots send some direct
light too.

Of two views of a spot, log(I1 - A1) - log(I2 - A2) is free of J; m, g, b, u and log B follow by
Gauss-Newton steps on all three channels together. Slopes and shadows change the direct light of a
view in all channels alike, and by far more than they change ratios of channels: errors are taken
to have one part that the channels share, and a small one of each, of the size of I. Both are
measured from the residuals. Where a step is linearised the light of a spot is the mean of what its
two views say: noise of one view, on both sides of the equation, would draw u to zero.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.sparse import block_array, csr_array, diags_array
from scipy.sparse.linalg import splu

from alice_survey.core.block_solver import solve_symmetric
from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from reconstruct.light.solve import (
    FALL_OFF_SIGMA,
    GRID,
    SAMPLES_PER_FACT,
    LightSamples,
    around_zero,
    bending,
    node_weights,
)

MIN_LEFT = np.float32(0.05)
"""Share of the light that stays at least when the water's is taken away."""
GREEN = 1
_NODES = GRID[0] * GRID[1]
_B, _LOG_GROWTH, _SPREAD = -3, -2, -1
"""Places of b, log B and s among a channel's unknowns, after m and u."""
_ROUNDS = 10
_GAIN_ROUNDS = (0, 4, 9)
"""Rounds that solve for gains too, which takes long; the others hold them."""
_STEP = 0.6
"""Share of a step in u and log B that is taken, but in the last rounds."""
_SHARE, _SHARE_SIGMA = 0.5, 0.5
"""Expected mean of u over a picture."""
_SATURATION, _SATURATION_SIGMA = 3.0, 0.5
"""Expected B z0, and sigma of its logarithm: 95 % of what endless water adds."""
_MIDDLE_SPREAD, _SPREAD_SIGMA = 1.0, 1.0
"""Expected s: between daylight and lamp."""
_SPREADS = (0.0, 2.0)
_FREE_ROUNDS, _HELD_SIGMA = 4, 0.01
"""Rounds after which s is held, within its bounds: its light has the shades of slopes in it."""
_TIE = 1e6
"""Weight with which s is the same for all channels."""
_MAX_SHARE_SIGMA = 0.25
"""Largest sigma of the mean of u with which light is taken away."""
_MIN_SAMPLES = 1000
"""Fewer leave residuals that say too little of the noise."""
_GAIN_SIGMA, _MIN_GAIN_SIGMA = 1.0, 0.02
_MIN_NOISE = 0.003
"""Least sigma of a channel's own part of a logarithm."""


@dataclass(frozen=True, kw_only=True, eq=False)
class WaterLight:
    """Light that water adds, and how it weakens the rest."""

    added: Mapping[str, Array]
    """Per camera (rows, columns, 3): light added at the middle range, BGR."""
    growth: Array
    """(3,) B, per unit of range."""
    share: Array
    """(3,) mean of u; 0 where not known."""
    share_sigma: Array
    """(3,)."""
    fall_off: Array
    """(3,) b, per unit of range."""
    fall_off_sigma: Array
    """(3,)."""
    to_green_sigma: Array
    """(3,) sigmas of the differences of b from that of green, which are known far better."""
    spread: float
    """s."""
    middle_range: float


def growth_at(growth: Array, ranges: NDArray[np.floating[Any]], middle_range: float) -> Array:
    """(..., 3) light added up to ranges (...) over that up to the middle one."""
    found: Array = np.expm1(-np.asarray(ranges)[..., None] * growth)
    return found / np.expm1(-middle_range * growth)


@progress.step("solve the light of the water")
def solve_water(
    samples: LightSamples, dark: Mapping[str, Array], cameras: Sequence[str]
) -> WaterLight:
    """Find what the water adds and takes.

    Args:
        samples: linear light; its logarithm and ranges, at least one.
        dark: per camera (rows, columns, 3) darkest light that each place shows.
        cameras: of the views, by number.
    """
    known = np.full(3, np.inf)
    if len(samples.views) >= _MIN_SAMPLES:
        found = _solve(samples, dark, cameras)
        known = found.share_sigma
        if (known <= _MAX_SHARE_SIGMA).all():
            return found
    # fall-offs are then those of all the light
    without = _solve(samples, {name: np.zeros_like(level) for name, level in dark.items()}, cameras)
    return replace(without, share=np.zeros(3), share_sigma=known)


def _solve(samples: LightSamples, dark: Mapping[str, Array], cameras: Sequence[str]) -> WaterLight:
    names = sorted(dark)
    camera_of = np.array([names.index(camera) for camera in cameras])
    level = np.concatenate([dark[name].reshape(-1, 3) for name in names])
    light = np.exp(samples.levels.astype(np.float64))
    ranges = np.asarray(samples.ranges, np.float64)
    middle = float(np.median(ranges))
    at = tuple(_place_matrix(samples, camera_of, len(names), side) for side in range(2))
    gain = _gain_matrix(samples.views, len(cameras))
    nodes, pictures = len(level), len(cameras)
    count = 2 * nodes + 3
    spread = (_MIDDLE_SPREAD, _SPREAD_SIGMA)
    u, log_b = np.full((nodes, 3), _SHARE), np.full(3, np.log(_SATURATION / middle))
    solution = np.zeros((3, count + pictures))
    noise, gain_sigma = np.array([0.05, 0.01]), _GAIN_SIGMA
    for turn in range(_ROUNDS):
        step = _linearise(light, ranges, middle, at, gain, level, u, log_b, solution, turn == 0)
        rest = step.target - np.stack(
            [step.dense[c] @ x[:count] + gain @ x[count:] for c, x in enumerate(solution)], axis=1
        )
        if turn:
            noise = _noise(rest, step)
        weights = _weights(rest, step, noise, robust=turn > 0)
        dense, right = _normal(step, gain, weights)
        gains = np.full(3 * pictures, gain_sigma**-2)
        prior = _prior(len(names), middle, spread)
        held = None if turn in _GAIN_ROUNDS else solution[:, count:].ravel()
        solution, sigmas = _solve_normal(dense, right, prior, gains, held, 3 * count)
        part = _STEP if turn < _ROUNDS - 2 else 1.0
        found = np.clip(solution[:, nodes : 2 * nodes].T, 0.0, 1.0)
        u = u + part * (found - u)
        log_b = log_b + part * np.clip(solution[:, :count][:, _LOG_GROWTH] - log_b, -1.0, 1.0)
        if turn == _FREE_ROUNDS:
            spread = (float(np.clip(solution[GREEN, :count][_SPREAD], *_SPREADS)), _HELD_SIGMA)
        gain_sigma = float(np.clip(solution[:, count:].std(), _MIN_GAIN_SIGMA, _GAIN_SIGMA))
    share_sigma, fall_off_sigma, to_green = sigmas
    added = (u * level).reshape(len(names), *GRID, 3)
    return WaterLight(
        added=dict(zip(names, added, strict=True)),
        growth=np.exp(log_b),
        share=u.mean(axis=0),
        share_sigma=share_sigma,
        fall_off=solution[:, :count][:, _B],
        fall_off_sigma=fall_off_sigma,
        to_green_sigma=to_green,
        spread=float(solution[:, :count][:, _SPREAD].mean()),
        middle_range=middle,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _PairEquations:
    """Equations of a round: dense[c] @ (m, u, b, log B, s) + gains = target[:, c], N rows."""

    dense: list[csr_array]
    target: Array
    """(N, 3)."""
    size: Array
    """(N, 3) square of the light shown over that which is left, the mean of both views."""
    usable: NDArray[np.bool_]
    """(N,)."""


def _linearise(
    light: Array, ranges: Array, middle: float, at: tuple[csr_array, ...], gain: csr_array,
    level: Array, u: Array, log_b: Array, solution: Array, first: bool,
) -> _PairEquations:  # fmt: skip
    nodes = len(level)
    count = 2 * nodes + 3
    growth = np.exp(log_b)
    h = growth_at(growth, ranges, middle)
    beyond = np.log(ranges / middle)
    dense, targets, sizes = [], [], []
    usable = np.ones(len(light), np.bool_)
    for c in range(3):
        added = np.stack([side @ (level[:, c] * u[:, c]) for side in at], axis=1) * h[..., c]
        shown = light[..., c]
        left = np.maximum(shown - added, MIN_LEFT * shown)
        usable &= (shown - added > MIN_LEFT * shown).all(axis=1)
        expected = left
        if not first:
            x = solution[c]
            model = np.stack([side @ x[:nodes] for side in at], axis=1)
            model -= x[:count][_B] * (ranges - middle) + x[:count][_SPREAD] * beyond
            # half of the gains' difference each way, about the spot's mean light
            model += 0.5 * (gain @ x[count:])[:, None] * [1.0, -1.0]
            ground = (np.log(left) - model).mean(axis=1, keepdims=True)
            expected = np.exp(ground + model)
        scale = h[..., c] / expected
        by_u = sum(
            sign * (diags_array(scale[:, k]) @ at[k] @ diags_array(level[:, c]))
            for k, sign in enumerate((1.0, -1.0))
        )
        by_growth = _slope_of_growth(growth[c], ranges, middle) * added / expected
        by_growth = by_growth[:, 0] - by_growth[:, 1]
        ends = [ranges[:, 1] - ranges[:, 0], by_growth, beyond[:, 1] - beyond[:, 0]]
        dense.append(
            block_array([[at[0] - at[1], by_u, csr_array(np.stack(ends, axis=1))]]).tocsr()
        )
        logs = np.log(left)
        targets.append(logs[:, 0] - logs[:, 1] + by_u @ u[:, c] + by_growth * log_b[c])
        sizes.append(((shown / left) ** 2).mean(axis=1))
    return _PairEquations(
        dense=dense, target=np.stack(targets, axis=1), size=np.stack(sizes, axis=1), usable=usable
    )


def _slope_of_growth(growth: float, ranges: Array, middle: float) -> Array:
    """Change of the logarithm of the light added with that of B."""

    def one(z: Array | float) -> Array:
        return np.asarray(growth * z / np.expm1(growth * np.asarray(z)))

    return one(ranges) - one(middle)


def _noise(rest: Array, step: _PairEquations) -> Array:
    """Sigmas of the part that channels share, and of their own over root of `size`."""
    own = [
        (rest[:, c] - rest[:, GREEN]) / np.sqrt(step.size[:, c] + step.size[:, GREEN])
        for c in (0, 2)
    ]
    parts = np.concatenate([np.abs(part[step.usable]) for part in own])
    sigma = max(1.4826 * float(np.median(parts)), _MIN_NOISE)
    green = 1.4826 * float(np.median(np.abs(rest[step.usable, GREEN])))
    size = float(np.median(step.size[step.usable, GREEN]))
    return np.array([math.sqrt(max(green**2 - sigma**2 * size, sigma**2)), sigma])


def _weights(rest: Array, step: _PairEquations, noise: Array, robust: bool) -> Array:
    """(N, 3, 3) inverse covariances of samples, Huber's weights in."""
    covariance = noise[0] ** 2 + noise[1] ** 2 * step.size[:, :, None] * np.eye(3)
    inverse = np.linalg.inv(covariance)
    weight = step.usable / SAMPLES_PER_FACT
    if robust:
        far = np.sqrt(np.einsum("ni,nij,nj->n", rest, inverse, rest) / 3.0)
        weight = weight / np.maximum(far, 1.0)
    return inverse * weight[:, None, None]


def _normal(step: _PairEquations, gain: csr_array, weights: Array) -> tuple[csr_array, Array]:
    """Normal equations of what the channels share, dense unknowns of all channels first."""
    whole = [block_array([[dense, gain]], format="csr") for dense in step.dense]
    count, size = step.dense[0].shape[1], whole[0].shape[1]
    blocks = np.empty((3, 3), object)
    for a in range(3):
        for b in range(a, 3):
            blocks[a, b] = whole[a].T @ diags_array(weights[:, a, b]) @ whole[b]
            blocks[b, a] = blocks[a, b].T
    right = np.stack([
        whole[a].T @ (weights[:, a] * step.target).sum(axis=1) for a in range(3)
    ])  # fmt: skip
    order = np.arange(3 * size).reshape(3, size)
    order = np.concatenate([order[:, :count].ravel(), order[:, count:].ravel()])
    return block_array(blocks.tolist(), format="csr")[order][:, order], right.ravel()[order]


def _solve_normal(
    matrix: csr_array, right: Array, prior: tuple[Array, Array], gains: Array,
    held: Array | None, dense: int,
) -> tuple[Array, tuple[Array, Array, Array]]:  # fmt: skip
    """Solve with the gains eliminated, or held; (3, unknowns), and sigmas of u, b, b - green's."""
    count = dense // 3
    mixed = matrix[:dense, dense:]
    kept, ends = matrix[:dense, :dense].toarray(), right[:dense] + np.tile(prior[1], 3)
    if held is None:
        block = splu((matrix[dense:, dense:] + diags_array(gains)).tocsc())
        solved = block.solve(np.column_stack([mixed.T.toarray(), right[dense:]]))
        taken = mixed @ solved
        kept, ends = kept - taken[:, :-1], ends - taken[:, -1]
    else:
        ends = ends - mixed @ held
    for c in range(3):
        at = slice(c * count, (c + 1) * count)
        kept[at, at] += prior[0]
    spreads = (1 + np.arange(3)) * count + _SPREAD
    kept[np.ix_(spreads, spreads)] += _TIE * (3.0 * np.eye(3) - 1.0)
    nodes = (count - 3) // 2
    looks = np.zeros((dense, 9))
    for c in range(3):
        looks[c * count + nodes : c * count + 2 * nodes, c] = 1.0 / nodes
        looks[(c + 1) * count + _B, [3 + c, 6 + c]] = 1.0
        looks[(GREEN + 1) * count + _B, 6 + c] -= 1.0
    both = solve_symmetric(kept, np.column_stack([ends, looks]))
    x = both[:, 0]
    sigmas = np.sqrt(np.maximum((looks * both[:, 1:]).sum(axis=0), 0.0))
    gain = held if held is not None else solved[:, -1] - (solved[:, :-1] * x).sum(axis=1)
    solution = np.concatenate([x.reshape(3, count), gain.reshape(3, -1)], axis=1)
    return solution, (sigmas[:3], sigmas[3:6], sigmas[6:])


def _prior(cameras: int, middle: float, spread: tuple[float, float]) -> tuple[Array, Array]:
    """Normal matrix and right side of (m, u, b, log B, s) of a channel."""
    # u of a whole picture counts once
    share = bending() + np.eye(_NODES) / (_SHARE_SIGMA**2 * _NODES)
    sigmas = np.array([FALL_OFF_SIGMA / middle, _SATURATION_SIGMA, np.sqrt(3.0) * spread[1]])
    ends = np.array([0.0, np.log(_SATURATION / middle), spread[0]])
    matrix = block_diag(*[around_zero()] * cameras, *[share] * cameras, np.diag(sigmas**-2))
    expected = np.concatenate([np.zeros(cameras * _NODES), np.full(cameras * _NODES, _SHARE), ends])
    return matrix, matrix @ expected


def _place_matrix(
    samples: LightSamples, camera_of: NDArray[np.int64], cameras: int, side: int
) -> csr_array:
    """(N, nodes) from values at all cameras' nodes to those at the places of one side."""
    at, weights = node_weights(samples.places[:, side])
    at = at + (_NODES * camera_of[samples.views[:, side]])[:, None]
    rows = np.repeat(np.arange(len(at)), 4)
    shape = (len(at), cameras * _NODES)
    return csr_array((weights.ravel(), (rows, at.ravel())), shape=shape)


def _gain_matrix(views: NDArray[np.int32], pictures: int) -> csr_array:
    """(N, pictures) 1 at the first view of a sample and -1 at the second."""
    rows = np.arange(len(views))
    values = np.concatenate([np.ones(len(views)), -np.ones(len(views))])
    both = (np.concatenate([rows, rows]), np.concatenate([views[:, 0], views[:, 1]]))
    return csr_array((values, both), shape=(len(views), pictures))
