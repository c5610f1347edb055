"""Paint the pages of a texture: each picture is read twice, to compare seams and to paint."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.base.compiled import compiled
from alice_survey.base.executor import Executor
from alice_survey.base.frames import Array
from alice_survey.base.run import progress
from reconstruct.light.solve import LightModel
from reconstruct.mesh.atlas import Atlas, Wedges, make_atlas, make_wedges
from reconstruct.mesh.labels import Charts
from reconstruct.mesh.seam_colours import level_seams, seam_pairs
from reconstruct.mesh.topology import Triangles
from reconstruct.mesh.visibility import to_world
from reconstruct.pictures.undistorted import Pictures
from reconstruct.views.model import View

Float32 = NDArray[np.float32]
_SEAM_SIGMA_PX = 4.0
"""Sigma of the average around a seam's vertices by which both sides are compared."""
_MOST_PAGES = 16
_JPEG_QUALITY = 93


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
    colours: NDArray[np.uint8]
    """(V, 3) RGB."""
    label: NDArray[np.int32]
    """(T,) view of every face, negative where no view sees it."""
    scale: float
    """Factor by which the pictures were shrunk."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PagePaintTask:
    """The patches of one view."""

    workspace: Path
    view: View
    light: LightModel
    scale: float
    sizes: tuple[tuple[int, int], ...]
    pages: tuple[Path, ...]
    charts: NDArray[np.int32]
    """(C,) their numbers."""
    page: NDArray[np.int32]
    corner: NDArray[np.int64]
    source: NDArray[np.int64]
    box: NDArray[np.int64]
    pixels: tuple[Array, ...]
    """Per patch (W, 2) its wedges in the picture as scaled."""
    corrections: tuple[Float32, ...]
    """Per patch (W, 3), BGR."""
    triangles: tuple[Triangles, ...]
    """Per patch (T, 3) of its own wedges."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SeamTask:
    """The wedges of one view at seams."""

    workspace: Path
    view: View
    light: LightModel
    pixels: Array


def paint(
    folder: Path,
    vertices: Array,
    triangles: Triangles,
    offset_enu: Array,
    charts: Charts,
    views: Sequence[View],
    workspace: Path,
    light: LightModel,
    cloud_colours: NDArray[np.uint8],
    *,
    plain_pixel: float,
    page_px: int,
    executor: Executor,
) -> Textured:
    """Make the texture of a mesh.

    Args:
        folder: for the pages, `texture_0.jpg` and on.
        vertices: (V, 3) east, north, up from the offset.
        triangles: (T, 3).
        offset_enu: (3,).
        charts: patches and their views.
        views: by label.
        workspace: with the pictures.
        light: of the survey.
        cloud_colours: (V, 3) RGB that paint what no view sees.
        plain_pixel: side of a texture's pixel there.
        page_px: largest side of a page.
        executor: where tasks run.
    """
    wedges = make_wedges(triangles, charts)
    pixels = wedge_pixels(vertices, wedges, charts, views, offset_enu, plain_pixel)
    atlas = make_atlas(pixels, wedges, len(charts.views), page_px, _MOST_PAGES)
    corrections = _corrections(pixels, wedges, charts, views, workspace, light, executor)
    unseen = charts.views[wedges.chart] < 0
    corrections[unseen] = cloud_colours[wedges.vertex[unseen]][:, ::-1]
    scratch = tuple(folder / f"page_{number}.raw" for number in range(len(atlas.sizes)))
    for path, (width, height) in zip(scratch, atlas.sizes, strict=True):
        np.memmap(path, np.uint8, "w+", shape=(height, width, 3)).flush()
    placed = pixels * atlas.scale
    tasks = _paint_tasks(
        workspace, atlas, wedges, charts, views, light, placed, corrections, scratch
    )
    for _ in executor.map(paint_view, tasks, label="paint"):
        pass
    on_page = atlas.place(pixels, wedges.chart)
    pages, colours = [], np.zeros((len(vertices), 3))
    weight = np.zeros(len(vertices))
    for number, (path, size) in enumerate(zip(scratch, atlas.sizes, strict=True)):
        page = np.array(np.memmap(path, np.uint8, "r", shape=(size[1], size[0], 3)))
        mine = np.flatnonzero(atlas.page[wedges.chart] == number)
        at = np.floor(on_page[mine]).astype(np.intp)
        smooth = cv2.blur(page, (3, 3))[at[:, 1], at[:, 0], ::-1].astype(np.float64)
        np.add.at(colours, wedges.vertex[mine], smooth)
        np.add.at(weight, wedges.vertex[mine], 1.0)
        pages.append(folder / f"texture_{number}.jpg")
        write_jpeg(pages[-1], page)
        path.unlink()
    return Textured(
        vertices=vertices,
        wedges=wedges,
        uv=atlas.uv(on_page, wedges.chart),
        page=atlas.page[charts.chart],
        pages=tuple(pages),
        colours=np.rint(colours / np.maximum(weight, 1.0)[:, None]).astype(np.uint8),
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
    order = np.argsort(label, kind="stable")
    for mine in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
        number = int(label[mine[0]])
        points = vertices[wedges.vertex[mine]]
        if number >= 0:
            pixels[mine] = views[number].project(to_world(points, offset_enu))
        else:
            axis = (-1 - number) // 2
            pixels[mine] = np.delete(points, axis, axis=1) / plain_pixel
    return pixels


def even_colour(pictures: Pictures, view: View, light: LightModel) -> Float32:
    """A view's picture under even light, (H, W, 3) BGR."""
    colour = pictures.colour(view.image)
    factors = light.factors(view.camera, view.image)
    rows, columns = factors.shape[:2]
    height, width = colour.shape[:2]
    x, y = np.meshgrid(
        ((np.arange(width) + 0.5) / width * (columns - 1)).astype(np.float32),
        ((np.arange(height) + 0.5) / height * (rows - 1)).astype(np.float32),
    )
    lift = cv2.remap(factors, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    even: Float32 = colour.astype(np.float32) * lift
    return even


def seam_colours(task: SeamTask) -> Float32:
    """Mean colour around pixels of one view, (N, 3) BGR; NaN where nothing usable is near."""
    pictures = Pictures.open(task.workspace)
    even = even_colour(pictures, task.view, task.light)
    weight = pictures.valid(task.view.image).astype(np.float32)
    even *= weight[..., None]
    total = cv2.GaussianBlur(even, (0, 0), _SEAM_SIGMA_PX)
    share = cv2.GaussianBlur(weight, (0, 0), _SEAM_SIGMA_PX)
    x = (task.pixels[:, 0] - 0.5).astype(np.float32).reshape(-1, 1)
    y = (task.pixels[:, 1] - 0.5).astype(np.float32).reshape(-1, 1)
    sums, shares = (
        cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for picture in (total, share)
    )
    shares = shares.reshape(-1, 1)
    found: Float32 = np.where(
        shares > 0.1, sums.reshape(-1, 3) / np.maximum(shares, 0.1), np.float32(np.nan)
    )
    return found


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
    groups = [np.flatnonzero(at_seam & (label == n)) for n in np.unique(label[at_seam])]
    tasks = [
        SeamTask(workspace=workspace, view=views[label[g[0]]], light=light, pixels=pixels[g])
        for g in groups
    ]
    colours = np.full((len(label), 3), np.nan)
    found = executor.map(seam_colours, tasks, label="compare seams")
    for group, colour in zip(groups, found, strict=True):
        colours[group] = colour
    return level_seams(wedges, colours, label >= 0)


def _paint_tasks(
    workspace: Path,
    atlas: Atlas,
    wedges: Wedges,
    charts: Charts,
    views: Sequence[View],
    light: LightModel,
    placed: Array,
    corrections: Array,
    pages: tuple[Path, ...],
) -> list[PagePaintTask]:
    """One task for each view with patches; the last for what no view sees."""
    count = len(charts.views)
    by_chart = np.argsort(wedges.chart, kind="stable")
    wedge_starts = np.searchsorted(wedges.chart[by_chart], np.arange(count + 1))
    local = np.empty(len(by_chart), np.int32)
    local[by_chart] = np.arange(len(by_chart)) - wedge_starts[wedges.chart[by_chart]]
    face_order = np.argsort(charts.chart, kind="stable")
    face_starts = np.searchsorted(charts.chart[face_order], np.arange(count + 1))
    tasks = []
    shown = np.maximum(charts.views, -1)
    for number in np.unique(shown):
        mine = np.flatnonzero(shown == number)
        members = [by_chart[wedge_starts[c] : wedge_starts[c + 1]] for c in mine]
        tasks.append(
            PagePaintTask(
                workspace=workspace,
                view=views[max(number, 0)],
                light=light,
                scale=atlas.scale if number >= 0 else 0.0,
                sizes=atlas.sizes,
                pages=pages,
                charts=mine.astype(np.int32),
                page=atlas.page[mine],
                corner=atlas.corner[mine],
                source=atlas.source[mine],
                box=atlas.box[mine],
                pixels=tuple(placed[m] for m in members),
                corrections=tuple(corrections[m].astype(np.float32) for m in members),
                triangles=tuple(
                    local[wedges.triangles[face_order[face_starts[c] : face_starts[c + 1]]]]
                    for c in mine
                ),
            )
        )
    return tasks


def paint_view(task: PagePaintTask) -> None:
    """Write the patches of one view into the pages; no two views write to the same pixel."""
    plain = task.scale == 0.0
    pages = [
        np.memmap(path, np.uint8, "r+", shape=(height, width, 3))
        for path, (width, height) in zip(task.pages, task.sizes, strict=True)
    ]
    picture = np.zeros((1, 1, 3), np.float32)
    valid = np.ones((1, 1), np.uint8)
    if not plain:
        pictures = Pictures.open(task.workspace)
        picture = even_colour(pictures, task.view, task.light)
        valid = pictures.valid(task.view.image).astype(np.uint8)
        if task.scale < 1.0:
            size = (
                max(1, round(picture.shape[1] * task.scale)),
                max(1, round(picture.shape[0] * task.scale)),
            )
            picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
            valid = cv2.resize(valid, size, interpolation=cv2.INTER_NEAREST)
    for i in range(len(task.charts)):
        (width, height), (x, y) = task.box[i], task.source[i]
        columns = np.clip(np.arange(x, x + width), 0, picture.shape[1] - 1)
        rows = np.clip(np.arange(y, y + height), 0, picture.shape[0] - 1)
        crop = picture[np.ix_(rows, columns)]
        usable = valid[np.ix_(rows, columns)] > 0
        correction, covered = spread_corners(
            task.pixels[i] - task.source[i],
            task.triangles[i],
            task.corrections[i],
            (int(height), int(width)),
        )
        nearest = _nearest(covered)
        patch = crop + correction[nearest]
        beyond = ~covered & ~usable
        patch[beyond] = patch[nearest][beyond]
        left, top = task.corner[i]
        pages[task.page[i]][top : top + height, left : left + width] = np.clip(
            np.rint(patch), 0, 255
        ).astype(np.uint8)
    for page in pages:
        page.flush()


def _nearest(covered: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
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
