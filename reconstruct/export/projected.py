"""The products in another coordinate system: rasters resampled, points transformed one by one.

A workspace is in a projection about its own datum, true to scale (`reconstruct.raster`). A map grid
such as UTM turns and stretches it: rasters are resampled, cloud, mesh and track are exact. Heights
stay above the model's vertical datum, whose name every file carries.
"""

import csv
import shutil
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import groupby, islice
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import rasterio
from rasterio.enums import Resampling
from rasterio.vrt import WarpedVRT
from rasterio.warp import calculate_default_transform

from alice_survey.core import products
from alice_survey.core.artefacts import Stage, atomic_path, run_stage, write_csv, write_json
from alice_survey.core.errors import ConfigError, ReconstructionError
from alice_survey.core.frames import Array
from alice_survey.core.records import MeshRecord, SurfaceRecord
from alice_survey.core.run import progress
from reconstruct.copc import PointSpool, write_copc
from reconstruct.raster import BLOCK, local_crs, opened_raster, small_cache, tiles_of_shape
from reconstruct.stages import DENSE, MESH, MOSAIC
from reconstruct.views.model import WorldFrame, read_frame

_CHUNK = 1_000_000
_TILE = 4 * BLOCK


@dataclass(frozen=True, kw_only=True)
class Destination:
    """Where products go."""

    frame: WorldFrame
    local: pyproj.CRS
    """Of the workspace."""
    crs: pyproj.CRS
    name: str
    """As the user wrote it."""

    @cached_property
    def _transformer(self) -> pyproj.Transformer:
        return pyproj.Transformer.from_crs(self.local, self.crs, always_xy=True)

    def places(self, east_north: Array) -> Array:
        """Easting and northing (N, 2), metres, of local east and north (N, 2)."""
        east, north = east_north.T
        found: Array = np.column_stack(self._transformer.transform(east, north, errcheck=True))
        return found

    def turn_normals(self, normals: Array, east_north: Array) -> Array:
        """Directions (N, 3) at a place (2,): by the convergence of its meridians."""
        at = self.places(np.array([east_north, east_north + np.array([0.0, 1.0])]))
        x, y = (at[1] - at[0]) / np.linalg.norm(at[1] - at[0])
        turn = np.array([[y, x, 0.0], [-x, y, 0.0], [0.0, 0.0, 1.0]])
        found: Array = normals @ turn.T
        return found


def export_projected(workspace: Path, crs: str) -> tuple[str, dict[str, Any]]:
    """Write a workspace's products in another projected coordinate system.

    They go into a folder named after it, `EPSG-32636`; what is there and up to date stays.

    Args:
        workspace: with a finished reconstruction.
        crs: what pyproj takes: `EPSG:32636`, a PROJ string, WKT.

    Returns:
        What was written, as text and as JSON values.

    Raises:
        ConfigError: it is no projected system in metres.
        ReconstructionError: the model has no place in the world.
        WorkspaceError: a stage is missing.
    """
    for needed in (DENSE, MOSAIC, MESH):
        needed.need(workspace)
    frame = read_frame(workspace / "sparse" / "frame.json")
    if frame.datum is None or frame.name != "ned":
        raise ReconstructionError(
            f"{workspace}: the model has no place in the world, so that it has none in {crs}: "
            "import navigation with positions, or control points"
        )
    local = pyproj.CRS.from_wkt(local_crs(frame.datum).to_wkt())
    target = Destination(frame=frame, local=local, crs=_projected_crs(crs, frame), name=crs)
    folder = "".join(c if c.isalnum() else "-" for c in crs)[:60].strip("-")
    stage = Stage(
        name=folder,
        version=2,
        settings={"crs": target.crs.to_wkt()},
        inputs=[workspace / name for name in ("dense", "mosaic", "mesh", "sparse/track.csv")],
    )
    run_stage(workspace, stage, partial(_export, workspace, target))
    text = (
        f"{crs}: {target.crs.name}; heights above {frame.vertical_datum}; in {workspace / folder}"
    )
    return text, {
        "folder": str(workspace / folder),
        "crs": target.crs.name,
        "vertical_datum": frame.vertical_datum,
    }


def _projected_crs(crs: str, frame: WorldFrame) -> pyproj.CRS:
    try:
        found = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError:
        raise ConfigError(f"--crs {crs}: unknown; write it as EPSG:32636") from None
    if found.is_compound or found.is_vertical:
        raise ConfigError(
            f"--crs {crs}: give the horizontal system alone: heights stay above "
            f"{frame.vertical_datum}, since nothing here knows where that lies in another datum"
        )
    if not found.is_projected or any(axis.unit_name != "metre" for axis in found.axis_info):
        raise ConfigError(
            f"--crs {crs}: {found.name} is no projected system in metres, which rasters and "
            "meshes need: take the UTM zone, EPSG:326NN north of the equator, EPSG:327NN south"
        )
    return found


def _export(workspace: Path, target: Destination, folder: Path) -> None:
    dense = workspace / "dense"
    for one in (*products.rasters_in("dense"), products.MOSAIC):
        _resample(workspace / one.path, folder / one.path.name, target)
    for style in dense.glob("*.qml"):
        shutil.copy2(style, folder / style.name)
    spacing = SurfaceRecord.read(dense / "surface.json").cell
    _cloud(dense / "cloud.copc.laz", folder / "cloud.copc.laz", spacing, target)
    offset = _mesh(workspace / "mesh", folder, target)
    _track(workspace / "sparse" / "track.csv", folder / "track.csv", target)
    write_json(
        folder / "projected.json",
        {
            "format": "alice-survey projected products",
            "version": 1,
            "crs": target.crs.to_wkt(),
            "vertical_datum": target.frame.vertical_datum,
            "mesh_offset": offset,
            "notes": list(target.frame.notes),
        },
    )


@progress.step("resample rasters")
@small_cache()
def _resample(source: Path, path: Path, target: Destination) -> None:
    """Resample a raster, block by block: measured values bilinear, numbers by the nearest cell."""
    with opened_raster(source) as raster:
        transform, width, height = calculate_default_transform(
            raster.crs, target.crs.to_wkt(), raster.width, raster.height, *raster.bounds,
            resolution=raster.transform.a,
        )  # fmt: skip
        smooth = raster.dtypes[0].startswith("float") or raster.count > 1
        options = {
            "crs": target.crs.to_wkt(),
            "transform": transform,
            "width": width,
            "height": height,
            "resampling": Resampling.bilinear if smooth else Resampling.nearest,
        }
        profile = raster.profile | {
            "driver": "GTiff", "crs": target.crs.to_wkt(), "transform": transform, "width": width,
            "height": height, "tiled": True, "blockxsize": BLOCK, "blockysize": BLOCK,
            "compress": "deflate", "bigtiff": "if_safer",
        }  # fmt: skip
        for name in ("photometric", "interleave"):
            profile.pop(name, None)
        with (
            WarpedVRT(raster, **options) as warped,
            atomic_path(path) as temporary,
            rasterio.open(temporary, "w", **profile) as made,
        ):
            made.update_tags(**{k: v for k, v in raster.tags().items() if k != "AREA_OR_POINT"})
            for band in range(1, raster.count + 1):
                made.set_band_description(band, raster.descriptions[band - 1] or "")
                made.set_band_unit(band, raster.units[band - 1] or "")
            made.colorinterp = raster.colorinterp
            for window in tiles_of_shape(height, width, _TILE):
                made.write(warped.read(window=window), window=window)


@progress.step("transform the cloud")
def _cloud(source: Path, path: Path, spacing: float, target: Destination) -> None:
    import laspy

    with laspy.open(source) as file:
        header = laspy.LasHeader(version="1.4", point_format=file.header.point_format)
        middle = (np.array(file.header.mins) + np.array(file.header.maxs)) / 2
        header.offsets = [*np.round(target.places(middle[None, :2])[0]), file.header.offsets[2]]
        header.scales = file.header.scales
        header.creation_date = file.header.creation_date
        header.add_crs(target.crs)
        spool = PointSpool.of(path.with_name("scratch"), header, spacing)
        parts = []
        for number, part in enumerate(file.chunk_iterator(_CHUNK)):
            points = laspy.ScaleAwarePointRecord.zeros(len(part), header=header)
            for name in part.array.dtype.names or ():
                if name not in "XYZ":
                    points.array[name] = part.array[name]
            at = target.places(np.column_stack([part.x, part.y]))
            points.x, points.y, points.z = at[:, 0], at[:, 1], np.asarray(part.z)
            normals = np.column_stack([part["nx"], part["ny"], part["nz"]])
            turned = target.turn_normals(normals, middle[:2])
            points["nx"], points["ny"], points["nz"] = turned.T
            parts.append(spool.add(f"{number}", points.array))
    write_copc(path, header, spool, parts)


@progress.step("transform the mesh")
def _mesh(source: Path, folder: Path, target: Destination) -> list[float]:
    """Write the textured mesh; return the easting, northing and height of its coordinates' zero."""
    old = np.array(MeshRecord.read(source / "mesh.json").offset_east_north_up)
    offset = np.round([*target.places(old[None, :2])[0], old[2]])
    for path in (source / "mesh.mtl", *sorted(source.glob("texture_*"))):
        shutil.copy2(path, folder / path.name)

    heading = (
        f"# offset_east_north_up {' '.join(repr(float(v)) for v in offset)}\n"
        f"# {target.name}, unit m, x east, y north, z up\n"
        f"# vertical datum: {target.frame.vertical_datum}\n"
    )
    with (
        (source / "mesh.obj").open() as lines,
        atomic_path(folder / "mesh.obj") as temporary,
        temporary.open("w") as file,
    ):
        file.write(heading)
        for is_vertex, group in groupby(lines, lambda line: line.startswith("v ")):
            if not is_vertex:
                file.writelines(line for line in group if not line.startswith("#"))
                continue
            while part := list(islice(group, _CHUNK)):
                local = np.array([line.split()[1:4] for line in part], dtype=np.float64) + old
                at = np.column_stack([target.places(local[:, :2]), local[:, 2]]) - offset
                np.savetxt(file, at, fmt="v %.6f %.6f %.6f")
    return [float(v) for v in offset]


def _track(source: Path, path: Path, target: Destination) -> None:
    with source.open(newline="") as file:
        rows = list(csv.DictReader(file))
    local = np.array([[float(row["east_m"]), float(row["north_m"])] for row in rows])
    at = target.places(local.reshape(-1, 2))
    write_csv(
        path,
        ("image", "station", "time_s", "easting_m", "northing_m", "height_m",
         "sigma_north_m", "sigma_east_m", "sigma_depth_m"),
        [
            (row["image"], row["station"], row["time_s"], f"{x:.6f}", f"{y:.6f}",
             f"{-float(row['depth_m']):.6f}", row.get("sigma_north_m", ""),
             row.get("sigma_east_m", ""), row.get("sigma_depth_m", ""))
            for row, (x, y) in zip(rows, at, strict=True)
        ],
    )  # fmt: skip
