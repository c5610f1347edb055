"""Parts of pictures that show what other instants do not: fish, weed, divers, drifting particles.

The surface on which two or more other stations agree is drawn into a view, and each of these
stations shows what colour it has there. Lamps, water and exposure make smooth differences, which
are fitted away pair by pair; what is left is noise, fine detail that does not quite register, and
what is not part of the surface. The latter is where a view differs from what the others agree on.
"""

import shutil
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import atomic_path, write_csv
from alice_survey.core.block_solver import MAD_TO_SIGMA
from alice_survey.core.frames import Array
from camera_calib.approximation.pinhole_warp import PinholeWarp
from reconstruct.dense.view_store import CHECKED, FACTORS, PICTURE, ViewStore, pack
from reconstruct.dense.views import ViewTask
from reconstruct.pictures.undistorted import MOVING, Pictures, moving_path, read_mask
from reconstruct.raster import write_png
from reconstruct.views.model import View

Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

COMPARED = 16
"""Neighbouring views that a view is compared with."""
LATTICE_PX = 256
"""Cells across a view in which views are compared, about."""
_SAME_DEPTH = 0.02
"""Relative difference up to which depths are those of one surface."""
_DARKEST = 6.0
"""Grey level below which differences are noise."""
_MIN_CELLS = 50
"""Cells that a view must share with another for their light to be compared."""
_FITTED_CELLS = 1500
_FIT_ROUNDS = 6
_MIN_SIGMA = 0.02
"""Of logarithms of light: what differs less is never told apart."""
_SEED, _GROWN = 4.5, 2.2
"""Standard deviations from which cells differ, and to which what differs is grown."""
_SEED_SHARE, _MIN_AREA = 0.3, 4
"""Of the compared cells of a part, those that differ by far; and its cells. In other light,
differences that fade out are many."""
_GAP_CELLS, _RIM_CELLS = 3, 2
"""Gaps in a part that are closed; and around it, where its rim is blended with what is behind."""
_MAX_SHARE = 0.5
"""A view that differs in more of what is compared differs otherwise."""
_SHOWN, _SHOWN_ACROSS, _SHOWN_SHAPE = 6, 3, (360, 480)
"""Pictures on the sheet, across it, and rows and columns of each."""
_ABOUT = ("moving.csv", "moving.png")
_LOGARITHMS = np.log(np.maximum(np.arange(256, dtype=np.float32), np.float32(_DARKEST)))
"""Of grey levels."""
_OUTLINE_BGR = (60, 60, 255)
_LOOK = "look"


class MovingShare(NamedTuple):
    """How much of a picture moves."""

    image: str
    masked: float
    """Share of the picture."""
    compared: float
    """Share of it that two or more other stations show."""


class Look(NamedTuple):
    """A view on a lattice of cells."""

    view: View
    step: int
    """Pixels of the view to a cell, each way."""
    light: Float32
    """(h, w, 3, 3) logarithm of even light in BGR, and its least and most in 3 x 3 cells."""
    usable: Mask
    """(h, w) where it shows something that may be used."""
    depth: Float32
    """(h, w) confirmed depth, NaN where unknown."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.depth.shape[0], self.depth.shape[1]

    @property
    def every_other(self) -> "Look":
        """One in four of the cells, the upper left."""
        one = slice(None, None, 2)
        light, usable, depth = self.light[one, one], self.usable[one, one], self.depth[one, one]
        return Look(self.view, 2 * self.step, light, usable, depth)


def mask_moving(workspace: Path, folder: Path, task: ViewTask) -> MovingShare:
    """Find what moves in a view; write its mask where anything does.

    Args:
        workspace: with the pictures.
        folder: of the stage; `moving/` in it holds the masks, as taken, 0 = leave out.
        task: the view and its neighbours; `keep_look` has kept the looks of all.
    """
    store, view = task.store, task.view
    look = load_look(store, task.index, view)
    others = [
        load_look(store, number, other)
        for number, other in task.others
        if other.station != view.station
    ]
    found, compared = moving_parts(look, others)
    if not found.any():
        return MovingShare(image=view.image, masked=0.0, compared=compared)
    pictures = Pictures.open(workspace)
    at = _lattice_as_taken(pictures.warp(view.image)) * view.pinhole.size_px / (2 * look.step)
    with np.errstate(invalid="ignore"):
        inside = np.asarray(((at >= 0) & (at < found.shape[::-1])).all(axis=-1))
    columns, rows = np.where(inside[..., None], at, 0).astype(np.int64).transpose(2, 0, 1)
    taken = found[rows, columns] & inside
    size = pictures.warp(view.image).size_px
    mask = cv2.resize(np.where(taken, 0, 255).astype(np.uint8), size,
                      interpolation=cv2.INTER_NEAREST)  # fmt: skip
    target = moving_path(folder / MOVING, view.image)
    target.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(target) as path:
        path.write_bytes(cv2.imencode(".png", mask, [cv2.IMWRITE_PNG_BILEVEL, 1])[1].tobytes())
    return MovingShare(image=view.image, masked=float(taken.mean()), compared=compared)


def clear_moving(folder: Path) -> None:
    """Forget what a run that was interrupted found."""
    shutil.rmtree(folder / MOVING, ignore_errors=True)
    for name in _ABOUT:
        (folder / name).unlink(missing_ok=True)


def show_moving(workspace: Path, folder: Path, shares: Sequence[MovingShare]) -> None:
    """Write `moving.csv`, and `moving.png` of the pictures in which most moves."""
    rows = [(one.image, f"{one.masked:.5f}", f"{one.compared:.3f}") for one in shares]
    table, sheet_png = (folder / name for name in _ABOUT)
    write_csv(table, ("image", "masked_share", "compared_share"), rows)
    shown = sorted((one for one in shares if one.masked > 0), key=lambda one: -one.masked)[:_SHOWN]
    if not shown:
        return
    pictures = Pictures.open(workspace)
    tiles = np.zeros((-(-len(shown) // _SHOWN_ACROSS) * _SHOWN_ACROSS, *_SHOWN_SHAPE, 3), np.uint8)
    for tile, one in zip(tiles, shown, strict=False):
        mask = read_mask(moving_path(folder / MOVING, one.image), pictures.warp(one.image).size_px)
        size = _SHOWN_SHAPE[::-1]
        tile[:] = cv2.resize(pictures.as_taken(one.image), size, interpolation=cv2.INTER_AREA)
        left_out = cv2.resize((~mask).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        outlines = cv2.findContours(left_out, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
        cv2.drawContours(tile, outlines, -1, _OUTLINE_BGR, 2)
    lines = tiles.reshape(-1, _SHOWN_ACROSS, *tiles.shape[1:])
    write_png(sheet_png, np.vstack([np.hstack(list(line)) for line in lines]))


@lru_cache(maxsize=16)
def _lattice_as_taken(warp: PinholeWarp) -> Array:
    """Where the pinhole shows cells of the picture as taken, (rows, columns, 2) of its size."""
    width, height = warp.size_px
    step = max(1, round(width / LATTICE_PX))
    rows, columns = -(-height // step), -(-width // step)
    x = (np.arange(columns) + 0.5) * width / columns
    y = (np.arange(rows) + 0.5) * height / rows
    taken = np.stack(np.meshgrid(x, y), axis=-1)
    return warp.to_pinhole(taken) / warp.pinhole.size_px


def keep_look(task: ViewTask) -> None:
    """Keep what a view shows on its lattice, for all views that are compared with it.

    Args:
        task: a view whose depth has been checked; the store has the factors of its light.
    """
    store, index, view = task.store, task.index, task.view
    width, height = view.pinhole.size_px
    step = _step(view)
    h, w = height // step, width // step
    colour = store.load_colour(index)
    factors = cv2.resize(store.load(0, FACTORS)[index], (width, height))
    valid = store.load_mask(index, PICTURE, "valid", width)
    valid &= cv2.inRange(colour, (0,) * 3, (_DARKEST,) * 3) == 0
    depth, _ = store.load_depth(index, "fine")
    depth[~store.load_mask(index, CHECKED, "kept", width)] = np.nan
    part = slice(0, h * step), slice(0, w * step)
    middle = slice(step // 2, h * step, step), slice(step // 2, w * step, step)
    shown = cv2.resize(_LOGARITHMS[colour[part]], (w, h), interpolation=cv2.INTER_AREA)
    usable = cv2.resize(valid[part].astype(np.uint8), (w, h), interpolation=cv2.INTER_AREA) > 0
    light = with_bounds(shown + np.log(factors[middle]))
    store.save(index, _LOOK, pack(light=light, usable=usable, depth=depth[middle]))


def load_look(store: ViewStore, index: int, view: View) -> Look:
    """What `keep_look` kept."""
    kept = store.load(index, _LOOK)
    return Look(view, _step(view), *(np.asarray(kept[name]) for name in kept.dtype.names or ()))


def _step(view: View) -> int:
    return max(1, round(view.pinhole.width_px / LATTICE_PX))


def moving_parts(look: Look, others: Sequence[Look]) -> tuple[Mask, float]:
    """Where a view shows what others do not.

    Args:
        look: the view; one in four of its cells is compared.
        others: views at other stations that see the same surface.

    Returns:
        (h / 2, w / 2) mask, and the share of the cells that could be compared.
    """
    fewer = look.every_other
    drawn = np.array([draw(other.every_other, fewer) for other in others], np.float32)
    at = np.array([other.view.station for other in others], np.int64)
    still = shared_depth(drawn.reshape(-1, *fewer.shape), at, _SAME_DEPTH)
    rows, columns = np.nonzero(np.isfinite(still) & fewer.usable)
    nothing = np.zeros(still.shape, np.bool_)
    depth = still[rows, columns]
    pixels: Array = (np.column_stack([columns, rows]).astype(np.float64) * 2 + 0.5) * look.step
    own, places = fewer.light[rows, columns], pixels / look.view.pinhole.size_px
    shown, stations, sigmas = [], [], []
    for other in others:
        cells, log_ratio = cells_at(look.view.show_in(other.view, pixels, depth), depth, other)
        known = np.flatnonzero(cells >= 0)
        if len(known) < _MIN_CELLS:
            continue
        there = other.light.reshape(-1, 3, 3)[cells]
        there[cells < 0] = np.nan
        features = smooth_features(places, log_ratio)
        chosen = known[:: max(1, len(known) // _FITTED_CELLS)]
        fit, sigma = smooth_difference(features[chosen], own[chosen, 0] - there[chosen, 0])
        there += (features @ fit)[:, None].astype(np.float32)
        shown.append(there)
        sigmas.append(sigma)
        stations.append(other.view.station)
    if len(set(stations)) < 2:
        return nothing, 0.0
    usual: Float32 = np.median(sigmas, axis=0).astype(np.float32)
    misfit, votes = find_odd(own, np.stack(shown), np.array(stations), usual, _GROWN)
    field = np.full(still.shape, np.nan, np.float32)
    field[rows, columns] = np.where(votes >= 2, misfit, np.nan)
    compared = np.isfinite(field)
    found = _parts(np.nan_to_num(field))
    if found.sum() > _MAX_SHARE * compared.sum():
        found = nothing
    return found, float(compared.mean())


def draw(look: Look, onto: Look) -> Array:
    """Draw the surface of a view into another, each cell into the four around it, the nearest last.

    Returns:
        (h, w) depth of the other's cells; NaN where nothing is drawn.
    """
    rows, columns = np.nonzero(np.isfinite(look.depth))
    pixels: Array = (np.column_stack([columns, rows]).astype(np.float64) + 0.5) * look.step
    x, y, depth = look.view.show_in(onto.view, pixels, look.depth[rows, columns]).T
    x, y = np.floor(x / onto.step - 0.5), np.floor(y / onto.step - 0.5)
    height, width = onto.shape
    inside = (x >= -1) & (x < width) & (y >= -1) & (y < height)
    cell = ((y[inside] + 1) * (width + 1) + x[inside] + 1).astype(np.int64)
    found = np.full((height + 1, width + 1), np.inf)
    np.minimum.at(found.reshape(-1), cell, depth[inside])  # each stands for the four around
    found = np.minimum(found[:-1], found[1:])
    found = np.minimum(found[:, :-1], found[:, 1:])
    return np.where(np.isfinite(found), found, np.nan)


def shared_depth(stack: Float32, stations: NDArray[np.int64], tolerance: float) -> Float32:
    """The nearest depth of each cell that views of two or more stations share.

    It is that of a surface which stays. Where there is none it is NaN.

    Args:
        stack: (K, h, w) depths, NaN where unknown.
        stations: (K,) of the views.
        tolerance: relative difference.
    """
    found: Float32 = np.full(stack.shape[1:], np.nan, np.float32)
    for depth, station in zip(stack, stations, strict=True):
        near = np.abs(stack - depth) <= np.float32(tolerance) * depth
        apart = near[stations != station].any(axis=0) & ~(depth >= found)
        mean = np.where(near, stack, 0).sum(axis=0, dtype=np.float64) / np.maximum(near.sum(0), 1)
        found[apart] = mean[apart]
    return found


def cells_at(there: Array, depth_here: Float32, other: Look) -> tuple[NDArray[np.int64], Array]:
    """Cells of a view that show points which have some depth (N,) in another.

    Args:
        there: (N, 3) pixels and depths of the points in the view.
        depth_here: (N,) in the other one.
        other: the view.

    Returns:
        (N,) cells, counted by rows, -1 where none shows the point; and (N,) the logarithm of the
        point's depth in the other view over that in this one, 0 where none does.
    """
    x, y, z = there.T / np.array([[other.step], [other.step], [1.0]])
    inside = (x >= 0) & (x < other.shape[1]) & (y >= 0) & (y < other.shape[0])
    column, row = np.where(inside, (x, y), 0).astype(np.int64)
    inside &= other.usable[row, column]
    inside &= np.abs(other.depth[row, column] - z) <= _SAME_DEPTH * z
    log_ratio = np.log(np.where(inside, depth_here / z, 1.0))
    return np.where(inside, row * other.shape[1] + column, -1), log_ratio


def with_bounds(light: Float32) -> Float32:
    """Light (h, w, 3) with its lowest and highest in the 3 x 3 cells around, (h, w, 3, 3)."""
    kernel = np.ones((3, 3), np.uint8)
    return np.stack([light, cv2.erode(light, kernel), cv2.dilate(light, kernel)], axis=2)


def smooth_features(places: Array, log_ratio: Array) -> Array:
    """(N, 7) what light may differ by: of second degree over the view, and with the range."""
    x, y = places.T - 0.5
    return np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y, log_ratio])


def smooth_difference(features: Array, apart: Float32) -> tuple[Array, Array]:
    """Fit differences of light (N, 3) robustly; coefficients (7, 3), and sigma (3,) of the rest."""
    a, b = features, apart.astype(np.float64)
    fit = np.zeros((a.shape[1], 3))
    fit[0] = np.median(b, axis=0)
    ridge = 1e-3 * len(a) * np.eye(a.shape[1])
    ridge[0, 0] = 0.0
    for _ in range(_FIT_ROUNDS):
        rest = b - a @ fit
        sigma = np.maximum(MAD_TO_SIGMA * np.median(np.abs(rest), axis=0), _MIN_SIGMA)
        size = np.sqrt(np.mean(np.square(rest / sigma), axis=1))
        weight = 1.0 / (1.0 + np.square(size / 2.0))
        left = a * weight[:, None]
        fit = np.linalg.solve(left.T @ a + ridge, left.T @ b)
    rest = b - a @ fit
    return fit, np.maximum(MAD_TO_SIGMA * np.median(np.abs(rest), axis=0), _MIN_SIGMA)


def find_odd(
    own: Float32, shown: Float32, stations: NDArray[np.int64], sigma: Float32, agreeing: float
) -> tuple[Float32, NDArray[np.int64]]:
    """How far each cell differs from what others agree on.

    Args:
        own: (N, 3, 3) light of cells, and its bounds around; colours last.
        shown: (K, N, 3, 3) what others show, NaN where they do not see it.
        stations: (K,) of the others.
        sigma: (3,) of differences, by colour.
        agreeing: largest difference from the median, in standard deviations, of one that agrees.

    Returns:
        (N,) root mean square difference over the colours in standard deviations, beyond what lies
        within the bounds of either; and how many stations agree, 0 where fewer than half of the
        views do.
    """
    known = np.isfinite(shown[:, :, 0, 0]).sum(axis=0)
    ranked, rank = np.sort(shown, axis=0), known[None, :, None, None]  # NaN comes last
    below, above = (
        np.take_along_axis(ranked, np.maximum(at, 0), axis=0)[0]
        for at in ((rank - 1) // 2, np.minimum(rank // 2, len(shown) - 1))
    )
    middle, low, high = (0.5 * (below + above)).transpose(1, 0, 2)

    def beyond(value: Float32, low: Float32, high: Float32) -> Float32:
        return np.asarray(np.maximum(np.maximum(low - value, value - high), np.float32(0)))

    near = _rms(beyond(middle, shown[:, :, 1], shown[:, :, 2]), sigma) <= agreeing
    votes = sum(near[stations == one].any(axis=0).astype(np.int64) for one in np.unique(stations))
    apart = np.minimum(beyond(own[:, 0], low, high), beyond(middle, own[:, 1], own[:, 2]))
    misfit = np.where(known < 2, np.float32(np.nan), _rms(apart, sigma))
    return misfit, np.where((2 * near.sum(axis=0) >= known) & (known >= 2), votes, 0)


def _rms(apart: Float32, sigma: Float32) -> Float32:
    return np.asarray(np.sqrt(np.mean(np.square(apart / sigma), axis=-1)))


def _parts(misfit: Float32) -> Mask:
    """Parts of a view that differ: around cells that do by far, as far as it does somewhat."""
    near = misfit > _GROWN
    count, label, stats, _ = cv2.connectedComponentsWithStats(near.astype(np.uint8))
    seeds = np.bincount(label[misfit > _SEED], minlength=count)
    area = stats[:, cv2.CC_STAT_AREA]
    kept = (seeds >= _SEED_SHARE * area) & (area >= _MIN_AREA)
    kept[0] = False
    found: Mask = kept[label]
    if not found.any():
        return found
    closed = cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_CLOSE, _disc(_GAP_CELLS))
    return np.asarray(cv2.dilate(closed, _disc(_RIM_CELLS)) > 0)


def _disc(radius: int) -> NDArray[np.uint8]:
    size = (2 * radius + 1, 2 * radius + 1)
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, size), np.uint8)
