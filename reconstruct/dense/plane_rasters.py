"""What the dense stage does for each plane: lay out its grid, fuse its tiles, write its rasters."""

import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.base.errors import ReconstructionError, warn
from alice_survey.base.executor import Executor
from reconstruct.dense.cloud import laz_writer, voxel_edge, write_cloud, write_cloud_json
from reconstruct.dense.pose_part import ErrorsOfPoses, PosePart
from reconstruct.dense.tiles import FuseSetup, Tile, ViewSummary, fuse_tile, tile_tasks
from reconstruct.dense.view_store import ViewStore
from reconstruct.dense.views import ViewTask, lay_out_view
from reconstruct.light.solve import LightModel
from reconstruct.planes import LEVEL_PLANE, PLANES, Plane, turned, write_plane
from reconstruct.raster import DemGrid, grid_over, preview_dem, round_cell, tiled_raster
from reconstruct.views.model import SparseModel, WorldFrame

CELL_PIXELS = 2.5
"""Side of a DEM cell in mean ground pixels of the pictures as matched, unless depth is coarser."""
_MOST_CELLS = 4_000_000_000
_MOST_POINTS = 40_000_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Confirmed:
    """Confirmed depth of all views, and what is known of the survey."""

    store: ViewStore
    model: SparseModel
    """Views as matched, in the world."""
    sigma_factor: float
    """On the standard deviations of refined depths."""
    light: LightModel
    poses: ErrorsOfPoses | None
    executor: Executor


@dataclass(frozen=True, kw_only=True, eq=False)
class Layout:
    """Where the surface lies over a plane."""

    plane: Plane
    model: SparseModel
    """In the frame of the plane."""
    summaries: Sequence[ViewSummary]
    pose_part: PosePart | None

    @property
    def bounds(self) -> list[tuple[float, float, float, float]]:
        """South, west, north and east of each view that has depth."""
        return [summary.bounds for summary in self.summaries if summary.bounds is not None]

    def grid(self, cell: float) -> DemGrid:
        """The grid over all points.

        Raises:
            ReconstructionError: it would be too large.
        """
        grid = grid_over(self.bounds, cell)
        if grid.rows * grid.columns > _MOST_CELLS:
            raise ReconstructionError(
                f"cells of {cell} {self.model.frame.unit} would make a grid of {grid.rows} x "
                f"{grid.columns} over the plane {self.plane.name!r}; raise reconstruct.dem_cell_m"
            )
        return grid

    def offset(self, grid: DemGrid) -> tuple[float, float, float]:
        """Whole numbers near the middle of the points: east, north, up."""
        up = float(np.nanmedian([s.up for s in self.summaries]))
        east = float(grid.east_of(grid.columns / 2))
        north = float(grid.north_of(grid.rows / 2))
        return (float(np.round(east)), float(np.round(north)), float(np.round(up)))


@dataclass(frozen=True, kw_only=True)
class Fused:
    """A plane whose rasters are written."""

    plane: Plane
    grid: DemGrid
    pose_sigma: float | None
    """Standard deviation of heights from errors of poses, median."""


def fuse_planes(
    confirmed: Confirmed, folder: Path, planes: Sequence[Plane], cell_m: float | None
) -> list[Fused]:
    """Write the rasters of planes, and the cloud.

    The cloud is made over the level plane, whether it is among the others or not. The first plane
    on which something is seen has its rasters in the folder itself, the others below `planes`.

    Args:
        confirmed: depth of all views.
        folder: of the stage.
        planes: to project on.
        cell_m: side of a cell; None takes it from the pictures' resolution.

    Returns:
        The planes on which something is seen, one or more; a warning names the others.

    Raises:
        ReconstructionError: no depth was confirmed, nothing is seen on any plane, or a grid would
            be too large.
    """
    level = _layout(confirmed, LEVEL_PLANE)
    if not level.bounds:
        raise no_depth(len(confirmed.model.views))
    cell = surface_cell(level.summaries, cell_m, confirmed.model.frame)
    layouts = [level if p.is_level else _layout(confirmed, p) for p in planes]
    seen = [layout for layout in layouts if layout.bounds]
    grids = [layout.grid(cell) for layout in (level, *seen)]
    cells = max(grid.rows * grid.columns for grid in grids)
    edge = voxel_edge(cell, cells, _MOST_POINTS)
    if (folder / PLANES).exists():  # of a run that was interrupted
        shutil.rmtree(folder / PLANES)
    made = []
    for layout in (level, *(one for one in seen if not one.plane.is_level)):
        below = folder / PLANES / layout.plane.name
        fused = _fuse(confirmed, layout, (folder, below), cell, edge)
        if fused is not None and layout.plane in planes:
            made.append(fused)
        else:
            shutil.rmtree(below)
    made.sort(key=lambda fused: planes.index(fused.plane))
    for plane in planes:
        if all(fused.plane != plane for fused in made):
            warn(
                f"plane {plane.name!r} ({plane.about}): no picture shows a surface that faces its "
                "viewer: it has no DEM and no mosaic"
            )
    if not made:
        raise ReconstructionError(
            'nothing is seen on any of the planes: reconstruct.planes = ["auto"] finds the best'
        )
    first = folder / PLANES / made[0].plane.name
    for path in first.iterdir():
        path.rename(folder / path.name)
    first.rmdir()
    if len(made) == 1:
        first.parent.rmdir()
    return made


def no_depth(pictures: int) -> ReconstructionError:
    """What to say where no depth was confirmed."""
    return ReconstructionError(
        f"no depth was confirmed by a second view in {pictures} pictures; they need more overlap, "
        "sharper texture or better positions"
    )


def surface_cell(summaries: Sequence[ViewSummary], cell: float | None, frame: WorldFrame) -> float:
    """Side of a cell of all planes: as wanted, else as pictures and depths resolve."""
    if cell is not None and not frame.scaled:
        warn("reconstruct.dem_cell_m is taken in model units: the model has no scale")
    footprint = float(np.nanmedian([s.footprint for s in summaries]))
    sigma = float(np.nanmedian([s.sigma for s in summaries]))
    return cell or round_cell(max(CELL_PIXELS * footprint, 1.5 * sigma))


def _layout(confirmed: Confirmed, plane: Plane) -> Layout:
    model = turned(confirmed.model, plane)
    tasks = [
        ViewTask(store=confirmed.store, index=n, view=view, others=())
        for n, view in enumerate(model.views)
    ]
    lay_out = partial(lay_out_view, confirmed.sigma_factor, plane.name)
    return Layout(
        plane=plane,
        model=model,
        summaries=list(confirmed.executor.map(lay_out, tasks, label=_label("lay out", plane))),
        pose_part=None if confirmed.poses is None else confirmed.poses.over(plane),
    )


def _fuse(
    confirmed: Confirmed,
    layout: Layout,
    folders: tuple[Path, Path],
    cell: float,
    edge: float,
) -> Fused | None:
    """Write one plane's rasters, and with the level one the cloud; None where no cell is known.

    Args:
        confirmed: depth of all views.
        layout: over the plane.
        folders: of the stage, and for the rasters.
        cell: side of a cell.
        edge: of the cubes to which the cloud is thinned.

    Raises:
        ReconstructionError: the cloud has no point.
    """
    (stage, folder), plane, grid = folders, layout.plane, layout.grid(cell)
    folder.mkdir(parents=True)
    setup = FuseSetup(
        store=confirmed.store,
        plane=plane.name,
        light=confirmed.light,
        stations=np.array([view.station for view in layout.model.views], dtype=np.int64),
        offset_enu=layout.offset(grid),
        edge=edge,
        sigma_factor=confirmed.sigma_factor,
    )
    tasks = tile_tasks(grid, layout.model.views, layout.summaries, layout.pose_part)
    tiles = confirmed.executor.map(partial(fuse_tile, setup), tasks, label=_label("fuse", plane))
    known = _Count()
    parts = _write_rasters(folder, grid, layout.model.frame, known.passed(tiles))
    if plane.is_level:
        _write_cloud(stage, parts, setup, layout.model.frame, len(layout.model.views))
    else:
        for _ in parts:
            pass
    if known.cells == 0:
        return None
    write_plane(folder, plane, confirmed.model.frame)
    preview_dem(folder / "dem.tif", folder / "dem.png")
    sigma = None if layout.pose_part is None else float(f"{layout.pose_part.median:.3g}")
    return Fused(plane=plane, grid=grid, pose_sigma=sigma)


def _label(what: str, plane: Plane) -> str:
    return what if plane.is_level else f"{what} {plane.name}"


class _Count:
    """Counts the known cells of tiles that pass."""

    def __init__(self) -> None:
        self.cells = 0

    def passed(self, tiles: Iterable[Tile]) -> Iterator[Tile]:
        """The same tiles."""
        for tile in tiles:
            self.cells += int(np.isfinite(tile.height).sum())
            yield tile


def _write_cloud(
    folder: Path,
    parts: Iterator[NDArray[Any]],
    setup: FuseSetup,
    frame: WorldFrame,
    pictures: int,
) -> None:
    offset = setup.offset_enu
    with laz_writer(folder / "cloud.laz", offset, frame) as write_laz:
        count = write_cloud(folder / "cloud.ply", write_laz(parts), offset, frame)
    if count == 0:
        raise no_depth(pictures)
    write_cloud_json(folder / "cloud.json", count, offset, setup.edge, frame)


def _write_rasters(
    folder: Path, grid: DemGrid, frame: WorldFrame, tiles: Iterator[Tile]
) -> Iterator[NDArray[Any]]:
    """Write the tiles' rasters and hand their cloud points on."""
    unit, nan = frame.unit, float("nan")
    up = "towards its viewer" if frame.name == "plane" else "up"
    over = f"above {frame.vertical_datum}, {up} ({unit})"
    bands = {
        "height": ("dem", "float32", nan, f"height {over}"),
        "sigma": ("sigma", "float32", nan, f"standard deviation of the height ({unit})"),
        "slope": ("slope", "float32", nan, "steepest slope (degrees)"),
        "count": (
            "count", "uint16", None,
            "views that the height rests on; 0 where a small gap was bridged",
        ),
        "stations": (
            "stations", "uint8", None,
            "stations that the height rests on (255: or more); 0 where a small gap was bridged",
        ),
        "surfaces": (
            "surfaces", "uint8", None,
            "surfaces over each other, of which the height is the uppermost's; 0 where a small "
            "gap was bridged",
        ),
        "lower": (
            "lower", "float32", nan,
            f"height of the lowest of several surfaces {over}; unknown where there is one",
        ),
    }  # fmt: skip
    with ExitStack() as files:
        rasters = {
            name: files.enter_context(
                tiled_raster(folder / f"{file}.tif", grid, frame, dtype, nodata, text)
            )
            for name, (file, dtype, nodata, text) in bands.items()
        }
        for tile in tiles:
            for name, raster in rasters.items():
                raster.write(getattr(tile, name), 1, window=tile.window)
            yield tile.vertices
