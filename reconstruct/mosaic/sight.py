"""How a view sees a grid over the surface, straight in the picture as taken."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from alice_survey.frames import Array
from camera_calib.approximation.dispersion import channel_cameras
from camera_calib.water import CHANNELS
from reconstruct.dense.dem import DemGrid
from reconstruct.dense.points import enu_from_cam, pinhole_of
from reconstruct.lenses.lens import FlatPortLens, Lens
from reconstruct.lenses.range_shift import RangeShift, range_shift
from reconstruct.model import View
from reconstruct.mosaic.grid import Float32, footprints, height_at_pixels
from reconstruct.mosaic.ortho import look_up, visible_cells
from reconstruct.pictures.undistorted import taken_nodes

_SPACING_PX = 8.0
"""Of nodes between which a lens is bilinear: within 0.001 px for the lenses of such cameras."""
_HIDES_CELLS = 2.5
"""Height over a line of sight, in cells of the DEM, at which a cell hides what is behind it."""
_RIM_PX = 2.0


@dataclass(frozen=True, kw_only=True)
class Water:
    """What bends the colours behind a flat port; the index itself comes from the calibration."""

    temperature_c: float
    salinity_psu: float
    depth_m: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Optics:
    """One camera, or one channel of it, from its pinhole's pixels to the picture as taken."""

    taken_nodes: Array
    """(rows, columns, 2); see `taken_nodes`."""
    shift: RangeShift | None
    size_px: tuple[int, int]
    """Width and height of the picture as taken."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """Where and how well a view shows the cells of a grid, (H, W) each."""

    x: Float32
    """Column in the picture as taken, the first pixel's centre is 0; -1 where not seen."""
    y: Float32
    quality: Float32
    """0 where not seen."""
    range: Float32
    """Distance from the pinhole's centre; NaN where not seen."""

    def places(self, size_px: tuple[int, int]) -> tuple[Float32, Float32]:
        """Columns and rows as shares of the picture's width and height."""
        width, height = size_px
        across: Float32 = (self.x + np.float32(0.5)) / np.float32(width)
        down: Float32 = (self.y + np.float32(0.5)) / np.float32(height)
        return across, down


class Ground:
    """A part of the DEM, and what each view sees of it (kept, since it is asked for often)."""

    def __init__(self, dem: Float32, around: DemGrid) -> None:
        """`dem` holds the heights of the cells of `around`."""
        self.dem = dem
        self.around = around
        self._visible: dict[str, NDArray[np.bool_]] = {}
        known = np.isfinite(dem)
        self._heights = (float(dem[known].min()), float(dem[known].max())) if known.any() else None

    def visible_from(self, view: View) -> NDArray[np.bool_]:
        """Cells of the DEM that a view sees over it."""
        if view.image not in self._visible:
            around = self.around
            self._visible[view.image] = visible_cells(
                self.dem,
                enu_from_cam(view, np.zeros(3))[:, 3],
                around.west,
                around.north,
                around.cell,
                _HIDES_CELLS * around.cell,
                self._reached(view),
            )
        return self._visible[view.image]

    def _reached(self, view: View) -> tuple[int, int, int, int]:
        """Rows and columns of the DEM that a view may see."""
        around = self.around
        if self._heights is None:
            return 0, 0, 0, 0
        west, east, south, north = footprints((view,), self._heights).boxes[0]
        edge = 2.0 * around.cell
        rows = (np.array([around.north - north - edge, around.north - south + edge])) / around.cell
        columns = (np.array([west - edge - around.west, east + edge - around.west])) / around.cell
        r = np.clip(rows, 0, around.rows).astype(int)
        c = np.clip(columns, 0, around.columns).astype(int)
        return int(r[0]), int(r[1]), int(c[0]), int(c[1])

    def surface(self, grid: DemGrid) -> "Surface":
        """Heights of a grid on it."""
        height = height_at_pixels(self.dem, self.around, grid)
        return Surface(grid=grid, height=height, ground=self)


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """Heights of a grid."""

    grid: DemGrid
    height: Float32
    """(rows, columns) of the grid, up."""
    ground: Ground

    def part(self, rows: slice, columns: slice) -> "Surface":
        """A part of it."""
        grid = self.grid.window(
            rows.start, columns.start, rows.stop - rows.start, columns.stop - columns.start
        )
        return replace(self, grid=grid, height=self.height[rows, columns])


def camera_optics(lens: Lens, scaled: bool) -> Optics:
    """Of a lens; without lengths in metres a port's range shift is not known."""
    return Optics(
        taken_nodes=taken_nodes(lens, _SPACING_PX),
        shift=range_shift(lens) if scaled and isinstance(lens, FlatPortLens) else None,
        size_px=lens.size_px,
    )


def channel_optics(lens: FlatPortLens, water: Water, scaled: bool) -> tuple[Optics, ...]:
    """Of the blue, green and red channel of a camera behind a port, in the order of BGR.

    All see through the pinhole of green; the rays that they take through port and water differ by
    their indices, at the working range and beyond it.
    """
    cameras = channel_cameras(
        lens.camera,
        temperature_c=water.temperature_c,
        salinity_psu=water.salinity_psu,
        depth_m=water.depth_m,
    )
    found = {n: camera_optics(replace(lens, camera=cameras[n]), scaled) for n in CHANNELS}
    return found["blue"], found["green"], found["red"]


def see(view: View, optics: Optics, surface: Surface) -> Seen:
    """Look at a surface with a view; what the surface itself hides is not seen."""
    grid, around = surface.grid, surface.ground.around
    camera = enu_from_cam(view, np.zeros(3))
    east, north = float(grid.east_of(0.5)), float(grid.north_of(0.5))
    rotation = camera[:, :3].T
    cam_from_enu = np.column_stack([rotation, -rotation @ camera[:, 3]])
    shift = view.shift_arguments if optics.shift is None else optics.shift.arguments
    x, y, quality, ranges = look_up(
        surface.height,
        surface.ground.visible_from(view),
        ((around.north - north) / around.cell - 0.5, (east - around.west) / around.cell - 0.5),
        grid.cell / around.cell,
        np.ascontiguousarray(cam_from_enu),
        pinhole_of(view),
        shift,
        optics.taken_nodes,
        optics.size_px,
        (east, north),
        grid.cell,
        _RIM_PX,
    )
    return Seen(x=x, y=y, quality=quality, range=ranges)
