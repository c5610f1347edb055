"""The flat-port refraction that a warp to one pinhole leaves, exact at every distance.

A flat port has no single centre: the ray of a pixel misses the pinhole's centre by an offset s in
the plane of that centre, and runs straight through the water with slope t. At depth z before the
centre it is at `s + t z`, so that the pinhole's pixel of the spot is `c + f (t + s / z)`. A picture
that is warped to be right at the working depth z0 therefore shows the spot

    ideal = warped + A(warped) (1/z - 1/z0),   A = f s,

without any approximation: one field of vectors over the picture, in pixel metres, describes it.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.base.compiled import compiled
from alice_survey.base.frames import Array
from reconstruct.views.lens import FlatPortLens, Lens

_COLUMNS = 129
"""Nodes along the picture's width; fewer along its height."""
_ROUNDS = 5
"""Rounds of the fixed-point iteration to a warped pixel: each gains a factor of 10 at a quarter of
the working depth, of 100 near it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RangeShift:
    """The field A of one camera, and the depth at which its pictures are exact."""

    nodes: NDArray[np.float64]
    """(rows, columns, 2) pixels times unit of length, at nodes spread evenly over the warped
    picture, the first and last on its outer edges."""
    width_px: float
    height_px: float
    inverse_working: float
    """1/z0, per unit of length; depths count from the pinhole's centre along its axis."""

    def ideal(self, warped: Array, depth: Array | float) -> Array:
        """Pixels (N, 2) where the pinhole sees what the warped picture shows at pixels (N, 2).

        Args:
            warped: pixels of the warped picture.
            depth: (N,) of the spot before the pinhole's centre; NaN or infinite as known.
        """
        found: Array = warped + self._shift(warped, depth)
        return found

    def warped(self, ideal: Array, depth: Array | float) -> Array:
        """The inverse of `ideal`."""
        found = np.asarray(ideal, dtype=np.float64)
        for _ in range(_ROUNDS):
            found = ideal - self._shift(found, depth)
        return found

    def scaled(self, sx: float, sy: float) -> "RangeShift":
        """The same field for a picture that is made smaller by a factor along x and y."""
        return replace(
            self,
            nodes=self.nodes * [sx, sy],
            width_px=self.width_px * sx,
            height_px=self.height_px * sy,
        )

    @property
    def arguments(self) -> tuple[NDArray[np.float64], float, float, float]:
        """The arguments of kernels; see `sight.KernelLens`."""
        return self.nodes, self.width_px, self.height_px, self.inverse_working

    def _shift(self, pixels: Array, depth: Array | float) -> Array:
        pixels = np.ascontiguousarray(pixels, dtype=np.float64)
        inverse = 1.0 / np.broadcast_to(np.asarray(depth, dtype=np.float64), len(pixels))
        at = _fields(self.nodes, self.width_px, self.height_px, pixels)
        shift: Array = at * (inverse - self.inverse_working)[:, None]
        return shift


def range_shift(lens: Lens) -> RangeShift:
    """The field of a lens, lengths in metres; zero where there is no port."""
    width, height = lens.pinhole.width_px, lens.pinhole.height_px
    if not isinstance(lens, FlatPortLens):
        return no_shift(width, height)
    working = lens.virtual.working_range_m - lens.virtual.centre_z_m
    rows = max(2, round((_COLUMNS - 1) * height / width) + 1)
    x, y = np.linspace(0.0, width, _COLUMNS), np.linspace(0.0, height, rows)
    nodes = np.stack(np.meshgrid(x, y), axis=-1)
    field = field_of(lens, nodes.reshape(-1, 2)).reshape(nodes.shape)
    return RangeShift(
        nodes=_without_holes(field),
        width_px=float(width),
        height_px=float(height),
        inverse_working=1.0 / working,
    )


def field_of(lens: FlatPortLens, warped: Array) -> Array:
    """A at pixels (N, 2) of the warped picture, traced exactly; NaN beyond the lens's reach."""
    taken = lens.from_pinhole(warped)
    point, direction = lens.camera.unproject(taken)
    virtual = lens.virtual
    point = lens.pinhole_from_cam.apply(point)
    with np.errstate(invalid="ignore"):
        offset = point[:, :2] - point[:, 2:] * direction[:, :2] / direction[:, 2:]
    field: Array = virtual.focal_px * offset
    return field


def no_shift(width_px: int, height_px: int) -> RangeShift:
    """The field of a camera without a port."""
    return RangeShift(
        nodes=np.zeros((2, 2, 2)),
        width_px=float(width_px),
        height_px=float(height_px),
        inverse_working=0.0,
    )


def _without_holes(field: Array) -> Array:
    """A field whose nodes beyond the lens's reach have the value of the nearest known one."""
    known = np.isfinite(field).all(axis=2)
    if known.all():
        return field
    from scipy.ndimage import distance_transform_edt

    find: Any = distance_transform_edt
    nearest = find(~known, return_distances=False, return_indices=True)
    filled: Array = field[tuple(nearest)]
    return filled


@compiled
def field_at(
    nodes: Array, width_px: float, height_px: float, x: float, y: float
) -> tuple[float, float]:
    """A at one pixel, bilinear between nodes; the nearest edge's beyond the picture."""
    rows, columns = nodes.shape[0], nodes.shape[1]
    u = min(max(x / width_px * (columns - 1), 0.0), columns - 1.0)
    v = min(max(y / height_px * (rows - 1), 0.0), rows - 1.0)
    column, row = min(int(u), columns - 2), min(int(v), rows - 2)
    p, q = u - column, v - row
    a = (1 - p) * (1 - q)
    b = p * (1 - q)
    c = (1 - p) * q
    d = p * q
    return (
        a * nodes[row, column, 0] + b * nodes[row, column + 1, 0]
        + c * nodes[row + 1, column, 0] + d * nodes[row + 1, column + 1, 0],
        a * nodes[row, column, 1] + b * nodes[row, column + 1, 1]
        + c * nodes[row + 1, column, 1] + d * nodes[row + 1, column + 1, 1],
    )  # fmt: skip


@compiled
def _fields(nodes: Array, width_px: float, height_px: float, pixels: Array) -> Array:
    found = np.empty_like(pixels)
    for i in range(pixels.shape[0]):
        found[i] = field_at(nodes, width_px, height_px, pixels[i, 0], pixels[i, 1])
    return found
