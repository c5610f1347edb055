"""Surface, mosaic and camera track of a workspace as arrays."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.windows import Window
from scipy.spatial.transform import RigidTransform

from alice_survey.core.contents import Location, in_workspace, taken_from
from alice_survey.core.frames import Array
from alice_survey.kit.words import count
from reconstruct.placing.track import read_track_poses
from reconstruct.raster import opened_raster
from reconstruct.views.model import WorldFrame, read_frame


@dataclass(frozen=True, kw_only=True, eq=False)
class _MapRaster:
    west: float
    """Left edge, in the raster's coordinates (metres where the model is scaled)."""
    north: float
    """Upper edge."""
    cell: float
    """Side of a cell."""
    unit: str
    """Unit of lengths: `m`, or `model units` where the scale is not known."""
    crs: Any
    """`rasterio.crs.CRS`, or None where the model has no place on the Earth."""

    def _extent_of(self, cells: NDArray[Any]) -> tuple[float, float, float, float]:
        rows, columns = cells.shape[:2]
        return (
            self.west, self.west + columns * self.cell,
            self.north - rows * self.cell, self.north,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Dem(_MapRaster):
    """Heights of the surface, with their standard deviations.

    Example:
        >>> import alice_survey as alice
        >>> dem = alice.Survey("small").dem
        >>> bool(dem.height.shape == dem.sigma.shape)
        True
    """

    height: Array
    """(rows, columns) heights, positive up, row 0 in the north; NaN where nothing was measured."""
    sigma: Array
    """(rows, columns) standard deviations of the heights."""

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """West, east, south and north edges, as `matplotlib.imshow` takes them."""
        return self._extent_of(self.height)

    def height_at(self, east: Array, north: Array) -> Array:
        """Heights of the cells at given coordinates; NaN outside or where none is known.

        Args:
            east: in the raster's coordinates.
            north: array of the same shape.
        """
        rows, columns = self.height.shape
        row = np.floor((self.north - np.asarray(north, dtype=float)) / self.cell).astype(int)
        column = np.floor((np.asarray(east, dtype=float) - self.west) / self.cell).astype(int)
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        return np.where(
            inside, self.height[row.clip(0, rows - 1), column.clip(0, columns - 1)], np.nan
        )

    def __repr__(self) -> str:
        rows, columns = self.height.shape
        known = np.isfinite(self.height)
        return (
            f"DEM: {columns} x {rows} cells of {self.cell:.4g} {self.unit}, "
            f"{known.mean():.0%} known, median sigma {np.nanmedian(self.sigma):.3g} {self.unit}"
        )


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Mosaic(_MapRaster):
    """The orthomosaic.

    Example:
        >>> import alice_survey as alice
        >>> alice.Survey("small").mosaic.rgba.shape[2]
        4
    """

    rgba: NDArray[np.uint8]
    """(rows, columns, 4); alpha is 0 where no picture shows the sea floor."""

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """West, east, south and north edges, as `matplotlib.imshow` takes them."""
        return self._extent_of(self.rgba)

    def __repr__(self) -> str:
        rows, columns = self.rgba.shape[:2]
        share = (self.rgba[..., 3] > 0).mean()
        return (
            f"mosaic: {columns} x {rows} pixels of {self.cell:.4g} {self.unit}, {share:.0%} painted"
        )


def read_dem(workspace: Location, max_cells: int = 4000) -> Dem:
    """Read the surface of a reconstructed workspace.

    Args:
        workspace: its folder, or a `dem.tif` with `sigma.tif` beside it.
        max_cells: rows and columns at most; a larger raster is averaged by blocks.

    Raises:
        WorkspaceError: there is no surface, or its file is damaged.

    Example:
        >>> import alice_survey as alice
        >>> alice.read_dem("small", max_cells=50).height.shape[0] <= 50
        True
    """
    path = in_workspace(workspace, "dense/dem.tif")
    height, place = _read(path, [1], max_cells)
    sigma, _ = _read(path.with_name("sigma.tif"), [1], max_cells)
    return Dem(height=height[0].astype(float), sigma=sigma[0].astype(float), **place)


def read_mosaic(workspace: Location, max_pixels: int = 4000) -> Mosaic:
    """Read the mosaic of a reconstructed workspace.

    Args:
        workspace: its folder, or a `mosaic.tif`.
        max_pixels: rows and columns at most; a larger raster is averaged by blocks.

    Raises:
        WorkspaceError: there is no mosaic, or its file is damaged.

    Example:
        >>> import alice_survey as alice
        >>> alice.read_mosaic("small", max_pixels=100).rgba.dtype
        dtype('uint8')
    """
    path = in_workspace(workspace, "mosaic/mosaic.tif")
    bands, place = _read(path, [1, 2, 3, 4], max_pixels)
    return Mosaic(rgba=np.ascontiguousarray(bands.transpose(1, 2, 0)), **place)


def _read(path: Path, bands: list[int], maximum: int) -> tuple[Any, dict[str, Any]]:
    """Bands (B, rows, columns), and where they lie."""
    with opened_raster(path) as raster:
        shrink = max(1, math.ceil(max(raster.height, raster.width) / maximum))
        shape = max(1, raster.height // shrink), max(1, raster.width // shrink)
        # Whole blocks only, so that cells stay square: less than one at the south and east edges.
        window = Window(0, 0, shape[1] * shrink, shape[0] * shrink)
        values = raster.read(
            bands, window=window, out_shape=(len(bands), *shape), resampling=Resampling.average
        )
        place = {
            "west": raster.transform.c,
            "north": raster.transform.f,
            "cell": raster.transform.a * shrink,
            "unit": raster.tags().get("UNIT", "m"),
            "crs": raster.crs,
        }
    return values, place


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Track:
    """Positions of the registered pictures, with their covariances.

    Example:
        >>> import alice_survey as alice
        >>> track = alice.Survey("small").track
        >>> len(track.images) == len(track.world_from_cam)
        True
    """

    images: tuple[str, ...]
    """(N,) names as in the manifest."""
    world_from_cam: RigidTransform
    """(N,) poses of the entrance pupils, RDF camera to the model's frame."""
    frame: WorldFrame
    """Frame of the coordinates: `ned` in metres, or the model's own."""
    covariance: Array | None
    """(N, 6, 6) of position in the frame (metres) and of a small turn about its axes (radians);
    None where it was not estimated."""

    @property
    def sigma(self) -> Array | None:
        """(N, 3) standard deviations of the positions."""
        if self.covariance is None:
            return None
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)[:, :3])

    @property
    def table(self) -> dict[str, Any]:
        """Columns of positions and their sigmas, as `pandas.DataFrame` and its like take them."""
        columns = {"image": np.array(self.images)}
        columns |= dict(zip("xyz", self.world_from_cam.translation.T, strict=True))
        sigma = () if self.sigma is None else self.sigma.T
        return columns | dict(zip(("sigma_x", "sigma_y", "sigma_z"), sigma, strict=False))

    def __repr__(self) -> str:
        text = f"track: {count(len(self.images), 'picture')} in the frame '{self.frame.name}'"
        if self.sigma is not None:
            text += f", median position sigma {np.median(self.sigma):.3g} {self.frame.unit}"
        return text


def read_track(workspace: Location) -> Track:
    """Read the camera track of a reconstructed workspace.

    Args:
        workspace: its folder, or its `sparse/`.

    Raises:
        WorkspaceError: there is no track, or a file is damaged.

    Example:
        >>> import alice_survey as alice
        >>> alice.read_track("small").covariance.shape[1:]
        (6, 6)
    """
    folder = in_workspace(workspace, "sparse")
    poses = read_track_poses(folder / "track.csv")
    images = tuple(sorted(poses))
    return Track(
        images=images,
        world_from_cam=RigidTransform.concatenate([poses[name] for name in images]),
        frame=read_frame(folder / "frame.json"),
        covariance=_covariance(folder / "track_covariance.npz", images),
    )


def _covariance(path: Path, images: tuple[str, ...]) -> Array | None:
    if not path.is_file():
        return None
    with taken_from(path), np.load(path) as stored:
        row = {str(name): i for i, name in enumerate(stored["image"])}
        rows: Array = stored["covariance"][[row[name] for name in images]]
    return rows
