"""The surface of a depth map as triangles, textured by its own picture."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.base.errors import ReconstructionError
from alice_survey.base.frames import Array
from alice_survey.base.run import progress
from reconstruct.mesh.atlas import Wedges
from reconstruct.mesh.decimate import decimate
from reconstruct.mesh.formats import GLB_AXES, write_glb, write_mesh_ply, write_obj
from reconstruct.mesh.texture import Textured, write_jpeg
from reconstruct.mesh.topology import Triangles, split_fans, without_folds
from reconstruct.station.precise import remapped
from reconstruct.views.model import View

_MOST_VERTICES = 600_000
_STEEPEST = 8.0
"""Change of depth over the length of a side across the picture beyond which a side is a jump."""
_ERROR_SIGMAS = 0.3
_GROWTH = 1.4


@dataclass(frozen=True, kw_only=True, eq=False)
class StationMesh:
    """Triangles in the world of the pair."""

    vertices: Array
    """(V, 3) vertices."""
    triangles: Triangles
    """(T, 3) counter-clockwise seen from the camera."""


@progress.step("make the mesh")
def depth_mesh(
    view: View, depth: NDArray[np.float32], sigma: NDArray[np.float32], most: int
) -> StationMesh:
    """Triangles between the pixels of a depth map, without those across jumps, decimated.

    Args:
        view: of the depth.
        depth: (H, W), NaN where unknown: holes stay holes.
        sigma: (H, W) of it: the mesh keeps within a share of its median.
        most: triangles.

    Raises:
        ReconstructionError: no triangle is left.
    """
    step = max(1, int(np.ceil(np.sqrt(np.isfinite(depth).sum() / _MOST_VERTICES))))
    thinned = depth[::step, ::step].astype(np.float64)
    rows, columns = np.nonzero(np.isfinite(thinned))
    pixels: Array = np.column_stack([columns, rows]) * float(step) + np.array([0.5, 0.5])
    vertices = view.at_depth(pixels, thinned[rows, columns])
    number = np.full(thinned.shape, -1, np.int32)
    number[rows, columns] = np.arange(len(rows), dtype=np.int32)
    a, b = number[:-1, :-1].ravel(), number[:-1, 1:].ravel()
    c, d = number[1:, :-1].ravel(), number[1:, 1:].ravel()
    # seen from the camera y points down: a, c, b turns left
    triangles = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
    triangles = triangles[(triangles >= 0).all(axis=1)]
    z = thinned[rows, columns][triangles]
    side = z.mean(axis=1) * step / np.sqrt(view.fx_px * view.fy_px)
    triangles = triangles[np.ptp(z, axis=1) <= _STEEPEST * side]
    triangles = without_folds(vertices, triangles)
    if not len(triangles):
        raise ReconstructionError("the pair's depths are too scattered to carry a surface")
    vertices, triangles, _ = split_fans(vertices, triangles)
    error = _ERROR_SIGMAS * float(np.nanmedian(sigma))
    while True:
        fewer = decimate(vertices, triangles, np.zeros(len(vertices), np.bool_), error)
        vertices, triangles = fewer.vertices, fewer.triangles
        if len(triangles) <= most:
            break
        error *= _GROWTH
    triangles = without_folds(vertices, triangles)
    vertices, triangles, _ = split_fans(vertices, triangles)
    return StationMesh(vertices=vertices, triangles=triangles)


def write_station_mesh(
    folder: Path,
    mesh: StationMesh,
    view: View,
    colour: NDArray[np.uint8],
    facts: dict[str, Any],
) -> None:
    """Write `mesh.glb`, `mesh.obj` with `mesh.mtl` and `texture_0.jpg`, and `mesh.ply`."""
    page = folder / "texture_0.jpg"
    write_jpeg(page, colour)
    pixels = view.project(mesh.vertices)
    size = np.array([view.width_px, view.height_px], dtype=np.float64)
    uv = np.clip(pixels / size, 0.0, 1.0)
    uv[:, 1] = 1.0 - uv[:, 1]
    count = len(mesh.vertices)
    shown = remapped(colour, pixels, cv2.INTER_LINEAR, cv2.BORDER_REPLICATE)
    rgb = np.ascontiguousarray(shown[:, ::-1])
    vertices = mesh.vertices * [1.0, -1.0, -1.0]
    textured = Textured(
        vertices=vertices,
        wedges=Wedges(
            vertex=np.arange(count), chart=np.zeros(count, np.int32), triangles=mesh.triangles
        ),
        uv=uv,
        page=np.zeros(len(mesh.triangles), np.int32),
        pages=(page,),
        colours=rgb,
        label=np.zeros(len(mesh.triangles), np.int32),
        scale=1.0,
    )
    comments = [
        "origin at the left camera's entrance pupil, m",
        "x right, y up, z towards the camera",
    ]
    axes = GLB_AXES.replace("east", "right").replace("north", "up in the picture")
    about = {"unit": "m", "axes": axes, "left": facts["left"]}
    write_glb(folder / "mesh.glb", textured, about)
    write_obj(folder / "mesh.obj", textured, comments)
    write_mesh_ply(folder / "mesh.ply", vertices, mesh.triangles, rgb, comments)
