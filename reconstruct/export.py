"""Products for other programs: in another coordinate system, and pictures without refraction.

A workspace is in a projection about its own datum, true to scale (`reconstruct.raster`). A map grid
such as UTM turns and stretches it: rasters are resampled, cloud and mesh are exact. Heights
stay above the model's vertical datum, whose name every file carries.

A camera behind a flat port has no single centre: a picture that is warped to a pinhole is exact at
one distance only. Exported pictures take each pixel from where the camera sees what the pinhole's
ray meets of the surface, so that every picture is that of a pinhole, of this surface.
"""

import shutil
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyproj
import rasterio
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.vrt import WarpedVRT
from rasterio.warp import calculate_default_transform
from scipy.ndimage import map_coordinates

from alice_survey.core import products
from alice_survey.core.artefacts import Stage, atomic_path, run_stage, write_json
from alice_survey.core.errors import ConfigError, ReconstructionError, warn
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array, is_beyond
from alice_survey.core.records import MeshRecord, SurfaceRecord
from alice_survey.core.run import progress
from reconstruct.copc import PointSpool, write_copc
from reconstruct.dense.cloud import cloud_in_parts, frame_comments
from reconstruct.evaluate.scores import read_mesh
from reconstruct.mesh.formats import write_obj
from reconstruct.mesh.visibility import ray_scene
from reconstruct.pictures.undistorted import Pictures, show_at
from reconstruct.raster import BLOCK, local_crs, opened_raster, small_cache, tiles_of_shape
from reconstruct.stages import DENSE, MESH, MOSAIC, PLACING
from reconstruct.views.model import View, WorldFrame, points_of_views, read_frame, read_model
from reconstruct.views.model_files import read_reconstruction
from reconstruct.views.range_shift import fill_holes

_CHUNK = 1_000_000
_TILE = 4 * BLOCK


@dataclass(frozen=True, kw_only=True)
class Destination:
    """Where products go."""

    frame: WorldFrame
    crs: pyproj.CRS
    name: str
    """As the user wrote it."""
    transformer: pyproj.Transformer
    """From east and north of the workspace."""

    def places(self, east_north: Array) -> Array:
        """Easting and northing (N, 2), metres, of local east and north (N, 2)."""
        east, north = east_north.T
        return np.asarray(np.column_stack(self.transformer.transform(east, north, errcheck=True)))

    def turn_normals(self, normals: Array, east_north: Array) -> Array:
        """Directions (N, 3) at a place (2,): by the convergence of its meridians."""
        at = self.places(np.array([east_north, east_north + np.array([0.0, 1.0])]))
        x, y = (at[1] - at[0]) / np.linalg.norm(at[1] - at[0])
        turn = np.array([[y, x, 0.0], [-x, y, 0.0], [0.0, 0.0, 1.0]])
        return np.asarray(normals @ turn.T)


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
    target = destination(crs, frame)
    folder = "".join(c if c.isalnum() else "-" for c in crs)[:60].strip("-")
    stage = Stage(
        name=folder,
        version=3,
        command="reconstruct",
        settings={"crs": target.crs.to_wkt()},
        inputs=[workspace / name for name in ("dense", "mosaic", "mesh")],
    )
    run_stage(workspace, stage, partial(_write_projected, workspace, target))
    name, datum, folder = target.crs.name, frame.vertical_datum, str(workspace / folder)
    text = f"{crs}: {name}; heights above {datum}; in {folder}"
    return text, {"folder": folder, "crs": name, "vertical_datum": datum}


def projected_system(crs: str) -> pyproj.CRS:
    """What the text of `--crs` names.

    Raises:
        ConfigError: it is no projected system in metres.
    """
    try:
        found = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError:
        raise ConfigError(f"--crs {crs}: unknown; write it as EPSG:32636") from None
    flat = found.is_projected and not found.is_compound
    if not flat or any(axis.unit_name != "metre" for axis in found.axis_info):
        raise ConfigError(
            f"--crs {crs}: {found.name} is not a projected system in metres, horizontal alone: "
            "take the UTM zone, such as EPSG:32636; heights stay as they are"
        )
    return found


def destination(crs: str, frame: WorldFrame) -> Destination:
    """A projected system that products of a frame go to.

    Raises:
        ConfigError: it is no projected system in metres.
        ReconstructionError: the frame has no place in the world.
    """
    if frame.datum is None or frame.name != "ned":
        raise ReconstructionError(
            f"the model has no place in the world, so that it has none in {crs}: import navigation "
            "with positions, or control points"
        )
    found = projected_system(crs)
    area, datum = found.area_of_use, frame.datum
    if area is not None and is_beyond(area, datum.latitude_deg, datum.longitude_deg):
        warn(
            f"--crs {crs}: the survey is at {datum.place}, outside of where {found.name} is used "
            f"({area.west:g} to {area.east:g} E): its UTM zone is EPSG:{datum.utm_epsg}"
        )
    local = pyproj.CRS.from_wkt(local_crs(frame.datum).to_wkt())
    to = pyproj.Transformer.from_crs(local, found, always_xy=True)
    return Destination(frame=frame, crs=found, name=crs, transformer=to)


def _write_projected(workspace: Path, target: Destination, folder: Path) -> None:
    dense = workspace / "dense"
    for one in (*products.rasters_in("dense"), products.MOSAIC):
        _resample(workspace / one.path, folder / one.path.name, target)
    for style in dense.glob("*.qml"):
        shutil.copy2(style, folder / style.name)
    spacing = SurfaceRecord.read(dense / "surface.json").cell
    _cloud(dense / "cloud.copc.laz", folder / "cloud.copc.laz", spacing, target)
    offset = _mesh(workspace / "mesh", folder, target)
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
        resampling = Resampling.bilinear if smooth else Resampling.nearest
        grid = {
            "crs": target.crs.to_wkt(), "transform": transform, "width": width, "height": height,
        }  # fmt: skip
        profile = raster.profile | grid | {
            "driver": "GTiff", "tiled": True, "blockxsize": BLOCK, "blockysize": BLOCK,
            "compress": "deflate", "bigtiff": "if_safer",
        }  # fmt: skip
        for name in ("photometric", "interleave"):
            profile.pop(name, None)
        with (
            WarpedVRT(raster, resampling=resampling, **grid) as warped,
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

    def places(enu: Array) -> Array:
        local = enu + old
        return np.column_stack([target.places(local[:, :2]), local[:, 2]]) - offset

    heading = [
        f"offset_east_north_up {' '.join(repr(float(v)) for v in offset)}",
        f"{target.name}, unit m, x east, y north, z up",
        f"vertical datum: {target.frame.vertical_datum}",
    ]
    write_obj(folder / "mesh.obj", source / "mesh.glb", places, heading)
    return [float(v) for v in offset]


COPIES = "ply-obj"


def export_copies(workspace: Path) -> tuple[str, dict[str, Any]]:
    """Write the cloud of a workspace as PLY and its mesh as OBJ, into `ply-obj/`.

    Returns:
        What was written, as text and as JSON values.

    Raises:
        WorkspaceError: a stage is missing.
    """
    for needed in (DENSE, MESH):
        needed.need(workspace)
    inputs = [workspace / "dense", workspace / "mesh"]
    stage = Stage(name=COPIES, version=1, command="reconstruct", settings={}, inputs=inputs)
    run_stage(workspace, stage, partial(_write_copies, workspace))
    folder = workspace / COPIES
    return f"{COPIES}: cloud.ply, mesh.obj in {folder}", {"folder": str(folder)}


@progress.step("write copies")
def _write_copies(workspace: Path, folder: Path) -> None:
    frame, mesh = read_frame(workspace / "sparse" / "frame.json"), workspace / "mesh"
    cloud = cloud_in_parts(workspace / "dense", folder, frame)
    if cloud.parent != folder:
        shutil.copy2(cloud, folder / cloud.name)
    offset = MeshRecord.read(mesh / "mesh.json").offset_east_north_up
    comments = frame_comments(frame, offset)
    write_obj(folder / "mesh.obj", mesh / "mesh.glb", np.asarray, comments)


FOLDER = "undistorted"
_NODE_PX = 4
"""Pixels between places at which a ray's way to the surface is computed."""
_WRITABLE = {".png", ".jpg", ".jpeg", ".tif", ".tiff"}
_QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 97]


def export_undistorted(workspace: Path, executor: Executor) -> tuple[str, dict[str, Any]]:
    """Write pictures, masks and COLMAP's model of a workspace.

    They go into `undistorted/`; what is there and up to date stays.

    Returns:
        What was written, as text and as JSON values.

    Raises:
        WorkspaceError: the workspace has no finished model or mesh.
    """
    for needed in (PLACING, MESH):
        needed.need(workspace)
    sparse = workspace / "sparse"
    stage = Stage(
        name=FOLDER,
        version=2,
        command="reconstruct",
        settings={},
        inputs=[sparse / "model", sparse / "cameras.json", sparse / "frame.json",
                workspace / "mesh" / "mesh.glb", workspace / "images"],
        resumes=True,
    )  # fmt: skip
    run_stage(workspace, stage, partial(_write_undistorted, workspace, executor))
    folder = workspace / FOLDER
    pictures = sum(1 for path in (folder / "images").rglob("*") if path.is_file())
    text = (
        f"undistorted: {pictures} pictures with masks and COLMAP model (sparse/, sparse/0/) in "
        f"{folder}"
    )
    return text, {"pictures": pictures, "folder": str(folder)}


def _write_undistorted(workspace: Path, executor: Executor, folder: Path) -> None:
    model = read_model(workspace / "sparse")
    depths = [
        float(np.median(view.world_from_cam.inv().apply(points)[:, 2])) if len(points) else 1.0
        for view, points in zip(model.views, points_of_views(model), strict=True)
    ]
    tasks = list(zip(model.views, depths, strict=True))
    write = partial(export_view, workspace, folder)
    done = list(executor.map(write, tasks, label="undistort pictures"))
    names = {view.image: exported_name(view.image) for view in model.views}
    _write_colmap(workspace / "sparse" / "model", folder / "sparse", names)
    write_json(
        folder / "export.json",
        {
            "format": "alice-survey undistorted pictures",
            "version": 1,
            "frame": model.frame.name,
            "unit": model.frame.unit,
            "vertical_datum": model.frame.vertical_datum,
            "pictures": len(done),
            "on_surface": {
                names[view.image]: round(on_surface, 4)
                for view, on_surface in zip(model.views, done, strict=True)
            },
            "notes": list(model.frame.notes),
        },
    )  # fmt: skip


def exported_name(image: str) -> str:
    """The name of an exported picture: that of the picture, as PNG where it is of a rare kind."""
    path = Path(image)
    return image if path.suffix.lower() in _WRITABLE else path.with_suffix(".png").as_posix()


def export_view(workspace: Path, folder: Path, task: tuple[View, float]) -> float:
    """Write a picture and its mask.

    Args:
        workspace: with the picture and the mesh.
        folder: to write into.
        task: the view, and its depth where it sees nothing of the mesh.

    Returns:
        Share of it whose rays meet the surface; the others take the depth of the nearest that do.
    """
    view, depth = task
    pictures, name = Pictures.still(workspace), exported_name(view.image)
    target = folder / "images" / name
    mask = folder / "masks" / f"{name}.png"
    surface = surface_depth(view, *scene_of(workspace / "mesh"))
    on_surface = float(np.isfinite(surface).mean())
    if mask.exists():  # of a run that was interrupted; it is written last
        return on_surface
    filled = fill_holes(surface) if on_surface else np.full(surface.shape, depth)
    x, y = taken_at(pictures, view, filled)
    taken = pictures.as_taken(view.image)
    inside = (x >= 0) & (x <= taken.shape[1] - 1) & (y >= 0) & (y <= taken.shape[0] - 1)
    x, y = np.where(inside, x, np.float32(-10.0)), np.where(inside, y, np.float32(-10.0))
    colour = show_at(taken, x, y)
    usable = pictures.usable(view.image)
    if usable is not None:
        inside &= cv2.remap(usable.astype(np.uint8), x, y, cv2.INTER_NEAREST) > 0
    for path, values in ((target, np.where(inside[..., None], colour, np.uint8(0))),
                         (mask, inside.astype(np.uint8) * 255)):  # fmt: skip
        with atomic_path(path) as temporary:
            if not cv2.imwrite(str(temporary), values, _QUALITY):
                raise OSError(f"{path}: cannot be written")
    return on_surface


def surface_depth(view: View, scene: Any, origin: Array) -> Array:
    """Depth of a mesh along a view's axis, at nodes `_NODE_PX` apart over its pinhole's picture.

    Args:
        view: through whose pinhole to look.
        scene: of Open3D, to cast rays in.
        origin: (3,) of the scene's coordinates in the world.

    Returns:
        (rows, columns); NaN where a ray meets nothing.
    """
    import open3d as o3d

    pixels = _nodes(*view.pinhole.size_px)
    slopes = view.pinhole.slopes(pixels.reshape(-1, 2))
    rays = np.column_stack([slopes, np.ones(len(slopes))])  # of depth 1: lengths are depths
    ways = view.world_from_cam.rotation.apply(rays)
    starts = np.broadcast_to(view.world_from_cam.translation - origin, ways.shape)
    cast = o3d.core.Tensor.from_numpy(np.hstack([starts, ways]).astype(np.float32))
    depth = scene.cast_rays(cast)["t_hit"].numpy().astype(np.float64)
    return np.asarray(np.where(np.isfinite(depth), depth, np.nan).reshape(pixels.shape[:2]))


def taken_at(
    pictures: Pictures, view: View, depth: Array
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where each pixel of a view's pinhole lies in the picture as taken.

    Args:
        pictures: of the workspace.
        view: through whose pinhole a surface is seen.
        depth: (rows, columns) of the surface at nodes over the picture.

    Returns:
        x and y, (H, W), in OpenCV's pixels (the first pixel's centre is 0, 0); NaN where the camera
        does not see what the pinhole would.
    """
    width, height = view.pinhole.size_px
    pixels = _nodes(width, height)
    warped = view.shift.warp(pixels.reshape(-1, 2), depth.reshape(-1)).reshape(pixels.shape)
    rows, columns = pixels.shape[:2]
    across, down = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    at = across / width * (columns - 1), down / height * (rows - 1)
    shift = warped - pixels
    across += bilinear(shift[..., 0], *at) - 0.5
    down += bilinear(shift[..., 1], *at) - 0.5
    x, y = (
        bilinear(np.where(one > -1.0, one, np.float32(np.nan)), across, down)
        for one in pictures.maps(view.image)
    )
    return x.astype(np.float32), y.astype(np.float32)


def _nodes(width: int, height: int) -> Array:
    """(rows, columns, 2) pixels, from the picture's outer edges on, `_NODE_PX` apart or less."""
    x = np.linspace(0.0, width, -(-width // _NODE_PX) + 1)
    y = np.linspace(0.0, height, -(-height // _NODE_PX) + 1)
    return np.stack(np.meshgrid(x, y), axis=-1)


def bilinear(values: NDArray[Any], x: Array, y: Array) -> Array:
    """Values (H, W) at columns x and rows y, any shape; NaN outside.

    cv2.remap rounds places to 1/32 of a pixel.
    """
    return np.asarray(map_coordinates(values, [y, x], np.float64, order=1, cval=np.nan))


def scene_of(mesh: Path) -> tuple[Any, Array]:
    """The mesh of a folder to cast rays at, and the origin (3,) of its coordinates in the world."""
    return _scene(mesh, (mesh / "mesh.glb").stat().st_mtime_ns)


@lru_cache(maxsize=1)
def _scene(mesh: Path, written_ns: int) -> tuple[Any, Array]:
    vertices, triangles = read_mesh(mesh)
    origin = vertices.mean(axis=0)
    return ray_scene((vertices - origin, triangles.astype(np.int32))), origin


def _write_colmap(model: Path, folder: Path, names: dict[str, str]) -> None:
    """The model as text, and as binary in `0/`, with the names of the exported pictures."""
    found = read_reconstruction(model)
    for image in found.images.values():
        image.name = names.get(image.name, image.name)
    if folder.exists():
        shutil.rmtree(folder)
    (folder / "0").mkdir(parents=True)
    found.write_text(folder)
    found.write_binary(folder / "0")
