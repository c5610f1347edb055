"""Where every patch of a mesh lies in the pages of its texture."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.frames import Array
from reconstruct.mesh.topology import Triangles
from reconstruct.mesh.visibility import Charts

PADDING_PX = 8
"""Pixels around a patch that continue its picture: mipmaps down to an eighth mix nothing else."""


PAGE_PX = 8192
"""Largest side of a page."""
_MAX_PAGES, _FILLED, _ROWS_FILLED = 16, 0.75, 0.83
"""Pages of a mesh; shares of a page that patches may fill, and mostly fill in rows."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Wedges:
    """The corners of faces: one for each vertex and patch that meets it."""

    vertex: NDArray[np.int64]
    """(W,) its vertex."""
    chart: NDArray[np.int32]
    """(W,) its patch."""
    triangles: Triangles
    """(T, 3) wedges of every face."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Atlas:
    """Pages, and where patches lie in them."""

    sizes: tuple[tuple[int, int], ...]
    """Width and height of every page, px."""
    page: NDArray[np.int32]
    """(C,) page of every patch."""
    corner: NDArray[np.int64]
    """(C, 2) pixel of the page at the first pixel of the patch's box, padding included."""
    source: NDArray[np.int64]
    """(C, 2) pixel of the picture (as scaled) at the same place; may be negative."""
    box: NDArray[np.int64]
    """(C, 2) width and height of the box, padding included."""
    scale: float
    """Factor by which pictures are shrunk for the texture; 1 keeps them."""

    def place(self, pixels: Array, chart: NDArray[np.int32]) -> Array:
        """Pixels (W, 2) of pictures, in each one's patch, to pixels of the patches' pages."""
        return pixels * self.scale - self.source[chart] + self.corner[chart]

    def part(self, mine: NDArray[np.int64]) -> "Atlas":
        """The same pages with some of the patches."""
        names = ("page", "corner", "source", "box")
        return replace(self, **{name: getattr(self, name)[mine] for name in names})

    def uv(self, placed: Array, chart: NDArray[np.int32]) -> Array:
        """Pixels (W, 2) of pages as u to the right and v upwards, 0 to 1."""
        size = np.array(self.sizes, dtype=np.float64)[self.page[chart]]
        uv: Array = placed / size
        uv[:, 1] = 1.0 - uv[:, 1]
        return uv


def make_wedges(triangles: Triangles, charts: Charts) -> Wedges:
    """The wedges of a mesh, by patch and vertex."""
    chart = np.repeat(charts.chart.astype(np.int64), 3)
    count = int(triangles.max(initial=-1)) + 1
    key, wedge = np.unique(chart * count + triangles.reshape(-1), return_inverse=True)
    return Wedges(
        vertex=key % count,
        chart=(key // count).astype(np.int32),
        triangles=wedge.reshape(-1, 3).astype(np.int32),
    )


def make_pages(pixels: Array, wedges: Wedges, page: NDArray[np.int32] | None, count: int) -> Atlas:
    """Pack the boxes of patches into pages, each as small as it goes.

    The texture is made coarser until no page is larger than `PAGE_PX`.

    Args:
        pixels: (W, 2) of every wedge in its picture.
        wedges: of the mesh.
        page: (C,) that every patch is to be on, those of -1 on none; None for few full ones.
        count: of patches.
    """
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, wedges.chart, pixels)
    np.maximum.at(high, wedges.chart, pixels)
    page = _share_out(high - low + 2 * PADDING_PX) if page is None else page
    corner, scale = np.zeros((count, 2), np.int64), 1.0
    while True:
        source = np.floor(low * scale).astype(np.int64) - PADDING_PX
        box = np.ceil(high * scale).astype(np.int64) + PADDING_PX - source
        sizes = []
        for number in range(int(page.max(initial=-1)) + 1):
            mine = np.flatnonzero(page == number)
            area = int(box[mine].prod(1).sum() / _ROWS_FILLED)
            side = max(int(box[mine].max(initial=4)), math.isqrt(area))
            side = -(-side // 4) * 4
            corner[mine] = at = pack(box[mine], side)
            used = int((at[:, 1] + box[mine, 1]).max(initial=4))
            sizes.append((side, -(-used // 4) * 4))
        widest = max(map(max, sizes), default=0)
        if widest <= PAGE_PX:
            break
        scale *= 0.95 * PAGE_PX / widest
    return Atlas(sizes=tuple(sizes), page=page, corner=corner, source=source, box=box, scale=scale)


def _share_out(box: Array) -> NDArray[np.int32]:
    """Pages (C,) for boxes (C, 2), as few as may hold them, those of one height together."""
    order = np.lexsort((-box[:, 0], -box[:, 1]))
    filled = np.cumsum(box[order].prod(axis=1)) / (_FILLED * PAGE_PX**2)
    pages = min(math.ceil(filled.max(initial=0.0)), _MAX_PAGES)
    page = np.zeros(len(box), np.int32)
    page[order] = np.minimum(filled * (pages / filled.max(initial=1e-9)), pages - 1).astype(int)
    return page


def pack(boxes: NDArray[np.int64], side: int) -> NDArray[np.int64]:
    """Put boxes into rows of a page, tallest first.

    Args:
        boxes: (C, 2) widths and heights.
        side: width of the page, and of the widest box at most.

    Returns:
        Corner (C, 2) of every box, no two of which overlap.
    """
    order = np.lexsort((np.arange(len(boxes)), -boxes[:, 0], -boxes[:, 1]))
    corner = np.empty((len(boxes), 2), np.int64)
    x = y = below = 0
    for box, (width, height) in zip(order.tolist(), boxes[order].tolist(), strict=True):
        if x + width > side:
            x, y = 0, below
        corner[box] = x, y
        x, below = x + width, max(below, y + height)
    return corner
