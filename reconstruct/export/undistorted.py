"""Pictures without refraction and distortion, beside a model of pinholes that is exact for them.

A camera behind a flat port has no single centre: a picture that is warped to a pinhole is exact at
one distance only. Here each pixel is taken from where the camera sees what the pinhole's ray meets
of the surface, so that every picture is that of a pinhole, of this surface.

nerfstudio's `transforms.json` holds poses, pinholes and first points of a splat or a radiance
field. Its convention (docs.nerf.studio, "Data conventions"): camera to world, with the camera's x
to the right, y up and z backwards (OpenGL); the world's z up.
"""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from alice_survey.core.artefacts import Stage, atomic_path, run_stage, write_json
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array
from reconstruct.evaluate.surface import read_mesh
from reconstruct.pictures.undistorted import Pictures
from reconstruct.ply import write_ply
from reconstruct.stages import MESH, PLACING
from reconstruct.views.model import SparseModel, View, points_of_views, read_model
from reconstruct.views.model_files import read_reconstruction

_ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])
_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"),
                   ("red", "u1"), ("green", "u1"), ("blue", "u1")])  # fmt: skip
_GREY = 128


def write_nerfstudio(folder: Path, model: SparseModel, names: Mapping[str, str]) -> None:
    """Write `transforms.json` and `points.ply` of exported pictures.

    Args:
        folder: with `images/` and `masks/`.
        model: of the pictures.
        names: of the exported pictures, by those of the views.
    """
    points = np.zeros(len(model.points_world), _POINT)
    points["x"], points["y"], points["z"] = (model.points_world @ _ENU_FROM_NED.T).T
    points["red"] = points["green"] = points["blue"] = _GREY
    write_ply(folder / "points.ply", [points], ["sparse points: east, north, up"])
    frames = [
        {
            "file_path": f"images/{names[view.image]}",
            "mask_path": f"masks/{names[view.image]}.png",
            "fl_x": view.pinhole.fx_px,
            "fl_y": view.pinhole.fy_px,
            "cx": view.pinhole.cx_px,
            "cy": view.pinhole.cy_px,
            "w": view.pinhole.width_px,
            "h": view.pinhole.height_px,
            "transform_matrix": world_from_gl(view).tolist(),
        }
        for view in model.views
    ]
    write_json(
        folder / "transforms.json",
        {"camera_model": "PINHOLE", "ply_file_path": "points.ply", "frames": frames},
    )


def world_from_gl(view: View) -> Array:
    """(4, 4) pose of a view's camera in OpenGL's axes, in a world of east, north, up."""
    pose = np.eye(4)
    pose[:3, :3] = _ENU_FROM_NED @ view.world_from_cam.rotation.as_matrix() @ _OPENCV_FROM_OPENGL
    pose[:3, 3] = _ENU_FROM_NED @ view.world_from_cam.translation
    return pose


FOLDER = "undistorted"
_NODE_PX = 4
"""Pixels between places at which a ray's way to the surface is computed."""
_WRITABLE = {".png", ".jpg", ".jpeg", ".tif", ".tiff"}
_QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 97]


@dataclass(frozen=True, kw_only=True)
class Exported:
    """One picture that was written."""

    on_surface: float
    """Share of it whose rays meet the surface; the others take the depth of the nearest that do."""
    size_px: tuple[int, int]


def export_undistorted(workspace: Path, executor: Executor) -> tuple[str, dict[str, Any]]:
    """Write pictures, masks, COLMAP's model and nerfstudio's `transforms.json` of a workspace.

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
        version=1,
        settings={},
        inputs=[sparse / "model", sparse / "cameras.json", sparse / "frame.json",
                workspace / "mesh" / "mesh.ply", workspace / "images"],
        resumes=True,
    )  # fmt: skip
    run_stage(workspace, stage, partial(_export, workspace, executor))
    folder = workspace / FOLDER
    pictures = sum(1 for path in (folder / "images").rglob("*") if path.is_file())
    text = (
        f"undistorted: {pictures} pictures with masks, COLMAP model (sparse/, sparse/0/) and "
        f"transforms.json in {folder}"
    )
    return text, {"pictures": pictures, "folder": str(folder)}


def _export(workspace: Path, executor: Executor, folder: Path) -> None:
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
    write_nerfstudio(folder, model, names)
    write_json(
        folder / "export.json",
        {
            "format": "alice-survey undistorted pictures",
            "version": 1,
            "frame": model.frame.name,
            "unit": model.frame.unit,
            "vertical_datum": model.frame.vertical_datum,
            "axes_of_sparse": ["north", "east", "down"],
            "axes_of_transforms": ["east", "north", "up"],
            "pictures": len(done),
            "on_surface": {
                names[view.image]: round(one.on_surface, 4)
                for view, one in zip(model.views, done, strict=True)
            },
            "notes": list(model.frame.notes),
        },
    )  # fmt: skip


def exported_name(image: str) -> str:
    """The name of an exported picture: that of the picture, as PNG where it is of a rare kind."""
    path = Path(image)
    return image if path.suffix.lower() in _WRITABLE else path.with_suffix(".png").as_posix()


def export_view(workspace: Path, folder: Path, task: tuple[View, float]) -> Exported:
    """Write a picture and its mask.

    Args:
        workspace: with the picture and the mesh.
        folder: to write into.
        task: the view, and its depth where it sees nothing of the mesh.
    """
    view, depth = task
    pictures, name = Pictures.still(workspace), exported_name(view.image)
    target = folder / "images" / name
    mask = folder / "masks" / f"{name}.png"
    width, height = view.pinhole.size_px
    surface = surface_depth(view, *scene_of(workspace / "mesh"))
    on_surface = float(np.isfinite(surface).mean())
    if mask.exists():  # of a run that was interrupted; it is written last
        return Exported(on_surface=on_surface, size_px=(width, height))
    x, y = taken_at(pictures, view, _fill(surface, depth))
    taken = pictures.as_taken(view.image)
    inside = (x >= 0) & (x <= taken.shape[1] - 1) & (y >= 0) & (y <= taken.shape[0] - 1)
    x, y = np.where(inside, x, np.float32(-10.0)), np.where(inside, y, np.float32(-10.0))
    colour = cv2.remap(taken, x, y, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
    usable = pictures.usable(view.image)
    if usable is not None:
        inside &= cv2.remap(usable.astype(np.uint8), x, y, cv2.INTER_NEAREST) > 0
    for path, values in ((target, np.where(inside[..., None], colour, np.uint8(0))),
                         (mask, inside.astype(np.uint8) * 255)):  # fmt: skip
        with atomic_path(path) as temporary:
            if not cv2.imwrite(str(temporary), values, _QUALITY):
                raise OSError(f"{path}: cannot be written")
    return Exported(on_surface=on_surface, size_px=(width, height))


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
    found: Array = np.where(np.isfinite(depth), depth, np.nan).reshape(pixels.shape[:2])
    return found


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
    rows, columns = values.shape
    inside = (x >= 0) & (y >= 0) & (x <= columns - 1) & (y <= rows - 1)  # NaN compares as False
    x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
    column = np.clip(x.astype(np.int64), 0, columns - 2)
    row = np.clip(y.astype(np.int64), 0, rows - 2)
    p, q = x - column, y - row
    above = values[row, column] * (1 - p) + values[row, column + 1] * p
    below = values[row + 1, column] * (1 - p) + values[row + 1, column + 1] * p
    found: Array = np.where(inside, above * (1 - q) + below * q, np.nan)
    return found


def _fill(depth: Array, otherwise: float) -> Array:
    """Depths whose holes have that of the nearest known node."""
    known = np.isfinite(depth)
    if not known.any():
        return np.full(depth.shape, otherwise)
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    filled: Array = depth[tuple(nearest)]
    return filled


def scene_of(mesh: Path) -> tuple[Any, Array]:
    """The mesh of a folder to cast rays at, and the origin (3,) of its coordinates in the world."""
    return _scene(mesh, (mesh / "mesh.ply").stat().st_mtime_ns)


@lru_cache(maxsize=1)
def _scene(mesh: Path, written_ns: int) -> tuple[Any, Array]:
    import open3d as o3d

    vertices, triangles = read_mesh(mesh)
    origin = vertices.mean(axis=0)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor.from_numpy((vertices - origin).astype(np.float32)),
        o3d.core.Tensor.from_numpy(np.ascontiguousarray(triangles.astype(np.uint32))),
    )
    return scene, origin


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
