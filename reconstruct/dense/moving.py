"""Parts of pictures that show what other instants do not: fish, weed, divers, drifting particles.

The surface on which two or more other stations agree is drawn into a view, and each of these
stations shows what colour it has there. Lamps, water and exposure make smooth differences, which
are fitted away pair by pair; what is left is noise, fine detail that does not quite register, and
what is not part of the surface. The latter is where a view differs from what the others agree on.
"""

import math
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import atomic_path, write_csv
from alice_survey.core.block_solver import MAD_TO_SIGMA
from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from camera_calib.approximation.pinhole_warp import PinholeWarp
from reconstruct.dense.view_store import ViewStore
from reconstruct.dense.views import ViewTask
from reconstruct.pictures.undistorted import MOVING, Pictures, moving_path, read_mask
from reconstruct.views.model import View
from reconstruct.views.range_shift import FAST, KernelLens, line_of, shown_at

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
_MIN_CELLS = 200
"""Cells that a view must share with another for their light to be compared."""
_FITTED_CELLS = 4000
_FIT_ROUNDS = 6
_MIN_SIGMA = 0.02
"""Of logarithms of light: what differs less is never told apart."""
_SEED, _GROWN = 4.5, 2.2
"""Standard deviations from which cells differ, and to which what differs is grown."""
_SEED_SHARE, _MIN_AREA = 0.3, 12
"""Of the cells of a part, those that differ by far; and its cells. In other light, differences
that fade out are many."""
_GAP_CELLS, _RIM_CELLS = 5, 3
"""Gaps in a part that are closed; and around it, where its rim is blended with what is behind."""
_MAX_SHARE = 0.5
"""A view that differs in more of what is compared differs otherwise."""
_SHOWN, _SHOWN_ACROSS, _SHOWN_PX = 6, 3, 480
"""Pictures on the sheet, across it, and their width."""
_ABOUT = ("moving.csv", "moving.png")
_LOGARITHMS = np.log(np.maximum(np.arange(256, dtype=np.float32), np.float32(_DARKEST)))
"""Of grey levels."""
_OUTLINE_BGR = (60, 60, 255)


@dataclass(frozen=True, kw_only=True)
class MovingShare:
    """How much of a picture moves."""

    image: str
    masked: float
    """Share of the picture."""
    compared: float
    """Share of it that two or more other stations show."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Look:
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
    at = _lattice_as_taken(pictures.warp(view.image)) * view.pinhole.size_px / look.step
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
    maximum = sorted((one for one in shares if one.masked > 0), key=lambda one: -one.masked)[
        :_SHOWN
    ]
    if not maximum:
        return
    pictures, tiles = Pictures.open(workspace), []
    for one in maximum:
        taken = pictures.as_taken(one.image)
        mask = read_mask(moving_path(folder / MOVING, one.image), pictures.warp(one.image).size_px)
        size = (_SHOWN_PX, round(_SHOWN_PX * taken.shape[0] / taken.shape[1]))
        shown = cv2.resize(taken, size, interpolation=cv2.INTER_AREA)
        left_out = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) == 0
        outlines, _ = cv2.findContours(left_out.astype(np.uint8), cv2.RETR_EXTERNAL,
                                       cv2.CHAIN_APPROX_NONE)  # fmt: skip
        cv2.drawContours(shown, outlines, -1, _OUTLINE_BGR, 2)
        tiles.append(shown)
    height = max(tile.shape[0] for tile in tiles)
    sheet = np.zeros((-(-len(tiles) // _SHOWN_ACROSS) * height, _SHOWN_ACROSS * _SHOWN_PX, 3),
                     np.uint8)  # fmt: skip
    for number, tile in enumerate(tiles):
        row, column = divmod(number, _SHOWN_ACROSS)
        at = slice(row * height, row * height + tile.shape[0])
        sheet[at, column * _SHOWN_PX : (column + 1) * _SHOWN_PX] = tile
    with atomic_path(sheet_png) as path:
        path.write_bytes(cv2.imencode(".png", sheet)[1].tobytes())


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
    factors = cv2.resize(store.load_factors(index), (width, height))
    valid = store.load_mask(index, "valid", width) & (colour.max(axis=2) > _DARKEST)
    depth, _ = store.load_depth(index, "fine")
    depth[~store.load_mask(index, "kept", width)] = np.nan
    part = slice(0, h * step), slice(0, w * step)
    middle = slice(step // 2, h * step, step), slice(step // 2, w * step, step)
    shown = cv2.resize(_LOGARITHMS[colour[part]], (w, h), interpolation=cv2.INTER_AREA)
    usable = cv2.resize(valid[part].astype(np.uint8), (w, h), interpolation=cv2.INTER_AREA) > 0
    store.save(index, "look.light", with_bounds(shown + np.log(factors[middle])))
    store.save(index, "look.usable", usable)
    store.save(index, "look.depth", np.ascontiguousarray(depth[middle]))


def load_look(store: ViewStore, index: int, view: View) -> Look:
    """What `keep_look` kept."""
    return Look(
        view=view,
        step=_step(view),
        light=np.asarray(store.load(index, "look.light")),
        usable=np.asarray(store.load(index, "look.usable")),
        depth=np.asarray(store.load(index, "look.depth")),
    )


def _step(view: View) -> int:
    return max(1, round(view.pinhole.width_px / LATTICE_PX))


def moving_parts(look: Look, others: Sequence[Look]) -> tuple[Mask, float]:
    """Where a view shows what others do not.

    Args:
        look: the view.
        others: views at other stations that see the same surface.

    Returns:
        (h, w) mask, and the share of the cells that could be compared.
    """
    shape = look.shape
    still = still_depth(look, others)
    rows, columns = np.nonzero(np.isfinite(still) & look.usable)
    nothing = np.zeros(shape, np.bool_)
    if len(rows) < _MIN_CELLS:
        return nothing, 0.0
    pixels: Array = np.column_stack([columns, rows]).astype(np.float64)
    pixels = (pixels + 0.5) * look.step
    points = look.view.at_depth(pixels, still[rows, columns].astype(np.float64))
    own = look.light[rows, columns]
    places = pixels / look.view.pinhole.size_px
    shown = np.empty((len(others), *own.shape), np.float32)
    stations: list[int] = []
    sigmas: list[Array] = []
    for other in others:
        cells, log_ratio = cells_at(
            points,
            still[rows, columns],
            np.ascontiguousarray(other.view.world_from_cam.inv().as_matrix()[:3]),
            other.view.kernel_lens,
            float(other.step),
            other.depth,
            other.usable,
        )
        known = np.flatnonzero(cells >= 0)
        if len(known) < _MIN_CELLS:
            continue
        chosen = known[:: max(1, len(known) // _FITTED_CELLS)]
        there = other.light.reshape(-1, 3, 3)[cells[chosen], 0]
        fit, sigma = _smooth_difference(
            _smooth(places[chosen], log_ratio[chosen]), own[chosen, 0] - there
        )
        adapt(other.light, cells, places, log_ratio, fit, shown[len(stations)])
        sigmas.append(sigma)
        stations.append(other.view.station)
    if len(set(stations)) < 2:
        return nothing, 0.0
    sigma = np.median(sigmas, axis=0).astype(np.float32)
    misfit, votes = odd_ones(
        own, shown[: len(stations)], np.array(stations, np.int64), sigma, _GROWN
    )
    field = np.full(shape, np.nan, np.float32)
    field[rows, columns] = np.where(votes >= 2, misfit, np.nan)
    compared = np.isfinite(field)
    found = _parts(np.nan_to_num(field))
    if found.sum() > _MAX_SHARE * compared.sum():
        found = nothing
    return found, float(compared.mean())


def still_depth(look: Look, others: Sequence[Look]) -> Float32:
    """Depth (h, w) of the surface on which two or more other stations agree; NaN where none."""
    stack = np.full((len(others), *look.shape), np.nan, np.float32)
    for k, other in enumerate(others):
        move = look.view.world_from_cam.inv() * other.view.world_from_cam
        draw(
            other.depth,
            (other.view.kernel_lens, float(other.step)),
            np.ascontiguousarray(move.as_matrix()[:3]),
            (look.view.kernel_lens, float(look.step)),
            stack[k],
        )
    stations = np.array([other.view.station for other in others], np.int64)
    return shared_depth(stack, stations, _SAME_DEPTH)


@compiled(error_model="numpy", fastmath=FAST)
def draw(
    depth: Float32,
    lattice: tuple[KernelLens, float],
    onto_from_cam: Array,
    onto_lattice: tuple[KernelLens, float],
    onto: Float32,
) -> None:
    """Draw the surface of a view into another, each cell into the four around it, the nearest last.

    Args:
        depth: (h, w) of the view's cells, NaN where unknown.
        lattice: lens of the view, and pixels to a cell.
        onto_from_cam: (3, 4) transform of points to the other's camera.
        onto_lattice: as `lattice`, of the other.
        onto: (h, w) depth of the other's cells, changed in place; NaN where nothing is drawn yet.
    """
    (pinhole, field, inverse_working), step = lattice
    onto_lens, onto_step = onto_lattice
    height, width = onto.shape
    t = onto_from_cam
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            z = depth[i, j]
            if math.isnan(z):
                continue
            x, y, by_x, by_y = line_of(
                pinhole, field, inverse_working, (j + 0.5) * step, (i + 0.5) * step
            )
            a, b = x * z + by_x, y * z + by_y
            deep = t[2, 0] * a + t[2, 1] * b + t[2, 2] * z + t[2, 3]
            if deep <= 0.0:
                continue
            a, b = (
                t[0, 0] * a + t[0, 1] * b + t[0, 2] * z + t[0, 3],
                t[1, 0] * a + t[1, 1] * b + t[1, 2] * z + t[1, 3],
            )
            u, v = shown_at(onto_lens, a, b, deep)
            left, top = math.floor(u / onto_step - 0.5), math.floor(v / onto_step - 0.5)
            for row in range(max(top, 0), min(top + 2, height)):
                for column in range(max(left, 0), min(left + 2, width)):
                    if not onto[row, column] <= deep:
                        onto[row, column] = deep


@compiled
def shared_depth(stack: Float32, stations: NDArray[np.int64], tolerance: float) -> Float32:
    """The nearest depth of each cell that views of two or more stations share.

    Args:
        stack: (K, h, w) depths, NaN where unknown.
        stations: (K,) of the views.
        tolerance: relative difference.
    """
    views, height, width = stack.shape
    found = np.full((height, width), np.nan, np.float32)
    for row in range(height):
        for column in range(width):
            for k in range(views):
                z = stack[k, row, column]
                if math.isnan(z) or z >= found[row, column]:
                    continue
                total, count, apart = 0.0, 0, False
                for j in range(views):
                    other = stack[j, row, column]
                    if abs(other - z) <= tolerance * z:
                        total += other
                        count += 1
                        apart = apart or stations[j] != stations[k]
                if apart:
                    found[row, column] = total / count
    return found


@compiled(error_model="numpy", fastmath=FAST)
def cells_at(
    points: Array,
    depth_here: Float32,
    cam_from_world: Array,
    lens: KernelLens,
    step: float,
    depth: Float32,
    usable: Mask,
) -> tuple[NDArray[np.int64], Array]:
    """Cells of a view that show points (N, 3) which have some depth (N,) in another.

    Returns:
        (N,) cells, counted by rows, -1 where none shows the point; and (N,) the logarithm of the
        point's depth in the other view over that in this one.
    """
    height, width = depth.shape
    cells = np.full(len(points), -1, np.int64)
    log_ratio = np.zeros(len(points))
    t = cam_from_world
    for n in range(len(points)):
        e, m, d = points[n, 0], points[n, 1], points[n, 2]
        z = t[2, 0] * e + t[2, 1] * m + t[2, 2] * d + t[2, 3]
        if z <= 0.0:
            continue
        a = t[0, 0] * e + t[0, 1] * m + t[0, 2] * d + t[0, 3]
        b = t[1, 0] * e + t[1, 1] * m + t[1, 2] * d + t[1, 3]
        u, v = shown_at(lens, a, b, z)
        column, row = math.floor(u / step), math.floor(v / step)
        if column < 0 or row < 0 or column >= width or row >= height or not usable[row, column]:
            continue
        if abs(depth[row, column] - z) <= _SAME_DEPTH * z:
            cells[n], log_ratio[n] = row * width + column, math.log(depth_here[n] / z)
    return cells, log_ratio


def with_bounds(light: Float32) -> Float32:
    """Light (h, w, 3) with its lowest and highest in the 3 x 3 cells around, (h, w, 3, 3)."""
    kernel = np.ones((3, 3), np.uint8)
    return np.stack([light, cv2.erode(light, kernel), cv2.dilate(light, kernel)], axis=2)


@compiled
def adapt(
    light: Float32,
    cells: NDArray[np.int64],
    places: Array,
    log_ratio: Array,
    fit: Array,
    shown: Float32,
) -> None:
    """Write what a view shows as another would see it, (N, 3, 3); NaN where it shows nothing.

    Args:
        light: (h, w, 3, 3) of the view.
        cells: (N,) of the view, see `cells_at`.
        places: (N, 2) in the other, as shares of its size.
        log_ratio: (N,) see `cells_at`.
        fit: (7, 3) coefficients of `_smooth`.
        shown: to write to.
    """
    width = light.shape[1]
    for n in range(len(cells)):
        if cells[n] < 0:
            shown[n] = np.nan
            continue
        row, column = cells[n] // width, cells[n] % width
        x, y = places[n, 0] - 0.5, places[n, 1] - 0.5
        for c in range(3):
            change = fit[0, c] + x * fit[1, c] + y * fit[2, c] + log_ratio[n] * fit[6, c]
            change += x * x * fit[3, c] + x * y * fit[4, c] + y * y * fit[5, c]
            for kind in range(3):
                shown[n, kind, c] = light[row, column, kind, c] + change


def _smooth(places: Array, log_ratio: Array) -> Array:
    """(N, 7) what light may differ by: of second degree over the view, and with the range."""
    x, y = places.T - 0.5
    return np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y, log_ratio])


def _smooth_difference(features: Array, apart: Float32) -> tuple[Array, Array]:
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


@compiled
def odd_ones(
    own: Float32,
    shown: Float32,
    stations: NDArray[np.int64],
    sigma: Float32,
    agreeing: float,
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
    views, count = shown.shape[0], own.shape[0]
    misfit = np.full(count, np.nan, np.float32)
    votes = np.zeros(count, np.int64)
    values, at, met = np.empty(views), np.empty(views, np.int64), np.empty(views, np.int64)
    middle, low, high = np.empty(3), np.empty(3), np.empty(3)
    for n in range(count):
        known = 0
        for k in range(views):
            if not math.isnan(shown[k, n, 0, 0]):
                at[known] = k
                known += 1
        if known < 2:
            continue
        for c in range(3):
            for kind in range(3):
                for i in range(known):
                    value, place = shown[at[i], n, kind, c], i
                    while place > 0 and values[place - 1] > value:
                        values[place] = values[place - 1]
                        place -= 1
                    values[place] = value
                value = 0.5 * (values[(known - 1) // 2] + values[known // 2])
                if kind == 0:
                    middle[c] = value
                elif kind == 1:
                    low[c] = value
                else:
                    high[c] = value
        near, places = 0, 0
        for i in range(known):
            square = 0.0
            for c in range(3):
                off = max(shown[at[i], n, 1, c] - middle[c], middle[c] - shown[at[i], n, 2, c], 0.0)
                square += (off / sigma[c]) ** 2
            if math.sqrt(square / 3.0) > agreeing:
                continue
            near += 1
            station, first = stations[at[i]], True
            for j in range(places):
                first = first and met[j] != station
            if first:
                met[places] = station
                places += 1
        square = 0.0
        for c in range(3):
            there = max(low[c] - own[n, 0, c], own[n, 0, c] - high[c], 0.0)
            here = max(own[n, 1, c] - middle[c], middle[c] - own[n, 2, c], 0.0)
            square += (min(there, here) / sigma[c]) ** 2
        misfit[n] = math.sqrt(square / 3.0)
        if 2 * near >= known:
            votes[n] = places
    return misfit, votes


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
