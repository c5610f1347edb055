"""Factors by which pictures are shrunk for depth, from their size and the cells that are wanted."""

MAX_PIXELS = 3_000_000
"""Depth with more pixels is matched in pictures that are halved until they have fewer."""
CELL_PIXELS = 2.5
"""Side of a cell of the surface in mean ground pixels of views, unless depth is coarser."""
_MIN_SCALE = 0.05


def matching_scale(pixels: float, finest: float = 1.0) -> float:
    """A factor, halved until a picture of so many pixels that is shrunk by it is small enough."""
    scale = finest
    while pixels * scale * scale > MAX_PIXELS:
        scale /= 2.0
    return scale


def scale_for_cell(cell: float | None, pixel: float) -> float:
    """Factor at which a cell of the surface has as many pixels of depth as it has by default.

    Args:
        cell: side of a cell; None for the finest that pictures give.
        pixel: side of a pixel on the ground, in the same unit.
    """
    return 1.0 if cell is None else min(1.0, max(_MIN_SCALE, CELL_PIXELS * pixel / cell))
