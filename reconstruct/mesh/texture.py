"""Paint the pages of a texture: each picture is read twice, to compare seams and to paint.

Colour steps between patches of different pictures are levelled over the whole mesh at once. Every
patch gets a smooth correction, one value a channel at each of its wedges, such that both sides of a
seam show the same and the corrections change as little as they can within a patch (Lempitsky &
Ivanov 2007, eq. 5; Waechter et al. 2014, "Let there be color!", eq. 3).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.linalg import cg

from alice_survey.core.compiled import compiled
from alice_survey.core.errors import warn
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from reconstruct.light.solve import LightModel
from reconstruct.mesh.atlas import Atlas, Wedges, make_pages, make_wedges
from reconstruct.mesh.topology import Triangles, edges_of
from reconstruct.mesh.visibility import Charts, choose_views, find_candidates, make_charts, to_world
from reconstruct.pictures.undistorted import WHOLE, Part, Pictures
from reconstruct.ply import CloudFile
from reconstruct.views.model import View

Float32 = NDArray[np.float32]
_SEAM_SIGMA_PX = 4.0
"""Sigma of the average around a seam's vertices by which both sides are compared."""
_LIFT_STEPS = 0.5
"""Height over the surface, in spacings of the cloud, at which lines of sight start."""
_JPEG_QUALITY = 93
_MAX_ROWS = 30_000
"""Most rows for `cv2.remap`, which takes at most 32767."""
_SMOOTHNESS = 0.1
"""Weight of a change along an edge within a patch, over that of a step at a seam."""
_PULL = 1e-4
"""Weight of the correction itself, which keeps the level of the whole."""
_TOLERANCE, _MAX_STEPS = 1e-5, 5000


@dataclass(frozen=True, kw_only=True, eq=False)
class Textured:
    """A mesh with its texture."""

    vertices: Array
    """(V, 3) east, north, up from the offset."""
    wedges: Wedges
    uv: Array
    """(W, 2) u to the right, v upwards, 0 to 1."""
    page: NDArray[np.int32]
    """(T,) page of every face."""
    pages: tuple[Path, ...]
    label: NDArray[np.int32]
    """(T,) view of every face, negative where no view sees it."""
    scale: float
    """Factor by which the pictures were shrunk."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PagePaintTask:
    """The patches of one view."""

    view: View | None
    """None for what no view sees, which has the colours of the cloud."""
    factors: Float32 | None
    """What evens its light; None without a view."""
    atlas: Atlas
    """Of these patches."""
    pixels: tuple[Array, ...]
    """Per patch (W, 2) its wedges in the picture as scaled."""
    corrections: tuple[Float32, ...]
    """Per patch (W, 3), BGR."""
    triangles: tuple[Triangles, ...]
    """Per patch (T, 3) of its own wedges."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MeshSetup:
    """What a mesh and all its tiles share."""

    workspace: Path
    """With the pictures."""
    cloud: CloudFile
    offset: Array
    """(3,) of its coordinates: east, north, up."""
    step: float
    """Spacing of its points."""
    pixel: float
    """Side of a texture's pixel where no view sees the mesh."""


def make_texture(
    setup: MeshSetup,
    folder: Path,
    vertices: Array,
    triangles: Triangles,
    views: Sequence[View],
    light: LightModel,
    executor: Executor,
    tile: NDArray[np.int32] | None = None,
    **occluders: Any,
) -> Textured:
    """Choose the views that paint a mesh, and paint it.

    Args:
        setup: of the survey.
        folder: for the pages, `texture_0.jpg` and on.
        vertices: (V, 3) east, north, up from the offset.
        triangles: (T, 3).
        views: to choose from.
        light: of the survey.
        executor: where tasks run.
        tile: (T,) page of every face, -1 for those that only help to level the colours; None where
            patches go onto as few pages as they can.
        occluders: of `find_candidates`.
    """
    path = folder / "sights.npz"
    np.savez(path, vertices=vertices, triangles=triangles, offset=setup.offset, **occluders)
    lift, count = _LIFT_STEPS * setup.step, len(triangles)
    candidates = find_candidates(path, count, setup.workspace, views, lift, executor)
    path.unlink()
    label = choose_views(vertices, triangles, candidates)
    del candidates
    charts = make_charts(vertices, triangles, label, tile)
    page = None
    if tile is not None:
        page = np.empty(len(charts.views), np.int32)
        page[charts.chart] = tile
    wedges = make_wedges(triangles, charts)
    pixels = wedge_pixels(vertices, wedges, charts, views, setup.offset, setup.pixel)
    atlas = make_pages(pixels, wedges, page, len(charts.views))
    corrections = _corrections(pixels, wedges, charts, views, setup.workspace, light, executor)
    unseen = charts.views[wedges.chart] < 0
    cloud_colours = colours_of_cloud(setup.cloud, vertices, setup.step)
    corrections[unseen] = cloud_colours[wedges.vertex[unseen]][:, ::-1]
    scratch = tuple(folder / f"page_{number}.raw" for number in range(len(atlas.sizes)))
    for path, (width, height) in zip(scratch, atlas.sizes, strict=True):
        np.memmap(path, np.uint8, "w+", shape=(height, width, 3)).flush()
    placed = pixels * atlas.scale
    tasks = _paint_tasks(atlas, wedges, charts, views, light, placed, corrections)
    work = partial(paint_view, setup.workspace, scratch)
    for _ in executor.map(work, tasks, label="paint"):
        pass
    on_page = atlas.place(pixels, wedges.chart)
    pages = []
    for number, (path, size) in enumerate(zip(scratch, atlas.sizes, strict=True)):
        picture = np.array(np.memmap(path, np.uint8, "r", shape=(size[1], size[0], 3)))
        pages.append(folder / f"texture_{number}.jpg")
        write_jpeg(pages[-1], picture)
        path.unlink()
    return Textured(
        vertices=vertices,
        wedges=wedges,
        uv=atlas.uv(on_page, wedges.chart),
        page=atlas.page[charts.chart],
        pages=tuple(pages),
        label=charts.label,
        scale=atlas.scale,
    )


def write_jpeg(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write a BGR picture without thinning its colours."""
    flags = [
        cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    ]  # fmt: skip
    path.write_bytes(cv2.imencode(".jpg", picture, flags)[1].tobytes())


def wedge_pixels(
    vertices: Array,
    wedges: Wedges,
    charts: Charts,
    views: Sequence[View],
    offset_enu: Array,
    plain_pixel: float,
) -> Array:
    """Where the picture of every wedge's patch shows it, (W, 2).

    What no view sees lies flat along the axis that it faces most.
    """
    label = charts.views[wedges.chart]
    pixels = np.empty((len(label), 2))
    for mine in by_value(label, np.arange(len(label))):
        number = int(label[mine[0]])
        points = vertices[wedges.vertex[mine]]
        if number >= 0:
            pixels[mine] = views[number].project(to_world(points, offset_enu))
        else:
            axis = (-1 - number) // 2
            pixels[mine] = np.delete(points, axis, axis=1) / plain_pixel
    return pixels


def by_value(values: NDArray[np.integer], rows: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Some rows in groups of one value each, by rising value and in their order."""
    order = rows[np.argsort(values[rows], kind="stable")]
    groups = np.split(order, np.flatnonzero(np.diff(values[order])) + 1)
    return groups if len(order) else []


def even_colour(pictures: Pictures, view: View, factors: Float32, part: Part = WHOLE) -> Float32:
    """A view's picture, or a part of it, under even light, (H, W, 3) BGR."""
    colour = pictures.colour(view.image, part)
    x, y = (
        ((np.arange(size)[along] + 0.5) / size * (nodes - 1)).astype(np.float32)
        for size, nodes, along in zip(
            view.pinhole.size_px, factors.shape[1::-1], part[::-1], strict=True
        )
    )
    at = np.meshgrid(x, y)
    lift = cv2.remap(factors, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(colour.astype(np.float32) * lift)


def _part_around(view: View, low: Array, high: Array, margin: int) -> Part:
    """The part of a view between two pixels (2,) and a margin around, of one pixel at least."""
    size = np.array(view.pinhole.size_px)
    first = np.clip(np.floor(low) - margin, 0, size - 1).astype(int).tolist()
    last = np.clip(np.ceil(high) + margin, np.add(first, 1), size).astype(int).tolist()
    return slice(first[1], last[1]), slice(first[0], last[0])


def seam_colours(workspace: Path, task: tuple[View, Float32, Array]) -> Float32:
    """Mean colour around pixels (N, 2) of one view, (N, 3) BGR; NaN where nothing usable is near.

    Args:
        workspace: with the pictures.
        task: the view, what evens its light, and the pixels.
    """
    view, factors, pixels = task
    pictures = Pictures.still(workspace)
    margin = math.ceil(5 * _SEAM_SIGMA_PX)
    part = _part_around(view, np.nanmin(pixels, axis=0), np.nanmax(pixels, axis=0), margin)
    even = even_colour(pictures, view, factors, part)
    weight = pictures.valid(view.image, part).astype(np.float32)
    even *= weight[..., None]
    total = cv2.GaussianBlur(even, (0, 0), _SEAM_SIGMA_PX)
    share = cv2.GaussianBlur(weight, (0, 0), _SEAM_SIGMA_PX)
    sums, shares = (
        remap(
            picture, pixels - (part[1].start, part[0].start), cv2.INTER_LINEAR, cv2.BORDER_REPLICATE
        )
        for picture in (total, share)
    )
    return np.where(
        shares[:, None] > 0.1, sums / np.maximum(shares, 0.1)[:, None], np.float32(np.nan)
    )


def remap(picture: NDArray[Any], pixels: Array, interpolation: int, border: int) -> NDArray[Any]:
    """What OpenCV finds in a picture (H, W, ...) at pixels (N, 2), (N, ...).

    Beyond the picture it is what the border's mode says, NaN for a constant one.
    """
    at = np.nan_to_num(pixels - 0.5, nan=-1e4).astype(np.float32)
    parts = [np.empty((0, *picture.shape[2:]), picture.dtype)]
    for first in range(0, len(at), _MAX_ROWS):
        x, y = at[first : first + _MAX_ROWS].T[:, :, None]
        parts.append(
            cv2.remap(
                picture, np.ascontiguousarray(x), np.ascontiguousarray(y), interpolation,
                borderMode=border, borderValue=np.nan,
            )[:, 0]
        )  # fmt: skip
    return np.concatenate(parts)


def _corrections(
    pixels: Array,
    wedges: Wedges,
    charts: Charts,
    views: Sequence[View],
    workspace: Path,
    light: LightModel,
    executor: Executor,
) -> Array:
    """Corrections (W, 3), BGR, that level the seams between views."""
    label = charts.views[wedges.chart]
    at_seam = np.zeros(len(label), np.bool_)
    at_seam[seam_pairs(wedges)] = True
    at_seam &= label >= 0
    groups = by_value(label, np.flatnonzero(at_seam))
    seeing = [views[label[group[0]]] for group in groups]
    tasks = [(view, light.factors(view.camera, view.image), pixels[group])
             for view, group in zip(seeing, groups, strict=True)]  # fmt: skip
    colours = np.full((len(label), 3), np.nan)
    found = executor.map(partial(seam_colours, workspace), tasks, label="compare seams")
    for group, colour in zip(groups, found, strict=True):
        colours[group] = colour
    return level_seams(wedges, colours, label >= 0)


def seam_pairs(wedges: Wedges) -> NDArray[np.int64]:
    """(S, 2) wedges of one vertex in different patches, each next to the one before."""
    order = np.argsort(wedges.vertex, kind="stable")
    same = wedges.vertex[order][1:] == wedges.vertex[order][:-1]
    return np.stack([order[:-1][same], order[1:][same]], axis=1).astype(np.int64)


@progress.step("level colours")
def level_seams(wedges: Wedges, colours: Array, free: NDArray[np.bool_]) -> Array:
    """Corrections (W, 3) to add to the colours of patches.

    Args:
        wedges: of the mesh.
        colours: (W, 3) what the patch's picture shows around the wedge; used at seams only.
        free: (W,) wedges that may be corrected; others stay at 0.
    """
    pairs = seam_pairs(wedges)
    pairs = pairs[np.isfinite(colours[pairs]).all(axis=(1, 2))]
    edges, _ = edges_of(wedges.triangles)
    count = len(wedges.vertex)
    gain = _laplacian(pairs, 1.0, count) + _laplacian(edges, _SMOOTHNESS, count)
    gain = (gain + diags_array(np.full(count, _PULL))).tocsr()
    kept = np.flatnonzero(free)
    system = csr_array(gain[kept][:, kept])
    inverse = diags_array(1.0 / system.diagonal())
    result = np.zeros((count, 3))
    for channel in range(3):
        step = colours[pairs[:, 1], channel] - colours[pairs[:, 0], channel]
        target = np.bincount(pairs[:, 0], step, count) - np.bincount(pairs[:, 1], step, count)
        if not np.any(target[kept]):
            continue
        solution, failed = cg(system, target[kept], rtol=_TOLERANCE, maxiter=_MAX_STEPS, M=inverse)
        if failed:
            warn(f"colours of the mesh (channel {channel}) are not levelled to {_TOLERANCE:g}")
        result[kept, channel] = solution
    return result


def _laplacian(pairs: NDArray[np.int64], weight: float, count: int) -> csr_array:
    one, other = pairs[:, 0], pairs[:, 1]
    values = np.full(len(pairs), weight)
    rows = np.concatenate([one, other, one, other])
    columns = np.concatenate([one, other, other, one])
    entries = np.concatenate([values, values, -values, -values])
    return coo_array((entries, (rows, columns)), (count, count)).tocsr()


def _paint_tasks(
    atlas: Atlas,
    wedges: Wedges,
    charts: Charts,
    views: Sequence[View],
    light: LightModel,
    placed: Array,
    corrections: Array,
) -> list[PagePaintTask]:
    """One task for each view with patches; the last for what no view sees."""
    members = by_value(wedges.chart, np.arange(len(wedges.chart)))
    faces = by_value(charts.chart, np.arange(len(charts.chart)))
    local = np.empty(len(wedges.chart), np.int32)
    for mine in members:
        local[mine] = np.arange(len(mine))
    tasks = []
    shown = np.maximum(charts.views, -1)
    for mine in by_value(shown, np.flatnonzero(atlas.page >= 0)):
        number = int(shown[mine[0]])
        view = views[number] if number >= 0 else None
        tasks.append(
            PagePaintTask(
                view=view,
                factors=None if view is None else light.factors(view.camera, view.image),
                atlas=atlas.part(mine),
                pixels=tuple(placed[members[c]] for c in mine),
                corrections=tuple(corrections[members[c]].astype(np.float32) for c in mine),
                triangles=tuple(local[wedges.triangles[faces[c]]] for c in mine),
            )
        )
    return tasks


def paint_view(workspace: Path, files: tuple[Path, ...], task: PagePaintTask) -> None:
    """Write the patches of one view into the pages; no two views write to the same pixel.

    Args:
        workspace: with the pictures.
        files: of the pages.
        task: the patches.
    """
    atlas = task.atlas
    pages = {
        number: np.memmap(files[number], np.uint8, "r+", shape=(*atlas.sizes[number][::-1], 3))
        for number in np.unique(atlas.page).tolist()
    }
    picture = np.zeros((1, 1, 3), np.float32)
    valid = np.ones((1, 1), np.uint8)
    part = WHOLE
    if task.view is not None and task.factors is not None:
        pictures = Pictures.still(workspace)
        if atlas.scale == 1.0:
            ends = atlas.source.min(axis=0), (atlas.source + atlas.box).max(axis=0)
            part = _part_around(task.view, *ends, 0)
        picture = even_colour(pictures, task.view, task.factors, part)
        valid = pictures.valid(task.view.image, part).astype(np.uint8)
        if atlas.scale < 1.0:
            size = [max(1, round(side * atlas.scale)) for side in picture.shape[1::-1]]
            picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
            valid = cv2.resize(valid, size, interpolation=cv2.INTER_NEAREST)
    for i, (corners, values, triangles) in enumerate(
        zip(task.pixels, task.corrections, task.triangles, strict=True)
    ):
        (width, height), (x, y) = atlas.box[i], atlas.source[i]
        x, y = x - (part[1].start or 0), y - (part[0].start or 0)
        columns = np.clip(np.arange(x, x + width), 0, picture.shape[1] - 1)
        rows = np.clip(np.arange(y, y + height), 0, picture.shape[0] - 1)
        crop = picture[np.ix_(rows, columns)]
        usable = valid[np.ix_(rows, columns)] > 0
        correction, covered = spread_corners(
            corners - atlas.source[i], triangles, values, (int(height), int(width))
        )
        nearest = nearest_covered(covered)
        patch = crop + correction[nearest]
        beyond = ~covered & ~usable
        patch[beyond] = patch[nearest][beyond]
        left, top = atlas.corner[i]
        pages[int(atlas.page[i])][top : top + height, left : left + width] = np.clip(
            np.rint(patch), 0, 255
        ).astype(np.uint8)
    for page in pages.values():
        page.flush()


def nearest_covered(covered: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Row and column of the covered pixel next to every pixel (itself where covered)."""
    if not covered.any():
        every = np.indices(covered.shape)
        return every[0], every[1]
    _, labels = cv2.distanceTransformWithLabels(
        (~covered).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    row_of = np.zeros(int(labels.max()) + 1, np.intp)
    column_of = np.zeros_like(row_of)
    rows, columns = np.nonzero(covered)
    row_of[labels[rows, columns]], column_of[labels[rows, columns]] = rows, columns
    return row_of[labels], column_of[labels]


@compiled
def spread_corners(
    corners: Array, triangles: Triangles, values: Float32, shape: tuple[int, int]
) -> tuple[Float32, NDArray[np.bool_]]:
    """Values at the corners of triangles, spread linearly over the pixels they cover.

    Args:
        corners: (W, 2) pixels from the outer corner of the first.
        triangles: (T, 3).
        values: (W, 3).
        shape: rows and columns.

    Returns:
        (H, W, 3) at the pixels' centres, 0 where nothing covers them, and (H, W) whether a
        triangle does (to within half a pixel, so that none is missed along a shared side).
    """
    rows, columns = shape
    spread = np.zeros((rows, columns, 3), np.float32)
    covered = np.zeros((rows, columns), np.bool_)
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ax, ay = corners[a, 0], corners[a, 1]
        ux, uy = corners[b, 0] - ax, corners[b, 1] - ay
        vx, vy = corners[c, 0] - ax, corners[c, 1] - ay
        area = ux * vy - uy * vx
        if abs(area) < 1e-9:
            continue
        # a step of half a pixel changes a share by at most half its slope
        slack_b = 0.5 * (abs(vy) + abs(vx)) / abs(area)
        slack_c = 0.5 * (abs(uy) + abs(ux)) / abs(area)
        slack_a = 0.5 * (abs(vy - uy) + abs(vx - ux)) / abs(area)
        left = max(0, int(min(ax, corners[b, 0], corners[c, 0]) - 0.5))
        right = min(columns - 1, int(max(ax, corners[b, 0], corners[c, 0]) + 0.5))
        top = max(0, int(min(ay, corners[b, 1], corners[c, 1]) - 0.5))
        bottom = min(rows - 1, int(max(ay, corners[b, 1], corners[c, 1]) + 0.5))
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                dx, dy = column + 0.5 - ax, row + 0.5 - ay
                share_b = (dx * vy - dy * vx) / area
                share_c = (ux * dy - uy * dx) / area
                share_a = 1.0 - share_b - share_c
                if share_a < -slack_a or share_b < -slack_b or share_c < -slack_c:
                    continue
                inside = share_a >= 0.0 and share_b >= 0.0 and share_c >= 0.0
                if covered[row, column] and not inside:
                    continue
                covered[row, column] = True
                for k in range(3):
                    spread[row, column, k] = (
                        share_a * values[a, k] + share_b * values[b, k] + share_c * values[c, k]
                    )
    return spread, covered


@progress.step("take colours from the cloud")
def colours_of_cloud(cloud: Any, vertices: Array, reach: float) -> NDArray[np.uint8]:
    """The colours (V, 3), RGB, that the points of a cloud around vertices have on average."""
    from scipy.spatial import cKDTree

    side = 256 * reach
    tile = np.floor(vertices[:, :2] / side).astype(np.int64)
    colours = np.full((len(vertices), 3), 128, np.uint8)
    order = np.lexsort((tile[:, 0], tile[:, 1]))
    cuts = np.flatnonzero(np.any(np.diff(tile[order], axis=0) != 0, axis=1)) + 1
    for mine in np.split(order, cuts):
        west, south = tile[mine[0]] * side - 2 * reach
        records = cloud.inside(west, west + side + 4 * reach, south, south + side + 4 * reach)
        if len(records) < 4:
            continue
        points = np.column_stack([records[axis] for axis in "xyz"])
        _, near = cKDTree(points).query(vertices[mine], k=4)
        rgb = np.column_stack([records[name] for name in ("red", "green", "blue")])
        colours[mine] = np.rint(rgb[near].mean(axis=1)).astype(np.uint8)
    return colours
